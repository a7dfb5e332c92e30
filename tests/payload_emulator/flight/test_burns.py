"""Burns that the payload knows of: the table, and the filter's flight over them."""

from __future__ import annotations

import numpy as np
import pytest

from lunar.frames import IauOrientation
from lunar.gravity import builtin_gravity
from lunar.timescales import parse_utc, tdb_s_from_utc_ns, ticks_from_utc_ns
from payload_emulator.flight.navigation.filter.dynamics import OrbitModel, ProcessNoise, flown
from tests.payload_emulator.flight.test_dynamics import start_state
from tmtc.dictionary.tables import (
    BurnTable,
    GravityTable,
    no_burns,
    pack_burn_table,
    pack_orientation_table,
    unpack_burn_table,
    unpack_orientation_table,
)
from tmtc.errors import TableError

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
