"""A bus of another mission: its XTCE definition, and packets of it made from values, bit by bit.

What is in a packet is written here with Python integers and `struct` alone, so that expected values do not come from
the code under test.
"""

import struct

import numpy as np
from spacepackets.ccsds import PacketType, SpacePacketHeader

NAMESPACE = "http://www.omg.org/spec/XTCE/20180204"


def document(types, parameters, containers, name="BUS", more=""):
    """An XTCE document of types, parameters (name: type) and containers."""
    listed = "".join(f'<Parameter name="{key}" parameterTypeRef="{kind}"/>' for key, kind in parameters.items())
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><SpaceSystem name="{name}" xmlns="{NAMESPACE}"><TelemetryMetaData>'
        f"<ParameterTypeSet>{types}</ParameterTypeSet><ParameterSet>{listed}</ParameterSet>"
        f"<ContainerSet>{containers}</ContainerSet></TelemetryMetaData>{more}</SpaceSystem>"
    )


def integer(name, bits, encoding="unsigned", inner="", order=""):
    byte_order = f' byteOrder="{order}"' if order else ""
    return (
        f'<IntegerParameterType name="{name}" signed="{str(encoding != "unsigned").lower()}"><UnitSet/>'
        f'<IntegerDataEncoding sizeInBits="{bits}" encoding="{encoding}"{byte_order}>{inner}</IntegerDataEncoding>'
        "</IntegerParameterType>"
    )


def floating(name, bits, encoding="IEEE754", order=""):
    byte_order = f' byteOrder="{order}"' if order else ""
    return (
        f'<FloatParameterType name="{name}"><UnitSet/>'
        f'<FloatDataEncoding sizeInBits="{bits}" encoding="{encoding}"{byte_order}/></FloatParameterType>'
    )


def calibrated(name, bits, encoding, calibrator):
    return (
        f'<FloatParameterType name="{name}"><UnitSet><Unit>V</Unit></UnitSet>'
        f'<IntegerDataEncoding sizeInBits="{bits}" encoding="{encoding}">{calibrator}</IntegerDataEncoding>'
        "</FloatParameterType>"
    )


def polynomial(*coefficients):
    terms = "".join(f'<Term coefficient="{c!r}" exponent="{k}"/>' for k, c in enumerate(coefficients))
    return f"<PolynomialCalibrator>{terms}</PolynomialCalibrator>"


def default(calibrator):
    return f"<DefaultCalibrator>{calibrator}</DefaultCalibrator>"


def spline(points, order, extrapolate):
    listed = "".join(f'<SplinePoint raw="{a}" calibrated="{b}"/>' for a, b in points)
    return f'<SplineCalibrator order="{order}" extrapolate="{str(extrapolate).lower()}">{listed}</SplineCalibrator>'


def comparison(parameter, value, operator="==", calibrated=True):
    operator = operator.replace("<", "&lt;").replace(">", "&gt;")
    return (
        f'<Comparison parameterRef="{parameter}" value="{value}" comparisonOperator="{operator}" '
        f'useCalibratedValue="{str(calibrated).lower()}"/>'
    )


def container(name, entries, base="", criteria="", *, abstract=False):
    listed = "".join(
        entry if entry.startswith("<") else f'<ParameterRefEntry parameterRef="{entry}"/>' for entry in entries
    )
    inherits = ""
    if base:
        inside = f"<RestrictionCriteria>{criteria}</RestrictionCriteria>" if criteria else ""
        inherits = f'<BaseContainer containerRef="{base}">{inside}</BaseContainer>'
    return (
        f'<SequenceContainer name="{name}" abstract="{str(abstract).lower()}">'
        f"<EntryList>{listed}</EntryList>{inherits}</SequenceContainer>"
    )


def layout(types, *more, **parameters):
    """A document of one container P with all its parameters, and containers that continue it."""
    return document(types, parameters, container("P", list(parameters)) + "".join(more))


def child(criteria, name="Q", base="P"):
    """A container that adds nothing but a condition."""
    return container(name, [], base, criteria)


def both(*comparisons):
    return f"<ComparisonList>{''.join(comparisons)}</ComparisonList>"


HEADER = {
    "VERSION": 3, "TYPE": 1, "SEC_HDR_FLG": 1, "PKT_APID": 11, "SEQ_FLGS": 2, "SRC_SEQ_CTR": 14, "PKT_LEN": 16,
}  # fmt: skip
HEADER_TYPES = "".join(integer(f"U{bits}", bits) for bits in sorted(set(HEADER.values()) | {4, 5, 8, 12, 24, 32}))
HEADER_PARAMETERS = {name: f"U{bits}" for name, bits in HEADER.items()}
HEADER_CONTAINER = container("CCSDSPacket", list(HEADER), abstract=True)


def bus_like(parameters, *containers, types=""):
    """A document of packets with the primary header."""
    return document(HEADER_TYPES + types, {**HEADER_PARAMETERS, **parameters}, HEADER_CONTAINER + "".join(containers))


LITTLE = "leastSignificantByteFirst"
_MODES = {0: "SAFE", 1: "NOMINAL", 7: "DETUMBLE"}
_LINEAR = [(0.0, -40.0), (64.0, 0.0), (128.0, 35.5), (255.0, 125.0)]
_STEPS = [(0.0, 1.0), (100.0, 2.5), (255.0, 4.0)]


def enumerated(name, bits, labels, encoding="unsigned"):
    listed = "".join(f'<Enumeration value="{code}" label="{label}"/>' for code, label in labels.items())
    return (
        f'<EnumeratedParameterType name="{name}"><UnitSet/>'
        f'<IntegerDataEncoding sizeInBits="{bits}" encoding="{encoding}"/>'
        f"<EnumerationList>{listed}</EnumerationList></EnumeratedParameterType>"
    )


def text_type(size, charset="UTF-8", name="T"):
    return (
        f'<StringParameterType name="{name}"><UnitSet/>'
        f'<StringDataEncoding encoding="{charset}">{size}</StringDataEncoding></StringParameterType>'
    )


def binary(size, after="", name="B"):
    """Octets of a fixed number of bits, or of a size that is written out."""
    written = f"<FixedValue>{size}</FixedValue>" if isinstance(size, int) else size
    return (
        f'<BinaryParameterType name="{name}"><UnitSet/><BinaryDataEncoding><SizeInBits>{written}</SizeInBits>{after}'
        "</BinaryDataEncoding></BinaryParameterType>"
    )


def fixed_size(bits, inside=""):
    return f"<SizeInBits><Fixed><FixedValue>{bits}</FixedValue></Fixed>{inside}</SizeInBits>"


def dynamic(parameter, **adjustment):
    attributes = "".join(f' {key}="{value}"' for key, value in adjustment.items())
    adjusted = f"<LinearAdjustment{attributes}/>" if adjustment else ""
    return f'<DynamicValue><ParameterInstanceRef parameterRef="{parameter}"/>{adjusted}</DynamicValue>'


_TYPES = (
    HEADER_TYPES
    + "".join(integer(f"I{bits}", bits, "twosComplement") for bits in (7, 12, 16, 33, 64))
    + integer("U64", 64)
    + integer("U63", 63)
    + integer("U16LE", 16, order=LITTLE)
    + integer("I32LE", 32, "twosComplement", order=LITTLE)
    + integer("U24LE", 24, order=LITTLE)
    + "".join(floating(f"F{bits}", bits) for bits in (16, 32, 64))
    + floating("F64LE", 64, order=LITTLE)
    + floating("MIL", 32, "MILSTD_1750A")
    + enumerated("MODE", 3, _MODES)
    + enumerated("TREND", 4, {-1: "FALLING", 0: "LEVEL", 1: "RISING"}, "twosComplement")
    + '<BooleanParameterType name="FLAG"><UnitSet/><IntegerDataEncoding sizeInBits="1"/></BooleanParameterType>'
    + calibrated("VOLT", 12, "unsigned", default(polynomial(-1.5, 0.25)))
    + calibrated("TEMP", 16, "twosComplement", default(polynomial(21.0, 0.5, -0.001953125)))
    + calibrated("LINEAR", 8, "unsigned", default(spline(_LINEAR, 1, True)))
    + calibrated("STEPS", 8, "unsigned", default(spline(_STEPS, 0, True)))
    + calibrated(
        "GAIN",
        16,
        "unsigned",
        default(polynomial(0.0, 2.0)) + "<ContextCalibratorList>"
        f"<ContextCalibrator><ContextMatch>{comparison('MODE', 'SAFE')}</ContextMatch>"
        f"<Calibrator>{polynomial(100.0, -1.0)}</Calibrator></ContextCalibrator>"
        f"<ContextCalibrator><ContextMatch>{comparison('GAIN', 40000, '>=', False)}</ContextMatch>"
        f"<Calibrator>{polynomial(0.0, 4.0)}</Calibrator></ContextCalibrator></ContextCalibratorList>",
    )
    + '<AbsoluteTimeParameterType name="CLOCK"><Encoding units="seconds" scale="0.0009765625" offset="10">'
    '<IntegerDataEncoding sizeInBits="32"/></Encoding><ReferenceTime><Epoch>TAI</Epoch></ReferenceTime>'
    "</AbsoluteTimeParameterType>"
    + text_type(fixed_size(64), "US-ASCII", "NAME")
    + text_type(fixed_size(96, "<TerminationChar>00</TerminationChar>"), name="LABEL")
    + text_type(fixed_size(80, '<LeadingSize sizeInBitsOfSizeTag="8"/>'), name="TAGGED")
    + text_type(fixed_size(64), "UTF-16BE", "WIDE")
    + text_type(f'<Variable maxSizeInBits="2040">{dynamic("TEXT_LENGTH", slope=8)}</Variable>', name="TEXT")
    + binary(dynamic("PKT_LEN", slope=8, intercept=-80), name="DUMP")
    + binary(24, name="KEY")
)

# name: type, in the order of the packet; each housekeeping value stands under its own name
HOUSEKEEPING = """
MODE:MODE ENABLED:FLAG TREND:TREND VOLTAGE:VOLT RATE:I12 SMALL:I7 LARGE:I33 SERIAL:U64 DEPTH:I64 TEMPERATURE:TEMP
HEATER:LINEAR STAGE:STEPS GAIN:GAIN HALF:F16 SINGLE:F32 DOUBLE:F64 SWAPPED_16:U16LE SWAPPED_32:I32LE
SWAPPED_24:U24LE SWAPPED_DOUBLE:F64LE MIL:MIL CLOCK:CLOCK ODD_1:FLAG UNEVEN:U63 NAME:NAME LABEL:LABEL TAGGED:TAGGED
WIDE:WIDE KEY:KEY
"""
HOUSEKEEPING = dict(pair.split(":") for pair in HOUSEKEEPING.split())

_PARAMETERS = {
    **HEADER_PARAMETERS,
    "DAY": "U16", "MILLISECOND": "U32", "MICROSECOND": "U16",
    **HOUSEKEEPING,
    "TEXT_LENGTH": "U8", "TEXT": "TEXT", "REASON": "U8", "DUMP": "DUMP", "COARSE": "U32", "FINE": "U24", "VALUE": "F32",
}  # fmt: skip

APID_HOUSEKEEPING, APID_EVENT, APID_DUMP, APID_BARE = 0x064, 0x065, 0x066, 0x3E7


def _either(*conditions):
    listed = "".join(
        f'<Condition><ParameterInstanceRef parameterRef="{p}" useCalibratedValue="false"/>'
        f"<ComparisonOperator>{o}</ComparisonOperator><Value>{v}</Value></Condition>"
        for p, o, v in conditions
    )
    return f"<BooleanExpression><ORedConditions>{listed}</ORedConditions></BooleanExpression>"


BUS = document(
    _TYPES,
    _PARAMETERS,
    HEADER_CONTAINER
    + container(
        "TIMED", ["DAY", "MILLISECOND", "MICROSECOND"], "CCSDSPacket",
        both(comparison("VERSION", 0), comparison("SEC_HDR_FLG", 1), comparison("PKT_APID", APID_DUMP, "!=")),
        abstract=True,
    )
    + container("Housekeeping", list(HOUSEKEEPING), "TIMED", comparison("PKT_APID", APID_HOUSEKEEPING))
    + container("Event", ["REASON", "TEXT_LENGTH", "TEXT"], "TIMED", comparison("PKT_APID", APID_EVENT))
    + container("UrgentEvent", ["VALUE"], "Event", comparison("REASON", 200, ">="))
    + container("Dump", ["COARSE", "FINE", "DUMP", "VALUE"], "CCSDSPacket", comparison("PKT_APID", APID_DUMP))
    + container(
        "Bare", ["VALUE"], "CCSDSPacket", _either(("PKT_APID", "==", APID_BARE), ("PKT_APID", "==", APID_BARE + 1)),
    ),
)  # fmt: skip


class Bits:
    """Bits written one value after another."""

    number = 0
    count = 0

    def add(self, value, bits):
        value = int(value)
        assert -(1 << bits) <= value < 1 << bits
        self.number = self.number << bits | value & ((1 << bits) - 1)
        self.count += bits
        return self

    def octets(self, data):
        return self.add(int.from_bytes(data, "big"), 8 * len(data))

    def packed(self):
        """The octets, the last filled with zeros."""
        self.add(0, -self.count % 8)
        return self.number.to_bytes(self.count // 8, "big")


def space_packet(apid, data, count, secondary=True):
    """A packet with the header that `spacepackets` makes."""
    header = SpacePacketHeader(
        packet_type=PacketType.TM, apid=apid, seq_count=count & 0x3FFF, data_len=len(data) - 1,
        sec_header_flag=secondary,
    )  # fmt: skip
    return bytes(header.pack()) + data


def housekeeping(rng, count):
    """A housekeeping packet of 124 octets with random values, whole ranges included."""
    mode, trend = rng.choice(list(_MODES)), rng.integers(-1, 2)
    bits = Bits()

    def draw(rows):
        for row in rows.split(","):
            width, low, high = map(int, row.split())
            bits.add(rng.integers(low, high), width)

    draw("16 20000 30000, 32 0 86400000, 16 0 1000")
    bits.add(mode, 3).add(rng.integers(2), 1).add(trend, 4)
    draw("12 0 4096, 12 -2048 2048, 7 -64 64, 33 -4294967296 4294967296")
    bits.add(rng.integers(2**64, dtype=np.uint64), 64)
    draw("64 -9223372036854775808 9223372036854775807, 16 -32768 32768, 8 0 255, 8 0 255, 16 0 65536")
    bits.octets(struct.pack(">efd", rng.normal(), rng.normal(), rng.normal() * 1e200))
    bits.octets(struct.pack("<Hi", rng.integers(65536), rng.integers(-(2**31), 2**31)))
    bits.octets(rng.bytes(3)).octets(struct.pack("<d", rng.normal())).octets(rng.bytes(8))
    draw("1 0 2, 63 0 9223372036854775808")
    bits.octets(bytes(rng.integers(32, 127, 8).tolist()))
    label = "häuser"[: rng.integers(7)].encode()
    bits.octets(label + b"\0" + rng.bytes(11 - len(label)))
    tagged = int(rng.integers(10))
    bits.add(8 * tagged, 8).octets(bytes(rng.integers(32, 127, tagged).tolist()) + bytes(9 - tagged))
    bits.octets("µA°C".encode("utf-16-be")).octets(rng.bytes(3))
    return space_packet(APID_HOUSEKEEPING, bits.packed(), count)


def event(rng, count):
    """An event packet with a text of up to 40 characters, and a value behind it if it is urgent."""
    text = "".join(rng.choice(list("abcµ° Z"), rng.integers(40))).encode()
    reason = rng.integers(256)
    data = rng.bytes(8) + bytes((reason, len(text))) + text
    return space_packet(APID_EVENT, data + (struct.pack(">f", rng.normal()) if reason >= 200 else b""), count)


def dump(rng, count):
    """A dump of up to 300 octets behind a CUC time of 4 and 3 octets."""
    data = rng.bytes(7) + rng.bytes(rng.integers(2, 302)) + struct.pack(">f", rng.normal())
    return space_packet(APID_DUMP, data, count)


def bare(rng, count):
    """A packet without secondary header."""
    data = struct.pack(">f", rng.normal())
    return space_packet(APID_BARE + int(rng.integers(2)), data, count, secondary=False)


def capture(packets, seed):
    """Packets of all kinds, mixed; every APID counts for itself."""
    rng = np.random.default_rng(seed)
    makers = (housekeeping, event, dump, bare)
    counts = {}
    made = []
    for _ in range(packets):
        packet = makers[rng.integers(4)](rng, 0)
        count = counts[packet[:2]] = counts.get(packet[:2], -1) + 1
        made.append(packet[:2] + struct.pack(">H", 0xC000 | count & 0x3FFF) + packet[4:])
    return made
