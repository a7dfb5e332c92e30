"""Effects of telecommands on the payload: none that lasts, a change of on-board state, or a loss of data.

The effect decides whether a second person has to approve a telecommand. It is the same for a parameter that is set by
one telecommand and for a parameter table that is uploaded in many. A telecommand that performs a function has the
effect of that function; a telecommand that schedules another one has the effect of the scheduled telecommand.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from tmtc.dictionary.codes import FUNCTIONS
from tmtc.dictionary.schema import Dictionary
from tmtc.errors import TmtcError


class Effect(StrEnum):
    """Effect of a telecommand on the payload, from the least to the most severe."""

    ROUTINE = "routine"
    CHANGES_STATE = "changes on-board state"
    DESTROYS_DATA = "destroys data"


@dataclass(frozen=True, slots=True)
class CommandEffect:
    """Effect and its reason; `subject` names the telecommand, and the function after a slash if there is one."""

    subject: str
    effect: Effect
    reason: str


_ROUTINE, _CHANGES, _DESTROYS = Effect.ROUTINE, Effect.CHANGES_STATE, Effect.DESTROYS_DATA
_REPORTS = "only generates a report"

FUNCTION = "perform_function"
CARRIER = "insert_activity"

_EFFECTS: dict[str, tuple[Effect, str]] = {
    "enable_housekeeping": (_ROUTINE, "adds reports"),
    "disable_housekeeping": (_CHANGES, "the ground no longer receives this housekeeping report"),
    "request_housekeeping": (_ROUTINE, _REPORTS),
    "set_housekeeping_interval": (_ROUTINE, "changes the interval of a report within fixed limits"),
    "create_housekeeping": (_ROUTINE, "adds reports"),
    "delete_housekeeping": (_CHANGES, "removes a report that other users may need"),
    "report_housekeeping_definition": (_ROUTINE, _REPORTS),
    "enable_event": (_ROUTINE, "adds reports"),
    "disable_event": (_CHANGES, "the ground no longer receives this event"),
    "report_disabled_events": (_ROUTINE, _REPORTS),
    "set_time_report_rate": (_ROUTINE, "changes the interval of a report within fixed limits"),
    "enable_schedule": (_ROUTINE, "enables activities, each of which was approved by its own rule"),
    "disable_schedule": (_CHANGES, "planned activities no longer run"),
    "reset_schedule": (_DESTROYS, "deletes all planned activities"),
    "delete_activity": (_CHANGES, "a planned activity no longer runs"),
    "report_schedule": (_ROUTINE, _REPORTS),
    "uplink_first": (_CHANGES, "replaces an on-board table"),
    "uplink_middle": (_CHANGES, "replaces an on-board table"),
    "uplink_last": (_CHANGES, "replaces an on-board table"),
    "replay_store": (_ROUTINE, "sends stored packets again"),
    "delete_store": (_DESTROYS, "deletes stored packets"),
    "report_store": (_ROUTINE, _REPORTS),
    "test_connection": (_ROUTINE, _REPORTS),
    "request_parameter": (_ROUTINE, _REPORTS),
    "set_parameter": (_CHANGES, "replaces a value of the on-board table of parameters"),
    f"{FUNCTION}/set_mode": (_CHANGES, "changes the operating mode of the payload"),
    f"{FUNCTION}/start_observation": (_ROUTINE, "nominal operation; it ends automatically"),
    f"{FUNCTION}/stop_observation": (_ROUTINE, "ends an observation; nothing recorded is lost"),
    f"{FUNCTION}/manual_step": (_CHANGES, "changes the state of an estimator"),
    f"{FUNCTION}/reset_estimators": (_CHANGES, "replaces the navigation state"),
    f"{FUNCTION}/clear_store": (_DESTROYS, "deletes all stored packets"),
    f"{FUNCTION}/reboot": (_DESTROYS, "stops all activities; data held only in memory are lost"),
    f"{FUNCTION}/check_tables": (_ROUTINE, _REPORTS),
    f"{FUNCTION}/synchronise_clock": (_CHANGES, "changes on-board time, the time base of all telemetry"),
    f"{FUNCTION}/abort_uplink": (_DESTROYS, "discards the received parts of an upload"),
    f"{FUNCTION}/widen_estimate": (_CHANGES, "changes the covariance of the navigation filter"),
    f"{FUNCTION}/resynchronise_commands": (_CHANGES, "changes which telecommands are treated as repetitions"),
    f"{FUNCTION}/downlink_thumbnail": (_ROUTINE, "sends a stored image"),
    f"{FUNCTION}/downlink_map": (_ROUTINE, "sends a stored table"),
}

EFFECTS: Mapping[str, CommandEffect] = {
    subject: CommandEffect(subject, effect, reason) for subject, (effect, reason) in _EFFECTS.items()
}
"""Effects by telecommand, or by telecommand and function where the function decides."""

_FUNCTION_NAMES = dict(FUNCTIONS)


def effect_of(dictionary: Dictionary, name: str, arguments: Mapping[str, Any], octets: bytes) -> CommandEffect:
    """Return the effect of a telecommand; an unknown telecommand counts as the most severe.

    Parameters
    ----------
    octets
        The telecommand packet, from which a scheduled telecommand is read.
    """
    if name == CARRIER:
        items = dictionary.unpack_command(octets).values["items"]["octet"]
        inner = bytes(np.asarray(items, dtype=np.uint8))
        try:
            carried = dictionary.unpack_command(inner)
        except TmtcError as error:
            return CommandEffect(name, _DESTROYS, f"schedules an invalid telecommand ({error})")
        return effect_of(dictionary, carried.name, carried.values, inner)
    subject = name
    if name == FUNCTION:
        function = arguments.get("function_id")
        label = _FUNCTION_NAMES.get(function, "unknown") if isinstance(function, int) else str(function)
        subject = f"{name}/{label}"
    return EFFECTS.get(subject, CommandEffect(subject, _DESTROYS, "unknown effect"))
