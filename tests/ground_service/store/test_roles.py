"""Privileges of the database role of the service with PostgreSQL."""

from dataclasses import dataclass

from pytest import MonkeyPatch, fixture, mark, raises
from sqlalchemy import create_engine, make_url, text
from sqlalchemy.exc import DBAPIError, ProgrammingError

from ground_service.access.service import audit
from ground_service.ground import ground_from_settings
from ground_service.ingest.service import ingest_file
from ground_service.settings import load_settings
from ground_service.store import repository
from ground_service.store.database import open_database
from ground_service.store.events import publish
from ground_service.store.models import METADATA
from ground_service.store.roles import PowerfulRole, check_role
from ground_service.worker.upkeep import tidy
from linna import cli

SERVICE = "linna_service"
BACKUP = "linna_backup"
OWNER = "linna_owner"


@dataclass(frozen=True)
class Roles:
    """URLs of one database as its superuser, the owner of the schema, the service, and backups."""

    superuser: str
    owner: str
    service: str
    backup: str


@fixture(scope="module")
def roles(new_postgres_database):
    superuser = new_postgres_database()
    database = make_url(superuser).database
    engine = create_engine(superuser, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        for name in (OWNER, SERVICE, BACKUP):
            connection.execute(text(f"CREATE ROLE {name} LOGIN"))
        connection.execute(text(f"ALTER DATABASE {database} OWNER TO {OWNER}"))
        connection.execute(text(f"ALTER SCHEMA public OWNER TO {OWNER}"))
    urls = [
        make_url(superuser).set(username=name).render_as_string(hide_password=False)
        for name in (OWNER, SERVICE, BACKUP)
    ]
    with MonkeyPatch.context() as patch:
        patch.setenv("LINNA_DATABASE_URL", urls[1])
        patch.setenv("LINNA_MIGRATION_DATABASE_URL", urls[0])
        patch.setenv("LINNA_BACKUP_ROLE", BACKUP)
        assert cli.run(["db", "upgrade"]) == 0
    yield Roles(superuser, *urls)
    # Roles belong to the server, which other modules share.
    with engine.connect() as connection:
        for name in (SERVICE, BACKUP, OWNER):
            connection.execute(text(f"REASSIGN OWNED BY {name} TO CURRENT_USER"))
            connection.execute(text(f"DROP OWNED BY {name}"))
            connection.execute(text(f"DROP ROLE {name}"))
    engine.dispose()


def assert_refused(url, statement):
    engine = create_engine(url, isolation_level="AUTOCOMMIT")
    try:
        with raises(DBAPIError) as error, engine.connect() as connection:
            connection.execute(text(statement))
    finally:
        engine.dispose()
    # insufficient_privilege, and nothing else, such as a name that is not there.
    assert getattr(error.value.orig, "sqlstate", None) == "42501"


REFUSED = """
UPDATE audit SET actor = 'nobody'
DELETE FROM audit
TRUNCATE audit
ALTER TABLE audit DISABLE TRIGGER ALL
DROP TRIGGER audit_no_update ON audit
ALTER TABLE users ADD COLUMN hidden text
DROP TABLE packets
TRUNCATE packets
CREATE TABLE mine (a int)
CREATE FUNCTION mine() RETURNS int LANGUAGE sql AS 'SELECT 1'
CREATE TRIGGER mine AFTER INSERT ON users EXECUTE FUNCTION linna_refuse_audit_change()
UPDATE alembic_version SET version_num = '9'
CREATE ROLE mine SUPERUSER
ALTER ROLE linna_service SUPERUSER
SET ROLE linna_owner
SET session_replication_role = replica
COPY (SELECT 1) TO PROGRAM 'true'
COPY users FROM '/etc/passwd'
SELECT pg_read_file('/etc/passwd')
ALTER SYSTEM SET archive_command = 'true'
CREATE EXTENSION file_fdw
"""


@mark.parametrize("statement", REFUSED.strip().splitlines())
def test_the_role_of_the_service_is_refused(roles, statement):
    assert_refused(roles.service, statement)


REFUSED_BACKUP = """
INSERT INTO users (name, role, state, created_utc_ns) VALUES ('a', 'admin', 'active', 0)
UPDATE users SET role = 'admin'
DELETE FROM jobs
TRUNCATE packets
DROP TABLE packets
CREATE TABLE mine (a int)
SELECT nextval('users_id_seq')
SET ROLE linna_service
COPY (SELECT 1) TO PROGRAM 'true'
"""


@mark.parametrize("statement", REFUSED_BACKUP.strip().splitlines())
def test_the_role_of_the_backup_cannot_write(roles, statement):
    assert_refused(roles.backup, statement)


def test_a_backup_is_made_with_the_role_of_the_backup_and_restored(roles, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LINNA_DATABASE_URL", roles.owner)
    monkeypatch.setenv("LINNA_HOME", str(tmp_path / "home"))
    assert cli.run(["user", "add", "bea", "--role", "viewer"]) == 0
    monkeypatch.setenv("LINNA_DATABASE_URL", roles.backup)
    assert cli.run(["db", "backup", "--out", str(tmp_path / "saved")]) == 0
    monkeypatch.delenv("LINNA_DATABASE_URL")
    monkeypatch.setenv("LINNA_HOME", str(tmp_path / "new"))
    assert cli.run(["db", "restore", str(tmp_path / "saved")]) == 0
    capsys.readouterr()
    assert cli.run(["user", "list"]) == 0
    assert "bea" in capsys.readouterr().out


@fixture
def empty(roles, new_postgres_database):
    """Another database of the server, without tables."""
    superuser = new_postgres_database()
    service = make_url(superuser).set(username=SERVICE).render_as_string(hide_password=False)
    yield Roles(superuser, superuser, service, "")
    engine = create_engine(superuser, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"DROP OWNED BY {SERVICE}"))
    engine.dispose()


def test_the_role_of_the_service_restores_a_backup_into_an_upgraded_database(empty, tmp_path, monkeypatch, capsys):
    """As the documentation says for the compose file: upgrade, restore, then the administrator."""
    monkeypatch.setenv("LINNA_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("LINNA_ADMIN_TOKEN", "token of the administrator, long")
    assert cli.run(["user", "ensure", "admin", "--role", "admin"]) == 0
    assert cli.run(["user", "add", "bea", "--role", "viewer"]) == 0
    assert cli.run(["db", "backup", "--out", str(tmp_path / "saved")]) == 0
    monkeypatch.setenv("LINNA_HOME", str(tmp_path / "new"))
    monkeypatch.setenv("LINNA_MIGRATION_DATABASE_URL", empty.owner)
    monkeypatch.setenv("LINNA_DATABASE_URL", empty.service)
    assert cli.run(["db", "upgrade"]) == 0
    assert cli.run(["db", "restore", str(tmp_path / "saved")]) == 0
    assert cli.run(["verify"]) == 0
    assert cli.run(["user", "ensure", "admin", "--role", "admin"]) == 0
    # The numbers of rows continue after those of the backup.
    assert cli.run(["user", "add", "cid", "--role", "viewer"]) == 0
    capsys.readouterr()
    assert cli.run(["user", "list"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in ("admin", "bea", "cid"))
    assert cli.run(["db", "restore", str(tmp_path / "saved")]) == 2
    assert "expected an empty service, found rows in" in capsys.readouterr().err


def test_granting_for_backups_takes_away_what_is_too_much(roles, monkeypatch, capsys):
    owner = create_engine(roles.owner, isolation_level="AUTOCOMMIT")
    with owner.connect() as connection:
        connection.execute(text(f"GRANT ALL ON ALL TABLES IN SCHEMA public TO {BACKUP}"))
    monkeypatch.setenv("LINNA_DATABASE_URL", roles.service)
    monkeypatch.setenv("LINNA_MIGRATION_DATABASE_URL", roles.owner)
    assert cli.run(["db", "grant", "--backup"]) == 2
    assert "role of backups, found none" in capsys.readouterr().err
    assert cli.run(["db", "grant", "--backup", "--role", BACKUP]) == 0
    with owner.connect() as connection:
        rights = connection.execute(
            text("SELECT DISTINCT privilege_type FROM information_schema.role_table_grants WHERE grantee = :name"),
            {"name": BACKUP},
        )
        assert set(rights.scalars()) == {"SELECT"}
    owner.dispose()


def test_the_service_does_its_work_with_its_role(roles, tmp_path, synthetic_pass, monkeypatch):
    monkeypatch.setenv("LINNA_ALLOW_DATABASE_OWNER", "false")
    settings = load_settings(home=tmp_path / "home", database_url=roles.service)
    with ground_from_settings(settings) as ground:
        ingest_file(ground, synthetic_pass.folder / "downlink.cadu", spacecraft_id=76, instance="a")
        with ground.database.writing() as connection:
            audit(connection, "tests", "user.add", "somebody", {})
            publish(connection, "test", {})
            publish(connection, "test", {})
        with ground.database.writing() as connection:
            connection.execute(repository.EVENT_LOG.update().values(utc_ns=1))
        assert tidy(ground, 30)["events"] >= 1


def test_a_role_with_more_power_than_the_service_needs_is_refused(roles, tmp_path, monkeypatch):
    monkeypatch.setenv("LINNA_ALLOW_DATABASE_OWNER", "false")
    for url, powers in (
        (roles.superuser, {"is a superuser", "can create roles", "owns tables", "can change the audit log"}),
        (roles.owner, {"owns tables", "can add to the schema", "can change the audit log"}),
    ):
        with raises(PowerfulRole, match="LINNA_MIGRATION_DATABASE_URL") as error:
            ground_from_settings(load_settings(home=tmp_path, database_url=url))
        assert powers <= set(error.value.powers)
        assert "is a superuser" in error.value.powers or url == roles.owner
    allowed = load_settings(home=tmp_path, database_url=roles.owner, allow_database_owner=True)
    ground_from_settings(allowed).close()


def test_one_right_too_many_is_noticed(roles):
    owner = create_engine(roles.owner, isolation_level="AUTOCOMMIT")
    database = open_database(roles.service)
    check_role(database)
    with owner.connect() as connection:
        for right in ("UPDATE", "DELETE", "TRUNCATE", "TRIGGER"):
            connection.execute(text(f"GRANT {right} ON audit TO {SERVICE}"))
            with raises(PowerfulRole, match="can change the audit log"):
                check_role(database)
            connection.execute(text(f"REVOKE {right} ON audit FROM {SERVICE}"))
        connection.execute(text(f"GRANT CREATE ON SCHEMA public TO {SERVICE}"))
        with raises(PowerfulRole, match="can add to the schema"):
            check_role(database)
    owner.dispose()
    database.engine.dispose()


def test_granting_again_takes_away_what_is_too_much(roles, monkeypatch, capsys):
    owner = create_engine(roles.owner, isolation_level="AUTOCOMMIT")
    with owner.connect() as connection:
        connection.execute(text(f"GRANT ALL ON ALL TABLES IN SCHEMA public TO {SERVICE}"))
        connection.execute(text(f"GRANT ALL ON SCHEMA public TO {SERVICE}"))
    owner.dispose()
    monkeypatch.setenv("LINNA_DATABASE_URL", roles.service)
    monkeypatch.setenv("LINNA_MIGRATION_DATABASE_URL", roles.owner)
    assert cli.run(["db", "grant"]) == 0
    database = open_database(roles.service)
    check_role(database)
    database.engine.dispose()
    capsys.readouterr()
    assert cli.run(["db", "grant", "--role", "nobody_known"]) == 2
    assert "expected the role nobody_known, found none" in capsys.readouterr().err
    assert cli.run(["db", "grant", "--print"]) == 0
    printed = capsys.readouterr().out
    assert f'GRANT SELECT, INSERT ON "audit" TO "{SERVICE}"' in printed
    assert f'GRANT SELECT ON "alembic_version" TO "{SERVICE}"' in printed


def test_the_service_cannot_take_the_schema_away(roles, monkeypatch):
    monkeypatch.setenv("LINNA_DATABASE_URL", roles.service)
    monkeypatch.delenv("LINNA_MIGRATION_DATABASE_URL", raising=False)
    database = open_database(roles.service)
    with raises(ProgrammingError, match="must be owner"):
        METADATA.drop_all(database.engine)
    with database.reading() as connection:
        assert connection.execute(text("SELECT count(*) FROM alembic_version")).scalar() == 1
    database.engine.dispose()


def test_sqlite_has_no_roles(tmp_path):
    check_role(open_database(f"sqlite:///{tmp_path / 'a.db'}"))
