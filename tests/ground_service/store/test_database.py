"""The database: migrations, versions, and what goes wrong with disks, each in one clear line. Values that a
database cannot hold are refused in one line on both databases, without the address of the database.
"""

import errno
import os
import sqlite3

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import delete, insert, inspect, select, text

from ground_service.errors import (
    DatabaseBusy,
    DatabaseNotMigrated,
    DatabaseTooNew,
    DatabaseTooOld,
    DatabaseUnavailable,
    FileDamaged,
    InvalidInput,
    NotFound,
    StorageFull,
    StorageReadOnly,
    public_text,
    storage_error,
)
from ground_service.ground import open_ground
from ground_service.http.model import Paging
from ground_service.store import repository
from ground_service.store.database import database_error, open_database, prepare_database, schema_revisions
from ground_service.store.files import FileArchive
from ground_service.store.models import METADATA
from ground_service.store.repository import VEHICLES
from tests.ground_service.schema import described_schema


def url(path):
    return f"sqlite:///{path / 'linna.db'}"


def test_a_new_database_is_made_with_the_newest_schema(tmp_path):
    database = prepare_database(url(tmp_path / "deep" / "folder"))
    found, head, _ = schema_revisions(database)
    assert found == head
    with database.reading() as connection:
        assert compare_metadata(MigrationContext.configure(connection), METADATA) == []
    database.engine.dispose()


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_a_migrated_database_has_the_schema_of_the_models(tmp_path, new_postgres_database, kind):
    """A change of the tables without a migration fails here."""
    urls = [url(tmp_path / "a"), url(tmp_path / "b")]
    if kind == "postgresql":
        urls = [new_postgres_database(), new_postgres_database()]
    migrated, made = prepare_database(urls[0], upgrade=True), open_database(urls[1])
    with made.writing() as connection:
        METADATA.create_all(connection)
    assert described_schema(migrated) == described_schema(made)
    for database in (migrated, made):
        database.engine.dispose()


def test_samples_are_clustered_by_time(tmp_path):
    """The primary key leads with vehicle, dictionary and time: a time range is one contiguous read."""
    database = prepare_database(url(tmp_path))
    with database.reading() as connection:
        made = connection.execute(text("SELECT sql FROM sqlite_master WHERE name = 'navigation_states'")).scalar_one()
        key = inspect(connection).get_pk_constraint("navigation_states")["constrained_columns"]
    assert "WITHOUT ROWID" in made
    assert key == ["vehicle_id", "dictionary_version", "ticks", "packet_id"]
    database.engine.dispose()


def test_a_database_of_a_newer_version_is_left_alone(tmp_path):
    database = prepare_database(url(tmp_path))
    with database.writing() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    database.engine.dispose()
    with pytest.raises(DatabaseTooNew, match=r"linna\.db: expected schema revision \S+, found 9999 of a newer"):
        prepare_database(url(tmp_path))


@pytest.mark.parametrize("revision", ["0001", "0011"])
def test_a_database_before_version_1_is_refused_with_the_way_to_carry_it_over(tmp_path, revision):
    database = prepare_database(url(tmp_path))
    with database.writing() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = :found"), {"found": revision})
    database.engine.dispose()
    for upgrade in (None, True, False):
        with pytest.raises(DatabaseTooOld) as caught:
            prepare_database(url(tmp_path), upgrade=upgrade)
    assert f"found {revision} of a version before 1.0" in str(caught.value)
    assert "into a new database with 'linna ingest'" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_empty_database_is_left_empty_where_it_may_not_be_upgraded(tmp_path):
    with pytest.raises(DatabaseNotMigrated, match="found none; run 'linna db upgrade'"):
        prepare_database(url(tmp_path), upgrade=False)


def test_a_file_that_is_no_database_is_refused_in_one_line(tmp_path):
    (tmp_path / "linna.db").write_bytes(b"not a database, but long enough to be looked at " * 40)
    with pytest.raises(DatabaseUnavailable, match="file is not a database; expected a SQLite database"):
        prepare_database(url(tmp_path))


@pytest.mark.parametrize("wrong", ["nonsense", "oracle+what://x", "postgresql+psycopg://nobody:secret@127.0.0.1:1/x"])
def test_a_database_that_cannot_be_reached_is_named_without_its_password(wrong):
    with pytest.raises(DatabaseUnavailable) as caught:
        prepare_database(wrong)
    assert "secret" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_connection_for_reading_refuses_changes(postgres_url):
    database = prepare_database(postgres_url, upgrade=True)
    changes = (insert(VEHICLES).values(ccsds_id=76, instance="flight"), delete(VEHICLES))
    for change in changes:
        with pytest.raises(RuntimeError, match="a connection for reading"), database.reading() as connection:
            connection.execute(change)
    with database.writing() as connection:
        connection.execute(changes[0])
    with database.reading() as connection:
        assert len(connection.execute(select(VEHICLES)).all()) == 1
    database.engine.dispose()


def test_a_write_that_fails_leaves_nothing_behind(tmp_path):
    database = prepare_database(url(tmp_path))
    with pytest.raises(RuntimeError), database.writing() as connection:
        connection.execute(text("INSERT INTO vehicles (ccsds_id, instance) VALUES (1, 'x')"))
        raise RuntimeError
    with database.reading() as connection:
        assert connection.execute(text("SELECT count(*) FROM vehicles")).scalar_one() == 0
    database.engine.dispose()


def test_a_full_database_is_one_clear_line(tmp_path):
    """SQLite itself says that it is full when it may take no more pages."""
    database = prepare_database(url(tmp_path))
    with pytest.raises(StorageFull, match="no space left"), database.writing() as connection:
        pages = connection.execute(text("PRAGMA page_count")).scalar_one()
        connection.execute(text(f"PRAGMA max_page_count = {pages}"))
        for number in range(2000):
            connection.execute(
                text("INSERT INTO vehicles (ccsds_id, instance) VALUES (:n, :i)"), {"n": number, "i": "x" * 90}
            )
    database.engine.dispose()


def test_a_read_only_database_is_one_clear_line(tmp_path):
    prepare_database(url(tmp_path)).engine.dispose()
    database = open_database(f"sqlite:///file:{tmp_path / 'linna.db'}?mode=ro&uri=true")
    with pytest.raises(StorageReadOnly), database.writing() as connection:
        connection.execute(text("INSERT INTO vehicles (ccsds_id, instance) VALUES (1, 'x')"))
    database.engine.dispose()


@pytest.mark.parametrize(
    "number, kind", [(errno.ENOSPC, StorageFull), (errno.EROFS, StorageReadOnly), (errno.EACCES, StorageReadOnly)]
)
def test_errors_of_the_disk_are_named(number, kind):
    error = storage_error(OSError(number, os.strerror(number)), "/archive")
    assert isinstance(error, kind)
    assert str(error).startswith("/archive: ")


def test_a_file_is_stored_once_and_cannot_be_changed(tmp_path):
    archive = FileArchive(tmp_path / "files")
    first = archive.put([b"abc", b"def"])
    assert archive.put_octets(b"abcdef") == first
    assert archive.get(first.sha256) == b"abcdef"
    assert [p.name for p in archive.root.rglob("*") if p.is_file()] == [first.sha256]
    assert first.path.stat().st_mode & 0o222 == 0


def test_a_file_cut_off_while_stored_leaves_nothing(tmp_path):
    archive = FileArchive(tmp_path / "files")

    def broken():
        yield b"abc"
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(StorageFull):
        archive.put(broken())
    assert not [p for p in archive.root.rglob("*") if p.is_file()]


def test_a_damaged_file_is_noticed(tmp_path):
    archive = FileArchive(tmp_path / "files")
    stored = archive.put_octets(b"abcdef")
    stored.path.chmod(0o644)
    stored.path.write_bytes(b"abcdeg")
    with pytest.raises(FileDamaged, match="expected octets with SHA-256"):
        archive.get(stored.sha256)
    with pytest.raises(NotFound):
        archive.get("0" * 64)


def test_sqlite_can_be_opened_by_anything_else(tmp_path):
    """No lock is held and no transaction left open after use."""
    prepare_database(url(tmp_path)).engine.dispose()
    with sqlite3.connect(tmp_path / "linna.db") as connection:
        connection.execute("INSERT INTO vehicles (ccsds_id, instance) VALUES (1, 'x')")
    connection.close()


def test_a_commit_waits_for_the_standby_even_if_the_role_is_set_up_otherwise(new_postgres_database):
    url = new_postgres_database()
    for unsafe in ("local", "remote_write", "off"):
        database = open_database(f"{url}?options=-csynchronous_commit%3D{unsafe}")
        with database.reading() as connection:
            assert connection.execute(text("SHOW synchronous_commit")).scalar() == "on"
        database.engine.dispose()


def test_a_database_of_another_encoding_is_refused_in_one_line(new_postgres_database):
    """Its texts come back as octets."""
    url = new_postgres_database()
    engine = open_database(url).engine.execution_options(isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text("CREATE DATABASE octets ENCODING 'SQL_ASCII' LOCALE 'C' TEMPLATE template0"))
    engine.dispose()
    with pytest.raises(DatabaseUnavailable, match=r"octets: .* encoding UTF8, found SQL_ASCII$"):
        prepare_database(url.rpartition("/")[0] + "/octets", upgrade=True)


@pytest.mark.parametrize(
    "values",
    [
        {"result": {"value": float("nan")}}, {"result": {"value": [1.0, float("inf")]}}, {"attempts": 10**20},
        {"created_utc_ns": -(2**70)}, {"error": "half of a pair \ud800"},
    ],
)  # fmt: skip
def test_a_value_that_no_database_can_hold_is_refused(either, values):
    row = {
        "id": "j", "kind": "report", "state": "queued", "arguments": {}, "progress": 0.0, "attempts": 0,
        "created_utc_ns": 1, **values,
    }  # fmt: skip
    with (
        pytest.raises(InvalidInput, match="request: expected text and numbers that the database can hold") as refused,
        either.database.writing() as connection,
    ):
        repository.add(connection, repository.JOBS, **row)
    assert "://" not in public_text(refused.value)
    with either.database.reading() as connection:
        assert repository.newest(connection, repository.JOBS, Paging())[1] == 0


def test_text_with_nul_is_refused_by_postgresql_as_input(migrated_postgres, tmp_path):
    url = migrated_postgres()
    with (
        open_ground(tmp_path, database_url=url) as ground,
        pytest.raises(InvalidInput, match="can hold"),
        ground.database.reading() as connection,
    ):
        repository.find(connection, repository.JOBS, id="a\x00")


@pytest.mark.parametrize("sqlstate", ["40001", "40P01", "55P03"])
def test_a_transaction_that_the_database_gave_up_may_be_tried_again(sqlstate):
    class Original(Exception):
        pass

    from sqlalchemy.exc import DBAPIError

    original = Original("deadlock detected")
    original.sqlstate = sqlstate
    error = database_error(DBAPIError("UPDATE", {}, original), "postgresql://secret@db/linna")
    assert isinstance(error, DatabaseBusy)
    assert "secret" not in str(error)


def test_all_connections_of_a_process_together_keep_at_most_thirty_two_mib_of_pages(tmp_path):
    engine = open_database(f"sqlite:///{tmp_path / 'linna.db'}").engine
    with engine.connect() as connection:
        kept_kib = -connection.exec_driver_sql("PRAGMA cache_size").scalar_one()
    most = engine.pool.size() + engine.pool._max_overflow
    assert most == 15 and 1024 <= kept_kib <= 32 * 1024 / most
