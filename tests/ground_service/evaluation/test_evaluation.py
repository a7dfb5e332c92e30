"""A synthetic pass, imported and evaluated: every figure is known beforehand."""

import hashlib
import json
import shutil

import pytest

from ground_service.client.connection import NotFound as NotFoundThere
from ground_service.client.connection import ServiceProblem
from ground_service.client.local import local_client
from ground_service.errors import InvalidInput, NotFound, StorageFull
from ground_service.evaluation import service as reports
from ground_service.evaluation.service import evaluate, make_report, pass_summary, report_document
from ground_service.ground import Ground, open_ground
from ground_service.http.model import Paging
from ground_service.passes.archive_import import import_archive
from ground_service.store import repository
from lunar.timescales import format_utc
from reports import pdf_pages
from reports.values import PassReport, SettingsComparison
from tests.ground_service.archive_hash import archive_hash
from tests.ground_service.conftest import enter_files

Imported = tuple[Ground, int, PassReport]
FRAMES = 40


@pytest.fixture(scope="module")
def imported(synthetic_pass, tmp_path_factory):
    with open_ground(tmp_path_factory.mktemp("imported") / "home") as ground:
        pass_id = import_archive(ground, synthetic_pass.folder)
        yield ground, pass_id, evaluate(ground, pass_id)


def test_importing_again_gives_the_same_pass_and_the_same_archive(imported, synthetic_pass):
    ground, pass_id, _ = imported
    vehicle = ground.read(repository.get, repository.PASSES, pass_id, "pass")["vehicle_id"]
    before = ground.read(archive_hash, vehicle)
    assert import_archive(ground, synthetic_pass.folder) == pass_id
    assert ground.read(archive_hash, vehicle) == before
    assert pass_summary(ground, pass_id)["packets"] == len(synthetic_pass.packets)


def test_a_report_is_written_and_kept(imported, tmp_path):
    ground, pass_id, _ = imported
    made = make_report(ground, pass_id, out=tmp_path / "out")
    assert "synthetic pass" in made.html.read_text()
    assert json.loads(made.json.read_text())
    row = ground.read(repository.get, repository.REPORTS, made.report_id, "report")
    assert ground.files.get(row["html_sha256"]) == made.html.read_bytes()


def test_settings_are_compared_with_those_of_the_pass_before(imported, synthetic_pass, tmp_path):
    ground, _, first = imported
    assert first.comparison is None
    folder = shutil.copytree(synthetic_pass.folder, tmp_path / "later")
    start = format_utc(first.span.start_utc_ns + 1_000_000_000) if first.span else ""
    enter_files(folder, start_utc=start, frames_expected=41, scenario_toml="no scenario")
    changes = (("observation.frames_expected", FRAMES, 41), ("scenario", {}, "no scenario"))
    later = evaluate(ground, import_archive(ground, folder))
    assert later.comparison == SettingsComparison(first.title, changes)


def test_a_pdf_is_made_of_stored_octets_when_it_is_first_read(imported, tmp_path, monkeypatch):
    """With a full disk it is read all the same, made again for the next reader, and equal."""
    ground, pass_id, _ = imported
    (tmp_path / "report.pdf").write_bytes(b"of the report before")
    key = make_report(ground, pass_id, out=tmp_path).report_id
    assert not (tmp_path / "report.pdf").exists()

    def fail(*_):
        raise StorageFull("archive")

    def kept():
        return ground.read(repository.get, repository.REPORTS, key, "report")["pdf_sha256"]

    with monkeypatch.context() as full:
        full.setattr(reports, "register_file", fail)
        first = report_document(ground, key, "pdf")
    assert first.startswith(b"%PDF-") and kept() is None
    monkeypatch.setattr(reports, "evaluate_pass", fail)
    digests = {hashlib.sha256(octets).hexdigest() for octets in (first, report_document(ground, key, "pdf"))}
    assert digests == {kept()}
    monkeypatch.setattr(pdf_pages, "pdf_of", fail)
    assert report_document(ground, key, "pdf")[:5] == b"%PDF-"


def test_a_report_is_made_in_process_without_http(imported, tmp_path, monkeypatch):
    """What fails is asked again as an operation, which states the fault."""
    ground, pass_id, _ = imported
    monkeypatch.setattr(pdf_pages, "pdf_of", lambda *_: b"%PDF-")
    with local_client(open_ground(ground.home), "ann") as client, monkeypatch.context() as patched:
        patched.setattr(type(client), "_transport", None)
        key = client.make_report(pass_id)
        for kind in ("html", "json", "pdf"):
            client.get_report(key, tmp_path / f"report.{kind}", format=kind)
        assert client.get_report_summary(key).pass_id == pass_id
        assert client.get_job(key).state == "done"
        patched.undo()
        for ask in (client.make_report, client.get_job, client.get_report_summary):
            with pytest.raises(ServiceProblem, match=r"expected|String should match"):
                ask(-1)
        with pytest.raises(NotFoundThere, match=f"report {'0' * 32}: not found"):
            client.get_report("0" * 32, tmp_path / "none")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["report.html", "report.json", "report.pdf"]
    assert (tmp_path / "report.pdf").read_bytes() == report_document(ground, key, "pdf") == b"%PDF-"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start_utc": None}, "start_utc: expected str, found None"),
        ({"stop_utc": "yesterday"}, "expected UTC epochs"),
        ({"stop_utc": "2020-01-01T00:00:00Z"}, "stop_utc: expected an epoch after"),
        ({"schema_version": 99}, "schema_version: expected 1 or less, found 99 of a newer version"),
        ({"../x": "0"}, "expected a path inside the archive"),
        ({"no.bin": "0"}, "no.bin: expected a file of the archive"),
        ({"reference.oem": "0" * 64}, "damaged or cut short"),
    ],
)
def test_a_wrong_manifest_is_refused_and_nothing_is_stored(synthetic_pass, ground, tmp_path, change, message):
    folder = shutil.copytree(synthetic_pass.folder, tmp_path / "wrong")
    manifest = json.loads((folder / "manifest.json").read_text())
    for key, value in change.items():
        if "." in key:
            manifest["files"][key] = {"sha256": value}
        else:
            manifest[key] = value
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(InvalidInput, match=message):
        import_archive(ground, folder)
    for table in (repository.PASSES, repository.FILES):
        assert ground.read(repository.newest, table, Paging())[1] == 0


def test_no_archive_and_no_pass_are_refused(ground, tmp_path):
    with pytest.raises(InvalidInput, match=r"expected a pass archive with manifest.json"):
        import_archive(ground, tmp_path)
    with pytest.raises(NotFound, match="pass 5: not found"):
        evaluate(ground, 5)
