"""Orbits about the Moon: force model, adaptive propagation with dense output, many states at once, transition matrix.

States are position and velocity (m, m/s) from the Moon's centre along ICRF axes; time is TDB seconds past J2000.
Forces: gravity field to any degree in principal axes, tides of Earth and Sun, optionally the pressure of sunlight with
the shadows of Moon and Earth.

The Runge-Kutta-Nystrom pair 8(6) of Dormand et al. takes the steps: it uses that no force here depends on velocity.
Every accepted step is kept, and between steps a quintic through position, velocity and acceleration at both ends is
read, within 1 mm and 1e-4 m/s.
On a low orbit at degree 100 the longest step of a method rules nearly always: the errors of equal steps cancel better
than those of steps that follow the terrain.

References
----------
Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I (1993), sections II.4 (step size) and II.10 (DOP853).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from lunar import constants
from lunar.arrays import FloatArray, IntArray
from lunar.errors import EphemerisCoverageError, ImpactError, OrbitError
from lunar.gravity import GravityField, packed, packed_gradient
from lunar.third_bodies import earth_position_icrf_m, sun_position_icrf_m

if TYPE_CHECKING:
    from lunar.frames import Orientation


RTOL, MAX_STEP_S = 1e-9, 30.0
"""Tolerance of a step and longest step that suit a low orbit."""

_ERROR_ORDER = 7
_TABLE_STEP_S = 43_200.0
_TABLE_TERMS = 8
_KNOTS = 16_384


@dataclass(frozen=True, slots=True)
class SolarPressure:
    """Radiation pressure on a sphere: cross-section over mass, and the reflection coefficient (1 black, 2 mirror)."""

    area_to_mass_m2_kg: float = 0.01
    reflection: float = 1.3


@dataclass(frozen=True, eq=False)
class ForceModel:
    """Forces on the orbiter.  ``degree`` None takes the whole field.

    Tables of the Moon's orientation and of Earth and Sun are kept inside as they are asked for, per half day.
    """

    gravity: GravityField
    orientation: Orientation
    degree: int | None = None
    earth: bool = True
    sun: bool = True
    solar_pressure: SolarPressure | None = None
    _segments: dict[int, FloatArray] = field(default_factory=dict, init=False, repr=False)
    _joined: dict[tuple[int, int], FloatArray] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.degree is not None and not 0 <= self.degree <= self.gravity.degree:
            raise OrbitError(
                f"gravity field {self.gravity.name}: expected a degree from 0 to {self.gravity.degree}, "
                f"found {self.degree}"
            )

    @property
    def name(self) -> str:
        degree = self.gravity.degree if self.degree is None else self.degree
        bodies = [name for name, on in (("Earth", self.earth), ("Sun", self.sun)) if on]
        pressure = ["solar pressure"] if self.solar_pressure else []
        return " + ".join([f"{self.gravity.name} {degree}x{degree}", *bodies, *pressure])

    @property
    def gm_m3_s2(self) -> float:
        return self.gravity.gm_m3_s2


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """An orbit known at all times from ``start_tdb_s`` to ``stop_tdb_s``.

    ``elapsed_s`` (n,) are the times of the steps after ``epoch_tdb_s``, ``states`` (n, 6) and ``accelerations``
    (n, 3) what was there, ICRF.  A burn appears as two steps at the same time; from that time on the later one holds.
    """

    epoch_tdb_s: float
    elapsed_s: FloatArray = field(repr=False)
    states: FloatArray = field(repr=False)
    accelerations: FloatArray = field(repr=False)
    evaluations: int = 0

    @property
    def start_tdb_s(self) -> float:
        return self.epoch_tdb_s + float(self.elapsed_s[0])

    @property
    def stop_tdb_s(self) -> float:
        return self.epoch_tdb_s + float(self.elapsed_s[-1])

    def state(self, tdb_s: ArrayLike) -> FloatArray:
        """Return position and velocity, shape ``(..., 6)``, at TDB seconds past J2000, shape ``(...)``.

        Raises
        ------
        EphemerisCoverageError
            Where an epoch is outside the propagated span (beyond the microsecond that a float64 of seconds can tell).
        """
        return self.state_after(np.asarray(tdb_s, dtype=np.float64) - self.epoch_tdb_s)

    def state_after(self, elapsed_s: ArrayLike) -> FloatArray:
        """Return position and velocity, shape ``(..., 6)``, at seconds after ``epoch_tdb_s``, shape ``(...)``."""
        from lunar import _dynamics_kernel as kernel

        wanted = np.asarray(elapsed_s, dtype=np.float64)
        flat = np.ascontiguousarray(wanted.reshape(-1))
        slack = 1e-6
        first, last = float(self.elapsed_s[0]), float(self.elapsed_s[-1])
        outside = ~((flat >= first - slack) & (flat <= last + slack))
        if np.any(outside):
            raise EphemerisCoverageError(
                f"{flat[outside][0]:.3f} s", f"{first:.3f}..{last:.3f} s after the start", "trajectory"
            )
        out = np.empty((len(flat), 6))
        kernel.evaluate(self.elapsed_s, self.states, self.accelerations, flat, out)
        return out.reshape(*wanted.shape, 6)

    def arcs(self) -> tuple[Trajectory, ...]:
        """Return the parts between burns, each smooth up to and including its ends."""
        burns = np.nonzero(np.diff(self.elapsed_s) == 0.0)[0] + 1
        edges = [0, *burns.tolist(), len(self.elapsed_s)]
        return tuple(
            Trajectory(self.epoch_tdb_s, self.elapsed_s[a:b], self.states[a:b], self.accelerations[a:b])
            for a, b in itertools.pairwise(edges)
            if b - a > 1
        )


def propagate(
    epoch_tdb_s: float,
    position_icrf_m: ArrayLike,
    velocity_icrf_m_s: ArrayLike,
    duration_s: float,
    model: ForceModel,
    rtol: float = RTOL,
    max_step_s: float = MAX_STEP_S,
    ground_radius_m: float = constants.MOON_RADIUS_M,
) -> Trajectory:
    """Return the orbit from a state at ``epoch_tdb_s`` over ``duration_s`` (negative: backwards).

    With the default ``rtol`` (per step, of position and velocity) and ``max_step_s`` a low orbit is within 0.5 m over
    30 days at degree 100.

    Raises
    ------
    ImpactError
        Where the orbit meets the sphere of ``ground_radius_m`` (0 lets it pass).
    OrbitError
        Where the start is below ground, not finite, or no step size meets the tolerance.
    """
    arc = integrate_arc(
        epoch_tdb_s,
        0.0,
        state_vector(position_icrf_m, velocity_icrf_m_s),
        float(duration_s),
        model,
        rtol,
        max_step_s,
        ground_radius_m,
    )
    return join(epoch_tdb_s, [arc])


def propagate_with_stm(
    epoch_tdb_s: float,
    position_icrf_m: ArrayLike,
    velocity_icrf_m_s: ArrayLike,
    duration_s: float,
    model: ForceModel,
    stm_degree: int = 8,
    step_s: float = 15.0,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return position (3,), velocity (3,) and transition matrix (6, 6) after ``duration_s`` (either sign).

    The state moves under the whole model, the matrix under its field to ``stm_degree`` with Earth and Sun.  Equal
    steps of the eighth-order method, none longer than ``step_s``: within 0.1 mm per orbit at 15 s and degree 100.
    """
    from lunar import _dynamics_kernel as kernel
    from lunar._tableaux import DOP853_A, DOP853_B, DOP853_C

    start = state_vector(position_icrf_m, velocity_icrf_m_s)
    if duration_s == 0.0:
        return start[:3], start[3:], np.eye(6)
    gravity, force, table, scratch = force_arrays(model, epoch_tdb_s, 0.0, duration_s)
    low = packed_gradient(model.gravity, min(stm_degree, _degree(model)))
    steps = max(1, int(np.ceil(abs(duration_s) / step_s - 1e-9)))
    y = kernel.transition(
        start, float(duration_s), steps, gravity, low, force, table, scratch, DOP853_A, DOP853_B, DOP853_C
    )
    return y[:3], y[3:6], y[6:].reshape(6, 6)


@dataclass(frozen=True, slots=True, eq=False)
class Arc:
    """One uninterrupted integration: knots in order of integration, and why it ended."""

    elapsed_s: FloatArray
    states: FloatArray
    accelerations: FloatArray
    status: int
    evaluations: int
    next_step_s: float


def integrate_arc(
    epoch_tdb_s: float,
    start_s: float,
    state: FloatArray,
    stop_s: float,
    model: ForceModel,
    rtol: float,
    max_step_s: float,
    ground_radius_m: float,
    *,
    event: int = 0,
    event_radius_m: float = 0.0,
    first_step_s: float = 10.0,
) -> Arc:
    """Return the steps from ``start_s`` to ``stop_s`` after the epoch, or to the event asked for (see the kernel)."""
    from lunar import _dynamics_kernel as kernel
    from lunar._tableaux import ERROR, A, B, C

    _check_arc(state, stop_s, rtol, max_step_s, ground_radius_m)
    forces = kernel.Forces(*force_arrays(model, epoch_tdb_s, start_s, stop_s))
    tableau = kernel.Method(A, B, C, ERROR, _ERROR_ORDER)
    control = kernel.Control(rtol, max_step_s, ground_radius_m, event, event_radius_m)
    parts: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    time, y, step, evaluations = start_s, np.ascontiguousarray(state), first_step_s, 0
    status = kernel.STEP_LIMIT
    while status == kernel.STEP_LIMIT:
        knots = kernel.Knots(np.empty(_KNOTS), np.empty((_KNOTS, 6)), np.empty((_KNOTS, 3)))
        count, status, cost, step = kernel.integrate(time, y, float(stop_s), forces, tableau, control, step, knots)
        first = 1 if parts else 0  # a part begins with the last knot of the one before
        parts.append((knots.times[first:count], knots.states[first:count], knots.rates[first:count]))
        time, y = knots.times[count - 1], knots.states[count - 1].copy()
        evaluations += cost
    if status == kernel.TOO_SMALL:
        raise OrbitError(
            f"propagation: expected steps over 1 us to meet a tolerance of {rtol:g}, found none at {time:.3f} s"
        )
    elapsed, states, rates = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    if status == kernel.GROUND:
        ground_s = _ground_time(elapsed[-2:], states[-2:], rates[-2:], ground_radius_m)
        raise _impact(epoch_tdb_s, ground_s, elapsed[-2:], states[-2:], rates[-2:], model)
    return Arc(elapsed, states, rates, status, evaluations, step)


def _check_arc(state: FloatArray, stop_s: float, rtol: float, max_step_s: float, ground_radius_m: float) -> None:
    """Refuse limits that no integration can keep, and a start in the ground."""
    if not (1e-15 <= rtol <= 1e-3 and max_step_s > 0.0 and np.isfinite(stop_s)):
        raise OrbitError(
            f"propagation: expected a finite span, a step over 0 s and a tolerance from 1e-15 to 1e-3, "
            f"found {stop_s} s, {max_step_s} s, {rtol}"
        )
    radius = float(np.linalg.norm(state[:3]))
    if not radius > max(ground_radius_m, 1.0):
        raise OrbitError(
            f"start of the orbit: expected a distance above {ground_radius_m / 1e3:.3f} km from the Moon's centre, "
            f"found {radius / 1e3:.3f} km"
        )


def join(epoch_tdb_s: float, arcs: list[Arc]) -> Trajectory:
    """Return arcs that follow on each other as one trajectory, in ascending time.

    The first knot of an arc that goes on from the very state in which the one before ended is left out.
    """
    skips = [0] + [
        int(np.array_equal(after.states[0], before.states[-1])) for before, after in itertools.pairwise(arcs)
    ]
    elapsed = np.concatenate([arc.elapsed_s[skip:] for arc, skip in zip(arcs, skips, strict=True)])
    states = np.concatenate([arc.states[skip:] for arc, skip in zip(arcs, skips, strict=True)])
    rates = np.concatenate([arc.accelerations[skip:] for arc, skip in zip(arcs, skips, strict=True)])
    if len(elapsed) == 1:  # a propagation over no time at all
        elapsed, states, rates = (np.repeat(elapsed, 2), np.repeat(states, 2, axis=0), np.repeat(rates, 2, axis=0))
        elapsed[1] += 1e-6
        states[1, :3] += 1e-6 * states[0, 3:]
    if elapsed[-1] < elapsed[0]:
        elapsed, states, rates = elapsed[::-1].copy(), states[::-1].copy(), rates[::-1].copy()
    return Trajectory(epoch_tdb_s, elapsed, states, rates, sum(arc.evaluations for arc in arcs))


def state_vector(position_icrf_m: ArrayLike, velocity_icrf_m_s: ArrayLike) -> FloatArray:
    """Return position and velocity as one array (6,)."""
    state = np.concatenate(
        [
            np.asarray(position_icrf_m, dtype=np.float64).reshape(3),
            np.asarray(velocity_icrf_m_s, dtype=np.float64).reshape(3),
        ]
    )
    if not np.all(np.isfinite(state)):
        raise OrbitError(f"start of the orbit: expected six finite numbers, found {state.tolist()}")
    return state


def force_arrays(
    model: ForceModel, epoch_tdb_s: float, start_s: float, stop_s: float
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """Return what the compiled right-hand side reads: packed field, scalars, table over the span, scratch length."""
    from lunar import _dynamics_kernel as kernel
    from lunar._gravity_kernel import scratch_size

    degree = _degree(model)
    first = int(np.floor((epoch_tdb_s + min(start_s, stop_s)) / _TABLE_STEP_S))
    last = int(np.floor((epoch_tdb_s + max(start_s, stop_s)) / _TABLE_STEP_S))
    force = np.zeros(kernel.FORCES)
    force[kernel.TABLE_START_S] = first * _TABLE_STEP_S - epoch_tdb_s
    force[kernel.TABLE_STEP_S] = _TABLE_STEP_S
    force[kernel.GM_EARTH] = constants.GM_EARTH_M3_S2 if model.earth else 0.0
    force[kernel.GM_SUN] = constants.GM_SUN_M3_S2 if model.sun else 0.0
    if model.solar_pressure is not None:
        pressure = constants.SOLAR_PRESSURE_1AU_N_M2 * constants.ASTRONOMICAL_UNIT_M**2
        force[kernel.PRESSURE] = pressure * model.solar_pressure.area_to_mass_m2_kg * model.solar_pressure.reflection
    force[kernel.MOON_RADIUS] = constants.MOON_RADIUS_M
    force[kernel.EARTH_RADIUS] = constants.EARTH_RADIUS_M
    force[kernel.SUN_RADIUS] = constants.SUN_RADIUS_M
    return packed(model.gravity, degree), force, _table(model, first, last), scratch_size(degree)


def _degree(model: ForceModel) -> int:
    return model.gravity.degree if model.degree is None else model.degree


def _table(model: ForceModel, first: int, last: int) -> FloatArray:
    """Return polynomials over the half days ``first`` to ``last``; a half day has the same ones in any span."""
    if (first, last) in model._joined:
        return model._joined[first, last]
    missing = [k for k in range(first, last + 1) if k not in model._segments]
    if missing:
        model._segments.update(zip(missing, _series(model, np.array(missing)), strict=True))
    joined = np.stack([model._segments[k] for k in range(first, last + 1)])
    model._joined.clear()
    model._joined[first, last] = joined
    return joined


def _series(model: ForceModel, segments: IntArray) -> FloatArray:
    """Return coefficients (segments, powers of -1..1, columns) of orientation, Earth and Sun.

    Fitted at the Chebyshev nodes; eight terms leave less than a float64 of seconds does.
    """
    from lunar._dynamics_kernel import COLUMNS

    node = np.pi * (np.arange(_TABLE_TERMS) + 0.5) / _TABLE_TERMS
    times = (segments[:, None] + 0.5 * (1.0 + np.cos(node))) * _TABLE_STEP_S
    values = np.zeros((len(segments), _TABLE_TERMS, COLUMNS))
    values[..., :9] = model.orientation.pa_from_icrf(times).reshape(len(segments), _TABLE_TERMS, 9)
    values[..., 9:12] = earth_position_icrf_m(times)
    values[..., 12:15] = sun_position_icrf_m(times)
    chebyshev = 2.0 / _TABLE_TERMS * np.cos(np.arange(_TABLE_TERMS)[:, None] * node)
    chebyshev[0] *= 0.5
    powers = np.zeros((_TABLE_TERMS, _TABLE_TERMS))
    for term in range(_TABLE_TERMS):
        powers[: term + 1, term] = np.polynomial.chebyshev.cheb2poly([0.0] * term + [1.0])
    return np.ascontiguousarray(np.einsum("tn,snc->stc", powers @ chebyshev, values))


def _ground_time(elapsed: FloatArray, states: FloatArray, rates: FloatArray, ground_radius_m: float) -> float:
    """Return when the last step first meets the ground radius, by a scan and bisection on the dense output."""
    from lunar import _dynamics_kernel as kernel

    # Two knots in ascending order, so that the evaluation can search them.
    order = slice(None) if elapsed[1] > elapsed[0] else slice(None, None, -1)
    times_of, states_at, rates_at = (np.ascontiguousarray(array[order]) for array in (elapsed, states, rates))
    fractions = np.linspace(0.0, 1.0, 257)
    low, high = elapsed[0], elapsed[1]
    out = np.empty((len(fractions), 6))
    for _ in range(3):
        times = low + (high - low) * fractions
        kernel.evaluate(times_of, states_at, rates_at, times, out)
        below = np.nonzero(np.linalg.norm(out[:, :3], axis=-1) <= ground_radius_m)[0]
        at = int(below[0]) if len(below) else len(times) - 1
        low, high = times[max(at - 1, 0)], times[at]
    return float(high)


def _impact(
    epoch_tdb_s: float, ground_s: float, elapsed: FloatArray, states: FloatArray, rates: FloatArray, model: ForceModel
) -> ImpactError:
    from lunar.frames import spherical_from_mcmf
    from lunar.timescales import format_utc, utc_ns_from_tdb_s

    arc = Arc(elapsed, states, rates, 0, 0, 0.0)
    position = join(epoch_tdb_s, [arc]).state_after(ground_s)[:3]
    tdb_s = epoch_tdb_s + ground_s
    latitude, longitude, _ = spherical_from_mcmf(model.orientation.mcmf_from_icrf(tdb_s) @ position)
    utc_ns = utc_ns_from_tdb_s(tdb_s)
    return ImpactError(utc_ns, format_utc(utc_ns), float(latitude), float(longitude))
