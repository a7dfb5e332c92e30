"""Cost of every route: memory above the resting memory of a web process, and processor time, with the largest inputs.

`python -m benchmarks.campaigns.costs [--only NAME ...] [--missing] [--write]`: an API process on PostgreSQL without
workers, so that jobs are added and not run, answers each operation of the API. An operation without a case is called
with the largest value of each of its parameters and the longest texts. Memory is that of the process. The exit status
is 1 if an answer is above `MEMORY_MIB` or `PROCESSOR_S`, or is an internal error.
`--write` enters the rows into the table of `docs/results/requests.md`; `--missing` measures operations without a row.
"""

import argparse
import io
import json
import os
import re
import sys
import tempfile
import time
import urllib.parse
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks._ground_service import processor_s, resident_mib
from benchmarks._servers import Deployment, PostgresServer
from benchmarks.ground import START, definition, mixed_downlink
from ground_service.evaluation.service import make_report
from ground_service.ground import open_ground
from ground_service.ingest.service import ingest_file
from ground_service.store.database import prepare_database
from lunar.catalogue import ROWS_LIMIT
from lunar.constants import DAY_NS, GM_MOON_M3_S2, MOON_RADIUS_M
from lunar.ephemeris import ephemeris_from_states
from lunar.messages.oem import format_oem
from lunar.timescales import format_utc
from studies.harness.parts import Part

MEMORY_MIB, PROCESSOR_S = 256, 10.0
PAGE = Path(__file__).resolve().parents[2] / "docs" / "results" / "requests.md"
PACKETS, ROWS = 40_000, 100
NOT_MEASURED = "not measured: the last run was stopped before it"
MISSION = (
    'name = "largest"\n[spacecraft]\nid = 76\nname = "SelenITA"\n'
    '[camera]\nwidth_px = 512\nheight_px = 512\nfov_deg = 120.0\npointing = "nadir"\n'
)


@dataclass(frozen=True, slots=True)
class Cost:
    """Memory above the resting memory, memory that is kept, and processor time of a request."""

    operation: str
    what: str
    status: int
    memory_mib: float
    kept_mib: float
    processor_s: float
    detail: str = ""

    @property
    def fault(self) -> str:
        """Return why the answer breaks the rule; empty if it does not."""
        if self.status >= 500 and self.status not in (501, 503):
            return f"status {self.status}: {self.detail}"
        is_above = self.memory_mib > MEMORY_MIB or self.processor_s > PROCESSOR_S
        return f"above {MEMORY_MIB} MiB or {PROCESSOR_S:.0f} s" if is_above else ""

    def cells(self) -> str:
        """Return the cells of a row of the table."""
        figures = f"{self.memory_mib:.0f} | {self.kept_mib:.0f} | {self.processor_s:.1f}"
        return f"| `{self.operation}` | {self.what} | {self.status} | {figures} |"


def at(days: float) -> str:
    """Return a time after the start of the pass."""
    return format_utc(START + int(days * DAY_NS), 0)


def circle(states: int, step_s: float) -> bytes:
    """Return an OEM of a circular orbit."""
    utc_ns = START - DAY_NS + (np.arange(states) * step_s * 1e9).astype(np.int64)
    radius = MOON_RADIUS_M + 30e3
    rate = np.sqrt(GM_MOON_M3_S2 / radius**3)
    angle = (rate * (utc_ns - START) / 1e9)[:, None]
    across, along = np.array([0.0, 0.6, 0.8]), np.array([1.0, 0.0, 0.0])
    position = radius * (np.cos(angle) * along + np.sin(angle) * across)
    velocity = radius * rate * (np.cos(angle) * across - np.sin(angle) * along)
    return format_oem(ephemeris_from_states(utc_ns, position, velocity, object_name="SelenITA")).encode()


def catalogue(rows: int) -> Iterator[bytes]:
    """Yield a crater catalogue."""
    yield b"id,latitude_deg,longitude_deg,diameter_m,depth_m\n"
    for k in range(rows):
        place = f"{k * 7919 % 1_780_001 / 1e4 - 89:.6f},{k * 104_729 % 3_599_999 / 1e4:.6f}"
        yield f"{k + 1},{place},{1000 + k % 3_000},0\n".encode()


def zipped(name: str, octets: bytes, **others: bytes) -> bytes:
    """Return a zip file of a file, and of others."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for one, content in {name: octets, **others}.items():
            archive.writestr(one, content)
    return made.getvalue()


def cases() -> list[tuple[str, str, str, Any]]:
    """Return operation, what is largest, path, and body (made when it is sent) of requests."""
    region = {"latitude_deg": {"min": -60.0, "max": 60.0}, "west_deg": 300.0, "east_deg": 40.0}
    terms = {"windows": 100, "period_days": 1.0, "regions": [region] * 50}
    ticks = [((1 << 40) + 65_536 * 60 * k, {"received": at(k / 1440)}) for k in range(9_000)]
    points = [time | {"ticks": one, "light_time_s": 1.3, "boot_count": 0} for one, time in ticks]
    times = [time | {"packet_ticks": one, "sequence_count": k} for k, (one, time) in enumerate(ticks)]
    link = '[[links]]\nname = "l{}"\nkind = "file"\ndownlink = "/nowhere"\n'
    words = "".join(f'{name} = "{"x" * 80}"\n' for name in map("e{}".format, range(10_000)))
    described = (MISSION + "".join(map(link.format, range(100))) + "[procedures]\n" + words).encode()
    span = {"spacecraft_id": 76, "start": at(0), "stop": at(31)}
    files = {f"images/{k}.png": {"sha256": f"{k:064x}", "bytes": 1} for k in range(15_000)}
    manifest = {"schema_version": 1, "pass_name": "p", "spacecraft_id": 76, "cadence_s": 15.0, "files": files}
    compared = {"candidate": "current", "archives": [f"{k:064x}" for k in range(14_000)]}
    command = {"name": "test_connection", "spacecraft_id": 76, "arguments": dict.fromkeys(map(str, range(60_000)))}
    listed = json.dumps(manifest).encode()
    formats = "oem oem-xml aem spk ck spice sclk fk ik geojson gpkg czml parquet netcdf csv tum images"
    kinds = [f"{kind}?format={one}" for kind in ("housekeeping", "detections") for one in ("json", "csv")]
    window = span | {"stop": at(0.4), "cadence_s": 0.1}
    bodies = {
        "256 MiB": lambda: iter([os.urandom(1 << 20)] * 256),
        "1 GiB": lambda: iter([os.urandom(1 << 20)] * 1024),
        "states": lambda: circle(800_000, 2.0),
        "line": lambda: b"X" * (96 << 20),
        "craters": lambda: b"".join(catalogue(ROWS_LIMIT)),
        "described": lambda: described,
        "mission": MISSION.encode,
        "pass": definition(PACKETS) | {"name": "again"},
        "span": span,
        "contacts": span | {"needs_contact": True, "minimum_battery": 0.3},
        "dense": span | {"craters_per_frame": 5.0},
        "window": window,
        "approved": {"state": "approved"},
        "request": {"name": "r", "spacecraft_id": 76, **terms},
        "terms": {"terms": terms},
        "points": {"points": points},
        "times": {"receptions": times},
        "command": command,
        "build": lambda: zipped("build.toml", b"", model=bytes(256 << 20)),
        "listed": lambda: zipped("manifest.json", listed),
        "compared": compared,
        "measured": {"reason": "measured"},
    }
    lines = CASES.format(rows=ROWS_LIMIT, start=at(0), later=at(8), end=at(31)).splitlines()
    rows = [(one, what, path, bodies.get(body)) for one, what, path, body in (line.split("|") for line in lines)]
    rows += [("export_pass", one, "exports", {"pass_id": 1, "format": one}) for one in formats.split()]
    rows += [("get_packets", f"10,000 {one}", f"passes/1/packets/{one}", None) for one in kinds]
    newest = "reports?" + "&".join(f"pass_id={k}" for k in range(1, 101))
    return [*rows, ("list_newest_reports", "100 passes", newest, None)]


CASES = """\
upload_archive|256 MiB|archives|256 MiB
upload_telemetry|1 GiB|telemetry?spacecraft_id=76|1 GiB
add_ephemeris|800,000 states|ephemerides|states
add_ephemeris|96 MiB in one line|ephemerides|line
add_catalogue|{rows:,} rows|catalogues|craters
add_mission|1 MiB, 100 links|missions|described
check_mission|1 MiB, 100 links|missions/check|described
check_mission|a plan|missions/check?plan=true|mission
define_pass||passes|pass
search_windows|31 days|windows/search|span
search_windows|with contacts|windows/search|contacts
search_windows|with craters|windows/search|dense
add_window|10 h at 10 Hz|windows|window
change_window|a draft|windows/1|approved
add_request|50 regions|requests|request
change_request|50 regions|requests/1|terms
add_correlations|9,000 points|spacecraft/76/correlations|points
add_receptions|9,000 times|spacecraft/76/receptions|times
get_forecast|8 days|plan/forecast?spacecraft_id=76&start={start}&stop={later}|
list_contacts|31 days|contacts?since={start}&until={end}|
enter_telecommand|60,000 arguments|telecommands|command
add_build|256 MiB|builds|build
keep_archive|15,000 files|regression-archives|listed
start_regression|14,000 archives|regressions|compared
start_analysis|14,000 archives|analyses|compared
withdraw_ingest|all packets|ingests/1/withdraw|measured"""
"""Operation, what is largest, path, and name of the body."""

VALUES: dict[str, Any] = {
    "spacecraft_id": 76, "estimator": "paper", "parameter": "temperature_c", "packet": "housekeeping",
    "month": "2029-08", "ticks": 1 << 40,
    "ephemeris_id": 99, "job_id": "0" * 32, "revision": "0" * 64, "sha256": "0" * 64, "window_id": 2,
    "name": "nobody", "digest": "0" * 64, "regression_id": "0" * 32, "report_id": "0" * 32, "start": at(-30),
    "stop": at(30), "unused_days": 1,
}  # fmt: skip
"""Values of parameters of the operations that have no case; those of others are 1."""


def derived(path: str, operation: Mapping[str, Any], schemas: Mapping[str, Any]) -> tuple[str, str, Any]:
    """Return the request of an operation with the largest values of its parameters and the longest texts."""
    query, values = {}, VALUES
    for one in operation.get("parameters", ()):
        name = one["name"]
        if one["in"] == "query" and (one.get("required") or name in ("limit", "max_points")):
            query[name] = values.get(name, one["schema"].get("maximum", 1))
    filled = re.sub(r"\{(\w+)\}", lambda found: urllib.parse.quote(str(values.get(found[1], 1))), path)
    body = None
    if content := operation.get("requestBody", {}).get("content"):
        named = content["application/json"]["schema"]["$ref"].rpartition("/")[2]
        fields = schemas[named]["properties"].items()
        body = {name: "x" * one["maxLength"] for name, one in fields if "maxLength" in one}
    what = "largest page" if "limit" in query else "longest texts" if body else ""
    return what, f"{filled}?{urllib.parse.urlencode(query)}", body


def measure(client: httpx.Client, part: Part, name: str, method: str, case: tuple[str, str, Any]) -> Cost:
    """Send a request and return what it costs."""
    what, path, body = case
    given = {"json": body} if isinstance(body, Mapping) else {"content": body() if callable(body) else body}
    Path(f"/proc/{part.pid}/clear_refs").write_text("5")  # the peak begins at the present memory
    resting, before = resident_mib(part, "VmRSS"), processor_s(part)
    answer = client.request(method, path, **given)
    spent, peak = processor_s(part) - before, resident_mib(part, "VmHWM") - resting
    until = time.monotonic() + 30.0
    while resident_mib(part, "VmRSS") > resting + 32 and time.monotonic() < until:
        time.sleep(0.1)
    detail = answer.text[:200] if answer.status_code >= 400 else ""
    return Cost(name, what, answer.status_code, peak, resident_mib(part, "VmRSS") - resting, spent, detail)


def table() -> dict[str, str]:
    """Return the rows of the page by operation and input."""
    rows = [line for line in PAGE.read_text().splitlines() if line.startswith("| `")]
    return {row.split("|", 3)[1] + row.split("|", 3)[2]: row for row in rows}


def weight(row: str) -> list[float]:
    """Return the order of a row: the dearest first, those that were not measured last."""
    return [-float(cell.replace("–", "-1")) for cell in row.split("|")[4:7:2]]


def measured(only: Sequence[str], but: Collection[str] = ()) -> Iterator[Cost]:
    """Yield the costs of all operations, or of some."""
    with tempfile.TemporaryDirectory(prefix="costs-") as name, PostgresServer(Path(name)) as server:
        folder, url = Path(name), server.url
        prepare_database(url, upgrade=True).engine.dispose()
        with Deployment(folder, url=url, LINNA_LINKS="false") as service:
            base = f"http://127.0.0.1:{service.ports[0]}/api/v1/"
            with httpx.Client(base_url=base, timeout=900.0) as client:
                client.post("missions", content=MISSION).raise_for_status()
                client.post("ephemerides", content=circle(50_000, 60.0)).raise_for_status()
                client.post("passes", json=definition(PACKETS)).raise_for_status()
                for k in range(1, ROWS):
                    body = {"spacecraft_id": 76, "start": at(k / 24), "stop": at((k + 0.1) / 24)}
                    client.post("windows", json=body).raise_for_status()
                    client.post("telecommands", json={"name": "test_connection", "spacecraft_id": 76})
                with open_ground(folder / "home", database_url=url) as ground:
                    downlink = folder / "all.cadu"
                    downlink.write_bytes(mixed_downlink(PACKETS))
                    ingest_file(ground, downlink, spacecraft_id=76)
                    VALUES["report_id"] = make_report(ground, 1).report_id
                part, document = service.parts["api 1"], client.get("openapi.json").json()
                schemas = document["components"]["schemas"]
                found = [
                    (one, m, path[8:]) for path, methods in document["paths"].items() for m, one in methods.items()
                ]
                found.sort(key=lambda one: (one[0]["operationId"] == "withdraw_ingest", one[1] == "delete"))
                for described, method, path in found:
                    operation = described["operationId"]
                    mine = [one[1:] for one in cases() if one[0] == operation]
                    for case in mine or [derived(path, described, schemas)]:
                        if (not only or operation in only) and operation not in but:
                            cost = measure(client, part, operation, method, case)
                            if cost.fault and cost.status == 200:  # the first answer may compile kernels
                                cost = measure(client, part, operation, method, case)
                            yield cost


def main(words: Sequence[str] | None = None) -> int:
    """Run the campaign; 1 if a request costs more than the rule allows."""
    parser = argparse.ArgumentParser(prog="costs", description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", default=(), metavar="OPERATION")
    parser.add_argument("--missing", action="store_true", help="measure operations without a row")
    parser.add_argument("--write", action="store_true", help=f"enter the rows into {PAGE.name}")
    given = parser.parse_args(words)
    rows, are_faulty = table(), False
    known = {key.split("`")[1] for key, row in rows.items() if NOT_MEASURED not in row}
    for one in measured(given.only, known if given.missing else ()):
        are_faulty |= bool(one.fault)
        print(one.cells(), one.fault, one.detail, flush=True)
        if given.write:
            rows.pop(f" `{one.operation}`  {NOT_MEASURED} ", None)
            rows[f" `{one.operation}`  {one.what} "] = one.cells()
            shown = sorted(rows.values(), key=weight)
            head = PAGE.read_text().split("|---")[0]
            PAGE.write_text(f"{head}|---|---|---|---|---|---|\n" + "\n".join(shown) + "\n")
    return int(are_faulty)


if __name__ == "__main__":
    sys.exit(main())
