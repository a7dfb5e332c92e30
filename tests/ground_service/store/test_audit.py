"""Audit chain: entries in the order of commits, changes that break it, and concurrent processes."""

import hashlib
import json
import os
import subprocess
import sys

from pytest import mark, raises
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError

from ground_service.access.service import add_user
from ground_service.errors import AuditBroken, GroundError
from ground_service.store import audit
from ground_service.store.database import prepare_database
from ground_service.store.models import AUDIT
from ground_service.worker.upkeep import nightly
from linna import cli
from tests.ground_service.conftest import cells

PROCESSES, EACH = 4, 25


def add(database, *actions, detail=None):
    with database.writing() as connection:
        for action in actions:
            audit.add_note(connection, audit.Note(5, "ann", action, "7", detail or {}))


def broken(database):
    with database.snapshot() as connection:
        return list(audit.broken_entries(connection))


def head(database):
    with database.reading() as connection:
        return audit.read_head(connection)


def without_guards(database, statement):
    """Change the log as a user with the right to change the schema."""
    with database.writing() as connection:
        for name in audit.GUARD_NAMES:
            on = " ON audit" if database.dialect == "postgresql" else ""
            connection.execute(text(f"DROP TRIGGER {name}{on}"))
        connection.exec_driver_sql(statement)


def test_an_entry_is_bound_to_the_one_before_by_a_hash_that_anybody_can_compute(database):
    add(database, "first", "second", detail={"b": 1.5, "a": [None, "ü"]})
    found = "0" * 64
    for number, action in enumerate(("first", "second"), 1):
        content = [found, number, 5, "ann", action, "7", {"a": [None, "ü"], "b": 1.5}]
        found = hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
    assert head(database) == audit.Head(2, found)
    assert broken(database) == []


def test_what_is_undone_leaves_no_entry(database):
    with raises(RuntimeError), database.writing() as connection:
        audit.add_note(connection, audit.Note(5, "ann", "look", "", {}))
        raise RuntimeError
    assert head(database) == audit.Head(0, audit.GENESIS)
    with database.reading() as connection, raises(RuntimeError, match="inside Database"):
        audit.add_note(connection, audit.Note(5, "ann", "look", "", {}))


def test_numbers_that_are_not_finite_and_keys_that_are_no_text_are_kept_as_text(database):
    add(database, "look", detail={"value": float("nan"), "items": {1: float("inf")}})
    assert broken(database) == []


@mark.parametrize("statement", ["UPDATE audit SET actor = 'bob'", "DELETE FROM audit WHERE id = 1"])
def test_the_database_refuses_to_change_the_log(database, statement):
    add(database, "first")
    with raises(GroundError, match="audit entries cannot be changed or removed"), database.writing() as one:
        one.execute(text(statement))
    assert broken(database) == []
    with database.reading() as connection:
        assert audit.missing_guards(connection) == []


DAMAGE = """
UPDATE audit SET utc_ns = 6 WHERE id = 2 | changed content
UPDATE audit SET actor = 'bob' WHERE id = 2 | changed content
UPDATE audit SET action = 'other' WHERE id = 2 | changed content
UPDATE audit SET target = '8' WHERE id = 2 | changed content
UPDATE audit SET detail = '{"a": 1}' WHERE id = 2 | changed content
UPDATE audit SET sha256 = '11' WHERE id = 2 | changed content
UPDATE audit SET previous_sha256 = '11' WHERE id = 2 | found another
DELETE FROM audit WHERE id = 1 | entry 1 missing
DELETE FROM audit WHERE id = 2 | entry 2 missing
DELETE FROM audit WHERE id = 3 | expected the head at the newest entry
UPDATE audit_head SET number = 2 | expected the head at the newest entry
UPDATE audit_head SET sha256 = '11' | expected the head at the newest entry
INSERT INTO audit_head (id, number, sha256) VALUES (2, 1, '11') | found 1 more
DELETE FROM audit_head | the head of the chain is missing
"""


@mark.parametrize("statement, reason", cells(DAMAGE))
def test_every_change_of_the_log_is_found(tmp_path, statement, reason):
    database = prepare_database(f"sqlite:///{tmp_path / 'linna.db'}")
    add(database, "first", "second", "third")
    without_guards(database, statement)
    found = broken(database)
    assert found and reason in " ".join(one.reason for one in found)
    with database.reading() as connection:
        assert audit.missing_guards(connection) == list(audit.GUARD_NAMES)
    database.engine.dispose()


def test_entries_that_are_put_in_are_found(database):
    add(database, "first")
    row = {
        "id": 2, "utc_ns": 5, "actor": "eve", "action": "a", "target": "", "detail": {},
        "previous_sha256": "1" * 64, "sha256": "2" * 64,
    }  # fmt: skip
    with database.writing() as connection:
        connection.execute(AUDIT.insert(), [row])
    assert {one.number for one in broken(database)} == {1, 2}


def test_without_its_head_the_log_takes_no_entry_and_nothing_is_stored(database):
    add(database, "first")
    without_guards(database, "DELETE FROM audit_head")
    with raises(AuditBroken), database.writing() as connection:
        connection.execute(text("INSERT INTO vehicles (ccsds_id, instance) VALUES (1, 'x')"))
        audit.add_note(connection, audit.Note(5, "ann", "look", "", {}))
    with database.reading() as connection:
        assert connection.execute(text("SELECT count(*) FROM vehicles")).scalar_one() == 0


def test_a_failed_statement_of_the_database_is_reported_as_one(database):
    with raises(GroundError) as caught, database.writing() as connection:
        connection.execute(text("INSERT INTO nothing VALUES (1)"))
    assert isinstance(caught.value.__cause__, DBAPIError)


PROGRAM = """
import sys
from sqlalchemy import text
from ground_service.store import audit
from ground_service.store.database import open_database
database = open_database(sys.argv[1])
for k in range(int(sys.argv[3])):
    with database.writing() as connection:
        connection.execute(text("UPDATE vehicles SET ccsds_id = ccsds_id + 1 WHERE id = :id"), {"id": 1 + k % 3})
        audit.add_note(connection, audit.Note(k, sys.argv[2], "race", str(k), {"k": k}))
        audit.add_note(connection, audit.Note(k, sys.argv[2], "race again", str(k), {}))
"""


def test_several_processes_at_once_make_one_chain(database):
    with database.writing() as connection:
        for key in 1, 2, 3:
            connection.execute(
                text("INSERT INTO vehicles (id, ccsds_id, instance) VALUES (:k, 0, :i)"), {"k": key, "i": str(key)}
            )
    url = database.engine.url.render_as_string(hide_password=False)
    running = [
        subprocess.Popen([sys.executable, "-c", PROGRAM, url, f"p{n}", str(EACH)], env=dict(os.environ))
        for n in range(PROCESSES)
    ]
    assert [process.wait() for process in running] == [0] * PROCESSES
    assert broken(database) == []
    found = head(database)
    assert found is not None and found.number == 2 * PROCESSES * EACH
    with database.reading() as connection:
        rows = connection.execute(AUDIT.select().order_by(AUDIT.c.id)).mappings().all()
        assert connection.execute(text("SELECT sum(ccsds_id) FROM vehicles")).scalar_one() == PROCESSES * EACH
    for one in range(PROCESSES):  # each process's own entries come in its order, the two of a transaction together
        mine = [(row["target"], row["action"], row["id"]) for row in rows if row["actor"] == f"p{one}"]
        assert [target for target, _, _ in mine[::2]] == [str(k) for k in range(EACH)]
        assert all(b[2] == a[2] + 1 for a, b in zip(mine[::2], mine[1::2], strict=True))


def test_the_lock_is_only_held_at_the_end(migrated_postgres):
    """A long transaction with an audit entry does not keep another from being committed."""
    database = prepare_database(migrated_postgres())
    with database.writing() as long:
        audit.add_note(long, audit.Note(5, "slow", "work", "", {}))
        with database.writing() as short:
            short.execute(text("SET LOCAL lock_timeout = '2s'"))
            audit.add_note(short, audit.Note(5, "quick", "work", "", {}))
    with database.reading() as connection:
        actors = [row[0] for row in connection.execute(text("SELECT actor FROM audit ORDER BY id"))]
    assert actors == ["quick", "slow"]
    assert broken(database) == []
    database.engine.dispose()


def test_a_chain_that_was_cut_is_found_by_the_heads_of_another_machine(ground, tmp_path, capsys):
    """Triggers that were made again hide the cut from everything inside the database."""
    (ground.home / "secrets").mkdir()
    (ground.home / "secrets/audit").write_text("key")
    heads = tmp_path / "heads"
    heads.mkdir()
    for name in "ann", "bob":
        add_user(ground, name, "viewer")
        nightly(ground, {"audit_heads": str(heads)})
    command = ["verify", "--home", str(ground.home), "--head", str(heads)]
    assert cli.run(command) == 0
    with ground.database.writing() as connection:
        made = connection.execute(text("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'")).all()
        for name, _ in made:
            connection.execute(text(f"DROP TRIGGER {name}"))
        connection.execute(text("DELETE FROM audit WHERE id = 2"))
        connection.execute(text("UPDATE audit_head SET number = 1, sha256 = (SELECT sha256 FROM audit)"))
        for _, sql in made:
            connection.execute(text(sql))
    assert cli.run(command[:3]) == 0
    assert cli.run(command) == 1
    assert "audit 2: expected the entry of the stored head, found none" in capsys.readouterr().out
    [file] = heads.iterdir()
    file.write_text(file.read_text().splitlines()[0].replace("1:", "0:") + "\n")
    assert cli.run(command) == 2
    assert "expected heads signed with the key of this service" in capsys.readouterr().err
