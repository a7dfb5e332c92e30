"""Packets and packet definitions in other programs: they decode our packets, and write definitions or packets."""

import json
import struct
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

from _cells import run

OWN_HEADER = ["VERSION", "TYPE", "SEC_HDR_FLG", "PKT_APID", "SEQ_FLGS", "SRC_SEQ_CTR", "PKT_LEN"]


def _space_packet(apid, data, count=0, *, secondary=False):
    first = apid | (0x0800 if secondary else 0)
    return struct.pack(">HHH", first, 0xC000 | count, len(data) - 1) + data


def _octets_of(cells, number):
    """Return the packets of our downlink, the idle ones left out."""
    stream, found, at = Path(cells.sample("packets.bin")).read_bytes(), [], 0
    while at < len(stream):
        end = at + 7 + int.from_bytes(stream[at + 4 : at + 6], "big")
        found.append(stream[at:end])
        at = end
    return found[:number]


def yamcs_pymdb(cells):
    """Every kind of type in one definition."""
    import yamcs.pymdb as y
    from yamcs.pymdb import ccsds

    def written(path):
        s = y.System("BUS")
        header = ccsds.add_ccsds_header(s)
        n = y.IntegerParameter(s, "n", signed=False, encoding=y.uint8_t)
        is_ok = y.BooleanMember("ok", encoding=y.bool_t, zero_string_value="BAD", one_string_value="GOOD")
        members = [
            y.IntegerMember("x", signed=False, encoding=y.uint8_t),
            y.FloatMember("y", encoding=y.float32_t, bits=32),
            y.AggregateMember("z", members=[is_ok]),
        ]
        agg = y.AggregateParameter(s, "agg", members=members)
        element = y.IntegerDataType(signed=False, encoding=y.uint16_t)
        arr = y.ArrayParameter(s, "arr", data_type=element, length=y.ParameterValue(n))
        start = datetime(2000, 1, 1, tzinfo=UTC)
        at = y.AbsoluteTimeParameter(s, "at", reference=start, encoding=y.FloatTimeEncoding(bits=64))
        short = y.StringParameter(s, "short", encoding=y.StringEncoding(bits=64, termination=b"\0"))
        long = y.StringParameter(s, "long", encoding=y.StringEncoding(length_bits=16, max_bits=800))
        octets = y.BinaryParameter(s, "octets", encoding=y.BinaryEncoding(length_bits=8))
        curve = y.Interpolate(xp=[30, 20, 10], fp=[3, 2, 1])
        volts = y.FloatParameter(s, "volts", bits=64, encoding=y.uint8_t, calibrator=curve)
        mode = y.EnumeratedParameter(s, "mode", choices=[(0, "OFF"), (1, "ON")], encoding=y.uint8_t)
        rep = y.IntegerParameter(s, "rep", signed=False, encoding=y.uint8_t)
        entries = [y.ParameterEntry(one) for one in (n, agg, arr, at, short, long, octets, volts, mode)]
        y.Container(
            s, "pkt", base=header.tm_container, condition=y.eq(header.tm_apid, 100),
            entries=[*entries, y.ParameterEntry(rep, repeat=3)],
        )  # fmt: skip
        with (cells.out / "pymdb.xml").open("w") as file:
            s.dump(file)
        packets, right = [], []
        for k in range(4):
            body = bytes((k, 7)) + struct.pack(">fB", 1.5 * k, (k % 2) << 7)
            body += b"".join(struct.pack(">H", 100 + i) for i in range(k))
            text = "z" * (k + 1)
            body += (
                struct.pack(">d", 86400.25 + k) + b"ABCDEFGH" + struct.pack(">H", len(text)) + text.encode()
            )
            body += bytes((2, 0xAB, k)) + bytes((10 + 5 * k, k % 2)) + bytes((1, 2, k))
            packets.append(_space_packet(100, body, k))
            right.append(
                {
                    "n": k, "agg": {"x": 7, "y": 1.5 * k, "z": {"ok": bool(k % 2)}},
                    "arr": [100 + i for i in range(k)], "at": 86400.25 + k, "short": "ABCDEFGH", "long": text,
                    "octets": f"ab{k:02x}", "volts": 1 + 0.5 * k, "mode": ("OFF", "ON")[k % 2], "rep": [1, 2, k],
                }
            )  # fmt: skip
        Path(path).write_bytes(b"".join(packets))
        return right

    names = ["n", "agg", "arr", "at", "short", "long", "octets", "volts", "mode", "rep"]
    cells.writes("XTCE", "pymdb.bin", "packets", written, xtce=["pymdb.xml"], parameters=names)


def _alias(name, kind):
    return {"kind": "alias", "qualifiedName": name, "type": kind, "underlyingType": kind}


def fprime_xtce(cells):
    """A dictionary of F Prime with a channel of each kind and a packet of several."""

    def number(name, size, *, signed=False, kind="integer"):
        return {"name": name, "kind": kind, "size": size, **({"signed": signed} if kind == "integer" else {})}

    def written(path):
        mode = {
            "kind": "enum", "qualifiedName": "Bus.Mode", "representationType": number("U8", 8),
            "enumeratedConstants": [{"name": "OFF", "value": 0}, {"name": "ON", "value": 1}], "default": "Bus.Mode.OFF",
        }  # fmt: skip
        size = _alias("FwSizeStoreType", number("U16", 16))
        parts = {"timeBase": number("U16", 16), "timeContext": number("U8", 8), "seconds": number("U32", 32)}
        parts["useconds"] = number("U32", 32)
        members = {name: {"type": kind, "index": k} for k, (name, kind) in enumerate(parts.items())}
        stamp = {"kind": "struct", "qualifiedName": "Fw.TimeValue", "members": members, "default": {}}
        kinds = {
            "Bus.count": number("U32", 32), "Bus.level": number("I16", 16, signed=True),
            "Bus.volts": number("F32", 32, kind="float"),
            "Bus.mode": {"name": "Bus.Mode", "kind": "qualifiedIdentifier"},
            "Bus.label": {"name": "string", "kind": "string", "size": 40},
        }  # fmt: skip
        channels = [
            {"name": name, "type": kind, "id": 16 + k, "telemetryUpdate": "always", "annotation": name}
            for k, (name, kind) in enumerate(kinds.items())
        ]
        packets = [{"name": "Sets", "id": 4, "group": 1, "members": ["Bus.count", "Bus.mode"]}]
        dictionary = {
            "metadata": {"deploymentName": "Bus", "projectVersion": "1", "frameworkVersion": "1", "libraryVersions": [],
                         "dictionarySpecVersion": "1.0.0"},
            "typeDefinitions": [mode, size, _alias("FwTlmPacketizeIdType", number("U16", 16)), stamp],
            "constants": [], "commands": [], "parameters": [], "events": [],
            "records": [], "containers": [], "telemetryChannels": channels,
            "telemetryPacketSets": [{"name": "Set", "members": packets, "omitted": []}],
        }  # fmt: skip
        source = cells.out / "dictionary.json"
        source.write_text(json.dumps(dictionary))
        subprocess.run(
            [sys.executable, "-m", "fprime_xtce", str(source), "-o", str(cells.out / "fprime.xml")],
            check=True,
        )

    def sent(path):
        """Return the values of a packet of each channel and of the set, packed as F Prime does."""
        written(path)
        stamp = struct.pack(">HBII", 2, 0, 1000, 250)
        at = {"timeBase": 2, "timeContext": 0, "seconds": 1000, "useconds": 250}
        channels = [
            ("count", struct.pack(">I", 77), 77), ("level", struct.pack(">h", -5), -5),
            ("volts", struct.pack(">f", 1.25), 1.25),
            ("mode", b"\x01", "ON"), ("label", b"\x00\x05HELLO" + bytes(35), "HELLO"),
        ]  # fmt: skip
        packets, right = [], []
        for k, (name, octets, value) in enumerate(channels):
            packets.append(_space_packet(1, struct.pack(">HI", 1, 16 + k) + stamp + octets, k))
            right.append({"packet": name, "FPrimeTime": at, name: value})
        packets.append(_space_packet(4, struct.pack(">HH", 4, 4) + stamp + struct.pack(">IB", 78, 0)))
        right.append({"packet": "Sets", "FPrimeTime": at, "count": 78, "mode": "OFF"})
        Path(path).write_bytes(b"".join(packets))
        return right

    cells.writes("XTCE", "fprime.bin", "packets", sent, xtce=["fprime.xml"], subset=True)


def openc3(cells):
    """A configuration of COSMOS as XTCE: three packets with a root container each."""
    import os

    os.environ.setdefault("OPENC3_NO_STORE", "1")
    from openc3.packets.packet_config import PacketConfig

    def written(path):
        text = "".join(
            f'TELEMETRY BUS {name} BIG_ENDIAN "{name}"\n  APPEND_ITEM CCSDSVER 3 UINT\n  APPEND_ITEM CCSDSTYPE 1 UINT\n'
            "  APPEND_ITEM CCSDSSHF 1 UINT\n"
            f"  APPEND_ID_ITEM CCSDSAPID 11 UINT {apid}\n"
            "  APPEND_ITEM CCSDSSEQFLAGS 2 UINT\n  APPEND_ITEM CCSDSSEQCNT 14 UINT\n  APPEND_ITEM CCSDSLENGTH 16 UINT\n"
            f"{items}"
            for name, apid, items in (
                (
                    "HK",
                    1,
                    "  APPEND_ITEM TEMP 16 INT\n    POLY_READ_CONVERSION 10.0 0.5\n  APPEND_ITEM VOLT 32 FLOAT\n",
                ),
                ("EVENT", 2, "  APPEND_ITEM CODE 8 UINT\n    STATE OFF 0\n    STATE ON 1\n"),
                ("IMAGE", 3, "  APPEND_ARRAY_ITEM PIXELS 8 UINT 32\n"),
            )
        )
        source = cells.out / "bus.txt"
        source.write_text(text)
        config = PacketConfig()
        config.process_file(str(source), "BUS")
        config.to_xtce(str(cells.out))
        found = sorted(cells.out.rglob("*.xtce"))
        (cells.out / "openc3.xml").write_bytes(found[0].read_bytes())
        packets = [
            _space_packet(1, struct.pack(">hf", -4, 1.5)),
            _space_packet(2, b"\x01"),
            _space_packet(3, bytes((1, 2, 3, 4))),
            _space_packet(1, struct.pack(">hf", 8, 2.5), 1),
        ]
        Path(path).write_bytes(b"".join(packets))
        heads = [(1, 0, 5), (2, 0, 0), (3, 0, 3), (1, 1, 5)]
        bodies = [
            {"TEMP": 8.0, "VOLT": 1.5}, {"CODE": "ON"}, {"PIXELS": [1, 2, 3, 4]}, {"TEMP": 14.0, "VOLT": 2.5},
        ]  # fmt: skip
        names = ("HK", "EVENT", "IMAGE")
        return [
            {
                "packet": names[apid - 1], "CCSDSVER": 0, "CCSDSTYPE": 0, "CCSDSSHF": 0, "CCSDSAPID": apid,
                "CCSDSSEQFLAGS": 3, "CCSDSSEQCNT": count, "CCSDSLENGTH": length, **body,
            }
            for (apid, count, length), body in zip(heads, bodies, strict=True)
        ]  # fmt: skip

    cells.not_tried("reads", "XTCE", "its reader of XTCE is not in the Python package")
    cells.writes("XTCE", "openc3.bin", "packets", written, xtce=["openc3.xml"])


def space_packet_parser(cells):
    import space_packet_parser as spp

    def plain(value):
        if isinstance(value, (bytes, bytearray)):
            return bytes(value).hex()
        return (
            float(value) if isinstance(value, float) else int(value) if isinstance(value, int) else str(value)
        )

    def decoded(definition, kept):
        found = []
        for octets in _octets_of(cells, None):
            packet = definition.parse_bytes(octets)
            found.append({key: plain(value) for key, value in packet.items()})
        return [{key: one.get(key) for key in wanted} for one, wanted in zip(found, kept, strict=True)]

    right = [
        {key: value for key, value in one.items() if key != "packet" and not isinstance(value, (list, dict))}
        for one in cells.expected("unrolled")
    ]

    def read():
        return decoded(spp.load_xtce(cells.sample("unrolled.xml")), right)

    def written(path):
        definition = spp.load_xtce(cells.sample("unrolled.xml"))
        definition.write_xml(str(cells.out / "spp.xml"))
        Path(path).write_bytes(Path(cells.sample("packets.bin")).read_bytes())
        return cells.expected("unrolled")

    cells.reads("XTCE (unrolled), packets", right, read)
    cells.writes("XTCE", "spp.bin", "packets", written, xtce=["spp.xml"])


def ccsdspy(cells):
    """The housekeeping of a pass with a fixed layout."""
    import ccsdspy as ccs
    import numpy as np

    records = [one for one in cells.expected("packets") if one["packet"] == "housekeeping"]
    apid = records[0]["PKT_APID"]
    fields = (
        ("PUS", 8),
        ("SERVICE", 8),
        ("SUBTYPE", 8),
        ("COUNTER", 16),
        ("DESTINATION", 16),
        ("P_FIELD", 8),
        ("COARSE", 32),
        ("FINE", 16),
    )

    def read():
        kept = [one for one in _octets_of(cells, None) if (one[0] & 7) << 8 | one[1] == apid]
        source = cells.out / "housekeeping.bin"
        source.write_bytes(b"".join(kept))
        layout = [ccs.PacketField(name, "uint", bits) for name, bits in fields]
        layout.append(ccs.PacketArray(name="REST", data_type="uint", bit_length=8, array_shape="expand"))
        found = ccs.VariableLength(layout).load(str(source), include_primary_header=True)
        names = (
            "CCSDS_APID",
            "CCSDS_SEQUENCE_COUNT",
            "CCSDS_PACKET_LENGTH",
            "SERVICE",
            "SUBTYPE",
            "COUNTER",
            "COARSE",
            "FINE",
        )
        return np.column_stack([found[name].astype(float) for name in names]).tolist()

    names = (
        "PKT_APID",
        "SRC_SEQ_CTR",
        "PKT_LEN",
        "SERVICE",
        "SUBTYPE",
        "MESSAGE_COUNTER",
        "TIME_COARSE",
        "TIME_FINE",
    )
    cells.reads("headers of packets", [[float(one[name]) for name in names] for one in records], read)

    def written(path):
        layout = [ccs.PacketField("a", "uint", 16), ccs.PacketField("b", "int", 32)]
        packets = ccs.FixedLength(layout, apid=77)
        values = {"a": np.array([1, 2, 65535]), "b": np.array([-1, 0, 123456])}
        packets.to_file(path, pkt_type=0, apid=77, sec_header_flag=0, seq_flag=3, data=values)
        (cells.out / "ccsdspy.xml").write_text(_two_fields())
        return [{"a": int(a), "b": int(b)} for a, b in zip(values["a"], values["b"], strict=True)]

    cells.writes("packets", "ccsdspy.bin", "packets", written, xtce=["ccsdspy.xml"], parameters=["a", "b"])


def _two_fields():
    """Return XTCE with a primary header, an unsigned and a signed integer."""
    widths = dict(zip(OWN_HEADER, (3, 1, 1, 11, 2, 14, 16), strict=True)) | {"a": 16, "b": 32}
    types = "".join(
        f'<IntegerParameterType name="{n}_T" signed="{"true" if n == "b" else "false"}"><IntegerDataEncoding'
        f' sizeInBits="{w}" encoding="{"twosComplement" if n == "b" else "unsigned"}"/></IntegerParameterType>'
        for n, w in widths.items()
    )
    names = "".join(f'<Parameter name="{n}" parameterTypeRef="{n}_T"/>' for n in widths)
    entries = "".join(f'<ParameterRefEntry parameterRef="{n}"/>' for n in widths)
    return (
        '<SpaceSystem xmlns="http://www.omg.org/spec/XTCE/20180204" name="T"><TelemetryMetaData>'
        f"<ParameterTypeSet>{types}</ParameterTypeSet><ParameterSet>{names}</ParameterSet><ContainerSet>"
        f'<SequenceContainer name="P"><EntryList>{entries}</EntryList></SequenceContainer></ContainerSet>'
        "</TelemetryMetaData></SpaceSystem>"
    )


def spacepackets(cells):
    from spacepackets.ecss.tc import PusTc
    from spacepackets.ecss.tm import PusTm

    records = cells.expected("packets")

    def read():
        found = []
        for octets in _octets_of(cells, None):
            one = PusTm.unpack(octets, timestamp_len=7)
            stamp = one.timestamp
            found.append(
                [
                    one.apid,
                    one.seq_count,
                    one.service,
                    one.subservice,
                    int.from_bytes(stamp[1:5], "big"),
                    len(one.source_data),
                ]
            )
        return [list(map(float, row)) for row in found]

    right = [
        [
            one["PKT_APID"],
            one["SRC_SEQ_CTR"],
            one["SERVICE"],
            one["SUBTYPE"],
            one["TIME_COARSE"],
            one["PKT_LEN"] + 1 - 14 - 2,
        ]
        for one in records
    ]
    cells.reads("PUS telemetry with checksum", [list(map(float, row)) for row in right], read)

    def written(path):
        commands = [
            (17, 1, b"", "test_connection"), (3, 5, struct.pack(">H", 1), "enable_housekeeping"),
            (8, 1, struct.pack(">Hdd", 8, 0, 0), "perform_function"),
            (20, 3, struct.pack(">Hd", 1, 5.0), "set_parameter"),
        ]  # fmt: skip
        packets = [
            PusTc(apid=160, service=service, subservice=subtype, app_data=data, seq_count=k).pack().hex()
            for k, (service, subtype, data, _) in enumerate(commands)
        ]
        Path(path).write_text(json.dumps(packets))
        return [name for *_, name in commands]

    cells.writes("PUS telecommands", "spacepackets.json", "telecommands", written)


def satnogs_decoders(cells):
    """A frame of AX.25 with one of our packets, as an amateur station would store it."""
    from satnogsdecoders.decoder import Ax25frames

    octets = _octets_of(cells, 1)[0]
    address = bytes(ord(c) << 1 for c in "LINNA ") + b"\x60" + bytes(ord(c) << 1 for c in "GROUND") + b"\x61"

    def read():
        frame = Ax25frames.from_bytes(address + b"\x03\xf0" + octets)
        text = frame.ax25_frame.payload.ax25_info
        return [text.hex() if isinstance(text, bytes) else str(text)]

    cells.reads("packet in an AX.25 frame", [octets.hex()], read)


def cfdp_py(cells):
    """Protocol data units of a transaction in space packets, described by XTCE."""
    from spacepackets.cfdp import CfdpLv  # noqa: F401
    from spacepackets.cfdp.conf import PduConfig
    from spacepackets.cfdp.defs import ChecksumType, TransmissionMode
    from spacepackets.cfdp.pdu import MetadataParams, MetadataPdu
    from spacepackets.cfdp.pdu.file_data import FileDataParams, FileDataPdu
    from spacepackets.util import ByteFieldU16

    def written(path):
        conf = PduConfig(
            transaction_seq_num=ByteFieldU16(9), source_entity_id=ByteFieldU16(1), dest_entity_id=ByteFieldU16(2),
            trans_mode=TransmissionMode.UNACKNOWLEDGED,
        )  # fmt: skip
        params = MetadataParams(
            closure_requested=False, checksum_type=ChecksumType.CRC_32, file_size=11, source_file_name="a.bin",
            dest_file_name="b.bin",
        )  # fmt: skip
        units = [
            MetadataPdu(conf, params).pack(),
            FileDataPdu(conf, FileDataParams(b"hello world", 0)).pack(),
        ]
        Path(path).write_bytes(b"".join(_space_packet(500, bytes(one), k) for k, one in enumerate(units)))
        (cells.out / "cfdp.xml").write_text(_cfdp_xtce())
        heads = [(0, units[0]), (1, units[1])]
        return [
            {
                "pdu_type": kind, "length": int.from_bytes(one[1:3], "big"), "source": 1, "transaction": 9,
                "destination": 2, "data": bytes(one[10:]).hex(),
            }
            for kind, one in heads
        ]  # fmt: skip

    names = ["pdu_type", "length", "source", "transaction", "destination", "data"]
    cells.writes(
        "CFDP units in packets, by XTCE", "cfdp.bin", "packets", written, xtce=["cfdp.xml"], parameters=names
    )


def _cfdp_xtce():
    """Return XTCE of the fixed header of a PDU with identifiers of two octets, and its data."""
    widths = dict(zip(OWN_HEADER, (3, 1, 1, 11, 2, 14, 16), strict=True))
    widths |= {
        "version": 3,
        "pdu_type": 1,
        "flags": 4,
        "length": 16,
        "sizes": 8,
        "source": 16,
        "transaction": 16,
        "destination": 16,
    }
    types = "".join(
        f'<IntegerParameterType name="{n}_T" signed="false"><IntegerDataEncoding sizeInBits="{w}"/>'
        "</IntegerParameterType>"
        for n, w in widths.items()
    )
    names = "".join(f'<Parameter name="{n}" parameterTypeRef="{n}_T"/>' for n in (*widths, "data"))
    entries = "".join(f'<ParameterRefEntry parameterRef="{n}"/>' for n in (*widths, "data"))
    return (
        '<SpaceSystem xmlns="http://www.omg.org/spec/XTCE/20180204" name="CFDP"><TelemetryMetaData>'
        f'<ParameterTypeSet>{types}<BinaryParameterType name="data_T"><BinaryDataEncoding><SizeInBits><DynamicValue>'
        '<ParameterInstanceRef parameterRef="length"/><LinearAdjustment slope="8"/></DynamicValue></SizeInBits>'
        f"</BinaryDataEncoding></BinaryParameterType></ParameterTypeSet><ParameterSet>{names}</ParameterSet><ContainerSet>"
        f'<SequenceContainer name="PDU"><EntryList>{entries}</EntryList></SequenceContainer></ContainerSet>'
        "</TelemetryMetaData></SpaceSystem>"
    )


run(globals())
