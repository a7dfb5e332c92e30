"""Windows in the past, of unknown spacecraft, and those that are taken back from the spacecraft; on both databases."""

from unittest.mock import MagicMock

import numpy as np
from pytest import approx, raises

from ground_service.contacts.commanding.service import get_command, take_uplink
from ground_service.errors import Conflict, PlanConflicts
from ground_service.ingest.service import ingest_file
from ground_service.missions.service import add_mission
from ground_service.passes.model import PassFilter
from ground_service.passes.store import list_passes
from ground_service.planning import service as planning
from ground_service.planning import standing
from ground_service.planning.forecast import get_forecast
from ground_service.planning.model import WindowEntry, WindowSearch
from ground_service.planning.store import get_window
from ground_service.worker.scheduler import Scheduler
from linna.cli import run
from lunar.ephemeris import Ephemeris, ephemeris_from_states
from lunar.messages.oem import save_oem
from lunar.timescales import format_utc, ticks_from_utc_ns
from tests.ground_service.conftest import START, add_reference, circular_states, event_packet, save_circle
from tmtc.dictionary.payload import DICTIONARY

NS = 10**9
MINUTE = 60 * NS
MISSION = b'name = "m"\n[spacecraft]\nid = 76\nname = "SelenITA"\n'


def add(ground, start=START + 60 * MINUTE, spacecraft=76):
    return planning.add_window(ground, WindowEntry("w", start, start + 10 * MINUTE, 15.0, spacecraft), actor="ann")


def decided(ground, window, decision):
    return planning.change_window(ground, window.id, actor="bob", changes={}, decision=decision)


def on_board(ground):
    """A window whose telecommands were sent."""
    add_mission(ground, MISSION)
    window = decided(ground, add(ground), "approved")
    planning.uplink_window(ground, window.id, actor="ann")
    take_uplink(ground, spacecraft_id=76, actor="ann")
    assert ground.read(get_window, window.id).state == "uplinked"
    return window


def receive(ground, *packets):
    file = ground.home / f"{abs(hash(packets))}.packets"
    file.write_bytes(b"".join(packets))
    ingest_file(ground, file, spacecraft_id=76)


def records(ground, window):
    return [get_command(ground, key).record for key in window.telecommands]


def verified(ground, window, after, outcome="verification_completed"):
    """Reports of the telecommands of a window that delete activities."""
    found = records(ground, ground.read(get_window, window.id))
    values = {} if outcome == "verification_completed" else {"failure_code": "no_such_activity"}
    return [
        DICTIONARY.pack(outcome, {"request_id": one.request_id, **values}, ticks=after, sequence_count=k)
        for k, one in enumerate(found)
        if one.name == "delete_activity"
    ]


def test_a_window_that_has_begun_is_neither_entered_nor_approved_nor_released(either, now):
    add_mission(either, MISSION)
    with raises(PlanConflicts, match="expected a start after the mission time 2029-08-07T06:00:00"):
        add(either, START)
    window = add(either)
    now.utc_ns += 61 * MINUTE
    with raises(PlanConflicts, match="expected a start after the mission time"):
        decided(either, window, "approved")
    now.utc_ns = START
    decided(either, window, "approved")
    now.utc_ns += 61 * MINUTE
    with raises(Conflict, match=r"began at 2029-08-07T07:00:00.*its telecommands are not sent"):
        planning.uplink_window(either, window.id, actor="ann")


def test_a_draft_whose_time_has_come_ends(either, now):
    add_mission(either, MISSION)
    window = add(either)
    scheduler = Scheduler(either, MagicMock(), lambda: None, {})
    scheduler.tick()
    assert either.read(get_window, window.id).state == "draft"
    now.utc_ns += 61 * MINUTE
    scheduler.tick()
    ended = either.read(get_window, window.id)
    assert (ended.state, ended.reason) == ("failed", standing.NOT_APPROVED)


def test_nothing_to_send_is_status_2_and_no_file(ground, tmp_path, capsys, now):
    window = on_board(ground)
    out = tmp_path / "w.cltu"
    assert run(["plan", "uplink", str(window.id), "--home", str(ground.home), "--out", str(out)]) == 2
    assert run(["command", "uplink", "--spacecraft-id", "76", "--home", str(ground.home), "--out", str(out)]) == 1
    assert "nothing to send: its telecommands are sent" in capsys.readouterr().err
    assert not out.exists()


def test_candidates_in_the_past_are_not_offered(ground, tmp_path, now):
    add_reference(ground, save_circle(tmp_path / "a.oem"))
    now.utc_ns = START + 30 * MINUTE
    found = planning.search_windows(ground, WindowSearch())
    assert found.candidates and min(one.start.utc_ns for one in found.candidates) >= now.utc_ns
    now.utc_ns += 86_400 * NS
    with raises(Conflict, match="expected a span that ends after the mission time"):
        planning.search_windows(ground, WindowSearch())


def test_a_spacecraft_without_a_description_is_not_planned(either, now):
    add_mission(either, MISSION)
    with raises(Conflict, match=r"spacecraft 77: .*states \(76\), found none"):
        add(either, spacecraft=77)
    with raises(Conflict, match=r"spacecraft 77"):
        planning.search_windows(either, WindowSearch(spacecraft_id=77))
    with raises(Conflict, match=r"spacecraft 77"):
        get_forecast(either, spacecraft_id=77, instance="flight", start_utc_ns=START, stop_utc_ns=START + MINUTE)


def test_a_window_on_board_is_cancelling_until_its_activities_are_deleted(either, now):
    window = on_board(either)
    cancelled = decided(either, window, "failed")
    assert cancelled.state == "cancelling"
    commands = records(either, cancelled)
    deleted = [one.arguments["request_id"] for one in commands if one.name == "delete_activity"]
    assert deleted == [one.request_id for one in commands if one.carrier_id is not None]
    assert len(deleted) == 2
    with raises(Conflict):  # it still has its time
        decided(either, add(either), "approved")
    take_uplink(either, spacecraft_id=76, actor="ann")
    receive(either, *verified(either, window, int(ticks_from_utc_ns(START + MINUTE))))
    ended = either.read(get_window, window.id)
    assert (ended.state, ended.reason) == ("failed", "it was cancelled, its activities were deleted on board")


def test_a_cancelled_window_that_flies_all_the_same_becomes_a_pass_with_a_remark(either, now):
    window = on_board(either)
    decided(either, window, "failed")
    take_uplink(either, spacecraft_id=76, actor="ann")
    ticks = int(ticks_from_utc_ns(START + MINUTE))
    receive(either, *verified(either, window, ticks, "verification_not_completed"))
    found = either.read(get_window, window.id)
    assert found.state == "cancelling" and "no such activity" in (found.reason or "")
    start = int(ticks_from_utc_ns(START + 60 * MINUTE))
    now.utc_ns += 61 * MINUTE
    state = {"frame_number": 0, "image_ticks": start + 9, "image_quality": 0, "items": []}
    frame = DICTIONARY.pack("detections", state, ticks=start + 99, sequence_count=0)
    receive(either, event_packet(start, 0, "observation_started"), frame)
    found = either.read(get_window, window.id)
    assert (found.state, found.reason) == ("executing", "it was flown although it was cancelled")
    [made] = either.read(list_passes, PassFilter(limit=9)).items
    assert made.name == "w (it was flown although it was cancelled)"


def test_a_window_that_has_begun_on_board_cannot_be_cancelled(either, now):
    window = on_board(either)
    now.utc_ns += 61 * MINUTE
    for state in "uplinked", "executing":
        assert either.read(get_window, window.id).state == state
        with raises(Conflict, match="too late to delete its activities; perform_function stop_observation"):
            decided(either, window, "failed")
        receive(either, event_packet(int(ticks_from_utc_ns(window.start.utc_ns)), 0, "observation_started"))


def save_with_hole(path):
    """Write an ephemeris of four hours without the second one."""
    utc_ns = START + np.arange(0, 240, dtype=np.int64) * MINUTE
    parts = [ephemeris_from_states(times, *circular_states(times)).segments[0] for times in (utc_ns[:60], utc_ns[120:])]
    save_oem(Ephemeris(tuple(parts)), path)
    return path


def test_a_search_goes_around_a_hole_or_takes_the_ephemeris_that_has_none(ground, tmp_path, now):
    hole = add_reference(ground, save_with_hole(tmp_path / "hole.oem"))
    span = {"start": format_utc(START), "stop": format_utc(START + 239 * MINUTE)}
    asked = WindowSearch.model_validate(span)
    found = planning.search_windows(ground, asked)
    assert found.ephemeris_id == hole and found.candidates
    inside = (START + 60 * MINUTE, START + 119 * MINUTE)
    assert not [one for one in found.candidates if one.start.utc_ns < inside[1] and one.stop.utc_ns > inside[0]]
    assert "without 1 spans that it does not cover" in found.data[0]
    whole = add_reference(ground, save_circle(tmp_path / "whole.oem"))
    assert add_reference(ground, save_with_hole(tmp_path / "hole2.oem")) in (hole, whole + 1)
    assert planning.search_windows(ground, asked).ephemeris_id == whole


def test_a_first_window_is_as_long_as_the_error_of_its_coast_requires():
    """1,750 km s over the duration: 3.5 km need 500 s, and a longer stated duration stays."""
    assert WindowSearch(first_coast_m=3_500.0).constraints().minimum_duration_s == approx(500.0)
    assert WindowSearch(first_coast_m=1e6).constraints().minimum_duration_s == 300.0
    assert WindowSearch().constraints().minimum_duration_s == 300.0
