"""Conditions in telemetry that raise alarms, and the life cycle of an alarm. Pure functions of plain values.

The life cycle follows the states of ANSI/ISA-18.2: an alarm is *raised*; an operator *acknowledges* it; it is *cleared*
when it has been acknowledged and its condition has ended. An alarm whose condition ends first stays raised until it is
acknowledged, so that no alarm disappears unseen. The condition of an event report ends with the report.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lunar.arrays import IntArray
from tmtc.dictionary.fields import Field
from tmtc.dictionary.payload import DICTIONARY, STRUCTURES
from tmtc.dictionary.schema import PacketDefinition, Table, limit_states
from tmtc.packets.stream import cut_packets

WARNING, ALARM = 1, 2
SEVERITIES = {WARNING: "warning", ALARM: "alarm"}
EVENT_SEVERITIES = {"event_medium": WARNING, "event_high": ALARM}
"""Severity of the alarms of event packets; events of lower severity raise none."""

OUTCOMES = ("fix_refused",)
"""Events that are a normal outcome of a frame: requirements judge their share, single ones raise no alarm."""

_WATCHED = (*map(DICTIONARY.packet, EVENT_SEVERITIES), *STRUCTURES.values())
WATCHED_APIDS = tuple(sorted({one.apid for one in _WATCHED}))

Source = Literal["event", "parameter", "operations"]
OPERATIONS: Source = "operations"
"""Source of alarms for what stops operations (`worker.watch`)."""

State = Literal["raised", "acknowledged", "cleared"]


@dataclass(frozen=True, slots=True)
class Condition:
    """One cause of alarms in some packets: an event, or a parameter outside its limits.

    Attributes
    ----------
    severity
        The worst severity found: `WARNING` or `ALARM`.
    first_ticks, last_ticks
        On-board times of the first and the last packet with the condition.
    count
        Number of these packets.
    value
        Value of the parameter in the last of them, in its unit; None for an event.
    """

    source: Source
    name: str
    severity: int
    first_ticks: int
    last_ticks: int
    count: int
    value: float | None = None


def limited_parameters() -> tuple[Field, ...]:
    """Return the housekeeping parameters that have limits."""
    return tuple(field for packet in STRUCTURES.values() for field in _limited(packet))


def conditions_in(octets: bytes) -> tuple[Condition, ...]:
    """Return the conditions in telemetry packets that stand end to end, one for each cause, by source and name."""
    tables = DICTIONARY.unpack_many(octets, cut_packets(octets))
    found: dict[tuple[Source, str], Condition] = {}
    for one in _conditions(tables):
        key = (one.source, one.name)
        found[key] = joined(found[key], one) if key in found else one
    return tuple(found[key] for key in sorted(found))


def joined(first: Condition, second: Condition) -> Condition:
    """Return the union of two conditions of the same cause; the order does not matter."""
    later = max((first, second), key=lambda one: (one.last_ticks, one.value is not None, one.value or 0.0))
    return Condition(
        first.source,
        first.name,
        max(first.severity, second.severity),
        min(first.first_ticks, second.first_ticks),
        later.last_ticks,
        first.count + second.count,
        later.value,
    )


def broken_limits(octets: bytes) -> frozenset[str]:
    """Return the names of the parameters that are outside their limits in housekeeping packets."""
    return frozenset(one.name for one in conditions_in(octets) if one.source == "parameter")


def state_after(state: str, *, active: bool, worse: bool) -> State:
    """Return the state of an open alarm after new telemetry.

    Parameters
    ----------
    active
        Whether the condition is still true in the newest telemetry.
    worse
        Whether the severity has increased: the alarm must be acknowledged again.
    """
    if worse or state == "raised":
        return "raised"
    return "acknowledged" if active else "cleared"


def _conditions(tables: Mapping[str, Table]) -> Iterator[Condition]:
    labels = DICTIONARY.labels("event_info", "event_id")
    for packet, severity in EVENT_SEVERITIES.items():
        table = tables.get(packet)
        if table is None:
            continue
        ids = table.columns["event_id"]
        for code in np.unique(ids).tolist():
            name = labels.get(code, f"event_{code}")
            if name not in OUTCOMES:
                yield _condition("event", name, severity, table.ticks[ids == code], None)
    for structure in STRUCTURES.values():
        table = tables.get(structure.name)
        if table is None:
            continue
        for field in _limited(structure):
            values = table.columns[field.name]
            states = limit_states(field, values)
            broken = np.flatnonzero(states)
            if broken.size:
                last = broken[np.argmax(table.ticks[broken])]
                yield _condition("parameter", field.name, int(states.max()), table.ticks[broken], float(values[last]))


def _limited(packet: PacketDefinition) -> tuple[Field, ...]:
    return tuple(one for one in packet.fields if one.warning is not None or one.alarm is not None)


def _condition(source: Source, name: str, severity: int, ticks: IntArray, value: float | None) -> Condition:
    return Condition(source, name, severity, int(ticks.min()), int(ticks.max()), len(ticks), value)
