"""Ingest of a downlink file: the raw file is archived, its packets are stored once each, everything is accounted for.

The archive that results depends only on the octets that were ingested, not on their order, on how they were split into
files or on how often they came. An ingest that was cut off can simply be run again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection

from ground_service.clock import utc_now_ns
from ground_service.errors import PASSING, GroundError, InvalidInput
from ground_service.link.stream import DownlinkReader
from ground_service.services.ground import Ground
from ground_service.services.joining import join_with_others
from ground_service.services.recorrelation import recorrelate
from ground_service.services.redecode import catch_up, note_dictionary
from ground_service.services.window_progress import advance_windows
from ground_service.store import repository
from ground_service.store.files import StoredFile, read_blocks
from ground_service.store.packets import store_batch
from tmtc.dictionary import DICTIONARY
from tmtc.errors import TmtcError

FLOWN = "flight"
"""Instance of a spacecraft that telemetry belongs to when nothing else is said."""

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class IngestResult:
    """What one ingest found in its file, and what of it was new.

    `packets_joined` came about only together with files that were ingested before. `uplink` holds, for each spacecraft
    and telecommand channel that the frames tell of, what `tmtc.clcw.UplinkSeen` says.
    """

    ingest_id: int
    vehicle_id: int | None
    octets: int
    packets: int
    packets_new: int
    packets_joined: int
    packets_repeated: int
    samples: int
    crc_errors: int
    octets_skipped: int
    frames: int
    frames_bad: int
    symbols_corrected: int
    unknown: int
    uplink: tuple[dict[str, Any], ...] = ()


def ingest_file(
    ground: Ground,
    path: Path,
    *,
    spacecraft_id: int | None = None,
    instance: str = FLOWN,
    name: str | None = None,
) -> IngestResult:
    """Archive a downlink file and store what is in it.

    Parameters
    ----------
    spacecraft_id
        Whose the file is: frames of other spacecraft are left out. None takes the ids from the frames; bare packets
        carry none, so they need it.
    instance
        Which instance of the spacecraft the telemetry belongs to.

    Raises
    ------
    InvalidInput
        If the file cannot be read or holds nothing of a downlink.
    """
    if not path.is_file():
        raise InvalidInput(str(path), "", "a downlink file", "a folder" if path.is_dir() else "nothing there")
    stored = ground.files.put_file(path)
    return ingest_stored(
        ground, stored, spacecraft_id=spacecraft_id, instance=instance, name=name or path.name
    )


def ingest_stored(
    ground: Ground, stored: StoredFile, *, spacecraft_id: int | None = None, instance: str = FLOWN, name: str
) -> IngestResult:
    """Store what is in an archived downlink file; see `ingest_file`."""
    ingest_id = begin_ingest(ground, stored, name)
    return run_ingest(ground, ingest_id, spacecraft_id=spacecraft_id, instance=instance)


def begin_ingest(ground: Ground, stored: StoredFile, name: str) -> int:
    """Enter an archived file to be ingested; the id of the ingest."""
    with ground.database.writing() as connection:
        return add_ingest(connection, stored, name)


def add_ingest(connection: Connection, stored: StoredFile, name: str) -> int:
    """As `begin_ingest`, within the caller's transaction."""
    now = utc_now_ns()
    repository.register_file(connection, stored, "downlink", name, now)
    return int(
        repository.add(
            connection,
            repository.INGESTS,
            vehicle_id=None,
            file_sha256=stored.sha256,
            state="queued",
            dictionary_version=DICTIONARY.version,
            received_utc_ns=now,
            accounting={},
        )
    )


def run_ingest(
    ground: Ground,
    ingest_id: int,
    *,
    spacecraft_id: int | None = None,
    instance: str = FLOWN,
    progress: Progress | None = None,
) -> IngestResult:
    """Do what was entered with `begin_ingest`; running it again is harmless.

    `progress` is told the share of the file that is stored, several times where it is long.
    """
    with ground.database.writing() as connection:
        record = repository.get(connection, repository.INGESTS, ingest_id, "ingest")
        repository.change(connection, repository.INGESTS, ingest_id, state="running")
    path = ground.files.path(record["file_sha256"])
    try:
        reader = DownlinkReader(spacecraft_id)
        result = _store_stream(ground, ingest_id, reader, instance, record["file_sha256"], path, progress)
        if result.packets == 0 and result.frames == result.frames_bad:
            raise InvalidInput(
                _name(ground, record["file_sha256"]),
                "",
                "a stream of CADUs or of space packets",
                f"{result.octets} octets without a single good packet",
            )
    except PASSING:
        raise
    except (GroundError, TmtcError) as error:
        with ground.database.writing() as connection:
            repository.change(
                connection,
                repository.INGESTS,
                ingest_id,
                state="failed",
                error=str(error),
                finished_utc_ns=utc_now_ns(),
            )
        raise
    with ground.database.writing() as connection:
        repository.change(
            connection,
            repository.INGESTS,
            ingest_id,
            state="done",
            error=None,
            vehicle_id=result.vehicle_id,
            finished_utc_ns=utc_now_ns(),
            accounting=asdict(result),
        )
    return result


def _store_stream(
    ground: Ground,
    ingest_id: int,
    reader: DownlinkReader,
    instance: str,
    sha256: str,
    path: Path,
    progress: Progress | None,
) -> IngestResult:
    vehicles: dict[int, int] = {}
    new = samples = unknown = 0
    total = max(path.stat().st_size, 1)
    for batch in reader.batches(read_blocks(path)):
        ground.check_stopping()
        if len(batch) == 0 and (reader.edges is None or reader.edges.settings is None):
            continue
        if batch.spacecraft_id is None:
            raise InvalidInput("downlink of bare packets", "", "the id of their spacecraft", "none given")
        with ground.database.writing() as connection:
            if batch.spacecraft_id not in vehicles:
                vehicle = repository.vehicle_id(connection, batch.spacecraft_id, instance)
                note_dictionary(connection, vehicle)
                vehicles[batch.spacecraft_id] = vehicle
            stored = store_batch(connection, vehicles[batch.spacecraft_id], batch)
        new += stored.new
        samples += stored.samples
        unknown += batch.unknown
        if progress is not None:
            progress(reader.accounting.octets / total)
    joined = 0
    if reader.edges is not None:
        for spacecraft_id, vehicle in vehicles.items():
            with ground.database.writing() as connection:
                joined += join_with_others(
                    connection, ground.files, vehicle, spacecraft_id, sha256, reader.edges
                )
    for vehicle in vehicles.values():
        catch_up(ground, vehicle)
        if not recorrelate(ground, vehicle) and new + joined:
            advance_windows(ground, vehicle)
    found = reader.accounting
    return IngestResult(
        ingest_id=ingest_id,
        vehicle_id=next(iter(vehicles.values()), None),
        octets=found.octets,
        packets=found.packets,
        packets_new=new + joined,
        packets_joined=joined,
        packets_repeated=found.packets - new,
        samples=samples,
        crc_errors=found.crc_errors,
        octets_skipped=found.octets_skipped,
        frames=found.frames,
        frames_bad=found.frames_bad,
        symbols_corrected=found.symbols_corrected,
        unknown=unknown,
        uplink=tuple(
            {"spacecraft_id": spacecraft_id, **asdict(seen)}
            for (spacecraft_id, _), seen in sorted(found.uplink.items())
        ),
    )


def _name(ground: Ground, sha256: str) -> str:
    with ground.database.reading() as connection:
        return str(repository.get(connection, repository.FILES, sha256, "file")["name"])
