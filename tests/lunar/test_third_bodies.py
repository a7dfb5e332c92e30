"""Earth and Sun seen from the Moon against a published ephemeris."""

import json
from pathlib import Path

import numpy as np
import pytest

from lunar.constants import GM_EARTH_M3_S2, GM_SUN_M3_S2
from lunar.third_bodies import earth_position_icrf_m, sun_position_icrf_m

REFERENCE = json.loads(
    (Path(__file__).parents[1] / "references" / "lunar" / "third_bodies_de421.json").read_text()
)
ORBIT_RADIUS_M = 1_768_180.0


def tide(gm: float, body_m: np.ndarray, orbiter_m: np.ndarray) -> np.ndarray:
    """Pull on the orbiter less the pull on the Moon, m/s^2."""
    away = body_m - orbiter_m
    return gm * (away / np.linalg.norm(away) ** 3 - body_m / np.linalg.norm(body_m) ** 3)


@pytest.mark.parametrize("body", ["earth", "sun"])
def test_pulls_on_a_low_orbit_are_those_of_de421(body: str) -> None:
    position, gm = {
        "earth": (earth_position_icrf_m, GM_EARTH_M3_S2),
        "sun": (sun_position_icrf_m, GM_SUN_M3_S2),
    }[body]
    rng = np.random.default_rng(1)
    for epoch in REFERENCE["epochs"]:
        ours_m = position((epoch["jd_tdb"] - 2_451_545.0) * 86_400.0)
        theirs_m = 1e3 * np.array(epoch[f"{body}_km"])
        direction = rng.standard_normal(3)
        orbiter_m = ORBIT_RADIUS_M * direction / np.linalg.norm(direction)
        expected = tide(gm, theirs_m, orbiter_m)
        error = np.linalg.norm(tide(gm, ours_m, orbiter_m) - expected)
        # Required: 1e-4 of the acceleration; the theory's 5 km leave 4e-5 of the Earth's, 2e-7 of the Sun's.
        assert error < {"earth": 5e-5, "sun": 1e-6}[body] * np.linalg.norm(expected), epoch["jd_tdb"]
        assert np.linalg.norm(ours_m - theirs_m) < {"earth": 5e3, "sun": 15e3}[body], epoch["jd_tdb"]


def test_whole_arrays_of_epochs_keep_their_shape() -> None:
    times = np.linspace(0.0, 1e9, 6).reshape(2, 3)
    for position in (earth_position_icrf_m, sun_position_icrf_m):
        many = position(times)
        assert many.shape == (2, 3, 3)
        np.testing.assert_allclose(many[1, 2], position(times[1, 2]), atol=1e-3)  # m
