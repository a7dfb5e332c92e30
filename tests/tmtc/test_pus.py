import pytest
from spacepackets.ccsds import SpacePacketHeader
from spacepackets.ecss import PusTc, PusTm

from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import MalformedPacket, TruncatedPacket
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


def test_a_telemetry_packet_is_what_spacepackets_reads():
    octets = DICTIONARY.pack(
        "time_report",
        {"reported_ticks": 0x0123456789AB, "rate_exponent": 4},
        ticks=0x0A0B0C0D0E0F,
        sequence_count=77,
        message_counter=513,
        destination=9,
    )
    theirs = PusTm.unpack(octets, timestamp_len=7)
    assert (theirs.apid, theirs.service, theirs.message_subtype, theirs.seq_count) == (0x0A5, 9, 2, 77)
    assert theirs.pus_tm_sec_header.message_counter == 513
    assert theirs.pus_tm_sec_header.dest_id == 9
    assert theirs.timestamp == bytes.fromhex("2E 0A0B0C0D0E0F")
    assert theirs.tm_data == bytes.fromhex("00000123456789AB 04")


def test_a_telecommand_of_spacepackets_is_read_and_equal_to_ours():
    theirs = PusTc(
        service=17,
        message_subtype=1,
        apid=0x0A0,
        seq_count=5,
        source_id=3,
        ack_flags=ACK_ACCEPTANCE | ACK_COMPLETION,
    ).pack()
    ours = DICTIONARY.pack_command(
        "test_connection", {}, sequence_count=5, acknowledgements=ACK_ACCEPTANCE | ACK_COMPLETION, source=3
    )
    assert ours == bytes(theirs)
    read = DICTIONARY.unpack_command(bytes(theirs))
    assert (read.name, read.sequence_count, read.acknowledgements, read.source) == (
        "test_connection",
        5,
        9,
        3,
    )


def test_headers_come_back():
    telemetry = TmSecondaryHeader(255, 255, (1 << 48) - 1, 65535, 65535, 15)
    assert unpack_tm_header(pack_tm_header(telemetry)) == telemetry
    telecommand = TcSecondaryHeader(255, 255, 15, 65535)
    assert unpack_tc_header(pack_tc_header(telecommand)) == telecommand


def test_headers_of_another_pus_version_are_refused():
    with pytest.raises(MalformedPacket, match="expected PUS version 2, found 1"):
        unpack_tm_header(b"\x10" + bytes(13))
    with pytest.raises(MalformedPacket, match="expected PUS version 2, found 1"):
        unpack_tc_header(b"\x10" + bytes(4))
    with pytest.raises(TruncatedPacket):
        unpack_tm_header(bytes(13))


def test_the_request_id_is_the_packet_id_and_sequence_control():
    packet = DICTIONARY.pack_command("test_connection", {}, sequence_count=0x123)
    assert request_id(packet) == 0x18A0C123
    assert SpacePacketHeader.unpack(packet[:6]).packet_id.raw() == 0x18A0
