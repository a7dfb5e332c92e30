"""Cost of every route: memory above the resting memory of a web process, and processor time, with the largest inputs.

`python -m benchmarks.campaigns.costs [--only NAME ...] [--write]`: an API process on PostgreSQL without workers, so
that jobs are added and not run, answers each operation of the API and each page. An operation without a case is
called with the largest value of each of its parameters, and one that the table of values does not know is an error.
Memory is anonymous memory of the process, processor time with that of its ended children. The exit status is 1 if an
answer is above `MEMORY_MIB` or `PROCESSOR_S`, or is no answer of the expected kind. `--write` stores the table in
`docs/results/requests.md`.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import sys
import tempfile
import threading
import time
import urllib.parse
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks._servers import PostgresServer
from benchmarks.campaigns._deployment import ManyApis
from benchmarks.ground import START, definition, mixed_downlink
from ground_service.access.service import add_user
from ground_service.contacts.commanding.service import enter_command
from ground_service.evaluation.service import make_report
from ground_service.ground import Ground, open_ground
from ground_service.ingest.service import ingest_file
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.service import add_mission
from ground_service.passes.service import define_pass
from ground_service.planning.model import WindowEntry
from ground_service.planning.service import add_window
from ground_service.store.database import prepare_database
from lunar.catalogue import ROWS_LIMIT
from lunar.constants import GM_MOON_M3_S2, MOON_RADIUS_M
from lunar.ephemeris import ephemeris_from_states
from lunar.messages.oem import format_oem
from lunar.timescales import format_utc, parse_utc

MEMORY_MIB = 256
PROCESSOR_S = 10.0
PAGE = Path(__file__).resolve().parents[2] / "docs" / "results" / "requests.md"
PACKETS = 40_000
ROWS = 100
MISSION = """
name = "largest"
[spacecraft]
id = 76
name = "SelenITA"
[camera]
width_px = 512
height_px = 512
fov_deg = 120.0
pointing = "nadir"
"""
DAY_NS = 86_400 * 10**9


@dataclass(frozen=True, slots=True)
class Case:
    """A request: what is largest about it, path with query, and body."""

    what: str
    path: str
    body: bytes | Callable[[], bytes | Iterator[bytes]] | Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Cost:
    """Memory above the resting memory, processor time, and memory kept ten seconds after the answer."""

    operation: str
    what: str
    status: int
    memory_mib: float
    kept_mib: float
    processor_s: float
    wall_s: float
    detail: str = ""

    @property
    def fault(self) -> str:
        """Return why the answer breaks the rule; empty if it does not."""
        if self.status >= 500 and self.status not in (501, 503):
            return f"status {self.status}: {self.detail}"
        if self.memory_mib > MEMORY_MIB or self.processor_s > PROCESSOR_S:
            return f"above {MEMORY_MIB} MiB or {PROCESSOR_S:.0f} s"
        return ""


def circle(states: int, step_s: float, name: str = "SelenITA") -> bytes:
    """Return an OEM of a circular orbit."""
    utc_ns = START - DAY_NS + (np.arange(states) * step_s * 1e9).astype(np.int64)
    radius = MOON_RADIUS_M + 30e3
    angle = np.sqrt(GM_MOON_M3_S2 / radius**3) * (utc_ns - START) / 1e9
    across, along = np.array([0.0, 0.6, 0.8]), np.array([1.0, 0.0, 0.0])
    position = radius * (np.cos(angle)[:, None] * along + np.sin(angle)[:, None] * across)
    speed = np.sqrt(GM_MOON_M3_S2 / radius)
    velocity = speed * (np.cos(angle)[:, None] * across - np.sin(angle)[:, None] * along)
    return format_oem(ephemeris_from_states(utc_ns, position, velocity, object_name=name)).encode()


def catalogue(rows: int) -> Iterator[bytes]:
    """Yield a crater catalogue."""
    yield b"id,latitude_deg,longitude_deg,diameter_m,depth_m\n"
    for start in range(0, rows, 50_000):
        numbers = range(start, min(start + 50_000, rows))
        yield "".join(
            f"{k + 1},{k * 7919 % 1_780_001 / 1e4 - 89:.6f},{k * 104_729 % 3_599_999 / 1e4:.6f},{1000 + k % 3_000},0\n"
            for k in numbers
        ).encode()


def filling(octets: int) -> Callable[[], Iterator[bytes]]:
    """Return the blocks of a body of noise of a size."""
    block = np.random.default_rng(1).bytes(1 << 20)
    return lambda: (block for _ in range(octets >> 20))


def zipped(files: Mapping[str, bytes]) -> bytes:
    """Return a zip file."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name, octets in files.items():
            archive.writestr(name, octets)
    return made.getvalue()


def prepare(ground: Ground, folder: Path) -> dict[str, str]:
    """Fill the archive; return the tokens of an operator and an administrator."""
    add_mission(ground, MISSION.encode())
    add_ephemeris(ground, ground.files.put_octets(circle(50_000, 60.0)), name="reference")
    downlink = folder / "all.cadu"
    downlink.write_bytes(mixed_downlink(PACKETS))
    ingest_file(ground, downlink, spacecraft_id=76)
    whole = definition(PACKETS)
    span = {f"{name}_utc_ns": parse_utc(whole[name]) for name in ("start", "stop")}
    define_pass(ground, name="all", spacecraft_id=76, **span)
    for k in range(ROWS):
        start = START + (k + 1) * 3600 * 10**9
        add_window(ground, WindowEntry(f"w{k}", start, start + 600 * 10**9, 15.0, 76), actor="ann")
        enter_command(ground, "test_connection", {}, spacecraft_id=76, instance="flight", actor="ann")
    report = make_report(ground, 1).report_id
    return {"report": str(report), **{role: add_user(ground, role, role) for role in ("operator", "admin")}}


def at(days: float) -> str:
    """Return a time after the start of the pass."""
    return format_utc(START + int(days * DAY_NS), 0)


def archive() -> bytes:
    """Return a zipped pass archive of many files."""
    listed = {f"images/{k}.png": {"sha256": f"{k:064x}", "bytes": 1} for k in range(15_000)}
    manifest = {
        "schema_version": 1,
        "pass_name": "p",
        "spacecraft_id": 76,
        "start_utc": at(0),
        "stop_utc": at(0.1),
        "cadence_s": 15.0,
        "frames_expected": 0,
        "files": listed,
    }
    return zipped({"manifest.json": json.dumps(manifest).encode(), "noise": os.urandom(64 << 20)})


def build() -> bytes:
    """Return a zipped build with a large network."""
    return zipped({"build.toml": b'schema_version = 1\nname = "b"\n', "model.onnx": os.urandom(256 << 20)})


def cases() -> dict[str, list[Case]]:
    """Return the requests with the largest bodies, by operation."""
    region = {"latitude_deg": {"min": -60.0, "max": 60.0}, "west_deg": 300.0, "east_deg": 40.0}
    points = [
        {"ticks": (1 << 40) + 65_536 * 60 * k, "received": at(k / 1440), "light_time_s": 1.3, "boot_count": 0}
        for k in range(9_000)
    ]
    many_keys = MISSION + "".join(
        f'[[links]]\nname = "l{k}"\nkind = "file"\ndownlink = "/nowhere/{k}"\n' for k in range(14_000)
    )
    formats = ("oem", "oem-xml", "aem", "spk", "ck", "spice", "sclk", "fk", "ik", "geojson", "gpkg", "czml")
    formats += ("parquet", "netcdf", "csv", "tum", "images")
    search = {"spacecraft_id": 76, "start": at(0), "stop": at(31), "step_s": 30.0}
    window = {"spacecraft_id": 76, "start": at(20), "stop": at(20.4), "cadence_s": 0.1}
    terms = {"windows": 100, "period_days": 1.0, "regions": [region] * 50}
    request = {"name": "r", "spacecraft_id": 76, **terms}
    receptions = [{"ticks": one["ticks"], "received": one["received"]} for one in points]
    entered = {
        "name": "test_connection",
        "spacecraft_id": 76,
        "arguments": {f"k{k}": k for k in range(60_000)},
    }
    compared = {
        "candidate": "current",
        "baseline": "current",
        "archives": [f"{k:064x}" for k in range(14_000)],
    }
    contacts = {**search, "needs_contact": True, "minimum_battery": 0.3}
    return {
        "upload_archive": [Case("256 MiB", "archives", filling(256 << 20))],
        "upload_telemetry": [Case("1 GiB", "telemetry?spacecraft_id=76", filling(1 << 30))],
        "add_ephemeris": [
            Case("800,000 states, 96 MiB", "ephemerides", lambda: circle(800_000, 2.0)[: 96 << 20]),
            Case("96 MiB in one line", "ephemerides", lambda: b"X" * (96 << 20)),
        ],
        "add_catalogue": [Case(f"{ROWS_LIMIT:,} rows", "catalogues", lambda: catalogue(ROWS_LIMIT))],
        "add_mission": [Case("1 MiB, 14,000 links", "missions", many_keys.encode()[: 1 << 20])],
        "check_mission": [
            Case("1 MiB, 14,000 links", "missions/check", many_keys.encode()[: 1 << 20]),
            Case("a plan", "missions/check?plan=true", MISSION.encode()),
        ],
        "define_pass": [Case("31 days", "passes", {**definition(PACKETS), "name": "again"})],
        "export_pass": [Case(one, "exports", {"pass_id": 1, "format": one}) for one in formats],
        "search_windows": [
            Case("31 days", "windows/search", search),
            Case("31 days, contacts", "windows/search", contacts),
            Case("craters", "windows/search", {**search, "craters_per_frame": 5.0}),
        ],
        "add_window": [Case("10 h at 10 Hz", "windows", window)],
        "change_window": [Case("a draft", "windows/1", {"state": "approved"})],
        "add_request": [Case("50 regions", "requests", request)],
        "change_request": [Case("50 regions", "requests/1", {"terms": terms})],
        "add_correlations": [Case("9,000 points", "spacecraft/76/correlations", {"points": points})],
        "add_receptions": [Case("9,000 times", "spacecraft/76/receptions", {"receptions": receptions})],
        "get_forecast": [Case("8 days", f"plan/forecast?spacecraft_id=76&start={at(0)}&stop={at(8)}")],
        "list_contacts": [Case("31 days", f"contacts?since={at(0)}&until={at(31)}")],
        "enter_telecommand": [Case("1 MiB", "telecommands", entered)],
        "add_build": [Case("256 MiB", "builds", build)],
        "keep_archive": [Case("15,000 files", "regression-archives", archive)],
        "start_regression": [Case("14,000 archives", "regressions", compared)],
        "start_analysis": [Case("14,000 archives", "analyses", compared)],
        "get_packets": [
            Case(f"{PACKETS // 4:,} packets as {one}", f"passes/1/packets/{kind}?format={one}")
            for kind in ("housekeeping", "detections") for one in ("json", "csv")
        ],
        "change_handover": [Case("a note", "spacecraft/76/handover", {"note": "x" * 1000})],
        "hold_spacecraft": [Case("a hold", "spacecraft/76/hold", {"reason": "measured"})],
        "withdraw_ingest": [Case("all packets", "ingests/1/withdraw", {"reason": "measured"})],
        "list_newest_reports": [Case("100 passes", "reports?" + "&".join(f"pass_id={k}" for k in range(1, 100)))],
        "add_monthly_report": [Case("a month", "spacecraft/76/monthly-reports/2029-08")],
        "delete_kept_archives": [Case("all", "regression-archives?unused_days=1")],
    }  # fmt: skip


VALUES: dict[str, Any] = {
    "pass_id": 1, "spacecraft_id": 76, "estimator": "paper", "parameter": "temperature_c", "packet": "housekeeping",
    "ticks": 1 << 40, "frame_number": 1, "ingest_id": 1, "month": "2029-08", "landmark_id": 1, "ephemeris_id": 99,
    "job_id": "0" * 32, "revision": "0" * 64, "sha256": "0" * 64, "window_id": 2, "name": "nobody", "request_id": 1,
    "command_id": 1, "alarm_id": 1, "digest": "0" * 64, "regression_id": "0" * 32, "token_id": 999,
    "report_id": "0" * 32, "start": at(-30), "stop": at(30), "path": "site.css", "version": "1", "format": None,
}  # fmt: skip
"""Values of parameters of the operations that have no case."""
LAST = ("withdraw_ingest", "delete_kept_archives", "end_session")
"""Operations after all others."""


def derived(path: str, operation: Mapping[str, Any], values: Mapping[str, Any]) -> Case:
    """Return an operation with the largest values of its parameters."""
    query = {}
    for one in operation.get("parameters", ()):
        name, schema = one["name"], one["schema"]
        if one["in"] == "query" and (one.get("required") or name in ("limit", "max_points")):
            query[name] = values.get(name, schema.get("maximum"))
    filled = re.sub(r"\{(\w+)(?::path)?\}", lambda found: urllib.parse.quote(str(values[found[1]])), path)
    body = {} if "requestBody" in operation else None
    return Case("largest page" if "limit" in query else "", f"{filled}?{urllib.parse.urlencode(query)}", body)


class Watch:
    """Anonymous memory of a process, and processor time with that of its ended children."""

    def __init__(self, pid: int) -> None:
        self.pid = pid

    def memory_mib(self) -> float:
        """Return the anonymous memory now."""
        lines = Path(f"/proc/{self.pid}/status").read_text().splitlines()
        return int(next(one for one in lines if one.startswith("RssAnon")).split()[1]) / 1024

    def processor_s(self) -> float:
        """Return the processor time so far, that of ended children included."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")

    @contextlib.contextmanager
    def peak(self) -> Iterator[list[float]]:
        """Sample the memory into the list while the context lasts."""
        samples, done = [self.memory_mib()], threading.Event()

        def watch() -> None:
            while not done.wait(0.01):
                samples.append(self.memory_mib())

        watcher = threading.Thread(target=watch)
        watcher.start()
        try:
            yield samples
        finally:
            done.set()
            watcher.join()


def measure(client: httpx.Client, watch: Watch, name: str, method: str, case: Case) -> Cost:
    """Send a request and return what it costs."""
    body: Any = case.body() if callable(case.body) else case.body
    given = {"json": body} if isinstance(body, Mapping) else {"content": body}
    resting, before, clock = watch.memory_mib(), watch.processor_s(), time.perf_counter()
    with watch.peak() as samples:
        answer = client.request(method, case.path, **given)
    wall = time.perf_counter() - clock
    spent = watch.processor_s() - before
    until = time.monotonic() + 30.0
    while watch.memory_mib() > resting + 32 and time.monotonic() < until:
        time.sleep(0.1)
    detail = answer.text[:200] if answer.status_code >= 400 else ""
    return Cost(
        name, case.what, answer.status_code, max(samples) - resting, watch.memory_mib() - resting, spent, wall, detail
    )  # fmt: skip


def measured(only: Sequence[str]) -> Iterator[Cost]:
    """Yield the costs of all operations and pages."""
    with tempfile.TemporaryDirectory(prefix="costs-") as name:
        folder = Path(name)
        with PostgresServer(folder) as server:
            prepare_database(server.url, upgrade=True).engine.dispose()
            with open_ground(folder / "home", database_url=server.url) as ground:
                known = prepare(ground, folder)
            with ManyApis(folder, server.url, count=1) as service:
                watch = Watch(service.parts["api 1"].pid)
                base = f"http://127.0.0.1:{service.ports[0]}"
                headers = {"Authorization": f"Bearer {known['admin']}"}
                with httpx.Client(base_url=f"{base}/api/v1/", headers=headers, timeout=900.0) as client:
                    paths = client.get("openapi.json").json()["paths"]
                    client.get("status")
                    special = cases()
                    found = [
                        (one["operationId"], method.upper(), path.removeprefix("/api/v1/"), one)
                        for path, methods in paths.items()
                        for method, one in methods.items()
                    ]
                    found.sort(key=lambda one: (one[0] in LAST, one[1] == "DELETE"))
                    values = {**VALUES, "report_id": known["report"]}
                    unknown = set(special) - {one[0] for one in found}
                    if unknown:
                        raise SystemExit(f"cases of no operation: {', '.join(sorted(unknown))}")
                    for operation, method, path, described in found:
                        if only and operation not in only:
                            continue
                        for case in special.get(operation) or [derived(path, described, values)]:
                            cost = measure(client, watch, operation, method, case)
                            if cost.fault and cost.status == 200:  # the first answer may compile kernels
                                cost = measure(client, watch, operation, method, case)
                            yield cost


def table(costs: Sequence[Cost]) -> str:
    """Return the table, the largest first."""
    lines = [
        "| operation | input | status | memory, MiB | kept, MiB | processor, s |",
        "|---|---|---|---|---|---|",
    ]
    for one in sorted(costs, key=lambda one: (-one.memory_mib, -one.processor_s)):
        cells = (
            f"`{one.operation}`",
            one.what,
            str(one.status),
            f"{one.memory_mib:.0f}",
            f"{one.kept_mib:.0f}",
        )
        lines.append(f"| {' | '.join(cells)} | {one.processor_s:.1f} |")
    return "\n".join(lines)


def main(words: Sequence[str] | None = None) -> int:
    """Run the campaign; 1 if a request costs more than the rule allows."""
    parser = argparse.ArgumentParser(prog="costs", description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", default=(), metavar="OPERATION")
    parser.add_argument("--write", action="store_true", help=f"store the table in {PAGE.name}")
    given = parser.parse_args(words)
    costs = []
    for one in measured(given.only):
        costs.append(one)
        figures = f"{one.memory_mib:7.0f} MiB {one.kept_mib:6.0f} kept {one.processor_s:6.1f} s {one.wall_s:5.0f} wall"
        found = f"{figures}  {one.fault} {one.detail}"
        print(f"{one.operation:28} {one.what:26} {one.status} {found}", flush=True)
        if given.write:
            head = PAGE.read_text().split("| operation |")[0]
            PAGE.write_text(head + table(costs) + "\n")
    return int(any(one.fault for one in costs))


if __name__ == "__main__":
    sys.exit(main())
