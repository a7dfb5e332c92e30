"""One frame of a data set: picture, labels of what is in it, metadata."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, OctetArray
from lunar.camera import PinholeCamera, ground_point_sphere, nadir_camera_from_mcmf
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from lunar.plausible import HEIGHT_M
from lunar.timescales import format_utc
from payload_emulator.session.world.recipe import Recipe, Source
from payload_emulator.training.data.shots import Pose, draw_photometry, draw_sensor, draw_sun

_LABEL_MINIMUM_M = 2_000.0
_STAMPED_MINIMUM_PX = 9.0
_BLOCK_DEG = 8.0
_TRIES_OF_LIGHT = 20


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """A finished frame: image of 8 or 16 bits, frame values, crater columns, pose, direction of the Sun.

    The image is gray (H, W) or RGB (H, W, 3).
    """

    image: NDArray[Any]
    row: dict[str, float]
    craters: dict[str, NDArray[Any]]
    pose: Pose
    sun_mcmf: FloatArray


def take_frame(
    terrain: Any,
    camera: PinholeCamera,
    source: Source,
    pose_of: Callable[[np.random.Generator], Pose],
    number: int,
    recipe: Recipe,
    render: Callable[..., Any],
    rng: np.random.Generator,
    sun_mcmf: FloatArray | None = None,
) -> Shot:
    """A frame whose picture is usable; pose, light, surface and sensor are drawn again where it is not.

    `sun_mcmf`, (3,), is the direction to the Sun where it is not to be drawn.
    """
    from payload_emulator.flight.vision.preprocess import ImageQuality, prepare_image
    from payload_emulator.sim.render.light import sun_angles, sun_direction_mcmf

    for _ in range(_TRIES_OF_LIGHT):
        pose = pose_of(rng)
        if sun_mcmf is None:
            elevation, azimuth = draw_sun(source.light, rng)
            sun = sun_direction_mcmf(elevation, azimuth, pose.latitude_rad, pose.longitude_rad)
        else:
            sun = sun_mcmf
            elevation, azimuth = sun_angles(sun, pose.latitude_rad, pose.longitude_rad)
        rendering = render(
            terrain, camera, pose.position_mcmf_m, pose.camera_from_mcmf, sun, draw_photometry(source.vary, rng)
        )
        image, coarse = _exposed(rendering.radiance, draw_sensor(source.vary, rng), recipe, rng)
        if prepare_image(coarse).quality is ImageQuality.OK:
            break
    position, rotation = pose.position_mcmf_m, pose.camera_from_mcmf
    craters = _label(terrain, camera, pose, rendering, source.label_minimum_px)
    small = stamped_craters(terrain, camera, position, rotation, coarse)
    craters = {key: np.concatenate([craters[key], small[key]]) for key in craters}
    latitude_deg, longitude_deg = math.degrees(pose.latitude_rad), math.degrees(pose.longitude_rad) % 360.0
    row = {
        "number": number,
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "altitude_m": pose.altitude_m,
        "ground_m": pose.ground_m,
        "sun_elevation_deg": math.degrees(elevation),
        "sun_azimuth_deg": math.degrees(azimuth),
        "block": int((latitude_deg + 90.0) // _BLOCK_DEG) * 100 + int(longitude_deg // _BLOCK_DEG),
    }
    return Shot(image, row, craters, pose, sun)


def describe(
    camera: PinholeCamera, shot: Shot, source: Source, split: str, terrain: Any, utc_ns: int | None = None
) -> dict[str, Any]:
    """Metadata of a frame for its JSON file; angles in degrees."""
    pose, row = shot.pose, shot.row
    position, rotation = pose.position_mcmf_m, pose.camera_from_mcmf
    corners = ground_point_sphere(camera, rotation, position, camera.corners_px())
    latitude, longitude, _ = spherical_from_mcmf(corners)
    relative = rotation @ np.asarray(nadir_camera_from_mcmf(position)).T
    document: dict[str, Any] = {
        "frame": int(row["number"]),
        "source": source.name,
        "split": split,
        "terrain": terrain.name,
        "data": list(terrain.data_names),
        "latitude_deg": row["latitude_deg"],
        "longitude_deg": row["longitude_deg"],
        "altitude_km": row["altitude_m"] / 1000.0,
        "mean_ground_m": row["ground_m"],
        "tilt_deg": math.degrees(math.acos(min(1.0, float(relative[2, 2])))),
        "azimuth_deg": math.degrees(math.atan2(float(relative[1, 0]), float(relative[0, 0]))),
        "sun_elevation_deg": row["sun_elevation_deg"],
        "sun_azimuth_deg": row["sun_azimuth_deg"],
        "sun_camera": [float(value) for value in rotation @ shot.sun_mcmf],
        "sun_mcmf": [float(value) for value in shot.sun_mcmf],
        "corners_deg": [
            {"latitude": float(a), "longitude": float(o) % 360.0}
            for a, o in zip(np.degrees(latitude), np.degrees(longitude), strict=True)
        ],
        "position_mcmf_m": [float(value) for value in position],
        "camera_from_mcmf": [[float(value) for value in line] for line in rotation],
    }
    return document if utc_ns is None else document | {"epoch": format_utc(utc_ns)}


def _exposed(
    radiance: NDArray[np.float32], sensor: Any, recipe: Recipe, rng: np.random.Generator
) -> tuple[NDArray[Any], OctetArray]:
    """The frame as the recipe wants it, mean of the channels (H, W) or RGB (H, W, 3), and its mean in 8 bits."""
    from payload_emulator.flight.vision.preprocess import gray_levels
    from payload_emulator.sim.render.sensor import take_picture

    in_colour = recipe.colour == "rgb"
    picture = take_picture(radiance, replace(sensor, bits=recipe.bits), rng)
    if recipe.bits == 8:
        gray = gray_levels(picture.astype(np.uint8, copy=False))
        return (picture if in_colour else gray), gray
    red, green, blue = np.moveaxis(picture, -1, 0)
    total = red.astype(np.uint32) + green + blue  # a sum along an axis of three is ten times slower
    deep = ((total + 1) // 3).astype(np.uint16)
    return (picture if in_colour else deep), (deep >> 8).astype(np.uint8)


def _label(terrain: Any, camera: PinholeCamera, pose: Pose, rendering: Any, least_px: float) -> dict[str, NDArray[Any]]:
    """Catalogued craters in view with what scoring and training need to know of each."""
    from payload_emulator.sim.render.labels import label_frame

    position, rotation = pose.position_mcmf_m, pose.camera_from_mcmf
    # No crater of fewer metres has `least_px` even on the highest ground straight below; tilt is a few degrees at most.
    resolved_m = 0.95 * least_px * (pose.altitude_m - HEIGHT_M.high) / camera.focal_px
    labels = label_frame(terrain, camera, position, rotation, max(_LABEL_MINIMUM_M, resolved_m), rendering.lit)
    measured = terrain.measured(labels.index)
    points = (measured.position_mcmf_m - position) @ rotation.T
    diameter_px = camera.focal_px * measured.diameter_m / points[:, 2]
    chosen = np.flatnonzero((diameter_px >= least_px) & measured.complete)
    near = measured.select(chosen)
    u, v = labels.u_px[chosen], labels.v_px[chosen]
    distance = np.linalg.norm(points[chosen], axis=1)
    row = np.clip(np.rint(v).astype(int), 0, camera.height_px - 1)
    column = np.clip(np.rint(u).astype(int), 0, camera.width_px - 1)
    seen = rendering.range_m[row, column]
    hidden = np.isnan(seen) | (seen < 0.9 * distance)
    return {
        "id": near.ids.astype(np.int64),
        "u_px": u.astype(np.float32),
        "v_px": v.astype(np.float32),
        "diameter_px": diameter_px[chosen].astype(np.float32),
        "diameter_m": near.diameter_m.astype(np.float32),
        "depth_ratio": (near.depth_m / near.diameter_m).astype(np.float32),
        "lit": np.nan_to_num(labels.lit_fraction[chosen]).astype(np.float32),
        "hidden": hidden.astype(np.uint8),
        "latitude_deg": np.degrees(near.latitude_rad),
        "longitude_deg": np.degrees(near.longitude_rad) % 360.0,
        "major_px": labels.major_px[chosen].astype(np.float32),
        "minor_px": labels.minor_px[chosen].astype(np.float32),
        "angle_rad": labels.angle_rad[chosen].astype(np.float32),
        "visible": labels.visible_fraction[chosen].astype(np.float32),
    }


def stamped_craters(
    terrain: Any, camera: PinholeCamera, position: FloatArray, rotation: FloatArray, image: OctetArray
) -> dict[str, NDArray[Any]]:
    """Craters below the catalogue's limit that the terrain draws from its seed, where they are large in the image.

    Their ids are negative: they teach what a crater looks like at any scale (from 12 km one of 1.5 km is 18 px wide),
    and are no part of scoring. No shadow picture is kept for them, so "lit" is judged on the image.
    """
    latitude, longitude, altitude_m = (float(value) for value in spherical_from_mcmf(position))
    reach = (altitude_m + 4_000.0) * math.tan(camera.fov_rad / 2.0) * 1.1 / MOON_RADIUS_M
    wide = reach / max(math.cos(latitude), 0.2)
    shapes = terrain.small_craters(
        np.array([latitude - reach, latitude + reach]), np.array([longitude - wide, longitude + wide])
    )
    diameter_m = 2.0 * shapes.radius_rad * MOON_RADIUS_M
    flat = mcmf_from_spherical(shapes.latitude_rad, shapes.longitude_rad, 0.0) - position
    rough = np.asarray(flat) @ rotation.T
    uv = camera.project(rough)
    with np.errstate(invalid="ignore"):
        large = camera.focal_px * diameter_m / rough[:, 2] >= 0.75 * _STAMPED_MINIMUM_PX
        chosen = np.flatnonzero(large & camera.contains(uv, -40.0))
    place_latitude, place_longitude = shapes.latitude_rad[chosen], shapes.longitude_rad[chosen]
    azimuth = np.arange(8) * (math.pi / 4.0)
    arc = shapes.radius_rad[chosen][:, None]
    rim_latitude = place_latitude[:, None] + arc * np.cos(azimuth)
    rim_longitude = place_longitude[:, None] + arc * np.sin(azimuth) / np.cos(place_latitude)[:, None]
    level = terrain.level_for(altitude_m / camera.focal_px)
    height = terrain.height_m(rim_latitude, rim_longitude, level).mean(axis=1) if chosen.size else np.zeros(0)
    points = (np.asarray(mcmf_from_spherical(place_latitude, place_longitude, height)) - position) @ rotation.T
    uv = camera.project(points)
    diameter_px = camera.focal_px * diameter_m[chosen] / points[:, 2]
    keep = np.flatnonzero((diameter_px >= _STAMPED_MINIMUM_PX) & camera.contains(uv))
    chosen, uv, diameter_px = chosen[keep], uv[keep], diameter_px[keep]
    return {
        "id": -1 - np.arange(chosen.size, dtype=np.int64),
        "u_px": uv[:, 0].astype(np.float32),
        "v_px": uv[:, 1].astype(np.float32),
        "diameter_px": diameter_px.astype(np.float32),
        "diameter_m": diameter_m[chosen].astype(np.float32),
        "depth_ratio": (shapes.depth_m[chosen] / diameter_m[chosen]).astype(np.float32),
        "lit": _bright_share(image, uv, diameter_px).astype(np.float32),
        "hidden": np.zeros(chosen.size, np.uint8),
        "latitude_deg": np.degrees(shapes.latitude_rad[chosen]),
        "longitude_deg": np.degrees(shapes.longitude_rad[chosen]) % 360.0,
        "major_px": diameter_px.astype(np.float32),
        "minor_px": diameter_px.astype(np.float32),
        "angle_rad": np.zeros(chosen.size, np.float32),
        "visible": np.ones(chosen.size, np.float32),
    }


def _bright_share(image: OctetArray, uv: FloatArray, diameter_px: FloatArray) -> FloatArray:
    """Share of 16 points around each centre that are brighter than a third of the frame's median bright pixel."""
    bright = image[image > 8]
    level = float(np.median(bright)) / 3.0 if bright.size else 255.0
    radius = np.repeat([0.6, 1.25], 8)
    angle = np.tile(np.arange(8) * (math.pi / 4.0), 2)
    u = uv[:, :1] + 0.5 * diameter_px[:, None] * radius * np.cos(angle)
    v = uv[:, 1:] + 0.5 * diameter_px[:, None] * radius * np.sin(angle)
    rows = np.clip(np.rint(v).astype(int), 0, image.shape[0] - 1)
    columns = np.clip(np.rint(u).astype(int), 0, image.shape[1] - 1)
    share: FloatArray = (image[rows, columns] > level).mean(axis=1) if uv.shape[0] else np.zeros(0)
    return share
