"""Frozen values from TOML tables: pydantic checks keys and types, faults name place, expectation and finding.

A table names only what it sets; the rest keeps the defaults of the dataclass, or the values of an instance that the
table changes. Types are strict: a whole number counts as a number, and nothing else is converted.
"""

import dataclasses
import difflib
import math
from collections.abc import Callable, Sequence
from enum import IntEnum
from functools import lru_cache
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, create_model
from pydantic_core import PydanticCustomError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Record = TypeVar("Record", bound="DataclassInstance")
Bounds = Callable[[str], tuple[float, float]]
"""Function that returns the least and the greatest value of a number by the name of its key."""

SHOWN = 80
"""Largest number of characters of a wrong value in a message."""

_EXPECTED = {
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "a text",
    "tuple_type": "a list",
    "model_type": "a table",
    "finite_number": "finite",
}


class TableFault(ValueError):
    """Fault of a table.

    Attributes
    ----------
    place
        Dotted name of the key, such as ``window.passes`` or ``orbit.position_km[0]``.
    expected, found
        Texts for a message.
    known
        For an unknown key, the keys that are known at its place; empty for other faults.
    """

    def __init__(self, place: str, expected: str, found: str, known: Sequence[str] = ()) -> None:
        super().__init__(f"{place}: expected {expected}, found {found}")
        self.place, self.expected, self.found, self.known = place, expected, found, tuple(known)

    @property
    def nearest(self) -> str | None:
        """The known key nearest to an unknown one; None without."""
        close = difflib.get_close_matches(self.place.rpartition(".")[2], self.known, n=1)
        return close[0] if close else None


def read_table(
    kind: type[Record], table: object, path: str = "", *, present: Record | None = None, bounds: Bounds | None = None
) -> Record:
    """Return a dataclass with the values of a table.

    Parameters
    ----------
    path
        Dotted name of the table, for messages.
    present
        Instance whose values stay where the table names none; None starts from the defaults.
    bounds
        Limits of numbers by the last part of their name; without, numbers must be finite.

    Raises
    ------
    TableFault
        An unknown key, a value of a wrong type or out of bounds, or no value for a field without a default.
    """
    try:
        given = _model(kind, bounds).model_validate(table)
    except ValidationError as error:
        raise _fault(kind, error, path) from None
    return _merged(kind, given, path, present)


@lru_cache(maxsize=256)
def _model(kind: type, bounds: Bounds | None) -> type[BaseModel]:
    """Return the pydantic model of a dataclass; all its fields may be absent."""
    hints = get_type_hints(kind)
    names = [item.name for item in dataclasses.fields(kind)]
    fields: dict[str, Any] = {name: (_annotation(hints[name], name, bounds), None) for name in names}
    settings = ConfigDict(extra="forbid", strict=True, frozen=True, protected_namespaces=())
    return create_model(kind.__name__, __config__=settings, **fields)


def _annotation(hint: Any, name: str, bounds: Bounds | None) -> Any:
    """Return the pydantic annotation of a field's type."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        (only,) = (item for item in inner if item is not NoneType)
        return _annotation(only, name, bounds) | None
    if dataclasses.is_dataclass(hint):
        return _model(hint, bounds)  # type: ignore[arg-type]  # a class, not an instance
    if origin is tuple:
        several: Any = tuple  # mypy takes no computed types in brackets
        if inner[-1] is Ellipsis:
            return Annotated[several[_annotation(inner[0], name, bounds), ...], Field(strict=False)]
        kinds = tuple(_annotation(item, name, bounds) for item in inner)
        return Annotated[several[kinds], Field(strict=False), BeforeValidator(_of_length(len(kinds)))]
    if isinstance(hint, type) and issubclass(hint, IntEnum):
        return Annotated[hint, BeforeValidator(_member_of(hint))]
    if hint in (int, float):
        return Annotated[hint, BeforeValidator(_within(hint, bounds(name) if bounds else None))]
    return hint


def _of_length(count: int) -> Callable[[object], object]:
    def check(value: object) -> object:
        if isinstance(value, list) and len(value) != count:
            raise PydanticCustomError("expected", "{expected}", {"expected": f"{count} values", "found": len(value)})
        return value

    return check


def _member_of(kind: type[IntEnum]) -> Callable[[object], object]:
    def check(value: object) -> object:
        if value not in kind.__members__:
            raise PydanticCustomError("expected", "{expected}", {"expected": f"one of {', '.join(kind.__members__)}"})
        return kind[str(value)]

    return check


def _within(kind: type, limits: tuple[float, float] | None) -> Callable[[object], object]:
    """Return a check that numbers are finite and within limits; values of other types pass on to pydantic."""

    def check(value: object) -> object:
        if type(value) is int and kind is float:
            value = float(value)
        if type(value) not in (int, float) or type(value) is not kind:
            return value
        assert isinstance(value, (int, float))
        if limits is None:
            if not math.isfinite(value):
                raise PydanticCustomError("expected", "{expected}", {"expected": "finite"})
        elif not (math.isfinite(value) and limits[0] <= value <= limits[1]):
            upper = f" to {limits[1]:g}" if math.isfinite(limits[1]) else ""
            expected = f"a finite number from {limits[0]:g}{upper}"
            raise PydanticCustomError("expected", "{expected}", {"expected": expected})
        return value

    return check


def _merged(kind: type[Record], given: BaseModel, path: str, present: Record | None) -> Record:
    """Return an instance with the values that a model was given."""
    hints = get_type_hints(kind)
    values = {}
    for name in given.model_fields_set:
        value, place = getattr(given, name), f"{path}.{name}" if path else name
        if isinstance(value, BaseModel):
            value = _merged(_dataclass_in(hints[name]), value, place, getattr(present, name, None))
        elif isinstance(value, tuple) and value and isinstance(value[0], BaseModel):
            inner = _dataclass_in(get_args(hints[name])[0])
            value = tuple(_merged(inner, item, f"{place}[{k}]", None) for k, item in enumerate(value))
        values[name] = value
    try:
        return kind(**values) if present is None else dataclasses.replace(present, **values)
    except TypeError:
        known = ", ".join(item.name for item in dataclasses.fields(kind))
        raise TableFault(path, f"all of {known}", ", ".join(values) or "none") from None


def _dataclass_in(hint: Any) -> Any:
    """Return the dataclass that a hint is or that it contains; None without."""
    return next((item for item in (hint, *get_args(hint)) if dataclasses.is_dataclass(item)), None)


def _fault(kind: type, error: ValidationError, path: str) -> TableFault:
    """Return the first fault that pydantic found."""
    first = error.errors(include_url=False)[0]
    place, here = path, kind
    for step in first["loc"][:-1] if first["type"] == "extra_forbidden" else first["loc"]:
        place = f"{place}[{step}]" if isinstance(step, int) else f"{place}.{step}" if place else step
        hint = get_type_hints(here).get(str(step)) if dataclasses.is_dataclass(here) else None
        here = _dataclass_in(hint) or here
    context = first.get("ctx", {})
    found = str(context.get("found", repr(first["input"])[:SHOWN]))
    if first["type"] == "extra_forbidden":
        name = str(first["loc"][-1])
        known = [item.name for item in dataclasses.fields(here)]
        return TableFault(f"{place}.{name}" if place else name, f"one of {', '.join(known)}", "an unknown key", known)
    if first["type"] == "literal_error":
        hint = get_type_hints(here)[str(first["loc"][-1])]
        choices = [one for kind in (hint, *get_args(hint)) if get_origin(kind) is Literal for one in get_args(kind)]
        return TableFault(place, f"one of {', '.join(map(repr, choices))}", found)
    return TableFault(place, str(context.get("expected", _EXPECTED.get(first["type"], first["msg"]))), found)


def toml_text(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n") + '"'
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(toml_text(item) for item in value) + "]"
    return repr(value)
