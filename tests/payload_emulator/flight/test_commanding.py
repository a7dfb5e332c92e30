"""Telecommands cut from octets, and the memory of those that came before; packets are built here octet by octet."""

import binascii

from pytest import mark, raises

from payload_emulator.flight.onboard.commanding import Command, CommandHistory, Refusal, failure, parse_commands

UNKNOWN_PACKET, BAD_CHECKSUM, BAD_LENGTH, DUPLICATE, OUT_OF_SEQUENCE = 1, 2, 3, 6, 8


def packet(count, body=b"", *, service=17, source=0, acknowledge=15):
    """A telecommand to APID 160 with CRC-16/CCITT-FALSE; service 17, subtype 1 is the connection test."""
    secondary = bytes([0x20 | acknowledge, service, 1]) + source.to_bytes(2, "big")
    head = (0x18A0).to_bytes(2, "big") + (0xC000 | count).to_bytes(2, "big")
    whole = head + (len(secondary) + len(body) + 1).to_bytes(2, "big") + secondary + body
    return whole + binascii.crc_hqx(whole, 0xFFFF).to_bytes(2, "big")


def request(count):
    return 0x18A0C000 | count


def test_packets_laid_end_to_end_are_cut_and_named():
    first, second = parse_commands(packet(5) + packet(16_383, source=7, acknowledge=9))
    assert isinstance(first, Command) and isinstance(second, Command)
    assert (first.name, first.values, first.request_id) == ("test_connection", {}, request(5))
    assert (first.acknowledgements, first.packet, first.sequence_count) == (15, packet(5), 5)
    assert (second.acknowledgements, second.sequence_count) == (9, 16_383)
    assert second.packet == packet(16_383, source=7, acknowledge=9)
    assert list(parse_commands(b"")) == []


def test_a_broken_length_ends_the_reading_and_a_broken_packet_does_not():
    damaged = bytearray(packet(1))
    damaged[-1] ^= 1
    wrong_field = packet(2, b"\x01")
    unknown = packet(3, service=99)
    whole = bytes(damaged) + wrong_field + unknown + packet(4) + packet(6)[:12]
    assert [
        one if isinstance(one, Refusal) else one.request_id for one in parse_commands(whole)
    ] == [
        Refusal(request(1), BAD_CHECKSUM),
        Refusal(request(2), BAD_LENGTH),
        Refusal(request(3), UNKNOWN_PACKET),
        request(4),
        Refusal(request(6), BAD_LENGTH)
    ]  # fmt: skip


@mark.parametrize("kept", [1, 3, 5, 6, 12])
def test_octets_too_few_for_a_packet_are_refused_by_what_there_is_of_its_name(kept):
    (found,) = parse_commands(packet(5)[:kept])
    # The request id is the first four octets, and nought where there are fewer.
    assert found == Refusal(int.from_bytes((packet(5)[:kept] + bytes(4))[:4], "big"), BAD_LENGTH)


def test_a_packet_too_short_for_a_telecommand_or_for_its_fields_has_a_wrong_length():
    """13 octets are the shortest; a length field of 5 says 12."""
    short = packet(5)[:4] + (5).to_bytes(2, "big") + bytes(6)
    assert list(parse_commands(short + packet(6))) == [Refusal(request(5), BAD_LENGTH)]
    # Service 8, subtype 1 carries a function and two arguments, 18 octets.
    assert isinstance(next(parse_commands(packet(9, bytes([0, 1]) + bytes(16), service=8))), Command)
    for octets in (17, 8, 0):
        (found,) = parse_commands(packet(9, (bytes([0, 1]) + bytes(16))[:octets], service=8))
        assert found == Refusal(request(9), BAD_LENGTH), octets


def test_the_codes_are_those_of_the_dictionary():
    assert [failure(name) for name in ("unknown_packet", "duplicate", "out_of_sequence")] == [1, 6, 8]
    with raises(KeyError):
        failure("boredom")


def noted(*packets):
    history = CommandHistory()
    for one in packets:
        history.note(one)
    return history


@mark.parametrize(
    "count, code",
    [
        (100, OUT_OF_SEQUENCE), (99, OUT_OF_SEQUENCE), (101, 0), (8_291, 0), (8_292, OUT_OF_SEQUENCE),
        (16_383, OUT_OF_SEQUENCE)
    ]
)  # fmt: skip
def test_counts_go_forward_by_less_than_half_of_their_range(count, code):
    """After 100 come 101 to 8291; 8192 further on may as well be behind. The packets differ by their flags."""
    assert noted(packet(100)).judge(packet(count, acknowledge=1)) == code


def test_a_count_wraps_and_the_first_command_of_a_source_may_have_any():
    history = noted(packet(16_383))
    assert history.judge(packet(0)) == 0 and history.judge(packet(8_190)) == 0
    assert history.judge(packet(8_191)) == OUT_OF_SEQUENCE
    history = CommandHistory()
    assert history.judge(packet(9_000)) == 0
    history.note(packet(9_000))
    assert history.judge(packet(3, source=1)) == 0
    history.note(packet(3, source=1))
    assert history.newest_count == 3
    # Sources are counted apart, by both octets of their number.
    assert history.judge(packet(9_001)) == 0 and history.judge(packet(4, source=1)) == 0
    assert history.judge(packet(8_999)) == OUT_OF_SEQUENCE and history.judge(packet(4, source=256)) == 0


def test_the_same_packet_is_a_duplicate_even_where_sequence_does_not_count():
    history = noted(packet(5), packet(6))
    assert history.judge(packet(5)) == DUPLICATE
    assert history.judge(packet(5), in_sequence=False) == DUPLICATE
    # The same count with other contents is another packet, and merely late.
    assert history.judge(packet(5, acknowledge=1)) == OUT_OF_SEQUENCE
    assert history.judge(packet(5, acknowledge=1), in_sequence=False) == 0


def test_a_command_out_of_band_moves_no_count():
    history = noted(packet(100))
    history.note(packet(50, acknowledge=1), in_sequence=False)
    assert history.newest_count == 100
    assert history.judge(packet(50, acknowledge=1)) == DUPLICATE
    assert history.judge(packet(101)) == 0 and history.judge(packet(60)) == OUT_OF_SEQUENCE


def test_the_last_256_commands_and_the_last_sixteen_sources_are_remembered():
    history = noted(*(packet(count) for count in range(257)))
    assert history.judge(packet(0), in_sequence=False) == 0
    assert history.judge(packet(1), in_sequence=False) == DUPLICATE
    assert history.judge(packet(256), in_sequence=False) == DUPLICATE
    history = noted(*(packet(100, source=source) for source in range(16)))
    history.note(packet(101, source=0))  # received again: the second is now the one longest silent
    history.note(packet(100, source=16))
    assert history.judge(packet(50, source=1)) == 0
    assert history.judge(packet(50, source=0)) == OUT_OF_SEQUENCE
    assert history.judge(packet(50, source=2)) == OUT_OF_SEQUENCE


def test_a_history_comes_back_from_memory_as_it_was():
    history = noted(packet(100), packet(3, source=1))
    plain = history.to_plain()
    assert plain == [
        3, [(0, 100), (1, 3)],
        [[request(100), binascii.crc32(packet(100))], [request(3), binascii.crc32(packet(3, source=1))]]
    ]  # fmt: skip
    fresh = CommandHistory()
    fresh.restore(plain)
    assert fresh == history
    assert fresh.judge(packet(100)) == DUPLICATE and fresh.judge(packet(99)) == OUT_OF_SEQUENCE
    assert CommandHistory().to_plain() == [-1, [], []]
