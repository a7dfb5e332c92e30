import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmtc.cuc import (
    EPOCH_1958_TAI,
    TICKS_LIMIT,
    CucTime,
    pack_cds,
    pack_cuc,
    pack_cuc_time,
    unpack_cds,
    unpack_cuc,
    unpack_cuc_time,
)
from tmtc.errors import MalformedPacket, TruncatedPacket, ValueRefused


def test_on_board_time_is_p_field_2e_with_four_octets_of_seconds_and_two_of_fraction():
    # 301.0-B-4 3.2.2: agency epoch 010, 4 coarse octets (11), 2 fine octets (10)
    assert pack_cuc(1 << 16 | 0x8000) == bytes.fromhex("2E 00000001 8000")
    assert unpack_cuc(bytes.fromhex("2E 00000001 8000")) == 0x18000


def test_the_1958_epoch_gives_p_field_1e():
    assert pack_cuc_time(CucTime(1, 0, epoch=EPOCH_1958_TAI))[0] == 0x1E


@pytest.mark.parametrize("ticks", [0, 1, TICKS_LIMIT - 1])
def test_the_ends_of_the_range_come_back(ticks):
    assert unpack_cuc(pack_cuc(ticks)) == ticks


@pytest.mark.parametrize("ticks", [-1, TICKS_LIMIT])
def test_times_beyond_the_range_are_refused(ticks):
    with pytest.raises(ValueRefused):
        pack_cuc(ticks)


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 7), st.integers(0, 10), st.data())
def test_cuc_of_any_width_comes_back(coarse_octets, fine_octets, data):
    coarse = data.draw(st.integers(0, 256**coarse_octets - 1))
    fine = data.draw(st.integers(0, 256**fine_octets - 1))
    time = CucTime(coarse, fine, coarse_octets, fine_octets)
    octets = pack_cuc_time(time)
    assert unpack_cuc_time(octets + b"more") == (time, len(octets))


def test_other_fractions_are_given_in_ticks():
    assert CucTime(3, 0x80, 4, 1).ticks == (3 << 16) + 0x8000
    assert CucTime(3, 0x800001, 4, 3).ticks == (3 << 16) + 0x8000
    assert CucTime(3, 0, 4, 0).ticks == 3 << 16


def test_damaged_times_are_refused():
    with pytest.raises(TruncatedPacket):
        unpack_cuc(b"\x2e\0\0\0")
    with pytest.raises(MalformedPacket, match="expected P-field 0x2E, found 0x1E"):
        unpack_cuc(b"\x1e\0\0\0\0\0\0")
    with pytest.raises(MalformedPacket):
        unpack_cuc_time(b"\x40\0\0\0\0\0\0")
    with pytest.raises(TruncatedPacket):
        unpack_cuc_time(b"\x2e\0\0\0")


def test_cds_short_counts_days_since_1958():
    # 2000-01-01 is day 15340 of the 1958 epoch
    octets = pack_cds(15340, 43_200_000)
    assert octets == bytes.fromhex("40 3BEC 02932E00")
    assert unpack_cds(octets) == (15340, 43_200_000)
