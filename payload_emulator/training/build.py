"""Rendering of a data set, shard by shard: a pure function of recipe, data and shard number, whatever the workers.

Resumable: a shard whose labels file exists is not made again. Memory: each worker keeps one terrain at a time.
"""

from __future__ import annotations

import hashlib
import json
import math
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.camera import PinholeCamera, ground_point_sphere, nadir_camera_from_mcmf
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder, find_data
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from payload_emulator.errors import DatasetError
from payload_emulator.training import dataset as store
from payload_emulator.training.recipe import Box, Recipe, Source

Floats = NDArray[np.float64]

_ATTEMPTS = 4000
_LOWEST_FLIGHT_M = 9_000.0  # above the ground: lower, a 5 km crater fills more than a sixth of the frame
_LABEL_MINIMUM_M = 2_000.0
_LABEL_MINIMUM_PX = 5.0
_STAMPED_MINIMUM_PX = 9.0
_BLOCK_DEG = 8.0
_SHARD_REACH_DEG = 2.5  # frames of a shard look at neighbouring ground, so that its terrain is made once


@dataclass(frozen=True, slots=True)
class Shard:
    """A run of frames of one source."""

    name: str
    source: Source
    seed: int
    number: int
    first_frame: int
    frames: int


@dataclass(slots=True)
class _Place:
    """Where a shard draws its frames: the box of its source; after the first frame, the part about that frame."""

    box: Box
    near: Box | None = None


def plan_shards(recipe: Recipe, frames: int) -> list[Shard]:
    """Shards of a data set of about `frames` frames; each source gets its share, rounded to whole frames."""
    total = sum(source.share for source in recipe.sources)
    if frames < len(recipe.sources) or total <= 0.0:
        raise DatasetError(
            f"data set: expected at least one frame per source ({len(recipe.sources)}), found {frames}"
        )
    shards: list[Shard] = []
    first = 0
    for source in recipe.sources:
        wanted = max(1, round(frames * source.share / total))
        for done in range(0, wanted, recipe.frames_per_shard):
            count = min(wanted - done, recipe.frames_per_shard)
            # Runs of one seed, so that a worker seldom has to open another terrain.
            seed = source.seeds[done * len(source.seeds) // wanted]
            shards.append(Shard(f"{len(shards):05d}", source, seed, len(shards), first, count))
            first += count
    return shards


def build(
    recipe: Recipe, folder: Path, frames: int, data: DataFolder, workers: int = 1
) -> Iterator[tuple[int, int]]:
    """Make or finish a data set; yields (frames done, frames in all) after every shard.

    Raises
    ------
    DatasetError
        The folder holds another data set, or the recipe needs data that are not there.
    """
    shards = plan_shards(recipe, frames)
    total = sum(shard.frames for shard in shards)
    _claim(folder, recipe, frames)
    if any(source.terrain == "real" for source in recipe.sources) and not data.dem_tiles:
        raise DatasetError(f"data set {recipe.name}: expected terrain tiles in the data folder, found none")
    todo = [shard for shard in shards if not (folder / "shards" / f"{shard.name}.npz").is_file()]
    done = total - sum(shard.frames for shard in todo)
    yield done, total
    root = str(data.root) if data.root is not None else ""
    if workers <= 1:
        for shard in todo:
            make_shard(recipe, shard, folder, root)
            done += shard.frames
            yield done, total
    elif todo:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, mp_context=context) as pool:
            running = {pool.submit(make_shard, recipe, shard, folder, root): shard for shard in todo}
            for finished in as_completed(running):
                finished.result()
                done += running[finished].frames
                yield done, total
    hashes = {
        shard.name: hashlib.sha256((folder / "shards" / f"{shard.name}.npz").read_bytes()).hexdigest()
        for shard in shards
    }
    store.write_index(folder, recipe, total, hashes, _data_names(recipe, data))


def make_shard(recipe: Recipe, shard: Shard, folder: Path, data_root: str) -> None:
    """Render the frames of one shard and write them with their labels."""
    terrain = _terrain(shard.source, shard.seed, data_root)
    rng = np.random.Generator(np.random.Philox(key=[recipe.seed, shard.number]))
    place = _Place(_draw_box(shard.source, rng))
    camera = PinholeCamera(recipe.width_px, recipe.height_px, math.radians(recipe.fov_deg))
    frame_rows: list[dict[str, float]] = []
    crater_rows: list[dict[str, NDArray[Any]]] = []
    poses: list[tuple[Floats, Floats, Floats]] = []
    for k in range(shard.frames):
        number = shard.first_frame + k
        image, row, craters, pose = _make_frame(terrain, camera, shard.source, place, number, rng)
        store.write_gray(folder / "images" / f"{number:06d}.png", image)
        store.write_json(
            folder / "metadata" / f"{number:06d}.json", _metadata(camera, shard, row, pose, terrain)
        )
        frame_rows.append(row)
        crater_rows.append(craters)
        poses.append(pose)
    labels = store.ShardLabels(
        source=shard.source.name,
        split=shard.source.split,
        complete=shard.source.terrain == "procedural",
        frames={key: np.array([row[key] for row in frame_rows]) for key in store.FRAME_COLUMNS},
        sun_camera=np.array([pose[2] for pose in poses]),
        camera_from_mcmf=np.array([pose[1] for pose in poses]),
        position_mcmf_m=np.array([pose[0] for pose in poses]),
        craters={key: np.concatenate([part[key] for part in crater_rows]) for key in store.CRATER_COLUMNS},
        first=np.concatenate([[0], np.cumsum([part["id"].size for part in crater_rows])]).astype(np.int64),
    )
    store.write_shard(folder, shard.name, labels)


def _make_frame(
    terrain: Any, camera: PinholeCamera, source: Source, place: _Place, number: int, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], dict[str, float], dict[str, NDArray[Any]], tuple[Floats, Floats, Floats]]:
    from payload_emulator.flight.preprocess import ImageQuality, gray_levels, prepare_image
    from payload_emulator.sim.light import sun_direction_mcmf
    from payload_emulator.sim.renderer import render
    from payload_emulator.sim.sensor import expose

    for _ in range(20):
        latitude, longitude, altitude_m, ground_m, position, rotation = _draw_pose(
            terrain, camera, source, place, rng
        )
        elevation, azimuth = _draw_sun(source.light, rng)
        sun = sun_direction_mcmf(elevation, azimuth, latitude, longitude)
        rendering = render(terrain, camera, position, rotation, sun, _draw_photometry(source.vary, rng))
        rgb = expose(rendering.radiance, _draw_sensor(source.vary, rng), rng)
        image = gray_levels(rgb)
        if prepare_image(image).quality is ImageQuality.OK:
            break
    craters = _label(terrain, camera, position, rotation, rendering)
    small = stamped_craters(terrain, camera, position, rotation, image)
    craters = {key: np.concatenate([craters[key], small[key]]) for key in craters}
    block = int((math.degrees(latitude) + 90.0) // _BLOCK_DEG) * 100 + int(
        math.degrees(longitude) % 360.0 // _BLOCK_DEG
    )
    row = {
        "number": number,
        "latitude_deg": math.degrees(latitude),
        "longitude_deg": math.degrees(longitude) % 360.0,
        "altitude_m": altitude_m,
        "ground_m": ground_m,
        "sun_elevation_deg": math.degrees(elevation),
        "sun_azimuth_deg": math.degrees(azimuth),
        "block": block,
    }
    return image, row, craters, (position, rotation, rotation @ sun)


def _draw_pose(
    terrain: Any, camera: PinholeCamera, source: Source, place: _Place, rng: np.random.Generator
) -> tuple[float, float, float, float, Floats, Floats]:
    edge = _edge_pixels(camera)
    box = place.box
    for attempt in range(_ATTEMPTS):
        draw = place.near if place.near is not None and attempt < _ATTEMPTS // 4 else box
        latitude = math.asin(
            rng.uniform(math.sin(math.radians(draw.south_deg)), math.sin(math.radians(draw.north_deg)))
        )
        longitude = math.radians(rng.uniform(draw.west_deg, draw.east_deg))
        altitude_m = 1000.0 * rng.uniform(*source.altitude_km)
        turn = _pointing(source.vary, rng)
        position = np.asarray(mcmf_from_spherical(latitude, longitude, altitude_m))
        rotation = turn @ nadir_camera_from_mcmf(position)
        ground = ground_point_sphere(camera, rotation, position, edge)
        if not np.isfinite(ground).all():
            continue
        edge_latitude, edge_longitude, _ = spherical_from_mcmf(ground)
        if not _allowed(source, box, np.degrees(edge_latitude), np.degrees(edge_longitude)):
            continue
        if not np.all(terrain.covers(edge_latitude, edge_longitude)):
            continue
        inner = np.concatenate([0.5 * (ground + ground.mean(axis=0)), ground.mean(axis=0)[None]])
        inner_latitude, inner_longitude, _ = spherical_from_mcmf(inner)
        heights = terrain.height_m(inner_latitude, inner_longitude)
        if not np.isfinite(heights).all() or altitude_m - heights.max() < _LOWEST_FLIGHT_M:
            continue
        if place.near is None:
            place.near = _about(box, math.degrees(latitude), math.degrees(longitude))
        return latitude, longitude, altitude_m, float(heights.mean()), position, rotation
    raise DatasetError(
        f"data set source {source.name!r}: expected room for a footprint in box {box.west_deg:g}..{box.east_deg:g} E, "
        f"{box.south_deg:g}..{box.north_deg:g} N, found none in {_ATTEMPTS} draws"
    )


def _about(box: Box, latitude_deg: float, longitude_deg: float) -> Box:
    """The part of a box within `_SHARD_REACH_DEG` of a place."""
    wide = _SHARD_REACH_DEG / max(math.cos(math.radians(latitude_deg)), 0.2)
    return Box(
        max(box.west_deg, longitude_deg - wide),
        min(box.east_deg, longitude_deg + wide),
        max(box.south_deg, latitude_deg - _SHARD_REACH_DEG),
        min(box.north_deg, latitude_deg + _SHARD_REACH_DEG),
    )


def _allowed(source: Source, box: Box, latitude_deg: Floats, longitude_deg: Floats) -> bool:
    """Whether a footprint's edge lies in the box and clear of every box to avoid, buffer included."""
    if not _inside(box, latitude_deg, longitude_deg, 0.0).all():
        return False
    return not any(
        _inside(other, latitude_deg, longitude_deg, source.buffer_km).any() for other in source.avoid
    )


def _inside(box: Box, latitude_deg: Floats, longitude_deg: Floats, buffer_km: float) -> NDArray[np.bool_]:
    margin = math.degrees(buffer_km * 1000.0 / MOON_RADIUS_M)
    widen = margin / np.cos(np.radians(np.minimum(np.abs(latitude_deg) + margin, 85.0)))
    middle = 0.5 * (box.west_deg + box.east_deg)
    offset = np.mod(longitude_deg - middle + 180.0, 360.0) - 180.0
    across = np.abs(offset) <= 0.5 * (box.east_deg - box.west_deg) + widen
    inside: NDArray[np.bool_] = (
        across & (latitude_deg >= box.south_deg - margin) & (latitude_deg <= box.north_deg + margin)
    )
    return inside


def _edge_pixels(camera: PinholeCamera) -> Floats:
    """Sixteen pixels along the edge of the image, (16, 2)."""
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    along_u, along_v = np.linspace(-0.5, right, 5), np.linspace(-0.5, bottom, 5)
    top = [(u, -0.5) for u in along_u]
    low = [(u, bottom) for u in along_u]
    sides = [(u, v) for u in (-0.5, right) for v in along_v[1:-1]]
    return np.array(top + low + sides)


def _draw_box(source: Source, rng: np.random.Generator) -> Box:
    areas = np.array(
        [
            (b.east_deg - b.west_deg)
            * (math.sin(math.radians(b.north_deg)) - math.sin(math.radians(b.south_deg)))
            for b in source.boxes
        ]
    )
    return source.boxes[int(rng.choice(len(source.boxes), p=areas / areas.sum()))]


def _draw_sun(light: str, rng: np.random.Generator) -> tuple[float, float]:
    if light == "paper":
        return math.radians(rng.uniform(5.0, 15.0)), math.radians(rng.uniform(-45.0, 45.0))
    azimuth = math.radians(rng.uniform(-180.0, 180.0))
    if light == "low":
        return math.radians(rng.uniform(5.0, 15.0)), azimuth
    limits = ((5.0, 15.0), (15.0, 35.0), (35.0, 60.0), (3.0, 5.0))[
        int(rng.choice(4, p=(0.7, 0.17, 0.07, 0.06)))
    ]
    return math.radians(rng.uniform(*limits)), azimuth


def _pointing(vary: bool, rng: np.random.Generator) -> Floats:
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


def _draw_photometry(vary: bool, rng: np.random.Generator) -> Any:
    from payload_emulator.sim.photometry import LAWS, Photometry

    if not vary:
        return Photometry()
    law = LAWS[int(rng.choice(len(LAWS), p=_law_shares(LAWS)))]
    return Photometry(
        law=law,
        phase_slope_per_rad=float(rng.uniform(0.2, 1.0)),
        albedo_contrast=float(rng.uniform(0.0, 1.6)),
    )


def _law_shares(laws: tuple[str, ...]) -> list[float]:
    return [0.5 if law == "lunar-lambert" else 0.5 / (len(laws) - 1) for law in laws]


def _draw_sensor(vary: bool, rng: np.random.Generator) -> Any:
    from payload_emulator.sim.sensor import SensorModel, random_sensor

    return random_sensor(rng) if vary else SensorModel()


def _label(
    terrain: Any, camera: PinholeCamera, position: Floats, rotation: Floats, rendering: Any
) -> dict[str, NDArray[Any]]:
    """Catalogued craters in view with what scoring and training need to know of each."""
    from payload_emulator.sim.labels import label_frame

    labels = label_frame(terrain, camera, position, rotation, _LABEL_MINIMUM_M, rendering.lit)
    measured = terrain.measured(labels.index)
    points = (measured.position_mcmf_m - position) @ rotation.T
    diameter_px = camera.focal_px * measured.diameter_m / points[:, 2]
    chosen = np.flatnonzero((diameter_px >= _LABEL_MINIMUM_PX) & measured.complete)
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
    }


def stamped_craters(
    terrain: Any, camera: PinholeCamera, position: Floats, rotation: Floats, image: NDArray[np.uint8]
) -> dict[str, NDArray[Any]]:
    """Craters below the catalogue's limit that the terrain draws from its seed, where they are large in the image.

    Their ids are negative: they teach what a crater looks like at any scale (from 12 km one of 1.5 km is 18 px wide),
    and are no part of scoring. No shadow picture is kept for them, so "lit" is judged on the image.
    """
    latitude, longitude, altitude_m = (float(value) for value in spherical_from_mcmf(position))
    reach = (altitude_m + 4_000.0) * math.tan(camera.fov_rad / 2.0) * 1.1 / MOON_RADIUS_M
    wide = reach / max(math.cos(latitude), 0.2)
    shapes = terrain._small.around(
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
    height = terrain.height_m(rim_latitude, rim_longitude).mean(axis=1) if chosen.size else np.zeros(0)
    points = (
        np.asarray(mcmf_from_spherical(place_latitude, place_longitude, height)) - position
    ) @ rotation.T
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
    }


def _bright_share(image: NDArray[np.uint8], uv: Floats, diameter_px: Floats) -> Floats:
    """Share of 16 points around each centre that are brighter than a third of the frame's median bright pixel."""
    bright = image[image > 8]
    level = float(np.median(bright)) / 3.0 if bright.size else 255.0
    radius = np.repeat([0.6, 1.25], 8)
    angle = np.tile(np.arange(8) * (math.pi / 4.0), 2)
    u = uv[:, :1] + 0.5 * diameter_px[:, None] * radius * np.cos(angle)
    v = uv[:, 1:] + 0.5 * diameter_px[:, None] * radius * np.sin(angle)
    rows = np.clip(np.rint(v).astype(int), 0, image.shape[0] - 1)
    columns = np.clip(np.rint(u).astype(int), 0, image.shape[1] - 1)
    share: Floats = (image[rows, columns] > level).mean(axis=1) if uv.shape[0] else np.zeros(0)
    return share


def _metadata(
    camera: PinholeCamera,
    shard: Shard,
    row: dict[str, float],
    pose: tuple[Floats, Floats, Floats],
    terrain: Any,
) -> dict[str, Any]:
    position, rotation, sun_camera = pose
    corners = ground_point_sphere(camera, rotation, position, camera.corners_px())
    latitude, longitude, _ = spherical_from_mcmf(corners)
    down = nadir_camera_from_mcmf(position)
    relative = rotation @ np.asarray(down).T
    return {
        "frame": int(row["number"]),
        "source": shard.source.name,
        "split": shard.source.split,
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
        "sun_camera": [float(value) for value in sun_camera],
        "corners_deg": [
            {"latitude": float(a), "longitude": float(o) % 360.0}
            for a, o in zip(np.degrees(latitude), np.degrees(longitude), strict=True)
        ],
        "position_mcmf_m": [float(value) for value in position],
        "camera_from_mcmf": [[float(value) for value in line] for line in rotation],
    }


_open_terrains: dict[tuple[str, int, str], Any] = {}


def _terrain(source: Source, seed: int, data_root: str) -> Any:
    """The terrain of a shard; a worker keeps the last one it used."""
    from payload_emulator.sim.terrain.opening import open_terrain

    key = (source.terrain, seed, data_root)
    if key not in _open_terrains:
        _open_terrains.clear()
        kind = "raster" if source.terrain == "real" else "procedural"
        _open_terrains[key] = open_terrain(kind, find_data(Path(data_root) if data_root else None), seed)
    return _open_terrains[key]


def _claim(folder: Path, recipe: Recipe, frames: int) -> None:
    """Make the folder for this recipe, or refuse one that holds another data set."""
    claim = folder / "recipe.json"
    wanted = {"recipe_sha256": recipe.digest, "frames": frames}
    if claim.is_file():
        found = json.loads(claim.read_text(encoding="utf-8"))
        if found != wanted:
            raise DatasetError(
                f"{folder}: expected an empty folder or the same data set (recipe {recipe.digest[:12]}, "
                f"{frames} frames), "
                f"found one of recipe {str(found.get('recipe_sha256'))[:12]}, {found.get('frames')} frames"
            )
    elif folder.exists() and any(folder.iterdir()):
        raise DatasetError(f"{folder}: expected an empty folder or a data set, found other files")
    for name in ("images", "metadata", "shards"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    store.write_json(claim, wanted)


def _data_names(recipe: Recipe, data: DataFolder) -> list[str]:
    if any(source.terrain == "real" for source in recipe.sources):
        return list(data.names())
    return ["procedural Moon (no data)"]
