"""The rule about second persons: from the effects of telecommands, raised or relaxed by a mission."""

import pytest

from ground_service.commanding.approval import DEFAULT_POLICY
from tmtc.effects import EFFECTS, CommandEffect, Effect


def needs(subject: str, policy=DEFAULT_POLICY) -> bool:
    return policy.needs_second_person(EFFECTS[subject])


def test_whatever_is_not_routine_needs_a_second_person() -> None:
    assert all(needs(subject) == (one.effect is not Effect.ROUTINE) for subject, one in EFFECTS.items())
    for critical in (
        "set_parameter", "uplink_first", "disable_schedule", "delete_activity", "perform_function/set_mode",
        "perform_function/synchronise_clock", "perform_function/reboot", "delete_store",
    ):  # fmt: skip
        assert needs(critical)
    for routine in (
        "test_connection",
        "enable_schedule",
        "perform_function/start_observation",
        "replay_store",
    ):
        assert not needs(routine)


def test_a_mission_can_raise_and_relax_the_rule() -> None:
    policy = DEFAULT_POLICY.raised("replay_store").relaxed("perform_function/set_mode")
    assert needs("replay_store", policy) and not needs("perform_function/set_mode", policy)
    assert needs("set_parameter", policy)
    for change in (policy.raised, policy.relaxed):
        with pytest.raises(ValueError, match="found 'set_mode'"):
            change("set_mode")


def test_what_nobody_knows_needs_a_second_person_whatever_the_policy() -> None:
    policy = DEFAULT_POLICY.relaxed(*EFFECTS)
    assert policy.needs_second_person(CommandEffect("new_command", Effect.ROUTINE, ""))
