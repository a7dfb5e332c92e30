"""Jobs end exactly once; follow-up of a live pass without a request: evaluated, reported, kept and processed."""

import errno
import json
import shutil
from pathlib import Path
from unittest.mock import Mock

import numpy as np
from pytest import fixture, mark, raises

from ground_service.client.connection import Conflict as ClientConflict
from ground_service.client.local import local_client
from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, DatabaseUnavailable, FileDamaged, InvalidInput, StorageFull, public_text
from ground_service.evaluation import service as evaluation
from ground_service.evaluation.landmarks.model import LandmarkFilter
from ground_service.evaluation.landmarks.service import list_landmarks
from ground_service.evaluation.store import newest_report
from ground_service.ground import open_ground
from ground_service.http.model import Paging
from ground_service.ingest.service import enter_ingest, ingest_file
from ground_service.jobs.service import JobFilter, add_job, enter_job, list_jobs, repeat_failed, unfinished_jobs
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
from ground_service.store import event_kinds as events
from ground_service.store import repository
from ground_service.store.event_kinds import ContactEnded, PassEvaluated, RegressionJudged, publish
from ground_service.store.states import JOB, move
from ground_service.worker import actions, jobs
from ground_service.worker.condition import complaints, read_condition
from ground_service.worker.dispatch import InlineDispatcher
from ground_service.worker.follow_up import FollowUp, follow_in_process
from ground_service.worker.jobs import run_job
from ground_service.worker.scheduler import Scheduler
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
from tests.scenarios import SYNTHETIC

FRAMES = 24
STOP = START + 10 * CADENCE_S * NS

MISSION = f"""{SYNTHETIC}gravity_degree = 12
[time]
correlation = "ideal"
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


@fixture(scope="module")
def flown(make_pass):
    return make_pass(frames=FRAMES, seed=9)


def deliver_reference(ground, flown):
    add_ephemeris(ground, ground.files.put_file(flown.folder / "reference.oem"), name="reference")


def prepared(ground, flown, settings="", *, mission=MISSION, reference=True):
    """Enter what a ground knows before a pass; return an approved window."""
    held = add_catalogue(ground, ground.files.put_file(flown.folder / "catalogue.csv"), "craters.csv")
    add_mission(ground, (mission.format(sha256=held.sha256) + settings).encode())
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


def receive(ground, packets):
    file = ground.home / f"{len(packets)}.cadu"
    file.write_bytes(encode_downlink(packets))
    ingest_file(ground, file, spacecraft_id=SPACECRAFT)


def followed(ground, flown, *given, **how):
    """Receive a prepared pass; return its window."""
    window_id = prepared(ground, flown, *given, **how)
    receive(ground, flown.packets)
    return window_id


def follow_up(ground):
    """Jobs of the follow-up, oldest first."""
    return list(ground.read(list_jobs, JobFilter(kind="automation")).items)[::-1]


def done_steps(ground):
    """Steps of the follow-up that were done, in their order."""
    return [name for one in follow_up(ground) for name in one.result or {} if name != "event"]


def end_contact(ground, vehicle, utc_ns):
    ended = ContactEnded(
        contact_id=1, link="x", station="madrid", vehicle_id=vehicle, start_utc_ns=utc_ns - 60 * NS,
        stop_utc_ns=utc_ns, octets=1, telecommands=0,
    )  # fmt: skip
    ground.write(publish, ended)


def report_of(ground, pass_id):
    path = ground.home / "reports" / f"pass-{pass_id}" / "report.json"
    return json.loads(path.read_text())


def processed(ground, window_id):
    """Return the pass of a window that is processed."""
    window = ground.read(get_window, window_id)
    assert window.state == "processed"
    return window.pass_id


def test_a_live_pass_is_complete_and_processed_without_a_request(either, flown):
    window_id = followed(either, flown)
    pass_id = processed(either, window_id)
    report, after = follow_up(either)
    assert (report.state, after.state) == ("done", "done")
    log = {one.number: one for one in events.read_events(either.database, 0, 1000)}
    assert log[report.arguments["event"]].payload == {"id": window_id, "state": "downlinked"}
    assert log[after.arguments["event"]].payload == {"id": window_id, "state": "processed"}
    assert set(report.result["report of pass 1"]["inputs"]["missing"]) == {"correlation"}
    kept = after.result["archive of pass 1"]
    assert (kept["state"], kept["reason"]) == ("telemetry only", LIVE)
    assert after.result["monthly report"] == {}  # the month of the pass is not complete
    document = report_of(either, pass_id)
    assert document["evidence_level"].startswith("2 ")
    assert {one["name"] for one in document["navigation"] if one["kind"] == "baseline"} >= {"propagate-only", "Kepler"}
    assert 0.6 < document["detector"]["micro"]["recall"] < 0.8  # a quarter of the craters is not detected
    assert {one["key"]: one["status"] for one in document["requirements"]}["detector.recall"] == "met"
    assert not {"detector", "reference", "error"} & set(document["not_available"])


def test_an_incomplete_window_is_processed_after_the_contact_and_late_data_change_its_report(either, flown):
    window_id = prepared(either, flown)
    lost = slice(20, 26)
    receive(either, flown.packets[: lost.start] + flown.packets[lost.stop :])
    assert either.read(get_window, window_id).state == "executed" and follow_up(either) == []
    vehicle = either.read(windows.get_record, window_id).vehicle_id
    end_contact(either, vehicle, START)  # before the end of the window
    assert follow_up(either) == []
    end_contact(either, vehicle, STOP + NS)
    pass_id = processed(either, window_id)
    assert done_steps(either) == ["report of pass 1", "archive of pass 1", "monthly report"]
    first = report_of(either, pass_id)
    [kept] = kept_archives(either)
    receive(either, flown.packets[lost])
    [replaced] = kept_archives(either)
    assert replaced.pass_id == kept.pass_id == pass_id and replaced.octets > kept.octets
    again = report_of(either, pass_id)
    assert again["packets"]["lost"] < first["packets"]["lost"]
    assert processed(either, window_id)
    end_contact(either, vehicle, STOP + 2 * NS)
    assert done_steps(either)[3:] == ["archive of pass 1"]


def test_a_reference_that_arrives_after_the_report_completes_it(either, flown):
    window_id = followed(either, flown, reference=False)
    pass_id = processed(either, window_id)
    reasons = report_of(either, pass_id)["not_available"]
    assert reasons["error"] == "no reference ephemeris covers this pass" and "detector" in reasons
    deliver_reference(either, flown)
    report = report_of(either, pass_id)
    assert 0.6 < report["detector"]["micro"]["recall"] < 0.8
    assert not {"detector", "reference", "error", "baselines"} & set(report["not_available"])
    assert processed(either, window_id)
    newest = either.read(newest_report, pass_id, other_than="")
    assert newest.previous_id is not None and newest.event_number is not None
    assert {one.state for one in follow_up(either)} == {"done"}


def test_a_mission_without_a_camera_is_processed_and_its_report_says_what_that_means(ground, flown):
    before, _, rest = MISSION.partition("[camera]")
    window_id = followed(ground, flown, mission=before + "[frames]" + rest.partition("[frames]")[2])
    pass_id = processed(ground, window_id)
    report = report_of(ground, pass_id)
    said = "the mission description does not state sizes of the camera, which are assumed: image width (512 px)"
    assert [one for one in report["remarks"] if one.startswith(said)]
    [made, _] = follow_up(ground)
    assert made.result["report of pass 1"]["inputs"]["missing"]["camera"].startswith(said)


def test_an_event_that_is_followed_again_has_one_result(ground, flown):
    followed(ground, flown)
    for job in follow_up(ground):
        again = actions.run_steps(ground, job.arguments["event"])
        assert again.get("report of pass 1") == (job.result or {}).get("report of pass 1")
    kinds = [one.kind for one in events.read_events(ground.database, 0, 1000)]
    assert kinds.count(PassEvaluated.event_kind) == 1 and len(follow_up(ground)) == 2


def test_a_follow_up_that_a_process_left_is_done_by_the_next(tmp_path, flown, monkeypatch):
    def full(*_, **__):
        raise StorageFull("disk")

    with open_ground(tmp_path / "home") as ground:
        follow_in_process(ground)
        window_id = prepared(ground, flown)
        with monkeypatch.context() as patched:
            patched.setattr(actions, "make_report", full)
            receive(ground, flown.packets)
        assert [one.state for one in follow_up(ground)] == ["queued"]
        assert ground.read(get_window, window_id).state == "downlinked"
    with open_ground(tmp_path / "home") as ground:
        follow_in_process(ground)
        InlineDispatcher(ground).resume()
        assert processed(ground, window_id)
        assert ground.read(unfinished_jobs) == []


def test_a_report_that_failed_is_stated_at_its_window_and_made_later(either, flown, monkeypatch):
    def broken(*_, **__):
        raise InvalidInput("report", "", "a renderer", "none")

    with monkeypatch.context() as patched:
        patched.setattr(actions, "make_report", broken)
        window_id = prepared(either, flown)
        receive(either, flown.packets)
    [failed] = follow_up(either)
    why = "report: expected a renderer, found none"
    assert (failed.state, failed.error) == ("failed", f"report of pass 1: {why}")
    window = either.read(get_window, window_id)
    assert (window.state, window.reason) == ("downlinked", f"report of pass 1 failed: {why}")
    either.write(repeat_failed, utc_now_ns())  # not before its time
    assert either.read(unfinished_jobs) == []
    either.write(repeat_failed, utc_now_ns() + 61 * NS)
    InlineDispatcher(either).resume()
    assert processed(either, window_id)
    assert {one.state for one in follow_up(either)} == {"done"}


def test_an_unfinished_job_of_a_rule_of_an_earlier_version_ends_without_work(ground):
    ground.write(publish, RegressionJudged(id="1" * 32, verdict="fail"))
    for kind in ("automation", "notification"):
        done = run_job(ground, enter_job(ground, kind, {"event": 1}))
        assert (done.state, done.result) == ("done", {"event": 1})
    failed = run_job(ground, enter_job(ground, "automation", {"event": 99}))
    assert failed.error == "event 99: not found"


@mark.parametrize("evaluate", [False, None])
def test_an_imported_archive_is_kept_once_unless_the_mission_evaluates_nothing(ground, flown, evaluate):
    stated = "" if evaluate is None else "[automation]\nevaluate = false\n"
    add_mission(ground, f'name = "m"\n[spacecraft]\nid = {SPACECRAFT}\n{stated}'.encode())
    pass_id = import_archive(ground, flown.folder)
    assert import_archive(ground, flown.folder) == pass_id
    assert done_steps(ground) == ([] if evaluate is False else [f"archive of pass {pass_id}"])


def test_a_mission_that_evaluates_nothing_leaves_its_windows_to_persons(ground, flown):
    window_id = followed(ground, flown, "[automation]\nevaluate = false\n")
    assert follow_up(ground) == [] and ground.read(get_window, window_id).state == "downlinked"


def test_the_catalogue_of_a_live_pass_is_cut_to_its_track(ground, flown):
    window_id = followed(ground, flown)
    whole = evaluation.evaluate(ground, processed(ground, window_id))
    assert whole.detector is not None
    assert any("synthetic craters" in one for one in whole.data_sources)


def test_a_mission_without_an_available_catalogue_is_refused_with_the_reason(ground):
    missing = parse_mission(f'name = "m"\n[catalogue]\nsha256 = "{"0" * 64}"\n')
    with raises(InvalidInput, match=r"m, catalogue.sha256: expected a catalogue that the ground holds"):
        catalogue_of(ground, missing)
    with raises(InvalidInput, match="linna catalogue add FILE"):
        catalogue_of(ground, parse_mission('name = "m"\n[catalogue]\nsource = "x"\n'))
    with raises(InvalidInput, match="found neither"):
        catalogue_of(ground, parse_mission('name = "m"\n'))


def test_only_a_crater_catalogue_is_held(ground, flown):
    with raises(InvalidInput, match="crater catalogue"):
        add_catalogue(ground, ground.files.put_octets(b"a,b\n1,2\n"), "x.csv")
    for _ in range(2):
        add_catalogue(ground, ground.files.put_file(flown.folder / "catalogue.csv"), "craters.csv")
    (held,) = ground.read(list_catalogues, Paging()).items
    assert held.name == "craters.csv"


def test_a_worker_that_only_reads_events_enters_no_job_twice(tmp_path, flown):
    with open_ground(tmp_path / "home") as ground:
        jobs = []
        follow = FollowUp(ground, start=jobs.append)
        prepared(ground, flown)
        receive(ground, flown.packets)
        for _ in range(3):
            follow.drain()
        assert jobs == ground.read(unfinished_jobs) == [one.id for one in follow_up(ground)] != []


def test_a_processed_pass_is_searched_for_landmarks(either, flown, tmp_path):
    full = load_catalogue(flown.folder / "catalogue.csv")
    thin = SyntheticPass(tmp_path / "thin", flown.packets, flown.utc_ns, flown.expected, flown.missed)
    shutil.copytree(flown.folder, thin.folder)
    save_catalogue(full.select(np.arange(len(full)) % 3 != 0), thin.folder / "catalogue.csv")
    window_id = prepared(either, thin, "[automation]\nlandmarks = true\n")
    receive(either, thin.packets)
    assert processed(either, window_id)
    [_, after] = follow_up(either)
    added = after.result["landmarks of pass 1"]["added"]
    page = either.read(list_landmarks, LandmarkFilter(limit=1000))
    assert page.total == added > 20 and {one.state for one in page.items} == {"seen"}


@fixture
def job_that(monkeypatch, ground):
    """A function that enters a job with the given work."""

    def enter(work):
        monkeypatch.setitem(jobs.WORK, "nightly", work)
        return enter_job(ground, "nightly", {})

    return enter


def row_of(ground, job):
    return ground.read(repository.get, repository.JOBS, job, "job")


MISSING = FileNotFoundError(errno.ENOENT, "No such file or directory", "/srv/linna/files/ab")


@mark.parametrize(
    "error, shown",
    [
        (OverflowError("Python int too large"), "OverflowError: Python int too large"),
        (KeyError("vehicle"), "KeyError: 'vehicle'"), (ValueError("first\nsecond"), "ValueError: first second"),
        (MemoryError(), "MemoryError"), (MISSING, "FileNotFoundError: No such file or directory"),
        (InvalidInput("/srv/linna/a.zip", "", "a zip", "none"), "a.zip: expected a zip, found none"),
    ],
)  # fmt: skip
def test_whatever_error_a_job_meets_it_ends_as_failed_and_is_not_repeated(ground, job_that, error, shown):
    work = Mock(side_effect=error)
    job = job_that(work)
    for _ in range(3):
        row = run_job(ground, job)
    assert (row.state, row.error, row.attempts, work.call_count) == ("failed", shown, 1, 1)
    assert ground.read(unfinished_jobs) == []


def test_a_failed_ingest_is_repeated_with_longer_and_longer_waits(either, monkeypatch):
    """An acknowledged ingest is done at most 85 minutes after its cause is gone, without anybody."""
    work, waits_min = Mock(side_effect=[*[FileNotFoundError("gone")] * 5, {}]), (1, 4, 16, 64)
    monkeypatch.setitem(jobs.WORK, "ingest", work)
    monkeypatch.setitem(jobs.WORK, "report", work)
    job, other = (enter_job(either, kind, {"pass_id": 1, "ingest_id": 1}) for kind in ("ingest", "report"))
    scheduler = Scheduler(either, InlineDispatcher(either), lambda: None, {"retention_days": 90})
    assert run_job(either, other).state == run_job(either, job).state == "failed"
    shown = complaints(read_condition(either, None))
    assert "1 ingests have failed; repeat or dismiss them on the page Shift." in shown
    for attempt, minutes in enumerate(waits_min, start=1):
        for passed_min, attempts in ((minutes - 0.5, attempt), (minutes, attempt + 1)):
            since = utc_now_ns() - int(passed_min * 60e9)
            with either.database.writing() as connection:
                connection.execute(repository.JOBS.update().values(finished_utc_ns=since))
            scheduler.tick()
            assert row_of(either, job)["attempts"] == attempts
    assert (row_of(either, job)["state"], row_of(either, other)["attempts"]) == ("done", 1)


def test_a_failed_job_is_repeated_by_one_action(ground, job_that, monkeypatch):
    job = job_that(lambda *_: {}["missing"])
    assert run_job(ground, job).state == "failed"
    monkeypatch.setitem(jobs.WORK, "nightly", lambda *_: {"repeated": True})
    with local_client(ground, "ann") as client:
        assert client.repeat_job(job).result == {"repeated": True}
        with raises(ClientConflict, match="expected state failed, found done"):
            client.repeat_job(job)
        assert next(iter(client.list_audit(action="repeat job"))).actor == "ann"
        with raises(ClientConflict, match="expected state failed, found done"):
            client.delete_job(job)


def test_a_failed_ingest_is_dismissed(ground, job_that):
    job = job_that(lambda *_: {}["missing"])
    run_job(ground, job)
    with local_client(ground, "ann") as client:
        client.delete_job(job)
        assert [one.id for one in client.list_jobs()] == []
        assert next(iter(client.list_audit(action="dismiss job"))).target == job


def test_the_traceback_of_an_unexpected_error_is_in_the_log(ground, job_that, caplog):
    job = job_that(lambda *_: {}["missing"])
    run_job(ground, job)
    [record] = [one for one in caplog.records if one.levelname == "ERROR"]
    assert record.exc_info is not None and job in record.getMessage()


def test_a_full_disk_is_no_fault_of_the_job(ground, job_that):
    job = job_that(Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with raises(StorageFull):
        run_job(ground, job)
    row = row_of(ground, job)
    assert (row["state"], row["attempts"]) == ("queued", 0)


def test_a_result_that_the_database_cannot_hold_fails_the_job(ground, job_that):
    row = run_job(ground, job_that(lambda *_: {"median": float("nan")}))
    assert row.state == "failed" and "JSON" in row.error


def test_an_attempt_that_another_has_overtaken_changes_nothing(ground, job_that):
    """This occurs after a network failure, if the database grants the lock of the first worker to a second one."""

    def work(_ground, _arguments, job_id):
        ground.write(move, JOB, job_id, "running", attempts=2)
        return {"made by": "the first"}

    row = run_job(ground, job_that(work))
    assert (row.state, row.attempts, row.result) == ("running", 2, None)


def test_an_id_that_stands_for_another_request_is_refused(ground):
    enter_job(ground, "report", {"pass_id": 1}, job_id="a" * 32)
    assert enter_job(ground, "report", {"pass_id": 1}, job_id="a" * 32) == "a" * 32
    for kind, arguments in (("report", {"pass_id": 2}), ("nightly", {})):
        with raises(Conflict, match="found another"):
            ground.write(add_job, kind, arguments, job_id="a" * 32)


def test_an_ingest_asked_for_twice_is_one_and_of_another_file_is_refused(ground):
    one, other = (ground.files.put_octets(octets) for octets in (b"one", b"other"))
    given = {"spacecraft_id": 76, "instance": "flight", "job_id": "b" * 32}
    first = enter_ingest(ground, one, "one", **given)
    assert enter_ingest(ground, one, "one", **given) == first
    for stored, changed in ((other, {}), (one, {"spacecraft_id": 77}), (one, {"instance": "else"})):
        with raises(Conflict, match="found another"):
            enter_ingest(ground, stored, "one", **(given | changed))
    assert ground.read(repository.newest, repository.INGESTS, Paging())[1] == 1


@mark.parametrize(
    "error, shown",
    [
        (DatabaseUnavailable("postgresql://linna:***@db/linna", "gone"), "database (address) cannot be opened: gone"),
        (FileDamaged(Path("/srv/linna/files/ab/cdef"), "1", "2"), "cdef: expected octets with SHA-256 1, found 2"),
        (InvalidInput("window", "name", "a line", "'\x1b[2J\n'"), "window, name: expected a line, found ' [2J '"),
        (ValueError(), "ValueError"),
        (InvalidInput("x", "", "a number from 0/1 to 3", "and/or"), "x: expected a number from 0/1 to 3, found and/or"),
    ],
)  # fmt: skip
def test_what_is_shown_of_an_error_is_one_line_without_places_of_the_server(error, shown):
    assert public_text(error) == shown


def test_a_long_error_is_cut():
    assert len(public_text(ValueError("x" * 9000))) == 500
