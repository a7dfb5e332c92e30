"""Light, shadow and links against the Apollo landings, an eclipse catalogue, astropy and geometry by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lunar.constants import ASTRONOMICAL_UNIT_M, EARTH_RADIUS_M, MOON_RADIUS_M, NS, SPEED_OF_LIGHT_M_S, SUN_RADIUS_M
from lunar.ephemeris import ephemeris_from_states
from lunar.errors import EphemerisCoverageError, LunarError
from lunar.frames import IauOrientation, enu_from_mcmf, mcmf_from_spherical
from lunar.third_bodies import earth_position_icrf_m, sun_position_icrf_m
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from lunar.visibility import (
    GroundStation,
    _itrf_from_icrf,
    _zenith,
    find_windows,
    limb_clearance_m,
    link,
    station_icrf,
    subsatellite,
    sun_elevation_azimuth,
    sunlit_fraction,
)
from tests.lunar.orbits import POLAR, START, circle, times

# Orloff 2000, Apollo by the Numbers (NASA SP-2000-4029): touchdown and Sun angle.
# Places: Davies and Colvin 2000.
LANDINGS = """
1969-07-20T20:17:40 0.67408 23.47297 10.8
1969-11-19T06:54:36 -3.01239 -23.42157 5.1
1971-02-05T09:18:13 -3.64530 -17.47136 10.3
1971-07-30T22:16:29 26.13222 3.63386 12.2
1972-12-11T19:54:58 20.19080 30.77168 13.3
"""


@pytest.mark.parametrize("landing", LANDINGS.strip().splitlines())
def test_the_sun_stood_where_the_apollo_crews_found_it(landing):
    landing_utc, *numbers = landing.split()
    latitude_deg, longitude_deg, sun_angle_deg = map(float, numbers)
    tdb_s = tdb_s_from_utc_ns(parse_utc(landing_utc))
    sun_mcmf_m = IauOrientation().mcmf_from_icrf(tdb_s) @ sun_position_icrf_m(tdb_s)
    place = np.radians([latitude_deg, longitude_deg])
    elevation, azimuth = np.degrees(sun_elevation_azimuth(*place, sun_mcmf_m))
    # Sun angles are published to 0.1 deg and were rounded from mission plans: the Sun climbs 0.1 deg in 12 minutes.
    assert elevation == pytest.approx(sun_angle_deg, abs=0.2)
    # They landed in the morning, with the Sun in the east behind them.
    assert azimuth == pytest.approx(90.0, abs=8.0)


def test_the_earth_shadowed_the_moon_when_the_eclipse_catalogue_says():
    # NASA eclipse catalogue, 27 July 2018, UT: P1 17:14:49, U2 19:30:15, greatest 20:21:44, U3 21:13:12, P4 23:28:37.
    # A spacecraft 60 km over the middle of the near side is within 0.25 degrees of the Moon's centre.
    utc_ns = np.array([parse_utc(f"2018-07-27T{clock}") for clock in ("17:00:00", "20:21:44", "23:45:00")])
    tdb_s = tdb_s_from_utc_ns(utc_ns)
    earth, sun = earth_position_icrf_m(tdb_s), sun_position_icrf_m(tdb_s)
    position = 1_797_400.0 * earth / np.linalg.norm(earth, axis=1, keepdims=True)
    assert sunlit_fraction(position, sun, earth).tolist() == [1.0, 0.0, 1.0]
    assert sunlit_fraction(position, sun).tolist() == [1.0] * 3


def test_the_sun_sets_on_a_spacecraft_within_a_penumbra_of_the_suns_width():
    sun = np.array([ASTRONOMICAL_UNIT_M, 0.0, 0.0])
    radius = MOON_RADIUS_M + 30e3
    # Angle from the anti-Sun direction at which the Sun's centre touches the limb; its disc is 9.3 mrad wide.
    edge = math.asin(MOON_RADIUS_M / radius)
    half = SUN_RADIUS_M / ASTRONOMICAL_UNIT_M
    angle = np.array([0.0, edge - 2 * half, edge, edge + 2 * half, math.pi])
    position = radius * np.stack([-np.cos(angle), np.sin(angle), np.zeros(5)], -1)
    fraction = sunlit_fraction(position, sun)
    assert fraction[[0, 1, 3, 4]].tolist() == [0.0, 0.0, 1.0, 1.0]
    # The limb is so large that it halves the disc like a straight edge; its curvature gives a third of a percent.
    assert fraction[2] == pytest.approx(0.5, abs=0.005)


@given(st.floats(0.0, 0.02), st.floats(0.0, 0.01), st.floats(0.001, 0.01))
def test_the_covered_share_of_a_disc_is_that_of_a_fine_grid(apart, near_radius, far_radius):
    # Far body at unit distance 10, near body at 1, so angular radii are asin(R / d).
    to_far = np.array([10.0, 0.0, 0.0])
    to_near = np.array([math.cos(apart), math.sin(apart), 0.0])
    from lunar.visibility import _disc_overlap

    share = _disc_overlap(to_far, 10.0 * math.sin(far_radius), to_near, math.sin(near_radius))
    x, y = np.meshgrid(*[np.linspace(-far_radius, far_radius, 400)] * 2)
    disc = x**2 + y**2 <= far_radius**2
    covered = (x - apart) ** 2 + y**2 <= near_radius**2
    # 126,000 grid points inside the disc; its edge blurs a percent of them.
    assert share == pytest.approx(np.count_nonzero(disc & covered) / np.count_nonzero(disc), abs=0.01)


def test_azimuth_runs_clockwise_from_north():
    place = mcmf_from_spherical(0.3, 0.5)
    east, north, up = enu_from_mcmf(0.3, 0.5)
    for azimuth in (0.0, 0.5, 2.0, 4.0, 6.0):
        sun = place + 1e11 * (math.sin(azimuth) * east + math.cos(azimuth) * north + math.tan(0.2) * up)
        assert sun_elevation_azimuth(0.3, 0.5, sun) == pytest.approx((0.2, azimuth), abs=1e-9)


def test_the_subsatellite_point_undoes_the_orientation():
    tdb_s = tdb_s_from_utc_ns(START + np.arange(3) * 3600 * NS)
    rotation = IauOrientation().mcmf_from_icrf(tdb_s)
    position = np.einsum("nji,nj->ni", rotation, mcmf_from_spherical([0.1, -0.2, 0.3], [1.0, 2.0, -3.0], 20e3))
    latitude, longitude, altitude = subsatellite(position, tdb_s, IauOrientation())
    assert [*latitude, *longitude] == pytest.approx([0.1, -0.2, 0.3, 1.0, 2.0, -3.0])
    assert altitude == pytest.approx(20e3, abs=1e-6)


def test_the_limb_hides_the_earth_on_the_far_side_only():
    earth = np.array([384_400e3, 0.0, 0.0])
    radius = MOON_RADIUS_M + 30e3
    # From 30 km up the horizon dips by acos(R / r) = 10.57 deg, so the Earth is seen to 100.57 deg from below it (less
    # the parallax of the Earth, 0.26 deg).
    dip = math.acos(MOON_RADIUS_M / radius)
    parallax = MOON_RADIUS_M / 384_400e3
    limit = math.pi / 2 + dip - parallax
    for angle, seen in ((0.0, True), (1.5, True), (limit - 1e-3, True), (limit + 1e-3, False), (math.pi, False)):
        position = radius * np.array([math.cos(angle), math.sin(angle), 0.0])
        assert bool(limb_clearance_m(position, earth) > 0.0) is seen
    assert limb_clearance_m([0.0, radius, 0.0], [384_400e3, radius, 0.0]) == np.inf
    assert limb_clearance_m([-1.0, radius, 0.0], [384_400e3, radius, 0.0]) == pytest.approx(30e3)


def orbit(hours=6):
    elapsed = np.arange(0.0, hours * 3600.0, 30.0)
    return ephemeris_from_states(times(elapsed), *circle(elapsed, north=POLAR))


GOLDSTONE = GroundStation("DSS-14", math.radians(35.42590), math.radians(243.11046), 1002.0)


@pytest.mark.filterwarnings("ignore:.*dubious year:erfa.ErfaWarning")
def test_station_and_elevation_are_those_of_astropy():
    from astropy import units as u
    from astropy.coordinates import GCRS, ITRS, AltAz, CartesianRepresentation, EarthLocation
    from astropy.time import Time
    from astropy.utils import iers

    utc_ns = parse_utc("2024-08-07T18:00:00")
    ours, _ = station_icrf(GOLDSTONE, utc_ns)
    place = EarthLocation.from_geodetic(243.11046 * u.deg, 35.42590 * u.deg, 1002.0 * u.m)
    with iers.conf.set_temp("auto_download", False):
        time = Time("2024-08-07T18:00:00", scale="utc")
        theirs = place.get_gcrs_posvel(time)[0].xyz.to_value(u.m)
        # UT1 - UTC is 0.02 s and polar motion 0.3 arcseconds then: 10 m each, here left out.
        assert np.linalg.norm(ours - theirs) < 30.0
        moon = np.array([2.0e8, -2.5e8, 2.0e8])
        seen = ITRS(CartesianRepresentation(moon * u.m), obstime=time)
        direction = seen.transform_to(GCRS(obstime=time)).cartesian.xyz.to_value(u.m)
        local = (moon - place.get_itrs(time).cartesian.xyz.to_value(u.m)) * u.m
        frame = ITRS(CartesianRepresentation(local), obstime=time, location=place)
        elevation = frame.transform_to(AltAz(obstime=time, location=place)).alt.to_value(u.rad)
    leg = direction - theirs
    up = _zenith(GOLDSTONE) @ _itrf_from_icrf(utc_ns)
    # 1e-4 rad is what the Earth turns in 1.4 s.
    assert math.asin(leg @ up / np.linalg.norm(leg)) == pytest.approx(elevation, abs=1e-4)


def test_range_and_light_time_are_those_of_the_signal_that_arrives():
    ephemeris = orbit()
    received = START + np.arange(10, 300, 7) * 60 * NS
    received = received[received < ephemeris.stop_utc_ns]
    found = link(ephemeris, received, GOLDSTONE)
    assert np.allclose(found.range_m, found.light_time_s * SPEED_OF_LIGHT_M_S, rtol=0, atol=1e-3)
    emitted = received - np.rint(found.light_time_s * NS).astype(np.int64)
    position, _ = ephemeris.at(emitted)
    # Geocentric places of the spacecraft at emission and of the station at reception.
    spacecraft = position - earth_position_icrf_m(tdb_s_from_utc_ns(emitted))
    distance = np.linalg.norm(spacecraft - station_icrf(GOLDSTONE, received)[0], axis=1)
    assert np.allclose(found.range_m, distance, rtol=0, atol=1e-3)
    assert np.all((found.light_time_s > 1.15) & (found.light_time_s < 1.37))
    assert np.array_equal(found.visible, (found.limb_clearance_m > 0) & (found.elevation_rad >= math.radians(10)))


def test_the_spacecraft_is_behind_the_moon_about_half_of_a_revolution_that_faces_the_earth():
    ephemeris = orbit(hours=4)
    epochs = ephemeris.utc_ns[2:]
    found = link(ephemeris, epochs)
    assert np.all(np.isnan(found.elevation_rad))
    earth = earth_position_icrf_m(tdb_s_from_utc_ns(epochs))
    geometry = limb_clearance_m(ephemeris.at(epochs)[0], earth) > 0.0
    # Light time shifts the edges by 1.3 s, less than a step.
    assert np.count_nonzero(found.visible != geometry) <= 4
    assert 0.4 < np.mean(found.visible) < 0.75
    windows = find_windows(lambda t: link(ephemeris, t).visible, int(epochs[0]), int(epochs[-1]), 30.0, 0.01)
    assert 2 <= len(windows) <= 4
    for start, stop in windows:
        assert link(ephemeris, start).visible and link(ephemeris, stop).visible
        if stop < epochs[-1]:
            assert not link(ephemeris, stop + 20_000_000).visible


def test_a_link_before_the_ephemeris_starts_is_refused():
    with pytest.raises(EphemerisCoverageError):
        link(orbit(), START)


@pytest.mark.parametrize("shape", [(), (0,), (1,), (2, 3)])
def test_links_keep_leading_dimensions(shape):
    found = link(orbit(), np.full(shape, START + 3600 * NS), GOLDSTONE)
    assert found.visible.shape == found.range_m.shape == found.elevation_rad.shape == shape


def test_windows_are_found_to_the_tolerance_and_may_reach_the_ends():
    edges = (START + np.array([0, 100, 250, 300, 500, 600]) * NS).tolist()
    first, last = edges[0], edges[-1]

    def condition(t):
        return (t < edges[1]) | ((t >= edges[2]) & (t <= edges[3])) | (t > edges[4])

    windows = np.array(find_windows(condition, first, last, 10.0, 1e-6))
    assert windows.shape == (3, 2) and np.max(np.abs(windows.ravel() - edges)) <= 1000
    assert find_windows(lambda t: t < 0, first, last) == []
    assert find_windows(lambda t: t > 0, first, last) == [(first, last)]
    with pytest.raises(LunarError, match="expected a stop after the start"):
        find_windows(condition, last, first)


def test_the_earths_own_disc_hides_the_sun_only_from_behind_it():
    sun = np.array([ASTRONOMICAL_UNIT_M, 0.0, 0.0])
    between = np.array([384_400e3, 0.0, 0.0])
    position = np.array([MOON_RADIUS_M + 30e3, 0.0, 0.0])
    assert EARTH_RADIUS_M / 384_400e3 > SUN_RADIUS_M / ASTRONOMICAL_UNIT_M
    assert sunlit_fraction(position, sun, between) == 0.0
    assert sunlit_fraction(position, sun, -between) == 1.0
