"""Keplerian elements and state vectors, both in the same inertial frame, which the caller chooses.

Scenarios give elements in the MCI frame (IAU Moon equator and node of date); `icrf_state_from_elements` converts
them to ICRF.  Elements are osculating: those of the two-body orbit with the same position and velocity.

References
----------
Montenbruck and Gill, Satellite Orbits (2000), sections 2.2.3 and 2.2.4.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import FloatArray
from lunar.errors import OrbitError


@dataclass(frozen=True, slots=True)
class Elements:
    """Classical elements of an ellipse."""

    semi_major_axis_m: float
    eccentricity: float
    inclination_rad: float
    raan_rad: float
    argument_of_perilune_rad: float
    true_anomaly_rad: float


def state_from_elements(elements: Elements, gm_m3_s2: float) -> tuple[FloatArray, FloatArray]:
    """Return position (3,) in m and velocity (3,) in m/s in the frame of the elements.

    Raises
    ------
    OrbitError
        If the elements do not describe an ellipse.
    """
    a, e = elements.semi_major_axis_m, elements.eccentricity
    if not (math.isfinite(a) and a > 0.0 and 0.0 <= e < 1.0 and 0.0 <= elements.inclination_rad <= math.pi):
        raise OrbitError(
            "elements: expected a semi-major axis above 0, an eccentricity from 0 to below 1 and an inclination from 0 "
            f"to 180 deg, found {a / 1e3:g} km, {e:g}, {math.degrees(elements.inclination_rad):g} deg"
        )
    p = a * (1.0 - e * e)
    u = elements.argument_of_perilune_rad + elements.true_anomaly_rad
    node = np.array([math.cos(elements.raan_rad), math.sin(elements.raan_rad), 0.0])
    across = np.array(
        [
            -math.sin(elements.raan_rad) * math.cos(elements.inclination_rad),
            math.cos(elements.raan_rad) * math.cos(elements.inclination_rad),
            math.sin(elements.inclination_rad),
        ]
    )
    radius = p / (1.0 + e * math.cos(elements.true_anomaly_rad))
    speed = math.sqrt(gm_m3_s2 / p)
    omega = elements.argument_of_perilune_rad
    position = radius * (math.cos(u) * node + math.sin(u) * across)
    velocity = speed * (-(math.sin(u) + e * math.sin(omega)) * node + (math.cos(u) + e * math.cos(omega)) * across)
    return position, velocity


def elements_from_state(position_m: ArrayLike, velocity_m_s: ArrayLike, gm_m3_s2: float) -> Elements:
    """Return the osculating elements of a bound state.

    Angles are in 0..2 pi.  The node of an equatorial orbit is along x; the perilune of a circular orbit is at the node.

    Raises
    ------
    OrbitError
        If the state does not describe an ellipse.
    """
    r = np.asarray(position_m, dtype=np.float64)
    v = np.asarray(velocity_m_s, dtype=np.float64)
    radius, h = float(np.linalg.norm(r)), np.cross(r, v)
    energy = 0.5 * float(v @ v) - gm_m3_s2 / radius
    momentum = float(np.linalg.norm(h))
    if not (energy < 0.0 and momentum > 0.0):
        raise OrbitError(
            f"state: expected a bound orbit, found an energy of {energy:g} m2/s2, momentum {momentum:g} m2/s"
        )
    a = -0.5 * gm_m3_s2 / energy
    eccentricity_vector = np.cross(v, h) / gm_m3_s2 - r / radius
    e = float(np.linalg.norm(eccentricity_vector))
    inclination = math.atan2(math.hypot(h[0], h[1]), h[2])
    raan = math.atan2(h[0], -h[1]) if math.hypot(h[0], h[1]) > 1e-12 * momentum else 0.0
    node = np.array([math.cos(raan), math.sin(raan), 0.0])
    across = np.cross(h / momentum, node)
    u = math.atan2(float(r @ across), float(r @ node))
    omega = math.atan2(float(eccentricity_vector @ across), float(eccentricity_vector @ node)) if e > 1e-12 else 0.0
    turn = 2.0 * math.pi
    return Elements(a, e, inclination, raan % turn, omega % turn, (u - omega) % turn)


def icrf_state_from_elements(elements: Elements, tdb_s: float, gm_m3_s2: float) -> tuple[FloatArray, FloatArray]:
    """Return position and velocity along ICRF axes from elements in MCI at ``tdb_s``."""
    from lunar.frames import mci_from_icrf

    icrf_from_mci = np.asarray(mci_from_icrf(tdb_s)).T
    position, velocity = state_from_elements(elements, gm_m3_s2)
    return icrf_from_mci @ position, icrf_from_mci @ velocity


def elements_from_icrf_state(
    position_icrf_m: ArrayLike, velocity_icrf_m_s: ArrayLike, tdb_s: float, gm_m3_s2: float
) -> Elements:
    """Return osculating elements in MCI (Moon's equator and node of date) at ``tdb_s`` of a state along ICRF axes."""
    from lunar.frames import mci_from_icrf

    rotation = np.asarray(mci_from_icrf(tdb_s))
    return elements_from_state(
        rotation @ np.asarray(position_icrf_m), rotation @ np.asarray(velocity_icrf_m_s), gm_m3_s2
    )
