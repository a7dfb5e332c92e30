import math

import numpy as np
import pytest
from ccsdspy import FixedLength, PacketArray, PacketField, VariableLength
from hypothesis import given, settings
from hypothesis import strategies as st

from tmtc.dictionary.fields import Field
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
from tmtc.packets.stream import cut_packets

HOUSEKEEPING = {
    "structure_id": 1, "boot_count": 3, "mode": "observing", "frames_processed": 148, "frames_bad": 2,
    "detections_total": 4000, "packets_sent": 900, "anchor_reads": 7, "events_sent": 5,
    "telecommands_accepted": 4, "telecommands_rejected": 1, "last_image_quality": "dark",
    "temperature_c": -12.34, "bus_voltage_v": 12.017, "power_w": 8.25, "memory_used_kib": 81920,
    "queue_depth": 12, "storage_used_permille": 250, "model_hash": 0xDEADBEEF, "parameters_hash": 1,
    "catalogue_hash": 2, "anchor_table_hash": 3, "clock_status": "synchronised", "watchdog_resets": 0,
}  # fmt: skip


def pack(name: str, values: dict, **header: int) -> bytes:
    return DICTIONARY.pack(name, values, **{"ticks": 5 << 16, "sequence_count": 1, **header})


def test_the_layouts_have_the_lengths_of_the_interface():
    lengths = {
        d.name: (d.apid, d.service, d.subtype, d.base_length, d.item_length) for d in DICTIONARY.telemetry
    }
    # 20 octets of headers, the fields, 2 of checksum
    assert lengths["housekeeping"] == (0x0A0, 3, 25, 22 + 67, 0)
    assert lengths["detections"] == (0x0A1, 129, 1, 22 + 14, 9)
    assert lengths["navigation_state"] == (0x0A2, 129, 2, 22 + 67, 0)
    assert lengths["frame_outcome"] == (0x0A3, 129, 3, 22 + 31, 0)
    assert lengths["event_high"] == (0x0A4, 5, 4, 22 + 22, 0)
    assert lengths["time_report"] == (0x0A5, 9, 2, 22 + 9, 0)
    assert lengths["verification_not_completed"] == (0x0A6, 1, 8, 22 + 6, 0)


def test_the_version_has_the_hash_under_which_it_was_released():
    # A change here is a change of the interface: add a packet and a version, change none that was released.
    # Two packets were withdrawn without a new version: all others are as before, so no archive is decoded again.
    assert DICTIONARY.version == 7
    assert DICTIONARY.hash == "aa0e6af217c291cc86233fb16cf1bed09095754b5c77d4503aefa91e340defcb"


def test_housekeeping_comes_back_within_its_quantisation():
    name, values = DICTIONARY.unpack(pack("housekeeping", HOUSEKEEPING))
    assert name == "housekeeping"
    assert values["mode"] == 2 and values["last_image_quality"] == 1
    assert values["temperature_c"] == pytest.approx(-12.34, abs=0.005)  # half a step of 0.01
    assert values["bus_voltage_v"] == pytest.approx(12.017, abs=0.0005)
    assert values["model_hash"] == 0xDEADBEEF
    assert DICTIONARY.labels("housekeeping", "mode")[values["mode"]] == "observing"


def test_fields_stand_where_the_interface_says():
    octets = pack("housekeeping", HOUSEKEEPING)
    assert octets[:6] == bytes.fromhex("08A0 C001 0052")
    assert octets[6:20] == bytes.fromhex("20 03 19 0000 0000 2E 00000005 0000")
    assert octets[20:29] == bytes.fromhex("0001 0003 02 00000094")
    # ccsdspy decodes the same octets from a layout written by hand
    fields = [
        PacketArray(name="head", data_type="uint", bit_length=8, array_shape=14, array_order="C"),
        *(
            PacketField(name=n, data_type="uint", bit_length=b)
            for n, b in (("structure", 16), ("boot", 16), ("mode", 8))
        ),
        PacketArray(name="u32", data_type="uint", bit_length=32, array_shape=6, array_order="C"),
        PacketField(name="accepted", data_type="uint", bit_length=16),
        PacketField(name="rejected", data_type="uint", bit_length=16),
        PacketField(name="quality", data_type="uint", bit_length=8),
        PacketField(name="temperature", data_type="int", bit_length=16),
        PacketArray(name="rest", data_type="uint", bit_length=8, array_shape=31, array_order="C"),
        PacketField(name="crc", data_type="uint", bit_length=16),
    ]
    import io

    theirs = FixedLength(fields).load(io.BytesIO(octets * 3))
    assert theirs["u32"][2].tolist() == [148, 2, 4000, 900, 7, 5]
    assert theirs["temperature"].tolist() == [-1234] * 3


def test_ccsdspy_reads_the_repeated_items_to_the_same_raw_values():
    import io

    rng = np.random.default_rng(3)
    octets, counts = b"", [0, 1, 7, 255, 3]
    for count in counts:
        octets += pack("detections", detections(count, rng))
    item = ["u_px", "v_px", "diameter_px", "score", "size_class", "sigma_px"]
    fields = [
        PacketArray(name="head", data_type="uint", bit_length=8, array_shape=14, array_order="C"),
        PacketField(name="frame_number", data_type="uint", bit_length=32),
        PacketField(name="image_ticks", data_type="uint", bit_length=64),
        PacketField(name="image_quality", data_type="uint", bit_length=8),
        PacketField(name="count", data_type="uint", bit_length=8),
        PacketArray(name="items", data_type="uint", bit_length=8, array_shape="expand"),
        PacketField(name="crc", data_type="uint", bit_length=16),
    ]
    theirs = VariableLength(fields).load(io.BytesIO(octets))
    table = DICTIONARY.unpack_many(octets, cut_packets(octets))["detections"]
    assert theirs["count"].tolist() == counts == table.columns["count"].tolist()
    for row in range(len(counts)):
        mine = table.item_owner == row
        dtype = np.dtype([(n, d) for n, d in zip(item, (">u2", ">u2", ">u2", "u1", "i1", "u1"), strict=True)])
        records = np.asarray(theirs["items"][row], dtype=np.uint8).reshape(-1).view(dtype)
        for name in item:
            np.testing.assert_array_equal(table.items_raw[name][mine], records[name])


def detections(count: int, rng: np.random.Generator) -> dict:
    items = {
        "u_px": rng.uniform(0, 1023, count),
        "v_px": rng.uniform(0, 1023, count),
        "diameter_px": rng.uniform(0, 1023, count),
        "score": rng.uniform(0, 1, count),
        "size_class": rng.integers(-1, 4, count),
        "sigma_px": np.where(rng.uniform(size=count) < 0.2, np.nan, rng.uniform(0, 3.9, count)),
    }
    return {"frame_number": 9, "image_ticks": 1 << 40, "image_quality": "ok", "items": items}


def test_items_may_be_given_as_mappings_or_as_arrays():
    rng = np.random.default_rng(1)
    values = detections(4, rng)
    rows = [{k: v[n].item() for k, v in values["items"].items()} for n in range(4)]
    assert pack("detections", {**values, "items": rows}) == pack("detections", {**values, "count": 4})


def test_a_packet_without_items_is_a_packet():
    _, values = DICTIONARY.unpack(
        pack("detections", {**detections(0, np.random.default_rng(0)), "items": []})
    )
    assert values["count"] == 0 and values["items"]["u_px"].size == 0
    octets = pack("detections", {"frame_number": 1, "image_ticks": 1, "image_quality": 0})
    table = DICTIONARY.unpack_many(octets, cut_packets(octets))["detections"]
    assert len(table) == 1 and table.item_owner.size == 0


def test_unknown_sigma_is_nan_and_large_sigma_saturates_below_the_code_for_unknown():
    values = detections(3, np.random.default_rng(0))
    values["items"]["sigma_px"] = np.array([np.nan, 100.0, 0.5])
    _, back = DICTIONARY.unpack(pack("detections", values))
    np.testing.assert_array_equal(back["items"]["sigma_px"], [np.nan, 254 / 64, 0.5])


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 255))
def test_quantised_columns_come_back_within_half_a_step(seed, count):
    values = detections(count, np.random.default_rng(seed))
    _, back = DICTIONARY.unpack(pack("detections", values))
    steps = {"u_px": 1 / 64, "v_px": 1 / 64, "diameter_px": 1 / 64, "score": 1 / 255, "sigma_px": 1 / 64}
    for name, step in steps.items():
        np.testing.assert_allclose(back["items"][name], values["items"][name], atol=step / 2 + 1e-12, rtol=0)
    np.testing.assert_array_equal(back["items"]["size_class"], values["items"]["size_class"])
    # and what came back packs to the same octets
    assert pack("detections", back) == pack("detections", values)


def raw_values(f: Field) -> st.SearchStrategy:
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
            lambda raw: math.nan if raw == f.missing else raw * f.scale + f.offset if f.is_calibrated else raw
        )
    return one if f.size == 1 else st.lists(one, min_size=f.size, max_size=f.size)


def packets_of(definition: PacketDefinition) -> st.SearchStrategy:
    fields = {
        f.name: raw_values(f)
        for f in definition.fields
        if not (definition.group and f.name == definition.group.count)
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
    header = {
        "ticks": data.draw(st.integers(0, 2**48 - 1)),
        "sequence_count": data.draw(st.integers(0, 16383)),
        "message_counter": data.draw(st.integers(0, 65535)),
    }
    octets = DICTIONARY.pack(definition.name, values, **header)
    decoded = DICTIONARY.unpack_packet(octets)
    assert {k: getattr(decoded, k) for k in header} == header
    assert DICTIONARY.pack(definition.name, decoded.values, **header) == octets
    table = DICTIONARY.unpack_many(octets * 2, cut_packets(octets * 2))[definition.name]
    assert table.ticks.tolist() == [header["ticks"]] * 2
    assert table.sequence_count.tolist() == [header["sequence_count"]] * 2
    for f in definition.fields:
        np.testing.assert_array_equal(
            table.columns[f.name][1], np.asarray(decoded.values[f.name]).astype(table.columns[f.name].dtype)
        )
    if definition.group:
        for f in definition.group.fields:
            mine = table.items[f.name][table.item_owner == 1]
            np.testing.assert_array_equal(mine, decoded.values[definition.group.name][f.name])


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_every_telecommand_of_the_dictionary_comes_back_equal(data):
    definition = data.draw(st.sampled_from(DICTIONARY.telecommands))
    values = data.draw(packets_of(definition))
    octets = DICTIONARY.pack_command(definition.name, values, sequence_count=7)
    command = DICTIONARY.unpack_command(octets)
    assert command.name == definition.name
    assert DICTIONARY.pack_command(definition.name, command.values, sequence_count=7) == octets


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("housekeeping", {"mode": 9}, r"housekeeping\.mode: expected one of 0 \(safe\).*found 9"),
        ("housekeeping", {"mode": "asleep"}, "found 'asleep'"),
        ("housekeeping", {"boot_count": 65536}, "expected an integer from 0 to 65535, found 65536"),
        ("housekeeping", {"boot_count": 1.5}, "expected an integer"),
        ("housekeeping", {"storage_used_permille": 1001}, "from 0 to 1000, found 1001"),
        ("housekeeping", {"structure_id": 2}, "from 1 to 1"),
        ("housekeeping", {"temperature_c": math.nan}, "expected a number from -327.68 to 327.67"),
        ("housekeeping", {"temprature_c": 1.0}, "no such field"),
        ("detections", {"count": 3}, "expected 2, the number of items"),
    ],
)
def test_values_that_break_the_rules_are_refused_with_field_and_range(name, change, message):
    base = HOUSEKEEPING if name == "housekeeping" else detections(2, np.random.default_rng(0))
    with pytest.raises(ValueRefused, match=message):
        pack(name, {**base, **change})


def test_a_missing_value_is_refused():
    with pytest.raises(ValueRefused, match=r"housekeeping\.mode: expected a value"):
        pack("housekeeping", {k: v for k, v in HOUSEKEEPING.items() if k != "mode"})


def test_positions_outside_their_range_are_refused_and_more_items_than_fit_too():
    values = detections(2, np.random.default_rng(0))
    with pytest.raises(ValueRefused, match=r"detections\.u_px"):
        pack("detections", {**values, "items": {**values["items"], "u_px": [-1.0, 5.0]}})
    with pytest.raises(ValueRefused, match="at most 255 items"):
        pack("detections", detections(256, np.random.default_rng(0)))
    with pytest.raises(ValueRefused, match="columns of one length"):
        pack("detections", {**values, "items": {**values["items"], "u_px": [5.0]}})


def test_a_number_too_large_for_single_precision_is_refused():
    values = {
        "frame_number": 0, "image_ticks": 0, "estimator": 0, "outcome": 0, "latitude_deg": 0.0, "longitude_deg": 0.0,
        "altitude_m": 0.0, "velocity_icrf_m_s": [1e39, 0.0, 0.0], "sigma_rtn_m": [math.nan] * 3,
        "nis": 0.0, "matched": 0,
    }  # fmt: skip
    with pytest.raises(ValueRefused):
        pack("navigation_state", values)


def test_damaged_packets_are_refused_each_for_its_reason():
    octets = pack("housekeeping", HOUSEKEEPING)
    with pytest.raises(TruncatedPacket, match="expected 89 octets, found 88"):
        DICTIONARY.unpack(octets[:-1])
    with pytest.raises(ChecksumError):
        DICTIONARY.unpack(octets[:-1] + bytes((octets[-1] ^ 1,)))
    with pytest.raises(MalformedPacket, match="found 90"):
        DICTIONARY.unpack(octets + b"\0")
    with pytest.raises(MalformedPacket, match="expected type 0"):
        DICTIONARY.unpack(DICTIONARY.pack_command("test_connection", {}, sequence_count=0))


def test_packets_of_another_dictionary_are_unknown_and_left_out_of_the_tables():
    other = Dictionary(
        9,
        (
            PacketDefinition("strange", 0x123, 200, 1, "Not ours", (Field("x", "u8", "x"),)),
            PacketDefinition(
                "longer",
                0x0A5,
                9,
                2,
                "Our time report, longer",
                (Field("x", "u64", "x"), Field("y", "u32", "y")),
            ),
        ),
    )
    strange = other.pack("strange", {"x": 1}, ticks=0, sequence_count=0)
    longer = other.pack("longer", {"x": 1, "y": 2}, ticks=0, sequence_count=0)
    with pytest.raises(UnknownPacket, match="no packet of APID 0x123, service 200, subtype 1"):
        DICTIONARY.unpack(strange)
    with pytest.raises(MalformedPacket, match="time_report: expected 31 octets, found 34"):
        DICTIONARY.unpack(longer)
    buffer = strange + longer + pack("housekeeping", HOUSEKEEPING)
    cut = cut_packets(buffer)
    assert DICTIONARY.identify(buffer, cut).tolist() == [-1, WRONG_LENGTH, 0]
    assert {
        name: table.packet_index.tolist() for name, table in DICTIONARY.unpack_many(buffer, cut).items()
    } == {"housekeeping": [2]}


def test_a_dictionary_that_defines_a_packet_twice_is_refused():
    definition = PacketDefinition(
        "p", 1, 1, 1, "", (Field("n", "u8", ""),), Group("n", (Field("x", "u8", ""),))
    )
    with pytest.raises(MalformedPacket, match="p is defined twice"):
        Dictionary(1, (definition, definition))


def test_a_column_is_made_once_when_it_is_asked_for():
    buffer = pack("housekeeping", HOUSEKEEPING) + pack("detections", detections(2, np.random.default_rng(0)))
    tables = DICTIONARY.unpack_many(buffer, cut_packets(buffer))
    assert set(tables) == {"housekeeping", "detections"}
    columns = tables["housekeeping"].columns
    assert list(columns) == [f.name for f in DICTIONARY.packet("housekeeping").fields]
    assert columns["mode"] is columns["mode"]
    assert set(columns._made) == {"mode"}


def test_integer_columns_do_not_wrap_in_arithmetic():
    buffer = pack("housekeeping", HOUSEKEEPING)
    table = DICTIONARY.unpack_many(buffer, cut_packets(buffer))["housekeeping"]
    assert table.columns["frames_bad"].dtype == np.int64 and table.raw["frames_bad"].dtype == np.uint32
    assert table.columns["image_ticks" if "image_ticks" in table.columns else "mode"].dtype == np.int64


@pytest.mark.parametrize("value", [0, 2**63 - 1, 2**63, 2**64 - 1])
def test_unsigned_integers_of_64_bits_stay_what_was_sent(value):
    definition = PacketDefinition(
        "wide",
        1,
        3,
        25,
        "",
        (Field("number", "u64", ""), Field("vector", "u64", "", size=2), Field("count", "u8", "")),
        Group("count", (Field("item", "u64", ""),)),
    )
    dictionary = Dictionary(1, (definition,))
    values = {"number": value, "vector": [1, value], "items": [{"item": value}, {"item": 7}]}
    octets = dictionary.pack("wide", values, ticks=0, sequence_count=0)
    table = dictionary.unpack_many(octets, cut_packets(octets))["wide"]
    assert table.columns["number"].tolist() == [value] and table.columns["vector"].tolist() == [[1, value]]
    assert table.items["item"].tolist() == [value, 7]
    assert dictionary.unpack(octets)[1]["items"]["item"].tolist() == [value, 7]


def test_limits_tell_warning_from_alarm():
    temperature = DICTIONARY.packet("housekeeping").field("temperature_c")
    values = [-41.0, -30.0, -20.0, 20.0, 60.0, 61.0, 86.0, math.nan]
    assert limit_states(temperature, values).tolist() == [
        ALARM,
        WARNING,
        0,
        0,
        0,
        WARNING,
        ALARM,
        WITHIN_LIMITS,
    ]
    assert limit_states(DICTIONARY.packet("housekeeping").field("mode"), [3]).tolist() == [WITHIN_LIMITS]
