"""Decoded packets as JSON, CSV or Parquet: one record for each packet, in the order of the stream."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from tmtc.dictionary.fields import Field
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import Table
from tmtc.errors import UnknownPacket
from tmtc.packets.cuc import TICKS_PER_SECOND
from tmtc.parquet import parquet_octets

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
