"""Alembic environment: migrations on the connection of the program, then the triggers of the audit log."""

from __future__ import annotations

from alembic import context
from sqlalchemy import Connection, inspect

from ground_service.store.audit import install_guards
from ground_service.store.models import METADATA


def run() -> None:
    """Migrate the connection given in the configuration's attributes, or the one of `linna db`'s settings."""
    connection = context.config.attributes.get("connection")
    if connection is None:
        from ground_service.settings import load_settings
        from ground_service.store.database import open_database

        database = open_database(load_settings().resolved_database_url())
        with database.writing() as own:
            _migrate(own)
    else:
        _migrate(connection)


def _migrate(connection: Connection) -> None:
    context.configure(
        connection=connection, target_metadata=METADATA, render_as_batch=True, transaction_per_migration=False
    )
    context.run_migrations()
    if inspect(connection).has_table("audit"):
        install_guards(connection)


run()
