"""Packets to CADUs and back, with every octet of the downlink accounted for.

Sending: packets → one unbroken stream of octets per virtual channel → TM transfer frames → Reed-Solomon
codeblocks → randomised → behind markers. Receiving goes the other way, finds out the settings of the link
by trial where they are not given, and never fails on damage: what is lost is counted and located.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from tmtc import cadu, reed_solomon
from tmtc.clcw import UplinkSeen, uplink_seen
from tmtc.crc import CRC_LENGTH
from tmtc.dictionary import DICTIONARY
from tmtc.errors import LinkFormatError, ValueRefused
from tmtc.frames import (
    FRAME_HEADER_LENGTH,
    FRAME_MAX_LENGTH,
    IDLE_CHANNEL,
    NO_PACKET_BEGINS,
    OCF_LENGTH,
    ONLY_IDLE_DATA,
    append_frame_checksums,
    frame_checksums_hold,
    frame_headers,
    idle_data,
)
from tmtc.packets import idle_packet
from tmtc.pus import TM_HEADER_LENGTH
from tmtc.randomiser import Randomiser, randomise
from tmtc.reed_solomon import ReedSolomon, code_for
from tmtc.schema import Dictionary, Table, as_octets
from tmtc.sequence import SequenceReport, account
from tmtc.stream import Octets, PacketCut, PrimaryHeaders, cut_packets, primary_headers

OctetArray = npt.NDArray[np.uint8]
IntArray = npt.NDArray[np.int64]
Coding = Literal["rs", "none"]

FRAME_GOOD, FRAME_UNCORRECTABLE, FRAME_BAD_CHECKSUM, FRAME_FOREIGN = 0, 1, 2, 3
FRAME_VERDICTS = ("good", "uncorrectable", "bad_checksum", "foreign")

_RANDOMISERS: tuple[Randomiser, ...] = ("legacy", "long", "none")
_BATCH = 512
_SAMPLE = 48


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """How frames travel; what both ends of a link have to agree on.

    `interleave` None takes the least that fits `frame_length`. `checksum`: frames end with frame error
    control.
    """

    frame_length: int = 1115
    coding: Coding = "rs"
    randomiser: Randomiser = "legacy"
    interleave: int | None = None
    rs_errors: int = 16
    dual_basis: bool = True
    checksum: bool = True

    @property
    def code(self) -> ReedSolomon | None:
        """The Reed-Solomon code, or None."""
        if self.coding == "none":
            return None
        if self.coding != "rs":
            raise LinkFormatError(f"link: expected coding rs or none, found {self.coding!r}")
        return code_for(self.frame_length, self.rs_errors, self.interleave, self.dual_basis)

    @property
    def block_length(self) -> int:
        """Octets between two markers."""
        code = self.code
        return self.frame_length if code is None else code.block_length

    @property
    def cadu_length(self) -> int:
        """Octets of a CADU, marker included."""
        return cadu.ASM_LENGTH + self.block_length


@dataclass(slots=True)
class DownlinkEncoder:
    """The sending end: keeps the frame counts from one call to the next."""

    spacecraft_id: int
    settings: LinkSettings = LinkSettings()
    master_count: int = 0
    channel_counts: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 0 <= self.spacecraft_id < 1 << 10:
            raise ValueRefused("transfer frame", "spacecraft_id", self.spacecraft_id, "0..1023")
        if not 16 <= self.settings.frame_length <= FRAME_MAX_LENGTH:
            raise ValueRefused(
                "transfer frame", "frame_length", self.settings.frame_length, f"16..{FRAME_MAX_LENGTH}"
            )

    def encode(
        self,
        packets: Iterable[bytes],
        virtual_channel: int = 0,
        clcw: bytes | Sequence[bytes] | None = None,
    ) -> bytes:
        """CADUs that carry `packets` whole, the last frame filled up with an idle packet; nothing for none.

        `clcw` is the operational control field of all frames; or one for each packet, of which a frame carries that of
        the last packet that has begun by its end. None: the frames have no such field.
        """
        joined = list(packets)
        lengths = np.array([len(p) for p in joined], dtype=np.int64)
        if not lengths.size:
            return b""
        zone = self._zone(clcw)
        total = int(lengths.sum())
        fill = -total % zone
        if 0 < fill < FRAME_HEADER_LENGTH + 1:
            fill += zone
        starts = np.cumsum(lengths) - lengths
        if fill:
            joined.append(idle_packet(fill))
            starts = np.append(starts, total)
        data = np.frombuffer(b"".join(joined), dtype=np.uint8).reshape(-1, zone)
        pointers = np.full(data.shape[0], NO_PACKET_BEGINS, dtype=np.int64)
        frame, first = np.unique(starts // zone, return_index=True)
        pointers[frame] = starts[first] % zone
        fields = _control_fields(clcw, 1 if isinstance(clcw, bytes) else lengths.size)
        if fields is not None and not isinstance(clcw, bytes):
            fields = fields[np.searchsorted(starts[: lengths.size], zone * np.arange(1, len(data) + 1)) - 1]
        return self._cadus(data, pointers, virtual_channel, fields)

    def idle(self, frames: int = 1, clcw: bytes | None = None) -> bytes:
        """CADUs that carry nothing, on the idle channel."""
        data = np.frombuffer(idle_data(self._zone(clcw)), dtype=np.uint8)
        pointers = np.full(frames, ONLY_IDLE_DATA, dtype=np.int64)
        data = np.broadcast_to(data, (frames, data.size))
        return self._cadus(data, pointers, IDLE_CHANNEL, _control_fields(clcw, 1))

    def _zone(self, clcw: bytes | Sequence[bytes] | None) -> int:
        """Octets of a frame for packets."""
        return (
            self.settings.frame_length
            - FRAME_HEADER_LENGTH
            - (0 if clcw is None else OCF_LENGTH)
            - (CRC_LENGTH if self.settings.checksum else 0)
        )

    def _cadus(
        self, data: OctetArray, pointers: IntArray, virtual_channel: int, clcw: OctetArray | None
    ) -> bytes:
        """CADUs of packet zones (n, zone) with operational control fields (n or 1, 4)."""
        if not 0 <= virtual_channel < 8:
            raise ValueRefused("transfer frame", "virtual_channel", virtual_channel, "0..7")
        n, zone = data.shape
        settings = self.settings
        code = settings.code
        count = np.arange(n, dtype=np.int64)
        channel_count = self.channel_counts.get(virtual_channel, 0)
        first = self.spacecraft_id << 4 | virtual_channel << 1 | (clcw is not None)
        frames = np.empty((n, settings.frame_length), dtype=np.uint8)
        frames[:, 0], frames[:, 1] = first >> 8, first & 0xFF
        frames[:, 2] = (self.master_count + count) & 0xFF
        frames[:, 3] = (channel_count + count) & 0xFF
        frames[:, 4], frames[:, 5] = 0b11 << 3 | pointers >> 8, pointers & 0xFF
        frames[:, FRAME_HEADER_LENGTH : FRAME_HEADER_LENGTH + zone] = data
        if clcw is not None:
            at = FRAME_HEADER_LENGTH + zone
            frames[:, at : at + OCF_LENGTH] = clcw
        if settings.checksum:
            append_frame_checksums(frames)
        self.master_count = (self.master_count + n) & 0xFF
        self.channel_counts[virtual_channel] = (channel_count + n) & 0xFF
        blocks = frames if code is None else reed_solomon.encode(frames, code)
        result = np.empty((n, settings.cadu_length), dtype=np.uint8)
        result[:, : cadu.ASM_LENGTH] = np.frombuffer(cadu.ASM, dtype=np.uint8)
        result[:, cadu.ASM_LENGTH :] = randomise(blocks, settings.randomiser)
        return result.tobytes()


def _control_fields(clcw: bytes | Sequence[bytes] | None, count: int) -> OctetArray | None:
    """The operational control fields (count, 4)."""
    if clcw is None:
        return None
    fields = [clcw] if isinstance(clcw, bytes) else list(clcw)
    if len(fields) != count:
        raise ValueRefused("transfer frame", "clcw", f"{len(fields)} fields", f"{count}, one for each packet")
    wrong = next((one for one in fields if len(one) != OCF_LENGTH), None)
    if wrong is not None:
        raise ValueRefused("transfer frame", "clcw", wrong, f"{OCF_LENGTH} octets")
    return np.frombuffer(b"".join(fields), dtype=np.uint8).reshape(count, OCF_LENGTH)


def encode_cadus(
    packets: Iterable[bytes],
    *,
    spacecraft_id: int,
    virtual_channel: int = 0,
    frame_length: int = 1115,
    coding: Coding = "rs",
    randomiser: Randomiser = "legacy",
    interleave: int | None = None,
    checksum: bool = True,
) -> bytes:
    """A whole downlink: CADUs that carry `packets`, frame counts from zero (`DownlinkEncoder` goes on counting)."""
    settings = LinkSettings(
        frame_length=frame_length,
        coding=coding,
        randomiser=randomiser,
        interleave=interleave,
        checksum=checksum,
    )
    return DownlinkEncoder(spacecraft_id, settings).encode(packets, virtual_channel)


@dataclass(frozen=True, slots=True, eq=False)
class FrameTable:
    """One row for every CADU that was found, the discarded ones too.

    `offset` of the marker in the stream, `marker_errors` wrong bits of it, `corrected` symbols repaired
    ((n, interleave), -1 where a codeword is lost), `verdict` an index of `FRAME_VERDICTS`; the header
    fields of lost frames are not to be trusted.
    """

    offset: IntArray
    marker_errors: IntArray
    corrected: npt.NDArray[np.int16]
    verdict: npt.NDArray[np.int8]
    spacecraft_id: IntArray
    virtual_channel: IntArray
    master_count: IntArray
    channel_count: IntArray
    first_header_pointer: IntArray
    clcw: npt.NDArray[np.uint32]

    def __len__(self) -> int:
        return int(self.offset.size)


@dataclass(frozen=True, slots=True, eq=False)
class DownlinkDecode:
    """What came out of a downlink, and what became of every octet of it.

    `buffer` holds the packet octets that `cut` points into. `unknown` counts packets with a right checksum that the
    dictionary does not know or that are not as long as it says. `octets` says where the octets of the input went;
    its values sum to their number. `frames_bad` counts frames that were found but could not be used, truncated ones
    included.
    """

    buffer: OctetArray
    cut: PacketCut
    headers: PrimaryHeaders
    sequence: SequenceReport
    unknown: int
    settings: LinkSettings | None
    frames: FrameTable | None
    spacecraft_id: int | None
    octets: dict[str, int]
    frames_bad: int
    frames_lost: int
    symbols_corrected: int

    @property
    def packets(self) -> int:
        """Packets whose checksum holds, copies included."""
        return int(np.count_nonzero(self.cut.crc_ok))

    @property
    def by_apid(self) -> dict[int, int]:
        """Packets whose checksum holds, by APID."""
        apids, counts = np.unique(self.headers.apid[self.cut.crc_ok], return_counts=True)
        return dict(zip(apids.tolist(), counts.tolist(), strict=True))

    @property
    def gaps(self) -> int:
        """Stretches of missing sequence counts."""
        return self.sequence.gaps

    @property
    def packets_missing(self) -> int:
        """Packets missing by their sequence counts."""
        return self.sequence.missing

    @property
    def duplicates(self) -> int:
        """Packets that came again with the same octets."""
        return self.sequence.duplicates

    @property
    def conflicts(self) -> int:
        """Packets with the sequence count of another but other octets."""
        return self.sequence.conflicts

    @property
    def crc_errors(self) -> int:
        """Packets with a wrong checksum."""
        return self.cut.crc_errors

    @property
    def octets_skipped(self) -> int:
        """Octets that belong to no frame or to no packet."""
        return sum(self.octets[k] for k in ("unsynchronised", "orphaned", "skipped"))

    @property
    def frame_count(self) -> int:
        """CADUs found, good or bad."""
        return 0 if self.frames is None else len(self.frames)

    @property
    def uplink(self) -> tuple[UplinkSeen, ...]:
        """What the frames of the spacecraft tell of its telecommand channels."""
        return () if self.frames is None else uplink_seen(self.frames.clcw)

    @property
    def complete(self) -> bool:
        """Whether nothing is damaged, missing, unknown or left over."""
        return not (
            self.gaps
            or self.conflicts
            or self.crc_errors
            or self.unknown
            or self.octets_skipped
            or self.frames_bad
            or self.frames_lost
        )

    def tables(self, dictionary: Dictionary = DICTIONARY) -> dict[str, Table]:
        """The packets as columns."""
        return dictionary.unpack_many(self.buffer, self.cut)

    def accounting(self) -> dict[str, object]:
        """The figures of `linna tm check`."""
        return {
            "kind": "packets" if self.settings is None else "cadu",
            "packets": self.packets,
            "by_apid": {f"0x{apid:03X}": count for apid, count in self.by_apid.items()},
            "gaps": self.gaps,
            "packets_missing": self.packets_missing,
            "duplicates": self.duplicates,
            "conflicts": self.conflicts,
            "crc_errors": self.crc_errors,
            "unknown": self.unknown,
            "octets_skipped": self.octets_skipped,
            "frames": self.frame_count,
            "frames_bad": self.frames_bad,
            "frames_lost": self.frames_lost,
            "symbols_corrected": self.symbols_corrected,
            "clcw": [asdict(seen) for seen in self.uplink],
            "octets": self.octets,
            "spacecraft_id": self.spacecraft_id,
            "link": None if self.settings is None else _describe(self.settings),
        }


def decode(
    octets: Octets,
    *,
    settings: LinkSettings | None = None,
    spacecraft_id: int | None = None,
    dictionary: Dictionary = DICTIONARY,
) -> DownlinkDecode:
    """Everything that a downlink file holds: a stream of CADUs or of bare packets, told apart by their
    content.

    Parameters
    ----------
    settings
        Of the link; found out by trial when not given.
    spacecraft_id
        Frames of other spacecraft are not used; the commonest id by default.

    Raises
    ------
    LinkFormatError
        Markers stand in the stream, but no setting known here makes frames of what is between them.
    """
    stream = as_octets(octets)
    period = settings.cadu_length if settings else cadu.find_period(stream)
    if not period or (settings is None and not _looks_like_cadus(stream, period)):
        return _bare_packets(stream, dictionary)
    synchronised = cadu.synchronise(stream, period)
    if settings is None:
        settings = _find_settings(stream, synchronised)
    return _frames_to_packets(stream, synchronised, settings, spacecraft_id, dictionary)


def _bare_packets(stream: OctetArray, dictionary: Dictionary) -> DownlinkDecode:
    cut = cut_packets(stream)
    headers = primary_headers(stream, cut)
    octets = _octet_account(stream.size, cut)
    return DownlinkDecode(
        buffer=stream,
        cut=cut,
        headers=headers,
        sequence=_account(stream, cut, headers, dictionary),
        unknown=_unknown(stream, cut, dictionary),
        settings=None,
        frames=None,
        spacecraft_id=None,
        octets=octets,
        frames_bad=0,
        frames_lost=0,
        symbols_corrected=0,
    )


def _frames_to_packets(
    stream: OctetArray,
    sync: cadu.CaduSync,
    settings: LinkSettings,
    spacecraft_id: int | None,
    dictionary: Dictionary,
) -> DownlinkDecode:
    frames, corrected = _read_frames(stream, sync, settings)
    header = frame_headers(frames)
    verdict = np.full(frames.shape[0], FRAME_GOOD, dtype=np.int8)
    verdict[(corrected < 0).any(axis=1)] = FRAME_UNCORRECTABLE
    if settings.checksum:
        usable = np.flatnonzero(verdict == FRAME_GOOD)
        verdict[usable[~frame_checksums_hold(frames[usable])]] = FRAME_BAD_CHECKSUM
    usable = np.flatnonzero((verdict == FRAME_GOOD) & (header.version == 0))
    if spacecraft_id is None and usable.size:
        spacecraft_id = int(np.bincount(header.spacecraft_id[usable]).argmax())
    foreign = (header.version != 0) | (header.spacecraft_id != spacecraft_id)
    verdict[(verdict == FRAME_GOOD) & foreign] = FRAME_FOREIGN
    good = verdict == FRAME_GOOD

    end = settings.frame_length - (CRC_LENGTH if settings.checksum else 0)
    clcw = np.zeros(frames.shape[0], dtype=np.uint32)
    has_clcw = np.flatnonzero(good & header.ocf)
    clcw[has_clcw] = np.ascontiguousarray(frames[has_clcw, end - OCF_LENGTH : end]).view(">u4")[:, 0]

    parts: list[OctetArray] = []
    segments: list[IntArray] = []
    filled, idle_octets, orphaned, frames_lost = 0, 0, 0, 0
    # where the packet zone begins and ends: behind the secondary header, before the operational control field
    zone_start = FRAME_HEADER_LENGTH + np.where(
        header.secondary_header, (frames[:, FRAME_HEADER_LENGTH] & 0x3F).astype(np.int64) + 1, 0
    )
    zone_stop = end - np.where(header.ocf, OCF_LENGTH, 0)
    # all frames of a channel have one layout; should they not, the layouts are kept apart
    layout = np.stack((header.virtual_channel, zone_start, zone_stop), axis=1)
    for channel, start, stop in np.unique(layout[good & (zone_start < zone_stop)], axis=0).tolist():
        mine = np.flatnonzero(good & (layout == (channel, start, stop)).all(axis=1))
        rebuilt = _rebuild(
            frames[mine, start:stop], header.channel_count[mine], header.first_header_pointer[mine]
        )
        parts.append(rebuilt.buffer)
        segments.append(rebuilt.segments + filled)
        filled += rebuilt.buffer.size
        idle_octets += rebuilt.idle_octets
        orphaned += rebuilt.orphaned
        frames_lost += rebuilt.frames_lost
    buffer = np.concatenate(parts) if parts else np.empty(0, dtype=np.uint8)
    ranges = np.concatenate(segments) if segments else np.empty((0, 2), dtype=np.int64)
    cut = cut_packets(buffer, segments=ranges)
    headers = primary_headers(buffer, cut)
    n_good = int(np.count_nonzero(good))
    zone_octets = filled + idle_octets
    octets = _octet_account(int((ranges[:, 1] - ranges[:, 0]).sum()), cut)
    octets["orphaned"] = orphaned
    octets["idle_frames"] = idle_octets
    octets["frame_overhead"] = n_good * settings.cadu_length - zone_octets
    octets["bad_frames"] = (frames.shape[0] - n_good) * settings.cadu_length
    octets["unsynchronised"] = stream.size - frames.shape[0] * settings.cadu_length
    table = FrameTable(
        offset=sync.offsets,
        marker_errors=sync.marker_errors,
        corrected=corrected,
        verdict=verdict,
        spacecraft_id=header.spacecraft_id,
        virtual_channel=header.virtual_channel,
        master_count=header.master_count,
        channel_count=header.channel_count,
        first_header_pointer=header.first_header_pointer,
        clcw=clcw,
    )
    return DownlinkDecode(
        buffer=buffer,
        cut=cut,
        headers=headers,
        sequence=_account(buffer, cut, headers, dictionary),
        unknown=_unknown(buffer, cut, dictionary),
        settings=settings,
        frames=table,
        spacecraft_id=spacecraft_id,
        octets=octets,
        frames_bad=frames.shape[0] - n_good + int(sync.truncated.size),
        frames_lost=frames_lost,
        symbols_corrected=int(corrected[corrected > 0].sum()),
    )


def _read_frames(
    stream: OctetArray, sync: cadu.CaduSync, settings: LinkSettings
) -> tuple[OctetArray, npt.NDArray[np.int16]]:
    """Frames (n, frame_length), de-randomised and repaired, and corrected symbols (n, interleave)."""
    code = settings.code
    n = sync.offsets.size
    frames = np.empty((n, settings.frame_length), dtype=np.uint8)
    corrected = np.zeros((n, code.interleave if code else 1), dtype=np.int16)
    for first in range(0, n, _BATCH):
        part = slice(first, min(first + _BATCH, n))
        blocks = randomise(_blocks(stream, sync.offsets[part], settings.block_length), settings.randomiser)
        if code is None:
            frames[part] = blocks
        else:
            repaired = reed_solomon.decode(blocks, code)
            frames[part], corrected[part] = repaired.frames, repaired.corrected
    return frames, corrected


def _blocks(stream: OctetArray, offsets: IntArray, length: int) -> OctetArray:
    """The `length` octets behind each marker (n, length)."""
    if not offsets.size:
        return np.empty((0, length), dtype=np.uint8)
    windows = np.lib.stride_tricks.sliding_window_view(stream, cadu.ASM_LENGTH + length)
    return np.ascontiguousarray(windows[offsets][:, cadu.ASM_LENGTH :])


_LATE_FRAMES = 64


@dataclass(frozen=True, slots=True, eq=False)
class _Rebuilt:
    buffer: OctetArray
    segments: IntArray
    idle_octets: int
    orphaned: int
    frames_lost: int


def _rebuild(zones: OctetArray, count: IntArray, pointer: IntArray) -> _Rebuilt:
    """The packet octets of one virtual channel and the stretches of them that are unbroken.

    A stretch begins at the first packet that begins in it: octets before belong to a packet whose head was
    lost.
    """
    zone = zones.shape[1]
    step = np.diff(count) % 256
    run = np.concatenate((np.zeros(1, dtype=np.int64), np.cumsum(step != 1)))
    idle = pointer == ONLY_IDLE_DATA
    lost = 0 if (step == 1).all() else _frames_lost(zones, count, idle)
    zones, pointer, run = zones[~idle], pointer[~idle], run[~idle]
    begins = np.flatnonzero(pointer < zone)
    runs, first = np.unique(run[begins], return_index=True)
    starts = begins[first] * zone + pointer[begins[first]]
    stops = np.searchsorted(run, runs, side="right") * zone
    segments = np.stack((starts, stops), axis=1).astype(np.int64)
    used = int((stops - starts).sum())
    buffer = np.ascontiguousarray(zones).reshape(-1)
    return _Rebuilt(
        buffer=buffer,
        segments=segments,
        idle_octets=int(np.count_nonzero(idle)) * zone,
        orphaned=buffer.size - used,
        frames_lost=lost,
    )


def _frames_lost(zones: OctetArray, count: IntArray, idle: npt.NDArray[np.bool_]) -> int:
    """Frames of one virtual channel that are missing by their counts of 8 bits.

    What came before, octet for octet, is sent again and not counted; a count up to `_LATE_FRAMES` behind the one before
    is of a frame that comes late. Losses of whole rounds of the count cannot be seen.
    """
    seen: set[tuple[int, bytes]] = set()
    kept = []
    for k, (number, is_idle) in enumerate(zip(count.tolist(), idle.tolist(), strict=True)):
        if not is_idle:
            key = (number, zones[k].tobytes())
            if key in seen:
                continue
            seen.add(key)
        kept.append(k)
    step = np.diff(count[kept]) % 256
    unwrapped = np.cumsum(np.where(step >= 256 - _LATE_FRAMES, step - 256, step), dtype=np.int64)
    numbers = np.unique(np.concatenate((np.zeros(1, dtype=np.int64), unwrapped)))
    return int(numbers[-1] - numbers[0]) + 1 - numbers.size


def _octet_account(total: int, cut: PacketCut) -> dict[str, int]:
    good = int(cut.lengths[cut.crc_ok].sum())
    bad = int(cut.lengths[~cut.crc_ok].sum())
    return {
        "packets": good,
        "damaged_packets": bad,
        "idle_packets": cut.octets_idle,
        "skipped": total - good - bad - cut.octets_idle,
        "orphaned": 0,
        "idle_frames": 0,
        "frame_overhead": 0,
        "bad_frames": 0,
        "unsynchronised": 0,
    }


def _unknown(buffer: OctetArray, cut: PacketCut, dictionary: Dictionary) -> int:
    return int(np.count_nonzero(cut.crc_ok & (dictionary.identify(buffer, cut) < 0)))


def _account(
    buffer: OctetArray, cut: PacketCut, headers: PrimaryHeaders, dictionary: Dictionary
) -> SequenceReport:
    """Completeness of the packets whose checksum holds; on-board time where they have it, else arrival."""
    good = np.flatnonzero(cut.crc_ok)
    offsets, lengths = cut.offsets[good], cut.lengths[good]
    ticks = np.arange(good.size, dtype=np.int64)
    timed = np.flatnonzero(
        headers.secondary_header[good] & (lengths >= FRAME_HEADER_LENGTH + TM_HEADER_LENGTH)
    )
    timed = timed[buffer[offsets[timed] + 13] == 0x2E]
    value = np.zeros(timed.size, dtype=np.int64)
    for k in range(14, 20):
        value = value << 8 | buffer[offsets[timed] + k]
    ticks[timed] = value
    view = buffer.data

    def same(a: int, b: int) -> bool:
        first = view[offsets[a] : offsets[a] + lengths[a]]
        return bool(first == view[offsets[b] : offsets[b] + lengths[b]])

    return account(
        headers.apid[good],
        headers.sequence_count[good],
        ticks,
        same,
        boot=_boots(buffer, cut, ticks, dictionary),
    )


def _boots(buffer: OctetArray, cut: PacketCut, ticks: IntArray, dictionary: Dictionary) -> IntArray | None:
    """Which boot made each packet, by the boot counts that housekeeping reports; None where it reports one
    at most.

    Boots are taken to begin at their boot event, or else at their first housekeeping packet.
    """
    tables = dictionary.unpack_many(buffer, cut, only=("housekeeping", "event_info"))
    housekeeping = tables.get("housekeeping")
    if housekeeping is None:
        return None
    counts = housekeeping.columns["boot_count"]
    if np.all(counts == counts[0]):
        return None
    boots = np.unique(counts)
    begins = np.array([housekeeping.ticks[counts == boot].min() for boot in boots])
    ends = np.array([housekeeping.ticks[counts == boot].max() for boot in boots])
    if np.any(begins[1:] <= ends[:-1]):
        return None  # the clock did not go on through the boots: time tells nothing about them
    events = tables.get("event_info")
    if events is not None:
        starts = events.ticks[events.columns["event_id"] == 1]
        for k in range(1, boots.size):
            between = starts[(starts > ends[k - 1]) & (starts <= begins[k])]
            if between.size:
                begins[k] = between.min()
    found: IntArray = boots[np.maximum(np.searchsorted(begins, ticks, side="right") - 1, 0)]
    return found


def _looks_like_cadus(stream: OctetArray, period: int) -> bool:
    """Whether markers stand at most of the places where a stream of that period has them."""
    if period < cadu.ASM_LENGTH + FRAME_HEADER_LENGTH + 2:
        return False
    sample = stream[: max(64 * period, 1 << 16)]
    found = cadu.synchronise(sample, period).offsets.size
    return 2 * found * period >= sample.size or found >= 3


def _find_settings(stream: OctetArray, sync: cadu.CaduSync) -> LinkSettings:
    """The settings under which the stream makes sense, among those that the distance of markers allows.

    Codewords, then frame checksums, then headers and packets are asked. The last decide between settings that the code
    cannot tell apart: the legacy sequence is a codeword itself where no virtual fill is used.
    """
    n = sync.offsets.size
    # spread over the stream, so that one bad stretch does not hide the truth
    spread = (
        sync.offsets[np.unique(np.linspace(0, n - 1, min(n, _SAMPLE)).astype(np.int64))]
        if n
        else sync.offsets
    )
    coded, uncoded = _candidates(sync.period - cadu.ASM_LENGTH)
    blocks = _blocks(stream, spread, sync.period - cadu.ASM_LENGTH)
    plain = {name: randomise(blocks, name) for name in _RANDOMISERS}
    finalists = (
        _best([(_clean_share(plain[c.randomiser], c), c) for c in coded])
        or _best([(float(frame_checksums_hold(plain[c.randomiser]).mean()), c) for c in uncoded])
        or [c for c in coded if _can_repair(plain[c.randomiser], c)]
        or [replace(c, checksum=False) for c in uncoded]
    )
    scores = []
    for candidate in finalists:
        settings = candidate
        code = candidate.code
        frames = plain[candidate.randomiser]
        if code is not None:
            decoded = reed_solomon.decode(frames[:8], code)
            frames = decoded.frames[(decoded.corrected >= 0).all(axis=1)]
            if not frame_checksums_hold(frames).sum() > frames.shape[0] / 2:
                settings = replace(candidate, checksum=False)
        # version 0, and behind the counts: no flags set, segment length id 11
        regular = (frames[:, 0] >> 6 == 0) & (frames[:, 4] >> 3 == 0b00011)
        packets = _frames_to_packets(stream, sync.head(64), settings, None, DICTIONARY).packets
        scores.append((packets + float(regular.mean()) if regular.size else packets, settings))
    score, settings = max(scores, key=operator.itemgetter(0))
    if score < 0.5:
        raise LinkFormatError(
            f"downlink: markers stand every {sync.period} octets, but no coding and randomiser known here fits; "
            "expected Reed-Solomon, frame error control, frame headers or packets to make sense, found none of them"
        )
    return settings


def _best(shares: list[tuple[float, LinkSettings]]) -> list[LinkSettings]:
    """Those with at least half of the greatest share; none where all shares are small."""
    greatest = max((share for share, _ in shares), default=0.0)
    return [settings for share, settings in shares if share >= greatest / 2] if greatest > 0.02 else []


def _clean_share(blocks: OctetArray, settings: LinkSettings) -> float:
    assert settings.code is not None
    return float(reed_solomon.clean(blocks, settings.code).mean())


def _can_repair(blocks: OctetArray, settings: LinkSettings) -> bool:
    """Whether the first codeword of some block can be repaired."""
    code = settings.code
    assert code is not None
    _, corrected = reed_solomon.repair(blocks[:8, :: code.interleave], code)
    return bool((corrected >= 0).any())


def _candidates(block_length: int) -> tuple[list[LinkSettings], list[LinkSettings]]:
    coded = []
    for errors in (16, 8):
        for depth in reversed(reed_solomon.INTERLEAVES):
            frame_length = block_length - 2 * errors * depth
            if block_length % depth or block_length // depth > reed_solomon.CODEWORD or frame_length < 16:
                continue
            for dual in (True, False):
                for name in _RANDOMISERS:
                    coded.append(LinkSettings(frame_length, "rs", name, depth, errors, dual))
    uncoded = [LinkSettings(block_length, "none", name) for name in _RANDOMISERS]
    return coded, uncoded


def _describe(settings: LinkSettings) -> dict[str, object]:
    code = settings.code
    return {
        "frame_length": settings.frame_length,
        "cadu_length": settings.cadu_length,
        "coding": settings.coding,
        "interleave": code.interleave if code else None,
        "rs_errors": code.errors if code else None,
        "dual_basis": code.dual_basis if code else None,
        "randomiser": settings.randomiser,
        "checksum": settings.checksum,
    }
