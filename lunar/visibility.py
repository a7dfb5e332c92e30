"""Visibility: sub-satellite point and ground track, Sun and shadow, the Earth and its stations behind the limb.

Bodies are spheres: the Moon of `MOON_RADIUS_M`, the Sun and the Earth of their mean radii.  Positions are
Moon-centred in ICRF axes unless a name says otherwise; directions to the Sun are geometric (its light is 500
s old, which turns the Moon by 0.08 deg).  Earth orientation takes UT1 = UTC and no polar motion, which moves
a station by up to 420 m.

Every function takes leading dimensions ``(...)``.

References
----------
Montenbruck and Gill 2000, Satellite Orbits, section 3.4.2: conical shadow, overlap of two discs.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.constants import EARTH_RADIUS_M, MOON_RADIUS_M, NS, SPEED_OF_LIGHT_M_S, SUN_RADIUS_M
from lunar.ephemeris import Ephemeris
from lunar.errors import LunarError
from lunar.frames import Orientation, enu_from_mcmf, mcmf_from_spherical, spherical_from_mcmf
from lunar.timescales import TT_MINUS_TAI_NS, tai_ns_from_utc_ns, tdb_s_from_utc_ns


@dataclass(frozen=True, slots=True)
class GroundStation:
    """A station on the Earth: WGS 84 latitude, east longitude, height, and the lowest elevation it can work at."""

    name: str
    latitude_rad: float
    longitude_rad: float
    height_m: float = 0.0
    minimum_elevation_rad: float = math.radians(10.0)


DSN_STATIONS = (
    GroundStation("Goldstone", math.radians(35.4267), math.radians(243.1100), 1000.0),
    GroundStation("Canberra", math.radians(-35.4024), math.radians(148.9813), 690.0),
    GroundStation("Madrid", math.radians(40.4314), math.radians(355.7520), 830.0),
)
"""Sites of the Deep Space Network, to a kilometre (DSN 810-005, module 301); the Moon is always visible from one."""


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """Geometry of a radio link at epochs ``(...)`` of reception on the Earth.

    ``elevation_rad`` is that of the spacecraft over the station's horizon; ``limb_clearance_m`` the height of
    the line of sight over the Moon's sphere, infinite where the spacecraft is on the near side of it.
    """

    visible: BoolArray
    range_m: FloatArray
    light_time_s: FloatArray
    elevation_rad: FloatArray
    limb_clearance_m: FloatArray


def subsatellite(
    position_icrf_m: ArrayLike, tdb_s: ArrayLike, orientation: Orientation
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return latitude, east longitude (-pi..pi) in rad and altitude in m of positions ``(..., 3)``."""
    return spherical_from_mcmf(_rotate(orientation.mcmf_from_icrf(tdb_s), position_icrf_m))


def sun_elevation_azimuth(
    latitude_rad: ArrayLike, longitude_rad: ArrayLike, sun_mcmf_m: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return elevation and azimuth (from north, clockwise, 0..2 pi) in rad of the Sun at places on the sphere."""
    place = mcmf_from_spherical(latitude_rad, longitude_rad)
    enu = _rotate(enu_from_mcmf(latitude_rad, longitude_rad), np.asarray(sun_mcmf_m, dtype=np.float64) - place)
    east, north, up = np.moveaxis(enu, -1, 0)
    azimuth = np.mod(np.arctan2(east, north), 2.0 * math.pi)
    return np.asarray(np.arctan2(up, np.hypot(east, north))), np.asarray(azimuth)


def sunlit_fraction(
    position_icrf_m: ArrayLike, sun_icrf_m: ArrayLike, earth_icrf_m: ArrayLike | None = None
) -> FloatArray:
    """Return the share ``(...)`` of the Sun's disc that a spacecraft sees past the Moon, and past the Earth if given.

    0 in the umbra, 1 in full sunlight.
    """
    position = np.asarray(position_icrf_m, dtype=np.float64)
    to_sun = np.asarray(sun_icrf_m, dtype=np.float64) - position
    fraction = 1.0 - _disc_overlap(to_sun, SUN_RADIUS_M, -position, MOON_RADIUS_M)
    if earth_icrf_m is not None:
        to_earth = np.asarray(earth_icrf_m, dtype=np.float64) - position
        fraction = np.minimum(fraction, 1.0 - _disc_overlap(to_sun, SUN_RADIUS_M, to_earth, EARTH_RADIUS_M))
    return np.asarray(fraction)


def limb_clearance_m(position_icrf_m: ArrayLike, target_icrf_m: ArrayLike) -> FloatArray:
    """Return by how much the line to a target passes over the Moon's sphere; negative where the Moon hides it.

    Infinite where the nearest point of the line to the Moon's centre is the spacecraft itself.
    """
    position = np.asarray(position_icrf_m, dtype=np.float64)
    leg = np.asarray(target_icrf_m, dtype=np.float64) - position
    direction = leg / np.linalg.norm(leg, axis=-1, keepdims=True)
    along = -np.sum(position * direction, axis=-1)
    closest = np.linalg.norm(position + along[..., None] * direction, axis=-1)
    return np.asarray(np.where(along > 0.0, closest - MOON_RADIUS_M, np.inf))


def station_icrf(station: GroundStation, utc_ns: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the Earth-centred position in m and the zenith of a station, each ``(..., 3)`` in ICRF axes."""
    from pymap3d import geodetic2ecef

    turn = np.swapaxes(_itrf_from_icrf(utc_ns), -1, -2)
    fixed = geodetic2ecef(station.latitude_rad, station.longitude_rad, station.height_m, deg=False)
    return _rotate(turn, fixed), _rotate(turn, _zenith(station))


def link(ephemeris: Ephemeris, utc_ns: ArrayLike, station: GroundStation | None = None) -> Link:
    """Return the link from a spacecraft to a station, or to the centre of the Earth, at epochs of reception.

    Both ends are put into the frame that moves with the Earth, whose time UTC keeps: the spacecraft and the
    Moon where they were at emission, the station where it is at reception.

    Raises
    ------
    EphemerisCoverageError
        Where the ephemeris does not reach back to the epochs of emission.
    """
    from lunar.third_bodies import earth_position_icrf_m

    received = np.asarray(utc_ns, dtype=np.int64)
    flat = received.reshape(-1)
    offset, up = 2 * (np.zeros((len(flat), 3)),) if station is None else station_icrf(station, flat)
    light_time_s = np.full(len(flat), 1.28)
    # Each round gains a factor of c / 2 km/s: three leave 1e-11 s.
    for _ in range(3):
        emitted = flat - np.rint(light_time_s * NS).astype(np.int64)
        position, _ = ephemeris.at(emitted)
        receiver = np.asarray(earth_position_icrf_m(tdb_s_from_utc_ns(emitted))) + offset
        leg = position - receiver
        range_m = np.linalg.norm(leg, axis=-1)
        light_time_s = range_m / SPEED_OF_LIGHT_M_S
    clearance = limb_clearance_m(position, receiver)
    visible = clearance > 0.0
    elevation = np.full(len(flat), np.nan)
    if station is not None:
        elevation = np.arcsin(np.clip(np.sum(leg * up, axis=-1) / range_m, -1.0, 1.0))
        visible &= elevation >= station.minimum_elevation_rad
    values = (visible, range_m, light_time_s, elevation, clearance)
    return Link(*(np.asarray(value).reshape(received.shape) for value in values))


def find_windows(
    condition: Callable[[IntArray], BoolArray],
    start_utc_ns: int,
    stop_utc_ns: int,
    step_s: float = 30.0,
    tolerance_s: float = 1.0,
) -> list[tuple[int, int]]:
    """Return the spans in which a condition on epochs (n,) holds, edges found by bisection.

    What lasts less than ``step_s`` may be missed.
    """
    if stop_utc_ns <= start_utc_ns or step_s <= 0.0 or tolerance_s <= 0.0:
        raise LunarError("windows: expected a stop after the start and a step and a tolerance above 0")
    epochs = np.arange(start_utc_ns, stop_utc_ns, round(step_s * NS), dtype=np.int64)
    epochs = np.append(epochs, np.int64(stop_utc_ns))
    held = np.asarray(condition(epochs), dtype=np.bool_)
    changes = np.flatnonzero(held[1:] != held[:-1])
    low, high, before = epochs[changes], epochs[changes + 1], held[changes]
    while len(changes) and np.max(high - low) > tolerance_s * NS:
        middle = low + (high - low) // 2
        same = np.asarray(condition(middle), dtype=np.bool_) == before
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    # Of the two sides of an edge, the one on which the condition holds.
    edges = np.where(before, low, high)
    bounds = [int(epochs[0])] * bool(held[0]) + edges.tolist() + [int(epochs[-1])] * bool(held[-1])
    return list(zip(bounds[::2], bounds[1::2], strict=True))


def _rotate(matrix: FloatArray, vector: ArrayLike) -> FloatArray:
    return np.asarray(np.einsum("...ij,...j->...i", matrix, np.asarray(vector, dtype=np.float64)))


def _disc_overlap(to_far: FloatArray, far_radius_m: float, to_near: FloatArray, near_radius_m: float) -> FloatArray:
    """Return the share of the far body's disc that the near one covers; 0 where the near one is farther away."""
    far_distance = np.linalg.norm(to_far, axis=-1)
    near_distance = np.linalg.norm(to_near, axis=-1)
    a = np.arcsin(np.minimum(far_radius_m / far_distance, 1.0))
    b = np.arcsin(np.minimum(near_radius_m / near_distance, 1.0))
    cross = np.linalg.norm(np.cross(to_far, to_near), axis=-1)
    c = np.arctan2(cross, np.sum(to_far * to_near, axis=-1))
    with np.errstate(invalid="ignore", divide="ignore"):
        x = (c**2 + a**2 - b**2) / (2.0 * c)
        y = np.sqrt(np.maximum(a**2 - x**2, 0.0))
        lens = a**2 * np.arccos(np.clip(x / a, -1, 1)) + b**2 * np.arccos(np.clip((c - x) / b, -1, 1)) - c * y
        share = lens / (math.pi * a**2)
    share = np.where(c >= a + b, 0.0, np.where(c <= b - a, 1.0, np.where(c <= a - b, (b / a) ** 2, share)))
    return np.asarray(np.where(near_distance < far_distance, share, 0.0))


def _zenith(station: GroundStation) -> FloatArray:
    """Return the upward normal of the ellipsoid in Earth-fixed axes, (3,)."""
    cosine = math.cos(station.latitude_rad)
    x, y = math.cos(station.longitude_rad), math.sin(station.longitude_rad)
    return np.array([cosine * x, cosine * y, math.sin(station.latitude_rad)])


def _itrf_from_icrf(utc_ns: ArrayLike) -> FloatArray:
    """Return the terrestrial from celestial rotation ``(..., 3, 3)``, IAU 2006/2000A with UT1 = UTC."""
    import erfa

    utc = np.asarray(utc_ns, dtype=np.int64)
    tt = np.asarray(tai_ns_from_utc_ns(utc)) + TT_MINUS_TAI_NS
    day = 86_400 * NS
    tt_day, tt_rest = np.divmod(tt, day)
    ut_day, ut_rest = np.divmod(utc, day)
    unix_jd = 2_440_587.5
    matrix = erfa.c2t06a(unix_jd + tt_day, tt_rest / day, unix_jd + ut_day, ut_rest / day, 0.0, 0.0)
    return np.asarray(matrix, dtype=np.float64)


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
