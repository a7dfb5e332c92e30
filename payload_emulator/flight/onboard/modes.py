"""Modes of the payload as a machine: which follows which, and what is allowed in each."""

from enum import IntEnum


class PayloadMode(IntEnum):
    """safe: alive, nothing powered that can be spared; standby: ready; observing: frames are processed;
    downlinking: the store is sent, frames are not looked at."""

    safe = 0
    standby = 1
    observing = 2
    downlinking = 3


_SAFE, _STANDBY, _OBSERVING, _DOWNLINKING = PayloadMode
ALL_MODES = frozenset(PayloadMode)

# By telecommand or by the schedule. Fault reactions may go to `safe` or `standby` from anywhere.
TRANSITIONS: dict[PayloadMode, frozenset[PayloadMode]] = {
    _SAFE: frozenset({_SAFE, _STANDBY}),
    _STANDBY: ALL_MODES,
    _OBSERVING: frozenset({_SAFE, _STANDBY, _OBSERVING}),
    _DOWNLINKING: frozenset({_SAFE, _STANDBY, _DOWNLINKING}),
}

_QUIET = frozenset({_SAFE, _STANDBY})
_NOT_OBSERVING = ALL_MODES - {_OBSERVING}
# Telecommands and functions that not every mode allows; all others are allowed in all.
ALLOWED: dict[str, frozenset[PayloadMode]] = {
    "uplink_first": _QUIET,
    "uplink_middle": _QUIET,
    "uplink_last": _QUIET,
    "replay_store": frozenset({_STANDBY, _DOWNLINKING}),
    "delete_store": _NOT_OBSERVING,
    "start_observation": frozenset({_STANDBY, _OBSERVING}),
    "stop_observation": frozenset({_OBSERVING}),
    "manual_step": frozenset({_OBSERVING}),
    "reset_estimators": frozenset({_STANDBY, _OBSERVING}),
    "widen_estimate": frozenset({_STANDBY, _OBSERVING}),
    "clear_store": _NOT_OBSERVING,
    "downlink_thumbnail": frozenset({_OBSERVING}),
    "downlink_map": frozenset({_STANDBY, _OBSERVING, _DOWNLINKING}),
}


def may_change(present: PayloadMode, wanted: PayloadMode) -> bool:
    """Return whether an order may lead from one mode to the other."""
    return wanted in TRANSITIONS[present]


def allows(mode: PayloadMode, name: str) -> bool:
    """Return whether a telecommand or function may be carried out in a mode."""
    return mode in ALLOWED.get(name, ALL_MODES)
