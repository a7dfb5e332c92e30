"""Places, light and cameras of the frames of a data set: seeded draws.

Everything is drawn from the generator passed in, in a fixed order, so that a shard's frames follow from its number.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lunar.arrays import FloatArray
from lunar.boxes import Box, inside_box
from lunar.camera import PinholeCamera, ground_point_sphere, nadir_camera_from_mcmf
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from payload_emulator.errors import DatasetError
from payload_emulator.session.world.recipe import Source

_ATTEMPTS = 4000
_LOWEST_FLIGHT_M = 9_000.0  # above the ground: lower, a 5 km crater fills more than a sixth of the frame
_LAWS = ("lunar-lambert", "lambert", "hapke")
_LAW_SHARES = (0.5, 0.25, 0.25)
_SHARD_REACH_DEG = 2.5  # frames of a shard look at neighbouring ground, so that its terrain is made once


@dataclass(slots=True)
class ShardBox:
    """Region of the frames of a shard: the box of its source; after the first frame, the part about that frame."""

    box: Box
    near: Box | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Position of a camera (rad, m), and the mean height of the ground in view above the map sphere."""

    latitude_rad: float
    longitude_rad: float
    altitude_m: float
    ground_m: float
    position_mcmf_m: FloatArray
    camera_from_mcmf: FloatArray


def draw_pose(terrain: Any, camera: PinholeCamera, source: Source, place: ShardBox, rng: np.random.Generator) -> Pose:
    """A pose whose footprint lies where the source may look, on the terrain, well above the ground.

    Raises
    ------
    DatasetError
        There is no room for a footprint in the box of `place`.
    """
    edge = edge_pixels(camera)
    box = place.box
    for attempt in range(_ATTEMPTS):
        draw = place.near if place.near is not None and attempt < _ATTEMPTS // 4 else box
        latitude = math.asin(
            rng.uniform(math.sin(math.radians(draw.south_deg)), math.sin(math.radians(draw.north_deg)))
        )
        longitude = math.radians(rng.uniform(draw.west_deg, draw.east_deg))
        altitude_m = 1000.0 * rng.uniform(*source.altitude_km)
        turn = draw_pointing(source.vary, rng)
        poses = [
            _pose_over(terrain, camera, source, box, place_of_view, altitude_m, turn, edge)
            for place_of_view in _views(source, latitude, longitude)
        ]
        first = poses[0]
        if first is None or any(pose is None for pose in poses):
            continue
        if place.near is None:
            place.near = _about(box, math.degrees(latitude), math.degrees(longitude))
        return first
    raise DatasetError(
        f"data set source {source.name!r}: expected room for a footprint in box {box.west_deg:g}..{box.east_deg:g} E, "
        f"{box.south_deg:g}..{box.north_deg:g} N, found none in {_ATTEMPTS} draws"
    )


def view_position_mcmf_m(source: Source, first: Pose, view: int) -> FloatArray:
    """Position (3,) of a later view of a pose, MCMF m: further north at the same altitude above the map sphere."""
    latitude, longitude = _views(source, first.latitude_rad, first.longitude_rad)[view]
    return np.asarray(mcmf_from_spherical(latitude, longitude, first.altitude_m))


def _views(source: Source, latitude_rad: float, longitude_rad: float) -> list[tuple[float, float]]:
    """Latitude and longitude of the views of a place, rad."""
    step_rad = 1000.0 * source.view_step_km / MOON_RADIUS_M
    return [(latitude_rad + k * step_rad, longitude_rad) for k in range(source.views)]


def _pose_over(
    terrain: Any,
    camera: PinholeCamera,
    source: Source,
    box: Box,
    place_rad: tuple[float, float],
    altitude_m: float,
    turn: FloatArray,
    edge: FloatArray,
) -> Pose | None:
    """The pose over a latitude and longitude; None where it may not look or is too low."""
    position = np.asarray(mcmf_from_spherical(*place_rad, altitude_m))
    rotation = turn @ nadir_camera_from_mcmf(position)
    ground = footprint_edge(camera, rotation, position, edge)
    edge_latitude, edge_longitude, _ = spherical_from_mcmf(ground)
    if source.footprint == "inside" and not allowed(source, box, np.degrees(edge_latitude), np.degrees(edge_longitude)):
        return None
    if not np.all(terrain.covers(edge_latitude, edge_longitude)):
        return None
    heights = _heights_in_view(terrain, ground)
    if not np.isfinite(heights).all() or altitude_m - heights.max() < _LOWEST_FLIGHT_M:
        return None
    return Pose(*place_rad, altitude_m, float(heights.mean()), position, rotation)


def pose_at(
    terrain: Any,
    camera: PinholeCamera,
    source: Source,
    position_mcmf_m: FloatArray,
    where: str,
    rng: np.random.Generator,
) -> Pose:
    """The pose at a place of an ephemeris; `where` names it in the error.

    Raises
    ------
    DatasetError
        The place is below the ground.
    """
    latitude, longitude, altitude_m = (float(value) for value in spherical_from_mcmf(position_mcmf_m))
    rotation = draw_pointing(source.vary, rng) @ nadir_camera_from_mcmf(position_mcmf_m)
    ground = footprint_edge(camera, rotation, position_mcmf_m, edge_pixels(camera))
    heights = _heights_in_view(terrain, ground)
    under = float(heights[-1])
    if altitude_m <= under:
        raise DatasetError(
            f"data set source {source.name!r}: {where}: expected a place above the ground at "
            f"{math.degrees(latitude):.3f} deg, {math.degrees(longitude) % 360.0:.3f} deg E "
            f"({under:.0f} m over the map sphere), found the camera at {altitude_m:.0f} m"
        )
    return Pose(latitude, longitude, altitude_m, float(heights.mean()), position_mcmf_m, rotation)


def _heights_in_view(terrain: Any, edge_mcmf_m: FloatArray) -> FloatArray:
    """Heights (n + 1,) half-way to the points (n, 3) of a footprint's edge and in its middle.

    On the level on which rims are measured, which the labels need anyway.
    """
    from payload_emulator.sim.terrain.tiles import MEASURE_LEVEL

    middle = edge_mcmf_m.mean(axis=0)
    inner = np.concatenate([0.5 * (edge_mcmf_m + middle), middle[None]])
    latitude, longitude, _ = spherical_from_mcmf(inner)
    return np.asarray(terrain.height_m(latitude, longitude, MEASURE_LEVEL))


def footprint_edge(
    camera: PinholeCamera, camera_from_mcmf: FloatArray, position_mcmf_m: FloatArray, uv: FloatArray
) -> FloatArray:
    """Points (n, 3) of the map sphere that pixels (n, 2) see, MCMF m; where a pixel sees the sky, the horizon below it.

    At 150 km a camera of 120 degrees sees the sky in its corners (67.8 degrees off nadir, horizon at 67.0).
    """
    ground = ground_point_sphere(camera, camera_from_mcmf, position_mcmf_m, uv)
    sky = ~np.isfinite(ground).all(axis=-1)
    if sky.any():
        distance = float(np.linalg.norm(position_mcmf_m))
        up = position_mcmf_m / distance
        rays = camera.rays(uv)[sky] @ camera_from_mcmf
        level = rays - (rays @ up)[:, None] * up
        level /= np.linalg.norm(level, axis=1)[:, None]
        cosine = MOON_RADIUS_M / distance
        ground[sky] = MOON_RADIUS_M * (cosine * up + math.sqrt(1.0 - cosine**2) * level)
    return ground


def _about(box: Box, latitude_deg: float, longitude_deg: float) -> Box:
    """The part of a box within `_SHARD_REACH_DEG` of a place."""
    wide = _SHARD_REACH_DEG / max(math.cos(math.radians(latitude_deg)), 0.2)
    return Box(
        max(box.west_deg, longitude_deg - wide),
        min(box.east_deg, longitude_deg + wide),
        max(box.south_deg, latitude_deg - _SHARD_REACH_DEG),
        min(box.north_deg, latitude_deg + _SHARD_REACH_DEG),
    )


def allowed(source: Source, box: Box, latitude_deg: FloatArray, longitude_deg: FloatArray) -> bool:
    """Return whether a footprint's edge lies in the box and clear of every box to avoid, buffer included."""
    if not inside_box(box, latitude_deg, longitude_deg, 0.0).all():
        return False
    return not any(inside_box(other, latitude_deg, longitude_deg, source.buffer_km).any() for other in source.avoid)


def edge_pixels(camera: PinholeCamera) -> FloatArray:
    """Sixteen pixels along the edge of the image, (16, 2)."""
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    along_u, along_v = np.linspace(-0.5, right, 5), np.linspace(-0.5, bottom, 5)
    top = [(u, -0.5) for u in along_u]
    low = [(u, bottom) for u in along_u]
    sides = [(u, v) for u in (-0.5, right) for v in along_v[1:-1]]
    return np.array(top + low + sides)


def draw_box(source: Source, rng: np.random.Generator) -> Box:
    """One of the source's boxes, by area."""
    areas = np.array(
        [
            (b.east_deg - b.west_deg) * (math.sin(math.radians(b.north_deg)) - math.sin(math.radians(b.south_deg)))
            for b in source.boxes
        ]
    )
    return source.boxes[int(rng.choice(len(source.boxes), p=areas / areas.sum()))]


def draw_sun(light: str, rng: np.random.Generator) -> tuple[float, float]:
    """Elevation and azimuth of the Sun below the camera, rad, by the rule of the source's light."""
    if light == "paper":
        return math.radians(rng.uniform(5.0, 15.0)), math.radians(rng.uniform(-45.0, 45.0))
    azimuth = math.radians(rng.uniform(-180.0, 180.0))
    if light == "low":
        return math.radians(rng.uniform(5.0, 15.0)), azimuth
    limits = ((5.0, 15.0), (15.0, 35.0), (35.0, 60.0), (3.0, 5.0))[int(rng.choice(4, p=(0.7, 0.17, 0.07, 0.06)))]
    return math.radians(rng.uniform(*limits)), azimuth


def draw_pointing(vary: bool, rng: np.random.Generator) -> FloatArray:
    """Small rotation of the camera: yaw of 4 degrees, tilt of 0.7 degrees (one sigma, cut at three)."""
    if not vary:
        return np.eye(3)
    x, y, z = np.clip(rng.normal(size=3), -3.0, 3.0) * np.radians([0.7, 0.7, 4.0])
    cos_z, sin_z = math.cos(z), math.sin(z)
    about_z = np.array([[cos_z, -sin_z, 0.0], [sin_z, cos_z, 0.0], [0.0, 0.0, 1.0]])
    cos_x, sin_x = math.cos(x), math.sin(x)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cos_x, -sin_x], [0.0, sin_x, cos_x]])
    cos_y, sin_y = math.cos(y), math.sin(y)
    about_y = np.array([[cos_y, 0.0, sin_y], [0.0, 1.0, 0.0], [-sin_y, 0.0, cos_y]])
    return np.asarray(about_z @ about_y @ about_x)


def draw_photometry(vary: bool, rng: np.random.Generator) -> Any:
    """A `Photometry`: nominal, or another law, phase curve and albedo contrast for each frame."""
    from payload_emulator.sim.render.photometry import Photometry

    if not vary:
        return Photometry()
    law = _LAWS[int(rng.choice(len(_LAWS), p=_LAW_SHARES))]
    return Photometry(
        law=law, phase_slope_per_rad=float(rng.uniform(0.2, 1.0)), albedo_contrast=float(rng.uniform(0.0, 1.6))
    )


def draw_sensor(vary: bool, rng: np.random.Generator) -> Any:
    """A `SensorModel`: nominal, or exposure, tone curve, blur and noise drawn for each frame."""
    from payload_emulator.sim.render.sensor import SensorModel, random_sensor

    return random_sensor(rng) if vary else SensorModel()
