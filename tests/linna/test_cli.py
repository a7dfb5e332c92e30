"""The command line: help, unknown commands, errors as one line; the same words and figures from a server."""

import argparse
import json
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace

from pytest import fixture, mark, raises

from ground_service.ground import open_ground
from ground_service.passes.archive_import import import_archive
from ground_service.settings import Settings
from linna import cli
from linna.__main__ import main
from linna.cli import run
from linna.commands import user
from linna.parser import ABOVE_ZERO, REQUIRED, all_commands, command_parser, number
from lunar.timescales import format_utc, ticks_from_utc_ns
from payload_emulator.errors import install_hint
from payload_emulator.session.scenario import load_scenario
from payload_emulator.session.world.recipe import load_recipe, procedural_recipe
from tests.ground_service.conftest import START, event_packet, save_circle, write_manifest
from tests.scenarios import still_scenario
from tests.serving import ran, served
from tmtc.downlink import encode_cadus


def linna(*arguments):
    return ran([sys.executable, "-m", "linna", *arguments])


def test_help_groups_the_commands_by_task():
    result = linna("--help")
    assert result.returncode == 0
    tasks = [block.splitlines() for block in result.stdout.split("\n\n")[2:-1]]
    assert [task.rstrip(":") for task, *_ in tasks] == [*cli.TASKS]
    assert [line.split()[0] for _, *lines in tasks for line in lines] == [*cli.GROUPS]


def test_help_imports_no_numerical_library():
    code = (
        "import sys, linna.cli; linna.cli.run(['--help']); print([m for m in sys.modules if m in "
        "('numpy', 'numba', 'matplotlib', 'cv2', 'sqlalchemy', 'fastapi', 'onnxruntime')])"
    )
    result = ran([sys.executable, "-c", code], check=True)
    assert result.stdout.strip().endswith("[]")


def test_an_unknown_command_is_one_line_with_the_nearest_name(capsys):
    assert cli.run(["dmo"]) == 2
    captured = capsys.readouterr()
    assert captured.err.strip() == "linna: error: unknown command 'dmo' (did you mean 'demo'?); see linna --help"


def test_every_command_has_a_description_and_an_example_and_states_required_options():
    for group in cli.GROUPS:
        for name, parser in all_commands(command_parser(cli.GROUPS, group)):
            if name.split()[1] != group:
                continue
            assert parser.description, name
            text = " ".join(parser.format_help().split())
            if parser.get_default("handler"):
                words = shlex.split(parser.format_help().rpartition("example: ")[2])
                path = name.split()
                assert words[: len(path)] == path
                parser.parse_args(words[len(path) :])
            for action in parser._actions:
                if action.required and action.option_strings:
                    assert f"{REQUIRED}" in text, f"{name} {action.option_strings[0]}"
                    assert (action.help or "").endswith(REQUIRED), f"{name} {action.option_strings[0]}"


@mark.parametrize(
    "words, page",
    [
        (("emulate", "no-such-scenario"), "tutorials/own-scenario"),
        (("regress", "run", "--build", "none.toml", "--archive", "."), "tutorials/own-build"),
        (("ingest", "{text}", "--home", "{home}"), "tutorials/other-packets"),
    ],
)
def test_errors_of_common_mistakes_name_their_page(words, page, tmp_path, capsys):
    (tmp_path / "text").write_text("nothing of use")
    found = [word.format(text=tmp_path / "text", home=tmp_path / "home") for word in words]
    assert cli.run(found) == 2
    file = Path(capsys.readouterr().err.rpartition("(help: ")[2].removesuffix(")\n"))
    assert file.is_file() and file.with_suffix("").as_posix().endswith(f"/{page}")


def test_errors_are_a_json_object_with_json(capsys):
    assert cli.run(["plan", "add", "--json"]) == 2
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {
        "error": "the following arguments are required: --start, --stop, --spacecraft-id",
        "status": 2,
    }
    assert cli.run(["emulate", "no-such-scenario", "--out", "nowhere", "--json"]) == 2
    captured = capsys.readouterr()
    assert "no such scenario file" in json.loads(captured.out)["error"] and captured.err.count("\n") == 1
    assert cli.run(["plan", "add"]) == 2
    assert capsys.readouterr().out == ""


SCENARIO = still_scenario("small", 60.0)


def test_a_scenario_is_checked_without_a_flight(tmp_path, typed):
    path = tmp_path / "small.toml"
    path.write_text(SCENARIO)
    found = typed(f"emulate {path} --check --json")
    assert (found["frames"], found["start_utc"]) == (4, "2029-08-07T01:40:00Z")
    assert found["stop_utc"] == "2029-08-07T01:40:45Z" and "procedural" in found["data"][0]
    assert [one.name for one in tmp_path.iterdir()] == ["small.toml"]
    path.write_text(SCENARIO.replace("duration_s = 60.0", "duration_s = -1.0"))
    assert "duration_s" in typed(f"emulate {path} --check", 2)


def test_a_mission_description_is_checked_by_a_dry_run(tmp_path, capsys):
    path = tmp_path / "mission.toml"
    path.write_text('name = "m"\n[spacecraft]\nid = 76\n')
    assert cli.run(["mission", "check", str(path)]) == 0
    capsys.readouterr()
    assert cli.run(["mission", "check", str(path), "--flight", "--json"]) == 2
    [fault] = json.loads(capsys.readouterr().out)["faults"]
    assert fault.endswith("reference.oem: expected a file in the folder of the mission description, found none")


def test_a_number_outside_its_limits_is_refused():
    kind = number(int, least=1, most=5)
    assert (kind("1"), kind("5"), ABOVE_ZERO("1e-9")) == (1, 5, 1e-9)
    for wrong, text in [
        (kind, "0"),
        (kind, "6"),
        (kind, "1.5"),
        (ABOVE_ZERO, "0"),
        (ABOVE_ZERO, "nan"),
        (ABOVE_ZERO, "inf"),
    ]:
        with raises(argparse.ArgumentTypeError, match=f"expected a number .*found '{text}'"):
            wrong(text)


def test_a_warning_tells_which_of_home_and_server_is_used(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LINNA_SERVER", "http://ground:8042")
    assert cli.run(["pass", "list", "--home", str(tmp_path)]) == 0
    warning = f"linna: warning: --home {tmp_path} is used, LINNA_SERVER=http://ground:8042 is not"
    assert capsys.readouterr().err.count(warning) == 1


def test_commands_accept_names_of_shipped_scenarios():
    assert load_recipe(Path("selenita")).name == procedural_recipe(20290807).name
    assert load_recipe(Path("paper-dataset")).name == "paper"
    assert load_scenario(Path("paper-day")).name == "paper-day"


def test_installation_hints_fit_the_environment(monkeypatch, tmp_path):
    assert install_hint("train") == "make install-dev"  # a checkout
    monkeypatch.setattr("payload_emulator.errors.__file__", str(tmp_path / "payload_emulator/errors.py"))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert install_hint("train") == f"python3 -m pip --python {sys.executable} install 'linna[train]'"
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object())
    assert install_hint("train") == "pip install 'linna[train]'"


def test_a_list_of_this_machine_imports_neither_http_nor_kernels(tmp_path):
    script = (
        "import sys; from linna.cli import run; status = run(['pass', 'list', '--home', sys.argv[1]]);"
        "print(status, {'fastapi', 'httpx', 'numba', 'numpy'} & set(sys.modules))"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "home")]
    done = ran(command, check=True)
    none = "no passes: telemetry alone makes none; a pass is a flown window, an imported archive, or a defined interval"
    assert done.stdout == f"{none}\n0 set()\n"


def test_a_command_ends_without_a_look_at_every_object(monkeypatch, capsys):
    monkeypatch.setattr("linna.__main__.run", lambda words: 3)
    monkeypatch.setattr("gc.set_threshold", lambda _: None)
    monkeypatch.setattr("gc.freeze", lambda: sys.stdout.write("frozen"))
    with raises(SystemExit, match="3"):
        main()
    assert capsys.readouterr().out == "frozen"


NS = 1_000_000_000


@fixture(scope="module")
def reference(tmp_path_factory):
    return save_circle(tmp_path_factory.mktemp("oem") / "reference.oem")


@fixture
def downlink(tmp_path):
    ticks = int(ticks_from_utc_ns(START + 60 * NS))
    path = tmp_path / "downlink.cadu"
    path.write_bytes(encode_cadus([event_packet(ticks + k, k) for k in range(5)], spacecraft_id=76))
    return path


@fixture
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


@fixture
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
    assert "expected a URL such as" in typed("pass list --server ftp://x --json", 2)


def test_a_failed_job_is_reported_in_one_line_that_names_the_file(tmp_path):
    archive = tmp_path / "archive"
    archive.mkdir()
    (archive / "manifest.json").write_text("{}")
    words = [sys.executable, "-m", "linna", "ingest", str(archive), "--home", str(tmp_path / "home")]
    done = ran(words)
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
