"""Crude data sets for the tests: bright-and-dark blobs on a plain, drawn without any renderer."""

import numpy as np
from pytest import fixture

from payload_emulator.session.world.recipe import Recipe, Source
from payload_emulator.training.data import dataset as store
from payload_emulator.training.data.dataset import FrameTruth
from payload_emulator.training.data.finishing import write_index
from payload_emulator.training.evaluate.scoring import FrameDetections

SIZE = 512


def truth_of(u, v, diameter=30.0, ratio=0.1, azimuth=0.0, number=0, diameter_m=7e3):
    u, v = np.array(u, float), np.array(v, float)
    columns = (np.broadcast_to(one, u.shape).astype(float) for one in (diameter, diameter_m, ratio))
    return FrameTruth(u, v, *columns, np.arange(u.size) + 100 * number, 512, 512, azimuth, number)


def found_at(u, v, diameter=30.0, diameter_m=7e3, scores=0.9, sigma=1.0, *further, **more):
    """Detections; a number stands for an array of it."""
    u, columns = np.array(u, float), (v, diameter, diameter_m, scores, sigma, *further)
    return FrameDetections(u, *(np.broadcast_to(one, u.shape).astype(float) for one in columns), **more)


def draw_blobs(rng, u, v, diameter, pits=()):
    """Gray image (512, 512) of blobs like craters (lit below: Sun at the top) and pits, dark spots of 40 px."""
    row, column = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
    image = 110.0 + 4.0 * rng.standard_normal((SIZE, SIZE))
    for x, y, d in zip(u, v, diameter, strict=True):
        dx, dy = (column - x) / (0.5 * d), (row - y) / (0.5 * d)
        image += 90.0 * dy * np.exp(-1.5 * (dx * dx + dy * dy))
    for x, y in pits:
        image -= 60.0 * np.exp(-1.5 * ((column - x) ** 2 + (row - y) ** 2) / 20.0**2)
    return np.clip(image, 0, 255).astype(np.uint8)


def write_blob_dataset(folder, frames_per_split, seed=3, pits=()):
    """A data set of blobs in the project's own format, 30 km up over a plain; pits have no labels."""
    recipe = Recipe("blobs", seed, tuple(Source(name, name, "procedural", 1.0) for name in frames_per_split))
    for name in ("images", "metadata", "shards"):
        (folder / name).mkdir(parents=True)
    hashes, number = {}, 0
    rng = np.random.default_rng(seed)
    position = np.array([1_737_400.0 + 30_000.0, 0.0, 0.0])
    # At latitude and longitude 0 the axes are up, east, north; the camera's are east, south, down.
    rotation = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    focal = 256.0 / np.tan(np.radians(60.0))
    for shard, (split, count) in enumerate(frames_per_split.items()):
        rows, craters, first = [], [], [0]
        for _ in range(count):
            n = 12
            u, v = rng.uniform(25, SIZE - 25, n), rng.uniform(25, SIZE - 25, n)
            far = np.array([i == 0 or np.hypot(u[:i] - u[i], v[:i] - v[i]).min() > 60 for i in range(n)])
            u, v = u[far], v[far]
            d = rng.uniform(26.0, 50.0, u.size)
            store.write_frame(folder / "images" / f"{number:06d}.png", draw_blobs(rng, u, v, d, pits))
            store.write_json(folder / "metadata" / f"{number:06d}.json", {"frame": number})
            rows.append(number)
            craters.append(
                {
                    "id": np.arange(u.size) + 1000 * number, "u_px": u, "v_px": v, "diameter_px": d,
                    "diameter_m": d * 30_000.0 / focal, "depth_ratio": np.full(u.size, 0.15),
                    "lit": np.ones(u.size), "hidden": np.zeros(u.size, np.uint8), "latitude_deg": np.zeros(u.size),
                    "longitude_deg": np.zeros(u.size),
                }
            )  # fmt: skip
            first.append(first[-1] + u.size)
            number += 1
        values = {
            "number": rows, "latitude_deg": 0.0, "longitude_deg": 0.0, "altitude_m": 30_000.0, "ground_m": 0.0,
            "sun_elevation_deg": 10.0, "sun_azimuth_deg": 0.0, "block": rows,
        }  # fmt: skip
        labels = store.ShardLabels(
            source=split,
            split=split,
            complete=True,
            frames={
                key: np.broadcast_to(np.asarray(values[key], float), (count,)).copy() for key in store.FRAME_COLUMNS
            },
            sun_camera=np.tile([0.0, -0.98, -0.17], (count, 1)),
            camera_from_mcmf=np.tile(rotation, (count, 1, 1)),
            position_mcmf_m=np.tile(position, (count, 1)),
            craters={key: np.concatenate([part[key] for part in craters]) for key in store.CRATER_COLUMNS},
            first=np.array(first),
        )
        hashes[f"{shard:05d}"] = store.write_shard(folder, f"{shard:05d}", labels)
    write_index(folder, recipe, number, hashes, ["blobs"])
    return store.Dataset(folder)


@fixture(scope="session")
def blob_dataset(tmp_path_factory):
    return write_blob_dataset(tmp_path_factory.mktemp("blobs") / "set", {"train": 24, "val": 6, "test": 4})


@fixture(scope="session")
def make_blob_dataset():
    return write_blob_dataset
