"""Raw files accounted for by on-board time, against streams whose every frame and packet is known."""

import numpy as np

from ground_service.passes.downlink_accounting import account_raw, read_raw
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import LinkSettings, encode_cadus

SPACECRAFT = 76
CADU = LinkSettings().cadu_length
HOUR = 3600 << 16
HOUSEKEEPING, EVENTS = 0x0A0, 0x0A4


def event(ticks, count):
    values = {"event_id": "observation_stopped", "frame_number": count, "value_1": 0.0, "value_2": 0.0}
    return DICTIONARY.pack("event_info", values, ticks=ticks, sequence_count=count)


def stream(start_ticks, packets):
    """Events a second apart from `start_ticks` on, in one stream of CADUs."""
    return encode_cadus([event(start_ticks + (k << 16), k) for k in range(packets)], spacecraft_id=SPACECRAFT)


def found(*files, hours=(0, 11)):
    """Account for raw files between two hours."""
    return account_raw([read_raw(one, SPACECRAFT) for one in files], *(hour * HOUR for hour in hours))


def both(*files):
    """Account for the first and for the second pass."""
    return found(*files), found(*files, hours=(19, 30))


FIRST, SECOND = stream(10 * HOUR, 300), stream(20 * HOUR, 90)
"""Two passes; an event is 39 octets or so, a frame holds 28 of them."""


def test_two_passes_in_one_file_are_separated():
    one, two = both(FIRST + SECOND)
    assert (one.frames, two.frames) == (len(FIRST) // CADU, len(SECOND) // CADU)
    assert (one.octets, two.octets) == (len(FIRST), len(SECOND))
    assert found(FIRST + SECOND, hours=(10, 11)) == one
    assert found(FIRST + SECOND, hours=(12, 13)).frames == 0
    assert read_raw(FIRST + SECOND, SPACECRAFT).span == (10 * HOUR, 20 * HOUR + (89 << 16))


def test_frames_that_cannot_be_used_lie_where_their_neighbours_lie():
    octets = bytearray(FIRST + SECOND)
    middle = 3 * CADU
    octets[middle + 50 : middle + 400] = bytes(350)  # beyond repair, in the first pass
    octets[len(FIRST) + CADU + 60] ^= 0xFF  # one symbol to repair, in the second
    one, two = both(bytes(octets))
    assert (one.frames, one.frames_bad, one.symbols_corrected) == (len(FIRST) // CADU, 1, 0)
    assert (two.frames, two.frames_bad, two.symbols_corrected) == (len(SECOND) // CADU, 0, 1)
    assert one.octets == len(FIRST) and two.octets == len(SECOND)


def test_octets_between_frames_belong_to_the_frame_before_and_duplicates_to_their_process():
    octets = FIRST[: 2 * CADU] + bytes(777) + FIRST[2 * CADU :] + SECOND
    one, two = both(octets)
    assert one.octets_skipped == 777 and one.octets == len(FIRST) + 777
    assert two.octets_skipped == 0
    assert found(octets, hours=(10, 11)).octets_skipped == 777
    again = encode_cadus([event(10 * HOUR, 0), event(10 * HOUR + (5 << 16), 5)], spacecraft_id=SPACECRAFT)
    three = [one.duplicates[EVENTS] for one in (*both(FIRST, again, SECOND), found(FIRST))]
    assert three == [2, 0, 0]


def test_a_packet_put_together_from_parts_leaves_no_octets_unused():
    """Two frames are exchanged: the packets across their borders are put together, and none of their octets is left."""
    octets = FIRST[: 2 * CADU] + FIRST[3 * CADU : 4 * CADU] + FIRST[2 * CADU : 3 * CADU] + FIRST[4 * CADU :]
    # The packets put together stand in no frame: they give none of another pass their time.
    alone, (_, two) = found(octets), both(octets + SECOND)
    assert (alone.frames, alone.frames_bad, alone.octets) == (len(FIRST) // CADU, 0, len(FIRST))
    assert (alone.octets_skipped, alone.duplicates) == (0, {EVENTS: 0})
    assert two.frames == len(SECOND) // CADU


def test_packets_with_a_wrong_checksum_are_counted_by_process():
    good = [event(10 * HOUR + (k << 16), k) for k in range(5)]
    bad = bytearray(good[2])
    bad[-5] ^= 1
    one = found(b"".join([*good[:2], bytes(bad), *good[3:]]))
    assert (one.crc_errors, one.duplicates, one.frames) == ({EVENTS: 1}, {EVENTS: 0}, None)


def test_frames_of_another_spacecraft_and_files_without_a_readable_packet_are_left_out():
    other = encode_cadus([event(10 * HOUR + (k << 16), k) for k in range(60)], spacecraft_id=5)
    one = found(FIRST + other)
    assert (one.frames, one.frames_bad) == (len(FIRST) // CADU, 0)
    noise = np.random.default_rng(1).integers(0, 256, 5000, dtype=np.uint8).tobytes()
    assert read_raw(noise, SPACECRAFT).span is None
    always = (0, 1 << 20)
    assert found(noise, hours=always).octets_skipped == 0 and found(hours=always).frames is None


def test_a_pass_of_one_frame_at_the_start_of_a_file_has_its_own_time():
    short = stream(10 * HOUR, 20)
    assert len(short) == CADU
    one = found(short + SECOND, hours=(10, 11))
    assert (one.frames, one.octets) == (1, CADU)
