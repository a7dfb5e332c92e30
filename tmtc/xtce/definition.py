"""Imported packet definitions as plain values: types, parameters, conditions and containers.

References
----------
OMG XTCE 1.2 (CCSDS 660.0-B-2); CCSDS 660.1-G-2 for what the elements mean.
"""

from __future__ import annotations

from dataclasses import dataclass
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
    """Whether the code of an enumerated parameter lies in one of the ranges [first, last]; `negated`: in none."""

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

    `terminator` ends the text inside the buffer; `tag_bits` is the width of a leading number of bits of the text.
    """

    charset: str
    size: Size | None
    terminator: bytes = b""
    tag_bits: int = 0
    most_bits: int | None = None


@dataclass(frozen=True, slots=True)
class BinaryEncoding:
    """Octets: `size` bits of them."""

    size: Size


Encoding = IntegerEncoding | FloatEncoding | StringEncoding | BinaryEncoding


@dataclass(frozen=True, slots=True)
class ScalarType:
    """One value: how it is stored, and what its codes are called (first code, last code, name), rising.

    Calibrated values outside `warning` (least, greatest; None: no limit) need attention, those outside `alarm` action.
    """

    name: str
    encoding: Encoding
    labels: tuple[tuple[int, int, str], ...] = ()
    is_boolean: bool = False
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
    """Elements of one type with indices `first` to `last`, both included."""

    name: str
    element: DataType
    first: Size
    last: Size


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

    It begins `offset` bits after the entry before it (`from_start` False) or after the beginning of the container.
    """

    item: Parameter | Container
    offset: int = 0
    from_start: bool = False
    condition: Condition | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Container:
    """A layout of a packet or of a part of it.

    `children` are the containers that continue it where their `condition` holds; an `abstract` one is no packet by
    itself.
    """

    name: str
    path: str
    entries: tuple[Entry, ...]
    abstract: bool
    condition: Condition | None
    children: tuple[Container, ...]
    description: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Definition:
    """What a set of XTCE documents defines; `roots` are the containers without a base, by name."""

    name: str
    roots: dict[str, Container]
    parameters: dict[str, Parameter]
    containers: dict[str, Container]
