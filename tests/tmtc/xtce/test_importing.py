"""XTCE documents that are damaged, hostile or beyond the subset: one line each, and nothing guessed."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from tests.tmtc import foreign
from tests.tmtc.foreign import calibrated, comparison, container, default, document, floating, integer, polynomial
from tests.tmtc.xtce.test_decode import ARRAY_ENTRY, aggregate, array_type, dimension, text_type, whole
from tmtc.errors import DefinitionError
from tmtc.xtce import nodes
from tmtc.xtce.decode import Decoder
from tmtc.xtce.definition import IntegerEncoding, Polynomial, ScalarType
from tmtc.xtce.importing import parse_xtce

U8 = integer("u8", 8)
PLAIN = container("P", ["a"])


def refused(text: str | bytes) -> str:
    with pytest.raises(DefinitionError) as caught:
        parse_xtce({"bus.xml": text})
    message = str(caught.value)
    assert "\n" not in message and message.startswith("bus.xml")
    assert "expected" in message and "found" in message and len(message) < 400
    return message


def of_type(types: str) -> str:
    return document(types, {"a": "t"}, PLAIN)


# the document


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_document_cut_off_is_refused(share):
    octets = foreign.BUS.encode()
    assert "well-formed XML" in refused(octets[: int(len(octets) * share)])


def test_document_types_and_with_them_entities_are_refused_before_they_are_read():
    bomb = '<!ENTITY a "ha">' + "".join(f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">' for k in range(12))
    laughs = f'<?xml version="1.0"?><!DOCTYPE lolz [{bomb}]><SpaceSystem name="&m;"/>'
    assert "document type declaration" in refused(laughs)
    external = '<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/hostname">]><SpaceSystem name="&e;"/>'
    assert "document type declaration" in refused(external)
    assert "document type declaration" in refused('<!DOCTYPE x SYSTEM "http://localhost/x.dtd"><SpaceSystem name="x"/>')
    assert "well-formed" in refused('<SpaceSystem name="&e;"/>')


def test_elements_of_another_namespace_are_not_passed_over():
    text = document(U8, {"a": "u8"}, '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="x.xml"/>' + PLAIN)
    assert "namespace" in refused(text)


def test_documents_are_bounded_in_depth_number_and_size(monkeypatch):
    assert "deep" in refused(document("", {}, "<a>" * 200 + "</a>" * 200))
    monkeypatch.setattr(nodes, "MAX_ELEMENTS", 100)
    assert "at most 100 elements" in refused(foreign.BUS)
    monkeypatch.setattr(nodes, "MAX_OCTETS", 1000)
    assert "at most 1000 octets" in refused(foreign.BUS)


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "well-formed"),
        ("<SpaceSystem", "well-formed"),
        ('<?xml version="1.0" encoding="klingon"?><SpaceSystem name="x"/>', "encoding"),
        ('<TelemetryMetaData name="x"/>', "a SpaceSystem"),
        ("<SpaceSystem/>", "an attribute name"),
        ('<SpaceSystem name="x"/>', "a container without a base"),
        ('<SpaceSystem name="x"><Surprise/></SpaceSystem>', "Surprise, which is not"),
    ],
)
def test_other_documents_are_refused(text, words):
    assert words in refused(text.encode() if "klingon" in text else text)


def test_octets_of_other_encodings_are_read():
    text = document(U8, {"a": "u8"}, PLAIN).replace("UTF-8", "UTF-16")
    assert list(parse_xtce(text.encode("utf-16")).roots) == ["P"]


# references


@pytest.mark.parametrize(
    "text, words",
    [
        (document(U8, {"a": "u9"}, PLAIN), "Parameter 'a': expected the name of a parameter type, found 'u9'"),
        (document(U8, {}, PLAIN), "expected the name of a parameter, found 'a'"),
        (document(U8, {"a": "/x/u8"}, PLAIN), "found '/x/u8'"),
        (document(U8, {"a": "../../u8"}, PLAIN), "found '../../u8'"),
        (document(U8, {"a": "u8"}, container("P", ["a"], "Q")), "the name of a container, found 'Q'"),
        (document(U8, {"a": "u8"}, PLAIN + container("Q", [], "P", comparison("b", 1))), "found 'b'"),
        (document(U8, {"a": "u8"}, PLAIN + container("Q", [], "P", comparison("a.x", 1))), "member of 'u8', found 'x'"),
        (document(U8 + U8, {"a": "u8"}, PLAIN), "a unique name"),
        (document(U8, {"a": "u8"}, PLAIN + PLAIN), "a unique name"),
        (
            document(U8, {"a": "u8", "b": "u8"}, PLAIN + container("Q", ["b"], "P", comparison("b", 1))),
            "parameters that stand before, found 'b'",
        ),
    ],
)  # fmt: skip
def test_references_to_nothing_are_refused(text, words):
    assert words in refused(text)


def test_a_size_that_stands_behind_what_it_measures_is_refused():
    size = "<SizeInBits><DynamicValue><ParameterInstanceRef parameterRef='n'/></DynamicValue></SizeInBits>"
    types = U8 + f'<BinaryParameterType name="b"><BinaryDataEncoding>{size}</BinaryDataEncoding></BinaryParameterType>'
    assert "stand before, found 'n'" in refused(document(types, {"n": "u8", "b": "b"}, container("P", ["b", "n"])))


@pytest.mark.parametrize(
    "text, words",
    [
        (document(U8, {"a": "u8"}, container("P", ["a"], "P")), "found itself"),
        (document(U8, {"a": "u8"}, container("P", ["a"], "Q") + container("Q", [], "P")), "found itself"),
        (
            document(U8, {"a": "u8"}, PLAIN + "".join(container(x, [], y) for x, y in ("XY", "YZ", "ZX"))),
            "found itself",
        ),
        (document(U8, {"a": "u8"}, container("P", ['<ContainerRefEntry containerRef="P"/>'])), "in itself"),
        (
            document(
                U8,
                {"a": "u8"},
                "".join(container(x, [f'<ContainerRefEntry containerRef="{y}"/>']) for x, y in ("PQ", "QP")),
            ),
            "in itself",
        ),
        (document(aggregate("t", {"x": "t"}), {"a": "t"}, PLAIN), "in itself"),
        (document(aggregate("t", {"x": "s"}) + aggregate("s", {"x": "t"}), {"a": "t"}, PLAIN), "in itself"),
        (document(array_type("t", "t", dimension(last=3)), {"a": "t"}, PLAIN), "in itself"),
        (of_type('<IntegerParameterType name="t" baseType="t"/>'), "again"),
        (of_type("".join(f'<FloatParameterType name="{x}" baseType="{y}"/>' for x, y in ("ts", "st"))), "again"),
        (of_type(calibrated("t", 8, "unsigned", "<ContextCalibratorList><ContextCalibrator><ContextMatch>"
            f"{comparison('a', 1)}</ContextMatch><Calibrator>{polynomial(1.0)}</Calibrator></ContextCalibrator>"
            "</ContextCalibratorList>")), "useCalibratedValue false"),
    ],
)  # fmt: skip
def test_what_contains_itself_is_refused(text, words):
    assert words in refused(text)


def test_types_that_multiply_are_refused_without_being_written_out():
    # ten members of ten members of …: 10^12 values
    types = U8 + aggregate("t0", {f"m{k}": "u8" for k in range(10)})
    types += "".join(aggregate(f"t{n}", {f"m{k}": f"t{n - 1}" for k in range(10)}) for n in range(1, 12))
    assert "at most 100000 values" in refused(document(types, {"a": "t11"}, PLAIN))
    inside = container("C0", ["a"] * 10) + "".join(
        container(f"C{n}", [f'<ContainerRefEntry containerRef="C{n - 1}"/>'] * 10) for n in range(1, 12)
    )
    assert "at most 100000 values" in refused(document(U8, {"a": "u8"}, inside))


def test_long_chains_of_inheritance_are_read_and_endless_ones_refused():
    def chain(count: int) -> str:
        links = "".join(container(f"C{k}", ["a"], f"C{k - 1}") for k in range(1, count))
        return document(U8, {"a": "u8"}, container("C0", ["a"]) + links)

    found = Decoder(parse_xtce(chain(1500))).decode(*whole([bytes(range(250)) * 6]))
    assert list(found.tables) == ["C1499"] and found.tables["C1499"].columns["a"].to_list() == [249]
    assert "more than 2000 steps" in refused(chain(3000))


# values out of bounds


@pytest.mark.parametrize(
    "types, words",
    [
        (integer("t", 65), "sizeInBits of 1 to 64, found 65"),
        (integer("t", 0), "sizeInBits of 1 to 64, found 0"),
        (integer("t", -8), "sizeInBits of 1 to 64, found -8"),
        (integer("t", 10**30), "sizeInBits of 1 to 64"),
        (integer("t", 8).replace('Bits="8"', 'Bits="eight"'), "a whole number as sizeInBits, found 'eight'"),
        (integer("t", 8, "BCD"), "found BCD"),
        (integer("t", 12, order=foreign.LITTLE), "whole octets"),
        (integer("t", 8, order="middle"), "byteOrder"),
        (integer("t", 8).replace("encoding=", 'bitOrder="leastSignificantBitFirst" encoding='), "bitOrder"),
        (integer("t", 8, inner="<Checksum/>"), "Checksum, which is not"),
        (integer("t", 8).replace("IntegerDataEncoding", "StringDataEncoding"), "expected one of IntegerDataEncoding"),
        (floating("t", 80), "sizeInBits 16, 32 or 64"),
        (floating("t", 64, "MILSTD_1750A"), "sizeInBits 32 or 48"),
        (floating("t", 32, "DEC"), "found DEC"),
        ('<IntegerParameterType name="t"/>', "expected a data encoding, found none"),
        ('<MysteryParameterType name="t"/>', "MysteryParameterType, which is not"),
        (calibrated("t", 8, "unsigned", default("<MathOperationCalibrator/>")), "MathOperationCalibrator, which"),
        (calibrated("t", 8, "unsigned", default("<PolynomialCalibrator/>")), "a Term"),
        (calibrated("t", 8, "unsigned", default(polynomial(float("nan")))), "a finite number as coefficient"),
        (
            calibrated("t", 8, "unsigned", default(polynomial(1.0).replace('exponent="0"', 'exponent="-1"'))),
            "an exponent of 0 to 30, found -1",
        ),
        (calibrated("t", 8, "unsigned", default(foreign.spline([(1, 1)], 1, True))), "two points"),
        (calibrated("t", 8, "unsigned", default(foreign.spline([(1, 2), (1, 1)], 1, True))), "value, found two"),
        (calibrated("t", 8, "unsigned", default(foreign.spline([(1, 1), (2, 1)], 3, True))), "order 0 or 1"),
        (text_type(foreign.fixed_size(-8), name="t"), "found -8"),
        (text_type(foreign.fixed_size(999_999_999_999), name="t"), "found 999999999999"),
        (text_type("<SizeInBits/>", name="t"), "a size of the text"),
        (text_type("", name="t"), "either SizeInBits or Variable, found neither"),
        (text_type(foreign.fixed_size(8), "EBCDIC", "t"), "EBCDIC"),
        (
            text_type("<SizeInBits><TerminationChar>0000</TerminationChar></SizeInBits>", name="t"),
            "one character of UTF-8, found '0000'",
        ),
        (
            '<BinaryParameterType name="t"><BinaryDataEncoding><SizeInBits><FixedValue>-1</FixedValue></SizeInBits>'
            "</BinaryDataEncoding></BinaryParameterType>",
            "found -1",
        ),
        (
            '<BinaryParameterType name="t"><BinaryDataEncoding><SizeInBits><FixedValue>8</FixedValue></SizeInBits>'
            "<FromBinaryTransformAlgorithm/></BinaryDataEncoding></BinaryParameterType>",
            "FromBinaryTransformAlgorithm, which is not",
        ),
        (
            '<EnumeratedParameterType name="t"><IntegerDataEncoding sizeInBits="2"/><EnumerationList>'
            '<Enumeration value="4" label="x"/></EnumerationList></EnumeratedParameterType>',
            "codes of 0 to 3, found 4 to 4",
        ),
        (
            '<EnumeratedParameterType name="t"><IntegerDataEncoding sizeInBits="8"/><EnumerationList>'
            '<Enumeration value="1" maxValue="5" label="x"/><Enumeration value="4" label="y"/></EnumerationList>'
            "</EnumeratedParameterType>",
            "one name for each code, found two for 4",
        ),
        (aggregate("t", {}), "expected a member, found none"),
        (U8 + array_type("t", "u8", dimension(last=10**9)), "found 1000000000"),
        (U8 + array_type("t", "u8", dimension(last=500_000, first=-500_000)), "elements, found 1000001"),
        (U8 + array_type("t", "u8", dimension(last=-5)), "found -4"),
        (U8 + array_type("t", "u8", ""), "1 to 4 dimensions"),
    ],
)  # fmt: skip
def test_types_beyond_the_subset_or_their_bounds_are_refused_by_name(types, words):
    assert words in refused(of_type(types))


@pytest.mark.parametrize(
    "entry, words",
    [
        ('<StreamSegmentEntry streamRef="x"/>', "StreamSegmentEntry"),
        ('<ParameterSegmentRefEntry parameterRef="a" sizeInBits="4"/>', "ParameterSegmentRefEntry"),
        (
            '<ParameterRefEntry parameterRef="a"><RepeatEntry><Count><FixedValue>2</FixedValue></Count>'
            '<Offset><DynamicValue><ParameterInstanceRef parameterRef="a"/></DynamicValue></Offset></RepeatEntry>'
            "</ParameterRefEntry>",
            "Offset: expected a FixedValue between repetitions, found DynamicValue",
        ),
        (
            '<ParameterRefEntry parameterRef="a"><LocationInContainerInBits referenceLocation="containerEnd">'
            "<FixedValue>0</FixedValue></LocationInContainerInBits></ParameterRefEntry>",
            "containerEnd",
        ),
        (
            '<ParameterRefEntry parameterRef="a"><LocationInContainerInBits><DynamicValue/></LocationInContainerInBits>'
            "</ParameterRefEntry>",
            "expected an element ParameterInstanceRef, found none",
        ),
        (
            '<IndirectParameterRefEntry><ParameterInstance parameterRef="a"/></IndirectParameterRefEntry>',
            "expected an entry that is supported (ParameterRefEntry, ArrayParameterRefEntry, ContainerRefEntry), "
            "found IndirectParameterRefEntry",
        ),
        (ARRAY_ENTRY("a"), "an array"),
    ],
)
def test_entries_beyond_the_subset_are_refused_by_name(entry, words):
    assert words in refused(document(U8, {"a": "u8"}, container("P", [entry])))


MODES = (
    '<EnumeratedParameterType name="m"><IntegerDataEncoding sizeInBits="8"/><EnumerationList>'
    '<Enumeration value="1" label="ON"/></EnumerationList></EnumeratedParameterType>'
)


@pytest.mark.parametrize(
    "criteria, words",
    [
        (comparison("a", "one"), "a number, found 'one'"),
        (comparison("a", "1.5"), "a number, found '1.5'"),
        (comparison("a", 1, "~"), "an operator"),
        (comparison("b", 1), "a name of a code ('ON'), found '1'"),
        (comparison("b", "ON", ">"), "== or !="),
        ("<CustomAlgorithm/>", "CustomAlgorithm, which is not"),
        ("<NextContainer/>", "NextContainer, which is not"),
        ("<ComparisonList/>", "a Comparison"),
        (comparison("a", 1) + comparison("a", 2), "one of Comparison, ComparisonList, BooleanExpression, found 2"),
        ("<BooleanExpression><ANDedConditions/></BooleanExpression>", "a condition, found none"),
        (
            "<BooleanExpression><Condition><ParameterInstanceRef parameterRef='a'/>"
            "<ComparisonOperator>==</ComparisonOperator></Condition></BooleanExpression>",
            "two sides",
        ),
    ],
)
def test_conditions_beyond_the_subset_are_refused_by_name(criteria, words):
    text = document(U8 + MODES, {"a": "u8", "b": "m"}, container("P", ["a", "b"]) + container("Q", [], "P", criteria))
    assert words in refused(text)


def test_conditions_are_joined_and_compared_as_written():
    def side(parameter: str) -> str:
        return f'<ParameterInstanceRef parameterRef="{parameter}" useCalibratedValue="false"/>'

    def condition(left: str, operator: str, right: str) -> str:
        other = side(right) if right.isalpha() else f"<Value>{right}</Value>"
        operator = operator.replace("<", "&lt;")
        return f"<Condition>{side(left)}<ComparisonOperator>{operator}</ComparisonOperator>{other}</Condition>"

    inner = f"<ORedConditions>{condition('a', '<', 'b')}{condition('b', '==', '0')}</ORedConditions>"
    joined = f"<ANDedConditions>{condition('a', '!=', '5')}{inner}</ANDedConditions>"
    expression = f"<BooleanExpression>{joined}</BooleanExpression>"
    text = document(U8, dict.fromkeys("ab", "u8"), container("P", ["a", "b"]) + container("Q", [], "P", expression))
    pairs = [(a, b) for a in range(8) for b in range(8)]
    found = Decoder(parse_xtce(text)).decode(*whole([bytes(pair) for pair in pairs]))
    expected = [k for k, (a, b) in enumerate(pairs) if a != 5 and (a < b or b == 0)]
    assert found.tables["Q"].packet_index.tolist() == expected
    assert len(found.tables["P"]) == 64 - len(expected)


@pytest.mark.parametrize(
    "operator, expected",
    [("==", [3]), ("!=", [1, 2, 4]), ("<", [1, 2]), ("<=", [1, 2, 3]), (">", [4]), (">=", [3, 4]), ("geq", [3, 4])],
)
@pytest.mark.parametrize(
    "types", [integer("t", 8), integer("t", 64), calibrated("t", 8, "unsigned", default(polynomial(0.0, 0.5)))]
)
def test_comparisons_mean_what_they_say(operator, expected, types):
    value, width = ("3", 1) if "<PolynomialCalibrator" not in types else ("1.5", 1)
    width = 8 if 'sizeInBits="64"' in types else width
    text = document(types, {"a": "t"}, PLAIN + container("Q", [], "P", comparison("a", value, operator)))
    found = Decoder(parse_xtce(text)).decode(*whole([k.to_bytes(width, "big") for k in range(1, 5)]))
    values = found.tables["Q"].columns["a"].to_list(raw=True)
    assert values == expected


@pytest.mark.parametrize("operator, expected", [("==", [1]), ("!=", [0, 2])])
def test_names_of_codes_are_compared(operator, expected):
    text = document(MODES, {"a": "m"}, PLAIN + container("Q", [], "P", comparison("a", "ON", operator)))
    found = Decoder(parse_xtce(text)).decode(*whole([b"\0", b"\1", b"\2"]))
    assert found.tables["Q"].packet_index.tolist() == expected


@pytest.mark.parametrize("spelling", ["IEEE-754", "IEEE754", "IEEE754_1985"])
def test_floats_are_known_by_their_older_names(spelling):
    text = document(floating("f", 32, spelling), {"a": "f"}, PLAIN)
    assert Decoder(parse_xtce(text)).decode(*whole([b"\x3f\xc0\0\0"])).tables["P"].columns["a"].to_list() == [1.5]


def test_comparisons_hold_over_the_whole_of_64_bits():
    value = 2**64 - 2
    text = document(integer("t", 64), {"a": "t"}, PLAIN + container("Q", [], "P", comparison("a", value)))
    packets = [k.to_bytes(8, "big") for k in (value - 1, value, value + 1, 2**63)]
    assert Decoder(parse_xtce(text)).decode(*whole(packets)).tables["Q"].packet_index.tolist() == [1]
    beyond = document(integer("t", 64), {"a": "t"}, PLAIN + container("Q", [], "P", comparison("a", 2**70, "<")))
    assert len(Decoder(parse_xtce(beyond)).decode(*whole(packets)).tables["Q"]) == 4


def test_members_of_aggregates_and_booleans_are_compared():
    flag = '<BooleanParameterType name="f"><IntegerDataEncoding sizeInBits="4"/></BooleanParameterType>'
    types = integer("n", 4) + flag + aggregate("t", {"kind": "n", "on": "f"})
    text = document(
        types,
        {"a": "t"},
        PLAIN
        + container("Q", [], "P", comparison("a.kind", 3))
        + container("R", [], "P", comparison("a.on", "True", "!=")),
    )
    found = Decoder(parse_xtce(text)).decode(*whole([b"\x31", b"\x30", b"\x20", b"\x21"]))
    assert {name: table.packet_index.tolist() for name, table in found.tables.items()} == {"Q": [0], "R": [2], "P": [3]}
    assert found.verdict.tolist() == [0, 2, 0, 0]


# spellings of other tools


def test_a_document_of_yamcs_pymdb_is_read_to_the_values_of_yamcs():
    """Members of aggregates with `/`, a container with a size, names of booleans, points in any order."""
    flag = (
        '<BooleanParameterType name="f" zeroStringValue="Absent" oneStringValue="Present">'
        '<IntegerDataEncoding sizeInBits="1"/></BooleanParameterType>'
    )
    types = flag + integer("u7", 7) + integer("u8", 8) + aggregate("id", {"flag": "f", "kind": "u7"})
    size = "<BinaryEncoding><SizeInBits><FixedValue>16</FixedValue></SizeInBits></BinaryEncoding><EntryList>"
    part = '<ContainerRefEntry containerRef="part"/>'

    def criteria(member: str, value: str) -> str:
        return (
            f'<BooleanExpression><Condition><ParameterInstanceRef parameterRef="{member}"/>'
            f"<ComparisonOperator>==</ComparisonOperator><Value>{value}</Value></Condition></BooleanExpression>"
        )

    text = document(
        types,
        {"id": "id", "a": "u8", "b": "u8"},
        container("part", ["a"]).replace("<EntryList>", size)
        + container("head", ["id"], abstract=True).replace("<EntryList>", size)
        + container("P", [part, "b"], "head", criteria("id/kind", "3.0"))
        + container("Q", ["b"], "P", criteria("/BUS/id/flag", "Present")),
    )
    found = Decoder(parse_xtce(text)).decode(*whole([bytes((0x83, 1, 0, 2, 9)), bytes((0x03, 5, 0, 6))]))
    assert {name: table.columns["b"].to_list() for name, table in found.tables.items()} == {"P": [6], "Q": [9]}
    assert "a member of 'id', found 'sort'" in refused(text.replace("id/kind", "id/sort"))


def test_entries_are_repeated_as_arrays():
    def repeated(entry: str, count: str) -> str:
        return entry.replace("/>", f"><RepeatEntry><Count>{count}</Count></RepeatEntry></{entry[1:].split()[0]}>")

    three = "<FixedValue>3</FixedValue>"
    dynamic = "<DynamicValue><ParameterInstanceRef parameterRef='n'/></DynamicValue>"
    entries = [
        "n",
        repeated('<ParameterRefEntry parameterRef="a"/>', three),
        repeated('<ContainerRefEntry containerRef="R"/>', dynamic),
        "z",
    ]
    text = document(
        U8, dict.fromkeys(["n", "a", "b", "c", "z"], "u8"), container("R", ["b", "c"]) + container("P", entries)
    )
    columns = Decoder(parse_xtce(text)).decode(*whole([bytes((2, *range(10, 13), 1, 2, 3, 4, 9))])).tables["P"].columns
    assert {name: column.to_list()[0] for name, column in columns.items()} == {
        "n": 2, "a": [10, 11, 12], "R": [{"b": 1, "c": 2}, {"b": 3, "c": 4}], "z": 9,
    }  # fmt: skip
    later = container("Q", [], "P", comparison("a", 10))
    assert "stand before, found 'a'" in refused(text.replace("</ContainerSet>", f"{later}</ContainerSet>"))


def test_integers_and_booleans_may_be_stored_as_floats():
    types = floating("t", 32).replace("FloatParameterType", "IntegerParameterType")
    types += floating("f", 32).replace("FloatParameterType", "BooleanParameterType")
    text = document(types, {"a": "t", "b": "f"}, container("P", ["a", "b"]))
    columns = Decoder(parse_xtce(text)).decode(*whole([struct.pack(">ff", 42.0, 1.0)])).tables["P"].columns
    assert (columns["a"].to_list(), columns["b"].to_list()) == ([42.0], [True])


def test_octet_orders_may_be_listed():
    for order, value in (("3,2,1,0", 0x01020304), ("0,1,2,3", 0x04030201)):
        text = document(integer("t", 32, order=order), {"a": "t"}, PLAIN)
        columns = Decoder(parse_xtce(text)).decode(*whole([bytes((1, 2, 3, 4))])).tables["P"].columns
        assert columns["a"].to_list() == [value]
    assert "byteOrder" in refused(of_type(integer("t", 32, order="2,3,0,1")))


def test_elements_of_commands_cannot_refuse_a_document():
    more = '<CommandMetaData><MetaCommandSet><x:Odd xmlns:x="urn:x"/><Unknown/></MetaCommandSet></CommandMetaData>'
    assert list(parse_xtce(document(U8, {"a": "u8"}, PLAIN, more=more)).roots) == ["P"]


def test_alarms_that_are_not_read_are_counted():
    alarms = (
        "<DefaultAlarm><StaticAlarmRanges><WatchRange minInclusive='0'/><WarningRange minInclusive='0'/>"
        "<SevereRange maxInclusive='9'/></StaticAlarmRanges><ChangeAlarmRanges/></DefaultAlarm>"
        "<ContextAlarmList><ContextAlarm/><ContextAlarm/></ContextAlarmList>"
    )
    kind = integer("t", 8)
    end = kind.index("</IntegerParameterType>")
    definition = parse_xtce(of_type(kind[:end] + alarms + kind[end:] + integer("unused", 8)))
    assert definition.alarms_not_read == 4  # watch beside warning, changes, two in a context
    assert definition.remarks == ("alarms that are not read: 4",)
    inside = kind[:end] + alarms.replace("<StaticAlarmRanges>", "<StaticAlarmRanges rangeForm='inside'>") + kind[end:]
    assert parse_xtce(of_type(inside)).alarms_not_read == 6
    assert parse_xtce(of_type(kind)).alarms_not_read == 0


# what is passed over on purpose


def test_descriptions_alarms_algorithms_and_commands_change_nothing():
    types = (
        '<IntegerParameterType name="t" initialValue="3" signed="false" shortDescription="x">'
        "<LongDescription>y</LongDescription><AliasSet><Alias nameSpace='a' alias='b'/></AliasSet>"
        "<UnitSet><Unit>m</Unit></UnitSet>"
        '<IntegerDataEncoding sizeInBits="8">' + default(polynomial(1.0, 2.0)) + "</IntegerDataEncoding>"
        "<ToString/><ValidRange minInclusive='0'/><DefaultAlarm><StaticAlarmRanges/></DefaultAlarm>"
        "</IntegerParameterType>"
        "<UnusedParameterType name='never looked at'/>"
    )
    text = document(types, {"a": "t"}, PLAIN, more="<CommandMetaData><MetaCommandSet/></CommandMetaData>")
    text = text.replace("</ContainerSet>", "</ContainerSet><AlgorithmSet><CustomAlgorithm name='x'/></AlgorithmSet>")
    definition = parse_xtce(text)
    (parameter,) = definition.parameters.values()
    assert isinstance(parameter.type, ScalarType) and parameter.type.unit == "m"
    assert isinstance(parameter.type.encoding, IntegerEncoding)
    assert parameter.type.encoding.calibration.default == Polynomial(((1.0, 0), (2.0, 1)))
    column = Decoder(definition).decode(*whole([b"\x05"])).tables["P"].columns["a"]
    assert column.to_list() == [11.0] and np.array_equal(column.to_list(raw=True), [5])


def test_what_the_schema_allows_and_no_value_depends_on_is_no_reason_to_refuse():
    time = (
        '<RelativeTimeParameterType name="t"><Encoding units="s"><IntegerDataEncoding sizeInBits="8">'
        '<ErrorDetectCorrect><Parity type="Even" bitsFromReference="0" reference="start"/></ErrorDetectCorrect>'
        "</IntegerDataEncoding></Encoding><DefaultAlarm><StaticAlarmRanges/></DefaultAlarm>"
        "</RelativeTimeParameterType>"
    )
    octets = (
        '<BinaryParameterType name="o"><BinaryDataEncoding><ErrorDetectCorrect/><SizeInBits><FixedValue>8</FixedValue>'
        "</SizeInBits></BinaryDataEncoding></BinaryParameterType>"
    )
    body = container("P", ["a", "b"]).replace('abstract="false"', 'abstract=" false "')
    definition = parse_xtce(document(time + octets, {"a": "t", "b": "o"}, body))
    columns = Decoder(definition).decode(*whole([b"\x05\x06"])).tables["P"].columns
    assert columns["a"].to_list() == [5] and columns["b"].to_list() == [b"\x06"]


def test_points_of_a_spline_of_another_order_are_refused():
    points = '<SplinePoint raw="0" calibrated="1"/><SplinePoint order="1" raw="9" calibrated="2"/>'
    spline = f'<DefaultCalibrator><SplineCalibrator order="0">{points}</SplineCalibrator></DefaultCalibrator>'
    words = refused(document(calibrated("u8", 8, "unsigned", spline), {"a": "u8"}, container("P", ["a"])))
    assert "SplinePoint: expected order 0, that of the calibrator, found 1" in words
