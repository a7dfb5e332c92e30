"""Standing requests: filling, explaining, replacing, approval, and one plan of several processes, on both databases."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

from pytest import fixture, raises

from ground_service.contacts.commanding.model import TelecommandFilter
from ground_service.contacts.commanding.service import get_command, list_telecommands
from ground_service.errors import InvalidInput, NotFound, PlanConflicts
from ground_service.ground import open_ground
from ground_service.missions.service import add_mission
from ground_service.planning import service as planning
from ground_service.planning import standing, store
from ground_service.planning.model import StandingRequestChange, StandingRequestIn, WindowEntry, WindowFilter
from ground_service.planning.progress import advance_windows
from ground_service.planning.store import get_plan, get_request, get_window, list_windows
from ground_service.store.event_kinds import read_events
from ground_service.worker.follow_up import follow_in_process
from tests.ground_service.conftest import START, add_reference, save_circle
from tests.scenarios import SELENITA

NS = 10**9
HOUR = 3600 * NS
DAYS = 3

MISSION = (
    SELENITA
    + """[link.stations.here]
latitude_deg = 10.0
longitude_deg = 60.0
minimum_elevation_deg = 0.0
[link.stations.there]
latitude_deg = -10.0
longitude_deg = -120.0
minimum_elevation_deg = 0.0
{extra}
"""
)
LINKS = """[[links]]
name = "a"
kind = "tcp"
station = "here"
uplink = "127.0.0.1:9"
[[links]]
name = "b"
kind = "tcp"
station = "there"
uplink = "127.0.0.1:9"
"""
AUTOMATIC = '[approval]\nwindows = "automatic"\n'


@fixture(params=["sqlite", "postgresql"])
def either(request, tmp_path, oem):
    """A service with an ephemeris on each database, which does not follow its events: only the tests plan."""
    url = request.getfixturevalue("migrated_postgres")() if request.param == "postgresql" else None
    with open_ground(tmp_path / "home", database_url=url) as opened:
        add_reference(opened, oem)
        yield opened


@fixture
def ground(tmp_path, oem):
    """As `either`, on SQLite."""
    with open_ground(tmp_path / "home") as opened:
        add_reference(opened, oem)
        yield opened


@fixture(scope="module")
def oem(tmp_path_factory):
    path = tmp_path_factory.mktemp("oem") / "reference.oem"
    return save_circle(path, START - 3 * HOUR, 24.0 * DAYS)


def prepare(ground, extra=AUTOMATIC + LINKS):
    add_mission(ground, MISSION.format(extra=extra).encode(), actor="ann")


def windows_of(ground):
    """All windows in the order of their start."""
    return sorted(ground.read(list_windows, WindowFilter()).items, key=lambda one: one.start.utc_ns)


def request(ground, **changes):
    values = {"name": "low Sun", "spacecraft_id": 76, "windows": 2, "horizon_days": 1.0} | changes
    return standing.add_request(ground, StandingRequestIn.model_validate(values), actor="ann").id


def plan(ground, now, later_ns=0):
    """Make one step of the planning; return its counts."""
    return standing.plan_tick(ground, now.utc_ns + later_ns)


def planned(ground, now, extra=AUTOMATIC + LINKS, **changes):
    """Plan a request for the first time; return its key."""
    prepare(ground, extra)
    key = request(ground, **changes)
    plan(ground, now)
    return key


def change(ground, key, **changes):
    standing.change_request(ground, key, StandingRequestChange.model_validate(changes), actor="ann")


def test_no_more_windows_are_planned_than_have_room_on_board(ground, now):
    prepare(ground, AUTOMATIC + LINKS + "\n[resources]\nwindows_on_board = 1\n")
    key = request(ground)
    assert plan(ground, now)["added"] == 1
    left = [one.reason for one in ground.read(get_plan, key).candidates if one.outcome == "rejected"]
    assert "the telecommands of 1 windows wait on board" in left
    now.utc_ns = windows_of(ground)[0].stop.utc_ns + HOUR
    assert plan(ground, now)["added"] == 1


def test_the_coming_days_are_filled_once_and_windows_without_a_contact_are_replaced(either, now):
    prepare(either)
    key = request(either)
    done = plan(either, now)
    assert done == {"failed": 0, "added": 2, "approved": 2, "released": 2}
    windows = windows_of(either)
    assert {one.request_id for one in windows} == {key}
    for one in windows:
        assert one.state == "approved" and one.start.utc_ns >= now.utc_ns + standing.LEAD_NS
        assert one.predicted.sun_elevation_deg.min >= -0.1
    made = either.read(get_plan, key)
    assert [one.window_id for one in made.candidates if one.outcome == "planned"] == sorted(one.id for one in windows)
    left = [one.reason for one in made.candidates if one.outcome == "rejected"]
    assert left and all(left) and "the number of windows of its period is planned" in left
    assert either.read(get_request, key).windows == {"approved": 2}
    commands = either.read(list_telecommands, TelecommandFilter(state="released")).items
    assert len(commands) == 6 and all(get_command(either, one.id).record.send_before_utc_ns for one in commands)
    assert [e.payload["request_id"] for e in read_events(either.database, 0, 9999) if e.kind == "plan"] == [key]
    for later in 0, 600, 1200:
        assert sum(plan(either, now, later * NS).values()) == 0
    assert windows_of(either) == windows
    first = windows[0]
    now.utc_ns = first.start.utc_ns
    done = plan(either, now)
    assert (done["failed"], done["added"]) == (1, 1)
    failed = either.read(get_window, first.id)
    assert (failed.state, failed.reason) == ("failed", standing.NO_CONTACT)
    commands = either.read(list_telecommands, TelecommandFilter()).items
    assert {one.state for one in commands if one.window_id == first.id} == {"rejected"}
    assert either.read(get_plan, key).replaced == [{"window_id": first.id, "reason": standing.NO_CONTACT}]
    assert either.read(get_request, key).windows == {"approved": 2, "failed": 1}


def test_a_request_is_planned_without_further_action(tmp_path, oem, now):
    with open_ground(tmp_path / "home") as ground:
        add_reference(ground, oem)
        follow_in_process(ground)
        prepare(ground)
        key = request(ground, windows=2)
        assert ground.read(get_request, key).windows == {"approved": 2}
        assert sum(plan(ground, now).values()) == 0
        change(ground, key, terms={"windows": 2, "horizon_days": 1.0})  # planned again, and they still count
        assert ground.read(get_request, key).windows == {"approved": 2}
        assert sum(plan(ground, now).values()) == 0
        found = ground.read(store.get_request_record, key)
        assert standing._first_needed(found, now.utc_ns + 30 * HOUR) == found.anchor_utc_ns
        assert [ground.write(store.claim_plan, found) for _ in range(2)] == [True, False]


def test_data_of_a_replaced_window_belong_to_the_window_that_has_its_time(either, now, monkeypatch):
    planned(either, now)
    first = windows_of(either)[0]
    window = either.read(store.get_record, first.id)
    assert either.write(store.change_window, window, state="failed", reason="a telecommand of it failed")
    assert plan(either, now)["added"] == 1
    second = max(windows_of(either), key=lambda one: one.id)
    assert (second.start, second.stop) == (first.start, first.stop)
    monkeypatch.setattr("ground_service.planning.progress.received_frames", lambda *_: 5)
    advance_windows(either, 1)
    found = [either.read(get_window, one.id) for one in (first, second)]
    assert [one.state for one in found] == ["failed", "executing"]
    assert found[0].pass_id is None and found[1].pass_id is not None
    assert found[0].reason == "a telecommand of it failed"


def test_windows_of_the_present_period_count_long_after_they_ended(ground, now):
    key = planned(ground, now, windows=1)
    (window,) = ground.read(store.windows_around, 1, now.utc_ns)
    assert ground.write(store.change_window, window, state="processed")
    later = window.stop.utc_ns + 30 * HOUR
    assert ground.read(store.windows_around, 1, later) == []
    assert standing.plan_tick(ground, later)["added"] == 0
    change(ground, key, terms={"windows": 1, "period_days": 1.0, "horizon_days": 1.0})
    assert standing.plan_tick(ground, later)["added"] >= 1  # that window belongs to an earlier period


def test_without_automatic_approval_windows_wait_for_a_person_and_then_are_released(ground, now):
    prepare(ground, LINKS)
    request(ground, windows=2)
    assert plan(ground, now) == {"failed": 0, "added": 2, "approved": 0, "released": 0}
    windows = windows_of(ground)
    assert {one.state for one in windows} == {"draft"}
    first, last = windows
    planning.change_window(ground, last.id, actor="bob", changes={}, decision="approved")
    assert plan(ground, now)["released"] == 1
    assert standing.plan_tick(ground, first.start.utc_ns)["failed"] == 1
    assert ground.read(get_window, first.id).reason == standing.NOT_APPROVED


def test_windows_need_a_contact_before_them(ground, now):
    closed = 'outages = ["2029-08-07T00:00:00Z/2029-08-07T18:00:00Z"]\nminimum_elevation_deg = 0.0\n'
    text = MISSION.format(extra=AUTOMATIC + LINKS).replace("minimum_elevation_deg = 0.0\n", closed)
    add_mission(ground, text.encode(), actor="ann")
    key = request(ground)
    plan(ground, now)
    made = ground.read(get_plan, key)
    reasons = {one.reason for one in made.candidates if one.start.utc_ns < START + 12 * HOUR}
    assert reasons == {"no contact before it to send its telecommands"}
    planned = [one for one in made.candidates if one.outcome == "planned"]
    assert planned and all(one.start.utc_ns > START + 12 * HOUR for one in planned)


def test_the_duty_limit_of_the_mission_description_is_kept(ground, now):
    prepare(ground, AUTOMATIC + LINKS + "[resources]\nobserve_hours_per_day = 0.5\n")
    key = request(ground, windows=20, maximum_duration_s=900.0, minimum_duration_s=800.0)
    assert plan(ground, now)["added"] == 2
    reasons = {one.reason for one in ground.read(get_plan, key).candidates}
    assert "more than 0.5 h of observation within 24 h" in reasons


def test_regions_and_the_end_of_the_ephemeris_bound_the_plan(ground, now):
    prepare(ground)
    region = {"latitude_deg": {"min": -20.0, "max": 20.0}}
    key = request(ground, windows=5, horizon_days=10.0, regions=[region], minimum_duration_s=60.0)
    plan(ground, now)
    made = ground.read(get_plan, key)
    assert made.reason.startswith("the reference ephemeris ends at 2029-08-10")
    windows = windows_of(ground)
    assert windows
    for one in windows:
        latitude = one.predicted.latitude_deg
        assert -20.1 <= latitude.min <= latitude.max <= 20.1


UPLOADS = "[uploads]\ntables = []\n"
ONE_PERSON = AUTOMATIC + 'one_person_for = ["perform_function/set_mode"]\n'


def test_sequences_of_windows_do_not_overlap(ground, now):
    planned(ground, now, ONE_PERSON + LINKS + UPLOADS, windows=5, minimum_duration_s=200.0, maximum_duration_s=400.0)
    windows = windows_of(ground)
    between = [(b.start.utc_ns - a.stop.utc_ns) / NS for a, b in pairwise(windows)]
    # One sequence ends 20 s after its window, and the next begins 60 s before its own.
    assert len(windows) == 5 and min(between) == 81.0


def test_a_window_that_cannot_be_released_states_the_reason(ground, now):
    planned(ground, now, LINKS + UPLOADS, windows=1)
    (window,) = windows_of(ground)
    planning.change_window(ground, window.id, actor=standing.PLANNER, changes={}, decision="approved")
    assert plan(ground, now)["released"] == 0
    assert ground.read(get_window, window.id).reason.startswith(
        "its telecommands cannot be released: telecommand perform_function: critical; expected"
    )


def test_windows_keep_the_limits_of_images(ground, now):
    planned(
        ground,
        now,
        AUTOMATIC + LINKS + "[observation]\nlatitude_limit_deg = 50\nneeds_daylight = false\n",
        windows=6,
        minimum_duration_s=200.0,
    )
    windows = windows_of(ground)
    spans = [one.predicted.latitude_deg for one in windows]
    assert windows and all(-50.1 < span.min <= span.max < 50.1 for span in spans)
    assert any(one.predicted.sun_elevation_deg.max < 0.0 for one in windows)  # the scenario draws its own light
    region = {"latitude_deg": {"min": 52.0, "max": 90.0}}
    key = request(ground, regions=[region], minimum_duration_s=60.0)
    plan(ground, now)
    reason = ground.read(get_plan, key).reason
    assert "excluded by latitude limit of the mission description 50 deg, regions" in reason
    start = windows[0].start.utc_ns + HOUR // 2
    entry = WindowEntry("pole", start, start + HOUR, 15.0, 76)
    with raises(PlanConflicts, match="expected latitudes within the 50 deg of the mission description"):
        planning.add_window(ground, entry, actor="ann")


def test_without_an_ephemeris_the_plan_says_so(ground, now):
    now.utc_ns += 9 * 24 * HOUR
    key = planned(ground, now, AUTOMATIC)
    made = ground.read(get_plan, key)
    assert (windows_of(ground), made.reason) == ([], "no reference ephemeris covers the coming days")


def test_paused_and_deleted_requests_are_not_planned(ground, now):
    prepare(ground)
    key = request(ground)
    change(ground, key, state="paused")
    assert plan(ground, now)["added"] == 0
    change(ground, key, state="active", terms={"windows": 1, "horizon_days": 1.0})
    assert plan(ground, now)["added"] == 1
    standing.delete_request(ground, key, actor="ann")
    assert [one.request_id for one in windows_of(ground)] == [None]
    with raises(NotFound):
        ground.read(get_request, key)


def test_contradictory_terms_are_refused(ground):
    with raises(InvalidInput, match="minimum_duration_s: expected at most maximum_duration_s"):
        request(ground, minimum_duration_s=900.0, maximum_duration_s=600.0)
    with raises(InvalidInput, match="stop: expected a time after the start"):
        request(ground, start="2029-08-07T00:00:00Z", stop="2029-08-06T00:00:00Z")


def test_processes_that_plan_at_the_same_time_make_one_plan(migrated_postgres, oem, tmp_path, now):
    url = migrated_postgres()
    grounds = [open_ground(tmp_path / "home", database_url=url) for _ in range(4)]
    prepare(grounds[0])
    add_reference(grounds[0], oem)
    key = request(grounds[0])
    with ThreadPoolExecutor(4) as pool:
        added = list(pool.map(lambda one: plan(one, now)["added"], grounds))
    assert sorted(added) == [0, 0, 0, 2] and len(windows_of(grounds[0])) == 2
    assert grounds[0].read(store.get_request_record, key).plans == 1
    for one in grounds:
        one.close()
