"""The true flight: trajectory of the spacecraft, its disturbances, when it observes, how it points.

Everything here is truth: it reaches flight software as images, attitude readings and clock ticks only.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.constants import MOON_RADIUS_M, NS
from lunar.frames import (
    Orientation,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rtn_from_inertial,
    spherical_from_mcmf,
)
from lunar.propagation import ForceModel, propagate
from lunar.timescales import format_utc, tdb_s_from_utc_ns
from payload_emulator.errors import ScenarioError

_SEARCH_STEP_NS = 20_000_000_000
_POLAR_NORTH_LIMIT_RAD = np.radians(89.9)


@dataclass(slots=True)
class ReadCount:
    """Number of reads of the truth inside `counted_reads`."""

    count: int = 0


_COUNTED: ContextVar[ReadCount | None] = ContextVar("counted_reads_of_truth", default=None)


@contextmanager
def counted_reads(counter: ReadCount) -> Iterator[None]:
    """Count every read of any truth by this thread; reads by other threads are not counted."""
    token = _COUNTED.set(counter)
    try:
        yield
    finally:
        _COUNTED.reset(token)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """A flown trajectory and the rotation of the Moon it was flown with.

    Attributes
    ----------
    state_icrf
        Function from TDB seconds past J2000, shape (n,), to position (m) and velocity (m/s), shape (n, 6), ICRF axes.
    start_utc_ns, stop_utc_ns
        Span that `state_icrf` covers.
    orientation
        Rotation of the Moon in the simulated world.
    breaks_utc_ns
        Instants at which the state jumps.
    """

    state_icrf: Callable[[FloatArray], FloatArray]
    start_utc_ns: int
    stop_utc_ns: int
    orientation: Orientation
    breaks_utc_ns: tuple[int, ...] = ()

    def states(self, utc_ns: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Position (n, 3) in metres and velocity (n, 3) in m/s, Moon-centred ICRF axes, at UTC instants (n,)."""
        counter = _COUNTED.get()
        if counter is not None:
            counter.count += 1
        state = self.state_icrf(np.asarray(tdb_s_from_utc_ns(np.atleast_1d(utc_ns)), dtype=np.float64))
        return state[:, :3], state[:, 3:]

    def positions_mcmf(self, utc_ns: ArrayLike) -> FloatArray:
        """Position in MCMF, metres, shape (n, 3), at UTC instants (n,)."""
        times = np.atleast_1d(utc_ns)
        position, _ = self.states(times)
        rotation = self.orientation.mcmf_from_icrf(np.asarray(tdb_s_from_utc_ns(times), dtype=np.float64))
        return np.asarray(np.einsum("nij,nj->ni", rotation, position), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Spliced:
    """A trajectory of several arcs: up to each joint (TDB s, ascending) one function, after the last another."""

    joints_tdb_s: tuple[float, ...]
    arcs: tuple[Callable[[FloatArray], FloatArray], ...]

    def __call__(self, tdb_s: FloatArray) -> FloatArray:
        """Return states (n, 6) at times (n,)."""
        number = np.searchsorted(np.array(self.joints_tdb_s), tdb_s, side="left")
        states = np.empty((tdb_s.size, 6))
        for k in np.unique(number):
            states[number == k] = self.arcs[k](tdb_s[number == k])
        return states


def spliced(
    before: Callable[[FloatArray], FloatArray], joint_tdb_s: float, after: Callable[[FloatArray], FloatArray]
) -> Spliced:
    """Return a trajectory that follows one function up to a joint and another one after it."""
    if isinstance(before, Spliced):
        return Spliced((*before.joints_tdb_s, joint_tdb_s), (*before.arcs, after))
    return Spliced((joint_tdb_s,), (before, after))


def frame_times(
    truth: Truth, start_utc_ns: int, stop_utc_ns: int, interval_ns: int, latitude_band_rad: tuple[float, float]
) -> IntArray:
    """UTC instants of the frames between two instants: one each interval, where the sub-satellite latitude allows."""
    times = np.arange(start_utc_ns, stop_utc_ns, interval_ns, dtype=np.int64)
    if times.size == 0:
        return times
    latitude, _, _ = spherical_from_mcmf(truth.positions_mcmf(times))
    return times[(latitude >= latitude_band_rad[0]) & (latitude <= latitude_band_rad[1])]


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """One crossing of a latitude band.

    Attributes
    ----------
    start_utc_ns, stop_utc_ns
        Span of the crossing with a search step before and after it.
    longitude_rad
        Longitude in the middle of the crossing.
    in_reach
        Whether the whole swath lies between the wanted longitudes.
    missing_rad
        Ranges of latitude, south to north, (n, 2), at which part of the swath has no terrain.
    """

    start_utc_ns: int
    stop_utc_ns: int
    longitude_rad: float
    in_reach: bool
    missing_rad: FloatArray

    @property
    def observable(self) -> bool:
        """Return whether the whole swath lies on terrain and between the wanted longitudes."""
        return self.in_reach and not self.missing_rad.size


def find_crossings(
    truth: Truth,
    covers: Callable[[FloatArray, FloatArray], BoolArray],
    in_reach: Callable[[FloatArray], BoolArray],
    *,
    not_before_utc_ns: int,
    latitude_band_rad: tuple[float, float],
    direction: str,
    half_fov_rad: float,
) -> list[Crossing]:
    """Crossings of a latitude band northwards ("ascending"), southwards ("descending") or either ("any"), in order.

    The swath is the footprint's half-width either side of the track, as wide in longitude as the latitude makes it.
    `covers` tells of latitudes and longitudes (n,) whether there is terrain, `in_reach` of longitudes (n,) whether they
    are wanted. Crossings cut by the ends of the trajectory are left out.
    """
    times = np.arange(not_before_utc_ns, truth.stop_utc_ns, _SEARCH_STEP_NS, dtype=np.int64)
    latitude, longitude, altitude = spherical_from_mcmf(truth.positions_mcmf(times))
    inside = (latitude >= latitude_band_rad[0]) & (latitude <= latitude_band_rad[1])
    northward = np.gradient(latitude) > 0.0
    wanted = inside & {"ascending": northward, "descending": ~northward, "any": inside}[direction]
    half_width_rad = altitude * np.tan(half_fov_rad) / MOON_RADIUS_M
    margin_rad = half_width_rad / np.cos(np.minimum(np.abs(latitude), _POLAR_NORTH_LIMIT_RAD))
    place = np.flatnonzero(wanted)
    swath = longitude[place] + np.array([[0.0], [-1.0], [1.0]]) * margin_rad[place]
    there, reached = np.zeros(times.size, dtype=bool), np.zeros(times.size, dtype=bool)
    there[place] = covers(np.broadcast_to(latitude[place], swath.shape), swath).all(axis=0)
    reached[place] = in_reach(swath).all(axis=0)
    crossings = []
    for first, last in _runs(wanted):
        if first == 0 or last == times.size - 1:
            continue
        here = slice(first, last + 1)
        gaps = [latitude[first + a : first + b + 1] for a, b in _runs(~there[here])]
        missing = np.array(sorted((float(gap.min()), float(gap.max())) for gap in gaps)).reshape(-1, 2)
        crossings.append(
            Crossing(
                int(times[first]) - _SEARCH_STEP_NS,
                int(times[last]) + _SEARCH_STEP_NS,
                float(longitude[(first + last) // 2]),
                bool(reached[here].all()),
                missing,
            )
        )
    return crossings


def perturbed(camera_from_source: FloatArray, error_rad: FloatArray) -> FloatArray:
    """The attitude turned by a small rotation vector `error_rad` (3,) given in camera axes."""
    angle = float(np.linalg.norm(error_rad))
    if angle == 0.0:
        return camera_from_source
    axis = error_rad / angle
    quaternion = np.concatenate([[np.cos(angle / 2.0)], np.sin(angle / 2.0) * axis])
    return np.asarray(matrix_from_quaternion(quaternion) @ camera_from_source, dtype=np.float64)


def attitude_message(camera_from_icrf: FloatArray, sun_direction_camera: FloatArray) -> FloatArray:
    """Return the message of the ADCS: q_wxyz of camera_from_icrf, then the unit Sun vector in the camera, (7,)."""
    return np.concatenate([quaternion_from_matrix(camera_from_icrf), sun_direction_camera])


def require_above_ground(
    truth: Truth,
    utc_ns: IntArray,
    height_m: Callable[[FloatArray, FloatArray], FloatArray],
    highest_m: float = math.inf,
) -> None:
    """Refuse a trajectory that dips below the terrain at any of the instants.

    The terrain is looked up only below `highest_m`, above which none of it reaches: to look is to make it.

    Raises
    ------
    ScenarioError
        With the epoch, the place and the depth.
    """
    latitude, longitude, altitude = spherical_from_mcmf(truth.positions_mcmf(utc_ns))
    low = np.flatnonzero(altitude < highest_m)
    if not low.size:
        return
    utc_ns, latitude, longitude = utc_ns[low], latitude[low], longitude[low]
    clearance = altitude[low] - height_m(latitude, longitude)
    lowest = int(np.argmin(clearance))
    if clearance[lowest] <= 0.0:
        raise ScenarioError(
            f"trajectory: expected to stay above the terrain, found it {-clearance[lowest]:.0f} m below at "
            f"{format_utc(int(utc_ns[lowest]))}, latitude {np.degrees(latitude[lowest]):.2f}, longitude "
            f"{np.degrees(longitude[lowest]) % 360.0:.2f} deg"
        )


def _runs(mask: BoolArray) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(first), int(stop) - 1) for first, stop in zip(edges[::2], edges[1::2], strict=True)]


# The flown orbit is known this long beyond what anyone asks for.
_MARGIN_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class TrueBurn:
    """An impulsive burn as planned and as carried out, ICRF axes."""

    utc_ns: int
    planned_m_s: FloatArray
    done_m_s: FloatArray
    sigma_m_s: float
    declared: bool = True


def executed(utc_ns: int, done_m_s: FloatArray, error_fraction: float, seed: tuple[int, int]) -> TrueBurn:
    """A burn of the flown orbit with the plan that it came from: the two differ by a share of its size per axis."""
    sigma = error_fraction * float(np.linalg.norm(done_m_s))
    error = sigma * np.random.default_rng((*seed, utc_ns % 2**32)).standard_normal(3)
    return TrueBurn(utc_ns, done_m_s - error, np.asarray(done_m_s, dtype=np.float64), sigma)


def turned_state(state: FloatArray, distance_m: float, heading_rad: float) -> FloatArray:
    """The state (6,) turned about the Moon's centre by an arc of a length, towards a heading from along track."""
    _, along, normal = rtn_from_inertial(state[:3], state[3:])
    axis = np.cos(heading_rad) * normal + np.sin(heading_rad) * along
    half = 0.5 * distance_m / float(np.linalg.norm(state[:3]))
    turn = matrix_from_quaternion(np.concatenate([[np.cos(half)], np.sin(half) * axis]))
    return np.concatenate([turn @ state[:3], turn @ state[3:]])


def changed(truth: Truth, utc_ns: int, change: Callable[[FloatArray], FloatArray], model: ForceModel) -> Truth:
    """The flight whose state (6,), ICRF, is changed at an instant and flown on from there without further burns."""
    at_s = float(tdb_s_from_utc_ns(utc_ns))
    state = change(truth.state_icrf(np.array([at_s]))[0])
    left_s = (truth.stop_utc_ns - utc_ns) / NS + _MARGIN_S
    after = propagate(at_s, state[:3], state[3:], left_s, model).state
    before = truth.state_icrf

    def joined(tdb_s: FloatArray) -> FloatArray:
        later = tdb_s >= at_s
        states = np.empty((tdb_s.size, 6))
        if np.any(later):
            states[later] = after(tdb_s[later])
        if not np.all(later):
            states[~later] = before(tdb_s[~later])
        return states

    return replace(truth, state_icrf=joined, breaks_utc_ns=(*truth.breaks_utc_ns, utc_ns))
