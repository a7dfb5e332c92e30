"""The distributed form of a mission run: processes are killed, and the figures are those of the embedded form."""

import json
import threading
from pathlib import Path

from pytest import approx, mark

from benchmarks.campaigns._kills import PlannedKill
from benchmarks.campaigns.mission_kills import KillableSpacecraft, KillTerms, run_killed
from ground_service.contacts.links import service as links
from lunar.datafolder import DataFolder
from payload_emulator.session.scenario import parse_scenario
from studies.harness.parts import runs
from studies.mission_run.run import RunTerms, run_mission
from tests.mission_reports import figures_of
from tests.scenarios import commanded_scenario

HOUR_NS = 3_600_000_000_000

SCENARIO = commanded_scenario("half-a-day")

KILLED = (
    ("started", "database", 0.0), ("started", "spacecraft", 0.1), ("ended", "link", 0.3), ("ended", "worker", 0.0),
    ("settled", "broker", 0.2), ("settled", "api", 0.0),
)  # fmt: skip


def hold_telecommands_until_the_spacecraft_was_killed(monkeypatch):
    """Let the ground wait for the stations of a spacecraft that is killed meanwhile."""
    was_restarted = threading.Event()
    restart, unsent = KillableSpacecraft.restart, links.unsent

    def note_restart(spacecraft):
        restart(spacecraft)
        was_restarted.set()

    monkeypatch.setattr(KillableSpacecraft, "restart", note_restart)
    monkeypatch.setattr(links, "unsent", lambda *given: unsent(*given) or int(not was_restarted.is_set()))


@mark.campaign
def test_kills_do_not_change_the_figures_of_a_run(tmp_path, monkeypatch):
    monkeypatch.delenv("LINNA_DATA", raising=False)
    scenario, data = parse_scenario(SCENARIO), DataFolder(None)
    terms = RunTerms(days=0.25, windows_per_day=4, window_s=600.0)
    whole = run_mission(scenario, data, tmp_path / "whole", terms, print)
    planned = tuple(PlannedKill(scenario.epoch_utc_ns, phase, part, delay_s, 0.1) for phase, part, delay_s in KILLED)
    monkeypatch.setattr("benchmarks.campaigns.mission_kills.plan_kills", lambda *_: planned)
    hold_telecommands_until_the_spacecraft_was_killed(monkeypatch)
    folder = tmp_path / "killed"
    killing = KillTerms(0.25, windows_per_day=4, window_s=600.0, kill_seed=1, kills=len(planned))
    killed = run_killed(scenario, data, folder, killing, print)
    assert killed["kills"]["by_part"] == {part: 1 for _, part, _ in sorted(KILLED, key=lambda one: one[1])}
    assert killed["kills"]["done"] == killed["kills"]["planned"] == len(KILLED)
    # A report uses the time correlation of that moment, which further time reports of the contact change a little.
    assert figures_of(killed) == approx(figures_of(whole), rel=1e-5, abs=0.0, nan_ok=True)
    assert len(figures_of(whole)) > 50
    assert killed["windows"]["processed"] == killed["windows"]["flown"] > 0 and killed["interventions"] == 0
    assert killed["packets_received"] == killed["packets"] > 0 and killed["packets_lost"] == 0
    kills = killed["kills"]["list"]
    assert len(kills) == len(KILLED) and all(0.0 < one["recovery_s"] < 120.0 for one in kills)
    # Nothing is left of the deployment.
    assert not any(runs(pid) for pid, _ in json.loads((folder / "processes.json").read_text()).values())
    assert not Path((folder / "postgres-folder").read_text()).exists()
