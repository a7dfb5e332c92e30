"""Execution of builds in a local sandbox, or in a runner that shares only an exchange folder with the service.

The exchange folder holds `jobs`, `running` and `results`. A job is a folder with `request.json`, `archive` and `build`,
and appears under its final name only when it is complete. The runner moves it to `running`, copies it, runs it, and
publishes a folder of the same name in `results` with `report.json`, `printed.txt` and the outputs. `runner.json` is
touched every few seconds while the runner lives. docs/build-contract.md describes the files.

The service does not trust the results: it accepts only requested names, regular files with a single link, within the
limits, opened without following symbolic links, and it validates every field of the report.
"""

import contextlib
import fcntl
import json
import logging
import os
import shutil
import stat
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass

from ground_service.regression import sandbox as host
from ground_service.regression.sandbox import Run, SandboxRefused
from kernels import cache_folder

DOWNLINKS = ("downlink.cadu", "downlink.packets")
PERFORMANCE = "performance.json"
OUTPUTS = (*DOWNLINKS, PERFORMANCE)

PROTOCOL_VERSION = 3
REQUEST, REPORT, PRINTED, ALIVE = "request.json", "report.json", "printed.txt", "runner.json"
REPORT_LIMIT_OCTETS = 1 << 16
PRINTED_LIMIT_OCTETS = 1 << 17
POLL_S = 0.1
HEARTBEAT_S = 2.0
GRACE_S = 180.0
"""Time after the time limit of a run within which the runner must publish its result."""

SILENT_S = 30.0
"""Age of `runner.json` from which the runner counts as stopped."""

_log = logging.getLogger(__name__)
Seconds = Annotated[float, Field(ge=0.0, le=1e7, allow_inf_nan=False)]


@dataclass(frozen=True, slots=True)
class RunRequest:
    """Request of a run: words with the placeholders {python}, {archive}, {out} and {folder}, limits, and outputs.

    A renderer reads the public data products; a build does not.
    """

    words: tuple[str, ...]
    limits: Mapping[str, int]
    outputs: tuple[Annotated[str, Field(pattern=r"^[a-z]+\.[a-z]+$")], ...] = OUTPUTS
    reads_data: bool = False
    version: int = PROTOCOL_VERSION


class RunReport(BaseModel):
    """Result of a run."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    cause: Literal["", "timeout", "cpu", "memory", "disk", "crashed"] = ""
    exit_status: Annotated[int, Field(ge=0, le=255)] | None = None
    full: bool = False
    wall_s: Seconds = 0.0
    cpu_s: Seconds = 0.0
    peak_rss_mib: Annotated[float, Field(ge=0.0, le=1e9, allow_inf_nan=False)] = 0.0
    isolation: Annotated[str, Field(max_length=200, pattern=r"^[\w ,./-]*$")] = ""
    refused: Annotated[str, Field(max_length=2000)] = ""


def run_confined(
    request: RunRequest,
    staged: Path,
    written: Path,
    printed: Path,
    *,
    runner: Path | None,
    private: Sequence[Path],
    data: Path | None = None,
) -> dict[str, Any]:
    """Run a program in a runner or in a local sandbox; return the report.

    Parameters
    ----------
    staged
        Folder with `archive` and `build`, copies that belong to this run.
    written, printed
        Destinations of the outputs and of the end of the program's printed text.
    runner
        Exchange folder of the runner that executes the run; None runs it in a local sandbox.
    private
        Folders that the program must not be able to read, such as the archive of the service.
    data
        Folder of the public data products, for a request that reads them.

    Raises
    ------
    SandboxRefused
        The program cannot be isolated.
    """
    if runner is not None:
        return _run_by_runner(runner, request, staged, written, printed)
    host.check_private(private, [data] if data else ())
    return _run_in_sandbox(request, staged, written, printed, data)


def _run_in_sandbox(
    request: RunRequest, staged: Path, written: Path, printed: Path, data: Path | None
) -> dict[str, Any]:
    host.make_readable(staged / "archive")
    host.make_readable(staged / "build")
    host.protection()
    folders = {"archive": staged / "archive", "build": staged / "build", "kernels": cache_folder()}
    variables = {**ENVIRONMENT, "NUMBA_CACHE_DIR": "/kernels"}
    if request.reads_data and data is not None:
        folders["data"], variables["LINNA_DATA"] = data, "/data"
    places = {"{python}": sys.executable, "{archive}": "/archive", "{out}": host.OUT, "{folder}": "/build"}
    run = Run(
        tuple(_placed(word, places) for word in request.words),
        variables,
        request.limits,
        request.outputs,
        written.absolute(),
        printed.absolute(),
        (
            *host.program_view(),
            *(host.Part("bind", str(path.absolute()), f"/{name}") for name, path in folders.items() if path.is_dir()),
        ),
    )
    return host.execute(run)


def _run_by_runner(exchange: Path, request: RunRequest, staged: Path, written: Path, printed: Path) -> dict[str, Any]:
    identity = uuid.uuid4().hex
    try:
        for name in ("jobs", "running", "results"):
            _make_shared(exchange / name)
        job = exchange / "jobs" / identity
        partial = job.with_name("." + identity)
        _make_shared(partial)
        try:
            for name in ("archive", "build"):
                shutil.copytree(staged / name, partial / name)
            (partial / REQUEST).write_text(json.dumps(asdict(request)))
            _share(partial)
            partial.rename(job)
            result = _awaited(exchange, identity, request.limits["wall_s"] + GRACE_S)
            return _taken(result, request, written, printed)
        finally:
            for place in (partial, job, exchange / "results" / identity):
                shutil.rmtree(place, ignore_errors=True)
    except OSError as error:
        raise SandboxRefused(f"runner exchange {exchange}: {error.strerror}") from None


ENVIRONMENT = {
    "PATH": ":".join([os.path.dirname(sys.executable), "/usr/local/bin", "/usr/bin", "/bin"]),
    "PYTHONPATH": str(host.package_root()),
    "PYTHONDONTWRITEBYTECODE": "1",
    "PYTHONHASHSEED": "0",
    "HOME": host.HOME,
    "TMPDIR": host.WRITABLE,
    "XDG_DATA_HOME": host.HOME,
    "LANG": "C.UTF-8",
    "TZ": "UTC",
    "OMP_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "PASSIVE",
    "OPENBLAS_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}
"""Environment variables of a program: no proxies, one thread."""


# The runner


def serve_exchange(
    exchange: Path, *, jobs: int | None = None, stopping: threading.Event | None = None, data: Path | None = None
) -> int:
    """Run the jobs of an exchange folder one by one, until `jobs` of them are done or `stopping` is set.

    `data` is the folder of the public data products for renderers.

    Returns
    -------
    int
        Number of completed jobs.

    Raises
    ------
    SandboxRefused
        Builds cannot be isolated here, or another runner serves the folder.
    """
    host.protection()
    stopping = stopping or threading.Event()
    for name in ("jobs", "running", "results"):
        _make_shared(exchange / name)
    done = 0
    with _alone(exchange), _heartbeat(exchange):
        for left in sorted((exchange / "running").iterdir()):
            # The runner ended during this job.
            _publish(exchange, left.name, {"cause": "crashed"}, None, ())
        while not stopping.is_set() and (jobs is None or done < jobs):
            job = _next_job(exchange)
            if job is None:
                stopping.wait(POLL_S)
                continue
            _run_job(exchange, job, data)
            done += 1
    return done


def _next_job(exchange: Path) -> Path | None:
    """Take over the oldest job and return its folder; None without one."""
    waiting = [path for path in (exchange / "jobs").iterdir() if not path.name.startswith(".")]
    for path in sorted(waiting, key=lambda path: path.stat().st_mtime_ns):
        with contextlib.suppress(OSError):
            return path.rename(exchange / "running" / path.name)
    return None


def _run_job(exchange: Path, job: Path, data: Path | None) -> None:
    with tempfile.TemporaryDirectory(prefix="runner-") as name:
        folder = Path(name)
        out = folder / "out"
        out.mkdir(mode=0o700)
        report: dict[str, Any]
        outputs: tuple[str, ...] = ()
        try:
            request = RunRequest(**json.loads((job / REQUEST).read_text()))
            if request.version != PROTOCOL_VERSION:
                raise SandboxRefused(f"request: expected version {PROTOCOL_VERSION}, found {request.version}")
            for part in ("archive", "build"):
                shutil.copytree(job / part, folder / part)
            outputs = request.outputs
            report = _run_in_sandbox(request, folder, out, out / PRINTED, data)
        except SandboxRefused as error:
            report = {"refused": str(error)}
        except (OSError, ValueError, TypeError, KeyError) as error:
            report = {"refused": f"request: {type(error).__name__}: {error}"[:500]}
        _publish(exchange, job.name, report, out, outputs)


def _publish(
    exchange: Path, identity: str, report: Mapping[str, Any], out: Path | None, outputs: Sequence[str]
) -> None:
    partial = exchange / "results" / f".{identity}"
    shutil.rmtree(partial, ignore_errors=True)
    _make_shared(partial)
    for name in (*outputs, PRINTED):
        if out is not None and (out / name).is_file():
            shutil.copyfile(out / name, partial / name)
    (partial / REPORT).write_text(json.dumps(report))
    _share(partial)
    partial.rename(exchange / "results" / identity)
    shutil.rmtree(exchange / "running" / identity, ignore_errors=True)


@contextlib.contextmanager
def _alone(exchange: Path) -> Iterator[None]:
    with (exchange / "runner.lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise SandboxRefused(f"{exchange}: expected no other runner, found one") from None
        yield


@contextlib.contextmanager
def _heartbeat(exchange: Path) -> Iterator[None]:
    ended = threading.Event()
    alive = exchange / ALIVE
    alive.write_text(json.dumps({"version": PROTOCOL_VERSION}))

    def beat() -> None:
        while not ended.wait(HEARTBEAT_S):
            with contextlib.suppress(OSError):
                os.utime(alive)

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        alive.unlink(missing_ok=True)


# The service


def _awaited(exchange: Path, identity: str, run_s: float) -> Path:
    """Wait for a result while the runner is alive, and return its folder."""
    result, running = exchange / "results" / identity, exchange / "running" / identity
    started: float | None = None
    quiet_since = time.monotonic()
    while not result.exists():
        now = time.monotonic()
        if alive(exchange):
            quiet_since = now
        elif now - quiet_since > SILENT_S or not (
            started or os.path.lexists(exchange / ALIVE) or any((exchange / "running").iterdir())
        ):
            raise SandboxRefused(f"runner exchange {exchange}: expected a runner, found none that responds")
        if started is None and running.exists():
            started = now
        if started is not None and now - started > run_s:
            raise SandboxRefused(f"runner exchange {exchange}: the runner did not respond in time")
        time.sleep(POLL_S)
    return result


def alive(exchange: Path) -> bool:
    """Return whether a runner serves the folder now."""
    try:
        return time.time() - os.lstat(exchange / ALIVE).st_mtime < SILENT_S
    except OSError:
        return False


def _taken(result: Path, request: RunRequest, written: Path, printed: Path) -> dict[str, Any]:
    """Copy the result of a runner out of the exchange folder and validate it."""
    folder = os.open(result, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        octets = _octets(folder, REPORT, REPORT_LIMIT_OCTETS)
        if octets is None:
            raise SandboxRefused("runner: expected a report, found none")
        try:
            report = RunReport.model_validate_json(octets)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise SandboxRefused(f"runner: {REPORT}: {where}: {first['msg'].lower()}") from None
        if report.refused:
            raise SandboxRefused("runner: " + " ".join(report.refused.split()), remedy="")
        limit = request.limits["file_mib"] << 20
        for name in request.outputs:
            octets = _octets(folder, name, limit)
            if octets is not None:
                (written / name).write_bytes(octets)
        printed.write_bytes(_octets(folder, PRINTED, PRINTED_LIMIT_OCTETS) or b"")
    finally:
        os.close(folder)
    return {**report.model_dump(exclude={"refused"}), "isolation": f"runner, {report.isolation}"}


def _octets(folder: int, name: str, limit: int) -> bytes | None:
    """Return the content of a regular file with a single link and a permitted size; None if there is no file."""
    try:
        descriptor = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=folder)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SandboxRefused(f"runner: {name}: expected a regular file, found {error.strerror}") from None
    with os.fdopen(descriptor, "rb") as stream:
        state = os.fstat(descriptor)
        if not stat.S_ISREG(state.st_mode) or state.st_nlink != 1:
            raise SandboxRefused(f"runner: {name}: expected a regular file with a single link, found another")
        octets = stream.read(limit + 1)
    if len(octets) > limit:
        raise SandboxRefused(f"runner: {name}: expected at most {limit} octets, found more")
    return octets


def _make_shared(folder: Path) -> None:
    """Create a folder that service and runner, which share a group, may change, and that others cannot read."""
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(PermissionError):  # created by the other side
        folder.chmod(0o2770)


def _share(folder: Path) -> None:
    for where, _, names in os.walk(folder):
        os.chmod(where, 0o2770)
        for name in names:
            path = os.path.join(where, name)
            os.chmod(path, 0o770 if os.stat(path).st_mode & stat.S_IXUSR else 0o660)


def _placed(word: str, places: Mapping[str, str]) -> str:
    for place, value in places.items():
        word = word.replace(place, value)
    return word
