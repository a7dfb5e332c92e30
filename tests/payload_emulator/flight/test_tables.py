"""On-board tables: what is packed comes back, and nothing damaged is taken for a table."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, raises

from lunar.constants import MOON_RADIUS_M
from tmtc.dictionary.tables import (
    MAP_RADIUS_M,
    CatalogueTable,
    GravityTable,
    InitialState,
    pack_anchor_table,
    pack_catalogue_table,
    pack_gravity_table,
    pack_initial_state,
    pack_orientation_table,
    unpack_anchor_table,
    unpack_catalogue_table,
    unpack_gravity_table,
    unpack_initial_state,
    unpack_orientation_table,
)
from tmtc.errors import TableError


def small_anchor(moon):
    seconds = np.arange(0.0, 1_200.0, 60.0)
    return moon.anchor(seconds)


def catalogue_table(count=50):
    rng = np.random.default_rng(2)
    return CatalogueTable(
        np.arange(count) + 7, rng.uniform(-1.0, 1.0, count), rng.uniform(0.0, 2.0 * np.pi, count),
        rng.uniform(3e3, 30e3, count), rng.uniform(-8e3, 8e3, count), rng.uniform(20.0, 900.0, (count, 3))
    )  # fmt: skip


def test_an_anchor_table_of_60_s_steps_interpolates_to_a_millimetre(moon):
    table = unpack_anchor_table(small_anchor(moon))
    for second in (0.0, 7.5, 333.25, 600.0, 1_100.0):
        ticks = moon.ticks_at(second)
        latitude, longitude, altitude = moon.place(moon.orbit([second])[0])
        sample = table.at(ticks)
        assert sample.latitude_rad * moon.radius_m == approx(latitude * moon.radius_m, abs=1e-3)
        assert sample.longitude_rad * moon.radius_m == approx(longitude * moon.radius_m, abs=1e-3)
        assert table.altitude_m(ticks) == approx(altitude, abs=1e-3)


def test_an_anchor_table_answers_nothing_outside_its_span_or_in_a_gap(moon):
    seconds = np.concatenate([np.arange(0.0, 600.0, 60.0), np.arange(2_000.0, 2_600.0, 60.0)])
    table = unpack_anchor_table(moon.anchor(seconds))
    for second in (-1.0, 1_000.0, 2_600.0):
        assert table.at(moon.ticks_at(second)) is None
        assert np.isnan(table.altitude_m(moon.ticks_at(second)))
    for second in (535.0, 2_003.0):
        _, _, altitude = moon.place(moon.orbit([second])[0])
        # Beside the gap only the nodes of one side serve: less than eight of them, still well below a metre.
        assert table.altitude_m(moon.ticks_at(second)) == approx(altitude, abs=0.1)


def test_the_anchor_table_knows_which_way_a_pass_moves(moon):
    seconds = np.arange(0.0, 6_600.0, 60.0)
    table = unpack_anchor_table(moon.anchor(seconds))
    z = moon.orbit(seconds)[:, 2] / np.linalg.norm(moon.orbit(seconds), axis=1)
    for k in range(2, seconds.size - 2, 7):
        if abs(z[k]) < 0.95:
            sample = table.at(moon.ticks_at(seconds[k]))
            assert sample.direction == np.sign(z[k + 1] - z[k - 1])


def test_a_catalogue_table_comes_back_within_its_quantisation(moon):
    table = catalogue_table()
    octets = pack_catalogue_table(table)
    back = unpack_catalogue_table(octets)
    order = np.argsort(table.latitude_rad)
    assert len(octets) == 20 + 4 + 22 * 50
    assert_array_equal(back.ids, table.ids[order])
    assert_allclose(back.latitude_rad * moon.radius_m, table.latitude_rad[order] * moon.radius_m, atol=2e-3)
    assert_allclose(back.longitude_rad * moon.radius_m, table.longitude_rad[order] * moon.radius_m, atol=2e-3)
    assert_allclose(back.diameter_m, table.diameter_m[order], atol=2.0)
    assert_allclose(back.rim_height_m, table.rim_height_m[order], atol=0.25)
    # Uncertainty is rounded up, never down.
    assert np.all(back.sigma_m >= table.sigma_m[order])
    assert np.all(back.sigma_m <= table.sigma_m[order] + 0.5)


def test_longitudes_on_either_side_of_the_meridian_survive_packing():
    table = catalogue_table(3)
    near = CatalogueTable(
        table.ids, table.latitude_rad, np.array([-1e-12, 2 * np.pi - 1e-12, -3.0]), table.diameter_m,
        table.rim_height_m, table.sigma_m
    )  # fmt: skip
    back = unpack_catalogue_table(pack_catalogue_table(near))
    expected = near.longitude_rad[np.argsort(near.latitude_rad)]
    assert_allclose(np.exp(1j * back.longitude_rad), np.exp(1j * expected), atol=2e-9)


def test_gravity_orientation_and_initial_state_come_back_exactly():
    rng = np.random.default_rng(3)
    lower = np.tril(rng.normal(size=(9, 9)))
    gravity = GravityTable("TEST8", 4.9e12, 1.738e6, lower, 2.0 * lower)
    again = unpack_gravity_table(pack_gravity_table(gravity))
    assert (again.name, again.gm_m3_s2, again.radius_m) == ("TEST8", 4.9e12, 1.738e6)
    assert_array_equal(again.c_bar, lower)
    assert_array_equal(again.s_bar, 2.0 * lower)
    state = InitialState(5, rng.normal(size=3), rng.normal(size=3), 5_000.0, 5.0)
    back = unpack_initial_state(pack_initial_state(state))
    assert_array_equal(back.position_icrf_m, state.position_icrf_m)
    assert_array_equal(back.velocity_icrf_m_s, state.velocity_icrf_m_s)
    assert (back.ticks, back.sigma_position_m, back.sigma_velocity_m_s) == (5, 5_000.0, 5.0)


def test_an_orientation_table_of_two_hour_steps_is_a_rotation_good_to_a_millimetre():
    def matrix(second):
        # A turning Moon with a physical libration of 0.01 rad and 27 days: rates as large as the real ones.
        w, tilt = 2.6617e-6 * second, 0.4 + 1e-2 * np.sin(2.6617e-6 * second)
        rz = np.array([[np.cos(w), np.sin(w), 0], [-np.sin(w), np.cos(w), 0], [0, 0, 1]])
        rx = np.array([[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]])
        return rz @ rx

    seconds = np.arange(-36_000.0, 122_400.0, 7_200.0)
    ticks = np.round(seconds * 65_536).astype(int)
    octets = pack_orientation_table(ticks, [matrix(second) for second in seconds], np.eye(3))
    table = unpack_orientation_table(octets)
    for second in (0.0, 1_234.0, 50_000.0):
        found = table.at(round(second * 65_536))
        assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
        assert_allclose(found * 1.7374e6, matrix(second) * 1.7374e6, atol=1e-3)
    assert table.at(int(ticks[-1]) + 1) is None


def all_tables(moon):
    lower = np.tril(np.ones((4, 4)))
    return [
        (small_anchor(moon), unpack_anchor_table),
        (pack_catalogue_table(catalogue_table()), unpack_catalogue_table),
        (pack_gravity_table(GravityTable("X", 1.0, 1.0, lower, lower)), unpack_gravity_table),
        (pack_orientation_table([0, 10, 20], np.stack([np.eye(3)] * 3), np.eye(3)), unpack_orientation_table),
        (pack_initial_state(InitialState(0, np.ones(3), np.ones(3), 1.0, 1.0)), unpack_initial_state),
    ]


def test_every_table_refuses_truncation_and_every_other_kind(moon):
    packed = all_tables(moon)
    for k, (octets, unpack) in enumerate(packed):
        unpack(octets)
        for length in (0, 7, 19, 20, 24, len(octets) - 1):
            with raises(TableError):
                unpack(octets[:length])
        with raises(TableError):
            unpack(octets + b"\0")
        for j, (other, _) in enumerate(packed):
            if j != k:
                with raises(TableError, match="expected a table of kind"):
                    unpack(other)


@given(data=st.data())
@settings(max_examples=200, deadline=None)
def test_any_flipped_bit_is_refused(moon, data):
    octets, unpack = data.draw(st.sampled_from(all_tables(moon)))
    damaged = bytearray(octets)
    bit = data.draw(st.integers(0, 8 * len(octets) - 1))
    damaged[bit // 8] ^= 1 << (bit % 8)
    with raises(TableError):
        unpack(bytes(damaged))


def test_a_table_with_values_that_are_not_finite_is_refused(moon):
    seconds = np.arange(0.0, 300.0, 60.0)
    positions = moon.orbit(seconds)
    positions[2, 1] = np.nan
    octets = pack_anchor_table([moon.ticks_at(second) for second in seconds], positions)
    with raises(TableError, match="expected finite numbers, value 7 is nan"):
        unpack_anchor_table(octets)
    with raises(TableError, match="strictly increasing"):
        pack_anchor_table([3, 2], np.ones((2, 3)))


def test_heights_refer_to_the_sphere_of_the_maps():
    assert MAP_RADIUS_M == MOON_RADIUS_M
