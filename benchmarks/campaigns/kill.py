"""Random kills of every part of the service during ingest and reports.

    python -m benchmarks.campaigns.kill [--kills 500] [--state FILE [--seconds S]] [--laptop] [--json]

Starts PostgreSQL, Redis, the API and two workers on private ports, uploads pieces of one downlink in random order, over
and over, asks for reports, and meanwhile kills (SIGKILL) one part after another and starts it again. In the end every
job has to be at its end, every upload ingested, and the archive equal to that of the same downlink ingested once,
undisturbed, into SQLite. Exit status 1 where that does not hold. `--laptop`: the API alone, with its jobs, on SQLite.

The campaign goes in runs of `--kills-per-run`, each with servers and an archive of its own. With `--state` each run is
added to a file when it is over, and a campaign goes on where that file ends; `--seconds` begins no run after that time
and ends the kills of the one under way.
"""

from __future__ import annotations

import argparse
import http.client
import itertools
import json
import os
import random
import signal
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import select

from benchmarks.campaigns._deployment import Deployment, Laptop
from benchmarks.ground import START, STEP_NS, mixed_downlink
from ground_service.services.ground import Ground, open_ground
from ground_service.services.ingest import ingest_file
from ground_service.store import repository
from ground_service.store.canonical import archive_hash
from lunar.timescales import format_utc

CADU_OCTETS = 1279
SPACECRAFT = 76
PATIENCE_S = 900.0
ROUND_S = 10.0
TARGETS = ("api", "worker", "database", "broker")
ENDS = ("done", "failed")
COUNTS = ("uploads", "attempts", "lost", "doubled", "seconds")

Figures = dict[str, Any]


def ask(api: str, method: str, path: str, body: bytes | None = None, key: str = "") -> Any:
    """The answer as JSON; asked again until there is one that is not about something being away."""
    headers = {"Idempotency-Key": key, "Content-Type": "application/json"} if key else {}
    until = time.monotonic() + PATIENCE_S
    while True:
        request = urllib.request.Request(f"{api}/api/v1{path}", data=body, method=method, headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return json.loads(answer.read())
        except urllib.error.HTTPError as error:
            if error.code < 500:
                raise SystemExit(f"{method} {path}: {error.code} {error.read()[:300]!r}") from None
        except (OSError, ValueError, http.client.HTTPException):  # cut off in the middle of an answer
            pass
        if time.monotonic() > until:
            raise SystemExit(f"{method} {path}: no answer within {PATIENCE_S:.0f} s")
        time.sleep(0.3)


class Harassment(threading.Thread):
    """Kills one part after another, at random, and starts it again."""

    def __init__(
        self, service: Deployment | Laptop, rng: random.Random, kills: int, pause_s: float, until: float
    ) -> None:
        super().__init__()
        self.killed: Counter[str] = Counter()
        self.broken: BaseException | None = None
        self.enough = threading.Event()
        self._service, self._rng, self._kills, self._pause_s, self._until = (
            service,
            rng,
            kills,
            pause_s,
            until,
        )

    def run(self) -> None:
        try:
            while self.killed.total() < self._kills and time.monotonic() < self._until:
                if self.enough.wait(self._rng.uniform(0.0, 2.0 * self._pause_s)):
                    return
                part = self._rng.choice(list(self._service.parts))
                self._service.parts[part].kill()
                time.sleep(self._rng.uniform(0.0, self._pause_s))
                self._service.parts[part].start()
                self.killed[part.partition(" ")[0]] += 1
        except BaseException as error:
            self.broken = error


def contents(ground: Ground) -> tuple[str, list[bytes]]:
    """The hash of the archive and the digests of its packets."""
    table = repository.PACKETS
    with ground.database.reading() as connection:
        vehicle = repository.vehicle_id(connection, SPACECRAFT, "flight")
        digests = connection.execute(select(table.c.digest).where(table.c.vehicle_id == vehicle)).scalars()
        return archive_hash(connection, vehicle), [bytes(digest) for digest in digests]


def one_run(
    kills: int,
    seed: int,
    *,
    laptop: bool,
    pause_s: float,
    packets: int,
    pieces: int,
    reports: int,
    until: float,
) -> Figures:
    """Kills over one archive; the figures."""
    rng = random.Random(seed)
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stream = mixed_downlink(packets)
        (folder / "whole.cadu").write_bytes(stream)
        with open_ground(folder / "reference") as ground:
            ingest_file(ground, folder / "whole.cadu")
            expected, there = contents(ground)
        cadus = len(stream) // CADU_OCTETS
        cuts = [round(k * cadus / pieces) * CADU_OCTETS for k in range(pieces + 1)]
        parts = [stream[a:b] for a, b in itertools.pairwise(cuts)]
        service = Laptop(folder) if laptop else Deployment(folder)
        harassment = Harassment(service, rng, kills, pause_s, until)
        harassment.start()
        try:
            jobs = work_meanwhile(service.api, harassment, parts, random.Random(seed + 1), packets, reports)
            harassment.join()
            if harassment.broken:
                raise harassment.broken
            for part in service.parts.values():
                part.revive()
            states, attempts = ends_of(service.api, jobs)
            with open_ground(service.home, database_url=service.url) as ground:
                found, stored = contents(ground)
                with ground.database.reading() as connection:
                    rows = repository.page(connection, repository.INGESTS, limit=100_000).rows
        finally:
            harassment.enough.set()
            service.stop()
            harassment.join()
            service.stop()  # what was being started meanwhile
    return {
        "seed": seed,
        "kills": dict(harassment.killed),
        "seconds": round(time.monotonic() - started),
        "uploads": len(rows),
        "jobs": dict(states),
        "attempts": attempts,
        "ingests": dict(Counter(row["state"] for row in rows)),
        "packets": len(there),
        "lost": len(set(there) - set(stored)),
        "doubled": len(stored) - len(set(stored)),
        "archive_identical": found == expected,
    }


def the_pass(api: str, definition: bytes) -> int:
    """Define a pass; where a kill leaves open whether it was done, look, and ask again under another key."""
    for attempt in range(20):
        try:
            return int(ask(api, "POST", "/passes", definition, f"pass {attempt}")["id"])
        except SystemExit as refused:
            if "409" not in str(refused):
                raise
        known = ask(api, "GET", "/passes")["items"]
        if known:
            return int(known[0]["id"])
    raise SystemExit("POST /passes: its end was left open 20 times")


def work_meanwhile(
    api: str,
    harassment: Harassment,
    parts: Sequence[bytes],
    rng: random.Random,
    packets: int,
    reports: int,
) -> list[str]:
    """Upload every piece, and all of them again while there are kills, with reports in between; the jobs.

    A round waits a little for the first job of the round before: a great heap of jobs tells no more than a small one.
    """
    definition = {
        "name": "all",
        "start": format_utc(START),
        "stop": format_utc(START + packets * STEP_NS // 4),
        "spacecraft_id": SPACECRAFT,
    }
    jobs: list[str] = []
    first = ""
    round_ = 0
    while round_ == 0 or harassment.is_alive():
        patient = time.monotonic() + ROUND_S
        while round_ > 0 and harassment.is_alive() and time.monotonic() < patient:
            if ask(api, "GET", f"/jobs/{first}")["state"] in ENDS:
                break
            time.sleep(0.2)
        first = ""
        for k in rng.sample(range(len(parts)), len(parts)):
            answer = ask(
                api, "POST", f"/telemetry?spacecraft_id={SPACECRAFT}", parts[k], f"piece {k} {round_}"
            )
            jobs.append(answer["job_id"])
            first = first or answer["job_id"]
            if round_ > 0 and not harassment.is_alive():
                break
        if round_ == 0:
            pass_id = the_pass(api, json.dumps(definition).encode())
            jobs += [ask(api, "POST", f"/passes/{pass_id}/reports", b"", f"report {k}")["id"]
                     for k in range(reports)]  # fmt: skip
        round_ += 1
    return jobs


def ends_of(api: str, jobs: Sequence[str]) -> tuple[Counter[str], int]:
    """How the jobs ended, and how often they were begun."""
    states: Counter[str] = Counter()
    attempts = 0
    for job in jobs:
        until = time.monotonic() + PATIENCE_S
        while True:
            row = ask(api, "GET", f"/jobs/{job}")
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
    """Whether nothing was lost or doubled and every job and ingest came to a good end."""
    return (
        figures["archives_identical"] == figures["runs"]
        and figures["lost"] == figures["doubled"] == 0
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
    ]
    return "\n".join(lines)


def load_runs(path: Path | None) -> list[Figures]:
    """The runs of a state file; none where there is no file yet."""
    if path is None or not path.exists():
        return []
    runs = json.loads(path.read_text())["runs"]
    assert isinstance(runs, list)
    return runs


def save_runs(path: Path, runs: Sequence[Figures]) -> None:
    """Replace the state file at once."""
    beside = path.with_name(path.name + ".new")
    beside.write_text(json.dumps({"runs": runs}, indent=1))
    os.replace(beside, path)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=500)
    parser.add_argument("--kills-per-run", type=int, default=100)
    parser.add_argument("--state", type=Path, help="file that runs are added to, to go on from")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="kill no longer than that")
    parser.add_argument("--laptop", action="store_true", help="the API alone, on SQLite")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--pause", type=float, default=1.0, help="about how long everything runs between kills, s"
    )
    parser.add_argument("--packets", type=int, default=40_000)
    parser.add_argument("--pieces", type=int, default=60)
    parser.add_argument("--reports", type=int, default=6)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was started is ended
    until = time.monotonic() + given.seconds
    runs = load_runs(given.state)
    while (left := given.kills - totals(runs)["killed"]) > 0 and time.monotonic() < until:
        one = one_run(
            min(left, given.kills_per_run),
            given.seed + len(runs),
            laptop=given.laptop,
            pause_s=given.pause,
            packets=given.packets,
            pieces=given.pieces,
            reports=given.reports,
            until=until,
        )
        runs.append(one)
        if given.state is not None:
            save_runs(given.state, runs)
        print(f"run {len(runs)}: {json.dumps(one)}", file=sys.stderr, flush=True)
    figures = totals(runs)
    print(json.dumps(figures, indent=2) if given.json else table(figures))
    return 0 if holds(figures) else 1


if __name__ == "__main__":
    sys.exit(main())
