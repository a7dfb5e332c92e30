"""Builds as programs inside limits: what becomes of those that behave and do not; their verdicts in lists."""

import dataclasses
import tempfile
import time
import venv
from pathlib import Path

from pytest import fixture, mark, raises

from ground_service.errors import BuildNotChecked, InvalidInput
from ground_service.http.model import Paging, UtcTime
from ground_service.regression import builds
from ground_service.regression import sandbox as host
from ground_service.regression.build_runs import run_build
from ground_service.regression.builds import changes, load_build, register_build
from ground_service.regression.model import REASONS_LIMIT, JudgedGate, Regression, Verdict
from ground_service.regression.sandbox import SandboxRefused
from ground_service.regression.store import list_builds
from linna.cli import run as run_command
from tests.serving import ran

LIMITS = "\n[limits]\nwall_s = 20\ncpu_s = 10\nmemory_mib = 300\nfile_mib = 4\nfolder_mib = 12\n"


@fixture(scope="module")
def archive(make_flyable):
    return make_flyable(frames=2, seed=31).folder


@fixture
def fly(make_build, archive, tmp_path):
    def run(program, limits=LIMITS):
        build = load_build(make_build("bad", program="import os, pathlib, sys, time\n" + program, extra=limits))
        return run_build(build, archive, tmp_path / "out")

    return run


def test_a_program_that_ends_well_leaves_a_downlink_and_its_costs(fly, tmp_path):
    run = fly("pathlib.Path(sys.argv[2], 'downlink.packets').write_bytes(b'abc')\nx = [0] * 4_000_000")
    assert (run.outcome, run.detail) == ("ok", "")
    assert run.downlink == tmp_path / "out/downlink.packets"
    assert run.downlink.read_bytes() == b"abc"
    assert 0.0 < run.cpu_s < 10.0
    # Four million pointers of eight octets, on top of an interpreter of some ten.
    assert 30.0 < run.peak_rss_mib < 120.0
    assert not (tmp_path / "out/.run").exists()


def test_builds_do_not_run_without_bubblewrap(fly, monkeypatch):
    monkeypatch.setattr(host.shutil, "which", lambda name: None)
    host.protection.cache_clear()
    run = fly("pathlib.Path(sys.argv[2], 'downlink.packets').write_bytes(b'abc')")
    assert (run.outcome, run.downlink) == ("refused", None)
    assert run.detail.startswith("expected the program bwrap (Debian package bubblewrap), found none; remedy: ")


def test_a_refusal_has_a_reason_if_python_says_nothing(monkeypatch):
    host.protection.cache_clear()
    monkeypatch.setattr(host, "execute", lambda run: {"exit_status": 1})
    with raises(host.SandboxRefused, match="Python does not run in the sandbox: no text, exit status 1"):
        host.protection()


def test_builds_run_where_python_is_installed_below_tmp():
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        Path(name).chmod(0o755)
        venv.create(name)
        command = [f"{name}/bin/python", "-c", f"from {host.__name__} import *; print(protection())"]
        environment = {"PYTHONPATH": str(host.package_root())}
        said = ran(command, env=environment, check=True)
    assert said.stdout.startswith("bubblewrap, private root, user ")


def test_the_processor_time_of_ended_processes_counts(fly):
    run = fly(
        "for _ in range(3):\n"
        "    if os.fork() == 0:\n"
        "        while time.process_time() < 0.1: pass\n"
        "        os._exit(0)\n"
        "    os.wait()\n"
        "pathlib.Path(sys.argv[2], 'downlink.packets').write_bytes(b'abc')\n"
    )
    assert 0.29 < run.cpu_s < 3.0


def test_a_program_that_makes_too_many_files_is_stopped(fly, monkeypatch):
    monkeypatch.setattr(host, "INODES", 500)
    run = fly("for k in range(1000): pathlib.Path(sys.argv[2], str(k)).touch()\ntime.sleep(2)")
    assert run.outcome == "disk"


@mark.parametrize(
    "program, outcome, message",
    [
        ("os.kill(os.getpid(), 11)", "crashed", "11"),
        ("while True: pass", "cpu", ""),
        (
            "for i in range(8): pathlib.Path(sys.argv[2], f'{i}.bin').write_bytes(bytes(2 << 20))\ntime.sleep(2)",
            "disk",
            "",
        ),
    ],
)
def test_a_program_that_kills_itself_or_exceeds_a_limit_is_reported(fly, program, outcome, message):
    run = fly(program, LIMITS.replace("cpu_s = 10", "cpu_s = 1"))
    assert run.outcome == outcome and message in run.detail


def test_a_program_that_is_not_there_is_a_crash_and_no_error_of_the_ground(archive, tmp_path):
    file = tmp_path / "build.toml"
    file.write_text('name = "gone"\ncommand = ["/nonexistent/program", "{archive}", "{out}"]\n')
    run = run_build(load_build(file), archive, tmp_path / "out")
    assert run.outcome == "crashed"


def test_what_a_program_leaves_running_is_killed_with_it(fly, tmp_path):
    """It forks twice into a session of its own, as a daemon does."""
    marker = tmp_path / "alive"
    fly(
        "if os.fork() == 0:\n"
        "    os.setsid()\n"
        "    if os.fork() == 0:\n"
        f"        os.execv('/bin/sh', ['sh', '-c', 'while true; do echo x >> {marker}; sleep 0.05; done'])\n"
        "    os._exit(0)\n"
        "time.sleep(0.3)\n"
        "pathlib.Path(sys.argv[2], 'downlink.packets').write_bytes(b'abc')\n"
    )
    before = marker.stat().st_size if marker.exists() else 0
    time.sleep(0.3)
    assert (marker.stat().st_size if marker.exists() else 0) == before


def test_a_program_gets_no_socket_but_pairs_of_its_own(fly):
    run = fly(
        "import socket\n"
        "found = []\n"
        "for family in (socket.AF_INET, socket.AF_INET6, socket.AF_UNIX, socket.AF_NETLINK, socket.AF_VSOCK):\n"
        "    try:\n        socket.socket(family); found.append('made')\n"
        "    except OSError as error: found.append(error.errno)\n"
        "a, b = socket.socketpair(); a.send(b'x'); found.append(b.recv(1).decode())\n"
        "found.append(pathlib.Path('/proc/net/dev').read_text().count('\\n') - 2)\n"
        "pathlib.Path(sys.argv[2], 'downlink.packets').write_text(str(found))\n"
    )
    # EPERM of the system call filter; and behind it a network of its own that holds an idle loopback only.
    assert run.downlink.read_text() == "[1, 1, 1, 1, 1, 'x', 1]"


def test_a_program_sees_what_the_payload_was_given_and_no_truth_or_secret(fly, monkeypatch):
    for secret in "LINNA_DATABASE_URL", "HTTPS_PROXY", "LINNA_DATA":
        monkeypatch.setenv(secret, "postgresql://secret")
    run = fly(
        "seen = sorted(str(p.relative_to(sys.argv[1])) for p in pathlib.Path(sys.argv[1]).rglob('*') if p.is_file())\n"
        "found = [*seen, *sorted(os.environ)]\n"
        "pathlib.Path(sys.argv[2], 'downlink.packets').write_text('\\n'.join(found))\n"
    )
    found = run.downlink.read_text().split("\n")
    assert {"manifest.json", "payload/inputs.jsonl", "frames/000000.png"} <= set(found)
    assert not {"reference.oem", "truth.oem", "catalogue.csv", "downlink.cadu"} & set(found)
    assert "PATH" in found and not {"LINNA_DATABASE_URL", "HTTPS_PROXY", "LINNA_DATA"} & set(found)


def test_a_program_reads_compiled_functions_of_the_service_and_changes_none(fly, tmp_path, monkeypatch):
    cache = tmp_path / "kernels"
    cache.mkdir()
    (cache / "one").write_text("code")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))
    run = fly(
        "folder, found = pathlib.Path(os.environ['NUMBA_CACHE_DIR']), ''\n"
        "try: (folder / 'two').touch()\n"
        "except OSError as error: found = error.strerror\n"
        "pathlib.Path(sys.argv[2], 'downlink.packets').write_text((folder / 'one').read_text() + found)\n"
    )
    assert run.downlink.read_text() == "codeRead-only file system"


def test_a_program_that_damages_its_archive_damages_a_copy(fly, archive):
    before = (archive / "frames/000000.png").read_bytes()
    fly("pathlib.Path(sys.argv[1], 'frames/000000.png').write_bytes(b'')")
    assert (archive / "frames/000000.png").read_bytes() == before


def test_a_run_goes_into_a_new_folder_only(fly, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/precious").write_text("x")
    with raises(InvalidInput, match="expected a new or empty folder"):
        fly("")


WRONG_BUILDS = r"""
command = ["x", "{archive}", "{out}"] -> name: expected a value, found nothing
name = "x" | command = ["x"] -> expected the places {archive} and {out}
name = "x" | comand = [] -> comand: expected 'command', found unknown key 'comand'
name = "x" | model = "../../etc/passwd" -> expected a file in the folder of the build file, found one elsewhere
name = "x" | model = "gone.onnx" -> gone.onnx: expected a file in the folder of the build file, found nothing
name = "x" | limits.wall_s = -1 -> limits.wall_s: expected greater than 0, found -1
name = "x" | limits.wall_s = 7_201 -> limits.wall_s: expected less than or equal to 7200
name = "x" | limits.memory_mib = 9_000_000_000_000 -> limits.memory_mib: expected less than or equal
name = "x" | provenance.commit = 0xF -> provenance.commit
name = "x" | schema_version = 9 -> schema_version: expected 1, found 9
name =  -> expected a build file (TOML)
name = "x\u001b" -> name: expected a text without control characters, found
name = "x\u2028" -> name: expected a line of 1 to 200 characters without control characters
name = "x" | version = "1\n2" -> version: expected a line of 1 to 200 characters
name = "x" | command = ["x", "{archive}", "{out}"] | model = "m" -> expected a command, or a model
"""


@mark.parametrize("row", WRONG_BUILDS.strip().split("\n"))
def test_a_bad_build_file_is_refused_with_its_key(row, tmp_path):
    text, message = row.replace("0xF", f"0x{'f' * 5000}").split(" -> ")
    file = tmp_path / "build.toml"
    file.write_text(text.replace(" | ", "\n"))
    with raises(InvalidInput) as error:
        load_build(file)
    assert message in str(error.value)


def test_the_identity_of_a_build_is_that_of_what_it_runs(make_build):
    first = load_build(make_build("one", program="pass"))
    file = first.folder / "build.toml"
    file.write_text(file.read_text().replace('name = "one"', 'name = "two"'))
    assert load_build(file).digest == first.digest
    (first.folder / "fly.py").write_text("pass  # changed")
    assert load_build(file).digest != first.digest
    assert len(load_build("current").digest) == 64


def test_what_differs_between_two_builds_on_the_flight_code_is_named(tmp_path, make_build):
    def build(name, text, parameters=""):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "p.toml").write_text(parameters)
        (folder / "m.onnx").write_bytes(name.encode())
        (folder / "build.toml").write_text(f'name = "{name}"\n{text}')
        return load_build(folder)

    own = 'parameters = "p.toml"\n'
    good = build("good", own, "flight.odometry.time_gap_s = 61.0\ndetector.score_threshold = 0.5\n")
    bad = build("bad", own, "detector.score_threshold = 0.9\n[flight]\nhousekeeping_interval_s = 30.0\n")
    flown = [{"flight.housekeeping_interval_s": 60.0, "flight.odometry.time_gap_s": 61.0}]
    assert changes(good, bad, flown) == [
        "detector.score_threshold = 0.9 (baseline: 0.5)",
        "flight.housekeeping_interval_s = 30.0 (baseline: 60.0)",
    ]
    assert changes(good, bad) == [
        "detector.score_threshold = 0.9 (baseline: 0.5)",
        "flight.housekeeping_interval_s = 30.0 (baseline: not set)",
        "flight.odometry.time_gap_s = not set (baseline: 61.0)",
    ]
    assert changes(good, good) == changes(load_build("current"), build("same", "")) == []
    assert changes(load_build("current"), build("other", 'model = "m.onnx"\n')) == ["network"]
    older = dataclasses.replace(load_build("current"), flight_code="0" * 64)
    assert changes(older, load_build("current")) == ["flight code"]
    assert changes(good, load_build(make_build("program", program="pass"))) == []


@fixture
def write(tmp_path):
    def build(parameters):
        (tmp_path / "p.toml").write_text(parameters)
        (tmp_path / "build.toml").write_text('name = "b"\nparameters = "p.toml"\n')
        return str(tmp_path / "build.toml")

    return build


@mark.parametrize(
    "text, message",
    [
        (
            "flight.anchored.gravity_degre = 60",
            "p.toml, flight.anchored.gravity_degre: expected gravity_degree (nearest known key), found an unknown key",
        ),
        (
            "detector.score_threshold = 7.0",
            "p.toml, detector.score_threshold: expected a finite number from 0 to 1, found 7.0",
        ),
    ],
)
def test_a_wrong_parameter_is_refused_in_one_line_and_nothing_is_registered(ground, write, text, message):
    with raises(InvalidInput) as error:
        register_build(ground, load_build(write(text)))
    assert str(error.value) == message
    assert ground.read(list_builds, Paging()).items == []
    assert not list((ground.home / "regression/builds").glob("*"))


def test_right_parameters_are_registered_and_checked_once(ground, write, monkeypatch):
    file = write("flight.anchored.gravity_degree = 60")
    first = register_build(ground, load_build(file))
    assert [one.digest for one in ground.read(list_builds, Paging()).items] == [first.digest]
    monkeypatch.setattr(builds, "run_confined", None)
    assert register_build(ground, load_build(file)).digest == first.digest


def _refused(*_, **__):
    raise SandboxRefused("no user namespaces")


def _ended(**changes):
    def run(request, staged, written, printed, **_):
        printed.write_text("Traceback\nMemoryError\n")
        return {"cause": "", "exit_status": 0} | changes

    return run


@mark.parametrize(
    "run, message",
    [
        (_refused, "no user namespaces"),
        (_ended(exit_status=1), "status 1: MemoryError"),
        (_ended(exit_status=2), "status 2: MemoryError"),
        (_ended(exit_status=137), "status 137"),
        (_ended(cause="timeout"), "ended with timeout"),
    ],
)
def test_a_build_that_cannot_be_checked_is_not_registered(ground, write, monkeypatch, run, message):
    monkeypatch.setattr(builds, "run_confined", run)
    with raises(BuildNotChecked, match=message):
        register_build(ground, load_build(write("flight.anchored.gravity_degree = 60")))
    assert ground.read(list_builds, Paging()).items == []


def test_the_command_checks_a_build_file(write, capsys):
    assert run_command(["replay", "--check-build", write("detector.max_detection = 3")]) == 2
    assert "expected max_detections (nearest known key), found an unknown key" in capsys.readouterr().out
    file = write("detector.max_detections = 3")
    assert run_command(["replay", "--check-build", file]) == 0
    text = Path(file).read_text()
    for wrong, message in ("schema_version = 7", "expected 1, found 7"), ("modle = 'x'", "expected 'model'"):
        Path(file).write_text(f"{wrong}\n{text.replace('schema_version = 1', '')}")
        capsys.readouterr()
        assert run_command(["replay", "--check-build", file]) == 2
        assert message in capsys.readouterr().out
    assert run_command(["replay", "--out", "x"]) == 2
    assert "expected ARCHIVE, or --check-build BUILD" in capsys.readouterr().err


BUILD = {"version": "1.2", "digest": "ab" * 32, "flight_code": None, "provenance": {}}
POLICY = {"version": "1", "sha256": "00", "confidence": 0.95, "power": 0.8}  # of an earlier version


UNKNOWN = ("pass_id", "margin", "p_value", "level", "resolution", "frames_needed", "reason")


def gate(name, outcome, **values):
    known = {
        "passed": outcome == "pass", "baseline": 0.9, "candidate": 0.7, "limit": 0.05, "unit": "",
        "change_bounds": (None, None), "frames": 10,
    }  # fmt: skip
    return JudgedGate(name=name, outcome=outcome, **dict.fromkeys(UNKNOWN) | known | values)


def regression(verdict, gates, **values):
    result = Verdict(
        verdict=verdict,
        baseline={"name": "old", **BUILD},
        candidate={"name": "new", **BUILD},
        policy=POLICY,
        headline=f"{verdict}: no loss",
        frames=10,
        frames_needed=None,
        gates=gates,
        passes=values.get("passes", []),
        remarks=["builds were isolated"],
    )
    return Regression(id="1", verdict=verdict, created=UtcTime(0), result=result)


def test_a_list_names_builds_and_a_gate_that_was_waived_does_not_count():
    summary = regression("pass", [gate("recall", "pass")]).summary()
    assert summary.candidate_title == "new 1.2 (abababababab)"
    assert summary.baseline_title == "old 1.2 (abababababab)"
    assert (summary.reasons, summary.headline) == ([], "pass: no loss")
    found = regression("pass", [gate("other", "fail", waived="known"), gate("recall", "pass", waived=None)])
    assert found.result.gates[0].text == "other: waived: known"
    assert found.summary().gates_failed == 0


def test_reasons_are_failed_gates_then_open_ones_then_passes_without_a_comparison():
    open_gate = gate("drift", "inconclusive", reason="too few frames")
    failed = gate("recall", "fail", pass_id="pass 1", unit="m")
    lost = {"name": "pass 2", "archive": "x", "state": "candidate failed", "detail": "exit status 4"}
    found = regression("fail", [open_gate, failed], passes=[lost])
    assert found.summary().reasons == [
        "recall on pass 1: 0.9 to 0.7 m",
        "drift: 0.9 to 0.7, too few frames",
        "pass 2: exit status 4",
    ]
    assert len(regression("fail", 9 * [failed]).summary().reasons) == REASONS_LIMIT


def test_a_gate_without_figures_states_its_reason_or_outcome():
    for candidate, figures in (None, ""), (0.7, " 0.9 to 0.7,"):
        one = gate("recall", "fail", candidate=candidate, limit=None, reason="no detections")
        assert one.text == f"recall:{figures} no detections"
