"""The slow, simple renderer that the fast one is tested against: every ray is marched over the curved Moon itself.

It shares with the fast one the terrain's tiles and the photometric law, and nothing of the geometry: no tangent grid,
no sweep, no interpolated map coordinates, double precision throughout.  Slopes are differences over two pixels of the
terrain's level in both, for that is part of what a picture of this terrain means.
"""

import math

import numpy as np
import numpy.typing as npt

from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from lunar.frames import spherical_from_mcmf
from payload_emulator.errors import TerrainError
from payload_emulator.sim.render._raymarch_kernel import Ground, Surface, march
from payload_emulator.sim.render.light import SUN_ANGULAR_RADIUS_RAD
from payload_emulator.sim.render.photometry import Photometry
from payload_emulator.sim.render.renderer import Rendering
from payload_emulator.sim.terrain.tiles import MEAN_ALBEDO, MEASURE_LEVEL, Terrain, TerrainPatch

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
    level = terrain.level_for(height_above_ground_m("raymarch", terrain, position) / camera.focal_px)
    v, u = np.mgrid[0 : camera.height_px : every, 0 : camera.width_px : every]
    rays = camera.rays(np.stack([u, v], axis=-1).astype(np.float64)) @ rotation
    patch = terrain.patch(*rays_window(camera, position, rotation, sun), level)
    radiance, lit, range_m = (np.empty(u.shape, np.float32) for _ in range(3))
    march(
        position,
        np.ascontiguousarray(rays),
        sun,
        _ground(patch),
        SUN_ANGULAR_RADIUS_RAD,
        Surface(photometry.tables(), photometry.law == "hapke", MEAN_ALBEDO, photometry.albedo_contrast),
        radiance,
        lit,
        range_m,
    )
    return Rendering(radiance, lit, range_m)


def height_above_ground_m(renderer: str, terrain: Terrain, position_mcmf_m: FloatArray) -> float:
    """Height of a camera at a position (3,) above the ground below it; TerrainError below 50 m."""
    latitude, longitude, altitude = (float(value) for value in spherical_from_mcmf(position_mcmf_m))
    ground = float(terrain.height_m(latitude, longitude, MEASURE_LEVEL))
    if altitude <= ground + 50.0:
        raise TerrainError(
            f"{renderer}: expected a camera above the ground, found it {altitude - ground:.0f} m above terrain "
            f"of {ground:.0f} m"
        )
    return altitude - ground


def cast(
    terrain: Terrain,
    camera: PinholeCamera,
    position_mcmf_m: npt.ArrayLike,
    camera_from_mcmf: npt.ArrayLike,
    uv_px: npt.ArrayLike,
) -> FloatArray:
    """Return where the rays of picture points (n, 2), inside or not far outside, meet the ground: (n, 3) in MCMF,
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
    march(
        position,
        np.ascontiguousarray(rays[None]),
        overhead,
        _ground(patch),
        SUN_ANGULAR_RADIUS_RAD,
        Surface(Photometry().tables(), False, MEAN_ALBEDO, 1.0),
        radiance,
        lit,
        range_m,
    )
    return np.asarray(position + rays * range_m[0, :, None])


def _ground(patch: TerrainPatch) -> Ground:
    where = (patch.first_row, patch.first_column, patch.pixels_per_radian)
    return Ground(patch.heights, patch.albedo, patch.table, *where, patch.low_m, patch.high_m)


def rays_window(
    camera: PinholeCamera, position: FloatArray, rotation: FloatArray, sun: FloatArray
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
