"""`linna db upgrade | downgrade | status`: the schema of the ground database."""

from __future__ import annotations

import argparse

from linna.commands._ground import add_service_options, settings_of
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
    for action in (upgrade, downgrade, status):
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


def _show(arguments: argparse.Namespace, found: str | None, head: str, label: str) -> int:
    current = found or "none"
    emit(
        arguments,
        {"database": label, "revision": found, "head": head, "current": found == head},
        text=f"{label}: revision {current}, newest {head}",
    )
    return 0
