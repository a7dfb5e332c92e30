"""Second persons: from the effects of telecommands, raised or relaxed by a mission description."""

from ground_service.missions.model import Approval
from tmtc.dictionary.effects import EFFECTS, Effect

needs = Approval().needs_second_person


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
    rules = Approval(second_person_for=("replay_store",), one_person_for=("perform_function/set_mode",))
    assert rules.needs_second_person("replay_store")
    assert not rules.needs_second_person("perform_function/set_mode")
    assert rules.needs_second_person("set_parameter")


def test_an_unknown_telecommand_needs_a_second_person_whatever_the_mission_states() -> None:
    assert Approval(one_person_for=tuple(EFFECTS)).needs_second_person("new_command")
