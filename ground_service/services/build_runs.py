"""One run of a build over one archived pass: an external program inside limits, and what became of it."""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ground_service.errors import InvalidInput
from ground_service.services import _confine
from ground_service.services.builds import Build, package_root
from ground_service.services.regression_archives import write_flight_view

DOWNLINKS = ("downlink.cadu", "downlink.packets")
PERFORMANCE = "performance.json"
PERFORMANCE_LIMIT_OCTETS = 64 << 20
PRINTED_SHOWN = 2000
GRACE_S = 60

OK = "ok"
OUTCOMES = {
    OK: "ended well",
    "crashed": "crashed",
    "timeout": "hung: stopped at its time limit",
    "cpu": "stopped at its CPU time limit",
    "memory": "ran out of the memory it is allowed",
    "disk": "wrote more than it is allowed",
    "nothing": "ended without a downlink",
    "garbage": "wrote a downlink that is no telemetry",
    "refused": "was not run",
}
# A shell that waits: the first process of a namespace is spared most signals, which the program shall not be.
_WAITING_SHELL = ("sh", "-c", '"$@"; exit $?', "sh")
# Ways to shut a program off from the network, the strongest first; a process namespace also holds back all it starts.
_NAMESPACES = (
    (
        "network and process namespace",
        ("unshare", "--net", "--pid", "--fork", "--kill-child", "--", *_WAITING_SHELL),
    ),
    (
        "network, process and user namespace",
        (
            "unshare",
            "--user",
            "--map-root-user",
            "--net",
            "--pid",
            "--fork",
            "--kill-child",
            "--",
            *_WAITING_SHELL,
        ),
    ),
    ("network namespace", ("unshare", "--user", "--map-root-user", "--net", "--")),
)
NO_NAMESPACE = "environment without proxies only"
_OUT_OF_MEMORY = ("MemoryError", "bad_alloc", "Cannot allocate memory", "std::length_error", "out of memory")
_OUT_OF_DISK = ("File too large", "No space left on device", "file size limit")


@dataclass(frozen=True, slots=True)
class BuildRun:
    """What became of a run.

    Attributes
    ----------
    outcome
        A key of `OUTCOMES`.
    detail
        What to tell a person who asks why.
    isolation
        How the program was shut off from the network.
    """

    build: str
    outcome: str
    detail: str
    downlink: Path | None
    performance: Mapping[str, Any] | None
    wall_s: float
    cpu_s: float
    peak_rss_mib: float
    isolation: str

    def summary(self) -> dict[str, Any]:
        """The run as figures for a script, and as a line for a person."""
        figures = {
            key: value for key, value in asdict(self).items() if key not in ("downlink", "performance")
        }
        told = f"{self.build} {OUTCOMES[self.outcome]}" + (f": {self.detail}" if self.detail else "")
        return {
            **figures,
            "downlink": str(self.downlink) if self.downlink else None,
            "text": f"{told} ({self.cpu_s:.1f} s of CPU, {self.peak_rss_mib:.0f} MiB)",
        }


def run_build(build: Build, archive: Path, out: Path) -> BuildRun:
    """Run a build over an archived pass, its downlink written into `out`.

    The program sees a copy of what the payload was given, in a folder of its own: no reference, no truth, no catalogue
    of the ground, no network, no clock but what the operating system cannot hide.
    """
    if out.exists() and any(out.iterdir()):
        raise InvalidInput(str(out), "", "a new or empty folder", "something in it")
    work = out / ".run"
    work.mkdir(parents=True)
    try:
        write_flight_view(archive, work / "archive")
        written = work / "out"
        written.mkdir()
        report = _confined(build, work / "archive", written, out / "printed.txt")
        return _judged(build, report, written, out)
    finally:
        shutil.rmtree(work, ignore_errors=True)


@functools.cache
def network_prefix() -> tuple[str, tuple[str, ...]]:
    """How programs are shut off from the network here, and the command that does it."""
    for name, prefix in _NAMESPACES:
        try:
            tried = subprocess.run([*prefix, "true"], capture_output=True, timeout=10, check=False)
        except (OSError, subprocess.TimeoutExpired):
            continue
        if tried.returncode == 0:
            return name, prefix
    return NO_NAMESPACE, ()


def _confined(build: Build, archive: Path, written: Path, printed: Path) -> dict[str, Any]:
    isolation, prefix = network_prefix()
    limits = asdict(build.limits)
    job = {
        "command": build.arguments(archive.absolute(), written.absolute()),
        "cwd": str(written.absolute()),
        "environment": _environment(written),
        "limits": limits,
        "prefix": list(prefix),
        "output": str(printed.absolute()),
    }
    reading, writing = os.pipe()
    try:
        with subprocess.Popen(
            [sys.executable, "-I", "-S", str(Path(_confine.__file__)), str(writing)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(writing,),
            start_new_session=True,
        ) as keeper:
            os.close(writing)
            writing = -1
            try:
                keeper.communicate(json.dumps(job).encode(), timeout=limits["wall_s"] + GRACE_S)
            except (subprocess.TimeoutExpired, KeyboardInterrupt):
                keeper.kill()
                raise
        with os.fdopen(reading) as stream:
            reading = -1
            told = stream.read()
    finally:
        for descriptor in (reading, writing):
            if descriptor >= 0:
                os.close(descriptor)
    report: dict[str, Any] = (
        json.loads(told) if told else {"cause": "crashed", "exit_status": None, "signal": None}
    )
    return {"wall_s": 0.0, "cpu_s": 0.0, "peak_rss_mib": 0.0, **report, "isolation": isolation}


def _environment(written: Path) -> dict[str, str]:
    """Everything that a program is told of the world: no data folder, no proxies, one thread."""
    return {
        "PATH": os.environ.get("PATH", "/usr/local/bin:/usr/bin:/bin"),
        "PYTHONPATH": str(package_root()),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONHASHSEED": "0",
        "HOME": str(written.absolute()),
        "TMPDIR": str(written.absolute()),
        "XDG_DATA_HOME": str(written.absolute()),
        "LANG": "C.UTF-8",
        "TZ": "UTC",
        "OMP_NUM_THREADS": "1",
        "OMP_WAIT_POLICY": "PASSIVE",
        "OPENBLAS_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
    }


def _judged(build: Build, report: Mapping[str, Any], written: Path, out: Path) -> BuildRun:
    printed = _tail(out / "printed.txt")
    outcome, detail = _outcome(report, printed)
    downlink: Path | None = None
    performance = None
    for name in DOWNLINKS:
        found = written / name
        if found.is_file() and not found.is_symlink():
            downlink = out / name
            shutil.move(found, downlink)
            break
    measured = written / PERFORMANCE
    if (
        measured.is_file()
        and not measured.is_symlink()
        and measured.stat().st_size <= PERFORMANCE_LIMIT_OCTETS
    ):
        shutil.move(measured, out / PERFORMANCE)
        performance = read_performance(out / PERFORMANCE)
    if outcome == OK and downlink is None:
        outcome, detail = "nothing", f"expected {' or '.join(DOWNLINKS)} in its output folder"
    return BuildRun(
        build.title,
        outcome,
        detail,
        downlink if outcome == OK else None,
        performance,
        float(report["wall_s"]),
        float(report["cpu_s"]),
        float(report["peak_rss_mib"]),
        str(report["isolation"]),
    )


def _outcome(report: Mapping[str, Any], printed: str) -> tuple[str, str]:
    cause, status, killed = report["cause"], report["exit_status"], report["signal"]
    last = printed.strip().splitlines()[-1][:200] if printed.strip() else ""
    if killed is None and status is not None and status > 128:
        killed = status - 128
    if cause:
        return str(cause), ""
    if killed == 24:  # SIGXCPU
        return "cpu", ""
    if killed == 25 or (status != 0 and any(sign in printed for sign in _OUT_OF_DISK)):  # SIGXFSZ
        return "disk", last
    if status != 0 and any(sign in printed for sign in _OUT_OF_MEMORY):
        return "memory", last
    if status == 0 and killed is None:
        return OK, ""
    how = f"signal {killed}" if killed is not None else f"exit status {status}"
    return "crashed", f"{how}: {last}" if last else how


def read_performance(path: Path) -> dict[str, Any] | None:
    """The costs that a build reports of itself, None where they are not in the form of the contract."""
    try:
        given = json.loads(path.read_text())
        stages = {str(name): [float(value) for value in values] for name, values in given["stages"].items()}
        return {"stages": stages, "yardstick": [float(value) for value in given.get("yardstick", [])]}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _tail(path: Path) -> str:
    try:
        return path.read_text(errors="replace")[-PRINTED_SHOWN:]
    except OSError:
        return ""
