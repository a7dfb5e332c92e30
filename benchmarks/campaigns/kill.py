"""Campaign of random kills of every part of the service during ingest, commanding and reports.

    python -m benchmarks.campaigns.kill [--kills 300] [--state FILE] [--laptop] [--json]

Starts PostgreSQL, Redis, two API processes and two workers on private ports. Four clients upload pieces of one
downlink, cut at random octets, in random order, over and over, and meanwhile enter,
release, reject and fetch telecommands. One part after another is killed (SIGKILL) and started again.

In the end every job has to be done, the archive equal to that of the same downlink ingested once, undisturbed, into
SQLite, and answers to the clients have to hold: every acknowledged telecommand is there once, in the acknowledged
state, none shares a sequence count or was handed out twice, every change has one audit entry, the hash chain is whole,
and `linna verify` finds no damage. Exit status 1 where that does not hold. `--laptop`: one API alone, with its jobs, on
SQLite.

The campaign goes in runs of 100 kills, each with its own servers and archive. With `--state` each run is added to a
file when it is over, and a campaign goes on where that file ends.
"""

import argparse
import json
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import select

from benchmarks._servers import Deployment
from benchmarks.campaigns._clients import TIMEOUT_S, Client, Piece, Session, broken_of, cut_pieces
from benchmarks.campaigns._ledger import FAULTS, AuditLine, Ledger, judge
from benchmarks.ground import definition, mixed_downlink
from ground_service.access.service import add_user
from ground_service.ground import Ground, open_ground
from ground_service.ingest.service import ingest_file
from ground_service.store import audit, repository
from ground_service.store.vehicles import vehicle_id
from ground_service.worker.integrity import verify
from tests.ground_service.archive_hash import archive_hash

SPACECRAFT = 76
CLIENTS = 4
APIS = 2
ROUND_S = 10.0
TARGETS = ("api", "worker", "database", "broker")
ENDS = ("done", "failed")
COUNTS = ("uploads", "attempts", "telecommands", "handed_out", "lost", "doubled", *FAULTS, "seconds")

Figures = dict[str, Any]


class Harassment(threading.Thread):
    """Kills one part after another, at random, and starts it again."""

    def __init__(self, service: Deployment, rng: random.Random, kills: int, pause_s: float) -> None:
        super().__init__()
        self.killed: Counter[str] = Counter()
        self.broken: BaseException | None = None
        self.enough = threading.Event()
        self._service, self._rng, self._kills = service, rng, kills
        self._pause_s = pause_s
        self._targets = list(service.parts)

    def run(self) -> None:
        try:
            while self.killed.total() < self._kills:
                if self.enough.wait(self._rng.uniform(0.0, 2.0 * self._pause_s)):
                    return
                name = self._rng.choice(self._targets)
                part = self._service.parts[name]
                part.kill()
                time.sleep(self._rng.uniform(0.0, self._pause_s))
                part.start()
                self.killed[name.partition(" ")[0]] += 1
        except BaseException as error:
            self.broken = error


def contents(ground: Ground) -> tuple[str, list[bytes]]:
    """The hash of the archive and the digests of its packets."""
    table = repository.PACKETS
    with ground.database.reading() as connection:
        vehicle = vehicle_id(connection, SPACECRAFT, "flight")
        digests = connection.execute(select(table.c.digest).where(table.c.vehicle_id == vehicle)).scalars()
        return archive_hash(connection, vehicle), [bytes(digest) for digest in digests]


def commands_of(ground: Ground, ledger: Ledger) -> tuple[int, Counter[str]]:
    """Return the number of telecommands, and the differences between the archive and the acknowledgements."""
    lines = []
    with ground.database.snapshot() as connection:
        rows = [dict(row) for row in connection.execute(select(repository.TELECOMMANDS)).mappings()]
        for action, target, actor in connection.execute(
            select(repository.AUDIT.c.action, repository.AUDIT.c.target, repository.AUDIT.c.actor)
        ):
            verb, _, kind = action.rpartition(" ")
            if kind == "telecommand":
                lines.append(AuditLine(verb, int(target), actor))
        faults = judge(ledger, rows, lines)
        faults["chain_broken"] = sum(1 for _ in audit.broken_entries(connection))
        for number, sha256 in set(ledger.heads):
            faults["heads_lost"] += number > 0 and audit.read_entry_sha256(connection, number) != sha256
    damage = verify(ground, rebuild=True).damaged
    for one in damage[:5]:
        print(f"damaged: {one}", file=sys.stderr, flush=True)
    faults["rows_damaged"] = len(damage)
    return len(rows), faults


def one_run(kills: int, seed: int, given: argparse.Namespace) -> Figures:
    """Kills over one archive; the figures."""
    packets = given.packets
    rng = random.Random(seed)
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stream = mixed_downlink(packets)
        (folder / "whole.cadu").write_bytes(stream)
        with open_ground(folder / "reference") as ground:
            ingest_file(ground, folder / "whole.cadu")
            expected, there = contents(ground)
        service = Deployment(folder) if given.laptop else Deployment(folder, APIS, 2)
        ledger = Ledger()
        harassment = Harassment(service, rng, kills, given.pause)
        try:
            with open_ground(service.home, database_url=service.url) as ground:
                sessions = [Session(service.apis, add_user(ground, f"client{k}", "operator")) for k in range(CLIENTS)]
            harassment.start()
            work_meanwhile(sessions, harassment, stream, random.Random(seed + 1), ledger, given)
            harassment.join()
            if harassment.broken:
                raise harassment.broken
            for part in service.parts.values():
                part.revive()
            states, attempts = ends_of(sessions[0], ledger.jobs)
            with open_ground(service.home, database_url=service.url) as ground:
                found, stored = contents(ground)
                with ground.database.reading() as connection:
                    rows = connection.execute(select(repository.INGESTS.c.state)).all()
                telecommands, faults = commands_of(ground, ledger)
        finally:
            harassment.enough.set()
            service.stop()
            if harassment.ident is not None:
                harassment.join()
            service.stop()  # what was being started meanwhile
    return {
        "seed": seed,
        "kills": dict(harassment.killed),
        "seconds": round(time.monotonic() - started),
        "uploads": len(rows),
        "jobs": dict(states),
        "attempts": attempts,
        "ingests": dict(Counter(row.state for row in rows)),
        "packets": len(there),
        "lost": len(set(there) - set(stored)),
        "doubled": len(stored) - len(set(stored)),
        "archive_identical": found == expected,
        "telecommands": telecommands,
        "handed_out": sum(len(one.commands) for one in ledger.hand_outs),
        "hand_outs_unanswered": ledger.unanswered_hand_outs,
        **{name: faults[name] for name in FAULTS},
    }


def the_pass(session: Session, body: bytes) -> int:
    """Define a pass; where a kill leaves open whether it was done, look, and ask again under another key."""
    for attempt in range(20):
        answer = session.ask("POST", "/passes", body, f"pass {attempt}", 201, 409)
        if answer.status_code == 201:
            return int(answer.json()["id"])
        known = session.get("/passes")["items"]
        if known:
            return int(known[0]["id"])
    raise SystemExit("POST /passes: its end was left open 20 times")


def work_meanwhile(
    sessions: Sequence[Session],
    harassment: Harassment,
    stream: bytes,
    rng: random.Random,
    ledger: Ledger,
    given: argparse.Namespace,
) -> None:
    """Upload the downlink with clients, repeatedly during the kills, with commands and reports in between.

    A round waits for the first job of the previous round, to limit the number of waiting jobs.
    """
    waiting: deque[Piece] = deque()
    over, pieces = threading.Event(), given.pieces
    clients = [
        Client(f"client{k}", session, SPACECRAFT, waiting, ledger, random.Random(rng.getrandbits(64)), over)
        for k, session in enumerate(sessions)
    ]
    try:
        waiting.extend(cut_pieces(stream, pieces, rng, "round 0"))
        for client in clients:
            client.start()
        while waiting and not over.wait(0.2):
            pass
        ask_for_reports(sessions[0], given.packets, given.reports, ledger)
        round_ = 0
        while harassment.is_alive() and not over.is_set():
            patient = time.monotonic() + ROUND_S
            first = round_ * pieces // 2
            while harassment.is_alive() and time.monotonic() < patient:
                # A piece taken by a client counts as accepted only once its job is known.
                known = ledger.jobs[first : first + 1]
                if known and sessions[0].get(f"/jobs/{known[0]}")["state"] in ENDS:
                    break
                over.wait(0.5)
            round_ += 1
            waiting.extend(cut_pieces(stream, pieces, rng, f"round {round_}"))
            while waiting and harassment.is_alive() and not over.wait(0.2):
                pass
        waiting.clear()
    finally:
        over.set()
        for client in clients:
            if client.ident is not None:
                client.join()
    if broken := broken_of(clients):
        raise broken


def ask_for_reports(session: Session, packets: int, reports: int, ledger: Ledger) -> None:
    """Define a pass over the whole time and request reports of it."""
    pass_id = the_pass(session, json.dumps(definition(packets)).encode())
    for k in range(reports):
        answer = session.ask("POST", f"/passes/{pass_id}/reports", b"", f"report {k}", 200, 202)
        ledger.jobs.append(answer.json()["id"])


def ends_of(session: Session, jobs: Sequence[str]) -> tuple[Counter[str], int]:
    """Count the final states of the jobs and their starts."""
    states: Counter[str] = Counter()
    attempts = 0
    for job in jobs:
        until = time.monotonic() + TIMEOUT_S
        while True:
            row = session.get(f"/jobs/{job}")
            if row["state"] in ENDS or time.monotonic() > until:
                break
            time.sleep(0.5)
        states[row["state"]] += 1
        attempts += row["attempts"]
    return states, attempts


def totals(runs: Sequence[Mapping[str, Any]]) -> Figures:
    """All runs together."""
    sums: dict[str, Counter[str]] = {"kills": Counter(), "jobs": Counter(), "ingests": Counter()}
    for one in runs:
        for name, counter in sums.items():
            counter.update(one[name])
    return {
        "runs": len(runs),
        "killed": sum(sums["kills"].values()),
        **{name: dict(sorted(counter.items())) for name, counter in sums.items()},
        **{name: sum(one[name] for one in runs) for name in COUNTS},
        "archives_identical": sum(one["archive_identical"] for one in runs),
    }


def holds(figures: Mapping[str, Any]) -> bool:
    """Return whether nothing was lost or doubled and every job and ingest ended well."""
    return (
        figures["archives_identical"] == figures["runs"]
        and figures["lost"] == figures["doubled"] == 0
        and not any(figures[name] for name in FAULTS)
        and set(figures["jobs"]) <= {"done"}
        and set(figures["ingests"]) <= {"done"}
    )


def table(figures: Mapping[str, Any]) -> str:
    """The cumulative table as text."""
    lines = [f"{'killed':<12}{'times':>7}"]
    lines += [f"{target:<12}{figures['kills'].get(target, 0):>7}" for target in TARGETS]
    ended = ", ".join(f"{count} {state}" for state, count in figures["jobs"].items())
    lines += [
        f"{'all':<12}{figures['killed']:>7}   in {figures['runs']} runs, {figures['seconds']} s",
        f"jobs ended: {ended} ({figures['attempts']} attempts); uploads: {figures['uploads']}",
        f"packets lost: {figures['lost']}, doubled: {figures['doubled']}; "
        f"archives identical to an undisturbed one: {figures['archives_identical']} of {figures['runs']}",
        f"telecommands: {figures['telecommands']}, handed out and acknowledged: {figures['handed_out']}; "
        + ", ".join(f"{name.replace('_', ' ')}: {figures[name]}" for name in FAULTS),
    ]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--state", type=Path, help="file that runs are added to, to go on from")
    parser.add_argument("--laptop", action="store_true", help="the API alone, on SQLite")
    parser.add_argument("--pause", type=float, default=1.0, help="about how long all runs between kills, s")
    for name, default in {"packets": 40_000, "pieces": 60, "reports": 6}.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was started is ended
    runs = json.loads(given.state.read_text()) if given.state and given.state.exists() else []
    while (left := given.kills - totals(runs)["killed"]) > 0:
        runs.append(one_run(min(left, 100), 1 + len(runs), given))
        if given.state:
            temporary = given.state.with_suffix(".new")
            temporary.write_text(json.dumps(runs))
            temporary.replace(given.state)
        print(f"run {len(runs)}: {json.dumps(runs[-1])}", file=sys.stderr, flush=True)
    figures = totals(runs)
    print(json.dumps(figures, indent=2) if given.json else table(figures))
    return 0 if holds(figures) else 1


if __name__ == "__main__":
    sys.exit(main())
