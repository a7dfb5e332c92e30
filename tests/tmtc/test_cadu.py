import numpy as np
from pytest import mark

from tmtc.link.cadu import ASM, cadu_octets, synchronise
from tmtc.link.link_check import survey_markers

PERIOD = 128
PLACES = list(range(0, 20 * PERIOD, PERIOD))
MARKER = np.frombuffer(ASM, dtype=np.uint8)


def noise_of(shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def stream_of(count, seed=0):
    blocks = noise_of((count, PERIOD), seed)
    blocks[:, :4] = MARKER
    return blocks.reshape(-1)


def find_period(stream):
    return next(iter(survey_markers(stream).distances), 0)


def starts(stream, **options):
    return synchronise(stream, PERIOD, **options).offsets.tolist()


def after_headers(count):
    """Places of CADUs behind a header of 8 octets each."""
    return [(PERIOD + 8) * k + 8 for k in range(count)]


def test_every_cadu_of_a_stream_is_found_wherever_it_begins_and_none_in_noise():
    assert bytes.fromhex("1ACFFC1D") == ASM
    stream = stream_of(50)
    assert find_period(stream) == PERIOD
    assert starts(stream) == list(range(0, 50 * PERIOD, PERIOD))
    assert starts(stream_of(50)[77:-5]) == [PERIOD * k - 77 for k in range(1, 49)]
    assert starts(np.empty(0, dtype=np.uint8)) == []
    noise = noise_of(100_000, 1)
    assert (find_period(noise), starts(noise)) == (0, [])


@mark.parametrize("which", [slice(10, 11), slice(1, None, 2)])
@mark.parametrize("wrong_bits", [1, 3, 4, 16, 24])
def test_damaged_markers_are_passed_over_while_in_lock_and_turn_no_frame(wrong_bits, which):
    stream = stream_of(20)
    markers = stream.reshape(-1, PERIOD)[which, :4]
    bits = np.unpackbits(markers, axis=1)
    bits[:, :wrong_bits] ^= 1
    markers[:] = np.packbits(bits, axis=1)
    sync = synchronise(stream, PERIOD, verify=lambda sync: (sync.offsets % PERIOD == 0) & ~sync.inverted)
    assert sync.offsets.tolist() == PLACES
    assert (sync.marker_errors[which] == wrong_bits).all() and not sync.inverted.any()


def test_lost_octets_cost_their_frame_and_inserted_ones_markers_and_outages_none():
    stream = np.delete(stream_of(20), slice(7 * PERIOD + 60, 7 * PERIOD + 63))
    sync = synchronise(stream, PERIOD)
    assert sync.offsets.tolist() == PLACES[:7] + [at - 3 for at in PLACES[8:]]
    assert sync.truncated.tolist() == [7 * PERIOD]
    stream = np.insert(stream_of(20), 7 * PERIOD, np.zeros(5, dtype=np.uint8))
    assert starts(stream) == PLACES[:7] + [at + 5 for at in PLACES[7:]]
    stream = stream_of(20)
    stream[5 * PERIOD + 40 : 5 * PERIOD + 44] = MARKER
    assert starts(stream) == PLACES
    # not even in search: the check one period later fails
    assert starts(stream[5 * PERIOD + 10 :]) == [PERIOD * k - 10 for k in range(1, 15)]
    noise = noise_of(100_001, 9)
    stream = np.concatenate((stream_of(5), noise, stream_of(5, seed=2)))
    after = 5 * PERIOD + noise.size
    assert starts(stream) == [PERIOD * k + gap for gap in (0, after) for k in range(5)]
    assert starts(stream_of(1)) == [0]


def sync_of_bits(bits, **options):
    octets = np.packbits(bits)
    return octets, synchronise(octets, PERIOD, **options)


@mark.parametrize("slip", range(1, 8))
def test_a_stream_that_begins_within_an_octet_is_found_and_aligned(slip):
    stream = stream_of(12)
    octets, sync = sync_of_bits(np.unpackbits(stream)[slip:])
    assert sync.start_bits.tolist() == [8 * PERIOD * k - slip for k in range(1, 12)]
    assert cadu_octets(octets, sync).tolist() == stream.reshape(-1, PERIOD)[1:].tolist()


def test_a_bit_slip_costs_one_frame_and_an_inverted_stretch_is_turned_upright():
    stream = stream_of(20)
    octets, sync = sync_of_bits(np.delete(np.unpackbits(stream), 8 * (7 * PERIOD + 60)))
    rows = [k for k in range(20) if k != 7]
    assert sync.start_bits.tolist() == [8 * PERIOD * k - (k > 7) for k in rows]
    assert sync.truncated.tolist() == [PERIOD * 7]
    assert cadu_octets(octets, sync).tolist() == stream.reshape(-1, PERIOD)[rows].tolist()
    turned = stream.copy()
    turned[8 * PERIOD : 15 * PERIOD] ^= 0xFF
    sync = synchronise(turned, PERIOD)
    assert sync.inverted.tolist() == [8 <= k < 15 for k in range(20)]
    assert cadu_octets(turned, sync).tolist() == stream.reshape(-1, PERIOD).tolist()


def test_headers_and_gaps_between_cadus_are_passed_over_and_weak_markers_bridged():
    stream = stream_of(20).reshape(-1, PERIOD)
    recorded = np.hstack((np.zeros((20, 8), dtype=np.uint8), stream)).reshape(-1)
    assert starts(recorded) == after_headers(20)
    rng = np.random.default_rng(11)
    stream = stream_of(30).reshape(-1, PERIOD)
    parts, expected, at = [], [], 0
    for cadu in stream:
        gap = rng.integers(0, 256, int(rng.integers(0, 50)), dtype=np.uint8)
        parts += [gap, cadu]
        expected.append(at + gap.size)
        at += gap.size + PERIOD
    assert starts(np.concatenate(parts)) == expected
    stream = stream_of(30).reshape(-1, PERIOD)
    stream[10:16, :4] = noise_of((6, 4), 3)
    assert starts(stream.reshape(-1)) == list(range(0, 30 * PERIOD, PERIOD))


def test_a_frame_with_a_worn_marker_and_no_neighbours_is_accepted_only_when_it_proves_itself():
    noise = noise_of(4 * PERIOD, 5)
    frame = stream_of(1)
    frame[0] ^= 0b00000111
    stream = np.concatenate((noise, frame, noise))
    assert starts(stream) == []
    assert starts(stream, verify=lambda sync: sync.offsets == 4 * PERIOD) == [4 * PERIOD]


def test_the_period_is_found_in_the_whole_stream_however_long_the_noise_before_it():
    noise = noise_of(5_000_000, 7)
    assert find_period(np.concatenate((noise, stream_of(40)))) == PERIOD


def header_with_a_likeness(wrong_bits, *, inverted):
    """A record header of 8 octets with a marker of `wrong_bits` wrong bits that begins within an octet."""
    bits = np.zeros(64, dtype=np.uint8)
    likeness = np.unpackbits(MARKER) ^ np.uint8(inverted)
    likeness[-wrong_bits:] ^= 1
    bits[21:53] = likeness
    return np.packbits(bits)


@mark.parametrize("inverted", [False, True])
@mark.parametrize("count", [1, 2, 12])
@mark.parametrize("is_checked", [False, True])
def test_likenesses_of_a_marker_in_the_headers_of_records_do_not_catch_the_lock(count, inverted, is_checked):
    header = header_with_a_likeness(3, inverted=inverted)
    stream = np.hstack((np.tile(header, (count, 1)), stream_of(count).reshape(-1, PERIOD))).reshape(-1)
    expected = after_headers(count)
    verify = (lambda sync: np.isin(sync.start_bits, 8 * np.array(expected))) if is_checked else None
    sync = synchronise(stream, PERIOD, verify=verify, record_octets=8)
    assert sync.offsets.tolist() == expected
    assert not sync.inverted.any()


def test_a_likeness_that_others_follow_or_in_the_last_frame_does_not_cost_a_valid_frame():
    header = np.concatenate((MARKER, np.zeros(4, dtype=np.uint8)))
    frames = stream_of(12).reshape(-1, PERIOD)
    frames[:, 3] ^= 0b00000101
    stream = np.hstack((np.tile(header, (12, 1)), frames)).reshape(-1)
    expected = after_headers(12)
    assert starts(stream, verify=lambda sync: np.isin(sync.offsets, expected), record_octets=8) == expected
    stream = stream_of(3)
    stream[2 * PERIOD + 60 : 2 * PERIOD + 64] = MARKER ^ np.uint8([0, 0, 0, 7])
    # the stream goes on for most of a frame, whose marker and the rest are damaged
    stream = np.concatenate((stream, np.zeros(PERIOD - 1, dtype=np.uint8)))
    valid = [0, PERIOD, 2 * PERIOD]
    sync = synchronise(stream, PERIOD, verify=lambda sync: np.isin(sync.offsets, valid))
    assert sync.offsets.tolist() == valid
    assert sync.truncated.size == 0


def test_the_last_frame_with_a_damaged_marker_is_kept_with_or_without_a_check():
    stream = np.concatenate((np.full(40, 0xAA, dtype=np.uint8), stream_of(1)))
    stream[43] ^= 0b00000111
    assert starts(stream) == [40]
    assert starts(stream, verify=lambda sync: np.zeros(sync.offsets.size, dtype=np.bool_)) == [40]
