from hypothesis import given, settings
from hypothesis import strategies as st
from pytest import mark, raises

from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import ChecksumError, FrameError, TruncatedPacket, ValueRefused
from tmtc.link.uplink import (
    CLTU_START,
    CLTU_TAIL,
    CONTROL_SET_COUNT,
    CONTROL_UNLOCK,
    Farm,
    TcFrame,
    UplinkDecoder,
    UplinkEncoder,
    bch_parity,
    encode_cltu,
    pack_tc_frame,
    unpack_tc_frame,
)
from tmtc.packets.stream import cut_packets

COMMANDS = [
    DICTIONARY.pack_command("set_parameter", {"parameter_id": k, "value": k / 3}, sequence_count=k) for k in range(6)
]
FIRST = COMMANDS[:1]
SENT = UplinkEncoder(76).encode(FIRST)
LONG = DICTIONARY.pack_command(
    "uplink_first",
    {"transaction": 1, "part": 1, "table": "model", "items": {"octet": [k % 251 for k in range(5000)]}},
    sequence_count=9,
)


def test_code_blocks_cltus_and_frames_are_those_of_the_standard():
    # a code block seen on other links: 22F600FF00421A with parity octet 12
    assert bch_parity(bytes.fromhex("22F600FF00421A")) == 0x12
    assert encode_cltu(bytes.fromhex("22F600FF00421A")) == CLTU_START + bytes.fromhex("22F600FF00421A12") + CLTU_TAIL
    # the last block is filled with 55
    assert encode_cltu(b"\x01")[2:9] == b"\x01" + b"\x55" * 6
    # version 00, bypass 1, control 0, spare 00, spacecraft 76 | channel 2, length 9 - 1 | number 5
    frame = pack_tc_frame(TcFrame(76, 2, 5, b"\xc0\x01", bypass=True))
    assert frame[:7] == bytes.fromhex("204C 0808 05 C001")
    assert unpack_tc_frame(frame + b"\x55\x55") == TcFrame(76, 2, 5, b"\xc0\x01", bypass=True)


def test_damaged_frames_are_refused_each_for_its_reason():
    frame = pack_tc_frame(TcFrame(76, 2, 5, b"\xc0\x01"))
    for octets, error, message in (
        (frame[:-1] + bytes((frame[-1] ^ 1,)), ChecksumError, None), (frame[:-1], TruncatedPacket, None),
        (b"\xff" * 12, FrameError, None), (bytes(12), FrameError, "8 octets or more"),
    ):  # fmt: skip
        with raises(error, match=message):
            unpack_tc_frame(octets)
    with raises(ValueRefused, match=r"1\.\.1017"):
        pack_tc_frame(TcFrame(76, 2, 5, bytes(1018)))
    assert len(pack_tc_frame(TcFrame(76, 2, 5, bytes(1017)))) == 1024


@mark.parametrize("randomised", [True, False])
@mark.parametrize("bypass", [True, False])
def test_what_is_sent_comes_back_long_packets_too(randomised, bypass):
    octets = UplinkEncoder(76, randomised=randomised, bypass=bypass).encode([*COMMANDS, LONG])
    decoded = UplinkDecoder(76, randomised=randomised).decode(octets)
    assert list(decoded.packets) == [*COMMANDS, LONG]
    assert (decoded.octets_skipped, decoded.faults, decoded.frames) == (0, (), 11)


def test_a_wrong_bit_of_a_block_is_repaired_and_two_lose_that_command_only():
    octets = bytearray(SENT)
    for k in range((len(octets) - 10) // 8):
        octets[2 + 8 * k + k % 8] ^= 0x80 >> k % 7  # information and parity, never the filler bit
    assert list(UplinkDecoder(76).decode(octets).packets) == FIRST
    each = [UplinkEncoder(76).encode([command]) for command in COMMANDS]
    damaged = bytearray(each[2])
    damaged[5] ^= 0x81
    decoded = UplinkDecoder(76).decode(b"".join([*each[:2], bytes(damaged), *each[3:]]))
    assert list(decoded.packets) == COMMANDS[:2] + COMMANDS[3:]
    assert decoded.faults and decoded.octets_skipped > 0


def test_what_lies_between_cltus_and_frames_for_another_spacecraft_are_not_used():
    octets = b"\xeb\x90\xeb\x90" + b"\x55" * 9 + SENT + b"\xaa" * 20
    decoded = UplinkDecoder(76).decode(octets)
    assert list(decoded.packets) == FIRST
    assert decoded.octets_skipped == 33
    decoded = UplinkDecoder(77).decode(SENT)
    assert decoded.packets == ()
    assert decoded.faults == ("telecommand frame: expected spacecraft 77, found 76",)


def test_sequence_controlled_frames_are_used_once_and_in_order():
    frames = [UplinkEncoder(76, bypass=False, sequence_number=k).encode([c]) for k, c in enumerate(COMMANDS)]
    decoder = UplinkDecoder(76)
    assert list(decoder.decode(frames[0] + frames[0]).packets) == FIRST
    assert decoder.decode(frames[2]).packets == ()
    farm = decoder.farms[0]
    assert farm.retransmit and farm.clcw.report_value == 1
    assert list(decoder.decode(frames[1] + frames[2]).packets) == COMMANDS[1:3]
    assert not farm.retransmit


def test_a_number_far_off_locks_the_receiver_until_it_is_unlocked():
    decoder = UplinkDecoder(76)
    far = UplinkEncoder(76, bypass=False, sequence_number=100).encode(FIRST)
    assert decoder.decode(far).packets == ()
    assert decoder.farms[0].clcw.lockout
    assert decoder.decode(UplinkEncoder(76, bypass=False).encode(FIRST)).packets == ()
    # expedited frames pass all the same
    assert list(decoder.decode(SENT).packets) == FIRST
    for command in (CONTROL_UNLOCK, CONTROL_SET_COUNT + b"\x64"):
        frame = pack_tc_frame(TcFrame(76, 0, 0, command, bypass=True, control=True))
        decoder.decode(encode_cltu(frame, randomised=True))
    assert list(decoder.decode(far).packets) == FIRST
    assert decoder.farms[0].clcw.farm_b_counter == 3


def test_packets_without_their_first_or_last_segment_are_dropped():
    frames = UplinkEncoder(76).frames(LONG)
    decoder = UplinkDecoder(76, randomised=False)
    decoded = decoder.decode(b"".join(encode_cltu(f) for f in frames[1:]))
    assert decoded.packets == () and len(decoded.faults) == len(frames) - 1
    # the next whole one is
    assert list(decoder.decode(b"".join(encode_cltu(f) for f in frames)).packets) == [LONG]
    frames = UplinkEncoder(76).frames(LONG)
    decoder = UplinkDecoder(76, randomised=False)
    stream = encode_cltu(frames[0]) + b"".join(encode_cltu(f) for f in UplinkEncoder(76).frames(COMMANDS[0]))
    decoded = decoder.decode(stream)
    assert list(decoded.packets) == FIRST
    assert decoded.faults == ("segment: expected a continuation, found the beginning of another packet",)


def test_packets_are_cut_where_they_say_and_expedited_and_control_frames_counted():
    frame = pack_tc_frame(TcFrame(76, 0, 0, b"\xc0" + COMMANDS[0] + COMMANDS[1] + b"\x18\xa0", bypass=True))
    decoded = UplinkDecoder(76, randomised=False).decode(encode_cltu(frame))
    assert list(decoded.packets) == COMMANDS[:2]
    assert decoded.faults == ("segment: expected a packet, found 2 octets",)
    farm = Farm()
    assert farm.accept(TcFrame(1, 0, 0, b"\xc0", bypass=True))
    assert not farm.accept(TcFrame(1, 0, 0, CONTROL_UNLOCK, bypass=True, control=True))
    assert not farm.accept(TcFrame(1, 0, 0, CONTROL_UNLOCK, control=True))
    assert farm.farm_b_counter == 2
    octets = b"\x00" + b"".join(COMMANDS)
    assert list(cut_packets(octets, packet_type=1).packets(octets)) == COMMANDS


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 10**9), st.integers(0, 7)), max_size=8),
    st.lists(st.integers(0, 10**9), max_size=3),
)
def test_whatever_the_link_does_no_command_is_invented(flips, cuts):
    octets = bytearray(UplinkEncoder(76, bypass=False).encode(COMMANDS))
    for position, bit in flips:
        octets[position % len(octets)] ^= 1 << bit
    for position in cuts:
        del octets[position % len(octets)]
    decoded = UplinkDecoder(76).decode(octets)
    assert set(decoded.packets) <= set(COMMANDS)
    assert len(set(decoded.packets)) == len(decoded.packets)
    assert 0 <= decoded.octets_skipped <= len(octets)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=200))
def test_any_octets_at_all_are_survived(octets):
    assert UplinkDecoder(76).decode(octets + CLTU_START + octets).octets_skipped <= 2 * len(octets) + 2


@mark.parametrize(
    "data", [b"", b"\x01", b"\x00\x00", CONTROL_SET_COUNT, CONTROL_SET_COUNT + b"\x01\x02", b"\x82\x01\x05"]
)
def test_an_invalid_control_command_is_not_counted(data):
    farm = Farm(lockout=True)
    assert not farm.accept(TcFrame(1, 0, 0, data, bypass=True, control=True))
    assert farm.farm_b_counter == 0 and farm.lockout


def test_a_count_that_is_set_in_lockout_is_counted_and_not_obeyed():
    farm = Farm(lockout=True)
    assert not farm.accept(TcFrame(1, 0, 0, CONTROL_SET_COUNT + b"\x07", bypass=True, control=True))
    assert (farm.farm_b_counter, farm.expected, farm.lockout) == (1, 0, True)
