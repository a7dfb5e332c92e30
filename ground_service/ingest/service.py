"""Ingest of downlink files: the raw file is archived, its packets are stored once each, everything is accounted for.

The archive that results depends only on the octets of the recordings, not on their order, on how they were split into
pieces or on how often they came. An ingest that was cut off can simply be run again.
"""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.errors import PASSING, Conflict, GroundError, InvalidInput, StateConflict
from ground_service.ground import Ground
from ground_service.ingest import doubt_store, store
from ground_service.ingest.model import IngestResult
from ground_service.ingest.reception import Progress, Reading
from ground_service.ingest.recording_store import Piece, add_piece, get_piece
from ground_service.jobs.service import OTHER_REQUEST, Job, add_job, find_job
from ground_service.missions.store import stations_in_force
from ground_service.store.files import StoredFile, register_file
from ground_service.store.vehicles import FLOWN, all_vehicles, hold, lock_vehicle
from ground_service.telemetry import store as telemetry
from ground_service.telemetry import values as parameters
from ground_service.telemetry.decoding import decode_declared, definitions_in_force, redecode
from ground_service.toml import REASON_LIMIT, require_line
from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import TmtcError
from tmtc.link.settings import LinkSettings
from tmtc.packets.pus import NO_TICKS


@dataclass(frozen=True, slots=True)
class PiecePosition:
    """Position of a file in its recording, as stated by its sender."""

    stream: str
    offset: int


def ingest_file(
    ground: Ground,
    path: Path,
    *,
    spacecraft_id: int | None = None,
    instance: str = FLOWN,
    name: str | None = None,
    place: PiecePosition | None = None,
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
        Recording of which the file is a piece, and its offset; None: the file is a whole recording.
    station
        Name of the station in the mission description; empty: not stated.
    link
        Link settings as text (`LinkSettings.parse`), used without evidence; None: not stated.

    Raises
    ------
    InvalidInput
        If the file is unreadable, or a whole recording without a frame or packet.
    """
    if not path.is_file():
        raise InvalidInput(str(path), "", "a downlink file", "a folder" if path.is_dir() else "nothing there")
    return ingest_stored(
        ground,
        ground.files.put_file(path),
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
    place: PiecePosition | None = None,
    station: str = "",
    link: str | None = None,
) -> IngestResult:
    """Store what is in an archived downlink file; see `ingest_file`."""
    with ground.database.writing() as connection:
        piece = _add(connection, stored, name, "running", spacecraft_id, instance, place, station, link)
    return _ingest(ground, piece)


def enter_ingest(
    ground: Ground,
    stored: StoredFile,
    name: str,
    *,
    spacecraft_id: int | None,
    instance: str,
    place: PiecePosition | None = None,
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
    arguments = {"spacecraft_id": spacecraft_id, "instance": instance}
    with ground.database.writing() as connection:
        if job_id is not None:
            hold(connection, f"job {job_id}")
            known = find_job(connection, job_id)
            if known is not None:
                return _known_ingest(connection, known, stored, arguments), job_id
        ingest_id = _add(connection, stored, name, "queued", spacecraft_id, instance, place, station, link).ingest_id
        return ingest_id, add_job(connection, "ingest", {"ingest_id": ingest_id, **arguments}, job_id=job_id)


def _add(
    connection: Connection,
    stored: StoredFile,
    name: str,
    state: str,
    spacecraft_id: int | None,
    instance: str,
    place: PiecePosition | None,
    station: str,
    link: str | None,
) -> Piece:
    """Add the ingest of an archived file as a piece of its recording; return the piece."""
    try:
        assert link is None or LinkSettings.parse(link)
    except TmtcError as error:
        raise InvalidInput("telemetry", "link", "link settings", str(error)) from error
    stations = station and stations_in_force(connection, spacecraft_id)
    if stations and station not in stations:
        raise Conflict(
            f"station: expected one of the mission description ({', '.join(sorted(stations))}), found {station[:64]}"
        )
    now = utc_now_ns()
    register_file(connection, stored, "downlink", name, now)
    ingest_id = store.add_ingest(
        connection, stored.sha256, state=state, dictionary_version=DICTIONARY.version, now_utc_ns=now
    )
    stream, position = ("", 0) if place is None else (place.stream, place.offset)
    piece = Piece(ingest_id, instance, spacecraft_id, stored.sha256, stored.octets, stream, position, station, link)
    add_piece(connection, piece)
    return piece


def _known_ingest(connection: Connection, job: Job, stored: StoredFile, asked: dict[str, Any]) -> int:
    """Return the ingest of an existing job with the same file and the same spacecraft."""
    if job.kind == "ingest" and asked.items() <= job.arguments.items():
        ingest_id = int(job.arguments["ingest_id"])
        if store.get_ingest(connection, ingest_id).sha256 == stored.sha256:
            return ingest_id
    raise Conflict(OTHER_REQUEST)


def run_ingest(
    ground: Ground, ingest_id: int, *, progress: Progress | None = None, judged: bool = False
) -> IngestResult:
    """Read the piece of an ingest that was entered; a repetition changes nothing.

    `progress` is called with the stored share of the file, several times for a long file. `judged`: which packets have
    an implausible time is known already.
    """
    with ground.database.reading() as connection:
        piece = get_piece(connection, ingest_id)
    return _ingest(ground, piece, progress, judged=judged)


def _ingest(ground: Ground, piece: Piece, progress: Progress | None = None, *, judged: bool = False) -> IngestResult:
    with ground.database.listeners.held():  # one call for the whole file, not one for each batch
        try:
            reading = Reading(ground, piece, progress, judged=judged)
            reading.read()
            readings = [reading]
            for other in reading.readable_now():
                with suppress(InvalidInput):
                    again = Reading(ground, other, judged=judged)
                    again.read()
                    readings.append(again)
            for one in readings:
                one.decode()
        except PASSING:
            raise
        except (GroundError, TmtcError) as error:
            with ground.database.writing() as connection:
                store.fail_ingest(connection, piece.ingest_id, str(error), utc_now_ns())
            raise
    return [one.result for one in readings if one.piece.ingest_id == piece.ingest_id][-1]


def withdraw_ingest(ground: Ground, ingest_id: int, *, reason: str, actor: str) -> str:
    """Withdraw an ingest and add the job that derives everything again without it; return the id of the job.

    The file, the ingest and the audit entry stay.

    Raises
    ------
    StateConflict
        It is not done.
    """
    require_line(reason, "ingest", "reason", REASON_LIMIT)
    with ground.database.writing() as connection:
        found = store.get_ingest(connection, ingest_id)
        if not store.change_ingest(connection, ingest_id, "done", "withdrawing"):
            raise StateConflict("ingest", ingest_id, "done", found.state)
        audit(connection, actor, "withdraw ingest", str(ingest_id), {"reason": reason, "sha256": found.sha256})
        return add_job(connection, "withdrawal", {"ingest_id": ingest_id})


def derive_without(ground: Ground, ingest_id: int) -> int:
    """Read the other ingests of the vehicles of a withdrawn one again; return their number.

    Doing it again changes nothing.
    """
    with ground.database.listeners.held():
        with ground.database.writing() as connection:
            found = store.get_ingest(connection, ingest_id)
            vehicles = [] if found.accounting is None else list(found.accounting.vehicle_ids)
            for vehicle in vehicles:
                lock_vehicle(connection, vehicle)
                doubt_store.withdraw_packets(
                    connection, vehicle, telemetry.packets_before(connection, vehicle, 2**62, NO_TICKS)
                )
                store.forget_rest(connection, vehicle, ingest_id)
            others = store.ingests_of_vehicles(connection, vehicles, ingest_id)
        for other in others:
            ground.check_stopping()
            with suppress(InvalidInput, TmtcError):
                run_ingest(ground, other)
        with ground.database.writing() as connection:
            store.change_ingest(connection, ingest_id, "withdrawing", "withdrawn")
    return len(others)


def apply_definition(ground: Ground, vehicle: int) -> int:
    """Decode a vehicle's packets with the definitions in force for it; return the number of samples.

    Packets without a checksum that no earlier description declared are not stored yet: the raw files are read again.
    """
    stored = decode_declared(ground, vehicle, doubt_store.withdraw_doubted)
    with ground.database.reading() as connection:
        to_read = parameters.ingests_to_read(connection, vehicle)
    for ingest_id in to_read:
        ground.check_stopping()
        with suppress(InvalidInput, TmtcError):  # a file that is still no downlink
            run_ingest(ground, ingest_id)
    with ground.database.writing() as connection:
        parameters.note_read(connection, vehicle)
    return stored + decode_declared(ground, vehicle, doubt_store.withdraw_doubted)


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
            if not parameters.is_decoded(connection, one.id, definitions_in_force(connection, one.id)[0].digest)
        ]
