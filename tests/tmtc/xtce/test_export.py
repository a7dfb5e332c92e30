"""The XTCE export, judged by a decoder and a validator that know nothing of this project."""

import math
import warnings
import xml.etree.ElementTree as ET
from math import isnan

import numpy as np
import space_packet_parser as spp
from numpy.random import default_rng
from pytest import fixture, mark
from space_packet_parser.xtce.validation import validate_xtce

from tmtc.dictionary.fields import PARAMETERS, Field
from tmtc.dictionary.payload import DICTIONARY
from tmtc.packets.space_packets import CRC_LENGTH
from tmtc.packets.stream import whole_packets
from tmtc.xtce.decode import Decoder
from tmtc.xtce.export import format_xtce, parameter_name
from tmtc.xtce.importing import parse_xtce


@fixture(scope="module")
def document(tmp_path_factory):
    """The unrolled form: the independent decoder does not support arrays."""
    path = tmp_path_factory.mktemp("xtce") / "linna.xml"
    path.write_text(format_xtce(unrolled=True), encoding="utf-8")
    return path


@fixture(scope="module")
def decoder(document):
    return spp.load_xtce(document)


def test_the_document_validates_against_the_schema_and_its_references_hold(document):
    validate(document, "all")


def validate(path, level):
    result = validate_xtce(path, level=level, print_results=False, allow_schema_download=False)
    assert result.valid, result.errors


def test_the_form_with_arrays_validates_against_the_schema_and_is_short(tmp_path):
    text = format_xtce()
    path = tmp_path / "arrays.xml"
    path.write_text(text, encoding="utf-8")
    validate(path, "schema")
    assert text.count("<SequenceContainer") == len(DICTIONARY.telemetry) + 2
    assert len(text) < 300_000


@fixture(scope="module")
def imported():
    return parse_xtce(format_xtce())


@mark.parametrize("definition", DICTIONARY.telemetry, ids=lambda d: d.name)
def test_the_form_with_arrays_is_imported_to_equal_values_of_every_packet(definition, imported):
    rng = default_rng(18)
    counts = [0, 1, 2, 40, 255] if definition.group else [0, 0, 0]
    packets = [random_packet(definition, count, rng) for count in counts]
    cut = whole_packets(np.array([len(packet) for packet in packets]))
    found = Decoder(imported).decode(b"".join(packets), cut)
    assert found.counts()["decoded"] == len(packets)
    (table,) = found.tables.values()
    assert table.name == definition.name
    assert not table.unread_bits.any()
    columns = {
        name: list(zip(column.to_list(), column.to_list(raw=True), strict=True))
        for name, column in table.columns.items()
    }
    for row, octets in enumerate(packets):
        ours = DICTIONARY.unpack_packet(octets)
        assert columns["TIME_COARSE"][row][0] << 16 | columns["TIME_FINE"][row][0] == ours.ticks
        assert columns["ERROR_CONTROL"][row][0] == int.from_bytes(octets[-2:], "big")
        for f in definition.fields:
            for name, value, raw in named(definition, f, ours):
                assert_imported(columns[name][row], value, raw, f)
        if definition.group is None:
            continue
        values, raws = columns[parameter_name(definition.name, definition.group.name)][row]
        fields = definition.group.fields
        if [f.type for f in fields] == ["u8"]:
            assert values == bytes(ours.values["items"]["octet"].astype(np.uint8))
            continue
        assert len(values) == counts[row]
        for f in fields:
            for k in range(counts[row]):
                pair = (values[k], raws[k]) if len(fields) == 1 else (values[k][f.name], raws[k][f.name])
                assert_imported(pair, ours.values["items"][f.name][k], ours.raw["items"][f.name][k], f)


def named(definition, f, ours):
    """Names of the parameters of a field, with their values and raw values."""
    value, raw = ours.values[f.name], ours.raw[f.name]
    if f.size == 1:
        return [(parameter_name(definition.name, f.name), value, raw)]
    return [(parameter_name(definition.name, f.name, k + 1), value[k], raw[k]) for k in range(f.size)]


def assert_imported(pair, value, raw, f):
    if f.labels:
        assert pair == (f.label(raw), raw)
    elif f.missing is not None and raw == f.missing:
        assert pair[1] == raw
    elif f.is_float and isnan(value):
        assert isnan(pair[0])
    else:
        assert pair == (value, raw)


def random_value(f, rng):
    if f.size > 1:
        return [random_value(Field(f.name, f.type, ""), rng) for _ in range(f.size)]
    if f.labels:
        return int(rng.choice([code for code, _ in f.labels]))
    if f.is_float:
        return float(np.float32(rng.normal(0, 1e3)))
    low, high = f.raw_limits
    if f.minimum is not None or f.maximum is not None:
        low = math.ceil((f.minimum or 0.0) / f.scale)
        high = math.floor((high if f.maximum is None else f.maximum) / f.scale + 1e-9)
    if f.missing is not None:
        high = min(high, f.missing - 1)  # "not known" has no expression in XTCE
    raw = int(rng.integers(low, high, dtype=np.uint64 if low >= 0 else np.int64, endpoint=True))
    return raw * f.scale + f.offset if f.is_calibrated else raw


def random_packet(definition, count, rng):
    group = definition.group
    values = {f.name: random_value(f, rng) for f in definition.fields if not (group and f.name == group.count)}
    if group:
        values[group.name] = [{f.name: random_value(f, rng) for f in group.fields} for _ in range(count)]
    return DICTIONARY.pack(
        definition.name, values, ticks=int(rng.integers(0, 2**48)), sequence_count=int(rng.integers(0, 16384)),
        message_counter=int(rng.integers(0, 65536)),
    )  # fmt: skip


@mark.parametrize("definition", DICTIONARY.telemetry, ids=lambda d: d.name)
def test_an_independent_decoder_reads_every_packet_to_equal_values(definition, decoder):
    rng = default_rng(17)
    counts = [0, 1, 2, 40] if definition.group else [0, 0, 0]
    if definition.name == "detections":
        counts.append(255)  # the longest; this decoder needs a second for it
    for count in counts:
        octets = random_packet(definition, count, rng)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            theirs = decoder.parse_bytes(octets)
        ours = DICTIONARY.unpack_packet(octets)
        assert theirs["PKT_APID"] == ours.apid and theirs["SRC_SEQ_CTR"] == ours.sequence_count
        assert (theirs["SERVICE"], theirs["SUBTYPE"]) == (ours.service, ours.subtype)
        assert theirs["TIME_COARSE"] << 16 | theirs["TIME_FINE"] == ours.ticks
        for f in definition.fields:
            for name, value, raw in named(definition, f, ours):
                assert_equal(theirs[name], value, raw, f)
        if definition.group and [f.type for f in definition.group.fields] == ["u8"]:
            name = parameter_name(definition.name, "items")
            assert bytes(theirs[name]) == bytes(ours.values["items"]["octet"].astype(np.uint8))
        elif definition.group:
            for f in definition.group.fields:
                for k in range(count):
                    name = parameter_name(definition.name, f.name, k + 1)
                    assert_equal(theirs[name], ours.values["items"][f.name][k], ours.raw["items"][f.name][k], f)


def assert_equal(theirs, value, raw, f):
    if f.labels:
        assert (str(theirs), theirs.raw_value) == (f.label(raw), raw)
    elif f.is_float and isnan(value):
        assert isnan(theirs)
    else:
        assert theirs == value and theirs.raw_value == raw


def test_telecommands_are_as_long_as_the_dictionary_expects_once_the_sender_appends_their_checksum():
    name = "{http://www.omg.org/spec/XTCE/20180204}"
    tree = ET.fromstring(format_xtce())
    commands = {one.get("name"): one for one in tree.iter(f"{name}MetaCommand")}
    assert len(commands) == len(DICTIONARY.telecommands) == 27
    for definition in DICTIONARY.telecommands:
        command = commands[definition.name]
        fixed = [int(one.attrib["sizeInBits"]) for one in command.iter(f"{name}FixedValueEntry")]
        names = [one.attrib["argumentRef"] for one in command.iter(f"{name}ArgumentRefEntry")]
        group = [definition.group.name] if definition.group else []
        assert names == [f.name for f in definition.fields] + group
        given = {f.name: first_value(f) for f in definition.fields}
        if definition.group:
            given[definition.group.name] = []
            del given[definition.group.count]
        packet = DICTIONARY.pack_command(definition.name, given, sequence_count=0)
        assert len(packet) == sum(fixed) // 8 + sum(f.octets for f in definition.fields) + CRC_LENGTH
        if definition.group:
            (kind,) = (
                one
                for one in tree.iter(f"{name}BinaryArgumentType")
                if one.get("name") == f"{definition.name}_{group[0]}_Type"
            )
            (size,) = kind.iter(f"{name}LinearAdjustment")
            assert size.get("slope") == str(8 * sum(f.octets for f in definition.group.fields))
    for kind in tree.iter(f"{name}EnumeratedArgumentType"):
        if "parameter_id" in kind.attrib["name"]:
            listed = {one.get("label"): one.get("value") for one in kind.iter(f"{name}Enumeration")}
            assert listed == {one.name: str(one.number) for one in PARAMETERS}


def first_value(f):
    """Return a value that the field accepts."""
    return f.labels[0][0] if f.labels else max(f.minimum or 0, 0)
