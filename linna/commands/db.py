"""`linna db upgrade | downgrade | status | backup | restore | tidy | redecode`: the database of the ground."""

from __future__ import annotations

import argparse
from pathlib import Path

from linna.commands._ground import add_service_options, open_service, settings_of
from linna.output import add_json_flag, emit


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    upgrade = actions.add_parser("upgrade", help="bring the schema to this version")
    upgrade.set_defaults(handler=run_upgrade)
    downgrade = actions.add_parser("downgrade", help="take the schema back to an earlier revision")
    downgrade.add_argument("revision", help="the revision, or base for an empty database")
    downgrade.set_defaults(handler=run_downgrade)
    status = actions.add_parser("status", help="which revision the database has")
    status.set_defaults(handler=run_status)
    saving = actions.add_parser("backup", help="write the whole service into a new folder, while it runs")
    saving.add_argument("--out", type=Path, required=True, metavar="DIR")
    saving.set_defaults(handler=run_backup)
    restoring = actions.add_parser("restore", help="fill an empty service from a backup")
    restoring.add_argument("folder", type=Path)
    restoring.set_defaults(handler=run_restore)
    tidying = actions.add_parser("tidy", help="take away the feed and finished jobs that are old")
    tidying.add_argument("--days", type=int, help="older than this (default: $LINNA_RETENTION_DAYS)")
    tidying.set_defaults(handler=run_tidy)
    decoding = actions.add_parser("redecode", help="decode the archive again with this version's dictionary")
    decoding.set_defaults(handler=run_redecode)
    for action in (upgrade, downgrade, status, saving, restoring, tidying, decoding):
        add_service_options(action)
        add_json_flag(action)


def run_upgrade(arguments: argparse.Namespace) -> int:
    from ground_service.store.database import prepare_database, schema_revisions

    url = settings_of(arguments).resolved_database_url()
    database = prepare_database(url, upgrade=True)
    return _show(arguments, *schema_revisions(database)[:2], database.label)


def run_downgrade(arguments: argparse.Namespace) -> int:
    from ground_service.store.database import downgrade_database, open_database, schema_revisions
    from linna.errors import UsageError

    database = open_database(settings_of(arguments).resolved_database_url())
    known = schema_revisions(database)[2]
    if arguments.revision not in (*known, "base"):
        raise UsageError(f"revision: expected one of {', '.join(known)} or base, found {arguments.revision}")
    downgrade_database(database, arguments.revision)
    return _show(arguments, *schema_revisions(database)[:2], database.label)


def run_status(arguments: argparse.Namespace) -> int:
    from ground_service.store.database import open_database, schema_revisions

    database = open_database(settings_of(arguments).resolved_database_url())
    return _show(arguments, *schema_revisions(database)[:2], database.label)


def run_backup(arguments: argparse.Namespace) -> int:
    from ground_service.clock import utc_now_ns
    from ground_service.services.backup import backup

    with open_service(arguments) as ground:
        manifest = backup(ground, arguments.out, now_utc_ns=utc_now_ns())
    text = f"{arguments.out}: {sum(manifest['rows'].values())} rows, {manifest['files']} files"
    emit(arguments, {"folder": str(arguments.out), **manifest}, text=text)
    return 0


def run_restore(arguments: argparse.Namespace) -> int:
    from ground_service.services.backup import restore

    with open_service(arguments) as ground:
        manifest = restore(arguments.folder, ground)
        label = ground.database.label
    text = f"{label}: {sum(manifest['rows'].values())} rows, {manifest['files']} files"
    emit(arguments, {"database": label, **manifest}, text=text)
    return 0


def run_tidy(arguments: argparse.Namespace) -> int:
    from ground_service.services.upkeep import tidy

    days = arguments.days if arguments.days is not None else settings_of(arguments).retention_days
    with open_service(arguments) as ground:
        removed = tidy(ground, max(days, 0))
    emit(
        arguments, {"removed": removed}, text=", ".join(f"{count} {name}" for name, count in removed.items())
    )
    return 0


def run_redecode(arguments: argparse.Namespace) -> int:
    from ground_service.services.redecode import redecode_all

    with open_service(arguments) as ground:
        rows = redecode_all(ground)
    emit(arguments, {"rows": rows}, text=f"{rows} rows")
    return 0


def _show(arguments: argparse.Namespace, found: str | None, head: str, label: str) -> int:
    current = found or "none"
    emit(
        arguments,
        {"database": label, "revision": found, "head": head, "current": found == head},
        text=f"{label}: revision {current}, newest {head}",
    )
    return 0
