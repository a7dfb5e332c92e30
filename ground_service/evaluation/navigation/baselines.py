"""What the ground would know without any camera: the start state, propagated to every sample.

Every estimate is compared with two baselines: the two-body orbit, and propagation with a gravity field of moderate
degree with the Earth and the Sun. An estimate that is no better than these has learnt nothing from its images.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.frames import Orientation
from lunar.gravity import GravityField
from lunar.propagation import ForceModel, propagate
from lunar.timescales import tdb_s_from_utc_ns

BASELINE_DEGREE = 50
"""Degree of the propagate-only baseline: what a flight computer can afford."""


@dataclass(frozen=True, slots=True, eq=False)
class StartState:
    """The state that the estimators were started from, Moon-centred ICRF."""

    utc_ns: int
    position_icrf_m: FloatArray
    velocity_icrf_m_s: FloatArray


def propagated_positions(
    start: StartState,
    utc_ns: IntArray,
    gravity: GravityField,
    degree: int,
    orientation: Orientation,
    *,
    third_bodies: bool = True,
) -> FloatArray:
    """Return the ICRF positions (n, 3) of the start state flown on to `utc_ns` (n,), ascending; NaN before the start.

    Degree 0 without third bodies is the two-body (Kepler) orbit.

    Raises
    ------
    ImpactError
        If the orbit meets the ground.
    """
    positions = np.full((len(utc_ns), 3), np.nan)
    after = np.asarray(utc_ns) >= start.utc_ns
    if not after.any():
        return positions
    epoch = float(tdb_s_from_utc_ns(start.utc_ns))
    tdb_s = np.asarray(tdb_s_from_utc_ns(np.asarray(utc_ns)[after]), dtype=np.float64)
    duration_s = float(tdb_s[-1] - epoch)
    if duration_s <= 0.0:
        positions[after] = start.position_icrf_m
        return positions
    model = ForceModel(
        gravity=gravity,
        degree=min(degree, gravity.degree),
        orientation=orientation,
        earth=third_bodies,
        sun=third_bodies,
    )
    trajectory = propagate(epoch, start.position_icrf_m, start.velocity_icrf_m_s, duration_s, model)
    positions[after] = trajectory.state(np.minimum(tdb_s, trajectory.stop_tdb_s))[:, :3]
    return positions
