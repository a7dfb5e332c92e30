"""Panels of the Grafana dashboard, drawn from the answers of Prometheus: python -m benchmarks.dashboard PICTURE.

A deployment on this machine reads, ingests and reports; Prometheus scrapes its API process every second. Each query of
`deploy/grafana/linna.json` is then answered by Prometheus and drawn by matplotlib, not by Grafana.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx
import yaml

from benchmarks._ground_service import READS
from benchmarks.campaigns._clients import cut_pieces
from benchmarks.campaigns._deployment import Deployment
from benchmarks.ground import definition, mixed_downlink
from ground_service.access.service import add_user
from ground_service.clock import utc_now_ns
from ground_service.errors import GroundError
from ground_service.ground import Ground, open_ground
from ground_service.ingest.service import ingest_file
from ground_service.jobs.service import enter_job
from ground_service.store import repository
from ground_service.worker.backup import backup
from ground_service.worker.jobs import run_job
from studies.harness.parts import Part, answers_http, free_port

DEPLOY = Path(__file__).resolve().parents[1] / "deploy"
PACKETS = 400


def panels() -> list[dict[str, Any]]:
    """Return the panels of the dashboard."""
    found: list[dict[str, Any]] = json.loads((DEPLOY / "grafana/linna.json").read_text())["panels"]
    return found


class Prometheus:
    """Prometheus with the configuration of the compose file, which scrapes API processes of this machine."""

    def __init__(self, folder: Path, api_ports: tuple[int, ...]) -> None:
        program = shutil.which("prometheus")
        if program is None:
            raise GroundError("expected prometheus on this machine, found none")
        settings = yaml.safe_load((DEPLOY / "prometheus/prometheus.yml").read_text())
        settings["global"] = {"scrape_interval": "1s", "evaluation_interval": "1s"}
        settings["rule_files"] = [str(DEPLOY / "prometheus/linna.rules.yml")]
        (service,) = (one for one in settings["scrape_configs"] if one["job_name"] == "linna")
        service["static_configs"] = [{"targets": [f"127.0.0.1:{port}" for port in api_ports]}]
        settings["scrape_configs"] = [service]
        configuration = folder / "prometheus.yml"
        configuration.write_text(yaml.safe_dump(settings))
        port = free_port()
        self._url = f"http://127.0.0.1:{port}"
        command = [program, f"--config.file={configuration}", f"--storage.tsdb.path={folder / 'prometheus'}"]
        command.append(f"--web.listen-address=127.0.0.1:{port}")
        self.part = Part(command, folder / "prometheus.log", lambda: answers_http(f"{self._url}/-/ready"))
        self.part.start()

    def query(self, expression: str) -> list[dict[str, Any]]:
        """Return the series that a query has now, without those that are not a number."""
        found = self._ask("query", query=expression)
        return [one for one in found if one["value"][1] != "NaN"]

    def series(self, expression: str, start_s: float, stop_s: float) -> list[dict[str, Any]]:
        """Return the series of a query over a time."""
        return self._ask("query_range", query=expression, start=start_s, end=stop_s, step=1)

    def _ask(self, what: str, **parameters: Any) -> list[dict[str, Any]]:
        answer = httpx.get(f"{self._url}/api/v1/{what}", params=parameters, timeout=30.0).json()
        if answer["status"] != "success":
            raise GroundError(f"{parameters['query']}: expected an answer, found {answer.get('error')}")
        result: list[dict[str, Any]] = answer["data"]["result"]
        return result


def fill(ground: Ground, folder: Path, backups: Path) -> None:
    """Store what a service has after some work: packets, a time correlation, a failed job and a backup."""
    stream = folder / "first.cadu"
    stream.write_bytes(mixed_downlink(PACKETS))
    vehicle = ingest_file(ground, stream, spacecraft_id=76).vehicle_id
    with ground.database.writing() as connection:
        repository.add(
            connection,
            repository.CORRELATIONS,
            vehicle_id=vehicle,
            method="constant",
            start_ticks=0,
            stop_ticks=1,
            reference_ticks=0,
            reference_utc_ns=0,
            drift_ppb=0.0,
            points=2,
            created_utc_ns=utc_now_ns(),
        )
    run_job(ground, enter_job(ground, "report", {"pass_id": 999}))
    backup(ground, backups / "first", now_utc_ns=utc_now_ns())


def draw(prometheus: Prometheus, start_s: float, stop_s: float, picture: Path) -> int:
    """Draw all panels; return the number of queries without data."""
    from matplotlib.figure import Figure

    rows = max(one["gridPos"]["y"] + one["gridPos"]["h"] for one in panels())
    figure = Figure(figsize=(16.0, 0.36 * rows), layout="constrained")
    grid = figure.add_gridspec(rows, 24)
    empty = 0
    for panel in panels():
        place = panel["gridPos"]
        axes = figure.add_subplot(
            grid[place["y"] : place["y"] + place["h"], place["x"] : place["x"] + place["w"]]
        )
        axes.set_title(panel["title"], fontsize=9, loc="left")
        axes.tick_params(labelsize=7)
        axes.set_xlabel("s", fontsize=7)
        for target in panel["targets"]:
            found = prometheus.series(target["expr"], start_s, stop_s)
            empty += not found
            for one in found:
                name = ", ".join(one["metric"].values()) or target.get("legendFormat", "")
                times, values = zip(
                    *((at - start_s, float(value)) for at, value in one["values"]), strict=True
                )
                axes.plot(times, values, label=name, linewidth=1.2)
        if axes.get_legend_handles_labels()[1]:
            axes.legend(fontsize=6, loc="upper left")
    figure.savefig(picture, dpi=100)
    return empty


def work(service: Deployment, token: str, seconds: float) -> None:
    """Read, upload and report."""
    until = time.monotonic() + seconds
    pieces = cut_pieces(mixed_downlink(20_000), 400, random.Random(3), "piece")
    headers = {"Authorization": f"Bearer {token}"}
    with httpx.Client(base_url=f"{service.api}/api/v1", headers=headers, timeout=60.0) as client:
        client.post("/passes", json=definition(PACKETS)).raise_for_status()
        for turn, piece in enumerate(pieces * 100):
            if time.monotonic() > until:
                break
            client.post(f"/telemetry?spacecraft_id=76&{piece.place}", content=piece.octets).raise_for_status()
            client.get(READS[turn % len(READS)])
            if turn % 20 == 0:
                client.post("/passes/1/reports")
            time.sleep(0.05)


def main() -> int:
    """Draw; 1 if a query has no data."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("picture", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        service = Deployment(folder, 1, LINNA_BACKUPS=str(folder / "backups"))
        try:
            with open_ground(service.home, database_url=service.url) as ground:
                token = add_user(ground, "ann", "operator")
                fill(ground, folder, folder / "backups")
            prometheus = Prometheus(folder, (int(service.api.rpartition(":")[2]),))
            service.parts["prometheus"] = prometheus.part
            began = time.time()
            work(service, token, given.seconds)
            empty = draw(prometheus, began, time.time(), given.picture)
        finally:
            service.stop()
    print(json.dumps({"dashboard": {"panels": len(panels()), "queries_without_data": empty}}))
    return 1 if empty else 0


if __name__ == "__main__":
    raise SystemExit(main())
