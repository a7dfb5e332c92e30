"""A simulated mission from end to end: spacecraft, stations, ground, reports; and what goes on after a stop."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ground_service.client.local import local_client
from ground_service.ground import open_ground
from ground_service.http.times import UtcTime
from ground_service.planning.request_model import PlannedCandidate, RequestPlan
from lunar.catalogue import make_catalogue
from lunar.datafolder import DataFolder
from lunar.timescales import parse_utc
from payload_emulator.errors import LinkError, ScenarioError
from payload_emulator.session.recipe import Box, inside_box
from payload_emulator.session.regions import observed_boxes
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.spacecraft import SPACECRAFT_ID
from studies.mission_run.checkpoints import Checkpoints
from studies.mission_run.comparison import compare_reports, largest_relative
from studies.mission_run.figures import Progress, missing_windows, note_plan, windows_asked
from studies.mission_run.ground import EmbeddedGround
from studies.mission_run.run import MissionRun, RunTerms, _read_progress, run_mission
from tests.scenarios import commanded_scenario

SCENARIO = commanded_scenario("half-a-day", "[clock]\noffset_s = 0.4\ndrift_ppm = 5.0\n")
DRIFT_PPM = 5.0

Figures = dict[str, Any]
TERMS = RunTerms(days=0.5, windows_per_day=1, window_s=600.0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Figures]:
    """Folder and figures of a run without a stop."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, run_mission(parse_scenario(SCENARIO), DataFolder(None), folder, TERMS, lambda line: None)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_half_a_day_is_planned_flown_received_and_reported_without_a_person(
    whole: tuple[Path, Figures],
) -> None:
    folder, figures = whole
    said: list[str] = []
    windows = figures["windows"]
    assert windows["requested"] == windows["flown"] == windows["processed"] == figures["reports"] == 1
    assert windows["failed"] == 0 and figures["images_lost"] == 0 and figures["missing_windows"] == []
    assert figures["packets_lost"] == 0 and figures["packets_received"] == figures["packets"] > 0
    (flown,) = figures["performance"]["passes"]
    assert 38 <= flown["frames"] <= 42  # 600 s / 15 s
    assert figures["frames"] == figures["frames_received"] == flown["frames"]
    assert figures["navigation"]["spherical"]["median_m"] == flown["median_error_m"] > 0.0
    # The clock of this scenario drifts: the time reports of the contacts tell by how much.
    with open_ground(folder / "ground") as ground, local_client(ground, "viewer") as client:
        (line,) = [one for one in client.list_correlations(SPACECRAFT_ID) if one.in_force]
    assert line.points >= 3 and line.rejected == 0
    assert line.drift_ppb == pytest.approx(-1e3 * DRIFT_PPM, abs=20.0)
    assert line.residual_max_ns is not None and line.residual_max_ns < 100e3
    # All that was posted is the set-up: catalogue, mission, ephemeris, standing request.
    assert figures["interventions"] == 0 and figures["interventions_list"] == []
    assert figures["alerts"] == len(figures["alarms"]) == 0
    assert figures["monthly_reports"] == [str(folder / "report-2029-08.html")]
    assert "2029-08" in (folder / "report-2029-08.html").read_text()
    assert json.loads((folder / "report.json").read_text())["windows"] == windows
    # The same again prints the figures of the run that has ended; other terms need another folder.
    again = run_mission(parse_scenario(SCENARIO), DataFolder(None), folder, TERMS, said.append)
    assert again["windows"] == windows and "this run has ended" in said[-1]
    with pytest.raises(ScenarioError, match="expected a new folder, or the same scenario and options"):
        run_mission(
            parse_scenario(SCENARIO), DataFolder(None), folder, replace(TERMS, days=0.75), said.append
        )


class Orders:
    """A spacecraft that keeps orders."""

    def __init__(self) -> None:
        self.orders: list[str] = []

    def order(self, word: str) -> None:
        self.orders.append(word)


def state(octets: int) -> dict[str, Any]:
    return {"kind": "state", "unacknowledged": octets}


@pytest.mark.parametrize(
    ("said", "error"),
    [
        ([{"kind": "error", "text": "out of memory"}, state(0)], "spacecraft: out of memory"),
        ([state(10)], "expected its state, found its end"),
        ([state(10)] * 3, "all telemetry within 0 s, found 10 octets without it"),
        ([{"kind": "paused"}, state(10), state(0)], None),
    ],
)
def test_a_wait_for_stored_telemetry_ends_with_an_error_or_with_all(
    said: list[dict[str, Any]], error: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("studies.mission_run.run.SETTLE_S", 0.0 if len(said) == 3 and error else 60.0)
    spacecraft: Any = Orders()
    with nullcontext() if error is None else pytest.raises(LinkError, match=error):
        MissionRun._wait_acknowledged(spacecraft, iter(said))
    assert set(spacecraft.orders) == {"state"}


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"posts": [], "unknown": 1}', '{"posts": [1]}', '{"posts": null}']
)
def test_the_folder_of_another_version_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "progress.json").write_text(text)
    with pytest.raises(ScenarioError, match=r"progress.json: expected .* start the run in a new folder$"):
        _read_progress(tmp_path / "progress.json")


@pytest.mark.parametrize(("days", "asked"), [(0.1, 0), (0.5, 2), (1.0, 2), (1.2, 4), (30.0, 60)])
def test_what_is_asked_for_is_counted_by_the_days_of_the_request(days: float, asked: int) -> None:
    assert windows_asked(days, 2, 4.0 / 24.0) == asked


def test_each_missing_window_has_the_reason_of_the_plan_of_its_day() -> None:
    start = parse_utc("2029-08-07T00:00:00Z")
    at = [UtcTime(start + round(hours * 3.6e12)) for hours in (3.0, 5.0, 30.0, 50.0)]
    night, contact = "Sun below the horizon", "no contact before it to send its telecommands"
    candidates = [
        PlannedCandidate(start=one, stop=one, outcome="rejected", window_id=None, reason=why)
        for one, why in zip(at, (contact, night, contact, None), strict=True)
    ]
    plan = RequestPlan(
        request_id=1, planned=at[1], until=at[3], reason=None, basis="", candidates=candidates, replaced=[]
    )
    progress = Progress()
    note_plan(progress, plan, start)
    note_plan(progress, plan.model_copy(update={"candidates": [], "reason": night}), start)
    found = missing_windows([at[0].utc_ns, at[2].utc_ns, at[2].utc_ns], start, 2, 6, progress)
    assert [(one["day"], one["missing"], one["reason"]) for one in found] == [
        (0, 1, night),
        (2, 2, "not known"),
    ]
    assert progress.not_entered["1"] == contact


def test_what_a_person_does_after_the_posts_is_an_intervention(tmp_path: Path) -> None:
    clock = tmp_path / "clock"
    ground = EmbeddedGround.open(tmp_path / "home", DataFolder(None), clock)
    try:
        ground.client.add_mission(b'name = "x"\n[spacecraft]\nid = 76\n')
        posted = (1, ground.audit_head())
        assert ground.interventions([posted]) == []
        assert len(ground.interventions([])) == 1
        command = ground.client.enter_telecommand("test_connection", 76)
        ground.client.release_telecommand(command.id)
        assert [one["text"].split(":")[0] for one in ground.interventions([posted])] == ["mission-run"] * 2
    finally:
        ground.close()


def test_a_restored_checkpoint_has_archive_spacecraft_and_progress_of_one_moment(tmp_path: Path) -> None:
    home, snapshot, progress = tmp_path / "ground", tmp_path / "exact", tmp_path / "progress.json"
    (home / "incoming").mkdir(parents=True)
    checkpoints = Checkpoints(tmp_path, home, snapshot)

    def write(number: int) -> None:
        snapshot.write_text(str(number))
        progress.write_text(str(number))
        with closing(sqlite3.connect(home / "linna.db")) as connection, connection:
            connection.execute("create table if not exists one (number)")
            connection.execute("insert into one values (?)", (number,))

    for number in (1, 2):
        write(number)
        checkpoints.keep(progress)
    write(3)
    (home / "incoming" / "segment").touch()
    kept = checkpoints.restore()
    assert kept is not None and kept.read_text() == snapshot.read_text() == "2"
    with closing(sqlite3.connect(home / "linna.db")) as connection:
        assert connection.execute("select number from one").fetchall() == [(1,), (2,)]
    assert not (home / "incoming").exists()
    assert Checkpoints(tmp_path / "other", home, snapshot).restore() is None and not home.exists()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_stopped_run_continues_and_ends_with_the_same_figures(
    whole: tuple[Path, Figures], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("studies.mission_run.run.CHECKPOINT_S", 0.0)
    lines: list[str] = []

    def stop(line: str) -> None:
        lines.append(line)
        if len(lines) == 3:
            raise KeyboardInterrupt

    folder = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        run_mission(parse_scenario(SCENARIO), DataFolder(None), folder, TERMS, stop)
    assert (folder / "checkpoint" / "archive.db").exists()
    monkeypatch.setattr("studies.mission_run.run.CHECKPOINT_S", 3600.0)
    again = run_mission(parse_scenario(SCENARIO), DataFolder(None), folder, TERMS, lines.append)
    assert any("continues from 2029-08-07T" in line for line in lines)
    assert again["starts"] == 2 and again["interventions"] == 0
    # A report uses the time correlation of that moment, which further time reports of the contact change a little.
    values, differences = compare_reports(whole[1], again)
    largest = largest_relative(differences)
    assert largest is not None and largest < 1e-5 and values > 50


def flat_terrain(listed: list[tuple[float, float, bool]], tiles: list[tuple[float, float]]) -> Any:
    """Return real terrain with craters (latitude, longitude, complete), and rasters on cells by their corners."""
    latitude, longitude, complete = (np.array(column) for column in zip(*listed, strict=True))
    catalogue = make_catalogue(
        np.radians(latitude), np.radians(longitude), np.full(len(listed), 6e3), source="x", complete=complete
    )

    def covers(latitude_rad: Any, longitude_rad: Any) -> Any:
        south, west = np.degrees(latitude_rad), np.degrees(longitude_rad)
        held = np.zeros(np.broadcast(south, west).shape, dtype=bool)
        for low, left in tiles:
            held |= (south >= low) & (south < low + 15) & (west >= left) & (west < left + 15)
        return held

    return SimpleNamespace(is_real=True, catalogue=catalogue, covers=covers)


def test_windows_are_requested_where_rasters_and_catalogue_describe_the_ground() -> None:
    listed = [
        # Catalogued from 30 S to 30 N at 0 to 15 E, from 30 N to 60 N at 15 to 30 E, in parts at 30 to 45 E.
        *((latitude, 5.0, True) for latitude in (-20.0, -5.0, 5.0, 20.0)),
        *((latitude, 20.0, True) for latitude in (35.0, 50.0)),
        *((latitude, 35.0, latitude < 0.0) for latitude in (-5.0, 5.0)),
    ]
    equator = observed_boxes(flat_terrain(listed, []), 13.0)
    assert equator == [Box(0.0, 15.0, -13.0, 13.0), Box(15.0, 30.0, 32.0, 58.0)]
    # Ground with height rasters comes first, also further away from the equator.
    assert observed_boxes(flat_terrain(listed, [(0.0, 0.0), (15.0, 0.0)]), 13.0)[0] == Box(
        0.0, 15.0, 2.0, 28.0
    )
    # Part of the height is not enough.
    assert observed_boxes(flat_terrain(listed, [(0.0, 0.0)]), 13.0) == equator
    everywhere = SimpleNamespace(is_real=False)
    assert observed_boxes(cast(Any, everywhere), 13.0) == [Box(-180.0, 180.0, -13.0, 13.0)]
    widened = Box(-5.0, 15.0, -13.0, 13.0).widened(5.0)
    places = np.array([0.0, 17.0, 19.0]), np.array([352.0, 19.0, 0.0])
    assert inside_box(widened, *places).tolist() == [True, True, False]
