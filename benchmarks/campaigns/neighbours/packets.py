"""Packets and packet definitions in other programs: they decode our packets, and write definitions or packets."""

import json
import struct
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

from _cells import run

_HEADER = dict(
    zip(["VERSION", "TYPE", "SHF", "APID", "FLAGS", "COUNT", "LENGTH"], (3, 1, 1, 11, 2, 14, 16), strict=True)
)


def _packet(apid, data, count=0):
    return struct.pack(">HHH", apid, 0xC000 | count, len(data) - 1) + data


def _save(path, apid, bodies):
    Path(path).write_bytes(b"".join(_packet(apid, one, k) for k, one in enumerate(bodies)))


def _stored(cells):
    """Return the packets of our downlink."""
    stream, found, at = Path(cells.sample("packets.bin")).read_bytes(), [], 0
    while at < len(stream):
        found.append(stream[at : at + 7 + int.from_bytes(stream[at + 4 : at + 6], "big")])
        at += len(found[-1])
    return found


def _xtce(fields, signed=(), octets=""):
    """Return XTCE of a primary header and integers; `octets` counts octets that follow."""
    widths, kind = {**_HEADER, **fields}, "IntegerParameterType"
    forms = {name: "twosComplement" if name in signed else "unsigned" for name in widths}
    types = "".join(
        f'<{kind} name="{n}_T"><IntegerDataEncoding sizeInBits="{w}" encoding="{forms[n]}"/></{kind}>'
        for n, w in widths.items()
    )
    if octets:
        types += (
            '<BinaryParameterType name="data_T"><BinaryDataEncoding><SizeInBits><DynamicValue><ParameterInstanceRef'
            f' parameterRef="{octets}"/><LinearAdjustment slope="8"/></DynamicValue></SizeInBits></BinaryDataEncoding>'
            "</BinaryParameterType>"
        )
    names = [*widths, *["data"] * bool(octets)]
    parameters = "".join(f'<Parameter name="{n}" parameterTypeRef="{n}_T"/>' for n in names)
    entries = "".join(f'<ParameterRefEntry parameterRef="{n}"/>' for n in names)
    return (
        '<SpaceSystem xmlns="http://www.omg.org/spec/XTCE/20180204" name="T"><TelemetryMetaData><ParameterTypeSet>'
        f"{types}</ParameterTypeSet><ParameterSet>{parameters}</ParameterSet><ContainerSet><SequenceContainer"
        f' name="P"><EntryList>{entries}</EntryList></SequenceContainer></ContainerSet></TelemetryMetaData>'
        "</SpaceSystem>"
    )


def yamcs_pymdb(cells):
    import yamcs.pymdb as y

    def written(path):
        s = y.System("BUS")
        header = y.ccsds.add_ccsds_header(s)
        octet, start = {"signed": False, "encoding": y.uint8_t}, datetime(2000, 1, 1, tzinfo=UTC)
        n, rep = y.IntegerParameter(s, "n", **octet), y.IntegerParameter(s, "rep", **octet)
        is_ok = y.BooleanMember("ok", encoding=y.bool_t, zero_string_value="BAD", one_string_value="GOOD")
        real = y.FloatMember("y", encoding=y.float32_t, bits=32)
        members = [y.IntegerMember("x", **octet), real, y.AggregateMember("z", members=[is_ok])]
        word = y.IntegerDataType(signed=False, encoding=y.uint16_t)
        curve = y.Interpolate(xp=[30, 20, 10], fp=[3, 2, 1])
        text = y.StringEncoding(length_bits=16, max_bits=800)
        parameters = [
            n,
            y.AggregateParameter(s, "agg", members=members),
            y.ArrayParameter(s, "arr", data_type=word, length=y.ParameterValue(n)),
            y.AbsoluteTimeParameter(s, "at", reference=start, encoding=y.FloatTimeEncoding(bits=64)),
            y.StringParameter(s, "short", encoding=y.StringEncoding(bits=64, termination=b"\0")),
            y.StringParameter(s, "long", encoding=text),
            y.BinaryParameter(s, "octets", encoding=y.BinaryEncoding(length_bits=8)),
            y.FloatParameter(s, "volts", bits=64, encoding=y.uint8_t, calibrator=curve),
            y.EnumeratedParameter(s, "mode", choices=[(0, "OFF"), (1, "ON")], encoding=y.uint8_t),
        ]
        entries = [*map(y.ParameterEntry, parameters), y.ParameterEntry(rep, repeat=3)]
        y.Container(s, "pkt", entries, base=header.tm_container, condition=y.eq(header.tm_apid, 100))
        with (cells.out / "pymdb.xml").open("w") as file:
            s.dump(file)
        bodies, right = [], []
        for k in range(4):
            arr, long = [100 + i for i in range(k)], "z" * (k + 1)
            body = struct.pack(f">BBfB{k}Hd", k, 7, 1.5 * k, (k % 2) << 7, *arr, 86400.25 + k) + b"ABCDEFGH"
            body += struct.pack(">H", len(long)) + long.encode()
            bodies.append(body + bytes((2, 0xAB, k, 10 + 5 * k, k % 2, 1, 2, k)))
            agg = {"x": 7, "y": 1.5 * k, "z": {"ok": bool(k % 2)}}
            texts = ("ABCDEFGH", long, f"ab{k:02x}")
            values = (k, agg, arr, 86400.25 + k, *texts, 1 + 0.5 * k, ("OFF", "ON")[k % 2])
            names = [one.name for one in parameters]
            right.append({**dict(zip(names, values, strict=True)), "rep": [1, 2, k]})
        _save(path, 100, bodies)
        return right

    cells.packets("XTCE", "pymdb", written)


def fprime_xtce(cells):
    def number(name, size, kind="integer"):
        return {"name": name, "kind": kind, "size": size, "signed": name[0] == "I"}

    def alias(name):
        kind = number("U16", 16)
        return {"kind": "alias", "qualifiedName": name, "type": kind, "underlyingType": kind}

    channels = {
        "count": (number("U32", 32), struct.pack(">I", 77), 77),
        "level": (number("I16", 16), struct.pack(">h", -5), -5),
        "volts": (number("F32", 32, "float"), struct.pack(">f", 1.25), 1.25),
        "mode": ({"name": "Bus.Mode", "kind": "qualifiedIdentifier"}, b"\x01", "ON"),
        "label": ({"name": "string", "kind": "string", "size": 40}, b"\0\5HELLO" + bytes(35), "HELLO"),
    }

    def written(path):
        codes = [{"name": name, "value": k} for k, name in enumerate(("OFF", "ON"))]
        mode = {"kind": "enum", "qualifiedName": "Bus.Mode", "representationType": number("U8", 8)}
        mode |= {"enumeratedConstants": codes, "default": "Bus.Mode.OFF"}
        sizes = {"timeBase": 16, "timeContext": 8, "seconds": 32, "useconds": 32}
        types = [number(f"U{bits}", bits) for bits in sizes.values()]
        members = {name: {"type": types[k], "index": k} for k, name in enumerate(sizes)}
        stamp = {"kind": "struct", "qualifiedName": "Fw.TimeValue", "members": members, "default": {}}
        names = ("constants", "commands", "parameters", "events", "records", "containers")
        kinds = [(f"Bus.{name}", kind) for name, (kind, *_) in channels.items()]
        dictionary = {name: [] for name in names} | {
            "metadata": {"deploymentName": "Bus"},
            "typeDefinitions": [mode, alias("FwSizeStoreType"), alias("FwTlmPacketizeIdType"), stamp],
            "telemetryChannels": [{"name": n, "type": kind, "id": 16 + k} for k, (n, kind) in enumerate(kinds)],
            "telemetryPacketSets": [{"members": [{"name": "Sets", "id": 4, "members": ["Bus.count", "Bus.mode"]}]}],
        }
        (cells.out / "bus.json").write_text(json.dumps(dictionary))
        command = [sys.executable, "-m", "fprime_xtce", "bus.json", "-o", "fprime.xml"]
        subprocess.run(command, check=True, cwd=cells.out)
        at, octets = dict(zip(sizes, (2, 0, 1000, 250), strict=True)), struct.pack(">HBII", 2, 0, 1000, 250)
        parts = enumerate(channels.values())
        bodies = [struct.pack(">HI", 1, 16 + k) + octets + body for k, (_, body, _) in parts]
        _save(path, 1, bodies)
        with Path(path).open("ab") as file:
            file.write(_packet(4, struct.pack(">HH", 4, 4) + octets + struct.pack(">IB", 78, 0)))
        right = [{"packet": name, "FPrimeTime": at, name: value} for name, (*_, value) in channels.items()]
        return [*right, {"packet": "Sets", "FPrimeTime": at, "count": 78, "mode": "OFF"}]

    cells.packets("XTCE", "fprime", written)


def openc3(cells):
    from openc3.packets.packet_config import PacketConfig

    kinds = {
        "HK": "  APPEND_ITEM TEMP 16 INT\n    POLY_READ_CONVERSION 10.0 0.5\n  APPEND_ITEM VOLT 32 FLOAT\n",
        "EVENT": "  APPEND_ITEM CODE 8 UINT\n    STATE OFF 0\n    STATE ON 1\n",
        "IMAGE": "  APPEND_ARRAY_ITEM PIXELS 8 UINT 32\n",
    }

    def written(path):
        text = ""
        for apid, (name, items) in enumerate(kinds.items(), 1):
            text += f'TELEMETRY BUS {name} BIG_ENDIAN "{name}"\n'
            for field, bits in _HEADER.items():
                mark, code = ("ID_", f" {apid}") if field == "APID" else ("", "")
                text += f"  APPEND_{mark}ITEM {field} {bits} UINT{code}\n"
            text += items
        (cells.out / "bus.txt").write_text(text)
        config = PacketConfig()
        config.process_file(str(cells.out / "bus.txt"), "BUS")
        config.to_xtce(str(cells.out))
        next(cells.out.rglob("*.xtce")).rename(cells.out / "openc3.xml")
        bodies = [struct.pack(">hf", -4, 1.5), b"\x01", bytes((1, 2, 3, 4)), struct.pack(">hf", 8, 2.5)]
        apids = (1, 2, 3, 1)
        Path(path).write_bytes(b"".join(map(_packet, apids, bodies)))
        other = {"CODE": "ON"}, {"PIXELS": [1, 2, 3, 4]}
        values = {"TEMP": 8.0, "VOLT": 1.5}, *other, {"TEMP": 14.0, "VOLT": 2.5}
        return [{"packet": [*kinds][k - 1], "APID": k, **one} for k, one in zip(apids, values, strict=True)]

    cells.not_tried("reads", "XTCE", "its reader of XTCE is not in the Python package")
    cells.packets("XTCE", "openc3", written)


def space_packet_parser(cells):
    import space_packet_parser as spp

    expected, definition = cells.expected["unrolled"], spp.load_xtce(cells.sample("unrolled.xml"))
    kinds = (str, float, int, type(None))
    right = [{k: v for k, v in one.items() if k != "packet" and isinstance(v, kinds)} for one in expected]

    def plain(value):
        return next((kind(value) for kind in (float, int) if isinstance(value, kind)), str(value))

    def read():
        packets = map(definition.parse_bytes, _stored(cells))
        return [{key: plain(one[key]) for key in stated} for one, stated in zip(packets, right, strict=True)]

    def written(path):
        definition.write_xml(str(cells.out / "spp.xml"))
        Path(path).write_bytes(Path(cells.sample("packets.bin")).read_bytes())
        return expected

    cells.reads("XTCE (unrolled), packets", right, read)
    cells.packets("XTCE", "spp", written)


def ccsdspy(cells):
    import ccsdspy as ccs
    import numpy as np

    records = [one for one in cells.expected["packets"] if one["packet"] == "housekeeping"]
    fields = {"PUS": 8, "SERVICE": 8, "SUBTYPE": 8, "MESSAGE": 16, "TO": 16, "P": 8, "COARSE": 32, "FINE": 16}
    names = {"CCSDS_APID": "PKT_APID", "CCSDS_SEQUENCE_COUNT": "SRC_SEQ_CTR", "CCSDS_PACKET_LENGTH": "PKT_LEN"}
    names |= {"SERVICE": "SERVICE", "SUBTYPE": "SUBTYPE", "COARSE": "TIME_COARSE", "FINE": "TIME_FINE"}

    def read():
        apid, source = records[0]["PKT_APID"], cells.out / "housekeeping.bin"
        source.write_bytes(b"".join(one for one in _stored(cells) if (one[0] & 7) << 8 | one[1] == apid))
        layout = [ccs.PacketField(name, "uint", bits) for name, bits in fields.items()]
        layout.append(ccs.PacketArray(name="REST", data_type="uint", bit_length=8, array_shape="expand"))
        found = ccs.VariableLength(layout).load(str(source), include_primary_header=True)
        return np.column_stack([found[name].astype(float) for name in names]).tolist()

    def written(path):
        layout = [ccs.PacketField("a", "uint", 16), ccs.PacketField("b", "int", 32)]
        packets = ccs.FixedLength(layout, apid=77)
        values = {"a": np.array([1, 2, 65535]), "b": np.array([-1, 0, 123456])}
        packets.to_file(path, pkt_type=0, apid=77, sec_header_flag=0, seq_flag=3, data=values)
        (cells.out / "ccsdspy.xml").write_text(_xtce({"a": 16, "b": 32}, signed=("b",)))
        return [{"a": int(a), "b": int(b)} for a, b in zip(*values.values(), strict=True)]

    right = [[float(one[name]) for name in names.values()] for one in records]
    cells.reads("headers of packets", right, read)
    cells.packets("packets", "ccsdspy", written)


def spacepackets(cells):
    from spacepackets.ecss.tc import PusTc
    from spacepackets.ecss.tm import PusTm

    names = ("PKT_APID", "SRC_SEQ_CTR", "SERVICE", "SUBTYPE", "TIME_COARSE")

    def read():
        found = [PusTm.unpack(one, timestamp_len=7) for one in _stored(cells)]
        times = [int.from_bytes(one.timestamp[1:5], "big") for one in found]
        return [[p.apid, p.seq_count, p.service, p.subservice, t] for p, t in zip(found, times, strict=True)]

    def written(path):
        commands = {
            "test_connection": (17, 1, b""),
            "enable_housekeeping": (3, 5, struct.pack(">H", 1)),
            "perform_function": (8, 1, struct.pack(">Hdd", 8, 0, 0)),
            "set_parameter": (20, 3, struct.pack(">Hd", 1, 5.0)),
        }
        packets = [PusTc(apid=160, service=a, subservice=b, app_data=d) for a, b, d in commands.values()]
        Path(path).write_text(json.dumps([one.pack().hex() for one in packets]))
        return list(commands)

    right = [[one[name] for name in names] for one in cells.expected["packets"]]
    cells.reads("PUS telemetry with checksum", right, read)
    cells.writes("PUS telecommands", "spacepackets.json", "telecommands", written)


def satnogs_decoders(cells):
    from satnogsdecoders.decoder import Ax25frames

    octets = _stored(cells)[0]
    head = b"\x60".join(bytes(ord(c) << 1 for c in name) for name in ("LINNA ", "GROUND"))

    def read():
        frame = Ax25frames.from_bytes(head + b"\x61\x03\xf0" + octets)
        return [frame.ax25_frame.payload.ax25_info.hex()]

    cells.reads("packet in an AX.25 frame", [octets.hex()], read)


def cfdp_py(cells):
    from spacepackets.cfdp.conf import PduConfig
    from spacepackets.cfdp.defs import ChecksumType, TransmissionMode
    from spacepackets.cfdp.pdu import MetadataParams, MetadataPdu
    from spacepackets.cfdp.pdu.file_data import FileDataParams, FileDataPdu
    from spacepackets.util import ByteFieldU16

    fields = {"version": 3, "pdu_type": 1, "flags": 4, "length": 16, "sizes": 8}
    fields |= dict.fromkeys(("source", "transaction", "destination"), 16)

    def written(path):
        numbers = [ByteFieldU16(k) for k in (1, 2, 9)]
        conf = PduConfig(*numbers, TransmissionMode.UNACKNOWLEDGED)
        conf.source_entity_id, conf.dest_entity_id, conf.transaction_seq_num = numbers
        metadata = MetadataParams(False, ChecksumType.CRC_32, 11, "a.bin", "b.bin")
        data = FileDataParams(b"hello world", 0)
        units = [MetadataPdu(conf, metadata).pack(), FileDataPdu(conf, data).pack()]
        _save(path, 500, map(bytes, units))
        (cells.out / "cfdp.xml").write_text(_xtce(fields, octets="length"))
        same = {"source": 1, "transaction": 9, "destination": 2}
        return [
            {"pdu_type": k, "length": len(one) - 10, **same, "data": bytes(one[10:]).hex()}
            for k, one in enumerate(units)
        ]

    cells.packets("CFDP units in packets, by XTCE", "cfdp", written)


run(globals())
