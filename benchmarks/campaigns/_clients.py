"""Clients that upload pieces and add, decide and fetch telecommands while parts of the service are killed."""

import contextlib
import itertools
import json
import random
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import httpx

from benchmarks.campaigns._ledger import Decision, Entered, HandOut, Ledger, mark_of

TIMEOUT_S = 900.0
LOOK_AFTER_S = 1.0
"""Time after which the database has completed the statements of a killed process."""

FUNCTIONS = ("start_observation", "reboot")
"""Telecommands for one person, and for two persons."""

TIMEOUT_S = 86_400

RECENT = 12
"""Number of newest telecommands on which clients decide, so that they compete for the same ones."""


@dataclass(frozen=True, slots=True)
class Piece:
    """Octets of a downlink, and their offset in it."""

    name: str
    octets: bytes
    offset: int

    @property
    def place(self) -> str:
        """Parameters of the upload that state recording and offset."""
        return f"stream=downlink&offset={self.offset}"


@dataclass(frozen=True, slots=True)
class Session:
    """Session of one user with the processes of a service."""

    apis: tuple[str, ...]
    token: str

    def ask(self, method: str, path: str, body: bytes | None = None, key: str = "", *expected: int) -> httpx.Response:
        """Repeat a request, with one process after another, until a response is not for an unavailable part.

        Raises
        ------
        SystemExit
            If there is no such response within `TIMEOUT_S`, or it has none of the `expected` statuses.
        """
        headers = {"Authorization": f"Bearer {self.token}"}
        if body is not None:
            headers["Content-Type"] = (
                "application/octet-stream" if path.startswith("/telemetry") else "application/json"
            )
        if key:
            headers["Idempotency-Key"] = key
        until = time.monotonic() + TIMEOUT_S
        for api in itertools.cycle(random.sample(self.apis, len(self.apis))):
            with contextlib.suppress(httpx.HTTPError):
                found = httpx.request(method, f"{api}/api/v1{path}", content=body, headers=headers, timeout=60)
                if found.status_code < 500:
                    if expected and found.status_code not in expected:
                        raise SystemExit(f"{method} {path}: {found.status_code} {found.content[:300]!r}")
                    return found
            if time.monotonic() > until:
                raise SystemExit(f"{method} {path}: no answer within {TIMEOUT_S:.0f} s")
            time.sleep(0.3)
        raise AssertionError

    def get(self, path: str) -> Any:
        """Return the JSON of a path."""
        return self.ask("GET", path, None, "", 200).json()


class Client(threading.Thread):
    """User who uploads pieces and commands the spacecraft until there are no more pieces."""

    def __init__(
        self,
        name: str,
        session: Session,
        spacecraft: int,
        pieces: deque[Piece],
        ledger: Ledger,
        rng: random.Random,
        over: threading.Event,
    ) -> None:
        super().__init__(name=name)
        self.broken: BaseException | None = None
        self._session, self._spacecraft, self._pieces = session, spacecraft, pieces
        self._ledger, self._rng, self._over = ledger, rng, over

    def run(self) -> None:
        actions = self._actions()
        try:
            while not self._over.is_set():
                try:
                    piece = self._pieces.popleft()
                except IndexError:
                    self._over.wait(self._rng.uniform(0.0, 0.6))
                else:
                    self._upload(piece)
                next(actions)()
        except BaseException as error:
            self.broken = error
            self._over.set()

    def _actions(self) -> Iterator[Callable[[], None]]:
        """Yield the actions between pieces: each once, then in random order."""
        every = (self._enter, self._decide, self._fetch, self._note_head)
        yield from every
        while True:
            yield self._rng.choices(every, (3, 4, 2, 1))[0]

    def _upload(self, piece: Piece) -> None:
        path = f"/telemetry?spacecraft_id={self._spacecraft}&{piece.place}"
        answer = self._session.ask("POST", path, piece.octets, piece.name, 202)
        self._ledger.jobs.append(answer.json()["job_id"])

    def _enter(self) -> None:
        """Add a telecommand; after an unknown result check the list, and add it again under another key."""
        mark = self._ledger.count("marks")
        function = self._rng.choice(FUNCTIONS)
        given = {
            "name": "perform_function",
            "arguments": {"function_id": function, "argument_1": float(mark), "argument_2": 0.0},
            "spacecraft_id": self._spacecraft,
            "timeout_s": TIMEOUT_S,
        }
        for attempt in range(20):
            body, key = json.dumps(given).encode(), f"enter {mark} {attempt}"
            answer = self._session.ask("POST", "/telecommands", body, key, 201, 409)
            if answer.status_code == 201:
                self._ledger.entered.append(Entered(mark, int(answer.json()["id"]), self.name))
                return
            time.sleep(LOOK_AFTER_S)
            for row in self._session.get("/telecommands?limit=200")["items"]:
                if mark_of(row) == mark:
                    self._ledger.entered.append(Entered(mark, int(row["id"]), self.name))
                    return
        raise SystemExit("POST /telecommands: its end was left open 20 times")

    def _decide(self) -> None:
        """Release or reject one of the newest telecommands, concurrently with other clients."""
        recent = self._ledger.entered[-RECENT:]
        if not recent:
            return
        command = self._rng.choice(recent).command
        state = self._rng.choices(("released", "rejected"), (4, 1))[0]
        verb, body = ("release", b"") if state == "released" else ("reject", b'{"reason": "campaign"}')
        answer = self._session.ask("POST", f"/telecommands/{command}/{verb}", body, "", 200, 409)
        if answer.status_code == 200:
            self._ledger.decisions.append(Decision(command, state, self.name))
        elif found := answer.json().get("state"):
            self._ledger.decisions.append(Decision(command, found))

    def _fetch(self) -> None:
        """Fetch the telecommands to be sent, sometimes twice under one key."""
        key = f"uplink {self._rng.getrandbits(64):x}"
        path = f"/uplink?spacecraft_id={self._spacecraft}&format=packets"
        answer = self._session.ask("POST", path, None, key, 200, 409)
        if answer.status_code == 409:  # fetched by a process that was killed before its response
            self._ledger.count("unanswered_hand_outs")
            return
        commands = tuple(int(one) for one in answer.headers.get("x-telecommands", "").split(",") if one)
        self._ledger.hand_outs.append(HandOut(self.name, commands, answer.content))
        if self._rng.random() < 0.3 and self._session.ask("POST", path, None, key).content != answer.content:
            self._ledger.count("changed_answers")

    def _note_head(self) -> None:
        head = self._session.get("/audit/head")
        self._ledger.heads.append((int(head["number"]), str(head["sha256"])))


def cut_pieces(stream: bytes, pieces: int, rng: random.Random, name: str) -> list[Piece]:
    """Return a stream cut at random octets, in random order."""
    places = sorted(rng.sample(range(1, len(stream)), pieces - 1))
    made = [
        Piece(f"{name} {start}", stream[start:stop], start)
        for start, stop in itertools.pairwise([0, *places, len(stream)])
    ]
    rng.shuffle(made)
    return made


def broken_of(clients: Sequence[Client]) -> BaseException | None:
    """Return the error that ended a client prematurely."""
    return next((one.broken for one in clients if one.broken is not None), None)
