"""Position errors of reports, worked out again without any code of this project.

    python -m benchmarks.recomputation FOLDER SEED

FOLDER holds a mission run (`FOLDER/ground`) whose mission description states the lunar orientation DE421. Latitude,
longitude and altitude come from the octets of the stored packets by the layouts of the ICD, the reference from its OEM
file, the orientation of the Moon from SPICE (kernels in `LINNA_DATA`). Printed is the largest relative difference to
the statistics of five reports, drawn by the seed: median, 95th percentile, maximum and end of pass.
"""

import json
import os
import random
import sqlite3
import struct
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import spiceypy
from numpy.typing import NDArray
from scipy.interpolate import KroghInterpolator

REPORTS = 5
APID, SERVICE = 0x0A2, b"\x81\x02"
NAVIGATION_STATE = struct.Struct(">20xIQBBddd")
TICKS_PER_S = 65_536
ESTIMATORS = ("paper", "spherical", "anchored")
RADIUS_M = 1_737_400.0
J2000_TAI_S = -946_727_930.816
"""TDB seconds past J2000 less UTC seconds past 1970, to 2 ms: 37 leap seconds, TT less TAI 32.184 s."""

ROUNDING_NS = 1_000_000
FITTED = 8
"""States of an OEM around the wanted time, through which with their velocities one polynomial goes."""


Segment = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Times (n,) in ns, UTC, and positions and velocities (n, 2, 3) in m and m/s."""


def segments_of(oem: str) -> list[Segment]:
    """Return the segments of an OEM with UTC times."""
    found = []
    for segment in oem.split("META_STOP")[1:]:
        lines = segment.partition("META_START")[0].splitlines()
        rows = [line.split() for line in lines if line[:2] == "20"]
        values = np.array([[float(one) * 1e3 for one in row[1:7]] for row in rows]).reshape(-1, 2, 3)
        found.append((np.array([_utc_ns(row[0]) for row in rows]), values))
    return found


def position_m(segments: list[Segment], utc_ns: int) -> NDArray[np.float64]:
    """Return the position (3,) in m at a time."""
    for times, states in segments:
        if times[0] <= utc_ns <= times[-1]:
            first = min(max(int(np.searchsorted(times, utc_ns)) - FITTED // 2, 0), len(times) - FITTED)
            here = slice(max(first, 0), max(first, 0) + FITTED)
            nodes = np.repeat((times[here] - utc_ns) * 1e-9, 2)
            return np.asarray(KroghInterpolator(nodes, states[here].reshape(-1, 3))(0.0))
    raise ValueError("expected an OEM that contains the time, found none")


def _utc_ns(text: str) -> int:
    whole, _, part = text.rstrip("Z").partition(".")
    seconds = int(datetime.fromisoformat(whole).replace(tzinfo=UTC).timestamp())
    return seconds * 10**9 + int(f"{part:0<9}")


def _errors_m(home: Path, database: sqlite3.Connection, report: dict[str, Any]) -> dict[str, list[float]]:
    """Return the errors of each estimator in the order of the images."""
    digits = report["provenance"]["reference ephemeris"].rpartition(" ")[2]
    (file,) = home.glob(f"files/*/{digits}*")
    reference = segments_of(file.read_text())
    lines = "SELECT start_ticks, stop_ticks, reference_ticks, reference_utc_ns, drift_ppb FROM correlations"
    correlations = database.execute(f"{lines} WHERE superseded = 0").fetchall()
    start, stop = report["span"]["start_utc_ns"], report["span"]["stop_utc_ns"]
    found: dict[str, list[float]] = {name: [] for name in ESTIMATORS}
    for (octets,) in database.execute("SELECT octets FROM packets WHERE apid = ? ORDER BY ticks", (APID,)):
        if octets[7:9] != SERVICE:
            continue
        _, ticks, number, _, latitude, longitude, altitude = NAVIGATION_STATE.unpack_from(octets)
        line = min(correlations, key=lambda one: max(one[0] - ticks, ticks - one[1], 0))
        utc_ns = line[3] + round((ticks - line[2]) / TICKS_PER_S * 1e9 * (1.0 + 1e-9 * line[4]))
        if start - ROUNDING_NS <= utc_ns <= stop + ROUNDING_NS and np.isfinite(latitude):
            fixed = spiceypy.latrec(RADIUS_M + altitude, *np.radians([longitude, latitude]))
            turned = spiceypy.pxform("MOON_ME", "J2000", utc_ns * 1e-9 + J2000_TAI_S) @ fixed
            found[ESTIMATORS[number]].append(float(np.linalg.norm(turned - position_m(reference, utc_ns))))
    return found


def _statistics(errors: list[float]) -> dict[str, float]:
    names = {"median_3d_m": 50, "p95_3d_m": 95, "max_3d_m": 100}
    found = {name: float(np.percentile(errors, share)) for name, share in names.items()}
    return found | {"end_of_pass_m": errors[-1]}


def main(folder: str, seed: str) -> int:
    home = Path(folder) / "ground"
    for kernel in ("moon_pa_de421_1900-2050.bpc", "moon_080317.tf"):
        spiceypy.furnsh(f"{os.environ['LINNA_DATA']}/kernels/{kernel}")
    database = sqlite3.connect(f"file:{home}/linna.db?mode=ro", uri=True)
    paths = sorted(home.glob("reports/pass-*/report.json"))
    for path in random.Random(int(seed)).sample(paths, REPORTS):
        report = json.loads(path.read_text())
        errors = _errors_m(home, database, report)
        for series in report["navigation"]:
            if series["name"] in errors:
                again = _statistics(errors[series["name"]])
                different = max(abs(one / series["statistics"][name] - 1.0) for name, one in again.items())
                print(path.parent.name, series["name"], f"{different:.1e}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
