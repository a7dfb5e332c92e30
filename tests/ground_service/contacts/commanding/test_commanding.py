"""Telecommands: validation, release, second persons, uplink, and what the reports say became of them."""

import json
from itertools import combinations

from pytest import fixture, mark, raises
from sqlalchemy import event, update

from ground_service.contacts.commanding import service as commanding
from ground_service.contacts.commanding.core import FAILURES, STAGES, SentCommand, VerificationReport, fate_of
from ground_service.contacts.commanding.model import HandoverFilter, TelecommandFilter
from ground_service.contacts.commanding.service import (
    change_handover,
    enter_command,
    get_command,
    hold_spacecraft,
    list_telecommands,
    note_timeouts,
    reject_command,
    release_command,
    resume_spacecraft,
    take_released,
    take_uplink,
)
from ground_service.contacts.commanding.store import count_released, get_view, list_handovers
from ground_service.errors import Conflict, InvalidInput, NotFound
from ground_service.http.model import Paging
from ground_service.ingest.service import ingest_file
from ground_service.missions.model import Approval
from ground_service.planning.model import WindowFilter
from ground_service.planning.service import WindowEntry, add_window, change_window, uplink_window
from ground_service.planning.store import list_windows
from ground_service.store import repository
from ground_service.store.event_kinds import read_events
from ground_service.telemetry.decoding import readable_version
from lunar.timescales import parse_utc
from tests.ground_service.conftest import cells, steps_of
from tmtc.dictionary.effects import EFFECTS, Effect
from tmtc.dictionary.payload import DICTIONARY
from tmtc.link.uplink import UplinkDecoder
from tmtc.packets.stream import cut_packets

SPACECRAFT = 76
NOW = parse_utc("2029-08-07T06:00:00Z")
START = {"function_id": "start_observation", "argument_1": 600.0, "argument_2": 15.0}


def entered(ground, name="perform_function", actor="ann", **arguments):
    given = arguments or (START if name == "perform_function" else {})
    return enter_command(ground, name, given, spacecraft_id=SPACECRAFT, actor=actor)


def entered_elsewhere(ground, spacecraft=77, instance="flight"):
    """Enter and release a telecommand of another spacecraft."""
    command = enter_command(ground, "test_connection", {}, spacecraft_id=spacecraft, instance=instance, actor="ann")
    release_command(ground, command, actor="ann")
    return command


def uplinked(ground, **options):
    return take_uplink(ground, **{"spacecraft_id": SPACECRAFT, "actor": "ann"} | options)


def sent(ground):
    command = entered(ground)
    release_command(ground, command, actor="ann")
    uplinked(ground)
    return command


def downlink(ground, folder, *reports):
    path = folder / "reports.bin"
    packets = [
        DICTIONARY.pack(name, values, ticks=ticks, sequence_count=ticks % 16384) for name, ticks, values in reports
    ]
    path.write_bytes(b"".join(packets))
    ingest_file(ground, path, spacecraft_id=SPACECRAFT)


def test_a_command_goes_its_way_from_the_queue_to_its_completion(ground, tmp_path):
    command = entered(ground)
    assert get_command(ground, command).state == "queued"
    release_command(ground, command, actor="ann")
    stream, ids = uplinked(ground)
    assert ids == [command]
    view = get_command(ground, command)
    assert view.state == "sent"
    request = {"request_id": view.record.request_id}
    downlink(ground, tmp_path, ("verification_accepted", 1000, request))
    assert get_command(ground, command).state == "accepted"
    downlink(ground, tmp_path, ("verification_completed", 3000, request), ("verification_started", 2000, request))
    view = get_command(ground, command)
    assert view.state == "completed"
    assert [report.subtype for report in view.fate.reports] == [1, 3, 7]
    assert uplinked(ground) == (b"", [])
    # the receiver at the other end gets the very packet
    decoded = UplinkDecoder(SPACECRAFT).decode(stream)
    assert list(decoded.packets) == [view.record.octets]


def test_bare_packets_can_be_taken_instead_of_frames(ground):
    for _ in range(3):
        release_command(ground, entered(ground, "test_connection"), actor="ann")
    stream, ids = uplinked(ground, framed=False)
    cut = cut_packets(stream, packet_type=1)
    assert len(cut) == len(ids) == 3
    counts = [DICTIONARY.unpack_command(packet).sequence_count for packet in cut.packets(stream)]
    assert counts == [0, 1, 2]


REFUSED = """
self_destruct | {} | name: expected one of the 27 telecommands of the dictionary
test_connection\0 | {} | name: expected one of the 27 telecommands of the dictionary
perform_function | {"function_id": "dance", "argument_1": 0, "argument_2": 0} | function_id: expected one of
perform_function | {"function_id": 1} | argument_1: expected a value
perform_function | {"function_id": "start_observation", "duration_s": -1} | start_observation.duration_s: expected
set_housekeeping_interval | {"structure_id": 1, "interval_s": 0} | interval_s: expected
set_housekeeping_interval | {"structure_id": 1, "interval_s": true} | interval_s: expected a finite number
test_connection | {"extra": 1} | no such field
set_parameter | {"parameter_id": "x", "value": []} | expected
set_parameter | {"parameter_id": 1, "value": NaN} | set_parameter.value: expected a finite number
set_parameter | {"parameter_id": 1, "value": Infinity} | set_parameter.value: expected a finite number
set_parameter | {"parameter_id": 1, "value": -Infinity} | set_parameter.value: expected a finite number
set_parameter | {"parameter_id": 1, "value": true} | set_parameter.value: expected a finite number
set_parameter | {"parameter_id": 1, "value": false} | set_parameter.value: expected a finite number
set_parameter | {"parameter_id": true, "value": 1.0} | parameter_id: expected a finite number, found True
set_parameter | {"parameter_id": 1, "value": HUGE} | value: expected a number
delete_activity | {"request_id": -1} | request_id: expected
delete_activity | {"request_id": 1e20} | request_id: expected
insert_activity | {"release_ticks": 1, "items": [{"octet": 1}, {"octet": true}]} | items.octet: expected a finite number
"""


@mark.parametrize("name, arguments, message", cells(REFUSED))
def test_what_the_dictionary_refuses_is_not_queued(ground, name, arguments, message):
    given = json.loads(arguments.replace("HUGE", "1" + "0" * 400))
    with raises(InvalidInput, match=message):
        enter_command(ground, name, given, spacecraft_id=SPACECRAFT, actor="ann")
    assert ground.read(list_telecommands, TelecommandFilter()).total == 0


def test_only_a_queued_command_can_be_decided_on(ground):
    command = entered(ground)
    reject_command(ground, command, actor="bob", reason="wrong cadence")
    for decide in (
        lambda: release_command(ground, command, actor="bob"),
        lambda: reject_command(ground, command, actor="bob", reason="again"),
    ):
        with raises(Conflict, match="expected state queued, found rejected"):
            decide()
    with raises(NotFound):
        release_command(ground, 99, actor="bob")
    assert uplinked(ground) == (b"", [])


def test_a_failure_says_why(ground, tmp_path):
    command = sent(ground)
    request = get_command(ground, command).record.request_id
    downlink(
        ground, tmp_path, ("verification_not_accepted", 500, {"request_id": request, "failure_code": "wrong_mode"})
    )
    view = get_command(ground, command)
    assert (view.state, view.telecommand.remark) == ("failed", "not accepted: wrong mode")
    assert view.fate.reports[0].failure_code == 5


def test_a_time_out_is_put_on_record_once_and_stays_there(ground, tmp_path, clock):
    silent, completed, other = (sent(ground) for _ in range(3))
    entered(ground)
    request = {"request_id": get_command(ground, completed).record.request_id}
    downlink(ground, tmp_path, ("verification_completed", 3000, request))
    due = NOW + 600 * 10**9

    def noted(now):
        clock(now)
        return note_timeouts(ground, 0, now)

    assert noted(due - 1) == []
    assert noted(due + 10**9) == [silent, other]
    assert noted(due + 2 * 10**9) == []
    late = {"request_id": get_command(ground, silent).record.request_id}
    downlink(ground, tmp_path, ("verification_completed", 9000, late))
    assert (get_command(ground, silent).state, noted(due + 3 * 10**9)) == ("completed", [])
    with ground.database.reading() as connection:
        record = repository.newest(connection, repository.AUDIT, Paging(), action="time out telecommand")[0]
    assert [(row["actor"], row["target"], row["detail"]["state"]) for row in record] == [
        ("service", str(key), "sent") for key in (other, silent)
    ]
    assert {"id": silent, "state": "timed out"} in [item.payload for item in read_events(ground.database, 0)]


@mark.parametrize("spacecraft_id", [-1, 1024, 10**20, True])
def test_an_id_that_no_transfer_frame_can_carry_is_refused(ground, spacecraft_id):
    for work in (
        lambda: enter_command(ground, "test_connection", {}, spacecraft_id=spacecraft_id, actor="ann"),
        lambda: uplinked(ground, spacecraft_id=spacecraft_id),
    ):
        with raises(InvalidInput, match="spacecraft, id: expected 0 to 1023"):
            work()


@mark.parametrize("reason", ["", "two\nlines", "\x1b[2Jgone", "nul\x00", "x" * 501])
def test_a_reason_is_one_printable_line(ground, reason):
    command = entered(ground)
    with raises(InvalidInput, match="telecommand, reason: expected a line of 1 to 500 characters"):
        reject_command(ground, command, actor="bob", reason=reason)
    assert get_command(ground, command).state == "queued"


def test_arguments_nested_without_end_are_refused(ground):
    nested = 1
    for _ in range(3000):
        nested = [nested]
    with raises(InvalidInput, match="set_parameter"):
        entered(ground, "set_parameter", parameter_id=1, value=nested)


def test_an_instance_is_one_printable_line(ground):
    with raises(InvalidInput, match="spacecraft, instance"):
        enter_command(ground, "test_connection", {}, spacecraft_id=1, instance="a\nb", actor="ann")


def carrying(name, **arguments):
    octets = DICTIONARY.pack_command(name, arguments, sequence_count=0)
    return {"release_ticks": 1, "items": [{"octet": octet} for octet in octets]}


CRITICAL = """
set_parameter | {"parameter_id": 1, "value": 2.0} | True
perform_function | {"function_id": "set_mode", "argument_1": 1, "argument_2": 0} | True
perform_function | {"function_id": 7, "argument_1": 1, "argument_2": 0} | True
perform_function | {"function_id": "start_observation", "argument_1": 600.0, "argument_2": 15.0} | False
"""


@mark.parametrize("name, arguments, critical", cells(CRITICAL))
@mark.parametrize("carried", [False, True])
def test_what_changes_the_state_of_the_payload_needs_a_second_person(ground, name, arguments, critical, carried):
    given = json.loads(arguments)
    if carried:
        name, given = "insert_activity", carrying(name, **given)
    command = enter_command(ground, name, given, spacecraft_id=SPACECRAFT, actor="ann")
    assert str(bool(get_command(ground, command).record.critical)) == critical
    if critical == "True":
        with raises(
            Conflict, match=r"critical; expected a person other than ann .*\((changes on-board state|destroys data): "
        ):
            release_command(ground, command, actor="ann")
        release_command(ground, command, actor="bob")
    else:
        release_command(ground, command, actor="ann")
    assert get_command(ground, command).state == "released"


def raise_rule(monkeypatch):
    rules = Approval(second_person_for=("perform_function/start_observation",))
    monkeypatch.setattr(commanding, "approval_in_force", lambda *_: rules)


def drafted(ground):
    entry = WindowEntry("window", NOW, NOW + 600 * 10**9, 15.0, SPACECRAFT)
    return int(add_window(ground, entry, actor="ann").id)


def planned(ground):
    window = drafted(ground)
    change_window(ground, window, actor="ann", changes={}, decision="approved")
    return window


def test_one_person_plans_approves_and_uplinks_a_routine_window(ground):
    assert len(uplink_window(ground, planned(ground), actor="ann")) == 3


def test_the_approval_of_a_window_by_somebody_else_is_the_second_person_of_its_telecommands(ground, monkeypatch):
    raise_rule(monkeypatch)
    with raises(Conflict, match="expected a window that a second person has approved"):
        uplink_window(ground, planned(ground), actor="bob")
    assert ground.read(list_telecommands, TelecommandFilter()).total == 0
    [window] = [row.id for row in ground.read(list_windows, WindowFilter()).items]
    for decision in "draft", "approved":
        change_window(ground, window, actor="bob", changes={}, decision=decision)
    assert len(uplink_window(ground, window, actor="ann")) == 3


def test_who_changes_a_window_has_entered_it(ground, monkeypatch):
    raise_rule(monkeypatch)
    window = drafted(ground)
    change_window(ground, window, actor="bob", changes={"cadence_s": 20.0}, decision="approved")
    with raises(Conflict, match="a second person"):
        uplink_window(ground, window, actor="ann")


@fixture
def clock(monkeypatch):
    """A clock that stands at `NOW` until it is set."""

    def put(now):
        monkeypatch.setattr("ground_service.contacts.commanding.service.utc_now_ns", lambda: now)

    put(NOW)
    return put


def notes(ground, command):
    """Return who did what to a command, and the details, in order."""
    with ground.database.reading() as connection:
        rows = repository.newest(connection, repository.AUDIT, Paging(), target=str(command))[0]
    return [(row["actor"], row["action"], row["detail"]) for row in sorted(rows, key=lambda row: row["id"])]


def messages(ground):
    return [item.payload for item in read_events(ground.database, 0) if item.kind == "telecommand"]


def subset(row, names):
    return {name: getattr(row, name) for name in names}


def test_each_step_keeps_what_was_done_when_by_whom_and_tells_those_who_watch(ground, clock):
    command = enter_command(ground, "perform_function", START, spacecraft_id=SPACECRAFT, timeout_s=90, actor="ann")
    view = get_command(ground, command)
    assert (view.spacecraft_id, view.instance, view.fate) == (SPACECRAFT, "flight", None)
    expected = {
        "name": "perform_function", "arguments": START, "state": "queued", "critical": 0, "timeout_s": 90,
        "requested_by": "ann", "created_utc_ns": NOW, "window_id": None, "carrier_id": None, "decided_by": None,
        "sequence_count": None, "octets": None, "sent_utc_ns": None,
    }  # fmt: skip
    assert subset(view.record, expected) == expected
    clock(NOW + 1)
    release_command(ground, command, actor="bob")
    octets = DICTIONARY.pack_command("perform_function", START, sequence_count=0)
    expected |= {
        "state": "released", "decided_by": "bob", "decided_utc_ns": NOW + 1, "sequence_count": 0, "octets": octets,
        "request_id": int.from_bytes(octets[:4], "big"),
    }  # fmt: skip
    assert subset(get_command(ground, command).record, expected) == expected
    clock(NOW + 2)
    uplinked(ground, actor="cleo")
    row = get_command(ground, command).record
    assert (row.state, row.sent_utc_ns, row.sent_after_ticks) == ("sent", NOW + 2, -1)
    text = "function start observation, duration 600 s, cadence 15 s"
    assert notes(ground, command) == [
        ("ann", "enter telecommand", {"name": "perform_function", "text": text, "arguments": START}),
        ("bob", "release telecommand", {"sequence_count": 0}),
        ("cleo", "send telecommand", {}),
    ]
    assert messages(ground) == [{"id": command, "state": state} for state in ("queued", "released", "sent")]


def test_a_rejection_keeps_its_reason(ground, clock):
    command = entered(ground)
    clock(NOW + 5)
    reject_command(ground, command, actor="bob", reason="wrong cadence")
    row = get_command(ground, command).record
    assert (row.state, row.decided_by, row.decided_utc_ns, row.reason) == (
        "rejected", "bob", NOW + 5, "wrong cadence",
    )  # fmt: skip
    assert notes(ground, command)[1] == ("bob", "reject telecommand", {"reason": "wrong cadence"})
    assert messages(ground)[-1] == {"id": command, "state": "rejected"}


@mark.parametrize("timeout_s, accepted", [(0, False), (1, True), (2**31 - 1, True), (2**31, False), (True, False)])
def test_a_time_out_lasts_a_second_to_68_years(ground, timeout_s, accepted):
    def enter():
        return enter_command(ground, "test_connection", {}, spacecraft_id=SPACECRAFT, timeout_s=timeout_s, actor="ann")

    if accepted:
        assert get_command(ground, enter()).record.timeout_s == timeout_s
    else:
        with raises(InvalidInput, match=f"telecommand, timeout_s: expected 1 to 2147483647, found {timeout_s}"):
            enter()


def test_an_unknown_name_is_answered_with_the_nearest_one(ground):
    for name, near in ("test_conection", "test_connection"), ("zzz", DICTIONARY.telecommands[0].name):
        with raises(InvalidInput, match=f"^telecommand, name: expected .*, such as {near}, found '{name}'"):
            entered(ground, name)


def test_commands_are_sent_in_the_order_of_their_release(ground, clock):
    first, second, third = (entered(ground, "test_connection") for _ in range(3))
    for offset, command in (1, second), (2, third), (2, first):
        clock(NOW + offset)
        release_command(ground, command, actor="ann")
    stream, ids = uplinked(ground, framed=False)
    # Of two released in one instant the one entered first; the counts are those of the release.
    assert ids == [second, first, third]
    octets = [DICTIONARY.pack_command("test_connection", {}, sequence_count=count) for count in (0, 2, 1)]
    assert stream == b"".join(octets)


def test_an_uplink_holds_only_what_is_meant_for_its_spacecraft(ground):
    mine = entered(ground, "test_connection")
    release_command(ground, mine, actor="ann")
    twin, other = entered_elsewhere(ground, SPACECRAFT, "twin"), entered_elsewhere(ground)
    waiting = entered(ground, "test_connection")
    assert uplinked(ground)[1] == [mine]
    assert uplinked(ground, instance="twin")[1] == [twin]
    assert [get_command(ground, one).state for one in (other, waiting)] == ["released", "queued"]
    # Each spacecraft counts by itself.
    assert [get_command(ground, one).record.sequence_count for one in (mine, twin, other)] == [0, 0, 0]


def test_a_command_is_judged_by_reports_newer_than_those_known_when_it_was_sent(ground, tmp_path):
    first = sent(ground)
    request = get_command(ground, first).record.request_id
    downlink(
        ground, tmp_path, ("verification_accepted", 900, {"request_id": request}),
        ("verification_completed", 1200, {"request_id": request}),
    )  # fmt: skip
    assert get_command(ground, sent(ground)).record.sent_after_ticks == 1200
    other = entered_elsewhere(ground)
    uplinked(ground, spacecraft_id=77)
    assert get_command(ground, other).record.sent_after_ticks == -1


def test_commands_are_listed_newest_first_by_pages_and_by_state(ground):
    ids = [entered(ground, "test_connection") for _ in range(4)]
    release_command(ground, ids[1], actor="ann")

    def listed(**which):
        page = ground.read(list_telecommands, TelecommandFilter(**which))
        return [int(view.id) for view in page.items], page.total

    assert listed() == (ids[::-1], 4)
    assert listed(limit=2, offset=1) == ([ids[2], ids[1]], 4)
    assert listed(state="queued") == ([ids[3], ids[2], ids[0]], 3)
    assert listed(state="released") == ([ids[1]], 1)


def test_a_list_of_sent_commands_takes_as_many_statements_as_one_and_released_ones_are_counted_without_them(ground):
    statements = []
    event.listen(ground.database.engine, "before_cursor_execute", lambda *given: statements.append(given[2]))
    counts, works = [], []
    for _ in range(12):
        sent(ground)
        statements.clear()
        ground.read(list_telecommands, TelecommandFilter())
        counts.append(len(statements))
        with ground.database.reading() as connection:
            works.append(steps_of(connection, lambda given: count_released(given, SPACECRAFT, "flight", 0))[1])
    assert len(set(counts)) == 1 and works[-1] <= works[0] + 1


def test_the_state_of_a_telecommand_takes_no_more_work_with_a_hundred_times_the_housekeeping(ground, tmp_path):
    command, table, steps = sent(ground), repository.SAMPLES["housekeeping"], []
    request = {"request_id": get_command(ground, command).record.request_id}
    downlink(ground, tmp_path, ("verification_accepted", 10**6, request))
    for rows in range(20), range(20, 2000):
        with ground.database.writing() as connection:
            version = readable_version(connection, 1)
            mine = dict.fromkeys(table.c.keys(), 1) | {"dictionary_version": version}
            connection.execute(table.insert(), [mine | {"ticks": k, "packet_id": 10 + k} for k in rows])
        with ground.database.reading() as connection:
            view, work = steps_of(connection, lambda given: get_view(given, command, 0))
        assert view.state == "accepted"
        steps.append(work)
    assert steps[0] > 10 and steps[1] < 1.1 * steps[0]


def test_time_outs_are_noted_from_the_first_instant_asked_for_to_before_the_last(ground, clock):
    command = sent(ground)
    due = NOW + 600 * 10**9
    clock(due + 1)
    assert note_timeouts(ground, due + 1, due + 100) == []
    assert note_timeouts(ground, 0, due) == []
    assert note_timeouts(ground, due, due + 1) == [command]
    assert get_command(ground, command).record.timeout_noted_utc_ns == due + 1
    assert notes(ground, command)[-1] == ("service", "time out telecommand", {"state": "sent", "timeout_s": 600})
    assert note_timeouts(ground, 0, due + 100) == []


def vehicle_of(ground):
    command = entered(ground, "test_connection")
    return int(get_command(ground, command).record.vehicle_id)


def test_an_activity_carries_the_octets_of_its_telecommand(ground, clock):
    vehicle = vehicle_of(ground)
    outer = ground.write(
        commanding.add_scheduled, vehicle, "perform_function", START, release_ticks=65_536, actor="ann", timeout_s=77,
        window_id=5,
    )  # fmt: skip
    carrier, inner = get_command(ground, outer).record, get_command(ground, outer - 1).record
    octets = DICTIONARY.pack_command("perform_function", START, sequence_count=0)
    expected = {
        "name": "perform_function", "arguments": START, "state": "carried", "requested_by": "ann", "timeout_s": 77,
        "window_id": 5, "carrier_id": outer, "sequence_count": 0, "octets": octets, "decided_by": "ann",
        "decided_utc_ns": NOW, "request_id": int.from_bytes(octets[:4], "big"),
    }  # fmt: skip
    assert subset(inner, expected) == expected
    arguments = {"release_ticks": 65_536, "items": [{"octet": octet} for octet in octets]}
    expected = {
        "name": "insert_activity", "arguments": arguments, "state": "released", "requested_by": "ann",
        "timeout_s": 77, "window_id": 5, "carrier_id": None, "sequence_count": 1, "decided_by": "ann",
        "octets": DICTIONARY.pack_command("insert_activity", arguments, sequence_count=1),
    }  # fmt: skip
    assert subset(carrier, expected) == expected
    released = [get_command(ground, key).telecommand.release for key in (outer, outer - 1)]
    assert released == ["1999-12-31T23:59:29.000000Z", None]  # 2000-01-01 TAI, and 1 s
    clock(NOW + 9)
    assert uplinked(ground, actor="bob")[1] == [outer]
    # What is inside is sent with its carrier.
    inner = get_command(ground, outer - 1).record
    assert (inner.state, inner.sent_utc_ns, inner.sent_after_ticks) == ("sent", NOW + 9, -1)


REBOOT = {"function_id": "reboot", "argument_1": 0.0, "argument_2": 0.0}


@mark.parametrize(
    "approval, released",
    [(None, False), (commanding.Approval("ann", "ann"), False), (commanding.Approval("ann", "bob"), True)],
)
def test_a_telecommand_released_at_once_needs_an_approval_by_two_persons(ground, approval, released):
    vehicle = vehicle_of(ground)

    def add(name, arguments, work=commanding.add_released, **options):
        given = {"actor": "ann", "timeout_s": 50, "window_id": 3, "approval": approval}
        return ground.write(work, vehicle, name, arguments, **given, **options)

    def schedule():
        return add("perform_function", REBOOT, commanding.add_scheduled, release_ticks=1)

    if released:
        row = get_command(ground, add("perform_function", REBOOT)).record
        assert (row.state, row.critical, row.timeout_s, row.window_id) == ("released", 1, 50, 3)
        assert get_command(ground, schedule()).record.critical == 1
    else:
        for work in lambda: add("perform_function", REBOOT), schedule:
            with raises(Conflict, match=r"telecommand perform_function: .*critical"):
                work()
        assert ground.read(list_telecommands, TelecommandFilter()).total == 1
    # A routine command needs nobody.
    row = get_command(ground, add("test_connection", {})).record
    assert (row.state, row.critical) == ("released", 0)


def test_the_count_of_telecommands_wraps(ground):
    vehicle_of(ground)
    release_command(ground, 1, actor="ann")
    with ground.database.writing() as connection:
        connection.execute(update(repository.COMMAND_COUNTERS).values(telecommands=16_384))
    command = entered(ground, "test_connection")
    release_command(ground, command, actor="ann")
    row = get_command(ground, command).record
    assert row.sequence_count == 0 and row.octets == DICTIONARY.pack_command("test_connection", {}, sequence_count=0)


def test_nothing_is_released_or_sent_while_a_spacecraft_is_on_hold(either):
    released, queued = entered(either), entered(either)
    release_command(either, released, actor="ann")
    held = hold_spacecraft(either, SPACECRAFT, "flight", reason="antenna", actor="bob")
    assert (held.held_by, held.hold_reason) == ("bob", "antenna")
    with raises(Conflict, match=r"spacecraft 76 \(flight\): on hold by bob since .*: antenna"):
        release_command(either, queued, actor="ann")
    with raises(Conflict, match="on hold by bob"):
        uplinked(either)
    with either.database.writing() as connection:
        vehicle = get_command(either, released).record.vehicle_id
        assert take_released(connection, vehicle, SPACECRAFT, framed=True, actor="link") == (b"", [])
    with raises(Conflict, match="on hold by bob"):
        hold_spacecraft(either, SPACECRAFT, "flight", reason="again", actor="ann")
    assert resume_spacecraft(either, SPACECRAFT, "flight", actor="ann").held_by is None
    release_command(either, queued, actor="ann")
    assert uplinked(either)[1] == [released, queued]
    with raises(Conflict, match="expected a hold, found none"):
        resume_spacecraft(either, SPACECRAFT, "flight", actor="ann")


def test_a_hold_keeps_the_note_and_a_note_keeps_the_hold(ground):
    entered(ground)
    change_handover(ground, SPACECRAFT, "flight", "camera warm", actor="ann")
    hold_spacecraft(ground, SPACECRAFT, "flight", reason="antenna", actor="bob")
    change_handover(ground, SPACECRAFT, "flight", "camera cold", actor="eva")
    (found,) = ground.read(list_handovers, HandoverFilter(spacecraft_id=SPACECRAFT)).items
    assert (found.note, found.noted_by, found.held_by, found.hold_reason) == (
        "camera cold", "eva", "bob", "antenna",
    )  # fmt: skip
    assert ground.read(list_handovers, HandoverFilter(spacecraft_id=77)).items == []


def test_telecommands_of_windows_are_listed(ground):
    entered(ground)
    assert ground.read(list_telecommands, TelecommandFilter(window_id=[1, 2])).items == []
    assert len(ground.read(list_telecommands, TelecommandFilter()).items) == 1


needs = Approval().needs_second_person


def test_whatever_is_not_routine_needs_a_second_person():
    assert all(needs(subject) == (one.effect is not Effect.ROUTINE) for subject, one in EFFECTS.items())
    critical = (
        "set_parameter uplink_first disable_schedule delete_activity perform_function/set_mode "
        "perform_function/synchronise_clock perform_function/reboot delete_store"
    )
    assert all(map(needs, critical.split()))
    routine = "test_connection enable_schedule perform_function/start_observation replay_store"
    assert not any(map(needs, routine.split()))


def test_a_mission_can_raise_and_relax_the_rule():
    rules = Approval(second_person_for=("replay_store",), one_person_for=("perform_function/set_mode",))
    subjects = "replay_store perform_function/set_mode set_parameter"
    assert [*map(rules.needs_second_person, subjects.split())] == [True, False, True]
    # An unknown one needs a second person whatever the mission states.
    assert Approval(one_person_for=tuple(EFFECTS)).needs_second_person("new_command")


REQUEST = 0x18A0C005
SENT_NS, TIMEOUT_NS = 5_000, 600
COMMAND = SentCommand(REQUEST, SENT_NS, 100, 200, TIMEOUT_NS)


def report(subtype, ticks=150, request=REQUEST, step=None):
    return VerificationReport(subtype, request, ticks, step, None)


def test_the_subtypes_are_those_of_the_standard():
    assert STAGES == {
        1: "accepted", 2: "not accepted", 3: "started", 4: "not started", 5: "progress", 6: "progress failed",
        7: "completed", 8: "not completed", 10: "not routed",
    }  # fmt: skip
    assert FAILURES == (2, 4, 6, 8, 10)


def test_every_set_of_reports_has_the_state_of_its_worst_or_furthest_one():
    for count in range(len(STAGES) + 1):
        for subtypes in combinations(STAGES, count):
            seen = set(subtypes)
            if seen & {2, 4, 6, 8, 10}:
                expected = "failed"
            elif 7 in seen:
                expected = "completed"
            elif 3 in seen or 5 in seen:
                expected = "started"
            else:
                expected = "accepted" if 1 in seen else "sent"
            found = fate_of(COMMAND, [report(subtype) for subtype in subtypes], SENT_NS + TIMEOUT_NS + 1)
            assert found.state == expected, subtypes
            assert found.timed_out is (expected not in ("failed", "completed")), subtypes


@mark.parametrize("now_ns, overdue", [(SENT_NS + TIMEOUT_NS, False), (SENT_NS + TIMEOUT_NS + 1, True)])
def test_a_command_is_overdue_after_its_time_out_and_not_at_it(now_ns, overdue):
    assert fate_of(COMMAND, [], now_ns).timed_out is overdue


@mark.parametrize("ticks, counts", [(100, False), (101, True), (200, True), (201, False)])
def test_reports_made_between_sending_and_sending_again_count(ticks, counts):
    assert (fate_of(COMMAND, [report(7, ticks)], 0).state == "completed") is counts
    assert (fate_of(COMMAND, [report(7, ticks)], 0).reports == (report(7, ticks),)) is counts


def test_reports_are_in_order_and_those_of_other_requests_or_after_no_repetition_do_not_count():
    once = SentCommand(REQUEST, SENT_NS, 100, None, TIMEOUT_NS)
    assert fate_of(once, [report(7, 10**12)], 0).state == "completed"
    assert fate_of(COMMAND, [report(7, request=REQUEST + 1)], 0).reports == ()
    ordered = [
        report(1, 110), report(3, 110), report(5, 120), report(5, 120, step=1), report(5, 120, step=2),
        report(7, 130),
    ]  # fmt: skip
    assert fate_of(COMMAND, ordered[::-1], 0).reports == tuple(ordered)
