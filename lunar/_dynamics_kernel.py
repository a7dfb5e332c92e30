"""Compiled right-hand sides and integrators for orbits about the Moon, ICRF axes, SI units.

Time inside is seconds after the start of the propagation.  What changes with time but not with the orbit comes
from one table of polynomials in -1..1, ``table[segment, term, column]``: nine elements of pa_from_icrf (row by row),
then Earth and Sun positions.  ``force`` holds the scalars, at the places named below.
"""

import math
from typing import NamedTuple

import numpy as np

from kernels.compiled import njit
from lunar._gravity_kernel import acceleration, acceleration_gradient
from lunar.arrays import FloatArray

COLUMNS = 16
FORCES = 8
TABLE_START_S, TABLE_STEP_S, GM_EARTH, GM_SUN, PRESSURE, MOON_RADIUS, EARTH_RADIUS, SUN_RADIUS = range(FORCES)
"""Places in ``force``; PRESSURE is the radiation acceleration times the squared distance from the Sun, 0 for none."""

REACHED, STEP_LIMIT, EVENT, GROUND, TOO_SMALL = range(5)
"""Reasons for the end of an integration."""

NO_EVENT, PERISELENE, APOSELENE = range(3)

EVENT_TOLERANCE_S = 1e-6
EVENT_TRIES = 5
SHORTEST_STEP_S = 1e-6


class Forces(NamedTuple):
    """Acting forces: packed gravity field, scalars (see the module), table over the span, scratch length."""

    gravity: FloatArray
    scalars: FloatArray
    table: FloatArray
    scratch_size: int


class Method(NamedTuple):
    """Tableau of an embedded Runge-Kutta-Nystrom method (stages in rows), and the order of its error estimate.

    ``b`` and ``error`` have a row for positions and one for velocities.
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    error: FloatArray
    error_order: int


class Control(NamedTuple):
    """Tolerance of a step, longest step, radius of the ground; which event ends the integration, at which radius."""

    rtol: float
    max_step_s: float
    ground_m: float
    event: int
    event_radius_m: float


class Knots(NamedTuple):
    """Accepted steps: seconds (n,), states (n, 6) and accelerations (n, 3)."""

    times: FloatArray
    states: FloatArray
    rates: FloatArray


@njit(error_model="numpy", boundscheck=False, fastmath={"contract", "nsz"})
def look_up(table: FloatArray, force: FloatArray, t: float, out: FloatArray) -> None:
    """Write the table's columns at time ``t`` to ``out``, by Horner's rule."""
    place = (t - force[TABLE_START_S]) / force[TABLE_STEP_S]
    segment = min(max(int(place), 0), len(table) - 1)
    x = 2.0 * (place - segment) - 1.0
    terms = table.shape[1]
    for k in range(COLUMNS):
        out[k] = table[segment, terms - 1, k]
    for term in range(terms - 2, -1, -1):
        for k in range(COLUMNS):
            out[k] = out[k] * x + table[segment, term, k]


@njit(error_model="numpy", boundscheck=False, fastmath={"contract", "nsz"})
def _tide(gm: float, sx: float, sy: float, sz: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Acceleration by a distant body at s, less that of the Moon's centre, without cancellation (Battin 1999, 8.62)."""
    s2 = sx * sx + sy * sy + sz * sz
    dx, dy, dz = x - sx, y - sy, z - sz
    d2 = dx * dx + dy * dy + dz * dz
    q = (x * (x - 2.0 * sx) + y * (y - 2.0 * sy) + z * (z - 2.0 * sz)) / s2
    f = q * (3.0 + 3.0 * q + q * q) / (1.0 + (1.0 + q) * math.sqrt(1.0 + q))
    g = -gm / (d2 * math.sqrt(d2))
    return g * (x + f * sx), g * (y + f * sy), g * (z + f * sz)


@njit(error_model="numpy", boundscheck=False)
def _visible_share(
    sun_x: float, sun_y: float, sun_z: float, sun_radius: float, x: float, y: float, z: float, radius: float
) -> float:
    """Share of the Sun's disc left uncovered by a sphere: vectors from the spacecraft to the Sun and to its centre."""
    sun = math.sqrt(sun_x * sun_x + sun_y * sun_y + sun_z * sun_z)
    body = math.sqrt(x * x + y * y + z * z)
    if body >= sun:
        return 1.0
    a = math.asin(min(1.0, sun_radius / sun))
    b = math.asin(min(1.0, radius / body))
    cosine = (sun_x * x + sun_y * y + sun_z * z) / (sun * body)
    c = math.acos(min(1.0, max(-1.0, cosine)))
    if c >= a + b:
        return 1.0
    if c <= b - a:
        return 0.0
    if c <= a - b:
        return 1.0 - (b / a) ** 2
    # Two discs that overlap (Montenbruck and Gill, section 3.4.2).
    u = (c * c + a * a - b * b) / (2.0 * c)
    v = math.sqrt(max(0.0, a * a - u * u))
    area = a * a * math.acos(min(1.0, max(-1.0, u / a))) + b * b * math.acos(min(1.0, max(-1.0, (c - u) / b))) - c * v
    return 1.0 - area / (math.pi * a * a)


@njit(error_model="numpy", boundscheck=False)
def force_acceleration(
    t: float,
    x: float,
    y: float,
    z: float,
    gravity: FloatArray,
    force: FloatArray,
    table: FloatArray,
    scratch: FloatArray,
    frame: FloatArray,
) -> tuple[float, float, float]:
    """Return the acceleration in ICRF; ``frame`` receives the table's columns at ``t``."""
    look_up(table, force, t, frame)
    px = frame[0] * x + frame[1] * y + frame[2] * z
    py = frame[3] * x + frame[4] * y + frame[5] * z
    pz = frame[6] * x + frame[7] * y + frame[8] * z
    gx, gy, gz = acceleration(gravity, scratch, px, py, pz)
    ax = frame[0] * gx + frame[3] * gy + frame[6] * gz
    ay = frame[1] * gx + frame[4] * gy + frame[7] * gz
    az = frame[2] * gx + frame[5] * gy + frame[8] * gz
    if force[GM_EARTH] > 0.0:
        bx, by, bz = _tide(force[GM_EARTH], frame[9], frame[10], frame[11], x, y, z)
        ax += bx
        ay += by
        az += bz
    if force[GM_SUN] > 0.0:
        bx, by, bz = _tide(force[GM_SUN], frame[12], frame[13], frame[14], x, y, z)
        ax += bx
        ay += by
        az += bz
    if force[PRESSURE] > 0.0:
        sx, sy, sz = frame[12] - x, frame[13] - y, frame[14] - z
        light = _visible_share(sx, sy, sz, force[SUN_RADIUS], -x, -y, -z, force[MOON_RADIUS])
        light *= _visible_share(
            sx, sy, sz, force[SUN_RADIUS], frame[9] - x, frame[10] - y, frame[11] - z, force[EARTH_RADIUS]
        )
        d2 = sx * sx + sy * sy + sz * sz
        push = -light * force[PRESSURE] / (d2 * math.sqrt(d2))
        ax += push * sx
        ay += push * sy
        az += push * sz
    return ax, ay, az


@njit(error_model="numpy", boundscheck=False)
def interpolate(times: FloatArray, states: FloatArray, rates: FloatArray, k: int, s: float, out: FloatArray) -> None:
    """Write the state at the fraction ``s`` of the step from knot ``k``: the quintic through both ends (r, v, a)."""
    h = times[k + 1] - times[k]
    for d in range(3):
        v0, v1 = h * states[k, d + 3], h * states[k + 1, d + 3]
        a0, a1 = 0.5 * h * h * rates[k, d], 0.5 * h * h * rates[k + 1, d]
        gap = states[k + 1, d] - states[k, d] - v0 - a0
        slope = v1 - v0 - 2.0 * a0
        bend = a1 - a0
        c3 = 10.0 * gap - 4.0 * slope + bend
        c4 = -15.0 * gap + 7.0 * slope - 2.0 * bend
        c5 = 6.0 * gap - 3.0 * slope + bend
        out[d] = states[k, d] + s * (v0 + s * (a0 + s * (c3 + s * (c4 + s * c5))))
        out[d + 3] = (v0 + s * (2.0 * a0 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))) / h


@njit(error_model="numpy", boundscheck=False)
def evaluate(times: FloatArray, states: FloatArray, rates: FloatArray, wanted: FloatArray, out: FloatArray) -> None:
    """Write the states at ``wanted`` times; where two knots share a time (a burn) the later one rules from there on."""
    for i in range(len(wanted)):
        low = 0
        high = len(times) - 1
        while high - low > 1:  # the last knot at or before the wanted time
            middle = (low + high) // 2
            if times[middle] <= wanted[i]:
                low = middle
            else:
                high = middle
        while low > 0 and times[low + 1] == times[low]:
            low -= 1
        interpolate(times, states, rates, low, (wanted[i] - times[low]) / (times[low + 1] - times[low]), out[i])


@njit(error_model="numpy", boundscheck=False)
def _radial(state: FloatArray) -> float:
    return float(state[0] * state[3] + state[1] * state[4] + state[2] * state[5])


@njit(error_model="numpy", boundscheck=False)
def _events(
    times: FloatArray,
    states: FloatArray,
    rates: FloatArray,
    k: int,
    sign: float,
    ground_m: float,
    event: int,
    event_radius_m: float,
    out: FloatArray,
) -> tuple[int, float]:
    """Return what happened in the step from knot ``k``, and at which fraction; for EVENT ``out`` has the state."""
    end = states[k + 1]
    if end[0] * end[0] + end[1] * end[1] + end[2] * end[2] < ground_m * ground_m:
        return GROUND, 1.0
    low, high = 0.0, 1.0
    f_low, f_high = sign * _radial(states[k]), sign * _radial(end)
    rising = f_low < 0.0 <= f_high
    if not rising and not (event == APOSELENE and f_high < 0.0 <= f_low):
        return REACHED, 1.0
    # The zero of radial speed, by regula falsi with the Illinois rule.
    side = 0
    s = 0.5
    for _ in range(60):
        s = (low * f_high - high * f_low) / (f_high - f_low)
        interpolate(times, states, rates, k, s, out)
        f = sign * _radial(out)
        if abs(f) < 1e-3 or high - low < 1e-14:
            break
        if f * f_high > 0.0:
            high, f_high = s, f
            if side == -1:
                f_low *= 0.5
            side = -1
        else:
            low, f_low = s, f
            if side == 1:
                f_high *= 0.5
            side = 1
    radius = math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    if rising and radius < ground_m:
        return GROUND, s
    if rising and event == PERISELENE and radius < event_radius_m:
        return EVENT, s
    if not rising and radius > event_radius_m:
        return EVENT, s
    return REACHED, 1.0


@njit(error_model="numpy", boundscheck=False, nogil=True)
def _stage_place(
    work: FloatArray, k: FloatArray, y: FloatArray, a: FloatArray, c: FloatArray, stage: int, signed: float
) -> None:
    """Put the position of a stage into ``work``, from the accelerations ``k`` of the stages before it."""
    for d in range(3):
        work[d] = 0.0
    for j in range(stage):
        for d in range(3):
            work[d] += a[stage, j] * k[j, d]
    for d in range(3):
        work[d] = y[d] + signed * (c[stage] * y[d + 3] + signed * work[d])


@njit(error_model="numpy", boundscheck=False, nogil=True)
def _step_end(
    new: FloatArray,
    estimate: FloatArray,
    k: FloatArray,
    y: FloatArray,
    b: FloatArray,
    error: FloatArray,
    signed: float,
    rtol: float,
) -> float:
    """Put the state at the end of a step into ``new`` and return its error over the tolerance."""
    for d in range(6):
        new[d] = estimate[d] = 0.0
    for i in range(len(k)):
        for d in range(6):
            row = d // 3
            rate = k[i, d - 3] if d > 2 else signed * k[i, d]
            new[d] += b[row, i] * rate
            estimate[d] += error[row, i] * rate
    size_r = rtol * rtol * (y[0] * y[0] + y[1] * y[1] + y[2] * y[2])
    size_v = rtol * rtol * (y[3] * y[3] + y[4] * y[4] + y[5] * y[5])
    total = 0.0
    for d in range(6):
        if d < 3:
            new[d] += y[d + 3]
        new[d] = y[d] + signed * new[d]
        size = size_r if d < 3 else size_v
        total += estimate[d] * estimate[d] / size
    return abs(signed) * math.sqrt(total / 6.0)


@njit(error_model="numpy", boundscheck=False, nogil=True)
def _keep_knot(
    times: FloatArray, states: FloatArray, rates: FloatArray, count: int, t: float, y: FloatArray, k: FloatArray
) -> None:
    times[count] = t
    for d in range(6):
        states[count, d] = y[d]
    for d in range(3):
        rates[count, d] = k[0, d]


@njit(error_model="numpy", boundscheck=False, nogil=True)
def _back_to_knot(y: FloatArray, k: FloatArray, states: FloatArray, rates: FloatArray, knot: int) -> None:
    """Put state and acceleration of a knot into ``y`` and stage 0."""
    for d in range(3):
        y[d] = states[knot, d]
        y[d + 3] = states[knot, d + 3]
        k[0, d] = rates[knot, d]


@njit(error_model="numpy", boundscheck=False, nogil=True)
def _seconds_to_periapsis(y: FloatArray, k: FloatArray) -> float:
    """Return the time to the zero of the radial speed by a step of Newton's rule, from state and rates of a knot."""
    rate = y[3] * y[3] + y[4] * y[4] + y[5] * y[5] + y[0] * k[0, 0] + y[1] * k[0, 1] + y[2] * k[0, 2]
    seconds: float = -_radial(y) / rate
    return seconds


@njit(error_model="numpy", boundscheck=False, nogil=True)
def _next_size(step: float, estimate: float, h: float, max_step: float, order: int, rejected: bool) -> float:
    """Return the size of the next step from the error of the last one over the tolerance."""
    factor = 0.9 * estimate ** (-1.0 / order) if estimate > 0.0 else 5.0
    if estimate <= 1.0:
        grown = step * min(1.0 if rejected else 5.0, max(0.2, factor))
        # A step cut short at the end of the span says nothing against the size in use.
        return min(max_step, grown if step >= 0.999 * h else max(h, grown))
    return step * max(0.2, factor) if estimate == estimate else 0.1 * step


@njit(error_model="numpy", boundscheck=False, nogil=True)
def _next_end(t: float, stop_s: float, sign: float, h: float) -> tuple[float, float]:
    """Return the end and the length of the next step; the last two share what is left, so that none is tiny."""
    left = sign * (stop_s - t)
    step = h if left > 2.0 * h else (left if left <= h else 0.5 * left)
    return (stop_s if step == left else t + sign * step), step


@njit(error_model="numpy", boundscheck=False, nogil=True)
def _search_step(
    knots: Knots, count: int, status: int, sign: float, control: Control, y: FloatArray, k: FloatArray, work: FloatArray
) -> tuple[int, float]:
    """Return what happened in the step to the newest knot, and the time from there to the event that ends it."""
    times, states, rates = knots
    if status == EVENT:  # the dense output gave the time to some ms: Newton's rule on radial speed
        return EVENT, _seconds_to_periapsis(y, k)
    if count == 0:
        return status, 0.0
    found, fraction = _events(
        times, states, rates, count - 1, sign, control.ground_m, control.event, control.event_radius_m, work
    )
    return found, (fraction - 1.0) * (times[count] - times[count - 1]) if found == EVENT else 0.0


@njit(error_model="numpy", boundscheck=False, nogil=True)
def integrate(
    start_s: float,
    y0: FloatArray,
    stop_s: float,
    forces: Forces,
    method: Method,
    control: Control,
    first_step_s: float,
    knots: Knots,
) -> tuple[int, int, int, float]:
    """Integrate adaptively from ``start_s`` to ``stop_s`` (either may be the later), keeping every accepted step.

    Returns (number of knots, why it ended, evaluations, next step).  Knots are filled until they are full
    (STEP_LIMIT).  EVENT: the last knot is a periselene below ``event_radius_m``, or an aposelene above it, whichever
    ``event`` asks for.  GROUND: the last step met radius ``ground_m``, at its end or at a periselene in it.

    One loop over stages, with the forces evaluated in one place (each further one would be compiled again).  Stage 0
    is at a new knot; only there is the step that led to it searched for events, as its quintic needs the
    acceleration at both ends.
    """
    gravity, scalars, table, scratch_size = forces
    a, b, c, error, order = method
    times, states, rates = knots
    last = len(c) - 1
    scratch, frame, work = np.empty(scratch_size), np.empty(COLUMNS), np.empty(6)
    k, y, new, errors = np.empty((last + 1, 3)), y0.copy(), np.empty(6), np.empty(6)
    sign = 1.0 if stop_s >= start_s else -1.0
    t = t_new = start_s
    h = min(abs(first_step_s), control.max_step_s)
    step = signed = 0.0
    count = evaluations = stage = tries = 0
    status = REACHED
    rejected = known = False
    while True:
        _stage_place(work, k, y, a, c, stage, signed)
        if not known:
            k[stage, 0], k[stage, 1], k[stage, 2] = force_acceleration(
                t + c[stage] * signed, work[0], work[1], work[2], gravity, scalars, table, scratch, frame
            )
            evaluations += 1
        known = False
        if stage == 0:
            _keep_knot(times, states, rates, count, t, y, k)
            status, wait = _search_step(knots, count, status, sign, control, y, k, work)
            if abs(wait) > EVENT_TOLERANCE_S and tries < EVENT_TRIES:  # the step again, as far as the event
                tries += 1
                t, t_new = times[count - 1], t + wait
                signed, stage = t_new - t, 1
                step = abs(signed)
                _back_to_knot(y, k, states, rates, count - 1)
                continue
            count += 1
            if status != REACHED or sign * (stop_s - t) <= 0.0:
                return count, status, evaluations, h
            if count == len(times):
                return count, STEP_LIMIT, evaluations, h
        elif stage < last:
            stage += 1
            continue
        else:
            estimate = _step_end(new, errors, k, y, b, error, signed, control.rtol)
            h = _next_size(step, estimate, h, control.max_step_s, order, rejected)
            if estimate <= 1.0:
                rejected = False
                t = t_new
                for d in range(6):
                    y[d] = new[d]
                for d in range(3):
                    k[0, d] = k[last, d]
                known = True  # the last stage is the first of the next step
                signed, stage = 0.0, 0
                continue
            if h < SHORTEST_STEP_S:
                return count, TOO_SMALL, evaluations, h
            rejected = True
        t_new, step = _next_end(t, stop_s, sign, h)
        signed, stage = sign * step, 1


@njit(error_model="numpy", boundscheck=False)
def _tide_gradient(gm: float, sx: float, sy: float, sz: float, x: float, y: float, z: float, g: FloatArray) -> None:
    dx, dy, dz = x - sx, y - sy, z - sz
    d2 = dx * dx + dy * dy + dz * dz
    f = gm / (d2 * math.sqrt(d2))
    n = 3.0 * f / d2
    g[0, 0] += n * dx * dx - f
    g[1, 1] += n * dy * dy - f
    g[2, 2] += n * dz * dz - f
    g[0, 1] += n * dx * dy
    g[0, 2] += n * dx * dz
    g[1, 2] += n * dy * dz


@njit(error_model="numpy", boundscheck=False)
def _force_gradient(
    low: FloatArray, force: FloatArray, frame: FloatArray, x: float, y: float, z: float, g: FloatArray
) -> None:
    """Write the derivative of the acceleration by position, ICRF, of the field ``low`` with Earth and Sun."""
    xx, xy, xz, yy, yz, zz = acceleration_gradient(
        low,
        frame[0] * x + frame[1] * y + frame[2] * z,
        frame[3] * x + frame[4] * y + frame[5] * z,
        frame[6] * x + frame[7] * y + frame[8] * z,
    )
    for i in range(3):
        px, py, pz = frame[i], frame[3 + i], frame[6 + i]
        qx, qy, qz = px * xx + py * xy + pz * xz, px * xy + py * yy + pz * yz, px * xz + py * yz + pz * zz
        for j in range(i, 3):
            g[i, j] = qx * frame[j] + qy * frame[3 + j] + qz * frame[6 + j]
    if force[GM_EARTH] > 0.0:
        _tide_gradient(force[GM_EARTH], frame[9], frame[10], frame[11], x, y, z, g)
    if force[GM_SUN] > 0.0:
        _tide_gradient(force[GM_SUN], frame[12], frame[13], frame[14], x, y, z, g)
    g[1, 0], g[2, 0], g[2, 1] = g[0, 1], g[0, 2], g[1, 2]


@njit(
    error_model="numpy",
    boundscheck=False,
    nogil=True,
    ahead="f8[::1], f8, i8, *3 * [f8[::1]], f8[:, :, ::1], i8, f8[:, ::1], f8[::1], f8[::1]",
)
def transition(
    y0: FloatArray,
    duration_s: float,
    steps: int,
    gravity: FloatArray,
    low: FloatArray,
    force: FloatArray,
    table: FloatArray,
    scratch_size: int,
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
) -> FloatArray:
    """Return state and transition matrix (42 numbers, the matrix row by row) after ``steps`` equal steps."""
    scratch, frame, work, y = np.empty(scratch_size), np.empty(COLUMNS), np.empty(42), np.zeros(42)
    g = np.empty((3, 3))
    stages = len(c)
    k = np.empty((stages, 42))
    for i in range(6):
        y[i] = y0[i]
        y[6 + 7 * i] = 1.0
    h = duration_s / steps
    for number in range(steps):
        for stage in range(stages):
            for d in range(42):
                work[d] = y[d]
            for j in range(stage):
                factor = h * a[stage, j]
                for d in range(42):
                    work[d] += factor * k[j, d]
            t = (number + c[stage]) * h
            ax, ay, az = force_acceleration(t, work[0], work[1], work[2], gravity, force, table, scratch, frame)
            _force_gradient(low, force, frame, work[0], work[1], work[2], g)
            for d in range(3):
                k[stage, d] = work[d + 3]
            k[stage, 3], k[stage, 4], k[stage, 5] = ax, ay, az
            for j in range(6):
                for i in range(3):
                    k[stage, 6 + 6 * i + j] = work[24 + 6 * i + j]
                    total = 0.0
                    for d in range(3):
                        total += g[i, d] * work[6 + 6 * d + j]
                    k[stage, 24 + 6 * i + j] = total
        for stage in range(stages):
            factor = h * b[stage]
            for d in range(42):
                y[d] += factor * k[stage, d]
    return y
