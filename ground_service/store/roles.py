"""Roles of a PostgreSQL database (owner of the schema, limited service); frozen schema of a release.

The service reads and writes rows. It is not a superuser, owns nothing, cannot change the schema, and can add entries to
the audit log but neither change nor remove them. Migrations run as the owner, who then grants the service its
privileges.
"""

import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from sqlalchemy import Connection, text
from sqlalchemy.engine import Dialect
from sqlalchemy.exc import DBAPIError
from sqlalchemy.schema import CreateIndex, CreateTable

from ground_service.errors import DatabaseUnavailable, StoreError
from ground_service.store.database import Database
from ground_service.store.models import METADATA

READ_ONLY = ("alembic_version",)
APPEND_ONLY = ("audit",)


class PowerfulRole(StoreError):
    """The database role of the service has more privileges than the service needs."""

    def __init__(self, label: str, powers: list[str]) -> None:
        super().__init__(
            f"database {label}: expected a role that can only read and write rows, found one that "
            f"{', '.join(powers)}; remedy: run `linna db upgrade` with LINNA_MIGRATION_DATABASE_URL of the owner, "
            "which grants the role of LINNA_DATABASE_URL its privileges, or set LINNA_ALLOW_DATABASE_OWNER=true"
        )
        self.powers = tuple(powers)


def grant_statements(role: str, tables: list[str]) -> Iterator[str]:
    """Yield SQL that grants a role the privileges on all tables that the service needs and revokes all others."""
    name = quoted(role)
    yield from _without_rights(name)
    for table in sorted(tables):
        rights = "SELECT, INSERT, UPDATE, DELETE"
        if table in READ_ONLY:
            rights = "SELECT"
        elif table in APPEND_ONLY:
            rights = "SELECT, INSERT"
        yield f"GRANT {rights} ON {quoted(table)} TO {name}"
    yield f"GRANT USAGE, SELECT, UPDATE ON ALL SEQUENCES IN SCHEMA public TO {name}"


def backup_statements(role: str, tables: list[str]) -> Iterator[str]:
    """Yield SQL that lets a role read every table and nothing else, for backups."""
    name = quoted(role)
    yield from _without_rights(name)
    yield f"REVOKE ALL ON ALL SEQUENCES IN SCHEMA public FROM {name}"
    for table in sorted(tables):
        yield f"GRANT SELECT ON {quoted(table)} TO {name}"


def _without_rights(name: str) -> Iterator[str]:
    """Yield SQL that leaves a role, and everyone, no right but to see the schema; `name` is quoted."""
    yield "REVOKE ALL ON SCHEMA public FROM PUBLIC"
    yield f"REVOKE ALL ON SCHEMA public FROM {name}"
    yield f"GRANT USAGE ON SCHEMA public TO {name}"
    yield f"REVOKE ALL ON ALL TABLES IN SCHEMA public FROM PUBLIC, {name}"


def grant_service(database: Database, role: str) -> None:
    """Grant a role the privileges of the service, as the owner of the schema; a repeated call changes nothing.

    Raises
    ------
    DatabaseUnavailable
        There is no such role, or it is the owner.
    """
    _grant(database, role, grant_statements)


def grant_backup(database: Database, role: str) -> None:
    """Grant a role the right to read all tables, as the owner of the schema; a repeated call changes nothing.

    Raises
    ------
    DatabaseUnavailable
        There is no such role, or it is the owner.
    """
    _grant(database, role, backup_statements)


def _grant(database: Database, role: str, statements_of: Callable[[str, list[str]], Iterator[str]]) -> None:
    with database.writing() as connection:
        owner = connection.execute(text("SELECT current_user")).scalar_one()
        if owner == role:
            raise DatabaseUnavailable(database.label, f"expected another role than the owner {role}")
        query = text("SELECT 1 FROM pg_roles WHERE rolname = :name")
        if connection.execute(query, {"name": role}).scalar() is None:
            raise DatabaseUnavailable(
                database.label, f"expected the role {role}, found none; CREATE ROLE {quoted(role)} LOGIN PASSWORD ..."
            )
        tables = connection.scalars(text("SELECT tablename FROM pg_tables WHERE schemaname = 'public'"))
        for statement in statements_of(role, list(tables)):
            connection.execute(text(statement))


def powers_of(connection: Connection) -> list[str]:
    """Return the privileges of the role of this connection that the service does not need."""
    questions = {
        "is a superuser": "SELECT rolsuper FROM pg_roles WHERE rolname = current_user",
        "can create roles": "SELECT rolcreaterole FROM pg_roles WHERE rolname = current_user",
        "can replicate": "SELECT rolreplication FROM pg_roles WHERE rolname = current_user",
        "can run programs or access files of the server": (
            "SELECT bool_or(pg_has_role(current_user, oid, 'USAGE')) FROM pg_roles WHERE rolname IN "
            "('pg_execute_server_program', 'pg_read_server_files', 'pg_write_server_files')"
        ),
        "owns tables": (
            "SELECT EXISTS (SELECT 1 FROM pg_class WHERE relnamespace = 'public'::regnamespace "
            "AND pg_has_role(current_user, relowner, 'USAGE'))"
        ),
        "can add to the schema": "SELECT has_schema_privilege(current_user, 'public', 'CREATE')",
        "can change the audit log": (
            "SELECT bool_or(has_table_privilege(current_user, c.oid, 'UPDATE, DELETE, TRUNCATE, TRIGGER')) "
            "FROM pg_class c WHERE c.relname = 'audit' AND c.relnamespace = 'public'::regnamespace"
        ),
    }
    return [name for name, query in questions.items() if connection.execute(text(query)).scalar()]


def check_role(database: Database) -> None:
    """Refuse a role with more privileges than the service needs; SQLite has no roles.

    Raises
    ------
    PowerfulRole
        The role has such privileges.
    """
    if database.dialect != "postgresql":
        return
    with database.reading() as connection:
        try:
            powers = powers_of(connection)
        except DBAPIError as error:
            raise DatabaseUnavailable(database.label, str(error.orig).splitlines()[0]) from None
    if powers:
        raise PowerfulRole(database.label, powers)


def quoted(name: str) -> str:
    """Return a quoted SQL identifier."""
    return '"' + name.replace('"', '""') + '"'


def schema_statements(dialect: Dialect) -> list[str]:
    """Return the statements that create all tables and indexes, referenced tables first."""
    made: list[CreateTable | CreateIndex] = []
    for table in METADATA.sorted_tables:
        made.append(CreateTable(table))
        made += map(CreateIndex, sorted(table.indexes, key=lambda index: str(index.name)))
    return [re.sub(r"\s+", " ", str(one.compile(dialect=dialect))).strip() for one in made]


def create_schema(connection: Connection, snapshot: Path) -> None:
    """Create the tables of a snapshot in an empty database."""
    for statement in json.loads(snapshot.read_text(encoding="utf-8"))[connection.dialect.name]:
        connection.exec_driver_sql(statement)


if __name__ == "__main__":
    from sqlalchemy.dialects import postgresql, sqlite

    statements = {one.dialect.name: schema_statements(one.dialect()) for one in (sqlite, postgresql)}
    Path(sys.argv[1]).write_text(json.dumps(statements, indent=1) + "\n", encoding="utf-8")
