"""Columns of values decoded through an imported definition: numbers, texts, octets, arrays and records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Union, cast

import numpy as np

from tmtc.arrays import BoolArray, IntArray, RecordArray


@dataclass(frozen=True, slots=True, eq=False)
class ValueColumn:
    """Values (n,) of a parameter: `raw` as transmitted, `values` calibrated or named.

    Integers are int64, unsigned ones of 64 bits uint64, other numbers float64; texts, octets and names of codes are
    Python objects in object arrays. A code without a name stays an integer.
    """

    raw: RecordArray
    values: RecordArray

    def __len__(self) -> int:
        return len(self.raw)

    def take(self, index: IntArray) -> ValueColumn:
        """The rows of an index (m,)."""
        raw = self.raw.take(index)
        return ValueColumn(raw, raw if self.values is self.raw else self.values.take(index))

    def to_list(self, raw: bool = False) -> list[Any]:
        """Python values, one for each row."""
        listed: list[Any] = (self.raw if raw else self.values).tolist()
        return listed


@dataclass(frozen=True, slots=True, eq=False)
class ArrayColumn:
    """Arrays of n packets: `counts` (n,) and the elements of all of them one after another."""

    counts: IntArray
    elements: Column

    def __len__(self) -> int:
        return len(self.counts)

    def take(self, index: IntArray) -> ArrayColumn:
        """The rows of an index (m,)."""
        first = np.cumsum(self.counts) - self.counts
        counts = self.counts[index]
        place = np.arange(int(counts.sum()), dtype=np.int64)
        place += np.repeat(first[index] - (np.cumsum(counts) - counts), counts)
        return ArrayColumn(counts, self.elements.take(place))

    def to_list(self, raw: bool = False) -> list[Any]:
        """A list for each row."""
        elements = self.elements.to_list(raw)
        stops = np.cumsum(self.counts).tolist()
        return [elements[start:stop] for start, stop in zip([0, *stops][:-1], stops, strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class RecordColumn:
    """Records (n,) of named members, each a column."""

    members: dict[str, Column]

    def __len__(self) -> int:
        return len(next(iter(self.members.values())))

    def take(self, index: IntArray) -> RecordColumn:
        """The rows of an index (m,)."""
        return RecordColumn({name: member.take(index) for name, member in self.members.items()})

    def to_list(self, raw: bool = False) -> list[Any]:
        """A mapping for each row."""
        columns = [member.to_list(raw) for member in self.members.values()]
        return [dict(zip(self.members, row, strict=True)) for row in zip(*columns, strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class OptionalColumn:
    """A column that not every packet has: `present` (n,), and the values of the packets that have it."""

    present: BoolArray
    column: Column

    def __len__(self) -> int:
        return len(self.present)

    def take(self, index: IntArray) -> OptionalColumn:
        """The rows of an index (m,)."""
        present = self.present[index]
        place = np.cumsum(self.present) - 1
        return OptionalColumn(present, self.column.take(place[index[present]]))

    def to_list(self, raw: bool = False) -> list[Any]:
        """The values, None where there is none."""
        values = iter(self.column.to_list(raw))
        return [next(values) if there else None for there in self.present.tolist()]


Column = Union[ValueColumn, ArrayColumn, RecordColumn, OptionalColumn]  # noqa: UP007 - a forward reference


def concatenated(columns: list[Column]) -> Column:
    """One column of several of the same kind."""
    first = columns[0]
    if len(columns) == 1:
        return first
    if isinstance(first, ValueColumn):
        numbers = cast(list[ValueColumn], columns)
        raw = np.concatenate([c.raw for c in numbers])
        if all(c.values is c.raw for c in numbers):
            return ValueColumn(raw, raw)
        return ValueColumn(raw, np.concatenate([c.values for c in numbers]))
    if isinstance(first, ArrayColumn):
        arrays = cast(list[ArrayColumn], columns)
        counts = np.concatenate([c.counts for c in arrays])
        return ArrayColumn(counts, concatenated([c.elements for c in arrays]))
    if isinstance(first, RecordColumn):
        records = cast(list[RecordColumn], columns)
        return RecordColumn({name: concatenated([c.members[name] for c in records]) for name in first.members})
    optional = cast(list[OptionalColumn], columns)
    return OptionalColumn(np.concatenate([c.present for c in optional]), concatenated([c.column for c in optional]))
