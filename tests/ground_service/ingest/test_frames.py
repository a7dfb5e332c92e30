"""Reading a downlink in windows: no packet lost at a border, the same accounting as read at once."""

import tracemalloc
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from ground_service.ingest.bare import PacketReader
from ground_service.ingest.frames import FrameReader, Section
from ground_service.ingest.quality import NO_RECORD, Found
from tmtc.arrays import as_octets
from tmtc.downlink import DownlinkEncoder, LinkSettings, decode, encode_cadus, plan_of
from tmtc.link.frames import Clcw, pack_clcw

SPACECRAFT = 76


@pytest.fixture(scope="module")
def packets(make_pass: Callable[..., Any]) -> list[bytes]:
    return list(make_pass(frames=30).packets)


def windows(octets: bytes, size: int) -> Iterator[tuple[Any, bool]]:
    for start in range(0, len(octets), size):
        yield as_octets(octets[start : start + size]), start + size >= len(octets)


def reader_of(octets: bytes, spacecraft_id: int | None = None) -> FrameReader | PacketReader:
    sections = plan_of(octets).sections
    section = Section(None, 0, len(octets), 0, len(octets))
    if not sections:
        return PacketReader(section, Found(), spacecraft_id=spacecraft_id)
    return FrameReader(section, sections[0].settings, Found(), spacecraft_id=spacecraft_id, record=NO_RECORD)


def read(octets: bytes, window: int, spacecraft_id: int | None = None) -> tuple[list[bytes], Found, int]:
    """The packets, the counts, and the octets in no frame or packet."""
    reader = reader_of(octets, spacecraft_id)
    packets = [packet for batch in reader.batches(windows(octets, window)) for packet in batch.octets]
    found = reader.found
    return packets, found, len(octets) - found.octets_used + found.octets_unused


@pytest.mark.parametrize("window", [1 << 20, 8_000, 997])
def test_every_packet_comes_through_whatever_the_windows(packets: list[bytes], window: int) -> None:
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT, frame_length=223)
    found, accounting, skipped = read(stream, window)
    assert set(found) == set(packets)
    assert accounting.packets == len(packets)
    assert accounting.frames == len(stream) // 259
    assert (accounting.frames_bad, skipped, accounting.crc_errors) == (0, 0, 0)
    assert accounting.octets_used == len(stream)


@pytest.mark.parametrize("window", [1 << 20, 60_000])
def test_damage_is_accounted_for_alike_in_windows_and_at_once(packets: list[bytes], window: int) -> None:
    stream = bytearray(encode_cadus(packets, spacecraft_id=SPACECRAFT, frame_length=223))
    rng = np.random.default_rng(5)
    for at in rng.integers(0, len(stream), 3 * len(stream) // 259):
        stream[at] ^= int(rng.integers(1, 256))
    for frame in (3, 17, 40):
        stream[frame * 259 + 10 : frame * 259 + 110] = rng.bytes(100)
    whole = decode(bytes(stream))
    found, accounting, skipped = read(bytes(stream), window)
    assert set(found) == set(whole.cut.packets(whole.buffer))
    assert accounting.packets == whole.packets
    assert accounting.symbols_corrected == whole.symbols_corrected > 100
    assert accounting.frames_bad == whole.frames_bad == 3
    assert skipped == whole.octets_skipped


def test_bare_packets_are_read_in_any_windows(packets: list[bytes]) -> None:
    found, _, skipped = read(b"".join(packets), 1000, SPACECRAFT)
    assert (found, skipped) == (packets, 0)


def test_two_spacecraft_in_one_file_are_told_apart(packets: list[bytes]) -> None:
    stream = encode_cadus(packets[:40], spacecraft_id=76) + encode_cadus(packets[20:60], spacecraft_id=33)
    reader = reader_of(stream)
    by_spacecraft: dict[int | None, list[bytes]] = {}
    for batch in reader.batches(windows(stream, 1 << 20)):
        by_spacecraft.setdefault(batch.spacecraft_id, []).extend(batch.octets)
    assert by_spacecraft == {76: packets[:40], 33: packets[20:60]}
    assert reader.found.frames_bad == 0


def test_frames_of_another_spacecraft_are_left_out_when_one_is_named(packets: list[bytes]) -> None:
    stream = encode_cadus(packets[:40], spacecraft_id=76) + encode_cadus(packets[20:60], spacecraft_id=33)
    found, accounting, _ = read(stream, 1 << 20, 33)
    assert found == packets[20:60]
    assert accounting.frames_bad > 0


def test_memory_does_not_grow_with_the_stream(packets: list[bytes]) -> None:
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT, frame_length=223)
    read(stream, 1 << 20)  # imports and compiles
    section = Section(None, 0, 75 * len(stream), 0, 75 * len(stream))
    settings = LinkSettings(frame_length=223)
    reader = FrameReader(section, settings, Found(), spacecraft_id=SPACECRAFT, record=NO_RECORD)
    peaks: list[int] = []
    tracemalloc.start()
    for _ in reader.batches((as_octets(5 * stream), False) for _ in range(15)):
        reader.take_fragments()
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
    found, accounting, _ = read(stream, window)
    assert set(found) == set(packets)
    assert accounting.uplink == {(SPACECRAFT, 0): whole}
    assert whole.frames == accounting.frames and whole.changes > 50 and whole.frames_lockout > 0


def test_the_uplinks_of_two_spacecraft_in_one_file_are_told_apart(packets: list[bytes]) -> None:
    stream = b"".join(
        DownlinkEncoder(spacecraft).encode(packets[:40], clcw=pack_clcw(Clcw(0, number)))
        for spacecraft, number in ((76, 5), (33, 200))
    )
    _, accounting, _ = read(stream, 1 << 20)
    assert {key: seen.report_value for key, seen in accounting.uplink.items()} == {(76, 0): 5, (33, 0): 200}
