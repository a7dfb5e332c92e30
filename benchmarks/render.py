"""Time of a 512 x 512 frame with shadows on one core, its stages beside it: python -m benchmarks.render.

Alternative named beside it: the ray march over the same frame (every 8th pixel of every 8th row, scaled up).
"""

from __future__ import annotations

import json
import math
import os
import resource
import time

import numpy as np

from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.datafolder import find_data
from lunar.frames import mcmf_from_spherical
from payload_emulator.sim import raymarch, renderer
from payload_emulator.sim.labels import label_frame
from payload_emulator.sim.light import paper_light, sun_direction_mcmf
from payload_emulator.sim.sensor import SensorModel, expose
from payload_emulator.sim.terrain.opening import open_terrain
from payload_emulator.sim.terrain.tiles import TiledTerrain

REPEATS = 9


def measure(terrain: TiledTerrain, latitude_deg: float, longitude_deg: float) -> dict[str, object]:
    """Milliseconds of processor time per stage at three altitudes, the smallest of nine."""
    camera = PinholeCamera()
    rows: dict[str, object] = {}
    for number, altitude_km in enumerate((14.0, 30.0, 48.6)):
        place = math.radians(latitude_deg), math.radians(longitude_deg)
        position = mcmf_from_spherical(*place, 1000.0 * altitude_km)
        rotation = nadir_camera_from_mcmf(position)
        sun = sun_direction_mcmf(*paper_light(1, number), *place)
        first = time.thread_time()
        picture = renderer.render(terrain, camera, position, rotation, sun)
        first = time.thread_time() - first
        label_frame(terrain, camera, position, rotation, lit=picture.lit)
        stages: dict[str, list[float]] = {"render": [], "sensor": [], "labels": []}
        for _ in range(REPEATS):
            marks = [time.thread_time()]
            picture = renderer.render(terrain, camera, position, rotation, sun)
            marks.append(time.thread_time())
            expose(picture.radiance, SensorModel(), np.random.default_rng(0))
            marks.append(time.thread_time())
            label_frame(terrain, camera, position, rotation, lit=picture.lit)
            marks.append(time.thread_time())
            for name, spent in zip(stages, np.diff(marks), strict=True):
                stages[name].append(1e3 * float(spent))
        raymarch.render(terrain, camera, position, rotation, sun, every=64)
        began = time.thread_time()
        raymarch.render(terrain, camera, position, rotation, sun, every=8)
        marched = 64.0 * (time.thread_time() - began)
        rows[f"{altitude_km:g} km"] = {
            **{f"{name}_ms": round(min(values), 1) for name, values in stages.items()},
            "first_frame_with_tiles_ms": round(1e3 * first, 1),
            "raymarch_ms": round(1e3 * marched),
        }
    return rows


def main() -> None:
    root = os.environ.get("LINNA_DATA")
    results: dict[str, object] = {
        "procedural": measure(open_terrain("procedural", find_data(None), 3), 10.0, 20.0)
    }
    if root:
        results["GLD100"] = measure(open_terrain("raster", find_data(root), 3), -25.0, 305.0)
    results["peak_rss_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
