"""Ephemerides compared: with each other, in radial, transverse and normal axes of the first, and with gravity."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.constants import GM_EARTH_M3_S2, GM_MOON_M3_S2, NS
from lunar.ephemeris import Ephemeris, EphemerisSegment
from lunar.errors import EphemerisCoverageError, EphemerisError, UnmovedByGravity
from lunar.frames import matrix_from_quaternion, rtn_from_inertial
from lunar.plausible import OFF_NADIR_DEG, ORBIT_RADIUS_M, ORBIT_SPEED_M_S, VIEWS_OF_MOON
from lunar.third_bodies import earth_position_icrf_m
from lunar.timescales import format_tai, format_utc, tdb_s_from_tai_ns

GRAVITY_TOLERANCE = 2.5e-3
"""Largest median deviation of states from the motion about a point mass, as a part of the fall: see `check_gravity`."""

_ARC_RAD, _LONGEST_S, _FALL_M = 0.3, 21_600.0, 1000.0
_PAIRS, _STEPS = 200, 8
_NEAREST_EARTH_M, _MOST_TIDE = 3.56e8, 0.5
_SINGLE, _SINGLE_M, _FEWEST = 0.02, 100.0, 6
"""Part of the fall, and distance for rounded values, beyond which a state is off its neighbours; fewest states."""

_BURN_M_S = 100.0
"""More than an orbit correction changes the velocity."""

_BURN_LEAST_M_S, _UNMODELLED_M_S2 = 0.2, 5e-3
"""Change of the velocity that is a burn, above what the field of the Moon (mascons: 3e-3 m/s2) does in a step."""


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
    EphemerisError
        Where a state alone is off the motion of its neighbours.
    """
    for arc in ephemeris.arcs():
        _check_single(arc)
        measured = _deviations(arc)
        if not len(measured):
            _check_place(arc)
            continue
        weighted, off, expected, found, radius = np.median(measured, axis=0).tolist()
        # An orbit that was computed without the Earth is accepted too.
        tide = 3.0 * GM_EARTH_M3_S2 / GM_MOON_M3_S2 * (radius / _NEAREST_EARTH_M) ** 3
        if weighted > GRAVITY_TOLERANCE + min(tide, _MOST_TIDE):
            raise UnmovedByGravity(arc.object_name, radius, expected, found, off)


def _check_place(arc: EphemerisSegment) -> None:
    """Refuse states, too few for their motion to be judged, that are none of an orbit about the Moon."""
    radius_m, speed_m_s = (np.linalg.norm(values, axis=1) for values in (arc.position_m, arc.velocity_m_s))
    wrong = np.flatnonzero(~(ORBIT_RADIUS_M.holds(radius_m) & ORBIT_SPEED_M_S.holds(speed_m_s)))
    if wrong.size:
        k = int(wrong[0])
        raise EphemerisError(
            f"ephemeris state {k + 1} of {arc.object_name}, {format_tai(int(arc.tai_ns[k]))}: expected "
            f"{ORBIT_RADIUS_M} from the centre of the Moon at {ORBIT_SPEED_M_S}, found {radius_m[k]:.6g} m at "
            f"{speed_m_s[k]:.6g} m/s: another unit or centre?"
        )


def cut_at_burns(ephemeris: Ephemeris) -> Ephemeris:
    """Return an ephemeris cut between each two states that a burn parts: nothing is interpolated across it.

    From state to state the velocity changes as the attraction at both and its rates say, but for what other forces do,
    which act on the steps before and after too.
    """
    parts: list[EphemerisSegment] = []
    for one in ephemeris.segments:
        cuts = [0, *(np.flatnonzero(_burns(one)) + 1).tolist(), len(one.utc_ns)]
        parts += [one] if len(cuts) == 2 else one.parts(cuts)
    return replace(ephemeris, segments=tuple(parts))


def _burns(one: EphemerisSegment) -> BoolArray:
    """Return in which steps (n - 1,) of a segment the velocity changes as in none of the two before and after."""
    step = (np.diff(one.tai_ns) / NS)[:, None]
    if len(step) < _FEWEST:
        return np.zeros(len(step), dtype=np.bool_)
    position, velocity = one.position_m, one.velocity_m_s
    radius = np.linalg.norm(position, axis=1, keepdims=True)
    pull = -GM_MOON_M3_S2 * position / radius**3
    along = np.sum(position * velocity, axis=1, keepdims=True) / radius**2
    rate = -GM_MOON_M3_S2 * velocity / radius**3 - 3.0 * along * pull
    gained = 0.5 * step * (pull[:-1] + pull[1:]) - step**2 / 12.0 * np.diff(rate, axis=0)
    left = np.linalg.norm(np.diff(velocity, axis=0) - gained, axis=1)
    around = np.pad(left, 2, mode="reflect")
    near = np.max([around[k : k + len(left)] for k in (0, 1, 3, 4)], axis=0)
    turned = step[:, 0] * np.sqrt(GM_MOON_M3_S2 / radius[:-1, 0] ** 3)
    return np.asarray((left > 5.0 * near + _BURN_LEAST_M_S + _UNMODELLED_M_S2 * step[:, 0]) & (turned < _ARC_RAD))


def check_pointing(ephemeris: Ephemeris, utc_ns: IntArray, q_wxyz: FloatArray) -> None:
    """Refuse attitudes (n, 4), ICRF to camera at epochs (n,), whose boresights mostly miss the Moon.

    Raises
    ------
    EphemerisError
        Where a quaternion of another direction or order, or of other axes, is likely.
    """
    known = ephemeris.covers(utc_ns)
    if not known.any():
        spans = (
            f"{format_utc(int(a))}..{format_utc(int(b))}"
            for a, b in ((ephemeris.start_utc_ns, ephemeris.stop_utc_ns), (utc_ns[0], utc_ns[-1]))
        )
        raise EphemerisError("attitudes: expected times within {}, found {}".format(*spans))
    position = ephemeris.at(utc_ns[known])[0]
    radius = np.linalg.norm(position, axis=1)
    boresight = matrix_from_quaternion(q_wxyz[known])[:, 2]
    angle = np.arccos(np.clip(-np.einsum("ni,ni->n", boresight, position) / radius, -1.0, 1.0))
    seen, middle = float(np.mean(angle <= math.radians(OFF_NADIR_DEG))), math.degrees(float(np.median(angle)))
    if seen < VIEWS_OF_MOON:
        raise EphemerisError(
            f"attitudes: expected the camera within {OFF_NADIR_DEG:g} deg of nadir in {VIEWS_OF_MOON:.0%} of them or "
            f"more, found {seen:.0%}, {middle:.0f} deg in the median: quaternions in another order or direction, other "
            "axes, or other times?"
        )


def _check_single(arc: EphemerisSegment) -> None:
    """Refuse a state between two that agree without it; a burn parts the states before it from those after it."""
    rows = np.arange(len(arc.utc_ns))
    if len(rows) < _FEWEST:
        return
    off, fall, span = _apart(arc, rows)
    limit = max(_SINGLE, 20.0 * float(np.median(off / fall)))
    for k in np.flatnonzero(off > limit * fall + _SINGLE_M)[:_PAIRS].tolist():
        near = rows[max(k - 3, 0) : k + 6]
        for one in (k, k + 1, k + 2):
            others, least, _ = _apart(arc, near[near != one])
            # At the ends a burn looks alike, so only what no burn does is refused there.
            is_inner = 0 < one < len(rows) - 1 or off[k] > _BURN_M_S * span[k]
            if is_inner and np.all(others <= limit * least + _SINGLE_M):
                raise EphemerisError(
                    f"ephemeris state {one + 1} of {arc.object_name}, {format_tai(int(arc.tai_ns[one]))}: expected a "
                    f"state between its neighbours, found {np.round(arc.position_m[one] / 1e3, 3).tolist()} km and "
                    f"{np.round(arc.velocity_m_s[one] / 1e3, 6).tolist()} km/s"
                )


def _apart(arc: EphemerisSegment, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how far inner states (n - 2) lie off the curve of degree 5 through their neighbours, fall, and span in s.

    The fall is that of a body between the two, in m.
    """
    first, middle, last = rows[:-2], rows[1:-1], rows[2:]
    position, velocity = arc.position_m, arc.velocity_m_s
    pull = -GM_MOON_M3_S2 * position / np.linalg.norm(position, axis=1, keepdims=True) ** 3
    span = ((arc.tai_ns[last] - arc.tai_ns[first]) / NS)[:, None]
    share = ((arc.tai_ns[middle] - arc.tai_ns[first]) / NS)[:, None] / span
    between: FloatArray = np.zeros_like(position[middle])
    for side, t, sign in ((first, share, 1.0), (last, 1.0 - share, -1.0)):
        between += position[side] * (1.0 - t**3 * (10.0 - 15.0 * t + 6.0 * t**2))
        between += velocity[side] * (sign * span * (t - t**3 * (6.0 - 8.0 * t + 3.0 * t**2)))
        between += pull[side] * (0.5 * span**2 * t**2 * (1.0 - t) ** 3)
    off = np.linalg.norm(position[middle] - between, axis=1)
    fall = np.median(np.linalg.norm(pull, axis=1)) * span[:, 0] ** 2 / 8.0
    return off, fall, span[:, 0]


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
    fallen = _moved(start, speed, span, earth_position_icrf_m(tdb_s_from_tai_ns(middle))) - start - span * speed
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
