"""Removal of processes and files of builds between two runs of a runner."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ground_service.regression import runner
from ground_service.regression.sandbox import host, kernel, launcher
from ground_service.regression.sandbox.host import SandboxRefused
from ground_service.regression.sandbox.runner_checks import build_remains
from tests.serving import wait_for

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root can run processes as other users")

UID = launcher.FIRST_BUILD_UID + 7


@pytest.fixture
def shared(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o1777)
        monkeypatch.setattr(launcher, "WORLD_WRITABLE", (name,))
        yield folder


def test_a_refusal_has_a_reason_if_python_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    host.protection.cache_clear()
    monkeypatch.setattr(host, "execute", lambda run: {"exit_status": 1, "isolation": "namespaces"})
    assert host.protection().refusal == "Python does not run in the sandbox: no text, exit status 1"
    host.protection.cache_clear()


def test_builds_run_where_python_is_installed_below_tmp() -> None:
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        Path(name).chmod(0o755)
        venv.create(name)
        command = [f"{name}/bin/python", "-c", f"from {host.__name__} import *; print(protection().refusal)"]
        environment = {"PYTHONPATH": str(host.package_root())}
        said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert said.stdout.strip() == host.protection().refusal


def test_files_in_a_folder_without_permissions_are_removed(shared: Path) -> None:
    def leave() -> None:
        hidden = shared / "hidden" / "below"
        hidden.mkdir(parents=True)
        (hidden / "large").write_bytes(bytes(1000))
        (shared / "link").symlink_to("/etc")
        hidden.chmod(0)
        hidden.parent.chmod(0)

    launcher.as_user(UID, leave)
    (shared / "of the runner").touch()
    assert str(shared / "hidden") in build_remains()
    launcher.as_user(UID, lambda: launcher.remove_owned(UID))
    assert [one for one in build_remains() if one.startswith(str(shared))] == []
    assert [path.name for path in shared.iterdir()] == ["of the runner"]


def test_a_process_of_a_build_is_found_until_it_is_killed(shared: Path) -> None:
    with subprocess.Popen(["sleep", "60"], user=UID) as process:
        assert f"process {process.pid}" in build_remains()
        launcher.kill_user(UID)
    assert f"process {process.pid}" not in build_remains()


AS_RUNNER = (
    *("setpriv", "--bounding-set=-all,+setuid,+setgid,+kill", "--inh-caps=-all"),
    *(sys.executable, "-c"),
)


def said_by_runner(program: str, *words: int) -> Any:
    """Return what a program prints as JSON with the capabilities of a runner, which cannot inspect other users."""
    command = [*AS_RUNNER, program, *map(str, words)]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True, timeout=60)
    return json.loads(done.stdout)


def test_a_process_of_a_build_is_found_with_the_capabilities_of_a_runner() -> None:
    program = """
import json
from ground_service.regression.sandbox.runner_checks import build_remains
print(json.dumps(list(build_remains())))
"""
    with process_of_build(lambda: time.sleep(60)) as process:
        assert f"process {process}" in said_by_runner(program)


@contextlib.contextmanager
def process_of_build(program: Callable[[], None]) -> Iterator[int]:
    """Run a function in a process of the user of a build; yield its number."""
    process = os.fork()
    if process == 0:
        try:
            os.setresgid(UID, UID, UID)
            os.setresuid(UID, UID, UID)
            kernel.hide_memory(False)  # as after execution of a program
            program()
        finally:
            os._exit(1)
    try:
        yield process
    finally:
        launcher.kill_user(UID)
        os.waitpid(process, 0)
        wait_for(lambda: not processes_of(UID), "orphans reaped by process 1")


def share_memory() -> None:
    """Write 32 MiB, which eight processes then share."""
    held = b"x" * (32 << 20)
    for _ in range(3):
        os.fork()
    time.sleep(60)
    del held


def test_pages_that_processes_of_a_build_share_are_counted_once_by_a_runner() -> None:
    program = """
import json, sys
from ground_service.regression.sandbox import launcher
processes = list(map(int, sys.argv[2:]))
print(json.dumps([launcher.memory_of_user(int(sys.argv[1]), processes),
                  sum(map(launcher.resident_memory, processes))]))
"""
    with process_of_build(share_memory) as first:
        processes = [first]
        while len(processes) < 8:
            time.sleep(0.01)
            processes = [first, *launcher.descendants(first)]
        memory, resident = said_by_runner(program, UID, *processes)
    assert resident > 8 * (32 << 20)
    assert 32 << 20 < memory < resident / 3


def test_a_build_cannot_stop_the_process_that_ends_it() -> None:
    helper = os.fork()
    if helper == 0:
        try:
            launcher.act_as_user(UID)
            time.sleep(60)
        finally:
            os._exit(1)

    def stop() -> None:
        try:
            os.kill(helper, signal.SIGSTOP)
        except PermissionError:
            os._exit(7)

    try:
        while f"Uid:\t{UID + launcher.HELPER_OFFSET}\t{UID}\t" not in status_of(helper):
            time.sleep(0.01)
        with process_of_build(stop) as attacker:
            ended = os.waitid(os.P_PID, attacker, os.WEXITED | os.WNOWAIT)
        assert ended is not None and ended.si_status == 7
    finally:
        os.kill(helper, signal.SIGKILL)
        os.waitpid(helper, 0)


def status_of(process: int) -> str:
    return Path(f"/proc/{process}/status").read_text()


def processes_of(uid: int) -> list[str]:
    found = []
    for status in Path("/proc").glob("[0-9]*/status"):
        with contextlib.suppress(OSError):  # the process has ended
            if f"Uid:\t{uid}\t" in status.read_text(errors="replace"):
                found.append(status.parent.name)
    return found


def test_processes_of_another_pid_namespace_are_not_those_of_the_runner(shared: Path) -> None:
    command = [
        "unshare",
        "--pid",
        "--fork",
        "--kill-child",
        "setpriv",
        f"--reuid={UID}",
        "--clear-groups",
        "sleep",
        "60",
    ]
    with subprocess.Popen(command) as process:
        try:
            wait_for(lambda: processes_of(UID), "the process")
            found = processes_of(UID)
            assert not {f"process {number}" for number in found} & set(build_remains())
        finally:
            process.kill()


def test_a_runner_ends_if_a_build_left_something(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "jobs" / "one").mkdir(parents=True)
    monkeypatch.setattr(runner, "runner_mode", lambda exchange: "user")
    monkeypatch.setattr(runner, "_run_job", lambda exchange, job, *_: job.rmdir())
    monkeypatch.setattr(runner, "build_remains", lambda: iter(["process 7"]))
    with pytest.raises(SandboxRefused, match="found process 7"):
        runner.serve_exchange(tmp_path, jobs=1)
