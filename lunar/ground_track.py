"""Ground track of an orbiter over the Moon."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import FloatArray, IntArray
from lunar.constants import NS
from lunar.ephemeris import Ephemeris
from lunar.frames import Orientation
from lunar.timescales import tdb_s_from_utc_ns
from lunar.visibility import subsatellite


@dataclass(frozen=True, slots=True, eq=False)
class GroundTrack:
    """Sub-satellite points at epochs (n,): mean-Earth latitude, east longitude (0..2 pi), altitude over the sphere."""

    utc_ns: IntArray
    latitude_rad: FloatArray
    longitude_rad: FloatArray
    altitude_m: FloatArray


def ground_track(ephemeris: Ephemeris, orientation: Orientation, utc_ns: ArrayLike | None = None) -> GroundTrack:
    """Return the ground track at epochs (n,), or at all states of the ephemeris."""
    epochs = ephemeris.utc_ns if utc_ns is None else np.atleast_1d(np.asarray(utc_ns, dtype=np.int64))
    position_m, _ = ephemeris.at(epochs)
    latitude, longitude, altitude = subsatellite(position_m, tdb_s_from_utc_ns(epochs), orientation)
    return GroundTrack(epochs, latitude, np.mod(longitude, 2.0 * math.pi), altitude)


def even_epochs(ephemeris: Ephemeris, step_s: float) -> IntArray:
    """Return the epochs every ``step_s`` from the start that the ephemeris covers."""
    step_ns = max(round(step_s * NS), 1)
    epochs = np.arange(ephemeris.start_utc_ns, ephemeris.stop_utc_ns + 1, step_ns, dtype=np.int64)
    return np.asarray(epochs[ephemeris.covers(epochs)])
