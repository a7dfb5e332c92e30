"""Compiled inner loop of the on-board propagator: state, transition matrix and process noise over a short arc.

One arc is at most a minute or so: within it the Moon turns at a constant rate about a fixed axis and the Earth and
the Sun stand still. State: position, velocity (ICRF) and empirical acceleration (radial, transverse, normal), which
decays as a first-order Gauss-Markov process.
"""

import math

import numpy as np

from kernels.compiled import njit
from lunar._gravity_kernel import acceleration as field_acceleration
from lunar._gravity_kernel import acceleration_gradient
from lunar.arrays import FloatArray


@njit(error_model="numpy")
def _rotation(start: FloatArray, turn: FloatArray, fraction: float, out: FloatArray) -> None:
    """Rotation to principal axes at a fraction of the arc: exp(fraction [turn]) start, to third order."""
    a, b, c = turn[0] * fraction, turn[1] * fraction, turn[2] * fraction
    square = a * a + b * b + c * c
    first = 1.0 - square / 6.0
    second = 0.5
    for j in range(3):
        x, y, z = start[0, j], start[1, j], start[2, j]
        # k x column, then k x (k x column), with the sign of a rotation of axes.
        px, py, pz = y * c - z * b, z * a - x * c, x * b - y * a
        qx, qy, qz = py * c - pz * b, pz * a - px * c, px * b - py * a
        out[0, j] = x + first * px + second * qx
        out[1, j] = y + first * py + second * qy
        out[2, j] = z + first * pz + second * qz


@njit(error_model="numpy")
def _tide(x: float, y: float, z: float, body: FloatArray, gm: float) -> tuple[float, float, float]:
    """Acceleration by a distant body relative to that of the Moon's centre (third-body term)."""
    dx, dy, dz = body[0] - x, body[1] - y, body[2] - z
    near = gm / (dx * dx + dy * dy + dz * dz) ** 1.5
    far = gm / (body[0] ** 2 + body[1] ** 2 + body[2] ** 2) ** 1.5
    return near * dx - far * body[0], near * dy - far * body[1], near * dz - far * body[2]


@njit(error_model="numpy")
def _field(
    packed: FloatArray, scratch: FloatArray, rotation: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """Gravity of the Moon in inertial axes."""
    bx = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
    by = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
    bz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
    ax, ay, az = field_acceleration(packed, scratch, bx, by, bz)
    return (
        rotation[0, 0] * ax + rotation[1, 0] * ay + rotation[2, 0] * az,
        rotation[0, 1] * ax + rotation[1, 1] * ay + rotation[2, 1] * az,
        rotation[0, 2] * ax + rotation[1, 2] * ay + rotation[2, 2] * az,
    )


@njit(error_model="numpy")
def _axes(state: FloatArray, out: FloatArray) -> None:
    """Columns radial, transverse, normal of the orbit, in inertial axes."""
    r = math.sqrt(state[0] ** 2 + state[1] ** 2 + state[2] ** 2)
    hx = state[1] * state[5] - state[2] * state[4]
    hy = state[2] * state[3] - state[0] * state[5]
    hz = state[0] * state[4] - state[1] * state[3]
    h = math.sqrt(hx * hx + hy * hy + hz * hz)
    out[0, 0], out[1, 0], out[2, 0] = state[0] / r, state[1] / r, state[2] / r
    out[0, 2], out[1, 2], out[2, 2] = hx / h, hy / h, hz / h
    out[0, 1] = out[1, 2] * out[2, 0] - out[2, 2] * out[1, 0]
    out[1, 1] = out[2, 2] * out[0, 0] - out[0, 2] * out[2, 0]
    out[2, 1] = out[0, 2] * out[1, 0] - out[1, 2] * out[0, 0]


@njit(error_model="numpy")
def _rates(
    state: FloatArray,
    transition: FloatArray,
    decay: float,
    rotation: FloatArray,
    field: FloatArray,
    scratch: FloatArray,
    coarse: FloatArray,
    bodies: FloatArray,
    gms: FloatArray,
    axes: FloatArray,
    gradient: FloatArray,
    rate: FloatArray,
    transition_rate: FloatArray,
) -> None:
    """Time derivatives of state (6) and transition matrix (6, 9); `decay` is that of the empirical acceleration."""
    x, y, z = state[0], state[1], state[2]
    ax, ay, az = _field(field, scratch, rotation, x, y, z)
    for k in range(bodies.shape[0]):
        tx, ty, tz = _tide(x, y, z, bodies[k], gms[k])
        ax, ay, az = ax + tx, ay + ty, az + tz
    _axes(state, axes)
    rate[0], rate[1], rate[2] = state[3], state[4], state[5]
    rate[3], rate[4], rate[5] = ax, ay, az
    for i in range(3):
        for k in range(3):
            rate[3 + i] += decay * axes[i, k] * state[6 + k]
    bx = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
    by = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
    bz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
    xx, xy, xz, yy, yz, zz = acceleration_gradient(coarse, bx, by, bz)
    for i in range(3):
        p, q, r = rotation[0, i], rotation[1, i], rotation[2, i]
        u, v, w = xx * p + xy * q + xz * r, xy * p + yy * q + yz * r, xz * p + yz * q + zz * r
        for j in range(3):
            gradient[j, i] = rotation[0, j] * u + rotation[1, j] * v + rotation[2, j] * w
    for i in range(3):
        for j in range(9):
            transition_rate[i, j] = transition[3 + i, j]
            total = decay * axes[i, j - 6] if j >= 6 else 0.0
            for k in range(3):
                total += gradient[i, k] * transition[k, j]
            transition_rate[3 + i, j] = total


@njit(error_model="numpy")
def _advance(step_matrix: FloatArray, matrix: FloatArray, both_sides: bool, work: FloatArray) -> None:
    """Replace a matrix (9, 9) by step_matrix times it, and by that times the transpose where both sides are asked."""
    for i in range(9):
        for j in range(9):
            total = 0.0
            for k in range(9):
                total += step_matrix[i, k] * matrix[k, j]
            work[i, j] = total
    for i in range(9):
        for j in range(9):
            total = work[i, j]
            if both_sides:
                total = 0.0
                for k in range(9):
                    total += work[i, k] * step_matrix[j, k]
            matrix[i, j] = total


@njit(error_model="numpy")
def _add_noise(
    noise: FloatArray, axes: FloatArray, length_s: float, decay: float, white_psd: FloatArray, markov_sigma: FloatArray
) -> None:
    """Add the process noise of a step: white acceleration integrated twice, and the renewed part of the Markov one."""
    for i in range(3):
        noise[6 + i, 6 + i] += markov_sigma[i] ** 2 * (1.0 - decay * decay)
        for j in range(3):
            density = 0.0
            for k in range(3):
                density += axes[i, k] * white_psd[k] * axes[j, k]
            noise[i, j] += density * length_s**3 / 3.0
            noise[i, 3 + j] += density * length_s**2 / 2.0
            noise[3 + i, j] += density * length_s**2 / 2.0
            noise[3 + i, 3 + j] += density * length_s


@njit(
    error_model="numpy", ahead="f8[::1], f8, i8, f8[:, ::1], *4 * [f8[::1]], f8[:, ::1], f8[::1], f8, f8[::1], f8[::1]"
)
def propagate_arc(
    start: FloatArray,
    duration_s: float,
    steps: int,
    start_rotation: FloatArray,
    turn: FloatArray,
    field: FloatArray,
    scratch: FloatArray,
    coarse: FloatArray,
    bodies: FloatArray,
    gms: FloatArray,
    correlation_s: float,
    white_psd: FloatArray,
    markov_sigma: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return state (9,), transition (9, 9) and process noise (9, 9) at the end of an arc, by fourth-order Runge-Kutta.

    Parameters
    ----------
    start
        Position, velocity, empirical acceleration; m, m/s, m/s^2.
    duration_s, steps
        Length of the arc (may be negative) and number of steps in it.
    start_rotation, turn
        PA from ICRF at the start, and the rotation vector of the axes over the arc in PA, rad.
    field, coarse
        Packed gravity for the motion, and packed gradient of low degree for the transition.
    bodies, gms
        Positions (k, 3) and gravitational parameters of third bodies.
    correlation_s, white_psd, markov_sigma
        Of the empirical acceleration; spectral density (3,) of white acceleration, m^2/s^3, and standard
        deviation (3,) of the Gauss-Markov part, m/s^2; radial, transverse, normal.
    """
    h = duration_s / steps
    y = start.copy()
    noise, total, step_matrix, work = np.zeros((9, 9)), np.zeros((9, 9)), np.zeros((9, 9)), np.zeros((9, 9))
    for i in range(9):
        total[i, i] = 1.0
    rate, trial, summed = np.zeros(9), np.zeros(9), np.zeros(9)
    phi_rate, phi_trial, phi_summed = np.zeros((6, 9)), np.zeros((6, 9)), np.zeros((6, 9))
    axes, gradient, rotation = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    full = math.exp(-abs(h) / correlation_s)
    for n in range(steps):
        summed[:] = 0.0
        phi_summed[:] = 0.0
        rate[:] = 0.0
        phi_rate[:] = 0.0
        for stage in range(4):
            fraction = 0.5 * ((stage + 1) // 2)
            weight = 1.0 / 6.0 if stage == 0 or stage == 3 else 1.0 / 3.0
            for i in range(9):
                trial[i] = y[i] + h * fraction * rate[i]
            for i in range(6):
                for j in range(9):
                    phi_trial[i, j] = h * fraction * phi_rate[i, j]
                phi_trial[i, i] += 1.0
            _rotation(start_rotation, turn, (n + fraction) / steps, rotation)
            _rates(trial, phi_trial, full**fraction, rotation, field, scratch, coarse, bodies, gms,
                   axes, gradient, rate, phi_rate)  # fmt: skip
            for i in range(6):
                summed[i] += weight * rate[i]
                for j in range(9):
                    phi_summed[i, j] += weight * phi_rate[i, j]
        step_matrix[:] = 0.0
        for i in range(6):
            y[i] += h * summed[i]
            for j in range(9):
                step_matrix[i, j] = h * phi_summed[i, j]
            step_matrix[i, i] += 1.0
        for i in range(6, 9):
            y[i] *= full
            step_matrix[i, i] = full
        _advance(step_matrix, total, False, work)
        _advance(step_matrix, noise, True, work)
        _axes(y, axes)
        _add_noise(noise, axes, abs(h), full, white_psd, markov_sigma)
    return y, total, noise
