"""A synthetic pass, imported and evaluated: every figure is known beforehand."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ground_service.errors import InvalidInput, NotFound
from ground_service.evaluation import service as reports
from ground_service.evaluation.service import evaluate, make_report, pass_summary
from ground_service.ground import Ground, open_ground
from ground_service.http.model import Paging
from ground_service.passes.archive_import import import_archive
from ground_service.store import repository
from lunar.timescales import format_utc
from reports.values import PassReport, SettingsComparison
from tests.ground_service.archive_hash import archive_hash
from tests.ground_service.conftest import enter_files

Imported = tuple[Ground, int, PassReport]
FRAMES = 40
STEP_M = 24_536.0
"""Ground track of 15 s on a circle at 30 km: 1737.4 km * sqrt(GM / (1767.4 km)^3) * 15 s = 24.56 km, less the Moon's
turning under an orbit inclined by 80 degrees (0.15 %)."""


@pytest.fixture(scope="module")
def imported(synthetic_pass: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Imported]:
    with open_ground(tmp_path_factory.mktemp("imported") / "home") as ground:
        pass_id = import_archive(ground, synthetic_pass.folder)
        yield ground, pass_id, evaluate(ground, pass_id)


def series(report: PassReport, name: str) -> Any:
    return next(s for s in report.navigation if s.name == name)


def test_a_constant_error_comes_back_in_its_own_axes(imported: Imported) -> None:
    """30, -40 and 120 m put in along R, T and N come out to a millimetre: the OEM is written to that."""
    estimate = series(imported[2], "spherical")
    np.testing.assert_allclose(estimate.error_rtn_m, np.tile([30.0, -40.0, 120.0], (FRAMES, 1)), atol=2e-3)
    assert estimate.statistics.median_3d_m == pytest.approx(130.0, abs=2e-3)
    assert estimate.statistics.drift_percent == pytest.approx(0.0, abs=1e-6)


def test_drift_is_measured_between_resets(imported: Imported) -> None:
    """400 m a step of the ground track, reset at half time: the figure is the same as without the reset."""
    estimate = series(imported[2], "paper")
    assert estimate.statistics.drift_percent == pytest.approx(100.0 * 400.0 / STEP_M, rel=2e-3)
    assert estimate.statistics.max_3d_m == pytest.approx(7600.0, abs=1.0)
    assert estimate.reset_trigger[0] == "initialization"
    assert estimate.reset_trigger[20] == "safety_timeout"
    assert estimate.reset_error_m[20] == pytest.approx(7600.0, abs=1.0)
    assert (estimate.anchor_reads, estimate.anchor_reads_after_start) == (2, 1)


def test_the_orbit_is_two_body_so_kepler_is_exact_and_gravity_is_not(imported: Imported) -> None:
    report = imported[2]
    assert series(report, "Kepler").statistics.max_3d_m < 0.1
    assert 1.0 < series(report, "propagate-only").statistics.max_3d_m < 1000.0


def test_recall_and_precision_are_those_put_in(imported: Imported, synthetic_pass: Any) -> None:
    detector = imported[2].detector
    assert detector is not None
    assert detector.micro is not None
    assert detector.micro.expected == synthetic_pass.expected
    assert detector.micro.detected_true == synthetic_pass.expected - synthetic_pass.missed
    assert detector.micro.false_alarms == FRAMES
    # 0.5 and -1.25 px put in; telemetry rounds to 1/64 px
    assert detector.micro.localisation_px == pytest.approx(np.hypot(0.5, 1.25), abs=1 / 64)
    assert detector.residuals is not None
    assert np.mean(detector.residuals.du_px) == pytest.approx(0.5, abs=1 / 64)
    assert np.mean(detector.residuals.dv_px) == pytest.approx(-1.25, abs=1 / 64)


def test_frames_and_packets_are_accounted_for(imported: Imported, synthetic_pass: Any) -> None:
    report = imported[2]
    assert report.accounting is not None
    assert report.packets is not None
    assert (report.accounting.expected, report.accounting.processed) == (FRAMES, FRAMES)
    assert report.packets.packets == len(synthetic_pass.packets)
    assert (report.packets.lost, report.packets.duplicates, report.packets.frames_bad) == (0, 0, 0)
    assert len(report.truth_ledger) == 3
    assert len(report.events) == 1


def test_importing_again_gives_the_same_pass_and_the_same_archive(
    imported: Imported, synthetic_pass: Any
) -> None:
    ground, pass_id, _ = imported
    with ground.database.reading() as connection:
        vehicle = repository.get(connection, repository.PASSES, pass_id, "pass")["vehicle_id"]
        before = archive_hash(connection, vehicle)
    assert import_archive(ground, synthetic_pass.folder) == pass_id
    with ground.database.reading() as connection:
        assert archive_hash(connection, vehicle) == before
    assert pass_summary(ground, pass_id)["packets"] == len(synthetic_pass.packets)


def test_the_summary_has_what_the_demonstration_prints(imported: Imported) -> None:
    ground, pass_id, _ = imported
    summary = pass_summary(ground, pass_id)
    json.dumps(summary, allow_nan=False)
    assert summary["pass_id"] == pass_id
    assert summary["packets_lost"] == 0
    assert set(summary["detector"]) >= {"precision", "recall", "loc_px"}
    for mode in ("paper", "spherical"):
        assert set(summary["navigation"][mode]) >= {"median_3d_m", "p95_3d_m", "max_3d_m", "drift_percent"}


def test_a_report_is_written_and_kept(imported: Imported, tmp_path: Path) -> None:
    ground, pass_id, _ = imported
    made = make_report(ground, pass_id, out=tmp_path / "out")
    assert "synthetic pass" in made.html.read_text()
    assert json.loads(made.json.read_text())
    row = ground.read(repository.get, repository.REPORTS, made.report_id, "report")
    assert ground.files.get(row["html_sha256"]) == made.html.read_bytes()


def test_settings_are_compared_with_those_of_the_pass_before(
    imported: Imported, synthetic_pass: Any, tmp_path: Path
) -> None:
    ground, _, first = imported
    assert first.comparison is None
    folder = shutil.copytree(synthetic_pass.folder, tmp_path / "later")
    start = format_utc(first.span.start_utc_ns + 1_000_000_000) if first.span else ""
    enter_files(folder, start_utc=start, frames_expected=41, scenario_toml="no scenario")
    changes = (("observation.frames_expected", FRAMES, 41), ("scenario", {}, "no scenario"))
    later = evaluate(ground, import_archive(ground, folder))
    assert later.comparison == SettingsComparison(first.title, changes)


def test_a_pdf_is_made_on_request_and_reproducible(
    imported: Imported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ground, pass_id, _ = imported
    monkeypatch.setattr(reports, "utc_now_ns", lambda: 0)
    first = make_report(ground, pass_id, out=tmp_path / "first", pdf=True)
    second = make_report(ground, pass_id, out=tmp_path / "second", pdf=True)
    assert first.pdf is not None and second.pdf is not None
    same = first.pdf.read_bytes() == second.pdf.read_bytes()  # no comparison by pytest, which is slow
    assert same and first.pdf.read_bytes().startswith(b"%PDF-")
    assert make_report(ground, pass_id, out=tmp_path / "page").pdf is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("start_utc"), "start_utc: expected str, found None"),
        (lambda m: m.update(stop_utc="yesterday"), "expected UTC epochs"),
        (lambda m: m.update(stop_utc="2020-01-01T00:00:00Z"), "stop_utc: expected an epoch after"),
        (
            lambda m: m.update(schema_version=99),
            "schema_version: expected 1 or less, found 99 of a newer version",
        ),
        (lambda m: m["files"].update({"../x": {"sha256": "0"}}), "expected a path inside the archive"),
        (lambda m: m["files"].update({"no.bin": {"sha256": "0"}}), "no.bin: expected a file of the archive"),
        (lambda m: m["files"]["reference.oem"].update(sha256="0" * 64), "damaged or cut short"),
    ],
)
def test_a_wrong_manifest_is_refused_and_nothing_is_stored(
    synthetic_pass: Any, ground: Ground, tmp_path: Path, change: Any, message: str
) -> None:
    folder = shutil.copytree(synthetic_pass.folder, tmp_path / "wrong")
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(InvalidInput, match=message):
        import_archive(ground, folder)
    with ground.database.reading() as connection:
        assert repository.newest(connection, repository.PASSES, Paging())[1] == 0
        assert repository.newest(connection, repository.FILES, Paging())[1] == 0


def test_no_archive_and_no_pass_are_refused(ground: Ground, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"expected a pass archive with manifest.json"):
        import_archive(ground, tmp_path)
    with pytest.raises(NotFound, match="pass 5: not found"):
        evaluate(ground, 5)
