"""The on-board orbit model against the library's integrator, and its transition matrix against differences."""

import numpy as np
from numpy import cos, diag, radians, sin
from numpy.testing import assert_allclose
from pytest import mark
from scipy.spatial.transform import Rotation

from lunar.elements import Elements, icrf_state_from_elements
from lunar.frames import IauOrientation
from lunar.gravity import builtin_gravity
from lunar.gravity_omission import densities_at, field_noise
from lunar.propagation import ForceModel, propagate
from lunar.timescales import parse_utc, tdb_s_from_utc_ns, ticks_from_utc_ns, utc_ns_from_ticks
from payload_emulator.flight.navigation.filter.dynamics import OrbitModel, ProcessNoise, process_noise
from tmtc.dictionary.tables import GravityTable, pack_orientation_table
from tmtc.dictionary.tables import unpack_orientation_table as unpack

EPOCH = parse_utc("2029-08-07T00:00:00Z")
START = int(ticks_from_utc_ns(EPOCH))
MOON = IauOrientation()


def orientation_table():
    ticks = START + np.arange(-5, 8) * 7_200 * 65_536
    tdb_s = tdb_s_from_utc_ns(utc_ns_from_ticks(ticks))
    rotations = MOON.mcmf_from_icrf(tdb_s)
    return unpack(pack_orientation_table(ticks, rotations, MOON.pa_from_icrf(tdb_s[0]) @ rotations[0].T))


def model(noise=None):
    field = builtin_gravity()
    table = GravityTable(field.name, field.gm_m3_s2, field.radius_m, field.c_bar, field.s_bar)
    return OrbitModel(table, orientation_table(), 12, noise or ProcessNoise())


def start_state():
    position, velocity = icrf_state_from_elements(
        Elements(1_768_180.0, 0.006908, *radians([89.076, 3.164, 333.604, 8.882])),
        float(tdb_s_from_utc_ns(EPOCH)),
        builtin_gravity().gm_m3_s2,
    )
    return np.concatenate([position, velocity, np.zeros(3)])


def test_an_orbit_on_board_is_that_of_the_library_to_a_centimetre_and_ends_where_it_began():
    state, epoch_s = start_state(), float(tdb_s_from_utc_ns(EPOCH))
    predicted = model().propagate(state, START, START + 3_600 * 65_536)
    expected = propagate(epoch_s, state[:3], state[3:6], 3_700.0, ForceModel(builtin_gravity(), MOON)).state(
        epoch_s + 3_600.0
    )
    assert_allclose(predicted.state[:3], expected[:3], atol=0.01)
    assert_allclose(predicted.state[3:6], expected[3:], atol=1e-5)
    orbit, state = model(), start_state()
    there = orbit.propagate(state, START, START + 1_800 * 65_536)
    assert_allclose(orbit.propagate(there.state, START + 1_800 * 65_536, START).state[:6], state[:6], atol=1e-3)


@mark.parametrize("axis, step", [(0, 10.0), (2, 10.0), (4, 0.01), (6, 1e-6), (8, 1e-6)])
def test_the_transition_matrix_is_the_derivative_of_the_motion(axis, step):
    orbit, state, change = model(), start_state(), np.zeros(9)
    change[axis] = step
    until = START + 900 * 65_536
    ahead, here, behind = (orbit.propagate(state + k * change, START, until) for k in (1.0, 0.0, -1.0))
    difference = (ahead.state - behind.state) / (2.0 * step)
    column = here.transition[:, axis]
    for part in (slice(3), slice(3, 6)):
        assert_allclose(column[part], difference[part], atol=2e-3 * np.linalg.norm(difference[part]))


def test_white_acceleration_grows_velocity_variance_with_time():
    noise = ProcessNoise((1e-6, 1e-6, 1e-6), (1e-12, 1e-12, 1e-12), 900.0)
    predicted = model(noise).propagate(start_state(), START, START + 60 * 65_536)
    # Over a minute gravity gradient changes this by (60 s x 0.9e-3 rad/s)^2, three parts in a thousand.
    assert_allclose(diag(predicted.noise)[3:6], 60.0 * 1e-6, rtol=0.01)


def test_outside_the_orientation_table_there_is_no_prediction():
    assert model().propagate(start_state(), START, START + 40 * 86_400 * 65_536) is None


def test_less_gravity_on_board_means_more_process_noise():
    densities = [process_noise(degree).white_psd_m2_s3[0] for degree in (8, 20, 50, 70, 100)]
    assert densities == sorted(densities, reverse=True)


@mark.parametrize("field", ["LP165P", "GRGM660PRIM"])
def test_the_filter_and_the_smoother_have_the_same_noise(field):
    rng = np.random.default_rng(4)
    positions = (1_737_400.0 + rng.uniform(5e3, 150e3, 40))[:, None] * np.eye(3)[rng.integers(0, 3, 40)]
    positions = (Rotation.random(40, rng=rng).as_matrix() @ positions[:, :, None])[:, :, 0]
    velocities = 1_650.0 * rng.standard_normal((40, 3))
    flown = model(process_noise(50, field))
    expected = [flown._white_psd(*one) for one in zip(positions, velocities, strict=True)]
    assert_allclose(densities_at(field_noise(field, 50), positions, velocities), expected, rtol=1e-12)


POLAR_M_S = np.array([0.0, 0.0, 1_665.0])


def test_noise_falls_with_altitude_and_differs_by_side():
    orbit = model(ProcessNoise((4e-7, 2e-7, 1e-7), (1e-12,) * 3, 900.0, (9e-7, 9e-7, 9e-7), 8_000.0, 30_000.0))

    def density(altitude_m, longitude_deg):
        radius = 1_737_400.0 + altitude_m
        longitude = radians(longitude_deg)
        return orbit._white_psd(radius * np.array([cos(longitude), sin(longitude), 0.0]), POLAR_M_S)

    assert_allclose(density(30_000.0, 20.0), [4e-7, 2e-7, 1e-7], rtol=1e-9)
    assert_allclose(density(38_000.0, 20.0), np.array([4e-7, 2e-7, 1e-7]) / np.e, rtol=1e-9)
    assert_allclose(density(22_000.0, 104.0), np.array([4e-7, 2e-7, 1e-7]) * np.e, rtol=1e-9)
    assert_allclose(density(60_000.0, 106.0), 9e-7 / np.e, rtol=1e-9)
    # Beyond the altitudes at which it was measured it stays as it is there.
    assert density(2_000.0, 0.0) == density(10_000.0, 0.0)
    assert density(100e3, 180.0) == density(500e3, 180.0)
    flat = model(ProcessNoise((4e-7, 2e-7, 1e-7)))
    assert flat._white_psd(np.array([1_800e3, 0.0, 0.0]), POLAR_M_S) == (4e-7, 2e-7, 1e-7)


@mark.parametrize("inclination_deg", [90.0, 60.0, 120.0, 0.0])
def test_noise_over_the_far_side_grows_with_the_cosine_of_the_inclination(inclination_deg):
    noise = ProcessNoise(
        (4e-7, 2e-7, 1e-7), far_side_psd_m2_s3=(3e-6, 2e-6, 1e-6), far_side_oblique_psd_m2_s3=(8e-6, 0.0, 6e-6)
    )
    inclination = radians(inclination_deg)
    # Over 180 degrees of longitude on the equator, going up: east is -y there.
    velocity = 1_665.0 * np.array([0.0, -cos(inclination), sin(inclination)])
    share = abs(cos(inclination))
    found = model(noise)._white_psd(np.array([-1_768e3, 0.0, 0.0]), velocity)
    assert_allclose(found, [3e-6 + share * 8e-6, 2e-6, 1e-6 + share * 6e-6], rtol=1e-9)
    assert model(noise)._white_psd(np.array([1_768e3, 0.0, 0.0]), velocity) == (4e-7, 2e-7, 1e-7)


def test_the_noise_that_the_filter_adds_is_that_of_its_inclination():
    noise = ProcessNoise(
        (1e-12,) * 3, (1e-12,) * 3, 900.0, far_side_psd_m2_s3=(1e-12,) * 3, far_side_oblique_psd_m2_s3=(2e-6,) * 3
    )  # fmt: skip
    added = []
    for inclination_deg in (90.0, 60.0):
        inclination = radians(inclination_deg)
        rotation = model().mcmf_from_icrf(START)
        velocity = 1_665.0 * np.array([0.0, -cos(inclination), sin(inclination)])
        state = np.concatenate([rotation.T @ [-1_768e3, 0.0, 0.0], rotation.T @ velocity, np.zeros(3)])
        predicted = model(noise).propagate(state, START, START + 60 * 65_536)
        added.append(diag(predicted.noise)[3:6])
    # Half of 2e-6 for a minute at 60 degrees, nothing on a polar orbit.
    assert_allclose(added[1], 60.0 * 1e-6, rtol=0.01)
    assert_allclose(added[0], 0.0, atol=60.0 * 1e-8)
