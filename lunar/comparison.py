"""Ephemerides compared: with each other, in radial, transverse and normal axes of the first, and with gravity."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import FloatArray, IntArray
from lunar.constants import GM_EARTH_M3_S2, GM_MOON_M3_S2, NS
from lunar.ephemeris import Ephemeris, EphemerisSegment
from lunar.errors import EphemerisCoverageError, UnmovedByGravity
from lunar.frames import rtn_from_inertial
from lunar.third_bodies import earth_position_icrf_m
from lunar.timescales import format_utc, tdb_s_from_tai_ns

GRAVITY_TOLERANCE = 2.5e-3
"""Largest median deviation of states from the motion about a point mass, as a part of the fall: see `check_gravity`."""

_ARC_RAD, _LONGEST_S, _FALL_M = 0.3, 21_600.0, 1000.0
_PAIRS, _STEPS = 200, 8
_NEAREST_EARTH_M, _MOST_TIDE = 3.56e8, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class EphemerisDifference:
    """Difference (second minus first) at ``samples`` epochs; means and rms are radial, transverse, normal."""

    max_m: float
    rms_m: float
    mean_rtn_m: tuple[float, float, float]
    rms_rtn_m: tuple[float, float, float]
    samples: int
    utc_ns: IntArray
    position_rtn_m: FloatArray
    velocity_rtn_m_s: FloatArray


def compare(first: Ephemeris, second: Ephemeris, utc_ns: ArrayLike | None = None) -> EphemerisDifference:
    """Return the difference at epochs (n,), or at the states of the first that the second covers.

    Velocities are differenced in inertial axes and then rotated. They are not the rates of ``position_rtn_m``.

    Raises
    ------
    EphemerisCoverageError
        If the ephemerides have no common epoch, or do not both cover a given epoch.
    """
    if utc_ns is None:
        epochs = first.utc_ns[second.covers(first.utc_ns)]
        if len(epochs) == 0:
            raise EphemerisCoverageError(
                f"{format_utc(first.start_utc_ns)}..{format_utc(first.stop_utc_ns)}",
                f"{format_utc(second.start_utc_ns)}..{format_utc(second.stop_utc_ns)}",
                "comparison",
            )
    else:
        epochs = np.atleast_1d(np.asarray(utc_ns, dtype=np.int64))
    position_m, velocity_m_s = first.at(epochs)
    other_m, other_m_s = second.at(epochs)
    rtn = rtn_from_inertial(position_m, velocity_m_s)
    position_rtn_m = np.einsum("nij,nj->ni", rtn, other_m - position_m)
    velocity_rtn_m_s = np.einsum("nij,nj->ni", rtn, other_m_s - velocity_m_s)
    distance_m = np.linalg.norm(position_rtn_m, axis=1)
    means, squares = position_rtn_m.mean(axis=0), np.mean(position_rtn_m**2, axis=0)
    return EphemerisDifference(
        float(np.max(distance_m)),
        float(np.sqrt(np.mean(distance_m**2))),
        (float(means[0]), float(means[1]), float(means[2])),
        (math.sqrt(squares[0]), math.sqrt(squares[1]), math.sqrt(squares[2])),
        len(epochs),
        epochs,
        position_rtn_m,
        velocity_rtn_m_s,
    )


def check_gravity(ephemeris: Ephemeris) -> None:
    """Refuse an ephemeris whose states do not move as gravity moves them: other axes, units, centre or body.

    From states of each arc, orbits about the Moon as a point mass with the tide of the Earth are computed over 0.3 rad.
    The distance from the state there is divided by that through which gravity pulls it meanwhile.  Half of these
    quotients are above the median, which manoeuvres and single bad states do not move.  It is 5e-4 at altitudes of 18
    to 48 km in the GRAIL field, 2e-3 with velocities rounded to 1 m/s, and 4e-3 in axes that turn with the Moon.
    Shorter arcs, which a mascon may govern, count as the part of 0.3 rad that they are; without a fall of 1 km, not.

    Raises
    ------
    UnmovedByGravity
        Where the median of an arc is above `GRAVITY_TOLERANCE`, with the numbers.
    """
    for arc in ephemeris.arcs():
        measured = _deviations(arc)
        if not len(measured):
            continue
        weighted, off, expected, found, radius = np.median(measured, axis=0).tolist()
        # An orbit that was computed without the Earth is accepted too.
        tide = 3.0 * GM_EARTH_M3_S2 / GM_MOON_M3_S2 * (radius / _NEAREST_EARTH_M) ** 3
        if weighted > GRAVITY_TOLERANCE + min(tide, _MOST_TIDE):
            raise UnmovedByGravity(arc.object_name, radius, expected, found, off)


def _deviations(arc: EphemerisSegment) -> FloatArray:
    """Return weighted and plain deviation, expected and found acceleration, and radius (m, 5) of pairs of states."""
    seconds = (arc.tai_ns - arc.tai_ns[0]) / NS
    first = np.unique(np.linspace(0, len(seconds) - 1, _PAIRS).astype(np.int64))
    radius = np.linalg.norm(arc.position_m[first], axis=1)
    reach = np.minimum(_ARC_RAD * np.sqrt(radius**3 / GM_MOON_M3_S2), _LONGEST_S)
    last = np.minimum(np.searchsorted(seconds, seconds[first] + reach), len(seconds) - 1)
    span = (seconds[last] - seconds[first])[:, None]
    middle = (arc.tai_ns[first] + arc.tai_ns[last]) // 2
    start, speed = arc.position_m[first], arc.velocity_m_s[first]
    fallen = (
        _moved(start, speed, span, earth_position_icrf_m(tdb_s_from_tai_ns(middle))) - start - span * speed
    )
    found = arc.position_m[last] - start - span * speed
    expected_m, found_m, off_m = (np.linalg.norm(one, axis=1) for one in (fallen, found, found - fallen))
    kept = np.maximum(expected_m, found_m) > _FALL_M
    seconds_s = span[kept, 0]
    off, per_square = off_m[kept] / expected_m[kept], 2.0 / seconds_s**2
    weighted = off * np.minimum(seconds_s / reach[kept], 1.0)
    accelerations = [expected_m[kept] * per_square, found_m[kept] * per_square]
    return np.column_stack([weighted, off, *accelerations, radius[kept]])


def _moved(position: FloatArray, velocity: FloatArray, span: FloatArray, earth: FloatArray) -> FloatArray:
    """Return positions (n, 3) after spans of time (n, 1), by Runge and Kutta's method of order 4."""

    def rate(state: FloatArray) -> FloatArray:
        there = state[0]
        to_earth = earth - there
        pull = -GM_MOON_M3_S2 * there / np.linalg.norm(there, axis=1, keepdims=True) ** 3
        for sign, one in ((1.0, to_earth), (-1.0, earth)):
            pull = pull + sign * GM_EARTH_M3_S2 * one / np.linalg.norm(one, axis=1, keepdims=True) ** 3
        return np.stack([state[1], pull])

    state, step = np.stack([position, velocity]), span / _STEPS
    for _ in range(_STEPS):
        k1 = rate(state)
        k2 = rate(state + step / 2.0 * k1)
        k3 = rate(state + step / 2.0 * k2)
        state = state + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(state + step * k3))
    return np.asarray(state[0])
