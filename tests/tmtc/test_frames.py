import numpy as np
import pytest
from spacepackets.ccsds.tm_frame import TmFramePrimaryHeader

from tmtc.errors import FrameError, TruncatedPacket, ValueRefused
from tmtc.frames import (
    Clcw,
    TmFrameHeader,
    append_frame_checksums,
    frame_checksums_hold,
    frame_headers,
    idle_data,
    pack_clcw,
    pack_frame_header,
    unpack_clcw,
    unpack_frame_header,
)

HEADERS = [
    TmFrameHeader(0x4C, 0, 0, 0, 0),
    TmFrameHeader(0x3FF, 7, 255, 255, 0x7FF, ocf=True, secondary_header=True, synchronised=True),
    TmFrameHeader(76, 3, 17, 200, 0x7FE, ocf=True),
]


@pytest.mark.parametrize("header", HEADERS)
def test_headers_come_back_scalar_and_vectorised(header):
    octets = pack_frame_header(header)
    assert unpack_frame_header(octets) == header
    columns = frame_headers(np.frombuffer(octets * 2, dtype=np.uint8).reshape(2, 6))
    for name in TmFrameHeader.__dataclass_fields__:
        assert getattr(columns, name).tolist() == [getattr(header, name)] * 2
    assert columns.version.tolist() == [0, 0]


def test_headers_agree_with_spacepackets():
    theirs = TmFramePrimaryHeader.unpack(pack_frame_header(HEADERS[2]))
    assert (theirs.master_channel_id.spacecraft_id, theirs.vc_id) == (76, 3)
    assert (theirs.master_ch_frame_count, theirs.vc_frame_count) == (17, 200)
    assert theirs.frame_datafield_status.first_header_pointer == 0x7FE
    assert theirs.frame_datafield_status.segment_len_id == 0b11


def test_a_header_has_the_bits_that_the_standard_draws():
    # version 00, spacecraft 0001001100, channel 010, OCF 1 | 5 | 6 | flags 000, segment length id 11, pointer 10
    assert pack_frame_header(TmFrameHeader(76, 2, 5, 6, 10, ocf=True)) == bytes.fromhex("04C5 05 06 180A")


def test_fields_that_do_not_fit_are_refused():
    with pytest.raises(ValueRefused, match=r"spacecraft_id: expected 0\.\.1023, found 1024"):
        pack_frame_header(TmFrameHeader(1024, 0, 0, 0, 0))
    with pytest.raises(FrameError, match="expected version 0, found 3"):
        unpack_frame_header(b"\xff" * 6)
    with pytest.raises(TruncatedPacket):
        unpack_frame_header(b"\0" * 5)


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
