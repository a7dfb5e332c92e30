"""Frozen schema of a release: the statements that create its tables, for both databases.

`python -m ground_service.store.snapshot FILE` writes the schema of the tables of this version as JSON. The first
migration executes such a file, so that it does not depend on tables of later versions.
"""

import json
import re
import sys
from pathlib import Path

from sqlalchemy import Connection
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import Dialect
from sqlalchemy.schema import CreateIndex, CreateTable

from ground_service.store.models import METADATA

DIALECTS: dict[str, type[Dialect]] = {"sqlite": sqlite.dialect, "postgresql": postgresql.dialect}


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
    statements = {name: schema_statements(dialect()) for name, dialect in DIALECTS.items()}
    Path(sys.argv[1]).write_text(json.dumps(statements, indent=1) + "\n", encoding="utf-8")
