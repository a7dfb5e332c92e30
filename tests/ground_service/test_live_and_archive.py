"""One pass twice: flown live over TCP and planned over the API, and the same downlink imported as an archive.

The payload is the emulator's live session in accelerated time, without an operator of its own; nothing but the ground
commands it, over the link of its mission description. The archive holds the octets that a second receiver took from the
same telemetry port, the same reference ephemeris and mission description.
"""

from __future__ import annotations

import hashlib
import json
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from ground_service.client import Client
from ground_service.planning.model import Window
from ground_service.settings import Settings
from lunar.catalogue import save_catalogue
from lunar.datafolder import find_data
from lunar.messages.oem import save_oem
from lunar.timescales import format_utc, parse_utc
from payload_emulator.session.live import LiveSession
from payload_emulator.session.mission import OPERATIONS, live_mission_text
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.starting import load_scenario_payload
from payload_emulator.session.station_ports import RECORD_HEADER
from payload_emulator.session.world import build_world
from tests.scenarios import live_scenario
from tests.serving import served, wait_for
from tmtc.link import LinkSettings

SCENARIO = live_scenario("live and archive", 5, 1500.0)
NS = 1_000_000_000
START = parse_utc("2029-08-07T01:40:00Z")
FIRST, LAST = START + 180 * NS, START + 600 * NS
UNTIL = START + 1400 * NS
PATIENCE_S = 900.0

OF_THE_IMPORT = {
    "pass_id": "number of the row",
    "created_utc": "time at which the report was made",
    "provenance.spacecraft": "an archive has an instance of the spacecraft of its own",
    "provenance.archive": "a live pass has no archive",
    "provenance.crater catalogue SHA-256": "that of a live pass is cut along its track",
    "craters.source": "a live pass names the catalogue of its mission description",
    "data_sources": "a live pass names the catalogue of its mission description",
    "packets.receptions[0].station": "the archive does not name the station",
    "packets.receptions[0].first_utc_ns": "the archive does not state when it was received",
    "packets.receptions[0].last_utc_ns": "the archive does not state when it was received",
    "packets.receptions[0].octets": "records of the station have headers",
    "packets.octets": "records of the station have headers",
    "packets.octets_skipped": "records of the station have headers",
}
"""Fields that must differ, with the reason; all others are equal."""


@dataclass
class Both:
    """Reports of the same pass."""

    live: dict[str, Any]
    imported: dict[str, Any]
    window: Window


def receive(port: int) -> tuple[bytearray, threading.Thread]:
    """Take all telemetry of a port, as another station would."""
    octets = bytearray()
    connection = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)

    def take() -> None:
        with connection:
            while block := connection.recv(1 << 16):
                octets.extend(block)

    thread = threading.Thread(target=take)
    thread.start()
    return octets, thread


def received(port: int) -> bytes:
    """Return all that a port sends."""
    octets, thread = receive(port)
    thread.join(PATIENCE_S)
    return bytes(octets)


def without_headers(records: bytes) -> bytes:
    """Return the CADUs of records."""
    length = LinkSettings().cadu_length
    starts = range(RECORD_HEADER.size, len(records), RECORD_HEADER.size + length)
    return b"".join(records[start : start + length] for start in starts)


def fly_until(live: LiveSession, utc_ns: int) -> None:
    """Let simulated time pass until an instant, and wait for it."""
    with socket.create_connection(("127.0.0.1", live.ports["console"]), timeout=PATIENCE_S) as console:
        console.sendall(f"until {format_utc(utc_ns)}\n".encode())
        with console.makefile("r") as lines:
            for line in lines:
                if json.loads(line)["kind"] == "paused":
                    return
    raise AssertionError("the console ended")


def write_archive(folder: Path, octets: bytes, mission: str, window: Window, uploads: dict[str, Any]) -> Path:
    folder.mkdir()
    (folder / "downlink.cadu").write_bytes(octets)
    for name in ("reference.oem", "catalogue.csv"):
        (folder / name).write_bytes((folder.parent / name).read_bytes())
    (folder / "mission.toml").write_text(mission, encoding="utf-8")
    files = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}
    manifest = {
        "schema_version": 1,
        "pass_name": window.name,
        "spacecraft_id": 76,
        "start_utc": format_utc(FIRST),
        "stop_utc": format_utc(LAST),
        "cadence_s": window.cadence_s,
        "frames_expected": window.predicted.frames,
        **uploads,
        "files": {name: {"sha256": sha256} for name, sha256 in files.items()},
    }
    (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    return folder


def report_of(api: Client, pass_id: int, out: Path) -> dict[str, Any]:
    api.get_report(api.make_report(pass_id), out, format="json")
    document: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    return document


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def both(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Both:
    folder = tmp_path_factory.mktemp("live")
    data = find_data(None)
    world = build_world(parse_scenario(SCENARIO), data)
    loaded, reference, catalogue = load_scenario_payload(world, data)
    save_oem(reference, folder / "reference.oem")
    craters = folder / "catalogue.csv"
    save_catalogue(catalogue, craters)
    live = LiveSession(
        world,
        loaded,
        paused=True,
        mission=lambda world, ports: live_mission_text(
            world, data, "127.0.0.1", ports, OPERATIONS, catalogue=craters
        ),
    )
    flying = threading.Thread(target=live.run)
    flying.start()
    url = request.getfixturevalue("migrated_postgres")() if request.param == "postgresql" else None
    settings = Settings(
        home=folder / "home", allowed_hosts=("testserver",), database_url=url, allow_database_owner=True
    )
    try:
        with served(settings, "admin") as (server, token), Client(server, token) as api:
            mission = received(live.ports["mission"]).decode()
            captured, receiving = receive(live.ports["telemetry earth"])
            api.add_catalogue(craters)
            api.add_mission(mission.encode())
            api.add_ephemeris(folder / "reference.oem")
            clients = live.stations["earth"].telemetry.clients
            wait_for(lambda: len(clients) == 2, "both receivers")
            fly_until(live, START)
            window = api.add_window(
                {
                    "name": "both",
                    "start": format_utc(FIRST),
                    "stop": format_utc(LAST),
                    "spacecraft_id": 76,
                }
            ).id
            api.change_window(window, {"state": "approved"})
            api.uplink_window(window)
            wait_for(lambda: bool(live._uplinked), "telecommands")
            wait_for(lambda: not any(one.unsent for one in api.list_links()), "all telecommands")
            fly_until(live, UNTIL)
            live.stopping.set()
            flying.join(PATIENCE_S)
            receiving.join(PATIENCE_S)
            wait_for(lambda: api.get_window(window).state == "processed", "the report of the window")
            planned = api.get_window(window)
            of_live = report_of(api, planned.pass_id, folder / "live.json")
            flown = api.get_pass(planned.pass_id).manifest
            archive = write_archive(
                folder / "archive",
                without_headers(bytes(captured)),
                mission,
                planned,
                {key: flown[key] for key in ("start_state", "experiment")},
            )
            imported = api.import_archive(archive)
            of_archive = report_of(api, imported, folder / "archive.json")
            planned = api.get_window(window)
    finally:
        live.stopping.set()
        flying.join(PATIENCE_S)
    return Both(of_live, of_archive, planned)


def differences(one: Any, other: Any, name: str = "") -> Iterator[str]:
    """Yield the dotted names of values that differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in sorted({*one, *other}):
            yield from differences(one.get(key), other.get(key), f"{name}.{key}" if name else key)
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for number, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from differences(a, b, f"{name}[{number}]")
    elif one != other:
        yield name


def test_the_pass_was_flown_and_received(both: Both) -> None:
    assert both.window.state == "processed"
    assert both.live["packets"]["lost"] == 0 and both.live["accounting"]["acquired"] == 28
    assert both.live["navigation"] and both.live["events"] and both.live["housekeeping"]
    assert both.live["evidence_level"].startswith("2 ")
    assert "live and archive, revision " in both.live["provenance"]["mission description"]
    assert both.live["detector"]["micro"]["recall"] > 0.5


def test_live_pass_and_archive_have_equal_reports(both: Both) -> None:
    assert set(differences(both.live, both.imported)) == set(OF_THE_IMPORT)
