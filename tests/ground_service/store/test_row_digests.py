"""Digests of rows: updated by changes of the program, and mismatched after any other change."""

import sqlite3
import struct
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, text

from ground_service.store.database import Database, empty_database, prepare_database, upgrade_database
from ground_service.store.models import METADATA
from ground_service.store.row_digests import (
    BARE,
    StrayRow,
    guarded_tables,
    missing_triggers,
    row_sha256,
    stray_rows,
    unknown_digests,
)

TABLES: dict[str, Any] = dict(METADATA.tables)
REPORT = {
    "id": "r1",
    "pass_id": 1,
    "html_sha256": "h",
    "json_sha256": "j",
    "summary": {"b": [0.1, None], "ü": "x"},
}


def strays(database: Database) -> list[StrayRow]:
    with database.reading() as connection:
        return [row for table in guarded_tables() for row in stray_rows(connection, table)] + list(
            unknown_digests(connection)
        )


def outside(database: Database, *statements: str) -> None:
    """Return a connection of another program."""
    engine = create_engine(database.engine.url)
    with engine.begin() as connection:
        for statement in statements:
            connection.execute(text(statement))
    engine.dispose()


def fill(database: Database) -> None:
    with database.writing() as connection:
        connection.execute(
            TABLES["vehicles"].insert(), [{"ccsds_id": k, "instance": "a'b|ü"} for k in (1, 2, 3)]
        )
        connection.execute(
            TABLES["correlations"].insert(),
            [
                {
                    "vehicle_id": 1, "method": "m", "start_ticks": 1 << 47, "stop_ticks": 2, "reference_ticks": 3,
                    "reference_utc_ns": 4, "drift_ppb": drift, "residual_rms_ns": None, "points": 5,
                    "created_utc_ns": 6,
                }
                for drift in (0.1, 3.0, -1e300)
            ],
        )  # fmt: skip
        connection.execute(
            TABLES["telecommands"].insert(),
            [{
                "vehicle_id": 1, "name": "n", "arguments": {"x": [1, {"y": None}]}, "state": "queued", "critical": 0,
                "timeout_s": 1, "requested_by": "ann", "created_utc_ns": 1, "octets": b"\\x00\\xff",
            }],
        )  # fmt: skip


def test_digests_follow_what_the_program_writes(database: Database) -> None:
    fill(database)
    assert strays(database) == []
    with database.writing() as connection:
        connection.execute(text("UPDATE vehicles SET ccsds_id = 9 WHERE id = 1"))
        connection.execute(text("UPDATE vehicles SET id = 12 WHERE id = 2"))
        connection.execute(text("DELETE FROM vehicles WHERE id = 3"))
        connection.execute(text("UPDATE telecommands SET state = 'sent', octets = NULL"))
    assert strays(database) == []
    with pytest.raises(RuntimeError), database.writing() as connection:
        connection.execute(text("UPDATE vehicles SET ccsds_id = ccsds_id + 10"))
        raise RuntimeError
    assert strays(database) == []
    with database.reading() as connection:
        assert connection.execute(text("SELECT count(*) FROM row_digests")).scalar_one() == 2 + 3 + 1
        assert missing_triggers(connection) == []


@pytest.mark.parametrize(
    ("statement", "table", "reason"),
    [
        ("UPDATE vehicles SET ccsds_id = 9 WHERE id = 2", "vehicles", "changed content"),
        ("UPDATE correlations SET drift_ppb = 0.10000000000000002 WHERE id = 1", "correlations", "changed content"),
        ("UPDATE telecommands SET reason = ''", "telecommands", "changed content"),
        ("UPDATE telecommands SET state = 'sent'", "telecommands", "changed content"),
        ("DELETE FROM correlations WHERE id = 2", "correlations", "removed"),
        ("INSERT INTO vehicles (id, ccsds_id, instance) VALUES (7, 7, 'x')", "vehicles", "not written by this program"),
        ("DELETE FROM row_digests WHERE table_name = 'telecommands'", "telecommands", "found none"),
        ("UPDATE row_digests SET sha256 = '0' WHERE table_name = 'telecommands'", "telecommands", "changed content"),
        ("INSERT INTO row_digests VALUES ('vehicles', '77', '0')", "vehicles", "removed"),
        ("INSERT INTO row_digests VALUES ('nothing', '1', '0')", "nothing", "expected no digest"),
    ],
)  # fmt: skip
def test_what_anything_else_changes_is_found(
    database: Database, statement: str, table: str, reason: str
) -> None:
    fill(database)
    outside(database, statement)
    (found,) = strays(database)
    assert (found.table, reason in found.reason) == (table, True), found


def test_a_row_that_was_damaged_is_not_made_to_fit_by_a_later_change(database: Database) -> None:
    fill(database)
    outside(database, "UPDATE vehicles SET ccsds_id = 9 WHERE id = 2", "DELETE FROM vehicles WHERE id = 3")
    outside(database, "UPDATE telecommands SET state = 'sent'")
    with database.writing() as connection:
        connection.execute(text("UPDATE vehicles SET instance = 'new' WHERE id = 2"))
        connection.execute(text("INSERT INTO vehicles (id, ccsds_id, instance) VALUES (3, 5, 'again')"))
        connection.execute(text("DELETE FROM telecommands"))
    assert {(one.table, one.key) for one in strays(database)} == {
        ("vehicles", "2"),
        ("vehicles", "3"),
        ("telecommands", "1"),
    }


def test_a_schema_that_is_made_again_has_its_triggers_again(database: Database) -> None:
    fill(database)
    empty_database(database)
    upgrade_database(database)
    fill(database)
    assert strays(database) == []
    outside(database, "UPDATE vehicles SET ccsds_id = 9 WHERE id = 2")
    assert len(strays(database)) == 1


def test_another_program_can_still_write_a_sqlite_file(tmp_path: Path) -> None:
    prepare_database(f"sqlite:///{tmp_path / 'linna.db'}").engine.dispose()
    with sqlite3.connect(tmp_path / "linna.db") as connection:
        connection.execute("INSERT INTO vehicles (ccsds_id, instance) VALUES (1, 'x')")
    connection.close()


def test_every_table_has_digests_or_a_reason_for_none() -> None:
    assert {table.name for table in guarded_tables()} | BARE == set(TABLES)


def test_values_of_different_kinds_never_give_one_digest() -> None:
    values = [
        (), (None,), (1,), (1.0,), ("1",), (b"1",), ("", "a"), ("a", ""), (1, 2), (12,), ("i1;",), (-0.0,), (0.0,),
        (float("nan"),), (struct.pack("<d", 1.0),), ("ab", "c"), ("a", "bc"),
    ]  # fmt: skip
    assert len({row_sha256(*one) for one in values}) == len(values)
