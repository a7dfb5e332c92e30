"""Every transition between modes, by telecommand, and what each mode allows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from payload_emulator.flight.onboard.modes import ALLOWED, TRANSITIONS, PayloadMode
from tmtc.dictionary.payload import DICTIONARY

SAFE, STANDBY, OBSERVING, DOWNLINKING = PayloadMode
# Written out here a second time on purpose: who may follow whom.
ALLOWED_CHANGES = {
    (SAFE, SAFE), (SAFE, STANDBY),
    (STANDBY, SAFE), (STANDBY, STANDBY), (STANDBY, OBSERVING), (STANDBY, DOWNLINKING),
    (OBSERVING, SAFE), (OBSERVING, STANDBY), (OBSERVING, OBSERVING),
    (DOWNLINKING, SAFE), (DOWNLINKING, STANDBY), (DOWNLINKING, DOWNLINKING),
}  # fmt: skip
PATHS = {SAFE: [SAFE], STANDBY: [], OBSERVING: [OBSERVING], DOWNLINKING: [DOWNLINKING]}


def in_mode(make_rig: Callable[..., Any], mode: PayloadMode) -> Any:
    rig = make_rig()
    rig.step(b"".join(rig.function("set_mode", step) for step in PATHS[mode]))
    assert rig.payload.mode is mode
    return rig


@pytest.mark.parametrize("present", PayloadMode)
@pytest.mark.parametrize("wanted", PayloadMode)
def test_a_mode_follows_another_only_as_the_table_says(
    make_rig: Callable[..., Any], present: PayloadMode, wanted: PayloadMode
) -> None:
    rig = in_mode(make_rig, present)
    packets = rig.step(rig.function("set_mode", wanted))
    if (present, wanted) in ALLOWED_CHANGES:
        assert rig.payload.mode is wanted
        assert rig.refusals(packets) == []
        assert ("mode_changed" in rig.events(packets)) is (present is not wanted)
    else:
        assert rig.payload.mode is present
        assert rig.refusals(packets) == ["wrong_mode"]
    assert (wanted in TRANSITIONS[present]) is ((present, wanted) in ALLOWED_CHANGES)


COMMANDS = {
    "start_observation": ("perform_function", {"function_id": "start_observation"}),
    "stop_observation": ("perform_function", {"function_id": "stop_observation"}),
    "manual_step": ("perform_function", {"function_id": "manual_step"}),
    "reset_estimators": ("perform_function", {"function_id": "reset_estimators"}),
    "widen_estimate": ("perform_function", {"function_id": "widen_estimate"}),
    "clear_store": ("perform_function", {"function_id": "clear_store"}),
    "downlink_thumbnail": ("perform_function", {"function_id": "downlink_thumbnail"}),
    "downlink_map": ("perform_function", {"function_id": "downlink_map"}),
    "replay_store": ("replay_store", {"start_ticks": 1, "stop_ticks": 2}),
    "delete_store": ("delete_store", {"stop_ticks": 1}),
    "uplink_first": ("uplink_first", {"transaction": 1, "part": 1, "table": 1, "items": {"octet": [1]}}),
    "uplink_middle": ("uplink_middle", {"transaction": 1, "part": 2, "table": 1, "items": {"octet": [1]}}),
}


@pytest.mark.parametrize("name", sorted(ALLOWED))
@pytest.mark.parametrize("mode", PayloadMode)
def test_a_command_out_of_its_mode_is_refused_and_does_nothing(
    make_rig: Callable[..., Any], name: str, mode: PayloadMode
) -> None:
    if name == "uplink_last":
        kind, values = "uplink_last", {"transaction": 1, "part": 3, "table": 1, "items": {"octet": [1]}}
    else:
        kind, values = COMMANDS[name]
    if kind == "perform_function":
        values = {**values, "argument_1": 0.0, "argument_2": 0.0}
    rig = in_mode(make_rig, mode)
    packets = rig.step(rig.command(kind, **values))
    refused = rig.refusals(packets)
    assert ("wrong_mode" in refused) is (mode not in ALLOWED[name])
    if refused:
        assert rig.payload.mode is mode
        assert not rig.named(packets, "verification_completed")


def test_the_table_names_only_what_the_dictionary_has() -> None:
    functions = set(DICTIONARY.labels("perform_function", "function_id").values())
    commands = {definition.name for definition in DICTIONARY.telecommands}
    assert set(ALLOWED) <= functions | commands
    assert set(TRANSITIONS) == set(PayloadMode)
