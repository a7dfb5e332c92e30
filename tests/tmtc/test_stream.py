"""Packets out of damaged octets: each injury of the known list, then whatever hypothesis thinks of."""

from itertools import accumulate

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import default_rng
from pytest import mark

from tests.tmtc.test_downlink import make_packets
from tmtc.dictionary.payload import DICTIONARY
from tmtc.packets.space_packets import append_crc, crc16, idle_packet, pack_packet
from tmtc.packets.stream import cut_packets

PACKETS = make_packets(480)[:1000]
WHOLE = b"".join(PACKETS)
AT_500 = sum(map(len, PACKETS[:500]))
SWALLOWED = len(PACKETS[501]) + len(PACKETS[502])
"""Octets of exactly two packets."""


def cut_to(octets, expected, **options):
    """Cut octets into the packets that are expected, and see that all octets are accounted for."""
    cut = cut_packets(octets, **options)
    assert list(cut.packets(octets)) == expected
    assert_every_octet_is_accounted_for(octets, cut)
    return cut


def inserted(octets):
    return WHOLE[:AT_500] + octets + WHOLE[AT_500:]


def assert_every_octet_is_accounted_for(octets, cut):
    ranges = np.concatenate((np.stack((cut.offsets, cut.offsets + cut.lengths), axis=1), cut.skipped, cut.idle))
    ranges = ranges[np.argsort(ranges[:, 0], kind="stable")]
    edges = ranges.reshape(-1)
    if len(octets):
        assert edges[0] == 0 and edges[-1] == len(octets)
    assert np.all(ranges[1:, 0] == ranges[:-1, 1])


def test_a_stream_gives_all_its_packets_in_order_also_with_stray_octets():
    cut = cut_to(WHOLE, PACKETS)
    assert (cut.crc_errors, cut.octets_skipped, cut.octets_idle) == (0, 0, 0)
    cut = cut_packets(b"")
    assert len(cut) == 0 and cut.consumed == 0
    cut = cut_to(inserted(b"\x01\x02\x03"), PACKETS)
    assert cut.skipped.tolist() == [[AT_500, AT_500 + 3]]
    assert cut.crc_errors == 0


# the injuries that other decoders were measured with: 3 stray octets, a flipped bit, a wrong length, a cut end


@mark.parametrize("stray", [b"\x08\xa1\xc0", b"\x00" * 40, b"\xff" * 40, WHOLE[3:17], b"\x07\xff\xc0\x00\x00\x09"])
def test_stray_octets_that_look_like_headers_cost_no_packet(stray):
    cut = cut_to(inserted(stray), PACKETS)
    assert cut.octets_skipped + cut.lengths[~cut.crc_ok].sum() + cut.octets_idle == len(stray)


def test_a_flipped_bit_in_a_body_is_one_checksum_error_and_nothing_else():
    octets = bytearray(WHOLE)
    octets[AT_500 + 30] ^= 0x10
    cut = cut_to(octets, PACKETS[:500] + PACKETS[501:])
    assert (cut.crc_errors, cut.octets_skipped) == (1, 0)
    assert cut.lengths[~cut.crc_ok].tolist() == [len(PACKETS[500])]


@mark.parametrize("change", [9, -9, 1, 255, 5000, 40_000, SWALLOWED])
def test_a_wrong_length_field_costs_the_one_packet(change):
    octets, field = bytearray(WHOLE), slice(AT_500 + 4, AT_500 + 6)
    octets[field] = ((int.from_bytes(octets[field], "big") + change) % 65536).to_bytes(2, "big")
    cut = cut_to(octets, PACKETS[:500] + PACKETS[501:])
    assert cut.octets_skipped + cut.lengths[~cut.crc_ok].sum() == len(PACKETS[500])


def test_a_stream_that_begins_or_ends_in_mid_packet_loses_only_that_one():
    octets = WHOLE[: AT_500 + 11]
    cut = cut_to(octets, PACKETS[:500])
    assert cut.skipped.tolist() == [[AT_500, AT_500 + 11]]
    octets = WHOLE[7:]
    cut = cut_to(octets, PACKETS[1:])
    assert cut.octets_skipped == len(PACKETS[0]) - 7


def test_several_damaged_packets_in_a_row_are_separated():
    octets = bytearray(WHOLE)
    at = AT_500
    for packet in PACKETS[500:504]:
        octets[at + 20] ^= 1
        at += len(packet)
    cut = cut_to(octets, PACKETS[:500] + PACKETS[504:])
    assert (cut.crc_errors, cut.octets_skipped) == (4, 0)


def test_a_damaged_packet_that_holds_a_whole_packet_does_not_give_birth_to_it():
    inner = PACKETS[3]
    outer = DICTIONARY.pack(
        "large_data_first",
        {"transaction": 1, "part": 1, "table": "thumbnail", "items": {"octet": list(inner + bytes(20))}},
        ticks=0,
        sequence_count=0,
    )
    damaged = bytearray(outer)
    damaged[-5] ^= 1
    assert cut_to(inserted(bytes(damaged)), PACKETS).crc_errors == 1


def test_idle_packets_are_counted_and_not_given_and_those_of_the_other_type_are_none():
    octets = idle_packet(7) + inserted(idle_packet(300)) + idle_packet(12)
    cut = cut_to(octets, PACKETS)
    assert (cut.octets_idle, cut.octets_skipped) == (319, 0)
    # claims 65542 octets, far more than any damage: the packets "inside" it must come out
    octets = inserted(b"\x07\xff\xc0\x00\xff\xff")
    cut_to(octets, PACKETS)
    command = DICTIONARY.pack_command("test_connection", {}, sequence_count=1)
    cut = cut_packets(inserted(command))
    assert len(cut) == len(PACKETS) and cut.octets_skipped == len(command)
    assert cut_packets(command, packet_type=1).lengths.tolist() == [len(command)]


def test_noise_and_endless_headers_give_no_packets_and_hide_none():
    # 4 MB of noise hold some 500,000 places where a header could stand, eight of which a bare CRC would believe
    noise = default_rng(11).integers(0, 256, 4 << 20, dtype=np.uint8)
    cut = cut_packets(noise)
    assert int(cut.crc_ok.sum()) == 0
    assert cut.octets_skipped + cut.lengths.sum() == noise.size
    # nine octets that claim to be a packet each, none of them one; quadratic work would take minutes here
    octets = bytes.fromhex("000000000002AAAAAA") * 100_000
    cut = cut_packets(octets)
    assert not cut.crc_ok.any()
    assert_every_octet_is_accounted_for(octets, cut)
    rng = default_rng(12)
    parts = []
    for packet in PACKETS[:200]:
        parts += [rng.integers(0, 256, int(rng.integers(0, 3000)), dtype=np.uint8).tobytes(), packet]
    cut_to(b"".join(parts), PACKETS[:200])


def test_segments_are_cut_each_for_itself_and_the_longest_packet_is_one():
    # a packet must not be put together from both sides of a gap
    half = len(PACKETS[500]) // 2
    octets = WHOLE[: AT_500 + half] + WHOLE[AT_500 + half :]
    segments = np.array([[0, AT_500 + half], [AT_500 + half, len(octets)]], dtype=np.int64)
    assert cut_to(octets, PACKETS[:500] + PACKETS[501:], segments=segments).octets_skipped == len(PACKETS[500])
    packet = append_crc(pack_packet(5, bytes(65_536), sequence_count=0)[:-2])
    assert len(packet) == 65_542
    cut_to(packet + packet, [packet, packet])


AT = st.integers(0, 10**9)
INJURIES = st.one_of(
    st.tuples(st.just("flip"), AT, st.integers(0, 7)),
    st.tuples(st.just("insert"), AT, st.binary(max_size=12)),
    st.tuples(st.just("delete"), AT, st.integers(1, 40)),
)


def injure(octets, injuries):
    """The octets after the injuries, and marks (n + 1,): 1 octet k was hit, 2 something was put in before it."""
    before = {}
    values = list(octets)
    marks = np.zeros(len(octets) + 1, dtype=np.uint8)
    for kind, position, what in injuries:
        at = position % len(octets)
        if kind == "flip" and values[at] is not None:
            values[at] ^= 1 << what
            marks[at] |= 1
        elif kind == "insert" and what:
            before[at] = what
            marks[at] |= 2
        elif kind == "delete":
            values[at : at + what] = [None] * len(values[at : at + what])
            marks[at : at + what] |= 1
    result = b"".join(
        before.get(k, b"") + (b"" if value is None else bytes((value,))) for k, value in enumerate(values)
    )
    return result, marks


@settings(max_examples=150, deadline=None)
@given(st.lists(INJURIES, max_size=6))
def test_whatever_happens_no_whole_packet_is_lost_and_none_is_invented(injuries):
    packets = PACKETS[:40]
    octets, marks = injure(b"".join(packets), injuries)
    safe, at = [], 0
    for packet in packets:
        stop = at + len(packet)
        # what is put in before its first octet leaves a packet whole
        if not marks[at] & 1 and not marks[at + 1 : stop].any():
            safe.append(packet)
        at = stop
    cut = cut_packets(octets)
    found = list(cut.packets(octets))
    # injuries may undo each other, so more than the untouched packets may be whole; never others than were sent
    remaining = iter(found)
    assert all(packet in remaining for packet in safe)
    assert set(found) <= set(packets)
    assert_every_octet_is_accounted_for(octets, cut)


@mark.parametrize("cases", [1_000, 100_000])
def test_injured_streams_lose_no_whole_packet_and_invent_none(cases):
    # each case is a segment of its own: two to five packets, of which one to three octets are hit by chance
    rng = default_rng(2029)
    kinds = [
        DICTIONARY.pack("connection_report", {}, ticks=1, sequence_count=0),
        DICTIONARY.pack("verification_started", {"request_id": 77}, ticks=1, sequence_count=0),
        DICTIONARY.pack("parameter_report", {"parameter_id": 3, "value": 0.1}, ticks=1, sequence_count=9),
        PACKETS[0],
    ]
    counts, chosen = rng.integers(2, 6, cases).tolist(), rng.integers(0, 4, (cases, 5)).tolist()
    actions, places = rng.integers(0, 3, (cases, 3)).tolist(), rng.random((cases, 3)).tolist()
    strokes, values = rng.integers(1, 4, cases).tolist(), rng.integers(1, 256, (cases, 3)).tolist()
    buffer, segments, expected = bytearray(), [], []
    for case in range(cases):
        packets = [kinds[k] for k in chosen[case][: counts[case]]]
        octets = bytearray(b"".join(packets))
        starts = [0, *accumulate(map(len, packets))]
        hits = sorted({int(places[case][s] * len(octets)) for s in range(strokes[case])}, reverse=True)
        touched, shifts = set(), []
        for s, at in enumerate(hits):
            action = actions[case][s]
            within = next(k for k in range(len(packets)) if at < starts[k + 1])
            if action == 0:
                octets[at] ^= values[case][s]
                touched.add(within)
                continue
            new = bytes((values[case][s],)) * 3 if action == 1 else b""
            octets[at : at + (action == 2)] = new
            shifts.append((at, 3 if new else -1))
            if not new or at > starts[within]:
                touched.add(within)
        base = len(buffer)
        for k, start in enumerate(starts[:-1]):
            moved = base + start + sum(by for at, by in shifts if at <= start)
            if k not in touched:
                expected.append((moved, len(packets[k])))
        buffer += octets
        segments.append((base, len(buffer)))
    cut = cut_packets(buffer, segments=np.array(segments, dtype=np.int64))
    good = set(zip(cut.offsets[cut.crc_ok].tolist(), cut.lengths[cut.crc_ok].tolist(), strict=True))
    assert set(expected) <= good
    # a damaged packet passes for a whole one at the checksum's own odds: some 200,000 of them, one in 65,536
    assert len([at for at, length in good if bytes(buffer[at : at + length]) not in kinds]) <= 10
    assert int(cut.lengths.sum()) + cut.octets_skipped + cut.octets_idle == len(buffer)


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=400))
def test_any_octets_at_all_are_accounted_for(octets):
    cut = cut_packets(octets)
    assert_every_octet_is_accounted_for(octets, cut)
    for packet in cut.packets(octets):
        assert crc16(packet) == 0
