"""A pass with contacts, losses and faults, without rendering: the archive's own account is what the ground finds."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lunar.datafolder import find_data
from lunar.timescales import parse_utc
from payload_emulator.flight.payload import Payload
from payload_emulator.session.archive import emulator
from payload_emulator.session.archive.emulator import emulate
from payload_emulator.session.scenario import parse_scenario
from tmtc.dictionary.tables import CatalogueTable, pack_catalogue_table
from tmtc.downlink import decode
from tmtc.errors import TableError

ORBIT = """
[dynamics]
gravity = "builtin"
degree = 8
orientation = "iau"
[window]
search = "none"
start = "2029-08-08T02:30:00Z"
"""

SCENARIO = f"""
name = "lossy"
seed = 11
{ORBIT}duration_s = 6600.0
[camera]
images = "reduced"
frame_interval_s = 30.0
[terrain]
source = "procedural"
[navigation]
estimators = ["spherical"]
filter_gravity = "builtin"
filter_degree = 8
[clock]
offset_s = 0.4
drift_ppm = 3.0
[link]
stations = ["goldstone", "madrid", "canberra"]
minimum_elevation_deg = 5.0
rate_bps = 16000.0
frame_loss = 0.02
burst_start = 0.01
burst_end = 0.3
burst_frame_loss = 0.3
burst_bit_error_rate = 5e-3
repeat_share = 0.2
reorder_share = 0.2
playback = true
[faults]
events = ["processor_hang at 600", "camera_dark at 1200 for 120"]
"""


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    out = tmp_path_factory.mktemp("lossy") / "pass"
    return emulate(parse_scenario(SCENARIO), find_data(None), out), out


def test_every_octet_of_a_lossy_downlink_is_accounted_for(archive: tuple[dict[str, Any], Path]) -> None:
    summary, out = archive
    link, octets = summary["link"], (out / "downlink.cadu").read_bytes()
    found = decode(octets).accounting()
    for key in ("frames", "frames_bad", "packets", "duplicates"):
        assert found[key] == link[key], key
    assert sum(found["octets"].values()) == link["octets"] == len(octets)
    assert (found["crc_errors"], found["conflicts"], found["unknown"]) == (0, 0, 0)
    # Late playback and repeated dumps make copies; what is missing by its counts was lost on the link.
    assert link["duplicates"] > 0 and link["packets_lost"] > 0
    assert found["packets_missing"] <= link["packets_lost"]
    assert json.loads((out / "summary.json").read_text())["link"] == link


def test_the_machine_tells_of_its_faults_and_finishes_the_window(
    archive: tuple[dict[str, Any], Path],
) -> None:
    summary, out = archive
    assert summary["resets"] == ["watchdog"]
    assert summary["mode"] in ("standby", "downlinking")
    tables = decode((out / "downlink.cadu").read_bytes()).tables()
    events = {
        int(code) for name, t in tables.items() if name.startswith("event_") for code in t.columns["event_id"]
    }
    # boot, activity released, image dark, watchdog reset, state recovered
    assert {1, 5, 16, 50, 57} <= events
    quantities = tables["housekeeping"].columns
    assert quantities["boot_count"].max() == 2
    assert 20.0 > quantities["power_w"].max() > quantities["power_w"].min() > 1.0
    assert 10.0 < quantities["bus_voltage_v"].min() <= quantities["bus_voltage_v"].max() < 13.0


def test_no_frame_is_seen_twice_and_none_goes_back_in_time(archive: tuple[dict[str, Any], Path]) -> None:
    _, out = archive
    table = decode((out / "downlink.cadu").read_bytes()).tables()["detections"]
    _, first = np.unique(table.ticks, return_index=True)
    frames = table.columns["frame_number"][first]
    assert np.all(np.diff(frames) >= 1)


def test_the_dumps_are_listed_with_the_times_they_left(archive: tuple[dict[str, Any], Path]) -> None:
    summary, out = archive
    head, *rows = (out / "dumps.csv").read_text().splitlines()
    assert head == "sent_utc,received_utc,virtual_channel,packets,octets"
    assert len(rows) == summary["link"]["dumps"]
    assert sum(int(row.split(",")[3]) for row in rows) == summary["packets"]
    assert {row.split(",")[2] for row in rows} == {"0", "1"}
    # The Moon is 1.2 to 1.4 light seconds away.
    ways_s = [(parse_utc(b) - parse_utc(a)) / 1e9 for a, b in (row.split(",")[:2] for row in rows)]
    assert all(1.15 < way_s < 1.4 for way_s in ways_s)


def test_the_ground_finds_the_time_of_every_frame_from_time_reports(
    archive: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    from ground_service.evaluation.inputs import load_pass_inputs
    from ground_service.ground import open_ground
    from ground_service.missions.timekeeping.store import correlations_in_force
    from ground_service.passes.archive_import import import_archive
    from ground_service.worker.follow_up import follow_in_process

    _, out = archive
    true = np.loadtxt(out / "frame_times.csv", delimiter=",", skiprows=1, dtype=np.int64)
    with open_ground(tmp_path / "home") as ground:
        follow_in_process(ground)
        key = import_archive(ground, out)
        found = load_pass_inputs(ground, key).detections
        lines = ground.read(correlations_in_force, 1)
    assert [line.boot_count for line in lines] == [1, 2]
    assert lines[1].drift_ppb == pytest.approx(-3000.0, abs=200.0)
    nearest = np.abs(found.utc_ns[:, None] - true[None, :, 1]).min(axis=1)
    # 0.4 s off without the correlation; a tick is 15 us, and the first line is carried on to the boot.
    assert nearest.max() < 1_000_000


SHORT = f"""
name = "short"
{ORBIT}duration_s = 90.0
latitude_limit_deg = 90.0
[camera]
images = "reduced"
frame_interval_s = 30.0
[terrain]
source = "procedural"
[navigation]
estimators = ["anchored"]
filter_gravity = "builtin"
filter_degree = 8
"""


def test_a_named_anchoring_table_is_uploaded_as_it_is(tmp_path: Path) -> None:
    table = CatalogueTable(
        np.arange(3),
        np.radians([10.0, 20.0, 30.0]),
        np.radians([40.0, 50.0, 60.0]),
        np.full(3, 8e3),
        np.zeros(3),
        np.full((3, 3), 50.0),
    )
    named = tmp_path / "three.table"
    named.write_bytes(pack_catalogue_table(table))
    scenario = parse_scenario(SHORT).with_choices(anchoring_catalogue=named)
    emulate(scenario, find_data(None), tmp_path / "pass")
    manifest = json.loads((tmp_path / "pass" / "manifest.json").read_text())
    assert manifest["tables"]["catalogue"] == hashlib.sha256(named.read_bytes()).hexdigest()


def test_an_anchoring_table_that_is_none_is_refused_before_the_flight(tmp_path: Path) -> None:
    missing = parse_scenario(SHORT).with_choices(anchoring_catalogue=tmp_path / "none.table")
    with pytest.raises(TableError, match=r"none\.table: expected a table made by linna catalogue curate"):
        emulate(missing, find_data(None), tmp_path / "pass")
    damaged = tmp_path / "damaged.table"
    damaged.write_bytes(b"no table")
    with pytest.raises(TableError):
        emulate(
            parse_scenario(SHORT).with_choices(anchoring_catalogue=damaged),
            find_data(None),
            tmp_path / "pass",
        )
    assert not (tmp_path / "pass").exists()


@pytest.mark.parametrize("reads", [0, 2])
def test_reads_of_the_truth_are_counted_where_they_happen(
    reads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A payload cannot read the truth; a payload with access to it is detected."""
    stolen: list[Any] = []
    build, step = emulator.build_world, Payload.step

    def seen(*given: Any) -> Any:
        stolen.append(build(*given))
        return stolen[0]

    def stealing(self: Payload, *given: Any) -> Any:
        for _ in range(reads):
            stolen[0].truth.states(int(stolen[0].frame_utc_ns[0]))
        return step(self, *given)

    monkeypatch.setattr(emulator, "build_world", seen)
    monkeypatch.setattr(Payload, "step", stealing)
    text = SCENARIO.replace("duration_s = 6600.0", "duration_s = 90.0").replace(
        'name = "lossy"', 'name = "short"'
    )
    text = text.replace('estimators = ["spherical"]', 'estimators = ["paper"]')
    text = text.replace("2029-08-08T02:30:00Z", "2029-08-07T01:40:00Z")
    summary = emulate(parse_scenario(text), find_data(None), tmp_path / "pass")
    frames = summary["frames"]
    assert frames >= 2
    assert summary["truth_reads_after_start"] >= reads * frames
    assert (summary["truth_reads_after_start"] > 0) is (reads > 0)
    # The odometry reads its anchor ephemeris at every frame: that is another count.
    assert summary["anchor_reads_after_start"] >= frames - 1
