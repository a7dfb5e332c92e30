"""Where an orbiter was over the Moon, and what that amounts to: altitudes, passes, period, eclipse."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import FloatArray, IntArray
from lunar.constants import MOON_RADIUS_M
from lunar.ephemeris import Ephemeris
from lunar.frames import Orientation
from lunar.timescales import NS, tdb_s_from_utc_ns
from lunar.visibility import subsatellite

PASS_LATITUDE_RAD = math.radians(60.0)


@dataclass(frozen=True, slots=True, eq=False)
class GroundTrack:
    """Sub-satellite points at epochs (n,): mean-Earth latitude, east longitude (0..2 pi), altitude over the sphere."""

    utc_ns: IntArray
    latitude_rad: FloatArray
    longitude_rad: FloatArray
    altitude_m: FloatArray


@dataclass(frozen=True, slots=True)
class TrackStatistics:
    """Figures of a ground track; ``nan`` where it is too short to tell.

    ``share_inside`` is the share of the time spent within 60 degrees of the equator, in ``passes`` unbroken spans.
    """

    states: int
    span_s: float
    altitude_mean_m: float
    altitude_min_m: float
    altitude_max_m: float
    speed_mean_m_s: float
    ground_speed_mean_m_s: float
    period_s: float
    passes: int
    share_inside: float


def ground_track(
    ephemeris: Ephemeris, orientation: Orientation, utc_ns: ArrayLike | None = None
) -> GroundTrack:
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


def track_statistics(ephemeris: Ephemeris, track: GroundTrack) -> TrackStatistics:
    """Return the figures of a track over its own epochs, each counted alike."""
    position_m, velocity_m_s = ephemeris.at(track.utc_ns)
    radius_m = np.linalg.norm(position_m, axis=1)
    rate_rad_s = np.linalg.norm(np.cross(position_m, velocity_m_s), axis=1) / radius_m**2
    inside = np.abs(track.latitude_rad) <= PASS_LATITUDE_RAD
    steps = np.diff(track.utc_ns)
    # A pass ends where the latitude leaves the limits or where the track itself breaks off.
    broken = steps > 10 * np.median(steps) if len(steps) else np.zeros(0, dtype=np.bool_)
    starts = inside[1:] & (~inside[:-1] | broken)
    return TrackStatistics(
        states=len(track.utc_ns),
        span_s=float(track.utc_ns[-1] - track.utc_ns[0]) / NS,
        altitude_mean_m=float(np.mean(track.altitude_m)),
        altitude_min_m=float(np.min(track.altitude_m)),
        altitude_max_m=float(np.max(track.altitude_m)),
        speed_mean_m_s=float(np.mean(np.linalg.norm(velocity_m_s, axis=1))),
        ground_speed_mean_m_s=float(np.mean(rate_rad_s) * MOON_RADIUS_M),
        period_s=_nodal_period_s(track),
        passes=int(np.count_nonzero(starts) + inside[0]),
        share_inside=float(np.mean(inside)),
    )


def _nodal_period_s(track: GroundTrack) -> float:
    """Return the mean time between northward crossings of the equator; nan with fewer than two of them."""
    latitude = track.latitude_rad
    up = np.flatnonzero((latitude[:-1] < 0.0) & (latitude[1:] >= 0.0))
    if len(up) < 2:
        return math.nan
    share = -latitude[up] / (latitude[up + 1] - latitude[up])
    crossing_s = (track.utc_ns[up] - track.utc_ns[0]) / NS + share * (
        track.utc_ns[up + 1] - track.utc_ns[up]
    ) / NS
    intervals = np.diff(crossing_s)
    # A gap in the track swallows revolutions; the median tells which intervals are single ones.
    return float(np.mean(intervals[intervals < 1.5 * np.median(intervals)]))
