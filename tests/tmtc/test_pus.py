""""""

import numpy as np
from pytest import mark, raises
from spacepackets.ccsds import PacketType, SpacePacketHeader
from spacepackets.ecss import PusTc, PusTm

from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import MalformedPacket, TruncatedPacket, ValueRefused
from tmtc.packets.large_data import LargeData, LargeDataReceiver, split
from tmtc.packets.pus import (
    ACK_ACCEPTANCE,
    ACK_COMPLETION,
    TcSecondaryHeader,
    TmSecondaryHeader,
    pack_tc_header,
    pack_tm_header,
    request_id,
    unpack_tc_header,
    unpack_tm_header,
)
from tmtc.packets.space_packets import PacketSequencer, PrimaryHeader, idle_packet, pack_packet, unpack_primary_header


def test_a_telemetry_packet_is_what_spacepackets_reads():
    octets = DICTIONARY.pack(
        "time_report", {"reported_ticks": 0x0123456789AB, "rate_exponent": 4}, ticks=0x0A0B0C0D0E0F,
        sequence_count=77, message_counter=513, destination=9,
    )  # fmt: skip
    theirs = PusTm.unpack(octets, timestamp_len=7)
    header = theirs.pus_tm_sec_header
    found = (
        theirs.apid,
        theirs.service,
        theirs.message_subtype,
        theirs.seq_count,
        header.message_counter,
        header.dest_id,
    )
    assert found == (0x0A5, 9, 2, 77, 513, 9)
    assert theirs.timestamp == bytes.fromhex("2E 0A0B0C0D0E0F")
    assert theirs.tm_data == bytes.fromhex("00000123456789AB 04")


def test_a_telecommand_of_spacepackets_is_read_and_equal_to_ours():
    theirs = PusTc(
        service=17, message_subtype=1, apid=0x0A0, seq_count=5, source_id=3,
        ack_flags=ACK_ACCEPTANCE | ACK_COMPLETION,
    ).pack()  # fmt: skip
    ours = DICTIONARY.pack_command(
        "test_connection", {}, sequence_count=5, acknowledgements=ACK_ACCEPTANCE | ACK_COMPLETION, source=3
    )
    assert ours == bytes(theirs)
    read = DICTIONARY.unpack_command(bytes(theirs))
    assert (read.name, read.sequence_count, read.acknowledgements, read.source) == (
        "test_connection", 5, 9, 3,
    )  # fmt: skip


def test_headers_come_back_with_their_request_id_and_another_version_is_refused():
    telemetry = TmSecondaryHeader(255, 255, (1 << 48) - 1, 65535, 65535, 15)
    assert unpack_tm_header(pack_tm_header(telemetry)) == telemetry
    telecommand = TcSecondaryHeader(255, 255, 15, 65535)
    assert unpack_tc_header(pack_tc_header(telecommand)) == telecommand
    for unpack in (unpack_tm_header, unpack_tc_header):
        with raises(MalformedPacket, match="expected PUS version 2, found 1"):
            unpack(b"\x10" + bytes(13))
    with raises(TruncatedPacket):
        unpack_tm_header(bytes(13))
    packet = DICTIONARY.pack_command("test_connection", {}, sequence_count=0x123)
    assert request_id(packet) == 0x18A0C123
    assert SpacePacketHeader.unpack(packet[:6]).packet_id.raw() == 0x18A0


@mark.parametrize("apid", [0, 0x0A0, 0x7FF])
@mark.parametrize("count", [0, 16383])
@mark.parametrize("packet_type", [0, 1])
def test_headers_agree_with_spacepackets(apid, count, packet_type):
    octets = pack_packet(apid, b"abc", sequence_count=count, packet_type=packet_type)
    theirs = SpacePacketHeader.unpack(octets[:6])
    assert (theirs.apid, theirs.seq_count, theirs.packet_type) == (apid, count, PacketType(packet_type))
    assert (int(theirs.seq_flags), theirs.data_len, theirs.sec_header_flag) == (3, 2, True)
    ours = unpack_primary_header(octets)
    assert ours == PrimaryHeader(apid, packet_type, True, count, 2)
    assert ours.packet_length == len(octets) == 9


def test_values_that_do_not_fit_are_refused():
    for apid, data, count, message in (
        (2048, b"x", 0, r"expected 0\.\.2047, found 2048"), (1, b"x", 16384, "16384"), (1, b"", 0, None),
        (1, bytes(65537), 0, None),
    ):  # fmt: skip
        with raises(ValueRefused, match=message):
            pack_packet(apid, data, sequence_count=count)


def test_damaged_headers_are_refused():
    with raises(TruncatedPacket, match="expected 6 octets, found 5"):
        unpack_primary_header(bytes(5))
    with raises(MalformedPacket, match="expected version 0, found 7"):
        unpack_primary_header(b"\xff" * 6)


def test_idle_packets_have_the_idle_apid_and_counts_of_each_apid_wrap_at_14_bits():
    header = unpack_primary_header(idle_packet(7))
    assert (header.apid, header.secondary_header, header.packet_length) == (0x7FF, False, 7)
    with raises(ValueRefused):
        idle_packet(6)
    sequencer = PacketSequencer()
    counts = [sequencer.next(1) for _ in range(16386)]
    assert counts[:2] == [0, 1] and counts[16383:] == [16383, 0, 1]
    assert sequencer.next(2) == 0


IMAGE = np.random.default_rng(0).bytes(10_000)


def received(parts):
    receiver = LargeDataReceiver()
    return [whole for name, values in parts if (whole := receiver.accept(name, values)) is not None]


def through_packets(parts):
    """Return the values that the other end unpacks."""
    for k, (name, values) in enumerate(parts):
        yield DICTIONARY.unpack(DICTIONARY.pack(name, values, ticks=k, sequence_count=k))


@mark.parametrize("part_length", [1000, 9999, 10_000, 20_000])
def test_what_is_split_comes_back(part_length):
    parts = split(IMAGE, transaction=3, table="thumbnail", part_length=part_length)
    assert received(through_packets(parts)) == [LargeData(3, 6, IMAGE)]


def test_the_parts_are_first_middle_and_last():
    names = [name for name, _ in split(IMAGE, transaction=1, table=1, part_length=2500)]
    assert names == ["large_data_first", "large_data_middle", "large_data_middle", "large_data_last"]
    assert [name for name, _ in split(b"", transaction=1, table=1, part_length=10)] == ["large_data_last"]


def test_parts_go_up_as_telecommands():
    octets = b""
    for name, values in split(IMAGE, transaction=9, table="model", part_length=900, link="uplink"):
        command = DICTIONARY.unpack_command(DICTIONARY.pack_command(name, values, sequence_count=0))
        octets += command.values["items"]["octet"].astype(np.uint8).tobytes()
    assert octets == IMAGE


def test_order_and_repetition_do_not_matter():
    parts = list(through_packets(split(IMAGE, transaction=3, table="thumbnail", part_length=1000)))
    receiver = LargeDataReceiver()
    for k in (9, 0, 0, 4, 2, 1, 3, 5, 6, 7):
        assert receiver.accept(*parts[k]) is None
    assert receiver.accept(*parts[8]) == LargeData(3, 6, IMAGE)
    assert receiver._kept == 0


def test_a_number_begins_again_transfers_are_bounded_and_impossible_parts_are_refused():
    old = list(through_packets(split(IMAGE, transaction=3, table="thumbnail", part_length=5000)))
    new = list(through_packets(split(IMAGE[::-1], transaction=3, table="landmark_map", part_length=5000)))
    assert received([old[0], *new]) == [LargeData(3, 7, IMAGE[::-1])]
    receiver = LargeDataReceiver(most_octets=5000)
    for transaction in range(100):
        name, values = split(IMAGE, transaction=transaction, table=1, part_length=1000)[0]
        receiver.accept(name, values)
        assert receiver._kept <= 5000
    with raises(ValueRefused):
        split(IMAGE, transaction=1, table=1, part_length=0)
    with raises(ValueRefused, match="at most 65535 parts"):
        split(bytes(70_000), transaction=1, table=1, part_length=1)
