"""Burns that the payload knows of: the table, and the filter's flight over them."""

from __future__ import annotations

import numpy as np
import pytest

from lunar.frames import IauOrientation
from lunar.gravity import builtin_gravity
from lunar.timescales import parse_utc, tdb_s_from_utc_ns, ticks_from_utc_ns
from payload_emulator.flight.navigation import filter as kalman
from payload_emulator.flight.navigation.dynamics import OrbitModel, ProcessNoise, flown
from tests.payload_emulator.flight.test_dynamics import start_state
from tmtc.errors import TableError
from tmtc.tables import (
    BurnTable,
    GravityTable,
    no_burns,
    pack_burn_table,
    pack_orientation_table,
    unpack_burn_table,
    unpack_orientation_table,
)

EPOCH = parse_utc("2029-08-07T00:00:00Z")
START = int(ticks_from_utc_ns(EPOCH))
SECOND = 65_536
KICK = np.array([1.0, -2.0, 3.0])
TABLE = BurnTable(np.array([START + 600 * SECOND]), KICK[None], np.array([0.05]))


@pytest.fixture(scope="module")
def model() -> OrbitModel:
    hours = EPOCH + np.arange(-8, 9) * 3_600 * 10**9
    moon, field = IauOrientation(), builtin_gravity()
    tdb_s = np.asarray(tdb_s_from_utc_ns(hours), dtype=np.float64)
    rotations = moon.mcmf_from_icrf(tdb_s)
    table = unpack_orientation_table(
        pack_orientation_table(
            np.asarray(ticks_from_utc_ns(hours)), rotations, moon.pa_from_icrf(tdb_s[0]) @ rotations[0].T
        )
    )
    gravity = GravityTable(field.name, field.gm_m3_s2, field.radius_m, field.c_bar, field.s_bar)
    return OrbitModel(gravity, table, 8, ProcessNoise((1e-12,) * 3, (1e-12,) * 3, 900.0))


def test_a_table_of_burns_comes_back_in_order_of_time() -> None:
    two = BurnTable(np.array([START + 9, START]), np.stack([KICK, -KICK]), np.array([0.1, 0.2]))
    found = unpack_burn_table(pack_burn_table(two))
    np.testing.assert_array_equal(found.ticks, [START, START + 9])
    np.testing.assert_array_equal(found.delta_v_icrf_m_s, [-KICK, KICK])
    np.testing.assert_array_equal(found.sigma_m_s, [0.2, 0.1])
    assert len(unpack_burn_table(pack_burn_table(no_burns()))) == 0


@pytest.mark.parametrize(
    "table",
    [
        BurnTable(np.array([START, START]), np.stack([KICK, KICK]), np.array([0.1, 0.1])),
        BurnTable(np.array([START]), KICK[None], np.array([-0.1])),
        BurnTable(np.array([START]), np.full((1, 3), np.nan), np.array([0.1])),
    ],
)
def test_burns_at_one_time_negative_sigmas_and_nan_are_refused(table: BurnTable) -> None:
    with pytest.raises(TableError, match="burn table"):
        unpack_burn_table(pack_burn_table(table))


def test_a_burn_is_flown_at_its_time_and_not_before(model: OrbitModel) -> None:
    state, stop = start_state(), START + 900 * SECOND
    half = model.propagate(state, START, START + 600 * SECOND)
    assert half is not None
    kicked = half.state.copy()
    kicked[3:6] += KICK
    rest = model.propagate(kicked, START + 600 * SECOND, stop)
    assert rest is not None
    found = flown(model, state, START, stop, TABLE)
    assert found is not None
    np.testing.assert_array_equal(found, rest.state)
    before = flown(model, state, START, START + 599 * SECOND, TABLE)
    coasted = flown(model, state, START, START + 599 * SECOND, no_burns())
    np.testing.assert_array_equal(before, coasted)


def test_a_burn_adds_its_change_and_its_own_uncertainty_and_nothing_else() -> None:
    errors = kalman.CommonErrors()
    state = kalman.initial_filter_state(
        START, start_state()[:3], start_state()[3:6], 10.0, 0.01, (1e-9,) * 3, errors
    )
    after = kalman.burn(state, KICK, 0.05)
    np.testing.assert_allclose(after.mean - state.mean, np.r_[0, 0, 0, KICK, np.zeros(12)], atol=1e-12)
    added = after.covariance - state.covariance
    np.testing.assert_allclose(np.diag(added)[3:6], 0.0025, rtol=1e-9)
    added[3:6, 3:6] = 0.0
    assert not np.any(added)


def test_widening_adds_to_place_and_velocity_only() -> None:
    errors = kalman.CommonErrors()
    state = kalman.initial_filter_state(
        START, start_state()[:3], start_state()[3:6], 10.0, 0.01, (1e-9,) * 3, errors
    )
    wide = kalman.widened(state, 1_000.0, 1.0)
    np.testing.assert_allclose(
        np.sqrt(np.diag(wide.covariance)[:6]), [1_000.05] * 3 + [1.00005] * 3, rtol=1e-6
    )
    np.testing.assert_array_equal(wide.mean, state.mean)
    assert np.array_equal(wide.covariance[6:, 6:], state.covariance[6:, 6:])
