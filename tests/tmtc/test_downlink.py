"""The whole chain, packets to CADUs and back, under every setting and every injury; control words of a downlink."""

import functools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import array_equal, count_nonzero
from numpy.random import default_rng
from pytest import mark, raises
from spacepackets.ccsds.tm_frame import TmFramePrimaryHeader, TmTransferFrame

from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import (
    FRAME_BAD_CHECKSUM,
    FRAME_FOREIGN,
    FRAME_UNCORRECTABLE,
    DownlinkEncoder,
    LinkSettings,
    decode,
    encode_cadus,
)
from tmtc.errors import ChecksumError, FrameError, LinkFormatError, TruncatedPacket, ValueRefused
from tmtc.link.cadu import ASM
from tmtc.link.frames import (
    Clcw,
    append_frame_checksums,
    frame_checksums_hold,
    frame_headers,
    idle_data,
    pack_clcw,
    randomise,
    sequence,
    unpack_clcw,
    uplink_seen,
)
from tmtc.packets.space_packets import PacketSequencer, append_crc, check_crc, crc16, pack_packet

# Packet of the altimeter that the payload had until commit 7787a11f, from a recording.
WITHDRAWN = bytes.fromhex(
    "08aec000005b208110000000002e37acc8b4000000000001000037acc8b4000003000037acc8a780000046953a47c2e097e944840c4c000037ac"
    "c8ac80000046951753c1a0a35e43eb070e000037acc8b180000046959823427dad7643d2dbfae2f3"
)


def make_packets(count, seed=0, boot=1, start_s=0):
    rng = default_rng(seed)
    sequencer = PacketSequencer()
    packets = []

    def add(name, apid, **values):
        packets.append(DICTIONARY.pack(name, values, ticks=ticks, sequence_count=sequencer.next(apid)))

    for k in range(count):
        ticks = start_s + k << 16
        n = int(rng.integers(0, 30))
        items = {
            "u_px": rng.uniform(0, 511, n), "v_px": rng.uniform(0, 511, n), "diameter_px": rng.uniform(5, 80, n),
            "score": rng.uniform(0, 1, n), "size_class": rng.integers(-1, 4, n), "sigma_px": np.full(n, np.nan),
        }  # fmt: skip
        add("detections", 0xA1, frame_number=k, image_ticks=ticks, image_quality=0, items=items)
        add("event_low", 0xA4, event_id="fix_refused", frame_number=k, value_1=1.0, value_2=2.0)
        if k % 10 == 0:
            zeros = {f.name: 0 for f in DICTIONARY.packet("housekeeping").fields}
            add("housekeeping", 0xA0, **zeros | {"structure_id": 1, "boot_count": boot})
    return packets


def stranger_of(apid, octets):
    """A packet of an APID that no dictionary has."""
    return append_crc(pack_packet(apid, bytes(octets + 2), sequence_count=0)[:-2])


@functools.cache
def sent():
    return make_packets(200)


def read(octets, **options):
    """Decode, and see that all octets are accounted for."""
    decoded = decode(octets, **options)
    assert sum(decoded.octets.values()) == len(octets) and min(decoded.octets.values()) >= 0
    return decoded


def packets_of(decoded):
    return list(decoded.cut.packets(decoded.buffer))


def cadus(spacecraft_id=76, **options):
    return encode_cadus(sent(), spacecraft_id=spacecraft_id, **options)


@mark.parametrize("randomiser", ["none", "legacy", "long"])
@mark.parametrize("coding", ["rs", "none"])
@mark.parametrize("checksum", [True, False])
@mark.parametrize("frame_length", [223, 892, 1000, 1115])
def test_what_is_sent_comes_back_and_the_settings_are_found_out(randomiser, coding, checksum, frame_length):
    chosen = {"frame_length": frame_length, "coding": coding, "randomiser": randomiser}
    decoded = read(cadus(**chosen, checksum=checksum))
    assert packets_of(decoded) == sent()
    assert decoded.spacecraft_id == 76 and decoded.complete
    assert {name: getattr(decoded.settings, name) for name in chosen} == chosen


@mark.parametrize("errors", [8, 16])
@mark.parametrize("dual_basis", [True, False])
@mark.parametrize("interleave", [1, 2, 3, 4, 5, 8])
def test_every_reed_solomon_setting_is_found_out(errors, dual_basis, interleave):
    frame_length = (255 - 2 * errors - 3) * interleave
    wanted = LinkSettings(
        frame_length=frame_length, rs_errors=errors, interleave=interleave, dual_basis=dual_basis,
        randomiser="long",
    )  # fmt: skip
    decoded = read(DownlinkEncoder(5, wanted).encode(sent()))
    assert decoded.settings == wanted
    assert packets_of(decoded) == sent()


def test_a_cadu_of_the_default_link_is_1279_octets_and_its_frame_what_spacepackets_reads():
    octets = encode_cadus(sent()[:1], spacecraft_id=76)
    assert len(octets) == 1279 and octets[:4] == ASM
    octets = encode_cadus(
        sent()[:40], spacecraft_id=76, virtual_channel=2, coding="none", randomiser="none", frame_length=512
    )
    frames = [octets[at + 4 : at + 516] for at in range(0, len(octets), 516)]
    theirs = [TmTransferFrame.unpack(frame, 512, has_error_control_field=True) for frame in frames]
    assert [f.primary_header.vc_frame_count for f in theirs] == list(range(len(frames)))
    assert {f.primary_header.vc_id for f in theirs} == {2}
    assert b"".join(bytes(f.data_field) for f in theirs).startswith(b"".join(sent()[:40]))


def test_bare_packets_are_recognised_an_empty_file_is_empty_and_long_packets_span_frames():
    decoded = read(b"".join(sent()))
    assert decoded.settings is None and decoded.frames is None
    assert decoded.packets == len(sent()) and decoded.complete
    assert decoded.by_apid == {0xA0: 20, 0xA1: 200, 0xA4: 200}
    decoded = read(b"")
    assert (decoded.packets, decoded.octets_skipped, decoded.frame_count) == (0, 0, 0)
    assert encode_cadus([], spacecraft_id=1) == b""
    packets = [stranger_of(0x7A, 5000), *sent()[:3]]
    assert packets_of(read(encode_cadus(packets, spacecraft_id=1, frame_length=223))) == packets


@mark.parametrize("spare", range(9))
def test_the_last_frame_is_filled_exactly_however_little_is_left(spare):
    # zone of 215 octets: the packet leaves 0..8, fewer than the seven of the least idle packet among them
    packet = stranger_of(0x11, 207 - spare)
    decoded = read(encode_cadus([packet], spacecraft_id=1, frame_length=223, coding="none"))
    assert packets_of(decoded) == [packet]
    assert decoded.octets_skipped == 0 and decoded.octets["idle_packets"] in (0, spare, spare + 215)


def test_counts_go_on_from_dump_to_dump_and_virtual_channels_are_rebuilt_apart():
    encoder = DownlinkEncoder(76, LinkSettings(frame_length=64, coding="none"))
    decoded = read(b"".join(encoder.encode(sent()[k : k + 7]) for k in range(0, len(sent()), 7)))
    assert decoded.frame_count > 256 and decoded.frames_lost == 0
    assert packets_of(decoded) == sent()
    encoder = DownlinkEncoder(76)
    octets = b""
    for k in range(0, len(sent()), 20):
        octets += encoder.encode(sent()[k : k + 10], virtual_channel=0)
        octets += encoder.idle(2)
        octets += encoder.encode(sent()[k + 10 : k + 20], virtual_channel=1)
    decoded = read(octets)
    assert sorted(packets_of(decoded)) == sorted(sent())
    assert decoded.complete and decoded.octets["idle_frames"] == 2 * 21 * 1107


def test_the_command_link_control_word_comes_down_with_each_frame():
    clcw = Clcw(3, 9, retransmit=True)
    encoder = DownlinkEncoder(76)
    decoded = read(encoder.encode(sent(), clcw=pack_clcw(clcw)) + encoder.idle(1, clcw=pack_clcw(clcw)))
    assert packets_of(decoded) == sent()
    assert {unpack_clcw(int(word).to_bytes(4, "big")) for word in decoded.frames.clcw} == {clcw}


def test_each_frame_carries_the_control_word_of_the_last_packet_that_began():
    encoder = DownlinkEncoder(76)
    clcws = [pack_clcw(Clcw(0, k & 0xFF, farm_b_counter=k >> 8)) for k in range(len(sent()))]
    decoded = read(encoder.encode(sent(), clcw=clcws))
    assert packets_of(decoded) == sent() and decoded.complete
    starts = np.cumsum([0, *map(len, sent())])[:-1]
    for frame, word in enumerate(decoded.frames.clcw):
        begun = int(count_nonzero(starts < (frame + 1) * (1115 - 6 - 4 - 2))) - 1
        assert int(word).to_bytes(4, "big") == clcws[begun]
    with raises(ValueRefused, match="one for each packet"):
        encoder.encode(sent(), clcw=clcws[1:])
    with raises(ValueRefused, match="4 octets"):
        encoder.encode(sent()[:1], clcw=b"\x01\x00\x00")


def test_frames_with_and_without_control_words_are_read_from_one_stream():
    encoder = DownlinkEncoder(76)
    decoded = read(encoder.encode(sent()[:50]) + encoder.encode(sent()[50:], clcw=pack_clcw(Clcw(0, 5))))
    assert sorted(packets_of(decoded)) == sorted(sent()) and decoded.complete
    (seen,) = decoded.uplink
    assert 0 < seen.frames < decoded.frame_count and seen.report_value == 5 and seen.changes == 0
    assert read(encoder.encode(sent())).uplink == ()


# injuries of the link


def test_a_lost_frame_costs_the_packets_that_touch_it_and_no_other():
    octets = cadus()
    stops = np.cumsum([*map(len, sent())])
    first, last = np.array([0, *stops[:-1]]) // 1107, (stops - 1) // 1107
    hit = np.flatnonzero((first <= 5) & (last >= 5))
    decoded = read(octets[: 5 * 1279] + octets[6 * 1279 :])
    assert packets_of(decoded) == [p for k, p in enumerate(sent()) if k not in hit]
    assert decoded.frames_lost == 1 and decoded.frames_bad == 0
    assert decoded.sequence.missing == len(hit)


def test_frames_that_come_twice_or_late_are_not_lost_and_uncorrectable_ones_located():
    octets = cadus()
    frames = [octets[k : k + 1279] for k in range(0, len(octets), 1279)]
    again = frames[:20] + frames[:10] + frames[20:40] + frames[5:15] + frames[40:]
    late = frames[:10] + frames[12:20] + frames[10:12] + frames[20:]
    found = [read(b"".join(one)) for one in (again, late, late[:30] + late[33:] + late[:5])]
    assert [one.frames_lost for one in found] == [0, 0, 3]
    assert all({*packets_of(one)} == {*sent()} for one in found[:2])
    octets = bytearray(cadus())
    octets[5 * 1279 + 10 : 5 * 1279 + 10 + 17 * 5 : 5] = bytes(17)
    decoded = read(bytes(octets))
    assert decoded.frames_bad == 1 and decoded.frames.verdict[5] == FRAME_UNCORRECTABLE
    assert (decoded.frames.corrected[5] < 0).sum() == 1


def test_correctable_errors_cost_nothing_are_counted_and_may_be_in_every_codeword():
    octets = bytearray(cadus())
    for frame in (1, 3):
        for k in range(16 * 5):  # sixteen errors in each of the five codewords
            octets[frame * 1279 + 4 + 200 + k] ^= 0x5A
    decoded = read(bytes(octets))
    assert packets_of(decoded) == sent()
    assert decoded.symbols_corrected == 160 and decoded.complete
    assert decoded.frames.corrected[[1, 3]].tolist() == [[16] * 5] * 2
    octets = bytearray(encode_cadus(sent()[:60], spacecraft_id=76, randomiser="long"))
    for at in range(0, len(octets), 1279):
        octets[at + 300 : at + 305] = octets[at + 400 : at + 405] = bytes(5)
    decoded = read(bytes(octets))
    assert packets_of(decoded) == sent()[:60]
    assert decoded.settings.randomiser == "long"


def test_frames_with_a_bad_checksum_or_of_another_spacecraft_are_not_used():
    octets = bytearray(cadus(coding="none"))
    octets[3 * 1119 + 500] ^= 1
    decoded = read(bytes(octets))
    assert decoded.frames_bad == 1 and decoded.frames.verdict[3] == FRAME_BAD_CHECKSUM
    assert decoded.crc_errors == 0 and decoded.sequence.missing > 0
    other = encode_cadus(make_packets(3, seed=9), spacecraft_id=77)
    octets = cadus() + other
    decoded = read(octets)
    assert packets_of(decoded) == sent()
    assert decoded.frames_bad == (decoded.frames.verdict == FRAME_FOREIGN).sum() == len(other) // 1279
    assert read(octets, spacecraft_id=77).packets == len(make_packets(3, seed=9))


def test_attaching_in_mid_stream_or_frame_and_truncation_cost_no_whole_frame():
    # the first frames begin with the rest of a packet whose head was never received
    decoded = read(cadus()[3 * 1279 :])
    found = packets_of(decoded)
    assert found == sent()[len(sent()) - len(found) :]
    starts = np.cumsum([0, *map(len, sent())])
    assert len(found) == int(count_nonzero(starts[:-1] >= 3 * 1107))
    assert decoded.octets["orphaned"] == starts[len(sent()) - len(found)] - 3 * 1107
    assert decoded.crc_errors == 0
    assert read(cadus()[777:]).octets["unsynchronised"] == 1279 - 777
    decoded = read(cadus()[: 7 * 1279 + 600])
    assert decoded.frame_count == 7 and decoded.octets["unsynchronised"] == 600
    found = packets_of(decoded)
    assert found == sent()[: len(found)] and decoded.crc_errors == 0


def test_a_dump_that_comes_twice_is_duplicates_and_late_playback_and_a_reboot_leave_no_gap():
    encoder, half = DownlinkEncoder(76), len(sent()) // 2
    boots = make_packets(40, boot=1) + make_packets(40, seed=1, boot=2, start_s=5000)
    for octets, packets, duplicates in (
        (cadus() * 2, 2 * len(sent()), len(sent())),
        (encoder.encode(sent()[half:]) + encoder.encode(sent()[:half]), len(sent()), 0),
        (encode_cadus(boots, spacecraft_id=76), len(boots), 0),
    ):
        decoded = read(octets)
        found = decoded.sequence
        assert (decoded.packets, found.duplicates, found.gaps, found.conflicts) == (packets, duplicates, 0, 0)
    assert {account.boot for account in found.accounts} == {1, 2}


def test_unknown_packets_are_counted_given_settings_used_and_markers_without_frames_an_error():
    stranger = stranger_of(0x55, 28)
    decoded = read(b"".join([*sent()[:5], stranger, WITHDRAWN, *sent()[5:]]))
    assert decoded.unknown == 2 and not decoded.complete
    assert decoded.by_apid[0x55] == decoded.by_apid[0x0AE] == 1
    assert WITHDRAWN in set(packets_of(decoded))
    noise = default_rng(3).integers(0, 256, (30, 700), dtype=np.uint8)
    noise[:, :4] = np.frombuffer(ASM, dtype=np.uint8)
    with raises(LinkFormatError, match="mostly 700 octets apart"):
        read(noise.tobytes())
    wrong = read(cadus(), settings=LinkSettings(randomiser="none", dual_basis=False))
    assert wrong.packets == 0 and wrong.frames_bad == wrong.frame_count


def test_the_legacy_sequence_is_a_codeword_so_that_the_code_alone_cannot_tell_it_from_none():
    # the reason why the settings are found out by headers and packets as well
    from tmtc.link.reed_solomon import ReedSolomon, clean

    assert clean(randomise(np.zeros((1, 255), dtype=np.uint8), "legacy"), ReedSolomon(interleave=1)).all()


def test_impossible_settings_are_refused():
    for spacecraft_id, options, error, message in (
        (1024, {}, ValueRefused, "spacecraft_id"), (1, {"virtual_channel": 8}, ValueRefused, "virtual_channel"),
        (1, {"frame_length": 2049, "coding": "none"}, ValueRefused, "frame_length"),
        (1, {"frame_length": 1117}, LinkFormatError, "found 1117"),
    ):  # fmt: skip
        with raises(error, match=message):
            cadus(spacecraft_id, **options)


def test_the_largest_frame_of_the_standard_is_a_frame():
    assert packets_of(read(cadus(1, frame_length=2048, coding="none"))) == sent()


SENT = make_packets(30, seed=7)
STREAMS = {coding: encode_cadus(SENT, spacecraft_id=76, frame_length=223, coding=coding) for coding in ("rs", "none")}


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["rs", "none"]),
    st.lists(
        st.tuples(st.sampled_from(["flip", "insert", "delete"]), st.integers(0, 10**9), st.integers(0, 300)), max_size=6
    ),
)
def test_whatever_the_link_does_no_packet_is_invented_and_every_octet_is_accounted_for(coding, injuries):
    octets = bytearray(STREAMS[coding])
    for kind, position, size in injuries:
        at = position % len(octets)
        if kind == "flip":
            octets[at] ^= 1 << size % 8
        elif kind == "insert":
            octets[at:at] = bytes(size)
        else:
            del octets[at : at + size]
    decoded = read(bytes(octets), settings=LinkSettings(frame_length=223, coding=coding))
    assert set(packets_of(decoded)) <= set(SENT)
    assert decoded.sequence.conflicts == 0 and decoded.sequence.duplicates == 0


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=3000))
def test_any_octets_at_all_are_decoded_or_refused(octets):
    for given_settings in (None, LinkSettings(frame_length=223), LinkSettings(frame_length=64, coding="none")):
        try:
            read(octets, settings=given_settings)
        except LinkFormatError:
            continue


# version 00, spacecraft 0001001100, channel 010, OCF 1 | 5 | 6 | flags 000, segment length id 11, pointer 10
HEADERS = """04C50506180A 0 76 2 5 6 10 1 0
3FFFFFFFDFFF 0 1023 7 255 255 2047 1 1
C00000001800 3 0 0 0 0 0 0 0"""
FIELDS = "version spacecraft_id virtual_channel master_count channel_count first_header_pointer ocf secondary_header"


def test_headers_are_those_of_the_standard_and_of_spacepackets_and_checksums_hold_until_a_flip():
    octets, *values = zip(*map(str.split, HEADERS.splitlines()), strict=True)
    columns = frame_headers(np.frombuffer(bytes.fromhex("".join(octets)), dtype=np.uint8).reshape(3, 6))
    for name, expected in zip(FIELDS.split(), values, strict=True):
        assert getattr(columns, name).tolist() == [*map(int, expected)], name
    octets = bytes.fromhex("04C5 05 06 180A")
    theirs = TmFramePrimaryHeader.unpack(octets)
    ours = frame_headers(np.frombuffer(octets, dtype=np.uint8).reshape(1, 6))
    assert (theirs.master_channel_id.spacecraft_id, theirs.vc_id) == (ours.spacecraft_id[0], ours.virtual_channel[0])
    assert (theirs.master_ch_frame_count, theirs.vc_frame_count) == (ours.master_count[0], ours.channel_count[0])
    assert theirs.frame_datafield_status.first_header_pointer == ours.first_header_pointer[0]
    frames = default_rng(0).integers(0, 256, (5, 100), dtype=np.uint8)
    append_frame_checksums(frames)
    assert frame_checksums_hold(frames).all()
    frames[3, 50] ^= 1
    assert frame_checksums_hold(frames).tolist() == [True, True, True, False, True]


@mark.parametrize(
    "clcw", [Clcw(0, 0), Clcw(63, 255, True, True, True, True, True, 3, 7), Clcw(5, 17, lockout=True, farm_b_counter=2)]
)
def test_command_link_control_words_come_back(clcw):
    assert unpack_clcw(pack_clcw(clcw)) == clcw


def test_control_words_idle_data_and_checksums_are_those_of_the_standard():
    # type 0, version 00, status 000, COP 01 | VC 000101, spare 00 |
    # no RF 0, no lock 0, lockout 1, wait 0, retransmit 1, FARM-B 10, spare 0 | 17
    assert pack_clcw(Clcw(5, 17, lockout=True, retransmit=True, farm_b_counter=2)) == bytes.fromhex("01142C11")
    with raises(FrameError):
        unpack_clcw(b"\xff\xff\xff\xff")
    # 1 + D + D^2 + D^22 + D^32: thirty-two ones, then the sum of taps
    data = idle_data(1100)
    assert data[:5].hex() == "ffffffff6d"
    bits = np.unpackbits(np.frombuffer(data, dtype=np.uint8)).astype(int)
    n = np.arange(32, bits.size)
    assert array_equal(bits[n], (bits[n - 1] + bits[n - 2] + bits[n - 22] + bits[n - 32]) % 2)
    # CRC-16/IBM-3740, the "CRC-16/CCITT-FALSE" of ECSS-E-ST-70-41C annex B: check value of "123456789"
    assert crc16(b"123456789") == 0x29B1


# ECSS-E-ST-70-41C annex B.1.5 (verification of compliance)
@mark.parametrize("row", ["0000 1D0F", "000000 CC9C", "ABCDEF01 04A2", "1456F89A0001 7FD5"])
def test_the_checksum_agrees_with_the_vectors_of_the_standard(row):
    data, checksum = map(bytes.fromhex, row.split())
    assert crc16(data) == int.from_bytes(checksum, "big")


def test_a_checksum_leaves_no_remainder_and_a_wrong_one_is_reported_with_both_values():
    octets = append_crc(b"any octets")
    assert crc16(octets) == 0
    check_crc(octets, "test")
    with raises(ChecksumError, match="expected checksum 0x29B1, found 0x0000"):
        check_crc(b"123456789\0\0", "test")
    with raises(TruncatedPacket):
        check_crc(b"\0", "test")


SEQUENCES = {
    # CCSDS 131.0-B-3 section 9.4.2: first 40 bits of the 255-bit sequence; more octets from its register
    "legacy": ("FF480EC09A0D70BC8E2C", 255),
    # CCSDS 131.0-B-5 section 10: first 40 bits of the 131071-bit sequence
    "long": ("1C71B91BA9", 131_071),
    # CCSDS 231.0-B section 6: first 40 bits of the telecommand sequence
    "telecommand": ("FF399E5A68", 255),
}


@mark.parametrize("name", SEQUENCES)
def test_sequences_begin_as_the_standards_print_them_and_repeat_after_their_full_period_only(name):
    start, bits = SEQUENCES[name]
    assert sequence(name, len(start) // 2).tobytes().hex().upper() == start
    stream = np.unpackbits(sequence(name, (2 * bits + 7) // 8 + 1))
    assert array_equal(stream[:bits], stream[bits : 2 * bits])
    assert count_nonzero(stream[:bits]) == (bits + 1) // 2  # a maximal sequence has one more one than zeros
    for divisor in (3, 5, 17):
        if bits % divisor == 0:
            assert not array_equal(stream[: bits - bits // divisor], stream[bits // divisor : bits])


@mark.parametrize("name", ["none", "legacy", "long", "telecommand"])
def test_randomising_twice_gives_the_frames_back(name):
    frames = default_rng(0).integers(0, 256, (3, 1275), dtype=np.uint8)
    assert array_equal(randomise(randomise(frames, name), name), frames)


def test_an_unknown_randomiser_is_refused():
    with raises(LinkFormatError, match="expected one of none, legacy, long, telecommand, found 'xyz'"):
        sequence("xyz", 4)


TYPE_TWO_REPORT = 0x8000_0001


def words(*clcws):
    return np.array(
        [one if isinstance(one, int) else int.from_bytes(pack_clcw(one), "big") for one in clcws], dtype=np.uint32
    )


def test_stretches_and_channels_of_control_words_add_up_and_others_are_passed_over():
    locked = Clcw(0, 7, lockout=True, retransmit=True, farm_b_counter=2)
    (seen,) = uplink_seen(words(Clcw(0, 7), Clcw(0, 7), locked, locked, Clcw(0, 8, farm_b_counter=3)))
    assert (seen.frames, seen.changes) == (5, 2)
    assert (seen.frames_lockout, seen.frames_retransmit, seen.frames_wait, seen.frames_no_rf) == (2, 2, 0, 0)
    assert (seen.report_value, seen.farm_b_counter, seen.lockout) == (8, 3, False)
    seen = uplink_seen(words(Clcw(3, 1), 0, Clcw(0, 9), TYPE_TWO_REPORT, Clcw(3, 2), Clcw(0, 9)))
    found = [(one.virtual_channel, one.frames, one.changes, one.report_value) for one in seen]
    assert found == [(0, 2, 0, 9), (3, 2, 1, 2)]
    assert uplink_seen(words(0, TYPE_TWO_REPORT)) == () == uplink_seen(words())
    rng = default_rng(5)
    for _ in range(50):
        stream = words(*(Clcw(0, int(n), lockout=bool(n == 1)) for n in rng.integers(0, 3, 60)))
        first, last = sorted(rng.choice(np.arange(1, 60), 2, replace=False).tolist())
        (whole,), (head,), (tail,), (both,) = (
            uplink_seen(part) for part in (stream, stream[:last], stream[first:], stream[first:last])
        )
        assert head.followed_by(both, sign=-1).followed_by(tail) == whole
