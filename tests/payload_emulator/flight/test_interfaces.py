"""The document about the payload's ports, modes, parameters and faults is the current one, and complete."""

from __future__ import annotations

import re

from payload_emulator.flight.onboard.icd import format_interfaces
from payload_emulator.flight.onboard.modes import ALLOWED
from payload_emulator.flight.ports import Board
from tmtc.dictionary.onboard_parameters import PARAMETERS
from tmtc.dictionary.payload import DICTIONARY


def test_every_port_parameter_and_restricted_command_is_in_it() -> None:
    text = format_interfaces()
    ports = [name for name in vars(Board) if not name.startswith("_") and callable(getattr(Board, name))]
    assert len(ports) > 8
    for name in ports:
        assert f"| `{name}(" in text
    for parameter in PARAMETERS:
        assert f"| {parameter.number} | {parameter.name} |" in text
    for name in ALLOWED:
        assert f"| {name} |" in text


def test_the_events_of_the_table_of_faults_are_those_of_the_dictionary() -> None:
    known = set(DICTIONARY.labels("event_info", "event_id").values())
    rows = format_interfaces().split("## Faults")[1].splitlines()[4:]
    named = {event for row in rows if row for event in re.findall(r"\w+", row.split("|")[2])}
    assert len(named) > 25
    assert named <= known
