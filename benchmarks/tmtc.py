"""Benchmark of telemetry decoding (with checksums), compared with other libraries: python -m benchmarks tmtc.

Rates are by processor time of one thread, best of a few rounds: on a quiet machine that is the time that passes, and
a busy one changes it little. Slow rivals decode fewer packets of the same kind. Every decoder's values are compared
with ours.
"""

import binascii
import io
import logging
import struct
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._rows import Row, best_s
from tmtc.dictionary.fields import Field
from tmtc.dictionary.schema import Dictionary, Group, PacketDefinition
from tmtc.downlink import LinkSettings, decode, encode_cadus
from tmtc.link import reed_solomon
from tmtc.packets.space_packets import append_crc
from tmtc.packets.stream import cut_packets
from tmtc.xtce.export import format_xtce

PACKETS = 200_000
TYPES = ("u8", "i8", "u8", "u8", "i16", "u16", "u8", "f32", "u16", "u8", "u16", "u16") * 2
FIXED = PacketDefinition(
    "fixed", 0x111, 3, 25, "24 fields in 40 octets", tuple(Field(f"f{k}", t, "") for k, t in enumerate(TYPES))
)
VARIABLE = PacketDefinition(
    "variable",
    0x112,
    129,
    1,
    "Records of 8 octets",
    (Field("count", "u8", ""),),
    Group("count", (Field("record", "u64", ""),)),
)
DICTIONARY = Dictionary(1, (FIXED, VARIABLE))


def fixed_packets(count: int) -> bytes:
    """`count` packets of 62 octets."""
    rng = np.random.default_rng(1)
    dtype = np.dtype([("head", "V20"), *((f.name, f.dtype) for f in FIXED.fields)])
    first = DICTIONARY.pack("fixed", {f.name: 0 for f in FIXED.fields}, ticks=0, sequence_count=0)
    records = np.frombuffer(rng.bytes(count * dtype.itemsize), dtype=dtype).copy()
    records["head"] = np.frombuffer(first[:20], dtype="V20")[0]
    for f in FIXED.fields:
        if f.is_float:
            records[f.name] = rng.normal(size=count)
    octets = records.view(np.uint8).reshape(count, -1)
    octets[:, 2] = 0xC0 | (np.arange(count) >> 8 & 0x3F)
    octets[:, 3] = np.arange(count) & 0xFF
    return _with_checksums([row.tobytes() for row in octets])


def variable_packets(count: int) -> bytes:
    """`count` packets of 23 to 511 octets, 267 on average."""
    rng = np.random.default_rng(2)
    first = DICTIONARY.pack("variable", {"items": []}, ticks=0, sequence_count=0)
    parts = []
    for k, n in enumerate(rng.integers(0, 62, count).tolist()):
        head = struct.pack(">HHH", 0x0800 | VARIABLE.apid, 0xC000 | k & 0x3FFF, 16 + 8 * n)
        parts.append(head + first[6:20] + bytes((n,)) + rng.bytes(8 * n))
    return _with_checksums(parts)


def rows() -> Iterator[Row]:
    """Yield rates of decoding compared with the peers; different values are an error."""
    import ccsdspy

    ccsdspy.log.setLevel(logging.ERROR)
    n = PACKETS
    fixed, variable = fixed_packets(n), variable_packets(n)
    wrong = "" if _compare(fixed, variable, _ours(fixed), _ours(variable)) else "values of the decoders differ"
    peers: dict[str, Any] = {
        "fixed 62 octets": (
            fixed,
            {
                "spacepackets cut + header + struct + fastcrc": (_spacepackets_cut, n // 10),
                "ccsdspy FixedLength, no checksum": (_ccsdspy_fixed, n),
                "space_packet_parser XTCE, no checksum": (_xtce, n // 400),
                "struct loop + crc_hqx": (_struct_loop, n),
            },
        ),
        "variable mean 267 octets": (
            variable,
            {
                "ccsdspy VariableLength, no checksum": (_ccsdspy_variable, n // 20),
                "struct loop + frombuffer + crc_hqx": (_struct_loop_variable, n),
            },
        ),
    }
    for kind, (octets, runs) in peers.items():
        ours = n / best_s(lambda octets=octets: _ours(octets))
        for peer, (run, count) in runs.items():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                theirs = count / best_s(lambda run=run, octets=octets, count=count: run(octets, count))
            yield Row(kind, ours, "packets/s", peer, theirs, wrong)
    for what, figures in (("reed-solomon", _reed_solomon()), ("downlink", _downlink(variable))):
        for name, rate in figures.items():
            yield Row(f"{what}: {name}", rate, "MB/s")


def _ours(octets: bytes) -> Any:
    """Return tables with the transmitted values of all fields, as the other libraries give."""
    tables = DICTIONARY.unpack_many(octets, cut_packets(octets))
    for table in tables.values():
        list(table.raw.values()), list(table.items_raw.values())
    return tables


def _spacepackets_cut(octets: bytes, count: int) -> list[tuple[Any, ...]]:
    from fastcrc import crc16
    from spacepackets.ccsds import PacketId, PacketType, SpacePacketHeader
    from spacepackets.ccsds.spacepacket import parse_space_packets

    body = _struct_of(FIXED)
    wanted = [PacketId(PacketType.TM, True, FIXED.apid)]
    rows = []
    for packet in parse_space_packets(octets[: 62 * count], wanted).tm_list:
        SpacePacketHeader.unpack(packet[:6])
        if crc16.ibm_3740(bytes(packet)) == 0:
            rows.append(body.unpack_from(packet, 20))
    return rows


def _ccsdspy_fixed(octets: bytes, _: int = 0) -> Any:
    import ccsdspy

    kinds = {"u": "uint", "i": "int", "f": "float"}
    fields = [
        ccsdspy.PacketArray(name="head", data_type="uint", bit_length=8, array_shape=14, array_order="C"),
        *(
            ccsdspy.PacketField(name=f.name, data_type=kinds[f.type[0]], bit_length=int(f.type[1:]))
            for f in FIXED.fields
        ),
        ccsdspy.PacketField(name="crc", data_type="uint", bit_length=16),
    ]
    return ccsdspy.FixedLength(fields).load(io.BytesIO(octets))


def _ccsdspy_variable(octets: bytes, count: int) -> Any:
    import ccsdspy

    cut = cut_packets(octets)
    stop = int(cut.offsets[count]) if count < len(cut) else len(octets)
    fields = [
        ccsdspy.PacketArray(name="head", data_type="uint", bit_length=8, array_shape=14, array_order="C"),
        ccsdspy.PacketField(name="count", data_type="uint", bit_length=8),
        ccsdspy.PacketArray(name="record", data_type="uint", bit_length=64, array_shape="expand"),
        ccsdspy.PacketField(name="crc", data_type="uint", bit_length=16),
    ]
    return ccsdspy.VariableLength(fields).load(io.BytesIO(octets[:stop]))


def _xtce(octets: bytes, count: int) -> list[Any]:
    import space_packet_parser

    global _XTCE
    if _XTCE is None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "bench.xml")
            path.write_text(format_xtce(DICTIONARY, unrolled=True), encoding="utf-8")
            _XTCE = space_packet_parser.load_xtce(path)
    return [_XTCE.parse_bytes(octets[62 * k : 62 * (k + 1)]) for k in range(count)]


_XTCE: Any = None


def _struct_loop(octets: bytes, _: int = 0) -> list[tuple[Any, ...]]:
    body, view, at, rows = _struct_of(FIXED), memoryview(octets), 0, []
    while at < len(octets):
        stop = at + 7 + (octets[at + 4] << 8 | octets[at + 5])
        if binascii.crc_hqx(view[at:stop], 0xFFFF) == 0:
            rows.append(body.unpack_from(octets, at + 20))
        at = stop
    return rows


def _struct_loop_variable(octets: bytes, _: int = 0) -> list[Any]:
    view, at, rows = memoryview(octets), 0, []
    while at < len(octets):
        stop = at + 7 + (octets[at + 4] << 8 | octets[at + 5])
        if binascii.crc_hqx(view[at:stop], 0xFFFF) == 0:
            rows.append(np.frombuffer(octets, dtype=">u8", count=octets[at + 20], offset=at + 21))
        at = stop
    return rows


def _compare(fixed: bytes, variable: bytes, ours_fixed: Any, ours_variable: Any) -> bool:
    """Return whether all decoders read the same values."""
    columns = ours_fixed["fixed"].columns
    theirs = _ccsdspy_fixed(fixed)
    same = all(np.array_equal(columns[f.name], theirs[f.name]) for f in FIXED.fields)
    row = tuple(columns[f.name][7] for f in FIXED.fields)
    same &= row == _struct_loop(fixed)[7] == _spacepackets_cut(fixed, 8)[7]
    parsed = _xtce(fixed, 8)[7]
    same &= row == tuple(parsed[f"fixed_{f.name}"] for f in FIXED.fields)
    records = ours_variable["variable"].items_raw["record"]
    same &= np.array_equal(records, np.concatenate(_struct_loop_variable(variable)))
    some = _ccsdspy_variable(variable, PACKETS // 20)["record"]
    expected = np.concatenate([np.asarray(r, dtype=np.uint64) for r in some])
    return bool(same and np.array_equal(records[: expected.size], expected))


def _reed_solomon() -> dict[str, float]:
    """Megabytes of codeblocks a second: clean check, encoding, repair of 16 errors in every codeword."""
    code = reed_solomon.ReedSolomon()
    frames = np.random.default_rng(3).integers(0, 256, (4000, code.frame_length), dtype=np.uint8)
    blocks = reed_solomon.encode(frames, code)
    dirty = blocks[:100].copy()
    dirty[:, : 16 * code.interleave] ^= 0x5A
    assert reed_solomon.clean(blocks, code).all()
    assert np.array_equal(reed_solomon.decode(dirty, code).frames, frames[:100])
    return {
        "clean check": blocks.size / 1e6 / best_s(lambda: reed_solomon.clean(blocks, code)),
        "encode": frames.size / 1e6 / best_s(lambda: reed_solomon.encode(frames, code)),
        "repair of 16 errors a codeword": dirty.size / 1e6 / best_s(lambda: reed_solomon.decode(dirty, code)),
    }


def _downlink(octets: bytes) -> dict[str, float]:
    """Megabytes of CADUs a second, from the file to packets, accounted for; settings known and found out."""
    packets = list(cut_packets(octets).packets(octets))
    figures = {}
    for name, settings in (("uncoded", LinkSettings(coding="none")), ("coded, clean", LinkSettings(coding="rs"))):
        stream = encode_cadus(packets, spacecraft_id=76, coding=settings.coding)
        for how, given in (("settings known", settings), ("settings found out", None)):
            seconds = best_s(lambda stream=stream, given=given: decode(stream, settings=given, dictionary=DICTIONARY))
            figures[f"{name}, {how}"] = len(stream) / 1e6 / seconds
        assert decode(stream).packets == len(packets)
    return figures


def _struct_of(definition: PacketDefinition) -> struct.Struct:
    codes = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "f32": "f"}
    return struct.Struct(">" + "".join(codes[f.type] for f in definition.fields))


def _with_checksums(packets: list[bytes]) -> bytes:
    whole = (packet[:4] + (len(packet) - 5).to_bytes(2, "big") + packet[6:] for packet in packets)
    return b"".join(map(append_crc, whole))
