"""Upgrades without interruption: expansions of the schema, versions side by side, locks, databases of version 1.0."""

import shutil
import subprocess
import sys
import threading

import pytest
from sqlalchemy import MetaData, text

from ground_service.access.service import add_user, list_users
from ground_service.errors import DatabaseTooNew
from ground_service.ground import open_ground
from ground_service.store import database as stores
from ground_service.store.database import (
    known_revisions,
    migrations_folder,
    oldest_program,
    open_database,
    prepare_database,
    upgrade_database,
)
from ground_service.store.models import METADATA
from ground_service.store.roles import create_schema
from tests.ground_service.conftest import cells
from tests.ground_service.schema import described_schema
from tests.ground_service.store.schema_rules import RULE, breaking_changes
from tests.serving import wait_for

HEAD = known_revisions()[0]
EXPANSION = f"9.1_works_with_{HEAD}"
ADD = 'op.add_column("users", sa.Column("remark", sa.Text(), nullable=True))'


@pytest.fixture
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


@pytest.mark.parametrize(
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


@pytest.mark.parametrize("statement, fault", cells(BREAKING))
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
    with pytest.raises(DatabaseTooNew, match=r"found 9\.2_works_with_9\.1 of a newer version"):
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


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
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


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
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
    for database in (found, made):
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
        upgrade.join(60.0)
        assert not upgrade.is_alive()
        assert set(METADATA.tables["users"].columns.keys()) < set(reflected(other).tables["users"].columns.keys())
        assert [one.name for one in list_users(ground)] == ["ann"]
        other.engine.dispose()
