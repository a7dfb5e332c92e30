"""The scene that Blender's Cycles renders: a spherical cap displaced by the terrain, after section V-A of the paper.

Everything is in the east-north-up frame on the map sphere below the camera, in kilometres, so that what Blender keeps
in single precision is good to centimetres.  The scene is arrays and numbers only; Blender is not needed to make it.
"""

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from lunar.frames import enu_from_mcmf, mcmf_from_spherical, spherical_from_mcmf
from payload_emulator.errors import RendererError, TerrainError
from payload_emulator.sim.render.light import SUN_ANGULAR_RADIUS_RAD
from payload_emulator.sim.render.photometry import Photometry
from payload_emulator.sim.render.raymarch import height_above_ground_m, rays_window
from payload_emulator.sim.terrain.tiles import ALBEDO_SHIFT, MEAN_ALBEDO, TILE_PIXELS, TILE_SHIFT, Terrain, TerrainPatch

Image = npt.NDArray[np.float32]

GRID = 65
"""Vertices of the base mesh along latitude and longitude (paper V-A.1)."""

SMALLEST_HALF_EXTENT_RAD = math.radians(0.02)
LARGEST_HALF_EXTENT_RAD = math.radians(20.0)
"""Bounds of the cap, against degenerate footprints and views along the horizon (paper V-A.2)."""

LARGEST_TEXTURE = 8192
_ROWS_AT_ONCE = 128

FLAT_GROUND_BRIGHTNESS = 0.35
"""Filmic exposure brings flat ground of mean albedo to this scene brightness (0.18 is its middle gray)."""

MATT_SPECULAR_IOR = 1.05
"""Index of refraction of the paper's look: its Principled BSDF keeps a little gloss."""


@dataclass(frozen=True, slots=True)
class CyclesSettings:
    """Sampling and surface of Cycles.

    Attributes
    ----------
    samples
        Paths per pixel at most; adaptive sampling stops at ``noise_threshold`` before.
    pixels_per_polygon
        Size of the micropolygons that adaptive subdivision makes in view (paper: 0.5).
    offscreen_dicing
        Ground out of view, which only casts shadows, is this many times coarser.
    roughness
        Of the Principled BSDF: matt.
    terminator_offset
        Cycles' shadow terminator offset, against facets at the edge of shadow.
    diffuse_bounces
        Light from sunlit slopes into shadow.
    filter_px
        Width of the Blackman-Harris filter that paths of a pixel are drawn from; Blender's own default.
    threads
        Of the render; 0 uses every core.
    """

    samples: int = 16
    noise_threshold: float = 0.01
    pixels_per_polygon: float = 0.5
    offscreen_dicing: float = 4.0
    roughness: float = 1.0
    terminator_offset: float = 0.05
    geometry_offset: float = 0.1
    diffuse_bounces: int = 3
    filter_px: float = 1.5
    denoise: bool = True
    threads: int = 0
    seed: int = 0


@dataclass(frozen=True, eq=False, slots=True)
class CyclesScene:
    """Complete input of Blender; lengths in km, east-north-up axes.

    Attributes
    ----------
    vertices_km, uv
        Base mesh (65, 65, 3), rows from south to north, and its texture places (65, 65, 2).
    displacement
        Heights (rows, columns), south first, as shares 0..1 of the patch's own range; 0.5 is its middle, the sphere
        that the base mesh lies on.
    displacement_range_km
        Height of 1 over 0.
    albedo
        Base colour of a matt surface (rows, columns), south first: the normal albedo times what the photometric law
        makes of it over Lambert's under this Sun from this place.
    camera_to_world, sun_to_world
        4 x 4; Blender's cameras and lamps look along their own -z, y up.
    fov_rad, width_px, height_px
        Of the pinhole camera, horizontal.
    sun_angle_rad
        Diameter of the Sun's disc.
    exposure_stops
        Of the Filmic picture.
    specular_ior
        Index of refraction of the Principled BSDF. The paper's look has one barely over 1, which still mirrors a
        quarter of the light of a Sun 6 deg up (Fresnel) onward into the picture; 1 mirrors nothing.
    """

    vertices_km: FloatArray
    uv: FloatArray
    displacement: Image
    displacement_range_km: float
    albedo: Image
    camera_to_world: FloatArray
    sun_to_world: FloatArray
    fov_rad: float
    width_px: int
    height_px: int
    sun_angle_rad: float
    exposure_stops: float
    specular_ior: float = 1.0

    def save(self, path: Path, settings: CyclesSettings) -> None:
        """Write the scene and how to render it for the process that runs Blender, one ``.npz``."""
        values: dict[str, Any] = {item.name: getattr(self, item.name) for item in fields(self)}
        values |= {f"set_{item.name}": getattr(settings, item.name) for item in fields(settings)}
        with path.open("wb") as file:
            np.savez(file, **values)


def describe_scene(
    terrain: Terrain,
    camera: PinholeCamera,
    position_mcmf_m: npt.ArrayLike,
    camera_from_mcmf: npt.ArrayLike,
    sun_direction_mcmf: npt.ArrayLike,
    photometry: Photometry | None = None,
) -> CyclesScene:
    """The scene of one picture; arguments as those of `renderer.render`.

    Blender's regolith is matt Lambert, which the law ``matt`` leaves as it is (the paper's look).  Of the other laws
    the ratio to it goes into the base colour, texel by texel: Sun and camera are the same for the whole picture.

    Raises
    ------
    TerrainError
        The camera is in the ground, or sees ground the terrain does not hold.
    RendererError
        The lens distorts: Cycles' cameras do not.
    """
    if type(camera) is not PinholeCamera:
        raise RendererError(
            "cycles: expected a lens without distortion, found one with; the renderers fast and raymarch have it"
        )
    position = np.asarray(position_mcmf_m, dtype=np.float64)
    rotation = np.asarray(camera_from_mcmf, dtype=np.float64)
    sun = np.asarray(sun_direction_mcmf, dtype=np.float64)
    latitude, longitude, altitude = (float(value) for value in spherical_from_mcmf(position))
    level = terrain.level_for(height_above_ground_m("cycles", terrain, position) / camera.focal_px)
    south, north, west, east = _bounds(terrain, camera, position, rotation, sun, longitude)
    photometry = photometry or Photometry()
    heights, albedo = _textures(terrain, south, north, west, east, level)
    albedo = MEAN_ALBEDO + photometry.albedo_contrast * (albedo - MEAN_ALBEDO)
    if photometry.law != "matt":
        albedo *= _law_over_lambert(heights, (south, north, west, east), position, sun, photometry)
    low, high = float(heights.min()), float(heights.max())
    span = max(high - low, 1.0)
    middle = 0.5 * (high + low)
    enu = enu_from_mcmf(latitude, longitude)
    origin = position * (MOON_RADIUS_M / float(np.linalg.norm(position)))
    share = np.linspace(0.0, 1.0, GRID)
    points = mcmf_from_spherical(
        (south + share * (north - south))[:, None], (west + share * (east - west))[None, :], middle
    )
    sine = float(position @ sun) / float(np.linalg.norm(position))
    return CyclesScene(
        vertices_km=(points - origin) @ enu.T / 1e3,
        uv=np.stack(np.broadcast_arrays(share[None, :], share[:, None]), axis=-1),
        displacement=np.asarray((heights - middle) / span + 0.5, dtype=np.float32),
        displacement_range_km=span / 1e3,
        albedo=np.asarray(np.clip(albedo, 0.0, 1.0), dtype=np.float32),
        camera_to_world=_camera_to_world(enu @ rotation.T, altitude),
        sun_to_world=_sun_to_world(enu @ sun),
        fov_rad=camera.fov_rad,
        width_px=camera.width_px,
        height_px=camera.height_px,
        sun_angle_rad=2.0 * SUN_ANGULAR_RADIUS_RAD,
        exposure_stops=math.log2(FLAT_GROUND_BRIGHTNESS / (MEAN_ALBEDO * max(sine, 0.02))),
        specular_ior=MATT_SPECULAR_IOR if photometry.law == "matt" else 1.0,
    )


def _bounds(
    terrain: Terrain,
    camera: PinholeCamera,
    position: FloatArray,
    rotation: FloatArray,
    sun: FloatArray,
    longitude: float,
) -> tuple[float, float, float, float]:
    """South, north, west and east of the cap: all ground in view and toward the Sun that can shade it."""
    latitudes, longitudes, spacing = rays_window(camera, position, rotation, sun)
    turn = 2.0 * math.pi
    longitudes = longitude + (longitudes - longitude + math.pi) % turn - math.pi
    south, north = float(latitudes.min()), float(latitudes.max())
    spare = 0.15 * spacing / MOON_RADIUS_M
    south, north = south - spare, north + spare
    spare /= math.cos(min(max(abs(south), abs(north)), 1.5))
    west, east = float(longitudes.min()) - spare, float(longitudes.max()) + spare
    limits = []
    for low, high in ((south, north), (west, east)):
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        if half > LARGEST_HALF_EXTENT_RAD:
            raise TerrainError(
                f"cycles: expected a view of at most {math.degrees(2.0 * LARGEST_HALF_EXTENT_RAD):.0f} deg of ground, "
                f"found {math.degrees(2.0 * half):.1f} deg: the camera looks too near the horizon or a pole"
            )
        half = max(half, SMALLEST_HALF_EXTENT_RAD)
        limits += [middle - half, middle + half]
    return limits[0], limits[1], limits[2], limits[3]


def _textures(
    terrain: Terrain, south: float, north: float, west: float, east: float, level: int
) -> tuple[FloatArray, FloatArray]:
    """Heights in metres and albedo over the cap, rows from south to north, at the pixels of the terrain's level."""
    from payload_emulator.sim.terrain import kernels

    lattice = np.linspace(0.0, 1.0, 25)
    latitude, longitude = np.broadcast_arrays(
        (south + lattice * (north - south))[:, None], (west + lattice * (east - west))[None, :]
    )
    spacing = 0.6 * MOON_RADIUS_M * max(north - south, east - west) / 24.0
    patch = terrain.patch(latitude.ravel(), longitude.ravel(), spacing, level)
    rows = math.ceil((north - south) * patch.pixels_per_radian)
    columns = math.ceil((east - west) * patch.pixels_per_radian)
    if max(rows, columns) > LARGEST_TEXTURE:
        raise TerrainError(
            f"cycles: expected a cap of at most {LARGEST_TEXTURE} terrain pixels a side, found {rows} x {columns}"
        )
    middle_latitude = south + (np.arange(rows) + 0.5) / rows * (north - south)
    middle_longitude = west + (np.arange(columns) + 0.5) / columns * (east - west)
    latitude, longitude = np.broadcast_arrays(middle_latitude[:, None], middle_longitude[None, :])
    r, c = patch.coordinates(latitude, longitude)
    heights = np.empty(rows * columns)
    kernels.sample_pool(patch.heights, patch.table, TILE_SHIFT, r.ravel(), c.ravel(), heights)
    return heights.reshape(rows, columns), _albedo(patch, r, c)


def _law_over_lambert(
    heights: FloatArray,
    bounds: tuple[float, float, float, float],
    position: FloatArray,
    sun: FloatArray,
    photometry: Photometry,
) -> Image:
    """Return the ratio of the law to a matt Lambert surface by texel; slopes over two texels."""
    south, north, west, east = bounds
    rows, columns = heights.shape
    latitude = south + (np.arange(rows) + 0.5) / rows * (north - south)
    longitude = west + (np.arange(columns) + 0.5) / columns * (east - west)
    ratio = np.empty((rows, columns), np.float32)
    for first in range(0, rows, _ROWS_AT_ONCE):
        block = slice(first, min(first + _ROWS_AT_ONCE, rows))
        with_edges = slice(max(first - 1, 0), min(block.stop + 1, rows))
        radius = MOON_RADIUS_M + heights[block]
        inner = slice(block.start - with_edges.start, block.stop - with_edges.start)
        to_north = np.gradient(heights[with_edges], (north - south) / rows, axis=0)[inner] / radius
        to_east = np.gradient(heights[block], (east - west) / columns, axis=1) / radius
        cos_latitude, sin_latitude = np.cos(latitude[block])[:, None], np.sin(latitude[block])[:, None]
        to_east /= cos_latitude
        norm = 1.0 / np.sqrt(1.0 + to_north**2 + to_east**2)
        axes = _local_axes(cos_latitude, sin_latitude, longitude)
        local = [x * sun[0] + y * sun[1] + z * sun[2] for x, y, z in axes]
        seen = [x * position[0] + y * position[1] + z * position[2] for x, y, z in axes]
        seen[2] = seen[2] - radius
        reach = 1.0 / np.sqrt(seen[0] ** 2 + seen[1] ** 2 + seen[2] ** 2)
        mu0 = (local[2] - to_east * local[0] - to_north * local[1]) * norm
        mu = (seen[2] - to_east * seen[0] - to_north * seen[1]) * norm * reach
        cos_phase = (local[0] * seen[0] + local[1] * seen[1] + local[2] * seen[2]) * reach
        ratio[block] = photometry.over_lambert(mu0, mu, cos_phase)
    return ratio


def _local_axes(
    cos_latitude: FloatArray, sin_latitude: FloatArray, longitude: FloatArray
) -> tuple[tuple[FloatArray, FloatArray, FloatArray], ...]:
    """East, north and up at latitudes (n, 1) and longitudes (m,) as MCMF components that broadcast to (n, m)."""
    cos_longitude, sin_longitude = np.cos(longitude)[None, :], np.sin(longitude)[None, :]
    zero = np.zeros((1, 1))
    return (
        (-sin_longitude, cos_longitude, zero),
        (-sin_latitude * cos_longitude, -sin_latitude * sin_longitude, cos_latitude),
        (cos_latitude * cos_longitude, cos_latitude * sin_longitude, sin_latitude),
    )


def _albedo(patch: TerrainPatch, rows: FloatArray, columns: FloatArray) -> FloatArray:
    """Albedo at patch coordinates, bilinear on the coarser albedo pixels."""
    step = TILE_PIXELS >> ALBEDO_SHIFT
    mask = (1 << ALBEDO_SHIFT) - 1
    r, c = rows / step, columns / step
    i, j = np.floor(r).astype(np.int64), np.floor(c).astype(np.int64)
    fr, fc = r - i, c - j
    slot = patch.table[i >> ALBEDO_SHIFT, j >> ALBEDO_SHIFT]
    i, j = i & mask, j & mask
    pool = patch.albedo
    top = (1.0 - fc) * pool[slot, i, j] + fc * pool[slot, i, j + 1]
    low = (1.0 - fc) * pool[slot, i + 1, j] + fc * pool[slot, i + 1, j + 1]
    return np.asarray((1.0 - fr) * top + fr * low, dtype=np.float64)


def _camera_to_world(enu_from_camera: FloatArray, altitude_m: float) -> FloatArray:
    """Blender's camera has y up and looks along -z: the camera frame's y and z turned about."""
    matrix = np.eye(4)
    matrix[:3, :3] = enu_from_camera @ np.diag([1.0, -1.0, -1.0])
    matrix[2, 3] = altitude_m / 1e3
    return matrix


def _sun_to_world(sun_enu: FloatArray) -> FloatArray:
    """A lamp shines along its -z, so its z points to the Sun; how it is rolled does not matter."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(sun_enu[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(helper, sun_enu)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, np.cross(sun_enu, x), sun_enu], axis=1)
    return matrix
