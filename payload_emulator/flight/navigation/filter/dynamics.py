"""On-board orbit model: gravity, Earth and Sun, an empirical acceleration, and how much to trust them.

Inertial axes are ICRF, centred on the Moon. Gravity is evaluated in principal axes (PA), which the orientation
table relates to the inertial axes.
"""

from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray
from lunar.constants import GM_EARTH_M3_S2, GM_SUN_M3_S2, MOON_RADIUS_M
from lunar.gravity import GravityField, packed, packed_gradient
from lunar.gravity_omission import FAR_SIDE_COSINE, MEASURED_ALTITUDES_M, REFERENCE_ALTITUDE_M, field_noise
from lunar.third_bodies import earth_position_icrf_m, sun_position_icrf_m
from lunar.timescales import tdb_s_from_utc_ns, utc_ns_from_ticks
from tmtc.dictionary.tables import BurnTable, GravityTable, OrientationTable
from tmtc.packets.pus import TICKS_PER_SECOND

# Arc over which the Moon's rotation rate and the third bodies are held: the Earth moves 60 km of 384,000 in it,
# 4e-9 m/s^2 in its tide.
_ARC_S = 60.0
# RK4 at 5 s differs from 1 s by less than a millimetre over an orbit.
_STEP_S = 5.0
# The gradient of a field of degree 12 is right to a few parts in a thousand at 15 km.
_GRADIENT_DEGREE = 12
# Keeps the cosine of an inclination finite for a state without motion, which is no orbit.
_TINY = 1e-30


@dataclass(frozen=True, slots=True)
class ProcessNoise:
    """Unmodelled accelerations: radial, transverse, normal.

    Attributes
    ----------
    white_psd_m2_s3
        Spectral density of white acceleration: omission and commission errors of the gravity table.
    markov_sigma_m_s2, correlation_s
        First-order Gauss-Markov acceleration: slowly varying errors such as solar radiation pressure.
    far_side_psd_m2_s3
        White acceleration over the far side, for a field that was determined without tracking there; None if the field
        has the same accuracy on both sides.
    far_side_oblique_psd_m2_s3
        Density added to it, multiplied by the cosine of the inclination: errors of a field fitted to polar orbits
        cancel along a meridian and accumulate on an oblique track.
    scale_height_m, far_side_scale_height_m
        Height difference over which the density of each side decreases to 1/e: a field omits the highest degrees, whose
        power decreases by a factor of 50 between 15 and 45 km (degree 100). Densities are those at 30 km; None:
        independent of altitude.
    """

    white_psd_m2_s3: tuple[float, float, float] = (6e-8, 3e-8, 3e-8)
    markov_sigma_m_s2: tuple[float, float, float] = (2e-6, 2e-6, 2e-6)
    correlation_s: float = 900.0
    far_side_psd_m2_s3: tuple[float, float, float] | None = None
    scale_height_m: float | None = None
    far_side_scale_height_m: float | None = None
    far_side_oblique_psd_m2_s3: tuple[float, float, float] = (0.0, 0.0, 0.0)


def process_noise(degree: int, field: str = "") -> ProcessNoise:
    """Return the process noise that goes with a gravity table, by its name, used to a degree."""
    found = field_noise(field, degree)
    same = found.far_psd_m2_s3 == found.near_psd_m2_s3
    return ProcessNoise(
        white_psd_m2_s3=found.near_psd_m2_s3,
        far_side_psd_m2_s3=None if same else found.far_psd_m2_s3,
        scale_height_m=found.near_scale_height_m,
        far_side_scale_height_m=found.far_scale_height_m,
        far_side_oblique_psd_m2_s3=found.far_oblique_psd_m2_s3,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """State (9,) at the end of an arc, transition (9, 9) over it and process noise (9, 9) of it."""

    state: FloatArray
    transition: FloatArray
    noise: FloatArray


class OrbitModel:
    """Propagates position, velocity and empirical acceleration with their transition matrix.

    Parameters
    ----------
    gravity, orientation
        Uploaded tables.
    degree
        Degree to which the gravity table is used.
    noise
        Process noise.
    """

    def __init__(self, gravity: GravityTable, orientation: OrientationTable, degree: int, noise: ProcessNoise) -> None:
        from lunar._gravity_kernel import scratch_size

        used = min(degree, gravity.c_bar.shape[0] - 1)
        field = GravityField(gravity.name, gravity.gm_m3_s2, gravity.radius_m, gravity.c_bar, gravity.s_bar)
        self.degree = used
        self._orientation = orientation
        self._noise = noise
        self._field = packed(field, used)
        self._coarse = packed_gradient(field, min(_GRADIENT_DEGREE, used))
        self._scratch = np.zeros(scratch_size(used))

    def mcmf_from_icrf(self, ticks: int) -> FloatArray | None:
        """Return the rotation to mean-Earth axes, None outside the orientation table."""
        return self._orientation.at(ticks)

    def propagate(self, state: FloatArray, from_ticks: int, to_ticks: int) -> Prediction | None:
        """Return the state (9,) carried from one on-board time to another; None outside the orientation table."""
        from payload_emulator.flight.navigation.filter._dynamics_kernel import propagate_arc

        span = to_ticks - from_ticks
        arcs = max(1, int(np.ceil(abs(span) / (_ARC_S * TICKS_PER_SECOND))))
        edges = [from_ticks + round(span * k / arcs) for k in range(arcs + 1)]
        rotations = [self._orientation.at(ticks) for ticks in edges]
        total, noise = np.eye(9), np.zeros((9, 9))
        for k in range(arcs):
            start, stop = rotations[k], rotations[k + 1]
            if start is None or stop is None:
                return None
            duration_s = (edges[k + 1] - edges[k]) / TICKS_PER_SECOND
            if duration_s == 0.0:
                continue
            state, transition, added = propagate_arc(
                state,
                duration_s,
                max(1, int(np.ceil(abs(duration_s) / _STEP_S))),
                self._orientation.pa_from_mcmf @ start,
                self._orientation.pa_from_mcmf @ _turn(start, stop),
                self._field,
                self._scratch,
                self._coarse,
                _third_bodies((edges[k] + edges[k + 1]) // 2),
                _THIRD_BODY_GMS,
                self._noise.correlation_s,
                np.array(self._white_psd(start @ state[:3], start @ state[3:6])),
                np.array(self._noise.markov_sigma_m_s2),
            )
            total = transition @ total
            noise = transition @ noise @ transition.T + added
        return Prediction(state, total, noise)

    def _white_psd(self, position_mcmf_m: FloatArray, velocity_mcmf_m_s: FloatArray) -> tuple[float, float, float]:
        """Return the spectral density of white acceleration at a place, for an inertial velocity."""
        noise, radius_m = self._noise, float(np.linalg.norm(position_mcmf_m))
        psd, height_m = noise.white_psd_m2_s3, noise.scale_height_m
        if noise.far_side_psd_m2_s3 is not None and position_mcmf_m[0] <= FAR_SIDE_COSINE * radius_m:
            normal = np.cross(position_mcmf_m, velocity_mcmf_m_s)
            cosine = abs(float(normal[2])) / max(float(np.linalg.norm(normal)), _TINY)
            far, oblique = noise.far_side_psd_m2_s3, noise.far_side_oblique_psd_m2_s3
            psd = (far[0] + cosine * oblique[0], far[1] + cosine * oblique[1], far[2] + cosine * oblique[2])
            height_m = noise.far_side_scale_height_m
        if height_m is None:
            return psd
        lowest_m, highest_m = MEASURED_ALTITUDES_M
        altitude_m = min(max(radius_m - MOON_RADIUS_M, lowest_m), highest_m)
        factor = float(np.exp((REFERENCE_ALTITUDE_M - altitude_m) / height_m))
        return factor * psd[0], factor * psd[1], factor * psd[2]


def flown(model: OrbitModel, state: FloatArray, from_ticks: int, to_ticks: int, burns: BurnTable) -> FloatArray | None:
    """Return the state (9,) carried forwards over the planned burns on the way; None outside the orientation table."""
    reached = coasted(model, state, np.zeros((9, 9)), from_ticks, to_ticks, burns)
    return None if reached is None else reached[0]


def coasted(
    model: OrbitModel, state: FloatArray, covariance: FloatArray, from_ticks: int, to_ticks: int, burns: BurnTable
) -> tuple[FloatArray, FloatArray] | None:
    """Return state (9,) and covariance (9, 9) as `flown` does, with the noise of the motion and of the burns."""
    low, high = np.searchsorted(burns.ticks, [from_ticks, to_ticks], side="right")
    stops = [*burns.ticks[low:high].tolist(), to_ticks]
    for number, stop in enumerate(stops):
        reached = model.propagate(state, from_ticks, stop)
        if reached is None:
            return None
        covariance = reached.transition @ covariance @ reached.transition.T + reached.noise
        state, from_ticks = reached.state.copy(), stop
        if number < len(stops) - 1:
            state[3:6] += burns.delta_v_icrf_m_s[low + number]
            covariance[3:6, 3:6] += np.eye(3) * burns.sigma_m_s[low + number] ** 2
    return state, covariance


_THIRD_BODY_GMS = np.array([GM_EARTH_M3_S2, GM_SUN_M3_S2])


def _third_bodies(ticks: int) -> FloatArray:
    tdb_s = float(tdb_s_from_utc_ns(utc_ns_from_ticks(ticks)))
    return np.stack([earth_position_icrf_m(tdb_s), sun_position_icrf_m(tdb_s)])


def _turn(start: FloatArray, stop: FloatArray) -> FloatArray:
    """Return the rotation vector that carries the axes of `start` to those of `stop`, in the axes of `start`.

    The turn over a minute is 1.6e-4 rad: the antisymmetric part is the vector to 1e-12 rad.
    """
    change = stop @ start.T
    return 0.5 * np.array([change[1, 2] - change[2, 1], change[2, 0] - change[0, 2], change[0, 1] - change[1, 0]])
