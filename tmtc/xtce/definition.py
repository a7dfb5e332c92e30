"""Imported packet definitions as plain values: types, parameters, conditions and containers.

References
----------
OMG XTCE 1.2 (CCSDS 660.0-B-2); CCSDS 660.1-G-2 for what the elements mean.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from typing import Literal, Union

IntegerForm = Literal["unsigned", "twosComplement", "onesComplement", "signMagnitude"]
FloatForm = Literal["IEEE754", "MILSTD_1750A"]
Limits = tuple[float | None, float | None]
Operator = Literal["==", "!=", "<", "<=", ">", ">="]


@dataclass(frozen=True, slots=True)
class Reference:
    """An earlier parameter, or a member of an aggregate; `calibrated` or as transmitted."""

    parameter: str
    members: tuple[str, ...] = ()
    calibrated: bool = True


@dataclass(frozen=True, slots=True)
class Comparison:
    """`left operator right`; `right` is a value or another parameter."""

    left: Reference
    operator: Operator
    right: Reference | int | float | str | bool


@dataclass(frozen=True, slots=True)
class CodeIn:
    """Condition that an enumerated code lies in one of the ranges [first, last]; `negated`: in none."""

    left: Reference
    ranges: tuple[tuple[int, int], ...]
    negated: bool


@dataclass(frozen=True, slots=True)
class AllOf:
    """True where all conditions are."""

    conditions: tuple[Condition, ...]


@dataclass(frozen=True, slots=True)
class AnyOf:
    """True where one condition is."""

    conditions: tuple[Condition, ...]


Condition = Union[Comparison, CodeIn, AllOf, AnyOf]  # noqa: UP007 - a forward reference


@dataclass(frozen=True, slots=True)
class Polynomial:
    """Sum of coefficient * raw ** exponent over `terms`, in their order."""

    terms: tuple[tuple[float, int], ...]


@dataclass(frozen=True, slots=True)
class Spline:
    """Interpolation of `points` (raw, calibrated), raw rising: nearest lower (order 0) or linear (order 1)."""

    points: tuple[tuple[float, float], ...]
    order: int
    extrapolate: bool


Calibrator = Polynomial | Spline


@dataclass(frozen=True, slots=True)
class Calibration:
    """The first calibrator of `contexts` whose condition holds, else `default`, else the raw value."""

    default: Calibrator | None = None
    contexts: tuple[tuple[Condition, Calibrator], ...] = ()


@dataclass(frozen=True, slots=True)
class Size:
    """A number of bits, or an index: fixed, or slope * parameter + intercept, or the first match of `lookup`."""

    fixed: int | None = None
    reference: Reference | None = None
    slope: float = 1.0
    intercept: float = 0.0
    lookup: tuple[tuple[Condition, int], ...] = ()


@dataclass(frozen=True, slots=True)
class IntegerEncoding:
    """An integer of 1 to 64 bits; `little`: least significant octet first."""

    bits: int
    form: IntegerForm = "unsigned"
    little: bool = False
    calibration: Calibration = Calibration()


@dataclass(frozen=True, slots=True)
class FloatEncoding:
    """An IEEE 754 number of 16, 32 or 64 bits, or a MIL-STD-1750A number of 32 or 48."""

    bits: int
    form: FloatForm = "IEEE754"
    little: bool = False
    calibration: Calibration = Calibration()


@dataclass(frozen=True, slots=True)
class StringEncoding:
    """Text in a buffer of `size` bits, or as long as its size tag or terminator says where `size` is None.

    `terminator` ends the text inside the buffer; `tag_bits` is the width of a leading size of the text, which counts
    units of `unit_bits`.
    """

    charset: str
    size: Size | None
    terminator: bytes = b""
    tag_bits: int = 0
    most_bits: int | None = None
    unit_bits: int = 1


@dataclass(frozen=True, slots=True)
class BinaryEncoding:
    """Octets: `size` bits of them; or as many octets as a leading number of `tag_bits` bits says."""

    size: Size
    tag_bits: int = 0


Encoding = IntegerEncoding | FloatEncoding | StringEncoding | BinaryEncoding


@dataclass(frozen=True, slots=True)
class ScalarType:
    """One value: how it is stored, and what its codes are called (first code, last code, name), rising.

    `truth` are the names of false and true of a boolean.

    Calibrated values outside `warning` (least, greatest; None: no limit) need attention, those outside `alarm` action.
    """

    name: str
    encoding: Encoding
    labels: tuple[tuple[int, int, str], ...] = ()
    is_boolean: bool = False
    truth: tuple[str, str] = ("False", "True")
    unit: str = ""
    epoch: str = ""
    warning: Limits | None = None
    alarm: Limits | None = None

    @property
    def bits(self) -> int | None:
        """Width, None where it depends on the packet."""
        if isinstance(self.encoding, (IntegerEncoding, FloatEncoding)):
            return self.encoding.bits
        return None if self.encoding.size is None else self.encoding.size.fixed


@dataclass(frozen=True, slots=True)
class ArrayType:
    """Elements of one type with indices `first` to `last`, both included.

    `gap_bits` lie between two of them, `tail_bits` behind the last one.
    """

    name: str
    element: DataType
    first: Size
    last: Size
    gap_bits: int = 0
    tail_bits: int = 0


@dataclass(frozen=True, slots=True)
class AggregateType:
    """Named members, one after another."""

    name: str
    members: tuple[tuple[str, DataType], ...]


DataType = Union[ScalarType, ArrayType, AggregateType]  # noqa: UP007 - a forward reference


@dataclass(frozen=True, slots=True)
class Parameter:
    """A named value; `name` is its column, `path` its place in the tree of systems."""

    name: str
    path: str
    type: DataType
    description: str = ""


@dataclass(frozen=True, slots=True)
class Entry:
    """A parameter, or the entries of another container, in a container.

    It begins `offset` bits, or as many as the packet states, after the entry before it (`from_start` False) or after
    the beginning of the container.
    """

    item: Parameter | Container
    offset: int | Size = 0
    from_start: bool = False
    condition: Condition | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Container:
    """A layout of a packet or of a part of it.

    `children` are the containers that continue it where their `condition` holds; an `abstract` one is no packet by
    itself. As a part of another container it has `bits`, if they are stated.
    """

    name: str
    path: str
    entries: tuple[Entry, ...]
    abstract: bool
    condition: Condition | None
    children: tuple[Container, ...]
    description: str = ""
    bits: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Definition:
    """Definitions of a set of XTCE documents; `roots` are the containers without a base, by name.

    `alarms_not_read` counts the alarms of its types that change no limit here. `size_tags` says what the sizes before
    texts count (``octets``, ``bits``, or both); it is empty without any. `extrapolates`: splines that do not state it
    are extrapolated, as Yamcs does.
    """

    name: str
    roots: dict[str, Container]
    parameters: dict[str, Parameter]
    containers: dict[str, Container]
    alarms_not_read: int = 0
    size_tags: str = ""
    extrapolates: bool = False

    @property
    def remarks(self) -> tuple[str, ...]:
        """Choices of the reader that a person should know, one line each."""
        found = []
        if self.size_tags:
            found.append(f"sizes before texts count {self.size_tags}")
        if self.extrapolates:
            found.append("splines are extrapolated, as Yamcs does")
        if self.alarms_not_read:
            found.append(f"alarms that are not read: {self.alarms_not_read}")
        return tuple(found)


def references(item: object) -> set[str]:
    """Return the names of the parameters that a type or a condition refers to."""
    if isinstance(item, Reference):
        return {item.parameter}
    if isinstance(item, ScalarType):
        return references(item.encoding)
    if is_dataclass(item):
        item = tuple(getattr(item, one.name) for one in fields(item))
    return set().union(*map(references, item)) if isinstance(item, tuple) else set()


def tree(root: Container) -> Iterator[tuple[Container, tuple[Condition, ...]]]:
    """Yield a container and all that inherit from it, each with the conditions on the way to it."""
    pending: list[tuple[Container, tuple[Condition, ...]]] = [(root, ())]
    while pending:
        container, conditions = pending.pop()
        if container.condition is not None and container is not root:
            conditions = (*conditions, container.condition)
        yield container, conditions
        pending.extend((child, conditions) for child in container.children)


def header_field(root: Container, bit: int, bits: int) -> Reference | None:
    """Return the value that stands in this place of each packet that begins with a container; None without one."""
    found: dict[tuple[int, int], Reference] = {}
    _place_entries(root.entries, 0, found)
    return found.get((bit, bits))


def _place_entries(entries: tuple[Entry, ...], start: int, found: dict[tuple[int, int], Reference]) -> int | None:
    """Add values of fixed place by (bit, width); return the place behind them, None if it is not fixed."""
    at: int | None = start
    for entry in entries:
        if at is None or entry.condition is not None or isinstance(entry.offset, Size):
            return None
        at = (start if entry.from_start else at) + entry.offset
        if isinstance(entry.item, Parameter):
            at = _place_value(entry.item.type, at, Reference(entry.item.name), found)
        else:
            behind = _place_entries(entry.item.entries, at, found)
            at = behind if entry.item.bits is None else at + entry.item.bits
    return at


def fixed_bits(data_type: DataType) -> int | None:
    """Return the width of a type, None where it is not fixed."""
    return _place_value(data_type, 0, Reference(""), {})


def _place_value(
    data_type: DataType, at: int, reference: Reference, found: dict[tuple[int, int], Reference]
) -> int | None:
    if isinstance(data_type, ArrayType):
        return None
    if isinstance(data_type, ScalarType):
        if data_type.bits is None:
            return None
        found.setdefault((at, data_type.bits), reference)
        return at + data_type.bits
    place: int | None = at
    for name, member in data_type.members:
        if place is None:
            return None
        place = _place_value(member, place, Reference(reference.parameter, (*reference.members, name)), found)
    return place


def packet_apids(root: Container) -> tuple[frozenset[int], bool]:
    """Return the APIDs of the packets that begin with a container, and whether it accepts others as well."""
    field = header_field(root, 5, 11)
    apids: set[int] = set()
    accepts_others = False
    for container, conditions in tree(root):
        if not container.abstract:
            allowed = None if field is None else _allowed(AllOf(conditions), field)
            apids |= allowed or set()
            accepts_others |= allowed is None
    return frozenset(apids), accepts_others


def _allowed(condition: Condition, field: Reference) -> set[int] | None:
    """Return the values of a field for which a condition can hold; None if it can hold for any."""
    if isinstance(condition, (AllOf, AnyOf)):
        parts = [_allowed(one, field) for one in condition.conditions]
        known = [one for one in parts if one is not None]
        if isinstance(condition, AllOf):
            return set.intersection(*known) if known else None
        return set().union(*known) if len(known) == len(parts) else None
    if isinstance(condition, CodeIn) or condition.operator != "==" or not isinstance(condition.right, int):
        return None
    left = condition.left
    return {condition.right} if (left.parameter, left.members) == (field.parameter, field.members) else None
