"""XTCE documents that are damaged, hostile or beyond the subset: one line each, and nothing guessed."""

import struct

from pytest import mark, raises

from tests.tmtc import foreign
from tests.tmtc.foreign import (
    binary,
    calibrated,
    child,
    comparison,
    container,
    default,
    document,
    dynamic,
    enumerated,
    fixed_size,
    floating,
    integer,
    layout,
    polynomial,
    text_type,
)  # fmt: skip
from tests.tmtc.xtce.test_decode import ARRAY_ENTRY, aggregate, array_type, decoded, dimension, values
from tmtc.errors import DefinitionError
from tmtc.xtce import nodes
from tmtc.xtce.definition import IntegerEncoding, Polynomial, ScalarType
from tmtc.xtce.importing import parse_xtce

U8 = integer("u8", 8)
PLAIN = container("P", ["a"])
MODES = enumerated("m", 8, {1: "ON"})


def plain(*more):
    return layout(U8, *more, a="u8")


def refused(text):
    with raises(DefinitionError) as caught:
        parse_xtce({"bus.xml": text})
    message = str(caught.value)
    assert "\n" not in message and message.startswith("bus.xml")
    assert "expected" in message and "found" in message and len(message) < 400
    return message


def of_type(types):
    return layout(types, a="t")


def chosen(text, *packets):
    """Places of the packets of Q."""
    return decoded(text, packets).tables["Q"].packet_index.tolist()


# the document


@mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_document_cut_off_is_refused(share):
    octets = foreign.BUS.encode()
    assert "well-formed XML" in refused(octets[: int(len(octets) * share)])


def test_document_types_with_their_entities_and_other_namespaces_are_refused():
    bomb = '<!ENTITY a "ha">' + "".join(f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">' for k in range(12))
    for declared in (
        f"lolz [{bomb}]",
        'x [<!ENTITY e SYSTEM "file:///etc/hostname">]',
        'x SYSTEM "http://localhost/x.dtd"',
    ):
        text = f'<?xml version="1.0"?><!DOCTYPE {declared}><SpaceSystem name="&m;"/>'
        assert "document type declaration" in refused(text)
    assert "well-formed" in refused('<SpaceSystem name="&e;"/>')
    assert "namespace" in refused(plain('<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="x.xml"/>'))


def test_documents_are_bounded_in_depth_number_and_size(monkeypatch):
    assert "deep" in refused(document("", {}, "<a>" * 200 + "</a>" * 200))
    monkeypatch.setattr(nodes, "MAX_ELEMENTS", 100)
    assert "at most 100 elements" in refused(foreign.BUS)
    monkeypatch.setattr(nodes, "MAX_OCTETS", 1000)
    assert "at most 1000 octets" in refused(foreign.BUS)


OTHERS = """
 | well-formed
<SpaceSystem | well-formed
<?xml version="1.0" encoding="klingon"?><SpaceSystem name="x"/> | encoding
<TelemetryMetaData name="x"/> | a SpaceSystem
<SpaceSystem/> | an attribute name
<SpaceSystem name="x"/> | a container without a base
<SpaceSystem name="x"><Surprise/></SpaceSystem> | Surprise, which is not
"""


@mark.parametrize("row", OTHERS.strip("\n").splitlines())
def test_other_documents_are_refused(row):
    text, words = row.split(" | ")
    assert words in refused(text.encode())


def test_octets_of_other_encodings_are_read():
    assert list(parse_xtce(plain().replace("UTF-8", "UTF-16").encode("utf-16")).roots) == ["P"]


# references


@mark.parametrize(
    "text, words",
    [
        (layout(U8, a="u9"), "Parameter 'a': expected the name of a parameter type, found 'u9'"),
        (document(U8, {}, PLAIN), "expected the name of a parameter, found 'a'"),
        (layout(U8, a="/x/u8"), "found '/x/u8'"),
        (layout(U8, a="../../u8"), "found '../../u8'"),
        (document(U8, {"a": "u8"}, container("P", ["a"], "Q")), "the name of a container, found 'Q'"),
        (plain(child(comparison("b", 1))), "found 'b'"),
        (plain(child(comparison("a.x", 1))), "member of 'u8', found 'x'"),
        (layout(U8 + U8, a="u8"), "a unique name"),
        (plain(PLAIN), "a unique name"),
        (plain(container("Q", ["b"], "P", comparison("b", 1))).replace("</ParameterSet>",
            '<Parameter name="b" parameterTypeRef="u8"/></ParameterSet>'), "parameters that stand before, found 'b'"),
    ],
)  # fmt: skip
def test_references_to_nothing_are_refused(text, words):
    assert words in refused(text)


def test_a_size_that_stands_behind_what_it_measures_is_refused():
    assert "stand before, found 'n'" in refused(layout(U8 + binary(dynamic("n")), b="B", n="u8"))


INSIDE = '<ContainerRefEntry containerRef="{}"/>'.format


@mark.parametrize(
    "text, words",
    [
        (document(U8, {"a": "u8"}, container("P", ["a"], "P")), "found itself"),
        (document(U8, {"a": "u8"}, container("P", ["a"], "Q") + container("Q", [], "P")), "found itself"),
        (plain(*(container(x, [], y) for x, y in ("XY", "YZ", "ZX"))), "found itself"),
        (document(U8, {}, container("P", [INSIDE("P")])), "in itself"),
        (document(U8, {}, container("P", [INSIDE("Q")]) + container("Q", [INSIDE("P")])), "in itself"),
        (of_type(aggregate("t", {"x": "t"})), "in itself"),
        (of_type(aggregate("t", {"x": "s"}) + aggregate("s", {"x": "t"})), "in itself"),
        (of_type(array_type("t", "t", dimension(last=3))), "in itself"),
        (of_type('<IntegerParameterType name="t" baseType="t"/>'), "again"),
        (of_type("".join(f'<FloatParameterType name="{x}" baseType="{y}"/>' for x, y in ("ts", "st"))), "again"),
        (of_type(calibrated("t", 8, "unsigned", "<ContextCalibratorList><ContextCalibrator><ContextMatch>"
            f"{comparison('a', 1)}</ContextMatch><Calibrator>{polynomial(1.0)}</Calibrator></ContextCalibrator>"
            "</ContextCalibratorList>")), "useCalibratedValue false"),
    ],
)  # fmt: skip
def test_what_contains_itself_is_refused(text, words):
    assert words in refused(text)


def test_types_that_multiply_and_endless_inheritance_are_refused_and_long_chains_read():
    # ten members of ten members of …: 10^12 values
    types = U8 + aggregate("t0", {f"m{k}": "u8" for k in range(10)})
    types += "".join(aggregate(f"t{n}", {f"m{k}": f"t{n - 1}" for k in range(10)}) for n in range(1, 12))
    assert "at most 100000 values" in refused(layout(types, a="t11"))
    inside = "".join(container(f"C{n}", [INSIDE(f"C{n - 1}")] * 10) for n in range(1, 12))
    assert "at most 100000 values" in refused(document(U8, {"a": "u8"}, container("C0", ["a"] * 10) + inside))

    def chain(count):
        links = "".join(container(f"C{k}", ["a"], f"C{k - 1}") for k in range(1, count))
        return document(U8, {"a": "u8"}, container("C0", ["a"]) + links)

    found = decoded(chain(1500), [bytes(range(250)) * 6]).tables
    assert list(found) == ["C1499"] and found["C1499"].columns["a"].to_list() == [249]
    assert "more than 2000 steps" in refused(chain(3000))


# values out of bounds


TYPES = {
    "integer": integer("t", 8),
    "little": integer("t", 8, order=foreign.LITTLE),
    "float": floating("t", 32),
    "polynomial": calibrated("t", 8, "unsigned", default(polynomial(1.0))),
    "spline": calibrated("t", 8, "unsigned", default(foreign.spline([(1, 2), (2, 1)], 1, True))),
    "text": text_type(fixed_size(8), name="t"),
    "binary": binary(8, name="t"),
    "codes": enumerated("t", 2, {1: "x", 2: "y"}),
    "aggregate": aggregate("t", {"a": "u8"}),
    "array": array_type("t", "u8", dimension(last=7, first=-500_000)),
}
# type | what is replaced in it | by what | what the message says
FAULTS = """
integer | "8" | "65" | sizeInBits of 1 to 64, found 65
integer | "8" | "0" | sizeInBits of 1 to 64, found 0
integer | "8" | "-8" | sizeInBits of 1 to 64, found -8
integer | "8" | "1000000000000000000000000000000" | sizeInBits of 1 to 64
integer | "8" | "eight" | a whole number as sizeInBits, found 'eight'
integer | "unsigned" | "BCD" | found BCD
little | "8" | "12" | whole octets
little | leastSignificantByteFirst | middle | byteOrder
integer | encoding= | bitOrder="leastSignificantBitFirst" encoding= | bitOrder
integer | ></IntegerD | ><Checksum/></IntegerD | Checksum, which is not
integer | IntegerData | StringData | expected one of IntegerDataEncoding
float | "32" | "80" | sizeInBits 16, 32 or 64
float | "32" encoding="IEEE754" | "64" encoding="MILSTD_1750A" | sizeInBits 32 or 48
float | IEEE754 | DEC | found DEC
integer | * | <IntegerParameterType name="t"/> | expected a data encoding, found none
integer | * | <MysteryParameterType name="t"/> | MysteryParameterType, which is not
polynomial | <Poly | <MathOperationCalibrator/><Poly | MathOperationCalibrator, which
polynomial | <Term coefficient="1.0" exponent="0"/> |  | a Term
polynomial | "1.0" | "nan" | a finite number as coefficient
polynomial | "0" | "-1" | an exponent of 0 to 30, found -1
spline | <SplinePoint raw="2" calibrated="1"/> |  | two points
spline | raw="2" | raw="1" | value, found two
spline | order="1" | order="3" | order 0 or 1
text | >8< | >-8< | found -8
text | >8< | >999999999999< | found 999999999999
text | <Fixed><FixedValue>8</FixedValue></Fixed> |  | a size of the text
text | <SizeInBits><Fixed><FixedValue>8</FixedValue></Fixed></SizeInBits> |  | \
either SizeInBits or Variable, found neither
text | UTF-8 | EBCDIC | EBCDIC
text | <Fixed><FixedValue>8</FixedValue></Fixed> | <TerminationChar>0000</TerminationChar> | \
one character of UTF-8, found '0000'
binary | >8< | >-1< | found -1
binary | </BinaryD | <FromBinaryTransformAlgorithm/></BinaryD | FromBinaryTransformAlgorithm, which is not
codes | "2" label | "4" label | codes of 0 to 3, found 4 to 4
codes | "1" label | "1" maxValue="3" label | one name for each code, found two for 2
aggregate | <Member name="a" typeRef="u8"/> |  | expected a member, found none
array | >7< | >1000000000< | found 1000000000
array | >7< | >500000< | elements, found 1000001
array | >7< | >-500005< | found -4
array | * | <ArrayParameterType name="t" arrayTypeRef="u8"><DimensionList/></ArrayParameterType> | 1 to 4 dimensions
"""


@mark.parametrize("row", FAULTS.strip().splitlines())
def test_types_beyond_the_subset_or_their_bounds_are_refused_by_name(row):
    kind, old, new, words = row.split(" | ")
    assert old == "*" or old in TYPES[kind]
    assert words in refused(of_type(U8 + (new if old == "*" else TYPES[kind].replace(old, new))))


ENTRIES = f"""
<StreamSegmentEntry streamRef="x"/> | StreamSegmentEntry
<ParameterSegmentRefEntry parameterRef="a" sizeInBits="4"/> | ParameterSegmentRefEntry
<ParameterRefEntry parameterRef="a"><RepeatEntry><Count><FixedValue>2</FixedValue></Count><Offset>{dynamic("a")}\
</Offset></RepeatEntry></ParameterRefEntry> | Offset: expected a FixedValue between repetitions, found DynamicValue
<ParameterRefEntry parameterRef="a"><LocationInContainerInBits referenceLocation="containerEnd">\
<FixedValue>0</FixedValue></LocationInContainerInBits></ParameterRefEntry> | containerEnd
<ParameterRefEntry parameterRef="a"><LocationInContainerInBits><DynamicValue/></LocationInContainerInBits>\
</ParameterRefEntry> | expected an element ParameterInstanceRef, found none
<IndirectParameterRefEntry><ParameterInstance parameterRef="a"/></IndirectParameterRefEntry> | expected an entry that \
is supported (ParameterRefEntry, ArrayParameterRefEntry, ContainerRefEntry), found IndirectParameterRefEntry
{ARRAY_ENTRY("a")} | an array
"""


@mark.parametrize("row", ENTRIES.strip().splitlines())
def test_entries_beyond_the_subset_are_refused_by_name(row):
    entry, words = row.split(" | ")
    assert words in refused(document(U8, {"a": "u8"}, container("P", [entry])))


CRITERIA = f"""
{comparison("a", "one")} | a number, found 'one'
{comparison("a", "1.5")} | a number, found '1.5'
{comparison("a", 1, "~")} | an operator
{comparison("b", 1)} | a name of a code ('ON'), found '1'
{comparison("b", "ON", ">")} | == or !=
<CustomAlgorithm/> | CustomAlgorithm, which is not
<NextContainer/> | NextContainer, which is not
<ComparisonList/> | a Comparison
{comparison("a", 1) * 2} | one of Comparison, ComparisonList, BooleanExpression, found 2
<BooleanExpression><ANDedConditions/></BooleanExpression> | a condition, found none
<BooleanExpression><Condition><ParameterInstanceRef parameterRef='a'/>\
<ComparisonOperator>==</ComparisonOperator></Condition></BooleanExpression> | two sides
"""


@mark.parametrize("row", CRITERIA.strip().splitlines())
def test_conditions_beyond_the_subset_are_refused_by_name(row):
    criteria, words = row.split(" | ")
    assert words in refused(layout(U8 + MODES, child(criteria), a="u8", b="m"))


def test_conditions_are_joined_and_compared_as_written():
    def side(parameter):
        return f'<ParameterInstanceRef parameterRef="{parameter}" useCalibratedValue="false"/>'

    def condition(left, operator, right):
        other = side(right) if right.isalpha() else f"<Value>{right}</Value>"
        operator = operator.replace("<", "&lt;")
        return f"<Condition>{side(left)}<ComparisonOperator>{operator}</ComparisonOperator>{other}</Condition>"

    inner = f"<ORedConditions>{condition('a', '<', 'b')}{condition('b', '==', '0')}</ORedConditions>"
    joined = f"<ANDedConditions>{condition('a', '!=', '5')}{inner}</ANDedConditions>"
    text = layout(U8, child(f"<BooleanExpression>{joined}</BooleanExpression>"), a="u8", b="u8")
    pairs = [(a, b) for a in range(8) for b in range(8)]
    found = decoded(text, [bytes(pair) for pair in pairs])
    expected = [k for k, (a, b) in enumerate(pairs) if a != 5 and (a < b or b == 0)]
    assert found.tables["Q"].packet_index.tolist() == expected
    assert len(found.tables["P"]) == 64 - len(expected)


OPERATORS = {"==": "3", "!=": "124", "<": "12", "<=": "123", ">": "4", ">=": "34", "geq": "34"}


@mark.parametrize("operator", OPERATORS)
@mark.parametrize("width, value, types", [
    (1, 3, integer("t", 8)), (8, 3, integer("t", 64)),
    (1, 1.5, calibrated("t", 8, "unsigned", default(polynomial(0.0, 0.5)))),
])  # fmt: skip
def test_comparisons_mean_what_they_say(operator, width, value, types):
    text = layout(types, child(comparison("a", value, operator)), a="t")
    assert chosen(text, *(k.to_bytes(width, "big") for k in range(1, 5))) == [int(k) - 1 for k in OPERATORS[operator]]


def test_names_of_codes_are_compared():
    for operator, expected in (("==", [1]), ("!=", [0, 2])):
        assert chosen(layout(MODES, child(comparison("a", "ON", operator)), a="m"), b"\0", b"\1", b"\2") == expected


@mark.parametrize("spelling", ["IEEE-754", "IEEE754", "IEEE754_1985"])
def test_floats_are_known_by_their_older_names(spelling):
    assert values(layout(floating("f", 32, spelling), a="f"), [b"\x3f\xc0\0\0"]) == {"a": [1.5]}


def test_comparisons_hold_over_64_bits_and_for_members_and_booleans():
    value = 2**64 - 2
    packets = [k.to_bytes(8, "big") for k in (value - 1, value, value + 1, 2**63)]
    for condition, expected in ((comparison("a", value), [1]), (comparison("a", 2**70, "<"), [0, 1, 2, 3])):
        assert chosen(layout(integer("t", 64), child(condition), a="t"), *packets) == expected
    flag = '<BooleanParameterType name="f"><IntegerDataEncoding sizeInBits="4"/></BooleanParameterType>'
    types = integer("n", 4) + flag + aggregate("t", {"kind": "n", "on": "f"})
    text = layout(types, child(comparison("a.kind", 3)), child(comparison("a.on", "True", "!="), "R"), a="t")
    found = decoded(text, [b"\x31", b"\x30", b"\x20", b"\x21"])
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

    def criteria(member, value):
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
    found = decoded(text, [bytes((0x83, 1, 0, 2, 9)), bytes((0x03, 5, 0, 6))])
    assert {name: table.columns["b"].to_list() for name, table in found.tables.items()} == {"P": [6], "Q": [9]}
    assert "a member of 'id', found 'sort'" in refused(text.replace("id/kind", "id/sort"))


BITS = "<BinaryEncoding><SizeInBits><FixedValue>{}</FixedValue></SizeInBits></BinaryEncoding>"


def test_an_exclusive_limit_is_an_alarm_itself():
    ranges = "<CriticalRange minExclusive='3' maxExclusive='10'/><WarningRange minInclusive='4' maxInclusive='9'/>"
    alarm = f"<DefaultAlarm><StaticAlarmRanges>{ranges}</StaticAlarmRanges></DefaultAlarm></IntegerParameterType>"
    found = parse_xtce(of_type(integer("t", 8).replace("</IntegerParameterType>", alarm))).parameters["a"].type
    assert found.warning == (4.0, 9.0) and 3.0 < found.alarm[0] < 3.001 and 9.999 < found.alarm[1] < 10.0


def test_entries_are_repeated_as_arrays():
    def repeated(entry, count):
        return entry.replace("/>", f"><RepeatEntry><Count>{count}</Count></RepeatEntry></{entry[1:].split()[0]}>")

    entries = [
        "n", repeated('<ParameterRefEntry parameterRef="a"/>', "<FixedValue>3</FixedValue>"),
        repeated(INSIDE("R"), dynamic("n")), "z",
    ]  # fmt: skip
    text = document(U8, dict.fromkeys("nabcz", "u8"), container("R", ["b", "c"]) + container("P", entries))
    assert values(text, [bytes((2, 10, 11, 12, 1, 2, 3, 4, 9))]) == {
        "n": [2], "a": [[10, 11, 12]], "R": [[{"b": 1, "c": 2}, {"b": 3, "c": 4}]], "z": [9],
    }  # fmt: skip
    part = container("R", ["b", "c"])
    wide = text.replace(part, part.replace("<EntryList>", f"{BITS.format(24)}<EntryList>"))
    assert values(wide, [bytes((2, 10, 11, 12, 1, 2, 0, 3, 4, 0, 9)), bytes((0, 10, 11, 12, 9))]) == {
        "n": [2, 0], "a": [[10, 11, 12]] * 2, "R": [[{"b": 1, "c": 2}, {"b": 3, "c": 4}], []], "z": [9, 9],
    }  # fmt: skip
    assert "expected parts of 8 bits, found 16" in refused(wide.replace("24<", "8<"))
    later = child(comparison("a", 10))
    assert "stand before, found 'a'" in refused(text.replace("</ContainerSet>", f"{later}</ContainerSet>"))


def test_integers_may_be_stored_as_floats_octet_orders_listed_and_commands_refuse_nothing():
    types = floating("t", 32).replace("FloatParameterType", "IntegerParameterType")
    types += floating("f", 32).replace("FloatParameterType", "BooleanParameterType")
    assert values(layout(types, a="t", b="f"), [struct.pack(">ff", 42.0, 1.0)]) == {"a": [42.0], "b": [True]}
    for order, value in (("3,2,1,0", 0x01020304), ("0,1,2,3", 0x04030201)):
        assert values(of_type(integer("t", 32, order=order)), [b"\1\2\3\4"]) == {"a": [value]}
    assert "byteOrder" in refused(of_type(integer("t", 32, order="2,3,0,1")))
    more = '<CommandMetaData><MetaCommandSet><x:Odd xmlns:x="urn:x"/><Unknown/></MetaCommandSet></CommandMetaData>'
    assert list(parse_xtce(plain().replace("</SpaceSystem>", f"{more}</SpaceSystem>")).roots) == ["P"]


def test_alarms_that_are_not_read_are_counted():
    alarms = (
        "<DefaultAlarm><StaticAlarmRanges><WatchRange minInclusive='0'/><WarningRange minInclusive='0'/>"
        "<SevereRange maxInclusive='9'/></StaticAlarmRanges><ChangeAlarmRanges/></DefaultAlarm>"
        "<ContextAlarmList><ContextAlarm/><ContextAlarm/></ContextAlarmList>"
    )
    kind = integer("t", 8)
    end = kind.index("</IntegerParameterType>")
    definition = parse_xtce(of_type(kind[:end] + alarms + kind[end:] + integer("unused", 8)))
    assert definition.alarms_not_read == 4  # watch with warning, changes, two in a context
    assert definition.remarks == ("alarms that are not read: 4",)
    inside = kind[:end] + alarms.replace("<StaticAlarmRanges>", "<StaticAlarmRanges rangeForm='inside'>") + kind[end:]
    assert parse_xtce(of_type(inside)).alarms_not_read == 6
    assert parse_xtce(of_type(kind)).alarms_not_read == 0
    later = kind[:end] + alarms.replace("<DefaultAlarm>", "<DefaultAlarm minViolations='3'>") + kind[end:]
    assert parse_xtce(of_type(later)).alarms_not_read == 5


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
    (parameter,) = parse_xtce(text).parameters.values()
    assert isinstance(parameter.type, ScalarType) and parameter.type.unit == "m"
    assert isinstance(parameter.type.encoding, IntegerEncoding)
    assert parameter.type.encoding.calibration.default == Polynomial(((1.0, 0), (2.0, 1)))
    column = decoded(text, [b"\x05"]).tables["P"].columns["a"]
    assert (column.to_list(), column.to_list(raw=True)) == ([11.0], [5])


def test_what_the_schema_allows_and_no_value_depends_on_is_no_reason_to_refuse():
    time = (
        '<RelativeTimeParameterType name="t"><Encoding units="s"><IntegerDataEncoding sizeInBits="8">'
        '<ErrorDetectCorrect><Parity type="Even" bitsFromReference="0" reference="start"/></ErrorDetectCorrect>'
        "</IntegerDataEncoding></Encoding><DefaultAlarm><StaticAlarmRanges/></DefaultAlarm>"
        "</RelativeTimeParameterType>"
    )
    octets = binary(8).replace("<SizeInBits>", "<ErrorDetectCorrect/><SizeInBits>")
    text = layout(time + octets, a="t", b="B").replace('abstract="false"', 'abstract=" false "')
    assert values(text, [b"\x05\x06"]) == {"a": [5], "b": [b"\x06"]}


def test_points_of_a_spline_of_another_order_are_refused():
    points = '<SplinePoint raw="0" calibrated="1"/><SplinePoint order="1" raw="9" calibrated="2"/>'
    spline = f'<DefaultCalibrator><SplineCalibrator order="0">{points}</SplineCalibrator></DefaultCalibrator>'
    words = refused(layout(calibrated("u8", 8, "unsigned", spline), a="u8"))
    assert "SplinePoint: expected order 0, that of the calibrator, found 1" in words
