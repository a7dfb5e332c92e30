"""Forecast of a plan: conditions, resources, conflicts; choice of windows within the resources."""

import itertools
import math
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from pytest import approx, fixture, mark, raises

from ground_service.access.model import AuditFilter
from ground_service.access.store import list_audit
from ground_service.errors import Conflict, InvalidInput, NotFound
from ground_service.missions.catalogues import add_catalogue, withdraw_catalogue
from ground_service.missions.service import add_mission
from ground_service.planning import forecast, service
from ground_service.planning.filling import Option, ResourceGrid, choose, curves, take_in_order, violation
from ground_service.planning.model import WindowEntry, WindowSearch
from ground_service.planning.service import search_windows
from ground_service.planning.store import get_window
from lunar.catalogue import CraterCatalogue, save_catalogue
from lunar.constants import NS
from lunar.timescales import parse_utc
from tests.ground_service.conftest import add_reference

START = parse_utc("2029-08-07T06:00:00Z")
MISSION = """name = "small"
[spacecraft]
id = 76
[camera]
fov_deg = 120.0
[resources]
battery_wh = 20.0
generation_w = 0.0
idle_w = 6.0
observing_w = 60.0
minimum_battery = 0.5
storage_mib = 1.0
downlink_kbit_s = 8.0
{catalogue}"""


def test_curves_fill_and_empty_battery_and_storage():
    grid = ResourceGrid(
        start_utc_ns=0, step_s=3600.0, gain_wh=np.array([1.0, -2.0, -2.0, 5.0]),
        downlink_octets=np.array([0.0, 30.0, 30.0, 100.0]), battery_wh=10.0, floor_wh=0.0, observing_w=3.0,
        storage_octets=1000.0,
    )  # fmt: skip
    found = curves(grid, [Option(3600 * NS, 2 * 3600 * NS, 50)])  # in the second hour
    assert found.battery_wh.tolist() == [10.0, 5.0, 3.0, 8.0]  # full; -2 - 3; -2; +5
    assert found.stored_octets.tolist() == [0.0, 50.0, 20.0, 0.0]
    assert found.sent_octets.tolist() == [0.0, 0.0, 30.0, 20.0]
    empty = curves(grid, [Option(3600 * NS, 3 * 3600 * NS, 0), Option(3600 * NS, 3 * 3600 * NS, 0)])
    assert empty.battery_wh.tolist() == [10.0, 2.0, 0.0, 5.0]  # not below empty


@fixture
def planned(ground, synthetic_pass):
    """A service with an ephemeris of half an hour and a mission of small resources."""
    add_mission(ground, MISSION.format(catalogue="").encode(), actor="ann")
    add_reference(ground, synthetic_pass.folder / "reference.oem")
    return ground


def enter(ground, start_s, stop_s):
    start, stop = (START + round(one * NS) for one in (start_s, stop_s))
    return service.add_window(ground, WindowEntry("w", start, stop, 15.0, 76), actor="ann").id


def shown(ground, start_s=0.0, stop_s=600.0):
    start, stop = (START + round(one * NS) for one in (start_s, stop_s))
    return forecast.get_forecast(ground, spacecraft_id=76, instance="flight", start_utc_ns=start, stop_utc_ns=stop)


def test_a_forecast_has_the_conditions_of_the_ephemeris_and_the_resources_of_the_mission(planned):
    found = shown(planned)
    assert found.step_s == 60.0 and len(found.time_s) == 10
    assert found.time_s[0] == START / NS + 30.0
    for name in "latitude_deg", "sunlit", "battery_share", "stored_octets", "sent_octets", "downlink_octets":
        assert len(getattr(found, name)) == 10
    assert found.altitude_km == approx([30.0] * 10, abs=0.1)
    assert found.battery_floor == 0.5 and found.storage_octets == 1 << 20
    # 6 W of 20 Wh from where the ephemeris begins, ten minutes before.
    hours = (10 + np.arange(1, 11)) / 60.0
    assert found.battery_share == approx((1.0 - 6.0 * hours / 20.0).tolist(), abs=2e-3)
    assert found.conflicts == [] and found.reason is None


def test_conflicts_of_drafts_are_explained(planned):
    first, second = enter(planned, 0, 60), enter(planned, 30, 120)
    both = {one.window_id: one.reasons for one in shown(planned).conflicts}
    assert both == {
        first: [f"window {second} (w, draft) covers part of the same time"],
        second: [f"window {first} (w, draft) covers part of the same time"],
    }
    long = enter(planned, 120, 600)  # 9 Wh with the first, and 2 Wh of idle load: 9 of 20 Wh are left
    reasons = {one.window_id: one.reasons for one in shown(planned).conflicts}[long]
    assert len(reasons) == 1 and reasons[0].startswith("the battery would fall to 4")
    assert reasons[0].endswith(" %, expected 50 % or more")


def test_windows_lower_the_battery_and_fill_the_storage(planned):
    before = shown(planned)
    octets = planned.read(get_window, enter(planned, 60, 180)).data_octets
    after = shown(planned)
    drop = np.array(before.battery_share) - np.array(after.battery_share)
    assert drop.tolist() == approx([0.0, 0.05] + [0.1] * 8, abs=2e-3)  # 60 W for two minutes of 20 Wh
    # Half of the data come in each minute; a contact takes them in the next one.
    assert after.stored_octets[:4] == approx([0, octets / 2, octets / 2, 0], abs=1)
    assert after.assumed == []
    assert sum(after.sent_octets) <= octets


def test_an_interval_without_an_ephemeris_states_the_reason(planned):
    later = shown(planned, 86_400.0, 90_000.0)
    assert later.time_s == [] and later.reason == "no reference ephemeris covers the interval"
    partly = shown(planned, 0.0, 86_400.0)
    assert 0 < len(partly.time_s) < 86_400 / 60 and "ephemeris reference covers" in (partly.reason or "")


@mark.parametrize("stop_s", [0.0, -5.0, 8.1 * 86_400])
def test_an_empty_or_too_long_interval_is_an_error(planned, stop_s):
    with raises(InvalidInput, match="at most 8 days"):
        shown(planned, 0.0, stop_s)


def test_craters_are_counted_by_area_and_searched_for(planned, tmp_path):
    degrees = np.array([[1.0, 1.0, 6.0], [5.0, 9.0, 8.0], [85.0, -5.0, 7.0], [5.0, 5.0, 60.0]])
    ids, radians = np.arange(4), np.radians(degrees[:, :2])
    catalogue = CraterCatalogue(
        ids=ids, latitude_rad=radians[:, 0], longitude_rad=radians[:, 1], diameter_m=1e3 * degrees[:, 2],
        rim_height_m=np.zeros(4), depth_m=np.full(4, np.nan), complete=np.ones(4, dtype=np.bool_), source="four",
    )  # fmt: skip
    save_catalogue(catalogue, tmp_path / "four.csv")
    stored = planned.files.put_file(tmp_path / "four.csv")
    add_catalogue(planned, stored, "four.csv")
    text = MISSION.format(catalogue=f'[catalogue]\nsource = "four"\nsha256 = "{stored.sha256}"\n')
    add_mission(planned, text.encode(), actor="ann")
    searched = search_windows(planned, WindowSearch(craters_per_frame=0.0, spacecraft_id=76))
    assert "crater catalogue four" in searched.data
    found = forecast.crater_density(planned, 76)
    assert found.source == "four" and found.reason is None
    rows = np.array(found.rows)
    assert rows.shape == (18, 36) and np.count_nonzero(rows) == 2
    cell_km2 = 1737.4**2 * math.radians(10.0) * math.sin(math.radians(10.0))
    assert rows[9, 18] == approx(2 / cell_km2 * 1e4, abs=0.01)  # the crater of 60 km does not count
    assert rows[17, 17] > rows[9, 18] / 2  # one crater in a smaller cell


def test_a_catalogue_without_a_crater_is_refused(ground):
    stored = ground.files.put_octets(b"id,latitude_deg,longitude_deg,diameter_m,depth_m\n")
    with raises(InvalidInput, match=r"catalogue: expected a crater catalogue, found none\.csv: no crater$"):
        add_catalogue(ground, stored, "none.csv")


def test_a_withdrawn_catalogue_is_not_used_and_can_be_held_again(ground):
    octets = b"id,latitude_deg,longitude_deg,diameter_m,depth_m\n1,2.0,3.0,6000.0,600.0\n"
    stored = ground.files.put_octets(octets)
    add_catalogue(ground, stored, "one.csv")
    text = MISSION.format(catalogue=f'[catalogue]\nsha256 = "{stored.sha256}"\n')
    add_mission(ground, text.encode(), actor="ann")
    with raises(Conflict, match="is that of the mission of spacecraft 76"):
        withdraw_catalogue(ground, stored.sha256, actor="ann")
    add_mission(ground, MISSION.format(catalogue="").encode(), actor="ann")
    withdraw_catalogue(ground, stored.sha256, actor="ann")
    assert ground.read(list_audit, AuditFilter()).items[0].action == "withdraw catalogue"
    with raises(NotFound):
        withdraw_catalogue(ground, stored.sha256, actor="ann")
    add_mission(ground, text.replace("small", "again").encode(), actor="ann")
    assert "a catalogue that the ground holds" in (forecast.crater_density(ground, 76).reason or "")
    add_catalogue(ground, stored, "one.csv")
    assert forecast.crater_density(ground, 76).reason is None


def test_a_density_without_a_catalogue_states_the_reason(planned):
    found = forecast.crater_density(planned, 76)
    assert found.rows == [] and "catalogue" in (found.reason or "")
    assert "expected the source or SHA-256" in (forecast.crater_density(planned, 5).reason or "")


HOUR = 3600 * NS
STEP_S = 600.0


def grid(hours=24, **changes):
    n = round(hours * 3600 / STEP_S)
    plain = ResourceGrid(
        start_utc_ns=0, step_s=STEP_S, gain_wh=np.full(n, 1.0), downlink_octets=np.full(n, 1000.0), battery_wh=50.0,
        floor_wh=15.0, observing_w=20.0, storage_octets=10_000.0,
    )  # fmt: skip
    return replace(plain, **changes)


def window(start_h, hours, octets=100, value=1.0, period=0):
    return Option(round(start_h * HOUR), round((start_h + hours) * HOUR), octets, value, period)


def why(one, *windows):
    """Return why windows are not feasible."""
    return violation(one, [window(*each) for each in windows])


def test_windows_that_touch_do_not_overlap():
    assert why(grid(), (1, 1), (2, 1)) is None
    for one, gap in (grid(), 1.99), (grid(gap_ns=HOUR // 10), 2.09):
        assert why(one, (1, 1), (gap, 1)) == "overlaps another window or its telecommands"
        assert why(one, (1, 1), (gap + 0.02, 1)) is None


def test_the_battery_is_that_of_a_balance_by_hand_whatever_the_steps():
    # 6 Wh an hour in, 20 Wh an hour out: 14 Wh an hour less, from 50 Wh to 15 Wh in 2.5 h
    assert why(grid(), (1, 2.5)) is None
    assert why(grid(), (1, 2.6)) == "the battery would fall to 28 %, expected 30 % or more"
    # full again only after 28 / 6 h
    assert why(grid(), (1, 2), (3 + 14 / 3, 2.5)) is None
    assert why(grid(), (1, 2), (3 + 14 / 3 - 0.5, 2.5)) is not None
    for start in 0.0, 0.1, 1.05, 23.0:
        change, _ = grid().flows([window(start, 0.75)])
        assert (grid().gain_wh - change).sum() == approx(15.0)


def test_stored_data_leave_in_contacts():
    silent = np.zeros(144)
    silent[60:63] = 1000.0
    assert why(grid(downlink_octets=silent), (1, 1, 3000)) is None
    assert why(grid(), (1, 1, 10_000)) is None
    assert why(grid(), (1, 1, 10_001)) == "10001 octets would be stored on board, expected at most 10000"
    full = grid(downlink_octets=silent)
    assert why(full, (1, 1, 6000), (3, 1, 5000)) is not None
    assert why(full, (1, 1, 6000), (11, 1, 5000)) is None  # 3000 left in between


def test_data_have_to_be_down_in_time_and_the_duty_limit_counts_windows_of_a_day():
    late = np.zeros(48 * 6)
    late[6 * 30] = 5000.0
    slow = grid(48, downlink_octets=late)
    assert why(slow, (1, 1, 100)) == "its data would not be down within 24 h"
    assert why(slow, (8, 1, 5000)) is None
    assert why(slow, (8, 1, 5001)) == "its data would not be down within 24 h"
    strong = grid(72, gain_wh=np.full(72 * 6, 10.0), observe_s_per_day=7200.0)
    assert why(strong, (1, 1), (5, 1)) is None
    assert why(strong, (1, 1), (5, 1), (24.99, 0.5)) is not None
    assert why(strong, (1, 1), (5, 1), (25, 0.5)) is None


def test_quotas_are_kept_by_period_planned_windows_keep_their_resources_and_reasons_are_given():
    options = [window(k, 0.1, period=k // 4) for k in range(8)]
    chosen, reasons = choose(grid(), options, quota={0: 2, 1: 0})
    assert chosen == options[:2]
    assert set(reasons) == set(options[2:])
    assert set(reasons.values()) == {"the number of windows of its period is planned"}
    committed = [window(1, 2.4)]
    chosen, reasons = choose(grid(), [window(3.5, 1), window(20, 1)], committed)
    assert chosen == [window(20, 1)] and "battery" in reasons[window(3.5, 1)]
    assert choose(grid(), []) == ([], {})


options_of_a_day = st.lists(
    st.tuples(st.integers(0, 40), st.integers(1, 8), st.integers(1, 4000), st.integers(1, 5), st.integers(0, 1)).map(
        lambda v: window(v[0] / 2, v[1] / 4, v[2], float(v[3]), v[4])
    ),
    max_size=7,
    unique=True,
)


@settings(max_examples=60, deadline=None)
@given(options_of_a_day, st.integers(0, 4), st.integers(0, 4))
def test_a_plan_is_feasible_and_not_worse_than_any_order(options, first, second):
    tight = grid(downlink_octets=np.full(144, 150.0), storage_octets=5000.0, observe_s_per_day=4 * 3600.0)
    quota = {0: first, 1: second}
    chosen, reasons = choose(tight, options, quota=quota)
    assert violation(tight, chosen) is None
    assert all(sum(one.period == k for one in chosen) <= number for k, number in quota.items())
    assert sorted([*chosen, *reasons], key=hash) == sorted(options, key=hash)
    in_time = take_in_order(tight, sorted(options, key=lambda one: one.start_utc_ns), (), quota)[0]
    assert sum(one.value for one in chosen) >= sum(one.value for one in in_time)
    best = max(
        sum(one.value for one in some)
        for n in range(len(options) + 1)
        for some in itertools.combinations(options, n)
        if all(sum(one.period == k for one in some) <= number for k, number in quota.items())
        and violation(tight, some) is None
    )
    assert sum(one.value for one in chosen) <= best
    assert choose(tight, list(reversed(options)), quota=quota)[0] == chosen


def test_one_long_window_gives_way_to_several_of_more_value():
    long, short = window(2, 2.4, value=1.5), [window(2 + k, 0.5, value=1.0) for k in range(3)]
    chosen, _ = choose(grid(), [long, *short])
    assert chosen == short
