"""Disturbances of the true flight: displacement, burns, outage of the camera."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lunar.arrays import FloatArray
from lunar.constants import NS
from lunar.frames import matrix_from_quaternion, rtn_from_inertial
from lunar.propagation import ForceModel, propagate
from lunar.timescales import tdb_s_from_utc_ns
from payload_emulator.sim.orbit.truth import Truth

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
