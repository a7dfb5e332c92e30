"""The operators' commands on this machine and on a server: the same words, the same figures."""

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

from ground_service.ground import open_ground
from ground_service.passes.archive_import import import_archive
from ground_service.settings import Settings
from linna.cli import run
from linna.commands import user
from lunar.timescales import format_utc, ticks_from_utc_ns
from tests.ground_service.conftest import START, event_packet, save_circle, write_manifest
from tests.serving import served
from tmtc.downlink import encode_cadus

NS = 1_000_000_000


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    return save_circle(tmp_path_factory.mktemp("oem") / "reference.oem")


@pytest.fixture
def downlink(tmp_path):
    ticks = int(ticks_from_utc_ns(START + 60 * NS))
    path = tmp_path / "downlink.cadu"
    path.write_bytes(encode_cadus([event_packet(ticks + k, k) for k in range(5)], spacecraft_id=76))
    return path


@pytest.fixture
def server(tmp_path):
    """A served service with one operator: the options that name it."""
    with served(Settings(home=tmp_path / "served")) as (url, token):
        yield f"--server {url} --token {token}"


def test_a_pass_archive_is_imported_and_reported_over_the_wire(typed, server, synthetic_archive, tmp_path):
    with open_ground(tmp_path / "here") as ground:
        import_archive(ground, synthetic_archive)
    here = typed(f"pass show 1 --home {tmp_path}/here --json")
    assert typed(f"ingest {synthetic_archive} --json {server}")["ingested"][0]["pass_id"] == 1
    assert typed(f"pass show 1 --json {server}") == here
    made = typed(f"report 1 --out {tmp_path}/out --json {server}")
    for kind, start in (("html", b"<!"), ("json", b"{"), ("pdf", b"%PDF")):
        assert (tmp_path / "out" / f"report.{kind}").read_bytes().startswith(start)
    assert made["packets"] == here["packets"]


@pytest.fixture
def synthetic_archive(tmp_path, downlink, reference):
    """The smallest pass archive there is."""
    folder = tmp_path / "archive"
    folder.mkdir()
    for path in (downlink, reference):
        (folder / path.name).write_bytes(path.read_bytes())
    manifest = {
        "schema_version": 1, "pass_name": "small", "spacecraft_id": 76, "start_utc": format_utc(START),
    }  # fmt: skip
    write_manifest(folder, manifest | {"stop_utc": format_utc(START + 600 * NS)})
    return folder


def test_a_wrong_token_and_a_wrong_server_are_reported_in_one_line(typed, server):
    wrong = typed(f"pass list --json {server}x", 2)
    assert wrong.strip() == "linna: error: token: expected one that 'linna user add' gave out, found another"
    gone = typed("pass list --server http://127.0.0.1:1 --json", 2)
    assert gone.startswith("linna: error: http://127.0.0.1:1: cannot be reached")
    odd = typed("pass list --server ftp://x --json", 2)
    assert "expected a URL such as" in odd


def test_a_failed_job_is_reported_in_one_line_that_names_the_file(tmp_path):
    archive = tmp_path / "archive"
    archive.mkdir()
    (archive / "manifest.json").write_text("{}")
    words = [sys.executable, "-m", "linna", "ingest", str(archive), "--home", str(tmp_path / "home")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    progress, line = done.stderr.splitlines()
    assert progress == f"ingesting {archive} ..."
    assert line.startswith(f"linna: error: {archive}: manifest.json, schema_version: expected int, found None (help: ")


def test_an_unusable_file_does_not_keep_the_others_from_being_ingested(capsys, downlink, tmp_path):
    noise = tmp_path / "noise.cadu"
    noise.write_bytes(bytes(range(256)) * 80)
    home = ["--home", tmp_path / "home"]
    again = tmp_path / "again.cadu"
    again.write_bytes(downlink.read_bytes())
    assert run([*map(str, ["ingest", downlink, noise, again, *home]), "--json"]) == 2
    first, bad, last = json.loads(capsys.readouterr().out)["ingested"]
    assert "noise.cadu" in bad["error"]
    assert first["packets"] == last["packets"] > 0 and last["packets_new"] == 0


def test_a_user_of_an_unknown_mission_is_warned_of(capsys):
    service = SimpleNamespace(
        list_missions=lambda: [SimpleNamespace(mission="selenita")],
        add_user=lambda *_, **__: SimpleNamespace(token="T"),
    )
    assert user._add(service, "ann", "viewer", missions=["selenito", "selenita"])["token"] == "T"
    assert capsys.readouterr().err == ("linna: warning: no spacecraft has the mission 'selenito'; known: selenita\n")
