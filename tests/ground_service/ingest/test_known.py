"""Small pieces: few statements, the stored result, knowledge that is up to date."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event

from ground_service.ground import Ground
from ground_service.ingest import store
from ground_service.ingest.link_settings import known_before
from ground_service.ingest.recording_store import Piece
from ground_service.ingest.service import ingest_file
from ground_service.missions.service import add_mission
from ground_service.store.vehicles import vehicle_id
from tmtc.downlink import encode_cadus
from tmtc.link.settings import LinkSettings

SPACECRAFT = 76
STATEMENTS = 10
"""Statements of one piece besides the three bulk inserts (packets, samples, roll-ups)."""


@pytest.fixture(scope="module")
def pieces(make_pass: Callable[..., Any]) -> list[bytes]:
    """The first one shows the link; the others hold one packet each, in complete frames."""
    packets = list(make_pass(frames=6).packets)
    return [
        encode_cadus(packets[:4], spacecraft_id=SPACECRAFT),
        *(encode_cadus([one], spacecraft_id=SPACECRAFT) for one in packets[4:]),
    ]


def ingest_all(ground: Ground, pieces: list[bytes], folder: Path) -> list[dict[str, Any]]:
    """Ingest the pieces; return their results, as stored, without the numbers of the ingests."""
    found = []
    for octets in pieces:
        path = folder / "piece"
        path.write_bytes(octets)
        made = ingest_file(ground, path, spacecraft_id=SPACECRAFT)
        with ground.database.reading() as connection:
            kept = store.get_ingest(connection, made.ingest_id)
        assert kept.accounting == made
        assert kept.state == "done"
        found.append(made.model_dump(exclude={"ingest_id"}))
    return found


def test_a_small_piece_takes_few_statements_in_two_transactions(
    either: Ground, pieces: list[bytes], tmp_path: Path
) -> None:
    ingest_all(either, pieces[:3], tmp_path)
    path = tmp_path / "next"
    path.write_bytes(pieces[3])
    statements: list[str] = []
    until_commit: list[int] = []
    engine = either.database.engine
    event.listen(engine, "before_cursor_execute", lambda *given: statements.append(given[2]))
    event.listen(
        engine, "commit", lambda c: c.get_execution_options()["linna_write"] and until_commit.append(len(statements))
    )
    result = ingest_file(either, path, spacecraft_id=SPACECRAFT)
    with either.database.reading() as connection:
        assert store.get_ingest(connection, result.ingest_id).accounting == result
    # What follows the second commit are the automatic steps. SQLite begins transactions and has the bulk inserts.
    entered, stored = until_commit[:2]
    limit = STATEMENTS if either.database.dialect == "postgresql" else STATEMENTS + 6
    assert stored <= limit, statements[:stored]
    assert any("UPDATE ingests" in one for one in statements[entered:stored])
    assert not any("UPDATE ingests" in one for one in statements[stored:])


def test_the_declared_link_follows_new_mission_descriptions(either: Ground) -> None:
    piece = Piece(1, "flight", SPACECRAFT, "0" * 64, 1279, "", 0)

    def known() -> Any:
        with either.database.reading() as connection:
            return known_before(connection, piece)

    assert known().expected.settings == (LinkSettings().explicit,)
    assert known().around.vehicle_id is None
    with either.database.writing() as connection:
        vehicle = vehicle_id(connection, SPACECRAFT, "flight")
    assert known().around.vehicle_id == vehicle
    text = f'name = "one"\n[spacecraft]\nid = {SPACECRAFT}\n[link]\nframe_length = 1115\ncoding = "none"\n'
    add_mission(either, text.encode(), actor="ann")
    (stated,) = known().expected.settings
    assert (stated.frame_length, stated.coding) == (1115, "none")
    add_mission(either, text.replace("1115", "223").encode(), actor="ann")
    assert [one.frame_length for one in known().expected.settings] == [223]
