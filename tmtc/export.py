"""Decoded packets as JSON, CSV or Parquet: one record for each packet, in the order of the stream."""

import csv
import io
import json
import math
from collections.abc import Collection, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np

from tmtc.arrays import IntArray
from tmtc.dictionary.fields import Field
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import Table
from tmtc.errors import MissingLibrary, UnknownPacket

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


FORMATS = ("json", "csv", "parquet")

_EPOCH_TAI = np.datetime64("2000-01-01", "us")

Record = dict[str, Any]


def format_onboard_times(ticks: IntArray) -> list[str]:
    """Return the TAI texts, cut to 1 us, of on-board times (n,): ticks of 2^-16 s since 2000, at most 48 bits."""
    texts: list[str] = np.datetime_as_string(_EPOCH_TAI + ticks * 15_625 // 1024).tolist()  # 15,625/1,024 us a tick
    return texts


def packet_records(tables: Mapping[str, Table]) -> list[Record]:
    """A record for each packet, ordered as in the stream: header fields, then engineering values.

    Enumerated fields give their names, vectors lists, repeated items a list of records, unknown numbers None.
    """
    numbered: list[tuple[int, Record]] = []
    for name, table in tables.items():
        definition = DICTIONARY.packet(name)
        header = {"packet": name, "apid": definition.apid, "service": definition.service, "subtype": definition.subtype}
        columns: dict[str, list[Any]] = {
            **{key: [value] * len(table) for key, value in header.items()},
            "sequence_count": table.sequence_count.tolist(),
            "ticks": table.ticks.tolist(),
            "onboard_tai": format_onboard_times(table.ticks),
            **{f.name: _column(f, table.columns[f.name]) for f in definition.fields},
        }
        if definition.group:
            flat = _rows({f.name: _column(f, table.items[f.name]) for f in definition.group.fields})
            stops = np.searchsorted(table.item_owner, np.arange(len(table)), side="right").tolist()
            columns[definition.group.name] = [flat[i:j] for i, j in zip([0, *stops[:-1]], stops, strict=True)]
        numbered += zip(table.packet_index.tolist(), _rows(columns), strict=True)
    numbered.sort(key=lambda pair: pair[0])
    return [record for _, record in numbered]


def _rows(columns: Mapping[str, list[Any]]) -> list[Record]:
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def format_records(records: list[Record], kind: str) -> bytes:
    """The records as a file of that kind (`json`, `csv`, `parquet`).

    CSV and Parquet hold one row for each packet and a column for every field that occurs; vectors are spread over
    numbered columns, repeated items are JSON in one column.
    """
    if kind == "json":
        lines = ",\n".join(json.dumps(record, allow_nan=False) for record in records)
        return f"[\n{lines}\n]\n".encode()
    if kind not in FORMATS:
        raise UnknownPacket(f"format: expected one of {', '.join(FORMATS)}, found {kind!r}")
    columns = record_columns(records)
    if kind == "parquet":
        return parquet_octets(columns)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue().encode()


def record_columns(records: list[Record]) -> dict[str, list[object]]:
    """Return the records as columns of one length, None where a record has no such value."""
    columns: dict[str, list[object]] = {}
    for key in dict.fromkeys(chain.from_iterable(records)):
        columns |= _spread(key, [record.get(key) for record in records])
    return columns


def column_metadata(packet: str) -> dict[str, dict[str, str]]:
    """Return unit and description of the columns of a packet, as `record_columns` names them."""
    definition = DICTIONARY.packet(packet)
    stated: dict[str, dict[str, str]] = {}
    for one in definition.fields:
        entry = {"description": one.description} | ({"unit": one.unit} if one.unit else {})
        names = [one.name] if one.size == 1 else [f"{one.name}_{k}" for k in range(1, one.size + 1)]
        stated |= dict.fromkeys(names, entry)
    if definition.group:
        units = {one.name: one.unit for one in definition.group.fields if one.unit}
        stated[definition.group.name] = {"description": "JSON list of items", "units": json.dumps(units)}
    return stated


def _spread(key: str, values: list[Any]) -> dict[str, list[object]]:
    """Return a column as it is, vectors as numbered columns, lists of items as JSON; None may stand for any of them."""
    lists = [value for value in values if isinstance(value, list)]
    vectors = [one for one in lists if one and not isinstance(one[0], dict)]
    if not lists:
        return {key: values}
    if not vectors:
        return {key: [json.dumps(one, allow_nan=False) if isinstance(one, list) else one for one in values]}
    width = max(map(len, vectors))
    padded = [[*(one or []), *[None] * width][:width] for one in values]
    return {f"{key}_{k}": list(column) for k, column in enumerate(zip(*padded, strict=True), start=1)}


def _column(f: Field, values: Any) -> list[Any]:
    if f.labels:
        names = dict(f.labels)
        return [names.get(code, code) for code in values.tolist()]
    listed: list[Any] = values.tolist()
    return listed if values.dtype.kind != "f" or np.isfinite(values).all() else [plain(value) for value in listed]


def plain(value: Any) -> Any:
    """Return a value for JSON: octets as hexadecimal digits, numbers that are not finite as None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, list):
        return [plain(one) for one in value]
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    return value
