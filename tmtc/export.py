"""Decoded packets as JSON, CSV or Parquet: one record for each packet, in the order of the stream."""

import csv
import io
import json
import math
from collections.abc import Collection, Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from tmtc.dictionary.fields import Field
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import Table
from tmtc.errors import MissingLibrary, UnknownPacket
from tmtc.packets.pus import TICKS_PER_SECOND

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

_EPOCH_TAI = datetime(2000, 1, 1)

Record = dict[str, Any]


def format_onboard_time(ticks: int) -> str:
    """On-board time of the ideal clock, TAI, to the microsecond: `2029-08-07T00:00:37.000000`."""
    whole, fraction = divmod(int(ticks), TICKS_PER_SECOND)
    try:
        time = _EPOCH_TAI + timedelta(seconds=whole, microseconds=fraction * 1_000_000 // TICKS_PER_SECOND)
    except OverflowError:
        return ""
    return time.isoformat(timespec="microseconds")


def packet_records(tables: Mapping[str, Table]) -> list[Record]:
    """A record for each packet, ordered as in the stream: header fields, then engineering values.

    Enumerated fields give their names, vectors lists, repeated items a list of records, unknown numbers None.
    """
    numbered: list[tuple[int, Record]] = []
    for name, table in tables.items():
        definition = DICTIONARY.packet(name)
        columns = {f.name: _column(f, table.columns[f.name]) for f in definition.fields}
        items: list[list[Record]] = []
        if definition.group:
            fields = definition.group.fields
            cells = [_column(f, table.items[f.name]) for f in fields]
            names = [f.name for f in fields]
            flat = [dict(zip(names, row, strict=True)) for row in zip(*cells, strict=True)]
            stops = np.searchsorted(table.item_owner, np.arange(len(table)), side="right").tolist()
            items = [flat[start:stop] for start, stop in zip([0, *stops[:-1]], stops, strict=True)]
        for row in range(len(table)):
            ticks = int(table.ticks[row])
            record: Record = {
                "packet": name,
                "apid": definition.apid,
                "service": definition.service,
                "subtype": definition.subtype,
                "sequence_count": int(table.sequence_count[row]),
                "ticks": ticks,
                "onboard_tai": format_onboard_time(ticks),
            }
            for column, values in columns.items():
                record[column] = values[row]
            if definition.group:
                record[definition.group.name] = items[row]
            numbered.append((int(table.packet_index[row]), record))
    numbered.sort(key=lambda pair: pair[0])
    return [record for _, record in numbered]


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
    for row, record in enumerate(records):
        for key, value in _flat(record).items():
            column = columns.setdefault(key, [])
            column.extend([None] * (row - len(column)))
            column.append(value)
    for column in columns.values():
        column.extend([None] * (len(records) - len(column)))
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


def _flat(record: Record) -> Record:
    flat: Record = {}
    for key, value in record.items():
        if isinstance(value, list) and value and not isinstance(value[0], dict):
            flat.update({f"{key}_{k}": element for k, element in enumerate(value, start=1)})
        elif isinstance(value, list):
            flat[key] = json.dumps(value, allow_nan=False)
        else:
            flat[key] = value
    return flat


def _column(f: Field, values: Any) -> list[Any]:
    if f.labels:
        names = dict(f.labels)
        return [names.get(code, code) for code in values.tolist()]
    listed: list[Any] = values.tolist()
    return [plain(value) for value in listed] if values.dtype.kind == "f" else listed


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
