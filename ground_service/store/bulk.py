"""Many rows at once, by the quickest way of each database: executemany on SQLite, binary COPY on PostgreSQL.

Few rows are inserted on PostgreSQL with one statement, because COPY needs several messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import BigInteger, Connection, Float, Integer, LargeBinary, SmallInteger, Table, Text

FEW_ROWS = 64

Column = Sequence[Any] | NDArray[Any]

_COPY_TYPES = (
    (SmallInteger, "int2"),
    (BigInteger, "int8"),
    (Integer, "int4"),
    (Float, "float8"),
    (LargeBinary, "bytea"),
    (Text, "text"),
)


def insert_columns(
    connection: Connection, table: Table, columns: Mapping[str, Column], *, replace: bool = False
) -> int:
    """Insert rows given as equally long columns; return their number.

    With `replace`, at most `FEW_ROWS` rows with the same primary key are replaced.
    """
    values = [plain_column(column) for column in columns.values()]
    count = len(values[0]) if values else 0
    if count == 0:
        return 0
    names = ", ".join(f'"{name}"' for name in columns)
    conflict = _on_conflict(table, columns) if replace else ""
    if connection.dialect.name == "postgresql":
        driver: Any = connection.connection.driver_connection
        types = [table.c[name].type for name in columns]
        kinds = [next(code for of, code in _COPY_TYPES if isinstance(one, of)) for one in types]
        if count <= FEW_ROWS:
            arrays = ", ".join(f"%b::{kind}[]" for kind in kinds)
            with driver.cursor() as cursor:
                cursor.execute(
                    f'INSERT INTO "{table.name}" ({names}) SELECT * FROM unnest({arrays}){conflict}', values
                )
            return count
        with (
            driver.cursor() as cursor,
            cursor.copy(f'COPY "{table.name}" ({names}) FROM STDIN (FORMAT BINARY)') as copy,
        ):
            copy.set_types(kinds)
            for row in zip(*values, strict=True):
                copy.write_row(row)
    else:
        marks = ", ".join("?" * len(values))
        connection.exec_driver_sql(
            f'INSERT INTO "{table.name}" ({names}) VALUES ({marks}){conflict}',
            list(zip(*values, strict=True)),
        )
    return count


def _on_conflict(table: Table, columns: Mapping[str, Column]) -> str:
    key = [column.name for column in table.primary_key.columns]
    changed = ", ".join(f'"{name}" = excluded."{name}"' for name in columns if name not in key)
    return f" ON CONFLICT ({', '.join(key)}) DO UPDATE SET {changed}"


def plain_column(column: Column) -> list[Any]:
    """A column as Python values, NaN as None (SQL has no other word for "not known")."""
    if not isinstance(column, np.ndarray):
        return list(column)
    values: list[Any] = column.tolist()
    if column.dtype.kind == "f" and np.isnan(column).any():
        return [None if value != value else value for value in values]
    return values
