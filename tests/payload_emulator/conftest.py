"""A small world for navigation: a rough gravity field, craters of the paper's density, the paper's orbit."""

import functools
from typing import Any

import numpy as np
from pytest import MonkeyPatch, fixture

from lunar.elements import Elements, icrf_state_from_elements
from lunar.frames import IauOrientation
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from payload_emulator.sim.terrain import procedural
from studies.montecarlo import NavigationCase
from studies.montecarlo_world import crater_world, rough_gravity

EPOCH = parse_utc("2029-08-07T00:00:00Z")
TRUTH_DEGREE = 60


@fixture(scope="session", autouse=True)
def drawn_moons():
    """Keep plains and craters of the two newest seeds, which each opened world would draw; what draws is yielded."""
    plains, craters = procedural._plains_map, procedural._draw_catalogue
    kept = functools.lru_cache(2)(lambda salts: plains(list(salts)))
    moons = dict[int, Any]()

    def draw(rng, map_of_plains, seed):
        if seed not in moons:
            while len(moons) > 1:
                del moons[next(iter(moons))]
            moons[seed] = craters(rng, map_of_plains, seed)
        return moons[seed]

    with MonkeyPatch.context() as patch:
        patch.setattr(procedural, "_plains_map", lambda salts: kept(tuple(salts)))
        patch.setattr(procedural, "_draw_catalogue", draw)
        yield plains, craters


@fixture(scope="session")
def navigation_case():
    """Return a maker of cases; every argument of `NavigationCase` can be replaced."""
    gravity, craters = rough_gravity(TRUTH_DEGREE), crater_world()
    position, velocity = icrf_state_from_elements(
        Elements(1_768_180.0, 0.006908, *np.radians([89.076, 3.164, 333.604, 8.882])),
        float(tdb_s_from_utc_ns(EPOCH)),
        gravity.gm_m3_s2,
    )

    def make(frames=120, **changes):
        values = {
            "epoch_utc_ns": EPOCH, "position_icrf_m": position, "velocity_icrf_m_s": velocity,
            "frame_utc_ns": EPOCH + np.arange(frames) * 15 * 10**9, "imaging": np.ones(frames, dtype=bool),
            "gravity": gravity, "gravity_degree": TRUTH_DEGREE, "orientation": IauOrientation(),
            "filter_gravity": gravity.truncated(50), "filter_orientation": IauOrientation(), "craters": craters,
        }  # fmt: skip
        return NavigationCase(**{**values, **changes})

    return make
