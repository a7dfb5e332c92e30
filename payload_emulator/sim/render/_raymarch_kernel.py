"""Compiled ray march over the terrain's own grid; `raymarch` explains the frame (MCMF, metres)."""

import math
from typing import Any, NamedTuple

from numpy.typing import NDArray

from kernels.compiled import njit
from lunar.arrays import Float32Array, FloatArray, Int32Array
from lunar.constants import MOON_RADIUS_M
from payload_emulator.sim.terrain.tiles import ALBEDO_SHIFT, TILE_SHIFT

_BISECTIONS = 24
"""Halvings of the last stride of a ray: a stride of 50 m ends at micrometres."""

_FIRST_SHARE = 0.5
"""First step toward the Sun, and its steps on level ground, in pixels of the height grid."""

_LONGEST_SHADOW_M = 120.0e3
_LEAST_ACROSS = 0.05
_SMALLEST_MU = 0.02
_NEVER = 1.0e9


class Ground(NamedTuple):
    """Patch of terrain: heights and albedo by tile, table of tiles, first row and column, pixels per radian, limits."""

    heights: Float32Array
    albedo: NDArray[Any]
    table: Int32Array
    first_row: int
    first_column: int
    scale: float
    lowest_m: float
    highest_m: float


class Surface(NamedTuple):
    """Tables of the photometric law (3, n), whether it is Hapke's, mean albedo and scale of the departures from it."""

    law: Float32Array
    hapke: bool
    mean_albedo: float
    contrast: float


@njit(error_model="numpy")
def _row_column(ground: Ground, x: float, y: float, z: float) -> tuple[float, float]:
    """Return row and column of a point in the grid of heights."""
    latitude = math.atan2(z, math.sqrt(x * x + y * y))
    longitude = math.atan2(y, x)
    middle = (ground.first_column + (ground.table.shape[1] << TILE_SHIFT) / 2) / ground.scale
    longitude += 2.0 * math.pi * math.floor((middle - longitude) / (2.0 * math.pi) + 0.5)
    row = (0.5 * math.pi - latitude) * ground.scale - 0.5 - ground.first_row
    return row, longitude * ground.scale - 0.5 - ground.first_column


@njit(error_model="numpy")
def _height(ground: Ground, x: float, y: float, z: float) -> float:
    """Return the height of the ground under a point, bilinear in latitude and longitude."""
    heights = ground.heights
    r, c = _row_column(ground, x, y, z)
    i = math.floor(r)
    j = math.floor(c)
    slot = ground.table[i >> TILE_SHIFT, j >> TILE_SHIFT]
    fr = r - i
    fc = c - j
    mask = (1 << TILE_SHIFT) - 1
    i = (i & mask) + 1
    j = (j & mask) + 1
    top = (1.0 - fc) * heights[slot, i, j] + fc * heights[slot, i, j + 1]
    low = (1.0 - fc) * heights[slot, i + 1, j] + fc * heights[slot, i + 1, j + 1]
    height: float = (1.0 - fr) * top + fr * low
    return height


@njit(error_model="numpy")
def _albedo(ground: Ground, x: float, y: float, z: float) -> float:
    """Return the albedo under a point, bilinear."""
    albedo = ground.albedo
    step = 1 << (TILE_SHIFT - ALBEDO_SHIFT)
    row, column = _row_column(ground, x, y, z)
    r = row / step
    c = column / step
    i = math.floor(r)
    j = math.floor(c)
    slot = ground.table[i >> ALBEDO_SHIFT, j >> ALBEDO_SHIFT]
    fr = r - i
    fc = c - j
    mask = (1 << ALBEDO_SHIFT) - 1
    i &= mask
    j &= mask
    top = (1.0 - fc) * albedo[slot, i, j] + fc * albedo[slot, i, j + 1]
    low = (1.0 - fc) * albedo[slot, i + 1, j] + fc * albedo[slot, i + 1, j + 1]
    value: float = (1.0 - fr) * top + fr * low
    return value


@njit(error_model="numpy")
def march(
    position: FloatArray,
    rays: FloatArray,
    sun: FloatArray,
    ground: Ground,
    sun_radius: float,
    surface: Surface,
    radiance: Float32Array,
    lit: Float32Array,
    range_m: Float32Array,
) -> None:
    """Fill the images (H, W) by marching rays (H, W, 3) from a position (3,); sky has range NaN and radiance 0.

    Parameters
    ----------
    sun
        Unit vector to the Sun, shape (3,).
    sun_radius
        Angular radius of the Sun, rad.
    """
    for v in range(rays.shape[0]):
        for u in range(rays.shape[1]):
            ray = rays[v, u]
            radiance[v, u] = 0.0
            lit[v, u] = 0.0
            t = _hit(position, ray, ground)
            range_m[v, u] = t
            if not t >= 0.0:
                continue
            x, y, z = position[0] + t * ray[0], position[1] + t * ray[1], position[2] + t * ray[2]
            mx, my, mz = _normal(ground, x, y, z)
            mu0 = mx * sun[0] + my * sun[1] + mz * sun[2]
            mu = max(-(mx * ray[0] + my * ray[1] + mz * ray[2]), _SMALLEST_MU)
            if mu0 <= 0.0:
                continue
            bright = _sunlight(ground, sun, sun_radius, x, y, z)
            if bright <= 0.0:
                continue
            lit[v, u] = bright
            cosine = -(ray[0] * sun[0] + ray[1] * sun[1] + ray[2] * sun[2])
            shade = _albedo(ground, x, y, z)
            albedo = surface.mean_albedo + surface.contrast * (shade - surface.mean_albedo)
            radiance[v, u] = albedo * _reflected(surface, cosine, mu0, mu) * bright


@njit(error_model="numpy")
def _hit(position: FloatArray, ray: FloatArray, ground: Ground) -> float:
    """Return the range at which a ray meets the ground, NaN for the sky: strides, then halvings of the last one."""
    px, py, pz = position[0], position[1], position[2]
    dx, dy, dz = ray[0], ray[1], ray[2]
    # A quarter of a pixel of the height grid per step along the ray.
    stride = 0.25 * (MOON_RADIUS_M / ground.scale)
    top = MOON_RADIUS_M + ground.highest_m + 1.0
    bottom = MOON_RADIUS_M + ground.lowest_m - 1.0
    distance2 = px * px + py * py + pz * pz
    along = -(px * dx + py * dy + pz * dz)
    inside = along * along - distance2 + top * top
    if inside <= 0.0 or along <= 0.0:
        return math.nan
    t = max(along - math.sqrt(inside), 0.0)
    deep = along * along - distance2 + bottom * bottom
    stop = along - math.sqrt(deep) if deep > 0.0 else along + math.sqrt(inside)
    before = t
    hit = False
    # One step past the lowest ground, so that the last stretch is looked at too.
    while t <= stop + stride:
        x, y, z = px + t * dx, py + t * dy, pz + t * dz
        if math.sqrt(x * x + y * y + z * z) - MOON_RADIUS_M <= _height(ground, x, y, z):
            hit = True
            break
        before = t
        t += stride
    if not hit:
        return math.nan
    for _ in range(_BISECTIONS):
        middle = 0.5 * (before + t)
        x, y, z = px + middle * dx, py + middle * dy, pz + middle * dz
        if math.sqrt(x * x + y * y + z * z) - MOON_RADIUS_M <= _height(ground, x, y, z):
            t = middle
        else:
            before = middle
    hit_m: float = t
    return hit_m


@njit(error_model="numpy")
def _normal(ground: Ground, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the unit normal of the ground at a point, from the heights a pixel away on each side."""
    size = math.sqrt(x * x + y * y + z * z)
    ux, uy, uz = x / size, y / size, z / size
    flat = math.sqrt(ux * ux + uy * uy)
    ex, ey = -uy / flat, ux / flat
    nx, ny, nz = -uz * ey, uz * ex, ux * ey - uy * ex
    # One pixel each way: narrower to the east at higher latitudes, as the grid is.
    n = size / ground.scale
    b = n * flat
    east = _height(ground, x + b * ex, y + b * ey, z)
    west = _height(ground, x - b * ex, y - b * ey, z)
    north = _height(ground, x + n * nx, y + n * ny, z + n * nz)
    south = _height(ground, x - n * nx, y - n * ny, z - n * nz)
    ge, gn = (east - west) / (2.0 * b), (north - south) / (2.0 * n)
    mx = ux - ge * ex - gn * nx
    my = uy - ge * ey - gn * ny
    mz = uz - gn * nz
    norm = 1.0 / math.sqrt(mx * mx + my * my + mz * mz)
    return mx * norm, my * norm, mz * norm


@njit(error_model="numpy")
def _sunlight(ground: Ground, sun: FloatArray, sun_radius: float, x: float, y: float, z: float) -> float:
    """Return the share of the Sun's disc that a point sees: the smallest angle of its ray above the ground decides."""
    pixel = MOON_RADIUS_M / ground.scale
    top = MOON_RADIUS_M + ground.highest_m + 1.0
    rise = _NEVER
    s = _FIRST_SHARE * pixel
    while s < _LONGEST_SHADOW_M:
        qx, qy, qz = x + s * sun[0], y + s * sun[1], z + s * sun[2]
        far = math.sqrt(qx * qx + qy * qy + qz * qz)
        if far > top + 0.01 * s:
            break
        slant = (qx * sun[0] + qy * sun[1] + qz * sun[2]) / far
        across = math.sqrt(max(1.0 - slant * slant, 0.0))
        angle = (far - MOON_RADIUS_M - _height(ground, qx, qy, qz)) * across / s
        rise = min(rise, angle)
        if rise < -sun_radius:
            break
        s += _FIRST_SHARE * pixel / max(across, _LEAST_ACROSS)
    share = rise / sun_radius
    if share <= -1.0:
        return 0.0
    if share >= 1.0:
        return 1.0
    # Share of a disc above a straight horizon at `share` radii below its centre.
    return 0.5 + (share * math.sqrt(1.0 - share * share) + math.asin(share)) / math.pi


@njit(error_model="numpy")
def _reflected(surface: Surface, cosine: float, mu0: float, mu: float) -> float:
    """Return the reflectance of a white surface for a cosine of the phase angle; terms as in `_shade_kernel`."""
    law = surface.law
    place = min(max((cosine + 1.0) * 0.5, 0.0), 1.0) * (law.shape[1] - 2)
    k = int(place)
    f = place - k
    seeliger = law[0, k] + f * (law[0, k + 1] - law[0, k])
    lambert = law[1, k] + f * (law[1, k + 1] - law[1, k])
    value: float = seeliger * mu0 / (mu0 + mu) + lambert * mu0
    if surface.hapke:
        gamma = math.sqrt(1.0 - 0.21)
        many = (1.0 + 2.0 * mu0) / (1.0 + 2.0 * mu0 * gamma) * (1.0 + 2.0 * mu) / (1.0 + 2.0 * mu * gamma)
        value += law[2, k] * many * mu0 / (mu0 + mu)
    return value
