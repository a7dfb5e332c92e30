"""Small pieces of complete frames: few statements, the result of any other reading, knowledge that is up to date."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event

from ground_service.ground import Ground, open_ground
from ground_service.ingest import edge_store as edges
from ground_service.ingest import service, store
from ground_service.ingest.edge_store import Piece
from ground_service.ingest.known import known_before
from ground_service.ingest.service import ingest_file
from ground_service.ingest.stream import Link
from ground_service.missions.service import add_mission
from ground_service.store.models import ROLLUPS
from ground_service.store.vehicles import vehicle_id
from tests.ground_service.archive_hash import archive_hash
from tmtc.downlink import encode_cadus
from tmtc.link import LinkSettings

SPACECRAFT = 76
STATEMENTS = 9
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


def contents(ground: Ground) -> tuple[str, list[Any]]:
    """The hash of the archive, and its roll-ups."""
    with ground.database.reading() as connection:
        rollups = connection.execute(ROLLUPS.select().order_by(*ROLLUPS.primary_key.columns)).all()
        return archive_hash(connection, vehicle_id(connection, SPACECRAFT, "flight")), [
            tuple(row) for row in rollups
        ]


def test_a_small_piece_takes_few_statements_in_one_transaction(
    either: Ground, pieces: list[bytes], tmp_path: Path
) -> None:
    ingest_all(either, pieces[:3], tmp_path)
    path = tmp_path / "next"
    path.write_bytes(pieces[3])
    statements: list[str] = []
    until_commit: list[int] = []
    engine = either.database.engine
    event.listen(engine, "before_cursor_execute", lambda *given: statements.append(given[2]))
    event.listen(engine, "commit", lambda _: until_commit.append(len(statements)))
    result = ingest_file(either, path, spacecraft_id=SPACECRAFT)
    with either.database.reading() as connection:
        assert store.get_ingest(connection, result.ingest_id).accounting == result
    # What follows the commit are the automatic steps. SQLite begins both transactions and has the bulk inserts.
    limit = STATEMENTS if either.database.dialect == "postgresql" else STATEMENTS + 6
    assert until_commit[0] <= limit, statements[: until_commit[0]]
    assert not any("UPDATE ingests" in one for one in statements[until_commit[0] :])


def test_small_pieces_have_the_results_of_any_other_reading(
    either: Ground, pieces: list[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every piece comes twice; the other instance has the same archive without the short way."""
    found = ingest_all(either, [*pieces, *pieces], tmp_path)
    quick = contents(either)
    monkeypatch.setattr(service, "AT_ONCE_OCTETS", 0)
    other = tmp_path / "other"
    other.mkdir()
    with open_ground(other / "home") as ground:
        assert ingest_all(ground, [*pieces, *pieces], other) == found
        assert contents(ground) == quick


def test_what_is_known_follows_new_links_and_mission_descriptions(either: Ground) -> None:
    piece = Piece(1, "flight", SPACECRAFT, "0" * 64, 1279, "", 1, None)
    settings = LinkSettings().explicit

    def known() -> Any:
        with either.database.reading() as connection:
            return known_before(connection, piece)

    first = known()
    assert (first.links, first.expected.mission, first.around.vehicle_id) == ([], (), None)
    with either.database.writing() as connection:
        edges.learn_link(connection, "flight", Link(settings))
        vehicle = vehicle_id(connection, SPACECRAFT, "flight")
    assert known().links == [Link(settings)]
    assert known().around.vehicle_id == vehicle
    text = f'name = "one"\n[spacecraft]\nid = {SPACECRAFT}\n[link]\nframe_length = 1115\ncoding = "none"\n'
    add_mission(either, text.encode(), actor="ann")
    (stated,) = known().expected.mission
    assert (stated.frame_length, stated.coding) == (1115, "none")
    add_mission(either, text.replace("1115", "223").encode(), actor="ann")
    assert [one.frame_length for one in known().expected.mission] == [223]
