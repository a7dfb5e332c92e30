"""The operators' commands on this machine and on a server: the same words, the same figures."""

import argparse
import importlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ground_service.access.service import add_user
from ground_service.ground import open_ground
from ground_service.passes.archive_import import import_archive
from ground_service.settings import Settings
from linna.cli import GROUPS, run
from linna.commands import user
from linna.parser import LinnaParser
from lunar.timescales import format_utc, ticks_from_utc_ns
from tests.ground_service.conftest import START, event_packet, save_circle, write_manifest
from tests.serving import served
from tmtc.downlink import encode_cadus

NS = 1_000_000_000


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_circle(tmp_path_factory.mktemp("oem") / "reference.oem")


@pytest.fixture
def downlink(tmp_path: Path) -> Path:
    ticks = int(ticks_from_utc_ns(START + 60 * NS))
    path = tmp_path / "downlink.cadu"
    path.write_bytes(encode_cadus([event_packet(ticks + k, k) for k in range(5)], spacecraft_id=76))
    return path


@pytest.fixture
def server(tmp_path: Path) -> Iterator[list[str]]:
    """A served service with one operator: the options that name it."""
    with served(Settings(home=tmp_path / "served")) as (url, token):
        yield ["--server", url, "--token", token]


def asked(capsys: pytest.CaptureFixture[str], *words: Any, status: int = 0) -> Any:
    code = run([*map(str, words), "--json"])
    printed = capsys.readouterr()
    assert code == status, printed.err
    return json.loads(printed.out) if status == 0 else printed.err


def test_a_pass_archive_is_imported_and_reported_over_the_wire(
    capsys: pytest.CaptureFixture[str], server: list[str], synthetic_archive: Path, tmp_path: Path
) -> None:
    with open_ground(tmp_path / "here") as ground:
        import_archive(ground, synthetic_archive)
    here = asked(capsys, "pass", "show", 1, "--home", tmp_path / "here")
    assert asked(capsys, "ingest", synthetic_archive, *server)["ingested"][0]["pass_id"] == 1
    assert asked(capsys, "pass", "show", 1, *server) == here
    made = asked(capsys, "report", 1, "--out", tmp_path / "out", *server)
    for kind, start in (("html", b"<!"), ("json", b"{"), ("pdf", b"%PDF")):
        assert (tmp_path / "out" / f"report.{kind}").read_bytes().startswith(start)
    assert made["packets"] == here["packets"]


@pytest.fixture
def synthetic_archive(tmp_path: Path, downlink: Path, reference: Path) -> Path:
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


def test_a_wrong_token_and_a_wrong_server_are_told_in_one_line(
    capsys: pytest.CaptureFixture[str], server: list[str]
) -> None:
    wrong = asked(capsys, "pass", "list", *server[:3], "x", status=2)
    assert wrong.strip() == "linna: error: token: expected one that 'linna user add' gave out, found another"
    gone = asked(capsys, "pass", "list", "--server", "http://127.0.0.1:1", status=2)
    assert gone.startswith("linna: error: http://127.0.0.1:1: cannot be reached")
    odd = asked(capsys, "pass", "list", "--server", "ftp://x", status=2)
    assert "expected a URL such as" in odd


def test_a_failed_job_is_reported_in_one_line_that_names_the_file(tmp_path: Path) -> None:
    archive = tmp_path / "archive"
    archive.mkdir()
    (archive / "manifest.json").write_text("{}")
    words = [sys.executable, "-m", "linna", "ingest", str(archive), "--home", str(tmp_path / "home")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    progress, line = done.stderr.splitlines()
    assert progress == f"ingesting {archive} ..."
    assert line.startswith(
        f"linna: error: {archive}: manifest.json, schema_version: expected int, found None (help: "
    )


def ground_commands() -> set[tuple[str, ...]]:
    """Return the commands that accept --server, as group and action."""
    found: set[tuple[str, ...]] = set()
    for group, (module, _) in GROUPS.items():
        parser = LinnaParser()
        importlib.import_module(f"linna.commands.{module}").configure(parser)
        actions = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
        inner = {(group, name): one for action in actions for name, one in action.choices.items()}
        for words, one in (inner or {(group,): parser}).items():
            if "--server" in one.format_help():
                found.add(words)
    return found


SHIPPED_MISSION = """\
name = "exercise"

[spacecraft]
id = 76
name = "EXERCISE"
"""


def test_every_command_of_the_ground_prints_the_same_here_and_on_a_server(
    capsys: pytest.CaptureFixture[str],
    reference: Path,
    downlink: Path,
    synthetic_archive: Path,
    tmp_path: Path,
) -> None:
    mission = tmp_path / "mission.toml"
    mission.write_text(SHIPPED_MISSION)
    receptions = tmp_path / "receptions.csv"
    receptions.write_text("packet_ticks,sequence_count,received_utc\n1,1,2029-08-07T06:00:01.3Z\n")
    build = tmp_path / "build.toml"
    build.write_text('name = "exercise"\n')
    started: set[tuple[str, ...]] = set()
    outputs: list[list[tuple[Any, ...]]] = []
    with open_ground(tmp_path / "here") as ground:
        add_user(ground, "ann", "admin")
    with served(Settings(home=tmp_path / "served"), "admin") as (url, token):
        for where in (["--home", tmp_path / "here", "--as", "ann"], ["--server", url, "--token", token]):
            said: list[tuple[Any, ...]] = []

            def ask(*words: Any, said: list[Any] = said, where: list[Any] = where, text: bool = True) -> Any:
                """Run a command with --json, and without it if that changes nothing."""
                started.update({words[:1], words[:2]})
                code = run([*map(str, (*words, *where)), "--json"])
                printed = capsys.readouterr()
                figures = json.loads(printed.out) if printed.out else None
                said.append((words[:2], code, steady(figures), printed.err if code else ""))
                if text:
                    code = run([*map(str, (*words, *where))])
                    printed = capsys.readouterr()
                    said.append((words[:2], code, printed.out, printed.err if code else ""))
                return figures

            def do(*words: Any) -> Any:
                return ask(*words, text=False)

            do("mission", "add", mission)
            ask("mission", "add", downlink)
            revision = do("mission", "list")["missions"][0]["revision"]
            do("mission", "show", revision)
            ask("mission", "show", "0" * 64)
            do("plan", "ephemeris", reference)
            ask("plan", "withdraw", 99)
            ask("plan", "search", "--altitude-km", 30, 50, "--maximum-duration-s", 900)
            window = [
                "--start", "2029-08-07T06:10:00Z", "--stop", "2029-08-07T06:20:00Z", "--spacecraft-id", "76",
            ]  # fmt: skip
            number = do("plan", "add", *window)["id"]
            ask("plan", "add", *window)
            do("plan", "approve", number)
            do("plan", "draft", number)
            do("plan", "approve", number)
            ask("plan", "preview", number)
            do("plan", "uplink", number)
            ask("plan", "show", number)
            ask("plan", "list")
            do("plan", "fail", number, "--reason", "exercise")
            draft = do("plan", "add", *window, "--name", "second")["id"]
            do("plan", "delete", draft)
            ask("plan", "delete", draft)
            ask("command", "enter", "test_connection", "--spacecraft-id", 76, "unknown=1")
            entered = do("command", "enter", "test_connection", "--spacecraft-id", 76)["id"]
            do("command", "release", entered)
            ask("command", "release", entered)
            ask("command", "show", entered)
            do("command", "uplink", "--spacecraft-id", 76, "--out", tmp_path / "up.cltu")
            rejected = do("command", "enter", "test_connection", "--spacecraft-id", 76)["id"]
            do("command", "reject", rejected, "--reason", "exercise")
            assert do("command", "show", rejected)["remark"] == "exercise"
            ask("command", "enter", "dance", "--spacecraft-id", 76)
            ask("command", "list", "--limit", 2)
            ask("command", "receiver", "--spacecraft-id", 76)
            do("command", "hold", "antenna", "--spacecraft-id", 76)
            do("command", "resume", "--spacecraft-id", 76)
            do("command", "note", "camera warm", "--spacecraft-id", 76)
            assert do("command", "handovers")["handovers"][0]["note"] == "camera warm"
            do("ingest", synthetic_archive)
            do("ingest", downlink)
            ask("ingest", tmp_path / "nothing", downlink)
            ask("ingest", mission)
            ask("pass", "list")
            ask("pass", "show", 1)
            ask("pass", "show", 2)
            do("report", 1, "--out", tmp_path / "report")
            ask("report", 2, "--out", tmp_path / "report")
            ask("performance", "show", "--spacecraft-id", 76)
            month = ["--spacecraft-id", 76, "--month", "2031-01", "--out", tmp_path / "month"]
            ask("performance", "report", *month)
            ask("performance", "list")
            ask("link", "list")
            ask("link", "contacts", "--since", "2029-08-07T00:00:00Z")
            ask("link", "send", "nothing")
            ask("landmarks", "find", 99)
            ask("landmarks", "list", "--state", "proposed", "--limit", 3)
            ask("landmarks", "show", 99)
            ask("landmarks", "accept", 99, "--reason", "a rim in all images")
            ask("landmarks", "reject", 99)
            ask("landmarks", "export", "--labels", "--out", tmp_path / "labels.csv")
            ask("landmarks", "table", 99, "--out", tmp_path / "table.bin")
            ask("landmarks", "upload", mission, "--spacecraft-id", 76)
            ask("catalogue", "add", mission)
            ask("plan", "request", "list")
            ask("export", 99, "--format", "csv", "--out", tmp_path / "export.zip")
            do("alarm", "list", "--state", "raised")
            ask("alarm", "show", 1)
            ask("alarm", "acknowledge", 1, "--comment", "seen")
            ask("alarm", "shelve", 1, "--until", "2029-08-07T07:00:00Z")
            ask("correlate", "list", "--spacecraft-id", 76)
            ask("correlate", "residuals", "--spacecraft-id", 76)
            ask("correlate", "run", "--spacecraft-id", 76)
            ask("correlate", "withdraw", "--spacecraft-id", 76)
            ask("correlate", "receptions", receptions, "--spacecraft-id", 76)
            ask("correlate", "receptions", mission, "--spacecraft-id", 76)
            ask("regress", "archive", "add", synthetic_archive)
            ask("regress", "archive", "add", 99)
            ask("regress", "archive", "render", "0" * 64)
            ask("regress", "archive", "pin", "0" * 64)
            do("regress", "archive", "prune", "--unused-days", 1)
            ask("regress", "archive", "list")
            do("regress", "build", "register", build)
            ask("regress", "build", "register", mission)
            ask("regress", "build", "list")
            archives = ["--archive", synthetic_archive, tmp_path / "nothing"]
            ask("regress", "run", *archives, "--build", "current")
            ask("regress", "run", *archives, "--build", "0" * 64)
            ask("regress", "run", *archives, "--build", "current", "--policy", mission)
            ask("regress", "run", "--pass", 99, "--build", "current")
            ask("regress", "run", "--build", "current")
            ask("regress", "baseline", *archives)
            ask("regress", "placebo", *archives)
            do("user", "add", "bob", "--role", "viewer")
            ask("user", "add", "bob", "--role", "viewer")
            ask("user", "add", "b/b", "--role", "viewer")
            do("user", "token", "bob", "--keep")
            do("user", "disable", "bob")
            ask("user", "disable", "bob")
            do("user", "enable", "bob")
            do("user", "role", "bob", "operator")
            do("user", "missions", "bob", "selenita")
            do("user", "token", "bob", "--keep", "--mission", "selenita")
            ask("user", "disable", "ann")  # the last administrator
            ask("user", "list")
            tokens = do("user", "tokens", "bob")["tokens"]
            do("user", "revoke", tokens[0]["id"])
            ask("user", "revoke", tokens[0]["id"])
            do("audit", "list", "--actor", "ann", "--limit", 5)
            ask("audit", "list", "--since", "yesterday")
            do("audit", "head")
            outputs.append(said)
    assert ground_commands() <= started
    for here, there in zip(*outputs, strict=True):
        assert here == there


def steady(value: Any) -> Any:
    """Return figures without times of entry, hashes and tokens, which differ between two services."""
    left_out = {
        "created", "changed", "requested", "decided", "held", "noted", "sent", "entered", "expires", "used", "revoked",
        "time", "token", "hint", "sha256", "previous_sha256", "report_id", "number", "event",
    }  # fmt: skip
    if isinstance(value, dict):
        return {key: None if key in left_out else steady(item) for key, item in value.items()}
    if isinstance(value, list):
        return [steady(item) for item in value]
    return None if isinstance(value, str) and re.fullmatch("[0-9a-f]{32}", value) else value  # id of a job


def test_an_unusable_file_does_not_keep_the_others_from_being_ingested(
    capsys: pytest.CaptureFixture[str], downlink: Path, tmp_path: Path
) -> None:
    noise = tmp_path / "noise.cadu"
    noise.write_bytes(bytes(range(256)) * 80)
    home = ["--home", tmp_path / "home"]
    again = tmp_path / "again.cadu"
    again.write_bytes(downlink.read_bytes())
    assert run([*map(str, ["ingest", downlink, noise, again, *home]), "--json"]) == 2
    first, bad, last = json.loads(capsys.readouterr().out)["ingested"]
    assert "noise.cadu" in bad["error"]
    assert first["packets"] == last["packets"] > 0 and last["packets_new"] == 0


def test_a_user_of_an_unknown_mission_is_warned_of(capsys: pytest.CaptureFixture[str]) -> None:
    service: Any = SimpleNamespace(
        list_missions=lambda: [SimpleNamespace(mission="selenita")],
        add_user=lambda *_, **__: SimpleNamespace(token="T"),
    )
    assert user._add(service, "ann", "viewer", missions=["selenito", "selenita"])["token"] == "T"
    assert capsys.readouterr().err == (
        "linna: warning: no spacecraft has the mission 'selenito'; known: selenita\n"
    )
