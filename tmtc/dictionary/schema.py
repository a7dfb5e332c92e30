"""Packet definitions as tables, and what the tables do: pack, unpack (one packet or millions), name, hash.

A `Field` is one number (or a short vector of numbers) in a packet: how it is stored (`raw`), and what it
means (`engineering` = raw * scale + offset, NaN where raw is the `missing` code). A `PacketDefinition` is a
list of fields, optionally followed by a `Group` repeated as often as one of the fields says. A `Dictionary`
is a versioned set of definitions, compiled once to `struct` and numpy dtypes. All numbers are big-endian.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import operator
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from tmtc.arrays import BoolArray, IntArray, OctetArray, Octets, RecordArray, as_octets
from tmtc.dictionary.fields import Field
from tmtc.errors import MalformedPacket, TruncatedPacket, UnknownPacket, ValueRefused
from tmtc.packets import pus, space_packets
from tmtc.packets.stream import PacketCut

_STRUCT_CODES = {
    "u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "i32": "i", "u64": "Q", "i64": "q",
    "f32": "f", "f64": "d",
}  # fmt: skip

TM_DATA_START = space_packets.PRIMARY_HEADER_LENGTH + pus.TM_HEADER_LENGTH
TC_DATA_START = space_packets.PRIMARY_HEADER_LENGTH + pus.TC_HEADER_LENGTH

_TM_HEADER_DTYPE = np.dtype(
    [
        ("packet_id", ">u2"), ("sequence", ">u2"), ("data_length", ">u2"), ("pus", "u1"), ("service", "u1"),
        ("subtype", "u1"), ("message_counter", ">u2"), ("destination", ">u2"), ("p_field", "u1"),
        ("coarse", ">u4"), ("fine", ">u2"),
    ]
)  # fmt: skip
assert _TM_HEADER_DTYPE.itemsize == TM_DATA_START

WITHIN_LIMITS, WARNING, ALARM = 0, 1, 2

NOT_A_TM_PACKET = -1
WRONG_LENGTH = -2


@dataclass(frozen=True, slots=True)
class Group:
    """Fields that repeat; `count` names the field before them that tells how often."""

    count: str
    fields: tuple[Field, ...]
    name: str = "items"


@dataclass(frozen=True, slots=True)
class PacketDefinition:
    """A packet: where it is from (APID), what it is (service, subtype) and what it holds."""

    name: str
    apid: int
    service: int
    subtype: int
    description: str
    fields: tuple[Field, ...]
    group: Group | None = None
    packet_type: int = space_packets.TYPE_TELEMETRY

    @property
    def key(self) -> int:
        """Packet type, secondary header flag, APID, service and subtype as one integer."""
        return (self.packet_type << 12 | 1 << 11 | self.apid) << 16 | self.service << 8 | self.subtype

    @property
    def data_start(self) -> int:
        """Octets before the first field."""
        return TM_DATA_START if self.packet_type == space_packets.TYPE_TELEMETRY else TC_DATA_START

    @property
    def base_length(self) -> int:
        """Octets of the packet without repeated items, checksum included."""
        return self.data_start + sum(f.octets for f in self.fields) + space_packets.CRC_LENGTH

    @property
    def item_length(self) -> int:
        """Octets of one repeated item; 0 without a group."""
        return sum(f.octets for f in self.group.fields) if self.group else 0

    def field(self, name: str) -> Field:
        """The field or item field called `name`."""
        for candidate in self.fields + (self.group.fields if self.group else ()):
            if candidate.name == name:
                return candidate
        raise UnknownPacket(f"{self.name}: expected a field of this packet, found {name!r}")


@dataclass(frozen=True, slots=True, eq=False)
class DecodedPacket:
    """One packet of the dictionary with its headers; `values` are engineering, `raw` as transmitted."""

    name: str
    apid: int
    service: int
    subtype: int
    sequence_count: int
    ticks: int
    message_counter: int
    destination: int
    values: dict[str, Any]
    raw: dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class DecodedCommand:
    """One telecommand of the dictionary with its headers."""

    name: str
    apid: int
    service: int
    subtype: int
    sequence_count: int
    acknowledgements: int
    source: int
    values: dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """All packets of one kind as columns.

    `packet_index` (n,) points into the `PacketCut`; `columns` hold engineering values (integers as int64, u64 as
    uint64, all else float64), `raw` the transmitted ones; a field of size k gives (n, k). `items` holds the
    repeated fields of all packets one after another and `item_owner` the row of this table that each
    belongs to.
    """

    name: str
    packet_index: IntArray
    ticks: IntArray
    sequence_count: IntArray
    message_counter: IntArray
    columns: Mapping[str, RecordArray]
    raw: Mapping[str, RecordArray]
    items: Mapping[str, RecordArray]
    items_raw: Mapping[str, RecordArray]
    item_owner: IntArray

    def __len__(self) -> int:
        return int(self.packet_index.size)


@dataclass(frozen=True, eq=False)
class Dictionary:
    """A versioned set of telemetry and telecommand definitions."""

    version: int
    telemetry: tuple[PacketDefinition, ...]
    telecommands: tuple[PacketDefinition, ...] = ()
    _compiled: dict[str, _Compiled] = field(default_factory=dict, init=False, repr=False)
    _by_key: dict[int, PacketDefinition] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        for definition in self.telemetry + self.telecommands:
            if definition.name in self._compiled or definition.key in self._by_key:
                raise MalformedPacket(f"dictionary: {definition.name} is defined twice")
            self._compiled[definition.name] = _Compiled(definition)
            self._by_key[definition.key] = definition

    @functools.cached_property
    def hash(self) -> str:
        """SHA-256 (hex) of everything that the definitions say."""
        content = {
            "version": self.version,
            "telemetry": [asdict(d) for d in self.telemetry],
            "telecommands": [asdict(d) for d in self.telecommands],
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def packet(self, name: str) -> PacketDefinition:
        """The definition called `name`."""
        return self._find(name).definition

    def labels(self, packet: str, field_name: str) -> dict[int, str]:
        """Code to name of an enumerated field; empty for other fields."""
        return dict(self.packet(packet).field(field_name).labels)

    def pack(
        self,
        name: str,
        values: Mapping[str, object],
        *,
        ticks: int,
        sequence_count: int,
        message_counter: int = 0,
        destination: int = 0,
    ) -> bytes:
        """The telemetry packet `name` holding `values` (engineering).

        Enumerated fields take the code or its name. A repeated group takes a sequence of mappings or one
        mapping of arrays under the group's name; its count field may be left out.

        Raises
        ------
        UnknownPacket, ValueRefused
        """
        compiled = self._find(name)
        definition = compiled.definition
        if definition.packet_type != space_packets.TYPE_TELEMETRY:
            raise UnknownPacket(f"expected a telemetry packet, found telecommand {name!r}")
        header = pus.TmSecondaryHeader(definition.service, definition.subtype, int(ticks), message_counter, destination)
        return compiled.packet(pus.pack_tm_header(header), values, sequence_count)

    def pack_command(
        self,
        name: str,
        values: Mapping[str, object],
        *,
        sequence_count: int,
        acknowledgements: int = pus.ACK_ALL,
        source: int = 0,
    ) -> bytes:
        """Return the telecommand packet `name` with `values`, by the rules of `pack`, for finite numbers only.

        Values that are not numbers are refused: true and false are not accepted for any field.
        """
        compiled = self._find(name)
        definition = compiled.definition
        if definition.packet_type != space_packets.TYPE_TELECOMMAND:
            raise UnknownPacket(f"expected a telecommand, found telemetry packet {name!r}")
        for field_name, value in values.items():
            _refuse_no_number(name, field_name, value)
        header = pus.TcSecondaryHeader(definition.service, definition.subtype, acknowledgements, source)
        return compiled.packet(pus.pack_tc_header(header), values, sequence_count)

    def unpack(self, octets: bytes) -> tuple[str, dict[str, Any]]:
        """Name and engineering values of one telemetry packet; repeated items as a mapping of arrays.

        Raises
        ------
        TruncatedPacket, MalformedPacket, ChecksumError, UnknownPacket
        """
        decoded = self.unpack_packet(octets)
        return decoded.name, decoded.values

    def unpack_packet(self, octets: bytes) -> DecodedPacket:
        """One telemetry packet with its headers, engineering and raw values."""
        primary = _checked_header(octets, space_packets.TYPE_TELEMETRY)
        header = pus.unpack_tm_header(memoryview(octets)[space_packets.PRIMARY_HEADER_LENGTH :])
        compiled = self._identify_one(octets, header.service, header.subtype)
        values, raw = compiled.values(octets)
        return DecodedPacket(
            compiled.definition.name, primary.apid, header.service, header.subtype, primary.sequence_count,
            header.ticks, header.message_counter, header.destination, values, raw,
        )  # fmt: skip

    def unpack_command(self, octets: bytes) -> DecodedCommand:
        """One telecommand packet with its headers and engineering values."""
        primary = _checked_header(octets, space_packets.TYPE_TELECOMMAND)
        header = pus.unpack_tc_header(memoryview(octets)[space_packets.PRIMARY_HEADER_LENGTH :])
        compiled = self._identify_one(octets, header.service, header.subtype)
        values, _ = compiled.values(octets)
        return DecodedCommand(
            compiled.definition.name, primary.apid, header.service, header.subtype, primary.sequence_count,
            header.acknowledgements, header.source, values,
        )  # fmt: skip

    def identify(self, buffer: Octets, cut: PacketCut) -> IntArray:
        """Index into `telemetry` of every packet of `cut`, negative where there is none.

        `NOT_A_TM_PACKET` (-1): bad checksum or not in this dictionary; `WRONG_LENGTH` (-2): in the
        dictionary, but of another length than its definition and count say.
        """
        octets = as_octets(buffer)
        result = np.full(cut.offsets.size, NOT_A_TM_PACKET, dtype=np.int64)
        usable = np.flatnonzero(cut.crc_ok & (cut.lengths >= TM_DATA_START + space_packets.CRC_LENGTH))
        if not usable.size:
            return result
        header = gather(octets, cut.offsets[usable], _TM_HEADER_DTYPE)
        key = header["packet_id"].astype(np.int64) << 16
        key |= header["service"].astype(np.int64) << 8
        key |= header["subtype"]
        key[(header["pus"] >> 4 != 2) | (header["p_field"] != 0x2E)] = -1
        lengths = cut.lengths[usable]
        for index, definition in enumerate(self.telemetry):
            rows = np.flatnonzero(key == definition.key)
            if rows.size:
                mine = usable[rows]
                right = self._compiled[definition.name].lengths_hold(octets, cut.offsets[mine], lengths[rows])
                result[mine] = np.where(right, index, WRONG_LENGTH)
        return result

    def unpack_many(self, buffer: Octets, cut: PacketCut) -> dict[str, Table]:
        """A table for every kind of telemetry packet in `cut`; damaged and unknown ones are left out."""
        octets = as_octets(buffer)
        which = self.identify(octets, cut)
        tables = {}
        for index, definition in enumerate(self.telemetry):
            rows = np.flatnonzero(which == index)
            if rows.size:
                tables[definition.name] = self._compiled[definition.name].table(octets, cut.offsets, rows)
        return tables

    def _find(self, name: str) -> _Compiled:
        try:
            return self._compiled[name]
        except KeyError:
            raise UnknownPacket(
                f"dictionary {self.version}: expected one of {', '.join(self._compiled)}, found {name!r}"
            ) from None

    def _identify_one(self, octets: bytes, service: int, subtype: int) -> _Compiled:
        packet_id = int.from_bytes(octets[:2], "big")
        definition = self._by_key.get(packet_id << 16 | service << 8 | subtype)
        if definition is None:
            raise UnknownPacket(
                f"dictionary version {self.version} has no packet of APID 0x{packet_id & 0x7FF:03X}, "
                f"service {service}, subtype {subtype}"
            )
        return self._compiled[definition.name]


def limit_states(field: Field, values: npt.ArrayLike) -> npt.NDArray[np.int8]:
    """`WITHIN_LIMITS`, `WARNING` or `ALARM` for each engineering value; NaN breaks no limit."""
    numbers = np.asarray(values, dtype=np.float64)
    states = np.full(numbers.shape, WITHIN_LIMITS, dtype=np.int8)
    for state, limits in ((WARNING, field.warning), (ALARM, field.alarm)):
        if limits is not None:
            states[(numbers < limits[0]) | (numbers > limits[1])] = state
    return states


def gather(octets: OctetArray, starts: IntArray, dtype: np.dtype[Any]) -> RecordArray:
    """Records of `dtype` beginning at `starts` (n,), copied out of `octets`."""
    if not starts.size:
        return np.empty(0, dtype=dtype)
    length = dtype.itemsize
    opaque = np.dtype((np.void, length))
    windows: RecordArray = np.ndarray((octets.size - length + 1,), dtype=opaque, buffer=octets, strides=(1,))
    return windows[starts].view(dtype)


def _checked_header(octets: bytes, packet_type: int) -> Any:
    primary = space_packets.unpack_primary_header(octets)
    if len(octets) < primary.packet_length:
        raise TruncatedPacket("space packet", primary.packet_length, len(octets))
    if len(octets) > primary.packet_length:
        raise MalformedPacket(
            f"space packet: expected {primary.packet_length} octets by its length field, found {len(octets)}"
        )
    if primary.packet_type != packet_type or not primary.secondary_header:
        raise MalformedPacket(
            f"space packet: expected type {packet_type} with a secondary header, "
            f"found type {primary.packet_type}, secondary header flag {int(primary.secondary_header)}"
        )
    space_packets.check_crc(octets, f"packet of APID 0x{primary.apid:03X}, count {primary.sequence_count}")
    return primary


class _Compiled:
    """A definition with its struct and dtypes."""

    def __init__(self, definition: PacketDefinition) -> None:
        self.definition = definition
        group = definition.group
        codes = "".join(f"{f.size}{_STRUCT_CODES[f.type]}" for f in definition.fields)
        self.struct = struct.Struct(">" + codes)
        self.base_dtype = np.dtype(_dtype_fields(definition.fields))
        self.item_dtype = np.dtype(_dtype_fields(group.fields)) if group else None
        self.settable = {f.name for f in definition.fields} | ({group.name} if group else set())
        if definition.packet_type == space_packets.TYPE_TELEMETRY:
            self.tm_dtype = np.dtype([("header", _TM_HEADER_DTYPE), *_dtype_fields(definition.fields)])
        if group:
            count = definition.field(group.count)
            places = self.base_dtype.fields
            assert places is not None
            self.count_offset = definition.data_start + int(places[group.count][1])
            self.count_dtype = np.dtype(count.dtype)

    def packet(self, header: bytes, values: Mapping[str, object], sequence_count: int) -> bytes:
        """The whole packet with checksum."""
        definition = self.definition
        head = definition.packet_type << 12 | 1 << 11 | definition.apid
        body = header + self.data(values)
        packet = space_packets.pack_packet(
            definition.apid, body + b"\0\0", sequence_count=sequence_count, packet_type=definition.packet_type
        )
        assert int.from_bytes(packet[:2], "big") == head
        return space_packets.append_crc(packet[: -space_packets.CRC_LENGTH])

    def data(self, values: Mapping[str, object]) -> bytes:
        """The fields and items as octets."""
        definition, group = self.definition, self.definition.group
        unknown = values.keys() - self.settable
        if unknown:
            raise ValueRefused(definition.name, min(unknown), values[min(unknown)], "no such field")
        items, count = b"", 0
        if group:
            items, count = self._items(values.get(group.name, ()))
        numbers: list[int | float] = []
        for f in definition.fields:
            if group and f.name == group.count:
                if values.get(f.name, count) != count:
                    raise ValueRefused(definition.name, f.name, values[f.name], f"{count}, the number of items")
                if count > f.raw_limits[1]:
                    raise ValueRefused(definition.name, group.name, count, f"at most {f.raw_limits[1]} items")
                numbers.append(count)
                continue
            if f.name not in values:
                raise ValueRefused(definition.name, f.name, None, "a value")
            value = values[f.name]
            if f.size == 1:
                numbers.append(encode(definition.name, f, value))
                continue
            elements = list(value) if isinstance(value, (Sequence, np.ndarray)) else [value]
            if len(elements) != f.size:
                raise ValueRefused(definition.name, f.name, value, f"{f.size} numbers")
            one = replace(f, size=1)
            numbers.extend(encode(definition.name, one, element) for element in elements)
        try:
            return self.struct.pack(*numbers) + items
        except OverflowError:
            raise ValueRefused(definition.name, "f32 field", numbers, "magnitudes below 3.4e38") from None

    def values(self, octets: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
        """Engineering and raw values of one packet whose checksum holds."""
        definition, group = self.definition, self.definition.group
        found = len(octets)
        if found < definition.base_length:
            raise MalformedPacket(f"{definition.name}: expected {definition.base_length} octets or more, found {found}")
        numbers = iter(self.struct.unpack_from(octets, definition.data_start))
        raw: dict[str, Any] = {}
        values: dict[str, Any] = {}
        for f in definition.fields:
            if f.size == 1:
                raw[f.name] = next(numbers)
                values[f.name] = _decode(f, raw[f.name])
            else:
                raw[f.name] = [next(numbers) for _ in range(f.size)]
                values[f.name] = [_decode(f, r) for r in raw[f.name]]
        count = raw[group.count] if group else 0
        expected = definition.base_length + count * definition.item_length
        if found != expected:
            raise MalformedPacket(f"{definition.name}: expected {expected} octets, found {found}")
        if group:
            assert self.item_dtype is not None
            start = definition.base_length - space_packets.CRC_LENGTH
            records = np.frombuffer(octets, dtype=self.item_dtype, count=count, offset=start)
            raw[group.name], values[group.name] = map(dict, _columns(group.fields, records))
        return values, raw

    def lengths_hold(self, octets: OctetArray, offsets: IntArray, lengths: IntArray) -> BoolArray:
        """Return whether each packet is as long as its definition and count say."""
        definition = self.definition
        if definition.group is None:
            return np.asarray(lengths == definition.base_length)
        right = lengths >= definition.base_length
        counts = gather(octets, offsets[right] + self.count_offset, self.count_dtype).astype(np.int64)
        right[right] = lengths[right] == definition.base_length + counts * definition.item_length
        return right

    def table(self, octets: OctetArray, offsets: IntArray, rows: IntArray) -> Table:
        """The packets at `offsets[rows]` as columns; their lengths are known to hold."""
        definition, group = self.definition, self.definition.group
        starts = offsets[rows]
        records = gather(octets, starts, self.tm_dtype)
        header = records["header"]
        raw, columns = _columns(definition.fields, records)
        items = items_raw = _columns((), records)[0]
        owner = np.empty(0, dtype=np.int64)
        if group:
            from tmtc.packets import _cutting

            assert self.item_dtype is not None
            counts = raw[group.count].astype(np.int64)
            sizes = definition.item_length * counts
            found = np.empty(int(sizes.sum()), dtype=np.uint8)
            octets = octets.view()
            octets.flags.writeable = False  # as mostly: a kernel for both kinds would be compiled twice
            _cutting.copy_spans(octets, starts + (definition.base_length - space_packets.CRC_LENGTH), sizes, found)
            items_raw, items = _columns(group.fields, found.view(self.item_dtype))
            owner = np.repeat(np.arange(counts.size), counts)
        return Table(
            name=definition.name,
            packet_index=rows,
            ticks=header["coarse"].astype(np.int64) << 16 | header["fine"],
            sequence_count=(header["sequence"] & 0x3FFF).astype(np.int64),
            message_counter=header["message_counter"].astype(np.int64),
            columns=columns,
            raw=raw,
            items=items,
            items_raw=items_raw,
            item_owner=owner,
        )

    def _items(self, value: object) -> tuple[bytes, int]:
        definition, group = self.definition, self.definition.group
        assert group is not None and self.item_dtype is not None
        names = [f.name for f in group.fields]
        if isinstance(value, Mapping):
            columns = value
        elif isinstance(value, Sequence) and not isinstance(value, (str, bytes)):
            for item in value:
                if not isinstance(item, Mapping) or item.keys() != set(names):
                    raise ValueRefused(definition.name, group.name, item, f"mappings of {', '.join(names)}")
            columns = {name: [item[name] for item in value] for name in names}
        else:
            raise ValueRefused(definition.name, group.name, value, "a sequence of mappings or a mapping of arrays")
        if columns.keys() != set(names):
            raise ValueRefused(definition.name, group.name, sorted(columns), f"columns {', '.join(names)}")
        arrays = {f.name: _encode_column(definition.name, f, columns[f.name]) for f in group.fields}
        sizes = {a.shape[0] for a in arrays.values()}
        if len(sizes) > 1:
            raise ValueRefused(definition.name, group.name, sorted(sizes), "columns of one length")
        count = sizes.pop()
        records = np.empty(count, dtype=self.item_dtype)
        for name, array in arrays.items():
            records[name] = array
        return records.tobytes(), count


def _dtype_fields(fields: tuple[Field, ...]) -> list[Any]:
    return [(f.name, f.dtype) if f.size == 1 else (f.name, f.dtype, (f.size,)) for f in fields]


class _Columns(Mapping[str, RecordArray]):
    """Columns by field name, computed on first access."""

    def __init__(self, fields: tuple[Field, ...], make: Callable[[Field], RecordArray]) -> None:
        self._fields, self._make = {f.name: f for f in fields}, make
        self._made: dict[str, RecordArray] = {}

    def __getitem__(self, name: str) -> RecordArray:
        if name not in self._made:
            self._made[name] = self._make(self._fields[name])
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._fields)

    def __len__(self) -> int:
        return len(self._fields)


def _columns(fields: tuple[Field, ...], records: RecordArray) -> tuple[_Columns, _Columns]:
    """(raw, engineering) columns of big-endian `records`."""
    raw = _Columns(fields, lambda f: np.ascontiguousarray(records[f.name], np.dtype(f.dtype).newbyteorder("=")))
    return raw, _Columns(fields, lambda f: _decode_column(f, raw[f.name]))


def _decode_column(f: Field, raw: RecordArray) -> RecordArray:
    if f.is_float:
        return raw.astype(np.float64) if not f.is_calibrated else raw.astype(np.float64) * f.scale + f.offset
    if not f.is_calibrated:
        return raw.astype(np.uint64 if f.type == "u64" else np.int64, copy=False)
    values = raw * f.scale + f.offset
    if f.missing is not None:
        values[raw == f.missing] = np.nan
    return values


def _decode(f: Field, raw: int | float) -> int | float:
    if f.missing is not None and raw == f.missing:
        return math.nan
    return raw * f.scale + f.offset if f.is_calibrated else raw


def _expectation(f: Field) -> str:
    if f.labels:
        return "one of " + ", ".join(f"{code} ({name})" for code, name in f.labels)
    if f.is_float:
        low, high = -math.inf, math.inf
    else:
        least, greatest = f.raw_limits
        low, high = sorted((least * f.scale + f.offset, greatest * f.scale + f.offset))
    low = low if f.minimum is None else max(low, f.minimum)
    high = high if f.maximum is None else min(high, f.maximum)
    return f"{'a number' if f.is_float or f.is_calibrated else 'an integer'} from {low:.15g} to {high:.15g}"


def encode(packet: str, f: Field, value: object) -> int | float:
    """Return the raw number of one engineering value; `packet` is for messages.

    Raises
    ------
    ValueRefused
    """
    if f.labels and isinstance(value, str):
        for code, name in f.labels:
            if name == value:
                return code
        raise ValueRefused(packet, f.name, value, _expectation(f))
    if not f.is_float and not f.is_calibrated and f.minimum is None and f.maximum is None:
        try:
            code = operator.index(value)  # type: ignore[arg-type]  # refused below
        except TypeError:
            raise ValueRefused(packet, f.name, value, _expectation(f)) from None
        least, greatest = f.raw_limits
        if f.saturate:
            return min(max(code, least), greatest)
        if not least <= code <= greatest or (f.labels and code not in dict(f.labels)):
            raise ValueRefused(packet, f.name, value, _expectation(f))
        return code
    encoded = _encode_column(packet, f, [math.nan if value is None else value])[0]
    return float(encoded) if f.is_float else int(encoded)


def _encode_column(packet: str, f: Field, value: object) -> RecordArray:
    """Raw numbers (n,) of engineering values."""
    given = _as_array(f, value)
    if given.size == 0:
        return np.empty((0,) if f.size == 1 else (0, f.size), dtype=f.dtype)
    if given.shape[1:] != (() if f.size == 1 else (f.size,)):
        raise ValueRefused(packet, f.name, f"shape {given.shape}", f"{f.size} number(s) an element")
    if f.labels and given.dtype.kind == "U":
        return np.array([encode(packet, f, str(v)) for v in given], dtype=f.dtype)
    if given.dtype.kind not in "iufb" or (given.dtype.kind == "f" and not f.is_float and not f.is_calibrated):
        raise ValueRefused(packet, f.name, given.flat[0], _expectation(f))
    if f.minimum is not None or f.maximum is not None:
        low = -np.inf if f.minimum is None else f.minimum
        high = np.inf if f.maximum is None else f.maximum
        if f.saturate:
            given = np.clip(given, low, high)
        _refuse(packet, f, given, (given < low) | (given > high))
    if f.is_float:
        with np.errstate(over="ignore"):
            scaled = (given.astype(np.float64) - f.offset) / f.scale if f.is_calibrated else given
            raw: RecordArray = scaled.astype(f.dtype)
        _refuse(packet, f, given, np.isinf(raw) & ~np.isinf(given))
        return raw
    least, greatest = f.raw_limits
    if not f.is_calibrated:
        if f.saturate:
            given = np.clip(given, least, greatest)
        _refuse(packet, f, given, (given < least) | (given > greatest))
        if f.labels:
            _refuse(packet, f, given, ~np.isin(given, [code for code, _ in f.labels]))
        return given.astype(f.dtype)
    # the code of "not known" lies at an end of the range and is never given to a known value
    if f.missing == greatest:
        greatest -= 1
    elif f.missing == least:
        least += 1
    codes = np.rint((given.astype(np.float64) - f.offset) / f.scale)
    absent = np.isnan(codes)
    if f.missing is None:
        _refuse(packet, f, given, absent)
    if f.saturate:
        codes = np.clip(codes, least, greatest)
    _refuse(packet, f, given, (codes < least) | (codes > greatest))
    codes[absent] = 0 if f.missing is None else f.missing
    return codes.astype(f.dtype)


def _as_array(f: Field, value: object) -> RecordArray:
    given = np.asarray(value)
    if f.type == "u64" and given.dtype.kind == "f" and not isinstance(value, np.ndarray):
        # numpy makes floats of a list that holds integers below and above 2^63
        exact = np.asarray(value, dtype=object)
        least, greatest = f.raw_limits
        if all(isinstance(v, (int, np.integer)) and least <= v <= greatest for v in exact.flat):
            return exact.astype(np.uint64)
    return given


def _refuse_no_number(packet: str, name: str, value: object) -> None:
    """Refuse booleans, NaN and infinities anywhere in an argument of a telecommand."""
    if isinstance(value, Mapping):
        for key, one in value.items():
            _refuse_no_number(packet, f"{name}.{key}", one)
    elif isinstance(value, np.ndarray):
        if value.dtype.kind == "b" or (value.dtype.kind == "f" and not np.isfinite(value).all()):
            raise ValueRefused(packet, name, f"an array of {value.dtype}", "finite numbers")
    elif isinstance(value, (list, tuple)):
        for one in value:
            _refuse_no_number(packet, name, one)
    elif isinstance(value, (bool, np.bool_)) or (isinstance(value, float) and not math.isfinite(value)):
        raise ValueRefused(packet, name, value, "a finite number")


def _refuse(packet: str, f: Field, given: RecordArray, wrong: RecordArray) -> None:
    if np.any(wrong):
        raise ValueRefused(packet, f.name, given[wrong].flat[0].item(), _expectation(f))
