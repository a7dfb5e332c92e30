"""`linna tm` as its users type it."""

import csv
import json
import struct

import numpy as np
from pytest import fixture, mark

from linna.cli import run
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.link.cadu import ASM
from tmtc.packets.space_packets import PacketSequencer


def make_packets(count):
    sequencer = PacketSequencer()
    return [
        DICTIONARY.pack(
            "event_info",
            {"event_id": "anchor_read", "frame_number": k, "value_1": k / 2, "value_2": float("nan")},
            ticks=k << 16,
            sequence_count=sequencer.next(0xA4),
        )
        for k in range(count)
    ]


PACKETS = make_packets(100)


@fixture
def downlink(tmp_path):
    path = tmp_path / "downlink.cadu"
    path.write_bytes(encode_cadus(PACKETS, spacecraft_id=76))
    return path


def test_check_tells_the_account_of_an_undamaged_downlink(downlink, typed):
    summary = typed(f"tm check {downlink} --json --strict")
    assert summary["packets"] == 100 and summary["by_apid"] == {"0x0A4": 100}
    zeros = ("gaps", "duplicates", "crc_errors", "octets_skipped", "frames_bad", "symbols_corrected")
    assert {name: summary[name] for name in zeros} == dict.fromkeys(zeros, 0)
    assert sum(summary["octets"].values()) == downlink.stat().st_size


def test_check_tells_damage_and_fails_only_when_asked_to(downlink, typed):
    octets = bytearray(downlink.read_bytes())
    octets[1279 + 9] ^= 0xFF
    del octets[2 * 1279 : 3 * 1279]
    downlink.write_bytes(octets)
    summary = typed(f"tm check {downlink} --json")
    assert summary["symbols_corrected"] == 1 and summary["frames_lost"] == 1 and summary["gaps"] == 1
    assert summary["packets"] + summary["packets_missing"] == 100
    assert "symbols corrected 1" in typed(f"tm check {downlink} --strict", 1)


def test_decode_writes_json_to_a_file_or_to_standard_output(downlink, tmp_path, typed):
    out = tmp_path / "packets.json"
    summary = typed(f"tm decode {downlink} --out {out} --json")
    assert summary["packets"] == summary["written"] == 100 and summary["out"] == str(out)
    records = json.loads(out.read_text())
    assert [r["frame_number"] for r in records] == list(range(100)) and records[3]["value_1"] == 1.5
    assert typed(f"tm decode {downlink}") == records
    summary = typed(f"tm decode {downlink} --json")
    assert summary["telemetry"] == records and summary["packets"] == 100


def test_decode_without_a_packet_to_write_says_so_and_writes_no_file(downlink, tmp_path, capsys):
    out = tmp_path / "packets.json"
    assert run(f"tm decode {downlink} --packet housekeeping --out {out}".split()) == 1
    assert capsys.readouterr().err == "linna: expected a packet (housekeeping) among 100, found none\n"
    assert not out.exists()


def test_decode_writes_csv_and_parquet(downlink, tmp_path, typed):
    out = tmp_path / "packets"
    typed(f"tm decode {downlink} --format csv --out {out}")
    assert [row["event_id"] for row in csv.DictReader(out.read_text().splitlines())] == ["anchor_read"] * 100
    typed(f"tm decode {downlink} --format parquet --out {out}")
    assert out.read_bytes()[:4] == b"PAR1"


def test_bare_packets_are_decoded_as_well(tmp_path, typed):
    path = tmp_path / "packets.bin"
    path.write_bytes(b"".join(PACKETS))
    summary = typed(f"tm check {path} --json")
    assert (summary["kind"], summary["packets"], summary["link"]) == ("packets", 100, None)


def test_only_the_wanted_packets_are_decoded(downlink, typed):
    assert typed(f"tm decode {downlink} --packet detections", 1) == []
    assert "found 'nonsense'" in typed(f"tm decode {downlink} --packet nonsense", 2)


@mark.parametrize("content", [b"", b"this is no telemetry at all, not even nearly"])
def test_a_file_without_telemetry_is_refused_in_one_line(tmp_path, typed, content):
    path = tmp_path / "file.bin"
    path.write_bytes(content)
    error = typed(f"tm check {path}", 2)
    assert error == f"linna: error: {path}: expected CADUs or space packets, found none in its {len(content)} octets"


def test_frames_of_an_unknown_coding_and_a_missing_file_are_refused_with_the_name_of_the_file(tmp_path, typed):
    noise = np.random.default_rng(3).integers(0, 256, (30, 700), dtype=np.uint8)
    noise[:, :4] = np.frombuffer(ASM, dtype=np.uint8)
    (tmp_path / "odd.cadu").write_bytes(noise.tobytes())
    for command in ("check", "decode"):
        line = typed(f"tm {command} {tmp_path}/odd.cadu", 2)
        assert "odd.cadu" in line and "700 octets apart" in line
    typed(f"tm decode {tmp_path}/absent", 2)


def test_an_unwritable_place_leaves_nothing_behind(downlink, tmp_path, typed):
    typed(f"tm decode {downlink} --out {tmp_path}/absent/out.json", 2)
    assert [p.name for p in tmp_path.iterdir()] == [downlink.name]


def test_settings_of_the_link_may_be_given(downlink, typed):
    arguments = "--frame-length 1115 --coding rs --randomiser none --spacecraft-id 0x4C"
    summary = typed(f"tm check {downlink} --json {arguments}")
    assert summary["link"]["randomiser"] == "none" and summary["packets"] == 0
    typed(f"tm check {downlink} --frame-length 7", 2)


def test_the_icd_and_the_xtce_are_written(tmp_path, typed):
    assert typed("tm icd").startswith("# Interface control document")
    out = tmp_path / "linna.xml"
    assert typed(f"tm xtce --out {out} --json")["dictionary_hash"] == DICTIONARY.hash
    assert out.read_text().startswith("<?xml")


# packets of other missions


@fixture
def foreign(tmp_path):
    """A capture of another mission without error control, its definition and its packets."""
    from tests.tmtc import foreign

    definition, capture = tmp_path / "bus.xml", tmp_path / "bus.bin"
    definition.write_text(foreign.BUS, encoding="utf-8")
    packets = foreign.capture(120, 11)
    capture.write_bytes(b"".join(packets))
    return definition, capture, packets


def test_packets_without_error_control_are_checked_only_when_stated(foreign, typed):
    definition, capture, packets = foreign
    assert "found none" in typed(f"tm check {capture}", 2)
    summary = typed(f"tm check {capture} --no-error-control --json")
    assert summary["packets"] == summary["unknown"] == len(packets) and summary["gaps"] == 0
    strict = f"tm check {capture} --no-error-control --xtce {definition} --strict"
    assert "definition: decoded 120" in typed(strict)
    capture.write_bytes(b"".join([*packets, packets[-1][:-1]]))
    typed(strict, 1)
    capture.write_bytes(b"".join(bytes(4) + packet for packet in packets))
    assert "each behind 4 other octets" in typed(strict)
    for octets in (5, -1):
        typed(f"{strict} --prefix-octets {octets}", 2)
    short = [struct.pack(">HHHHIHHI", 0x8C8, 0xC000 | k, 13, 26000, 1000 * k, 2500, 330, 0) for k in range(8)]
    capture.write_bytes(b"".join([*short[:4], bytes((0x55,)) * 13, *short[4:]]))
    noisy = typed(f"tm check {capture} --no-error-control --json")
    assert (noisy["packets"], noisy["prefix_octets"], noisy["octets"]["skipped"]) == (7, 0, 13)


def test_packets_of_another_mission_are_decoded_through_their_definition(foreign, tmp_path, typed):
    import space_packet_parser

    definition, capture, packets = foreign
    theirs = space_packet_parser.load_xtce(definition)
    expected = [theirs.parse_bytes(p) for p in packets]
    decode = f"tm decode {capture} --xtce {definition} --no-error-control"
    records = typed(decode)
    for record, packet in zip(records, expected, strict=True):
        assert list(record)[1:] == list(packet)
        for name, value in packet.items():
            assert record[name] == (value.hex() if isinstance(value, bytes) else value)
    raw = typed(f"{decode} --raw --packet Housekeeping")
    chosen = [p for p in expected if "MODE" in p]
    assert [r["MODE"] for r in raw] == [p["MODE"].raw_value for p in chosen]
    assert [r["SERIAL"] for r in raw] == [p["SERIAL"] for p in chosen] and max(r["SERIAL"] for r in raw) >= 2**63
    out = tmp_path / "bus.csv"
    summary = typed(f"{decode} --format csv --out {out} --json")
    assert summary["written"] == 120 and summary["verdicts"]["decoded"] == 120
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert [r["packet"] for r in rows] == [r["packet"] for r in records]
    serials = [str(p["SERIAL"]) if "SERIAL" in p else "" for p in expected]
    assert [r["SERIAL"] for r in rows] == serials
    out = tmp_path / "bus.parquet"
    typed(f"{decode} --format parquet --out {out}")
    assert out.read_bytes()[:4] == b"PAR1"


@mark.parametrize(
    "change, options, words",
    [
        (('sizeInBits="64"', 'sizeInBits="640"'), "", "sizeInBits of 1 to 64, found 640"),
        (("</SpaceSystem>", ""), "", "well-formed XML"),
        (("", ""), "--container Absent", "expected the name of a container"),
        (("", ""), "--packet Absent", "expected a container"),
    ],
)
def test_a_definition_that_cannot_be_used_is_refused_in_one_line(foreign, tmp_path, change, options, words, typed):
    definition, capture, _ = foreign
    definition.write_text(definition.read_text().replace(*change, -1 if change[0] else 0))
    out = tmp_path / "out.json"
    decode = f"tm decode {capture} --xtce {definition} --no-error-control --out {out} {options}"
    assert words in typed(decode, 2) and not out.exists()


def test_options_of_a_definition_need_one(downlink, typed):
    assert "--raw: expected --xtce" in typed(f"tm decode {downlink} --raw", 2)
    assert "--container: expected --xtce" in typed(f"tm check {downlink} --container x", 2)


def test_arrays_and_aggregates_are_lists_and_mappings_and_columns_of_a_table(tmp_path, typed):
    from tests.tmtc.foreign import container, document, integer
    from tests.tmtc.xtce.test_decode import ARRAY_ENTRY, aggregate, array_type, dimension

    types = integer("u8", 8) + aggregate("pair", {"a": "u8", "b": "u8"}) + array_type("list", "u8", dimension("n"))
    parameters = {"head": "head", "n": "u8", "pair": "pair", "packet": "u8", "list": "list"}
    types += integer("head", 48)
    definition, capture = tmp_path / "d.xml", tmp_path / "c.bin"
    entries = ["head", "n", "pair", "packet", ARRAY_ENTRY("list")]
    definition.write_text(document(types, parameters, container("P", entries)))
    capture.write_bytes(bytes((0, 5, 0xC0, 0, 0, 5, 2, 3, 4, 5, 6, 7)) + bytes((0, 5, 0xC0, 1, 0, 3, 0, 8, 9, 10)))
    decode = f"tm decode {capture} --xtce {definition} --no-error-control"
    first, second = typed(decode)
    assert first["pair"] == {"a": 3, "b": 4} and first["list"] == [6, 7] and first["packet_"] == 5
    assert first["packet"] == "P" and second["list"] == []
    rows = list(csv.reader(typed(f"{decode} --format csv").splitlines()))
    assert rows[0] == ["packet", "head", "n", "pair.a", "pair.b", "packet_", "list"]
    assert rows[1][2:] == ["2", "3", "4", "5", "[6, 7]"] and rows[2][2:] == ["0", "8", "9", "10", "[]"]


def bus_packet(count, data, *, secondary=True, flags=3, apid=200):
    first = apid | (0x0800 if secondary else 0)
    return struct.pack(">HHH", first, flags << 14 | count, len(data) - 1) + data


@fixture
def timed(tmp_path, typed):
    """A definition whose packets have a time of four octets, and a function that checks or decodes packets with it."""
    from tests.tmtc.foreign import HEADER_CONTAINER, HEADER_PARAMETERS, HEADER_TYPES, comparison, container, document

    parameters = {**HEADER_PARAMETERS, "time": "U32", "value": "U16"}
    entries = container("hk", ["time", "value"], "CCSDSPacket", comparison("PKT_APID", 200))
    definition = tmp_path / "bus.xml"
    definition.write_text(document(HEADER_TYPES, parameters, HEADER_CONTAINER + entries))

    def summary(command, packets):
        path = tmp_path / "bus.bin"
        path.write_bytes(b"".join(packets))
        return typed(f"tm {command} {path} --xtce {definition} --no-error-control")

    return summary


def test_parts_of_segmented_packets_and_packets_without_their_header_are_counted_apart(timed):
    packets = [bus_packet(k, bytes(6)) for k in range(5)]
    packets += [bus_packet(5, bytes(5), flags=1), bus_packet(6, b"\x07", secondary=False, flags=2)]
    packets += [bus_packet(7, b"BOOTED", secondary=False), bus_packet(9, bytes(6), secondary=False, flags=2)]
    verdicts = timed("check --json", packets)["verdicts"]
    assert {name: count for name, count in verdicts.items() if count} == {
        "decoded": 6, "segments_not_joined": 1, "no_secondary_header": 1, "segments_joined": 1,
    }  # fmt: skip
    assert [record["value"] for record in timed("decode", packets)] == [0] * 5 + [7]
    bare = [bus_packet(k, bytes(6), secondary=False) for k in range(3)]  # no packet of the APID has a header
    assert timed("check --json", bare)["verdicts"]["decoded"] == 3


def test_counts_that_restart_are_distinguished_from_conflicts(timed):
    counts = [*range(25), *range(3, 30)]
    packets = [bus_packet(count, struct.pack(">IH", k, k)) for k, count in enumerate(counts)]
    out = timed("check", packets)
    assert "conflicts 0" in out
    assert "counts restart once; how many packets are missing around a restart is unknown" in out
    out = timed("check", [*packets[:25], bus_packet(20, bytes(6))])
    assert "conflict: a packet with the count of another one of its APID and other content" in out


def test_the_configuration_of_yamcs_is_written_for_a_spacecraft_and_a_station(tmp_path, typed):
    from ruamel.yaml import YAML

    from lunar.timescales import ONBOARD_EPOCH_TAI_NS, parse_utc, tai_ns_from_utc_ns

    command = f"tm yamcs --out {tmp_path}/y --spacecraft-id 77 --station host"
    files = typed(f"{command}:1234 --json")["files"]
    assert sorted(files) == sorted(str(path) for path in (tmp_path / "y").rglob("*.*"))
    frames, telecommands = YAML(typ="safe").load((tmp_path / "y/etc/yamcs.linna.yaml").read_text())["dataLinks"]
    assert (frames["spacecraftId"], frames["frameLength"], frames["errorDetection"]) == (77, 1115, "CRC16")
    assert [one["vcId"] for one in frames["virtualChannels"]] == [0, 1]
    assert (telecommands["host"], telecommands["port"]) == ("host", 1234)
    arguments = frames["virtualChannels"][0]["packetPreprocessorArgs"]
    epoch = tai_ns_from_utc_ns(parse_utc(arguments["timeEncoding"]["epochUTC"]))
    assert epoch == ONBOARD_EPOCH_TAI_NS and arguments["pktTimeOffset"] == 13
    assert YAML(typ="safe").load((tmp_path / "y/etc/yamcs.yaml").read_text())["instances"] == ["linna"]
    assert "--station: expected HOST:PORT, found 'host'" in typed(command, 2)


def test_plain_frames_of_a_downlink_are_sent_as_datagrams(downlink, typed):
    import socket

    damaged = bytearray(downlink.read_bytes())
    damaged[1279 + 4 : 2 * 1279] = bytes(1275)  # beyond repair
    downlink.write_bytes(bytes(100) + damaged)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        count = typed(f"tm frames {downlink} --to 127.0.0.1:{receiver.getsockname()[1]} --json")["frames"]
        received = [receiver.recv(2000) for _ in range(count)]
    assert count == len(damaged) // 1279 - 1
    assert {len(frame) for frame in received} == {1115}
    assert {frame[3] for frame in received} == {0, *range(2, count + 1)}


def test_frames_are_found_across_pieces_of_a_stream(downlink):
    from tmtc.link.frame_reading import plain_frames
    from tmtc.link.settings import LinkSettings

    octets = downlink.read_bytes()
    whole = list(plain_frames([octets], LinkSettings()))
    pieces = [octets[first : first + 900] for first in range(0, len(octets), 900)]
    assert list(plain_frames(pieces, LinkSettings())) == whole and len(whole) == len(octets) // 1279


def test_a_station_that_does_not_answer_is_named(typed):
    assert "SOURCE: expected a station at 127.0.0.1:1, found Connection refused" in typed("tm frames 127.0.0.1:1", 2)
    assert "SOURCE (no file): expected HOST:PORT, found 'absent.cadu'" in typed("tm frames absent.cadu", 2)
