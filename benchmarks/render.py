"""Renderers: python -m benchmarks render, or python -m benchmarks.render [--poses N] [--every K] [--terrain KIND].

One JSON object, on the procedural Moon and, where LINNA_DATA names it, on GLD100 terrain no detector was trained on.

speed: milliseconds of processor time of a 512 x 512 frame with shadows, by stage, at three altitudes, the smallest of
nine; for comparison the ray march over the same frame, and Blender's Cycles at 16 samples where
LINNA_BLENDER_PYTHON names an interpreter that has it.
fast_vs_raymarch: random poses of 14 to 50 km, Sun of 3 to 60 degrees, any azimuth and yaw, tilt to 5 degrees.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks._rows import Row
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.datafolder import find_data
from lunar.errors import LunarError
from lunar.frames import mcmf_from_spherical
from lunar.lens import pointed_camera_from_mcmf
from payload_emulator.errors import PayloadError
from payload_emulator.sim.render import raymarch, renderer
from payload_emulator.sim.render.cycles import render_scene
from payload_emulator.sim.render.cycles_scene import CyclesSettings, describe_scene
from payload_emulator.sim.render.labels import label_frame
from payload_emulator.sim.render.light import sun_direction_mcmf
from payload_emulator.sim.render.renderer import Rendering
from payload_emulator.sim.render.sensor import SensorModel, take_picture
from payload_emulator.sim.terrain.opening import open_terrain
from payload_emulator.sim.terrain.tiles import Terrain

REPEATS = 9
CAMERA = PinholeCamera()
SHADOW = 0.5
"""Ground that sees less of the Sun's disc is in shadow."""

FULLY_LIT = 0.95


@dataclasses.dataclass(frozen=True)
class Region:
    """Region of random poses: latitudes and longitudes in degrees; the place of the timed frames."""

    latitude_deg: tuple[float, float]
    longitude_deg: tuple[float, float]
    timed_deg: tuple[float, float]


PROCEDURAL = Region((-55.0, 55.0), (0.0, 360.0), (10.0, 20.0))
# Western Procellarum to the southern highlands, away from the edges of the available tiles.
REAL = Region((-50.0, 50.0), (286.0, 298.0), (-25.0, 295.0))


@dataclasses.dataclass(frozen=True, slots=True)
class Agreement:
    """Of one renderer with another.

    Attributes
    ----------
    shadow_iou
        Pixels dark in both over pixels dark in either; NaN without any.
    radiance_rmse
        Root mean square difference where both see the whole Sun, as a share of the reference's mean there; each view
        against its own mean.
    correlation
        Of radiance over all pixels on the Moon, the mean over views.
    views, dark_pixels
        What the figures come from; dark in either.
    """

    shadow_iou: float
    radiance_rmse: float
    correlation: float
    views: int
    dark_pixels: int


def speed(terrain: Terrain, region: Region, blender: str) -> dict[str, object]:
    """Milliseconds of processor time per stage at three altitudes."""
    return {
        f"{km:g} km": _speed_at(terrain, region, km, n, blender) for n, km in enumerate((14.0, 30.0, 48.6))
    }


def _speed_at(
    terrain: Terrain, region: Region, altitude_km: float, number: int, blender: str
) -> dict[str, object]:
    place = math.radians(region.timed_deg[0]), math.radians(region.timed_deg[1])
    position = mcmf_from_spherical(*place, 1000.0 * altitude_km)
    pose = (terrain, CAMERA, position, nadir_camera_from_mcmf(position))
    rng = np.random.default_rng((1, number))
    light = math.radians(rng.uniform(5.0, 15.0)), math.radians(rng.uniform(-45.0, 45.0))
    view = (*pose, sun_direction_mcmf(*light, *place))
    first_ms = _cpu_ms(lambda: renderer.render(*view))
    picture = renderer.render(*view)
    label_frame(*pose, lit=picture.lit)
    render_ms = _least_ms(lambda: renderer.render(*view))
    raymarch.render(*view, every=64)
    march_ms = 64.0 * _cpu_ms(lambda: raymarch.render(*view, every=8))
    sensor_ms = _least_ms(lambda: take_picture(picture.radiance, SensorModel(), np.random.default_rng(0)))
    row: dict[str, object] = {
        "render_ms": round(render_ms, 1),
        "sensor_ms": round(sensor_ms, 1),
        "labels_ms": round(_least_ms(lambda: label_frame(*pose, lit=picture.lit)), 1),
        "first_frame_with_tiles_ms": round(first_ms, 1),
        "raymarch_ms": round(march_ms),
        "raymarch_over_fast": round(march_ms / render_ms),
    }
    if blender and number == 1:
        made = render_scene(describe_scene(*view), CyclesSettings(samples=16), blender)
        row["cycles_16_samples_cpu_ms"] = round(1e3 * made.render_cpu_s)
        row["cycles_16_samples_wall_ms"] = round(1e3 * made.render_s)
        row["cycles_cpu_over_fast"] = round(1e3 * made.render_cpu_s / render_ms)
        row["blender"] = made.blender
    return row


def agreement(terrain: Terrain, region: Region, poses: int, every: int) -> dict[str, object]:
    """Fast against the ray march over the same random poses."""
    rng = np.random.default_rng(20)
    fast, marched = [], []
    tried = 0
    while len(fast) < poses and tried < 4 * poses:
        tried += 1
        latitude = math.radians(rng.uniform(*region.latitude_deg))
        longitude = math.radians(rng.uniform(*region.longitude_deg))
        position = mcmf_from_spherical(latitude, longitude, rng.uniform(14e3, 50e3))
        rotation = pointed_camera_from_mcmf(
            position, math.radians(rng.uniform(-5.0, 5.0)), rng.uniform(0.0, 2.0 * math.pi)
        )
        elevation, azimuth = math.radians(rng.uniform(3.0, 60.0)), rng.uniform(0.0, 2.0 * math.pi)
        view = (
            terrain,
            CAMERA,
            position,
            rotation,
            sun_direction_mcmf(elevation, azimuth, latitude, longitude),
        )
        try:
            picture = renderer.render(*view)
            oracle = raymarch.render(*view, every=every)
        except (PayloadError, LunarError) as error:
            print(f"pose left out: {error}", flush=True)
            continue
        fast.append(thinned(picture, every))
        marched.append(oracle)
    return {
        "fast_vs_raymarch": {
            **{
                key: round(value, 4)
                for key, value in dataclasses.asdict(compare_renderings(marched, fast)).items()
            },
            "worst_view_radiance_rmse": round(
                max(compare_renderings([m], [f]).radiance_rmse for m, f in zip(marched, fast, strict=True)), 4
            ),
            "median_range_error_m": round(
                float(
                    np.median(
                        [
                            np.nanmedian(np.abs(m.range_m - f.range_m))
                            for m, f in zip(marched, fast, strict=True)
                        ]
                    )
                ),
                2,
            ),
        },
    }


def compare_renderings(reference: Sequence[Rendering], other: Sequence[Rendering]) -> Agreement:
    """Agreement over views: renderings of the same ones by two renderers, in the same order."""
    both = either = 0
    errors, correlations = [], []
    for one, two in zip(reference, other, strict=True):
        ground = np.isfinite(one.range_m) & np.isfinite(two.range_m)
        dark, also = ground & (one.lit < SHADOW), ground & (two.lit < SHADOW)
        both += int(np.count_nonzero(dark & also))
        either += int(np.count_nonzero(dark | also))
        lit = ground & (one.lit > FULLY_LIT) & (two.lit > FULLY_LIT)
        if lit.any():
            expected = one.radiance[lit].astype(np.float64)
            errors.append(float(np.mean((two.radiance[lit] - expected) ** 2)) / float(expected.mean()) ** 2)
        correlations.append(_correlation(one.radiance[ground], two.radiance[ground]))
    return Agreement(
        shadow_iou=both / either if either else math.nan,
        radiance_rmse=math.sqrt(float(np.mean(errors))) if errors else math.nan,
        correlation=float(np.mean(correlations)) if correlations else math.nan,
        views=len(reference),
        dark_pixels=either,
    )


def thinned(rendering: Rendering, every: int) -> Rendering:
    """Each so-manieth pixel of each so-manieth row, as `raymarch.render` gives with the same ``every``."""
    return Rendering(
        rendering.radiance[::every, ::every],
        rendering.lit[::every, ::every],
        rendering.range_m[::every, ::every],
    )


def _correlation(one: NDArray[np.float32], two: NDArray[np.float32]) -> float:
    if one.size < 2 or one.std() == 0.0 or two.std() == 0.0:
        return math.nan
    return float(np.corrcoef(one, two)[0, 1])


def _least_ms(work: Callable[[], Any]) -> float:
    return min(_cpu_ms(work) for _ in range(REPEATS))


def _cpu_ms(work: Callable[[], Any]) -> float:
    began = time.thread_time()
    work()
    return 1e3 * (time.thread_time() - began)


def rows() -> Iterator[Row]:
    """Yield the fast renderer compared with the ray march on the procedural Moon; different pictures are an error."""
    terrain = open_terrain("procedural", find_data(None), 3)
    found: Any = agreement(terrain, PROCEDURAL, poses=6, every=16)["fast_vs_raymarch"]
    wrong = "" if found["correlation"] > 0.99 and found["median_range_error_m"] < 5.0 else f"{found}"
    for altitude, stages in speed(terrain, PROCEDURAL, "").items():
        one: Any = stages
        yield Row(f"frame from {altitude}", one["render_ms"], "ms", "ray march", one["raymarch_ms"], wrong)
        first = one["first_frame_with_tiles_ms"]
        yield Row(f"first frame of a place from {altitude}", first, "ms", "later frames", one["render_ms"])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--poses", type=int, default=50, help="random poses per terrain (default: 50)")
    parser.add_argument(
        "--every", type=int, default=8, help="march every so-manieth pixel and row (default: 8)"
    )
    parser.add_argument("--terrain", choices=("procedural", "real"), help="only this one (default: both)")
    arguments = parser.parse_args()
    root = os.environ.get("LINNA_DATA")
    blender = os.environ.get("LINNA_BLENDER_PYTHON", "")
    results: dict[str, object] = {}
    worlds = [("procedural Moon (level 2)", "procedural", None, PROCEDURAL)]
    if root:
        worlds.append(("GLD100, regions never trained on (level 3)", "raster", root, REAL))
    for name, kind, data, region in worlds:
        if arguments.terrain and (arguments.terrain == "real") != (kind == "raster"):
            continue
        terrain = open_terrain(kind, find_data(data), 3)
        results[name] = {
            "speed": speed(terrain, region, blender),
            **agreement(terrain, region, arguments.poses, arguments.every),
        }
    results["peak_rss_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
