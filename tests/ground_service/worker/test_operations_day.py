"""A day's operations through `linna` and a server: plan, uplink to the flying payload, downlink, ingest, report.

Once on a laptop (SQLite, jobs in the server), once on PostgreSQL, Redis and two workers. The payload is the flight
software itself on a simulated board; only its detector is scripted.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ground_service.settings import Settings
from linna.cli import run
from lunar.timescales import parse_utc, ticks_from_utc_ns
from payload_emulator.flight.payload import FlightParameters, FlightTables, Payload, PayloadMode
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.preprocess import ImageQuality
from payload_emulator.session.spacecraft import new_board
from tests.ground_service.conftest import START, save_circle
from tests.serving import served
from tmtc.downlink import encode_cadus
from tmtc.uplink import UplinkDecoder

NS = 1_000_000_000
SPACECRAFT = 76
STEP_S = 15.0


class Spacecraft:
    """The payload in flight: telecommand octets in, CADUs out."""

    def __init__(self) -> None:
        self.board = new_board(5, store_octets=1 << 18)
        self.payload = Payload(
            self,
            FlightParameters(),
            FlightTables(),
            model_octets=b"network" * 40,
            board=self.board,
            mode=PayloadMode.standby,
            make_detector=lambda _octets: self,
        )
        self.receiver = UplinkDecoder(SPACECRAFT)
        self.utc_ns = START
        self.packets: list[bytes] = []

    def examine(self, _image: Any, _sun: Any = None) -> tuple[ImageQuality, Detections]:
        one = np.full(1, 100.0)
        return ImageQuality.OK, Detections(one, one, one / 5.0, one / 100.0, np.full(1, np.nan))

    def fly(self, until_utc_ns: int, cltus: bytes = b"") -> bytes:
        """Go on until a time; what comes down meanwhile."""
        orders = b"".join(self.receiver.decode(cltus).packets) if cltus else b""
        packets: list[bytes] = []
        while self.utc_ns < until_utc_ns:
            self.utc_ns += round(STEP_S * NS)
            self.board.advance(STEP_S, 1.0)
            image = np.full((16, 16, 3), 90, dtype=np.uint8)
            attitude = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
            packets += self.payload.step(image, attitude, int(ticks_from_utc_ns(self.utc_ns)), orders)
            orders = b""
        return encode_cadus(packets, spacecraft_id=SPACECRAFT)


@contextmanager
def workers(settings: Settings, folder: Path, count: int) -> Iterator[None]:
    environment = {
        **os.environ,
        "LINNA_HOME": str(settings.home),
        "LINNA_DATABASE_URL": settings.resolved_database_url(),
        "LINNA_BROKER_URL": str(settings.resolved_broker_url()),
    }
    environment.pop("LINNA_DATA", None)
    started = []
    try:
        for number in range(count):
            with (folder / f"worker-{number}.log").open("wb") as log:
                command = [sys.executable, "-m", "linna", "worker"]
                started.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log))
        yield
    finally:
        for worker in started:
            worker.terminate()
        for worker in started:
            worker.wait(60)


def operate(capsys: pytest.CaptureFixture[str], service: tuple[str, str], folder: Path) -> None:
    url, token = service

    def linna(*words: Any) -> Any:
        code = run([*map(str, words), "--server", url, "--token", token, "--json"])
        printed = capsys.readouterr()
        assert code == 0, printed.err
        return json.loads(printed.out)

    def listen(stream: bytes) -> Any:
        (folder / "down.cadu").write_bytes(stream)
        (ingested,) = linna("ingest", folder / "down.cadu")["ingested"]
        return ingested

    linna("plan", "ephemeris", save_circle(folder / "reference.oem"))
    found = linna("plan", "search", "--altitude-km", 30, 50, "--maximum-duration-s", 600)["candidates"]
    chosen = found[1]
    key = linna(
        "plan", "add", "--start", chosen["start"], "--stop", chosen["stop"], "--spacecraft-id", SPACECRAFT,
        "--name", "first window",
    )["id"]  # fmt: skip
    linna("plan", "approve", key)
    linna("plan", "uplink", key)
    linna("command", "uplink", "--spacecraft-id", SPACECRAFT, "--out", folder / "up.cltu")
    assert linna("plan", "show", key)["state"] == "uplinked"

    spacecraft = Spacecraft()
    start, stop = parse_utc(chosen["start"]), parse_utc(chosen["stop"])
    listen(spacecraft.fly(start - 60 * NS, (folder / "up.cltu").read_bytes()))
    assert linna("plan", "show", key)["state"] == "uplinked"
    listen(spacecraft.fly((start + stop) // 2))
    assert linna("plan", "show", key)["state"] == "executing"
    ingested = listen(spacecraft.fly(stop + 1200 * NS))
    assert ingested["packets_new"] == ingested["packets"] > 0
    window = linna("plan", "show", key)
    assert window["state"] == "downlinked"
    states = {row["name"]: row["state"] for row in linna("command", "list")["telecommands"]}
    assert states == dict.fromkeys(("enable_schedule", "insert_activity", "perform_function"), "completed")

    made = linna("report", window["pass_id"], "--out", folder / "report")
    assert made["packets_lost"] == 0
    assert made["frames"] == pytest.approx(window["predicted"]["frames"], abs=1)
    assert (folder / "report" / "report.pdf").read_bytes().startswith(b"%PDF")
    assert linna("plan", "show", key)["state"] == "processed"


def test_a_day_on_a_laptop(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setenv("LINNA_HOME", str(tmp_path / "operator"))
    with served(Settings(home=tmp_path / "home")) as service:
        operate(capsys, service, tmp_path)


@pytest.mark.campaign
def test_a_day_on_postgresql_redis_and_two_workers(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: Any,
    migrated_postgres: Callable[[], str],
    redis_url: str,
) -> None:
    monkeypatch.setenv("LINNA_HOME", str(tmp_path / "operator"))
    settings = Settings(home=tmp_path / "home", database_url=migrated_postgres(), broker_url=redis_url)
    with workers(settings, tmp_path, 2), served(settings) as where:
        operate(capsys, where, tmp_path)
