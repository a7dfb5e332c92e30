"""Packets of an imported definition as columns: all packets of one layout at once, not one after another.

All packets walk the tree of containers together. Stretches of fixed width are gathered as records and split into
columns; where a width depends on the packet, the positions behind it are an array with one position per packet.
Elements of arrays are read together if their width is fixed, else all first ones, all second ones and so on. A packet
that does not fit its container is counted and left out; it never stops the others.

References
----------
CCSDS 660.1-G-2; MIL-STD-1750A section 4.1 for its floating point formats.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import eq, ge, gt, le, lt, methodcaller, ne
from typing import Any

import numpy as np
import numpy.typing as npt

from tmtc.arrays import BoolArray, IntArray, OctetArray, Octets, RecordArray, as_octets
from tmtc.dictionary.schema import gather
from tmtc.errors import DefinitionError
from tmtc.packets import space_packets
from tmtc.packets.stream import PacketCut, PrimaryHeaders
from tmtc.xtce.columns import ArrayColumn, Column, OptionalColumn, RecordColumn, ValueColumn, concatenated
from tmtc.xtce.definition import (
    AggregateType,
    AllOf,
    AnyOf,
    ArrayType,
    BinaryEncoding,
    Calibration,
    Calibrator,
    CodeIn,
    Condition,
    Container,
    DataType,
    Definition,
    Entry,
    FloatEncoding,
    IntegerEncoding,
    Parameter,
    Polynomial,
    Reference,
    ScalarType,
    Size,
    Spline,
    StringEncoding,
    header_field,
    packet_apids,
    references,
    tree,
)

DECODED, NO_CONTAINER, AMBIGUOUS, TOO_SHORT, MALFORMED, DAMAGED, SEGMENT, NO_HEADER, JOINED = range(9)
VERDICTS = (
    "decoded", "no_container", "ambiguous", "too_short", "malformed", "damaged", "segments_not_joined",
    "no_secondary_header", "segments_joined",
)  # fmt: skip
"""Outcomes of decoding a packet: decoded; no or several containers match; shorter than its container; a size that is
not possible, so that the places of the values behind it are unknown; a wrong checksum; a part of a segmented packet
that is not complete; without the secondary header that other packets of its APID have; a part that was decoded with the
first one of its packet, which has the outcome."""

_CHUNK = 1 << 17
"""Packets decoded together: bounds the memory for what is between."""

_SHORT_TEXT = 64
"""Octets of texts that are decoded together."""

_START = "\0start"
"""Name under which the beginnings of the packets are kept; no parameter is called so."""

_MOST_BITS = 1 << 40
"""Greater sizes are cut to this: no packet is as long."""


@dataclass(frozen=True, slots=True, eq=False)
class XtceTable:
    """All packets of one container as columns; `packet_index` (n,) points into the `PacketCut`.

    `unread_bits` (n,) are the bits behind the last entry.
    """

    name: str
    packet_index: IntArray
    columns: dict[str, Column]
    unread_bits: IntArray

    def __len__(self) -> int:
        return len(self.packet_index)

    def take(self, index: IntArray) -> XtceTable:
        """Return the selected packets."""
        columns = {name: column.take(index) for name, column in self.columns.items()}
        return XtceTable(self.name, self.packet_index[index], columns, self.unread_bits[index])


@dataclass(frozen=True, slots=True, eq=False)
class XtceDecode:
    """Tables by container, and for every packet of the cut an index of `VERDICTS` (n,).

    `unknown` are, by parameter, the packets of values that are not known: a number that its calibrator does not cover,
    a text that is none. Their transmitted values are kept.
    """

    tables: dict[str, XtceTable]
    verdict: npt.NDArray[np.int8]
    unknown: dict[str, IntArray]

    def counts(self) -> dict[str, int]:
        """Packets by verdict; those of the primary header only if there are any."""
        found = np.bincount(self.verdict, minlength=len(VERDICTS)).tolist()
        return {VERDICTS[k]: count for k, count in enumerate(found) if count or k <= DAMAGED}

    def values_unknown(self) -> dict[str, int]:
        """Values of decoded packets that are not known, by parameter."""
        return {name: len(packets) for name, packets in self.unknown.items() if len(packets)}

    def bits_not_read(self) -> dict[str, tuple[int, int]]:
        """Return least and most bits behind the last entry of packets, by container; without those that have none."""
        spans = {name: one.unread_bits for name, one in self.tables.items() if len(one)}
        return {name: (int(bits.min()), int(bits.max())) for name, bits in spans.items() if bits.max() > 0}


def choose_roots(definition: Definition, names: Sequence[str] = ()) -> tuple[Container, ...]:
    """The containers that packets begin with: those named, or all without a base if they can be distinguished.

    Raises
    ------
    DefinitionError
        There is no such container, or none is named and packets cannot tell between several.
    """
    for name in names:
        if name not in definition.containers:
            known = ", ".join(sorted(definition.containers)[:12])
            raise DefinitionError(f"{definition.name}: expected the name of a container ({known}), found {name!r}")
    roots = tuple(definition.containers[name] for name in names) or tuple(definition.roots.values())
    open_roots = [root.name for root in roots if not any(conditions for _, conditions in tree(root))]
    if len(open_roots) > 1:
        listed = ", ".join(sorted(open_roots)[:12])
        raise DefinitionError(
            f"{definition.name}: expected one container without a base, found {len(open_roots)} ({listed}) "
            "without conditions; name the one that packets begin with"
        )
    return roots


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """Octets with packets in them; `offsets` and `lengths` are by packet of the cut and hold for `packets`."""

    octets: OctetArray
    offsets: IntArray
    lengths: IntArray
    packets: IntArray


class Decoder:
    """A definition with its containers compiled to steps; stateless between calls."""

    def __init__(self, definition: Definition, roots: str | Sequence[str] | None = None) -> None:
        self.definition = definition
        self.roots = choose_roots(definition, (roots,) if isinstance(roots, str) else roots or ())
        self._steps: dict[str, list[_Step]] = {}
        self._conditional = [{one.name for one, conditions in tree(root) if conditions} for root in self.roots]
        self._reads_segments = any(_asks_for(root, 16, 2) for root in self.roots)
        self._reads_header_flag = any(_asks_for(root, 4, 1) for root in self.roots)

    def decode(
        self,
        buffer: Octets,
        cut: PacketCut,
        headers: PrimaryHeaders | None = None,
        *,
        whole_stream: bool = False,
        checksum_octets: int = 0,
    ) -> XtceDecode:
        """Tables of all packets, and a verdict for each.

        Parameters
        ----------
        headers
            Primary headers: parts of segmented packets are not decoded, unless the definition asks for the sequence
            flags.
        whole_stream
            With `headers`: the parts of a segmented packet are joined. Of an APID whose packets have a secondary
            header, packets without one are not decoded, unless the definition asks for the flag.
        checksum_octets
            Octets of the checksum at the end of a packet, which each part of a segmented packet has.
        """
        verdict = np.where(cut.crc_ok, DECODED, DAMAGED).astype(np.int8)
        octets = as_octets(buffer)
        sources = [_Source(octets, cut.offsets, cut.lengths, np.empty(0, dtype=np.int64))]
        if headers is not None and not self._reads_segments:
            verdict[cut.crc_ok & (headers.sequence_flags != space_packets.FLAGS_WHOLE)] = SEGMENT
            if whole_stream and (verdict == SEGMENT).any():
                sources.append(_join_segments(octets, cut, headers, verdict, checksum_octets))
        if headers is not None and whole_stream and not self._reads_header_flag:
            whole = verdict == DECODED
            usual = np.unique(headers.apid[whole & headers.secondary_header])
            verdict[whole & ~headers.secondary_header & np.isin(headers.apid, usual)] = NO_HEADER
        sources[0] = replace(sources[0], packets=np.flatnonzero(verdict == DECODED))
        for joined in sources[1:]:
            verdict[joined.packets] = DECODED
        if len(self.roots) == 1:
            return self._decode(self.roots[0], sources, verdict)
        packets = np.concatenate([source.packets for source in sources])
        whole = packets[cut.lengths[packets] >= 2]
        apid = np.full(len(cut), -1, dtype=np.int64)
        apid[whole] = (octets[cut.offsets[whole]].astype(np.int64) & 7) << 8 | octets[cut.offsets[whole] + 1]
        named = [packet_apids(root) for root in self.roots]
        found = []
        for root, (apids, accepts_others) in zip(self.roots, named, strict=True):
            foreign = frozenset().union(*(one for one, _ in named)) - apids
            possible = ~np.isin(apid, list(foreign)) if accepts_others else np.isin(apid, list(apids))
            mine = np.where((verdict == DECODED) & ~possible, NO_CONTAINER, verdict).astype(np.int8)
            its = [replace(one, packets=one.packets[possible[one.packets]]) for one in sources]
            found.append(self._decode(root, its, mine))
        return _merged(found, self._conditional)

    def _decode(self, root: Container, sources: Sequence[_Source], verdict: npt.NDArray[np.int8]) -> XtceDecode:
        """Decode packets that begin with a container; their verdicts are set."""
        pieces: dict[str, list[XtceTable]] = {}
        unknown: dict[str, list[IntArray]] = {}
        for source in sources:
            octets, packets = source.octets, source.packets
            begins, ends = source.offsets * 8, (source.offsets + source.lengths) * 8
            for first in range(0, len(packets), _CHUNK):
                chunk = packets[first : first + _CHUNK]
                base, end = int(begins[chunk].min()) // 8, int(ends[chunk].max()) // 8
                data = b"".join((octets[base:end].data, bytes(_SHORT_TEXT)))
                padded = np.frombuffer(data, dtype=np.uint8)
                run = _Run(octets, begins, ends, verdict, data, padded, base, unknown)
                for table in self._tables(root, run, _Rows(chunk, begins[chunk])):
                    pieces.setdefault(table.name, []).append(table)
        tables = {name: _joined(found) for name, found in sorted(pieces.items())}
        noted = {name: np.concatenate(parts) for name, parts in sorted(unknown.items())}
        return XtceDecode(tables, verdict, {name: one[verdict[one] == DECODED] for name, one in noted.items()})

    def _tables(self, root: Container, run: _Run, packets: _Rows) -> Iterator[XtceTable]:
        pending = [(root, packets)]
        while pending:
            container, rows = pending.pop()
            if rows.parent is None:  # a container that inherits begins where its root does
                rows.columns[_START] = ValueColumn(rows.at, rows.at)
            rows = _advance(run, self._compiled(container), rows)
            if not len(rows):
                continue
            matches = [
                np.ones(len(rows), dtype=np.bool_) if one.condition is None else _holds(one.condition, rows)
                for one in container.children
            ]
            number = np.sum(matches, axis=0, dtype=np.int64) if matches else np.zeros(len(rows), np.int64)
            run.verdict[rows.packet[number > 1]] = AMBIGUOUS
            for child, match in zip(container.children, matches, strict=True):
                mine = match & (number == 1)
                if mine.any():
                    pending.append((child, rows.narrowed(mine)))
            last = number == 0
            if container.abstract:
                run.verdict[rows.packet[last]] = NO_CONTAINER
            elif last.any():
                yield run.table(container.name, rows if last.all() else rows.narrowed(last))

    def _compiled(self, container: Container) -> list[_Step]:
        if container.path not in self._steps:
            self._steps[container.path] = _compile(container.entries, _START)
        return self._steps[container.path]


def _join_segments(
    octets: OctetArray, cut: PacketCut, headers: PrimaryHeaders, verdict: npt.NDArray[np.int8], checksum_octets: int
) -> _Source:
    """Join the parts of segmented packets whose counts follow one another; `packets` are the first parts.

    The verdict of the other parts becomes `JOINED`, also that of a part that follows itself again. A later part with a
    secondary header, whose length is not known, is not joined.
    """
    parts = np.flatnonzero(verdict == SEGMENT)
    parts = parts[np.argsort(headers.apid[parts], kind="stable")]
    copies, origins, parts = _repeated_parts(octets, cut, headers, parts)
    apid, count, flags = headers.apid[parts], headers.sequence_count[parts], headers.sequence_flags[parts]
    follows = (apid[1:] == apid[:-1]) & (count[1:] == (count[:-1] + 1) % space_packets.SEQUENCE_COUNT_LIMIT)
    follows &= (
        np.isin(flags[:-1], (space_packets.FLAGS_FIRST, space_packets.FLAGS_CONTINUATION))
        & ~headers.secondary_header[parts[1:]]
    )
    follows &= np.isin(flags[1:], (space_packets.FLAGS_LAST, space_packets.FLAGS_CONTINUATION))
    starts = np.flatnonzero(np.append(True, ~follows))
    stops = np.append(starts[1:], len(parts))
    is_whole = (flags[starts] == space_packets.FLAGS_FIRST) & (flags[stops - 1] == space_packets.FLAGS_LAST)
    offsets, lengths = cut.offsets.copy(), cut.lengths.copy()
    pieces: list[OctetArray] = []
    size = 0
    for start, stop in zip(starts[is_whole].tolist(), stops[is_whole].tolist(), strict=True):
        first, begin = parts[start], size
        for part in parts[start:stop].tolist():
            skipped = 0 if part == first else space_packets.PRIMARY_HEADER_LENGTH
            left = 0 if part == parts[stop - 1] else checksum_octets
            at = cut.offsets[part]
            pieces.append(octets[at + skipped : max(at + cut.lengths[part] - left, at + skipped)])
            size += len(pieces[-1])
        verdict[parts[start + 1 : stop]] = JOINED
        verdict[copies[np.isin(origins, parts[start:stop])]] = JOINED
        offsets[first], lengths[first] = begin, size - begin
    joined = np.concatenate(pieces) if pieces else np.empty(0, dtype=np.uint8)
    return _Source(joined, offsets, lengths, np.sort(parts[starts[is_whole]]))


def _repeated_parts(
    octets: OctetArray, cut: PacketCut, headers: PrimaryHeaders, parts: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the parts that are equal to the one before of their APID, the first of each of these, and the others."""
    again = np.zeros(len(parts), dtype=np.bool_)
    same = (np.diff(headers.apid[parts]) == 0) & (np.diff(headers.sequence_count[parts]) == 0)
    for k in np.flatnonzero(same).tolist():
        one, other = (octets[cut.offsets[p] : cut.offsets[p] + cut.lengths[p]] for p in parts[k : k + 2])
        again[k + 1] = np.array_equal(one, other)
    first = np.maximum.accumulate(np.where(again, 0, np.arange(len(parts))))
    return parts[again], parts[first[again]], parts[~again]


def _asks_for(root: Container, bit: int, bits: int) -> bool:
    """Return whether conditions of containers and entries ask for the value in a place of the header."""
    field = header_field(root, bit, bits)
    containers = [one for one, _ in tree(root)]
    conditions = [one.condition for one in containers]
    conditions += [entry.condition for one in containers for entry in one.entries]
    return field is not None and field.parameter in references(tuple(conditions))


def _merged(found: Sequence[XtceDecode], conditional: Sequence[set[str]]) -> XtceDecode:
    """Return what several first containers give: each packet by the one that decodes it.

    A container whose conditions hold comes before one without conditions.
    """
    n = len(found[0].verdict)
    claims = np.zeros((2, len(found), n), dtype=np.bool_)
    for k, one in enumerate(found):
        for table in one.tables.values():
            claims[int(table.name in conditional[k]), k, table.packet_index] = True
    chosen = np.where(claims[1].any(axis=0), claims[1], claims[0])
    number = chosen.sum(axis=0)
    worst = np.max([one.verdict for one in found], axis=0)
    verdict = np.where(number > 0, np.where(number > 1, AMBIGUOUS, DECODED), worst).astype(np.int8)
    chosen &= number == 1
    tables: dict[str, XtceTable] = {}
    unknown: dict[str, list[IntArray]] = {}
    for k, one in enumerate(found):
        for name, table in one.tables.items():
            kept = table.take(np.flatnonzero(chosen[k, table.packet_index]))
            if len(kept):
                tables[name] = kept
        for name, packets in one.unknown.items():
            unknown.setdefault(name, []).append(packets[chosen[k, packets]])
    noted = {name: np.concatenate(parts) for name, parts in sorted(unknown.items())}
    return XtceDecode(dict(sorted(tables.items())), verdict, noted)


# steps: what a list of entries comes to


@dataclass(frozen=True, slots=True)
class _Fixed:
    """Parameters of fixed width, `offset` bits from here; `extent` bits must be there, `advance` are passed."""

    fields: tuple[tuple[str, ScalarType, int], ...]
    extent: int
    advance: int


@dataclass(frozen=True, slots=True)
class _Seek:
    """Go to `offset` bits behind a mark (None: behind here)."""

    mark: str | None
    offset: int | Size


@dataclass(frozen=True, slots=True)
class _Mark:
    """Remember this position."""

    name: str


@dataclass(frozen=True, slots=True)
class _Read:
    """A parameter whose width depends on the packet, or that is an array or aggregate."""

    parameter: Parameter


@dataclass(frozen=True, slots=True)
class _Optional:
    """Steps for the packets for which the condition holds."""

    condition: Condition
    steps: tuple[_Step, ...]


_Step = _Fixed | _Seek | _Mark | _Read | _Optional


def _compile(entries: Sequence[Entry], mark: str) -> list[_Step]:
    steps: list[_Step] = []
    fields: list[tuple[str, ScalarType, int]] = []
    cursor = extent = 0

    def close() -> None:
        nonlocal cursor, extent
        if fields or cursor:
            steps.append(_Fixed(tuple(fields), extent, cursor))
        fields.clear()
        cursor = extent = 0

    for entry in entries:
        item = entry.item
        kind = item.type if isinstance(item, Parameter) and isinstance(item.type, ScalarType) else None
        bits = None if kind is None else kind.bits
        encoding = None if kind is None else kind.encoding
        offset = entry.offset
        plain = not entry.from_start and entry.condition is None
        if (
            plain
            and isinstance(offset, int)
            and kind is not None
            and bits is not None
            and isinstance(encoding, (IntegerEncoding, FloatEncoding))
        ):
            if fields and encoding.calibration.contexts:  # they may ask for fields of the same stretch
                close()
            if cursor + offset >= 0:
                fields.append((item.name, kind, cursor + offset))
                cursor += offset + bits
                extent = max(extent, cursor)
                continue
        close()
        own: list[_Step] = []
        if entry.from_start or offset:
            own.append(_Seek(mark if entry.from_start else None, offset))
        if isinstance(item, Parameter):
            own.append(_Read(item))
        else:
            inner = f"{mark}/{len(steps)}"
            own.append(_Mark(inner))
            own.extend(_compile(item.entries, inner))
            if item.bits is not None:
                own.append(_Seek(inner, item.bits))
        if entry.condition is None:
            steps.extend(own)
        else:
            steps.append(_Optional(entry.condition, tuple(own)))
    close()
    return steps


class _Rows:
    """Packets that have come the same way: `packet` (n,) in the cut, `at` (n,) bits into the buffer, columns so far.

    The columns of the way here stay with the rows that were there (`parent`); `index` (n,) are their rows that came
    further.
    """

    __slots__ = ("at", "columns", "index", "packet", "parent")

    def __init__(
        self, packet: IntArray, at: IntArray, parent: _Rows | None = None, index: IntArray | None = None
    ) -> None:
        self.packet = packet
        self.at = at
        self.parent = parent
        self.index = index
        self.columns: dict[str, Column] = {}

    def __len__(self) -> int:
        return len(self.packet)

    def narrowed(self, keep: BoolArray) -> _Rows:
        """Return the selected rows, with these rows as their parent."""
        index = np.flatnonzero(keep)
        return _Rows(self.packet[index], self.at[index], self, index)

    def column(self, name: str) -> Column | None:
        """The column of an earlier parameter, for these rows."""
        rows: _Rows | None = self
        index: IntArray | None = None
        while rows is not None:
            if name in rows.columns:
                found = rows.columns[name]
                return found if index is None else found.take(index)
            if rows.index is not None:
                index = rows.index if index is None else rows.index[index]
            rows = rows.parent
        return None

    def all_columns(self, since: _Rows | None = None) -> dict[str, Column]:
        """All columns in the order of the packet, or those from the rows `since` on; of two of one name the later."""
        levels: list[tuple[_Rows, IntArray | None]] = []
        rows: _Rows | None = self
        index: IntArray | None = None
        while rows is not None:
            levels.append((rows, index))
            if since is not None and rows.columns is since.columns:
                break
            if rows.index is not None:
                index = rows.index if index is None else rows.index[index]
            rows = rows.parent
        columns: dict[str, Column] = {}
        for level, chosen in reversed(levels):
            for name, column in level.columns.items():
                if not name.startswith("\0"):
                    columns[name] = column if chosen is None else column.take(chosen)
        return columns


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """A buffer that is being decoded; `data` are the octets of this chunk of packets, from `base` on.

    `padded` are the same octets with `_SHORT_TEXT` zeros behind them. `unknown` are packets of unknown values.
    """

    octets: OctetArray
    begins: IntArray
    ends: IntArray
    verdict: npt.NDArray[np.int8]
    data: bytes
    padded: OctetArray
    base: int
    unknown: dict[str, list[IntArray]]

    def note(self, name: str, packets: IntArray) -> None:
        """Note packets in which a value of a parameter is not known."""
        self.unknown.setdefault(name, []).append(packets)

    def end(self, rows: _Rows) -> IntArray:
        """Bits into the buffer at which the packets end."""
        found: IntArray = self.ends[rows.packet]
        return found

    def keep(self, rows: _Rows, good: BoolArray, verdict: int) -> _Rows:
        """The good rows; the packets of the others get the verdict."""
        if good.all():
            return rows
        self.verdict[rows.packet[~good]] = verdict
        return rows.narrowed(good)

    def room(self, rows: _Rows, bits: int | IntArray) -> BoolArray:
        """Return whether enough bits are left."""
        enough: BoolArray = self.end(rows) - rows.at >= bits
        return enough

    def table(self, name: str, rows: _Rows) -> XtceTable:
        """The rows as a table in the order of the stream."""
        columns = rows.all_columns()
        unread = self.end(rows) - rows.at
        return XtceTable(name, rows.packet, columns, unread)


def _advance(run: _Run, steps: Sequence[_Step], rows: _Rows) -> _Rows:
    for step in steps:
        if not len(rows):
            return rows
        if isinstance(step, _Fixed):
            rows = run.keep(rows, run.room(rows, step.extent), TOO_SHORT)
            if step.fields:
                rows = _fixed_columns(run, step, rows)
            rows = _moved(rows, rows.at + step.advance)
        elif isinstance(step, _Seek):
            mark = None if step.mark is None else rows.column(step.mark)
            at = mark.raw if isinstance(mark, ValueColumn) else rows.at
            if isinstance(step.offset, int):
                at = at + step.offset
            else:
                steps_on, sized = _sizes(run, step.offset, rows, None)
                rows, at = run.keep(rows, sized, MALFORMED), (at + steps_on)[sized]
            begin = run.begins[rows.packet]
            good = (at >= begin) & (at <= run.end(rows))
            moved = _moved(rows, at)
            rows = run.keep(moved, good, TOO_SHORT)
        elif isinstance(step, _Mark):
            rows = _moved(rows, rows.at)
            rows.columns[step.name] = ValueColumn(rows.at, rows.at)
        elif isinstance(step, _Read):
            column, at, readable = _read(run, step.parameter.type, rows, step.parameter.name)
            rows = _moved(rows if readable is None else rows.narrowed(readable), at)
            rows.columns[step.parameter.name] = column
        else:
            rows = _optional(run, step, rows)
    return rows


def _joined(tables: list[XtceTable]) -> XtceTable:
    """The tables of the chunks as one, in the order of the packets."""
    if len(tables) == 1:
        return tables[0]
    index = np.concatenate([table.packet_index for table in tables])
    whole = XtceTable(
        tables[0].name,
        index,
        {name: concatenated([table.columns[name] for table in tables]) for name in tables[0].columns},
        np.concatenate([table.unread_bits for table in tables]),
    )
    return whole if (np.diff(index) > 0).all() else whole.take(np.argsort(index, kind="stable"))


def _moved(rows: _Rows, at: IntArray) -> _Rows:
    """The same rows at other positions."""
    moved = _Rows(rows.packet, at, rows.parent, rows.index)
    moved.columns = rows.columns
    return moved


def _optional(run: _Run, step: _Optional, rows: _Rows) -> _Rows:
    inner = rows.narrowed(_holds(step.condition, rows))
    done = _advance(run, step.steps, inner)
    if not len(inner):
        return rows
    back = np.searchsorted(rows.packet, done.packet)  # packets rise
    at = rows.at.copy()
    at[back] = done.at
    present = np.zeros(len(rows), dtype=np.bool_)
    present[back] = True
    keep = run.verdict[rows.packet] == DECODED
    kept = _moved(rows, at).narrowed(keep)
    for name, column in done.all_columns(since=inner).items():
        kept.columns[name] = OptionalColumn(present[keep], column)
    return kept


# values

_Found = tuple[Column, IntArray, "BoolArray | None"]
"""A column and the positions behind it for the rows that could be read, and which these are (None: all)."""


def _fixed_columns(run: _Run, step: _Fixed, rows: _Rows) -> _Rows:
    raws = _raw_fields(run, rows.at, [(one.encoding, offset) for _, one, offset in step.fields], step.extent)
    for (name, data_type, _), raw in zip(step.fields, raws, strict=True):
        values, covered = _calibrated(data_type, raw, rows, name)
        rows.columns[name] = ValueColumn(raw, values)
        if covered is not None:
            run.note(name, rows.packet[~covered])
    return rows


def _read(run: _Run, data_type: DataType, rows: _Rows, name: str) -> _Found:
    """Read values of the parameter `name`, or of a part of it."""
    if isinstance(data_type, AggregateType):
        return _read_aggregate(run, data_type, rows, name)
    if isinstance(data_type, ArrayType):
        return _read_array(run, data_type, rows, name)
    encoding = data_type.encoding
    if isinstance(encoding, (IntegerEncoding, FloatEncoding)):
        return _read_records(run, data_type, [(data_type, 0)], rows, name)
    if isinstance(encoding, BinaryEncoding):
        if encoding.tag_bits:
            bits, sized = _tagged(run, rows, encoding.tag_bits, 8)
            return _read_octets(run, _moved(rows, rows.at + encoding.tag_bits), bits, sized, None, name)
        bits, sized = _sizes(run, encoding.size, rows, 0)
        return _read_octets(run, rows, bits, sized, None, name)
    if encoding.size is None:
        return _read_open_text(run, rows, encoding, name)
    bits, sized = _sizes(run, encoding.size, rows, 0)
    return _read_octets(run, rows, bits, sized, encoding, name)


def _read_aggregate(run: _Run, data_type: AggregateType, rows: _Rows, name: str) -> _Found:
    fixed = _fixed_fields(data_type)
    if fixed is not None:
        return _read_records(run, data_type, fixed, rows, name)
    members: dict[str, Column] = {}
    mine, index = rows, np.arange(len(rows), dtype=np.int64)
    for part, member in data_type.members:
        column, at, good = _read(run, member, mine, name)
        if good is not None:
            chosen = np.flatnonzero(good)
            members = {key: value.take(chosen) for key, value in members.items()}
            index = index[chosen]
            mine = mine.narrowed(good)
        members[part] = column
        mine = _moved(mine, at)
    kept = np.zeros(len(rows), dtype=np.bool_)
    kept[index] = True
    return RecordColumn(members), mine.at, None if kept.all() else kept


def _fixed_fields(data_type: DataType, offset: int = 0) -> list[tuple[ScalarType, int]] | None:
    """The numbers of a type of fixed width and their places, None where its width depends on the packet."""
    if isinstance(data_type, ScalarType):
        encoding = data_type.encoding
        if not isinstance(encoding, (IntegerEncoding, FloatEncoding)) or encoding.calibration.contexts:
            return None
        return [(data_type, offset)]
    if isinstance(data_type, ArrayType):
        return None
    fields: list[tuple[ScalarType, int]] = []
    for _, member in data_type.members:
        inner = _fixed_fields(member, offset)
        if inner is None:
            return None
        fields += inner
        last, place = inner[-1]
        assert last.bits is not None
        offset = place + last.bits
    return fields


def _read_records(
    run: _Run, data_type: DataType, fields: list[tuple[ScalarType, int]], rows: _Rows, name: str
) -> _Found:
    """Values or aggregates of fixed width."""
    last, place = fields[-1]
    assert last.bits is not None
    bits = place + last.bits
    enough = run.room(rows, bits)
    mine = run.keep(rows, enough, TOO_SHORT)
    raws = _raw_fields(run, mine.at, [(one.encoding, offset) for one, offset in fields], bits)
    columns: list[Column] = []
    for (one, _), raw in zip(fields, raws, strict=True):
        values, covered = _calibrated(one, raw, mine, name)
        columns.append(ValueColumn(raw, values))
        if covered is not None:
            run.note(name, mine.packet[~covered])
    column: Column = _assembled(data_type, iter(columns))
    return column, mine.at + bits, None if enough.all() else enough


def _assembled(data_type: DataType, columns: Any) -> Column:
    if isinstance(data_type, AggregateType):
        return RecordColumn({name: _assembled(member, columns) for name, member in data_type.members})
    column: Column = next(columns)
    return column


def _read_array(run: _Run, data_type: ArrayType, rows: _Rows, name: str) -> _Found:
    last, sized = _sizes(run, data_type.last, rows, None)
    first, also = _sizes(run, data_type.first, rows, None)
    counts = last - first + 1
    good = sized & also
    wrong = good & (counts < 0)
    run.verdict[rows.packet[wrong]] = MALFORMED
    good &= ~wrong
    fixed = _fixed_fields(data_type.element)
    bits = 1
    if fixed is not None:
        bits = fixed[-1][1] + (fixed[-1][0].bits or 0)
    gap = data_type.gap_bits
    # an element takes a bit at least, so that a count alone cannot ask for memory
    room = good & (counts <= (run.end(rows) - rows.at + gap) // (bits + gap))
    run.verdict[rows.packet[good & ~room]] = TOO_SHORT
    mine = rows.narrowed(room)
    counts = counts[room]
    if fixed is not None:
        column, at, whole = _read_fixed_elements(run, data_type, fixed, mine, counts, bits + gap, name)
    else:
        column, at, whole = _read_open_elements(run, data_type, mine, counts, name)
    if whole is not None:
        kept = room.copy()
        kept[np.flatnonzero(room)] = whole
        return column, at, kept
    return column, at, None if room.all() else room


def _read_fixed_elements(
    run: _Run,
    data_type: ArrayType,
    fields: list[tuple[ScalarType, int]],
    rows: _Rows,
    counts: IntArray,
    bits: int,
    name: str,
) -> _Found:
    """Elements of fixed width, `bits` from the start of one to that of the next."""
    owner = np.repeat(np.arange(len(rows), dtype=np.int64), counts)
    place = np.arange(len(owner), dtype=np.int64) - np.repeat(np.cumsum(counts) - counts, counts)
    elements = _Rows(rows.packet[owner], rows.at[owner] + place * bits, rows, owner)
    column, _, good = _read_records(run, data_type.element, fields, elements, name)
    at = rows.at + counts * bits - (data_type.gap_bits - data_type.tail_bits) * (counts > 0)
    if good is None:
        return ArrayColumn(counts, column), at, None
    kept = np.ones(len(rows), dtype=np.bool_)
    kept[owner[~good]] = False
    stays = np.flatnonzero(kept[owner[good]])
    index = np.flatnonzero(kept)
    return ArrayColumn(counts[index], column.take(stays)), at[index], kept


def _read_open_elements(run: _Run, data_type: ArrayType, rows: _Rows, counts: IntArray, name: str) -> _Found:
    """Elements whose width depends on the packet: the k-th of all packets together."""
    element = data_type.element
    at = rows.at.copy()
    kept = np.ones(len(rows), dtype=np.bool_)
    pieces: list[Column] = []
    owners: list[IntArray] = []
    k = 0
    while True:
        active = np.flatnonzero(kept & (counts > k))
        if not len(active):
            break
        start = at[active] + (data_type.gap_bits if k else 0)
        elements = _Rows(rows.packet[active], start, rows, active)
        column, behind, good = _read(run, element, elements, name)
        if good is not None:
            kept[active[~good]] = False
            active = active[good]
        at[active] = behind
        pieces.append(column)
        owners.append(active)
        k += 1
    if not pieces:
        # no packet has an element: a column of none, read from no rows
        column, _, _ = _read(run, element, rows.narrowed(np.zeros(len(rows), dtype=np.bool_)), name)
    else:
        joined = concatenated(pieces)
        owner = np.concatenate(owners)
        stays = np.flatnonzero(kept[owner])
        column = joined.take(stays[np.argsort(owner[stays], kind="stable")])
    index = np.flatnonzero(kept)
    at += data_type.tail_bits * (counts > 0)
    return ArrayColumn(counts[index], column), at[index], None if kept.all() else kept


def _sizes(run: _Run, size: Size, rows: _Rows, least: int | None) -> tuple[IntArray, BoolArray]:
    """Numbers (n,) that a size comes to, and where it is a number at all; the others are malformed."""
    good = np.ones(len(rows), dtype=np.bool_)
    if size.fixed is not None:
        return np.full(len(rows), size.fixed, dtype=np.int64), good
    if size.reference is not None:
        values, present = _resolved(size.reference, rows)
        with np.errstate(all="ignore"):
            numbers = values.astype(np.float64) * size.slope + size.intercept
        good = present & np.isfinite(numbers)
        numbers = np.clip(np.where(good, numbers, 0.0), -_MOST_BITS, _MOST_BITS)
        good &= numbers == np.rint(numbers)
        if least is not None:
            good &= numbers >= least
        found = np.where(good, numbers, 0.0).astype(np.int64)
    else:
        found = np.zeros(len(rows), dtype=np.int64)
        undecided = good.copy()
        for condition, value in size.lookup:
            matched = undecided & _holds(condition, rows)
            found[matched] = value
            undecided &= ~matched
        good = ~undecided
    run.verdict[rows.packet[~good]] = MALFORMED
    return found, good


def _read_octets(
    run: _Run, rows: _Rows, bits: IntArray, sized: BoolArray, text: StringEncoding | None, name: str
) -> _Found:
    """Octets, or texts in buffers, of so many bits (n,) each."""
    enough = run.room(rows, bits)
    run.verdict[rows.packet[sized & ~enough]] = TOO_SHORT
    good = sized & enough
    index = np.flatnonzero(good)
    at, bits = rows.at[index], bits[index]
    aligned = not ((at | bits) & 7).any()
    if aligned:
        column = _slices(run, at >> 3, bits >> 3)
    else:
        column = _objects(_pieces(run.octets, at, bits, left=text is not None))
    behind = at + bits
    if text is None:
        return ValueColumn(column, column), behind, None if good.all() else good
    texts = _aligned_texts(run, at, bits, column, text) if aligned else None
    is_plain = texts is not None
    if texts is None:
        texts = _objects(_texts(column.tolist(), text))
    if text.most_bits is not None and (bits > text.most_bits).any():
        texts[bits > text.most_bits], is_plain = None, False
    if not is_plain:
        unknown = np.array([one is None for one in texts.tolist()], dtype=np.bool_)
        run.note(name, rows.packet[index[unknown]])
    return ValueColumn(column, texts), behind, None if good.all() else good


def _slices(run: _Run, starts: IntArray, sizes: IntArray) -> RecordArray:
    """So many octets (n,) of the buffer from `starts` (n,) on, as objects."""
    if len(sizes) and 0 < sizes[0] <= 4096 and (sizes == sizes[0]).all():
        found: RecordArray = gather(run.octets, starts, np.dtype((np.void, int(sizes[0])))).astype(object)
        return found
    data = run.data
    first = starts - run.base
    last = first + sizes
    return _objects([data[a:b] for a, b in zip(first.tolist(), last.tolist(), strict=True)])


def _aligned_texts(
    run: _Run, at: IntArray, bits: IntArray, raw: RecordArray, encoding: StringEncoding
) -> RecordArray | None:
    """Texts (n,) in buffers `raw` of whole octets; None where one is no text or the layout is not a plain one."""
    starts, sizes = at >> 3, bits >> 3
    if encoding.tag_bits:
        if encoding.tag_bits & 7 or encoding.terminator or (bits < encoding.tag_bits).any():
            return None
        tag = IntegerEncoding(encoding.tag_bits)
        (lengths,) = _raw_fields(run, at, [(tag, 0)], encoding.tag_bits)
        lengths = lengths * encoding.unit_bits
        if (lengths & 7).any() or (lengths + encoding.tag_bits > bits).any():
            return None
        starts, sizes = at + encoding.tag_bits >> 3, lengths >> 3
    elif encoding.terminator:
        size = int(sizes[0]) if len(sizes) else 0
        if len(encoding.terminator) > 1 or size == 0 or (sizes != size).any():
            return None
        buffers = gather(run.octets, starts, np.dtype((np.void, size))).view(np.uint8).reshape(-1, size)
        ends = buffers == encoding.terminator[0]
        sizes = np.where(ends.any(axis=1), ends.argmax(axis=1), size)
    plain = not encoding.tag_bits and not encoding.terminator
    return _decoded_texts(run, starts, sizes, encoding.charset, raw if plain else None)


def _decoded_texts(
    run: _Run, starts: IntArray, sizes: IntArray, charset: str, whole: RecordArray | None
) -> RecordArray | None:
    """Texts (n,) of so many octets each; None where one of them is no text.

    Short ones are widened to four octets a character and made strings by numpy, which takes zeros at the end for none.
    The others are decoded one by one, out of `whole` where these are their octets.
    """
    width = {"ascii": 1, "latin-1": 1, "utf-8": 1, "utf-16-be": 2, "utf-16-le": 2}.get(charset, 0)
    longest = -(-int(sizes.max(initial=0)) // max(width, 1)) * max(width, 1)
    slow = np.ones(len(sizes), dtype=np.bool_)
    texts = np.empty(len(sizes), dtype=object)
    if width and 0 < longest <= _SHORT_TEXT:
        octets = gather(run.padded, starts - run.base, np.dtype((np.void, longest)))
        units = octets.view(">u2" if charset == "utf-16-be" else f"<u{width}").reshape(-1, longest // width)
        counts = sizes // width
        if (counts != longest // width).any():
            units[np.arange(longest // width) >= counts[:, None]] = 0
        slow = (counts > 0) & (units[np.arange(len(counts)), np.maximum(counts, 1) - 1] == 0)
        slow |= sizes % width != 0
        if charset in ("ascii", "utf-8"):
            slow |= units.max(axis=1) > 0x7F
        elif width == 2:  # surrogates
            slow |= (units >> 11 == 0x1B).any(axis=1)
        if 2 * int(slow.sum()) > len(slow):
            slow[:] = True
        else:
            texts = units.astype("=u4").view(f"=U{longest // width}")[:, 0].astype(object)
    rows = np.flatnonzero(slow)
    if len(rows):
        pieces = _slices(run, starts[rows], sizes[rows]) if whole is None else whole[rows]
        try:
            decode = bytes.decode if charset == "utf-8" else methodcaller("decode", charset)
            texts[rows] = _objects(list(map(decode, pieces.tolist())))
        except UnicodeDecodeError:
            return None
    return texts


def _pieces(octets: OctetArray, at: IntArray, bits: IntArray, *, left: bool) -> list[bytes]:
    """The bits (n,) from `at` on as octets; bits that fill no octet are in the low end of the first (`left` False),
    or in the high end of the last."""
    view = octets.data
    pieces = []
    for first, count in zip(at.tolist(), bits.tolist(), strict=True):
        last = first + count
        number = int.from_bytes(view[first >> 3 : (last + 7) >> 3], "big") >> (-last & 7)
        number &= (1 << count) - 1
        size = (count + 7) >> 3
        pieces.append((number << (-count & 7) if left else number).to_bytes(size, "big"))
    return pieces


def _objects(values: Sequence[Any]) -> RecordArray:
    array = np.empty(len(values), dtype=object)
    array[:] = values
    return array


def _texts(buffers: list[bytes], encoding: StringEncoding) -> list[str | None]:
    """Texts in buffers, None where a buffer holds none."""
    texts: list[str | None] = []
    for octets in buffers:
        try:
            texts.append(_text(octets, encoding))
        except ValueError:  # that of decoding included
            texts.append(None)
    return texts


def _text(octets: bytes, encoding: StringEncoding) -> str:
    if encoding.tag_bits:
        if len(octets) * 8 < encoding.tag_bits:
            raise ValueError("no room for the size")
        tagged = (encoding.tag_bits + 7) // 8
        length = (int.from_bytes(octets[:tagged], "big") >> (-encoding.tag_bits & 7)) * encoding.unit_bits
        if length % 8 or encoding.tag_bits + length > len(octets) * 8:
            raise ValueError("a size that is none")
        rest = int.from_bytes(octets, "big") >> (len(octets) * 8 - encoding.tag_bits - length)
        octets = (rest & ((1 << length) - 1)).to_bytes(length // 8, "big")
    if encoding.terminator:
        end = _terminated(octets, encoding.terminator)
        octets = octets if end < 0 else octets[:end]
    return octets.decode(encoding.charset)


def _terminated(octets: bytes, terminator: bytes) -> int:
    """Return the position of the terminator, at a whole character; -1 without one."""
    place = octets.find(terminator)
    while place > 0 and place % len(terminator):
        place = octets.find(terminator, place + 1)
    return place


def _read_open_text(run: _Run, rows: _Rows, encoding: StringEncoding, name: str) -> _Found:
    """Texts without a buffer: as long as the size before them or the terminator says, or to the end of the packet."""
    if encoding.tag_bits:
        bits, sized = _tagged(run, rows, encoding.tag_bits, encoding.unit_bits)
        return _read_octets(run, rows, bits + encoding.tag_bits, sized, encoding, name)
    most = _MOST_BITS if encoding.most_bits is None else encoding.most_bits
    sized = np.ones(len(rows), dtype=np.bool_)
    bits = np.zeros(len(rows), dtype=np.int64)
    ends = run.end(rows)
    for row, (at, end) in enumerate(zip(rows.at.tolist(), ends.tolist(), strict=True)):
        size = min(end - at, most) // 8
        rest = _pieces(run.octets, np.array([at]), np.array([size * 8]), left=True)[0]
        place = _terminated(rest, encoding.terminator)
        bits[row] = 8 * (size if place < 0 else place + len(encoding.terminator))
        sized[row] = place >= 0 or end - at <= most
    run.verdict[rows.packet[~sized]] = MALFORMED
    return _read_octets(run, rows, bits, sized, encoding, name)


def _tagged(run: _Run, rows: _Rows, tag_bits: int, unit: int) -> tuple[IntArray, BoolArray]:
    """Bits (n,) that leading sizes state, which count so many bits, and which packets have room for the size."""
    enough = run.room(rows, tag_bits)
    mine = run.keep(rows, enough, TOO_SHORT)
    (lengths,) = _raw_fields(run, mine.at, [(IntegerEncoding(tag_bits), 0)], tag_bits)
    bits = np.zeros(len(rows), dtype=np.int64)
    bits[np.flatnonzero(enough)] = lengths * unit
    return bits, enough


# numbers


def _raw_fields(run: _Run, at: IntArray, fields: Sequence[tuple[Any, int]], bits: int) -> list[RecordArray]:
    """Raw columns (n,) of numbers at offsets from `at`, all inside `bits` bits that are there."""
    if not len(at):
        return [np.empty(0, dtype=_raw_dtype(encoding)) for encoding, _ in fields]
    phase = at & 7
    least, greatest = int(phase.min()), int(phase.max())
    if least == greatest:
        return _record_fields(run.octets, at >> 3, least, fields, bits)
    columns: list[RecordArray] = [np.empty(len(at), dtype=_raw_dtype(encoding)) for encoding, _ in fields]
    for one in range(least, greatest + 1):
        mine = np.flatnonzero(phase == one)
        if len(mine):
            found = _record_fields(run.octets, at[mine] >> 3, one, fields, bits)
            for column, part in zip(columns, found, strict=True):
                column[mine] = part
    return columns


def _raw_dtype(encoding: IntegerEncoding | FloatEncoding) -> type:
    if isinstance(encoding, FloatEncoding):
        return np.float64
    return np.uint64 if encoding.bits == 64 and encoding.form == "unsigned" else np.int64


def _record_fields(
    octets: OctetArray, starts: IntArray, phase: int, fields: Sequence[tuple[Any, int]], bits: int
) -> list[RecordArray]:
    span = (phase + bits + 7) >> 3
    records = gather(octets, starts, np.dtype((np.void, span))).view(np.uint8).reshape(-1, span)
    columns: list[RecordArray] = []
    for encoding, offset in fields:
        if isinstance(encoding, IntegerEncoding):
            columns.append(_integers(records, phase + offset, encoding))
        else:
            columns.append(_floats(records, phase + offset, encoding))
    return columns


def _unsigned(records: OctetArray, bit: int, bits: int) -> npt.NDArray[np.uint64]:
    """Bits `bit` to `bit + bits` of each record as unsigned integers."""
    n, span = records.shape
    first, stop = bit >> 3, (bit + bits + 7) >> 3
    if stop - first == 9:
        high = _window(records, first, 8).astype(np.uint64)
        shift = stop * 8 - bit - bits
        value = high << np.uint64(8 - shift) | records[:, stop - 1] >> np.uint8(shift)
        return value & np.uint64((1 << bits) - 1)
    size = 1
    while size < stop - first:
        size *= 2
    begin = stop - size
    if begin < 0:
        begin = 0 if span >= size else -1
    if begin >= 0:
        value = _window(records, begin, size).astype(np.uint64)
        end = begin + size
    else:
        value = np.zeros(n, dtype=np.uint64)
        for column in range(first, stop):
            value = value << np.uint64(8) | records[:, column]
        begin, end = first, stop
    if end * 8 - bit - bits:
        value >>= np.uint64(end * 8 - bit - bits)
    if bits < 64 and bit > begin * 8:
        value &= np.uint64((1 << bits) - 1)
    return value


def _window(records: OctetArray, begin: int, size: int, kind: str = "u", order: str = ">") -> RecordArray:
    """Numbers of whole octets at one place of each record, without a copy."""
    n, span = records.shape
    return np.ndarray((n,), dtype=f"{order}{kind}{size}", buffer=records, offset=begin, strides=(span,))


def _integers(records: OctetArray, bit: int, encoding: IntegerEncoding) -> RecordArray:
    bits, form = encoding.bits, encoding.form
    order = "<" if encoding.little else ">"
    if not bit & 7 and bits in (8, 16, 32, 64) and form in ("unsigned", "twosComplement"):
        kind = "u" if form == "unsigned" else "i"
        return _window(records, bit >> 3, bits >> 3, kind, order).astype(_raw_dtype(encoding))
    value = _unsigned(records, bit, bits)
    if encoding.little:
        value = value.byteswap() >> np.uint64(64 - bits)
    if form == "unsigned":
        return value if bits == 64 else value.view(np.int64)
    sign = (value >> np.uint64(bits - 1)).astype(np.bool_)
    if form == "twosComplement":
        if bits == 64:
            return value.view(np.int64)
        half = np.int64(1 << bits - 1)
        return (value.view(np.int64) ^ half) - half
    if form == "onesComplement":
        inverted = ~value & np.uint64((1 << bits) - 1) if bits < 64 else ~value
        magnitude = np.where(sign, inverted, value)
    else:
        magnitude = value & np.uint64((1 << bits - 1) - 1)
    number = magnitude.view(np.int64)
    return np.where(sign, -number, number)


def _floats(records: OctetArray, bit: int, encoding: FloatEncoding) -> RecordArray:
    bits = encoding.bits
    order = "<" if encoding.little else ">"
    if encoding.form == "IEEE754" and not bit & 7:
        with np.errstate(invalid="ignore"):
            return _window(records, bit >> 3, bits >> 3, "f", order).astype(np.float64)
    value = _unsigned(records, bit, bits)
    if encoding.little:
        value = value.byteswap() >> np.uint64(64 - bits)
    if encoding.form == "IEEE754":
        with np.errstate(invalid="ignore"):
            return value.astype(f"=u{bits >> 3}").view(f"=f{bits >> 3}").astype(np.float64)
    number = value.view(np.int64)
    if bits == 32:  # mantissa (24 bits), exponent (8)
        mantissa, exponent, point = number >> 8, number & 0xFF, 23
    else:  # mantissa (24), exponent (8), rest of the mantissa (16)
        mantissa, exponent, point = (number >> 24) << 16 | number & 0xFFFF, number >> 16 & 0xFF, 39
    mantissa = (mantissa ^ (1 << point)) - (1 << point)
    exponent = (exponent ^ 0x80) - 0x80
    return np.ldexp(mantissa.astype(np.float64), (exponent - point).astype(np.int32))


# what numbers mean


def _calibrated(
    data_type: ScalarType, raw: RecordArray, rows: _Rows, name: str
) -> tuple[RecordArray, BoolArray | None]:
    """Values of raw numbers, and which of them a calibrator covers (None: all); the others are NaN."""
    if data_type.is_boolean:
        return raw != 0, None
    if data_type.labels:
        return _named(data_type, raw), None
    encoding = data_type.encoding
    assert isinstance(encoding, (IntegerEncoding, FloatEncoding))
    calibration = encoding.calibration
    if not calibration.contexts:
        return (raw, None) if calibration.default is None else _applied(calibration.default, raw)
    return _in_context(calibration, raw, rows, name)


def _named(data_type: ScalarType, raw: RecordArray) -> RecordArray:
    """Names of codes; a code without a name stays an integer."""
    firsts = np.array([first for first, _, _ in data_type.labels], dtype=raw.dtype)
    lasts = np.array([last for _, last, _ in data_type.labels], dtype=raw.dtype)
    names = _objects([label for _, _, label in data_type.labels])
    place = np.searchsorted(firsts, raw, side="right") - 1
    known = (place >= 0) & (raw <= lasts[np.maximum(place, 0)])
    values: RecordArray = names[np.maximum(place, 0)]
    if not known.all():
        values[~known] = raw[~known].tolist()
    return values


def _in_context(
    calibration: Calibration, raw: RecordArray, rows: _Rows, name: str
) -> tuple[RecordArray, BoolArray | None]:
    """Values by the first calibrator whose condition holds; a condition may ask for the raw value itself."""
    values = raw.astype(np.float64)
    covered = np.ones(len(raw), dtype=np.bool_)
    left = np.ones(len(raw), dtype=np.bool_)
    here = rows.narrowed(np.ones(len(rows), dtype=np.bool_))
    here.columns[name] = ValueColumn(raw, raw)
    choices = [*calibration.contexts, (None, calibration.default)]
    for condition, calibrator in choices:
        chosen = left if condition is None else left & _holds(condition, here)
        left = left & ~chosen
        if calibrator is not None and chosen.any():
            values[chosen], good = _applied(calibrator, raw[chosen])
            if good is not None:
                covered[np.flatnonzero(chosen)[~good]] = False
    return values, None if covered.all() else covered


def _applied(calibrator: Calibrator, raw: RecordArray) -> tuple[RecordArray, BoolArray | None]:
    """Calibrated values (n,), and which lie where the calibrator says something (None: all)."""
    x = raw.astype(np.float64)
    if isinstance(calibrator, Polynomial):
        total = np.zeros(len(x))
        with np.errstate(all="ignore"):
            for coefficient, exponent in calibrator.terms:
                total += coefficient * (x**exponent if exponent > 1 else x if exponent else 1.0)
        return total, None
    return _splined(calibrator, x)


def _splined(spline: Spline, x: RecordArray) -> tuple[RecordArray, BoolArray | None]:
    raws = np.array([point[0] for point in spline.points])
    calibrated = np.array([point[1] for point in spline.points])
    if spline.order == 0:
        values = calibrated[np.searchsorted(raws[1:], x, side="right")]
    else:
        left = np.searchsorted(raws[1:-1], x, side="right")
        slopes = np.diff(calibrated) / np.diff(raws)
        values = slopes[left] * (x - raws[left]) + calibrated[left]
    inside = (x >= raws[0]) & (x <= raws[-1])
    if spline.extrapolate:
        inside = ~np.isnan(x)
    if inside.all():
        return values, None
    return np.where(inside, values, np.nan), inside


# conditions

_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {"==": eq, "!=": ne, "<": lt, "<=": le, ">": gt, ">=": ge}


def _resolved(reference: Reference, rows: _Rows) -> tuple[RecordArray, BoolArray]:
    """Values (n,) of an earlier parameter, and which packets have it; zeros where there is none."""
    column = rows.column(reference.parameter)
    present = np.ones(len(rows), dtype=np.bool_)
    if column is None:
        return np.zeros(len(rows)), ~present
    if isinstance(column, OptionalColumn):
        present, column = column.present, column.column
    for member in reference.members:
        assert isinstance(column, RecordColumn)
        column = column.members[member]
    assert isinstance(column, ValueColumn)
    values = column.values if reference.calibrated else column.raw
    if not present.all():
        whole = np.zeros(len(rows), dtype=values.dtype)
        whole[present] = values
        values = whole
    return values, present


def _known(values: RecordArray) -> BoolArray:
    if values.dtype == np.object_:
        return np.array([one is not None for one in values.tolist()], dtype=np.bool_)
    return ~np.isnan(values) if values.dtype.kind == "f" else np.ones(len(values), dtype=np.bool_)


def _holds(condition: Condition, rows: _Rows) -> BoolArray:
    """Return where a condition holds (n,); a comparison with a parameter that a packet does not have does not."""
    if isinstance(condition, (AllOf, AnyOf)):
        parts = [_holds(one, rows) for one in condition.conditions]
        joined: BoolArray = np.all(parts, axis=0) if isinstance(condition, AllOf) else np.any(parts, axis=0)
        return joined
    if isinstance(condition, CodeIn):
        codes, present = _resolved(Reference(condition.left.parameter, condition.left.members, False), rows)
        inside = np.zeros(len(codes), dtype=np.bool_)
        for first, last in condition.ranges:
            inside |= (codes >= first) & (codes <= last)
        return present & (~inside if condition.negated else inside)
    left, present = _resolved(condition.left, rows)
    right: Any = condition.right
    if isinstance(right, Reference):
        right, also = _resolved(right, rows)
        present = present & also
    if condition.operator == "!=":  # of an unknown value, this is not known either
        present = present & _known(left)
    return present & np.asarray(_OPERATORS[condition.operator](left, right), dtype=np.bool_)
