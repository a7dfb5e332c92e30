"""Interface of the service to the sandbox: file system view of a build, and launcher."""

from __future__ import annotations

import functools
import json
import os
import stat
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

GRACE_S = 180.0
"""Time after the time limit of a run within which its launcher must end."""

PACKAGES = ("kernels", "lunar", "tmtc", "reports", "payload_emulator", "ground_service", "linna")
"""Packages that the flight code of this project needs; scenarios, migrations and tests are not visible."""

_SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib64", "/lib32")
_SYSTEM_FILES = ("/etc/ld.so.cache", "/etc/alternatives", "/sys/devices/system/cpu")
_LAUNCH = (
    "import sys; sys.path.insert(0, sys.argv.pop(1)); "
    "from ground_service.regression.sandbox.launcher import main; main()"
)
REMEDY = (
    "permit user namespaces for this process, or run builds in the runner: "
    "set LINNA_RUNNER_EXCHANGE and start `linna runner` (docs/build-contract.md)"
)


class SandboxRefused(Exception):
    """A run that was not started because it could not be isolated."""

    def __init__(self, reason: str, remedy: str = REMEDY) -> None:
        super().__init__(f"{reason}; remedy: {remedy}" if remedy else reason)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class Part:
    """Part of the file system of a run: a read-only `bind` of a path, a `link`, or a file with a `text`."""

    kind: Literal["bind", "link", "text"]
    source: str
    target: str


@dataclass(frozen=True, slots=True)
class Run:
    """Description of a run, as read by the launcher.

    Attributes
    ----------
    mode
        `namespaces`, or `user` in a container that is used only as a runner.
    limits
        As in the build file; see `ground_service.regression.builds.Limits`.
    outputs
        Names of the files that are copied from the output folder.
    deliver, printed
        Folder of the caller for the outputs, and file for the end of the program's printed text.
    """

    mode: Literal["namespaces", "user"]
    command: tuple[str, ...]
    cwd: str
    environment: Mapping[str, str]
    limits: Mapping[str, int]
    outputs: tuple[str, ...]
    deliver: str
    printed: str
    view: tuple[Part, ...] = field(default=())


@dataclass(frozen=True, slots=True)
class Protection:
    """Isolation of builds on this machine.

    Attributes
    ----------
    isolation
        The parts of the sandbox in force; "" if it is refused.
    refusal
        Why runs are refused; "" if they are not. The remedy is `REMEDY`.
    """

    isolation: str
    refusal: str


def execute(run: Run) -> dict[str, Any]:
    """Run a program in the sandbox; return the report of the launcher.

    Raises
    ------
    SandboxRefused
        The program was not run because a protection could not be enabled.
    """
    reading, writing = os.pipe()
    try:
        with subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _LAUNCH, str(package_root()), str(writing)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env={},
            pass_fds=(writing,),
            start_new_session=True,
        ) as launcher:
            os.close(writing)
            writing = -1
            try:
                job = json.dumps({**asdict(run), "environment": dict(run.environment)}).encode()
                _, failure = launcher.communicate(job, timeout=run.limits["wall_s"] + GRACE_S)
            except subprocess.TimeoutExpired as error:
                launcher.kill()
                raise SandboxRefused(f"the launcher did not end within {error.timeout:.0f} s") from None
            except BaseException:
                launcher.kill()
                raise
        with os.fdopen(reading) as stream:
            reading = -1
            written = stream.read()
    finally:
        for descriptor in (reading, writing):
            if descriptor >= 0:
                os.close(descriptor)
    if not written:
        lines = failure.decode(errors="replace").strip().splitlines() or ["no report"]
        raise SandboxRefused(f"the launcher failed: {lines[-1][:200]}")
    report: dict[str, Any] = json.loads(written)
    if "refused" in report:
        raise SandboxRefused(str(report["refused"]))
    if report.get("unconfined"):
        said = tail(Path(run.printed)).strip().splitlines() or [f"{run.command[0]} could not be started"]
        raise SandboxRefused(said[-1][:200])
    return report


def program_view() -> tuple[Part, ...]:
    """Return the parts of this machine that a program needs: system libraries, Python, the packages of this project."""
    parts: list[Part] = []
    for name in _SYSTEM:
        path = Path(name)
        if path.is_symlink():
            parts.append(Part("link", os.readlink(path), name))
        elif path.is_dir():
            parts.append(Part("bind", os.path.realpath(path), name))
    parts += [Part("bind", os.path.realpath(name), name) for name in _SYSTEM_FILES if Path(name).exists()]
    parts.append(Part("text", "build:x:{uid}:{uid}::/home/build:/bin/sh\n", "/etc/passwd"))
    parts.append(Part("text", "build:x:{uid}:\n", "/etc/group"))
    for folder in [*_python_folders(), *(package_root() / name for name in PACKAGES)]:
        for target in dict.fromkeys((str(folder), os.path.realpath(folder))):
            if os.path.isdir(target) and not _covered(target, parts):
                parts.append(Part("bind", os.path.realpath(target), target))
    return tuple(parts)


def check_private(folders: Sequence[Path], shown: Sequence[Path] = ()) -> None:
    """Refuse a layout in which a folder of the service is inside a folder that a program can read, such as `shown`.

    Raises
    ------
    SandboxRefused
        If there is such a folder.
    """
    parts = [*program_view(), *(Part("bind", "", os.path.realpath(one)) for one in shown)]
    for folder in folders:
        if _covered(os.path.realpath(folder), parts):
            raise SandboxRefused(
                f"{folder}: expected a folder outside those of Python, of the system and of data, which are readable"
            )


def package_root() -> Path:
    """Return the folder of the packages of this checkout or installation."""
    return Path(__file__).resolve().parents[3]


def tail(path: Path, octets: int = 2000) -> str:
    """Return the end of a text file; "" if there is none."""
    try:
        return path.read_text(errors="replace")[-octets:]
    except OSError:
        return ""


def make_readable(folder: Path) -> None:
    """Let every user read a folder of copies; the parent folder restricts who can reach it."""
    for where, _, names in os.walk(folder):
        Path(where).chmod(0o755)
        for name in names:
            path = Path(where) / name
            path.chmod(0o755 if path.stat().st_mode & stat.S_IXUSR else 0o644)


@functools.cache
def protection() -> Protection:
    """Return how builds are isolated here: every step of the launcher refuses a run that it cannot protect."""
    limits = {
        "wall_s": 30,
        "cpu_s": 20,
        "memory_mib": 512,
        "file_mib": 1,
        "folder_mib": 8,
        "open_files": 64,
        "processes": 16,
    }
    with tempfile.TemporaryDirectory(prefix="sandbox-") as folder:
        printed = Path(folder) / "printed.txt"
        command = (sys.executable, "-I", "-S", "-c", "print('ready')")
        run = Run("namespaces", command, "/out", {}, limits, (), folder, str(printed), program_view())
        try:
            report = execute(run)
        except SandboxRefused as error:
            return Protection("", error.reason)
        if report.get("exit_status") != 0 or tail(printed).strip() != "ready":
            said = tail(printed)[-200:].strip() or f"no text, exit status {report.get('exit_status')}"
            return Protection("", f"Python does not run in the sandbox: {said}")
    return Protection(str(report["isolation"]), "")


def _python_folders() -> list[Path]:
    names = ("stdlib", "platstdlib", "purelib", "platlib")
    found = [sys.base_prefix, sys.prefix, *(sysconfig.get_path(name) for name in names)]
    return [Path(name) for name in dict.fromkeys(found) if Path(name) != Path("/")]


def _covered(path: str, parts: Sequence[Part]) -> bool:
    return any(part.kind == "bind" and (path + "/").startswith(part.target + "/") for part in parts)
