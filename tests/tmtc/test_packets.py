import pytest
from spacepackets.ccsds import PacketType, SpacePacketHeader

from tmtc.errors import MalformedPacket, TruncatedPacket, ValueRefused
from tmtc.packets.space_packets import (
    PacketSequencer,
    PrimaryHeader,
    idle_packet,
    pack_packet,
    unpack_primary_header,
)


@pytest.mark.parametrize("apid", [0, 0x0A0, 0x7FF])
@pytest.mark.parametrize("count", [0, 16383])
@pytest.mark.parametrize("packet_type", [0, 1])
def test_headers_agree_with_spacepackets(apid, count, packet_type):
    octets = pack_packet(apid, b"abc", sequence_count=count, packet_type=packet_type)
    theirs = SpacePacketHeader.unpack(octets[:6])
    assert (theirs.apid, theirs.seq_count, theirs.packet_type) == (apid, count, PacketType(packet_type))
    assert (int(theirs.seq_flags), theirs.data_len, theirs.sec_header_flag) == (3, 2, True)
    ours = unpack_primary_header(octets)
    assert ours == PrimaryHeader(apid, packet_type, True, count, 2)
    assert ours.packet_length == len(octets) == 9


def test_values_that_do_not_fit_are_refused():
    with pytest.raises(ValueRefused, match=r"expected 0\.\.2047, found 2048"):
        pack_packet(2048, b"x", sequence_count=0)
    with pytest.raises(ValueRefused):
        pack_packet(1, b"x", sequence_count=16384)
    with pytest.raises(ValueRefused):
        pack_packet(1, b"", sequence_count=0)
    with pytest.raises(ValueRefused):
        pack_packet(1, bytes(65537), sequence_count=0)


def test_damaged_headers_are_refused():
    with pytest.raises(TruncatedPacket, match="expected 6 octets, found 5"):
        unpack_primary_header(bytes(5))
    with pytest.raises(MalformedPacket, match="expected version 0, found 7"):
        unpack_primary_header(b"\xff" * 6)


def test_idle_packets_have_the_idle_apid_and_no_secondary_header():
    header = unpack_primary_header(idle_packet(7))
    assert (header.apid, header.secondary_header, header.packet_length) == (0x7FF, False, 7)
    with pytest.raises(ValueRefused):
        idle_packet(6)


def test_sequence_counts_wrap_at_14_bits_separately_for_each_apid():
    sequencer = PacketSequencer()
    counts = [sequencer.next(1) for _ in range(16386)]
    assert counts[:2] == [0, 1] and counts[16383:] == [16383, 0, 1]
    assert sequencer.next(2) == 0
