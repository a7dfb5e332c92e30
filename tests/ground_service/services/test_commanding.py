"""Telecommands: validation, release by two persons, uplink, and what the reports say became of them."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import select

from ground_service.errors import Conflict, InvalidInput, NotFound
from ground_service.processing.verification import SentCommand, VerificationReport, fate_of
from ground_service.services import commanding
from ground_service.services.commanding import (
    enter_command,
    get_command,
    list_commands,
    note_timeouts,
    reject_command,
    release_command,
    take_uplink,
)
from ground_service.services.feed import read_feed
from ground_service.services.ground import Ground
from ground_service.services.ingest import ingest_file
from ground_service.services.planning import (
    WindowEntry,
    add_window,
    change_window,
    list_windows,
    uplink_window,
)
from ground_service.store import repository
from lunar.timescales import parse_utc
from tmtc.dictionary import DICTIONARY
from tmtc.stream import cut_packets
from tmtc.uplink import UplinkDecoder

SPACECRAFT = 76
START = {"function_id": "start_observation", "argument_1": 600.0, "argument_2": 15.0}


def entered(ground: Ground, name: str = "perform_function", actor: str = "ann", **arguments: Any) -> int:
    given = arguments or (START if name == "perform_function" else {})
    return enter_command(ground, name, given, spacecraft_id=SPACECRAFT, actor=actor)


def sent(ground: Ground, actor: str = "ann") -> int:
    command = entered(ground, actor=actor)
    release_command(ground, command, actor=actor)
    take_uplink(ground, spacecraft_id=SPACECRAFT, actor=actor)
    return command


def downlink(ground: Ground, folder: Path, *reports: tuple[str, int, dict[str, Any]]) -> None:
    path = folder / "reports.bin"
    path.write_bytes(
        b"".join(
            DICTIONARY.pack(name, values, ticks=ticks, sequence_count=ticks % 16384)
            for name, ticks, values in reports
        )
    )
    ingest_file(ground, path, spacecraft_id=SPACECRAFT)


def test_a_command_goes_its_way_from_the_queue_to_its_completion(ground: Ground, tmp_path: Path) -> None:
    command = entered(ground)
    assert get_command(ground, command).state == "queued"
    release_command(ground, command, actor="ann")
    stream, ids = take_uplink(ground, spacecraft_id=SPACECRAFT, actor="ann")
    assert ids == [command]
    view = get_command(ground, command)
    assert view.state == "sent"
    request = {"request_id": view.row["request_id"]}
    downlink(ground, tmp_path, ("verification_accepted", 1000, request))
    assert get_command(ground, command).state == "accepted"
    downlink(
        ground, tmp_path, ("verification_completed", 3000, request), ("verification_started", 2000, request)
    )
    view = get_command(ground, command)
    assert view.state == "completed"
    assert view.fate is not None
    assert [report.subtype for report in view.fate.reports] == [1, 3, 7]
    assert take_uplink(ground, spacecraft_id=SPACECRAFT, actor="ann") == (b"", [])
    # the receiver at the other end gets the very packet
    decoded = UplinkDecoder(SPACECRAFT).decode(stream)
    assert list(decoded.packets) == [view.row["octets"]]


def test_bare_packets_can_be_taken_instead_of_frames(ground: Ground) -> None:
    for _ in range(3):
        release_command(ground, entered(ground, "test_connection"), actor="ann")
    stream, ids = take_uplink(ground, spacecraft_id=SPACECRAFT, framed=False, actor="ann")
    cut = cut_packets(stream, packet_type=1)
    assert len(cut) == len(ids) == 3
    counts = [DICTIONARY.unpack_command(packet).sequence_count for packet in cut.packets(stream)]
    assert counts == [0, 1, 2]


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("self_destruct", {}, "name: expected one of the 27 telecommands of the dictionary"),
        (
            "perform_function",
            {"function_id": "dance", "argument_1": 0, "argument_2": 0},
            "function_id: expected one of",
        ),
        ("perform_function", {"function_id": 1}, "argument_1: expected a value"),
        ("set_housekeeping_interval", {"structure_id": 1, "interval_s": 0}, "interval_s: expected"),
        ("set_parameter", {"parameter_id": "x", "value": []}, "expected"),
        ("test_connection", {"extra": 1}, "no such field"),
        *(
            (
                "set_parameter",
                {"parameter_id": 1, "value": value},
                "set_parameter.value: expected a finite number",
            )
            for value in (float("nan"), float("inf"), -float("inf"), 1e400, True, False)
        ),
        (
            "set_parameter",
            {"parameter_id": True, "value": 1.0},
            "parameter_id: expected a finite number, found True",
        ),
        ("set_parameter", {"parameter_id": 1, "value": 10**400}, "value: expected a number"),
        (
            "set_housekeeping_interval",
            {"structure_id": 1, "interval_s": True},
            "interval_s: expected a finite number",
        ),
        ("delete_activity", {"request_id": -1}, "request_id: expected"),
        ("delete_activity", {"request_id": 1e20}, "request_id: expected"),
        (
            "insert_activity",
            {"release_ticks": 1, "items": [{"octet": 1}, {"octet": True}]},
            "items.octet: expected a finite number",
        ),
        ("test_connection\x00", {}, "name: expected one of the 27 telecommands of the dictionary"),
    ],
)
def test_what_the_dictionary_refuses_is_not_queued(
    ground: Ground, name: str, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(InvalidInput, match=message):
        enter_command(ground, name, arguments, spacecraft_id=SPACECRAFT, actor="ann")
    assert list_commands(ground)[1] == 0


@pytest.mark.parametrize("function", ["reboot", 7])
def test_a_critical_command_needs_a_second_person(ground: Ground, function: Any) -> None:
    command = entered(ground, function_id=function, argument_1=0.0, argument_2=0.0)
    with pytest.raises(Conflict, match="critical; expected a person other than ann"):
        release_command(ground, command, actor="ann")
    release_command(ground, command, actor="bob")
    assert get_command(ground, command).row["decided_by"] == "bob"


def test_only_a_queued_command_can_be_decided_on(ground: Ground) -> None:
    command = entered(ground)
    reject_command(ground, command, actor="bob", reason="wrong cadence")
    assert get_command(ground, command).row["reason"] == "wrong cadence"
    for decide in (
        lambda: release_command(ground, command, actor="bob"),
        lambda: reject_command(ground, command, actor="bob", reason="again"),
    ):
        with pytest.raises(Conflict, match="expected state queued, found rejected"):
            decide()
    with pytest.raises(NotFound):
        release_command(ground, 99, actor="bob")
    assert take_uplink(ground, spacecraft_id=SPACECRAFT, actor="ann") == (b"", [])


def test_every_step_is_in_the_audit_log(ground: Ground) -> None:
    command = sent(ground)
    with ground.database.reading() as connection:
        rows = connection.execute(
            select(repository.AUDIT.c.action, repository.AUDIT.c.actor).where(
                repository.AUDIT.c.target == str(command)
            )
        ).all()
    assert [tuple(row) for row in rows] == [
        ("enter telecommand", "ann"),
        ("release telecommand", "ann"),
        ("send telecommand", "ann"),
    ]


def test_a_failure_says_why(ground: Ground, tmp_path: Path) -> None:
    command = sent(ground)
    request = get_command(ground, command).row["request_id"]
    downlink(
        ground,
        tmp_path,
        ("verification_not_accepted", 500, {"request_id": request, "failure_code": "wrong_mode"}),
    )
    view = get_command(ground, command)
    assert view.state == "failed"
    assert view.fate is not None
    assert view.fate.reports[0].failure_code == 5


REQUEST = 0x18A0C000
COMMAND = SentCommand(REQUEST, sent_utc_ns=0, sent_after_ticks=100, repeated_after_ticks=None, timeout_ns=10)


def report(subtype: int, ticks: int, request: int = REQUEST) -> VerificationReport:
    return VerificationReport(subtype, request, ticks, None, None)


def test_reports_of_an_earlier_or_later_command_with_the_same_count_do_not_count() -> None:
    earlier, own, later = report(7, 100), report(1, 101), report(7, 201)
    again = SentCommand(REQUEST, 0, 100, 200, 10)
    assert fate_of(again, [earlier, own, later], 0).state == "accepted"
    assert fate_of(COMMAND, [report(7, 150, REQUEST + 1)], 0).state == "sent"


def test_a_command_whose_end_is_overdue_is_timed_out_until_late_reports_come() -> None:
    assert not fate_of(COMMAND, [], 10).timed_out
    assert fate_of(COMMAND, [report(1, 150)], 11).timed_out
    late = fate_of(COMMAND, [report(1, 150), report(7, 900)], 11)
    assert (late.state, late.timed_out) == ("completed", False)


def test_a_time_out_is_put_on_record_once_and_stays_there(
    ground: Ground, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    silent, completed = sent(ground), sent(ground)
    request = {"request_id": get_command(ground, completed).row["request_id"]}
    downlink(ground, tmp_path, ("verification_completed", 3000, request))
    due = get_command(ground, silent).row["sent_utc_ns"] + 600 * 10**9

    def noted(now: int) -> list[int]:
        monkeypatch.setattr("ground_service.services.command_state.utc_now_ns", lambda: now)
        return note_timeouts(ground, 0, now)

    assert noted(due - 1) == []
    assert noted(due + 10**9) == [silent]
    assert noted(due + 2 * 10**9) == []
    late = {"request_id": get_command(ground, silent).row["request_id"]}
    downlink(ground, tmp_path, ("verification_completed", 9000, late))
    assert (get_command(ground, silent).state, noted(due + 3 * 10**9)) == ("completed", [])
    with ground.database.reading() as connection:
        record = repository.page(connection, repository.AUDIT, action="time out telecommand").rows
    assert [(row["actor"], row["target"], row["detail"]["state"]) for row in record] == [
        ("service", str(silent), "sent")
    ]
    assert {"id": silent, "state": "timed out"} in [item["payload"] for item in read_feed(ground, 0)]


@given(st.lists(st.sampled_from([1, 3, 5, 7]), unique=True), st.randoms())
def test_the_order_in_which_reports_arrive_does_not_matter(subtypes: list[int], random: Any) -> None:
    reports = [report(subtype, 100 + subtype) for subtype in subtypes]
    shuffled = list(reports)
    random.shuffle(shuffled)
    assert fate_of(COMMAND, shuffled, 0) == fate_of(COMMAND, reports, 0)


@pytest.mark.parametrize("spacecraft_id", [-1, 1024, 10**20, True])
def test_an_id_that_no_transfer_frame_can_carry_is_refused(ground: Ground, spacecraft_id: int) -> None:
    for work in (
        lambda: enter_command(ground, "test_connection", {}, spacecraft_id=spacecraft_id, actor="ann"),
        lambda: take_uplink(ground, spacecraft_id=spacecraft_id, actor="ann"),
    ):
        with pytest.raises(InvalidInput, match="spacecraft, id: expected 0 to 1023"):
            work()


@pytest.mark.parametrize("reason", ["", "two\nlines", "\x1b[2Jgone", "nul\x00", "x" * 501])
def test_a_reason_is_one_printable_line(ground: Ground, reason: str) -> None:
    command = entered(ground)
    with pytest.raises(InvalidInput, match="reason: expected a line of 1 to 500 characters"):
        reject_command(ground, command, actor="bob", reason=reason)
    assert get_command(ground, command).state == "queued"


def test_arguments_nested_without_end_are_refused(ground: Ground) -> None:
    nested: Any = 1
    for _ in range(3000):
        nested = [nested]
    with pytest.raises(InvalidInput, match="set_parameter"):
        entered(ground, "set_parameter", parameter_id=1, value=nested)


def test_an_instance_is_one_printable_line(ground: Ground) -> None:
    with pytest.raises(InvalidInput, match="spacecraft, instance"):
        enter_command(ground, "test_connection", {}, spacecraft_id=1, instance="a\nb", actor="ann")


def carrying(name: str, **arguments: Any) -> dict[str, Any]:
    octets = DICTIONARY.pack_command(name, arguments, sequence_count=0)
    return {"release_ticks": 1, "items": [{"octet": octet} for octet in octets]}


@pytest.mark.parametrize(
    ("name", "arguments", "critical"),
    [
        ("set_parameter", {"parameter_id": 1, "value": 2.0}, True),
        ("disable_schedule", {}, True),
        ("perform_function", {"function_id": "set_mode", "argument_1": 1, "argument_2": 0}, True),
        ("perform_function", {"function_id": "synchronise_clock", "argument_1": 0, "argument_2": 0}, True),
        ("uplink_first", {"transaction": 1, "part": 1, "table": "parameters", "items": [{"octet": 1}]}, True),
        ("insert_activity", carrying("set_parameter", parameter_id=1, value=2.0), True),
        ("insert_activity", carrying("perform_function", **START), False),
        ("perform_function", START, False),
        ("enable_schedule", {}, False),
        ("test_connection", {}, False),
    ],
)
def test_what_changes_the_state_of_the_payload_needs_a_second_person(
    ground: Ground, name: str, arguments: dict[str, Any], critical: bool
) -> None:
    command = enter_command(ground, name, arguments, spacecraft_id=SPACECRAFT, actor="ann")
    assert bool(get_command(ground, command).row["critical"]) == critical
    if critical:
        with pytest.raises(
            Conflict, match=r"critical; expected .* \((changes on-board state|destroys data): "
        ):
            release_command(ground, command, actor="ann")
        release_command(ground, command, actor="bob")
    else:
        release_command(ground, command, actor="ann")
    assert get_command(ground, command).state == "released"


def raise_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = commanding.DEFAULT_POLICY.raised("perform_function/start_observation")
    monkeypatch.setattr(commanding, "policy_of", lambda *_: policy)


def planned(ground: Ground, entered_by: str, approved_by: str) -> int:
    start = parse_utc("2029-08-07T06:00:00Z")
    entry = WindowEntry("window", start, start + 600 * 10**9, 15.0, SPACECRAFT)
    window = int(add_window(ground, entry, actor=entered_by)["id"])
    change_window(ground, window, actor=approved_by, changes={}, decision="approved")
    return window


def test_one_person_plans_approves_and_uplinks_a_routine_window(ground: Ground) -> None:
    assert len(uplink_window(ground, planned(ground, "ann", "ann"), actor="ann")) == 3


def test_the_approval_of_a_window_by_somebody_else_is_the_second_person_of_its_telecommands(
    ground: Ground, monkeypatch: pytest.MonkeyPatch
) -> None:
    raise_rule(monkeypatch)
    with pytest.raises(Conflict, match="expected a window that a second person has approved"):
        uplink_window(ground, planned(ground, "ann", "ann"), actor="bob")
    assert list_commands(ground)[1] == 0
    [window] = [row["id"] for row in list_windows(ground)[0]]
    change_window(ground, window, actor="bob", changes={}, decision="draft")
    change_window(ground, window, actor="bob", changes={}, decision="approved")
    assert len(uplink_window(ground, window, actor="ann")) == 3


def test_who_changes_a_window_has_entered_it(ground: Ground, monkeypatch: pytest.MonkeyPatch) -> None:
    raise_rule(monkeypatch)
    start = parse_utc("2029-08-07T06:00:00Z")
    entry = WindowEntry("window", start, start + 600 * 10**9, 15.0, SPACECRAFT)
    window = int(add_window(ground, entry, actor="ann")["id"])
    change_window(ground, window, actor="bob", changes={"cadence_s": 20.0}, decision="approved")
    with pytest.raises(Conflict, match="a second person"):
        uplink_window(ground, window, actor="ann")
