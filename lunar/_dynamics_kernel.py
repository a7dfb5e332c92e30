"""Compiled right-hand sides and integrators for orbits about the Moon, ICRF axes, SI units.

Time inside is seconds after the start of the propagation.  What changes with time but not with the orbit comes from one
table of Chebyshev series, ``table[segment, term, column]``: nine elements of pa_from_icrf (row by row), then Earth and Sun
positions.  ``force`` holds the scalars, at the places named below.
"""

from __future__ import annotations

import math

import numpy as np

from lunar._compile import njit
from lunar._gravity_kernel import acceleration, acceleration_gradient

COLUMNS = 16
FORCES = 8
TABLE_START_S, TABLE_STEP_S, GM_EARTH, GM_SUN, PRESSURE, MOON_RADIUS, EARTH_RADIUS, SUN_RADIUS = range(FORCES)
"""Places in ``force``; PRESSURE is the radiation acceleration times the squared distance from the Sun, 0 for none."""

REACHED, STEP_LIMIT, EVENT, GROUND, TOO_SMALL = range(5)
"""Why an integration ended."""

NO_EVENT, PERISELENE, APOSELENE = range(3)


@njit(error_model="numpy", boundscheck=False, fastmath={"contract", "nsz"})
def look_up(table, force, t, out):  # type: ignore[no-untyped-def]
    """Write the table's 15 columns at time ``t`` to ``out``, by Clenshaw's rule."""
    place = (t - force[TABLE_START_S]) / force[TABLE_STEP_S]
    segment = min(max(int(place), 0), len(table) - 1)
    x2 = 2.0 * (2.0 * (place - segment) - 1.0)
    last = np.zeros(COLUMNS)
    before = np.zeros(COLUMNS)
    for term in range(table.shape[1] - 1, 0, -1):
        for k in range(COLUMNS):
            new = table[segment, term, k] + x2 * last[k] - before[k]
            before[k] = last[k]
            last[k] = new
    for k in range(COLUMNS):
        out[k] = table[segment, 0, k] + 0.5 * x2 * last[k] - before[k]


@njit(error_model="numpy", boundscheck=False, fastmath={"contract", "nsz"})
def _tide(gm, sx, sy, sz, x, y, z):  # type: ignore[no-untyped-def]
    """Acceleration by a distant body at s, less that of the Moon's centre, without cancellation (Battin 1999, 8.62)."""
    s2 = sx * sx + sy * sy + sz * sz
    dx, dy, dz = x - sx, y - sy, z - sz
    d2 = dx * dx + dy * dy + dz * dz
    q = (x * (x - 2.0 * sx) + y * (y - 2.0 * sy) + z * (z - 2.0 * sz)) / s2
    f = q * (3.0 + 3.0 * q + q * q) / (1.0 + (1.0 + q) ** 1.5)
    g = -gm / (d2 * math.sqrt(d2))
    return g * (x + f * sx), g * (y + f * sy), g * (z + f * sz)


@njit(error_model="numpy", boundscheck=False)
def _visible_share(sun_x, sun_y, sun_z, sun_radius, x, y, z, radius):  # type: ignore[no-untyped-def]
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
def force_acceleration(t, x, y, z, gravity, force, table, scratch, frame):  # type: ignore[no-untyped-def]
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
        light *= _visible_share(sx, sy, sz, force[SUN_RADIUS], frame[9] - x, frame[10] - y, frame[11] - z,
                                force[EARTH_RADIUS])
        d2 = sx * sx + sy * sy + sz * sz
        push = -light * force[PRESSURE] / (d2 * math.sqrt(d2))
        ax += push * sx
        ay += push * sy
        az += push * sz
    return ax, ay, az


@njit(error_model="numpy", boundscheck=False)
def _derivative(t, y, gravity, force, table, scratch, frame, out):  # type: ignore[no-untyped-def]
    ax, ay, az = force_acceleration(t, y[0], y[1], y[2], gravity, force, table, scratch, frame)
    out[0], out[1], out[2] = y[3], y[4], y[5]
    out[3], out[4], out[5] = ax, ay, az


@njit(error_model="numpy", boundscheck=False)
def _stages(t, h, y, k, a, c, gravity, force, table, scratch, frame, work):  # type: ignore[no-untyped-def]
    """Fill the derivatives k[1:] of one step from k[0]."""
    for i in range(1, len(c)):
        for d in range(6):
            total = 0.0
            for j in range(i):
                total += a[i, j] * k[j, d]
            work[d] = y[d] + h * total
        _derivative(t + c[i] * h, work, gravity, force, table, scratch, frame, k[i])


@njit(error_model="numpy", boundscheck=False)
def interpolate(s, h, first, first_a, last, last_a, out):  # type: ignore[no-untyped-def]
    """Write the state at the fraction ``s`` of a step: quintic through position, velocity, acceleration at both ends."""
    for d in range(3):
        v0, v1 = h * first[d + 3], h * last[d + 3]
        a0, a1 = 0.5 * h * h * first_a[d], 0.5 * h * h * last_a[d]
        gap = last[d] - first[d] - v0 - a0
        slope = v1 - v0 - 2.0 * a0
        bend = a1 - a0
        c3 = 10.0 * gap - 4.0 * slope + bend
        c4 = -15.0 * gap + 7.0 * slope - 2.0 * bend
        c5 = 6.0 * gap - 3.0 * slope + bend
        out[d] = first[d] + s * (v0 + s * (a0 + s * (c3 + s * (c4 + s * c5))))
        out[d + 3] = (v0 + s * (2.0 * a0 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))) / h


@njit(error_model="numpy", boundscheck=False)
def _apsis(h, first, first_a, last, last_a, out):  # type: ignore[no-untyped-def]
    """Return the fraction of a step at which r.v = 0 (bracketed by its ends), by the Illinois rule; state to ``out``."""
    low, high = 0.0, 1.0
    f_low = first[0] * first[3] + first[1] * first[4] + first[2] * first[5]
    f_high = last[0] * last[3] + last[1] * last[4] + last[2] * last[5]
    side = 0
    s = 0.5
    for _ in range(60):
        s = (low * f_high - high * f_low) / (f_high - f_low)
        interpolate(s, h, first, first_a, last, last_a, out)
        f = out[0] * out[3] + out[1] * out[4] + out[2] * out[5]
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
    return s


@njit(error_model="numpy", boundscheck=False, nogil=True)
def integrate(start_s, y0, stop_s, gravity, force, table, scratch_size, a, b, c, error, second_error, error_order, rtol,
              max_step_s, first_step_s, ground_m, event, event_radius_m, times, states, accelerations):
    # type: ignore[no-untyped-def]
    """Integrate adaptively from ``start_s`` to ``stop_s`` (either may be the later), keeping every accepted step.

    Returns (number of knots, why it ended, evaluations, next step).  Knots go to ``times``, ``states``, ``accelerations``
    until these are full (STEP_LIMIT).  EVENT: the last knot is a periselene below ``event_radius_m``, or an aposelene above
    it, whichever ``event`` asks for.  GROUND: the last step met radius ``ground_m``, at its end or at a periselene in it.
    """
    stages = len(c)
    scratch = np.empty(scratch_size)
    frame = np.empty(COLUMNS)
    work = np.empty(6)
    middle = np.empty(6)
    k = np.empty((stages, 6))
    y = y0.copy()
    new = np.empty(6)
    derivative = np.empty(6)
    sign = 1.0 if stop_s >= start_s else -1.0
    t = start_s
    _derivative(t, y, gravity, force, table, scratch, frame, k[0])
    evaluations = 1
    times[0] = t
    states[0] = y
    accelerations[0] = k[0, 3:]
    count = 1
    h = min(abs(first_step_s), max_step_s)
    rejected = False
    two_estimates = False
    for i in range(stages):
        two_estimates = two_estimates or second_error[i] != 0.0
    while sign * (stop_s - t) > 0.0:
        if count >= len(times):
            return count, STEP_LIMIT, evaluations, h
        left = sign * (stop_s - t)
        # The last two steps share what is left, so that no tiny step is made.
        step = h if left > 2.0 * h else (left if left <= h else 0.5 * left)
        final = step == left
        signed = sign * step
        _stages(t, signed, y, k, a, c, gravity, force, table, scratch, frame, work)
        evaluations += stages - 1
        size_r = rtol * math.sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2])
        size_v = rtol * math.sqrt(y[3] * y[3] + y[4] * y[4] + y[5] * y[5])
        e_r = e_v = e2_r = e2_v = 0.0
        for d in range(6):
            total = first = second = 0.0
            for i in range(stages):
                total += b[i] * k[i, d]
                first += error[i] * k[i, d]
                second += second_error[i] * k[i, d]
            new[d] = y[d] + signed * total
            if d < 3:
                e_r += first * first
                e2_r += second * second
            else:
                e_v += first * first
                e2_v += second * second
        estimate = e_r / size_r**2 + e_v / size_v**2
        if two_estimates:
            coarse = e2_r / size_r**2 + e2_v / size_v**2
            size = step * estimate / math.sqrt(estimate + 0.01 * coarse) if estimate > 0.0 else 0.0
        else:
            size = step * math.sqrt(estimate)
        size *= math.sqrt(1.0 / 6.0)
        factor = 0.9 * size ** (-1.0 / (error_order + 1)) if size > 0.0 else 5.0
        if not size <= 1.0:
            rejected = True
            h = step * max(0.2, factor) if size == size else 0.1 * step
            if h < 1e-6:
                return count, TOO_SMALL, evaluations, h
            continue
        grown = step * min(1.0 if rejected else 5.0, max(0.2, factor))
        h = min(max_step_s, grown if step >= h * 0.999 else max(h, grown))
        rejected = False
        t_new = stop_s if final else t + signed
        _derivative(t_new, new, gravity, force, table, scratch, frame, derivative)
        evaluations += 1
        before = sign * (y[0] * y[3] + y[1] * y[4] + y[2] * y[5])
        after = sign * (new[0] * new[3] + new[1] * new[4] + new[2] * new[5])
        radius = math.sqrt(new[0] * new[0] + new[1] * new[1] + new[2] * new[2])
        status = REACHED
        if radius < ground_m:
            status = GROUND
        elif (before < 0.0 <= after) or (event == APOSELENE and after < 0.0 <= before):
            low = before < 0.0
            fraction = _apsis(signed, y, k[0, 3:], new, derivative[3:], middle)
            apsis = math.sqrt(middle[0] ** 2 + middle[1] ** 2 + middle[2] ** 2)
            if low and apsis < ground_m:
                status = GROUND
            elif (low and event == PERISELENE and apsis < event_radius_m) or (
                not low and event == APOSELENE and apsis > event_radius_m
            ):
                status = EVENT
                t_new = t + fraction * signed
                new[:] = middle
                _derivative(t_new, new, gravity, force, table, scratch, frame, derivative)
                evaluations += 1
        t = t_new
        y[:] = new
        k[0] = derivative
        times[count] = t
        states[count] = y
        accelerations[count] = derivative[3:]
        count += 1
        if status != REACHED:
            return count, status, evaluations, h
    return count, REACHED, evaluations, h


@njit(error_model="numpy", boundscheck=False)
def evaluate(times, states, accelerations, wanted, out):  # type: ignore[no-untyped-def]
    """Write the states at ``wanted`` times; where two knots share a time (a burn) the later one rules from there on."""
    for i in range(len(wanted)):
        k = min(max(np.searchsorted(times, wanted[i], side="right") - 1, 0), len(times) - 2)
        while k > 0 and times[k + 1] == times[k]:
            k -= 1
        h = times[k + 1] - times[k]
        s = (wanted[i] - times[k]) / h
        interpolate(s, h, states[k], accelerations[k], states[k + 1], accelerations[k + 1], out[i])


@njit(error_model="numpy", boundscheck=False)
def _tide_gradient(gm, sx, sy, sz, x, y, z, g):  # type: ignore[no-untyped-def]
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
def _variational(t, y, gravity, low, force, table, scratch, frame, out):  # type: ignore[no-untyped-def]
    """State and transition matrix: y = r, v, then Phi (6 x 6, row by row)."""
    ax, ay, az = force_acceleration(t, y[0], y[1], y[2], gravity, force, table, scratch, frame)
    out[0], out[1], out[2] = y[3], y[4], y[5]
    out[3], out[4], out[5] = ax, ay, az
    m = frame[:9].copy().reshape(3, 3)
    p = m @ y[:3]
    xx, xy, xz, yy, yz, zz = acceleration_gradient(low, p[0], p[1], p[2])
    body = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    g = np.zeros((3, 3))
    for i in range(3):
        for j in range(i, 3):
            total = 0.0
            for a in range(3):
                for b in range(3):
                    total += m[a, i] * body[a, b] * m[b, j]
            g[i, j] = total
    if force[GM_EARTH] > 0.0:
        _tide_gradient(force[GM_EARTH], frame[9], frame[10], frame[11], y[0], y[1], y[2], g)
    if force[GM_SUN] > 0.0:
        _tide_gradient(force[GM_SUN], frame[12], frame[13], frame[14], y[0], y[1], y[2], g)
    g[1, 0], g[2, 0], g[2, 1] = g[0, 1], g[0, 2], g[1, 2]
    for j in range(6):
        for i in range(3):
            out[6 + 6 * i + j] = y[6 + 6 * (i + 3) + j]
            total = 0.0
            for a in range(3):
                total += g[i, a] * y[6 + 6 * a + j]
            out[6 + 6 * (i + 3) + j] = total


@njit(error_model="numpy", boundscheck=False)
def transition(y0, duration_s, steps, gravity, low, force, table, scratch_size, a, b, c):  # type: ignore[no-untyped-def]
    """Return state and transition matrix (42 numbers) after ``steps`` equal steps of the method's higher order."""
    scratch = np.empty(scratch_size)
    frame = np.empty(COLUMNS)
    stages = len(c)
    k = np.empty((stages, 42))
    work = np.empty(42)
    y = np.zeros(42)
    y[:6] = y0
    for i in range(6):
        y[6 + 7 * i] = 1.0
    h = duration_s / steps
    for number in range(steps):
        t = number * h
        _variational(t, y, gravity, low, force, table, scratch, frame, k[0])
        for i in range(1, stages):
            work[:] = y
            for j in range(i):
                if a[i, j] != 0.0:
                    f = h * a[i, j]
                    for d in range(42):
                        work[d] += f * k[j, d]
            _variational(t + c[i] * h, work, gravity, low, force, table, scratch, frame, k[i])
        for i in range(stages):
            f = h * b[i]
            for d in range(42):
                y[d] += f * k[i, d]
    return y
