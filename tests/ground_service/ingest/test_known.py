"""Small pieces: few statements, the stored result, knowledge that is up to date."""

import pytest
from sqlalchemy import event

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
def pieces(make_pass):
    """The first one shows the link; the others hold one packet each, in complete frames."""
    packets = list(make_pass(frames=6).packets)
    return [encode_cadus(one, spacecraft_id=SPACECRAFT) for one in (packets[:4], *([one] for one in packets[4:]))]


def ingest(ground, octets):
    """Ingest a piece and check its stored result."""
    path = ground.home / "piece"
    path.write_bytes(octets)
    made = ingest_file(ground, path, spacecraft_id=SPACECRAFT)
    kept = ground.read(store.get_ingest, made.ingest_id)
    assert (kept.accounting, kept.state) == (made, "done")


def test_a_small_piece_takes_few_statements_in_two_transactions(either, pieces):
    for piece in pieces[:3]:
        ingest(either, piece)
    statements = []
    until_commit = []
    engine = either.database.engine
    event.listen(engine, "before_cursor_execute", lambda *given: statements.append(given[2]))
    event.listen(
        engine, "commit", lambda c: c.get_execution_options()["linna_write"] and until_commit.append(len(statements))
    )
    ingest(either, pieces[3])
    # What follows the second commit are the automatic steps. SQLite begins transactions and has the bulk inserts.
    entered, stored = until_commit[:2]
    limit = STATEMENTS if either.database.dialect == "postgresql" else STATEMENTS + 6
    assert stored <= limit, statements[:stored]
    assert any("UPDATE ingests" in one for one in statements[entered:stored])
    assert not any("UPDATE ingests" in one for one in statements[stored:])


def test_the_declared_link_follows_new_mission_descriptions(either):
    piece = Piece(1, "flight", SPACECRAFT, "0" * 64, 1279, "", 0)

    def known():
        return either.read(known_before, piece)

    assert known().expected.settings == (LinkSettings().explicit,)
    assert known().around.vehicle_id is None
    vehicle = either.write(vehicle_id, SPACECRAFT, "flight")
    assert known().around.vehicle_id == vehicle
    text = f'name = "one"\n[spacecraft]\nid = {SPACECRAFT}\n[link]\nframe_length = 1115\ncoding = "none"\n'
    add_mission(either, text.encode(), actor="ann")
    (stated,) = known().expected.settings
    assert (stated.frame_length, stated.coding) == (1115, "none")
    add_mission(either, text.replace("1115", "223").encode(), actor="ann")
    assert [one.frame_length for one in known().expected.settings] == [223]
