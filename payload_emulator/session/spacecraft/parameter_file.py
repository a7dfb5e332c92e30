"""The parameter table of a payload build as a TOML file: every number of flight that may differ between builds.

A file names only what it changes; the rest stays as it was flown. Sections follow the parameters of flight:
`[detector]`, `[flight]`, `[flight.odometry]`, `[flight.anchored]` and deeper. A value that may be absent is taken
away by leaving its key out of a full file.
"""

import dataclasses
import math
import tomllib
from enum import IntEnum
from typing import Any

import numpy as np

from payload_emulator.errors import ParameterError
from payload_emulator.flight.payload import FlightParameters
from payload_emulator.flight.vision.detector import DetectorParameters
from payload_emulator.session.typed_toml import TableFault, read_table, toml_text

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
    "noise_fixes": _COUNT,
    "noise_largest": (1.0, math.inf),
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
    """Return TOML text with every parameter; `parse_parameters` reads equal values back."""
    return "\n".join(_section(parameters, "")).strip() + "\n"


def parse_parameters(
    text: str, flown: BuildParameters = BuildParameters(), source: str = "parameters", dropped: list[str] | None = None
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
    except (ValueError, RecursionError) as error:
        raise ParameterError(source, "", "parameters (TOML)", str(error)) from None
    return _read(flown, table, source, dropped)


def _section(value: Any, path: str) -> list[str]:
    lines, sections = [], []
    for item in dataclasses.fields(value):
        inner, name = getattr(value, item.name), f"{path}.{item.name}" if path else item.name
        if dataclasses.is_dataclass(inner):
            sections += _section(inner, name)
        elif inner is not None:
            lines.append(f"{item.name} = {toml_text(_plain(inner))}")
    return (["", f"[{path}]", *lines] if lines else []) + sections


def _plain(value: Any) -> Any:
    if isinstance(value, IntEnum):
        return value.name
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def _read(flown: BuildParameters, table: dict[str, Any], source: str, dropped: list[str] | None) -> BuildParameters:
    """Return parameters with the values of a table."""
    try:
        kept = table if dropped is None else _known(flown, table, "", dropped)
        changed = read_table(BuildParameters, kept, present=flown, bounds=_bounds)
        _refuse_crossed(changed, kept, "")
    except TableFault as fault:
        expected = f"{fault.nearest} (nearest known key)" if fault.nearest else fault.expected
        raise ParameterError(source, fault.place, expected, fault.found) from None
    return changed


def _known(value: Any, table: Any, path: str, dropped: list[str]) -> Any:
    """Return a table without the keys that a value's dataclass does not have, which go to `dropped`."""
    if not isinstance(table, dict) or not dataclasses.is_dataclass(value):
        return table
    names = {item.name for item in dataclasses.fields(value)}
    dropped += [f"{path}.{key}" if path else key for key in table if key not in names]
    return {
        key: _known(getattr(value, key), given, f"{path}.{key}" if path else key, dropped)
        for key, given in table.items()
        if key in names
    }


def _bounds(name: str) -> tuple[float, float]:
    return RANGES.get(name, (0.0, math.inf))


def _refuse_crossed(value: Any, table: Any, path: str) -> None:
    """Refuse a lower limit that a table puts above its upper limit, in any section."""
    for key, given in table.items():
        place = f"{path}.{key}" if path else key
        if isinstance(given, dict) and dataclasses.is_dataclass(getattr(value, key)):
            _refuse_crossed(getattr(value, key), given, place)
        for low_word, high_word in BOUND_WORDS:
            lower, upper = key.replace(high_word, low_word), key.replace(low_word, high_word)
            if lower == upper or not (hasattr(value, lower) and hasattr(value, upper)):
                continue
            low, high = getattr(value, lower), getattr(value, upper)
            if low > high:
                raise TableFault(place.replace(high_word, low_word), f"at most {upper} = {high!r}", repr(low))
