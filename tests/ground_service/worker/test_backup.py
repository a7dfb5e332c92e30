"""Backup and restore: all data are restored, damage is reported, nothing is overwritten."""

import hashlib
import json
import re
import sqlite3

from pytest import fixture, mark, raises
from sqlalchemy import select, text

from ground_service.access.service import add_user, authenticate, list_users
from ground_service.errors import Conflict, FileDamaged, InvalidInput, NotFound
from ground_service.evaluation.service import pass_summary
from ground_service.ground import open_ground
from ground_service.passes.archive_import import import_archive
from ground_service.planning.service import WindowEntry, add_window, change_window
from ground_service.store.audit import read_head
from ground_service.store.database import open_database, upgrade_database
from ground_service.store.models import METADATA
from ground_service.store.rows import table_digests
from ground_service.worker.backup import backup, restore
from linna import cli

NS = 1_000_000_000
START = 2_000_000_000 * NS


def everything(ground):
    with ground.database.reading() as connection:
        return {
            table.name: sorted(map(tuple, connection.execute(select(table))), key=str)
            for table in METADATA.sorted_tables
        }


def rows_of_an_empty_service(ground):
    """Check that the database contains only the head of an empty audit chain."""
    return {name: rows for name, rows in everything(ground).items() if rows} == {"audit_head": [(1, 0, "0" * 64)]}


@fixture
def filled(ground, synthetic_pass):
    import_archive(ground, synthetic_pass.folder)
    for k in (2, 1):
        start = START + k * 100 * NS
        add_window(ground, WindowEntry(f"w{k}", start, start + 50 * NS, 15.0, 76), actor="ann")
    change_window(ground, 1, actor="ann", changes={"predecessor_id": 2})  # it names a window with a greater key
    return ground, add_user(ground, "ann", "operator")


@fixture
def saved(filled, tmp_path):
    manifest = backup(filled[0], tmp_path / "saved", now_utc_ns=START)
    assert manifest["made_utc"] == "2033-05-18T03:33:20.000Z"
    yield tmp_path / "saved"


def test_everything_comes_back(filled, saved, tmp_path):
    ground, token = filled
    with open_ground(tmp_path / "again") as other:
        restore(saved, other)
        assert everything(other) == everything(ground)
        assert authenticate(other, token).name == "ann"
        assert pass_summary(other, 1) == pass_summary(ground, 1)
        add_window(other, WindowEntry("new", START, START + NS, 1.0, 76), actor="bob")  # keys go on behind
        with raises(Conflict, match="expected an empty service, found"):
            restore(saved, other)


def test_a_backup_overwrites_nothing(filled, saved):
    before = (saved / "linna.db").read_bytes()
    with raises(Conflict, match="expected a folder that is new or empty"):
        backup(filled[0], saved, now_utc_ns=START)
    assert (saved / "linna.db").read_bytes() == before


@mark.parametrize("file", [0, -1])
def test_a_damaged_file_is_found_before_anything_is_restored(saved, tmp_path, file):
    damaged = sorted(path for path in (saved / "files").rglob("*") if path.is_file())[file]
    damaged.chmod(0o644)
    damaged.write_bytes(b"x" + damaged.read_bytes())
    with open_ground(tmp_path / "again") as other:
        with raises(FileDamaged):
            restore(saved, other)
        assert rows_of_an_empty_service(other)
        assert not [path for path in other.files.root.rglob("*") if path.is_file()]
        damaged.unlink()
        with raises(NotFound):
            restore(saved, other)


CHANGES = """\
UPDATE windows SET cadence_s = 15.000000000000002 | windows: expected the rows that were saved
UPDATE packets SET ticks = ticks + 1 WHERE id = 3 | packets: expected the rows that were saved
UPDATE housekeeping SET power_w = power_w + 1e-9 | housekeeping: expected the rows that were saved
DELETE FROM tokens | tokens: expected 1 rows, found 0
INSERT INTO vehicles (ccsds_id, instance) VALUES (3, 'x') | vehicles: expected
UPDATE audit_head SET number = 2 | audit_head: expected the rows that were saved"""


@mark.parametrize("row", CHANGES.splitlines())
def test_a_changed_row_of_a_backup_is_not_restored(saved, tmp_path, row):
    statement, reason = row.split(" | ")
    with sqlite3.connect(saved / "linna.db") as connection:
        connection.execute(statement)
    connection.close()
    with open_ground(tmp_path / "again") as other:
        with raises(InvalidInput, match=re.escape(reason)):
            restore(saved, other)
        assert rows_of_an_empty_service(other)


def test_a_restore_that_is_refused_makes_no_database(saved, tmp_path, capsys):
    next(path for path in (saved / "files").rglob("*") if path.is_file()).write_bytes(b"changed")
    assert cli.run(["db", "restore", str(saved), "--home", str(tmp_path / "new")]) == 2
    assert "expected octets with SHA-256" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_changed_list_of_a_backup_is_not_believed(saved, tmp_path):
    manifest = json.loads((saved / "backup.json").read_text())
    assert manifest["audit_head"]["number"] == manifest["rows"]["audit"] == 5
    for changes, reason in (
        ({"schema_version": 1}, "schema_version: expected 2"),
        ({"files_sha256": "0" * 64}, "expected the files that were saved"),
        ({"audit_head": {"number": 4, "sha256": "0" * 64}}, "expected the head of the audit chain"),
        ({"tables": {}}, "expected the rows that were saved"),
    ):
        (saved / "backup.json").write_text(json.dumps({**manifest, **changes}))
        with open_ground(tmp_path / "again") as other, raises(InvalidInput, match=reason):
            restore(saved, other)
    with open_ground(tmp_path / "again") as other, raises(InvalidInput, match="expected a backup"):
        restore(tmp_path, other)


def test_a_backup_of_version_1_0_is_restored(tmp_path):
    """It has tables that are gone now; digests are those of its own columns."""
    saved = tmp_path / "saved"
    saved.mkdir()
    database = open_database(f"sqlite:///{saved / 'linna.db'}")
    upgrade_database(database, "1.0")
    user = "INSERT INTO users (name, role, state, created_utc_ns) VALUES ('ann', 'viewer', 'active', 1)"
    with database.writing() as connection:
        for statement in (user, "INSERT INTO row_digests VALUES ('users', '1', 'x')"):
            connection.execute(text(statement))
    with database.snapshot() as connection:
        tables, head = table_digests(connection), read_head(connection)
    database.engine.dispose()
    manifest = {
        "schema_version": 2, "rows": {name: one.rows for name, one in tables.items()},
        "tables": {name: one.sha256 for name, one in tables.items()}, "files": 0,
        "files_sha256": hashlib.sha256(b"").hexdigest(),
        "audit_head": {"number": head.number, "sha256": head.sha256},
    }  # fmt: skip
    assert "row_digests" not in tables
    (saved / "backup.json").write_text(json.dumps(manifest))
    (saved / "linna.db").chmod(0o400)
    before = (saved / "linna.db").read_bytes()
    with open_ground(tmp_path / "again") as other:
        restore(saved, other)
        assert [one.name for one in list_users(other)] == ["ann"]
    assert (saved / "linna.db").read_bytes() == before
