"""The parameter table of a payload build as a TOML file: every number of flight that may differ between builds.

A file names only what it changes; the rest stays as it was flown. Sections follow the parameters of flight:
`[detector]`, `[flight]`, `[flight.odometry]`, `[flight.anchored]` and deeper. A value that may be absent is taken
away by leaving its key out of a full file.
"""

from __future__ import annotations

import dataclasses
import difflib
import tomllib
from enum import IntEnum
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from payload_emulator.errors import ParameterError
from payload_emulator.flight.detector import DetectorParameters
from payload_emulator.flight.payload import FlightParameters


@dataclasses.dataclass(frozen=True, slots=True)
class BuildParameters:
    """All parameters of a payload: those of the detector and those of the rest of flight."""

    detector: DetectorParameters = dataclasses.field(default_factory=DetectorParameters)
    flight: FlightParameters = dataclasses.field(default_factory=FlightParameters)


def format_parameters(parameters: BuildParameters) -> str:
    """TOML text with every parameter; `parse_parameters` reads equal values back."""
    return "\n".join(_section(parameters, "")).strip() + "\n"


def parse_parameters(
    text: str,
    flown: BuildParameters = BuildParameters(),
    source: str = "parameters",
    dropped: list[str] | None = None,
) -> BuildParameters:
    """`flown` with what the TOML text changes.

    Parameters
    ----------
    dropped
        Takes the names of parameters that this flight code does not have, as a record of older code may hold; None
        refuses them.

    Raises
    ------
    ParameterError
        No TOML, an unknown key, or a value of another type; the message names the key.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ParameterError(f"{source}: not TOML: {error}") from None
    changed: BuildParameters = _changed(flown, BuildParameters, table, source, "", dropped)
    return changed


def flat_parameters(parameters: BuildParameters) -> dict[str, Any]:
    """Every parameter under its dotted name, such as ``flight.anchored.gravity_degree``; None where absent."""
    return _flat(parameters, "")


def with_values(
    flown: BuildParameters, values: dict[str, Any], source: str = "parameters"
) -> BuildParameters:
    """`flown` with the parameters of these dotted names set to these values."""
    table: dict[str, Any] = {}
    for name, value in values.items():
        *path, last = name.split(".")
        here = table
        for part in path:
            here = here.setdefault(part, {})
        here[last] = value
    changed: BuildParameters = _changed(flown, BuildParameters, table, source, "")
    return changed


def _flat(value: Any, path: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for item in dataclasses.fields(value):
        inner, name = getattr(value, item.name), f"{path}.{item.name}" if path else item.name
        if dataclasses.is_dataclass(inner):
            found |= _flat(inner, name)
        else:
            found[name] = _plain(inner)
    return found


def _section(value: Any, path: str) -> list[str]:
    lines, sections = [], []
    for item in dataclasses.fields(value):
        inner, name = getattr(value, item.name), f"{path}.{item.name}" if path else item.name
        if dataclasses.is_dataclass(inner):
            sections += _section(inner, name)
        elif inner is not None:
            lines.append(f"{item.name} = {_toml(_plain(inner))}")
    return (["", f"[{path}]", *lines] if lines else []) + sections


def _plain(value: Any) -> Any:
    if isinstance(value, IntEnum):
        return value.name
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return repr(value)


def _changed(
    value: Any, kind: type, table: Any, source: str, path: str, dropped: list[str] | None = None
) -> Any:
    """A dataclass with the fields that `table` names changed; built anew where there was none."""
    if not isinstance(table, dict):
        raise ParameterError(f"{source}: [{path}] must be a table, found {type(table).__name__}")
    hints = get_type_hints(kind)
    known = [item.name for item in dataclasses.fields(kind)]
    values: dict[str, Any] = {}
    for key, given in table.items():
        place = f"{path}.{key}" if path else key
        if key not in known and dropped is not None:
            dropped.append(place)
            continue
        if key not in known:
            close = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(known)}"
            raise ParameterError(f"{source}: unknown key '{place}'; {hint}")
        values[key] = _converted(hints[key], getattr(value, key, None), given, source, place, dropped)
    try:
        return kind(**values) if value is None else dataclasses.replace(value, **values)
    except TypeError:
        raise ParameterError(f"{source}: [{path}] needs all of {', '.join(known)}") from None


def _converted(
    hint: Any, present: Any, given: Any, source: str, place: str, dropped: list[str] | None = None
) -> Any:
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        if given is None and NoneType in inner:
            return None
        (hint,) = (item for item in inner if item is not NoneType)
        origin, inner = get_origin(hint), get_args(hint)
    if dataclasses.is_dataclass(hint):
        return _changed(present, hint, given, source, place, dropped)  # type: ignore[arg-type]
    if origin is tuple:
        if not isinstance(given, list):
            raise ParameterError(f"{source}: {place} must be a list, found {given!r}")
        kinds = [inner[0]] * len(given) if len(inner) == 2 and inner[1] is Ellipsis else list(inner)
        if len(kinds) != len(given):
            raise ParameterError(f"{source}: {place} must have {len(kinds)} values, found {len(given)}")
        return tuple(
            _converted(kind, None, item, source, f"{place}[{i}]", dropped)
            for i, (kind, item) in enumerate(zip(kinds, given, strict=True))
        )
    if isinstance(hint, type) and issubclass(hint, IntEnum):
        if given not in hint.__members__:
            raise ParameterError(
                f"{source}: {place} must be one of {', '.join(hint.__members__)}, found {given!r}"
            )
        return hint[given]
    if hint is float and type(given) is int:
        given = float(given)
    if type(given) is not hint:
        raise ParameterError(
            f"{source}: {place} must be a {getattr(hint, '__name__', hint)}, found {given!r}"
        )
    return given
