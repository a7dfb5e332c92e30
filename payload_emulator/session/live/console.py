"""Console of a live session: one word a line in, one JSON object a line out.

The words control the flow of simulated time: `run`, `pause`, `step`, `until UTC`, `rate X`; or ask for something:
`state`, `watch`, `save`, `quit`.
"""

import json
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from lunar.errors import LunarError
from lunar.timescales import format_utc, parse_utc
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.flight.payload import Payload
from payload_emulator.session.live.station_ports import Server
from tmtc.dictionary.payload import DICTIONARY

CONSOLE_EXACT = {"_discontinuous": "_discontinuous", "_console_count": "_count"}
"""Attributes of `Console` in an exact state, by their names there."""

_SOURCE = 2
_COUNTS = 1 << 13  # the ground's counts begin at 0: reports name a telecommand by its count


@dataclass(slots=True, eq=False)
class Console:
    """Console and the flow of time that it controls.

    Attributes
    ----------
    answers
        Functions of the session that return the answer to a word.
    ends_session
        Whether the session ends when the last connection ends.
    rate
        Simulated seconds per second; 0: as fast as possible.
    held
        Whether time stands still at the beginning or end of a contact until `run`.
    steps
        Steps by hand that are due.
    """

    answers: Mapping[str, Callable[[], dict[str, Any]]]
    stopping: threading.Event
    ends_session: bool = False
    rate: float = 0.0
    paused: bool = False
    held: bool = False
    steps: int = 0
    until_ns: int | None = None
    server: Server = field(init=False)
    _lines: dict[int, bytes] = field(default_factory=dict)
    _watching: set[int] = field(default_factory=set)
    _discontinuous: bool = False
    _count: int = _COUNTS

    def open(self, host: str, port: int) -> None:
        """Open the port; 0: a free one."""
        self.server = Server("console", port, host, self._receive, self._end)

    @property
    def is_watched(self) -> bool:
        """Return whether a connection watches the steps."""
        return bool(self._watching)

    def send(self, message: dict[str, Any]) -> None:
        """Send a message to every connection."""
        self.server.send(_line(message))

    def show(self, message: dict[str, Any]) -> None:
        """Send a step to the connections that watch."""
        line = _line(message | {"paused": self.paused, "rate": self.rate})
        for number in self._watching:
            self.server.reply(number, line)

    def pause_at(self, utc_ns: int) -> None:
        """Pause if the time of `until` is reached."""
        if self.until_ns is not None and utc_ns >= self.until_ns:
            self.until_ns, self.paused = None, True
            self.send({"kind": "paused", "utc": format_utc(utc_ns)})

    def manual_step(self, payload: Payload) -> bytes:
        """Return the telecommand that reports a step by hand to an observing payload; no octets without one."""
        self._discontinuous &= payload.mode is PayloadMode.observing
        if not self._discontinuous or not payload.frames:
            return b""
        self._discontinuous = False
        count = self._count
        self._count = _COUNTS | (count + 1) & (_COUNTS - 1)
        values = {"function_id": "manual_step", "argument_1": 0.0, "argument_2": 0.0}
        return DICTIONARY.pack_command("perform_function", values, sequence_count=count, source=_SOURCE)

    def _receive(self, connection: int, octets: bytes) -> None:
        *lines, rest = (self._lines.get(connection, b"") + octets)[-4096:].split(b"\n")
        self._lines[connection] = rest
        for line in lines:
            self._execute(connection, line.decode("utf-8", "replace").split())

    def _end(self, connection: int) -> None:
        """Remove a connection, and end the session with the last one."""
        self._lines.pop(connection, None)
        self._watching.discard(connection)
        if self.ends_session and not self.server.clients:
            self.stopping.set()

    def _execute(self, connection: int, words: list[str]) -> None:
        if words == ["run"]:
            self.held = self.paused = False
        elif words == ["pause"]:
            self.paused = self._discontinuous = True
        elif words == ["step"]:
            self.paused = self._discontinuous = True
            self.steps += 1
        elif words == ["watch"]:
            self._watching.add(connection)
        elif words == ["quit"]:
            self.stopping.set()
        elif len(words) == 1 and words[0] in self.answers:
            self.send(self.answers[words[0]]())
        elif len(words) == 2 and words[0] == "rate" and _number(words[1]) is not None:
            self.rate = _number(words[1]) or 0.0
        elif len(words) == 2 and words[0] == "until":
            try:
                self.until_ns = parse_utc(words[1])
                self.held = self.paused = False
            except LunarError as error:
                self.send({"kind": "error", "text": str(error)})
        elif words:
            text = " ".join(words)[:80]
            expected = "expected run, pause, step, state, watch, save, until UTC, rate X or quit"
            self.send({"kind": "error", "text": f"{expected}, found {text!r}"})


def _line(message: dict[str, Any]) -> bytes:
    return json.dumps(message).encode() + b"\n"


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0.0 <= value < 1e9 else None
