"""Packets of other missions decoded through their XTCE, against an independent interpreter and constructed values."""

import math
import struct
import warnings
from math import nan

import numpy as np
import space_packet_parser as spp
from numpy.random import default_rng
from pytest import approx, mark, raises

from tests.tmtc import foreign
from tests.tmtc.foreign import (
    HEADER,
    HEADER_PARAMETERS,
    HEADER_TYPES,
    Bits,
    binary,
    bus_like,
    calibrated,
    child,
    comparison,
    container,
    default,
    document,
    dynamic,
    fixed_size,
    floating,
    integer,
    layout,
    space_packet,
    text_type,
)  # fmt: skip
from tmtc.errors import DefinitionError
from tmtc.packets.stream import PacketCut, primary_headers
from tmtc.xtce.columns import ArrayColumn, OptionalColumn, ValueColumn
from tmtc.xtce.decode import VERDICTS, Decoder
from tmtc.xtce.importing import parse_xtce


def whole(packets):
    """Packets one after another, and a cut that says where they stand."""
    lengths = np.array([len(p) for p in packets], dtype=np.int64)
    offsets = np.cumsum(lengths) - lengths
    none = np.empty((0, 2), dtype=np.int64)
    ok = np.ones(len(packets), dtype=np.bool_)
    return b"".join(packets), PacketCut(offsets, lengths, ok, none, none, int(lengths.sum()))


def decoded(definition, packets, root=None):
    return Decoder(parse_xtce(definition), root).decode(*whole(packets))


def verdicts(definition, packets):
    return [VERDICTS[v] for v in decoded(definition, packets).verdict.tolist()]


def values(definition, packets, name="P"):
    """Values of packets of one container."""
    columns = decoded(definition, packets).tables[name].columns
    return {name: column.to_list() for name, column in columns.items()}


def one(data, types, **parameters):
    """Values of one packet of a container without header."""
    text = layout(types, **parameters)
    assert verdicts(text, [data]) == ["decoded"]
    return values(text, [data])


# against an interpreter of another project


def rows_of(found, count):
    """(value, raw) by parameter, for every packet."""
    rows = [{} for _ in range(count)]
    for table in found.tables.values():
        for name, column in table.columns.items():
            pairs = zip(column.to_list(), column.to_list(raw=True), strict=True)
            for packet, pair in zip(table.packet_index.tolist(), pairs, strict=True):
                rows[packet][name] = pair
    return rows


def same(a, b):
    return a == b or (isinstance(a, float) and isinstance(b, float) and math.isnan(a) and math.isnan(b))


@mark.parametrize("seed", range(3))
def test_an_independent_interpreter_reads_the_same_values_of_another_mission(seed, tmp_path):
    path = tmp_path / "bus.xml"
    path.write_text(foreign.BUS, encoding="utf-8")
    theirs = spp.load_xtce(path)
    packets = foreign.capture(400, seed)
    found = decoded(foreign.BUS, packets)
    assert set(found.tables) == {"Housekeeping", "Event", "UrgentEvent", "Dump", "Bare"}
    assert found.counts()["decoded"] == 400
    for packet, row in zip(packets, rows_of(found, 400), strict=True):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            expected = theirs.parse_bytes(packet)
        assert row.keys() == expected.keys()
        for name, value in expected.items():
            assert same(row[name][0], value) and same(row[name][1], value.raw_value), (name, row[name], value)
            assert isinstance(row[name][0], str) == isinstance(value, str)


# integers and floats of any width at any place


@mark.parametrize("bits", range(1, 65))
def test_integers_of_every_width_stand_at_every_place(bits):
    rng = default_rng(bits)
    types = integer("U", bits) + integer("I", bits, "twosComplement") + integer("PAD", 1)
    for phase in range(8):
        text = layout(types, **{f"P{k}": "PAD" for k in range(phase)}, A="U", B="I")
        drawn = [int.from_bytes(rng.bytes(8), "big") >> (64 - bits) for _ in range(6)]
        least = -(1 << bits - 1)
        pairs = [(0, least), ((1 << bits) - 1, -least - 1)]
        pairs += [(v, w + least) for v, w in zip(drawn[:3], drawn[3:], strict=True)]
        packets = [Bits().add(0, phase).add(u, bits).add(i, bits).packed() for u, i in pairs]
        columns = decoded(text, packets).tables["P"].columns
        assert list(zip(columns["A"].to_list(), columns["B"].to_list(), strict=True)) == pairs
        assert columns["A"].raw.dtype == (np.uint64 if bits == 64 else np.int64)
        assert columns["B"].raw.dtype == np.int64


def test_other_signs_are_read():
    types = integer("ONES", 9, "onesComplement") + integer("SIGN", 9, "signMagnitude")
    for value in (-255, -1, 0, 1, 255):
        ones = value if value >= 0 else ~-value & 0x1FF
        sign = value if value >= 0 else 0x100 | -value
        assert one(Bits().add(ones, 9).add(sign, 9).packed(), types, A="ONES", B="SIGN") == {"A": [value], "B": [value]}


# The examples of MIL-STD-1750A for 32 and 48 bits, and the least positive step of 48 bits at exponent 0 by hand
MIL_STD_1750A = """
7FFFFF7F 0.9999998807907104 127, 4000007F 0.5 127, 50000004 0.625 4, 40000001 0.5 1, 40000000 0.5 0, 400000FF 0.5 -1,
40000080 0.5 -128, 00000000 0 0, 80000000 -1 0, BFFFFF80 -0.5000001192092896 -128, 9FFFFF04 -0.7500001192092896 4,
4000007F0000 0.5 127, 400000000000 0.5 0, 400000FF0000 0.5 -1, 400000800000 0.5 -128, 8000007F0000 -1 127,
800000000000 -1 0, 800000FF0000 -1 -1, 800000800000 -1 -128, 000000000000 0 0, A00000FF0000 -0.75 -1,
000000000001 1 -39
"""


@mark.parametrize("row", MIL_STD_1750A.split(","))
def test_floats_of_mil_std_1750a_are_those_of_the_standard(row):
    octets, mantissa, exponent = row.split()
    data = bytes.fromhex(octets)
    found = one(data, floating("M", 8 * len(data), "MILSTD_1750A"), A="M")
    assert found["A"] == [float(mantissa) * 2.0 ** int(exponent)]


@mark.parametrize("bits", [16, 32, 64])
@mark.parametrize("phase", [0, 3])
def test_ieee_floats_stand_at_every_place(bits, phase):
    code = {16: "e", 32: "f", 64: "d"}[bits]
    types = floating("F", bits) + floating("L", bits, order=foreign.LITTLE) + integer("PAD", 3)
    parameters = {**({"P": "PAD"} if phase else {}), "A": "F", "B": "L"}
    for value in (0.0, -1.5, math.inf, 2.0**-14, 65504.0):
        packed = Bits().add(0, phase).octets(struct.pack(f">{code}", value)).octets(struct.pack(f"<{code}", value))
        found = one(packed.packed(), types, **parameters)
        assert found["A"] == found["B"] == [value]


def test_a_value_outside_its_spline_is_unknown_and_keeps_its_raw_value_unless_extrapolated():
    points = [(20.0, 3.0), (10.0, 1.0), (40.0, 5.0)]
    steps, lines, on = (
        calibrated("T", 8, "unsigned", default(foreign.spline(points, order, extrapolate)))
        for order, extrapolate in ((0, False), (1, False), (1, True))
    )
    packets = [bytes((k,)) for k in (9, 10, 19, 20, 25, 40, 41)]

    def read(types):
        return values(layout(types, A="T"), packets)["A"]

    assert read(steps) == approx([nan, 1.0, 1.0, 3.0, 3.0, 5.0, nan], nan_ok=True)
    assert read(lines) == approx([nan, 1.0, 2.8, 3.0, 3.5, 5.0, nan], nan_ok=True)
    assert read(on) == approx([0.8, 1.0, 2.8, 3.0, 3.5, 5.0, 5.1], rel=1e-15)
    found = decoded(layout(lines, A="T"), packets)
    assert found.counts()["decoded"] == 7 and found.values_unknown() == {"A": 2}
    assert found.tables["P"].columns["A"].to_list(raw=True) == [9, 10, 19, 20, 25, 40, 41]
    text = layout(lines, child(comparison("A", 1.0, "!=")), A="T")
    assert decoded(text, packets).tables["Q"].packet_index.tolist() == [2, 3, 4, 5]  # nothing is known of the others


def test_splines_of_yamcs_are_extrapolated_and_its_sizes_before_texts_count_octets():
    spline = foreign.spline([(0, 0), (100, 10)], 1, False).replace(' extrapolate="false"', "")
    tagged = fixed_size(72, '<LeadingSize sizeInBitsOfSizeTag="8"/>')
    text = layout(calibrated("T", 8, "unsigned", default(spline)) + text_type(tagged, name="S"), A="T", B="S")
    packet = bytes((200, 8)) + b"ABCDEFGH"
    others = decoded(text, [packet])
    assert values(text, [packet])["B"] == ["A"] and others.values_unknown() == {"A": 1}
    assert parse_xtce(text).remarks == ("sizes before texts count bits",)
    made = text.replace("<TelemetryMetaData>", "<!-- generated with Yamcs PyMDB --><TelemetryMetaData>")
    assert values(made, [packet]) == {"A": [20.0], "B": ["ABCDEFGH"]}
    assert parse_xtce(made).remarks == ("sizes before texts count octets", "splines are extrapolated, as Yamcs does")
    stated = Decoder(parse_xtce(text, "octets")).decode(*whole([packet]))
    assert stated.tables["P"].columns["B"].to_list() == ["ABCDEFGH"]


def test_a_code_without_a_name_stays_a_number_and_ranges_of_codes_share_one():
    text = layout(foreign.enumerated("E", 8, {1: "ONE", '10" maxValue="19': "TEENS"}), A="E")
    assert values(text, [bytes((k,)) for k in (0, 1, 2, 9, 10, 19, 20)])["A"] == [0, "ONE", 2, 9, "TEENS", "TEENS", 20]


# texts and octets


YAMCS_SIZE = dynamic("_yamcs_ignore")


def variable(octets, end):
    """A text of up to some octets that says itself where it ends, as Yamcs writes it."""
    return text_type(f'<Variable maxSizeInBits="{8 * octets}">{YAMCS_SIZE}{end}</Variable>')


def tagged(bits):
    return variable(100, f'<LeadingSize sizeInBitsOfSizeTag="{bits}"/>')


def test_a_text_may_say_its_length_itself():
    text = layout(tagged(16) + integer("N", 8), A="T", B="N")
    packets = [struct.pack(">H", len(t)) + t + b"\x07" for t in (b"", b"x", "µx".encode(), b"y" * 98)]
    assert values(text, packets) == {"A": ["", "x", "µx", "y" * 98], "B": [7] * 4}
    wrong = [
        struct.pack(">H", 99) + b"y" * 99 + b"\x07",  # beyond maxSizeInBits
        struct.pack(">H", 8) + b"y",  # beyond the packet
        struct.pack(">H", 2) + b"\xc3\x28\x07",  # not UTF-8
        b"\x00",
    ]
    assert verdicts(text, wrong) == ["decoded", "too_short", "decoded", "too_short"]
    assert values(text, wrong) == {"A": [None, None], "B": [7, 7]}
    assert decoded(text, wrong).tables["P"].columns["A"].to_list(raw=True)[1] == b"\0\2\xc3\x28"
    bits = Decoder(parse_xtce(text, "bits")).decode(*whole([struct.pack(">H", 12) + b"yyyy"]))
    assert bits.tables["P"].columns["A"].to_list() == [None]  # no whole octets


def test_octets_may_say_their_length_themselves_as_yamcs_writes_it():
    algorithm = '<AlgorithmText language="Java">org.yamcs.algo.LeadingSizeBinaryDecoder({})</AlgorithmText>'
    after = f'<FromBinaryTransformAlgorithm name="x">{algorithm.format(16)}</FromBinaryTransformAlgorithm>'
    text = layout(integer("N", 8) + binary(YAMCS_SIZE, after), b="B", n="N")
    assert values(text, [b"\0\0\7", b"\0\3abc\7"]) == {"b": [b"", b"abc"], "n": [7, 7]}
    assert verdicts(text, [b"\0", b"\0\3ab"]) == ["too_short", "too_short"]


def test_a_text_may_end_with_a_character_and_what_follows_begins_there():
    types = variable(10, "<TerminationChar>00</TerminationChar>") + integer("N", 8)
    text = layout(types, A="T", B="N")
    assert values(text, [b"\0\x05", b"ab\0\x06", b"abcdefghi\0\x07"]) == {"A": ["", "ab", "abcdefghi"], "B": [5, 6, 7]}
    assert verdicts(text, [b"abc", b"abcdefghijk\0\x07"]) == ["too_short", "malformed"]
    last = layout(types, A="T")
    assert values(last, [b"abc"])["A"] == ["abc"]  # the text fills what is left


def test_a_text_without_terminator_fills_its_field_and_one_of_two_octets_stands_at_a_character():
    text = layout(text_type(fixed_size(24, "<TerminationChar/>")) + integer("N", 8), A="T", B="N")
    packets = [b"ab\0\x07", b"abc\x07", b"\xc3\x28\0\x07"]
    assert values(text, packets) == {"A": ["ab", "abc", None], "B": [7] * 3}
    assert decoded(text, packets).values_unknown() == {"A": 1}
    size = fixed_size(64, "<TerminationChar>0000</TerminationChar>")
    data = "aĀ".encode("utf-16-be") + b"\0\0\0x"  # 00 61 01 00 00 00: the first two zeros are of two characters
    assert one(data, text_type(size, "UTF-16BE"), A="T")["A"] == ["aĀ"]


@mark.parametrize("charset", ["US-ASCII", "UTF-8", "ISO-8859-1", "UTF-16BE", "UTF-16LE"])
def test_zeros_at_the_end_of_a_text_belong_to_it(charset):
    text = layout(text_type(fixed_size(64), charset), A="T")
    expected = ["ab\0\0", "\0\0\0\0", "a\0b\0", "abcd"] * (2 if charset.startswith("UTF-16") else 1)
    if not charset.startswith("UTF-16"):
        expected = [one * 2 for one in expected]
    expected += [one.replace("\0", "z") for one in expected] * 3
    assert values(text, [one.encode(charset) for one in expected])["A"] == expected


def test_texts_that_begin_inside_an_octet_are_read_and_a_size_may_be_looked_up():
    types = integer("N", 3) + text_type(fixed_size(16)) + binary(13)
    found = one(Bits().add(5, 3).octets(b"hi").add(0x1ABC, 13).packed(), types, N="N", T="T", B="B")
    assert found == {"N": [5], "T": ["hi"], "B": [b"\x1a\xbc"]}
    lookup = "".join(
        f'<DiscreteLookup value="{bits}">{comparison("N", n)}</DiscreteLookup>' for n, bits in ((1, 8), (2, 24))
    )
    types = integer("N", 8) + binary(f"<DiscreteLookupList>{lookup}</DiscreteLookupList>")
    text = layout(types, N="N", B="B")
    packets = [b"\x01a", b"\x02abc", b"\x03abc"]
    assert values(text, packets)["B"] == [b"a", b"abc"]
    assert verdicts(text, packets) == ["decoded", "decoded", "malformed"]


# arrays and aggregates


def array_type(name, element, ending):
    return (
        f'<ArrayParameterType name="{name}" arrayTypeRef="{element}"><DimensionList>{ending}</DimensionList>'
        "</ArrayParameterType>"
    )


def dimension(parameter="", intercept=-1, last=0, first=0):
    ending = dynamic(parameter, intercept=intercept) if parameter else f"<FixedValue>{last}</FixedValue>"
    return (
        f"<Dimension><StartingIndex><FixedValue>{first}</FixedValue></StartingIndex>"
        f"<EndingIndex>{ending}</EndingIndex></Dimension>"
    )


def aggregate(name, members):
    listed = "".join(f'<Member name="{key}" typeRef="{kind}"/>' for key, kind in members.items())
    return f'<AggregateParameterType name="{name}"><MemberList>{listed}</MemberList></AggregateParameterType>'


ARRAY_ENTRY = '<ArrayParameterRefEntry parameterRef="{}"/>'.format


def test_arrays_of_aggregates_follow_their_count_as_in_the_pus_examples_of_yamcs():
    types = integer("N", 8) + integer("ID", 12) + integer("S", 4, "twosComplement")
    types += aggregate("ELEMENT", {"id": "ID", "status": "S"}) + array_type("REPORT", "ELEMENT", dimension("count"))
    body = container("P", ["count", ARRAY_ENTRY("report"), "end"])
    text = document(types, {"count": "N", "report": "REPORT", "end": "N"}, body)
    expected = [[(k * 100 + i, i % 16 - 8) for i in range(n)] for k, n in enumerate((3, 0, 1, 40))]
    packets = []
    for items in expected:
        bits = Bits().add(len(items), 8)
        for identity, status in items:
            bits.add(identity, 12).add(status, 4)
        packets.append(bits.octets(b"\xee").packed())
    table = decoded(text, packets).tables["P"]
    report = table.columns["report"]
    assert [[(e["id"], e["status"]) for e in row] for row in report.to_list()] == expected
    assert table.columns["end"].to_list() == [0xEE] * 4 and table.unread_bits.tolist() == [0] * 4
    assert isinstance(report, ArrayColumn) and report.counts.tolist() == [3, 0, 1, 40]


def test_elements_of_odd_width_begin_anywhere():
    text = layout(integer("N", 5) + integer("E", 11) + array_type("A", "E", dimension("n")), n="N", a="A", z="N")
    rng = default_rng(3)
    rows = [rng.integers(0, 2048, n).tolist() for n in (0, 1, 2, 7, 31)]
    packets = []
    for row in rows:
        bits = Bits().add(len(row), 5)
        for value in row:
            bits.add(value, 11)
        packets.append(bits.add(21, 5).packed())
    found = values(text, packets)
    assert found["a"] == rows and found["z"] == [21] * 5


def test_arrays_of_two_dimensions_are_lists_of_lists_the_last_index_moving_fastest():
    types = integer("N", 8) + array_type("A", "N", dimension("n") + dimension(last=4, first=3))
    assert one(bytes((3, 1, 2, 3, 4, 5, 6)), types, n="N", a="A")["a"] == [[[1, 2], [3, 4], [5, 6]]]


def test_elements_that_say_their_own_length_are_read_one_after_another():
    types = integer("N", 8) + tagged(8) + aggregate("ENTRY", {"key": "N", "text": "T"})
    types += array_type("A", "ENTRY", dimension("n"))
    text = layout(types, n="N", a="A", z="N")
    rows = [[], [(1, "a")], [(2, "bcd"), (3, ""), (4, "efghij")], [(5, "x" * 31)]]
    packets = [bytes((len(row),)) + b"".join(bytes((k, len(t))) + t.encode() for k, t in row) + b"\x63" for row in rows]
    broken = bytes((2, 9, 1, 65, 9, 25, 65))  # the second text is longer than the packet
    found = decoded(text, [*packets, broken])
    columns = found.tables["P"].columns
    assert [[(e["key"], e["text"]) for e in row] for row in columns["a"].to_list()] == rows
    assert columns["z"].to_list() == [0x63] * 4 and found.verdict.tolist() == [0, 0, 0, 0, 3]


def test_arrays_without_elements_are_empty_also_in_arrays():
    types = integer("N", 8) + array_type("A", "N", dimension("n"))
    types += aggregate("ROW", {"k": "N", "a": "A"}) + array_type("B", "ROW", dimension("n"))
    text = layout(types, n="N", b="B")
    assert values(text, [b"\0"])["b"] == [[]]
    two = values(text, [b"\0", bytes((2, 7, 1, 2, 8, 3, 4))])["b"]
    assert two == [[], [{"k": 7, "a": [1, 2]}, {"k": 8, "a": [3, 4]}]]
    types = integer("N", 8) + tagged(8) + array_type("A", "T", dimension("n"))
    text = layout(types, n="N", a="A")
    assert values(text, [b"\0", b"\0"])["a"] == [[], []]
    assert decoded(text, []).tables == {}


# layouts


def location(parameter, reference, place):
    place = place if isinstance(place, str) else f"<FixedValue>{place}</FixedValue>"
    return (
        f'<ParameterRefEntry parameterRef="{parameter}"><LocationInContainerInBits referenceLocation="{reference}">'
        f"{place}</LocationInContainerInBits></ParameterRefEntry>"
    )


def test_entries_may_stand_at_places_counted_from_the_start_or_from_the_entry_before():
    types = integer("N", 8) + integer("W", 16) + text_type(fixed_size(16))
    base = container(
        "BASE",
        [location("a", "containerStart", 8), location("b", "previousEntry", 8), location("c", "previousEntry", -24)],
    )
    child = container("P", ["t", location("d", "containerStart", 0), location("e", "previousEntry", 40)], "BASE")
    text = document(types, dict.fromkeys("abde", "N") | {"c": "W", "t": "T"}, base + child)
    assert values(text, [bytes((0, 1, 2, 65, 66, 5, 6, 7))]) == {
        "a": [1], "b": [65], "c": [0x0102], "t": ["AB"], "d": [0], "e": [6],
    }  # fmt: skip
    before = document(types, {"a": "N"}, container("P", [location("a", "previousEntry", -8)]))
    beyond = document(types, {"a": "N"}, container("P", [location("a", "containerStart", 800)]))
    assert verdicts(before, [b"abc"]) == verdicts(beyond, [b"abc"]) == ["too_short"]


def test_entries_under_a_condition_are_there_or_not():
    def under(parameter, *condition):
        inside = f"<IncludeCondition>{comparison(*condition)}</IncludeCondition>"
        return f'<ParameterRefEntry parameterRef="{parameter}">{inside}</ParameterRefEntry>'

    # as in the examples of space_packet_parser: two optional values before one that is always there
    types = integer("U8", 8) + integer("U16", 16) + integer("U32", 32)
    text = document(
        types,
        {"Mode": "U8", "Flag": "U8", "Data1": "U16", "Data2": "U16", "Always": "U32", "Last": "U8"},
        container("P", ["Mode", "Flag", under("Data1", "Mode", 1), under("Data2", "Flag", 1), "Always",
                        under("Last", "Data2", 500, ">")]),
    )  # fmt: skip
    packets = [
        struct.pack(">BBI", 0, 0, 9),
        struct.pack(">BBHI", 1, 0, 100, 8),
        struct.pack(">BBHI", 0, 1, 200, 7),
        struct.pack(">BBHHIB", 1, 1, 300, 600, 6, 5),
    ]
    table = decoded(text, packets).tables["P"]
    assert values(text, packets) == {
        "Mode": [0, 1, 0, 1], "Flag": [0, 0, 1, 1], "Data1": [None, 100, None, 300], "Data2": [None, None, 200, 600],
        "Always": [9, 8, 7, 6], "Last": [None, None, None, 5],
    }  # fmt: skip
    assert table.unread_bits.tolist() == [0] * 4 and isinstance(table.columns["Data1"], OptionalColumn)
    assert verdicts(text, [b"\x01\x00\x05", *packets]) == ["too_short", *["decoded"] * 4]


def test_an_entry_may_stand_at_a_place_that_the_packet_states():
    place = dynamic("n", slope=8)
    body = container("P", ["n", location("a", "containerStart", place), location("b", "previousEntry", place)])
    text = document(integer("N", 8), dict.fromkeys("nab", "N"), body)
    packets = [bytes((1, 2, 3, 4)), bytes((2, 9, 4, 5, 6, 7)), bytes((1, 2, 3)), bytes((9, 0, 0))]
    assert verdicts(text, packets) == ["decoded", "decoded", "too_short", "too_short"]
    assert values(text, packets) == {"n": [1, 2], "a": [2, 4], "b": [4, 7]}


@mark.parametrize("kind", [integer("A", 8), text_type(fixed_size(8), name="A")])
def test_repetitions_stand_apart_by_their_offset(kind):
    repeat = (
        f'<ParameterRefEntry parameterRef="a"><RepeatEntry><Count>{dynamic("n")}</Count>'
        "<Offset><FixedValue>8</FixedValue></Offset></RepeatEntry></ParameterRefEntry>"
    )
    text = document(integer("N", 8) + kind, {"n": "N", "a": "A", "z": "N"}, container("P", ["n", repeat, "z"]))
    packets = [b"\x03A.B.CZ", b"\x01AZ", b"\x00Z", b"\x02A.B", b"\x02A."]
    assert verdicts(text, packets) == ["decoded"] * 3 + ["too_short"] * 2
    right = [["A", "B", "C"], ["A"], []]
    found = values(text, packets[:3])
    assert [[c if isinstance(c, str) else chr(c) for c in row] for row in found["a"]] == right
    assert isinstance(found["a"][0][0], str) == ("String" in kind) and found["z"] == [ord("Z")] * 3


def test_a_container_in_a_container_begins_where_it_stands():
    part = container("PART", ["x", location("y", "containerStart", 8)])
    body = container("P", ["a", '<ContainerRefEntry containerRef="PART"/>', "z"])
    text = document(integer("N", 8), dict.fromkeys("axyz", "N"), part + body)
    assert values(text, [bytes((1, 2, 3, 4))]) == {"a": [1], "x": [2], "y": [3], "z": [4]}


def test_names_in_nested_systems_are_found_by_path_and_distinguished():
    inner = (
        '<SpaceSystem name="dt"><TelemetryMetaData><ParameterTypeSet>'
        + integer("u8", 8)
        + '</ParameterTypeSet></TelemetryMetaData></SpaceSystem><SpaceSystem name="PUS5"><TelemetryMetaData>'
        '<ParameterTypeSet><IntegerParameterType name="id" baseType="/dt/u8"/></ParameterTypeSet>'
        '<ParameterSet><Parameter name="x" parameterTypeRef="id"/><Parameter name="y" parameterTypeRef="../dt/u8"/>'
        '<Parameter name="w" parameterTypeRef="/BUS/dt/u8"/></ParameterSet>'
        "<ContainerSet>"
        + container("event", ["x", "y", "w"], "/root", comparison("/x", 7))
        + "</ContainerSet></TelemetryMetaData></SpaceSystem>"
    )
    text = document("", {"x": "dt/u8", "z": "dt/u8"}, container("root", ["x"], abstract=True), more=inner)
    expected = {"/BUS/x": [7], "/BUS/PUS5/x": [8], "y": [9], "w": [10]}
    assert values(text, [bytes((7, 8, 9, 10))], "event") == expected


def test_definitions_may_be_spread_over_documents():
    types = document(integer("u8", 8), {}, "", name="dt")
    packets = document("", {"x": "/dt/u8"}, container("P", ["x"]), name="PUS")
    found = Decoder(parse_xtce({"dt.xml": types, "pus.xml": packets})).decode(*whole([b"\x2a"]))
    assert found.tables["P"].columns["x"].to_list() == [42]


# what does not fit


OWN = {"N": "U8", "M": "U8"}


def test_a_packet_is_decoded_by_one_container_or_refused_with_the_reason():
    text = bus_like(
        OWN,
        container("A", ["N"], "CCSDSPacket", comparison("PKT_APID", 10, "<=")),
        container("B", ["N", "M"], "CCSDSPacket", comparison("PKT_APID", 10, ">=")),
    )
    rows = ((9, b"\1"), (10, b"\1\2"), (11, b"\1\2"), (11, b"\1"), (9, b"\1\2\3"))
    packets = [space_packet(*row, 0) for row in rows]
    found = decoded(text, packets)
    assert verdicts(text, packets) == ["decoded", "ambiguous", "decoded", "too_short", "decoded"]
    assert found.tables["A"].unread_bits.tolist() == [0, 16]
    assert found.counts() == {
        "decoded": 3, "no_container": 0, "ambiguous": 1, "too_short": 1, "malformed": 0, "damaged": 0,
    }  # fmt: skip
    only = bus_like(OWN, container("A", ["N"], "CCSDSPacket", comparison("PKT_APID", 9)))
    assert verdicts(only, packets[:3]) == ["decoded", "no_container", "no_container"]


def test_damaged_packets_are_left_out():
    octets, cut = whole([b"\x01", b"\x02"])
    damaged = PacketCut(cut.offsets, cut.lengths, np.array([True, False]), cut.skipped, cut.idle, cut.consumed)
    found = Decoder(parse_xtce(layout(integer("N", 8), a="N"))).decode(octets, damaged)
    assert found.tables["P"].columns["a"].to_list() == [1] and found.verdict.tolist() == [0, 5]


@mark.parametrize("count", [0, 1, 2, 255])
def test_an_array_cut_off_is_too_short_and_a_negative_count_malformed(count):
    text = layout(integer("N", 8) + integer("E", 32) + array_type("A", "E", dimension("n", intercept=-3)), n="N", a="A")
    full = bytes((count,)) + bytes(4 * max(count - 2, 0))
    expected = "malformed" if count < 2 else "decoded"
    assert verdicts(text, [full]) == [expected]
    if count > 2:
        assert verdicts(text, [full[:-1]]) == ["too_short"]


@mark.parametrize("slope, verdict", [(-8, "malformed"), (0.5, "malformed"), (1e300, "too_short"), (8, "decoded")])
def test_sizes_that_are_none_condemn_the_packet_alone(slope, verdict):
    text = layout(integer("N", 64) + binary(dynamic("n", slope=slope)), n="N", b="B")
    found = verdicts(text, [struct.pack(">Q", 3) + b"abc", struct.pack(">Q", 2**64 - 1) + b"abc"])
    assert found[0] == verdict and found[1] != "decoded"


def test_an_element_that_its_calibrator_does_not_cover_is_unknown_alone():
    element = calibrated("E", 8, "unsigned", default(foreign.spline([(0, 0), (100, 50)], 1, False)))
    text = layout(integer("N", 8) + element + array_type("A", "E", dimension("n")), n="N", a="A", z="N")
    packets = [bytes((2, 10, 20, 1)), bytes((3, 30, 101, 40, 2)), bytes((1, 100, 3)), bytes((0, 4))]
    assert verdicts(text, packets) == ["decoded"] * 4
    found = values(text, packets)
    assert found["z"] == [1, 2, 3, 4] and found["a"][0::2] == [[5.0, 10.0], [50.0]]
    assert found["a"][1] == approx([15.0, nan, 20.0], nan_ok=True)
    assert decoded(text, packets).values_unknown() == {"a": 1}


def test_every_truncation_of_every_packet_is_a_verdict():
    definition = parse_xtce(foreign.BUS)
    for packet in foreign.capture(12, 9):
        pieces = [packet[:n] for n in range(1, len(packet))]
        found = Decoder(definition).decode(*whole(pieces))
        # an event that is not urgent is whole without the value, and urgent ones are recognised by the missing value
        assert {VERDICTS[v] for v in found.verdict.tolist()} <= {"too_short", "malformed"}


def test_noise_is_decoded_or_given_a_verdict_and_never_stops_the_others():
    rng = default_rng(4)
    definition = parse_xtce(foreign.BUS)
    good = foreign.capture(50, 6)
    noise = [space_packet(int(rng.integers(100, 103)), rng.bytes(int(rng.integers(1, 200))), 0) for _ in range(500)]
    mixed = [p for pair in zip(good, noise[:50], strict=True) for p in pair] + noise[50:]
    assert Decoder(definition).decode(*whole(mixed)).verdict[0:100:2].tolist() == [0] * 50


def test_chunks_of_packets_are_joined(monkeypatch):
    monkeypatch.setattr("tmtc.xtce.decode._CHUNK", 7)
    packets = foreign.capture(100, 8)
    small = rows_of(decoded(foreign.BUS, packets), 100)
    monkeypatch.undo()
    assert small == rows_of(decoded(foreign.BUS, packets), 100)


def of_apid(name, apid, entries, *, abstract=True):
    """A first container of its own and one that continues it for packets of an APID, as OpenC3 writes them."""
    first = container(f"{name}_Base", [*HEADER, *entries], abstract=abstract)
    return first + container(name, [], f"{name}_Base", comparison("PKT_APID", apid))


def test_first_containers_are_distinguished_by_their_conditions():
    containers = of_apid("A", 1, ["N"]) + of_apid("B", 2, ["N", "M"]) + of_apid("C", 3, ["N"], abstract=False)
    text = document(HEADER_TYPES, {**HEADER_PARAMETERS, **OWN}, containers)
    packets = [space_packet(apid, data, 0) for apid, data in ((1, b"a"), (2, b"ab"), (3, b"c"), (4, b"d"), (2, b"x"))]
    found = decoded(text, packets)
    assert {name: table.packet_index.tolist() for name, table in found.tables.items()} == {
        "A": [0], "B": [1], "C": [2], "C_Base": [3],
    }  # fmt: skip
    assert verdicts(text, packets)[4] == "too_short"  # its APID is that of B
    same = parse_xtce(text.replace('value="2"', 'value="1"'))
    only = Decoder(same, ["A_Base", "B_Base"]).decode(*whole([*packets, space_packet(1, b"ab", 0)]))
    assert [VERDICTS[v] for v in only.verdict] == ["decoded", *["no_container"] * 4, "ambiguous"]


def test_the_first_of_several_containers_is_named_and_columns_of_numbers_are_arrays():
    text = layout(integer("N", 8), container("Q", ["a"]), a="N")
    with raises(DefinitionError, match=r"BUS: expected one container without a base, found 2 \(P, Q\)"):
        decoded(text, [b"\x01"])
    with raises(DefinitionError, match="expected the name of a container"):
        decoded(text, [b"\x01"], "R")
    assert list(decoded(text, [b"\x01"], "Q").tables) == ["Q"]
    column = decoded(foreign.BUS, foreign.capture(30, 1)).tables["Housekeeping"].columns["VOLTAGE"]
    assert isinstance(column, ValueColumn)
    assert column.values.dtype == np.float64 and column.raw.dtype == np.int64
    assert np.array_equal(column.values, column.raw * 0.25 - 1.5)
    assert list(HEADER) == list(HEADER_PARAMETERS)


def parts(apid, first_count, *pieces, flags=()):
    """Parts of a segmented packet: the first alone has a secondary header."""
    chosen = flags or (1, *[0] * (len(pieces) - 2), 2)
    return [
        struct.pack(">HHH", apid | (0x0800 if k == 0 else 0), flag << 14 | (first_count + k) % 16384, len(piece) - 1)
        + piece
        for k, (piece, flag) in enumerate(zip(pieces, chosen, strict=True))
    ]


def stream_of(packets, checksum_octets=0):
    """(index, a, b) of decoded packets of a stream, and the verdict of each packet."""
    body = container("P", ["a", "b"], "CCSDSPacket", comparison("VERSION", 0))
    text = bus_like({"a": "U16", "b": "U32"}, body)
    octets, cut = whole(packets)
    found = Decoder(parse_xtce(text)).decode(
        octets, cut, primary_headers(octets, cut), whole_stream=True, checksum_octets=checksum_octets
    )
    rows = []
    if table := found.tables.get("P"):
        columns = (table.columns[name].to_list() for name in "ab")
        rows = list(zip(table.packet_index.tolist(), *columns, strict=True))
    return rows, [VERDICTS[v] for v in found.verdict.tolist()]


def test_parts_of_packets_are_joined_also_over_the_end_of_the_counts_each_with_its_checksum():
    one = parts(5, 16383, b"\x00", b"\x01\x00\x00", b"\x00\x02")
    two = parts(6, 3, b"\x00\x03\x00\x00\x00", b"\x04")
    whole_one = space_packet(7, b"\x00\x05\x00\x00\x00\x06", 0)
    found, verdict = stream_of([one[0], whole_one, two[0], one[1], two[1], one[2]])
    assert found == [(0, 1, 2), (1, 5, 6), (2, 3, 4)]
    assert verdict == [*["decoded"] * 3, *["segments_joined"] * 3]
    found, _ = stream_of(parts(5, 0, b"\x00\x01CC", b"\x00\x00CC", b"\x00\x02CC"), checksum_octets=2)
    assert found == [(0, 1, 2)]


def test_a_part_that_was_sent_twice_is_joined_once():
    one = parts(5, 7, b"\x00", b"\x01\x00\x00", b"\x00\x02")
    assert stream_of([one[0], one[1], one[1], one[2]]) == ([(0, 1, 2)], ["decoded", *["segments_joined"] * 3])
    other = one[1][:-1] + b"\x09"
    assert stream_of([one[0], one[1], other, one[2]]) == ([], ["segments_not_joined"] * 4)
    assert stream_of([one[0], one[1], one[1]]) == ([], ["segments_not_joined"] * 3)


def test_parts_that_make_no_packet_are_counted_and_not_decoded():
    def all_of_them_alone(packets):
        return stream_of(packets) == ([], ["segments_not_joined"] * len(packets))

    three = parts(5, 0, b"\x00\x01", b"\x00\x00", b"\x00\x02")
    assert all_of_them_alone(three[:2]) and all_of_them_alone(three[1:]) and all_of_them_alone(three[::2])
    assert all_of_them_alone(three[::-1])
    headed = bytes((three[2][0] | 8,)) + three[2][1:]  # the length of its secondary header is not known
    assert all_of_them_alone([*three[:2], headed])
    assert stream_of([*three[:2], *parts(5, 2, b"\x00\x07\x00", b"\x00\x00\x08")])[0] == [(2, 7, 8)]
