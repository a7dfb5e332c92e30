"""Reading of one piece of a downlink: its link, its packets, and the octets that wait for adjacent pieces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from sqlalchemy import Connection

from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput
from ground_service.ground import Ground
from ground_service.ingest import edge_store as edges
from ground_service.ingest import store
from ground_service.ingest.frames import ChannelEdge, is_checked
from ground_service.ingest.joining import Joiner
from ground_service.ingest.known import Known, known_before
from ground_service.ingest.model import IngestResult, ReceivedControlWords, ReceivedLink, ReceivedSection
from ground_service.ingest.packets import PacketBatch, time_receptions
from ground_service.ingest.parameters import definitions_of_spacecraft
from ground_service.ingest.reception import ExpectedLink, remember_link
from ground_service.ingest.stream import (
    BARE,
    CADU_MAX_OCTETS,
    PROBE_OCTETS,
    DownlinkReader,
    Link,
    LinkAccounting,
    Reach,
    fragment_edges,
    reaches_of,
)
from ground_service.missions.definitions import PacketDefinitions
from ground_service.store.files import mapped_octets, read_blocks
from ground_service.store.stored_files import recorded_name
from tmtc.arrays import as_octets
from tmtc.cuc import NO_TICKS
from tmtc.errors import UnknownCoding
from tmtc.link import LinkSettings
from tmtc.packets import PACKET_MAX_LENGTH

Progress = Callable[[float], None]

LEAST_GOOD_FRAMES = 2
"""Smallest number of good frames from which their link settings are remembered."""

DEFAULT_LINKS = (Link(LinkSettings().explicit), Link(LinkSettings(checksum=False).explicit))
"""Links that are tried for an unknown spacecraft if a piece is too small to determine its link."""


@dataclass(frozen=True, slots=True)
class _Batch:
    """Packets of a downlink, and the fragments in its channels."""

    packets: PacketBatch
    channel_edges: list[ChannelEdge]
    is_bare: bool


class Reading:
    """Reading of one piece."""

    def __init__(
        self,
        ground: Ground,
        piece: edges.Piece,
        progress: Progress | None,
        vehicles: dict[int, int] | None = None,
    ) -> None:
        self.ground = ground
        self.piece = piece
        self.spacecraft_id = piece.spacecraft_id
        self.progress = progress
        self.vehicles: dict[int, int] = {} if vehicles is None else vehicles
        self.definitions: dict[int, PacketDefinitions] = {}
        self.known: Known | None = None
        self.joiner = Joiner(ground, piece, self.vehicles, self._unchecked_apids)
        self.new = self.unknown = 0
        self.ticks: list[int] = []
        self.accounting = LinkAccounting(octets=piece.octets, octets_skipped=piece.octets)
        self.expected = ExpectedLink()
        self.ambiguous = False
        self.sections: list[Reach] = []

    def _definitions(self, spacecraft: int) -> PacketDefinitions:
        """Return the packets that the mission description of a spacecraft declares."""
        if spacecraft not in self.definitions:
            with self.ground.database.reading() as connection:
                self.definitions[spacecraft] = definitions_of_spacecraft(
                    connection, spacecraft, self.piece.scope
                )[0]
        return self.definitions[spacecraft]

    def _unchecked_apids(self, spacecraft: int) -> frozenset[int]:
        return self._definitions(spacecraft).unchecked_apids

    def read(self) -> list[edges.Piece]:
        """Read and join the piece; return the pieces that can be read now because its link is known."""
        while True:
            known = self._look_around().links
            reaches = self._reaches(known)
            if reaches:
                self._read_reaches(reaches, known)
                self.joiner.join()
                return self._readable_now()
            link = self._link_by_place(known) if self.piece.octets <= CADU_MAX_OCTETS else None
            if link is None:
                self._refuse_noise()
            with self.ground.database.writing() as connection:
                self._keep_fragment(connection, link, known)
                edges.note_read(connection, self.piece.ingest_id, len(known))
            self.joiner.join()
            if link is not None and (self.joiner.joined.frames or self.joiner.joined.packets):
                with self.ground.database.writing() as connection:
                    self._learn(connection, link, known, len(known) + 1)
                return self._readable_now()
            with self.ground.database.reading() as connection:
                if len(edges.known_links(connection, self.piece.scope)) == len(known):
                    return []

    def complete_batches(self) -> list[PacketBatch] | None:
        """Return the packets of a small piece that nothing waits for; None for any other piece.

        All its octets are valid frames of a known link with complete packets. No octets of other pieces can be joined
        to it.
        """
        known = self._look_around()
        if not known.is_settled:
            return None
        reaches = self._reaches(known.links)
        if len(reaches) != 1 or (settings := reaches[0].link.settings) is None:
            return None
        unit = settings.cadu_length + self.expected.record.octets
        if reaches[0].link not in known.links or self.piece.octets % unit:
            return None
        reader = self._reader(reaches[0])
        octets = self.ground.files.read(self.piece.file_sha256, 0, self.piece.octets)
        batches = list(reader.batches([octets]))
        found = reader.accounting
        used = found.quality.octets_frames + found.quality.octets_records
        if reader.edges or reader.take_channel_edges() or found.frames_bad or used != self.piece.octets:
            return None
        assert self.piece.spacecraft_id is not None
        assert known.around.vehicle_id is not None
        self.vehicles[self.piece.spacecraft_id] = known.around.vehicle_id
        self.accounting, self.sections = found, reaches
        return batches

    def store_complete(self, connection: Connection, batches: Sequence[PacketBatch]) -> tuple[int, int]:
        """Store the packets of a complete piece; return the numbers of new packets and samples."""
        stored = [self._store_packets(connection, one) for one in batches if len(one)]
        return sum(one.new for one in stored), sum(one.samples for one in stored)

    def remember(self, connection: Connection, piece: edges.Piece) -> None:
        """Record the settings of a complete piece, whose ingest is stored."""
        settings = self.sections[0].link.settings
        if settings is not None and self.accounting.quality.frames_good >= LEAST_GOOD_FRAMES:
            remember_link(connection, piece, sorted(self.vehicles.values()), settings, utc_now_ns())

    def _look_around(self) -> Known:
        with self.ground.database.reading() as connection:
            self.known = known_before(connection, self.piece)
        self.expected = self.known.expected
        if self.piece.spacecraft_id is not None and self.known.definitions is not None:
            self.definitions.setdefault(self.piece.spacecraft_id, self.known.definitions)
        return self.known

    def _reader(self, reach: Reach) -> DownlinkReader:
        return DownlinkReader(
            reach,
            self.spacecraft_id,
            record=self.expected.record,
            error_control=self.expected.error_control,
            unchecked_apids=self._unchecked_apids,
        )

    def _reaches(self, known: list[Link]) -> list[Reach]:
        """Return the sections of the file; none without sufficient evidence of its link.

        Raises
        ------
        InvalidInput
            If the file has frames whose coding is unknown.
        """
        expected = [Link(one) for one in (*self.expected.mission, *self.expected.remembered)]
        candidates = list(dict.fromkeys([*expected, *known, *DEFAULT_LINKS]))
        octets = mapped_octets(self.ground.files.path(self.piece.file_sha256))
        try:
            unchecked = frozenset[int]()
            if self.spacecraft_id is not None:
                unchecked = self._unchecked_apids(self.spacecraft_id)
            reaches, plan = reaches_of(
                octets,
                candidates,
                stated=self.expected.stated,
                error_control=self.expected.error_control,
                unchecked_apids=unchecked,
            )
        except UnknownCoding as error:
            source = self._name()
            raise InvalidInput(source, "", error.expected, error.found) from error
        self.ambiguous = plan is not None and plan.ambiguous
        return reaches

    def _read_reaches(self, reaches: Sequence[Reach], known: list[Link]) -> None:
        """Read the sections of the file and store their packets and edges."""
        self.accounting = LinkAccounting()
        self.sections = list(reaches)
        for reach in reaches:
            reader = self._reader(reach)
            last = self._store_batches(reader)
            with self.ground.database.writing() as connection:
                self._store(connection, last)
                self.joiner.keep_channel_edges(connection, reader.take_channel_edges())
                self.joiner.keep_edges(connection, reach.link, reader.edges)
                self._learn(connection, reach.link, known, None)
                settings = reach.link.settings
                if settings is not None and reader.accounting.quality.frames_good >= LEAST_GOOD_FRAMES:
                    vehicles = sorted(self.vehicles.values())
                    remember_link(connection, self.piece, vehicles, settings, utc_now_ns())
            self.accounting.add(reader.accounting)

    def _learn(self, connection: Connection, link: Link, known: list[Link], links_tried: int | None) -> None:
        edges.note_read(connection, self.piece.ingest_id, links_tried)
        if link not in known:
            edges.learn_link(connection, self.piece.scope, link)

    def _readable_now(self) -> list[edges.Piece]:
        with self.ground.database.reading() as connection:
            links = len(edges.known_links(connection, self.piece.scope))
            return [
                edges.piece_of(connection, one)
                for one in edges.pieces_to_read_again(connection, self.piece.scope, links)
                if one != self.piece.ingest_id
            ]

    def _store_batches(self, reader: DownlinkReader) -> _Batch | None:
        """Store all batches of a section except the last one, which is returned."""
        ground, total, reach = self.ground, max(self.piece.octets, 1), reader.reach
        path = ground.files.path(self.piece.file_sha256)
        last: _Batch | None = None
        for batch in reader.batches(read_blocks(path, start=reach.start, stop=reach.stop)):
            ground.check_stopping()
            if batch.spacecraft_id is None:
                raise InvalidInput("downlink of bare packets", "", "the id of their spacecraft", "none given")
            if last is not None:
                with self.ground.database.writing() as connection:
                    self._store(connection, last)
            last = _Batch(batch, reader.take_channel_edges(), reach.link == BARE)
            if self.progress is not None:
                self.progress((reach.start + reader.accounting.octets) / total)
        return last

    def _store(self, connection: Connection, found: _Batch | None) -> None:
        if found is None or (found.is_bare and not len(found.packets)):
            return
        self.joiner.keep_channel_edges(connection, found.channel_edges)
        stored = self._store_packets(connection, found.packets)
        edges.count_stored(connection, self.piece.ingest_id, stored.new, stored.samples, joined=False)

    def _store_packets(self, connection: Connection, packets: PacketBatch) -> store.Stored:
        assert packets.spacecraft_id is not None
        vehicle = self.joiner.vehicle(connection, packets.spacecraft_id)
        stored = store.store_batch(connection, vehicle, packets)
        store.note_receptions(connection, vehicle, self.piece.station, time_receptions(packets))
        self.new += stored.new
        defined = np.isin(packets.apid, self._definitions(packets.spacecraft_id).apids)
        self.unknown += packets.unknown - int(np.count_nonzero(defined))
        timed = packets.ticks[packets.ticks != NO_TICKS]
        if timed.size:
            self.ticks = [min([*self.ticks, int(timed.min())]), max([*self.ticks, int(timed.max())])]
        return stored

    def _link_by_place(self, known: list[Link]) -> Link | None:
        """Return the link of a piece that is too small to determine it, from the adjacent octets."""
        if known:
            return None
        with self.ground.database.reading() as connection:
            before = edges.octets_before(connection, self.piece, PROBE_OCTETS // 4)
            behind = edges.octets_behind(connection, self.piece, PROBE_OCTETS // 4)
        if not before and not behind:
            return None
        parts = [*before, edges.Part(self.piece.file_sha256, 0, self.piece.octets), *behind]
        octets = b"".join(self.ground.files.read(one.file_sha256, one.start, one.stop) for one in parts)
        try:
            reaches, plan = reaches_of(as_octets(octets), DEFAULT_LINKS)
        except UnknownCoding:
            return None
        proposal = None if plan is None else plan.proposal
        if not self.piece.stream and proposal and not any(one.packets for one in proposal.evidence[:1]):
            # A piece that came twice has markers at a regular distance, which is no proof of a link.
            return None
        # octets that are adjacent only by order of arrival must not determine a link without proof
        link = reaches[0].link if reaches else None
        return link if link is None or link.settings is None or is_checked(link.settings) else None

    def _keep_fragment(self, connection: Connection, link: Link | None, known: list[Link]) -> None:
        """Store a piece without a complete unit as fragments, for each possible link."""
        links = [link] if link is not None else known or list(DEFAULT_LINKS[:1])
        if not known and self.spacecraft_id is not None and BARE not in links:
            links = [*links, BARE]
        octets = b""
        if self.piece.octets <= PACKET_MAX_LENGTH:
            octets = self.ground.files.read(self.piece.file_sha256, 0, self.piece.octets)
        for one in links:
            self.joiner.keep_edges(connection, one, fragment_edges(octets, one.settings) if octets else [])

    def _refuse_noise(self) -> None:
        """Refuse a piece that cannot be a fragment of a unit.

        Raises
        ------
        InvalidInput
            If the piece is longer than any CADU or packet but contains none.
        """
        limit = 2 * CADU_MAX_OCTETS if self.spacecraft_id is None else PACKET_MAX_LENGTH
        if self.piece.octets > limit:
            raise InvalidInput(
                self._name(),
                "",
                "a stream of CADUs or of space packets",
                f"{self.piece.octets} octets without a valid packet",
            )

    def result(self) -> IngestResult:
        """Return the result of the reading."""
        with self.ground.database.reading() as connection:
            pending = edges.octets_pending(connection, self.piece.file_sha256)
            totals = edges.stored_by(connection, self.piece.ingest_id)
        return self.result_of(totals, pending)

    def result_of(self, totals: tuple[int, int, int], pending: int = 0) -> IngestResult:
        """Return the result with the totals of `edge_store.stored_by` and the number of octets that wait."""
        found, joined = self.accounting, self.joiner.joined
        packets_new, packets_joined, samples = totals
        return IngestResult(
            ingest_id=self.piece.ingest_id,
            vehicle_id=next(iter(self.vehicles.values()), None),
            octets=found.octets,
            packets=found.packets,
            packets_new=packets_new,
            packets_joined=packets_joined,
            packets_repeated=found.packets - (packets_new - packets_joined),
            samples=samples,
            crc_errors=found.crc_errors,
            octets_skipped=found.octets_skipped,
            octets_pending=pending,
            frames=found.frames,
            frames_bad=found.frames_bad,
            frames_joined=joined.frames,
            symbols_corrected=found.symbols_corrected,
            unknown=self.unknown,
            first_ticks=self.ticks[0] if self.ticks else None,
            last_ticks=self.ticks[-1] if self.ticks else None,
            vehicle_ids=tuple(sorted(self.vehicles.values())),
            reception=self._reception(),
            uplink=tuple(
                ReceivedControlWords(spacecraft_id=spacecraft_id, **asdict(seen))
                for (spacecraft_id, _), seen in sorted(found.uplink.items())
            ),
        )

    def _reception(self) -> ReceivedLink | None:
        """Return the link quality, the sections of the file and the origin of their settings."""
        framed = [(one, one.link.settings) for one in self.sections if one.link.settings is not None]
        if not framed:
            return None
        return ReceivedLink(
            station=self.piece.station,
            ambiguous=self.ambiguous,
            **self.accounting.quality.describe(),
            sections=tuple(
                ReceivedSection.model_validate(
                    {
                        "start": one.start,
                        "stop": one.stop,
                        "source": self.expected.source_of(settings),
                        **settings.describe(),
                    }
                )
                for one, settings in framed
            ),
        )

    def _name(self) -> str:
        with self.ground.database.reading() as connection:
            return recorded_name(connection, self.piece.file_sha256)
