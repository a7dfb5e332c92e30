"""Reading a downlink in windows: no packet lost at a border, the same accounting as read at once."""

import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ground_service.ingest.stream import DownlinkReader, reaches_of
from tmtc.arrays import as_octets
from tmtc.downlink import DownlinkEncoder, LinkSettings, decode, encode_cadus
from tmtc.frames import Clcw, pack_clcw

SPACECRAFT = 76


@pytest.fixture(scope="module")
def packets(make_pass: Callable[..., Any]) -> list[bytes]:
    return list(make_pass(frames=30).packets)


def reader_of(octets: bytes, spacecraft_id: int | None = None, **options: Any) -> DownlinkReader:
    ((reach,), _) = reaches_of(as_octets(octets))
    return DownlinkReader(reach, spacecraft_id, **options)


def read(octets: bytes, block: int, window: int, spacecraft_id: int | None = None) -> tuple[list[bytes], Any]:
    reader = reader_of(octets, spacecraft_id, window_octets=window)
    blocks = (octets[i : i + block] for i in range(0, len(octets), block))
    found = [packet for batch in reader.batches(blocks) for packet in batch.octets]
    return found, reader.accounting


@pytest.mark.parametrize(("block", "window"), [(997, 1 << 20), (997, 8_000), (1 << 20, 1 << 20)])
def test_every_packet_comes_through_whatever_the_blocks(
    packets: list[bytes], block: int, window: int
) -> None:
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT, frame_length=223)
    found, accounting = read(stream, block, window)
    assert set(found) == set(packets)
    assert accounting.packets == len(packets)
    assert accounting.frames == len(stream) // 259
    assert (accounting.frames_bad, accounting.octets_skipped, accounting.crc_errors) == (0, 0, 0)
    assert accounting.octets == len(stream)


@pytest.mark.parametrize("window", [1 << 20, 60_000])
def test_damage_is_accounted_for_alike_in_windows_and_at_once(packets: list[bytes], window: int) -> None:
    stream = bytearray(encode_cadus(packets, spacecraft_id=SPACECRAFT, frame_length=223))
    rng = np.random.default_rng(5)
    for at in rng.integers(0, len(stream), 3 * len(stream) // 259):
        stream[at] ^= int(rng.integers(1, 256))
    for frame in (3, 17, 40):
        stream[frame * 259 + 10 : frame * 259 + 110] = rng.bytes(100)
    whole = decode(bytes(stream))
    found, accounting = read(bytes(stream), 1000, window)
    assert set(found) == set(whole.cut.packets(whole.buffer))
    assert accounting.packets == whole.packets
    assert accounting.symbols_corrected == whole.symbols_corrected > 100
    assert accounting.frames_bad == whole.frames_bad == 3
    assert accounting.octets_skipped == whole.octets_skipped


def test_bare_packets_are_read_in_any_blocks(packets: list[bytes]) -> None:
    found, accounting = read(b"".join(packets), 100, 1000, SPACECRAFT)
    assert found == packets
    assert accounting.octets_skipped == 0


def test_two_spacecraft_in_one_file_are_told_apart(packets: list[bytes]) -> None:
    stream = encode_cadus(packets[:40], spacecraft_id=76) + encode_cadus(packets[20:60], spacecraft_id=33)
    reader = reader_of(stream)
    by_spacecraft: dict[int | None, list[bytes]] = {}
    for batch in reader.batches([stream]):
        by_spacecraft.setdefault(batch.spacecraft_id, []).extend(batch.octets)
    assert by_spacecraft == {76: packets[:40], 33: packets[20:60]}
    assert reader.accounting.frames_bad == 0


def test_frames_of_another_spacecraft_are_left_out_when_one_is_named(packets: list[bytes]) -> None:
    stream = encode_cadus(packets[:40], spacecraft_id=76) + encode_cadus(packets[20:60], spacecraft_id=33)
    found, accounting = read(stream, 1 << 20, 1 << 20, 33)
    assert found == packets[20:60]
    assert accounting.frames_bad > 0


def test_memory_does_not_grow_with_the_stream(packets: list[bytes]) -> None:
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT, frame_length=223)
    read(stream, 1 << 20, 1 << 20)  # imports and compiles
    reader = reader_of(stream, SPACECRAFT, window_octets=5 * len(stream))
    peaks: list[int] = []
    tracemalloc.start()
    for _ in reader.batches(stream for _ in range(75)):
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.reset_peak()
    tracemalloc.stop()
    assert len(peaks) == 15
    # The first windows leave behind what is kept for good; ten more windows of the stream do not.
    assert max(peaks[4:]) - peaks[3] < len(stream)


@pytest.mark.parametrize("window", [1 << 20, 60_000])
def test_the_uplink_is_seen_alike_in_windows_and_at_once(packets: list[bytes], window: int) -> None:
    encoder = DownlinkEncoder(SPACECRAFT, LinkSettings(frame_length=223))
    clcws = [
        pack_clcw(Clcw(0, k // 9, lockout=40 < k < 60, farm_b_counter=k % 4)) for k in range(len(packets))
    ]
    stream = encoder.encode(packets, clcw=clcws)
    (whole,) = decode(stream).uplink
    found, accounting = read(stream, 1000, window)
    assert set(found) == set(packets)
    assert accounting.uplink == {(SPACECRAFT, 0): whole}
    assert whole.frames == accounting.frames and whole.changes > 50 and whole.frames_lockout > 0


def test_the_uplinks_of_two_spacecraft_in_one_file_are_told_apart(packets: list[bytes]) -> None:
    stream = b"".join(
        DownlinkEncoder(spacecraft).encode(packets[:40], clcw=pack_clcw(Clcw(0, number)))
        for spacecraft, number in ((76, 5), (33, 200))
    )
    _, accounting = read(stream, 1 << 20, 1 << 20)
    assert {key: seen.report_value for key, seen in accounting.uplink.items()} == {(76, 0): 5, (33, 0): 200}
