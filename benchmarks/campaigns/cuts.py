"""Campaign of recordings cut at random octets: every split, order and repetition must give the same archive.

    python -m benchmarks.campaigns.cuts [--cases 500] [--kinds KIND...] [--postgresql]

Each case makes recordings of one kind from its number, cuts them at random octets, and ingests the pieces in order,
reversed, shuffled, interleaved, or with repetitions and a second split, in an instance of its own. The packets, the
values, the accounting of a pass over all of it (gaps, duplicates, octets, frames, receptions) and the sums over the
ingests must equal those of the whole recordings. With PostgreSQL, several processes ingest the pieces of a case at the
same time. The exit status is 1 if an archive differs.
"""

import argparse
import itertools
import multiprocessing
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import select

from benchmarks._servers import PostgresServer
from benchmarks.campaigns.compatibility import compare
from benchmarks.downlink import telemetry
from ground_service.errors import DatabaseBusy, GroundError
from ground_service.ground import Ground, open_ground
from ground_service.ingest.service import PiecePosition, ingest_file
from ground_service.ingest.store import get_ingest
from ground_service.missions.service import add_mission
from ground_service.passes.service import completeness, define_pass
from ground_service.store import repository
from ground_service.store.database import prepare_database
from ground_service.store.vehicles import vehicle_id
from lunar.timescales import utc_ns_from_ticks
from tests.ground_service.archive_hash import archive_hash
from tmtc.downlink import DownlinkEncoder
from tmtc.errors import TmtcError
from tmtc.link.frames import Clcw, pack_clcw
from tmtc.link.settings import LinkSettings
from tmtc.packets.space_packets import append_crc, pack_packet

SPACECRAFT, OTHER, RECORDED, FOREIGN, PREFIXED, BARE = 76, 33, 90, 91, 92, 93
ORDERS = ("in order", "reversed", "shuffled", "interleaved", "repeated", "cut twice")
SHORT = LinkSettings(frame_length=223)
UNCODED = LinkSettings(frame_length=256, coding="none")
UNPROVED = LinkSettings(frame_length=256, coding="none", checksum=False)
STATION_HEADER, STATION_TRAILER, PREFIX = 16, 4, 12
MISSIONS = (
    f'name = "records"\n[spacecraft]\nid = {RECORDED}\n[link]\nframe_length = 223\ncoding = "rs"\n'
    f'randomiser = "legacy"\nframe_checksum = true\n[link.stations.madrid]\nheader_octets = {STATION_HEADER}\n'
    f'trailer_octets = {STATION_TRAILER}\ntime_code = "unix_ns"\ntime_offset = 8\n',
    f'name = "foreign"\n[spacecraft]\nid = {FOREIGN}\n'
    '[[packets]]\nname = "bus"\napids = [100, 101]\npacket_checksum = "none"\n',
    f'name = "prefixed"\n[spacecraft]\nid = {PREFIXED}\n[link]\npacket_prefix_octets = {PREFIX}\n',
    f'name = "bare"\n[spacecraft]\nid = {BARE}\n[link]\npacket_checksum = "none"\n',
    'name = "uncoded"\n[spacecraft]\nid = 94\n[link]\nframe_length = 256\ncoding = "none"\n',
    'name = "without proof"\n[spacecraft]\nid = 95\n'
    '[link]\nframe_length = 256\ncoding = "none"\nframe_checksum = false\n',
)
NEW = ("packets_new", "samples")
SUMS = ("crc_errors", "frames", "frames_bad", "symbols_corrected")
LOST = ("frames_inverted", "lock_losses", "octets_frames", "codewords", "codewords_lost")
RECEPTION_SUMS = ("frames_good", "wrong_bits", "checked_bits", "octets_records", *LOST)
OF_LOST_FRAMES = ("frames", "frames_bad", "octets_other", *LOST)
"""Counts that include frames which cannot be used: at the border of two pieces, those may be counted with both."""

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Recording:
    """Octets of one reception, and what its sender states."""

    name: str
    octets: bytes
    spacecraft: int | None = None
    station: str = ""


@dataclass(frozen=True, slots=True)
class Piece:
    """Octets [start, stop) of a recording; `whole` pieces state no position."""

    recording: Recording
    start: int
    stop: int
    whole: bool = False


# Recordings


def frames_of(rng: Rng, settings: LinkSettings, frames: int, spacecraft: int = SPACECRAFT) -> np.ndarray:
    """CADUs (n, length) with packets of the dictionary."""
    packets = telemetry(frames, int(rng.integers(1 << 20)), settings)
    octets = DownlinkEncoder(spacecraft, settings).encode(packets)
    return np.frombuffer(octets, dtype=np.uint8).reshape(-1, settings.cadu_length)


def long_packets(rng: Rng, count: int, shortest: int = 2_000, longest: int = 9_000) -> list[bytes]:
    """Packets of an undeclared process, longer than a frame."""
    return [
        append_crc(pack_packet(0x155, rng.bytes(int(rng.integers(shortest, longest))) + b"\0\0", sequence_count=k)[:-2])
        for k in range(count)
    ]


def framed(settings: LinkSettings, frames: int) -> Callable[[Rng], list[Recording]]:
    return lambda rng: [Recording("r", frames_of(rng, settings, frames).tobytes())]


def channels(rng: Rng) -> list[Recording]:
    """Two virtual channels in turn, idle frames between, and long packets in one of the channels."""
    encoder = DownlinkEncoder(SPACECRAFT, SHORT)
    short = list(telemetry(16, int(rng.integers(1 << 20)), SHORT))
    parts, clcw = [], [pack_clcw(Clcw(0, k)) for k in range(3)]
    for k, packet in enumerate(long_packets(rng, 3, 300, 3_000)):
        slow = encoder.encode([packet], virtual_channel=1, clcw=clcw[k])
        fast = encoder.encode(short[k::3], clcw=clcw[k])
        rows = [slow[at : at + SHORT.cadu_length] for at in range(0, len(slow), SHORT.cadu_length)]
        places = np.linspace(0, 1, len(rows)).tolist()
        rows += [fast[at : at + SHORT.cadu_length] for at in range(0, len(fast), SHORT.cadu_length)]
        places += np.linspace(0, 1, len(rows) - len(places)).tolist()
        parts += [rows[i] for i in np.argsort(places, kind="stable").tolist()] + [encoder.idle(clcw=clcw[k])]
    return [Recording("r", b"".join(parts))]


def two_spacecraft(rng: Rng) -> list[Recording]:
    """Frames of two spacecraft in turn."""
    one, two = frames_of(rng, SHORT, 20), frames_of(rng, SHORT, 20, OTHER)
    n = min(len(one), len(two))
    return [Recording("r", np.stack((one[:n], two[:n]), axis=1).tobytes())]


def two_stations(rng: Rng) -> list[Recording]:
    """Two stations receive one downlink, each without other frames; one recording begins where the other ends."""
    rows = frames_of(rng, SHORT, 40)
    n = len(rows)
    kept = [np.flatnonzero(rng.random(n) > 0.15) for _ in range(2)]
    low, high = n // 3, 2 * n // 3
    return [
        Recording("one", rows[kept[0][kept[0] < high]].tobytes(), station="a"),
        Recording("two", rows[kept[1][kept[1] >= low]].tobytes(), station="b"),
    ]


def station_records(rng: Rng) -> list[Recording]:
    """Frames in records of a station."""
    rows = frames_of(rng, SHORT, 30, RECORDED)
    head = rng.integers(0, 256, (len(rows), STATION_HEADER), dtype=np.uint8)
    head[:, 8:] = (1_900_000_000_000_000_000 + np.arange(len(rows)) * 10**9).astype(">i8").view(np.uint8).reshape(-1, 8)
    tail = rng.integers(0, 256, (len(rows), STATION_TRAILER), dtype=np.uint8)
    return [Recording("r", np.hstack((head, rows, tail)).tobytes(), spacecraft=RECORDED, station="madrid")]


def damaged(rng: Rng) -> list[Recording]:
    """Frames with bursts, destroyed markers, lost and inserted octets, and the wrong polarity from a place on."""
    rows = frames_of(rng, SHORT, 50).copy()
    n, length = rows.shape
    for k in rng.choice(n, n // 6, replace=False).tolist():
        at = int(rng.integers(0, length - 14))
        rows[k, at : at + 14] = rng.integers(0, 256, 14)  # the code corrects it
    for k in rng.choice(n, n // 8, replace=False).tolist():
        rows[k, :4] = rng.integers(0, 256, 4)
    for k in rng.choice(n, n // 12, replace=False).tolist():
        rows[k, 20:100] = rng.integers(0, 256, 80)  # beyond repair
    if rng.random() < 0.5:
        rows[int(rng.integers(n)) :] ^= 0xFF
    octets = rows.tobytes()
    for _ in range(3):
        at = int(rng.integers(len(octets)))
        if rng.random() < 0.5:
            octets = octets[:at] + octets[at + int(rng.integers(1, 700)) :]
        else:
            octets = octets[:at] + rng.bytes(int(rng.integers(1, 900))) + octets[at:]
    return [Recording("r", octets)]


def bare(rng: Rng) -> list[Recording]:
    """Packets without frames, some longer than others."""
    packets = list(telemetry(12, int(rng.integers(1 << 20)), LinkSettings()))
    return [Recording("r", b"".join([*packets[::2], *long_packets(rng, 2), *packets[1::2]]), spacecraft=SPACECRAFT)]


def foreign(rng: Rng) -> list[Recording]:
    """Packets without a checksum, declared by a mission description or not, between others, in frames."""
    own = list(telemetry(20, int(rng.integers(1 << 20)), SHORT))
    packets = unchecked_packets(rng, len(own))
    mixed = [packet for pair in zip(own, packets, strict=True) for packet in pair]
    return [Recording("r", DownlinkEncoder(FOREIGN, SHORT).encode(mixed))]


def unchecked_packets(rng: Rng, count: int) -> list[bytes]:
    """Packets without checksum and time of two declared processes and of an undeclared one."""
    return [
        pack_packet(100 + k % 3, bytes(20) + rng.bytes(40 + 40 * (k % 3)), sequence_count=k // 3) for k in range(count)
    ]


def without_checksum(rng: Rng) -> list[Recording]:
    """Packets without frames and without checksums."""
    return [Recording("r", b"".join(unchecked_packets(rng, 300)), spacecraft=BARE)]


def prefixed(rng: Rng) -> list[Recording]:
    """Packets without frames, each behind octets of a recorder."""
    packets = telemetry(12, int(rng.integers(1 << 20)), LinkSettings())
    octets = b"".join(rng.bytes(PREFIX) + packet for packet in packets)
    return [Recording("r", octets, spacecraft=PREFIXED)]


KINDS: dict[str, Callable[[Rng], list[Recording]]] = {
    "frames": framed(LinkSettings(), 14),
    "short frames": framed(SHORT, 50),
    "uncoded": framed(UNCODED, 50),
    "without proof": framed(UNPROVED, 50),
    "channels": channels,
    "spacecraft": two_spacecraft,
    "stations": two_stations,
    "records": station_records,
    "damaged": damaged,
    "packets": bare,
    "foreign": foreign,
    "without checksum": without_checksum,
    "prefixed": prefixed,
}


# Splits


def cuts_of(octets: int, rng: Rng) -> list[int]:
    """Random cuts: anywhere, close to each other, or a stretch of a few octets each."""
    cuts = rng.integers(1, octets, int(rng.integers(1, 9)))
    if rng.random() < 0.4:
        at = int(rng.integers(1, octets))
        cuts = np.concatenate((cuts, at + np.cumsum(rng.integers(1, 60, int(rng.integers(1, 6))))))
    return sorted({one for one in cuts.tolist() if 0 < one < octets})


def split(recording: Recording, rng: Rng) -> list[Piece]:
    size = len(recording.octets)
    edges = [0, *cuts_of(size, rng), size]
    return [Piece(recording, start, stop) for start, stop in itertools.pairwise(edges)]


def ordered(pieces: list[Piece], rng: Rng, order: str) -> list[Piece]:
    """Return the pieces in one of the `ORDERS`."""
    if order == "reversed":
        return pieces[::-1]
    if order == "interleaved":
        return pieces[::2] + pieces[1::2]
    if order == "repeated":
        pieces = [*pieces, *(pieces[i] for i in rng.integers(0, len(pieces), max(len(pieces) // 3, 1)))]
    if order == "cut twice":
        again = [piece for one in dict.fromkeys(piece.recording for piece in pieces) for piece in split(one, rng)]
        pieces = [*pieces, *(again[i] for i in rng.permutation(len(again))[: len(again) // 2])]
    if order != "in order":
        pieces = [pieces[i] for i in rng.permutation(len(pieces))]
    return pieces


@dataclass(frozen=True, slots=True)
class Case:
    """One case of the campaign, made from its number."""

    number: int
    kind: str
    order: str
    recordings: list[Recording]
    pieces: list[Piece]


def case_of(number: int, kinds: Sequence[str] = tuple(KINDS)) -> Case:
    """Return a case; each kind meets each order."""
    kind = kinds[number % len(kinds)]
    order = ORDERS[number // len(kinds) % len(ORDERS)]
    rng = np.random.default_rng((1, number))
    recordings = KINDS[kind](rng)
    pieces = [piece for one in recordings for piece in split(one, rng)]
    return Case(number, kind, order, recordings, ordered(pieces, rng, order))


# Archives


def ingest(ground: Ground, piece: Piece, instance: str, name: str) -> int:
    """Ingest one piece; return the id of its ingest."""
    path = ground.home / f"piece-{name}"
    path.write_bytes(piece.recording.octets[piece.start : piece.stop])
    for attempt in range(20):
        try:
            return ingest_file(
                ground,
                path,
                spacecraft_id=piece.recording.spacecraft,
                instance=instance,
                place=None if piece.whole else PiecePosition(piece.recording.name, piece.start),
                station=piece.recording.station,
            ).ingest_id
        except DatabaseBusy:
            if attempt == 19:
                raise
    raise AssertionError


def contents(ground: Ground, case: Case, instance: str) -> dict[str, Any]:
    """Return what the archive of an instance holds, with nothing that depends on the way it was filled."""
    found: dict[str, Any] = {}
    ids = [SPACECRAFT, OTHER, RECORDED, FOREIGN, PREFIXED, BARE]
    with ground.database.writing() as connection:
        vehicles = {one: vehicle_id(connection, one, instance) for one in ids}
        found["archive"] = {one: archive_hash(connection, key) for one, key in vehicles.items()}
        table = repository.PACKETS
        found["packets"] = len(
            connection.execute(select(table.c.id).where(table.c.vehicle_id.in_(vehicles.values()))).all()
        )
    start, stop = (utc_ns_from_ticks(ticks) for ticks in (0, 10_000 << 16))
    found["passes"] = {}
    for one in ids:
        key = define_pass(
            ground, name=instance, start_utc_ns=start, stop_utc_ns=stop, spacecraft_id=one, instance=instance
        )
        account = completeness(ground, key)
        figures = asdict(replace(account, receptions=(), completeness=None))
        left_out = OF_LOST_FRAMES if case.kind == "damaged" else ()
        receptions = [
            {name: value for name, value in asdict(reception).items() if name not in left_out}
            for reception in account.receptions
        ]
        found["passes"][one] = figures | {"receptions": sorted(map(str, receptions))}
    return found


def sums(ground: Ground, case: Case, results: Sequence[tuple[Piece, int]]) -> dict[str, int]:
    """Return the sums over the ingests: what is new over all, the rest over the first ingest of each piece."""
    total = Counter(dict.fromkeys((*NEW, *SUMS, *RECEPTION_SUMS), 0))
    counted: set[Piece] = set()
    for piece, ingest_id in sorted(results, key=lambda one: one[1]):
        with ground.database.reading() as connection:
            values = get_ingest(connection, ingest_id).accounting
        assert values is not None
        total.update({name: getattr(values, name) for name in NEW})
        if piece in counted:
            continue
        counted.add(piece)
        total.update({name: getattr(values, name) for name in SUMS})
        if values.reception is not None:
            total.update({name: getattr(values.reception, name) for name in RECEPTION_SUMS})
    return {name: value for name, value in total.items() if case.kind != "damaged" or name not in OF_LOST_FRAMES}


def wholes(case: Case) -> list[Piece]:
    """Return the recordings of a case as pieces without a position."""
    return [Piece(one, 0, len(one.octets), whole=True) for one in case.recordings]


class Archive:
    """An archive in which cases are ingested, each in an instance of its own, by this process or by several."""

    def __init__(self, ground: Ground, pool: Any = None) -> None:
        self.ground, self._pool = ground, pool
        for text in MISSIONS:
            add_mission(ground, text.encode())

    def ingest(self, pieces: Sequence[Piece], instance: str) -> list[int]:
        """Ingest pieces; return the ids of their ingests."""
        work = [(piece, instance, str(number)) for number, piece in enumerate(pieces)]
        if self._pool is None:
            return [ingest(self.ground, *one) for one in work]
        return list(self._pool.map(_ingest_here, work, chunksize=1))

    def difference(self, case: Case) -> str:
        """Ingest a case and compare it with the whole recordings; empty if the archives are equal."""
        names = f"whole-{case.number}", f"pieces-{case.number}"
        try:
            whole = list(zip(wholes(case), self.ingest(wholes(case), names[0]), strict=True))
            results = list(zip(case.pieces, self.ingest(case.pieces, names[1]), strict=True))
            expected, found = (contents(self.ground, case, one) for one in names)
        except (GroundError, TmtcError) as error:
            return f"refused: {error}"
        expected["ingests"], found["ingests"] = (sums(self.ground, case, ids) for ids in (whole, results))
        text, is_equal = compare(expected, found)
        return "" if is_equal else text


_GROUND: list[Ground] = []


def _open_here(home: str, url: str) -> None:
    _GROUND.append(open_ground(Path(home), database_url=url))


def _ingest_here(work: tuple[Piece, str, str]) -> int:
    return ingest(_GROUND[0], *work)


@contextmanager
def archive(folder: Path, url: str | None = None, processes: int = 3) -> Iterator[Archive]:
    """Open an archive; with the URL of an empty PostgreSQL database, several processes ingest."""
    with ExitStack() as stack:
        pool = None
        if url is not None:
            prepare_database(url, upgrade=True).engine.dispose()
            context = multiprocessing.get_context("spawn")
            pool = stack.enter_context(context.Pool(processes, _open_here, (str(folder), url)))
        yield Archive(stack.enter_context(open_ground(folder, database_url=url)), pool)


def main() -> int:
    """Ingest all cases; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS), metavar="KIND")
    parser.add_argument("--postgresql", action="store_true")
    given = parser.parse_args()
    equal: Counter[str] = Counter()
    pieces, started = 0, time.monotonic()
    cases = [case_of(number, given.kinds) for number in range(given.cases)]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        url = stack.enter_context(PostgresServer(folder)).url if given.postgresql else None
        found = stack.enter_context(archive(folder / "home", url))
        for case in cases:
            pieces += len(case.pieces)
            difference = found.difference(case)
            equal[case.kind] += not difference
            if difference:
                print(f"case {case.number} ({case.kind}, {case.order}): {difference}", file=sys.stderr, flush=True)
    for name, count in sorted(Counter(case.kind for case in cases).items()):
        print(f"{name:<20}{equal[name]:>6} of {count} equal")
    print(f"all {equal.total()} of {len(cases)}, {pieces} pieces, {round(time.monotonic() - started)} s")
    return int(equal.total() != len(cases))


if __name__ == "__main__":
    sys.exit(main())
