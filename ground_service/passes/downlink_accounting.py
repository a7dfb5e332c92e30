"""Accounting of octets, frames and packets of raw downlink files by on-board time.

Frames carry no time. A frame is assigned the time of the last packet that begins in it. A frame in which no packet
begins (damaged, idle, or the middle of a long packet) is assigned the time of the previous frame, or of the next one at
the start of a file. Therefore, every frame is assigned to the same pass as its neighbours. Files without a readable
packet belong to no pass.

The sequence count of a space packet has 14 bits and wraps; before anything is called a gap or a conflict it is
unwrapped, step by step in on-board time, never by arrival. Over a silence in which more than half a wrap of packets
could have been made, the number of whole wraps is chosen nearest to what the usual rate predicts. A count that falls
back while time goes on is a restart and begins a new run.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ground_service.telemetry.packets import packet_ticks
from lunar.arrays import BoolArray, IntArray
from tmtc.arrays import Octets
from tmtc.downlink import FRAME_FOREIGN, FRAME_GOOD, DownlinkDecode, decode
from tmtc.link.link_plan import LinkPlan, LinkSection
from tmtc.packets.pus import NO_TICKS, TICKS_PER_SECOND
from tmtc.packets.space_packets import SEQUENCE_COUNT_LIMIT
from tmtc.packets.stream import CHECKED, PacketForm

DIGEST_OCTETS = 16

REORDER_TICKS = TICKS_PER_SECOND
"""Counts may fall back within this time without meaning a restart: packets made in the same instant are stored in
no particular order. One second is far above the time between making two packets of one frame."""

RATE_PACKETS = 64
"""Packets over which a rate is taken."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Packets missing between two that came: how many, and the on-board times around them."""

    run: int
    first_count: int
    last_count: int
    before_ticks: int
    after_ticks: int

    @property
    def missing(self) -> int:
        """Return the number of missing packets."""
        return self.last_count - self.first_count + 1


@dataclass(frozen=True, slots=True, eq=False)
class SequenceAccount:
    """Sequence accounting of one vehicle and APID.

    `order` sorts the packets given into on-board order; `run` and `count` (n,) are in that order: the number of the
    run since a restart, and the unwrapped count within it. `conflicts` are packets whose unwrapped count another
    packet of other content has as well.
    """

    order: IntArray
    run: IntArray
    count: IntArray
    gaps: tuple[Gap, ...]
    restarts: int
    conflicts: int

    @property
    def lost(self) -> int:
        """Packets known to be missing."""
        return sum(gap.missing for gap in self.gaps)


def account_sequence(ticks: IntArray, sequence_count: IntArray) -> SequenceAccount:
    """Unwrap the counts of one APID and find what is missing.

    Parameters
    ----------
    ticks, sequence_count
        (n,) on-board time and 14-bit count of distinct packets, in any order.
    """
    ticks = np.asarray(ticks, dtype=np.int64)
    counts = np.asarray(sequence_count, dtype=np.int64)
    order = np.lexsort((counts, ticks)).astype(np.int64)
    if order.size == 0:
        return SequenceAccount(order, order.copy(), order.copy(), (), 0, 0)
    ticks, counts = ticks[order], counts[order]
    step_ticks = np.diff(ticks)
    near = np.mod(np.diff(counts) + SEQUENCE_COUNT_LIMIT // 2, SEQUENCE_COUNT_LIMIT) - SEQUENCE_COUNT_LIMIT // 2
    predicted = _usual_rate(near, step_ticks) * step_ticks
    far = predicted >= SEQUENCE_COUNT_LIMIT // 2
    wraps = np.where(far, np.rint((predicted - near) / SEQUENCE_COUNT_LIMIT), 0.0).astype(np.int64)
    steps = near + wraps * SEQUENCE_COUNT_LIMIT
    restart = (steps < 0) & (step_ticks > REORDER_TICKS)
    run = np.concatenate(([0], np.cumsum(restart))).astype(np.int64)
    total = np.concatenate(([0], np.cumsum(steps)))
    first = np.flatnonzero(np.concatenate(([True], restart)))
    count = total - total[first][run] + counts[first][run]

    by_count = np.lexsort((ticks, count, run))
    sorted_run, sorted_count, sorted_ticks = run[by_count], count[by_count], ticks[by_count]
    jump = np.diff(sorted_count)
    same_run = np.diff(sorted_run) == 0
    gaps = tuple(
        Gap(
            int(sorted_run[i]),
            int(sorted_count[i]) + 1,
            int(sorted_count[i + 1]) - 1,
            int(sorted_ticks[i]),
            int(sorted_ticks[i + 1]),
        )
        for i in np.flatnonzero(same_run & (jump > 1))
    )
    conflicts = int(np.count_nonzero(same_run & (jump == 0)))
    return SequenceAccount(order, run, count, gaps, int(run[-1]), conflicts)


def _usual_rate(near: IntArray, step_ticks: IntArray) -> float:
    """Packets per tick, as the median over stretches of `RATE_PACKETS` packets; 0 where too few packets say.

    Stretches, because packets come in bursts: the time between two of one burst says nothing about the rate.
    """
    if len(near) < RATE_PACKETS:
        return 0.0
    count = np.concatenate(([0], np.cumsum(near)))
    time = np.concatenate(([0], np.cumsum(step_ticks)))
    packets, ticks = count[RATE_PACKETS:] - count[:-RATE_PACKETS], time[RATE_PACKETS:] - time[:-RATE_PACKETS]
    forward = (packets > 0) & (ticks > 0)
    return float(np.median(packets[forward] / ticks[forward])) if forward.any() else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class RawFile:
    """Content of one raw file by on-board time; `NO_TICKS` if the time is unknown.

    Attributes
    ----------
    frame_ticks, frame_bad, frame_corrected, frame_octets
        For every frame (f,): time, whether it was unusable, corrected symbols, octets from its marker to the next.
    packet_ticks, packet_apid, packet_good
        For every packet (p,), including damaged ones; the APID of a damaged packet may be wrong.
    packet_digest
        Hash of every packet (p, 2) as two numbers of 64 bits, 0 for damaged ones.
    skipped_ticks, skipped_octets
        For every interval (s,) of octets that belongs to no frame or no packet.
    has_frames
        False for a file of bare packets.
    """

    frame_ticks: IntArray
    frame_bad: BoolArray
    frame_corrected: IntArray
    frame_octets: IntArray
    packet_ticks: IntArray
    packet_apid: IntArray
    packet_good: BoolArray
    packet_digest: NDArray[np.uint64]
    skipped_ticks: IntArray
    skipped_octets: IntArray
    has_frames: bool

    @property
    def octets(self) -> int:
        """Memory of the arrays."""
        arrays = (getattr(self, one.name) for one in fields(self))
        return sum(one.nbytes for one in arrays if isinstance(one, np.ndarray))

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last on-board time in the file; None if unknown."""
        times = self.packet_ticks[self.packet_ticks != NO_TICKS]
        return (int(times.min()), int(times.max())) if times.size else None


@dataclass(frozen=True, slots=True)
class RawAccount:
    """Sums over raw files within an interval of on-board time; `duplicates` and `crc_errors` are by APID.

    `frames` and `octets` are None if only bare packets were received.
    """

    frames: int | None
    frames_bad: int
    symbols_corrected: int
    octets: int
    octets_skipped: int
    duplicates: dict[int, int]
    crc_errors: dict[int, int]


def read_raw(
    octets: Octets, spacecraft_id: int | None, sections: Sequence[LinkSection] = (), form: PacketForm = CHECKED
) -> RawFile:
    """Return the content of a raw file for one spacecraft.

    `sections` are those of its ingest; without any, they follow from the file. `form` is that of the packets.

    Raises
    ------
    LinkFormatError
        If the file has frames with an unknown coding.
    """
    plan = LinkPlan(tuple(sections), None, has_regular_markers=True) if sections else None
    found = decode(octets, spacecraft_id=spacecraft_id, form=form, plan=plan)
    starts, good = found.cut.offsets, found.cut.crc_ok
    ticks = np.full(len(found.cut), NO_TICKS, dtype=np.int64)
    rows = np.flatnonzero(good)
    ticks[rows] = packet_ticks(found.buffer, found.cut, rows, found.headers.secondary_header[rows])
    order = np.argsort(starts, kind="stable")
    ticks[order] = _filled(ticks[order])
    skipped = _unused(found)
    skipped_ticks = ticks[order][_before(starts[order], skipped[:, 0])] if len(order) else _none(len(skipped))
    frames = _frames(found, starts[order], ticks[order], good[order])
    octets_skipped = skipped[:, 1] - skipped[:, 0]
    if found.frames is not None:
        # The parts of a reassembled packet are outside packets in the zones, but are used.
        joined = order[_frame_of(found, starts[order]) < 0]
        skipped_ticks = np.concatenate([skipped_ticks, ticks[joined]])
        octets_skipped = np.concatenate([octets_skipped, -found.cut.lengths[joined]])
        loose = frames[3] - found.frames.octets[found.frames.verdict != FRAME_FOREIGN]
        skipped_ticks = np.concatenate([skipped_ticks, frames[0]])
        octets_skipped = np.concatenate([octets_skipped, np.maximum(loose, 0)])
    return RawFile(
        *frames,
        packet_ticks=ticks,
        packet_apid=found.headers.apid.astype(np.int64),
        packet_good=good,
        packet_digest=_digests(found),
        skipped_ticks=skipped_ticks,
        skipped_octets=octets_skipped,
        has_frames=found.frames is not None,
    )


def account_raw(files: Sequence[RawFile], start_ticks: int, stop_ticks: int) -> RawAccount:
    """Return the sums over raw files from `start_ticks` to `stop_ticks`, both included."""

    def inside(ticks: IntArray) -> BoolArray:
        return np.asarray((ticks >= start_ticks) & (ticks <= stop_ticks), dtype=np.bool_)

    frames = frames_bad = corrected = octets = skipped = 0
    apids, digests, damaged = [_none(0)], [np.zeros((0, 2), dtype=np.uint64)], [_none(0)]
    for file in files:
        here = inside(file.frame_ticks)
        frames += int(np.count_nonzero(here))
        frames_bad += int(np.count_nonzero(here & file.frame_bad))
        corrected += int(file.frame_corrected[here].sum())
        octets += int(file.frame_octets[here].sum())
        skipped += int(file.skipped_octets[inside(file.skipped_ticks)].sum())
        here = inside(file.packet_ticks)
        apids.append(file.packet_apid[here & file.packet_good])
        digests.append(file.packet_digest[here & file.packet_good])
        damaged.append(file.packet_apid[here & ~file.packet_good])
    return RawAccount(
        frames=frames if any(file.has_frames for file in files) else None,
        frames_bad=frames_bad,
        symbols_corrected=corrected,
        octets=octets,
        octets_skipped=skipped,
        duplicates=_repeated(np.concatenate(apids), np.concatenate(digests)),
        crc_errors=_counts(np.concatenate(damaged)),
    )


def _repeated(apid: IntArray, digest: NDArray[np.uint64]) -> dict[int, int]:
    """Return how many packets (n,) of each APID have the hash of another one that is counted."""
    order = np.lexsort((digest[:, 1], digest[:, 0], apid))
    apid, digest = apid[order], digest[order]
    same = (np.diff(apid) == 0) & (np.diff(digest, axis=0) == 0).all(axis=1)
    repeated = _counts(apid[1:][same])
    return {one: repeated.get(one, 0) for one in np.unique(apid).tolist()}


def _counts(apid: IntArray) -> dict[int, int]:
    """Return the number of packets (n,) of each APID."""
    values, counts = np.unique(apid, return_counts=True)
    return dict(zip(values.tolist(), counts.tolist(), strict=True))


def _frames(
    found: DownlinkDecode, starts: IntArray, ticks: IntArray, good: BoolArray
) -> tuple[IntArray, BoolArray, IntArray, IntArray]:
    """Return time, unusable flag, corrected symbols and octets of every frame, except those of other spacecraft."""
    table = found.frames
    if table is None:
        none = np.zeros(0, dtype=np.int64)
        return none, none.astype(np.bool_), none, none
    own = np.flatnonzero(table.verdict != FRAME_FOREIGN)
    frame_ticks = np.full(len(table), NO_TICKS, dtype=np.int64)
    frame = _frame_of(found, starts)
    known = np.flatnonzero(good & (ticks != NO_TICKS) & (frame >= 0))
    # The assignment keeps the last packet that begins in each frame.
    frame_ticks[frame[known]] = ticks[known]
    # Octets between two markers belong to the frame of the first one, octets before the first marker to the first
    # frame.
    edges = np.concatenate([table.offset, [sum(found.octets.values())]])
    edges[0] = 0
    corrected = np.where(table.corrected > 0, table.corrected, 0).sum(axis=1).astype(np.int64)
    return (
        _filled(frame_ticks)[own],
        np.asarray(table.verdict != FRAME_GOOD, dtype=np.bool_)[own],
        corrected[own],
        np.diff(edges)[own],
    )


def _frame_of(found: DownlinkDecode, places: IntArray) -> IntArray:
    """Return the row of the frame whose packet zone contains each position of the buffer; -1 if none does."""
    table = found.frames
    assert table is not None
    used = np.flatnonzero(table.buffer_offset >= 0)
    used = used[np.argsort(table.buffer_offset[used], kind="stable")]
    if not used.size:
        return np.full(len(places), -1, dtype=np.int64)
    rows = used[_before(table.buffer_offset[used], places)]
    inside = (places >= table.buffer_offset[rows]) & (places < table.buffer_offset[rows] + table.buffer_octets[rows])
    return np.where(inside, rows, -1)


def _unused(found: DownlinkDecode) -> IntArray:
    """Return the ranges (s, 2) of the buffer outside packets: skipped octets, and packets whose start was lost."""
    cut = found.cut
    taken = np.concatenate(
        [np.stack([cut.offsets, cut.offsets + cut.lengths], axis=1), cut.idle.reshape(-1, 2)]
    ).astype(np.int64)
    taken = taken[np.argsort(taken[:, 0], kind="stable")]
    starts = np.concatenate([[0], taken[:, 1]])
    stops = np.concatenate([taken[:, 0], [len(found.buffer)]])
    return np.stack([starts, stops], axis=1)[stops > starts]


def _before(edges: IntArray, places: IntArray) -> IntArray:
    """Return the row of the last edge (ascending) at or before each position; the first row if there is none."""
    return np.maximum(np.searchsorted(edges, places, side="right") - 1, 0)


def _filled(ticks: IntArray) -> IntArray:
    """Return times (n,) with unknown times replaced by the previous one, at the start by the first known one."""
    known = np.flatnonzero(ticks != NO_TICKS)
    if not known.size:
        return ticks
    last = np.searchsorted(known, np.arange(len(ticks)), side="right") - 1
    return np.asarray(ticks[known[np.maximum(last, 0)]], dtype=np.int64)


def _none(count: int) -> IntArray:
    return np.full(count, NO_TICKS, dtype=np.int64)


def _digests(found: DownlinkDecode) -> NDArray[np.uint64]:
    view = found.buffer.data
    rows = zip(found.cut.offsets.tolist(), found.cut.lengths.tolist(), found.cut.crc_ok.tolist(), strict=True)
    octets = b"".join(
        hashlib.blake2b(view[start : start + length], digest_size=DIGEST_OCTETS).digest()
        if good
        else bytes(DIGEST_OCTETS)
        for start, length, good in rows
    )
    return np.frombuffer(octets, dtype="<u8").reshape(-1, 2).astype(np.uint64)
