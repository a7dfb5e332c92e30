"""Share of ingest jobs and requests that all processes serialise on: python -m benchmarks.locks.

PostgreSQL with one streaming standby, `fsync = on` and `synchronous_commit = on`, on private ports in a temporary
folder. An ingest job enters and ingests one piece of a downlink with its follow-up work; a request enters a
telecommand through the API in the process.

`held_share` is the time from the global lock of the event log, or of the head of the audit chain, to the end of its
transaction, compared with the time of a single process. `serialised_share` is the time for which a transaction holds
the lock while many writers wait for it, times the number of such transactions, compared with the time of a single
process: the reciprocal is the largest possible speed-up by more processes.
`gain` is the rate of two processes compared with that of one, each with a spacecraft of its own.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import multiprocessing
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import event, text

from benchmarks.ground import mixed_downlink
from ground_service.client.local import LocalClient
from ground_service.events import RequestChanged, publish
from ground_service.ground import Ground, open_ground
from ground_service.ingest.service import enter_ingest
from ground_service.store.events import LOCK
from ground_service.worker.follow_up import follow_in_process
from ground_service.worker.jobs import run_job
from studies.harness.parts import Part, PostgresServer, free_port, listens

SPACECRAFT = 76
PACKETS = 500
WARM_UP = 3
WRITERS, SECONDS = 16, 5.0


class Holds:
    """Global locks that the transactions of this process hold, and for how long."""

    def __init__(self, ground: Ground) -> None:
        self._began = threading.local()
        self._lock = threading.Lock()
        self.seconds, self.count = 0.0, 0
        event.listen(ground.database.engine, "after_cursor_execute", self._after)
        event.listen(ground.database.engine, "checkin", self._ended)

    def _after(self, *given: Any) -> None:
        statement, parameters = given[2], given[3]
        locks_feed = "pg_advisory_xact_lock" in statement and parameters == {"key": LOCK}
        locks_chain = "FROM audit_head" in statement and "FOR UPDATE" in statement
        if (locks_feed or locks_chain) and getattr(self._began, "at", None) is None:
            self._began.at = time.perf_counter()

    def _ended(self, *_: Any) -> None:
        at = getattr(self._began, "at", None)
        if at is not None:
            self._began.at = None
            with self._lock:
                self.seconds += time.perf_counter() - at
                self.count += 1


def ingest(ground: Ground, _client: LocalClient, instance: str, piece: bytes) -> None:
    """Ingest one piece of a downlink as a worker does."""
    stored = ground.files.put_octets(piece)
    _, job = enter_ingest(ground, stored, instance, spacecraft_id=SPACECRAFT, instance=instance)
    assert run_job(ground, job).state == "done"


def request(_ground: Ground, client: LocalClient, instance: str, _piece: bytes) -> None:
    """Enter a telecommand."""
    client.enter_telecommand("test_connection", SPACECRAFT, instance=instance)


OPERATIONS = {"ingest": ingest, "request": request}
COUNT = 30


def pieces(downlink: Path) -> list[bytes]:
    """Return the pieces of a downlink."""
    whole = downlink.read_bytes()
    cuts = np.linspace(0, len(whole), COUNT + WARM_UP + 1).astype(int)
    return [whole[a:b] for a, b in itertools.pairwise(cuts)]


def one_process(url: str, home: Path, name: str, instance: str, together: Any) -> dict[str, float]:
    """Repeat an operation; return the means of one."""
    given = pieces(home.with_name("whole.cadu"))
    ground = open_ground(home, database_url=url)
    with contextlib.closing(LocalClient(ground, "benchmark")) as client:
        if name == "ingest":
            follow_in_process(ground)
        for piece in given[:WARM_UP]:
            OPERATIONS[name](ground, client, instance, piece)
        holds = Holds(ground)
        together.wait()
        began, cpu = time.perf_counter(), time.process_time()
        for piece in given[WARM_UP:]:
            OPERATIONS[name](ground, client, instance, piece)
        took = time.perf_counter() - began
        return {
            "ms": 1e3 * took / COUNT,
            "cpu_ms": 1e3 * (time.process_time() - cpu) / COUNT,
            "locked_transactions": holds.count / COUNT,
            "held_share": holds.seconds / took,
        }


def _in_child(queue: Any, *given: Any) -> None:
    queue.put(one_process(*given))


def processes(url: str, home: Path, name: str, count: int, label: str) -> list[dict[str, float]]:
    """Run an operation in several processes at the same time."""
    context = multiprocessing.get_context("spawn")
    queue, together = context.Queue(), context.Barrier(count)
    started = [
        context.Process(target=_in_child, args=(queue, url, home, name, f"{label}-{k}", together))
        for k in range(count)
    ]
    for one in started:
        one.start()
    found = [queue.get(timeout=600) for _ in started]
    for one in started:
        one.join()
    return found


def exclusive(url: str, home: Path, writers: int) -> dict[str, float]:
    """Return the time of a transaction with one event, and of its lock, while writers have nothing else to do."""
    with open_ground(home, database_url=url) as ground:
        holds = Holds(ground)
        began = time.perf_counter()

        def write(k: int) -> None:
            while time.perf_counter() < began + SECONDS:
                with ground.database.writing() as connection:
                    publish(connection, RequestChanged(id=k, state="benchmark"))

        threads = [threading.Thread(target=write, args=(k,)) for k in range(writers)]
        for one in threads:
            one.start()
        for one in threads:
            one.join()
        wall = time.perf_counter() - began
        return {"ms": 1e3 * wall / holds.count, "held_ms": 1e3 * holds.seconds / holds.count}


@contextmanager
def servers(folder: Path) -> Iterator[str]:
    """Start the database with its standby; yield the URL."""
    with PostgresServer(folder, fsync="on", max_connections="60") as primary:
        place, port = str(primary.place / "standby"), free_port()
        at = ("-h", "127.0.0.1", "-p", str(primary.port), "-U", "linna")
        primary.run("pg_basebackup", *at, "-D", place, "-R", "-c", "fast")
        command = primary.command("postgres", "-D", place, "-p", str(port), "-k", place, "-h", "127.0.0.1")
        with Part(command, folder / "standby.log", lambda: listens(port), cwd=primary.place):
            primary.prepare_service()
            with open_ground(folder / "home", database_url=primary.url) as ground:
                _wait_for_standby(ground)
            yield primary.url


def _wait_for_standby(ground: Ground) -> None:
    with ground.database.reading() as connection:
        for statement in ("ALTER SYSTEM SET synchronous_standby_names = '*'", "SELECT pg_reload_conf()"):
            connection.execute(text(statement))
        until = time.monotonic() + 30.0
        query = text("SELECT sync_state FROM pg_stat_replication")
        while connection.execute(query).scalars().all() != ["sync"]:
            assert time.monotonic() < until, "the standby does not follow"
            time.sleep(0.1)


def measure() -> dict[str, Any]:
    """Return the figures."""
    figures: dict[str, Any] = {"cores": os.cpu_count(), "load": round(os.getloadavg()[0], 1)}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "whole.cadu").write_bytes(mixed_downlink(PACKETS * (COUNT + WARM_UP)))
        with servers(folder) as url:
            alone, many = (exclusive(url, folder / "home", count) for count in (1, WRITERS))
            figures["a_transaction"] = {"1 writer": alone, f"{WRITERS} writers": many}
            for kind in OPERATIONS:
                [one] = processes(url, folder / "home", kind, 1, "alone")
                pair = processes(url, folder / "home", kind, 2, "pair")
                figures[kind] = {
                    **{key: round(value, 4) for key, value in one.items()},
                    "serialised_share": round(many["held_ms"] * one["locked_transactions"] / one["ms"], 4),
                    "gain": round(sum(one["ms"] / other["ms"] for other in pair), 2),
                }
    return figures


if __name__ == "__main__":
    print(json.dumps({"locks": measure()}, indent=1))
