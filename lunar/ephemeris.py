"""Ephemerides as segments of states, and their interpolation.

States are Moon-centred in ICRF axes, m and m/s, at ``utc_ns`` epochs.  A segment is a span over which the
motion is smooth: nothing is interpolated across its ends, outside its useable interval, or in a gap of its
own.  Where two segments meet, the later one holds from its start on, so the state at a manoeuvre is the one
after it.

Interpolation runs on TAI, so a leap second inside a segment does no harm.  States within a leap second have the
``utc_ns`` of one second later; `EphemerisSegment.tai_ns` and `Ephemeris.at_tai` tell the two apart.

References
----------
CCSDS 502.0-B-3, Orbit Data Messages, section 5 and annex on interpolation: Hermite interpolation of degree 2
k - 1 uses k states.  Newton's form with repeated nodes: Burden and Faires, Numerical Analysis, section 3.4.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.constants import NS
from lunar.errors import DataFileError, EphemerisCoverageError, EphemerisError
from lunar.frames import ICRF
from lunar.timescales import format_tai, tai_ns_from_utc_ns, utc_ns_from_tai_ns

GAP_FACTOR = 10
"""A step longer than this many median steps of its segment is a gap, in which nothing is interpolated."""

INTERPOLATIONS = ("HERMITE", "LAGRANGE", "LINEAR")

_BLOCK = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Covariance:
    """Covariance of a state: (6, 6) in m2, m2/s, m2/s2, rows and columns x y z vx vy vz of ``frame``."""

    utc_ns: int
    frame: str
    matrix: FloatArray


@dataclass(frozen=True, eq=False)
class EphemerisSegment:
    """States of one smooth arc; epochs strictly increase.

    ``time_system`` is the one of the file it came from or goes to; ``utc_ns`` is UTC always.  ``tai_ns`` follows from
    it unless states are within a leap second.  Not slotted: tables for interpolation are kept after first use.

    Raises
    ------
    EphemerisError
        Where the frame is not ICRF, shapes do not agree, numbers are not finite, or epochs do not increase.
    """

    utc_ns: IntArray
    position_m: FloatArray
    velocity_m_s: FloatArray
    centre: str = "MOON"
    frame: str = ICRF
    object_name: str = "SELENITA"
    object_id: str = "SELENITA"
    time_system: str = "UTC"
    interpolation: str = "HERMITE"
    degree: int = 7
    useable_start_utc_ns: int | None = None
    useable_stop_utc_ns: int | None = None
    comments: tuple[str, ...] = ()
    covariances: tuple[Covariance, ...] = ()
    tai_ns: IntArray = field(default=None, repr=False)  # type: ignore[arg-type] # computed if it is not given

    def __post_init__(self) -> None:
        n = len(self.utc_ns)
        if self.tai_ns is None:
            object.__setattr__(self, "tai_ns", tai_ns_from_utc_ns(self.utc_ns))
        elif not np.array_equal(utc_ns_from_tai_ns(self.tai_ns), self.utc_ns):
            raise EphemerisError("an ephemeris segment: expected TAI epochs of its UTC epochs, found others")
        if self.frame != ICRF:
            raise EphemerisError(f"an ephemeris segment: expected states turned into ICRF, found {self.frame}")
        if n == 0:
            raise EphemerisError("an ephemeris segment: expected at least one state, found none")
        for name, values in (("positions", self.position_m), ("velocities", self.velocity_m_s)):
            if values.shape != (n, 3):
                raise EphemerisError(f"an ephemeris segment: expected {name} ({n}, 3), found {values.shape}")
            bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
            if bad.size:
                raise EphemerisError(f"ephemeris state {bad[0]}: expected finite {name}, found NaN or infinity")
        late = np.flatnonzero(np.diff(self.tai_ns) <= 0)
        if late.size:
            before, after = (format_tai(int(self.tai_ns[late[0] + k])) for k in (0, 1))
            raise EphemerisError(f"ephemeris state {late[0] + 1}: expected an epoch after {before}, found {after}")
        if self.interpolation not in INTERPOLATIONS or self.degree < 1:
            raise EphemerisError(
                f"an ephemeris segment: expected an interpolation of {', '.join(INTERPOLATIONS)} of "
                f"degree 1 or more, found {self.interpolation!r} of degree {self.degree}"
            )
        start, stop = self.span_tai_ns
        if start > stop:
            span = f"{format_tai(start)}..{format_tai(stop)}"
            raise EphemerisError(f"an ephemeris segment: expected a useable interval, found {span}")

    @property
    def start_utc_ns(self) -> int:
        """Return the first epoch at which a state may be asked for."""
        return utc_ns_from_tai_ns(self.span_tai_ns[0])

    @property
    def stop_utc_ns(self) -> int:
        """Return the last epoch at which a state may be asked for."""
        return utc_ns_from_tai_ns(self.span_tai_ns[1])

    @cached_property
    def span_tai_ns(self) -> tuple[int, int]:
        """Return the first and the last instant at which a state may be asked for."""
        first, last = int(self.tai_ns[0]), int(self.tai_ns[-1])
        if self.useable_start_utc_ns is not None:
            first = max(first, tai_ns_from_utc_ns(self.useable_start_utc_ns))
        if self.useable_stop_utc_ns is not None:
            last = min(last, tai_ns_from_utc_ns(self.useable_stop_utc_ns))
        return first, last

    def parts(self, cuts: Sequence[int]) -> "list[EphemerisSegment]":
        """Return the segments from each state in ``cuts`` to before the next, those that have a useable epoch."""
        (low, high), found = self.span_tai_ns, []
        for first, last in pairwise(cuts):
            if self.tai_ns[first] <= high and self.tai_ns[last - 1] >= low:
                start, stop = int(self.utc_ns[first]), int(self.utc_ns[last - 1])
                own = tuple(one for one in self.covariances if start <= one.utc_ns <= stop)
                found.append(_part(self, first, last, covariances=own))
        return found

    @cached_property
    def _uniform_step_ns(self) -> int:
        """Return the step where all are equal, else 0."""
        steps = np.diff(self.tai_ns)
        return int(steps[0]) if len(steps) and np.all(steps == steps[0]) else 0

    @cached_property
    def _gaps(self) -> BoolArray:
        """Return which steps (n - 1,) are gaps."""
        steps = np.diff(self.tai_ns)
        return steps > GAP_FACTOR * np.median(steps) if len(steps) > 2 else np.zeros(len(steps), dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class Ephemeris:
    """Segments in order of time, with the comments and the originator of the file as a whole.

    Raises
    ------
    EphemerisError
        Where there is no segment, the useable intervals of two overlap, or they are those of two objects.
    """

    segments: tuple[EphemerisSegment, ...]
    originator: str = "LINNA"
    comments: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.segments:
            raise EphemerisError("an ephemeris: expected at least one segment, found none")
        names = dict.fromkeys(one.object_name.casefold() for one in self.segments)
        if len(names) > 1:
            found = ", ".join(dict.fromkeys(one.object_name for one in self.segments))
            raise EphemerisError(f"an ephemeris: expected segments of one object, found {found}")
        for earlier, later in pairwise(self.segments):
            start, stop = later.span_tai_ns[0], earlier.span_tai_ns[1]
            if start < stop:
                raise EphemerisError(
                    f"an ephemeris: expected the next segment at or after {format_tai(stop)}, "
                    f"found it at {format_tai(start)}"
                )

    @property
    def words(self) -> str:
        """Return the object and the time scales of the file, as printed with figures of it."""
        systems = dict.fromkeys(one.time_system for one in self.segments)
        return f"{self.segments[0].object_name}, epochs in {' and '.join(systems)}"

    @property
    def start_utc_ns(self) -> int:
        return self.segments[0].start_utc_ns

    @property
    def stop_utc_ns(self) -> int:
        return self.segments[-1].stop_utc_ns

    @cached_property
    def utc_ns(self) -> IntArray:
        """Return the epochs of all states inside useable intervals; a shared epoch appears once."""
        kept = [s.utc_ns[(s.utc_ns >= s.start_utc_ns) & (s.utc_ns <= s.stop_utc_ns)] for s in self.segments]
        return np.unique(np.concatenate(kept))

    def arcs(self) -> tuple[EphemerisSegment, ...]:
        """Return the segments cut at their gaps, for formats whose readers would interpolate across these."""
        found = []
        for one in self.segments:
            cuts = [0, *(np.flatnonzero(one._gaps) + 1).tolist(), len(one.utc_ns)]
            found += [one] if len(cuts) == 2 else one.parts(cuts)
        return tuple(found)

    def covers(self, utc_ns: ArrayLike) -> BoolArray:
        """Return whether a state is known at epochs ``(...)``."""
        epochs = np.asarray(tai_ns_from_utc_ns(np.asarray(utc_ns, dtype=np.int64)))
        flat = epochs.reshape(-1)
        owner = self._owners(flat)
        good = owner >= 0
        for k in np.unique(owner[good]):
            mine = np.flatnonzero(owner == k)
            good[mine] = ~_in_gap(self.segments[k], flat[mine])
        return good.reshape(epochs.shape)

    def at(self, utc_ns: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return positions in m and velocities in m/s, each ``(..., 3)``, at epochs ``(...)``.

        Raises
        ------
        EphemerisCoverageError
            Where an epoch is outside every useable interval or inside a gap.
        """
        return self.at_tai(tai_ns_from_utc_ns(np.asarray(utc_ns, dtype=np.int64)))

    def at_tai(self, tai_ns: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return positions and velocities as `at` does, also within a leap second."""
        epochs = np.asarray(tai_ns, dtype=np.int64)
        flat = epochs.reshape(-1)
        owner = self._owners(flat)
        if np.any(owner < 0):
            self._refuse(int(flat[np.flatnonzero(owner < 0)[0]]))
        position = np.empty((len(flat), 3))
        velocity = np.empty((len(flat), 3))
        if len(self.segments) == 1:
            _interpolate(self.segments[0], flat, position, velocity)
        else:
            for k in np.unique(owner):
                mine = np.flatnonzero(owner == k)
                part_position, part_velocity = np.empty((len(mine), 3)), np.empty((len(mine), 3))
                _interpolate(self.segments[k], flat[mine], part_position, part_velocity)
                position[mine], velocity[mine] = part_position, part_velocity
        shape = (*epochs.shape, 3)
        return position.reshape(shape), velocity.reshape(shape)

    def _owners(self, flat: IntArray) -> IntArray:
        """Return for each epoch the index of the segment that holds it, -1 for none."""
        if len(self.segments) == 1:
            start, stop = self.segments[0].span_tai_ns
            return np.where((flat >= start) & (flat <= stop), 0, -1)
        starts, stops = np.array([s.span_tai_ns for s in self.segments], dtype=np.int64).T
        owner = np.searchsorted(starts, flat, side="right") - 1
        return np.where((owner >= 0) & (flat <= stops[np.maximum(owner, 0)]), owner, -1)

    def _refuse(self, tai_ns: int) -> None:
        spans: list[tuple[int, int]] = []
        for segment in self.segments:
            start, stop = segment.span_tai_ns
            joined = bool(spans) and spans[-1][1] == start
            spans.append((spans.pop()[0] if joined else start, stop))
        texts = [f"{format_tai(start)}..{format_tai(stop)}" for start, stop in spans[:3]]
        more = f" or {len(spans) - 3} later spans" if len(spans) > 3 else ""
        raise EphemerisCoverageError(format_tai(tai_ns), ", ".join(texts) + more)


def ephemeris_from_states(
    utc_ns: ArrayLike,
    position_icrf_m: ArrayLike,
    velocity_icrf_m_s: ArrayLike,
    object_name: str = "SELENITA",
    **fields: Any,
) -> Ephemeris:
    """Return an ephemeris of one segment from states (n,), (n, 3), (n, 3); ``fields`` as of the segment."""
    segment = EphemerisSegment(
        np.atleast_1d(np.asarray(utc_ns, dtype=np.int64)),
        np.atleast_2d(np.asarray(position_icrf_m, dtype=np.float64)),
        np.atleast_2d(np.asarray(velocity_icrf_m_s, dtype=np.float64)),
        object_name=object_name,
        **{"object_id": object_name, **fields},
    )
    return Ephemeris((segment,))


def resampled(ephemeris: Ephemeris, step_s: float | None = None) -> Ephemeris:
    """Return the states of each arc from its first to its last useable epoch, for formats without such intervals.

    Both ends of each arc are among the states, so an epoch that two arcs share occurs in both.

    Parameters
    ----------
    step_s
        Seconds between states; None takes the given states.
    """
    parts = []
    for one in ephemeris.arcs():
        start, stop = one.span_tai_ns
        if step_s is None:
            inner = one.tai_ns[(one.tai_ns > start) & (one.tai_ns < stop)]
        else:
            inner = np.arange(start, stop, max(round(step_s * NS), 1), dtype=np.int64)[1:]
        tai_ns = np.unique(np.array([start, *inner.tolist(), stop], dtype=np.int64))
        position_m, velocity_m_s = Ephemeris((one,)).at_tai(tai_ns)
        parts.append(
            replace(
                one,
                utc_ns=utc_ns_from_tai_ns(tai_ns),
                tai_ns=tai_ns,
                position_m=position_m,
                velocity_m_s=velocity_m_s,
                useable_start_utc_ns=None,
                useable_stop_utc_ns=None,
            )
        )
    return replace(ephemeris, segments=tuple(parts))


def _part(one: EphemerisSegment, first: int, last: int, **changes: Any) -> EphemerisSegment:
    """Return a segment of the states from ``first`` to before ``last``."""
    states = slice(first, last)
    return replace(
        one,
        utc_ns=one.utc_ns[states],
        tai_ns=one.tai_ns[states],
        position_m=one.position_m[states],
        velocity_m_s=one.velocity_m_s[states],
        **changes,
    )


def clipped(ephemeris: Ephemeris, start_utc_ns: int, stop_utc_ns: int) -> Ephemeris:
    """Return the part of an ephemeris that is useable in an interval, with the states that its interpolation needs.

    Raises
    ------
    EphemerisCoverageError
        Where no segment is useable in the interval.
    """
    parts = []
    for one in ephemeris.segments:
        start, stop = max(one.start_utc_ns, start_utc_ns), min(one.stop_utc_ns, stop_utc_ns)
        if start > stop:
            continue
        margin = one.degree + 1
        first = max(int(np.searchsorted(one.utc_ns, start, side="right")) - 1 - margin, 0)
        last = min(int(np.searchsorted(one.utc_ns, stop, side="left")) + 1 + margin, len(one.utc_ns))
        inner = (start, stop) != (int(one.utc_ns[first]), int(one.utc_ns[last - 1]))
        parts.append(
            _part(
                one,
                first,
                last,
                useable_start_utc_ns=start if inner else None,
                useable_stop_utc_ns=stop if inner else None,
                covariances=tuple(c for c in one.covariances if start <= c.utc_ns <= stop),
            )
        )
    if not parts:
        ephemeris._refuse(tai_ns_from_utc_ns(start_utc_ns))
    return Ephemeris(tuple(parts), ephemeris.originator, ephemeris.comments)


def read_text(path: Path | str, expected: str) -> str:
    """Return the text of a file; `DataFileError` where it cannot be read or is no text."""
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise DataFileError(path, "", expected, error.strerror or str(error)) from None
    except UnicodeDecodeError as error:
        raise DataFileError(path, f"octet {error.start}", expected, "octets that are no text") from None


def parse_numbers(rows: Sequence[str], width: int) -> FloatArray | None:
    """Return the numbers (n, width) in rows of text with ``width`` numbers each; None where any row is otherwise."""
    if not rows:
        return np.empty((0, width))
    try:
        values = np.loadtxt(rows, dtype=np.float64, comments=None, ndmin=2)
    except ValueError:
        return None
    return values if values.shape == (len(rows), width) else None


def _steps_of(segment: EphemerisSegment, epochs_tai_ns: IntArray) -> IntArray:
    """Return for each epoch the index of the state at or before it, at most n - 2 (0 for a lone state)."""
    nodes = segment.tai_ns
    if segment._uniform_step_ns:
        index: IntArray = (epochs_tai_ns - nodes[0]) // segment._uniform_step_ns
    else:
        index = np.searchsorted(nodes, epochs_tai_ns, side="right").astype(np.int64) - 1
    return np.asarray(np.clip(index, 0, max(len(nodes) - 2, 0)))


def _in_gap(segment: EphemerisSegment, flat: IntArray) -> BoolArray:
    """Return which TAI epochs (m,) are inside a gap."""
    if not np.any(segment._gaps):
        return np.zeros(len(flat), dtype=np.bool_)
    step = _steps_of(segment, flat)
    at_node = (flat == segment.tai_ns[step]) | (flat == segment.tai_ns[step + 1])
    return np.asarray(segment._gaps[step] & ~at_node)


def _interpolate(segment: EphemerisSegment, flat: IntArray, position: FloatArray, velocity: FloatArray) -> None:
    """Fill positions and velocities (m, 3) at TAI epochs (m,) inside the segment."""
    gap = _in_gap(segment, flat)
    if np.any(gap):
        asked = int(flat[np.flatnonzero(gap)[0]])
        k = int(_steps_of(segment, np.array([asked], dtype=np.int64))[0])
        before, after = (format_tai(int(epoch)) for epoch in segment.tai_ns[k : k + 2])
        raise EphemerisCoverageError(format_tai(asked), f"the states of a segment with a gap {before}..{after}")
    nodes = segment.tai_ns
    n = len(nodes)
    if n == 1:
        position[:], velocity[:] = segment.position_m[0], segment.velocity_m_s[0]
        return
    hermite = segment.interpolation == "HERMITE"
    degree = 1 if segment.interpolation == "LINEAR" else segment.degree
    width = min((degree + 1) // 2 if hermite else degree + 1, n)
    width = max(width, 2)
    step = _steps_of(segment, flat)
    # Tables of the steps that are needed only: all of them for dense requests, one for a single epoch.
    needed, row = np.unique(step, return_inverse=True) if len(flat) < n else (np.arange(n - 1), step)
    first = np.clip(needed - (width - 1) // 2, 0, n - width)
    window = first[:, None] + np.arange(width)
    # Times in units of the step, from its middle: the step itself is -1..1 and powers stay well scaled.
    origin_ns = nodes[needed]
    half_s = (nodes[needed + 1] - origin_ns) / (2 * NS)
    node = ((nodes[window] - origin_ns[:, None]) / NS / half_s[:, None] - 1.0).T
    states = np.concatenate([segment.position_m[window], segment.velocity_m_s[window]], axis=2).transpose(1, 2, 0)
    if hermite:
        table = _hermite_polynomials(node, states[:, :3], states[:, 3:] * half_s)
    else:
        table = _lagrange_polynomials(node, states)
    # One row per step, so that a request out of order touches one stretch of memory per epoch.
    terms, parts, _ = table.shape
    rows = np.ascontiguousarray(table.transpose(2, 0, 1)).reshape(-1, terms * parts)
    for start in range(0, len(flat), _BLOCK):
        part = slice(start, start + _BLOCK)
        which = row[part]
        x = (flat[part] - origin_ns[which]) / NS / half_s[which] - 1.0
        coefficients = np.ascontiguousarray(rows.take(which, axis=0).T).reshape(terms, parts, -1)
        value = coefficients[-1]
        if hermite:
            rate = np.zeros_like(value)
            for c in coefficients[-2::-1]:
                rate *= x
                rate += value
                value *= x
                value += c
            rate /= half_s[which]
            position[part], velocity[part] = value.T, rate.T
        else:
            for c in coefficients[-2::-1]:
                value *= x
                value += c
            position[part], velocity[part] = value[:3].T, value[3:].T


def _hermite_polynomials(node: FloatArray, value: FloatArray, rate: FloatArray) -> FloatArray:
    """Return power coefficients (2 k, c, m) from values and rates (k, c, m) at nodes (k, m)."""
    knots = np.repeat(node, 2, axis=0)
    column = np.repeat(value, 2, axis=0)
    differences = [column[0]]
    for order in range(1, len(knots)):
        span = knots[order:] - knots[:-order]
        column = np.diff(column, axis=0)
        if order == 1:
            # Between the two copies of a node the divided difference is the rate there.
            span[::2] = 1.0
            column[::2] = rate
        column /= span[:, None]
        differences.append(column[0])
    return _powers_from_newton(differences, knots)


def _lagrange_polynomials(node: FloatArray, value: FloatArray) -> FloatArray:
    """Return power coefficients (k, c, m) from values (k, c, m) at nodes (k, m)."""
    column = value
    differences = [column[0]]
    for order in range(1, len(node)):
        column = np.diff(column, axis=0) / (node[order:] - node[:-order])[:, None]
        differences.append(column[0])
    return _powers_from_newton(differences, node)


def _powers_from_newton(differences: list[FloatArray], knots: FloatArray) -> FloatArray:
    """Return power coefficients (k, c, m), constant first, from divided differences and knots (k, m)."""
    powers = np.zeros((len(differences), *differences[0].shape))
    powers[0] = differences[-1]
    for order in range(len(differences) - 2, -1, -1):
        shifted = powers[:-1].copy()
        powers *= -knots[order]
        powers[1:] += shifted
        powers[0] += differences[order]
    return powers
