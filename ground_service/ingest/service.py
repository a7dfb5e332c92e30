"""Ingest of a downlink file: the raw file is archived, its packets are stored once each, everything is accounted for.

The archive that results depends only on the octets that were ingested, not on their order, on how they were split into
files or on how often they came. An ingest that was cut off can simply be run again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from sqlalchemy import Connection

from ground_service.clock import utc_now_ns
from ground_service.errors import PASSING, Conflict, GroundError, InvalidInput
from ground_service.ground import Ground
from ground_service.ingest import edge_store as edges
from ground_service.ingest import store
from ground_service.ingest.frames import ChannelEdge, is_checked
from ground_service.ingest.joining import Joiner
from ground_service.ingest.model import IngestResult, ReceivedControlWords, ReceivedLink, ReceivedSection
from ground_service.ingest.packets import PacketBatch, time_receptions
from ground_service.ingest.parameters import decode_declared, definitions_in_force, definitions_of_spacecraft
from ground_service.ingest.reception import ExpectedLink, expected_link, remember_link
from ground_service.ingest.redecode import catch_up, redecode
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
from ground_service.jobs.model import Job
from ground_service.jobs.service import OTHER_REQUEST, add_job
from ground_service.jobs.store import find_job
from ground_service.missions.definitions import PacketDefinitions
from ground_service.store import parameters
from ground_service.store.counters import hold
from ground_service.store.files import StoredFile, mapped_octets, read_blocks
from ground_service.store.stored_files import recorded_name, register_file
from ground_service.store.vehicles import FLOWN, all_vehicles
from tmtc.arrays import as_octets
from tmtc.cuc import NO_TICKS
from tmtc.dictionary import DICTIONARY
from tmtc.errors import TmtcError, UnknownCoding
from tmtc.link import LinkSettings
from tmtc.packets import PACKET_MAX_LENGTH

Progress = Callable[[float], None]


LEAST_GOOD_FRAMES = 2
"""Smallest number of good frames from which their link settings are remembered."""

DEFAULT_LINKS = (Link(LinkSettings().explicit), Link(LinkSettings(checksum=False).explicit))
"""Links that are tried for an unknown spacecraft if a piece is too small to determine its link."""


@dataclass(frozen=True, slots=True)
class Place:
    """Position of a file in a stream of octets, as stated by its sender."""

    stream: str
    offset: int


def ingest_file(
    ground: Ground,
    path: Path,
    *,
    spacecraft_id: int | None = None,
    instance: str = FLOWN,
    name: str | None = None,
    place: Place | None = None,
    station: str = "",
    link: str | None = None,
) -> IngestResult:
    """Archive a downlink file and store its content.

    Parameters
    ----------
    spacecraft_id
        Spacecraft of the file; frames of other spacecraft are ignored. None: the ids are those of the frames. Required
        for bare packets, which have no id.
    instance
        Instance of the spacecraft to which the telemetry belongs.
    place
        Position of the file in its stream; None: joined by order of arrival and by content.
    station
        Name of the station in the mission description; empty: not stated.
    link
        Link settings as text (`LinkSettings.parse`), used without evidence; None: not stated.

    Raises
    ------
    InvalidInput
        If the file is unreadable or contains no part of a downlink.
    """
    if not path.is_file():
        raise InvalidInput(str(path), "", "a downlink file", "a folder" if path.is_dir() else "nothing there")
    stored = ground.files.put_file(path)
    return ingest_stored(
        ground,
        stored,
        spacecraft_id=spacecraft_id,
        instance=instance,
        name=name or path.name,
        place=place,
        station=station,
        link=link,
    )


def ingest_stored(
    ground: Ground,
    stored: StoredFile,
    *,
    spacecraft_id: int | None = None,
    instance: str = FLOWN,
    name: str,
    place: Place | None = None,
    station: str = "",
    link: str | None = None,
) -> IngestResult:
    """Store what is in an archived downlink file; see `ingest_file`."""
    with ground.database.writing() as connection:
        ingest_id = add_ingest(
            connection,
            stored,
            name,
            spacecraft_id=spacecraft_id,
            instance=instance,
            place=place,
            station=station,
            link=link,
            state="running",
        )
    return _run(ground, ingest_id)


def add_ingest(
    connection: Connection,
    stored: StoredFile,
    name: str,
    *,
    spacecraft_id: int | None = None,
    instance: str = FLOWN,
    place: Place | None = None,
    station: str = "",
    link: str | None = None,
    state: str = "queued",
) -> int:
    """Add an ingest of an archived file, within the caller's transaction; return its id."""
    if link is not None:
        _check_link(link)
    now = utc_now_ns()
    register_file(connection, stored, "downlink", name, now)
    ingest_id = store.add_ingest(
        connection, stored.sha256, state=state, dictionary_version=DICTIONARY.version, now_utc_ns=now
    )
    edges.add_piece(
        connection,
        edges.Piece(
            ingest_id=ingest_id,
            scope=instance,
            spacecraft_id=spacecraft_id,
            file_sha256=stored.sha256,
            octets=stored.octets,
            stream=place.stream if place is not None else "",
            position=place.offset if place is not None else ingest_id,
            links_tried=None,
            station=station,
            link=link,
        ),
    )
    return ingest_id


def _check_link(text: str) -> None:
    try:
        LinkSettings.parse(text)
    except TmtcError as error:
        raise InvalidInput("telemetry", "link", "link settings", str(error)) from error


def enter_ingest(
    ground: Ground,
    stored: StoredFile,
    name: str,
    *,
    spacecraft_id: int | None,
    instance: str,
    place: Place | None = None,
    station: str = "",
    link: str | None = None,
    job_id: str | None = None,
) -> tuple[int, str]:
    """Add an archived file and the job that ingests it in one transaction; return their ids, also if the job exists.

    Raises
    ------
    Conflict
        If the id belongs to another ingest.
    """
    with ground.database.writing() as connection:
        if job_id is not None:
            hold(connection, f"job {job_id}")
            known = find_job(connection, job_id)
            if known is not None:
                return _known_ingest(connection, known, stored, spacecraft_id, instance), job_id
        ingest_id = add_ingest(
            connection,
            stored,
            name,
            spacecraft_id=spacecraft_id,
            instance=instance,
            place=place,
            station=station,
            link=link,
        )
        arguments = {"ingest_id": ingest_id, "spacecraft_id": spacecraft_id, "instance": instance}
        return ingest_id, add_job(connection, "ingest", arguments, job_id=job_id)


def _known_ingest(
    connection: Connection,
    job: Job,
    stored: StoredFile,
    spacecraft_id: int | None,
    instance: str,
) -> int:
    """Return the ingest of an existing job with the same file and the same spacecraft."""
    asked = {"spacecraft_id": spacecraft_id, "instance": instance}
    if job.kind == "ingest" and asked.items() <= job.arguments.items():
        ingest_id = int(job.arguments["ingest_id"])
        if store.get_ingest(connection, ingest_id).sha256 == stored.sha256:
            return ingest_id
    raise Conflict(OTHER_REQUEST)


def run_ingest(
    ground: Ground,
    ingest_id: int,
    *,
    progress: Progress | None = None,
) -> IngestResult:
    """Run an ingest that was added with `add_ingest`; a repetition changes nothing.

    `progress` is called with the stored share of the file, several times for a long file.
    """
    with ground.database.writing() as connection:
        store.start_ingest(connection, ingest_id)
    return _run(ground, ingest_id, progress=progress)


def _run(ground: Ground, ingest_id: int, *, progress: Progress | None = None) -> IngestResult:
    with ground.database.listeners.held():  # one call for the whole file, not one for each batch
        return _run_held(ground, ingest_id, progress)


def _run_held(ground: Ground, ingest_id: int, progress: Progress | None) -> IngestResult:
    try:
        result = _read_piece(ground, ingest_id, progress)
    except PASSING:
        raise
    except (GroundError, TmtcError) as error:
        with ground.database.writing() as connection:
            store.fail_ingest(connection, ingest_id, str(error), utc_now_ns())
        raise
    with ground.database.writing() as connection:
        store.finish_ingest(connection, result, utc_now_ns())
    return result


def _read_piece(
    ground: Ground,
    ingest_id: int,
    progress: Progress | None,
) -> IngestResult:
    """Store the content of a piece and the units joined with others, and read pieces that wait for its link."""
    with ground.database.reading() as connection:
        piece = edges.piece_of(connection, ingest_id)
    reading = _Reading(ground, piece, progress)
    learned = reading.read()
    for other in learned:
        late = _Reading(ground, other, None, vehicles=reading.vehicles)
        late.read()
        with ground.database.writing() as connection:
            store.change_result(connection, late.result())
    for vehicle in reading.vehicles.values():
        catch_up(ground, vehicle)
        decode_declared(ground, vehicle)
    return reading.result()


def apply_definition(ground: Ground, vehicle: int) -> int:
    """Decode a vehicle's packets with the definitions in force for it; return the number of samples.

    Packets without a checksum that no earlier description declared are not stored yet: the raw files are read again.
    """
    stored = decode_declared(ground, vehicle)
    with ground.database.reading() as connection:
        to_read = parameters.ingests_to_read(connection, vehicle)
    for ingest_id in to_read:
        ground.check_stopping()
        with suppress(InvalidInput, TmtcError):  # a file that is still no downlink
            run_ingest(ground, ingest_id)
    with ground.database.writing() as connection:
        parameters.note_read(connection, vehicle)
    return stored + decode_declared(ground, vehicle)


def decode_all_again(ground: Ground) -> int:
    """Decode all packets with this version's dictionary and the mission descriptions; return the number of rows."""
    with ground.database.reading() as connection:
        vehicles = [one.id for one in all_vehicles(connection)]
    return sum(redecode(ground, one, DICTIONARY) + apply_definition(ground, one) for one in vehicles)


def undecoded_vehicles(ground: Ground, spacecraft_id: int) -> list[int]:
    """Return the vehicles of a spacecraft whose packets are not decoded with the definitions in force for them."""
    with ground.database.reading() as connection:
        mine = [one for one in all_vehicles(connection) if one.ccsds_id == spacecraft_id]
        return [
            one.id
            for one in mine
            if not parameters.is_decoded(
                connection, one.id, definitions_in_force(connection, one.id)[0].digest
            )
        ]


@dataclass(frozen=True, slots=True)
class _Batch:
    """Packets of a downlink, and the fragments in its channels."""

    packets: PacketBatch
    channel_edges: list[ChannelEdge]
    is_bare: bool


class _Reading:
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
            with self.ground.database.reading() as connection:
                known = edges.known_links(connection, self.piece.scope)
                self.expected = expected_link(connection, self.piece)
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
            reader = DownlinkReader(
                reach,
                self.spacecraft_id,
                record=self.expected.record,
                error_control=self.expected.error_control,
                unchecked_apids=self._unchecked_apids,
            )
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
        assert found.packets.spacecraft_id is not None
        vehicle = self.joiner.vehicle(connection, found.packets.spacecraft_id)
        self.joiner.keep_channel_edges(connection, found.channel_edges)
        stored = store.store_batch(connection, vehicle, found.packets)
        store.note_receptions(connection, vehicle, self.piece.station, time_receptions(found.packets))
        self.new += stored.new
        edges.count_stored(connection, self.piece.ingest_id, stored.new, stored.samples, joined=False)
        defined = np.isin(found.packets.apid, self._definitions(found.packets.spacecraft_id).apids)
        self.unknown += found.packets.unknown - int(np.count_nonzero(defined))
        timed = found.packets.ticks[found.packets.ticks != NO_TICKS]
        if timed.size:
            self.ticks = [min([*self.ticks, int(timed.min())]), max([*self.ticks, int(timed.max())])]

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
        found, joined = self.accounting, self.joiner.joined
        with self.ground.database.reading() as connection:
            pending = edges.octets_pending(connection, self.piece.file_sha256)
            packets_new, packets_joined, samples = edges.stored_by(connection, self.piece.ingest_id)
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
