"""A dictionary written down and read again: effects, texts, arguments, covariances and thumbnails."""

import ast
import io
import json
import math
import re
import struct
import zlib
from math import nan
from pathlib import Path

import numpy as np
from ccsdspy import FixedLength, PacketArray, PacketField, VariableLength
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, mark, raises

import payload_emulator.flight
from tmtc.dictionary.arguments import FUNCTION_ARGUMENTS, argument_text, arguments_by_number
from tmtc.dictionary.codes import EVENTS, FUNCTIONS
from tmtc.dictionary.definitions import format_dictionary, parse_dictionary
from tmtc.dictionary.effects import CARRIER, EFFECTS, FUNCTION, Effect, effect_of
from tmtc.dictionary.estimates import filter_estimates
from tmtc.dictionary.event_texts import EVENT_TEXTS, event_text
from tmtc.dictionary.fields import PARAMETERS, Field
from tmtc.dictionary.icd import format_icd
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import (
    ALARM,
    WARNING,
    WITHIN_LIMITS,
    WRONG_LENGTH,
    Dictionary,
    Group,
    PacketDefinition,
    limit_states,
)
from tmtc.errors import ChecksumError, MalformedPacket, TruncatedPacket, UnknownPacket, ValueRefused
from tmtc.packets.large_data import HEADER, Thumbnail, pack_thumbnail, unpack_thumbnail
from tmtc.packets.stream import cut_packets

HOUSEKEEPING = {f.name: 1 for f in DICTIONARY.packet("housekeeping").fields} | {
    "mode": "observing", "frames_processed": 148, "frames_bad": 2, "detections_total": 4000, "packets_sent": 900,
    "boot_count": 3, "anchor_reads": 7, "events_sent": 5, "telecommands_accepted": 4, "last_image_quality": "dark",
    "temperature_c": -12.34, "bus_voltage_v": 12.017, "model_hash": 0xDEADBEEF,
}  # fmt: skip


def pack(name, values):
    return DICTIONARY.pack(name, values, ticks=5 << 16, sequence_count=1)


def tables_of(octets):
    return DICTIONARY.unpack_many(octets, cut_packets(octets))


def layout(text):
    """Fields of ccsdspy: name:octets, and name:octets*times of arrays (* alone: what is left)."""
    fields = []
    for entry in ("head:1*14 " + text + " crc:2").split():
        name, octets, times = re.fullmatch(r"(\w+):(-?\d)(\*\d*)?", entry).groups()
        shared = {"name": name, "data_type": "int" if octets[0] == "-" else "uint", "bit_length": 8 * abs(int(octets))}
        if times:
            fields.append(PacketArray(**shared, array_shape=int(times[1:] or 0) or "expand", array_order="C"))
        else:
            fields.append(PacketField(**shared))
    return fields


LAYOUTS = """housekeeping 0A0 3 25 67 0
detections 0A1 129 1 14 9
navigation_state 0A2 129 2 67 0
frame_outcome 0A3 129 3 31 0
event_high 0A4 5 4 22 0
time_report 0A5 9 2 9 0
verification_not_completed 0A6 1 8 6 0"""


def test_the_layouts_have_the_lengths_of_the_interface():
    lengths = {
        f"{d.name} {d.apid:03X} {d.service} {d.subtype} {d.base_length - 22} {d.item_length}"
        for d in DICTIONARY.telemetry
    }
    # 20 octets of headers, the fields, 2 of checksum
    assert lengths >= set(LAYOUTS.splitlines())


def test_the_version_has_the_hash_under_which_it_was_released():
    # A change here is a change of the interface: add a packet and a version, change none that was released.
    # Two packets were withdrawn and events were added without a new version: all others are as before, so no archive
    # is decoded again.
    assert DICTIONARY.version == 7
    assert DICTIONARY.hash == "f597c227f8823961a9188be06e8fda98a0d1e470340c34e2e69cc994b54d1f7f"


def test_housekeeping_comes_back_within_its_quantisation():
    name, values = DICTIONARY.unpack(pack("housekeeping", HOUSEKEEPING))
    assert name == "housekeeping"
    assert values["mode"] == 2 and values["last_image_quality"] == 1
    assert values["temperature_c"] == approx(-12.34, abs=0.005)  # half a step of 0.01
    assert values["bus_voltage_v"] == approx(12.017, abs=0.0005)
    assert values["model_hash"] == 0xDEADBEEF
    assert DICTIONARY.labels("housekeeping", "mode")[values["mode"]] == "observing"


def test_fields_stand_where_the_interface_says():
    octets = pack("housekeeping", HOUSEKEEPING)
    assert octets[:6] == bytes.fromhex("08A0 C001 0052")
    assert octets[6:20] == bytes.fromhex("20 03 19 0000 0000 2E 00000005 0000")
    assert octets[20:29] == bytes.fromhex("0001 0003 02 00000094")
    # ccsdspy decodes the same octets from a layout written by hand
    fields = layout("structure:2 boot:2 mode:1 u32:4*6 accepted:2 rejected:2 quality:1 temperature:-2 rest:1*31")
    theirs = FixedLength(fields).load(io.BytesIO(octets * 3))
    assert theirs["u32"][2].tolist() == [148, 2, 4000, 900, 7, 5]
    assert theirs["temperature"].tolist() == [-1234] * 3


def test_ccsdspy_reads_the_repeated_items_to_the_same_raw_values():
    rng = default_rng(3)
    counts = [0, 1, 7, 255, 3]
    octets = b"".join(pack("detections", detections(count, rng)) for count in counts)
    fields = layout("frame_number:4 image_ticks:8 image_quality:1 count:1 items:1*")
    theirs = VariableLength(fields).load(io.BytesIO(octets))
    table = tables_of(octets)["detections"]
    assert theirs["count"].tolist() == counts == table.columns["count"].tolist()
    dtype = np.dtype(list(zip(detections(0, rng)["items"], (">u2", ">u2", ">u2", "u1", "i1", "u1"), strict=True)))
    for row in range(len(counts)):
        mine = table.item_owner == row
        records = np.asarray(theirs["items"][row], dtype=np.uint8).reshape(-1).view(dtype)
        for name in dtype.names:
            assert_array_equal(table.items_raw[name][mine], records[name])


def detections(count, rng):
    items = {name: rng.uniform(0, 1023, count) for name in ("u_px", "v_px", "diameter_px")} | {
        "score": rng.uniform(0, 1, count), "size_class": rng.integers(-1, 4, count),
        "sigma_px": np.where(rng.uniform(size=count) < 0.2, np.nan, rng.uniform(0, 3.9, count)),
    }  # fmt: skip
    return {"frame_number": 9, "image_ticks": 1 << 40, "image_quality": "ok", "items": items}


def test_items_are_mappings_arrays_or_none_and_a_large_sigma_saturates_below_the_code_for_unknown():
    values = detections(4, default_rng(1))
    rows = [{k: v[n].item() for k, v in values["items"].items()} for n in range(4)]
    assert pack("detections", {**values, "items": rows}) == pack("detections", {**values, "count": 4})
    _, values = DICTIONARY.unpack(pack("detections", {**detections(0, default_rng(0)), "items": []}))
    assert values["count"] == 0 and values["items"]["u_px"].size == 0
    table = tables_of(pack("detections", {"frame_number": 1, "image_ticks": 1, "image_quality": 0}))["detections"]
    assert len(table) == 1 and table.item_owner.size == 0
    values = detections(3, default_rng(0))
    values["items"]["sigma_px"] = np.array([np.nan, 100.0, 0.5])
    _, back = DICTIONARY.unpack(pack("detections", values))
    assert_array_equal(back["items"]["sigma_px"], [np.nan, 254 / 64, 0.5])


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 255))
def test_quantised_columns_come_back_within_half_a_step(seed, count):
    values = detections(count, default_rng(seed))
    _, back = DICTIONARY.unpack(pack("detections", values))
    for name, column in values["items"].items():
        atol = {"score": 0.5 / 255, "size_class": 0}.get(name, 0.5 / 64) + 1e-12
        assert_allclose(back["items"][name], column, atol=atol, rtol=0)
    # and what came back packs to the same octets
    assert pack("detections", back) == pack("detections", values)


def raw_values(f):
    if f.is_float:
        one = st.floats(width=int(f.type[1:]), allow_nan=True)
    elif f.labels:
        one = st.sampled_from([code for code, _ in f.labels])
    else:
        low, high = f.raw_limits
        if f.minimum is not None:
            low = max(low, math.ceil((f.minimum - f.offset) / f.scale - 1e-9))
        if f.maximum is not None:
            high = min(high, math.floor((f.maximum - f.offset) / f.scale + 1e-9))
        one = st.integers(low, high).map(
            lambda raw: nan if raw == f.missing else raw * f.scale + f.offset if f.is_calibrated else raw
        )
    return one if f.size == 1 else st.lists(one, min_size=f.size, max_size=f.size)


def packets_of(definition):
    fields = {
        f.name: raw_values(f) for f in definition.fields if not (definition.group and f.name == definition.group.count)
    }
    if definition.group:
        item = st.fixed_dictionaries({f.name: raw_values(f) for f in definition.group.fields})
        fields[definition.group.name] = st.lists(item, max_size=6)
    return st.fixed_dictionaries(fields)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_every_packet_of_the_dictionary_comes_back_equal_scalar_and_vectorised(data):
    definition = data.draw(st.sampled_from(DICTIONARY.telemetry))
    values = data.draw(packets_of(definition))
    limits = {"ticks": 2**48 - 1, "sequence_count": 16383, "message_counter": 65535}
    header = {name: data.draw(st.integers(0, limit)) for name, limit in limits.items()}
    octets = DICTIONARY.pack(definition.name, values, **header)
    decoded = DICTIONARY.unpack_packet(octets)
    assert {k: getattr(decoded, k) for k in header} == header
    assert DICTIONARY.pack(definition.name, decoded.values, **header) == octets
    table = tables_of(octets * 2)[definition.name]
    assert table.ticks.tolist() == [header["ticks"]] * 2
    assert table.sequence_count.tolist() == [header["sequence_count"]] * 2
    for f in definition.fields:
        assert_array_equal(
            table.columns[f.name][1], np.asarray(decoded.values[f.name]).astype(table.columns[f.name].dtype)
        )
    if definition.group:
        for f in definition.group.fields:
            mine = table.items[f.name][table.item_owner == 1]
            assert_array_equal(mine, decoded.values[definition.group.name][f.name])


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_every_telecommand_of_the_dictionary_comes_back_equal(data):
    definition = data.draw(st.sampled_from(DICTIONARY.telecommands))
    values = data.draw(packets_of(definition))
    octets = DICTIONARY.pack_command(definition.name, values, sequence_count=7)
    command = DICTIONARY.unpack_command(octets)
    assert command.name == definition.name
    assert DICTIONARY.pack_command(definition.name, command.values, sequence_count=7) == octets


@mark.parametrize("change, message", [
    ({"mode": 9}, r"housekeeping\.mode: expected one of 0 \(safe\).*found 9"), ({"mode": "asleep"}, "found 'asleep'"),
    ({"boot_count": 65536}, "expected an integer from 0 to 65535, found 65536"),
    ({"boot_count": 1.5}, "expected an integer"), ({"storage_used_permille": 1001}, "from 0 to 1000, found 1001"),
    ({"structure_id": 2}, "from 1 to 1"), ({"temprature_c": 1.0}, "no such field"),
    ({"temperature_c": nan}, "expected a number from -327.68 to 327.67"),
])  # fmt: skip
def test_values_that_break_the_rules_are_refused_with_field_and_range(change, message):
    with raises(ValueRefused, match=message):
        pack("housekeeping", HOUSEKEEPING | change)


def test_a_missing_value_is_refused():
    with raises(ValueRefused, match=r"housekeeping\.mode: expected a value"):
        pack("housekeeping", {k: v for k, v in HOUSEKEEPING.items() if k != "mode"})


def test_positions_outside_their_range_are_refused_and_more_items_than_fit_too():
    values, many = (detections(count, default_rng(0)) for count in (2, 256))
    for items, message in (
        ({"u_px": [-1.0, 5.0]}, r"detections\.u_px"), ({"u_px": [5.0]}, "columns of one length"),
        (many["items"], "at most 255 items"),
    ):  # fmt: skip
        with raises(ValueRefused, match=message):
            pack("detections", values | {"items": values["items"] | items})
    with raises(ValueRefused, match="expected 2, the number of items"):
        pack("detections", values | {"count": 3})


def test_a_number_too_large_for_single_precision_is_refused():
    values = {f.name: [nan] * 3 if f.size > 1 else 0 for f in DICTIONARY.packet("navigation_state").fields}
    pack("navigation_state", values | {"velocity_icrf_m_s": [1e38, 0.0, 0.0]})
    with raises(ValueRefused):
        pack("navigation_state", values | {"velocity_icrf_m_s": [1e39, 0.0, 0.0]})


def test_damaged_packets_are_refused_each_for_its_reason():
    octets = pack("housekeeping", HOUSEKEEPING)
    for damaged, error, message in (
        (octets[:-1], TruncatedPacket, "expected 89 octets, found 88"), (octets + b"\0", MalformedPacket, "found 90"),
        (octets[:-1] + bytes((octets[-1] ^ 1,)), ChecksumError, None),
        (DICTIONARY.pack_command("test_connection", {}, sequence_count=0), MalformedPacket, "expected type 0"),
    ):  # fmt: skip
        with raises(error, match=message):
            DICTIONARY.unpack(damaged)


def test_packets_of_another_dictionary_are_unknown_and_left_out_of_the_tables():
    x, y = Field("x", "u64", "x"), Field("y", "u32", "y")
    definitions = (
        PacketDefinition("strange", 0x123, 200, 1, "", (x,)), PacketDefinition("longer", 0x0A5, 9, 2, "", (x, y)),
    )  # fmt: skip
    other = Dictionary(9, definitions)
    strange, longer = (
        other.pack(d.name, {f.name: 1 for f in d.fields}, ticks=0, sequence_count=0) for d in definitions
    )
    for octets, error, message in (
        (strange, UnknownPacket, "no packet of APID 0x123, service 200, subtype 1"),
        (longer, MalformedPacket, "time_report: expected 31 octets, found 34"),
    ):
        with raises(error, match=message):
            DICTIONARY.unpack(octets)
    buffer = strange + longer + pack("housekeeping", HOUSEKEEPING)
    assert DICTIONARY.identify(buffer, cut_packets(buffer)).tolist() == [-1, WRONG_LENGTH, 0]
    assert {name: t.packet_index.tolist() for name, t in tables_of(buffer).items()} == {"housekeeping": [2]}


def test_a_dictionary_that_defines_a_packet_twice_is_refused():
    definition = PacketDefinition("p", 1, 1, 1, "", (Field("n", "u8", ""),), Group("n", (Field("x", "u8", ""),)))
    with raises(MalformedPacket, match="p is defined twice"):
        Dictionary(1, (definition, definition))


def test_a_column_is_made_once_when_it_is_asked_for_and_integers_do_not_wrap():
    tables = tables_of(pack("housekeeping", HOUSEKEEPING) + pack("detections", detections(2, default_rng(0))))
    assert set(tables) == {"housekeeping", "detections"}
    columns = tables["housekeeping"].columns
    assert list(columns) == [f.name for f in DICTIONARY.packet("housekeeping").fields]
    assert columns["mode"] is columns["mode"]
    assert set(columns._made) == {"mode"}
    table = tables_of(pack("housekeeping", HOUSEKEEPING))["housekeeping"]
    assert table.columns["frames_bad"].dtype == np.int64 and table.raw["frames_bad"].dtype == np.uint32
    assert table.columns["mode"].dtype == np.int64


@mark.parametrize("value", [0, 2**63 - 1, 2**63, 2**64 - 1])
def test_unsigned_integers_of_64_bits_stay_what_was_sent(value):
    definition = PacketDefinition(
        "wide", 1, 3, 25, "",
        (Field("number", "u64", ""), Field("vector", "u64", "", size=2), Field("count", "u8", "")),
        Group("count", (Field("item", "u64", ""),)),
    )  # fmt: skip
    dictionary = Dictionary(1, (definition,))
    values = {"number": value, "vector": [1, value], "items": [{"item": value}, {"item": 7}]}
    octets = dictionary.pack("wide", values, ticks=0, sequence_count=0)
    table = dictionary.unpack_many(octets, cut_packets(octets))["wide"]
    assert table.columns["number"].tolist() == [value] and table.columns["vector"].tolist() == [[1, value]]
    assert table.items["item"].tolist() == [value, 7]
    assert dictionary.unpack(octets)[1]["items"]["item"].tolist() == [value, 7]


def test_limits_tell_warning_from_alarm_and_a_dictionary_survives_being_written_down():
    field = DICTIONARY.packet("housekeeping").field
    values = [-41.0, -30.0, -20.0, 20.0, 60.0, 61.0, 86.0, nan]
    found = limit_states(field("temperature_c"), values).tolist()
    assert found == [ALARM, WARNING, 0, 0, 0, WARNING, ALARM, WITHIN_LIMITS]
    assert limit_states(field("mode"), [3]).tolist() == [WITHIN_LIMITS]
    again = parse_dictionary(format_dictionary(DICTIONARY))
    names = ("version", "hash", "telemetry", "telecommands")
    assert all(getattr(again, name) == getattr(DICTIONARY, name) for name in names)
    assert again.unpack(pack("connection_report", {}))[0] == "connection_report"


@mark.parametrize("text", ["", "[]", "{}", '{"version": 1, "telemetry": [{}], "telecommands": []}'])
def test_something_else_is_refused(text):
    with raises(MalformedPacket, match="expected a packet dictionary"):
        parse_dictionary(text, "old.json")


def test_a_changed_definition_is_refused():
    content = json.loads(format_dictionary(DICTIONARY))
    content["telemetry"][0]["fields"][0]["type"] = "u32"
    with raises(MalformedPacket, match="expected a dictionary with hash"):
        parse_dictionary(json.dumps(content))


def effect(name, **arguments):
    return effect_of(DICTIONARY, name, arguments, packed(name, arguments)).effect


def packed(name, arguments):
    return DICTIONARY.pack_command(name, arguments, sequence_count=0)


def function(name):
    return {"function_id": name, "argument_1": 0.0, "argument_2": 0.0}


def carried(octets):
    return {"release_ticks": 1, "items": [{"octet": octet} for octet in octets]}


def test_every_telecommand_function_and_parameter_has_one_effect_with_a_reason():
    names = {one.name for one in DICTIONARY.telecommands} - {FUNCTION, CARRIER}
    functions = {f"{FUNCTION}/{name}" for _, name in FUNCTIONS}
    assert set(EFFECTS) == names | functions
    assert all(one.reason and one.subject == subject for subject, one in EFFECTS.items())
    part = {"transaction": 1, "part": 1, "table": "parameters", "items": [{"octet": 0}]}
    assert effect("set_parameter", parameter_id=1, value=1.0) == effect("uplink_first", **part)
    assert effect("set_parameter", parameter_id=1, value=1.0) is Effect.CHANGES_STATE
    for name, code, expected in (
        ("set_mode", 1, Effect.CHANGES_STATE), ("start_observation", 2, Effect.ROUTINE),
        ("reboot", 7, Effect.DESTROYS_DATA), ("synchronise_clock", 9, Effect.CHANGES_STATE),
    ):  # fmt: skip
        assert effect(FUNCTION, **function(name)) is effect(FUNCTION, **function(code)) is expected


def test_an_activity_has_the_effect_of_what_it_carries_or_the_gravest_if_that_is_not_known():
    for name, expected in (("start_observation", Effect.ROUTINE), ("reboot", Effect.DESTROYS_DATA)):
        once = carried(packed(FUNCTION, function(name)))
        assert effect(CARRIER, **once) is effect(CARRIER, **carried(packed(CARRIER, once))) is expected
    assert effect(CARRIER, **carried(b"\x00" * 12)) is Effect.DESTROYS_DATA
    for name, arguments in ((FUNCTION, {"function_id": 999}), ("new_command", {})):
        assert effect_of(DICTIONARY, name, arguments, b"").effect is Effect.DESTROYS_DATA


FLIGHT = Path(next(iter(payload_emulator.flight.__path__)))


def test_values_of_events_are_read_as_names_and_unknown_ones_are_not_invented():
    for name, first, second, expected in (
        ("mode_changed", 1.0, 2.0, "from standby to observing"), ("mode_changed", 9.0, 2.0, "from 9 to observing"),
        ("table_loaded", 3.0, float(0xDF7F5779), "gravity, hash df7f5779"),
        ("camera_fault", 82.0, 3.0, "82 frames without image, camera switched 3 times"),
        ("telecommand_rejected", 5.0, float(0x1885C007), "telecommand with sequence count 7: wrong mode"),
        ("mode_changed", 1.0, None, "1"), ("mode_changed", 1.0, nan, "1"), ("no_such_event", 4.0, 0.5, "4, 0.5"),
        ("attitude_missing", 0.0, 0.0, ""),
    ):  # fmt: skip
        assert event_text(name, first, second) == expected
    seconds = (29 * 365 + 8 + 218) * 86_400 + 6 * 3600 + 37
    assert event_text("observation_started", seconds * 65_536.0, 15 * 65_536.0) == (
        "until 2029-08-07T06:00:37 TAI, every 15 s"
    )


def test_every_event_of_the_flight_software_is_described_with_its_values():
    """The number of values in the code of the flight software is that of the description."""
    found = {}
    for path in FLIGHT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "event":
                name = node.args[1]
                if isinstance(name, ast.Constant):
                    found[name.value] = len(node.args) - 2
    assert len(found) > 30
    assert set(found) <= {name for _, name in EVENTS}
    assert {name: len(EVENT_TEXTS[name].values) if name in EVENT_TEXTS else 0 for name in found} == found


OBSERVATION = {"function_id": "start_observation", "argument_1": 2227.5, "argument_2": 15.0}


def test_the_numbers_of_a_function_have_its_names_and_units():
    for arguments, expected in (
        (OBSERVATION, "start observation, duration 2227.5 s, cadence 15 s"), (function(7), "reboot"),
        ({"function_id": 11, "argument_1": 250.0, "argument_2": 0.25},
         "widen estimate, position 250 m, velocity 0.25 m/s"),
        ({"function_id": "set_mode", "argument_1": 1.5}, "set mode, mode 1.5"),
    ):  # fmt: skip
        assert argument_text("perform_function", arguments) == f"function {expected}"
    assert set(FUNCTION_ARGUMENTS) <= {name for _, name in FUNCTIONS}


def test_names_are_entered_in_place_of_numbers():
    given = {"function_id": "start_observation", "duration_s": 2227.5, "cadence_s": 15}
    assert arguments_by_number("perform_function", given) == OBSERVATION
    assert arguments_by_number("perform_function", OBSERVATION) == OBSERVATION
    mode = arguments_by_number("perform_function", {"function_id": "set_mode", "mode": "standby"})
    assert (mode["argument_1"], mode["argument_2"]) == (1, 0.0)
    changed = arguments_by_number("set_parameter", {"parameter_id": "temperature_high_c", "value": 55})
    assert changed == {"parameter_id": 7, "value": 55}
    assert argument_text("set_parameter", changed) == "parameter temperature high c, value 55 degC"


@mark.parametrize("name, values, expected", [
    (FUNCTION, {"function_id": "start_observation", "duration_s": -1.0}, "start_observation.duration_s"),
    (FUNCTION, {"function_id": "set_mode", "mode": "asleep"}, r"0 \(safe\)"),
    ("set_parameter", {"parameter_id": "temperature_high_c", "value": 101}, "20 to 100 degC"),
    ("set_parameter", {"parameter_id": 5, "value": 1.5}, "a whole number of 1 to 1000"),
])  # fmt: skip
def test_a_value_outside_its_range_is_refused_with_the_range(name, values, expected):
    with raises(ValueRefused, match=expected):
        arguments_by_number(name, values)


def test_a_carried_telecommand_is_written_out_with_its_time():
    octets = DICTIONARY.pack_command("perform_function", OBSERVATION, sequence_count=3)
    carrying = {"release_ticks": 65_536, "items": [{"octet": octet} for octet in octets]}
    assert argument_text("insert_activity", carrying, lambda ticks: f"{ticks / 65_536:g} s") == (
        "perform function (function start observation, duration 2227.5 s, cadence 15 s) at 1 s of the on-board clock"
    )
    assert argument_text("insert_activity", {**carrying, "items": [{"octet": 1}]}).startswith("1 octets at 2000-01-01")


def test_every_telecommand_has_a_text_for_its_least_values():
    for definition in DICTIONARY.telecommands:
        counted = definition.group.count if definition.group else None
        values = {
            field.name: field.labels[0][0] if field.labels else int(field.minimum or 0)
            for field in definition.fields
            if field.name != counted
        }
        if definition.group:
            item = {field.name: field.labels[0][0] if field.labels else 0 for field in definition.group.fields}
            values[definition.group.name] = [item]
        octets = DICTIONARY.pack_command(definition.name, values, sequence_count=1)
        unpacked = DICTIONARY.unpack_command(octets).values
        text = argument_text(definition.name, unpacked)
        assert text == argument_text(definition.name, values)
        assert bool(text) == bool(definition.fields), definition.name
    assert len({one.number for one in PARAMETERS}) == len(PARAMETERS)


RNG = default_rng(3)
STATES = RNG.standard_normal((2, 9)) * np.repeat([1.7e6, 1.6e3, 1e-6], 3)
_ROOTS = RNG.standard_normal((2, 9, 9)) * np.repeat([40.0, 0.05, 1e-6], 3)[:, None]
COVARIANCES = _ROOTS @ np.swapaxes(_ROOTS, 1, 2)


def packet(name, row, ticks):
    covariance = COVARIANCES[row]
    # Element by element, so that the order of the triangle is that of the interface and not of a library.
    if name == "filter_state":
        extra = {"covariance": [covariance[i, j] for i in range(9) for j in range(i + 1)]}
    else:
        triangle = [covariance[i, j] for i in range(9) for j in range(i, 9)]
        extra = {"covariance": triangle, "innovation_degrees": 22}
    values = {
        "frame_number": 5 + row, "image_ticks": ticks, "position_icrf_m": STATES[row, :3],
        "velocity_icrf_m_s": STATES[row, 3:6], "acceleration_rtn_m_s2": STATES[row, 6:], **extra,
    }  # fmt: skip
    return DICTIONARY.pack(name, values, ticks=ticks + 9, sequence_count=row)


def estimates_of(octets):
    return filter_estimates(DICTIONARY.unpack_many(octets, cut_packets(octets)))


@mark.parametrize("name, degrees", [("filter_state", -1), ("filter_estimate", 22)])
def test_state_and_covariance_come_back_within_single_precision(name, degrees):
    found = estimates_of(b"".join(packet(name, row, 100 + row) for row in (0, 1)))
    assert found.image_ticks.tolist() == [100, 101] and found.packet_ticks.tolist() == [109, 110]
    assert found.frame_number.tolist() == [5, 6] and found.packet_index.tolist() == [0, 1]
    assert found.innovation_degrees.tolist() == [degrees, degrees]
    assert_array_equal(found.state[:, :6], STATES[:, :6])
    assert_allclose(found.state[:, 6:], STATES[:, 6:], rtol=1e-7)
    assert_allclose(found.covariance, COVARIANCES, rtol=1.2e-7)


def test_a_stream_may_hold_packets_of_both_versions_and_other_ones():
    other = DICTIONARY.pack("connection_report", {}, ticks=1, sequence_count=1)
    found = estimates_of(packet("filter_estimate", 0, 7) + other + packet("filter_state", 1, 8))
    assert dict(zip(found.image_ticks.tolist(), found.packet_index.tolist(), strict=True)) == {7: 0, 8: 2}
    assert len(estimates_of(other)) == 0 and estimates_of(other).covariance.shape == (0, 9, 9)


def test_every_packet_field_and_label_is_in_the_document_and_each_enumeration_is_one():
    text = format_icd()
    assert "| mode_changed | mode before | mode after |" in text
    seen = {}
    for definition in DICTIONARY.telemetry + DICTIONARY.telecommands:
        assert f"### {definition.name}\n" in text
        for field in definition.fields + (definition.group.fields if definition.group else ()):
            assert f"| {field.name} |" in text
            assert all(f"| {code} | {label} |" in text for code, label in field.labels)
        for field in definition.fields:
            if field.labels:
                assert seen.setdefault(field.name, field.labels) == field.labels


@mark.parametrize("shape", [(3, 5), (1, 1), (0, 0)])
def test_a_thumbnail_reads_back(shape):
    levels = np.arange(shape[0] * shape[1], dtype=np.uint8).reshape(shape)
    octets = pack_thumbnail(Thumbnail(7, 2**40 + 1, levels))
    assert octets[:16] == struct.pack(">IQHH", 7, 2**40 + 1, *shape)
    found = unpack_thumbnail(octets)
    assert (found.frame_number, found.ticks) == (7, 2**40 + 1)
    assert_array_equal(found.levels, levels)


@mark.parametrize(
    "octets", [b"", bytes(15), *(HEADER.pack(1, 2, 3, 4) + body for body in (
        b"no zlib", zlib.compress(bytes(11)), zlib.compress(bytes(13)), zlib.compress(bytes(12))[:-5],
    ))],
)  # fmt: skip
def test_what_is_no_thumbnail_is_refused(octets):
    with raises(ValueRefused, match="thumbnail"):
        unpack_thumbnail(octets)
