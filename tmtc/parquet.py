"""A table as an Apache Parquet file, written with pyarrow, which is an optional dependency."""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from tmtc.errors import MissingLibrary

_INT64_LIMIT = 1 << 63


def parquet_octets(
    columns: Mapping[str, Sequence[object]],
    *,
    utc_columns: Collection[str] = (),
    fields: Mapping[str, Mapping[str, str]] | None = None,
    about: Mapping[str, str] | None = None,
) -> bytes:
    """Return a Parquet file of columns of one length; values are integers, floats or texts, None if there is none.

    `utc_columns` are nanoseconds since 1970 and become time stamps with the zone UTC. `fields` and `about` are metadata
    of the columns (unit, description) and of the file.

    A column of integers is int64, uint64 if a value needs it, and text if it has values that no 64-bit type holds
    together.

    Raises
    ------
    MissingLibrary
        If pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise MissingLibrary("Parquet", "pyarrow", "linna[parquet]") from None
    buffer = io.BytesIO()
    arrays = {
        name: pyarrow.array(values, type=pyarrow.timestamp("ns", tz="UTC"))
        if name in utc_columns
        else _array(pyarrow, values)
        for name, values in columns.items()
    }
    stated = fields or {}
    schema = pyarrow.schema(
        [pyarrow.field(name, array.type, metadata=stated.get(name)) for name, array in arrays.items()],
        metadata=dict(about) if about else None,
    )
    table = pyarrow.table(list(arrays.values()), schema=schema)
    parquet.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def _array(pyarrow: Any, values: Sequence[object]) -> Any:
    known = [value for value in values if value is not None]
    whole = [int(value) for value in known if isinstance(value, (int, np.integer))]  # also truth values
    if known and len(whole) == len(known):
        column = [int(value) if isinstance(value, (int, np.integer)) else None for value in values]
        if max(whole) < _INT64_LIMIT:
            return pyarrow.array(column, type=pyarrow.int64())
        if min(whole) >= 0:
            return pyarrow.array(column, type=pyarrow.uint64())
    elif known and all(isinstance(value, (int, float, np.integer, np.floating)) for value in known):
        return pyarrow.array(values, type=pyarrow.float64())
    return pyarrow.array([None if value is None else str(value) for value in values], type=pyarrow.string())
