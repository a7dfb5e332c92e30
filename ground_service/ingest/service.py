"""Ingest of a downlink file: the raw file is archived, its packets are stored once each, everything is accounted for.

The archive that results depends only on the octets that were ingested, not on their order, on how they were split into
files or on how often they came. An ingest that was cut off can simply be run again.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from sqlalchemy import Connection

from ground_service.clock import utc_now_ns
from ground_service.errors import PASSING, Conflict, GroundError, InvalidInput
from ground_service.ground import Ground
from ground_service.ingest import edge_store as edges
from ground_service.ingest import store
from ground_service.ingest.model import IngestResult
from ground_service.ingest.parameters import decode_declared, definitions_in_force
from ground_service.ingest.reading import Progress, Reading
from ground_service.ingest.redecode import catch_up, redecode
from ground_service.jobs.model import Job
from ground_service.jobs.service import OTHER_REQUEST, add_job
from ground_service.jobs.store import find_job
from ground_service.store import parameters
from ground_service.store.counters import hold
from ground_service.store.files import StoredFile
from ground_service.store.stored_files import register_file
from ground_service.store.vehicles import FLOWN, all_vehicles
from tmtc.dictionary import DICTIONARY
from tmtc.errors import TmtcError
from tmtc.link import LinkSettings

AT_ONCE_OCTETS = 256 << 10
"""Size up to which a piece of complete frames is stored and accounted for in one transaction."""


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
    piece = _new_piece(
        stored, spacecraft_id=spacecraft_id, instance=instance, place=place, station=station, link=link
    )
    now = utc_now_ns()

    def enter(connection: Connection, reading: Reading, packets: int, samples: int) -> IngestResult:
        result = reading.result_of((packets, 0, samples))
        register_file(connection, stored, "downlink", name, now)
        ingest_id = store.add_finished(connection, stored.sha256, result, now, utc_now_ns())
        edges.add_piece(connection, _entered(piece, ingest_id), packets, samples)
        return result.model_copy(update={"ingest_id": ingest_id})

    at_once = _store_at_once(ground, piece, enter)
    if at_once is not None:
        return at_once
    with ground.database.writing() as connection:
        ingest_id = _add_ingest(connection, stored, name, piece, "running")
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
) -> int:
    """Add an ingest of an archived file, within the caller's transaction; return its id."""
    piece = _new_piece(
        stored, spacecraft_id=spacecraft_id, instance=instance, place=place, station=station, link=link
    )
    return _add_ingest(connection, stored, name, piece, "queued")


def _new_piece(
    stored: StoredFile,
    *,
    spacecraft_id: int | None,
    instance: str,
    place: Place | None,
    station: str,
    link: str | None,
) -> edges.Piece:
    """Return a piece whose ingest is not entered yet."""
    if link is not None:
        _check_link(link)
    return edges.Piece(
        ingest_id=0,
        scope=instance,
        spacecraft_id=spacecraft_id,
        file_sha256=stored.sha256,
        octets=stored.octets,
        stream=place.stream if place is not None else "",
        position=place.offset if place is not None else 0,
        links_tried=None,
        station=station,
        link=link,
    )


def _entered(piece: edges.Piece, ingest_id: int) -> edges.Piece:
    """Return a piece with its ingest; without a stream its position is the order of arrival."""
    return replace(piece, ingest_id=ingest_id, position=piece.position if piece.stream else ingest_id)


def _add_ingest(connection: Connection, stored: StoredFile, name: str, piece: edges.Piece, state: str) -> int:
    now = utc_now_ns()
    register_file(connection, stored, "downlink", name, now)
    ingest_id = store.add_ingest(
        connection, stored.sha256, state=state, dictionary_version=DICTIONARY.version, now_utc_ns=now
    )
    edges.add_piece(connection, _entered(piece, ingest_id))
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
    at_once = _run_at_once(ground, ingest_id)
    if at_once is not None:
        return at_once
    with ground.database.writing() as connection:
        store.start_ingest(connection, ingest_id)
    return _run(ground, ingest_id, progress=progress)


def _run_at_once(ground: Ground, ingest_id: int) -> IngestResult | None:
    """Run the ingest of a small piece as `_store_at_once` does; None for any other piece."""
    with ground.database.reading() as connection:
        piece = edges.find_piece(connection, ingest_id)

    def finish(connection: Connection, reading: Reading, packets: int, samples: int) -> IngestResult:
        result = reading.result_of(edges.finish_piece(connection, ingest_id, packets, samples))
        store.finish_ingest(connection, result, utc_now_ns())
        return result

    return None if piece is None else _store_at_once(ground, piece, finish)


def _store_at_once(
    ground: Ground,
    piece: edges.Piece,
    finish: Callable[[Connection, Reading, int, int], IngestResult],
) -> IngestResult | None:
    """Store a small piece that nothing waits for, with its accounting, in one transaction; None for any other piece.

    `finish` receives the numbers of new packets and samples. After an error that does not pass nothing is stored, and
    the piece is read as any other, which records the error.
    """
    if piece.octets > AT_ONCE_OCTETS:
        return None
    try:
        reading = Reading(ground, piece, None)
        batches = reading.complete_batches()
        if batches is None:
            return None
        with ground.database.writing() as connection:
            result = finish(connection, reading, *reading.store_complete(connection, batches))
            reading.remember(connection, replace(piece, ingest_id=result.ingest_id))
        return result
    except PASSING:
        raise
    except (GroundError, TmtcError):
        return None


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
    reading = Reading(ground, piece, progress)
    learned = reading.read()
    for other in learned:
        late = Reading(ground, other, None, vehicles=reading.vehicles)
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
