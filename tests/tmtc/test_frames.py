import numpy as np
import pytest
from spacepackets.ccsds.tm_frame import TmFramePrimaryHeader

from tmtc.errors import FrameError
from tmtc.link.frames import (
    Clcw,
    append_frame_checksums,
    frame_checksums_hold,
    frame_headers,
    idle_data,
    pack_clcw,
    unpack_clcw,
)

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
    frames = np.frombuffer(bytes.fromhex("".join(octets for octets, _ in HEADERS)), dtype=np.uint8).reshape(
        3, 6
    )
    columns = frame_headers(frames)
    for k, name in enumerate(FIELDS):
        assert getattr(columns, name).tolist() == [values[k] for _, values in HEADERS], name


def test_headers_agree_with_spacepackets():
    octets = bytes.fromhex("04C5 05 06 180A")
    theirs = TmFramePrimaryHeader.unpack(octets)
    ours = frame_headers(np.frombuffer(octets, dtype=np.uint8).reshape(1, 6))
    assert (theirs.master_channel_id.spacecraft_id, theirs.vc_id) == (
        ours.spacecraft_id[0],
        ours.virtual_channel[0],
    )
    assert (theirs.master_ch_frame_count, theirs.vc_frame_count) == (
        ours.master_count[0],
        ours.channel_count[0],
    )
    assert theirs.frame_datafield_status.first_header_pointer == ours.first_header_pointer[0]


def test_frame_checksums_hold_until_a_bit_flips():
    frames = np.random.default_rng(0).integers(0, 256, (5, 100), dtype=np.uint8)
    append_frame_checksums(frames)
    assert frame_checksums_hold(frames).all()
    frames[3, 50] ^= 1
    assert frame_checksums_hold(frames).tolist() == [True, True, True, False, True]


@pytest.mark.parametrize(
    "clcw",
    [
        Clcw(0, 0),
        Clcw(63, 255, True, True, True, True, True, 3, 7),
        Clcw(5, 17, lockout=True, farm_b_counter=2),
    ],
)
def test_command_link_control_words_come_back(clcw):
    assert unpack_clcw(pack_clcw(clcw)) == clcw


def test_a_control_word_has_the_bits_that_the_standard_draws():
    # type 0, version 00, status 000, COP 01 | VC 000101, spare 00 |
    # no RF 0, no lock 0, lockout 1, wait 0, retransmit 1, FARM-B 10, spare 0 | 17
    assert pack_clcw(Clcw(5, 17, lockout=True, retransmit=True, farm_b_counter=2)) == bytes.fromhex(
        "01142C11"
    )
    with pytest.raises(FrameError):
        unpack_clcw(b"\xff\xff\xff\xff")


def test_idle_data_starts_with_the_register_of_ones():
    # 1 + D + D^2 + D^22 + D^32: thirty-two ones, then the sum of taps
    data = idle_data(1100)
    assert data[:5].hex() == "ffffffff6d"
    bits = np.unpackbits(np.frombuffer(data, dtype=np.uint8)).astype(int)
    n = np.arange(32, bits.size)
    assert np.array_equal(bits[n], (bits[n - 1] + bits[n - 2] + bits[n - 22] + bits[n - 32]) % 2)
