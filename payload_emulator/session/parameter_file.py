"""The parameter table of a payload build as a TOML file: every number of flight that may differ between builds.

A file names only what it changes; the rest stays as it was flown. Sections follow the parameters of flight:
`[detector]`, `[flight]`, `[flight.odometry]`, `[flight.anchored]` and deeper. A value that may be absent is taken
away by leaving its key out of a full file.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import tomllib
from collections.abc import Mapping
from enum import IntEnum
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from payload_emulator.errors import ParameterError
from payload_emulator.flight.instruments import flight_instruments
from payload_emulator.flight.payload import FlightParameters
from payload_emulator.flight.vision.detector import DetectorParameters

SHOWN = 80
"""Largest number of characters of a wrong value in a message."""

TYPE_WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}

_SHARE = (0.0, 1.0)
_COUNT = (1, math.inf)
RANGES: dict[str, tuple[float, float]] = {
    "score_threshold": _SHARE,
    "detection_persistence": _SHARE,
    "agreement_share": _SHARE,
    "false_set_limit": _SHARE,
    "harmful_set_limit": _SHARE,
    "false_fix_limit": _SHARE,
    "max_detections": _COUNT,
    "width_px": _COUNT,
    "height_px": _COUNT,
    "minimum_pairs": _COUNT,
    "lost_search_every": _COUNT,  # the number of frames is divided by it
    "housekeeping_interval_s": (1e-3, math.inf),
    "reference_interval_s": (1e-3, math.inf),
    "fov_rad": (1e-3, math.pi),
    "scale": (-0.5, 0.5),  # relative, positive or negative
}
"""Least and greatest value of a parameter by its last name. All others are limits, lengths, times, sigmas or counts,
which are never negative."""

BOUND_WORDS = (("minimum", "maximum"), ("lowest", "highest"))
"""Words that distinguish the names of a lower limit and its upper limit in a section."""


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
    """Return `flown` with the values of a TOML text.

    Parameters
    ----------
    dropped
        List that receives the names of parameters unknown to this flight code, which a file of older code may have;
        None refuses them.

    Raises
    ------
    ParameterError
        Invalid TOML, an unknown key, or a value of a wrong type or out of range; the message names the key.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ParameterError(source, "", "parameters (TOML)", str(error)) from None
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
        if isinstance(inner, Mapping):
            for key, one in inner.items():
                found |= _flat(one, f"{name}.{key}")
        elif dataclasses.is_dataclass(inner):
            found |= _flat(inner, name)
        else:
            found[name] = _plain(inner)
    return found


def _section(value: Any, path: str) -> list[str]:
    lines, sections = [], []
    for item in dataclasses.fields(value):
        inner, name = getattr(value, item.name), f"{path}.{item.name}" if path else item.name
        if isinstance(inner, Mapping):
            for key, one in inner.items():
                sections += _section(one, f"{name}.{key}") or ["", f"[{name}.{key}]"]
        elif dataclasses.is_dataclass(inner):
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
    """A dataclass with the fields that `table` names changed; created where there was none."""
    if not isinstance(table, dict):
        raise ParameterError(source, path, "a table", repr(table)[:SHOWN])
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
            expected = f"{close[0]} (nearest known key)" if close else f"one of {', '.join(known)}"
            raise ParameterError(source, place, expected, "an unknown key")
        values[key] = _converted(hints[key], getattr(value, key, None), given, source, place, dropped)
    try:
        result = kind(**values) if value is None else dataclasses.replace(value, **values)
    except TypeError:
        raise ParameterError(source, path, f"all of {', '.join(known)}", ", ".join(table) or "none") from None
    _refuse_crossed(result, values, source, path)
    return result


def _instruments(
    present: Mapping[str, Any], table: Any, source: str, path: str, dropped: list[str] | None
) -> dict[str, Any]:
    """Return the parameters of installed instruments with those that `table` names changed or added."""
    if not isinstance(table, dict):
        raise ParameterError(source, path, "a table", repr(table)[:SHOWN])
    known, changed = flight_instruments(), dict(present)
    for name, given in table.items():
        place = f"{path}.{name}"
        if name in known:
            kind = known[name].parameters
            changed[name] = _changed(changed.get(name, kind()), kind, given, source, place, dropped)
        elif dropped is not None:
            dropped.append(place)
        else:
            expected = f"one of {', '.join(known)}" if known else "no section: this build has no instruments"
            raise ParameterError(source, place, expected, "an unknown instrument")
    return changed


def _refuse_crossed(value: Any, changed: dict[str, Any], source: str, path: str) -> None:
    """Refuse a lower limit of a section that lies above its upper limit.

    Raises
    ------
    ParameterError
        A changed limit crosses its counterpart.
    """
    for low_word, high_word in BOUND_WORDS:
        for item in dataclasses.fields(value):
            upper = item.name.replace(low_word, high_word)
            if (
                low_word not in item.name
                or not hasattr(value, upper)
                or not {item.name, upper} & set(changed)
            ):
                continue
            low, high = getattr(value, item.name), getattr(value, upper)
            if low > high:
                raise ParameterError(source, f"{path}.{item.name}", f"at most {upper} = {high!r}", repr(low))


def _in_range(given: float, source: str, place: str) -> None:
    """Refuse a number that is not finite or outside the range of its parameter.

    Raises
    ------
    ParameterError
        The number is not finite or out of range.
    """
    low, high = RANGES.get(place.rsplit(".", 1)[-1].partition("[")[0], (0.0, math.inf))
    if not math.isfinite(given) or not low <= given <= high:
        expected = f"a finite number from {low:g}" + (f" to {high:g}" if math.isfinite(high) else "")
        raise ParameterError(source, place, expected, repr(given))


def _converted(
    hint: Any, present: Any, given: Any, source: str, place: str, dropped: list[str] | None = None
) -> Any:
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Mapping:
        return _instruments(present or {}, given, source, place, dropped)
    if origin in (Union, UnionType):
        if given is None and NoneType in inner:
            return None
        (hint,) = (item for item in inner if item is not NoneType)
        origin, inner = get_origin(hint), get_args(hint)
    if dataclasses.is_dataclass(hint):
        return _changed(present, hint, given, source, place, dropped)  # type: ignore[arg-type]
    if origin is tuple:
        if not isinstance(given, list):
            raise ParameterError(source, place, "a list", repr(given)[:SHOWN])
        kinds = [inner[0]] * len(given) if len(inner) == 2 and inner[1] is Ellipsis else list(inner)
        if len(kinds) != len(given):
            raise ParameterError(source, place, f"{len(kinds)} values", str(len(given)))
        return tuple(
            _converted(kind, None, item, source, f"{place}[{i}]", dropped)
            for i, (kind, item) in enumerate(zip(kinds, given, strict=True))
        )
    if isinstance(hint, type) and issubclass(hint, IntEnum):
        if given not in hint.__members__:
            raise ParameterError(source, place, f"one of {', '.join(hint.__members__)}", repr(given)[:SHOWN])
        return hint[given]
    if hint is float and type(given) is int:
        given = float(given)
    if type(given) is not hint:
        raise ParameterError(source, place, TYPE_WORDS.get(hint, str(hint)), repr(given)[:SHOWN])
    if hint in (int, float):
        _in_range(given, source, place)
    return given
