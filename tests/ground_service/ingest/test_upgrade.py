"""An archive of a version that joined pieces by content: fragments are kept, waiting pieces are listed."""

import json
import logging
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text

from ground_service.ground import Ground, open_ground
from ground_service.ingest.service import ingest_file
from ground_service.store import database as stores
from ground_service.store.database import open_database

ZONE = 1107
"""Octets of a frame for packets."""

FILE = "INSERT INTO files (sha256, kind, name, octets, received_utc_ns) VALUES (:sha256, 'downlink', 'a', 600, 1)"
EDGE = (
    "INSERT INTO stream_edges"
    " (domain, identity, role, open, count, next_count, fit, file_sha256, start, length, octets)"
    " VALUES (:domain, :identity, :role, 1, :count, :next_count, :fit, :sha256, :start, :length, :octets)"
)
INGEST = (
    "INSERT INTO ingests (id, file_sha256, state, dictionary_version, received_utc_ns, accounting)"
    " VALUES (:id, :sha256, 'done', 1, 1, :accounting)"
)
PIECE = (
    "INSERT INTO pieces (ingest_id, scope, file_sha256, octets, stream, position, links_tried, station,"
    " packets_stored, packets_joined, samples_stored) VALUES (:id, 'flight', :sha256, 600, :stream, 0, 2, '', 0, 0, 0)"
)


@pytest.fixture
def begun(synthetic_pass: Any) -> tuple[int, bytes]:
    """Octets of a packet in the first frame of the downlink and behind it."""
    at = 0
    for packet in synthetic_pass.packets:
        if at + len(packet) > ZONE:
            return at + len(packet) - ZONE, packet[: ZONE - at]
        at += len(packet)
    raise AssertionError


@pytest.fixture
def upgraded(begun: tuple[int, bytes], tmp_path: Path, caplog: pytest.LogCaptureFixture) -> Ground:
    """An archive in which the beginning of a packet waits, and two pieces of 600 octets, one without a position."""
    home = tmp_path / "home"
    home.mkdir()
    database = open_database(f"sqlite:///{home / 'linna.db'}")
    stores.upgrade_database(database, "1.1")
    with database.engine.begin() as connection:
        connection.execute(text("INSERT INTO vehicles (id, ccsds_id, instance) VALUES (1, 76, 'flight')"))
        for number, stream in ((1, ""), (2, "s")):
            ids = {"id": number, "sha256": str(number) * 64}
            connection.execute(text(FILE), ids)
            connection.execute(text(INGEST), ids | {"accounting": json.dumps({"octets_pending": 5})})
            connection.execute(text(PIECE), ids | {"stream": stream})
            raw = {"role": 1, "count": -1, "next_count": -1, "fit": 600, "octets": bytes(600)}
            for domain in ("cadus a flight", "packets 76 flight"):
                edge = {"domain": domain, "identity": ids["sha256"].encode()[:16], "start": 0, "length": 600}
                connection.execute(text(EDGE), raw | edge | {"sha256": ids["sha256"]})
        missing, octets = begun
        opener = {
            "domain": "channel 1 0 6 1113",
            "identity": b"x" * 16,
            "role": 0,
            "count": 1,
            "next_count": 1,
        }
        opener |= {"fit": missing, "octets": octets, "length": len(octets), "start": None, "sha256": None}
        connection.execute(text(EDGE), opener)
    database.engine.dispose()
    with caplog.at_level(logging.WARNING):
        return open_ground(home)


def test_the_beginning_of_a_packet_is_kept(upgraded: Ground, synthetic_pass: Any, tmp_path: Path) -> None:
    stream = (synthetic_pass.folder / "downlink.cadu").read_bytes()
    (tmp_path / "rest.cadu").write_bytes(stream[1279:])
    with upgraded as ground:
        assert ingest_file(ground, tmp_path / "rest.cadu").packets_joined == 1


def test_waiting_pieces_without_a_position_are_listed(
    upgraded: Ground, caplog: pytest.LogCaptureFixture
) -> None:
    said = [one.getMessage() for one in caplog.get_records("setup")]
    assert [one for one in said if "--recording NAME FILE" in one] == [
        f"ingest 1, file {'1' * 64}: 600 octets wait for others without a position; ingest the files of its "
        "recording again with 'linna ingest --recording NAME FILE...'"
    ]
    with upgraded as ground, ground.database.reading() as connection:
        rows = connection.execute(text("SELECT accounting FROM ingests ORDER BY id")).scalars().all()
        waits = connection.execute(text("SELECT waits FROM pieces ORDER BY ingest_id")).scalars().all()
    assert [json.loads(one)["octets_pending"] for one in rows] == [600, 600]
    assert waits == [None, 1]
