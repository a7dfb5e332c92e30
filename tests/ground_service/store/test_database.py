"""The database: migrations, upgrades, versions, disks and values that it cannot hold, each in one clear line."""

import errno
import os
import shutil
import sqlite3
import subprocess
import sys
import threading

from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from pytest import fixture, mark, raises
from sqlalchemy import MetaData, delete, insert, inspect, select, text

from ground_service.access.service import add_user, list_users
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
from ground_service.store import database as stores
from ground_service.store import repository
from ground_service.store.database import (
    database_error,
    known_revisions,
    migrations_folder,
    oldest_program,
    open_database,
    prepare_database,
    schema_revisions,
    upgrade_database,
)
from ground_service.store.files import FileArchive
from ground_service.store.models import METADATA
from ground_service.store.repository import VEHICLES
from ground_service.store.roles import create_schema
from tests.ground_service.conftest import cells
from tests.ground_service.schema import described_schema
from tests.ground_service.store.schema_rules import RULE, breaking_changes
from tests.serving import wait_for


def url(path):
    return f"sqlite:///{path / 'linna.db'}"


def test_a_new_database_is_made_with_the_newest_schema(tmp_path):
    database = prepare_database(url(tmp_path / "deep/folder"))
    found, head, _ = schema_revisions(database)
    assert found == head
    with database.reading() as connection:
        assert compare_metadata(MigrationContext.configure(connection), METADATA) == []
    database.engine.dispose()


@mark.parametrize("kind", ["sqlite", "postgresql"])
def test_a_migrated_database_has_the_schema_of_the_models(tmp_path, new_postgres_database, kind):
    """A change of the tables without a migration fails here."""
    urls = [url(tmp_path / "a"), url(tmp_path / "b")]
    if kind == "postgresql":
        urls = [new_postgres_database(), new_postgres_database()]
    migrated, made = prepare_database(urls[0], upgrade=True), open_database(urls[1])
    with made.writing() as connection:
        METADATA.create_all(connection)
    assert described_schema(migrated) == described_schema(made)
    for database in migrated, made:
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
    with raises(DatabaseTooNew, match=r"linna\.db: expected schema revision \S+, found 9999 of a newer"):
        prepare_database(url(tmp_path))


@mark.parametrize("revision", ["0001", "0011"])
def test_a_database_before_version_1_is_refused_with_the_way_to_carry_it_over(tmp_path, revision):
    database = prepare_database(url(tmp_path))
    with database.writing() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = :found"), {"found": revision})
    database.engine.dispose()
    for upgrade in None, True, False:
        with raises(DatabaseTooOld) as caught:
            prepare_database(url(tmp_path), upgrade=upgrade)
    assert f"found {revision} of a version before 1.0" in str(caught.value)
    assert "into a new database with 'linna ingest'" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_empty_database_is_left_empty_where_it_may_not_be_upgraded(tmp_path):
    with raises(DatabaseNotMigrated, match="found none; run 'linna db upgrade'"):
        prepare_database(url(tmp_path), upgrade=False)


def test_a_file_that_is_no_database_is_refused_in_one_line(tmp_path):
    (tmp_path / "linna.db").write_bytes(b"not a database, but long enough to be looked at " * 40)
    with raises(DatabaseUnavailable, match="file is not a database; expected a SQLite database"):
        prepare_database(url(tmp_path))


@mark.parametrize("wrong", ["nonsense", "oracle+what://x", "postgresql+psycopg://nobody:secret@127.0.0.1:1/x"])
def test_a_database_that_cannot_be_reached_is_named_without_its_password(wrong):
    with raises(DatabaseUnavailable) as caught:
        prepare_database(wrong)
    assert "secret" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_connection_for_reading_refuses_changes(postgres_url):
    database = prepare_database(postgres_url, upgrade=True)
    changes = (insert(VEHICLES).values(ccsds_id=76, instance="flight"), delete(VEHICLES))
    for change in changes:
        with raises(RuntimeError, match="a connection for reading"), database.reading() as connection:
            connection.execute(change)
    with database.writing() as connection:
        connection.execute(changes[0])
    with database.reading() as connection:
        assert len(connection.execute(select(VEHICLES)).all()) == 1
    database.engine.dispose()


def test_a_write_that_fails_leaves_nothing_behind(tmp_path):
    database = prepare_database(url(tmp_path))
    with raises(RuntimeError), database.writing() as connection:
        connection.execute(text("INSERT INTO vehicles (ccsds_id, instance) VALUES (1, 'x')"))
        raise RuntimeError
    with database.reading() as connection:
        assert connection.execute(text("SELECT count(*) FROM vehicles")).scalar_one() == 0
    database.engine.dispose()


def test_a_full_database_is_one_clear_line(tmp_path):
    """SQLite itself says that it is full when it may take no more pages."""
    database = prepare_database(url(tmp_path))
    with raises(StorageFull, match="no space left"), database.writing() as connection:
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
    with raises(StorageReadOnly), database.writing() as connection:
        connection.execute(text("INSERT INTO vehicles (ccsds_id, instance) VALUES (1, 'x')"))
    database.engine.dispose()


@mark.parametrize(
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

    with raises(StorageFull):
        archive.put(broken())
    assert not [p for p in archive.root.rglob("*") if p.is_file()]


def test_a_damaged_file_is_noticed(tmp_path):
    archive = FileArchive(tmp_path / "files")
    stored = archive.put_octets(b"abcdef")
    stored.path.chmod(0o644)
    stored.path.write_bytes(b"abcdeg")
    with raises(FileDamaged, match="expected octets with SHA-256"):
        archive.get(stored.sha256)
    with raises(NotFound):
        archive.get("0" * 64)


def test_sqlite_can_be_opened_by_anything_else(tmp_path):
    """No lock is held and no transaction left open after use."""
    prepare_database(url(tmp_path)).engine.dispose()
    with sqlite3.connect(tmp_path / "linna.db") as connection:
        connection.execute("INSERT INTO vehicles (ccsds_id, instance) VALUES (1, 'x')")
    connection.close()


def test_a_commit_waits_for_the_standby_even_if_the_role_is_set_up_otherwise(new_postgres_database):
    url = new_postgres_database()
    for unsafe in "local", "remote_write", "off":
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
    with raises(DatabaseUnavailable, match=r"octets: .* encoding UTF8, found SQL_ASCII$"):
        prepare_database(url.rpartition("/")[0] + "/octets", upgrade=True)


@mark.parametrize(
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
        raises(InvalidInput, match="request: expected text and numbers that the database can hold") as refused,
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
        raises(InvalidInput, match="can hold"),
        ground.database.reading() as connection,
    ):
        repository.find(connection, repository.JOBS, id="a\x00")


@mark.parametrize("sqlstate", ["40001", "40P01", "55P03"])
def test_a_transaction_that_the_database_gave_up_may_be_tried_again(sqlstate):
    class Original(Exception):
        pass

    from sqlalchemy.exc import DBAPIError

    original = Original("deadlock detected")
    original.sqlstate = sqlstate
    error = database_error(DBAPIError("UPDATE", {}, original), "postgresql://secret@db/linna")
    assert isinstance(error, DatabaseBusy)
    assert "secret" not in str(error)


HEAD = known_revisions()[0]
EXPANSION = f"9.1_works_with_{HEAD}"
ADD = 'op.add_column("users", sa.Column("remark", sa.Text(), nullable=True))'


@fixture
def migrations(tmp_path, monkeypatch):
    """A function that makes this version one with a further migration."""
    folder = tmp_path / "migrations"
    shutil.copytree(migrations_folder(), folder)

    def add(revision, *statements):
        body = "".join(f"    {one}\n" for one in statements)
        (folder / "versions/9999_further.py").write_text(
            "import sqlalchemy as sa\nfrom alembic import op\n"
            f'revision = "{revision}"\ndown_revision = "{HEAD}"\n\ndef upgrade() -> None:\n{body}'
        )
        monkeypatch.setattr(stores, "migrations_folder", lambda: folder)

    return add


def reflected(database):
    metadata = MetaData()
    with database.reading() as connection:
        metadata.reflect(connection)
    return metadata


def changes_of(folder, migrations, *statements):
    before = reflected(prepare_database(f"sqlite:///{folder / 'one.db'}"))
    migrations(EXPANSION, *statements)
    return breaking_changes(before, reflected(prepare_database(f"sqlite:///{folder / 'one.db'}")))


@mark.parametrize(
    "statement",
    [
        ADD,
        'op.add_column("users", sa.Column("n", sa.Integer(), nullable=False, server_default="0"))',
        'op.create_table("remarks", sa.Column("id", sa.Integer(), primary_key=True))',
        'op.create_index("ix_users_expires", "users", ["role"])',
        'op.execute("ALTER TABLE users ADD COLUMN n INTEGER NOT NULL DEFAULT 1")',
    ],
)
def test_an_expansion_keeps_the_version_before_it_working(tmp_path, migrations, statement):
    assert changes_of(tmp_path, migrations, statement) == []


BREAKING = """
op.drop_table("leases") | leases: removed
op.drop_column("leases", "owner") | leases.owner: removed
op.create_index("ux", "users", ["role"], unique=True) | users: new unique index ux
with op.batch_alter_table("users") as b: b.alter_column("role", type_=sa.Integer()) | users.role: VARCHAR
"""


@mark.parametrize("statement, fault", cells(BREAKING))
def test_a_change_that_breaks_the_version_before_it_is_named(tmp_path, migrations, statement, fault):
    found = changes_of(tmp_path, migrations, statement)
    assert found[0].startswith(fault)


def test_every_shipped_expansion_follows_the_rule(tmp_path):
    oldest_first = known_revisions()[::-1]
    assert oldest_first[0] == "1.0"
    database = open_database(f"sqlite:///{tmp_path / 'one.db'}")
    states = {}
    for revision in oldest_first:
        stores.upgrade_database(database, revision)
        states[revision] = reflected(database)
        assert len(revision) <= 32  # width of the column of alembic_version
        found = breaking_changes(states[oldest_program(revision)], states[revision])
        assert found == [], f"{revision}: {RULE}"


def test_a_program_works_with_an_expanded_schema_and_with_no_other_newer_one(tmp_path, migrations, monkeypatch):
    url = f"sqlite:///{tmp_path / 'one.db'}"
    shipped = migrations_folder()
    migrations(EXPANSION, ADD)
    prepare_database(url).engine.dispose()
    monkeypatch.setattr(stores, "migrations_folder", lambda: shipped)
    database = prepare_database(url)
    with database.writing() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9.2_works_with_9.1'"))
    with raises(DatabaseTooNew, match=r"found 9\.2_works_with_9\.1 of a newer version"):
        prepare_database(url)


def of_version_1(database):
    """Make a database as version 1.0 left it: its schema, a user, and the triggers of row digests."""
    stores.upgrade_database(database, "1.0")
    statements = [
        "INSERT INTO users (name, role, state, created_utc_ns) VALUES ('ann', 'viewer', 'active', 1)",
        "INSERT INTO row_digests VALUES ('users', '1', 'x')",
    ]
    if database.dialect == "postgresql":
        statements += [
            "CREATE FUNCTION linna_digest_users() RETURNS trigger LANGUAGE plpgsql AS "
            "$$BEGIN INSERT INTO row_digests VALUES ('users', NEW.id::text, 'x'); RETURN NULL; END$$",
            "CREATE TRIGGER row_digest AFTER INSERT ON users FOR EACH ROW EXECUTE FUNCTION linna_digest_users()",
        ]
    with database.writing() as connection:
        for statement in statements:
            connection.exec_driver_sql(statement)


@mark.parametrize("kind", ["sqlite", "postgresql"])
def test_a_database_of_version_1_0_is_upgraded(tmp_path, new_postgres_database, kind):
    url = f"sqlite:///{tmp_path / 'linna.db'}" if kind == "sqlite" else new_postgres_database()
    old, made = open_database(url), open_database(f"sqlite:///{tmp_path / 'made.db'}")
    if kind == "postgresql":
        made = open_database(new_postgres_database())
    of_version_1(old)
    old.engine.dispose()
    prepare_database(url, upgrade=True).engine.dispose()
    with open_ground(tmp_path, database_url=url) as ground:
        assert [one.name for one in list_users(ground)] == ["ann"]
        add_user(ground, "bob", "viewer")
        with made.writing() as connection:
            METADATA.create_all(connection)
        assert described_schema(ground.database) == described_schema(made)
        if kind == "postgresql":
            with ground.database.reading() as connection:
                left = "SELECT count(*) FROM pg_proc WHERE starts_with(proname, 'linna_digest')"
                assert connection.execute(text(left)).scalar() == 0
    made.engine.dispose()


@mark.parametrize("kind", ["sqlite", "postgresql"])
def test_a_snapshot_of_the_schema_makes_the_tables_of_this_version(tmp_path, new_postgres_database, kind):
    found, made = (
        open_database(f"sqlite:///{tmp_path / name}" if kind == "sqlite" else new_postgres_database())
        for name in ("found", "made")
    )
    command = [sys.executable, "-m", "ground_service.store.roles", str(tmp_path / "schema.json")]
    subprocess.run(command, check=True)
    with found.writing() as connection:
        create_schema(connection, tmp_path / "schema.json")
    with made.writing() as connection:
        METADATA.create_all(connection)
    assert described_schema(found) == described_schema(made) != {}
    for database in found, made:
        database.engine.dispose()


def test_a_migration_gives_way_to_requests_that_hold_locks(new_postgres_database, tmp_path, migrations):
    url = new_postgres_database()
    prepare_database(url, upgrade=True).engine.dispose()
    with open_ground(tmp_path / "home", database_url=url) as ground:
        add_user(ground, "ann", "viewer")
        migrations(EXPANSION, ADD, 'op.add_column("jobs", sa.Column("remark", sa.Text(), nullable=True))')
        other = open_database(url)
        upgrade = threading.Thread(target=upgrade_database, args=(other,), daemon=True)
        tried = text("SELECT count(*) FROM pg_locks WHERE NOT granted AND relation = 'jobs'::regclass")
        with ground.database.writing() as connection:
            connection.execute(text("SELECT count(*) FROM jobs"))
            upgrade.start()

            def waits():
                with other.reading() as looking:
                    return bool(looking.execute(tried).scalar())

            wait_for(waits, "the migration to wait for the table of jobs")
            # The migration has locked users and waits for jobs; without its limit this is a deadlock.
            connection.execute(text("UPDATE users SET role = role"))
        upgrade.join()
        assert not upgrade.is_alive()
        assert set(METADATA.tables["users"].columns.keys()) < set(reflected(other).tables["users"].columns.keys())
        assert [one.name for one in list_users(ground)] == ["ann"]
        other.engine.dispose()


def test_all_connections_of_a_process_together_keep_at_most_thirty_two_mib_of_pages(tmp_path):
    engine = open_database(f"sqlite:///{tmp_path / 'linna.db'}").engine
    with engine.connect() as connection:
        kept_kib = -connection.exec_driver_sql("PRAGMA cache_size").scalar_one()
    most = engine.pool.size() + engine.pool._max_overflow
    assert most == 15 and 1024 <= kept_kib <= 32 * 1024 / most
