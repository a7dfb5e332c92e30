"""Simulated year of passes in a PostgreSQL database: python -m benchmarks.year [--passes-a-day 28].

One pass of a scenario is emulated, imported and reported by the service. The database then copies the rows of this
pass, as passes of one spacecraft (28 a day), with times, ids, counts and hashes of their own. Before the
first copy and after each quarter, the service itself reads, ingests and reports; this is timed, by the clock and as
processor time of the service and of PostgreSQL, which other work on the machine changes less. Files are not copied.
Of roll-ups that several passes share, copies do not add to the values. PostgreSQL runs without `fsync`.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import Column, Connection, Table, text

from benchmarks.capacity import database_octets, named_copy
from benchmarks.ground import mixed_downlink
from ground_service.access.service import add_user
from ground_service.app import create_app
from ground_service.ground import Ground, open_ground
from ground_service.ingest.service import ingest_file
from ground_service.jobs.service import enter_job
from ground_service.passes.archive_import import import_archive
from ground_service.settings import Settings
from ground_service.store import models
from ground_service.store.database import prepare_database
from ground_service.store.rollups import BASE_TICKS
from ground_service.worker.jobs import run_job
from lunar.datafolder import find_data
from payload_emulator.session.emulator import emulate
from payload_emulator.session.scenario import load_scenario
from studies.harness.parts import Part, PostgresServer
from studies.harness.usage import family_cpu_s

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from fastapi.testclient import TestClient

STEP_S = 1_024
"""The time between passes is a multiple of the three shortest buckets of the roll-ups."""
S = 1_000_000_000
BLOCK = 100
QUARTERS = 4

COPIED = (
    "files", "ingests", "pieces", "packets", *(table.name for table in models.SAMPLE_TABLES), "rollups",
    "passes", "jobs", "reports", "event_log",
)  # fmt: skip
SERIAL = {"packet_id": "packets", "pass_id": "passes", "ingest_id": "ingests"}
"""Columns with the number of a row of a copied table."""
OWN_FILES = "SELECT html_sha256 FROM reports UNION SELECT json_sha256 FROM reports UNION SELECT pdf_sha256 FROM reports"
SHARED_HASHES = ("catalogue_sha256", "attitude_sha256", "file_sha256")
"""Columns with hashes of files that are the same for all passes: the copies have the downlink of the first pass."""

READS = (
    "/passes", "/passes/{pass}", "/passes/{pass}/completeness", "/passes/{pass}/events?limit=50",
    "/passes/{pass}/detections?limit=50", "/passes/{pass}/states?max_points=500",
    "/passes/{pass}/telemetry/power_w?max_points=500", "/jobs", "/ingests", "/spacecraft/{spacecraft}/trends",
    "/spacecraft/{spacecraft}/correlations",
)  # fmt: skip


class Year:
    """Database with the rows of one pass, which it copies."""

    def __init__(self, ground: Ground, period_s: int) -> None:
        self._ground, self._period_s = ground, period_s
        self.passes = 1
        self.rows: dict[str, int] = {}
        self._serial: dict[str, tuple[int, int]] = {}
        with ground.database.writing() as connection:
            connection.execute(text("UPDATE vehicles SET instance = 'flight'"))
            for name in COPIED:
                where = f"WHERE sha256 IN ({OWN_FILES})" if name == "files" else ""
                connection.execute(text(f"CREATE TABLE one_{name} AS SELECT * FROM {name} {where}"))
                self.rows[name] = _number(connection, f"SELECT count(*) FROM one_{name}")
            for name in (*SERIAL.values(), "event_log"):
                least, count = (
                    _number(connection, f"SELECT coalesce({one}, 0) FROM one_{name}")
                    for one in ("min(id)", "max(id) - min(id) + 1")
                )
                self._serial[name] = (least, count)
            self._frames = _number(connection, "SELECT count(DISTINCT frame_number) FROM one_detections")

    @property
    def span_ns(self) -> int:
        """Time from the first to the last pass."""
        return (self.passes - 1) * self._period_s * S

    def copy(self, passes: int) -> None:
        """Add copies of the pass."""
        for start in range(0, passes, BLOCK):
            with self._ground.database.writing() as connection:
                values = {
                    "first": self.passes,
                    "last": self.passes + min(BLOCK, passes - start) - 1,
                    **{
                        f"next_{name}": _number(connection, f"SELECT max(id) + 1 FROM {name}")
                        for name in self._serial
                        if self.rows[name]
                    },
                }
                for name in COPIED:
                    connection.execute(text(self._statement(models.METADATA.tables[name])), values)
            self.passes = values["last"] + 1
        with self._ground.database.writing() as connection:
            for name in self._serial:
                sequence = _text(connection, f"SELECT pg_get_serial_sequence('{name}', 'id')")
                if sequence:
                    connection.execute(
                        text(f"SELECT setval('{sequence}', (SELECT coalesce(max(id), 1) FROM {name}))")
                    )
            # What copies report has been handled.
            connection.execute(
                text("UPDATE event_positions SET number = (SELECT max(id) FROM event_log)"),
            )
            connection.execute(text("UPDATE alarm_positions SET packet_id = (SELECT max(id) FROM packets)"))
            connection.execute(text("ANALYZE"))

    def _statement(self, table: Table) -> str:
        names = ", ".join(f'"{column.name}"' for column in table.columns)
        values = ", ".join(self._value(table, column) for column in table.columns)
        return (
            f"INSERT INTO {table.name} ({names}) SELECT {values} "
            f"FROM generate_series(CAST(:first AS int8), :last) AS k "
            f"CROSS JOIN one_{table.name} AS t ORDER BY k ON CONFLICT DO NOTHING"
        )

    def _value(self, table: Table, column: Column[Any]) -> str:
        """Return the value of a column in copy `k` as SQL."""
        name, value = column.name, f't."{column.name}"'
        serial = SERIAL.get(name) or (table.name if name == "id" and table.name in self._serial else None)
        if serial is not None:
            least, count = self._serial[serial]
            return f"{value} - {least} + :next_{serial} + (k - CAST(:first AS int8)) * {count}"
        if name.endswith("ticks"):
            return f"CASE WHEN {value} < 0 THEN {value} ELSE {value} + k * {self._period_s << 16} END"
        if name.endswith("utc_ns"):
            return f"{value} + k * {self._period_s * S}"
        if name == "bucket":
            return f"{value} + k * {self._period_s << 16} / ({BASE_TICKS} * (4 ^ t.level)::int8)"
        if name == "sequence_count":
            return f"({value} + k * {self._frames}) % 16384"
        if name == "frame_number" and table.name != "events":
            return f"{value} + k * {self._frames}"
        if name == "digest":
            return f"decode(md5({value}::text || k), 'hex')"
        if name == "id":
            return f"md5({value} || k)"
        if "sha256" in name or name == "archive_digest":
            return value if name in SHARED_HASHES else f"md5({value} || k) || md5(k || {value})"
        return value


def _number(connection: Connection, query: str) -> int:
    return int(connection.execute(text(query)).scalar_one() or 0)


def _text(connection: Connection, query: str) -> str | None:
    found: str | None = connection.execute(text(query)).scalar_one()
    return found


def _milliseconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - began)


class Processor:
    """Processor time of this process and of the database server per item, ms."""

    def __init__(self, server: Part) -> None:
        self._server = server

    @contextmanager
    def per_item(self, items: int, into: dict[str, float]) -> Iterator[None]:
        """Note the processor time of a block that does `items` things."""
        service, database = time.process_time(), family_cpu_s(self._server.pid) or 0.0
        yield
        into["service_cpu_ms"] = round(1e3 * (time.process_time() - service) / items, 2)
        into["database_cpu_ms"] = round(1e3 * ((family_cpu_s(self._server.pid) or 0.0) - database) / items, 2)


def _p95(values: list[float]) -> float:
    return round(float(np.percentile(values, 95)), 1)


def read_times(
    settings: Settings, token: str, spacecraft: int, rounds: int, processor: Processor
) -> tuple[dict[str, list[float]], dict[str, float]]:
    """Return the times of the reads in ms, and the processor time of a read; each round reads another pass."""
    spent: dict[str, float] = {}
    times: dict[str, list[float]] = {path: [] for path in READS}
    headers = {"Authorization": f"Bearer {token}"}
    app = create_app(settings, inline_jobs=True)
    with TestClient(app, base_url="http://127.0.0.1:8042", headers=headers) as client:
        newest = client.get("/api/v1/passes?limit=200&instance=flight").raise_for_status().json()["items"]
        found = [one["id"] for one in newest]
        chosen = random.Random(1)

        def read(path: str) -> float:
            url = "/api/v1" + path.format_map({"pass": chosen.choice(found), "spacecraft": spacecraft})
            return _milliseconds(lambda: client.get(url).raise_for_status())

        for path in READS:  # loads and compiles
            read(path)
        with processor.per_item(rounds * len(READS), spent):
            for _ in range(rounds):
                for path in READS:
                    times[path].append(read(path))
    return times, spent


class Measured:
    """Work of the service on the growing database."""

    def __init__(
        self, ground: Ground, settings: Settings, archive: Path, folder: Path, processor: Processor
    ) -> None:
        self._processor = processor
        self._ground, self._settings, self._archive, self._folder = ground, settings, archive, folder
        self._token = add_user(ground, "ann", "operator")
        self._done = 0

    def whole_pass(self) -> float:
        """Import and report a pass; return the time in s."""
        self._done += 1
        copy = named_copy(self._archive, self._folder, self._done)
        began = time.perf_counter()
        pass_id = import_archive(self._ground, copy)
        run_job(self._ground, enter_job(self._ground, "report", {"pass_id": pass_id}))
        shutil.rmtree(copy)
        return time.perf_counter() - began

    def ingest_times(
        self, spacecraft: int, after_utc_ns: int, files: int
    ) -> tuple[list[float], dict[str, float]]:
        """Return the times in ms in which new packets are ingested, and the processor time of a file."""
        spent: dict[str, float] = {}
        paths = [self._folder / f"new-{number}.cadu" for number in range(files)]
        for number, path in enumerate(paths):
            path.write_bytes(mixed_downlink(1_440, after_utc_ns + number * 60 * S))
        with self._processor.per_item(files, spent):
            times = [
                _milliseconds(lambda path=path: ingest_file(self._ground, path, spacecraft_id=spacecraft))
                for path in paths
            ]
        for path in paths:
            path.unlink()
        return times, spent

    def figures(self, year: Year, spacecraft: int, stop_utc_ns: int, rounds: int) -> dict[str, Any]:
        """Return the figures of the database at its present size."""
        after = stop_utc_ns + year.span_ns + 300 * S
        ingest, ingest_cpu = self.ingest_times(spacecraft, after, rounds)
        pass_cpu: dict[str, float] = {}
        with self._processor.per_item(2, pass_cpu):
            whole = [self.whole_pass() for _ in range(2)]
        reads, read_cpu = read_times(self._settings, self._token, spacecraft, rounds, self._processor)
        slowest = max(reads, key=lambda path: float(np.median(reads[path])))
        return {
            "passes": year.passes,
            "database_gb": round(database_octets(self._ground) / 1e9, 2),
            "reads_p50_ms": round(float(np.median([one for times in reads.values() for one in times])), 1),
            "reads_p95_ms": _p95([one for times in reads.values() for one in times]),
            **{f"read_{name}": value for name, value in read_cpu.items()},
            "slowest_read": f"{slowest}: {np.median(reads[slowest]):.1f} ms",
            "ingest_p50_ms": round(float(np.median(ingest)), 1),
            "ingest_p95_ms": _p95(ingest),
            **{f"ingest_{name}": value for name, value in ingest_cpu.items()},
            "import_and_report_s": round(float(np.mean(whole)), 2),
            **{f"import_and_report_{name}": value for name, value in pass_cpu.items()},
            "load_average": round(os.getloadavg()[0], 1),
        }


def simulate(
    folder: Path, server: PostgresServer, archive: Path, passes_a_day: float, days: float, rounds: int
) -> dict[str, Any]:
    """Fill a database with passes; return the figures before the first copy and after each quarter."""
    data = find_data(os.environ.get("LINNA_DATA") or None)
    home, url = folder / "home", server.url
    prepare_database(url, upgrade=True).engine.dispose()
    settings = Settings(home=home, database_url=url, data=data.root, allow_database_owner=True)
    with open_ground(home, data, database_url=url) as ground:
        measured = Measured(ground, settings, archive, folder, Processor(server.part))
        measured.whole_pass()
        with ground.database.reading() as connection:
            spacecraft = _number(connection, "SELECT ccsds_id FROM vehicles")
            stop = _number(connection, "SELECT stop_utc_ns FROM passes")
        period_s = max(round(86_400 / passes_a_day / STEP_S), 1) * STEP_S
        year = Year(ground, period_s)
        print(json.dumps({"rows_of_a_pass": year.rows}), file=sys.stderr, flush=True)
        sizes = [measured.figures(year, spacecraft, stop, rounds)]
        print(json.dumps(sizes[-1]), file=sys.stderr, flush=True)
        each = max(round(days * 86_400 / period_s / QUARTERS), 1)
        for _ in range(QUARTERS):
            before = database_octets(ground)
            began = time.perf_counter()
            year.copy(each)
            copying_s = time.perf_counter() - began
            per_pass = (database_octets(ground) - before) / each
            sizes.append(
                {
                    **measured.figures(year, spacecraft, stop, rounds),
                    "database_octets_per_pass": round(per_pass),
                    "copying_s": round(copying_s, 1),
                }
            )
            print(json.dumps(sizes[-1]), file=sys.stderr, flush=True)
    return {"passes_a_day": round(86_400 / period_s, 1), "rows_of_a_pass": year.rows, "quarters": sizes}


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenario", default="selenita", help="scenario of the copied pass")
    parser.add_argument(
        "--archive", type=Path, help="archive of the copied pass; default: emulate the scenario"
    )
    parser.add_argument("--passes-a-day", type=float, default=28.0)
    parser.add_argument("--days", type=float, default=365.25, help="simulated time")
    parser.add_argument("--rounds", type=int, default=20, help="reads of each kind, and ingested files")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryDirectory() as server_name:
        archive = given.archive
        if archive is None:
            archive = Path(name) / "archive"
            emulate(load_scenario(given.scenario), find_data(os.environ.get("LINNA_DATA") or None), archive)
        with PostgresServer(Path(server_name)) as server:
            figures = simulate(Path(name), server, archive, given.passes_a_day, given.days, given.rounds)
    print(json.dumps({"year": figures}, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
