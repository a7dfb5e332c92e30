"""Texts of event values: what operators read in place of codes."""

import ast
import math
from pathlib import Path

import pytest

import payload_emulator.flight
from tmtc.dictionary.codes import EVENTS
from tmtc.dictionary.event_texts import EVENT_TEXTS, event_text
from tmtc.dictionary.icd import format_icd

FLIGHT = Path(next(iter(payload_emulator.flight.__path__)))


def test_values_of_events_are_read_as_names() -> None:
    assert event_text("mode_changed", 1.0, 2.0) == "from standby to observing"
    assert event_text("table_loaded", 3.0, float(0xDF7F5779)) == "gravity, hash df7f5779"
    assert event_text("camera_fault", 82.0, 3.0) == "82 frames without image, camera switched 3 times"
    assert (
        event_text("telecommand_rejected", 5.0, float(0x1885C007))
        == "telecommand with sequence count 7: wrong mode"
    )
    seconds = (29 * 365 + 8 + 218) * 86_400 + 6 * 3600 + 37
    assert event_text("observation_started", seconds * 65_536.0, 15 * 65_536.0) == (
        "until 2029-08-07T06:00:37 TAI, every 15 s"
    )


@pytest.mark.parametrize("value", [None, math.nan])
def test_unknown_values_are_not_invented(value: float | None) -> None:
    assert event_text("mode_changed", 1.0, value) == "1"
    assert event_text("no_such_event", 4.0, 0.5) == "4, 0.5"
    assert event_text("attitude_missing", 0.0, 0.0) == ""


def test_unknown_codes_remain_numbers() -> None:
    assert event_text("mode_changed", 9.0, 2.0) == "from 9 to observing"


def test_every_event_of_the_flight_software_is_described_with_its_values() -> None:
    """The number of values in the code of the flight software is that of the description."""
    found = {}
    for path in FLIGHT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Attribute)
                and node.func.attr == "event"
            ):
                name = node.args[1]
                if isinstance(name, ast.Constant):
                    found[name.value] = len(node.args) - 2
    assert len(found) > 30
    assert set(found) <= {name for _, name in EVENTS}
    assert {name: len(EVENT_TEXTS[name].values) if name in EVENT_TEXTS else 0 for name in found} == found


def test_the_interface_document_states_the_values() -> None:
    assert "| mode_changed | mode before | mode after |" in format_icd()
