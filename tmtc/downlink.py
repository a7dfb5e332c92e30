"""Packets to CADUs and back, with every octet of the downlink accounted for.

Sending: packets → one unbroken stream of octets per virtual channel → TM transfer frames → Reed-Solomon
codeblocks → randomised → behind markers. Receiving goes the other way, finds out the settings of the link
by trial where they are not given, and never fails on damage: what is lost is counted and located.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from tmtc.arrays import BoolArray, IntArray, OctetArray, Octets, as_octets
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import Dictionary, Table
from tmtc.errors import UnknownCoding, ValueRefused
from tmtc.link import cadu, reed_solomon
from tmtc.link.frame_reading import Frames, proof_of, read_frames
from tmtc.link.frames import (
    FRAME_HEADER_LENGTH,
    IDLE_CHANNEL,
    NO_PACKET_BEGINS,
    OCF_LENGTH,
    ONLY_IDLE_DATA,
    UplinkSeen,
    append_frame_checksums,
    idle_data,
    randomise,
    uplink_seen,
)
from tmtc.link.link_check import CountPackets, LinkProposal, propose_link, survey_markers
from tmtc.link.link_plan import LinkPlan, LinkSection, one_section, plan_link
from tmtc.link.settings import LinkSettings
from tmtc.packets.pus import TM_HEADER_LENGTH
from tmtc.packets.sequence import SequenceReport, account
from tmtc.packets.space_packets import CRC_LENGTH, PACKET_MAX_LENGTH, PRIMARY_HEADER_LENGTH, crc16, idle_packet
from tmtc.packets.stream import (
    CHECKED,
    PacketCut,
    PacketForm,
    PrimaryHeaders,
    cut_packets,
    find_prefix,
    primary_headers,
)

FRAME_GOOD, FRAME_UNCORRECTABLE, FRAME_BAD_CHECKSUM, FRAME_FOREIGN, FRAME_UNCHECKED = 0, 1, 2, 3, 4
_DEFAULT = LinkSettings()


@dataclass(slots=True)
class DownlinkEncoder:
    """The sending end: keeps the frame counts from one call to the next."""

    spacecraft_id: int
    settings: LinkSettings = _DEFAULT
    master_count: int = 0
    channel_counts: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 0 <= self.spacecraft_id < 1 << 10:
            raise ValueRefused("transfer frame", "spacecraft_id", self.spacecraft_id, "0..1023")

    def encode(
        self, packets: Iterable[bytes], virtual_channel: int = 0, clcw: bytes | Sequence[bytes] | None = None
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

    def _cadus(self, data: OctetArray, pointers: IntArray, virtual_channel: int, clcw: OctetArray | None) -> bytes:
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


def encode_cadus(packets: Iterable[bytes], *, spacecraft_id: int, virtual_channel: int = 0, **settings: Any) -> bytes:
    """A whole downlink: CADUs that carry `packets`, frame counts from zero; `settings` are those of `LinkSettings`."""
    return DownlinkEncoder(spacecraft_id, LinkSettings(**settings)).encode(packets, virtual_channel)


@dataclass(frozen=True, slots=True, eq=False)
class FrameTable:
    """Table with one row for every CADU found, including discarded ones.

    `offset` of the marker in the stream, `octets` of the CADU, `marker_errors` wrong bits of the marker, `corrected`
    symbols repaired ((n, interleave), -1 where a codeword is lost, 0 beyond the depth of the frame's code), `verdict`
    an index of `FRAME_VERDICTS`; the header fields of lost frames are not reliable. `buffer_offset` and
    `buffer_octets` locate the packet zone of the frame in the buffer of packet octets; they are -1 and 0 for frames
    without packet octets. Packets that were reassembled from parts follow the packet zones in the buffer.
    """

    offset: IntArray
    octets: IntArray
    marker_errors: IntArray
    corrected: npt.NDArray[np.int16]
    verdict: npt.NDArray[np.int8]
    spacecraft_id: IntArray
    virtual_channel: IntArray
    master_count: IntArray
    channel_count: IntArray
    first_header_pointer: IntArray
    clcw: npt.NDArray[np.uint32]
    buffer_offset: IntArray
    buffer_octets: IntArray

    def __len__(self) -> int:
        return int(self.offset.size)


@dataclass(frozen=True, slots=True, eq=False)
class DownlinkDecode:
    """Decoded downlink with the accounting of every octet.

    `buffer` holds the packet octets that `cut` points into. `unknown` counts packets with a right checksum that the
    dictionary does not know or that are not as long as it says. `octets` says where the octets of the input went;
    its values sum to their number. `frames_bad` counts frames that were found but could not be used, truncated ones
    included. `plan` holds the sections of a stream of frames; `settings` are those of the first section. Each packet of
    a stream without frames follows `prefix_octets`.
    """

    buffer: OctetArray
    cut: PacketCut
    headers: PrimaryHeaders
    sequence: SequenceReport
    unknown: int
    plan: LinkPlan
    frames: FrameTable | None
    spacecraft_id: int | None
    octets: dict[str, int]
    frames_bad: int
    frames_lost: int
    symbols_corrected: int
    prefix_octets: int = 0

    @property
    def settings(self) -> LinkSettings | None:
        """Link settings of the first section; None for bare packets."""
        return self.plan.sections[0].settings if self.plan.sections else None

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
    def frames_unchecked(self) -> int:
        """Number of frames without code and checksum, whose validity is unknown."""
        return 0 if self.frames is None else int(np.count_nonzero(self.frames.verdict == FRAME_UNCHECKED))

    @property
    def uplink(self) -> tuple[UplinkSeen, ...]:
        """Return the telecommand channels as the frames of the spacecraft report them."""
        return () if self.frames is None else uplink_seen(self.frames.clcw)

    @property
    def complete(self) -> bool:
        """Return whether nothing is damaged, missing, unknown or left over."""
        return not (
            self.sequence.gaps
            or self.sequence.conflicts
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
            "gaps": self.sequence.gaps,
            "packets_missing": self.sequence.missing,
            "duplicates": self.sequence.duplicates,
            "conflicts": self.sequence.conflicts,
            "count_restarts": self.sequence.restarts,
            "crc_errors": self.crc_errors,
            "unknown": self.unknown,
            "octets_skipped": self.octets_skipped,
            "prefix_octets": self.prefix_octets,
            "frames": self.frame_count,
            "frames_bad": self.frames_bad,
            "frames_unchecked": self.frames_unchecked,
            "frames_lost": self.frames_lost,
            "symbols_corrected": self.symbols_corrected,
            "clcw": [asdict(seen) for seen in self.uplink],
            "octets": self.octets,
            "spacecraft_id": self.spacecraft_id,
            "link": None if self.settings is None else self.settings.describe(),
            "link_sections": [
                {"start": one.start, "stop": one.stop, **one.settings.describe()} for one in self.plan.sections
            ],
            "link_ambiguous": self.plan.ambiguous,
        }


def decode(
    octets: Octets,
    *,
    settings: LinkSettings | None = None,
    spacecraft_id: int | None = None,
    dictionary: Dictionary = DICTIONARY,
    form: PacketForm = CHECKED,
    plan: LinkPlan | None = None,
) -> DownlinkDecode:
    """Everything that a downlink file holds: a stream of CADUs or of bare packets, distinguished by their
    content.

    Parameters
    ----------
    settings
        Of the link; found out by trial when not given.
    spacecraft_id
        Frames of other spacecraft are not used; the commonest id by default.
    form
        Of the packets: whether they end with a checksum, and octets before each packet of a stream without frames.
    plan
        Sections of the stream, if they are already known.

    Raises
    ------
    UnknownCoding
        The stream contains markers, but no frame is valid under any known link setting.
    """
    stream = as_octets(octets)
    if plan is None and settings is not None:
        plan = one_section(stream, settings)
    if plan is None:
        plan = plan_of(stream, dictionary=dictionary, form=form)
    if not plan.sections:
        return _bare_packets(stream, dictionary, form)
    sections = []
    for section in plan.sections:
        part = stream[section.start : section.stop]
        verify = proof_of(part, section.settings)
        sync = cadu.synchronise(part, section.settings.cadu_length, verify=verify)
        sections.append(_read_section(part, sync, section))
    return _frames_to_packets(stream, sections, plan, spacecraft_id, dictionary, form.in_frames)


def propose_settings(octets: Octets) -> LinkProposal:
    """Return the link settings that the whole stream supports, with the evidence."""
    stream = as_octets(octets)
    counter = _packet_counter(stream, DICTIONARY, CHECKED)
    return propose_link(stream, counter, survey_markers(stream))


def propose_packets(octets: Octets) -> tuple[int, PacketForm | None]:
    """Return the number of packets of a stream without frames, and the form that fits most of it; 0 and None if none.

    Packets that have a checksum need not fill the stream.
    """
    stream = as_octets(octets)
    for tried in (CHECKED, replace(CHECKED, error_control=False)):
        fits = [_packets_of_form(stream, replace(tried, prefix_octets=n)) for n in (0, find_prefix(stream, tried))]
        octets_used, packets, form = max(fits, key=lambda one: one[0])
        if 2 * octets_used >= stream.size > 0:
            return packets, form
    packets = int(np.count_nonzero(cut_packets(stream, form=CHECKED).crc_ok))
    return packets, CHECKED if packets else None


def _packets_of_form(stream: OctetArray, form: PacketForm) -> tuple[int, int, PacketForm]:
    """Return the octets of the packets of a form and their prefixes, the number of packets, and the form."""
    cut = cut_packets(stream, form=form)
    good = cut.lengths[cut.crc_ok]
    return int(good.sum()) + good.size * form.prefix_octets, good.size, form


def plan_of(octets: Octets, *, dictionary: Dictionary = DICTIONARY, form: PacketForm = CHECKED) -> LinkPlan:
    """Return the sections of a stream of CADUs and their link settings; no sections for bare packets.

    Raises
    ------
    UnknownCoding
        The stream contains markers, but no frame is valid under any known link setting.
    """
    stream = as_octets(octets)
    plan = plan_link(stream, _packet_counter(stream, dictionary, form.in_frames))
    if plan.sections or not plan.has_regular_markers:
        return plan
    cut = cut_packets(stream, form=form)
    if 2 * int(cut.lengths[cut.crc_ok].sum()) <= stream.size:  # bare packets do not fill most of the stream
        proposal = plan.proposal
        distance = next(iter(proposal.distances), 0) if proposal else 0
        raise UnknownCoding(proposal.markers if proposal else 0, distance)
    return plan


def _packet_counter(stream: OctetArray, dictionary: Dictionary, form: PacketForm) -> CountPackets:
    def count_packets(sync: cadu.CaduSync, settings: LinkSettings) -> tuple[int, float]:
        section = _read_section(stream, sync, LinkSection(0, stream.size, settings))
        plan = one_section(stream, settings)
        found = _frames_to_packets(stream, [section], plan, None, dictionary, form)
        filled = found.octets["packets"] + found.octets["idle_packets"] + found.octets["idle_frames"]
        return found.packets, filled / max(len(sync.start_bits) * settings.frame_length, 1)

    return count_packets


def _bare_packets(stream: OctetArray, dictionary: Dictionary, form: PacketForm) -> DownlinkDecode:
    cut = cut_packets(stream, form=form)
    headers = primary_headers(stream, cut)
    octets = _octet_account(stream.size, cut)
    if form.prefix_octets:
        octets["prefixes"] = octets["skipped"] - cut.octets_skipped
        octets["skipped"] = cut.octets_skipped
    return DownlinkDecode(
        buffer=stream,
        cut=cut,
        headers=headers,
        sequence=_account(stream, cut, headers, dictionary),
        unknown=_unknown(stream, cut, dictionary),
        plan=LinkPlan((), None, has_regular_markers=False),
        frames=None,
        spacecraft_id=None,
        octets=octets,
        frames_bad=0,
        frames_lost=0,
        symbols_corrected=0,
        prefix_octets=form.prefix_octets,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Section:
    """Frames (n,) of one section; `offset` (n,) in the whole stream."""

    settings: LinkSettings
    offset: IntArray
    marker_errors: IntArray
    truncated: int
    found: Frames

    @property
    def verdict(self) -> npt.NDArray[np.int8]:
        """Index of `FRAME_VERDICTS` (n,), by code and checksum."""
        verdict = np.full(len(self.offset), FRAME_GOOD, dtype=np.int8)
        verdict[~self.found.valid] = FRAME_BAD_CHECKSUM
        verdict[(self.found.corrected < 0).any(axis=1)] = FRAME_UNCORRECTABLE
        return verdict


def _read_section(part: OctetArray, sync: cadu.CaduSync, section: LinkSection) -> _Section:
    """Return the frames of a section from its octets and their synchronisation."""
    return _Section(
        section.settings,
        sync.offsets + section.start,
        sync.marker_errors,
        int(sync.truncated.size),
        read_frames(part, sync, section.settings),
    )


def _commonest_spacecraft(sections: Sequence[_Section]) -> int | None:
    ids = np.concatenate(
        [one.found.header.spacecraft_id[one.found.valid & (one.found.header.version == 0)] for one in sections]
    )
    return int(np.bincount(ids).argmax()) if ids.size else None


@dataclass(slots=True)
class _Filling:
    """Buffer of packet octets while it is filled, and its accounting."""

    parts: list[OctetArray] = field(default_factory=list)
    segments: list[IntArray] = field(default_factory=list)
    tables: list[FrameTable] = field(default_factory=list)
    filled: int = 0
    orphaned: int = 0
    idle: int = 0
    overhead: int = 0
    bad: int = 0
    lost: int = 0

    def add(self, section: _Section, spacecraft_id: int | None, depth: int, error_control: bool) -> None:
        """Add the packet octets of a section; `depth` is the largest interleaving depth of all sections."""
        settings, frames, header = section.settings, section.found.octets, section.found.header
        verdict = section.verdict
        foreign = (header.version != 0) | (header.spacecraft_id != spacecraft_id)
        verdict[(verdict == FRAME_GOOD) & foreign] = FRAME_FOREIGN
        good = verdict == FRAME_GOOD
        if not settings.proves_frames:
            verdict[good] = FRAME_UNCHECKED
        end = settings.frame_length - (CRC_LENGTH if settings.checksum else 0)
        clcw = np.zeros(frames.shape[0], dtype=np.uint32)
        has_clcw = np.flatnonzero(good & header.ocf)
        clcw[has_clcw] = np.ascontiguousarray(frames[has_clcw, end - OCF_LENGTH : end]).view(">u4")[:, 0]
        buffer_offset = np.full(frames.shape[0], -1, dtype=np.int64)
        buffer_octets = np.zeros(frames.shape[0], dtype=np.int64)
        # where the packet zone begins and ends: behind the secondary header, before the operational control field
        zone_start = FRAME_HEADER_LENGTH + np.where(
            header.secondary_header, (frames[:, FRAME_HEADER_LENGTH] & 0x3F).astype(np.int64) + 1, 0
        )
        zone_stop = end - np.where(header.ocf, OCF_LENGTH, 0)
        zone_octets = 0
        # all frames of a channel have one layout; should they not, the layouts are kept apart
        layout = np.stack((header.virtual_channel, zone_start, zone_stop), axis=1)
        for channel, start, stop in np.unique(layout[good & (zone_start < zone_stop)], axis=0).tolist():
            mine = np.flatnonzero(good & (layout == (channel, start, stop)).all(axis=1))
            rebuilt = _rebuild(
                frames[mine, start:stop], header.channel_count[mine], header.first_header_pointer[mine], error_control
            )
            used = mine[header.first_header_pointer[mine] != ONLY_IDLE_DATA]
            buffer_offset[used] = self.filled + (stop - start) * np.arange(used.size)
            buffer_octets[used] = stop - start
            self.parts.append(rebuilt.buffer)
            self.segments.append(rebuilt.segments + self.filled)
            self.filled += rebuilt.buffer.size
            zone_octets += rebuilt.octets + rebuilt.idle_octets
            self.idle += rebuilt.idle_octets
            self.orphaned += rebuilt.orphaned
            self.lost += rebuilt.frames_lost
        n_good = int(np.count_nonzero(good))
        self.overhead += n_good * settings.cadu_length - zone_octets
        self.bad += (frames.shape[0] - n_good) * settings.cadu_length
        corrected = np.zeros((frames.shape[0], depth), dtype=np.int16)
        corrected[:, : section.found.corrected.shape[1]] = section.found.corrected
        self.tables.append(
            FrameTable(
                offset=section.offset,
                octets=np.full(frames.shape[0], settings.cadu_length, dtype=np.int64),
                marker_errors=section.marker_errors,
                corrected=corrected,
                verdict=verdict,
                spacecraft_id=header.spacecraft_id,
                virtual_channel=header.virtual_channel,
                master_count=header.master_count,
                channel_count=header.channel_count,
                first_header_pointer=header.first_header_pointer,
                clcw=clcw,
                buffer_offset=buffer_offset,
                buffer_octets=buffer_octets,
            )
        )

    def table(self) -> FrameTable:
        """Return the frames of all sections."""
        if len(self.tables) == 1:
            return self.tables[0]
        return FrameTable(*(np.concatenate([getattr(one, f.name) for one in self.tables]) for f in fields(FrameTable)))


def _frames_to_packets(
    stream: OctetArray,
    sections: Sequence[_Section],
    plan: LinkPlan,
    spacecraft_id: int | None,
    dictionary: Dictionary,
    form: PacketForm,
) -> DownlinkDecode:
    if spacecraft_id is None:
        spacecraft_id = _commonest_spacecraft(sections)
    filling = _Filling()
    depth = max(one.found.corrected.shape[1] for one in sections)
    for section in sections:
        filling.add(section, spacecraft_id, depth, form.error_control)
    parts, segments = filling.parts, filling.segments
    buffer = np.concatenate(parts) if parts else np.empty(0, dtype=np.uint8)
    ranges = np.concatenate(segments) if segments else np.empty((0, 2), dtype=np.int64)
    cut = cut_packets(buffer, segments=ranges, form=form)
    headers = primary_headers(buffer, cut)
    table = filling.table()
    octets = _octet_account(int((ranges[:, 1] - ranges[:, 0]).sum()), cut)
    octets["orphaned"] = filling.orphaned
    octets["idle_frames"] = filling.idle
    octets["frame_overhead"] = filling.overhead
    octets["bad_frames"] = filling.bad
    octets["unsynchronised"] = stream.size - int(table.octets.sum())
    used = np.isin(table.verdict, (FRAME_GOOD, FRAME_UNCHECKED))
    return DownlinkDecode(
        buffer=buffer,
        cut=cut,
        headers=headers,
        sequence=_account(buffer, cut, headers, dictionary),
        unknown=_unknown(buffer, cut, dictionary),
        plan=plan,
        frames=table,
        spacecraft_id=spacecraft_id,
        octets=octets,
        frames_bad=int(np.count_nonzero(~used)) + sum(one.truncated for one in sections),
        frames_lost=filling.lost,
        symbols_corrected=int(table.corrected[table.corrected > 0].sum()),
    )


_LATE_FRAMES = 64
COUNT_MODULUS = 256
_MOST_TRIED = 4096
"""Largest number of frames tried to complete a packet: the longest packet fills 310 of the shortest frames."""


@dataclass(frozen=True, slots=True, eq=False)
class _Rebuilt:
    buffer: OctetArray
    segments: IntArray
    octets: int
    idle_octets: int
    orphaned: int
    frames_lost: int


def _rebuild(zones: OctetArray, count: IntArray, pointer: IntArray, error_control: bool) -> _Rebuilt:
    """Return the packet octets of one virtual channel and their contiguous segments.

    A segment starts with the first packet that begins in it; earlier octets belong to a packet whose start was lost. A
    packet whose end does not follow its start is completed from frames elsewhere in the stream: frames that were
    sent again, received by another station, or recorded out of order.
    """
    zone = zones.shape[1]
    step = np.diff(count) % COUNT_MODULUS
    run = np.concatenate((np.zeros(1, dtype=np.int64), np.cumsum(step != 1)))
    idle = pointer == ONLY_IDLE_DATA
    in_order = bool((step == 1).all())
    lost = 0 if in_order else _frames_lost(zones, count, idle)
    zones, pointer, run, count = zones[~idle], pointer[~idle], run[~idle], count[~idle]
    buffer = np.ascontiguousarray(zones).reshape(-1)
    segments = _segments(pointer, run, zone)
    octets = buffer.size
    if not in_order and segments.size and error_control:  # else nothing proves that parts belong together
        run = _split_where_damaged(buffer, segments, run, zone)
        segments = _segments(pointer, run, zone)
        completed, joined = _complete(zones, count, pointer, run, buffer, segments)
        if len(joined) > len(segments):
            # consecutive counts are not adjacent in the file: the order of the frames says nothing about losses
            lost = min(lost, _least_frames_lost(zones, count))
        buffer, segments = completed, joined
    return _Rebuilt(
        buffer=buffer,
        segments=segments,
        octets=octets,
        idle_octets=int(np.count_nonzero(idle)) * zone,
        orphaned=octets - int((segments[:, 1] - segments[:, 0]).sum()),
        frames_lost=lost,
    )


def _segments(pointer: IntArray, run: IntArray, zone: int) -> IntArray:
    """Return the octets [start, stop) (s, 2) of each run from the first packet that begins in it."""
    begins = np.flatnonzero(pointer < zone)
    runs, first = np.unique(run[begins], return_index=True)
    starts = begins[first] * zone + pointer[begins[first]]
    stops = np.searchsorted(run, runs, side="right") * zone
    return np.stack((starts, stops), axis=1).astype(np.int64)


def _split_where_damaged(buffer: OctetArray, segments: IntArray, run: IntArray, zone: int) -> IntArray:
    """Return the runs (n,) split where a packet that spans two frames has a wrong checksum.

    Of frames in any order one in 256 follows another by chance.
    """
    cut = cut_packets(buffer, segments=segments)
    bad = ~cut.crc_ok
    ranges = np.concatenate([cut.skipped, np.stack((cut.offsets[bad], cut.offsets[bad] + cut.lengths[bad]), axis=1)])
    border = -(-(ranges[:, 0] + 1) // zone)
    # not at the end of the run, where there is nothing to split
    parted = border[(border * zone < ranges[:, 1]) & (border < run.size)]
    begins = np.zeros(run.size, dtype=np.int64)
    begins[parted] = 1
    begins[1:] |= np.diff(run) != 0
    return np.cumsum(begins)


def _complete(
    zones: OctetArray, count: IntArray, pointer: IntArray, run: IntArray, buffer: OctetArray, segments: IntArray
) -> tuple[OctetArray, IntArray]:
    """Return buffer and segments with the packets reassembled from the end of one run and the start of another.

    A packet that is incomplete at the end of a run is continued by frames with the subsequent counts. The length in the
    packet header and the checksum decide whether they belong together. Each octet is used once.
    """
    zone = zones.shape[1]
    orphans: dict[int, list[int]] = {}
    for begin in np.flatnonzero(np.concatenate((np.ones(1, dtype=np.bool_), np.diff(run) != 0))).tolist():
        for k in range(begin, run.size):
            if run[k] != run[begin]:
                break
            if pointer[k] > 0:
                orphans.setdefault(int(count[k]), []).append(k)
            if pointer[k] < zone:
                break
    tails = cut_packets(buffer, segments=segments).skipped
    ends = dict(zip(segments[:, 1].tolist(), range(len(segments)), strict=True))
    segments, extra = segments.copy(), []
    used: set[int] = set()
    for start, stop in tails.tolist():
        row = ends.get(stop)
        if row is None:
            continue
        path = _continuation(buffer[start:stop].tobytes(), int(count[stop // zone - 1]), zones, pointer, orphans, used)
        if path:
            used.update(path)
            segments[row, 1] = start
            extra.append(np.concatenate([buffer[start:stop], *(zones[k, : min(pointer[k], zone)] for k in path)]))
    lengths = np.array([part.size for part in extra], dtype=np.int64)
    stops = buffer.size + np.cumsum(lengths)
    added = np.stack((stops - lengths, stops), axis=1)
    return np.concatenate([buffer, *extra]), np.concatenate([segments, added])


def _continuation(
    begun: bytes, count: int, zones: OctetArray, pointer: IntArray, orphans: dict[int, list[int]], used: set[int]
) -> list[int]:
    """Return the frames whose first octets complete a packet that began in a frame with that count; empty if none do.

    Copies of one frame are tried once, and at most `_MOST_TRIED` frames are tried.
    """
    zone = zones.shape[1]
    open_paths: list[tuple[bytes, int, list[int]]] = [(begun, count, [])]
    known: set[tuple[int, bytes]] = set()
    tried = 0
    while open_paths and tried < _MOST_TRIED:
        octets_before, count, path = open_paths.pop()
        count = (count + 1) % COUNT_MODULUS
        for k in orphans.get(count, ()):
            if k in used or k in path:
                continue
            tried += 1
            octets = octets_before + zones[k, : min(pointer[k], zone)].tobytes()
            if (len(path), octets) in known:
                continue
            known.add((len(path), octets))
            long_enough = len(octets) >= PRIMARY_HEADER_LENGTH
            wanted = int.from_bytes(octets[4:6], "big") + 7 if long_enough else PACKET_MAX_LENGTH
            if len(octets) == wanted and crc16(octets) == 0:
                return [*path, k]
            if pointer[k] >= zone and len(octets) < wanted:
                open_paths.append((octets, count, [*path, k]))
    return []


def _frames_lost(zones: OctetArray, count: IntArray, idle: BoolArray) -> int:
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


def _least_frames_lost(zones: OctetArray, count: IntArray) -> int:
    """Return the least number of frames that must be missing between frames (n, zone) in an unknown order.

    A sequence of T frames with counts from s on holds the count c at most (T - (c - s) mod 256 + 255) div 256 times.
    """
    different = {(number, zones[k].tobytes()) for k, number in enumerate(count.tolist())}
    times = np.bincount([number for number, _ in different], minlength=COUNT_MODULUS)
    seen = np.flatnonzero(times)
    behind = (seen[None, :] - np.arange(COUNT_MODULUS)[:, None]) % COUNT_MODULUS
    needed = (COUNT_MODULUS * (times[seen] - 1) + behind + 1).max(axis=1)
    return int(needed.min()) - len(different)


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


def _account(buffer: OctetArray, cut: PacketCut, headers: PrimaryHeaders, dictionary: Dictionary) -> SequenceReport:
    """Completeness of the packets whose checksum holds; on-board time where they have it, else arrival."""
    good = np.flatnonzero(cut.crc_ok)
    offsets, lengths = cut.offsets[good], cut.lengths[good]
    ticks = np.arange(good.size, dtype=np.int64)
    apid = headers.apid[good]
    # only packets of the dictionary are known to carry a time at this place; either all packets of an APID are
    # ordered by time or none
    has_time = (dictionary.identify(buffer, cut)[good] >= 0) & headers.secondary_header[good]
    has_time &= lengths >= FRAME_HEADER_LENGTH + TM_HEADER_LENGTH
    timed = np.flatnonzero(has_time & ~np.isin(apid, apid[~has_time]))
    value = np.zeros(timed.size, dtype=np.int64)
    for k in range(14, 20):
        value = value << 8 | buffer[offsets[timed] + k]
    ticks[timed] = value
    view = buffer.data

    def same(a: int, b: int) -> bool:
        first = view[offsets[a] : offsets[a] + lengths[a]]
        return bool(first == view[offsets[b] : offsets[b] + lengths[b]])

    return account(apid, headers.sequence_count[good], ticks, same, boot=_boots(buffer, cut, ticks, dictionary))


def _boots(buffer: OctetArray, cut: PacketCut, ticks: IntArray, dictionary: Dictionary) -> IntArray | None:
    """Return the boot of each packet by the boot counts in housekeeping; None where it reports one
    at most.

    Boots are taken to begin at their boot event, or else at their first housekeeping packet.
    """
    tables = dictionary.unpack_many(buffer, cut)
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
