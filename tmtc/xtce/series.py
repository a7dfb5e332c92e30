"""Imported packets as records, and their numbers as matrices: a column for every parameter of one number a packet.

Enumerations are their codes, booleans 0 and 1. Texts, octets and arrays have no column.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tmtc.arrays import FloatArray
from tmtc.export import Record, format_records, plain
from tmtc.xtce.columns import Column, OptionalColumn, RecordColumn, ValueColumn
from tmtc.xtce.decode import XtceDecode, XtceTable
from tmtc.xtce.definition import AggregateType, ArrayType, BinaryEncoding, Container, Entry, ScalarType, StringEncoding


@dataclass(frozen=True, slots=True)
class SeriesValue:
    """A number of a packet: its parameter, the members that lead to it in an aggregate, and its type."""

    parameter: str
    members: tuple[str, ...]
    type: ScalarType
    description: str

    @property
    def name(self) -> str:
        """Name of the value, such as ``BATTERY.voltage``."""
        return ".".join((self.parameter, *self.members))


def packet_layouts(*roots: Container) -> dict[str, tuple[SeriesValue, ...]]:
    """Return the values of the packets of each container, by its name, in the order of the packet."""
    layouts: dict[str, tuple[SeriesValue, ...]] = {}
    pending: list[tuple[Container, dict[str, SeriesValue]]] = [(root, {}) for root in roots]
    while pending:
        container, before = pending.pop()
        values = before | {one.name: one for one in _of_entries(container.entries)}
        if not container.abstract:
            layouts[container.name] = tuple(values.values())
        pending.extend((child, values) for child in container.children)
    return layouts


def series_matrix(table: XtceTable, layout: tuple[SeriesValue, ...]) -> FloatArray:
    """Return the values (n, v) of the packets of a table; NaN where a packet does not have one."""
    matrix = np.full((len(table), len(layout)), np.nan)
    for index, value in enumerate(layout):
        matrix[:, index] = _numbers(table.columns[value.parameter], value)
    return matrix


def _of_entries(entries: tuple[Entry, ...]) -> Iterator[SeriesValue]:
    for entry in entries:
        if isinstance(entry.item, Container):
            yield from _of_entries(entry.item.entries)
        else:
            yield from _of_type(entry.item.name, (), entry.item.type, entry.item.description)


def _of_type(
    parameter: str, members: tuple[str, ...], data_type: ScalarType | ArrayType | AggregateType, text: str
) -> Iterator[SeriesValue]:
    if isinstance(data_type, AggregateType):
        for name, member in data_type.members:
            yield from _of_type(parameter, (*members, name), member, text)
    elif isinstance(data_type, ScalarType) and not isinstance(data_type.encoding, (StringEncoding, BinaryEncoding)):
        yield SeriesValue(parameter, members, data_type, text)


def _numbers(column: Column, value: SeriesValue) -> FloatArray:
    if isinstance(column, OptionalColumn):
        numbers = np.full(len(column), np.nan)
        numbers[column.present] = _numbers(column.column, value)
        return numbers
    for member in value.members:
        assert isinstance(column, RecordColumn)
        column = column.members[member]
    assert isinstance(column, ValueColumn)
    named = bool(value.type.labels) or value.type.is_boolean
    found: FloatArray = (column.raw if named else column.values).astype(np.float64)
    return found


_CONTAINER = "packet"


def xtce_records(found: XtceDecode, *, raw: bool = False) -> list[Record]:
    """Return a record for each decoded packet in stream order: `packet` names the container, then its parameters.

    Arrays are lists, aggregates mappings, octets hexadecimal digits, numbers that are not finite None. `raw` gives
    values as transmitted instead of calibrated and named ones. A parameter that is called `packet` becomes `packet_`.
    """
    numbered: list[tuple[int, Record]] = []
    for name, table in found.tables.items():
        columns = {
            f"{key}_" if key == _CONTAINER else key: column.to_list(raw) for key, column in table.columns.items()
        }
        rows = zip(*columns.values(), strict=True) if columns else ((),) * len(table)
        for index, values in zip(table.packet_index.tolist(), rows, strict=True):
            record: Record = {_CONTAINER: name}
            record.update(zip(columns, map(plain, values), strict=True))
            numbered.append((index, record))
    numbered.sort(key=lambda pair: pair[0])
    return [record for _, record in numbered]


def format_xtce_records(records: list[Record], kind: str) -> bytes:
    """Return the records as a file of that kind (`json`, `csv`, `parquet`).

    CSV and Parquet hold a row for each packet and a column for every parameter that occurs; members of aggregates are
    columns `parameter.member`, arrays are JSON in one column.
    """
    return format_records(records if kind == "json" else [_flat(record) for record in records], kind)


def _flat(record: Record) -> Record:
    flat: Record = {}
    for key, value in record.items():
        if isinstance(value, dict):
            flat.update({f"{key}.{inner}": one for inner, one in _flat(value).items()})
        elif isinstance(value, list):
            flat[key] = json.dumps(value, allow_nan=False)
        else:
            flat[key] = value
    return flat
