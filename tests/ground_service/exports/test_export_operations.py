"""Exports over HTTP, with the client, and on the command line."""

import json
import zipfile
from pathlib import Path

import pytest

from ground_service.access.service import add_user
from ground_service.app import create_app
from ground_service.client import ServiceProblem
from ground_service.client.local import local_client
from ground_service.ground import Ground, open_ground
from ground_service.passes.archive_import import import_archive
from ground_service.settings import Settings
from linna.cli import run
from lunar.messages.oem import parse_oem
from tests.ground_service.exports.conftest import FRAMES, RichPass
from tests.serving import TestClient


@pytest.fixture(scope="module")
def home(rich_ground: Ground) -> Path:
    return rich_ground.home


def linna(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    status = run([str(one) for one in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_the_command_writes_one_file(home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "pass.oem"
    status, text, _ = linna(capsys, "export", 1, "--format", "oem", "--out", out, "--home", home, "--json")
    assert status == 0
    assert json.loads(text)["files"] == [str(out)]
    assert parse_oem(out.read_text()).segments[0].object_name == "SELENITA"


def test_the_command_writes_several_files_into_a_folder_or_a_zip(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, packed = tmp_path / "tables", tmp_path / "tables.zip"
    status, text, _ = linna(capsys, "export", 1, "--format", "csv", "--out", folder, "--home", home, "--json")
    assert status == 0
    files = json.loads(text)["files"]
    assert len((folder / "frames.csv").read_text().splitlines()) == 1 + FRAMES
    assert linna(capsys, "export", 1, "--format", "csv", "--out", packed, "--home", home)[0] == 0
    with zipfile.ZipFile(packed) as archive:
        assert sorted(archive.namelist()) == sorted(Path(file).name for file in files)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("1", "--format", "aem", "--out", "{folder}"), "--out: expected a file for aem, found a folder"),
        (("1", "--format", "csv", "--out", "{file}"), "--out: expected a folder for csv, found a file"),
        (("7", "--format", "aem", "--out", "{new}"), "pass 7: not found"),
        (("1", "--format", "oem", "--states", "paper", "--out", "{new}"), "expected reference or anchored"),
    ],
)
def test_faults_of_the_command_are_one_line(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str
) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    places = {name: str(tmp_path / name) for name in ("folder", "file", "new")}
    status, text, errors = linna(
        capsys, "export", *(one.format(**places) for one in arguments), "--home", home
    )
    assert (status, text) == (2, "")
    assert message in errors.splitlines()[-1]
    assert not (tmp_path / "new").exists()


def test_the_client_lists_formats_and_names_a_fault(rich_ground: Ground, tmp_path: Path) -> None:
    with local_client(open_ground(rich_ground.home), "test") as client:
        assert {"oem", "gpkg", "netcdf"} <= {one.name for one in client.list_export_formats()}
        with pytest.raises(ServiceProblem, match=r"expected .*reference"):
            client.export_pass(1, "oem", out=tmp_path / "pass.oem", states="truth")
    assert list(tmp_path.iterdir()) == []


def test_the_server_gives_the_file_with_its_name(rich_pass: RichPass, tmp_path: Path) -> None:
    with TestClient(create_app(Settings(home=tmp_path), inline_jobs=True)) as client:
        ground = client.app.state.ground
        import_archive(ground, rich_pass.folder)
        headers = {"Authorization": f"Bearer {add_user(ground, 'viewer', 'viewer')}"}
        assert client.post("/api/v1/exports", json={"pass_id": 1, "format": "aem"}).status_code == 401
        asked = {"pass_id": 1, "format": "aem", "version": "1.0"}
        answer = client.post("/api/v1/exports", json=asked, headers=headers)
        assert answer.status_code == 200
        assert answer.headers["Content-Disposition"] == 'attachment; filename="pass-1.aem"'
        assert answer.content.startswith(b"CCSDS_AEM_VERS = 1.0")
        for wrong in ({"pass_id": 1, "format": "doc"}, {"pass_id": 1}, {"pass_id": "1", "format": "aem"}):
            assert client.post("/api/v1/exports", json=wrong, headers=headers).status_code == 422
        assert client.get("/api/v1/exports/formats", headers=headers).json()[0]["name"] == "oem"
