"""Capacity plan: measured cost of a pass, packet and frame, extrapolated: python -m benchmarks.capacity.

One pass of a scenario is emulated. Copies of its archive, each with a name of its own, are imported and reported one
after the other, as passes of one spacecraft would be. The cost of a pass is the slope of a straight line through the
figures after each pass; `worst_residual_passes` is the largest distance of a figure from this line, in passes.
Processor time is that of the service; the server of PostgreSQL is measured by the clock only. The catalogue and the
reference ephemeris are the same for all passes and therefore stored once.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import text

from ground_service.evaluation.service import make_report
from ground_service.ground import Ground, open_ground
from ground_service.passes.archive_import import import_archive
from ground_service.store.database import prepare_database
from lunar.datafolder import find_data
from payload_emulator.session.emulator import emulate
from payload_emulator.session.scenario import load_scenario
from studies.harness.parts import PostgresServer

DAY_S = 86_400.0
YEAR_DAYS = 365.25
CADU_OCTETS = 1279
"""Attached sync marker and Reed-Solomon codeblock of the emulated link."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Cost of one pass: processor and wall time in seconds, growth of the database and of the files in octets."""

    cpu_s: float
    wall_s: float
    database_octets: float
    file_octets: float
    worst_residual_passes: float


@dataclass(frozen=True, slots=True)
class Offered:
    """What the machine of the plan offers: processor cores, disk of the database and of the archive in octets."""

    cores: float
    database_octets: float
    archive_octets: float


def slope(values: list[float]) -> tuple[float, float]:
    """Return the growth per pass of a figure measured after each pass, and the largest residual in passes."""
    passes = np.arange(1, len(values) + 1, dtype=float)
    growth, offset = np.polyfit(passes, np.array(values), 1)
    residual = np.max(np.abs(np.array(values) - growth * passes - offset))
    return float(growth), float(residual / growth) if growth > 0.0 else float("inf")


def database_octets(ground: Ground) -> int:
    """Return the size of the database."""
    if ground.database.dialect == "sqlite":
        with ground.database.reading() as connection:
            connection.execute(text("PRAGMA wal_checkpoint(TRUNCATE)"))
        return (ground.home / "linna.db").stat().st_size
    with ground.database.reading() as connection:
        return int(connection.execute(text("SELECT pg_database_size(current_database())")).scalar_one())


def file_octets(home: Path) -> int:
    """Return the octets of all files of the archive and of the reports."""
    found = (path for name in ("files", "reports") for path in (home / name).rglob("*"))
    return sum(path.stat().st_size for path in found if path.is_file())


def named_copy(archive: Path, folder: Path, number: int) -> Path:
    """Return a copy of an archive with the name of another pass.

    Its last CADU is repeated, so that the file of the downlink is another one and is stored.
    """
    copy = folder / f"pass-{number}"
    shutil.copytree(archive, copy)
    octets = (copy / "downlink.cadu").read_bytes()
    octets += number * octets[-CADU_OCTETS:]
    (copy / "downlink.cadu").write_bytes(octets)
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["pass_name"] = f"{manifest['pass_name']} {number}"
    manifest["files"]["downlink.cadu"] = {"sha256": hashlib.sha256(octets).hexdigest(), "bytes": len(octets)}
    (copy / "manifest.json").write_text(json.dumps(manifest))
    return copy


def measure(archive: Path, passes: int, folder: Path, database_url: str | None) -> Cost:
    """Import and report passes one after the other; return the cost of one."""
    home = folder / "home"
    names = ("cpu_s", "wall_s", "database_octets", "file_octets")
    figures: dict[str, list[float]] = {name: [] for name in names}
    data = find_data(os.environ.get("LINNA_DATA") or None)
    with open_ground(home, data, database_url=database_url) as ground:
        # The first pass also loads and compiles what all of them use.
        make_report(ground, import_archive(ground, named_copy(archive, folder, 0)))
        cpu, wall = time.process_time(), time.perf_counter()
        for number in range(1, passes + 1):
            copy = named_copy(archive, folder, number)
            make_report(ground, import_archive(ground, copy), pdf=True)
            figures["cpu_s"].append(time.process_time() - cpu)
            figures["wall_s"].append(time.perf_counter() - wall)
            figures["database_octets"].append(database_octets(ground))
            figures["file_octets"].append(file_octets(home))
            shutil.rmtree(copy)
    slopes = {name: slope(values) for name, values in figures.items()}
    worst = max(residual for _, residual in slopes.values())
    return Cost(**{name: growth for name, (growth, _) in slopes.items()}, worst_residual_passes=worst)


def plan(
    cost: Cost, passes_per_day: float, spacecraft: int, years: float, offered: Offered
) -> dict[str, Any]:
    """Extrapolate a cost; the first bottleneck is the resource that is used up first."""
    daily = passes_per_day * spacecraft
    days = years * YEAR_DAYS
    cores = daily * cost.cpu_s / DAY_S
    full_days = {
        "disk of the database": offered.database_octets / (daily * cost.database_octets),
        "disk of the archive": offered.archive_octets / (daily * cost.file_octets),
        "processor": 0.0 if cores > offered.cores else float("inf"),
    }
    first = min(full_days, key=lambda name: full_days[name])
    return {
        "spacecraft": spacecraft,
        "years": years,
        "passes": round(daily * days),
        "cores_busy": round(cores, 3),
        "database_gb": round(daily * days * cost.database_octets / 1e9, 1),
        "archive_gb": round(daily * days * cost.file_octets / 1e9, 1),
        "first_bottleneck": first if full_days[first] < days else "none within the time",
        "after_years": round(min(full_days[first] / YEAR_DAYS, 1e4), 2),
    }


def per_unit(cost: Cost, emulated: dict[str, Any]) -> dict[str, Any]:
    """Return the cost of one pass divided by its packets and frames."""
    found: dict[str, Any] = {"pass": {name: round(value, 3) for name, value in asdict(cost).items()}}
    for unit in ("packets", "frames"):
        count = emulated[unit]
        found[unit.removesuffix("s")] = {
            "cpu_ms": round(1e3 * cost.cpu_s / count, 3),
            "database_octets": round(cost.database_octets / count),
            "file_octets": round(cost.file_octets / count),
        }
    return found


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenario", default="selenita", help="scenario of the measured pass")
    parser.add_argument("--passes", type=int, default=6, help="number of measured passes")
    parser.add_argument(
        "--passes-per-day",
        type=float,
        default=27.0,
        help="of one spacecraft (27: every arc inside 60 degrees)",
    )
    parser.add_argument("--years", type=float, default=10.0)
    parser.add_argument("--cores", type=float, default=2.0, help="processor cores of the machine of the plan")
    parser.add_argument(
        "--disk-gb", type=float, default=2000.0, help="disk of the database, and of the archive"
    )
    parser.add_argument(
        "--database", choices=("sqlite", "postgresql"), nargs="+", default=["sqlite", "postgresql"]
    )
    given = parser.parse_args()
    offered = Offered(given.cores, given.disk_gb * 1e9, given.disk_gb * 1e9)
    data = find_data(os.environ.get("LINNA_DATA") or None)
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryDirectory() as server_name:
        folder = Path(name)
        made = emulate(load_scenario(given.scenario), data, folder / "archive")
        figures["emulated"] = {key: made[key] for key in ("frames", "packets")}
        for kind in given.database:
            place = folder / kind
            place.mkdir()
            if kind == "sqlite":
                cost = measure(folder / "archive", given.passes, place, None)
            else:
                with PostgresServer(Path(server_name)) as server:
                    prepare_database(server.url, upgrade=True).engine.dispose()
                    cost = measure(folder / "archive", given.passes, place, server.url)
            plans = [plan(cost, given.passes_per_day, count, given.years, offered) for count in (1, 100)]
            figures[kind] = {"cost": per_unit(cost, made), "plans": plans}
    print(json.dumps({"capacity": figures}, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
