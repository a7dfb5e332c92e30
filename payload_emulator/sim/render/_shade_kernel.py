"""Compiled shading of the pixels of a frame: place on the terrain, slope, albedo, reflectance, sunlight.

The Sun stands at -x of the tangent frame: its vector is (-sun_flat, 0, sun_up). Slopes come from the terrain's own
pixels: the tangent grid would blur them once more.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lunar._compile import njit
from lunar.arrays import Float32Array, Int32Array
from lunar.constants import MOON_RADIUS_M
from payload_emulator.sim.render._grid_kernel import INLINED, LINE, NODE_STEP, Grid, Nodes, Tiles
from payload_emulator.sim.render._trace_kernel import Eye

# Columns of the work buffer of a row of pixels: depth along the boresight (then range), place in the tangent frame,
# fractions of the grid's and of the nodes' row and column, height of the ground, its rise out of shadow, phase.
(
    _DEPTH, _X, _Y, _Z, _ROW_PART, _COLUMN_PART, _NODE_ROW_PART, _NODE_COLUMN_PART, _HEIGHT, _RISE, _PHASE,
) = (LINE * k for k in range(11))  # fmt: skip
_WORK = 11 * LINE
# What later loops put where it is no longer needed: slopes and albedo after the look-ups, then the terms of the law.
_SLOPE_X, _SLOPE_Y, _ALBEDO = _ROW_PART, _COLUMN_PART, _NODE_ROW_PART
_LAMBERT, _SEELIGER, _MULTIPLE, _SUN = _X, _Y, _Z, _RISE
# Columns of its whole numbers: cell of the grid, cell of the nodes.
_CELL, _NODE = 0, LINE
_PLACES = 2 * LINE

_SMALLEST_MU = np.float32(0.02)
_GAMMA = np.float32(math.sqrt(1.0 - 0.21))
_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_INVERSE_RADIUS = np.float32(1.0 / MOON_RADIUS_M)
_SHARE = np.float32(1.0 / NODE_STEP)


class Surface(NamedTuple):
    """Albedo of the patch's tiles (n, side, side), binary logarithm of height pixels to one of it, mean, contrast."""

    albedo: NDArray[Any]
    step: int
    mean: float
    contrast: float


class Light(NamedTuple):
    """Sine and cosine of the Sun's elevation, tables of the photometric law (3, n), and whether that is Hapke's."""

    sun_up: float
    sun_flat: float
    law: Float32Array
    hapke: bool


class Rays(NamedTuple):
    """Rays of a row of pixels in the tangent frame: (a + b) per column, c per row of a lens shift, and the image plane.

    The ray of column k is a k + b; ``left`` is the image coordinate of the first column, ``per_pixel`` its step,
    ``below`` that of the row.
    """

    ax: np.float32
    ay: np.float32
    az: np.float32
    bx: np.float32
    by: np.float32
    bz: np.float32
    cx: np.float32
    cy: np.float32
    cz: np.float32
    left: np.float32
    below: float
    per_pixel: np.float32


class Cells(NamedTuple):
    """Camera on the grid (row, column), texels per metre, altitude; last row and column of nodes; lengths of rows."""

    i0: np.float32
    j0: np.float32
    inverse: np.float32
    altitude: np.float32
    last_ni: np.int32
    last_nj: np.int32
    stride: np.int32
    node_stride: np.int32


@njit(fastmath=True, error_model="numpy", nogil=True)
def shade_pixels(
    depth: Float32Array,
    grid: Grid,
    eye: Eye,
    light: Light,
    nodes: Nodes,
    tiles: Tiles,
    surface: Surface,
    shift_u: Float32Array | None,
    shift_v: Float32Array | None,
    radiance: Float32Array,
    lit: Float32Array,
    range_m: Float32Array,
) -> None:
    """Fill the images from ``range_m``, which comes as the depth along the boresight.

    Parameters
    ----------
    depth
        Rise of the grid's ground out of shadow, in half widths of the penumbra.
    shift_u, shift_v
        Shifts (H, W) of pixels by the lens; None for a lens without distortion.
    """
    wide = radiance.shape[1]
    work = np.empty(_WORK, np.float32)
    places = np.empty(_PLACES, np.int32)
    cells = Cells(
        np.float32(-grid.x0_m / grid.texel_m),
        np.float32(-grid.y0_m / grid.texel_m),
        np.float32(1.0 / grid.texel_m),
        np.float32(eye.altitude_m),
        np.int32(nodes.row.shape[0] - 2),
        np.int32(nodes.row.shape[1] - 2),
        np.int32(depth.shape[1]),
        np.int32(nodes.row.shape[1]),
    )
    for v in range(radiance.shape[0]):
        rays = _rays_of(eye, v)
        # One test for both shifts, which numba resolves when it compiles; `shift_v` is given with `shift_u`.
        # As in `_trace_kernel`: look-ups apart from arithmetic.
        for k in range(wide):
            work[k + _DEPTH] = range_m[v, k]
        if shift_u is None:
            _place_row(work, places, rays, cells, wide)
        else:
            _place_shifted_row(work, places, rays, cells, wide, shift_u, shift_v, v)  # type: ignore[arg-type]
        _look_up_row(work, places, depth, nodes, tiles, surface, grid, wide)
        if shift_u is None:
            _reflect_row(work, rays, light, wide)
        else:
            _reflect_shifted_row(work, rays, light, wide, shift_u, shift_v, v)  # type: ignore[arg-type]
        _write_row(work, light, radiance, lit, range_m, v)


@njit(**INLINED)
def _rays_of(eye: Eye, v: int) -> Rays:
    """Return the rays of a row of pixels."""
    rotation, focal = eye.tangent_from_camera, eye.focal_px
    b = (v - eye.centre_v_px) / focal
    a = -eye.centre_u_px / focal
    return Rays(
        np.float32(rotation[0, 0] / focal),
        np.float32(rotation[1, 0] / focal),
        np.float32(rotation[2, 0] / focal),
        np.float32(rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2]),
        np.float32(rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2]),
        np.float32(rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2]),
        np.float32(rotation[0, 1] / focal),
        np.float32(rotation[1, 1] / focal),
        np.float32(rotation[2, 1] / focal),
        np.float32(a),
        b,
        np.float32(1.0 / focal),
    )


@njit(**INLINED)
def _place_row(work: Float32Array, places: Int32Array, rays: Rays, cells: Cells, wide: int) -> None:
    """Put the places that a row of pixels sees into the buffers."""
    ax, ay, az, bx, by, bz, _, _, _, _, _, _ = rays
    for k in range(wide):
        c = np.float32(k)
        t = max(work[k + _DEPTH], _ZERO)
        x = t * (ax * c + bx)
        y = t * (ay * c + by)
        z = cells.altitude + t * (az * c + bz)
        _keep_place(work, places, cells, k, x, y, z)


@njit(**INLINED)
def _place_shifted_row(
    work: Float32Array,
    places: Int32Array,
    rays: Rays,
    cells: Cells,
    wide: int,
    shift_u: Float32Array,
    shift_v: Float32Array,
    v: int,
) -> None:
    """Do as `_place_row` for a lens that shifts its pixels."""
    ax, ay, az, bx, by, bz, cx, cy, cz, _, _, _ = rays
    for k in range(wide):
        c = np.float32(k)
        t = max(work[k + _DEPTH], _ZERO)
        c += shift_u[v, k]
        d = shift_v[v, k]
        x = t * (ax * c + cx * d + bx)
        y = t * (ay * c + cy * d + by)
        z = cells.altitude + t * (az * c + cz * d + bz)
        _keep_place(work, places, cells, k, x, y, z)


@njit(**INLINED)
def _keep_place(
    work: Float32Array, places: Int32Array, cells: Cells, k: int, x: np.float32, y: np.float32, z: np.float32
) -> None:
    """Put a place in the tangent frame into the buffers, with its cell of the grid and of the nodes, and its height."""
    i = max(cells.i0 + x * cells.inverse, _ZERO)
    j = max(cells.j0 + y * cells.inverse, _ZERO)
    whole_i = np.int32(i)
    whole_j = np.int32(j)
    ni = min(np.int32(i * _SHARE), cells.last_ni)
    nj = min(np.int32(j * _SHARE), cells.last_nj)
    lean = z * _INVERSE_RADIUS
    bend = (x * x + y * y) * _INVERSE_RADIUS * (_ONE - lean + lean * lean)
    places[k + _CELL] = whole_i * cells.stride + whole_j
    places[k + _NODE] = ni * cells.node_stride + nj
    work[k + _X] = x
    work[k + _Y] = y
    work[k + _Z] = z
    work[k + _ROW_PART] = i - np.float32(whole_i)
    work[k + _COLUMN_PART] = j - np.float32(whole_j)
    work[k + _NODE_ROW_PART] = i * _SHARE - np.float32(ni)
    work[k + _NODE_COLUMN_PART] = j * _SHARE - np.float32(nj)
    work[k + _HEIGHT] = z + _HALF * bend * (_ONE - _HALF * _HALF * bend * _INVERSE_RADIUS)


@njit(**INLINED)
def _look_up_row(
    work: Float32Array,
    places: Int32Array,
    depth: Float32Array,
    nodes: Nodes,
    tiles: Tiles,
    surface: Surface,
    grid: Grid,
    wide: int,
) -> None:
    """Put rise out of shadow, slopes along x and y and albedo of a row of pixels into the buffer.

    The slope is that of the heights between the four central differences about the place. Nothing is looked up for
    pixels without ground or in full shadow.
    """
    next_one = np.uint64(1)
    next_row = np.uint64(depth.shape[1])
    next_node_row = np.uint64(nodes.row.shape[1])
    scale = _HALF * (_SHARE * np.float32(1.0 / grid.texel_m))
    rises = depth.ravel()
    node_r = nodes.row.ravel()
    node_c = nodes.column.ravel()
    slope_r = nodes.row_slope.ravel()
    slope_c = nodes.column_slope.ravel()
    for k in range(wide):
        if work[k + _DEPTH] < _ZERO:
            work[k + _RISE] = -_TWO
            continue
        m = np.uint64(places[k + _CELL])
        fi = work[k + _ROW_PART]
        fj = work[k + _COLUMN_PART]
        top = rises[m] + fj * (rises[m + next_one] - rises[m])
        m += next_row
        low = rises[m] + fj * (rises[m + next_one] - rises[m])
        rise = top + fi * (low - top)
        work[k + _RISE] = rise
        if rise <= -_ONE:
            continue
        # Place on the terrain's grid and how it changes along x and y.
        m = np.uint64(places[k + _NODE])
        m1 = m + next_one
        m2 = m + next_node_row
        m3 = m2 + next_one
        ti = work[k + _NODE_ROW_PART]
        tj = work[k + _NODE_COLUMN_PART]
        h = work[k + _HEIGHT]
        r00 = node_r[m] + h * slope_r[m]
        r01 = node_r[m1] + h * slope_r[m1]
        r10 = node_r[m2] + h * slope_r[m2]
        r11 = node_r[m3] + h * slope_r[m3]
        c00 = node_c[m] + h * slope_c[m]
        c01 = node_c[m1] + h * slope_c[m1]
        c10 = node_c[m2] + h * slope_c[m2]
        c11 = node_c[m3] + h * slope_c[m3]
        ra = r00 + tj * (r01 - r00)
        rb = r10 + tj * (r11 - r10)
        ca = c00 + tj * (c01 - c00)
        cb = c10 + tj * (c11 - c10)
        r = ra + ti * (rb - ra)
        c = ca + ti * (cb - ca)
        along_row, along_column = _differences(tiles.pool, tiles.table, tiles.shift, r, c)
        work[k + _SLOPE_X] = scale * (along_row * (rb - ra) + along_column * (cb - ca))
        work[k + _SLOPE_Y] = scale * (
            along_row * (r01 - r00 + ti * (r11 - r10 - r01 + r00))
            + along_column * (c01 - c00 + ti * (c11 - c10 - c01 + c00))
        )
        work[k + _ALBEDO] = _albedo(surface, tiles.table, tiles.shift, r, c)


@njit(**INLINED)
def _differences(
    pool: Float32Array, table: Int32Array, shift: int, r: np.float32, c: np.float32
) -> tuple[np.float32, np.float32]:
    """Return twice the change of height per pixel along rows and columns of the terrain, bilinear between pixels."""
    mask = np.uint64((1 << shift) - 1)
    tile_shift = np.uint64(shift)
    next_one = np.uint64(1)
    next_two = np.uint64(2)
    p = np.uint64(r)
    q = np.uint64(c)
    fi = r - np.float32(p)
    fj = c - np.float32(q)
    slot = np.uint64(table[p >> tile_shift, q >> tile_shift])
    p = p & mask
    q = q & mask
    p1 = p + next_one
    q1 = q + next_one
    p2 = p + next_two
    q2 = q + next_two
    p3 = p2 + next_one
    q3 = q2 + next_one
    h11 = pool[slot, p1, q1]
    h12 = pool[slot, p1, q2]
    h21 = pool[slot, p2, q1]
    h22 = pool[slot, p2, q2]
    w11 = fi * fj
    w01 = fj - w11
    w10 = fi - w11
    w00 = _ONE - fi - w01
    along_row = w00 * (h21 - pool[slot, p, q1]) + w01 * (h22 - pool[slot, p, q2])
    along_row += w10 * (pool[slot, p3, q1] - h11) + w11 * (pool[slot, p3, q2] - h12)
    along_column = w00 * (h12 - pool[slot, p1, q]) + w01 * (pool[slot, p1, q3] - h11)
    along_column += w10 * (h22 - pool[slot, p2, q]) + w11 * (pool[slot, p2, q3] - h21)
    return along_row, along_column


@njit(**INLINED)
def _albedo(surface: Surface, table: Int32Array, shift: int, r: np.float32, c: np.float32) -> np.float32:
    """Return the albedo at a place on the terrain (row, column of heights), bilinear, its contrast scaled."""
    albedo = surface.albedo
    mean = np.float32(surface.mean)
    spread = np.float32(surface.contrast)
    scale = np.float32(1.0 / (1 << surface.step))
    mask = np.uint64((1 << (shift - surface.step)) - 1)
    tile_shift = np.uint64(shift)
    next_one = np.uint64(1)
    slot = np.uint64(table[np.uint64(r) >> tile_shift, np.uint64(c) >> tile_shift])
    r *= scale
    c *= scale
    p = np.uint64(r)
    q = np.uint64(c)
    fi = r - np.float32(p)
    fj = c - np.float32(q)
    p = p & mask
    q = q & mask
    p1 = p + next_one
    q1 = q + next_one
    a0 = albedo[slot, p, q] + fj * (albedo[slot, p, q1] - albedo[slot, p, q])
    a1 = albedo[slot, p1, q] + fj * (albedo[slot, p1, q1] - albedo[slot, p1, q])
    value: np.float32 = mean + spread * (a0 + fi * (a1 - a0) - mean)
    return value


@njit(**INLINED)
def _reflect_row(work: Float32Array, rays: Rays, light: Light, wide: int) -> None:
    """Put sunlight, phase and the terms of the photometric law of a row of pixels into the buffer, and ranges."""
    ax, ay, az, bx, by, bz, _, _, _, left, below_row, per_pixel = rays
    square = np.float32(below_row * below_row + 1.0)
    up = np.float32(light.sun_up)
    flat = np.float32(light.sun_flat)
    many = np.float32(light.law.shape[1] - 2)
    for k in range(wide):
        c = np.float32(k)
        gx, gy, norm = _slope(work, k)
        right = left + c * per_pixel
        length = np.float32(math.sqrt(right * right + square))
        reach = _ONE / length
        vx = -(ax * c + bx) * reach
        vy = -(ay * c + by) * reach
        vz = -(az * c + bz) * reach
        _reflect(work, k, gx, gy, norm, vx, vy, vz, length, up, flat, many)


@njit(**INLINED)
def _reflect_shifted_row(
    work: Float32Array,
    rays: Rays,
    light: Light,
    wide: int,
    shift_u: Float32Array,
    shift_v: Float32Array,
    v: int,
) -> None:
    """Do as `_reflect_row` for a lens that shifts its pixels."""
    ax, ay, az, bx, by, bz, cx, cy, cz, left, below_row, per_pixel = rays
    up = np.float32(light.sun_up)
    flat = np.float32(light.sun_flat)
    many = np.float32(light.law.shape[1] - 2)
    for k in range(wide):
        c = np.float32(k)
        gx, gy, norm = _slope(work, k)
        c += shift_u[v, k]
        d = shift_v[v, k]
        right = left + c * per_pixel
        below = np.float32(below_row) + d * per_pixel
        length = np.float32(math.sqrt(right * right + below * below + _ONE))
        reach = _ONE / length
        vx = -(ax * c + cx * d + bx) * reach
        vy = -(ay * c + cy * d + by) * reach
        vz = -(az * c + cz * d + bz) * reach
        _reflect(work, k, gx, gy, norm, vx, vy, vz, length, up, flat, many)


@njit(**INLINED)
def _slope(work: Float32Array, k: int) -> tuple[np.float32, np.float32, np.float32]:
    """Return the slopes of the ground in the tangent frame along x and y, and what makes its normal a unit vector."""
    x = work[k + _X]
    y = work[k + _Y]
    z = work[k + _Z] * _INVERSE_RADIUS
    gx = work[k + _SLOPE_X]
    gy = work[k + _SLOPE_Y]
    # The nodes hold places at fixed height; the ground's own rise moves the place a little.
    lean = _ONE / (_ONE + (gx * x + gy * y) * _INVERSE_RADIUS)
    stretch = _ONE + (work[k + _HEIGHT] * _INVERSE_RADIUS - z) * (_ONE - z)
    steep = _INVERSE_RADIUS * (_ONE - z + z * z)
    gx = gx * lean * stretch - x * steep
    gy = gy * lean * stretch - y * steep
    norm = _ONE / np.float32(math.sqrt(gx * gx + gy * gy + _ONE))
    return gx, gy, norm


@njit(**INLINED)
def _reflect(
    work: Float32Array,
    k: int,
    gx: np.float32,
    gy: np.float32,
    norm: np.float32,
    vx: np.float32,
    vy: np.float32,
    vz: np.float32,
    length: np.float32,
    up: np.float32,
    flat: np.float32,
    many: np.float32,
) -> None:
    """Put sunlight, phase, terms of the law and range of a pixel into the buffer.

    With the cosines mu0 of incidence and mu of emission the terms are: Lambert, mu0; Lommel-Seeliger, mu0 / (mu0 + mu);
    multiple scattering, the latter times H(mu0) H(mu) with H(x) = (1 + 2 x) / (1 + 2 x gamma), gamma = sqrt(1 - w), w
    = 0.21.

    Parameters
    ----------
    gx, gy, norm
        Slopes of the ground, and the inverse length of its normal (-gx, -gy, 1).
    vx, vy, vz
        Unit vector to the camera.
    length
        Range over depth along the boresight.
    many
        Largest place in the tables of the law.

    References
    ----------
    Hapke (1981), Bidirectional reflectance spectroscopy 1: Theory, J. Geophys. Res. 86.
    """
    mu0 = (gx * flat + up) * norm
    mu = max((vz - gx * vx - gy * vy) * norm, _SMALLEST_MU)
    s = min(work[k + _RISE], _ONE)
    sun = _HALF + s * (np.float32(0.75) - np.float32(0.25) * s * s)
    sun = sun if (s > -_ONE and mu0 > _ZERO) else _ZERO
    mu0 = max(mu0, _ZERO)
    both = mu0 / (mu0 + mu)
    h0 = (_ONE + _TWO * mu0) / (_ONE + _TWO * mu0 * _GAMMA)
    h1 = (_ONE + _TWO * mu) / (_ONE + _TWO * mu * _GAMMA)
    work[k + _SUN] = sun
    work[k + _PHASE] = min(max((vz * up - vx * flat + _ONE) * _HALF, _ZERO), _ONE) * many
    work[k + _LAMBERT] = mu0
    work[k + _SEELIGER] = both
    work[k + _MULTIPLE] = both * h0 * h1
    work[k + _DEPTH] = work[k + _DEPTH] * length if work[k + _DEPTH] >= _ZERO else np.float32(np.nan)


@njit(**INLINED)
def _write_row(
    work: Float32Array,
    light: Light,
    radiance: Float32Array,
    lit: Float32Array,
    range_m: Float32Array,
    v: int,
) -> None:
    """Fill a row of the images from the buffer and the tables of the photometric law over the phase."""
    law = light.law
    next_one = np.uint64(1)
    for k in range(radiance.shape[1]):
        sun = work[k + _SUN]
        lit[v, k] = sun
        range_m[v, k] = work[k + _DEPTH]
        value = _ZERO
        if sun > _ZERO:
            place = work[k + _PHASE]
            m = np.uint64(place)
            f = place - np.float32(m)
            seeliger = law[0, m] + f * (law[0, m + next_one] - law[0, m])
            lambert = law[1, m] + f * (law[1, m + next_one] - law[1, m])
            value = seeliger * work[k + _SEELIGER] + lambert * work[k + _LAMBERT]
            if light.hapke:
                value += law[2, m] * work[k + _MULTIPLE]
            value *= work[k + _ALBEDO] * sun
        radiance[v, k] = value
