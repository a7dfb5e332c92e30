"""Packets without error control, with other headers, and in damaged streams; packets exported as tables."""

import csv
import functools
import io
import json
import logging
import struct
import sys
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from pytest import mark, raises
from spacepackets.ccsds import CdsShortTimestamp, PacketId, PacketType
from spacepackets.ccsds.spacepacket import parse_space_packets

from tests.lazy import Lazy
from tests.tmtc.foreign import bus_like, capture, comparison, container, floating, integer, space_packet
from tests.tmtc.test_downlink import make_packets
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import (
    FRAME_GOOD,
    FRAME_UNCHECKED,
    DownlinkEncoder,
    LinkSettings,
    decode,
    encode_cadus,
    propose_settings,
)
from tmtc.errors import LinkFormatError, MissingLibrary, UnknownPacket, ValueRefused
from tmtc.export import format_onboard_times, format_records, packet_records, parquet_octets
from tmtc.packets.space_packets import append_crc, idle_packet, pack_packet
from tmtc.packets.stream import UNCHECKED, PacketForm, cut_packets, find_prefix
from tmtc.xtce.decode import Decoder
from tmtc.xtce.importing import parse_xtce


def ephemeris(count):
    """An attitude and ephemeris packet as of a weather satellite: 71 octets, CDS time, no error control."""
    rng = np.random.default_rng(count)
    time = struct.pack(">HIH", 23109, count * 1000, 0)
    body = bytes((159,)) + time + rng.normal(size=6).astype(">f4").tobytes() + time
    return space_packet(11, time + body + rng.normal(size=4).astype(">f4").tobytes() + b"\x00" * 8, count)


def cut(octets):
    found = cut_packets(octets, form=UNCHECKED)
    rows = [(s, s + n) for s, n in zip(found.offsets.tolist(), found.lengths.tolist(), strict=True)]
    rows += [tuple(r) for r in found.skipped.tolist()] + [tuple(r) for r in found.idle.tolist()]
    rows.sort()
    assert [a for a, _ in rows] == [0, *(b for _, b in rows[:-1])] and rows[-1][1] == len(octets)
    return found


def columns_of(text, octets):
    """Values of the packets of a stream of one kind."""
    (table,) = Decoder(parse_xtce(text)).decode(octets, cut(octets)).tables.values()
    return {name: column.to_list() for name, column in table.columns.items()}


def packets_of(octets):
    return list(cut(octets).packets(octets))


def test_a_capture_of_7200_packets_without_error_control_is_read_whole():
    packets = [ephemeris(k) for k in range(7200)]
    octets = b"".join(packets)
    assert packets_of(octets) == packets
    theirs = parse_space_packets(octets, [PacketId(PacketType.TM, True, 11)])
    assert [bytes(p) for p in theirs.tm_list] == packets
    decoded = decode(octets, form=UNCHECKED)
    assert (decoded.packets, decoded.sequence.gaps, decoded.octets_skipped) == (7200, 0, 0)
    assert decoded.by_apid == {11: 7200}


def test_without_settings_nothing_is_taken_for_a_packet():
    octets = b"".join(ephemeris(k) for k in range(100))
    assert decode(octets).packets == 0


@mark.parametrize("seed", range(4))
def test_packets_of_all_kinds_with_and_without_secondary_header_are_read(seed):
    packets = capture(300, seed)
    assert packets_of(b"".join(packets)) == packets


def test_ccsdspy_reads_the_same_columns():
    import ccsdspy

    ccsdspy.log.setLevel(logging.ERROR)
    packets = [ephemeris(k) for k in range(500)]
    octets = b"".join(packets)
    own = {"DAY": "U16", "MS": "U32", "US": "U16", "ID": "U8", "TIME": "U64", **{f"P{k}": "F" for k in range(6)}}
    own |= {"AGAIN": "U64", **{f"Q{k}": "F" for k in range(4)}, "REST": "U64"}
    fields = [
        ccsdspy.PacketField(name, "float" if kind == "F" else "uint", 32 if kind == "F" else int(kind[1:]))
        for name, kind in own.items()
    ]
    theirs = ccsdspy.FixedLength(fields).load(io.BytesIO(octets))
    body = container("ephemeris", list(own), "CCSDSPacket", comparison("PKT_APID", 11))
    text = bus_like(own, body, types=integer("U64", 64) + floating("F", 32))
    ours = columns_of(text, octets)
    assert all(np.array_equal(ours[name], theirs[name]) for name in own)


# times of secondary headers


@mark.parametrize("coarse", range(1, 8))
@mark.parametrize("fine", [0, 1, 2, 3, 5])
def test_cuc_times_of_every_width_are_read_through_a_definition(coarse, fine):
    rng = np.random.default_rng(coarse * 10 + fine)
    parameters = {"COARSE": "C", **({"FINE": "F"} if fine else {}), "N": "U8"}
    types = integer("C", 8 * coarse) + (integer("F", 8 * fine) if fine else "")
    text = bus_like(parameters, container("P", list(parameters), "CCSDSPacket"), types=types)
    times = [(rng.bytes(coarse), rng.bytes(fine)) for _ in range(20)]
    octets = b"".join(space_packet(5, c + f + b"\x2a", k) for k, (c, f) in enumerate(times))
    columns = columns_of(text, octets)
    assert columns["COARSE"] == [int.from_bytes(c, "big") for c, _ in times]
    assert columns["N"] == [42] * 20
    if fine:
        assert columns["FINE"] == [int.from_bytes(f, "big") for _, f in times]


def test_a_cds_header_made_by_spacepackets_is_read():
    data = bytes(CdsShortTimestamp(ccsds_days=25000, ms_of_day=86_399_999).pack())
    own = {"P_FIELD": "U8", "DAY": "U16", "MS": "U32"}
    octets = b"".join(space_packet(5, data, k) for k in range(3))
    columns = columns_of(bus_like(own, container("P", list(own), "CCSDSPacket")), octets)
    assert {name: columns[name] for name in own} == {"P_FIELD": [0x40] * 3, "DAY": [25000] * 3, "MS": [86_399_999] * 3}


# damage


def test_octets_between_packets_cost_the_packet_before_which_nothing_confirms():
    rng = np.random.default_rng(1)
    packets = capture(200, 5)
    parts = []
    for k, packet in enumerate(packets):
        parts.append(packet)
        if k % 40 == 20:
            parts.append(b"\xff" + rng.bytes(int(rng.integers(5, 90))))
    octets = b"".join(parts)
    assert packets_of(octets) == [p for k, p in enumerate(packets) if k % 40 != 20]
    assert cut(octets).crc_errors == 5


@mark.parametrize("seed", range(5))
def test_a_hole_costs_the_packets_it_touches(seed):
    rng = np.random.default_rng(seed)
    packets = capture(300, seed)
    octets = b"".join(packets)
    ends = np.cumsum([len(p) for p in packets])
    start = int(rng.integers(len(octets) // 4, len(octets) // 2))
    stop = start + int(rng.integers(1, 3000))
    first, last = np.searchsorted(ends, [start, stop], side="right")
    whole_again = last if stop in (0, *ends) else last + 1
    assert packets_of(octets[:start] + octets[stop:]) == packets[:first] + packets[whole_again:]


def test_headers_alone_at_the_end_or_out_of_their_counts_are_no_packets():
    assert packets_of(b"\xff" * 100 + space_packet(5, b"abc", 0)) == []
    packets = [space_packet(9, b"abc", k) for k in range(20)]
    headers = space_packet(9, b"\xff" * 30, 9000) + space_packet(9, b"\xff" * 30, 4000)
    noise = b"\xff" * 20 + headers + b"\xff" * 5
    found = packets_of(b"".join(packets[:10]) + noise + b"".join(packets[10:]))
    assert found == packets[:9] + packets[10:]


def test_a_wrong_length_a_missing_beginning_and_end_cost_no_more_than_their_packets():
    packets = capture(100, 2)
    broken = bytearray(packets[50])
    broken[4:6] = struct.pack(">H", len(broken) + 100)
    found = packets_of(b"".join([*packets[:50], bytes(broken), *packets[51:]]))
    assert found == packets[:50] + packets[51:]
    packets = capture(60, 3)
    octets = b"".join(packets)
    assert packets_of(octets[5:]) == packets[1:]
    assert packets_of(octets[:-5]) == packets[:-1]
    assert packets_of(packets[0]) == packets[:1]


@mark.parametrize("seed", range(200))
def test_noise_is_no_packet(seed):
    noise = np.random.default_rng(seed).integers(0, 256, 20_000, dtype=np.uint8).tobytes()
    assert len(cut(noise)) == 0


@mark.parametrize("error_control", [False, True])
def test_packets_behind_octets_of_a_recorder_are_found_and_damage_costs_no_other(error_control):
    form, rng = PacketForm(error_control), np.random.default_rng(3)
    packets = capture(200, 4)
    if error_control:
        packets = [append_crc(packet[:4] + (len(packet) - 5).to_bytes(2, "big") + packet[6:]) for packet in packets]
    stream = b"".join(rng.bytes(12) + packet for packet in packets)
    assert find_prefix(np.frombuffer(stream, dtype=np.uint8), form) == 12
    prefixed = replace(form, prefix_octets=12)
    whole = cut_packets(stream, form=prefixed)
    assert (list(whole.packets(stream)), whole.octets_skipped) == (packets, 0)
    at = int(whole.offsets[50])
    damaged = stream[: at + 4] + bytes((0x7F,)) + stream[at + 5 :]  # its length
    found = list(cut_packets(damaged, form=prefixed).packets(damaged))
    assert found == packets[:50] + packets[51:]
    damaged = stream[: at + 9] + bytes((stream[at + 9] ^ 1,)) + stream[at + 10 :]
    assert cut_packets(damaged, form=prefixed).crc_errors == error_control


def test_packets_of_unknown_checksum_are_kept_where_they_lead_to_known_ones():
    known = [space_packet(9, bytes(30), k) for k in range(60)]
    strangers = [space_packet(10 + k % 2, bytes(33), k) for k in range(120)]
    groups = zip(known, strangers[::2], strangers[1::2], strict=True)
    packets = [packet for group in groups for packet in group]
    form = PacketForm(unchecked=frozenset({9}), unknown=frozenset({10, 11}))
    octets = b"".join(packets)
    assert list(cut_packets(octets, form=form).packets(octets)) == packets
    found = cut_packets(octets, form=replace(form, unknown=frozenset()))
    assert len(list(found.packets(octets))) < 120


@given(st.binary(max_size=400), st.lists(st.integers(0, 400), max_size=3))
def test_every_octet_of_anything_is_accounted_for(octets, ends):
    packet = space_packet(7, b"abc", 1)
    mixed = octets
    for place in ends:
        mixed = mixed[:place] + packet + mixed[place:]
    found = cut_packets(mixed, form=UNCHECKED)
    total = int(found.lengths.sum()) + found.octets_skipped + found.octets_idle
    assert total == len(mixed)


def test_idle_packets_are_distinguished_and_pieces_are_refused_without_error_control():
    packets = [space_packet(9, bytes((k,)), k) for k in range(10)]
    found = cut(b"".join(p + idle_packet(20) for p in packets))
    assert len(found) == 10 and found.octets_idle == 200
    with raises(ValueRefused, match="final"):
        cut_packets(b"abc", form=UNCHECKED, final=False)


# in transfer frames


def check(decoded, packets):
    assert list(decoded.cut.packets(decoded.buffer)) == packets
    assert decoded.sequence.gaps == decoded.sequence.missing == 0


def test_packets_without_error_control_are_taken_out_of_frames_except_lost_ones():
    packets = capture(400, 7)
    octets = encode_cadus(packets, spacecraft_id=42)
    check(decode(octets, form=UNCHECKED), packets)
    uncoded = encode_cadus(packets, spacecraft_id=42, coding="none", frame_length=223)
    check(decode(uncoded, form=UNCHECKED), packets)
    packets = capture(400, 8)
    octets = encode_cadus(packets, spacecraft_id=42)
    size = 1279
    decoded = decode(octets[: 5 * size] + octets[6 * size :], form=UNCHECKED)
    zone = 1115 - 6 - 2
    ends = np.cumsum([*map(len, packets)])
    starts = [0, *ends[:-1]]
    kept = [p for p, a, b in zip(packets, starts, ends, strict=True) if b <= 5 * zone or a >= 6 * zone]
    assert list(decoded.cut.packets(decoded.buffer)) == kept and decoded.frames_lost == 1


parquet = Lazy("pyarrow.parquet")

STATE = {f.name: [0.0] * 3 if f.size > 1 else 1 for f in DICTIONARY.packet("navigation_state").fields}


def tables():
    items = {
        "u_px": [1.5, 2.0], "v_px": [3.0, 4.0], "diameter_px": [10.0, 20.0], "score": [1.0, 0.0],
        "size_class": [0, -1], "sigma_px": [0.5, np.nan],
    }  # fmt: skip
    detections = {"frame_number": 1, "image_ticks": 7, "image_quality": "dark"}
    event = {"event_id": "boot", "frame_number": 0, "value_1": 0.25, "value_2": np.nan}
    state = STATE | {"velocity_icrf_m_s": [1.0, 2.0, 3.0], "sigma_rtn_m": [4.0, 5.0, np.nan]}
    octets = b"".join(
        (
            DICTIONARY.pack("event_info", event, ticks=0, sequence_count=0),
            DICTIONARY.pack("detections", {**detections, "items": items}, ticks=3 << 15, sequence_count=0),
            DICTIONARY.pack("detections", {**detections, "items": []}, ticks=2 << 16, sequence_count=1),
            DICTIONARY.pack("navigation_state", state, ticks=2 << 16, sequence_count=0),
        )
    )
    return DICTIONARY.unpack_many(octets, cut_packets(octets))


def test_json_and_csv_hold_the_records_in_order_with_names_and_times_and_no_packets_are_none():
    # 2029-08-07T00:00:00 TAI is 10811 days after the epoch
    times = format_onboard_times(np.array([0, 10811 * 86400 << 16 | 0x8000, (1 << 48) - 1]))
    assert times == ["2000-01-01T00:00:00.000000", "2029-08-07T00:00:00.500000", "2136-02-07T06:28:15.999984"]
    records = packet_records(tables())
    assert [r["packet"] for r in records] == ["event_info", "detections", "detections", "navigation_state"]
    assert records[0]["event_id"] == "boot" and records[0]["value_2"] is None
    assert records[1]["image_quality"] == "dark" and records[1]["onboard_tai"].endswith("00:00:01.500000")
    rows = [list(item.values()) for item in records[1]["items"]]
    assert rows == [[1.5, 3.0, 10.0, 1.0, "5-10 km", 0.5], [2.0, 4.0, 20.0, 0.0, "none", None]]
    assert list(records[1]["items"][0]) == ["u_px", "v_px", "diameter_px", "score", "size_class", "sigma_px"]
    assert records[2]["items"] == []
    assert records[3]["sigma_rtn_m"] == [4.0, 5.0, None]
    assert json.loads(format_records(records, "json")) == records
    rows = list(csv.DictReader(io.StringIO(format_records(records, "csv").decode())))
    assert [row["frame_number"] for row in rows] == ["0", "1", "1", "1"]
    assert [row["velocity_icrf_m_s_2"] for row in rows] == ["", "", "", "2.0"]
    assert json.loads(rows[1]["items"]) == records[1]["items"]
    assert [format_records([], kind) for kind in ("json", "csv")] == [b"[\n\n]\n", b"\n"]
    with raises(UnknownPacket, match="expected one of json, csv, parquet, found 'xml'"):
        format_records([], "xml")


def read_parquet(octets):
    return parquet.read_table(io.BytesIO(octets))


def test_parquet_columns_keep_values_and_gaps_truths_as_integers_and_stay_without_rows():
    table = read_parquet(parquet_octets({"n": [1, None, -3], "x": [0.5, 1, None], "t": ["a", None, "\u00b5"]}))
    assert table.to_pydict() == {"n": [1, None, -3], "x": [0.5, 1.0, None], "t": ["a", None, "\u00b5"]}
    assert [str(field.type) for field in table.schema] == ["int64", "double", "string"]
    assert read_parquet(parquet_octets({"b": [True, None, np.True_.item(), False]})).to_pydict() == {
        "b": [1, None, 1, 0]
    }
    assert read_parquet(parquet_octets({"n": [], "t": []})).column_names == ["n", "t"]


def test_parquet_without_its_library_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with raises(MissingLibrary, match=r"expected the library pyarrow, found none; install linna\[parquet\]"):
        parquet_octets({"n": [1]})


def test_unsigned_integers_of_64_bits_are_written_whole():
    state = STATE | {"image_ticks": 2**64 - 1}
    octets = DICTIONARY.pack("navigation_state", state, ticks=0, sequence_count=0)
    records = packet_records(DICTIONARY.unpack_many(octets, cut_packets(octets)))
    assert json.loads(format_records(records, "json"))[0]["image_ticks"] == 18446744073709551615
    rows = list(csv.DictReader(io.StringIO(format_records(records, "csv").decode())))
    assert rows[0]["image_ticks"] == "18446744073709551615"
    assert read_parquet(format_records(records, "parquet")).column("image_ticks").to_pylist() == [2**64 - 1]


def test_parquet_integers_stay_exact_and_records_are_its_rows():
    table = read_parquet(parquet_octets({"u": [0, None, 2**64 - 1], "both": [-1, 2**63, 5]}))
    assert table.to_pydict() == {"u": [0, None, 2**64 - 1], "both": ["-1", "9223372036854775808", "5"]}
    assert [str(field.type) for field in table.schema] == ["uint64", "string"]
    records = packet_records(tables())
    table = read_parquet(format_records(records, "parquet"))
    assert table.num_rows == len(records)
    assert table.column("apid").to_pylist() == [record["apid"] for record in records]


SETTINGS = LinkSettings()
ZONE = 1115 - 6 - 2


@functools.cache
def sent():
    return make_packets(1500, seed=5)


@functools.cache
def cadus():
    """Return the undamaged stream, one CADU per row."""
    octets = encode_cadus(sent(), spacecraft_id=76)
    return np.frombuffer(octets, dtype=np.uint8).reshape(-1, SETTINGS.cadu_length)


def with_bit_errors(rows, rate, seed):
    bits = np.unpackbits(rows.reshape(-1))
    wrong = np.random.default_rng(seed).random(bits.size) < rate
    return np.packbits(bits ^ wrong).reshape(rows.shape)


def packets_within(received):
    """Return the packets whose frames were all received."""
    edges = np.cumsum([0, *map(len, sent())])
    spans = zip(sent(), edges[:-1] // ZONE, (edges[1:] - 1) // ZONE + 1, strict=True)
    return [packet for packet, first, after in spans if received.issuperset(range(first, after))]


def check_stream(stream, expected, **options):
    octets = stream.tobytes()
    decoded = decode(octets, **options)
    assert set(decoded.cut.packets(decoded.buffer)) == set(expected)
    assert sum(decoded.octets.values()) == len(octets) and min(decoded.octets.values()) >= 0
    return decoded


@mark.parametrize("weak", [20, 100, 180])
def test_weak_frames_at_the_start_hide_neither_the_settings_nor_the_rest(weak):
    rows = cadus().copy()
    rows[:weak] = with_bit_errors(rows[:weak], 1.5e-2, seed=weak)
    known = decode(rows.tobytes(), settings=SETTINGS)
    decoded = check_stream(rows, list(known.cut.packets(known.buffer)))
    assert decoded.settings == propose_settings(cadus()).settings
    assert set(packets_within(set(range(weak, len(rows))))) <= set(decoded.cut.packets(decoded.buffer))
    assert decoded.frame_count == len(rows) and decoded.frames_bad > weak * 0.8


@mark.parametrize("octets", [77_000, 79_000, 3_000_000])
def test_noise_before_the_first_frame_hides_nothing(octets):
    noise = np.random.default_rng(octets).integers(0, 256, octets, dtype=np.uint8)
    decoded = check_stream(np.concatenate((noise, cadus().reshape(-1))), sent())
    assert decoded.octets["unsynchronised"] == octets


@mark.parametrize("rate", [0.0, 2e-3])
def test_a_station_header_before_each_frame_is_distinguished_from_the_frame(rate):
    header = np.random.default_rng(8).integers(0, 256, (len(cadus()), 8), dtype=np.uint8)
    decoded = check_stream(np.hstack((header, with_bit_errors(cadus(), rate, seed=9))), sent())
    assert decoded.settings.coding == "rs"
    assert (decoded.symbols_corrected > 0) == (rate > 0)


def test_gaps_of_any_length_between_frames_cost_nothing():
    rng = np.random.default_rng(10)
    parts = []
    for row in cadus():
        parts += [rng.integers(0, 256, int(rng.integers(0, 60)), dtype=np.uint8), row]
    check_stream(np.concatenate(parts), sent())


@mark.parametrize("rate, seed", [(2e-2, 0), (3e-2, 1)])
def test_frames_that_no_code_can_repair_are_never_good(rate, seed):
    rows = with_bit_errors(cadus()[:60], rate, seed)
    with raises(LinkFormatError, match="no valid frame"):
        decode(rows.tobytes())
    known = decode(rows.tobytes(), settings=SETTINGS)
    assert not (known.frames.verdict == FRAME_GOOD).any()


def test_a_frame_without_code_and_checksum_is_unchecked_and_never_good():
    octets = encode_cadus(sent(), spacecraft_id=76, coding="none", checksum=False)
    decoded = decode(octets)
    assert decoded.packets == len(sent())
    assert set(decoded.frames.verdict.tolist()) == {FRAME_UNCHECKED}
    assert decoded.accounting()["frames_unchecked"] == decoded.frame_count


@mark.parametrize("seed", range(20))
def test_noise_is_never_a_frame_or_a_packet(seed):
    noise = np.random.default_rng(seed).integers(0, 256, 20_000, dtype=np.uint8).tobytes()
    found = decode(noise)
    assert found.packets == 0 and found.frame_count == 0
    known = decode(noise, settings=SETTINGS)
    assert known.packets == 0
    assert not (known.frames.verdict == FRAME_GOOD).any()


def test_frames_of_several_receivers_in_any_order_give_every_packet():
    n = len(cadus())
    any_order = (np.random.default_rng(seed).permutation(n) for seed in range(3))
    for order in (np.repeat(np.arange(n), 2), np.r_[1:n:2, 0:n:2], *any_order):
        decoded = check_stream(cadus()[order], sent())
        assert (decoded.frames_lost, decoded.sequence.missing, decoded.sequence.conflicts) == (0, 0, 0)
    rng = np.random.default_rng(12)
    n = len(cadus())
    first, second = (np.flatnonzero(rng.random(n) > 0.15) for _ in range(2))
    received = set(first.tolist()) | set(second.tolist())
    decoded = check_stream(np.concatenate((cadus()[first], cadus()[second])), packets_within(received))
    assert decoded.frames_lost <= n - len(received)
    long = append_crc(pack_packet(0x55, bytes(range(256)) * 24, sequence_count=3)[:-2])
    octets = DownlinkEncoder(5, LinkSettings(frame_length=223)).encode([*sent()[:3], long, *sent()[3:6]])
    rows = np.frombuffer(octets, dtype=np.uint8).reshape(-1, 259)
    mixed = np.concatenate((rows[:5], rows[9:14], rows[4:10], rows[14:], rows[2:7]))
    decoded = decode(mixed.tobytes())
    assert long in set(decoded.cut.packets(decoded.buffer))
    assert sum(decoded.octets.values()) == mixed.size


def test_bit_slips_cost_only_the_frames_they_hit_and_an_inverted_stream_is_read():
    slips = [9 * 8 * 1279 + 4000, 50 * 8 * 1279 + 77, 100 * 8 * 1279 + 9000]
    stream = np.packbits(np.delete(np.unpackbits(cadus().reshape(-1)), slips))
    received = set(range(len(cadus()))) - {9, 50, 100}
    decoded = check_stream(stream, packets_within(received))
    assert decoded.frames_bad == 3
    check_stream(255 - cadus(), sent())


def test_foreign_packets_are_not_ordered_by_a_time_they_do_not_carry():
    # the 14th octet is that of a CUC time of the dictionary, the six octets behind it count down
    octets = b""
    for k in range(50):
        data = bytes(7) + b"\x2e" + (10**6 - k).to_bytes(6, "big") + bytes(10)
        octets += append_crc(pack_packet(0x123, data, sequence_count=k, secondary_header=True)[:-2])
    decoded = decode(octets)
    assert (decoded.packets, decoded.sequence.gaps, decoded.sequence.missing) == (50, 0, 0)
