"""Streams of ground stations: weak signals, noise, station headers, gaps, bit slips, several receivers, any order.

For each stream the packets that a decoder with known settings can find at best follow from the construction.
"""

import functools

import numpy as np
import pytest

from tests.tmtc.test_downlink import make_packets
from tmtc.downlink import (
    FRAME_GOOD,
    FRAME_UNCHECKED,
    DownlinkEncoder,
    LinkSettings,
    decode,
    encode_cadus,
    propose_settings,
)
from tmtc.errors import LinkFormatError
from tmtc.packets.space_packets import append_crc, pack_packet

SETTINGS = LinkSettings()
ZONE = 1115 - 6 - 2


@functools.cache
def sent():
    return make_packets(1500, seed=5)


@functools.cache
def cadus():
    """Return the undamaged stream, one CADU per row."""
    octets = encode_cadus(sent(), spacecraft_id=76)
    return np.frombuffer(octets, dtype=np.uint8).reshape(-1, SETTINGS.cadu_length)


def with_bit_errors(rows, rate, seed):
    bits = np.unpackbits(rows.reshape(-1))
    wrong = np.random.default_rng(seed).random(bits.size) < rate
    return np.packbits(bits ^ wrong).reshape(rows.shape)


def packets_within(received):
    """Return the packets whose frames were all received."""
    edges = np.cumsum([0, *map(len, sent())])
    spans = zip(sent(), edges[:-1] // ZONE, (edges[1:] - 1) // ZONE + 1, strict=True)
    return [packet for packet, first, after in spans if received.issuperset(range(first, after))]


def check(stream, expected, **options):
    octets = stream.tobytes()
    decoded = decode(octets, **options)
    assert set(decoded.cut.packets(decoded.buffer)) == set(expected)
    assert sum(decoded.octets.values()) == len(octets) and min(decoded.octets.values()) >= 0
    return decoded


@pytest.mark.parametrize("weak", [20, 100, 180])
def test_weak_frames_at_the_start_hide_neither_the_settings_nor_the_rest(weak):
    rows = cadus().copy()
    rows[:weak] = with_bit_errors(rows[:weak], 1.5e-2, seed=weak)
    known = decode(rows.tobytes(), settings=SETTINGS)
    decoded = check(rows, list(known.cut.packets(known.buffer)))
    assert decoded.settings == propose_settings(cadus()).settings
    assert set(packets_within(set(range(weak, len(rows))))) <= set(decoded.cut.packets(decoded.buffer))
    assert decoded.frame_count == len(rows) and decoded.frames_bad > weak * 0.8


@pytest.mark.parametrize("octets", [77_000, 79_000, 3_000_000])
def test_noise_before_the_first_frame_hides_nothing(octets):
    noise = np.random.default_rng(octets).integers(0, 256, octets, dtype=np.uint8)
    decoded = check(np.concatenate((noise, cadus().reshape(-1))), sent())
    assert decoded.octets["unsynchronised"] == octets


@pytest.mark.parametrize("rate", [0.0, 2e-3])
def test_a_station_header_before_each_frame_is_distinguished_from_the_frame(rate):
    header = np.random.default_rng(8).integers(0, 256, (len(cadus()), 8), dtype=np.uint8)
    decoded = check(np.hstack((header, with_bit_errors(cadus(), rate, seed=9))), sent())
    assert decoded.settings.coding == "rs"
    assert (decoded.symbols_corrected > 0) == (rate > 0)


def test_gaps_of_any_length_between_frames_cost_nothing():
    rng = np.random.default_rng(10)
    parts = []
    for row in cadus():
        parts += [rng.integers(0, 256, int(rng.integers(0, 60)), dtype=np.uint8), row]
    check(np.concatenate(parts), sent())


@pytest.mark.parametrize("rate, seed", [(2e-2, 0), (3e-2, 1)])
def test_frames_that_no_code_can_repair_are_never_good(rate, seed):
    rows = with_bit_errors(cadus()[:60], rate, seed)
    with pytest.raises(LinkFormatError, match="no valid frame"):
        decode(rows.tobytes())
    known = decode(rows.tobytes(), settings=SETTINGS)
    assert not (known.frames.verdict == FRAME_GOOD).any()


def test_a_frame_without_code_and_checksum_is_unchecked_and_never_good():
    octets = encode_cadus(sent(), spacecraft_id=76, coding="none", checksum=False)
    decoded = decode(octets)
    assert decoded.packets == len(sent())
    assert set(decoded.frames.verdict.tolist()) == {FRAME_UNCHECKED}
    assert decoded.accounting()["frames_unchecked"] == decoded.frame_count


@pytest.mark.parametrize("seed", range(20))
def test_noise_is_never_a_frame_or_a_packet(seed):
    noise = np.random.default_rng(seed).integers(0, 256, 20_000, dtype=np.uint8).tobytes()
    found = decode(noise)
    assert found.packets == 0 and found.frame_count == 0
    known = decode(noise, settings=SETTINGS)
    assert known.packets == 0
    assert not (known.frames.verdict == FRAME_GOOD).any()


def test_frames_of_several_receivers_in_any_order_give_every_packet():
    n = len(cadus())
    any_order = (np.random.default_rng(seed).permutation(n) for seed in range(3))
    for order in (np.repeat(np.arange(n), 2), np.r_[1:n:2, 0:n:2], *any_order):
        decoded = check(cadus()[order], sent())
        assert (decoded.frames_lost, decoded.sequence.missing, decoded.sequence.conflicts) == (0, 0, 0)
    rng = np.random.default_rng(12)
    n = len(cadus())
    first, second = (np.flatnonzero(rng.random(n) > 0.15) for _ in range(2))
    received = set(first.tolist()) | set(second.tolist())
    decoded = check(np.concatenate((cadus()[first], cadus()[second])), packets_within(received))
    assert decoded.frames_lost <= n - len(received)
    long = append_crc(pack_packet(0x55, bytes(range(256)) * 24, sequence_count=3)[:-2])
    octets = DownlinkEncoder(5, LinkSettings(frame_length=223)).encode([*sent()[:3], long, *sent()[3:6]])
    rows = np.frombuffer(octets, dtype=np.uint8).reshape(-1, 259)
    mixed = np.concatenate((rows[:5], rows[9:14], rows[4:10], rows[14:], rows[2:7]))
    decoded = decode(mixed.tobytes())
    assert long in set(decoded.cut.packets(decoded.buffer))
    assert sum(decoded.octets.values()) == mixed.size


def test_bit_slips_cost_only_the_frames_they_hit_and_an_inverted_stream_is_read():
    slips = [9 * 8 * 1279 + 4000, 50 * 8 * 1279 + 77, 100 * 8 * 1279 + 9000]
    stream = np.packbits(np.delete(np.unpackbits(cadus().reshape(-1)), slips))
    received = set(range(len(cadus()))) - {9, 50, 100}
    decoded = check(stream, packets_within(received))
    assert decoded.frames_bad == 3
    check(255 - cadus(), sent())


def test_foreign_packets_are_not_ordered_by_a_time_they_do_not_carry():
    # the 14th octet is that of a CUC time of the dictionary, the six octets behind it count down
    octets = b""
    for k in range(50):
        data = bytes(7) + b"\x2e" + (10**6 - k).to_bytes(6, "big") + bytes(10)
        octets += append_crc(pack_packet(0x123, data, sequence_count=k, secondary_header=True)[:-2])
    decoded = decode(octets)
    assert (decoded.packets, decoded.sequence.gaps, decoded.sequence.missing) == (50, 0, 0)
