"""`linna db`: schema, roles, backup and retention of the database."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from linna.commands._ground import add_service_options, open_service, settings_of
from linna.errors import UsageError
from linna.output import add_json_flag, emit
from linna.parser import option

if TYPE_CHECKING:
    from ground_service.settings import Settings


def configure_db(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    upgrade = actions.add_parser("upgrade", help="upgrade the schema to this version")
    upgrade.set_defaults(handler=run_upgrade)
    granting = actions.add_parser("grant", help="grant a database role the least privileges that the service needs")
    option(granting, "--role NAME", str, "default: the user of $LINNA_DATABASE_URL")
    option(
        granting, "--backup", bool, "grant only the right to read, for backups; --role defaults to $LINNA_BACKUP_ROLE"
    )
    option(granting, "--print", bool, "print the SQL statements and do not run them")
    granting.set_defaults(handler=run_grant)
    status = actions.add_parser("status", help="show the schema revision of the database")
    status.set_defaults(handler=run_status)
    saving = actions.add_parser("backup", help="write the whole service into a new folder, while it runs")
    option(saving, "--out DIR", Path, required=True)
    saving.set_defaults(handler=run_backup)
    restoring = actions.add_parser("restore", help="fill an empty service from a backup, of SQLite or PostgreSQL")
    option(restoring, "folder", Path)
    restoring.set_defaults(handler=run_restore)
    tidying = actions.add_parser("tidy", help="delete old feed messages and old finished jobs")
    option(tidying, "--days", int, "delete what is older than this number of days (default: $LINNA_RETENTION_DAYS)")
    tidying.set_defaults(handler=run_tidy)
    decoding = actions.add_parser("redecode", help="decode the archive again with this version's dictionary")
    decoding.set_defaults(handler=run_redecode)
    for action in (upgrade, granting, status, saving, restoring, tidying, decoding):
        add_service_options(action)
        add_json_flag(action)


def run_upgrade(arguments: argparse.Namespace) -> int:
    from ground_service.store.database import prepare_database, schema_revisions
    from ground_service.store.roles import grant_backup, grant_service

    settings = settings_of(arguments)
    database = prepare_database(settings.resolved_migration_url(), upgrade=True)
    try:
        role = _service_role(settings)
        if role is not None:
            grant_service(database, role)
        if settings.backup_role is not None:
            grant_backup(database, settings.backup_role)
        return _show(arguments, *schema_revisions(database)[:2], database.label)
    finally:
        database.engine.dispose()


def run_grant(arguments: argparse.Namespace) -> int:
    from ground_service.store import roles
    from ground_service.store.database import prepare_database
    from ground_service.store.models import METADATA

    settings = settings_of(arguments)
    purpose = "backups" if arguments.backup else "the service"
    role = arguments.role or (settings.backup_role if arguments.backup else _service_role(settings))
    if role is None:
        raise UsageError(f"--role: expected the database role of {purpose}, found none")
    statements_of = roles.backup_statements if arguments.backup else roles.grant_statements
    grant = roles.grant_backup if arguments.backup else roles.grant_service
    if arguments.print:
        statements = list(statements_of(role, [*METADATA.tables, *roles.READ_ONLY]))
        return emit(arguments, {"role": role, "statements": statements}, text=";\n".join(statements) + ";")
    database = prepare_database(settings.resolved_migration_url())
    try:
        grant(database, role)
    finally:
        database.engine.dispose()
    return emit(arguments, {"role": role, "database": database.label}, text=f"{database.label}: granted to {role}")


def _service_role(settings: Settings) -> str | None:
    """Return the database role of the service; None if it is also the role of migrations."""
    from sqlalchemy import make_url

    service, owner = (make_url(url) for url in (settings.resolved_database_url(), settings.resolved_migration_url()))
    if settings.migration_database_url is None or service.username == owner.username:
        return None
    return service.username


def run_status(arguments: argparse.Namespace) -> int:
    from ground_service.store.database import open_database, schema_revisions

    database = open_database(settings_of(arguments).resolved_database_url())
    return _show(arguments, *schema_revisions(database)[:2], database.label)


def run_backup(arguments: argparse.Namespace) -> int:
    from ground_service.clock import utc_now_ns
    from ground_service.worker.backup import backup

    with open_service(arguments) as ground:
        manifest = backup(ground, arguments.out, now_utc_ns=utc_now_ns())
    head = manifest["audit_head"]
    text = (
        f"{arguments.out}: {sum(manifest['rows'].values())} rows, {manifest['files']} files, "
        f"audit head {head['number']}:{head['sha256']}"
    )
    return emit(arguments, {"folder": str(arguments.out), **manifest}, text=text)


def run_restore(arguments: argparse.Namespace) -> int:
    from ground_service.worker.backup import checked, restore

    with checked(arguments.folder):
        pass  # before a database is made for it
    with open_service(arguments) as ground:
        manifest = restore(arguments.folder, ground)
        label = ground.database.label
    text = f"{label}: {sum(manifest['rows'].values())} rows, {manifest['files']} files"
    return emit(arguments, {"database": label, **manifest}, text=text)


def run_tidy(arguments: argparse.Namespace) -> int:
    from ground_service.worker.upkeep import tidy

    days = arguments.days if arguments.days is not None else settings_of(arguments).retention_days
    with open_service(arguments) as ground:
        removed = tidy(ground, max(days, 0))
    return emit(arguments, {"removed": removed}, text=", ".join(f"{count} {name}" for name, count in removed.items()))


def run_redecode(arguments: argparse.Namespace) -> int:
    from ground_service.ingest.service import decode_all_again

    with open_service(arguments) as ground:
        rows = decode_all_again(ground)
    return emit(arguments, {"rows": rows}, text=f"{rows} rows")


def _show(arguments: argparse.Namespace, found: str | None, head: str, label: str) -> int:
    current = found or "none"
    return emit(
        arguments,
        {"database": label, "revision": found, "head": head, "current": found == head},
        text=f"{label}: revision {current}, newest {head}",
    )
