"""Removal of processes and files of builds between two runs of a runner."""

import contextlib
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from ground_service.regression import runner
from ground_service.sandbox import launcher
from ground_service.sandbox.host import SandboxRefused
from ground_service.sandbox.runner_checks import build_remains

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root can run processes as other users")

UID = launcher.FIRST_BUILD_UID + 7


@pytest.fixture
def shared(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o1777)
        monkeypatch.setattr(launcher, "WORLD_WRITABLE", (name,))
        yield folder


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
            deadline = time.monotonic() + 20.0
            found: list[str] = []
            while not found and time.monotonic() < deadline:
                found = processes_of(UID)
            assert found
            assert not {f"process {number}" for number in found} & set(build_remains())
        finally:
            process.kill()


def test_a_runner_ends_if_a_build_left_something(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "jobs" / "one").mkdir(parents=True)
    monkeypatch.setattr(runner, "runner_mode", lambda exchange: "user")
    monkeypatch.setattr(runner, "_run_job", lambda exchange, job, mode: job.rmdir())
    monkeypatch.setattr(runner, "build_remains", lambda: iter(["process 7"]))
    with pytest.raises(SandboxRefused, match="found process 7"):
        runner.serve_exchange(tmp_path, jobs=1)
