"""A small world for navigation: a rough gravity field, craters of the paper's density, the paper's orbit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from lunar.catalogue import CraterCatalogue, make_catalogue
from lunar.elements import Elements, icrf_state_from_elements
from lunar.frames import IauOrientation
from lunar.gravity import GravityField, builtin_gravity
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from payload_emulator.montecarlo import NavigationCase

EPOCH = parse_utc("2029-08-07T00:00:00Z")
TRUTH_DEGREE = 60
# Kaula's rule for the Moon: 2.5e-4 / n^2 per coefficient.
KAULA = 2.5e-4


def rough_gravity(degree: int = TRUTH_DEGREE, seed: int = 3) -> GravityField:
    """Return the built-in field continued with random coefficients of the size that the Moon's have."""
    known = builtin_gravity()
    rng = np.random.default_rng(seed)
    n = np.arange(degree + 1)
    size = np.where(n > known.degree, KAULA / np.maximum(n, 1) ** 2, 0.0)[:, None]
    c_bar = np.tril(rng.standard_normal((degree + 1, degree + 1))) * size
    s_bar = np.tril(rng.standard_normal((degree + 1, degree + 1)), -1) * size
    s_bar[:, 0] = 0.0
    k = known.degree + 1
    c_bar[:k, :k], s_bar[:k, :k] = known.c_bar, known.s_bar
    return GravityField("rough", known.gm_m3_s2, known.radius_m, c_bar, s_bar)


def crater_world(seed: int = 11) -> CraterCatalogue:
    """Return craters of 5 to 30 km, as dense as the paper's, with heights of two kilometres' range."""
    rng = np.random.default_rng(seed)
    count = int(4.0 * np.pi * 1_737_400.0**2 * 2.09e-9)
    z, longitude = rng.uniform(-1.0, 1.0, count), rng.uniform(0.0, 2.0 * np.pi, count)
    # Cumulative size distribution with slope -1.77: the paper's own counts of its classes.
    diameter = 5e3 * (1.0 - rng.uniform(size=count) * (1.0 - 6.0**-1.77)) ** (-1.0 / 1.77)
    height = 1_500.0 * np.sin(3.0 * longitude) * z + 500.0 * rng.standard_normal(count)
    return make_catalogue(np.arcsin(z), longitude, diameter, source="simulated", rim_height_m=height)


@pytest.fixture(scope="session")
def navigation_case() -> Callable[..., NavigationCase]:
    """Return a maker of cases; every argument of `NavigationCase` can be replaced."""
    gravity, craters = rough_gravity(), crater_world()
    position, velocity = icrf_state_from_elements(
        Elements(1_768_180.0, 0.006908, *np.radians([89.076, 3.164, 333.604, 8.882])),
        float(tdb_s_from_utc_ns(EPOCH)),
        gravity.gm_m3_s2,
    )

    def make(frames: int = 120, **changes: Any) -> NavigationCase:
        values: dict[str, Any] = {
            "epoch_utc_ns": EPOCH,
            "position_icrf_m": position,
            "velocity_icrf_m_s": velocity,
            "frame_utc_ns": EPOCH + np.arange(frames) * 15 * 10**9,
            "imaging": np.ones(frames, dtype=bool),
            "gravity": gravity,
            "gravity_degree": TRUTH_DEGREE,
            "orientation": IauOrientation(),
            "filter_gravity": gravity.truncated(50),
            "filter_orientation": IauOrientation(),
            "craters": craters,
        }
        return NavigationCase(**{**values, **changes})

    return make
