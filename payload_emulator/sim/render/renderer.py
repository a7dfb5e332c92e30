"""The fast renderer: heights in a grid turned to the Sun, shadows by sweeping it, then one pass over the pixels.

The tangent frame has its origin on the map sphere below the camera; its rows run away from the Sun (x), its columns
across (y), z is up along the local vertical, and z of the ground includes the fall of the curved Moon.  The Sun is so
far away that its direction is one in this frame, so the shadow of a whole line of ground is a running maximum: exact,
and a few milliseconds.  Far casters toward the Sun enter through a coarser grid first.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from lunar.arrays import FloatArray
from lunar.camera import BrownCamera, PinholeCamera
from lunar.constants import MOON_RADIUS_M
from lunar.frames import spherical_from_mcmf
from payload_emulator.errors import TerrainError
from payload_emulator.sim.render.light import SUN_ANGULAR_RADIUS_RAD
from payload_emulator.sim.render.photometry import Photometry
from payload_emulator.sim.terrain import tiles
from payload_emulator.sim.terrain.photograph import PhotographTerrain

Image = npt.NDArray[np.float32]

NODE_STEP = 32
"""Latitude and longitude are exact at every 32nd grid point and bilinear between: about 2 m off at most."""

TEXEL_PER_PIXEL = 0.65
SMALLEST_TEXEL_M = 60.0
COARSE_TEXELS = 4
"""Texel of the grid toward the Sun that only casts, in texels of the picture's."""

CASTER_RELIEF_M = 4500.0
"""A caster is taken to rise at most this far above the ground it shades."""

LONGEST_SHADOW_M = 75.0e3
LARGEST_GRID = 4095
NO_SHADOW_M = -1.0e6


@dataclass(frozen=True, eq=False, slots=True)
class Rendering:
    """One picture before the sensor.

    Attributes
    ----------
    radiance
        (H, W), 1.0 for a white Lambert surface under a perpendicular Sun; 0 in shadow and off the Moon.
    lit
        (H, W), share of the Sun's disc seen from the ground: 0 shadow, 1 full Sun.
    range_m
        (H, W), distance from the camera to the ground along the pixel's ray; NaN off the Moon.
    """

    radiance: Image
    lit: Image
    range_m: Image


@dataclass(frozen=True, eq=False, slots=True)
class TangentGrid:
    """A rectangle of ground in the Sun-turned frame: point (i, j) lies at ``x0 + i * texel``, ``y0 + j * texel``."""

    x0_m: float
    y0_m: float
    texel_m: float
    rows: int
    columns: int


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """The camera and the Sun in the tangent frame."""

    tangent_from_mcmf: FloatArray
    altitude_m: float
    tangent_from_camera: FloatArray
    sun_elevation_rad: float


def render(
    terrain: tiles.Terrain,
    camera: PinholeCamera,
    position_mcmf_m: npt.ArrayLike,
    camera_from_mcmf: npt.ArrayLike,
    sun_direction_mcmf: npt.ArrayLike,
    photometry: Photometry | None = None,
) -> Rendering:
    """Picture of the terrain from a position (3,) with attitude (3, 3) under a Sun at a unit vector (3,), all MCMF.

    A terrain renders for one thread: others open their own, which gives the same bits.

    Raises
    ------
    TerrainError
        The camera is in the ground, sees no ground, or sees ground the terrain does not hold.
    """
    photometry = photometry or Photometry()
    view = tangent_view(position_mcmf_m, camera_from_mcmf, sun_direction_mcmf)
    ground_m = float(terrain.height_m(*_below(position_mcmf_m), tiles.MEASURE_LEVEL))
    if view.altitude_m <= ground_m + 50.0:
        raise TerrainError(
            f"render: expected a camera above the ground, found it {view.altitude_m - ground_m:.0f} m above terrain "
            f"of {ground_m:.0f} m"
        )
    level = terrain.level_for((view.altitude_m - ground_m) / camera.focal_px)
    likely, surely = _fit_grid(terrain, camera, view, level)
    rendering = _render_grid(terrain, camera, view, likely, level, photometry)
    if np.isnan(rendering.range_m).any():
        # Ground deeper than what the border showed, or sky: look at everything that could be there.
        rendering = _render_grid(terrain, camera, view, surely, level, photometry)
    if isinstance(terrain, PhotographTerrain):
        sample_m = (view.altitude_m - ground_m) / camera.focal_px
        return photographed(terrain, camera, rendering, position_mcmf_m, camera_from_mcmf, sample_m)
    return rendering


PHOTOGRAPH_RADIANCE = 0.25
"""Radiance of the brightest photographed ground: that of sunlit ground under a low Sun, for a fixed exposure."""


def photographed(
    terrain: PhotographTerrain,
    camera: PinholeCamera,
    rendering: Rendering,
    position_mcmf_m: npt.ArrayLike,
    camera_from_mcmf: npt.ArrayLike,
    sample_m: float,
) -> Rendering:
    """A rendering whose light is that of the photograph where its pixels meet the ground; 0 outside the photograph.

    `sample_m` is the ground covered by a pixel below the camera.
    """
    u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = camera.rays(np.stack([u, v], axis=-1).astype(np.float64))
    ground = np.asarray(position_mcmf_m, dtype=np.float64) + rendering.range_m[..., None] * (
        rays @ np.asarray(camera_from_mcmf, dtype=np.float64)
    )
    latitude, longitude, _ = spherical_from_mcmf(ground)
    brightness = terrain.brightness(latitude, longitude, sample_m)
    return Rendering(np.nan_to_num(brightness) * np.float32(PHOTOGRAPH_RADIANCE), rendering.lit, rendering.range_m)


def _render_grid(
    terrain: tiles.Terrain, camera: PinholeCamera, view: View, grid: TangentGrid, level: int, photometry: Photometry
) -> Rendering:
    from payload_emulator.sim.render._grid_kernel import Grid, Nodes, Tiles, block_peaks, sweep_shadows
    from payload_emulator.sim.render._shade_kernel import Light, Surface, shade_pixels
    from payload_emulator.sim.render._trace_kernel import Viewpoint, trace_pixels, trace_shifted

    sunward = _sunward_grid(grid, view)
    # One patch for both grids: a second call could evict tiles of the first.
    grids = (grid,) if sunward is None else (grid, sunward)
    patch = terrain.patch(*_outline(view, *grids), level)
    nodes = _grid_nodes(grid, view, patch)
    heights = _heights(grid, nodes, patch)
    shadow = np.full(grid.columns, NO_SHADOW_M, np.float32)
    distance = np.zeros(grid.columns, np.float32)
    if sunward is not None:
        shadow, distance = _incoming_shadow(grid, sunward, view, patch)
    lit = np.empty_like(heights)
    sweep_shadows(
        heights,
        shadow,
        distance,
        grid.texel_m,
        math.tan(view.sun_elevation_rad),
        _penumbra(view.sun_elevation_rad),
        lit,
    )
    shape = (camera.height_px, camera.width_px)
    radiance, mask, range_m = (np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.float32))
    place = Grid(grid.x0_m, grid.y0_m, grid.texel_m)
    viewpoint = Viewpoint(
        view.altitude_m,
        np.ascontiguousarray(view.tangent_from_camera),
        camera.focal_px,
        camera.centre_px[0],
        camera.centre_px[1],
    )
    shift_u, shift_v = pixel_shifts(camera) if isinstance(camera, BrownCamera) else (None, None)
    peaks = block_peaks(heights)
    ground = (heights, peaks, float(heights.min()) - 1.0, float(peaks.max()) + 1.0, place, viewpoint)
    if shift_u is None or shift_v is None:
        trace_pixels(*ground, range_m)
    else:
        trace_shifted(*ground, shift_u, shift_v, range_m)
    shade_pixels(
        lit,
        place,
        viewpoint,
        Light(
            math.sin(view.sun_elevation_rad),
            math.cos(view.sun_elevation_rad),
            photometry.tables(),
            photometry.law == "hapke",
        ),
        Nodes(*nodes),
        Tiles(patch.heights, patch.table, tiles.TILE_SHIFT),
        Surface(patch.albedo, tiles.TILE_SHIFT - tiles.ALBEDO_SHIFT, tiles.MEAN_ALBEDO, photometry.albedo_contrast),
        shift_u,
        shift_v,
        radiance,
        mask,
        range_m,
    )
    return Rendering(radiance, mask, range_m)


def tangent_view(
    position_mcmf_m: npt.ArrayLike, camera_from_mcmf: npt.ArrayLike, sun_direction_mcmf: npt.ArrayLike
) -> View:
    """The tangent frame under a position, rows running away from the Sun."""
    position = np.asarray(position_mcmf_m, dtype=np.float64)
    sun = np.asarray(sun_direction_mcmf, dtype=np.float64)
    distance = float(np.linalg.norm(position))
    up = position / distance
    sine = float(np.clip(up @ sun, -1.0, 1.0))
    toward = sun - sine * up
    length = float(np.linalg.norm(toward))
    if length < 1.0e-6:
        # The Sun is overhead: any azimuth will do.
        toward = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
        length = float(np.linalg.norm(toward))
    away = -toward / length
    frame = np.stack([away, np.cross(up, away), up])
    return View(
        frame, distance - MOON_RADIUS_M, frame @ np.asarray(camera_from_mcmf, dtype=np.float64).T, math.asin(sine)
    )


def places_of_tangent(
    view: View, x_m: npt.NDArray[Any], y_m: npt.NDArray[Any], height_m: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Latitude and longitude of ground of a given height at (x, y) of the tangent frame; NaN past the limb."""
    radius = MOON_RADIUS_M + np.asarray(height_m, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        z = np.sqrt(radius**2 - x_m**2 - y_m**2)
    point = np.stack(np.broadcast_arrays(x_m, y_m, z), axis=-1) @ view.tangent_from_mcmf
    return np.arctan2(point[..., 2], np.hypot(point[..., 0], point[..., 1])), np.arctan2(point[..., 1], point[..., 0])


def _below(position_mcmf_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    latitude, longitude, _ = spherical_from_mcmf(np.asarray(position_mcmf_m, dtype=np.float64))
    return latitude, longitude


def highest_latitude_rad(
    camera: PinholeCamera,
    position_mcmf_m: npt.ArrayLike,
    camera_from_mcmf: npt.ArrayLike,
    sun_direction_mcmf: npt.ArrayLike,
) -> float:
    """Greatest absolute latitude of ground that a picture needs, shadows included, over relief of `CASTER_RELIEF_M`."""
    view = tangent_view(position_mcmf_m, camera_from_mcmf, sun_direction_mcmf)
    rays = _border_rays(camera, view)
    heights = -CASTER_RELIEF_M, min(CASTER_RELIEF_M, view.altitude_m - 1.0)
    reach = [rays[:, :2] * _reach(rays, view.altitude_m, height)[:, None] for height in heights]
    grid = _rectangle(np.concatenate([np.zeros((1, 2)), *reach]), camera, view.altitude_m, 3.0)
    sunward = _sunward_grid(grid, view)
    latitude, _, _ = _outline(view, *((grid,) if sunward is None else (grid, sunward)))
    return float(np.nanmax(np.abs(latitude)))


def _penumbra(elevation_rad: float) -> float:
    """Half width in height of a penumbra per metre of horizontal distance to its caster."""
    high = math.tan(min(elevation_rad + SUN_ANGULAR_RADIUS_RAD, 1.5))
    return 0.5 * (high - math.tan(min(elevation_rad, 1.5) - SUN_ANGULAR_RADIUS_RAD))


def _fit_grid(terrain: tiles.Terrain, camera: PinholeCamera, view: View, level: int) -> tuple[TangentGrid, TangentGrid]:
    """The rectangle that holds the ground in the picture as far as its border shows, and one that holds it surely."""
    low, high = -500.0, 500.0
    rays = _border_rays(camera, view)
    for _ in range(4):
        # Rays that pass the limb end where they are closest to the Moon: the horizon.
        reach = [_reach(rays, view.altitude_m, bound) for bound in (low, min(high, view.altitude_m - 1.0))]
        hits = np.concatenate([np.zeros((1, 2)), *(rays[:, :2] * r[:, None] for r in reach)])
        ground = view.altitude_m - 0.5 * (low + high)
        surely = _rectangle(hits, camera, ground, 3.0)
        patch = terrain.patch(*_outline(view, surely), level)
        if patch.low_m >= low and patch.high_m <= high:
            break
        low, high = min(low, patch.low_m), max(high, patch.high_m)
    hits = np.concatenate([np.zeros((1, 2)), *_border_hits(rays, view, patch)])
    return _rectangle(hits, camera, ground, 10.0), surely


def _border_rays(camera: PinholeCamera, view: View) -> FloatArray:
    """Unit directions (n, 3) in the tangent frame along the border of the picture."""
    u = np.linspace(-0.5, camera.width_px - 0.5, 33)
    v = np.linspace(-0.5, camera.height_px - 0.5, 33)
    edge = np.concatenate(
        [
            np.stack([u, np.full(33, -0.5)], axis=-1),
            np.stack([u, np.full(33, camera.height_px - 0.5)], axis=-1),
            np.stack([np.full(33, -0.5), v], axis=-1),
            np.stack([np.full(33, camera.width_px - 0.5), v], axis=-1),
        ]
    )
    return np.asarray(camera.rays(edge) @ view.tangent_from_camera.T)


def _reach(rays: FloatArray, altitude_m: float, height_m: npt.ArrayLike) -> FloatArray:
    """Range along rays to the sphere at a height; to the point closest to it for rays that miss."""
    radius = MOON_RADIUS_M + np.asarray(height_m, dtype=np.float64)
    above = altitude_m - np.asarray(height_m, dtype=np.float64)
    descent = -rays[:, 2] * (MOON_RADIUS_M + altitude_m)
    root = np.sqrt(np.maximum(descent**2 - above * (above + 2.0 * radius), 0.0))
    return np.asarray(np.maximum(descent - root, 0.0))


def _border_hits(rays: FloatArray, view: View, patch: tiles.TerrainPatch) -> list[FloatArray]:
    """Return where the rays meet the ground, (n, 2) per round of a fixed-point search, the settled rounds only."""
    from payload_emulator.sim.terrain import kernels

    height = np.zeros(rays.shape[0])
    hits = []
    for number in range(7):
        reach = _reach(rays, view.altitude_m, np.minimum(height, view.altitude_m - 1.0))
        place = rays[:, :2] * reach[:, None]
        if number >= 4:
            hits.append(place)
        rows, columns = patch.coordinates(*places_of_tangent(view, place[:, 0], place[:, 1], height))
        kernels.sample_pool(patch.heights, patch.table, tiles.TILE_SHIFT, rows, columns, height)
    return hits


def _rectangle(hits: FloatArray, camera: PinholeCamera, ground_m: float, spare_texels: float) -> TangentGrid:
    texel = max(TEXEL_PER_PIXEL * ground_m / camera.focal_px, SMALLEST_TEXEL_M)
    spare = spare_texels * texel
    (x_low, y_low), (x_high, y_high) = hits.min(axis=0) - spare, hits.max(axis=0) + spare
    rows = _whole_nodes((x_high - x_low) / texel)
    columns = _whole_nodes((y_high - y_low) / texel)
    if max(rows, columns) > LARGEST_GRID:
        raise TerrainError(
            f"render: expected a view of at most {LARGEST_GRID} x {LARGEST_GRID} grid points, "
            f"found {rows} x {columns}: the camera looks too near the horizon"
        )
    return TangentGrid(float(x_low), float(y_low), texel, rows, columns)


def _whole_nodes(length: float) -> int:
    return math.ceil(length / NODE_STEP) * NODE_STEP + 1


def _outline(view: View, *grids: TangentGrid) -> tuple[FloatArray, FloatArray, float]:
    """Places on a lattice over the rectangles, borders included, and its spacing, for finding the tiles they need."""
    latitudes, longitudes, spacing = [], [], 0.0
    for grid in grids:
        x = grid.x0_m + np.linspace(-1.0, grid.rows, 17) * grid.texel_m
        y = grid.y0_m + np.linspace(-1.0, grid.columns, 17) * grid.texel_m
        spacing = max(spacing, 0.5 * math.hypot(x[1] - x[0], y[1] - y[0]))
        # Ground far below or above the sphere lies off the sphere's place by height over radius: a few hundred metres.
        for level in (-9000.0, 11000.0):
            latitude, longitude = places_of_tangent(view, x[:, None], y[None, :], level)
            latitudes.append(latitude.ravel())
            longitudes.append(longitude.ravel())
    return np.concatenate(latitudes), np.concatenate(longitudes), spacing


def _grid_nodes(grid: TangentGrid, view: View, patch: tiles.TerrainPatch) -> tuple[Image, Image, Image, Image]:
    """Patch row and column of every 32nd grid point at height 0, and their change per metre of height."""
    i = np.arange((grid.rows - 1) // NODE_STEP + 1) * NODE_STEP
    j = np.arange((grid.columns - 1) // NODE_STEP + 1) * NODE_STEP
    x = grid.x0_m + i[:, None] * grid.texel_m
    y = grid.y0_m + j[None, :] * grid.texel_m
    low = patch.coordinates(*places_of_tangent(view, x, y, -2000.0))
    high = patch.coordinates(*places_of_tangent(view, x, y, 2000.0))
    return (
        np.asarray(0.5 * (low[0] + high[0]), dtype=np.float32),
        np.asarray(0.5 * (low[1] + high[1]), dtype=np.float32),
        np.asarray((high[0] - low[0]) / 4000.0, dtype=np.float32),
        np.asarray((high[1] - low[1]) / 4000.0, dtype=np.float32),
    )


def _heights(grid: TangentGrid, nodes: tuple[Image, Image, Image, Image], patch: tiles.TerrainPatch) -> Image:
    from payload_emulator.sim.render._grid_kernel import Grid, Nodes, Tiles, fill_grid

    heights = np.empty((grid.rows, grid.columns), np.float32)
    place = Grid(grid.x0_m, grid.y0_m, grid.texel_m)
    fill_grid(heights, Nodes(*nodes), Tiles(patch.heights, patch.table, tiles.TILE_SHIFT), place)
    return heights


def _sunward_grid(grid: TangentGrid, view: View) -> TangentGrid | None:
    """A coarser strip toward the Sun whose last row lies one fine texel before the grid; None under a high Sun."""
    tangent = math.tan(min(max(view.sun_elevation_rad, 1.0e-3), 1.5))
    length = min(CASTER_RELIEF_M / tangent, LONGEST_SHADOW_M)
    texel = COARSE_TEXELS * grid.texel_m
    if length < texel:
        return None
    rows = _whole_nodes(length / texel)
    columns = _whole_nodes(grid.columns / COARSE_TEXELS + 2)
    return TangentGrid(grid.x0_m - grid.texel_m - (rows - 1) * texel, grid.y0_m - texel, texel, rows, columns)


def _incoming_shadow(
    grid: TangentGrid, sunward: TangentGrid, view: View, patch: tiles.TerrainPatch
) -> tuple[Image, Image]:
    """Height of the shadow that falls on the grid's first row from ground nearer the Sun, and how far its caster is."""
    from payload_emulator.sim.render._grid_kernel import sweep_shadows

    heights = _heights(sunward, _grid_nodes(sunward, view, patch), patch)
    shadow = np.full(sunward.columns, NO_SHADOW_M, np.float32)
    distance = np.zeros(sunward.columns, np.float32)
    tangent, penumbra = math.tan(view.sun_elevation_rad), _penumbra(view.sun_elevation_rad)
    sweep_shadows(heights, shadow, distance, sunward.texel_m, tangent, penumbra, np.empty_like(heights))
    places = (np.arange(grid.columns) * grid.texel_m + grid.y0_m - sunward.y0_m) / sunward.texel_m
    index = np.arange(sunward.columns)
    return (
        np.asarray(np.interp(places, index, shadow), dtype=np.float32),
        np.asarray(np.interp(places, index, distance), dtype=np.float32),
    )


@lru_cache(maxsize=4)
def pixel_shifts(camera: BrownCamera) -> tuple[Image, Image]:
    """Return the undistorted less the distorted place of every pixel: u and v, each (H, W), in pixels."""
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px].astype(np.float64)
    ideal = camera.focal_px * camera.undistorted(np.stack([u, v], axis=-1)) + np.array(camera.centre_px)
    shift_u, shift_v = (ideal[..., 0] - u).astype(np.float32), (ideal[..., 1] - v).astype(np.float32)
    shift_u.setflags(write=False)
    shift_v.setflags(write=False)
    return shift_u, shift_v
