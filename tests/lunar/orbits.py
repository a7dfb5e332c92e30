"""Circular orbits of the tests of ephemerides."""

import numpy as np

from lunar.constants import NS
from lunar.ephemeris import ephemeris_from_states
from lunar.frames import IauOrientation
from lunar.timescales import parse_utc

START = parse_utc("2029-08-07T00:00:00")
RADIUS_M = 1_768_180.0
RATE_RAD_S = 2 * np.pi / 6672.0
TILTED, POLAR = (0.0, 0.6, 0.8), (0.0, 0.0, 1.0)


def circle(elapsed_s, radius_m=RADIUS_M, node=(1.0, 0.0, 0.0), north=TILTED):
    """Position and velocity so long after the node, in the plane of two unit vectors."""
    angle = (RATE_RAD_S * np.asarray(elapsed_s))[..., None]
    position = radius_m * (np.cos(angle) * node + np.sin(angle) * north)
    return position, radius_m * RATE_RAD_S * (np.cos(angle) * north - np.sin(angle) * node)


def times(elapsed_s):
    return START + np.rint(np.asarray(elapsed_s) * NS).astype(np.int64)


def polar_orbit(hours, step_s=60.0, radius_m=RADIUS_M):
    """Ephemeris over the poles of the Moon, from the equator on."""
    pole = IauOrientation().mcmf_from_icrf(9.34e8)[2]
    node = np.cross([0.0, 0.0, 1.0], pole)
    elapsed = np.arange(0.0, hours * 3600.0 + 1.0, step_s)
    return ephemeris_from_states(times(elapsed), *circle(elapsed, radius_m, node / np.linalg.norm(node), pole))
