"""Benchmark of gravity kernel and propagation, compared with alternatives: python -m benchmarks orbit.

Rivals in the same run: brahe (Rust) and heyoka's scalar compiled function on the same coefficients and places, and
SciPy's DOP853 over the same right-hand side.
"""

import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks._rows import Row, best_s
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
    ours_us = best_s(lambda: _gravity_kernel.accelerations(packed, positions)) / EVALUATIONS * 1e6
    for name, rival in (("brahe, Clenshaw", _brahe), ("heyoka, scalar cfunc", _heyoka)):
        try:
            evaluate = rival(field)
        except ImportError as missing:
            yield Row(f"acceleration: {missing.name} is not installed", ours_us, "us")
            continue
        difference = float(np.max(np.abs(ours - evaluate(few))) / np.max(np.abs(ours)))
        wrong = f"relative difference {difference:.1e}" if difference > 1e-9 else ""
        theirs_us = best_s(lambda evaluate=evaluate: evaluate(few)) / len(few) * 1e6
        yield Row(f"acceleration, degree {field.degree}", ours_us, "us", name, theirs_us, wrong)


def _brahe(field: GravityField) -> Callable[[np.ndarray], np.ndarray]:
    """brahe reads coefficient files only: the field travels as one, to all digits."""
    import brahe

    degree = field.degree
    rows = [
        f"gfc {n} {m} {float(field.c_bar[n, m])!r} {float(field.s_bar[n, m])!r} 0 0"
        for n in range(degree + 1)
        for m in range(n + 1)
    ]
    head = f"""\
product_type gravity_field
modelname field
earth_gravity_constant {field.gm_m3_s2!r}
radius {field.radius_m!r}
max_degree {degree}
errors formal
norm fully_normalized
tide_system zero_tide
key L M C S sigma_C sigma_S
end_of_head"""
    with tempfile.NamedTemporaryFile("w", suffix=".gfc") as file:
        file.write("\n".join([head, *rows, ""]))
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
        (float(field.c_bar[n, m]), float(field.s_bar[n, m])) for n in range(field.degree + 1) for m in range(n + 1)
    ]
    formula = heyoka.model.sh_gravity_acc(
        list(place), pairs, field.gm_m3_s2, field.radius_m, max_degree=field.degree, max_order=field.degree
    )
    compiled = heyoka.cfunc(formula, list(place), compact_mode=True, batch_size=1)
    return lambda places: np.array([compiled(place) for place in places])


def _propagations(model: ForceModel) -> Iterator[Row]:
    epoch_s = float(tdb_s_from_utc_ns(parse_utc("2029-08-07T00:00:00Z")))
    elements = Elements(1_768_180.0, 0.006908, *np.radians([89.076, 3.164, 333.604, 8.882]))
    state = np.concatenate(icrf_state_from_elements(elements, epoch_s, model.gravity.gm_m3_s2))

    def month() -> None:
        trajectory, _ = propagate_with_maneuvers(epoch_s, state[:3], state[3:], 30 * 86_400.0, model, ManeuverRule())
        trajectory.state(epoch_s + np.arange(0.0, 30 * 86_400.0, 30.0))

    propagate(epoch_s, state[:3], state[3:], 60.0, model)
    yield Row("30 days with burns, a state each 30 s", best_s(month, 2), "s")
    duration_s = SCIPY_DAYS * 86_400.0
    gravity, force, table, scratch = force_arrays(model, epoch_s, 0.0, duration_s)
    work, columns = np.empty(scratch), np.empty(_dynamics_kernel.COLUMNS)

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        a = _dynamics_kernel.force_acceleration(t, y[0], y[1], y[2], gravity, force, table, work, columns)
        return np.array([y[3], y[4], y[5], *a])

    rates(0.0, state)
    scipy_s = best_s(
        lambda: solve_ivp(rates, (0.0, duration_s), state, method="DOP853", rtol=1e-11, atol=1e-6, dense_output=True), 2
    )
    propagate(epoch_s, state[:3], state[3:], 60.0, model)
    ours_s = best_s(lambda: propagate(epoch_s, state[:3], state[3:], duration_s, model), 3)
    yield Row(f"{SCIPY_DAYS * 24:.0f} h", ours_s, "s", "SciPy DOP853, same right-hand side", scipy_s)
