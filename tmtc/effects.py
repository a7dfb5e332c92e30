"""What each telecommand does to the payload: nothing that lasts, a change of its state, or a loss of data.

The rule that two people have to agree follows from the effect, so it is the same for a parameter that is set by one
telecommand and for the table of parameters that is uploaded in many. A telecommand that performs a function has the
effect of the function; one that carries another to be done later has the effect of that one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from tmtc.codes import FUNCTIONS
from tmtc.errors import TmtcError
from tmtc.schema import Dictionary


class Effect(StrEnum):
    """What a telecommand does to the payload, from the least to the gravest."""

    ROUTINE = "routine"
    CHANGES_STATE = "changes on-board state"
    DESTROYS_DATA = "destroys data"


@dataclass(frozen=True, slots=True)
class CommandEffect:
    """An effect and why it is this one; `subject` names the telecommand, or the function behind a slash."""

    subject: str
    effect: Effect
    reason: str


_ROUTINE, _CHANGES, _DESTROYS = Effect.ROUTINE, Effect.CHANGES_STATE, Effect.DESTROYS_DATA
_REPORTS = "only makes a report"

FUNCTION = "perform_function"
CARRIER = "insert_activity"

_EFFECTS: dict[str, tuple[Effect, str]] = {
    "enable_housekeeping": (_ROUTINE, "adds reports"),
    "disable_housekeeping": (_CHANGES, "the ground no longer sees the state of the payload"),
    "request_housekeeping": (_ROUTINE, _REPORTS),
    "set_housekeeping_interval": (_ROUTINE, "changes how often a report is made, within fixed limits"),
    "create_housekeeping": (_ROUTINE, "adds reports"),
    "delete_housekeeping": (_CHANGES, "a report that others may rely on is gone"),
    "report_housekeeping_definition": (_ROUTINE, _REPORTS),
    "enable_event": (_ROUTINE, "adds reports"),
    "disable_event": (_CHANGES, "the ground is no longer told of the event"),
    "report_disabled_events": (_ROUTINE, _REPORTS),
    "set_time_report_rate": (_ROUTINE, "changes how often a report is made, within fixed limits"),
    "enable_schedule": (_ROUTINE, "lets activities run, each of which was released by its own rule"),
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
    f"{FUNCTION}/set_mode": (_CHANGES, "decides what the payload does"),
    f"{FUNCTION}/start_observation": (_ROUTINE, "is what the payload is for; it ends by itself"),
    f"{FUNCTION}/stop_observation": (_ROUTINE, "ends an observation; nothing recorded is lost"),
    f"{FUNCTION}/manual_step": (_CHANGES, "moves the state of an estimator"),
    f"{FUNCTION}/reset_estimators": (_CHANGES, "replaces the navigation state"),
    f"{FUNCTION}/clear_store": (_DESTROYS, "deletes all stored packets"),
    f"{FUNCTION}/reboot": (_DESTROYS, "ends what runs; what is only in memory is lost"),
    f"{FUNCTION}/check_tables": (_ROUTINE, _REPORTS),
    f"{FUNCTION}/synchronise_clock": (_CHANGES, "moves on-board time, by which everything is ordered"),
    f"{FUNCTION}/abort_uplink": (_DESTROYS, "discards the parts of an upload that were received"),
    f"{FUNCTION}/widen_estimate": (_CHANGES, "changes the covariance of the navigation filter"),
    f"{FUNCTION}/resynchronise_commands": (_CHANGES, "changes which telecommands are taken for repetitions"),
    f"{FUNCTION}/downlink_thumbnail": (_ROUTINE, "sends an image that is stored"),
    f"{FUNCTION}/downlink_map": (_ROUTINE, "sends a table that is stored"),
}

EFFECTS: Mapping[str, CommandEffect] = {
    subject: CommandEffect(subject, effect, reason) for subject, (effect, reason) in _EFFECTS.items()
}
"""By telecommand, or by telecommand and function where that decides."""

_FUNCTION_NAMES = dict(FUNCTIONS)


def effect_of(
    dictionary: Dictionary, name: str, arguments: Mapping[str, Any], octets: bytes
) -> CommandEffect:
    """Return the effect of a telecommand; what is not known counts as the gravest.

    Parameters
    ----------
    octets
        The telecommand as a packet, out of which one that it carries is read.
    """
    if name == CARRIER:
        items = dictionary.unpack_command(octets).values["items"]["octet"]
        inner = bytes(np.asarray(items, dtype=np.uint8))
        try:
            carried = dictionary.unpack_command(inner)
        except TmtcError as error:
            return CommandEffect(name, _DESTROYS, f"carries what is no telecommand ({error})")
        return effect_of(dictionary, carried.name, carried.values, inner)
    subject = name
    if name == FUNCTION:
        function = arguments.get("function_id")
        label = _FUNCTION_NAMES.get(function, "unknown") if isinstance(function, int) else str(function)
        subject = f"{name}/{label}"
    unknown = CommandEffect(subject, _DESTROYS, "its effect is not known")
    return EFFECTS.get(subject, unknown)
