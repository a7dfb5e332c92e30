"""`linna alarm list | show | acknowledge | shelve`: alarms of the spacecraft."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from linna.commands._table import Command, add_commands

if TYPE_CHECKING:
    from ground_service.passes.alarms.model import Alarm, AlarmDetail


def _line(alarm: Alarm) -> str:
    value = "" if alarm.value is None else f", last {alarm.value:g} {alarm.unit} (limits {alarm.limits})"
    return (
        f"{alarm.id:>6}  {alarm.last[:19]}Z  {alarm.severity:<7} {alarm.state:<12} "
        f"{alarm.name.replace('_', ' ')}, {alarm.count} packets{value}"
    )


def _lines(alarm: AlarmDetail) -> str:
    history = (f"        {one.time[:19]}Z  {one.actor}: {one.change} {one.comment}" for one in alarm.history)
    return "\n".join([_line(alarm), *(one.rstrip() for one in history)])


COMMENT = {"comment": "comment for the history"}
COMMANDS = {
    "list": Command(
        "list_alarms",
        "list alarms, open ones first",
        _line,
        "alarms",
        "no alarms",
        options={"state": "only alarms in this state; can be repeated", "severity": "only alarms of this severity"},
    ),
    "show": Command("get_alarm", "show an alarm with its history", _lines),
    "acknowledge": Command("acknowledge_alarm", "acknowledge an alarm", _lines, options=COMMENT),
    "shelve": Command(
        "shelve_alarm",
        "suppress an alarm until a time",
        _lines,
        options=COMMENT | {"until": "end of the suppression (RFC 3339); in the past: end it now"},
    ),
}


def configure(parser: argparse.ArgumentParser) -> None:
    add_commands(parser, COMMANDS)
