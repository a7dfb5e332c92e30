"""Processes of a deployment on private ports of this machine, each of which can be killed and started again."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ground_service.errors import GroundError

START_S = 120.0
STOP_S = 30.0
PORTS = range(15_000, 32_000)
"""Below the ports that the kernel gives to outgoing connections, which could take a port while its server is down."""


def free_port() -> int:
    """Return a port that is free now."""
    for port in random.SystemRandom().sample(PORTS, 200):
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
    raise GroundError(f"ports {PORTS.start} to {PORTS.stop - 1}: expected a free one, found none in 200 attempts")


def listens(port: int) -> bool:
    """Return whether a program of this machine listens on a port."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def answers_http(url: str) -> bool:
    """Return whether a GET request is answered with success."""
    try:
        with urllib.request.urlopen(url, timeout=5) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


class Part:
    """A process of the deployment that can be killed with all its children and started again.

    Parameters
    ----------
    ready
        Whether it works, asked from its start on.
    attempts
        Number of starts after which one that ends at once is given up; None: as many as `START_S` permits.
    """

    def __init__(
        self, command: list[str], log: Path, ready: Callable[[], bool], attempts: int | None = None, **options: Any
    ) -> None:
        self._command, self._log, self._ready, self._options = command, log, ready, options
        self._attempts = attempts
        self._process: subprocess.Popen[bytes] | None = None
        self._ended = False

    def start(self) -> None:
        """Start it, again when it gives up at once (what it was killed with may not be gone yet).

        Raises
        ------
        GroundError
            It is not ready within `START_S`.
        """
        until, left = time.monotonic() + START_S, self._attempts or sys.maxsize
        while time.monotonic() < until and not self._ended and left:
            left -= 1
            with self._log.open("ab") as log:
                self._process = subprocess.Popen(
                    self._command, stdout=log, stderr=log, start_new_session=True, **self._options
                )
            while time.monotonic() < until and self._process.poll() is None:
                if self._ready():
                    return
                time.sleep(0.02)
            time.sleep(0.5)
        if self._ended:
            return
        self.kill()
        tail = self._log.read_text(errors="replace")[-500:].strip().replace("\n", " | ")
        raise GroundError(f"{' '.join(self._command[:4])}: expected it to start within {START_S:.0f} s, found: {tail}")

    def __enter__(self) -> Part:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end(signal.SIGTERM)

    @property
    def has_ended(self) -> bool:
        """Return whether it was started and has ended by itself."""
        return not self._ended and self._process is not None and self._process.poll() is not None

    def revive(self) -> None:
        """Start it where it has ended by itself, as a supervisor would."""
        if self.has_ended:
            self.start()

    @property
    def pid(self) -> int:
        """Its process."""
        assert self._process is not None
        return self._process.pid

    def end(self, number: signal.Signals | None = None) -> None:
        """End it permanently, with a signal first if one is given: it is not started again."""
        self._ended = True
        if self._process is None:
            return
        if number is not None and self._process.poll() is None:
            with contextlib.suppress(OSError, IndexError):
                as_other = self._command[0] == "runuser"
                os.kill(descendants(self._process.pid)[0] if as_other else self._process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(STOP_S)
        self.kill()

    def finish(self, seconds: float = 120.0) -> None:
        """Ask it to end (SIGTERM), as a supervisor would, and wait until it has."""
        assert self._process is not None
        self._process.terminate()
        self._process.wait(seconds)

    def kill(self) -> None:
        """Kill it and all its children (SIGKILL), and wait for their end."""
        killed = self._process  # it may be started again meanwhile
        assert killed is not None
        if killed.poll() is not None:
            return  # its number may be somebody else's by now
        kill_family(killed.pid)
        killed.wait()


def kill_family(pid: int) -> None:
    """Kill a process and its descendants, and wait until they have ended."""
    family = [pid, *descendants(pid)]
    for one in family:
        with contextlib.suppress(ProcessLookupError):
            os.kill(one, signal.SIGKILL)
    until = time.monotonic() + 10.0
    while any(runs(one) for one in family) and time.monotonic() < until:
        time.sleep(0.01)


def runs(pid: int) -> bool:
    """Return whether a process exists and is not a zombie."""
    return (started_ticks(pid) or 0) > 0


def started_ticks(pid: int) -> int | None:
    """Return the start of a running process in clock ticks since boot; None if it does not run."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else int(fields[19])


def descendants(pid: int) -> list[int]:
    """Return the processes below another, by what the kernel says."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = entry.read_text().rpartition(")")[2].split()
            children.setdefault(int(fields[1]), []).append(int(entry.parent.name))
    found, waiting = [], list(children.get(pid, ()))
    while waiting:
        found.append(waiting.pop(0))
        waiting += children.get(found[-1], ())
    return found


def bare_environment(**settings: str) -> dict[str, str]:
    """Return the environment with these settings of the service and none that it had before."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("LINNA_") or name == "LINNA_DATA"}
    return {**kept, **settings}


def environment_with_data(environment: Mapping[str, str], root: Path | None) -> dict[str, str]:
    """Return an environment in which the data folder is `root`, and no other; None: no data."""
    kept = {name: value for name, value in environment.items() if name != "LINNA_DATA"}
    return kept if root is None else {**kept, "LINNA_DATA": str(root)}
