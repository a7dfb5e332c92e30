"""One run of a build over one archived pass: an external program with resource limits, and its outcome."""

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ground_service.errors import InvalidInput
from ground_service.regression.archives import write_flight_view
from ground_service.regression.builds import Build
from ground_service.regression.model import OK
from ground_service.regression.runner import DOWNLINKS, PERFORMANCE, RunRequest, run_confined
from ground_service.regression.sandbox import SandboxRefused, tail
from ground_service.toml import read_json

PERFORMANCE_LIMIT_OCTETS = 8 << 20
PRINTED_SHOWN = 2000
PRINTED_LINES, PRINTED_OCTETS = 40, 16_384
"""Last lines of a failed program that are kept, and their greatest length."""

PRINTED = "printed.txt"

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
_OUT_OF_MEMORY = ("MemoryError", "bad_alloc", "Cannot allocate memory", "std::length_error", "out of memory")
_OUT_OF_DISK = ("File too large", "No space left on device", "file size limit")


@dataclass(frozen=True, slots=True)
class BuildRun:
    """Outcome of a run.

    Attributes
    ----------
    outcome
        A key of `OUTCOMES`.
    detail
        Explanation of the outcome for users.
    isolation
        Sandbox in which the program ran; "" if it was not run.
    printed
        Last lines that the program printed; "" for a run that ended well.
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
    printed: str = ""

    def summary(self) -> dict[str, Any]:
        """The run as figures for a script, and as a line for a person."""
        figures = {key: value for key, value in asdict(self).items() if key not in ("downlink", "performance")}
        message = f"{self.build} {OUTCOMES[self.outcome]}" + (f": {self.detail}" if self.detail else "")
        return {
            **figures,
            "downlink": str(self.downlink) if self.downlink else None,
            "text": f"{message} ({self.cpu_s:.1f} s of CPU, {self.peak_rss_mib:.0f} MiB)",
        }


def run_build(
    build: Build, archive: Path, out: Path, *, runner: Path | None = None, private: Sequence[Path] = ()
) -> BuildRun:
    """Run a build over an archived pass and write its downlink into `out`.

    The program has access only to copies of the payload inputs and of its own files: no reference, truth, ground
    catalogue, network or other part of this machine. It is not run if it cannot be isolated.

    Parameters
    ----------
    runner
        Exchange folder of the runner that executes the run; None runs it in a local sandbox.
    private
        Folders that a build must not be able to read, such as the archive of the service.
    """
    if out.exists() and any(out.iterdir()):
        raise InvalidInput(str(out), "", "a new or empty folder", "something in it")
    work = out / ".run"
    work.mkdir(parents=True)
    try:
        write_flight_view(archive, work / "archive", noise=build.noise)
        build.stage(work / "build")
        written = work / "out"
        written.mkdir()
        request = RunRequest(build.words, build.limits.model_dump())
        try:
            report = run_confined(request, work, written, out / PRINTED, runner=runner, private=private)
        except SandboxRefused as error:
            return BuildRun(build.title, "refused", str(error), None, None, 0.0, 0.0, 0.0, "")
        return _judged(build, report, written, out)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _judged(build: Build, report: Mapping[str, Any], written: Path, out: Path) -> BuildRun:
    outcome, detail = _outcome(report, tail(out / PRINTED, PRINTED_SHOWN))
    downlink: Path | None = None
    performance = None
    for name in DOWNLINKS:
        found = written / name
        if found.is_file() and not found.is_symlink():
            downlink = out / name
            shutil.move(found, downlink)
            break
    measured = written / PERFORMANCE
    if measured.is_file() and not measured.is_symlink():
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
        "" if outcome == OK else "\n".join(tail(out / PRINTED, PRINTED_OCTETS).splitlines()[-PRINTED_LINES:]),
    )


def _outcome(report: Mapping[str, Any], printed: str) -> tuple[str, str]:
    cause, status = report["cause"], report["exit_status"]
    last = printed.strip().splitlines()[-1][:200] if printed.strip() else ""
    killed = status - 128 if status is not None and status > 128 else None
    if cause:
        return str(cause), ""
    if status != 0 and report.get("full"):
        return "disk", last
    if killed == 24:  # SIGXCPU
        return "cpu", ""
    if killed == 25 or (status != 0 and any(sign in printed for sign in _OUT_OF_DISK)):  # SIGXFSZ
        return "disk", last
    if status != 0 and any(sign in printed for sign in _OUT_OF_MEMORY):
        return "memory", last
    if status == 0:
        return OK, ""
    how = f"signal {killed}" if killed is not None else f"exit status {status}"
    return "crashed", f"{how}: {last}" if last else how


def read_performance(path: Path) -> dict[str, Any] | None:
    """Return the costs that a build reports of itself; None if they are not finite times of the contract's form."""
    try:
        with path.open("rb") as stream:
            given = read_json(stream.read(PERFORMANCE_LIMIT_OCTETS + 1), PERFORMANCE, PERFORMANCE_LIMIT_OCTETS)
        stages = {str(name): [float(value) for value in values] for name, values in given["stages"].items()}
        times = [one for values in stages.values() for one in values]
        return {"stages": stages} if all(0.0 <= one < math.inf for one in times) else None
    except (InvalidInput, OSError, ArithmeticError, ValueError, KeyError, TypeError, AttributeError):
        return None
