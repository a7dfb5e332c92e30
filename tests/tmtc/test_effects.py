"""Effects of telecommands: stated for all, inherited by scheduling telecommands, most severe if unknown."""

from __future__ import annotations

from typing import Any

import pytest

from tmtc.dictionary.codes import FUNCTIONS
from tmtc.dictionary.effects import CARRIER, EFFECTS, FUNCTION, Effect, effect_of
from tmtc.dictionary.payload import DICTIONARY


def effect(name: str, **arguments: Any) -> Effect:
    return effect_of(DICTIONARY, name, arguments, packed(name, arguments)).effect


def packed(name: str, arguments: dict[str, Any]) -> bytes:
    return DICTIONARY.pack_command(name, arguments, sequence_count=0)


def function(name: Any) -> dict[str, Any]:
    return {"function_id": name, "argument_1": 0.0, "argument_2": 0.0}


def carried(octets: bytes) -> dict[str, Any]:
    return {"release_ticks": 1, "items": [{"octet": octet} for octet in octets]}


def test_every_telecommand_and_every_function_has_an_effect_with_a_reason_and_nothing_else_has() -> None:
    names = {one.name for one in DICTIONARY.telecommands} - {FUNCTION, CARRIER}
    functions = {f"{FUNCTION}/{name}" for _, name in FUNCTIONS}
    assert set(EFFECTS) == names | functions
    assert all(one.reason and one.subject == subject for subject, one in EFFECTS.items())


def test_a_parameter_and_the_table_that_holds_it_have_the_same_effect() -> None:
    part = {"transaction": 1, "part": 1, "table": "parameters", "items": [{"octet": 0}]}
    assert effect("set_parameter", parameter_id=1, value=1.0) == effect("uplink_first", **part)
    assert effect("set_parameter", parameter_id=1, value=1.0) is Effect.CHANGES_STATE


@pytest.mark.parametrize(
    ("name", "code", "expected"),
    [
        ("set_mode", 1, Effect.CHANGES_STATE),
        ("start_observation", 2, Effect.ROUTINE),
        ("reboot", 7, Effect.DESTROYS_DATA),
        ("synchronise_clock", 9, Effect.CHANGES_STATE),
    ],
)
def test_a_function_has_its_effect_by_name_and_by_code(name: str, code: int, expected: Effect) -> None:
    assert effect(FUNCTION, **function(name)) is effect(FUNCTION, **function(code)) is expected


def test_an_activity_has_the_effect_of_what_it_carries_however_deep() -> None:
    for inner, expected in (
        (function("start_observation"), Effect.ROUTINE),
        (function("reboot"), Effect.DESTROYS_DATA),
    ):
        once = carried(packed(FUNCTION, inner))
        assert effect(CARRIER, **once) is expected
        assert effect(CARRIER, **carried(packed(CARRIER, once))) is expected


def test_what_carries_no_telecommand_and_what_is_not_known_counts_as_the_gravest() -> None:
    assert effect(CARRIER, **carried(b"\x00" * 12)) is Effect.DESTROYS_DATA
    for name, arguments in ((FUNCTION, {"function_id": 999}), ("new_command", {})):
        assert effect_of(DICTIONARY, name, arguments, b"").effect is Effect.DESTROYS_DATA
