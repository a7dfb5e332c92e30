"""Downlink streams of ground stations, with the packets that can be found in each: python -m benchmarks downlink.

Every stream is made from a seed. The packets that a correct decoder finds follow from the construction: each CADU is
decoded at its true position, and a packet can be found if all of its frames can. `linna tm check` and `linna ingest`
are compared with this number, and their octet accounting with the size of the stream.
"""

import functools
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks._rows import Row
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import DownlinkEncoder, decode
from tmtc.errors import TmtcError
from tmtc.link import reed_solomon
from tmtc.link.frames import frame_checksums_hold, randomise
from tmtc.link.settings import LinkSettings
from tmtc.packets.space_packets import PacketSequencer, pack_packet
from tmtc.packets.stream import PacketForm

SPACECRAFT, OTHER_SPACECRAFT = 76, 33
FRAMES = 2000
SHORT = 400
"""Number of frames of the streams of a whole recording, and of the others."""

MISSION = """
name = "test"
[spacecraft]
id = {}
[link]
{}
"""

WEAK = 1.5e-2
"""Bit error rate at which hardly a codeword of Reed-Solomon (255, 223) can be repaired."""

Rows = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Files of a downlink and the packets that a correct decoder finds in them, by spacecraft."""

    name: str
    files: tuple[bytes, ...]
    packets: dict[int, frozenset[bytes]]
    error_control: bool = True
    declared: tuple[str, ...] = ()
    """Link settings of the mission descriptions that the ingest needs."""

    @property
    def true(self) -> int:
        """Number of packets that can be found."""
        return sum(len(one) for one in self.packets.values())


@functools.cache
def telemetry(frames: int, seed: int = 0, settings: LinkSettings = LinkSettings()) -> tuple[bytes, ...]:
    """Return packets of the dictionary that fill about this number of frames."""
    rng = np.random.default_rng(seed)
    sequencer = PacketSequencer()
    packets: list[bytes] = []
    filled = k = 0
    while filled < (frames - 1) * (settings.frame_length - 8):
        n = int(rng.integers(0, 30))
        items = {
            "u_px": rng.uniform(0, 511, n),
            "v_px": rng.uniform(0, 511, n),
            "diameter_px": rng.uniform(5, 80, n),
            "score": rng.uniform(0, 1, n),
            "size_class": rng.integers(-1, 4, n),
            "sigma_px": np.full(n, 1.0),
        }
        event = {"event_id": 3, "frame_number": k, "value_1": float(seed), "value_2": 2.0}
        image = {"frame_number": k, "image_ticks": k << 16, "image_quality": 0, "items": items}
        for name, values in (("detections", image), ("event_low", event)):
            count = sequencer.next(DICTIONARY.packet(name).apid)
            packets.append(DICTIONARY.pack(name, values, ticks=k << 16, sequence_count=count))
            filled += len(packets[-1])
        k += 1
    return tuple(packets)


@functools.cache
def cadus(
    frames: int = SHORT, seed: int = 0, settings: LinkSettings = LinkSettings(), spacecraft: int = SPACECRAFT
) -> Rows:
    """Return CADUs, one per row."""
    octets = DownlinkEncoder(spacecraft, settings).encode(telemetry(frames, seed, settings))
    return np.frombuffer(octets, dtype=np.uint8).reshape(-1, settings.cadu_length)


def with_bit_errors(rows: Rows, rate: float, seed: int) -> Rows:
    """Return the rows with independent bit errors."""
    bits = np.unpackbits(rows.reshape(-1))
    wrong = np.random.default_rng(seed).random(bits.size) < rate
    return np.packbits(bits ^ wrong).reshape(rows.shape)


def can_be_read(rows: Rows, settings: LinkSettings) -> NDArray[np.bool_]:
    """Return whether each CADU at its true position gives a valid frame."""
    blocks = randomise(np.ascontiguousarray(rows[:, 4:]), settings.randomiser)
    if settings.code is None:
        return frame_checksums_hold(blocks)
    repaired = reed_solomon.decode(blocks, settings.code)
    good: NDArray[np.bool_] = (repaired.corrected >= 0).all(axis=1)
    return good & frame_checksums_hold(repaired.frames) if settings.checksum else good


def packets_of(
    received: NDArray[np.bool_] | set[int], packets: Sequence[bytes], settings: LinkSettings
) -> frozenset[bytes]:
    """Return the packets whose frames were all received."""
    numbers = received if isinstance(received, set) else set(np.flatnonzero(received).tolist())
    zone = settings.frame_length - 6 - (2 if settings.checksum else 0)
    at, whole = 0, set()
    for packet in packets:
        if numbers.issuperset(range(at // zone, (at + len(packet) - 1) // zone + 1)):
            whole.add(packet)
        at += len(packet)
    return frozenset(whole)


def _one(
    name: str, stream: NDArray[np.uint8] | bytes, packets: frozenset[bytes] | tuple[bytes, ...], **more: Any
) -> Stream:
    octets = stream if isinstance(stream, bytes) else stream.tobytes()
    return Stream(name, (octets,), {SPACECRAFT: frozenset(packets)}, **more)


def _readable(
    name: str, rows: Rows, frames: int, settings: LinkSettings = LinkSettings(), seed: int = 0, **more: Any
) -> Stream:
    """Return the stream of rows, with the packets of the telemetry whose frames can be read."""
    packets = telemetry(frames, seed, settings)
    stream = more.pop("stream", rows)
    return _one(name, stream, packets_of(can_be_read(rows, settings), packets, settings), **more)


def weak_start(weak: int, frames: int = FRAMES, first: int = 0) -> Stream:
    """Return a recording with many bit errors in its first frames, or in those from another one on."""
    rows = cadus(frames).copy()
    rows[first : first + weak] = with_bit_errors(rows[first : first + weak], WEAK, seed=weak)
    where = "in the middle" if first else "at its start"
    return _readable(f"{weak} of {len(rows)} frames weak {where}", rows, frames)


def weak_everywhere(rate: float, seed: int) -> Stream:
    """Return a recording with one bit error rate."""
    rows = with_bit_errors(cadus(60), rate, seed)
    return _readable(f"bit error rate {rate:.1e} throughout, seed {seed}", rows, 60)


def noise_before(octets: int) -> Stream:
    """Return a recording that begins with noise."""
    noise = np.random.default_rng(octets).integers(0, 256, octets, dtype=np.uint8)
    return _one(f"{octets} octets of noise first", np.concatenate((noise, cadus().reshape(-1))), telemetry(SHORT))


def station_header(rate: float) -> Stream:
    """Return CADUs behind a station header of 8 octets: counter, and noise."""
    header = np.random.default_rng(8).integers(0, 256, (len(cadus()), 8), dtype=np.uint8)
    rows = with_bit_errors(cadus(), rate, seed=9)
    name = f"station header of 8 octets, bit error rate {rate:.0e}"
    return _readable(name, rows, SHORT, stream=np.hstack((header, rows)))


def random_gaps() -> Stream:
    """Return CADUs with gaps of random length."""
    rng = np.random.default_rng(10)
    parts = []
    for row in cadus():
        parts += [rng.integers(0, 256, int(rng.integers(0, 60)), dtype=np.uint8), row]
    return _one("random gaps between frames", np.concatenate(parts), telemetry(SHORT))


def bit_slips() -> Stream:
    """Return a recording that lost a bit in three frames."""
    length = 8 * LinkSettings().cadu_length
    lost = [9 * length + 4000, 50 * length + 77, 100 * length + 9000]
    stream = np.packbits(np.delete(np.unpackbits(cadus().reshape(-1)), lost))
    found = packets_of(set(range(len(cadus()))) - {9, 50, 100}, telemetry(SHORT), LinkSettings())
    return _one("three bits lost", stream, found)


def inverted() -> Stream:
    """Return a recording with the wrong polarity from its middle on."""
    rows = cadus().copy()
    rows[len(rows) // 2 :] ^= 0xFF
    return _one("inverted from the middle on", rows, telemetry(SHORT))


def settings_change() -> Stream:
    """Return a recording in which coding, randomiser and frame length change."""
    kinds = (
        LinkSettings(),
        LinkSettings(frame_length=892, interleave=4, randomiser="long"),
        LinkSettings(frame_length=1024, coding="none"),
    )
    parts = [cadus(SHORT, k, kind).reshape(-1) for k, kind in enumerate(kinds)]
    packets = [one for k, kind in enumerate(kinds) for one in telemetry(SHORT, k, kind)]
    declared = ('frame_length = 892\ninterleave = 4\nrandomiser = "long"', 'frame_length = 1024\ncoding = "none"')
    return _one("settings change twice", np.concatenate(parts), tuple(packets), declared=declared)


def shuffled() -> Stream:
    """Return the frames in any order."""
    order = np.random.default_rng(4).permutation(len(cadus()))
    return _one("frames in random order", cadus()[order], telemetry(SHORT))


def two_receivers(one_file: bool) -> Stream:
    """Return the recordings of two receivers, each with 15 % of the frames lost."""
    rng = np.random.default_rng(12)
    n = len(cadus())
    first, second = (np.flatnonzero(rng.random(n) > 0.15) for _ in range(2))
    files = (cadus()[first].tobytes(), cadus()[second].tobytes())
    found = packets_of(set(first.tolist()) | set(second.tolist()), telemetry(SHORT), LinkSettings())
    name = "two receivers with 15 % loss each, " + ("one file" if one_file else "two files")
    return Stream(name, (b"".join(files),) if one_file else files, {SPACECRAFT: found})


def two_spacecraft() -> Stream:
    """Return frames of two spacecraft, interleaved."""
    mine, other = cadus(SHORT)[:SHORT], cadus(SHORT, 7, LinkSettings(), OTHER_SPACECRAFT)[:SHORT]
    rows = np.empty((2 * min(len(mine), len(other)), mine.shape[1]), dtype=np.uint8)
    rows[0::2], rows[1::2] = mine[: len(rows) // 2], other[: len(rows) // 2]
    received = set(range(len(rows) // 2))
    found = {
        SPACECRAFT: packets_of(received, telemetry(SHORT), LinkSettings()),
        OTHER_SPACECRAFT: packets_of(received, telemetry(SHORT, 7), LinkSettings()),
    }
    return Stream("frames of two spacecraft in turn", (rows.tobytes(),), found)


def uncoded_weak() -> Stream:
    """Return uncoded frames with checksums, of which some have bit errors."""
    settings = LinkSettings(coding="none")
    rows = with_bit_errors(cadus(SHORT, 2, settings), 2e-5, seed=3)
    name, declared = "uncoded with checksum, bit error rate 2e-5", ('coding = "none"',)
    return _readable(name, rows, SHORT, settings, 2, declared=declared)


def without_error_control() -> Stream:
    """Return 7,200 packets without packet error control and PUS, as in most captures of other missions."""
    rng = np.random.default_rng(21)
    packets = [
        pack_packet(
            0x200 + k % 3, bytes(1) + rng.bytes(59 + 40 * (k % 3)), sequence_count=k // 3, secondary_header=True
        )
        for k in range(7200)
    ]
    name, declared = "7,200 packets without error control", ('packet_checksum = "none"',)
    return _one(name, b"".join(packets), tuple(packets), error_control=False, declared=declared)


STREAMS: dict[str, Callable[[], Stream]] = {
    "clean": lambda: _one("undamaged", cadus(FRAMES), telemetry(FRAMES)),
    "weak-100": lambda: weak_start(100),
    "weak-220": lambda: weak_start(220),
    "weak-400": lambda: weak_start(400),
    "weak-middle": lambda: weak_start(400, first=FRAMES // 2),
    "weak-1e-2": lambda: weak_everywhere(1e-2, 0),
    "noise-77000": lambda: noise_before(77_000),
    "noise-79000": lambda: noise_before(79_000),
    "noise-3000000": lambda: noise_before(3_000_000),
    "header": lambda: station_header(0.0),
    "header-errors": lambda: station_header(2e-3),
    "gaps": random_gaps,
    "slips": bit_slips,
    "inverted": inverted,
    "change": settings_change,
    "twice": lambda: _one("every frame twice", np.repeat(cadus(), 2, axis=0), telemetry(SHORT)),
    "odd-even": lambda: _one(
        "odd frames, then even frames", np.concatenate((cadus()[1::2], cadus()[0::2])), telemetry(SHORT)
    ),
    "shuffled": shuffled,
    "receivers-one-file": lambda: two_receivers(one_file=True),
    "receivers-two-files": lambda: two_receivers(one_file=False),
    "spacecraft": two_spacecraft,
    "uncoded": uncoded_weak,
    "no-error-control": without_error_control,
}
"""Streams by their short name."""


@dataclass(frozen=True, slots=True)
class FoundPackets:
    """Packets found in a stream by one program, false ones, and octets accounted for."""

    packets: int
    false: int
    octets: int


def checked(stream: Stream) -> FoundPackets:
    """Return what `linna tm check` finds in each spacecraft's frames of all files together."""
    octets = b"".join(stream.files)
    found = false = accounted = 0
    for spacecraft, packets in stream.packets.items():
        try:
            decoded = decode(octets, spacecraft_id=spacecraft, form=PacketForm(stream.error_control))
        except TmtcError:
            return FoundPackets(0, 0, 0)
        mine = set(decoded.cut.packets(decoded.buffer))
        found += len(mine & packets)
        false += len(mine - packets)
        accounted = sum(decoded.octets.values())
    return FoundPackets(found, false, accounted)


def ingested(stream: Stream) -> FoundPackets:
    """Return what `linna ingest` stores of the files in an empty archive."""
    from sqlalchemy import select

    from ground_service.errors import GroundError
    from ground_service.ground import open_ground
    from ground_service.ingest.service import ingest_file
    from ground_service.missions.service import add_mission
    from ground_service.store import repository
    from ground_service.store.vehicles import vehicle_id

    bare = SPACECRAFT if not stream.error_control else None
    with tempfile.TemporaryDirectory() as folder:
        ground = open_ground(Path(folder, "home"))
        for number, link in enumerate(stream.declared):
            add_mission(ground, MISSION.format(SPACECRAFT + number, link).encode())
        accounted = 0
        for number, octets in enumerate(stream.files):
            path = Path(folder, f"{number}.bin")
            path.write_bytes(octets)
            try:
                accounted += ingest_file(ground, path, spacecraft_id=bare).octets
            except (GroundError, TmtcError):
                continue
        found = false = 0
        table = repository.PACKETS
        with ground.database.reading() as connection:
            for spacecraft, packets in stream.packets.items():
                vehicle = vehicle_id(connection, spacecraft, "flight")
                rows = connection.execute(select(table.c.octets).where(table.c.vehicle_id == vehicle))
                mine = {bytes(row) for row in rows.scalars()}
                found += len(mine & packets)
                false += len(mine - packets)
        ground.close()
    return FoundPackets(found, false, accounted)


def rows() -> Iterator[Row]:
    """Yield the packets that `tm check` and `ingest` find, compared with those that can be found."""
    for made in STREAMS.values():
        stream = made()
        right = FoundPackets(stream.true, 0, sum(map(len, stream.files)))
        by_check, by_ingest = checked(stream), ingested(stream)
        wrong = "" if by_check == by_ingest == right else f"check {by_check}, ingest {by_ingest}, expected {right}"
        yield Row(stream.name, by_ingest.packets, "packets", "that can be found", stream.true, wrong)


def noise_found(files: int) -> dict[str, int]:
    """Return the number of random files with a packet, a frame without proof, or a good frame."""
    counts = {"files": files, "with_packets": 0, "with_good_frames": 0}
    for seed in range(files):
        rng = np.random.default_rng(seed)
        octets = rng.bytes(int(rng.integers(2_000, 100_000)))
        if seed % 2:  # markers at a regular distance that nothing stands behind
            stream = np.frombuffer(octets, dtype=np.uint8).copy()
            period = int(rng.choice((259, 514, 1028, 1279)))
            for k, octet in enumerate(bytes.fromhex("1ACFFC1D")):
                stream[k : stream.size - 4 + k : period] = octet
            octets = stream.tobytes()
        try:
            decoded = decode(octets)
        except TmtcError:
            continue
        counts["with_packets"] += bool(decoded.packets)
        counts["with_good_frames"] += bool(decoded.frame_count - decoded.frames_bad - decoded.frames_unchecked)
    return counts
