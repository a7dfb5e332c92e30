"""Benchmark of joining one piece while many edges wait, and of the rate of two workers.

    python -m benchmarks.joining [--edges 100000] [--pieces 40] [--postgresql] [--workers]

The edges of `--edges` pieces are put into the table: beginnings and ends of CADUs with lengths and frame counts as
random cuts leave them, and as many of packets of a channel. Then pieces of a downlink are ingested that each join the
one before. With an empty and with a full table the benchmark measures, for each piece: the search for neighbours with
the decoding of what they make up (`find`), the storage of the packets found (`store`), the commits, the processor time
of all joining, and the whole ingest.

`--workers` measures instead how many pieces a second one and two processes ingest into one PostgreSQL database.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from sqlalchemy import text

from benchmarks.ground import mixed_downlink
from ground_service.ground import Ground, open_ground
from ground_service.ingest import edge_store as edges
from ground_service.ingest.edges import CLOSER, OPENER, UNKNOWN, Edge
from ground_service.ingest.joining import Joiner, raw_domain
from ground_service.ingest.service import ingest_file
from ground_service.ingest.stream import Link, reaches_of
from ground_service.store import repository
from ground_service.store.database import prepare_database
from studies.mission_run.parts import PostgresServer
from tmtc.arrays import as_octets

SPACECRAFT = 76
SCOPE = "flight"
BLOCK = 5_000


def fill(ground: Ground, link: Link, count: int, channel: str) -> None:
    """Insert `count` edges of CADUs and of a channel each into the table."""
    assert link.settings is not None
    rng = np.random.default_rng(1)
    length = link.settings.cadu_length
    domain = raw_domain(edges.Piece(0, SCOPE, None, "0" * 64, 0, "", 0, None), link)
    for first in range(0, count, BLOCK):
        raw, packets = [], []
        for number in range(first, min(first + BLOCK, count)):
            size, frame = int(rng.integers(1, length)), int(rng.integers(256))
            octets = rng.bytes(size)
            if number % 2:
                raw.append(Edge(OPENER, UNKNOWN, frame, octets, number, length - size))
                packets.append(Edge(OPENER, UNKNOWN, frame, octets[:200], None, 1 + size % 300))
            else:
                raw.append(Edge(CLOSER, frame, UNKNOWN, octets, number))
                packets.append(Edge(CLOSER, frame, UNKNOWN, octets[:300]))
        with ground.database.writing() as connection:
            edges.add_edges(connection, domain, raw, "0" * 64)
            edges.add_edges(connection, channel, packets)
    # Run ANALYZE now, because autovacuum would otherwise run it during the measurement.
    with ground.database.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.execute(
            text("VACUUM ANALYZE stream_edges" if ground.database.dialect == "postgresql" else "ANALYZE")
        )


def measure(database_url: str | None, count: int, pieces: int) -> dict[str, Any]:
    """Return the milliseconds of joining a piece, with an empty and with a full table."""
    stream = mixed_downlink(40 * pieces)
    taken: dict[str, list[float]] = {}
    commits: list[float] = []
    join, store = Joiner.join, Joiner._store
    storing: list[float] = []

    def note(name: str, value: float) -> None:
        taken.setdefault(name, []).append(value)

    def timed_store(self: Joiner) -> list[bytes]:
        begun = time.perf_counter()
        try:
            return store(self)
        finally:
            storing.append(1e3 * (time.perf_counter() - begun))

    def timed(self: Joiner) -> None:
        storing.clear()
        begun, processor, before = time.perf_counter(), time.process_time(), len(commits)
        join(self)
        whole = 1e3 * (time.perf_counter() - begun)
        synced = sum(commits[before:])
        note("join_find_ms", whole - sum(storing))
        note("join_store_ms", sum(storing) - synced)
        note("join_commits_ms", synced)
        note("join_processor_ms", 1e3 * (time.process_time() - processor))

    figures: dict[str, Any] = {"edges": 2 * count, "pieces": pieces}
    with tempfile.TemporaryDirectory() as name:
        if database_url:
            prepare_database(database_url, upgrade=True).engine.dispose()
        with open_ground(Path(name) / "home", database_url=database_url) as ground, ExitStack() as opened:
            commit = ground.database.engine.dialect.do_commit

            def timed_commit(connection: Any) -> None:
                begun = time.perf_counter()
                commit(connection)
                commits.append(1e3 * (time.perf_counter() - begun))

            opened.enter_context(patch.object(ground.database.engine.dialect, "do_commit", timed_commit))
            ((reach, *_), _) = reaches_of(as_octets(stream[:100_000]))
            size = len(stream) // (2 * pieces + 2)
            path = Path(name) / "piece"

            def take(first: int, last: int) -> None:
                for number in range(first, last):
                    path.write_bytes(stream[number * size : (number + 1) * size])
                    begun, before = time.perf_counter(), len(commits)
                    ingest_file(ground, path)
                    note("piece_ms", 1e3 * (time.perf_counter() - begun))
                    note("piece_commits", float(len(commits) - before))
                    note("piece_commits_ms", sum(commits[before:]))

            take(0, 2)  # compiles
            with patch.object(Joiner, "join", timed), patch.object(Joiner, "_store", timed_store):
                for state, begin in (("empty", 2), ("full", 2 + pieces)):
                    taken.clear()
                    take(begin, begin + pieces)
                    figures[state] = {
                        name: {
                            "median": round(float(np.median(values)), 2),
                            "p95": round(float(np.percentile(values, 95)), 2),
                        }
                        for name, values in sorted(taken.items())
                    }
                    if state == "empty":
                        with ground.database.reading() as connection:
                            vehicle = repository.find(connection, repository.VEHICLES, ccsds_id=SPACECRAFT)
                        assert vehicle is not None
                        fill(ground, reach.link, count, f"channel {vehicle['id']} 0 6 1113")
    return figures


def work(url: str, home: str, pieces: list[bytes], ready: Any, gate: Any) -> None:
    """Ingest pieces as one worker process; the first one compiles, before the gate opens."""
    path = Path(home) / f"piece-{os.getpid()}"
    with open_ground(Path(home), database_url=url) as ground:
        for number, octets in enumerate(pieces):
            if number == 1:
                ready.release()
                gate.wait()
            path.write_bytes(octets)
            ingest_file(ground, path)


def measure_workers(pieces: int) -> dict[str, Any]:
    """Pieces a second that one and two worker processes ingest, each the pieces of a separate downlink."""
    stream = mixed_downlink(40 * pieces)
    size = len(stream) // (2 * pieces)
    context = multiprocessing.get_context("spawn")
    figures: dict[str, Any] = {"pieces": pieces, "piece_octets": size}
    for workers in (1, 2):
        with tempfile.TemporaryDirectory() as name, PostgresServer(Path(name)) as server:
            prepare_database(server.url, upgrade=True).engine.dispose()
            ready, gate = context.Semaphore(0), context.Event()
            shares = [
                [stream[k * size : (k + 1) * size] for k in range(half, 2 * pieces, 2)] for half in (0, 1)
            ]
            given = shares if workers == 2 else [shares[0] + shares[1]]
            processes = [
                context.Process(target=work, args=(server.url, name, share, ready, gate)) for share in given
            ]
            for process in processes:
                process.start()
            for _ in processes:
                ready.acquire()
            begun = time.perf_counter()
            gate.set()
            for process in processes:
                process.join()
            taken = time.perf_counter() - begun
            if any(process.exitcode for process in processes):
                raise SystemExit("a worker failed")
            figures[f"workers_{workers}_pieces_s"] = round((2 * pieces - workers) / taken, 2)
    figures["ratio"] = round(figures["workers_2_pieces_s"] / figures["workers_1_pieces_s"], 2)
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--edges", type=int, default=100_000)
    parser.add_argument("--pieces", type=int, default=40)
    parser.add_argument("--postgresql", action="store_true", help="use a temporary PostgreSQL server")
    parser.add_argument("--workers", action="store_true", help="measure the rate of one and of two workers")
    given = parser.parse_args()
    if given.workers:
        figures = measure_workers(given.pieces)
    elif given.postgresql:
        with tempfile.TemporaryDirectory() as name, PostgresServer(Path(name)) as server:
            figures = measure(server.url, given.edges, given.pieces)
    else:
        figures = measure(None, given.edges, given.pieces)
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
