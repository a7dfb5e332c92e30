"""The XTCE export, judged by a decoder and a validator that know nothing of this project."""

import math
import warnings

import numpy as np
import pytest
import space_packet_parser as spp
from space_packet_parser.xtce.validation import validate_xtce

from tmtc.dictionary import DICTIONARY
from tmtc.schema import Field, PacketDefinition
from tmtc.xtce import format_xtce, parameter_name


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    path = tmp_path_factory.mktemp("xtce") / "linna.xml"
    path.write_text(format_xtce(), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def decoder(document):
    return spp.load_xtce(document)


def test_the_document_validates_against_the_schema_and_its_references_hold(document):
    result = validate_xtce(document, level="all", print_results=False, allow_schema_download=False)
    assert result.valid, result.errors


def random_value(f: Field, rng: np.random.Generator):
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


def random_packet(definition: PacketDefinition, count: int, rng: np.random.Generator) -> bytes:
    group = definition.group
    values = {
        f.name: random_value(f, rng) for f in definition.fields if not (group and f.name == group.count)
    }
    if group:
        values[group.name] = [{f.name: random_value(f, rng) for f in group.fields} for _ in range(count)]
    return DICTIONARY.pack(
        definition.name,
        values,
        ticks=int(rng.integers(0, 2**48)),
        sequence_count=int(rng.integers(0, 16384)),
        message_counter=int(rng.integers(0, 65536)),
    )


@pytest.mark.parametrize("definition", DICTIONARY.telemetry, ids=lambda d: d.name)
def test_an_independent_decoder_reads_every_packet_to_equal_values(definition, decoder):
    rng = np.random.default_rng(17)
    counts = [0, 1, 2, 40, 255] if definition.group else [0, 0, 0]
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
            if f.size == 1:
                assert_equal(
                    theirs[parameter_name(definition.name, f.name)], ours.values[f.name], ours.raw[f.name], f
                )
            for k in range(f.size if f.size > 1 else 0):
                name = parameter_name(definition.name, f.name, k + 1)
                assert_equal(theirs[name], ours.values[f.name][k], ours.raw[f.name][k], f)
        if definition.group and [f.type for f in definition.group.fields] == ["u8"]:
            name = parameter_name(definition.name, "items")
            assert bytes(theirs[name]) == bytes(ours.values["items"]["octet"].astype(np.uint8))
        elif definition.group:
            for f in definition.group.fields:
                for k in range(count):
                    name = parameter_name(definition.name, f.name, k + 1)
                    assert_equal(
                        theirs[name], ours.values["items"][f.name][k], ours.raw["items"][f.name][k], f
                    )


def assert_equal(theirs, value, raw, f: Field) -> None:
    if f.labels:
        assert (str(theirs), theirs.raw_value) == (f.label(raw), raw)
    elif f.is_float and math.isnan(value):
        assert math.isnan(theirs)
    else:
        assert theirs == value and theirs.raw_value == raw
