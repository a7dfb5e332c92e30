"""The slow, simple renderer that the fast one is tested against: every ray is marched over the curved Moon itself.

It shares with the fast one the terrain's tiles and the photometric law, and nothing of the geometry: no tangent grid,
no sweep, no interpolated map coordinates, double precision throughout.  Slopes are differences over two pixels of the
terrain's level in both, for that is part of what a picture of this terrain means.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from lunar._compile import njit
from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from lunar.frames import spherical_from_mcmf
from payload_emulator.errors import TerrainError
from payload_emulator.sim.render.light import SUN_ANGULAR_RADIUS_RAD
from payload_emulator.sim.render.photometry import Photometry
from payload_emulator.sim.render.renderer import Rendering
from payload_emulator.sim.terrain.tiles import ALBEDO_SHIFT, MEAN_ALBEDO, MEASURE_LEVEL, TILE_SHIFT, Terrain

SHADOW_REACH_M = 90.0e3
MARGIN_M = 6_000.0


def render(
    terrain: Terrain,
    camera: PinholeCamera,
    position_mcmf_m: npt.ArrayLike,
    camera_from_mcmf: npt.ArrayLike,
    sun_direction_mcmf: npt.ArrayLike,
    photometry: Photometry | None = None,
    every: int = 1,
) -> Rendering:
    """Picture of the terrain, as `renderer.render`; about a hundred times slower.

    ``every`` marches only each so-manieth pixel of each so-manieth row and returns the smaller picture of those.

    Raises
    ------
    TerrainError
        The camera is in the ground or sees ground the terrain does not hold.
    """
    photometry = photometry or Photometry()
    position = np.asarray(position_mcmf_m, dtype=np.float64)
    rotation = np.asarray(camera_from_mcmf, dtype=np.float64)
    sun = np.asarray(sun_direction_mcmf, dtype=np.float64)
    latitude, longitude, altitude = (float(value) for value in spherical_from_mcmf(position))
    ground = float(terrain.height_m(latitude, longitude, MEASURE_LEVEL))
    if altitude <= ground + 50.0:
        raise TerrainError(
            f"raymarch: expected a camera above the ground, found it {altitude - ground:.0f} m above terrain "
            f"of {ground:.0f} m"
        )
    level = terrain.level_for((altitude - ground) / camera.focal_px)
    v, u = np.mgrid[0 : camera.height_px : every, 0 : camera.width_px : every]
    rays = camera.rays(np.stack([u, v], axis=-1).astype(np.float64)) @ rotation
    places = rays_window(camera, position, rotation, sun)
    patch = terrain.patch(*places, level)
    radiance, lit, range_m = (np.empty(u.shape, np.float32) for _ in range(3))
    _march(
        position,
        np.ascontiguousarray(rays),
        sun,
        patch.heights,
        patch.albedo,
        patch.table,
        patch.first_row,
        patch.first_column,
        patch.pixels_per_radian,
        patch.low_m,
        patch.high_m,
        SUN_ANGULAR_RADIUS_RAD,
        photometry.tables(),
        photometry.law == "hapke",
        MEAN_ALBEDO,
        photometry.albedo_contrast,
        radiance,
        lit,
        range_m,
    )
    return Rendering(radiance, lit, range_m)


def cast(
    terrain: Terrain,
    camera: PinholeCamera,
    position_mcmf_m: npt.ArrayLike,
    camera_from_mcmf: npt.ArrayLike,
    uv_px: npt.ArrayLike,
) -> FloatArray:
    """Where the rays of picture points (n, 2), inside the picture or not far outside, meet the ground: (n, 3) in MCMF,
    NaN for the sky.  The same march, over the same level of detail, as that of `render`.
    """
    position = np.asarray(position_mcmf_m, dtype=np.float64)
    rotation = np.asarray(camera_from_mcmf, dtype=np.float64)
    rays = camera.rays(uv_px) @ rotation
    latitude, longitude, altitude = (float(value) for value in spherical_from_mcmf(position))
    ground = float(terrain.height_m(latitude, longitude))
    level = terrain.level_for((altitude - ground) / camera.focal_px)
    overhead = position / float(np.linalg.norm(position))
    patch = terrain.patch(*rays_window(camera, position, rotation, overhead), level)
    radiance, lit, range_m = (np.empty((1, rays.shape[0]), np.float32) for _ in range(3))
    _march(
        position,
        np.ascontiguousarray(rays[None]),
        overhead,
        patch.heights,
        patch.albedo,
        patch.table,
        patch.first_row,
        patch.first_column,
        patch.pixels_per_radian,
        patch.low_m,
        patch.high_m,
        SUN_ANGULAR_RADIUS_RAD,
        Photometry().tables(),
        False,
        MEAN_ALBEDO,
        1.0,
        radiance,
        lit,
        range_m,
    )
    return np.asarray(position + rays * range_m[0, :, None])


def rays_window(
    camera: PinholeCamera,
    position: FloatArray,
    rotation: FloatArray,
    sun: FloatArray,
) -> tuple[FloatArray, FloatArray, float]:
    """Places over all ground that any ray, toward the ground or on to the Sun, can pass, and their spacing."""
    edge = np.linspace(-0.5, 1.0, 9)
    u = np.linspace(-0.5, camera.width_px - 0.5, 13)
    v = np.linspace(-0.5, camera.height_px - 0.5, 13)
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)) @ rotation
    distance = float(np.linalg.norm(position))
    points = []
    for level in (-9_000.0, 0.0, 8_000.0):
        radius = MOON_RADIUS_M + level
        along = -rays @ position
        root = np.sqrt(np.maximum(along**2 - distance**2 + radius**2, 0.0))
        reach = np.maximum(along - root, 0.0)
        points.append(position + rays * reach[:, None])
    hits = np.concatenate(points)
    up = position / distance
    sine = float(up @ sun)
    length = min(SHADOW_REACH_M, MARGIN_M / max(math.tan(math.asin(min(sine, 1.0))), 0.02))
    flat = sun - sine * up
    flat = flat / max(float(np.linalg.norm(flat)), 1.0e-9)
    shadowed = [hits + flat * length * max(share, 0.0) for share in edge]
    latitude, longitude, _ = spherical_from_mcmf(np.concatenate(shadowed))
    span = max(float(np.ptp(hits @ axis)) for axis in np.eye(3))
    return latitude, longitude, max(span / 12.0, length / 6.0)


@njit(error_model="numpy")
def _height(
    heights: Any, table: Any, first_row: Any, first_column: Any, scale: Any, x: Any, y: Any, z: Any
) -> Any:
    """Height of the ground under a point, bilinear in latitude and longitude."""
    latitude = math.atan2(z, math.sqrt(x * x + y * y))
    longitude = math.atan2(y, x)
    middle = (first_column + (table.shape[1] << TILE_SHIFT) / 2) / scale
    longitude += 2.0 * math.pi * math.floor((middle - longitude) / (2.0 * math.pi) + 0.5)
    r = (0.5 * math.pi - latitude) * scale - 0.5 - first_row
    c = longitude * scale - 0.5 - first_column
    i = math.floor(r)
    j = math.floor(c)
    slot = table[i >> TILE_SHIFT, j >> TILE_SHIFT]
    fr = r - i
    fc = c - j
    mask = (1 << TILE_SHIFT) - 1
    i = (i & mask) + 1
    j = (j & mask) + 1
    top = (1.0 - fc) * heights[slot, i, j] + fc * heights[slot, i, j + 1]
    low = (1.0 - fc) * heights[slot, i + 1, j] + fc * heights[slot, i + 1, j + 1]
    return (1.0 - fr) * top + fr * low


@njit(error_model="numpy")
def _albedo(
    albedo: Any, table: Any, first_row: Any, first_column: Any, scale: Any, x: Any, y: Any, z: Any
) -> Any:
    """Albedo under a point, bilinear."""
    latitude = math.atan2(z, math.sqrt(x * x + y * y))
    longitude = math.atan2(y, x)
    middle = (first_column + (table.shape[1] << TILE_SHIFT) / 2) / scale
    longitude += 2.0 * math.pi * math.floor((middle - longitude) / (2.0 * math.pi) + 0.5)
    step = 1 << (TILE_SHIFT - ALBEDO_SHIFT)
    r = ((0.5 * math.pi - latitude) * scale - 0.5 - first_row) / step
    c = (longitude * scale - 0.5 - first_column) / step
    i = math.floor(r)
    j = math.floor(c)
    slot = table[i >> ALBEDO_SHIFT, j >> ALBEDO_SHIFT]
    fr = r - i
    fc = c - j
    mask = (1 << ALBEDO_SHIFT) - 1
    i &= mask
    j &= mask
    top = (1.0 - fc) * albedo[slot, i, j] + fc * albedo[slot, i, j + 1]
    low = (1.0 - fc) * albedo[slot, i + 1, j] + fc * albedo[slot, i + 1, j + 1]
    return (1.0 - fr) * top + fr * low


@njit(error_model="numpy")
def _march(
    position: Any,
    rays: Any,
    sun: Any,
    heights: Any,
    albedo: Any,
    table: Any,
    first_row: Any,
    first_column: Any,
    scale: Any,
    lowest: Any,
    highest: Any,
    sun_radius: Any,
    law: Any,
    hapke: Any,
    mean_albedo: Any,
    contrast: Any,
    radiance: Any,
    lit: Any,
    range_m: Any,
) -> None:
    # A quarter of a pixel of the height grid per step along the ray.
    pixel = MOON_RADIUS_M / scale
    stride = 0.25 * pixel
    top = MOON_RADIUS_M + highest + 1.0
    bottom = MOON_RADIUS_M + lowest - 1.0
    px, py, pz = position[0], position[1], position[2]
    distance2 = px * px + py * py + pz * pz
    for v in range(rays.shape[0]):
        for u in range(rays.shape[1]):
            dx, dy, dz = rays[v, u, 0], rays[v, u, 1], rays[v, u, 2]
            radiance[v, u] = 0.0
            lit[v, u] = 0.0
            range_m[v, u] = np.nan
            along = -(px * dx + py * dy + pz * dz)
            inside = along * along - distance2 + top * top
            if inside <= 0.0 or along <= 0.0:
                continue
            t = max(along - math.sqrt(inside), 0.0)
            deep = along * along - distance2 + bottom * bottom
            stop = along - math.sqrt(deep) if deep > 0.0 else along + math.sqrt(inside)
            before = t
            hit = False
            # One step past the lowest ground, so that the last stretch is looked at too.
            while t <= stop + stride:
                x, y, z = px + t * dx, py + t * dy, pz + t * dz
                ground = _height(heights, table, first_row, first_column, scale, x, y, z)
                if math.sqrt(x * x + y * y + z * z) - MOON_RADIUS_M <= ground:
                    hit = True
                    break
                before = t
                t += stride
            if not hit:
                continue
            for _ in range(24):
                middle = 0.5 * (before + t)
                x, y, z = px + middle * dx, py + middle * dy, pz + middle * dz
                ground = _height(heights, table, first_row, first_column, scale, x, y, z)
                if math.sqrt(x * x + y * y + z * z) - MOON_RADIUS_M <= ground:
                    t = middle
                else:
                    before = middle
            range_m[v, u] = t
            x, y, z = px + t * dx, py + t * dy, pz + t * dz
            size = math.sqrt(x * x + y * y + z * z)
            ux, uy, uz = x / size, y / size, z / size
            flat = math.sqrt(ux * ux + uy * uy)
            ex, ey = -uy / flat, ux / flat
            nx, ny, nz = -uz * ey, uz * ex, ux * ey - uy * ex
            # One pixel each way: narrower to the east at higher latitudes, as the grid is.
            n = size / scale
            b = n * flat
            east = _height(heights, table, first_row, first_column, scale, x + b * ex, y + b * ey, z)
            west = _height(heights, table, first_row, first_column, scale, x - b * ex, y - b * ey, z)
            north = _height(
                heights, table, first_row, first_column, scale, x + n * nx, y + n * ny, z + n * nz
            )
            south = _height(
                heights, table, first_row, first_column, scale, x - n * nx, y - n * ny, z - n * nz
            )
            ge, gn = (east - west) / (2.0 * b), (north - south) / (2.0 * n)
            mx = ux - ge * ex - gn * nx
            my = uy - ge * ey - gn * ny
            mz = uz - gn * nz
            norm = 1.0 / math.sqrt(mx * mx + my * my + mz * mz)
            mu0 = (mx * sun[0] + my * sun[1] + mz * sun[2]) * norm
            mu = max(-(mx * dx + my * dy + mz * dz) * norm, 0.02)
            if mu0 <= 0.0:
                continue
            # Toward the Sun: the smallest angle between the ray and the ground below it decides.
            rise = 1.0e9
            s = 0.5 * pixel
            while s < 120.0e3:
                qx, qy, qz = x + s * sun[0], y + s * sun[1], z + s * sun[2]
                far = math.sqrt(qx * qx + qy * qy + qz * qz)
                if far > top + 0.01 * s:
                    break
                slant = (qx * sun[0] + qy * sun[1] + qz * sun[2]) / far
                across = math.sqrt(max(1.0 - slant * slant, 0.0))
                ground = _height(heights, table, first_row, first_column, scale, qx, qy, qz)
                angle = (far - MOON_RADIUS_M - ground) * across / s
                rise = min(rise, angle)
                if rise < -sun_radius:
                    break
                s += 0.5 * pixel / max(across, 0.05)
            share = rise / sun_radius
            if share <= -1.0:
                continue
            bright = 1.0
            if share < 1.0:
                # Share of a disc above a straight horizon at `share` radii below its centre.
                bright = 0.5 + (share * math.sqrt(1.0 - share * share) + math.asin(share)) / math.pi
            lit[v, u] = bright
            place = min(max((-(dx * sun[0] + dy * sun[1] + dz * sun[2]) + 1.0) * 0.5, 0.0), 1.0) * (
                law.shape[1] - 2
            )
            k = int(place)
            f = place - k
            seeliger = law[0, k] + f * (law[0, k + 1] - law[0, k])
            lambert = law[1, k] + f * (law[1, k + 1] - law[1, k])
            value = seeliger * mu0 / (mu0 + mu) + lambert * mu0
            if hapke:
                gamma = math.sqrt(1.0 - 0.21)
                many = (
                    (1.0 + 2.0 * mu0)
                    / (1.0 + 2.0 * mu0 * gamma)
                    * (1.0 + 2.0 * mu)
                    / (1.0 + 2.0 * mu * gamma)
                )
                value += law[2, k] * many * mu0 / (mu0 + mu)
            shade = _albedo(albedo, table, first_row, first_column, scale, x, y, z)
            radiance[v, u] = (mean_albedo + contrast * (shade - mean_albedo)) * value * bright
