"""A live pass that nobody asks for: reported, complete and processed; and what rules do with events."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ground_service import events
from ground_service.client.local import local_client
from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput, StateConflict, StorageFull
from ground_service.evaluation import service as evaluation
from ground_service.evaluation.landmarks.model import LandmarkFilter
from ground_service.evaluation.landmarks.store import list_landmarks
from ground_service.evaluation.store import newest_report
from ground_service.events import ContactEnded, PassEvaluated, RegressionJudged, WindowChanged, publish
from ground_service.ground import Ground, open_ground
from ground_service.http.model import Paging
from ground_service.ingest.service import ingest_file
from ground_service.jobs.store import unfinished_jobs
from ground_service.missions.catalogues import add_catalogue, catalogue_of
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.model import parse_mission
from ground_service.missions.service import add_mission
from ground_service.missions.store import list_catalogues
from ground_service.passes.archive_import import import_archive
from ground_service.planning import store as windows
from ground_service.planning.model import UploadedState, WindowUploads
from ground_service.planning.service import WindowEntry, add_window, change_window
from ground_service.planning.store import get_window
from ground_service.regression.archives import kept_archives
from ground_service.regression.pass_archives import LIVE
from ground_service.worker import actions
from ground_service.worker.actions import has_repetitions, repeat_due
from ground_service.worker.automation.model import ActionFilter, AutomationAction
from ground_service.worker.automation.service import decide, list_rules, record_actions, repeat
from ground_service.worker.automation.store import list_automation_actions
from ground_service.worker.dispatch import InlineDispatcher
from ground_service.worker.follow_up import FollowUp, follow_in_process
from ground_service.worker.jobs import run_job
from lunar.catalogue import load_catalogue, save_catalogue
from lunar.timescales import format_utc
from tests.ground_service.conftest import (
    CADENCE_S,
    NS,
    SPACECRAFT,
    START,
    SyntheticPass,
    circular_states,
    encode_downlink,
)

FRAMES = 24
STOP = START + 10 * CADENCE_S * NS

MISSION = f"""
name = "live"
[spacecraft]
id = {SPACECRAFT}
[time]
correlation = "ideal"
[frames]
orientation = "IAU WGCCRE 2009"
gravity_field = "GRGM1200L (12x12, built in)"
gravity_degree = 12
[camera]
width_px = 512
height_px = 512
fov_deg = 120.0
pointing = "nadir"
[catalogue]
source = "synthetic craters"
sha256 = "{{sha256}}"
[evidence]
world = "procedural"
seed = 1
[requirements]
estimator = "spherical"
median_error_m = 200.0
recall = 0.5
"""


@pytest.fixture(scope="module")
def flown(make_pass: Callable[..., SyntheticPass]) -> SyntheticPass:
    return make_pass(frames=FRAMES, seed=9)


def deliver_reference(ground: Ground, flown: SyntheticPass) -> None:
    add_ephemeris(ground, ground.files.put_file(flown.folder / "reference.oem"), name="reference")


def prepared(
    ground: Ground, flown: SyntheticPass, rules: str = "", *, mission: str = MISSION, reference: bool = True
) -> int:
    """Enter what a ground knows before a pass; return an approved window."""
    held = add_catalogue(ground, ground.files.put_file(flown.folder / "catalogue.csv"), "craters.csv")
    add_mission(ground, (mission.format(sha256=held.sha256) + rules).encode())
    if reference:
        deliver_reference(ground, flown)
    entry = WindowEntry("live", START, STOP, float(CADENCE_S), SPACECRAFT)
    window = add_window(ground, entry, actor="ann")
    change_window(ground, window.id, actor="bob", changes={}, decision="approved")
    position, velocity = circular_states(np.array([START]))
    state = UploadedState.model_validate(
        {
            "utc": format_utc(START),
            "position_icrf_m": tuple(position[0].tolist()),
            "velocity_icrf_m_s": tuple(velocity[0].tolist()),
        }
    )
    ground.write(windows.note_uploads, window.id, WindowUploads(start_state=state))
    return window.id


def receive(ground: Ground, packets: list[bytes], folder: Path) -> None:
    file = folder / f"{len(packets)}.cadu"
    file.write_bytes(encode_downlink(packets))
    ingest_file(ground, file, spacecraft_id=SPACECRAFT)


def actions_of(ground: Ground, **equal: Any) -> list[AutomationAction]:
    """Recorded actions, newest first."""
    return list(ground.read(list_automation_actions, ActionFilter(**equal)).items)


def recorded(ground: Ground, **equal: Any) -> list[tuple[str, str, str]]:
    return [(one.rule, one.action, one.state) for one in reversed(actions_of(ground, **equal))]


def end_contact(ground: Ground, vehicle: int, utc_ns: int) -> None:
    ended = ContactEnded(
        contact_id=1,
        link="x",
        station="madrid",
        vehicle_id=vehicle,
        start_utc_ns=utc_ns - 60 * NS,
        stop_utc_ns=utc_ns,
        octets=1,
        telecommands=0,
    )
    ground.write(publish, ended)


def report_of(ground: Ground, pass_id: int) -> dict[str, Any]:
    path = ground.home / "reports" / f"pass-{pass_id}" / "report.json"
    document: dict[str, Any] = json.loads(path.read_text())
    return document


def test_a_live_pass_is_complete_and_processed_without_a_request(
    either: Ground, flown: SyntheticPass, tmp_path: Path
) -> None:
    window_id = prepared(either, flown)
    receive(either, flown.packets, tmp_path)
    window = either.read(get_window, window_id)
    assert window.state == "processed" and window.pass_id is not None
    assert recorded(either) == [
        ("report of a complete window", "align", "done"),
        ("report of a complete window", "report", "done"),
        ("trends", "compute_trends", "done"),
        ("trends", "monthly_report", "done"),
        ("regression archive of a window", "keep_archive", "done"),
    ]
    found = actions_of(either, pass_id=window.pass_id)
    log = {one.number: one for one in events.read_events(either.database, 0, 1000)}
    kept = found[0].result
    assert kept is not None and (kept["state"], kept["reason"]) == ("telemetry only", LIVE)
    aligned = found[-1]
    assert log[aligned.event].payload == {"id": window_id, "state": "downlinked"}
    assert aligned.result is not None and set(aligned.result["missing"]) == {"correlation"}
    report = report_of(either, window.pass_id)
    assert report["evidence_level"].startswith("2 ")
    assert {one["name"] for one in report["navigation"] if one["kind"] == "baseline"} >= {
        "propagate-only",
        "Kepler",
    }
    assert 0.6 < report["detector"]["micro"]["recall"] < 0.8  # a quarter of the craters is not detected
    assert {one["key"]: one["status"] for one in report["requirements"]}["detector.recall"] == "met"
    assert not {"detector", "reference", "error"} & set(report["not_available"])


def test_an_incomplete_window_is_processed_after_the_contact_and_late_data_change_its_report(
    either: Ground, flown: SyntheticPass, tmp_path: Path
) -> None:
    window_id = prepared(either, flown)
    lost = slice(20, 26)
    receive(either, flown.packets[: lost.start] + flown.packets[lost.stop :], tmp_path)
    assert either.read(get_window, window_id).state == "executed" and recorded(either) == []
    with either.database.reading() as connection:
        vehicle = windows.get_record(connection, window_id).vehicle_id
    end_contact(either, vehicle, START)  # before the end of the window
    assert recorded(either) == []
    end_contact(either, vehicle, STOP + NS)
    window = either.read(get_window, window_id)
    assert window.state == "processed" and window.pass_id is not None
    assert [one[1:] for one in recorded(either)] == [
        ("align", "done"),
        ("report", "done"),
        ("mark_processed", "done"),
        ("compute_trends", "done"),
        ("monthly_report", "done"),
        ("keep_archive", "done"),
    ]
    first = report_of(either, window.pass_id)
    [kept] = kept_archives(either)
    receive(either, flown.packets[lost], tmp_path)
    [replaced] = kept_archives(either)
    assert replaced.pass_id == kept.pass_id == window.pass_id and replaced.octets > kept.octets
    again = report_of(either, window.pass_id)
    assert again["packets"]["lost"] < first["packets"]["lost"]
    assert either.read(get_window, window_id).state == "processed"
    end_contact(either, vehicle, STOP + 2 * NS)
    assert len(recorded(either)) == 7


def test_a_reference_that_arrives_after_the_report_completes_it(
    either: Ground, flown: SyntheticPass, tmp_path: Path
) -> None:
    window_id = prepared(either, flown, reference=False)
    receive(either, flown.packets, tmp_path)
    window = either.read(get_window, window_id)
    assert window.state == "processed" and window.pass_id is not None
    reasons = report_of(either, window.pass_id)["not_available"]
    assert reasons["error"] == "no reference ephemeris covers this pass" and "detector" in reasons
    deliver_reference(either, flown)
    report = report_of(either, window.pass_id)
    assert 0.6 < report["detector"]["micro"]["recall"] < 0.8
    assert not {"detector", "reference", "error", "baselines"} & set(report["not_available"])
    assert either.read(get_window, window_id).state == "processed"
    newest = either.read(newest_report, window.pass_id, other_than="")
    assert newest is not None and newest.previous_id is not None and newest.event_number is not None
    assert {one[2] for one in recorded(either)} == {"done"}


def test_a_mission_without_a_camera_is_processed_and_its_report_says_what_that_means(
    ground: Ground, flown: SyntheticPass, tmp_path: Path
) -> None:
    before, _, rest = MISSION.partition("[camera]")
    window_id = prepared(ground, flown, mission=before + "[catalogue]" + rest.partition("[catalogue]")[2])
    receive(ground, flown.packets, tmp_path)
    window = ground.read(get_window, window_id)
    assert window.state == "processed" and window.pass_id is not None
    assert {one[2] for one in recorded(ground)} == {"done"}
    report = report_of(ground, window.pass_id)
    said = (
        "the mission description does not state sizes of the camera, which are assumed: image width (512 px)"
    )
    assert [one for one in report["remarks"] if one.startswith(said)]
    aligned = actions_of(ground)[-1]
    assert aligned.result is not None and aligned.result["missing"]["camera"].startswith(said)


def test_an_event_that_is_handled_again_acts_once(
    ground: Ground, flown: SyntheticPass, tmp_path: Path
) -> None:
    window_id = prepared(ground, flown)
    receive(ground, flown.packets, tmp_path)
    before = recorded(ground)
    for event in events.read_events(ground.database, 0, 1000):
        if event.kind == WindowChanged.event_kind:
            record_actions(ground, event)
    assert recorded(ground) == before and ground.read(get_window, window_id).state == "processed"
    kinds = [one.kind for one in events.read_events(ground.database, 0, 1000)]
    assert kinds.count(PassEvaluated.event_kind) == 1


def test_actions_that_a_process_left_are_done_by_the_next(
    tmp_path: Path, flown: SyntheticPass, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> Any:
        raise StorageFull("disk")

    with open_ground(tmp_path / "home") as ground:
        follow_in_process(ground)
        window_id = prepared(ground, flown)
        with monkeypatch.context() as patched:
            patched.setattr(actions, "make_report", full)
            receive(ground, flown.packets, tmp_path)
        assert [one[1:] for one in recorded(ground)] == [("align", "done"), ("report", "queued")]
        assert ground.read(get_window, window_id).state == "downlinked"
    with open_ground(tmp_path / "home") as ground:
        follow_in_process(ground)
        InlineDispatcher(ground).resume()
        assert ground.read(get_window, window_id).state == "processed"
        assert {one[2] for one in recorded(ground)} == {"done"} and ground.read(unfinished_jobs) == []


def test_a_failed_action_skips_those_after_it_and_states_why(
    ground: Ground, flown: SyntheticPass, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any) -> Any:
        raise InvalidInput("pass", "", "a pass", "none")

    monkeypatch.setitem(actions.DOING, "align", broken)
    monkeypatch.setattr(actions, "RETRY_NS", (0, 0))
    window_id = prepared(ground, flown)
    receive(ground, flown.packets, tmp_path)
    found = actions_of(ground)
    why = "pass: expected a pass, found none (attempt 3 of 3)"
    assert [(one.action, one.state, one.error) for one in reversed(found)] == [
        ("align", "failed", why),
        ("report", "skipped", "align before it was not done"),
    ]
    window = ground.read(get_window, window_id)
    assert (window.state, window.reason) == ("downlinked", f"align failed: {why}")
    assert not has_repetitions(ground)


def test_a_failed_action_is_repeated_by_an_operator(
    either: Ground, flown: SyntheticPass, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With those that were skipped after it; the same request again changes nothing."""

    def broken(*_: Any, **__: Any) -> Any:
        raise InvalidInput("align", "", "a reference", "none")

    monkeypatch.setattr(actions, "RETRY_NS", (0, 0))
    with monkeypatch.context() as patched:
        patched.setattr(actions, "align_pass", broken)
        window_id = prepared(either, flown)
        receive(either, flown.packets, tmp_path)
    assert [one[1:] for one in recorded(either)] == [("align", "failed"), ("report", "skipped")]
    report, align = actions_of(either)
    with pytest.raises(StateConflict, match="expected state failed, found skipped"):
        repeat(either, report.id, actor="ann")
    with pytest.raises(StateConflict, match="expected state waiting, found failed"):
        decide(either, align.id, approve=True, actor="ann")
    # Nobody does the work here yet: the request is recorded once, however often it is made.
    with monkeypatch.context() as patched:
        patched.setattr(actions, "_run_chain", lambda *_: [])
        queued = repeat(either, align.id, actor="ann")
        assert (queued.state, queued.attempts, queued.error) == ("queued", 0, None)
        assert repeat(either, align.id, actor="ann") == queued
    with local_client(either, "ann") as service:
        entries = [one for one in service.list_audit() if one.action == "repeat automation"]
    assert [(one.actor, one.target) for one in entries] == [("ann", str(align.id))]
    actions.run_actions(either, align.event)
    assert {one[2] for one in recorded(either)} == {"done"}
    assert either.read(get_window, window_id).state == "processed"
    with pytest.raises(StateConflict, match="expected state failed, found done"):
        repeat(either, align.id, actor="ann")


def test_a_report_that_failed_is_made_later(
    either: Ground, flown: SyntheticPass, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once, then by the scheduler: until then the action is queued and states what is wrong."""
    attempts = []

    def broken(*_: Any, **__: Any) -> Any:
        attempts.append(1)
        raise InvalidInput("report", "", "a renderer", "none")

    with monkeypatch.context() as patched:
        patched.setattr(actions, "make_report", broken)
        window_id = prepared(either, flown)
        receive(either, flown.packets, tmp_path)
    report, align = actions_of(either)
    assert (align.state, report.state, report.attempts, len(attempts)) == ("done", "queued", 2, 2)
    assert report.error == "report: expected a renderer, found none" and report.next_attempt is not None
    assert either.read(get_window, window_id).state == "downlinked"
    assert has_repetitions(either) and repeat_due(either) == []  # not before its time
    monkeypatch.setattr(actions, "utc_now_ns", lambda: utc_now_ns() + 61 * NS)
    [job_id] = repeat_due(either)
    assert repeat_due(either) == [job_id]  # of several processes one does it
    run_job(either, job_id)
    assert either.read(get_window, window_id).state == "processed"
    assert {one[2] for one in recorded(either)} == {"done"} and not has_repetitions(either)


APPROVED = """
[[automation.rules]]
name = "report with approval"
on = "window ended"
when = { window_state = ["downlinked"] }
do = ["align", "report"]
approval = true
"""


def test_actions_with_approval_wait_for_it(ground: Ground, flown: SyntheticPass, tmp_path: Path) -> None:
    window_id = prepared(ground, flown, APPROVED)
    receive(ground, flown.packets, tmp_path)
    assert [one[1:] for one in recorded(ground)] == [("align", "waiting"), ("report", "waiting")]
    waiting = actions_of(ground, state="waiting")
    decided = decide(ground, waiting[-1].id, approve=True, actor="ann")
    assert decided.decided_by == "ann"
    assert [one[1:] for one in recorded(ground)] == [("align", "done"), ("report", "done")]
    assert ground.read(get_window, window_id).state == "processed"
    with pytest.raises(StateConflict, match="expected state waiting, found done"):
        decide(ground, waiting[-1].id, approve=False, actor="ann")


def test_refused_actions_are_not_done(ground: Ground, flown: SyntheticPass, tmp_path: Path) -> None:
    window_id = prepared(ground, flown, APPROVED)
    receive(ground, flown.packets, tmp_path)
    waiting = actions_of(ground, state="waiting")
    decide(ground, waiting[-1].id, approve=False, actor="ann")
    assert [one[1:] for one in recorded(ground)] == [("align", "refused"), ("report", "refused")]
    assert ground.read(get_window, window_id).state == "downlinked"


@pytest.mark.parametrize("rules", ["[automation]\nevaluate = false\n", "[automation]\nrules = []\n"])
def test_automation_that_is_switched_off_does_nothing(
    ground: Ground, flown: SyntheticPass, tmp_path: Path, rules: str
) -> None:
    window_id = prepared(ground, flown, rules)
    receive(ground, flown.packets, tmp_path)
    assert recorded(ground) == [] and ground.read(get_window, window_id).state == "downlinked"


def test_rules_in_force_show_which_are_default(ground: Ground, flown: SyntheticPass) -> None:
    prepared(ground, flown, APPROVED)
    rules = list_rules(ground)
    assert [(one.spacecraft_id, one.name, one.default) for one in rules] == [
        (SPACECRAFT, "report with approval", False),
        (None, "report of a complete window", True),
        (None, "report of an incomplete window", True),
        (None, "trends", True),
        (None, "regression archive of a window", True),
        (None, "regression archive after late data", True),
        (None, "regression archive of an imported pass", True),
    ]


def test_a_gate_acts_for_every_mission_that_reacts_to_it(
    ground: Ground, flown: SyntheticPass, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(actions, "RETRY_NS", (0, 0))
    rule = '[[automation.rules]]\nname = "gate"\non = "gate done"\nwhen = { verdict = ["fail"] }\n'
    prepared(ground, flown, rule + 'do = ["compute_trends"]\n')
    ground.write(publish, RegressionJudged(id="0" * 32, verdict="pass"))
    assert recorded(ground) == []
    ground.write(publish, RegressionJudged(id="1" * 32, verdict="fail"))
    assert recorded(ground) == [("gate", "compute_trends", "failed")]


def test_a_report_that_is_requested_again_without_changes_is_kept(
    ground: Ground, flown: SyntheticPass, tmp_path: Path
) -> None:
    window_id = prepared(ground, flown)
    receive(ground, flown.packets, tmp_path)
    ground.write(publish, WindowChanged(id=window_id, state="downlinked"))
    found = actions_of(ground)
    assert found[0].action == "report" and found[0].result is not None and found[0].result["unchanged"]


def test_the_catalogue_of_a_live_pass_is_cut_to_its_track(
    ground: Ground, flown: SyntheticPass, tmp_path: Path
) -> None:
    window_id = prepared(ground, flown)
    receive(ground, flown.packets, tmp_path)
    pass_id = ground.read(get_window, window_id).pass_id
    assert pass_id is not None
    whole = evaluation.evaluate(ground, pass_id)
    assert whole.detector is not None
    assert any("synthetic craters" in one for one in whole.data_sources)


def test_a_mission_without_an_available_catalogue_is_refused_with_the_reason(ground: Ground) -> None:
    missing = parse_mission(f'name = "m"\n[catalogue]\nsha256 = "{"0" * 64}"\n')
    with pytest.raises(
        InvalidInput, match=r"m, catalogue.sha256: expected a catalogue that the ground holds"
    ):
        catalogue_of(ground, missing)
    with pytest.raises(InvalidInput, match="linna catalogue add FILE"):
        catalogue_of(ground, parse_mission('name = "m"\n[catalogue]\nsource = "x"\n'))
    with pytest.raises(InvalidInput, match="found neither"):
        catalogue_of(ground, parse_mission('name = "m"\n'))


def test_only_a_crater_catalogue_is_held(ground: Ground, flown: SyntheticPass) -> None:
    with pytest.raises(InvalidInput, match="crater catalogue"):
        add_catalogue(ground, ground.files.put_octets(b"a,b\n1,2\n"), "x.csv")
    for _ in range(2):
        add_catalogue(ground, ground.files.put_file(flown.folder / "catalogue.csv"), "craters.csv")
    page = ground.read(list_catalogues, Paging())
    held, total = page.items, page.total
    assert total == 1 and held[0].name == "craters.csv"


def test_a_worker_that_only_reads_events_records_no_action_twice(
    tmp_path: Path, flown: SyntheticPass
) -> None:
    with open_ground(tmp_path / "home") as ground:
        jobs: list[str] = []
        follow = FollowUp(ground, start=jobs.append)
        prepared(ground, flown)
        receive(ground, flown.packets, tmp_path)
        for _ in range(3):
            follow.drain()
        assert [one[1:] for one in recorded(ground)] == [("align", "queued"), ("report", "queued")]
        assert len(set(jobs)) == len(ground.read(unfinished_jobs)) == 1


IMPORTED = """
name = "m"
[spacecraft]
id = 76
[[automation.rules]]
name = "report of an archive"
on = "archive imported"
do = ["align", "report"]
"""


def test_an_imported_archive_acts_once(ground: Ground, flown: SyntheticPass) -> None:
    add_mission(ground, IMPORTED.encode())
    pass_id = import_archive(ground, flown.folder)
    assert import_archive(ground, flown.folder) == pass_id
    assert recorded(ground) == [
        ("report of an archive", "align", "done"),
        ("report of an archive", "report", "done"),
    ]
    assert report_of(ground, pass_id)["detector"] is not None


LEARNING = """
[automation]
evaluate = true
[[automation.rules]]
name = "learn from every pass"
on = "window processed"
do = ["find_landmarks"]
"""


def test_a_processed_pass_is_searched_for_landmarks(
    either: Ground, flown: SyntheticPass, tmp_path: Path
) -> None:
    full = load_catalogue(flown.folder / "catalogue.csv")
    thin = SyntheticPass(tmp_path / "thin", flown.packets, flown.utc_ns, flown.expected, flown.missed)
    shutil.copytree(flown.folder, thin.folder)
    save_catalogue(full.select(np.arange(len(full)) % 3 != 0), thin.folder / "catalogue.csv")
    window_id = prepared(either, thin, LEARNING)
    receive(either, thin.packets, tmp_path)
    window = either.read(get_window, window_id)
    assert window.state == "processed" and window.pass_id is not None
    [searched] = [one for one in actions_of(either) if one.action == "find_landmarks"]
    assert (searched.rule, searched.state, searched.pass_id) == (
        "learn from every pass",
        "done",
        window.pass_id,
    )
    assert searched.result is not None and searched.result["added"] > 20
    page = either.read(list_landmarks, LandmarkFilter(limit=1000))
    found, total = page.items, page.total
    assert total == searched.result["added"] and {one.state for one in found} == {"seen"}
