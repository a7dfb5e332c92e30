"""Removal of processes and files of builds between two runs of a runner."""

import os
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from ground_service.sandbox import launcher
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
