"""Schema of a database as plain values, to compare two databases."""

from sqlalchemy import inspect, text


def described_schema(database):
    """Return columns, keys, constraints and indexes of every table, except the table of Alembic."""
    with database.reading() as connection:
        inspector = inspect(connection)
        tables = {
            name: {
                "columns": [{**column, "type": repr(column["type"])} for column in inspector.get_columns(name)],
                "key": inspector.get_pk_constraint(name),
                "foreign": sorted(inspector.get_foreign_keys(name), key=str),
                "unique": sorted(inspector.get_unique_constraints(name), key=str),
                "indexes": sorted(inspector.get_indexes(name), key=str),
                "checks": sorted(inspector.get_check_constraints(name), key=str),
            }
            for name in inspector.get_table_names()
            if name != "alembic_version"
        }
        if database.dialect == "sqlite":
            made = connection.execute(text("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
            clustered = {name: "WITHOUT ROWID" in sql for name, sql in made}
            for name, described in tables.items():
                described["clustered"] = clustered[name]
    return tables
