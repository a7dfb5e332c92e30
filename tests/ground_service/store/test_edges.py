"""Waiting edges: every query uses an index, with any number of edges."""

from collections.abc import Iterator
from typing import Any

import pytest
from sqlalchemy import event, text

from ground_service.ingest import edge_store as edges
from ground_service.ingest.edges import CLOSER, MIDDLE, OPENER, UNKNOWN, Edge
from ground_service.store.database import Database

COUNT = 4_000


@pytest.fixture
def database(database: Database) -> Database:
    """A database with waiting edges."""
    with database.writing() as connection:
        edges.add_edges(connection, "d", list(many()), "0" * 64)
    with database.writing() as connection:
        connection.execute(text("ANALYZE"))
    return database


def many() -> Iterator[Edge]:
    for number in range(COUNT):
        octets = bytes(1 + number % 900)
        if number % 3:
            yield Edge(OPENER, UNKNOWN, number % 256, octets, number, 1 + number % 1000)
        else:
            yield Edge(CLOSER, number % 256, UNKNOWN, octets, number)
    for number in range(20):
        yield Edge(MIDDLE, UNKNOWN, number, b"middle", COUNT + number)


def plans(database: Database, look_up: Any) -> list[str]:
    """Return the query plan of each query of `look_up`."""
    asked: list[tuple[str, Any]] = []

    def note(_c: Any, _cursor: Any, statement: str, parameters: Any, *_: Any) -> None:
        if statement.startswith("SELECT"):
            asked.append((statement, parameters))

    with database.reading() as connection:
        event.listen(database.engine, "before_cursor_execute", note)
        try:
            look_up(connection)
        finally:
            event.remove(database.engine, "before_cursor_execute", note)
        explain = "EXPLAIN QUERY PLAN " if database.dialect == "sqlite" else "EXPLAIN "
        found = []
        for statement, parameters in asked:
            rows = connection.exec_driver_sql(explain + statement, parameters).all()
            found.append("\n".join(str(row[-1]) for row in rows))
    assert found
    return found


PIECE = edges.Piece(1, "flight", None, "0" * 64, 100, "s", 500, None)

LOOK_UPS = {
    "length and count": lambda c: edges.candidates(c, "d", OPENER, fit=(77,), count=(5, UNKNOWN)),
    "length": lambda c: edges.candidates(c, "d", CLOSER, fit=(77,)),
    "count": lambda c: edges.candidates(c, "d", OPENER, count=(5,)),
    "next count": lambda c: edges.candidates(c, "d", MIDDLE, next_count=5, limit=8),
    "the newest": lambda c: edges.candidates(c, "d", OPENER, limit=50),
    "those without a place": lambda c: edges.candidates(c, "d", MIDDLE, limit=512),
    "identity": lambda c: edges.open_edges(c, "d", [b"0123456789abcdef"]),
}


@pytest.mark.parametrize("name", LOOK_UPS)
def test_edges_are_looked_up_by_an_index(database: Database, name: str) -> None:
    for plan in plans(database, LOOK_UPS[name]):
        assert "stream_edges" in plan
        if database.dialect == "sqlite":
            assert "SEARCH stream_edges USING INDEX" in plan and "SCAN" not in plan
        elif name == "the newest":  # most rows of this table match: PostgreSQL reads them backwards by id
            assert "Index Scan" in plan and "Sort" not in plan, plan
        else:
            assert ("Seq Scan" not in plan and "ix_stream_edges" in plan) or "uq_stream_edges" in plan, plan


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_the_newest_edges_are_read_without_sorting_all_that_wait(database: Database) -> None:
    (plan,) = plans(database, LOOK_UPS["the newest"])
    assert "ix_stream_edges_newest" in plan
    assert "SORT" not in plan.upper() and "TEMP B-TREE" not in plan


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_neighbours_are_looked_up_by_an_index(database: Database) -> None:
    for look_up in (edges.octets_before, edges.octets_behind):
        for plan in plans(database, lambda c, look_up=look_up: look_up(c, PIECE, 1000)):
            assert "SEARCH pieces USING INDEX ix_pieces_place" in plan and "TEMP B-TREE" not in plan
