"""Arguments of telecommands by name: what people enter and read in place of numbers of the packet.

The two numbers of `perform_function` have the names, units and ranges of its function, an on-board parameter has its
name. The packet dictionary and its hash do not contain them.
"""

from collections.abc import Callable, Mapping
from typing import Any

from tmtc.dictionary.codes import FUNCTIONS, MODES, QUANTITIES, TABLES
from tmtc.dictionary.effects import CARRIER, FUNCTION
from tmtc.dictionary.event_texts import number_text, time_text
from tmtc.dictionary.fields import BY_NAME, Field, find_parameter
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import encode
from tmtc.errors import TmtcError, ValueRefused

_YEAR_S = 86_400.0 * 366.0
_WIDEST = 1e6
"""No estimate is worth less than this (position in m, velocity in m/s)."""

FUNCTION_ARGUMENTS: Mapping[str, tuple[Field, ...]] = {
    "set_mode": (Field("mode", "f64", "Operating mode", labels=MODES),),
    "start_observation": (
        Field("duration_s", "f64", "Duration, 0 for no end", "s", minimum=0.0, maximum=_YEAR_S),
        Field("cadence_s", "f64", "Time between frames, 0 for all", "s", minimum=0.0, maximum=_YEAR_S),
    ),
    "abort_uplink": (Field("table", "f64", "Table whose upload is discarded", labels=TABLES),),
    "widen_estimate": (
        Field("position_m", "f64", "Standard deviation to add", "m", minimum=0.0, maximum=_WIDEST),
        Field("velocity_m_s", "f64", "Standard deviation to add", "m/s", minimum=0.0, maximum=_WIDEST),
    ),
}
"""Arguments of the functions that have any, in the order of `argument_1` and `argument_2`."""

_NUMBERS = ("argument_1", "argument_2")


def function_of(arguments: Mapping[str, Any]) -> str:
    """Return the name of the function that `perform_function` performs."""
    given = arguments.get("function_id")
    return dict(FUNCTIONS).get(given, str(given)) if isinstance(given, int) else str(given)


def arguments_by_number(name: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments as the packet has them; names stand for the numbers of functions and parameters.

    Raises
    ------
    ValueRefused
        A named value is not within its range.
    """
    given = dict(arguments)
    if name == FUNCTION:
        function = function_of(given)
        fields = FUNCTION_ARGUMENTS.get(function, ())
        for number, field in zip(_NUMBERS, fields, strict=False):
            if field.name in given:
                given[number] = encode(function, field, given.pop(field.name))
        given |= {number: 0.0 for number in _NUMBERS[len(fields) :] if number not in given}
    stated = given.get("parameter_id")
    parameter = BY_NAME.get(stated) if isinstance(stated, str) else find_parameter(stated)
    if parameter is not None:
        given["parameter_id"] = parameter.number
        value: Any = given.get("value")
        if type(value) in (int, float) and -1e300 < value < 1e300 and not parameter.accepts(value):
            kind = "a whole number of" if parameter.whole else "a number of"
            raise ValueRefused(
                name, parameter.name, value, f"{kind} {parameter.minimum:g} to {parameter.maximum:g} {parameter.unit}"
            )
    return given


def argument_text(name: str, arguments: Mapping[str, Any], time: Callable[[float], str] = time_text) -> str:
    """Return the arguments of a telecommand as text, with names and units; a carried telecommand is written out.

    Parameters
    ----------
    time
        Writes on-board times, in ticks.
    """
    if name == CARRIER:
        octets = bytes(_columns(arguments["items"])["octet"])
        try:
            carried = DICTIONARY.unpack_command(octets)
        except TmtcError:
            inside = f"{len(octets)} octets"
        else:
            values = argument_text(carried.name, carried.values, time)
            inside = f"{_words(carried.name)}{f' ({values})' if values else ''}"
        return f"{inside} at {time(float(arguments['release_ticks']))} of the on-board clock"
    definition = DICTIONARY.packet(name)
    fields = {field.name: field for field in definition.fields}
    shown: dict[str, Any] = dict(arguments)
    if definition.group is not None:
        shown.pop(definition.group.count, None)
    if name == FUNCTION:
        named = FUNCTION_ARGUMENTS.get(function_of(shown), ())
        numbers = [shown.pop(number, 0.0) for number in _NUMBERS]
        shown.update({field.name: number for field, number in zip(named, numbers, strict=False)})
        fields.update({field.name: field for field in named})
    parameter = find_parameter(shown.get("parameter_id"))
    if parameter is not None:
        shown["parameter_id"] = parameter.name
        fields["value"] = Field("value", "f64", "", parameter.unit)
    return ", ".join(_written(key, value, fields.get(key), time) for key, value in shown.items())


def _written(key: str, value: Any, field: Field | None, time: Callable[[float], str]) -> str:
    name = _words(key.removesuffix("_id"))
    if field is None:
        columns = _columns(value)
        if "octet" in columns:
            return f"{len(columns['octet'])} octets"
        labels = dict(QUANTITIES)
        return f"{name} {', '.join(_words(labels.get(one, str(one))) for one in columns['quantity'])}"
    if field.unit == "2^-16 s":
        return f"{name.removesuffix(' ticks')} {time(float(value))}"
    label = value if isinstance(value, str) else dict(field.labels).get(value)
    if label is not None:
        return f"{name} {_words(label)}"
    short = name.removesuffix(f" {_words(field.unit.replace('/', '_'))}")
    return f"{short} {number_text(float(value))} {field.unit}".rstrip()


def _columns(items: Any) -> Mapping[str, list[Any]]:
    """Return repeated items, given as mappings or as a mapping of arrays, by column."""
    if isinstance(items, Mapping):
        return {name: list(map(int, column)) for name, column in items.items()}
    return {name: [item[name] for item in items] for name in (items[0] if items else {"octet": 0})}


def _words(name: str) -> str:
    return name.replace("_", " ")
