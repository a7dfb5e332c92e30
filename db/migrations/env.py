"""Alembic environment: runs the migrations on the connection that the program hands over, then installs the triggers.

Triggers follow from the tables of this version, so they are made anew after every migration.
"""

from __future__ import annotations

from alembic import context

from ground_service.store.database import install_triggers
from ground_service.store.models import Base


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


def _migrate(connection: object) -> None:
    context.configure(
        connection=connection,  # type: ignore[arg-type]
        target_metadata=Base.metadata,
        render_as_batch=True,
        transaction_per_migration=False,
    )
    context.run_migrations()
    install_triggers(connection)  # type: ignore[arg-type]


run()
