"""A table as an Apache Parquet file, written with pyarrow, which is an optional dependency."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tmtc.errors import MissingLibrary

_INT64_LIMIT = 1 << 63


def parquet_octets(columns: Mapping[str, Sequence[object]]) -> bytes:
    """Return a Parquet file of columns of one length; values are integers, floats or texts, None if there is none.

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
    table = pyarrow.table({name: _array(pyarrow, values) for name, values in columns.items()})
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
