"""Numbers of imported packets as matrices: one column for every parameter that is one number in each packet.

Enumerations are their codes, booleans 0 and 1. Texts, octets and arrays have no column.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tmtc.arrays import FloatArray
from tmtc.xtce.columns import Column, OptionalColumn, RecordColumn, ValueColumn
from tmtc.xtce.decode import XtceTable
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
