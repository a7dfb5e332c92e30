"""Alarms: raised once for each cause, kept until acknowledged, equal for any order of arrival."""

import itertools

from hypothesis import given
from hypothesis import strategies as st
from pytest import mark, raises

from ground_service.access.model import AuditFilter
from ground_service.access.store import list_audit
from ground_service.clock import set_mission_clock, utc_now_ns
from ground_service.contacts.links.service import acquire, change_state, declared_links
from ground_service.errors import Conflict, InvalidInput, NotFound
from ground_service.ground import open_ground
from ground_service.ingest.service import ingest_file
from ground_service.missions.service import add_mission
from ground_service.passes.alarms import core
from ground_service.passes.alarms.model import AlarmFilter
from ground_service.passes.alarms.service import (
    acknowledge_alarm,
    examine_packets,
    get_alarm,
    list_alarms,
    shelve_alarm,
)
from ground_service.planning.model import StandingRequestIn, WindowEntry
from ground_service.planning.progress import note_reason
from ground_service.planning.service import add_window, change_window
from ground_service.planning.standing import add_request, plan_tick
from ground_service.store import repository
from ground_service.store.event_kinds import AlarmChanged, read_events
from ground_service.telemetry.values import last_packet, packets_after
from ground_service.worker.scheduler import Watch
from tests.ground_service.conftest import steps_of
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus

SPACECRAFT = 76
SECOND = 65_536
START = 1_000_000_000 * SECOND


WATCHED = core.WATCHED_APIDS


def housekeeping(second, temperature_c):
    """A housekeeping packet with one value outside its limits, if that of the temperature is."""
    values = {field.name: 0 for field in DICTIONARY.packet("housekeeping").fields}
    values |= {"structure_id": 1, "bus_voltage_v": 12.0, "temperature_c": temperature_c}
    return DICTIONARY.pack("housekeeping", values, ticks=START + second * SECOND, sequence_count=second % 16_384)


def event(second, name="event_high", event_id=20):
    values = {"event_id": event_id, "frame_number": second, "value_1": 0.0, "value_2": 0.0}
    return DICTIONARY.pack(name, values, ticks=START + second * SECOND, sequence_count=second % 16_384)


def receive(ground, *packets):
    """Ingest packets as a downlink of the flown spacecraft."""
    file = ground.home / "in.cadu"
    file.write_bytes(encode_cadus(list(packets), spacecraft_id=SPACECRAFT))
    ingest_file(ground, file)


def alarms(ground, *states):
    return ground.read(list_alarms, AlarmFilter(state=list(states))).items


def acknowledge(ground):
    """Acknowledge the newest alarm."""
    return acknowledge_alarm(ground, alarms(ground)[0].id, "", actor="eva")


def active(ground):
    return {one.name for one in alarms(ground) if one.active}


def states(ground):
    return [(one.state, one.count) for one in alarms(ground)]


def published(ground):
    """Return the states of alarms that were published."""
    return [AlarmChanged.of(one).state for one in read_events(ground.database, 0) if one.kind == "alarm"]


def test_an_event_stays_raised_through_later_passes_until_it_is_acknowledged(either):
    receive(either, *[event(k) for k in range(82)])
    receive(either, *[housekeeping(k, 20.0) for k in range(200, 240)])
    (alarm,) = alarms(either)
    assert (alarm.name, alarm.count, alarm.severity, alarm.state) == ("camera_fault", 82, "alarm", "raised")
    assert not alarm.active
    done = acknowledge_alarm(either, alarm.id, "camera restarted", actor="eva")
    assert (done.state, done.acknowledged_by) == ("cleared", "eva")
    assert [one.change for one in done.history] == ["raised", "acknowledged", "cleared"]
    assert done.history[1].comment == "camera restarted"
    assert either.read(list_audit, AuditFilter()).items[0].action == "acknowledge alarm"


def test_a_limit_is_broken_once_and_cleared_after_acknowledgement_and_return(either):
    receive(either, *[housekeeping(k, 70.0 + k) for k in range(5)])
    (alarm,) = alarms(either, "raised")
    assert (alarm.name, alarm.severity, alarm.count, alarm.value) == ("temperature_c", "warning", 5, 74.0)
    assert (alarm.active, alarm.limits, alarm.unit) == (True, "-20 to 60", "degC")
    assert acknowledge(either).state == "acknowledged"
    receive(either, housekeeping(10, 20.0))
    assert either.read(get_alarm, alarm.id).state == "cleared"
    receive(either, housekeeping(20, 65.0))
    assert states(either) == [("raised", 1), ("cleared", 5)]


def test_a_worse_condition_must_be_acknowledged_again(ground):
    receive(ground, housekeeping(0, 70.0))
    acknowledge(ground)
    for second, temperature_c, expected in (1, 75.0, ("acknowledged", "warning")), (2, 90.0, ("raised", "alarm")):
        receive(ground, housekeeping(second, temperature_c))
        (alarm,) = alarms(ground)
        assert (alarm.state, alarm.severity) == expected


@mark.parametrize("order", list(itertools.permutations(range(3))))
def test_an_alarm_does_not_depend_on_the_order_of_arrival(ground, order):
    parts = [
        [housekeeping(0, 70.0), event(1)],
        [housekeeping(10, 95.0), event(11), event(12, "event_medium")],
        [housekeeping(20, 61.0)],
    ]
    for part in order:
        receive(ground, *parts[part])
    assert sorted((one.name, one.severity, one.count, one.active, one.state, one.value) for one in alarms(ground)) == [
        ("camera_fault", "alarm", 3, False, "raised", None),
        ("temperature_c", "alarm", 3, True, "raised", 61.0),
    ]


def test_packets_that_arrive_again_are_not_counted_again(ground):
    packets = [event(k) for k in range(4)]
    receive(ground, *packets)
    receive(ground, *packets, event(4))
    assert [one.count for one in alarms(ground)] == [5]
    with ground.database.reading() as connection:
        vehicle = connection.exec_driver_sql("SELECT id FROM vehicles").scalar_one()
    assert examine_packets(ground, vehicle) == 0


def test_new_packets_are_found_without_a_search_of_those_before_or_of_others(ground, monkeypatch):
    monkeypatch.setattr("ground_service.telemetry.values.FEW_PACKETS", 500)
    steps = []
    for seconds in range(20), range(20, 1000):
        receive(ground, *(housekeeping(second, 20.0) for second in seconds))
        with ground.database.reading() as connection:
            last = last_packet(connection, 1)
            found, work = steps_of(connection, lambda given, last=last: packets_after(given, 1, last - 5, WATCHED, 9))
            steps += work, steps_of(connection, lambda given: packets_after(given, 2, 0, WATCHED, 9))[1]
        assert len(found.ids) == 5
    assert max(steps[1:]) < 1.5 * steps[0] + 5


def test_late_packets_of_a_cleared_alarm_do_not_raise_it_again(ground):
    receive(ground, event(10))
    acknowledge(ground)
    receive(ground, event(5))
    assert states(ground) == [("cleared", 2)]
    receive(ground, event(20))
    assert states(ground) == [("raised", 1), ("cleared", 2)]


def test_an_alarm_is_acknowledged_by_one_user(either):
    receive(either, housekeeping(0, 70.0))
    (alarm,) = alarms(either)
    acknowledge(either)
    with raises(Conflict, match=f"alarm {alarm.id}: expected state raised, found acknowledged by eva"):
        acknowledge_alarm(either, alarm.id, "", actor="max")
    with raises(NotFound):
        acknowledge_alarm(either, alarm.id + 1, "", actor="max")


def test_a_shelved_alarm_returns_at_its_time(either):
    receive(either, event(0))
    (alarm,) = alarms(either)
    now = utc_now_ns()
    hour = 3600 * 10**9
    shelved = shelve_alarm(either, alarm.id, now + hour, "known fault", actor="eva")
    assert (shelved.state, shelved.shelved_by) == ("shelved", "eva")
    assert alarms(either, "raised") == [] and len(alarms(either, "shelved")) == 1
    ended = shelve_alarm(either, alarm.id, now - hour, "", actor="eva")
    assert ended.state == "raised" and len(alarms(either, "raised")) == 1
    with raises(InvalidInput, match="expected a time within 30 days"):
        shelve_alarm(either, alarm.id, now + 31 * 24 * hour, "", actor="eva")
    acknowledge(either)
    with raises(Conflict, match="expected an open alarm, found cleared"):
        shelve_alarm(either, alarm.id, now + hour, "", actor="eva")


def test_an_alarm_is_shelved_in_mission_time_and_its_records_are_in_time_of_day(ground):
    receive(ground, event(0))
    moment = utc_now_ns() + 1000 * 86_400 * 10**9
    set_mission_clock(lambda: moment)
    shelved = shelve_alarm(ground, alarms(ground)[0].id, moment + 10**9, "known", actor="eva")
    assert shelved.state == "shelved" and abs(shelved.history[-1].time.utc_ns - utc_now_ns()) < 600e9
    moment += 2 * 10**9
    assert [one.state for one in alarms(ground)] == ["raised"]


def test_changes_are_published(ground):
    receive(ground, event(0))
    acknowledge(ground)
    assert published(ground) == ["raised", "cleared"]
    for second, value in enumerate((70.0, 71.0, 20.0, 21.0, 72.0)):
        receive(ground, housekeeping(second, value))
    assert published(ground)[2:] == ["raised", "condition ended", "condition returned"]


def test_events_of_low_severity_and_refused_fixes_raise_no_alarm(ground):
    receive(ground, *[event(k, "event_medium", 36) for k in range(4)])
    receive(ground, event(0, "event_info", 2), event(1, "event_low", 36), housekeeping(2, 20.0))
    assert alarms(ground) == []


def condition(ticks, severity, value):
    return core.Condition("parameter", "temperature_c", severity, ticks, ticks, 1, value)


@given(
    st.lists(
        st.builds(condition, st.integers(0, 5), st.sampled_from([1, 2]), st.floats(-90, 90)), min_size=3, max_size=6
    ),
    st.randoms(),
)
def test_conditions_are_joined_in_any_order(conditions, random):
    def whole(parts):
        result = parts[0]
        for one in parts[1:]:
            result = core.joined(result, one)
        return result

    shuffled = random.sample(conditions, len(conditions))
    assert whole(conditions) == whole(shuffled)


def test_what_stops_operations_is_an_alarm_until_it_ends(tmp_path):
    text = b'name = "stopped"\n[spacecraft]\nid = 76\n[uploads]\n'
    link = b'[[links]]\nname = "lab"\nkind = "tcp"\nuplink = "127.0.0.1:9"\n'
    moment = START // SECOND * 10**9
    set_mission_clock(lambda: moment)
    with open_ground(tmp_path) as ground:
        add_mission(ground, text + link)
        add_request(ground, StandingRequestIn(name="none", spacecraft_id=76, windows=1), actor="ann")
        entry = WindowEntry("w", moment + 3600 * 10**9, moment + 4200 * 10**9, 15.0, 76)
        window = add_window(ground, entry, actor="planner").id
        change_window(ground, window, actor="planner", changes={}, decision="approved")
        note_reason(ground, window, "cannot be released")
        plan_tick(ground, moment)
        watch = Watch(ground, holds_s=0.0)
        watch.tick()
        names = {"link_process_gone", "window_not_released", "plan_empty"}
        assert {one.name for one in alarms(ground, "raised")} == names
        watch.tick()  # no time has passed since
        assert {one.name for one in alarms(ground, "raised")} == {*names, "mission_time_stopped"}
        assert {(one.source, one.severity) for one in alarms(ground)} == {("operations", "alarm")}
        # The process of the links is back; they are refused, and a window is on board.
        assert acquire(ground, declared_links(ground)["lab"], "links", 10**12)
        watch.tick()
        assert active(ground) == {"no_link", "mission_time_stopped", "window_not_released", "plan_empty"}
        ground.write(repository.change, repository.WINDOWS, window, state="uplinked")
        watch.tick()
        assert active(ground) == {"no_link", "mission_time_stopped", "spacecraft_gone", "plan_empty"}
        moment += 10**9
        watch.tick()  # mission time passes: the link alone is missing
        assert active(ground) == {"no_link", "plan_empty"}
        watch.tick()
        change_state(ground, "lab", "links", "connected", None)
        watch.tick()  # mission time stands still, but the link is there
        assert active(ground) == {"mission_time_stopped", "plan_empty"}
        moment += 10**9
        watch.tick()
        assert "mission_time_stopped" not in active(ground)
        ground.write(repository.change, repository.WINDOWS, window, state="downlinked")
        watch.tick()
        assert not any(one.name == "report_overdue" for one in alarms(ground))
        moment += 2 * 86_400 * 10**9
        watch.tick()
        assert active(ground) == {"report_overdue", "plan_empty"}
        Watch(ground).tick()  # another process, which knows no ages
        assert active(ground) == {"report_overdue", "plan_empty"}
        watch.tick()  # no time has passed since
        other = Watch(ground)
        other.tick()
        assert "mission_time_stopped" in active(ground)
        with ground.database.writing() as connection:
            repository.change(connection, repository.WINDOWS, window, state="processed")
            repository.change(connection, repository.STANDING_REQUESTS, 1, state="ended")
        add_mission(ground, text)
        other.tick()
        assert active(ground) == set()


def test_an_alarm_states_the_procedure_of_the_mission_in_force(ground):
    receive(ground, housekeeping(0, 70.0), event(1))
    known = {one.name: one.id for one in alarms(ground, "raised")}
    add_mission(ground, b'name="w"\nspacecraft.id=76\nprocedures.temperature_c="Check the heaters."', actor="ann")
    procedures = {name: ground.read(get_alarm, key).procedure for name, key in known.items()}
    assert procedures == {"temperature_c": "Check the heaters.", "camera_fault": None}
