"""Rotations against SPICE, pymap3d, ERFA and NAIF; ground tracks, visibility and contacts; data folders."""

import json
import math
from math import cos, pi, radians, sin
from pathlib import Path

import erfa
import numpy as np
import spiceypy
from hypothesis import given
from hypothesis import strategies as st
from numpy import allclose, count_nonzero, exp, eye
from numpy.linalg import norm
from numpy.testing import assert_array_equal
from pytest import approx, fixture, mark, raises

from lunar.constants import ASTRONOMICAL_UNIT_M, EARTH_RADIUS_M, MOON_RADIUS_M, NS, SPEED_OF_LIGHT_M_S, SUN_RADIUS_M
from lunar.datafolder import DataFolder, default_orientation, find_data
from lunar.ephemeris import ephemeris_from_states
from lunar.errors import DataFileError, EphemerisCoverageError, LunarError
from lunar.frames import (
    PA_FROM_ME_DE421,
    IauOrientation,
    continuous_quaternions,
    enu_from_mcmf,
    icrf_from_j2000,
    load_orientation,
    matrix_from_quaternion,
    mci_from_icrf,
    mcmf_from_spherical,
    quaternion_from_matrix,
    rtn_from_inertial,
    spherical_from_mcmf,
)
from lunar.third_bodies import earth_position_icrf_m, sun_position_icrf_m
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from lunar.visibility import (
    GroundStation,
    _itrf_from_icrf,
    _zenith,
    even_epochs,
    find_windows,
    ground_track,
    limb_clearance_m,
    link,
    station_icrf,
    subsatellite,
    sun_elevation_azimuth,
    sunlit_fraction,
)
from tests.lunar.orbits import POLAR, START, circle, polar_orbit, times

SPICE = json.loads(Path(__file__).parents[1].joinpath("references/lunar/spice_moon_rotations.json").read_text())
SPICE_EPOCHS_TDB_S = np.array(SPICE["epochs_tdb_s"])

# The same model in the same arithmetic: 1e-9 rad is 1.7 mm on the ground.
SAME_MODEL_RAD = 1e-9

unit_quaternions = st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: norm(q) > 0.1)
latitudes = st.floats(-np.pi / 2, np.pi / 2)
longitudes = st.floats(-2 * np.pi, 2 * np.pi)


def angle_rad(first, second):
    """Angle of the rotation between matrices (..., 3, 3)."""
    difference = first @ np.swapaxes(second, -1, -2)
    off = difference - np.swapaxes(difference, -1, -2)
    return np.arcsin(np.clip(norm(np.stack([off[..., 2, 1], off[..., 0, 2], off[..., 1, 0]]), axis=0) / 2, 0, 1))


@fixture(scope="module")
def de421(data_path):
    return load_orientation(data_path / "kernels/moon_pa_de421_1900-2050.bpc", data_path / "kernels/moon_080317.tf")


@fixture(scope="module")
def spice_kernels(data_path):
    names = ("pck00010.tpc", "moon_pa_de421_1900-2050.bpc", "moon_080317.tf")
    for name in names:
        spiceypy.furnsh(str(data_path / "kernels" / name))
    yield
    spiceypy.kclear()


def spice_rotations(frame, epochs_tdb_s):
    return np.array([spiceypy.pxform("J2000", frame, epoch) for epoch in epochs_tdb_s])


def test_the_iau_series_is_that_of_spice_at_stored_epochs():
    ours = IauOrientation().mcmf_from_icrf(SPICE_EPOCHS_TDB_S)
    assert np.max(angle_rad(ours, np.array(SPICE["rotations"]["IAU_MOON"]))) < SAME_MODEL_RAD


@mark.real_data
@mark.parametrize("frame", ["IAU_MOON", "MOON_PA", "MOON_ME"])
def test_rotations_are_those_of_spice_with_the_same_kernels(frame, de421, spice_kernels):
    # From 1905 to 2049, both sides of every record edge that falls in between.
    epochs = np.r_[np.linspace(-3.0e9, 1.55e9, 301), de421.start_tdb_s + de421.record_s * np.arange(5000, 5010)]
    ours = {
        "IAU_MOON": IauOrientation().mcmf_from_icrf,
        "MOON_PA": de421.pa_from_icrf,
        "MOON_ME": de421.mcmf_from_icrf,
    }[frame](epochs)
    assert np.max(angle_rad(ours, spice_rotations(frame, epochs))) < SAME_MODEL_RAD


@mark.real_data
def test_the_kernel_file_gives_the_constant_rotation_that_is_built_in(de421):
    assert np.max(np.abs(de421.me_from_pa @ PA_FROM_ME_DE421 - eye(3))) < 1e-15


def test_the_rotation_from_principal_to_mean_earth_axes_is_that_of_naif_and_of_900_m_on_the_ground():
    # moon_080317.tf, "Program output": state of the Earth at 2008 MAR 17 20:10:00, km and km/s.
    earth_me = (379892.825, 33510.118, -12661.5278, 0.0400357582, 0.0117963334, 0.115130508)
    earth_pa = (379908.634, 33385.003, -12516.8859, 0.0399957879, 0.0117833314, 0.115145731)
    apart = np.abs(np.reshape(earth_pa, (2, 3)) @ PA_FROM_ME_DE421 - np.reshape(earth_me, (2, 3)))
    # Positions are printed to 1 m in 380,000 km.
    assert np.all(apart.max(axis=1) < (1e-3, 1e-9))
    # Williams, Boggs, Folkner 2008: 860 m at most on the surface ("about 0.9 km").
    place = mcmf_from_spherical(*np.meshgrid(np.linspace(-1.5, 1.5, 61), np.linspace(0, 6.2, 63)))
    assert 850.0 < norm(place @ PA_FROM_ME_DE421.T - place, axis=-1).max() < 900.0


@mark.real_data
def test_the_iau_series_is_within_two_hundred_metres_of_de421_in_this_century(de421):
    epochs = np.linspace(0.0, 1.55e9, 500)
    apart_m = MOON_RADIUS_M * angle_rad(IauOrientation().mcmf_from_icrf(epochs), de421.mcmf_from_icrf(epochs))
    assert 20.0 < np.median(apart_m) < 150.0
    assert apart_m.max() < 200.0


def test_mci_has_the_iau_pole_and_its_node_on_the_equator_and_the_bias_of_j2000_is_that_of_erfa():
    tdb_s = 934_027_269.183
    mci = mci_from_icrf(tdb_s)
    assert mci.shape == (3, 3)
    assert allclose(mci[2], IauOrientation().mcmf_from_icrf(tdb_s)[2], atol=1e-15)
    assert abs(mci[0, 2]) < 1e-15  # x lies in the equator of ICRF
    assert np.cross([0, 0, 1.0], mci[2]) @ mci[0] > 0.0  # and is the ascending node
    bias, _, _ = erfa.bp06(2_451_545.0, 0.0)
    # ERFA carries second-order terms; they are 1e-13 rad, far below a micrometre on an orbit.
    assert np.max(np.abs(icrf_from_j2000().T - bias)) < 1e-11


@given(latitudes, longitudes)
def test_enu_is_that_of_pymap3d_on_a_sphere(latitude, longitude):
    import pymap3d

    ball = pymap3d.Ellipsoid(MOON_RADIUS_M, MOON_RADIUS_M)
    place = mcmf_from_spherical(latitude, longitude)
    beyond = place + np.array([300.0, -200.0, 500.0])
    theirs = pymap3d.ecef2enu(*beyond, latitude, longitude, 0.0, ell=ball, deg=False)
    assert allclose(enu_from_mcmf(latitude, longitude) @ (beyond - place), np.array(theirs, dtype=float), atol=1e-6)


@given(latitudes, longitudes, st.floats(-1000.0, 100_000.0))
def test_spherical_coordinates_survive_cartesian_and_back(latitude, longitude, altitude_m):
    back = spherical_from_mcmf(mcmf_from_spherical(latitude, longitude, altitude_m))
    assert abs(back[0] - latitude) < 1e-12
    if abs(latitude) < np.pi / 2 - 1e-6:
        assert abs(exp(1j * back[1]) - exp(1j * longitude)) < 1e-9
    assert abs(back[2] - altitude_m) < 1e-8


def test_rtn_of_a_circular_equatorial_orbit_points_out_along_and_north():
    rtn = rtn_from_inertial([[1.0, 0, 0], [0, 2.0, 0]], [[0, 1.0, 0], [-1.0, 0, 0]])
    assert allclose(rtn[0], eye(3))
    assert allclose(rtn[1], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])


@given(unit_quaternions)
def test_quaternions_are_those_of_spice_and_survive_the_matrix(values):
    q = np.array(values) / norm(values)
    matrix = matrix_from_quaternion(q)
    # SPICE q2m: v_out = q v q*, scalar first, as here.
    assert allclose(matrix, spiceypy.q2m(q), atol=1e-14)
    back = quaternion_from_matrix(matrix)
    assert back[0] >= 0.0
    assert min(np.abs(back - q).max(), np.abs(back + q).max()) < 1e-12


def test_half_turns_have_quaternions_too():
    for q in eye(4)[1:]:
        assert allclose(np.abs(quaternion_from_matrix(matrix_from_quaternion(q))), q)


@mark.parametrize("shape", [(), (0,), (1,), (2, 3)])
def test_rotations_keep_leading_dimensions_and_are_orthonormal(shape):
    epochs = np.full(shape, 9.0e8) + np.arange(np.prod(shape, dtype=int)).reshape(shape) * 1e5
    places = np.broadcast_to(np.array([1.0, 2.0, 3.0]), (*shape, 3))
    rotations = [
        IauOrientation().mcmf_from_icrf(epochs),
        IauOrientation().pa_from_icrf(epochs),
        enu_from_mcmf(np.full(shape, 0.3), np.full(shape, 4.0)),
        rtn_from_inertial(places, np.broadcast_to(np.array([-2.0, 1.0, 0.5]), (*shape, 3))),
    ]
    for rotation in rotations:
        assert rotation.shape == (*shape, 3, 3)
        assert allclose(rotation @ np.swapaxes(rotation, -1, -2), eye(3), atol=1e-14)
        assert allclose(np.linalg.det(rotation), 1.0)
    assert quaternion_from_matrix(rotations[0]).shape == (*shape, 4)


@mark.real_data
def test_epochs_outside_the_kernel_are_refused(de421):
    with raises(EphemerisCoverageError, match=r"DE421: expected an epoch within"):
        de421.mcmf_from_icrf([0.0, 2.0e9])


@mark.real_data
@mark.parametrize("kept", [0, 500, 3000, 1_000_000])
def test_a_kernel_cut_short_is_refused_with_its_name(data_path, tmp_path, kept):
    octets = (data_path / "kernels/moon_pa_de421_1900-2050.bpc").read_bytes()
    path = tmp_path / "cut.bpc"
    path.write_bytes(octets[:kept])
    with raises(DataFileError, match=r"cut\.bpc.*expected.*found"):
        load_orientation(path)


def test_a_file_of_another_kind_and_a_missing_one_are_refused(tmp_path):
    other = tmp_path / "other.bpc"
    other.write_bytes(b"DAF/SPK " + bytes(5000))
    for path in (other, tmp_path / "none.bpc"):
        with raises(DataFileError, match="expected a binary PCK kernel"):
            load_orientation(path)


@mark.real_data
def test_a_frame_kernel_without_the_mean_earth_frame_is_refused(data_path, tmp_path):
    path = tmp_path / "wrong.tf"
    path.write_text("KPL/FK\n\\begindata\nFRAME_31006_NAME = 'MOON_PA_DE421'\n\\begintext\n")
    with raises(DataFileError, match="three angles of a mean-Earth frame"):
        load_orientation(data_path / "kernels/moon_pa_de421_1900-2050.bpc", path)


@mark.parametrize("count", [0, 1, 40])
def test_signs_of_successive_quaternions_do_not_flip(count):
    angle = 0.3 * np.arange(count)
    smooth = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle, 0.0 * angle], axis=1)
    flipped = smooth * np.where(np.arange(count) % 3 == 1, -1.0, 1.0)[:, None]
    assert_array_equal(continuous_quaternions(flipped), smooth)


@fixture(scope="module")
def day():
    """A circular polar orbit of the paper's semi-major axis, one day in 15 s steps."""
    return polar_orbit(23.999, 15.0)


def test_a_pass_within_sixty_degrees_lasts_37_minutes_and_epochs_can_be_chosen(day):
    track = ground_track(day, IauOrientation())
    inside = np.abs(track.latitude_rad) <= radians(60)
    edges = np.flatnonzero(np.diff(inside.astype(int)))
    assert np.mean(np.diff(edges)[int(inside[edges[0]]) :: 2] * 15.0 / 60.0) == approx(111.20 / 3, abs=0.1)
    epochs = even_epochs(day, 60.0)
    assert np.all(np.diff(epochs) == 60 * NS)
    track = ground_track(day, IauOrientation(), epochs)
    assert len(track.utc_ns) == 1440
    assert np.all((track.longitude_rad >= 0.0) & (track.longitude_rad < 2 * np.pi))


def test_without_a_folder_nothing_is_found_and_the_iau_series_is_used():
    data = find_data(None)
    assert data == DataFolder() and data.names() == ()
    assert default_orientation(data).name == "IAU WGCCRE 2009"


def test_an_empty_folder_holds_nothing_and_what_is_no_folder_is_refused(tmp_path):
    data = find_data(tmp_path)
    assert (data.root, data.names()) == (tmp_path, ())
    (tmp_path / "file").write_text("")
    for name in ("absent", "file"):
        with raises(DataFileError, match="expected a data folder"):
            find_data(tmp_path / name)


@mark.real_data
def test_the_whole_data_folder_is_recognised(data_path):
    data = find_data(data_path)
    missing = [name for name in DataFolder.__slots__ if not getattr(data, name)]
    # What `linna data fetch` adds: a finer height model and a calibrated albedo.
    assert missing == ["dem_sldem", "albedo_tiles"]
    assert len(data.names()) == 10
    assert default_orientation(data).name == "DE421"
    assert len(data.dem_tiles) == len(list((data_path / "dem").glob("*ppd_*E_*.jp2")))


def test_heights_and_craters_of_a_user_are_named_by_their_files(tmp_path):
    for name in ("dem/own-pole.tif", "craters/own.csv"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    assert find_data(tmp_path).names() == ("crater catalogue own.csv", "own heights own-pole.tif")


# Orloff 2000, Apollo by the Numbers (NASA SP-2000-4029): touchdown and Sun angle.
# Places: Davies and Colvin 2000.
LANDINGS = """
1969-07-20T20:17:40 0.67408 23.47297 10.8
1969-11-19T06:54:36 -3.01239 -23.42157 5.1
1971-02-05T09:18:13 -3.64530 -17.47136 10.3
1971-07-30T22:16:29 26.13222 3.63386 12.2
1972-12-11T19:54:58 20.19080 30.77168 13.3
"""


@mark.parametrize("landing", LANDINGS.strip().splitlines())
def test_the_sun_stood_where_the_apollo_crews_found_it(landing):
    landing_utc, *numbers = landing.split()
    latitude_deg, longitude_deg, sun_angle_deg = map(float, numbers)
    tdb_s = tdb_s_from_utc_ns(parse_utc(landing_utc))
    sun_mcmf_m = IauOrientation().mcmf_from_icrf(tdb_s) @ sun_position_icrf_m(tdb_s)
    elevation, azimuth = np.degrees(sun_elevation_azimuth(*np.radians([latitude_deg, longitude_deg]), sun_mcmf_m))
    # Sun angles are published to 0.1 deg and were rounded from mission plans: the Sun climbs 0.1 deg in 12 minutes.
    assert elevation == approx(sun_angle_deg, abs=0.2)
    # They landed in the morning, with the Sun in the east behind them.
    assert azimuth == approx(90.0, abs=8.0)


def test_the_earth_shadowed_the_moon_when_the_eclipse_catalogue_says():
    # NASA eclipse catalogue, 27 July 2018, UT: P1 17:14:49, U2 19:30:15, greatest 20:21:44, U3 21:13:12, P4 23:28:37.
    # A spacecraft 60 km over the middle of the near side is within 0.25 degrees of the Moon's centre.
    utc_ns = np.array([parse_utc(f"2018-07-27T{clock}") for clock in ("17:00:00", "20:21:44", "23:45:00")])
    tdb_s = tdb_s_from_utc_ns(utc_ns)
    earth, sun = earth_position_icrf_m(tdb_s), sun_position_icrf_m(tdb_s)
    position = 1_797_400.0 * earth / norm(earth, axis=1, keepdims=True)
    assert sunlit_fraction(position, sun, earth).tolist() == [1.0, 0.0, 1.0]
    assert sunlit_fraction(position, sun).tolist() == [1.0] * 3


def test_the_sun_sets_on_a_spacecraft_within_a_penumbra_of_the_suns_width():
    sun = np.array([ASTRONOMICAL_UNIT_M, 0.0, 0.0])
    radius = MOON_RADIUS_M + 30e3
    # Angle from the anti-Sun direction at which the Sun's centre touches the limb; its disc is 9.3 mrad wide.
    edge = math.asin(MOON_RADIUS_M / radius)
    half = SUN_RADIUS_M / ASTRONOMICAL_UNIT_M
    angle = np.array([0.0, edge - 2 * half, edge, edge + 2 * half, pi])
    fraction = sunlit_fraction(radius * np.stack([-np.cos(angle), np.sin(angle), np.zeros(5)], -1), sun)
    assert fraction[[0, 1, 3, 4]].tolist() == [0.0, 0.0, 1.0, 1.0]
    # The limb is so large that it halves the disc like a straight edge; its curvature gives a third of a percent.
    assert fraction[2] == approx(0.5, abs=0.005)


@given(st.floats(0.0, 0.02), st.floats(0.0, 0.01), st.floats(0.001, 0.01))
def test_the_covered_share_of_a_disc_is_that_of_a_fine_grid(apart, near_radius, far_radius):
    # Far body at unit distance 10, near body at 1, so angular radii are asin(R / d).
    to_far = np.array([10.0, 0.0, 0.0])
    to_near = np.array([cos(apart), sin(apart), 0.0])
    from lunar.visibility import _disc_overlap

    share = _disc_overlap(to_far, 10.0 * sin(far_radius), to_near, sin(near_radius))
    x, y = np.meshgrid(*[np.linspace(-far_radius, far_radius, 400)] * 2)
    disc = x**2 + y**2 <= far_radius**2
    covered = (x - apart) ** 2 + y**2 <= near_radius**2
    # 126,000 grid points inside the disc; its edge blurs a percent of them.
    assert share == approx(count_nonzero(disc & covered) / count_nonzero(disc), abs=0.01)


def test_azimuth_runs_clockwise_from_north_and_the_subsatellite_point_undoes_the_orientation():
    place = mcmf_from_spherical(0.3, 0.5)
    east, north, up = enu_from_mcmf(0.3, 0.5)
    for azimuth in (0.0, 0.5, 2.0, 4.0, 6.0):
        sun = place + 1e11 * (sin(azimuth) * east + cos(azimuth) * north + math.tan(0.2) * up)
        assert sun_elevation_azimuth(0.3, 0.5, sun) == approx((0.2, azimuth), abs=1e-9)
    tdb_s = tdb_s_from_utc_ns(START + np.arange(3) * 3600 * NS)
    rotation = IauOrientation().mcmf_from_icrf(tdb_s)
    position = np.einsum("nji,nj->ni", rotation, mcmf_from_spherical([0.1, -0.2, 0.3], [1.0, 2.0, -3.0], 20e3))
    latitude, longitude, altitude = subsatellite(position, tdb_s, IauOrientation())
    assert [*latitude, *longitude] == approx([0.1, -0.2, 0.3, 1.0, 2.0, -3.0])
    assert altitude == approx(20e3, abs=1e-6)


def test_the_limb_hides_the_earth_on_the_far_side_only():
    earth = np.array([384_400e3, 0.0, 0.0])
    radius = MOON_RADIUS_M + 30e3
    # From 30 km up the horizon dips by acos(R / r) = 10.57 deg, so the Earth is seen to 100.57 deg from below it (less
    # the parallax of the Earth, 0.26 deg).
    dip = math.acos(MOON_RADIUS_M / radius)
    parallax = MOON_RADIUS_M / 384_400e3
    limit = pi / 2 + dip - parallax
    for angle, seen in ((0.0, True), (1.5, True), (limit - 1e-3, True), (limit + 1e-3, False), (pi, False)):
        assert bool(limb_clearance_m(radius * np.array([cos(angle), sin(angle), 0.0]), earth) > 0.0) is seen
    assert limb_clearance_m([0.0, radius, 0.0], [384_400e3, radius, 0.0]) == np.inf
    assert limb_clearance_m([-1.0, radius, 0.0], [384_400e3, radius, 0.0]) == approx(30e3)


def orbit(hours=6):
    elapsed = np.arange(0.0, hours * 3600.0, 30.0)
    return ephemeris_from_states(times(elapsed), *circle(elapsed, north=POLAR))


GOLDSTONE = GroundStation("DSS-14", radians(35.42590), radians(243.11046), 1002.0)


@mark.filterwarnings("ignore:.*dubious year:erfa.ErfaWarning")
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
        assert norm(ours - theirs) < 30.0
        moon = np.array([2.0e8, -2.5e8, 2.0e8])
        seen = ITRS(CartesianRepresentation(moon * u.m), obstime=time)
        direction = seen.transform_to(GCRS(obstime=time)).cartesian.xyz.to_value(u.m)
        local = (moon - place.get_itrs(time).cartesian.xyz.to_value(u.m)) * u.m
        frame = ITRS(CartesianRepresentation(local), obstime=time, location=place)
        elevation = frame.transform_to(AltAz(obstime=time, location=place)).alt.to_value(u.rad)
    leg = direction - theirs
    up = _zenith(GOLDSTONE) @ _itrf_from_icrf(utc_ns)
    # 1e-4 rad is what the Earth turns in 1.4 s.
    assert math.asin(leg @ up / norm(leg)) == approx(elevation, abs=1e-4)


def test_range_and_light_time_are_those_of_the_signal_that_arrives():
    ephemeris = orbit()
    received = START + np.arange(10, 300, 7) * 60 * NS
    received = received[received < ephemeris.stop_utc_ns]
    found = link(ephemeris, received, GOLDSTONE)
    assert allclose(found.range_m, found.light_time_s * SPEED_OF_LIGHT_M_S, rtol=0, atol=1e-3)
    emitted = received - np.rint(found.light_time_s * NS).astype(np.int64)
    position, _ = ephemeris.at(emitted)
    # Geocentric places of the spacecraft at emission and of the station at reception.
    spacecraft = position - earth_position_icrf_m(tdb_s_from_utc_ns(emitted))
    distance = norm(spacecraft - station_icrf(GOLDSTONE, received)[0], axis=1)
    assert allclose(found.range_m, distance, rtol=0, atol=1e-3)
    assert np.all((found.light_time_s > 1.15) & (found.light_time_s < 1.37))
    assert np.array_equal(found.visible, (found.limb_clearance_m > 0) & (found.elevation_rad >= radians(10)))


def test_the_spacecraft_is_behind_the_moon_about_half_of_a_revolution_that_faces_the_earth():
    ephemeris = orbit(hours=4)
    epochs = ephemeris.utc_ns[2:]
    found = link(ephemeris, epochs)
    assert np.all(np.isnan(found.elevation_rad))
    earth = earth_position_icrf_m(tdb_s_from_utc_ns(epochs))
    geometry = limb_clearance_m(ephemeris.at(epochs)[0], earth) > 0.0
    # Light time shifts the edges by 1.3 s, less than a step.
    assert count_nonzero(found.visible != geometry) <= 4
    assert 0.4 < np.mean(found.visible) < 0.75
    windows = find_windows(lambda t: link(ephemeris, t).visible, int(epochs[0]), int(epochs[-1]), 30.0, 0.01)
    assert 2 <= len(windows) <= 4
    for start, stop in windows:
        assert link(ephemeris, start).visible and link(ephemeris, stop).visible
        if stop < epochs[-1]:
            assert not link(ephemeris, stop + 20_000_000).visible


def test_a_link_before_the_ephemeris_starts_is_refused():
    with raises(EphemerisCoverageError):
        link(orbit(), START)


@mark.parametrize("shape", [(), (0,), (1,), (2, 3)])
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
    with raises(LunarError, match="expected a stop after the start"):
        find_windows(condition, last, first)


def test_the_earths_own_disc_hides_the_sun_only_from_behind_it():
    sun = np.array([ASTRONOMICAL_UNIT_M, 0.0, 0.0])
    between = np.array([384_400e3, 0.0, 0.0])
    position = np.array([MOON_RADIUS_M + 30e3, 0.0, 0.0])
    assert EARTH_RADIUS_M / 384_400e3 > SUN_RADIUS_M / ASTRONOMICAL_UNIT_M
    assert sunlit_fraction(position, sun, between) == 0.0
    assert sunlit_fraction(position, sun, -between) == 1.0
