"""Telecommand channels as control words of a downlink show them."""

import numpy as np
import pytest
from spacepackets.ccsds.tm_frame import TmFramePrimaryHeader

from tmtc.errors import ChecksumError, FrameError, LinkFormatError, TruncatedPacket
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
from tmtc.packets.space_packets import append_crc, check_crc, crc16

HEADERS = (
    # version 00, spacecraft 0001001100, channel 010, OCF 1 | 5 | 6 | flags 000, segment length id 11, pointer 10
    ("04C5 05 06 180A", (0, 76, 2, 5, 6, 10, True, False)),
    ("3FFF FF FF DFFF", (0, 1023, 7, 255, 255, 2047, True, True)),
    ("C000 00 00 1800", (3, 0, 0, 0, 0, 0, False, False)),
)
FIELDS = (
    "version", "spacecraft_id", "virtual_channel", "master_count", "channel_count", "first_header_pointer", "ocf",
    "secondary_header",
)  # fmt: skip


def test_header_fields_are_the_bits_that_the_standard_draws():
    frames = np.frombuffer(bytes.fromhex("".join(octets for octets, _ in HEADERS)), dtype=np.uint8).reshape(3, 6)
    columns = frame_headers(frames)
    for k, name in enumerate(FIELDS):
        assert getattr(columns, name).tolist() == [values[k] for _, values in HEADERS], name


def test_headers_agree_with_spacepackets():
    octets = bytes.fromhex("04C5 05 06 180A")
    theirs = TmFramePrimaryHeader.unpack(octets)
    ours = frame_headers(np.frombuffer(octets, dtype=np.uint8).reshape(1, 6))
    assert (theirs.master_channel_id.spacecraft_id, theirs.vc_id) == (ours.spacecraft_id[0], ours.virtual_channel[0])
    assert (theirs.master_ch_frame_count, theirs.vc_frame_count) == (ours.master_count[0], ours.channel_count[0])
    assert theirs.frame_datafield_status.first_header_pointer == ours.first_header_pointer[0]


def test_frame_checksums_hold_until_a_bit_flips():
    frames = np.random.default_rng(0).integers(0, 256, (5, 100), dtype=np.uint8)
    append_frame_checksums(frames)
    assert frame_checksums_hold(frames).all()
    frames[3, 50] ^= 1
    assert frame_checksums_hold(frames).tolist() == [True, True, True, False, True]


@pytest.mark.parametrize(
    "clcw", [Clcw(0, 0), Clcw(63, 255, True, True, True, True, True, 3, 7), Clcw(5, 17, lockout=True, farm_b_counter=2)]
)
def test_command_link_control_words_come_back(clcw):
    assert unpack_clcw(pack_clcw(clcw)) == clcw


def test_a_control_word_has_the_bits_that_the_standard_draws():
    # type 0, version 00, status 000, COP 01 | VC 000101, spare 00 |
    # no RF 0, no lock 0, lockout 1, wait 0, retransmit 1, FARM-B 10, spare 0 | 17
    assert pack_clcw(Clcw(5, 17, lockout=True, retransmit=True, farm_b_counter=2)) == bytes.fromhex("01142C11")
    with pytest.raises(FrameError):
        unpack_clcw(b"\xff\xff\xff\xff")


def test_idle_data_starts_with_the_register_of_ones():
    # 1 + D + D^2 + D^22 + D^32: thirty-two ones, then the sum of taps
    data = idle_data(1100)
    assert data[:5].hex() == "ffffffff6d"
    bits = np.unpackbits(np.frombuffer(data, dtype=np.uint8)).astype(int)
    n = np.arange(32, bits.size)
    assert np.array_equal(bits[n], (bits[n - 1] + bits[n - 2] + bits[n - 22] + bits[n - 32]) % 2)


def test_the_checksum_has_the_published_check_value():
    # CRC-16/IBM-3740, the "CRC-16/CCITT-FALSE" of ECSS-E-ST-70-41C annex B: check value of "123456789"
    assert crc16(b"123456789") == 0x29B1


# ECSS-E-ST-70-41C annex B.1.5 (verification of compliance)
@pytest.mark.parametrize("row", ["0000 1D0F", "000000 CC9C", "ABCDEF01 04A2", "1456F89A0001 7FD5"])
def test_the_checksum_agrees_with_the_vectors_of_the_standard(row):
    data, checksum = map(bytes.fromhex, row.split())
    assert crc16(data) == int.from_bytes(checksum, "big")


def test_octets_with_their_checksum_leave_no_remainder():
    octets = append_crc(b"any octets")
    assert crc16(octets) == 0
    check_crc(octets, "test")


def test_a_wrong_checksum_is_reported_with_both_values():
    with pytest.raises(ChecksumError, match="expected checksum 0x29B1, found 0x0000"):
        check_crc(b"123456789\0\0", "test")
    with pytest.raises(TruncatedPacket):
        check_crc(b"\0", "test")


SEQUENCES = {
    # CCSDS 131.0-B-3 section 9.4.2: first 40 bits of the 255-bit sequence; more octets from its register
    "legacy": ("FF480EC09A0D70BC8E2C", 255),
    # CCSDS 131.0-B-5 section 10: first 40 bits of the 131071-bit sequence
    "long": ("1C71B91BA9", 131_071),
    # CCSDS 231.0-B section 6: first 40 bits of the telecommand sequence
    "telecommand": ("FF399E5A68", 255),
}


@pytest.mark.parametrize("name", SEQUENCES)
def test_sequences_begin_as_the_standards_print_them_and_repeat_after_their_full_period_only(name):
    start, bits = SEQUENCES[name]
    assert sequence(name, len(start) // 2).tobytes().hex().upper() == start
    stream = np.unpackbits(sequence(name, (2 * bits + 7) // 8 + 1))
    assert np.array_equal(stream[:bits], stream[bits : 2 * bits])
    assert np.count_nonzero(stream[:bits]) == (bits + 1) // 2  # a maximal sequence has one more one than zeros
    for divisor in (3, 5, 17):
        if bits % divisor == 0:
            assert not np.array_equal(stream[: bits - bits // divisor], stream[bits // divisor : bits])


@pytest.mark.parametrize("name", ["none", "legacy", "long", "telecommand"])
def test_randomising_twice_gives_the_frames_back(name):
    frames = np.random.default_rng(0).integers(0, 256, (3, 1275), dtype=np.uint8)
    assert np.array_equal(randomise(randomise(frames, name), name), frames)


def test_an_unknown_randomiser_is_refused():
    with pytest.raises(LinkFormatError, match="expected one of none, legacy, long, telecommand, found 'xyz'"):
        sequence("xyz", 4)


TYPE_TWO_REPORT = 0x8000_0001


def words(*clcws):
    return np.array(
        [one if isinstance(one, int) else int.from_bytes(pack_clcw(one), "big") for one in clcws], dtype=np.uint32
    )


def test_a_stretch_is_summed_up_and_its_newest_word_is_shown():
    locked = Clcw(0, 7, lockout=True, retransmit=True, farm_b_counter=2)
    (seen,) = uplink_seen(words(Clcw(0, 7), Clcw(0, 7), locked, locked, Clcw(0, 8, farm_b_counter=3)))
    assert (seen.frames, seen.changes) == (5, 2)
    assert (seen.frames_lockout, seen.frames_retransmit, seen.frames_wait, seen.frames_no_rf) == (2, 2, 0, 0)
    assert (seen.report_value, seen.farm_b_counter, seen.lockout) == (8, 3, False)


def test_channels_are_kept_apart_and_what_is_no_control_word_is_passed_over():
    seen = uplink_seen(words(Clcw(3, 1), 0, Clcw(0, 9), TYPE_TWO_REPORT, Clcw(3, 2), Clcw(0, 9)))
    found = [(one.virtual_channel, one.frames, one.changes, one.report_value) for one in seen]
    assert found == [(0, 2, 0, 9), (3, 2, 1, 2)]
    assert uplink_seen(words(0, TYPE_TWO_REPORT)) == () == uplink_seen(words())


def test_overlapping_stretches_add_up_to_the_whole():
    rng = np.random.default_rng(5)
    for _ in range(50):
        stream = words(*(Clcw(0, int(n), lockout=bool(n == 1)) for n in rng.integers(0, 3, 60)))
        first, last = sorted(rng.choice(np.arange(1, 60), 2, replace=False).tolist())
        (whole,), (head,), (tail,), (both,) = (
            uplink_seen(part) for part in (stream, stream[:last], stream[first:], stream[first:last])
        )
        assert head.followed_by(both, sign=-1).followed_by(tail) == whole
