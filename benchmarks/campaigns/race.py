"""Campaign of races for the state of telecommands, windows and jobs over HTTP.

    python -m benchmarks.campaigns.race [--races 10000] [--seed 1]

Starts PostgreSQL, Redis and two or more API processes on private ports. Every race sends several requests that
contradict each other at the same time, to the processes in turn:

release   three releases and two rejections of one queued telecommand, every other one a critical telecommand
uplink    four hand-outs (`POST uplink`) while released telecommands wait and another is released by two people
approve   three approvals and two cancellations of one draft window
window    two uplinks, a cancellation and a return to draft of one approved window, and two hand-outs meanwhile
ingest    four uploads with one idempotency key
regress   four regressions with one idempotency key

The campaign counts what must never happen: a telecommand released or handed out twice, two telecommands with one
sequence count, a release and a rejection that both succeed, telecommands of a withdrawn window that are handed out,
two jobs of one key, a lost request whose answer lacks the winning state, any server error. Exit status 1 if there
was any.
"""

import argparse
import http.client
import json
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sqlalchemy import func, select

from benchmarks._servers import Deployment, PostgresServer
from ground_service.access.service import add_user
from ground_service.clock import utc_now_ns
from ground_service.contacts.commanding.service import enter_command, release_command
from ground_service.ground import Ground, open_ground
from ground_service.planning.service import WindowEntry, add_window, change_window, uplink_window
from ground_service.regression.builds import load_build, register_build
from ground_service.store import repository
from ground_service.store.database import prepare_database
from lunar.constants import NS

SHARES = {"release": 60, "uplink": 15, "approve": 10, "window": 9, "ingest": 3, "regress": 3}
"""Share of each kind of race in percent."""

FIRST_SPACECRAFT, SPACECRAFT = 100, 8
CRITICAL = ("perform_function", {"function_id": "reboot", "argument_1": 0.0, "argument_2": 0.0})
ROUTINE: tuple[str, dict[str, Any]] = ("test_connection", {})
WINDOWS_FROM_NS = 1_900_000_000 * NS
FAULTS = [
    "double_releases",
    "double_hand_outs",
    "shared_counts",
    "two_winners",
    "no_winner",
    "withdrawn_but_live",
    "double_jobs",
    "unnamed_losers",
    "server_errors",
]

Figures = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Request:
    """Request of a race; `label` identifies it in the evaluation."""

    label: str
    method: str
    path: str
    user: str = "bob"
    body: bytes | None = None
    key: str = ""


@dataclass(frozen=True, slots=True)
class Answer:
    """Response to a request."""

    label: str
    status: int
    body: bytes
    telecommands: tuple[int, ...] = ()

    @property
    def won(self) -> bool:
        """Return whether the request took effect."""
        return 200 <= self.status < 300

    def json(self) -> Any:
        """Return the body as JSON; None if it is not JSON."""
        try:
            return json.loads(self.body)
        except ValueError:
            return None


class Racers:
    """Threads that send the requests of a race simultaneously, over persistent connections."""

    def __init__(self, ports: Sequence[int], tokens: Mapping[str, str], most: int = 8) -> None:
        self._ports, self._tokens = tuple(ports), dict(tokens)
        self._pool = ThreadPoolExecutor(most)
        self._local = threading.local()
        self._opened: list[http.client.HTTPConnection] = []

    def race(self, requests: Sequence[Request], rng: random.Random) -> list[Answer]:
        """Send requests simultaneously, to the processes in turn, and return the responses."""
        start = threading.Barrier(len(requests))
        first = rng.randrange(len(self._ports))
        order = list(requests)
        rng.shuffle(order)
        futures = [
            self._pool.submit(self._send, one, self._ports[(first + number) % len(self._ports)], start)
            for number, one in enumerate(order)
        ]
        return [future.result() for future in futures]

    def close(self) -> None:
        """End the threads and close their connections."""
        self._pool.shutdown(wait=True)
        for connection in self._opened:
            connection.close()

    def _send(self, request: Request, port: int, start: threading.Barrier) -> Answer:
        known = self._local.__dict__.setdefault("connections", {})
        connection = known.get(port)
        if connection is None:
            connection = known[port] = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
            connection.connect()
            self._opened.append(connection)
        headers = {"Authorization": f"Bearer {self._tokens[request.user]}"}
        if request.body is not None:
            octets = request.path.startswith("/telemetry")
            headers["Content-Type"] = "application/octet-stream" if octets else "application/json"
        if request.key:
            headers["Idempotency-Key"] = request.key
        start.wait(60)
        try:
            connection.request(request.method, f"/api/v1{request.path}", request.body, headers)
            answer = connection.getresponse()
            body = answer.read()
        except (OSError, http.client.HTTPException) as error:
            connection.close()
            known.pop(port, None)
            return Answer(request.label, 599, str(error).encode())
        named = answer.getheader("X-Telecommands") or ""
        return Answer(request.label, answer.status, body, tuple(int(one) for one in named.split(",") if one))


@dataclass
class Tally:
    """Counters of a campaign."""

    races: Counter[str] = field(default_factory=Counter)
    requests: Counter[str] = field(default_factory=Counter)
    won: Counter[str] = field(default_factory=Counter)
    faults: dict[str, Counter[str]] = field(default_factory=lambda: {name: Counter() for name in FAULTS})
    handed_out: Counter[int] = field(default_factory=Counter)
    examples: list[str] = field(default_factory=list)

    def fault(self, name: str, kind: str, text: str, count: int = 1) -> None:
        """Count a fault and keep the first few."""
        if count > 0:
            self.faults[name][kind] += count
            if len(self.examples) < 20:
                self.examples.append(f"{name} ({kind}): {text}")

    def add(self, kind: str, answers: Sequence[Answer], expected: tuple[int, ...] = (409,)) -> None:
        """Count the answers of a race."""
        self.races[kind] += 1
        self.requests[kind] += len(answers)
        for one in answers:
            self.won[kind] += one.won
            self.handed_out.update(one.telecommands)
            if not one.won:
                message = f"{one.label} {one.status} {one.body[:200]!r}"
                if one.status not in expected:
                    self.fault("server_errors", kind, message)
                elif kind not in ("ingest", "regress") and not (one.json() or {}).get("state"):
                    self.fault("unnamed_losers", kind, message)


class Campaign:
    """Seeded races over one deployment."""

    def __init__(self, ground: Ground, racers: Racers, builds: tuple[str, str], seed: int) -> None:
        self.ground, self.racers, self.builds = ground, racers, builds
        self.rng = random.Random(seed)
        self.tally = Tally()
        self.windows = 0

    def run(self, races: int) -> Figures:
        """Run races of all kinds in a seeded order; return the figures."""
        kinds = [kind for kind, share in SHARES.items() for _ in range(max(1, round(races * share / 100)))]
        self.rng.shuffle(kinds)
        started = time.monotonic()
        for number, kind in enumerate(kinds, start=1):
            getattr(self, f"_{kind}")(number)
        self._count_rows()
        tally = self.tally
        return {
            "races": sum(tally.races.values()),
            "seconds": round(time.monotonic() - started),
            "kinds": {
                kind: {
                    "races": tally.races[kind],
                    "requests": tally.requests[kind],
                    "won": tally.won[kind],
                    **{name: counts[kind] for name, counts in tally.faults.items() if counts[kind]},
                }
                for kind in SHARES
            },
            **{name: sum(counts.values()) for name, counts in tally.faults.items()},
            "examples": tally.examples,
        }

    def _spacecraft(self) -> int:
        return FIRST_SPACECRAFT + self.rng.randrange(SPACECRAFT)

    def _enter(self, spacecraft: int, what: tuple[str, dict[str, Any]] = ROUTINE) -> int:
        name, arguments = what
        return enter_command(self.ground, name, arguments, spacecraft_id=spacecraft, actor="ann")

    def _release(self, number: int) -> None:
        command = self._enter(self._spacecraft(), CRITICAL if number % 2 else ROUTINE)
        path, reason = f"/telecommands/{command}", json.dumps({"reason": "race"}).encode()
        requests = [Request("release", "POST", f"{path}/release", f"bob{k % 2}") for k in range(3)]
        requests += [Request("reject", "POST", f"{path}/reject", f"bob{k}", reason) for k in range(2)]
        answers = self.racers.race(requests, self.rng)
        self.tally.add("release", answers)
        won = Counter(one.label for one in answers if one.won)
        self.tally.fault("double_releases", "release", f"telecommand {command}", won["release"] - 1)
        self.tally.fault("two_winners", "release", f"telecommand {command}: {won}", won.total() > 1)
        self.tally.fault("no_winner", "release", f"telecommand {command}", won.total() == 0)

    def _uplink(self, _: int) -> None:
        spacecraft = self._spacecraft()
        for _ in range(2):
            release_command(self.ground, self._enter(spacecraft), actor="ann")
        late = self._enter(spacecraft)
        path = f"/telecommands/{late}/release"
        requests = [Request("release", "POST", path, f"bob{k}") for k in range(2)]
        requests += [self._hand_out(spacecraft, k) for k in range(4)]
        answers = self.racers.race(requests, self.rng)
        self.tally.add("uplink", answers)
        won = Counter(one.label for one in answers if one.won)
        self.tally.fault("double_releases", "uplink", f"telecommand {late}", won["release"] - 1)

    def _hand_out(self, spacecraft: int, k: int) -> Request:
        form = ("cltu", "packets")[k % 2]
        return Request("hand out", "POST", f"/uplink?spacecraft_id={spacecraft}&format={form}", f"bob{k % 2}")

    def _new_window(self, spacecraft: int) -> int:
        """Add a draft window over a time span that no other race uses."""
        start = WINDOWS_FROM_NS + self.windows * 7200 * NS
        self.windows += 1
        entry = WindowEntry(f"race {self.windows}", start, start + 600 * NS, 30.0, spacecraft)
        return int(add_window(self.ground, entry, actor="ann").id)

    def _approve(self, number: int) -> None:
        window = self._new_window(FIRST_SPACECRAFT + SPACECRAFT + number % SPACECRAFT)
        path = f"/windows/{window}"
        requests = [self._decision(path, "approved", k) for k in range(3)]
        requests += [self._decision(path, "failed", k) for k in range(2)]
        answers = self.racers.race(requests, self.rng)
        self.tally.add("approve", answers)
        won = Counter(one.label for one in answers if one.won)
        self.tally.fault("two_winners", "approve", f"window {window}: {won}", max(won.values(), default=0) > 1)
        self.tally.fault("no_winner", "approve", f"window {window}", won.total() == 0)
        expected = "failed" if won["failed"] else "approved"
        found = self.ground.read(repository.get, repository.WINDOWS, window, "window")["state"]
        self.tally.fault("two_winners", "approve", f"window {window}: {won}, is {found}", found != expected)

    def _decision(self, path: str, state: str, k: int = 0) -> Request:
        body = json.dumps({"state": state, "reason": "race"}).encode()
        return Request(state, "PATCH", path, f"bob{k % 2}", body)

    def _window(self, number: int) -> None:
        spacecraft = FIRST_SPACECRAFT + SPACECRAFT + number % SPACECRAFT
        window = self._new_window(spacecraft)
        change_window(self.ground, window, actor="bob0", changes={}, decision="approved")
        if self.rng.random() < 0.5:  # half of the windows are uplinked before, so that there are telecommands to fetch
            uplink_window(self.ground, window, actor="bob0")
        path = f"/windows/{window}"
        requests = [Request("uplink", "POST", f"{path}/uplink", f"bob{k}") for k in range(2)]
        requests += [self._decision(path, self.rng.choice(("failed", "draft")))]
        requests += [self._hand_out(spacecraft, k) for k in range(2)]
        self.tally.add("window", self.racers.race(requests, self.rng))
        self._judge_window(window)

    def _judge_window(self, window: int) -> None:
        """Check that the telecommands of a window match its decision."""
        table = repository.TELECOMMANDS
        with self.ground.database.reading() as connection:
            state = str(repository.get(connection, repository.WINDOWS, window, "window")["decision"])
            rows = connection.execute(select(table.c.name, table.c.state).where(table.c.window_id == window)).all()
        live = Counter(row[0] for row in rows if row[1] != "rejected")
        waiting = [row for row in rows if row[1] in ("released", "carried") and row[0] != "delete_activity"]
        message = f"window {window} {state}: {[tuple(row) for row in rows]}"
        self.tally.fault("two_winners", "window", message, live["enable_schedule"] > 1)
        self.tally.fault("withdrawn_but_live", "window", message, state != "approved" and bool(waiting))
        sent = any(row[1] == "sent" for row in rows)
        self.tally.fault("withdrawn_but_live", "window", message, state == "draft" and sent)

    def _ingest(self, number: int) -> None:
        body = f"race {number}".encode() * 8
        path = f"/telemetry?spacecraft_id={FIRST_SPACECRAFT}"
        requests = [Request("upload", "POST", path, "bob", body, f"ingest {number}") for _ in range(4)]
        self._one_job("ingest", requests, "job_id")

    def _regress(self, number: int) -> None:
        body = json.dumps({"baseline": self.builds[0], "candidate": self.builds[1]}).encode()
        requests = [Request("regression", "POST", "/regressions", "bob", body, f"regress {number}") for _ in range(4)]
        self._one_job("regress", requests, "id")

    def _one_job(self, kind: str, requests: Sequence[Request], name: str) -> None:
        answers = self.racers.race(requests, self.rng)
        self.tally.add(kind, answers)
        jobs = {(one.json() or {}).get(name) for one in answers if one.won}
        ingests = {(one.json() or {}).get("ingest_id") for one in answers if one.won}
        self.tally.fault("double_jobs", kind, str(jobs), max(len(jobs), len(ingests)) - 1)
        self.tally.fault("no_winner", kind, str([one.status for one in answers]), not jobs)

    def _count_rows(self) -> None:
        """Count the rows of the database after all races."""
        table, audit, jobs = repository.TELECOMMANDS, repository.AUDIT, repository.JOBS
        with self.ground.database.reading() as connection:
            counts = connection.execute(
                select(table.c.vehicle_id, table.c.sequence_count, func.count())
                .where(table.c.sequence_count.is_not(None))
                .group_by(table.c.vehicle_id, table.c.sequence_count)
            ).all()
            logged = connection.execute(
                select(audit.c.action, audit.c.target, func.count())
                .where(audit.c.action.in_(("release telecommand", "send telecommand")))
                .group_by(audit.c.action, audit.c.target)
            ).all()
            stray = connection.execute(select(func.count()).select_from(repository.INGESTS)).scalar_one()
            kinds = connection.execute(select(jobs.c.kind, func.count()).group_by(jobs.c.kind))
            entered = {kind: int(number) for kind, number in kinds}
        for vehicle, count, times in counts:
            self.tally.fault("shared_counts", "all", f"vehicle {vehicle}, count {count}", times - 1)
        for command, times in self.tally.handed_out.items():
            self.tally.fault("double_hand_outs", "all", f"telecommand {command}", times - 1)
        names = {"release telecommand": "double_releases", "send telecommand": "double_hand_outs"}
        for action, target, times in logged:
            self.tally.fault(names[action], "log", f"{action} {target}", times - 1)
        races = self.tally.races
        self.tally.fault("double_jobs", "ingest", f"{stray} ingests", stray - races["ingest"])
        limits = {"ingest": races["ingest"], "regression": races["regress"], "replay": 2 * races["regress"]}
        for kind, most in limits.items():
            found = entered.get(kind, 0)
            self.tally.fault("double_jobs", kind, f"{found} jobs, expected at most {most}", found - most)


def prepare(ground: Ground, folder: Path) -> tuple[dict[str, str], tuple[str, str]]:
    """Add users, two builds and an archive; return the tokens by user and the identities of the builds."""
    tokens = {name: add_user(ground, name, "operator") for name in ("ann", "bob", "bob0", "bob1")}
    builds = []
    for name in ("baseline", "candidate"):
        place = folder / name
        place.mkdir()
        (place / "build.toml").write_text(
            f'schema_version = 1\nname = "{name}"\ncommand = ["true", "{{archive}}", "{{out}}"]\n'
        )
        builds.append(register_build(ground, load_build(place)).digest)
    row = dict.fromkeys(("frames", "frames_stored", "octets", "pinned"), 1)
    row |= dict.fromkeys(("used_utc_ns", "created_utc_ns"), utc_now_ns())
    texts = dict.fromkeys(("digest", "manifest_sha256"), "a" * 64)
    texts |= {"name": "race", "state": "complete", "reason": ""}
    ground.write(repository.add, repository.REGRESSION_ARCHIVES, **row, **texts)
    return tokens, (builds[0], builds[1])


def holds(figures: Mapping[str, Any]) -> bool:
    """Return whether no forbidden event occurred."""
    return all(figures[name] == 0 for name in FAULTS)


def table(figures: Mapping[str, Any]) -> str:
    """Return the figures as text."""
    lines = [f"{'race':<10}{'races':>8}{'requests':>10}{'carried out':>13}{'refused':>9}"]
    totals: Counter[str] = Counter()
    for row in figures["kinds"].values():
        totals.update({name: row[name] for name in ("races", "requests", "won")})
    for kind, row in {**figures["kinds"], "all": totals}.items():
        refused = row["requests"] - row["won"]
        lines.append(f"{kind:<10}{row['races']:>8}{row['requests']:>10}{row['won']:>13}{refused:>9}")
    lines[-1] += f"   in {figures['seconds']} s"
    lines += [f"{name.replace('_', ' '):<22}{figures[name]:>6}" for name in FAULTS]
    lines += [f"  {one}" for one in figures["examples"]]
    return "\n".join(lines)


def run(folder: Path, url: str, races: int, apis: int = 2, seed: int = 1) -> Figures:
    """Run the campaign with an empty database at `url`; return the figures."""
    prepare_database(url, upgrade=True).engine.dispose()
    with open_ground(folder / "home", database_url=url) as ground:
        tokens, builds = prepare(ground, folder)
        with (
            Deployment(folder, apis, url=url, LINNA_PLACEBO_PASSES="0") as service,
            closing(Racers(service.ports, tokens)) as racers,
        ):
            return Campaign(ground, racers, builds, seed).run(races)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--races", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that started processes are ended
    with tempfile.TemporaryDirectory() as name, PostgresServer(Path(name)) as database:
        figures = run(Path(name), database.url, given.races, seed=given.seed)
    print(table(figures))
    return 0 if holds(figures) else 1


if __name__ == "__main__":
    sys.exit(main())
