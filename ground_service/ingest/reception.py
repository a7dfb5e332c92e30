"""Reading of one piece of a recording: the contiguous octets around it, their frames and packets, and their storage.

The piece is entered before it is read, and pieces of a recording are entered one after another. Each piece is read with
the octets that earlier pieces have before and behind it, so that every frame is completed by exactly one of them,
whatever the order and whatever process reads. Packets are stored once, by content.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from typing import NoReturn

import numpy as np
from sqlalchemy import Connection

from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput
from ground_service.ground import Ground
from ground_service.ingest import frames, store
from ground_service.ingest import recording_store as recordings
from ground_service.ingest.core import Fragment, LinkContent, complete, join
from ground_service.ingest.doubt_store import count_implausible, plausible_part, withdraw_doubted
from ground_service.ingest.frames import CADU_MAX_OCTETS, FrameReader, PacketReader, Section
from ground_service.ingest.link_settings import known_before, packet_form
from ground_service.ingest.model import IngestResult, ReceivedControlWords, ReceivedLink, ReceivedSection
from ground_service.ingest.recording_store import Part, Piece
from ground_service.ingest.store import Stored
from ground_service.missions.definitions import PacketDefinitions
from ground_service.store.files import FileArchive, mapped_octets, read_blocks, recorded_name
from ground_service.store.vehicles import vehicle_id
from ground_service.telemetry.decoding import catch_up, decode_declared, definitions_of_spacecraft, note_dictionary
from ground_service.telemetry.packets import PacketBatch, batch_of_cut, time_receptions
from lunar.arrays import OctetArray
from tmtc.arrays import as_octets
from tmtc.dictionary.payload import DICTIONARY
from tmtc.link.link_check import survey_markers
from tmtc.link.link_plan import declared_sections
from tmtc.link.settings import LinkSettings
from tmtc.packets.pus import NO_TICKS
from tmtc.packets.space_packets import PACKET_MAX_LENGTH
from tmtc.packets.stream import PacketForm, cut_packets, whole_packets

Progress = Callable[[float], None]

WINDOW_OCTETS = 2 << 20
"""Octets decoded and stored at a time: large enough to spread the cost of a transaction, small against memory:
decoding and storing take about ten times as much."""

FRAGMENTS_LIMIT = 1_000
"""Number of fragments of packets from which they are stored before the end of a piece."""

CERTAIN_OCTETS = 4 * CADU_MAX_OCTETS
"""Length of a piece from which no valid frame is a contradiction of the declaration, and not a lack of evidence."""

CHECK = "`linna link check FILE` shows the settings of its frames or packets, to be stated in the mission description"
HINT = "pieces of one recording are ingested with its name and their offsets (--recording NAME FILE...)"


@dataclass(frozen=True, slots=True)
class Run:
    """Contiguous octets of a recording: a piece, and what earlier pieces have before and behind it.

    `new`: ranges [start, stop) of the run that are read now. `begins`, `ends`: no earlier piece has the octets before
    or behind the run.
    """

    files: FileArchive
    piece: Piece
    before: tuple[Part, ...]
    behind: tuple[Part, ...]
    new: tuple[tuple[int, int], ...]
    begins: bool = True
    ends: bool = True

    @property
    def first(self) -> int:
        """Octets before the piece."""
        return sum(one.stop - one.start for one in self.before)

    @property
    def octets(self) -> int:
        """Octets of the run."""
        return sum(one.stop - one.start for one in self.parts)

    @property
    def parts(self) -> tuple[Part, ...]:
        """All octets of the run, as parts of files."""
        return *self.before, Part(self.piece.file_sha256, 0, self.piece.octets), *self.behind

    def whole(self) -> OctetArray:
        """Return all octets; a memory map for a piece without others."""
        if not self.before and not self.behind:
            return mapped_octets(self.files.path(self.piece.file_sha256))
        return self.read(0, self.octets)

    def read(self, start: int, stop: int) -> OctetArray:
        return as_octets(b"".join(self._blocks(start, stop)))

    def windows(self, start: int, stop: int) -> Iterator[tuple[OctetArray, bool]]:
        """Yield the octets [start, stop) in windows, and whether each is the last one."""
        held: list[bytes] = []
        size = reached = 0
        for block in self._blocks(start, stop):
            held.append(block)
            size, reached = size + len(block), reached + len(block)
            if size >= WINDOW_OCTETS or reached == stop - start:
                yield as_octets(b"".join(held)), reached == stop - start
                held, size = [], 0

    def _blocks(self, start: int, stop: int) -> Iterator[bytes]:
        at = 0
        for part in self.parts:
            low, high = max(start - at, 0), min(stop - at, part.stop - part.start)
            at += part.stop - part.start
            if low < high:
                path = self.files.path(part.file_sha256)
                yield from read_blocks(path, start=part.start + low, stop=part.start + high)


def run_around(connection: Connection, files: FileArchive, piece: Piece, reach: int) -> Run:
    """Return the octets of a recording around a piece, at most `reach` octets on each side."""
    if not piece.stream:
        return Run(files, piece, (), (), ((0, piece.octets),))
    found = recordings.neighbours(connection, piece, reach)
    run = Run(files, piece, found.before, found.behind, ())
    shift = piece.position - run.first
    return replace(
        run,
        new=tuple((start - shift, stop - shift) for start, stop in found.new),
        begins=run.first < reach,
        ends=run.octets - run.first - piece.octets < reach,
    )


def _sections(run: Run, links: Sequence[tuple[int, int, LinkSettings | None]], reach: int) -> Iterator[Section]:
    """Yield the sections of a run that are read now, with the octets around them."""
    position, stream = run.piece.position - run.first, run.piece.stream
    for start, stop, settings in links:
        for new in run.new:
            first, last = max(new[0], start), min(new[1], stop)
            if first < last:
                low, high = max(start, first - reach), min(stop, last + reach)
                begins, ends = run.begins and low == 0, run.ends and high == run.octets
                yield Section(settings, low, high, first, last, begins, ends, position, stream)


class Reading:
    """Reading of one piece whose ingest is entered; `progress` is called with the share that is stored.

    `judged`: which packets have an implausible time is known already.
    """

    def __init__(self, ground: Ground, piece: Piece, progress: Progress | None = None, *, judged: bool = False) -> None:
        self.ground, self.piece, self.progress, self.judged = ground, piece, progress, judged
        with ground.database.reading() as connection:
            self.known = known_before(connection, piece)
        self.expected = self.known.expected
        self.vehicles: dict[int, int] = {}
        if piece.spacecraft_id is not None and self.known.around.vehicle_id is not None:
            self.vehicles[piece.spacecraft_id] = self.known.around.vehicle_id
        self.definitions: dict[int, PacketDefinitions] = {}
        if piece.spacecraft_id is not None and self.known.definitions is not None:
            self.definitions[piece.spacecraft_id] = self.known.definitions
        self.forms: dict[int, PacketForm] = {}
        if piece.spacecraft_id is not None:
            self.forms[piece.spacecraft_id] = self.expected.form
        self.found = LinkContent()
        self.unknown = 0
        self.ticks: list[int] = []
        self.sections: list[Section] = []
        self.has_link = False
        self.octets_new = piece.octets
        self.is_framed = False
        self.is_started = self.is_doubted = False
        self.implausible = 0
        self.result: IngestResult

    def read(self) -> None:
        """Read the piece and store what it has completed."""
        run = self._run()
        readers = [self._reader(run, section) for section in self.sections]
        fragments: list[Fragment] = []
        held: PacketBatch | None = None
        end = 0
        for reader in readers:
            reader.begin_at(end)
            for batch in reader.batches(run.windows(reader.section.start, reader.section.stop)):
                self.ground.check_stopping()
                fragments += reader.take_fragments()
                if held is not None and len(held):
                    self._store_early(held, fragments)
                held = batch
            fragments += reader.take_fragments()
            end = max(end, reader.end)
        found = self.found
        if not (self.piece.stream or found.frames or found.packets or self.is_framed):
            self._refuse()
        self._settle(held, fragments, is_last=True)

    # The run and its sections

    def _run(self) -> Run:
        """Return the run around the piece, and set the sections of it that are read."""
        for reach in (frames.REACH_OCTETS, frames.FRAME_REACH_OCTETS):
            with self.ground.database.reading() as connection:
                run = run_around(connection, self.ground.files, self.piece, reach)
            self.octets_new = sum(stop - start for start, stop in run.new)
            links = self._links(run) if run.new else []
            self.has_link = bool(links) or not run.new
            if any(one is not None for _, _, one in links) or not self.piece.stream or not run.new:
                break
        if not self.has_link:
            links = self._links_of_recording(run)
            self.has_link = bool(links)
        self.sections = list(_sections(run, links, reach))
        return run

    def _links(self, run: Run) -> list[tuple[int, int, LinkSettings | None]]:
        """Return the parts [start, stop) of a run with their declared link settings; none without frames and packets.

        Frames that do not fit any declared settings have the first ones: their octets are kept and accounted for.
        """
        expected, piece = self.expected, self.piece
        if expected.stated is not None:
            return [(0, run.octets, expected.stated)]
        around = piece.octets <= WINDOW_OCTETS
        octets = run.whole() if around else mapped_octets(run.files.path(piece.file_sha256))
        survey = survey_markers(octets)
        if sections := declared_sections(octets, survey, expected.settings):
            shift = 0 if around else run.first
            starts = [0, *(one.start + shift for one in sections[1:])]
            ends = [*starts[1:], run.octets]
            return list(zip(starts, ends, (one.settings for one in sections), strict=True))
        if survey.markers and piece.stream and octets.size < CERTAIN_OCTETS:
            return []  # few frames without proof look like packets
        if self._has_packets(octets):
            return [(0, run.octets, None)]
        self.is_framed = survey.is_regular
        return [(0, run.octets, expected.settings[0])] if survey.is_regular else []

    def _links_of_recording(self, run: Run) -> list[tuple[int, int, LinkSettings | None]]:
        """Return the link settings of other pieces of the recording, for one without evidence; none if not known."""
        with self.ground.database.reading() as connection:
            known = recordings.accounting_of_recording(connection, self.piece)
        if known is None:
            return []
        names = {one.name for one in fields(LinkSettings)}
        reception = IngestResult.model_validate({**known, "ingest_id": 0}).reception
        if reception is None:
            return [(0, run.octets, None)]
        last = reception.sections[-1].model_dump(include=names, exclude_none=True)
        return [(0, run.octets, LinkSettings(**last))]

    def _has_packets(self, octets: OctetArray) -> bool:
        """Return whether octets are packets without frames."""
        form = self.expected.form
        for start in range(0, octets.size, WINDOW_OCTETS):
            window = octets[start : start + WINDOW_OCTETS + PACKET_MAX_LENGTH]
            cut = cut_packets(window, form=form)
            packets = int(np.count_nonzero(cut.crc_ok))
            fills = 2 * int((cut.lengths[cut.crc_ok] + form.prefix_octets).sum()) >= window.size
            # two right checksums prove packets; packets without one must fill half of the window
            is_weak = form.by_headers or bool(form.unchecked)
            if fills if is_weak else packets >= 2 or (packets and fills):
                return True
            if form.by_headers:
                return False
        return False

    def _reader(self, run: Run, section: Section) -> FrameReader | PacketReader:
        piece = self.piece
        reader: FrameReader | PacketReader
        if section.settings is not None:
            reader = FrameReader(
                section,
                section.settings,
                self.found,
                spacecraft_id=piece.spacecraft_id,
                form_of=self._form_of,
                record=self.expected.record,
            )
        elif piece.spacecraft_id is None:
            raise InvalidInput("downlink of bare packets", "", "the id of their spacecraft", "none given")
        else:
            reader = PacketReader(section, self.found, self.expected.form, spacecraft_id=piece.spacecraft_id)
        # earlier pieces were read without the octets that are new between them
        edges = [0, *(edge for one in run.new for edge in one), run.octets]
        known = [
            (max(start, section.start), min(stop, section.stop))
            for start, stop in zip(edges[::2], edges[1::2], strict=True)
        ]
        before = [one for one in known[::-1] if one[0] < one[1] <= section.first]
        after = [one for one in known if section.last <= one[0] < one[1]]
        reader.exclude(
            ((start, run.read(start, stop)) for start, stop in before),
            ((start, run.read(start, stop)) for start, stop in after),
        )
        return reader

    def _form_of(self, spacecraft: int) -> PacketForm:
        if spacecraft not in self.forms:
            with self.ground.database.reading() as connection:
                found = packet_form(connection, spacecraft, self.piece.scope, self.piece.station)
            self.forms[spacecraft] = found
        return self.forms[spacecraft]

    def _definitions(self, spacecraft: int) -> PacketDefinitions:
        """Return the packets that the mission description of a spacecraft declares."""
        if spacecraft not in self.definitions:
            with self.ground.database.reading() as connection:
                self.definitions[spacecraft], _ = definitions_of_spacecraft(connection, spacecraft, self.piece.scope)
        return self.definitions[spacecraft]

    def _refuse(self) -> NoReturn:
        """Refuse a whole recording without a frame and a packet."""
        with self.ground.database.reading() as connection:
            name = recorded_name(connection, self.piece.file_sha256)
        found = f"{self.piece.octets} octets with no frame or packet of the declared link; {CHECK}"
        if self.piece.octets < CERTAIN_OCTETS:
            found += f"; {HINT}"
        raise InvalidInput(name, "", "a stream of CADUs or of space packets", found)

    # Storage

    def _store_early(self, batch: PacketBatch, fragments: list[Fragment]) -> None:
        """Store a batch that is not the last one, and the fragments once there are many."""
        if not self.is_started:
            with self.ground.database.writing() as connection:
                store.start_ingest(connection, self.piece.ingest_id)
            self.is_started = True
        if len(fragments) < FRAGMENTS_LIMIT:
            with self.ground.database.writing() as connection:
                self._count(connection, self._store(connection, batch))
        else:
            self._settle(batch, fragments, is_last=False)
            fragments.clear()
        if self.progress is not None:
            self.progress(min(self.found.octets_used / max(self.piece.octets, 1), 1.0))

    def _settle(self, batch: PacketBatch | None, fragments: list[Fragment], *, is_last: bool) -> None:
        """Store a batch and fragments, and complete packets with fragments; finish the ingest if it is the last one."""
        packets, rest = join(fragments, self._form_of)
        with self.ground.database.writing() as connection:
            stored = Stored(0, 0, 0) if batch is None or not len(batch) else self._store(connection, batch)
            stored += self._store_whole(connection, packets)
            self.found.packets += len(packets)
            self.found.octets_unused -= sum(len(octets) for _, octets in packets)
            for spacecraft in sorted({one.channel[0] for one in rest}):
                mine = [one for one in rest if one.channel[0] == spacecraft]
                recordings.add_fragments(connection, self._vehicle(connection, spacecraft), mine)
            self._count(connection, stored, is_last=is_last and not rest)
        if not rest:
            return
        # of two pieces that are ingested at the same time, at least the later one sees the fragments of both
        packets, used = self._completed(rest)
        with self.ground.database.writing() as connection:
            stored = self._store_whole(connection, packets)
            for spacecraft in sorted({one.channel[0] for one in used}):
                mine = [one for one in used if one.channel[0] == spacecraft]
                recordings.remove_fragments(connection, self.vehicles[spacecraft], mine)
            self._count(connection, stored, joined=stored.new, is_last=is_last)

    def _completed(self, fragments: list[Fragment]) -> tuple[list[tuple[int, bytes]], set[Fragment]]:
        """Return the packets that stored fragments complete, with their spacecraft, and the fragments of them."""
        packets: list[tuple[int, bytes]] = []
        used: set[Fragment] = set()
        with self.ground.database.reading() as connection:
            for one in fragments:
                spacecraft = one.channel[0]
                vehicle = self.vehicles[spacecraft]
                before = partial(recordings.fragments_before, connection, vehicle)
                behind = partial(recordings.fragments_behind, connection, vehicle)
                if one in used:
                    continue
                if found := complete(one, before, behind, self._form_of(spacecraft)):
                    used.update(found[0])
                    packets.append((spacecraft, found[1]))
        return packets, used

    def _store(self, connection: Connection, packets: PacketBatch) -> Stored:
        assert packets.spacecraft_id is not None
        vehicle = self._vehicle(connection, packets.spacecraft_id)
        spacecraft, whole = packets.spacecraft_id, packets
        packets = plausible_part(connection, vehicle, self.piece.ingest_id, packets, judged=self.judged)
        self.is_doubted |= packets is not whole
        stored = store.store_batch(connection, vehicle, packets)
        store.note_receptions(connection, vehicle, self.piece.station, time_receptions(packets))
        defined = np.isin(packets.apid, self._definitions(spacecraft).apids)
        self.unknown += packets.unknown - int(np.count_nonzero(defined))
        timed = packets.ticks[packets.ticks != NO_TICKS]
        if timed.size:
            self.ticks = [min([*self.ticks, int(timed.min())]), max([*self.ticks, int(timed.max())])]
        return stored

    def _store_whole(self, connection: Connection, packets: list[tuple[int, bytes]]) -> Stored:
        """Store packets of spacecraft that were completed with fragments."""
        stored = Stored(0, 0, 0)
        for spacecraft in sorted({one for one, _ in packets}):
            octets = [packet for one, packet in packets if one == spacecraft]
            cut = whole_packets(np.array([len(one) for one in octets], dtype=np.int64))
            stored += self._store(connection, batch_of_cut(b"".join(octets), cut, DICTIONARY, spacecraft))
        return stored

    def _count(self, connection: Connection, stored: Stored, *, joined: int = 0, is_last: bool = False) -> None:
        """Add to the totals of the ingest; finish it if it is the last time."""
        key = self.piece.ingest_id
        added = {"packets_stored": stored.new, "packets_joined": joined, "samples_stored": stored.samples}
        if not is_last:
            recordings.count_stored(connection, key, added)
            return
        if self.is_doubted:
            self.implausible = count_implausible(connection, key)
        waits = None if self.has_link else 1
        self.result = self._result(recordings.count_stored(connection, key, added, waits=waits))
        store.finish_ingest(connection, self.result, utc_now_ns())

    def _vehicle(self, connection: Connection, spacecraft: int) -> int:
        """Return the vehicle id of a spacecraft; create it if it is new."""
        is_current = self.known.around.decoded_version == DICTIONARY.version
        if spacecraft not in self.vehicles or not (spacecraft == self.piece.spacecraft_id and is_current):
            vehicle = vehicle_id(connection, spacecraft, self.piece.scope)
            note_dictionary(connection, vehicle)
            self.vehicles[spacecraft] = vehicle
        return self.vehicles[spacecraft]

    def readable_now(self) -> list[Piece]:
        """Return the pieces that can be read because the link of their recording is known."""
        if not self.piece.stream:
            return []
        with self.ground.database.reading() as connection:
            if self.has_link:
                return recordings.waiting_pieces(connection, self.piece)
            # another piece may have been read in the meantime
            known = recordings.accounting_of_recording(connection, self.piece)
            return [] if known is None else [self.piece]

    def decode(self) -> None:
        """Decode what the description of a vehicle declares, or an older dictionary has decoded."""
        around, mine = self.known.around, self.piece.spacecraft_id
        is_current = around.decoded_version == DICTIONARY.version and not around.has_decodings
        for spacecraft, vehicle in self.vehicles.items():
            if spacecraft == mine and is_current and not self._definitions(spacecraft).declared:
                continue
            catch_up(self.ground, vehicle)
            decode_declared(self.ground, vehicle, withdraw_doubted)

    def _result(self, totals: tuple[int, int, int]) -> IngestResult:
        """Return the result with the totals of `recording_store.count_stored`."""
        found = self.found
        new, joined, samples = totals
        return IngestResult(
            ingest_id=self.piece.ingest_id,
            vehicle_id=next(iter(self.vehicles.values()), None),
            octets=self.piece.octets,
            packets=found.packets,
            packets_new=new,
            packets_joined=joined,
            packets_repeated=found.packets - (new - joined) - self.implausible,
            packets_implausible=self.implausible,
            samples=samples,
            crc_errors=found.crc_errors,
            octets_repeated=self.piece.octets - self.octets_new,
            octets_skipped=self.octets_new - found.octets_used + found.octets_unused,
            octets_pending=min(found.octets_waiting, self.octets_new) if self.has_link else self.octets_new,
            frames=found.frames,
            frames_bad=found.frames_bad,
            frames_joined=found.frames_joined,
            symbols_corrected=found.symbols_corrected,
            unknown=self.unknown,
            first_ticks=self.ticks[0] if self.ticks else None,
            last_ticks=self.ticks[-1] if self.ticks else None,
            vehicle_ids=tuple(sorted(self.vehicles.values())),
            reception=self._reception(),
            remark=self._remark(),
            uplink=tuple(
                ReceivedControlWords(spacecraft_id=spacecraft_id, **asdict(seen))
                for (spacecraft_id, _), seen in sorted(found.uplink.items())
            ),
        )

    def _remark(self) -> str:
        """Return how the octets contradict the declared link; empty if they fit."""
        settings = [one.settings for one in self.sections if one.settings is not None]
        good, frames = self.found.frames_good, self.found.frames
        if not (frames or self.is_framed) or not all(one.proves_frames for one in settings) or 2 * good > frames:
            return ""
        declared = ", ".join(f"{name}={value}" for name, value in settings[0].describe().items())
        source = self.expected.source_of(settings[0])
        return f"{good} of {frames} frames are valid with the {source} link settings ({declared}): {CHECK}"

    def _reception(self) -> ReceivedLink | None:
        """Return the link quality, the sections of the file and the origin of their settings."""
        framed = [(one, one.settings) for one in self.sections if one.settings is not None]
        if not framed:
            return None
        names = {one.name for one in fields(LinkContent)} & set(ReceivedLink.model_fields)
        return ReceivedLink(
            station=self.piece.station,
            bit_error_rate=self.found.bit_error_rate,
            octets=self.octets_new,
            octets_other=self.octets_new - self.found.octets_used,
            **{name: getattr(self.found, name) for name in names},
            sections=tuple(
                ReceivedSection.model_validate(
                    {
                        "start": one.first + one.position - self.piece.position,
                        "stop": one.last + one.position - self.piece.position,
                        "source": self.expected.source_of(settings),
                        **settings.describe(),
                    }
                )
                for one, settings in framed
            ),
        )
