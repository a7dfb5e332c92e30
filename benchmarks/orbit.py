"""Benchmark of gravity kernel and propagation, compared with alternatives: python -m benchmarks orbit.

Rivals in the same run: the textbook recursion in numba, brahe (Rust) and heyoka's scalar compiled function on the same
coefficients and places, and SciPy's DOP853 over the same right-hand side.
"""

import math
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks._rows import Row
from kernels.compiled import njit
from lunar import _dynamics_kernel, _gravity_kernel
from lunar.datafolder import default_gravity, default_orientation, find_data
from lunar.elements import Elements, icrf_state_from_elements
from lunar.gravity import GravityField
from lunar.maneuvers import ManeuverRule, propagate_with_maneuvers
from lunar.propagation import ForceModel, force_arrays, propagate
from lunar.timescales import parse_utc, tdb_s_from_utc_ns

DEGREE = 100
EVALUATIONS = 20_000
SCIPY_DAYS = 0.25


@njit
def textbook(c, s, gm, radius, positions, out):
    """Cunningham's recursion as in Montenbruck and Gill, section 3.2.4, order by order, unnormalised coefficients."""
    degree = c.shape[0] - 1
    v = np.zeros((degree + 2, degree + 2))
    w = np.zeros((degree + 2, degree + 2))
    for k in range(positions.shape[0]):
        x, y, z = positions[k]
        r2 = x * x + y * y + z * z
        rho = radius * radius / r2
        x0, y0, z0 = radius * x / r2, radius * y / r2, radius * z / r2
        v[0, 0] = radius / math.sqrt(r2)
        w[0, 0] = 0.0
        for m in range(degree + 2):
            if m > 0:
                v[m, m] = (2 * m - 1) * (x0 * v[m - 1, m - 1] - y0 * w[m - 1, m - 1])
                w[m, m] = (2 * m - 1) * (x0 * w[m - 1, m - 1] + y0 * v[m - 1, m - 1])
            if m <= degree:
                v[m + 1, m] = (2 * m + 1) * z0 * v[m, m]
                w[m + 1, m] = (2 * m + 1) * z0 * w[m, m]
            for n in range(m + 2, degree + 2):
                a, b = (2 * n - 1) / (n - m), (n + m - 1) / (n - m)
                v[n, m] = a * z0 * v[n - 1, m] - b * rho * v[n - 2, m]
                w[n, m] = a * z0 * w[n - 1, m] - b * rho * w[n - 2, m]
        ax = ay = az = 0.0
        for n in range(degree + 1):
            ax -= c[n, 0] * v[n + 1, 1]
            ay -= c[n, 0] * w[n + 1, 1]
            az -= (n + 1) * c[n, 0] * v[n + 1, 0]
            for m in range(1, n + 1):
                f = 0.5 * (n - m + 1) * (n - m + 2)
                cc, ss = c[n, m], s[n, m]
                ax += 0.5 * (-cc * v[n + 1, m + 1] - ss * w[n + 1, m + 1])
                ax += f * (cc * v[n + 1, m - 1] + ss * w[n + 1, m - 1])
                ay += 0.5 * (-cc * w[n + 1, m + 1] + ss * v[n + 1, m + 1])
                ay += f * (-cc * w[n + 1, m - 1] + ss * v[n + 1, m - 1])
                az += (n - m + 1) * (-cc * v[n + 1, m] - ss * w[n + 1, m])
        scale = gm / (radius * radius)
        out[k, 0], out[k, 1], out[k, 2] = scale * ax, scale * ay, scale * az


def rows() -> Iterator[Row]:
    """Yield acceleration and propagation compared with their peers: processor time, best of some rounds."""
    named = os.environ.get("LINNA_DATA")
    data = find_data(Path(named) if named else None)
    field, orientation = default_gravity(data), default_orientation(data)
    field = field.truncated(min(DEGREE, field.degree))
    yield from _kernels(field)
    yield from _propagations(ForceModel(field, orientation, field.degree))


def _kernels(field: GravityField) -> Iterator[Row]:
    positions = np.random.default_rng(1).standard_normal((EVALUATIONS, 3))
    positions *= 1_768_000.0 / np.linalg.norm(positions, axis=1, keepdims=True)
    few = positions[: EVALUATIONS // 10]
    packed = _gravity_kernel.pack(field.c_bar, field.s_bar, field.gm_m3_s2, field.radius_m)
    ours = _gravity_kernel.accelerations(packed, few)
    ours_us = _best(lambda: _gravity_kernel.accelerations(packed, positions)) / EVALUATIONS * 1e6
    for name, rival in (
        ("textbook recursion, numba", _textbook),
        ("brahe, Clenshaw", _brahe),
        ("heyoka, scalar cfunc", _heyoka),
    ):
        try:
            evaluate = rival(field)
        except ImportError as missing:
            yield Row(f"acceleration: {missing.name} is not installed", ours_us, "us")
            continue
        difference = float(np.max(np.abs(ours - evaluate(few))) / np.max(np.abs(ours)))
        wrong = f"relative difference {difference:.1e}" if difference > 1e-9 else ""
        theirs_us = _best(lambda evaluate=evaluate: evaluate(few)) / len(few) * 1e6
        yield Row(f"acceleration, degree {field.degree}", ours_us, "us", name, theirs_us, wrong)


def _textbook(field: GravityField) -> Callable[[np.ndarray], np.ndarray]:
    c, s = _unnormalised(field)

    def evaluate(places: np.ndarray) -> np.ndarray:
        found = np.empty_like(places)
        textbook(c, s, field.gm_m3_s2, field.radius_m, places, found)
        return found

    return evaluate


def _brahe(field: GravityField) -> Callable[[np.ndarray], np.ndarray]:
    """brahe reads coefficient files only: the field travels as one, to all digits."""
    import brahe

    degree = field.degree
    rows = [
        f"gfc {n} {m} {float(field.c_bar[n, m])!r} {float(field.s_bar[n, m])!r} 0 0"
        for n in range(degree + 1)
        for m in range(n + 1)
    ]
    head = (
        "product_type gravity_field",
        "modelname field",
        f"earth_gravity_constant {field.gm_m3_s2!r}",
        f"radius {field.radius_m!r}",
        f"max_degree {degree}",
        "errors formal",
        "norm fully_normalized",
        "tide_system zero_tide",
        "key L M C S sigma_C sigma_S",
        "end_of_head",
    )
    with tempfile.NamedTemporaryFile("w", suffix=".gfc") as file:
        file.write("\n".join([*head, *rows, ""]))
        file.flush()
        model = brahe.GravityModel.from_file(file.name)
    return lambda places: np.array(
        [model.compute_spherical_harmonics_clenshaw(place, degree, degree) for place in places]
    )


def _heyoka(field: GravityField) -> Callable[[np.ndarray], np.ndarray]:
    """heyoka compiles the field into one function; half a minute at degree 100."""
    import heyoka

    place = heyoka.make_vars("x", "y", "z")
    pairs = [
        (float(field.c_bar[n, m]), float(field.s_bar[n, m]))
        for n in range(field.degree + 1)
        for m in range(n + 1)
    ]
    formula = heyoka.model.sh_gravity_acc(
        list(place),
        pairs,
        field.gm_m3_s2,
        field.radius_m,
        max_degree=field.degree,
        max_order=field.degree,
    )
    compiled = heyoka.cfunc(formula, list(place), compact_mode=True, batch_size=1)
    return lambda places: np.array([compiled(place) for place in places])


def _propagations(model: ForceModel) -> Iterator[Row]:
    epoch_s = float(tdb_s_from_utc_ns(parse_utc("2029-08-07T00:00:00Z")))
    elements = Elements(1_768_180.0, 0.006908, *np.radians([89.076, 3.164, 333.604, 8.882]))
    state = np.concatenate(icrf_state_from_elements(elements, epoch_s, model.gravity.gm_m3_s2))

    def month() -> None:
        trajectory, _ = propagate_with_maneuvers(
            epoch_s, state[:3], state[3:], 30 * 86_400.0, model, ManeuverRule()
        )
        trajectory.state(epoch_s + np.arange(0.0, 30 * 86_400.0, 30.0))

    propagate(epoch_s, state[:3], state[3:], 60.0, model)
    yield Row("30 days with burns, a state each 30 s", _best(month, 2), "s")
    duration_s = SCIPY_DAYS * 86_400.0
    gravity, force, table, scratch = force_arrays(model, epoch_s, 0.0, duration_s)
    work, columns = np.empty(scratch), np.empty(_dynamics_kernel.COLUMNS)

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        a = _dynamics_kernel.force_acceleration(t, y[0], y[1], y[2], gravity, force, table, work, columns)
        return np.array([y[3], y[4], y[5], *a])

    rates(0.0, state)
    scipy_s = _best(
        lambda: solve_ivp(
            rates, (0.0, duration_s), state, method="DOP853", rtol=1e-11, atol=1e-6, dense_output=True
        ),
        2,
    )
    propagate(epoch_s, state[:3], state[3:], 60.0, model)
    ours_s = _best(lambda: propagate(epoch_s, state[:3], state[3:], duration_s, model), 3)
    yield Row(f"{SCIPY_DAYS * 24:.0f} h", ours_s, "s", "SciPy DOP853, same right-hand side", scipy_s)


def _unnormalised(field: GravityField) -> tuple[np.ndarray, np.ndarray]:
    n, m = np.meshgrid(np.arange(field.degree + 1), np.arange(field.degree + 1), indexing="ij")
    log_gamma = np.vectorize(math.lgamma)
    with np.errstate(invalid="ignore"):
        ratio = np.exp(0.5 * (log_gamma(np.abs(n - m) + 1.0) - log_gamma(n + m + 1.0)))
    scale = np.where(m <= n, ratio * np.sqrt((2.0 - (m == 0)) * (2 * n + 1)), 0.0)
    return field.c_bar * scale, field.s_bar * scale


def _best(run: Callable[[], object], rounds: int = 5) -> float:
    """Least processor time of several runs after one to warm up, seconds."""
    run()
    times = []
    for _ in range(rounds):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return min(times)
