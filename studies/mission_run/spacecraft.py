"""The spacecraft of a mission run: `linna emulate --live --no-operator` as a process, and its console."""

import contextlib
import json
import os
import signal
import socket
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from payload_emulator.errors import LinkError
from studies.harness.parts import Part, environment_with_data, free_port

ANSWER_S = 600.0
"""Longest wait for the spacecraft: the time to the next contact with windows in between, at maximum speed."""


START_ATTEMPTS = 3

ALLOCATOR = {"MALLOC_ARENA_MAX": "2", "MALLOC_MMAP_THRESHOLD_": str(4 << 20)}
"""Settings of the C library: large arrays go back to the system when they are dropped, so that memory stays flat."""


@dataclass(frozen=True, slots=True)
class SpacecraftFiles:
    """Files of a spacecraft under the folder of a run."""

    scenario: Path
    clock: Path
    craters: Path
    log: Path
    state: Path
    journal: Path


class SpacecraftProcess:
    """The emulated spacecraft and its stations in a process; `messages` of its console in order."""

    def __init__(
        self,
        files: SpacecraftFiles,
        stations: tuple[str, ...],
        days: float,
        rate: float,
        data: Path | None,
        *,
        holds: bool = True,
    ) -> None:
        self._log, self._console_port, self._mission_port = files.log, free_port(), free_port()
        words = ["emulate", files.scenario, "--live", "--no-operator", "--days", days, "--rate", rate]
        words += ["--keep-unacknowledged", "--paused", "--end-with-console", "--json"]
        words += ["--hold-contacts"] * holds
        words += ["--console-port", self._console_port, "--mission-port", self._mission_port]
        words += ["--state", files.state, "--journal", files.journal]
        words += ["--clock-file", files.clock, "--craters", files.craters]
        for name in stations:
            words += ["--station-port", f"{name}:{free_port()}:{free_port()}"]
        command = [sys.executable, "-m", "linna", *map(str, words)]
        # The console is connected at once, because its end is the end of the spacecraft.
        self._part = Part(
            command,
            files.log,
            self._is_connected,
            START_ATTEMPTS,
            env={**environment_with_data(os.environ, data), **ALLOCATOR},
        )
        self._console: socket.socket | None = None
        self.restart()

    def restart(self) -> None:
        """Start the process, after its end from its last exact state."""
        self._disconnect()
        self._part.start()
        assert self._console is not None
        self._lines = self._console.makefile("r")

    def _is_connected(self) -> bool:
        with contextlib.suppress(OSError):
            self._console = socket.create_connection(("127.0.0.1", self._console_port), timeout=ANSWER_S)
        return self._console is not None

    def messages(self) -> Iterator[dict[str, Any]]:
        """Return what the console says, until the spacecraft ends."""
        try:
            for line in self._lines:
                yield json.loads(line)
        except (OSError, ValueError) as error:
            raise LinkError(f"spacecraft: expected its console, found {error}; see {self._log}") from None

    def order(self, word: str) -> None:
        """Send a word to the console."""
        assert self._console is not None
        try:
            self._console.sendall(word.encode() + b"\n")
        except OSError as error:
            raise LinkError(f"spacecraft: expected its console, found {error}; see {self._log}") from None

    def mission_text(self) -> bytes:
        """Return the mission description that the spacecraft's operator hands over."""
        with socket.create_connection(("127.0.0.1", self._mission_port), timeout=ANSWER_S) as connection:
            return connection.makefile("rb").read()

    def stop(self) -> None:
        """Stop the spacecraft with its state kept."""
        with contextlib.suppress(LinkError):
            self.order("quit")
        self._part.end(signal.SIGTERM)
        self._disconnect()

    def _disconnect(self) -> None:
        """Close the console; its socket stays open as long as its reader is."""
        if self._console is not None:
            self._lines.close()
            self._console.close()
        self._console = None
