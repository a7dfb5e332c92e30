"""Decoding of the archive with another dictionary: new rows are added to the old ones, packets are unchanged.

Every block of packets is one transaction with the note of how far it has come, so a re-decoding that is cut off goes on
where it was, and several at once share the work. Until it is complete, everything is read as the older version decoded
it. Packets that come in meanwhile are decoded by the ingest.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from sqlalchemy import Connection, delete, func, select

from ground_service.ground import Ground
from ground_service.ingest.packets import batch_of_cut
from ground_service.ingest.store import store_samples
from ground_service.store import repository
from ground_service.store.rollups import forget_rollups
from ground_service.store.vehicles import decoded_version
from tmtc.dictionary import DICTIONARY
from tmtc.schema import Dictionary
from tmtc.stream import whole_packets

BLOCK_PACKETS = 20_000


def redecode(ground: Ground, vehicle: int, dictionary: Dictionary) -> int:
    """Decode all packets of a vehicle with `dictionary`; how many rows that gave here.

    Rows that this dictionary version gave before are replaced, so running it again changes nothing.
    """
    with ground.database.writing() as connection:
        _begin(connection, _locked(connection, vehicle), dictionary.version)
    return _go_on(ground, vehicle, dictionary)


def redecode_all(ground: Ground) -> int:
    """Decode everything with the dictionary of this version; how many rows that gave."""
    with ground.database.reading() as connection:
        vehicles = list(connection.execute(select(repository.VEHICLES.c.id)).scalars())
    return sum(redecode(ground, int(vehicle), DICTIONARY) for vehicle in vehicles)


def catch_up(ground: Ground, vehicle: int) -> int:
    """Decode a vehicle that an older dictionary decoded with that of this version; how many rows that gave."""
    with ground.database.reading() as connection:
        if not _behind(repository.get(connection, repository.VEHICLES, vehicle, "vehicle")):
            return 0
    with ground.database.writing() as connection:
        row = _locked(connection, vehicle)
        if not _behind(row):
            return 0
        if row["redecoding_version"] != DICTIONARY.version:
            _begin(connection, row, DICTIONARY.version)
    return _go_on(ground, vehicle, DICTIONARY)


def note_dictionary(connection: Connection, vehicle: int) -> None:
    """Record the dictionary version that decodes packets, before they are stored in the same transaction.

    Packets of the vehicle that an older version decoded must be decoded again up to this point; later packets are
    already decoded. The row is locked only if something must be recorded, so that several transactions can store
    packets.
    """
    row = repository.get(connection, repository.VEHICLES, vehicle, "vehicle")
    if row["decoded_version"] is not None and not _behind(row):
        return
    row = _locked(connection, vehicle)
    if row["decoded_version"] is None:
        repository.change(connection, repository.VEHICLES, vehicle, decoded_version=DICTIONARY.version)
    elif _behind(row) and row["redecoding_version"] != DICTIONARY.version:
        _begin(connection, row, DICTIONARY.version)


def vehicles_behind(ground: Ground) -> list[int]:
    """Vehicles whose archive is not decoded with the dictionary of this version."""
    with ground.database.reading() as connection:
        rows = connection.execute(select(repository.VEHICLES)).mappings()
        return [int(row["id"]) for row in rows if _behind(dict(row))]


def redecode_job_id(vehicle: int) -> str:
    """Id of the job that decodes a vehicle with the dictionary of this version."""
    return hashlib.blake2b(f"redecode {vehicle} {DICTIONARY.version}".encode(), digest_size=16).hexdigest()


def _behind(row: repository.Row) -> bool:
    return row["decoded_version"] is not None and row["decoded_version"] < DICTIONARY.version


def _locked(connection: Connection, vehicle: int) -> repository.Row:
    table = repository.VEHICLES
    connection.execute(select(table.c.id).where(table.c.id == vehicle).with_for_update())
    return repository.get(connection, table, vehicle, "vehicle")


def _begin(connection: Connection, row: repository.Row, version: int) -> None:
    """Take away what this version gave, and note what is to be decoded: the packets that are there now."""
    vehicle, packets = row["id"], repository.PACKETS
    for table in repository.SAMPLES.values():
        connection.execute(
            delete(table).where(table.c.vehicle_id == vehicle, table.c.dictionary_version == version)
        )
    forget_rollups(connection, vehicle, version)
    last = connection.execute(select(func.max(packets.c.id)).where(packets.c.vehicle_id == vehicle)).scalar()
    repository.change(
        connection,
        repository.VEHICLES,
        vehicle,
        redecoding_version=version,
        redecoded_to=0,
        redecode_until=last or 0,
    )


def _go_on(ground: Ground, vehicle: int, dictionary: Dictionary) -> int:
    rows = 0
    while True:
        ground.check_stopping()
        with ground.database.writing() as connection:
            row = _locked(connection, vehicle)
            if row["redecoding_version"] != dictionary.version:
                return rows  # another process has finished it
            done = _block(connection, row, dictionary)
            if done is None:
                return rows
            rows += done


def _block(connection: Connection, row: repository.Row, dictionary: Dictionary) -> int | None:
    """Decode the next packets; None when there are none left, which ends the re-decoding."""
    vehicle, table = row["id"], repository.PACKETS
    block: Any = connection.execute(
        select(table.c.id, table.c.octets)
        .where(
            table.c.vehicle_id == vehicle,
            table.c.id > row["redecoded_to"],
            table.c.id <= row["redecode_until"],
        )
        .order_by(table.c.id)
        .limit(BLOCK_PACKETS)
    ).all()
    if not block:
        ended: dict[str, Any] = {"redecoding_version": None, "redecoded_to": None, "redecode_until": None}
        if dictionary.version == DICTIONARY.version:
            ended["decoded_version"] = dictionary.version
        repository.change(connection, repository.VEHICLES, vehicle, **ended)
        return None
    buffer = b"".join(bytes(octets) for _, octets in block)
    cut = whole_packets(np.array([len(octets) for _, octets in block], dtype=np.int64))
    batch = batch_of_cut(buffer, cut, dictionary)
    ids = np.array([key for key, _ in block], dtype=np.int64)
    rows = store_samples(connection, vehicle, dictionary.version, batch.rows, ids)
    repository.change(connection, repository.VEHICLES, vehicle, redecoded_to=int(ids[-1]))
    return rows


def readable_version(connection: Connection, vehicle: int) -> int:
    """The dictionary version that a vehicle is to be read in: an older one until all is decoded with this one."""
    return decoded_version(connection, vehicle, DICTIONARY.version)
