"""The spacecraft of a mission run: `linna emulate --live --no-operator` as a process, and its console."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from payload_emulator.errors import LinkError
from studies.mission_run.parts import free_port, kill_family

START_S = 180.0
STOP_S = 60.0
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


class SpacecraftKilled(LinkError):
    """The process of the spacecraft was killed; it can be started again from its last exact state."""


class SpacecraftProcess:
    """The emulated spacecraft and its stations in a process; `messages` of its console in order."""

    def __init__(self, files: SpacecraftFiles, stations: tuple[str, ...], days: float, rate: float) -> None:
        self._files, self._stations, self._days, self._rate = files, stations, days, rate
        self._log = files.log
        self._station_ports = [free_port() for _ in range(2 * len(stations))]
        self._launch(keeps_ports=False)

    def restart(self) -> None:
        """Start the process after its end, from its last exact state and with the same ports of its stations."""
        self._disconnect()
        self._launch(keeps_ports=True)

    def _launch(self, *, keeps_ports: bool) -> None:
        for attempts_left in reversed(range(START_ATTEMPTS)):
            try:
                self._start()
                break
            except LinkError as error:
                # Another process can take a port between its choice and its use.
                if attempts_left == 0 or "Address already in use" not in str(error):
                    raise
                if not keeps_ports:
                    self._station_ports = [free_port() for _ in self._station_ports]
        self._lines = self._console.makefile("r")

    def _start(self) -> None:
        files, station_ports = self._files, self._station_ports
        console, mission = free_port(), free_port()
        self.mission_port = mission
        words = [
            "emulate",
            files.scenario,
            "--live",
            "--no-operator",
            "--days",
            self._days,
            "--rate",
            self._rate,
        ]
        words += ["--hold-contacts", "--journal", files.journal]
        words += ["--console-port", console, "--mission-port", mission, "--state", files.state]
        words += ["--clock-file", files.clock, "--craters", files.craters]
        words += ["--keep-unacknowledged", "--paused", "--end-with-console"]
        words += ["--json"]
        for k, name in enumerate(self._stations):
            words += ["--station-port", f"{name}:{station_ports[2 * k]}:{station_ports[2 * k + 1]}"]
        command = [sys.executable, "-m", "linna", *map(str, words)]
        with files.log.open("ab") as log:
            # A group of its own: Ctrl-C reaches the runner, which stops the spacecraft in order.
            self.was_killed = False
            self.process = subprocess.Popen(
                command, stdout=log, stderr=log, start_new_session=True, env={**os.environ, **ALLOCATOR}
            )
        self._console = self._connected(console)

    def messages(self) -> Iterator[dict[str, Any]]:
        """Return what the console says, until the spacecraft ends."""
        try:
            for line in self._lines:
                yield json.loads(line)
        except (OSError, ValueError) as error:
            self.check_killed()
            raise LinkError(f"spacecraft: expected its console, found {error}; see {self._log}") from None
        self.check_killed()

    def order(self, word: str) -> None:
        """Send a word to the console."""
        try:
            self._console.sendall(word.encode() + b"\n")
        except OSError as error:
            self.check_killed()
            raise LinkError(f"spacecraft: expected its console, found {error}; see {self._log}") from None

    def kill(self) -> None:
        """Kill the process (SIGKILL)."""
        self.was_killed = True
        kill_family(self.process.pid)

    def check_killed(self) -> None:
        """Raise `SpacecraftKilled` if `kill` was called since the last start."""
        if self.was_killed:
            self.process.wait(STOP_S)
            raise SpacecraftKilled("spacecraft: its process was killed")

    def mission_text(self) -> bytes:
        """Return the mission description that the spacecraft's operator hands over."""
        octets = b""
        with self._connected(self.mission_port) as connection:  # opened after the console
            while block := connection.recv(65_536):
                octets += block
        return octets

    def stop(self) -> None:
        """Stop the spacecraft with its state kept."""
        if self.process.poll() is None:
            with contextlib.suppress(OSError):
                self.order("quit")
            try:
                self.process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._disconnect()

    def _disconnect(self) -> None:
        """Close the console; its socket stays open as long as its reader is."""
        self._lines.close()
        self._console.close()

    def _connected(self, port: int) -> socket.socket:
        until = time.monotonic() + START_S
        while True:
            try:
                return socket.create_connection(("127.0.0.1", port), timeout=ANSWER_S)
            except OSError:
                if self.process.poll() is not None or time.monotonic() > until:
                    self.process.kill()
                    tail = self._log.read_text(errors="replace")[-400:].strip().replace("\n", " | ")
                    raise LinkError(f"spacecraft: expected it to start, found: {tail}") from None
                time.sleep(0.1)
