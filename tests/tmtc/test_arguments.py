"""Arguments of telecommands by name, with units and ranges."""

import pytest

from tmtc.dictionary.arguments import FUNCTION_ARGUMENTS, argument_text, arguments_by_number
from tmtc.dictionary.codes import FUNCTIONS
from tmtc.dictionary.onboard_parameters import PARAMETERS
from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import ValueRefused

OBSERVATION = {"function_id": "start_observation", "argument_1": 2227.5, "argument_2": 15.0}


def test_the_numbers_of_a_function_have_its_names_and_units() -> None:
    assert (
        argument_text("perform_function", OBSERVATION)
        == "function start observation, duration 2227.5 s, cadence 15 s"
    )
    assert (
        argument_text("perform_function", {"function_id": 7, "argument_1": 0.0, "argument_2": 0.0})
        == "function reboot"
    )
    widened = {"function_id": 11, "argument_1": 250.0, "argument_2": 0.25}
    assert (
        argument_text("perform_function", widened)
        == "function widen estimate, position 250 m, velocity 0.25 m/s"
    )
    assert set(FUNCTION_ARGUMENTS) <= {name for _, name in FUNCTIONS}


def test_names_are_entered_in_place_of_numbers() -> None:
    given = {"function_id": "start_observation", "duration_s": 2227.5, "cadence_s": 15}
    assert arguments_by_number("perform_function", given) == OBSERVATION
    assert arguments_by_number("perform_function", OBSERVATION) == OBSERVATION
    mode = arguments_by_number("perform_function", {"function_id": "set_mode", "mode": "standby"})
    assert (mode["argument_1"], mode["argument_2"]) == (1, 0.0)
    changed = arguments_by_number("set_parameter", {"parameter_id": "temperature_high_c", "value": 55})
    assert changed == {"parameter_id": 7, "value": 55}
    between = {"function_id": "set_mode", "argument_1": 1.5}
    assert argument_text("perform_function", between) == "function set mode, mode 1.5"
    assert argument_text("set_parameter", changed) == "parameter temperature high c, value 55 degC"


@pytest.mark.parametrize(
    ("name", "given", "expected"),
    [
        ("perform_function", {"function_id": "start_observation", "duration_s": -1.0}, "start_observation.duration_s"),
        ("perform_function", {"function_id": "set_mode", "mode": "asleep"}, r"0 \(safe\)"),
        ("set_parameter", {"parameter_id": "temperature_high_c", "value": 101}, "20 to 100 degC"),
        ("set_parameter", {"parameter_id": 5, "value": 1.5}, "a whole number of 1 to 1000"),
    ],
)  # fmt: skip
def test_a_value_outside_its_range_is_refused_with_the_range(
    name: str, given: dict[str, object], expected: str
) -> None:
    with pytest.raises(ValueRefused, match=expected):
        arguments_by_number(name, given)


def test_a_carried_telecommand_is_written_out_with_its_time() -> None:
    octets = DICTIONARY.pack_command("perform_function", OBSERVATION, sequence_count=3)
    carrying = {"release_ticks": 65_536, "items": [{"octet": octet} for octet in octets]}
    assert argument_text("insert_activity", carrying, lambda ticks: f"{ticks / 65_536:g} s") == (
        "perform function (function start observation, duration 2227.5 s, cadence 15 s) at 1 s of the on-board clock"
    )
    assert argument_text("insert_activity", {**carrying, "items": [{"octet": 1}]}).startswith(
        "1 octets at 2000-01-01"
    )


def test_every_telecommand_has_a_text_for_its_least_values() -> None:
    for definition in DICTIONARY.telecommands:
        counted = definition.group.count if definition.group else None
        values: dict[str, object] = {
            field.name: field.labels[0][0] if field.labels else int(field.minimum or 0)
            for field in definition.fields
            if field.name != counted
        }
        if definition.group:
            item = {
                field.name: field.labels[0][0] if field.labels else 0 for field in definition.group.fields
            }
            values[definition.group.name] = [item]
        octets = DICTIONARY.pack_command(definition.name, values, sequence_count=1)
        unpacked = DICTIONARY.unpack_command(octets).values
        text = argument_text(definition.name, unpacked)
        assert text == argument_text(definition.name, values)
        assert bool(text) == bool(definition.fields), definition.name
    assert len({one.number for one in PARAMETERS}) == len(PARAMETERS)
