"""Decoding of the archive with another dictionary: new rows are added to the old ones, packets are unchanged.

Every block of packets is one transaction with the note of how far it has come, so a re-decoding that is cut off goes on
where it was, and several at once share the work. Until it is complete, everything is read as the older version decoded
it. Packets that come in meanwhile are decoded by the ingest.
"""

from __future__ import annotations

import hashlib

import numpy as np
from sqlalchemy import Connection

from ground_service.ground import Ground
from ground_service.ingest import store
from ground_service.ingest.packets import batch_of_cut
from ground_service.store.parameters import last_packet
from ground_service.store.vehicles import (
    Vehicle,
    all_vehicles,
    change_vehicle,
    decoded_version,
    get_vehicle,
    lock_vehicle,
)
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import Dictionary
from tmtc.packets.stream import whole_packets

BLOCK_PACKETS = 20_000


def redecode(ground: Ground, vehicle: int, dictionary: Dictionary) -> int:
    """Decode all packets of a vehicle with `dictionary`; how many rows that gave here.

    Rows that this dictionary version gave before are replaced, so running it again changes nothing.
    """
    with ground.database.writing() as connection:
        lock_vehicle(connection, vehicle)
        _begin(connection, vehicle, dictionary.version)
    return _go_on(ground, vehicle, dictionary)


def catch_up(ground: Ground, vehicle: int) -> int:
    """Decode a vehicle that an older dictionary decoded with that of this version; how many rows that gave."""
    with ground.database.reading() as connection:
        if not _behind(get_vehicle(connection, vehicle)):
            return 0
    with ground.database.writing() as connection:
        found = lock_vehicle(connection, vehicle)
        if not _behind(found):
            return 0
        if found.redecoding_version != DICTIONARY.version:
            _begin(connection, vehicle, DICTIONARY.version)
    return _go_on(ground, vehicle, DICTIONARY)


def note_dictionary(connection: Connection, vehicle: int) -> None:
    """Record the dictionary version that decodes packets, before they are stored in the same transaction.

    Packets of the vehicle that an older version decoded must be decoded again up to this point; later packets are
    already decoded. The row is locked only if something must be recorded, so that several transactions can store
    packets.
    """
    found = get_vehicle(connection, vehicle)
    if found.decoded_version is not None and not _behind(found):
        return
    found = lock_vehicle(connection, vehicle)
    if found.decoded_version is None:
        change_vehicle(connection, vehicle, decoded_version=DICTIONARY.version)
    elif _behind(found) and found.redecoding_version != DICTIONARY.version:
        _begin(connection, vehicle, DICTIONARY.version)


def vehicles_behind(ground: Ground) -> list[int]:
    """Vehicles whose archive is not decoded with the dictionary of this version."""
    with ground.database.reading() as connection:
        return [one.id for one in all_vehicles(connection) if _behind(one)]


def redecode_job_id(vehicle: int) -> str:
    """Id of the job that decodes a vehicle with the dictionary of this version."""
    return hashlib.blake2b(f"redecode {vehicle} {DICTIONARY.version}".encode(), digest_size=16).hexdigest()


def _behind(vehicle: Vehicle) -> bool:
    return vehicle.decoded_version is not None and vehicle.decoded_version < DICTIONARY.version


def _begin(connection: Connection, vehicle: int, version: int) -> None:
    """Take away what this version gave, and note what is to be decoded: the packets that are there now."""
    store.forget_samples(connection, vehicle, version)
    last = last_packet(connection, vehicle)
    change_vehicle(connection, vehicle, redecoding_version=version, redecoded_to=0, redecode_until=last)


def _go_on(ground: Ground, vehicle: int, dictionary: Dictionary) -> int:
    rows = 0
    while True:
        ground.check_stopping()
        with ground.database.writing() as connection:
            found = lock_vehicle(connection, vehicle)
            if found.redecoding_version != dictionary.version:
                return rows  # another process has finished it
            done = _block(connection, found, dictionary)
            if done is None:
                return rows
            rows += done


def _block(connection: Connection, vehicle: Vehicle, dictionary: Dictionary) -> int | None:
    """Decode the next packets; None when there are none left, which ends the re-decoding."""
    ids, packets = store.packets_between(
        connection, vehicle.id, vehicle.redecoded_to or 0, vehicle.redecode_until or 0, BLOCK_PACKETS
    )
    if not packets:
        ended: dict[str, int | None] = dict.fromkeys(("redecoding_version", "redecoded_to", "redecode_until"))
        if dictionary.version == DICTIONARY.version:
            ended["decoded_version"] = dictionary.version
        change_vehicle(connection, vehicle.id, **ended)
        return None
    cut = whole_packets(np.array([len(octets) for octets in packets], dtype=np.int64))
    batch = batch_of_cut(b"".join(packets), cut, dictionary)
    rows = store.store_samples(connection, vehicle.id, dictionary.version, batch.rows, ids)
    change_vehicle(connection, vehicle.id, redecoded_to=int(ids[-1]))
    return rows


def readable_version(connection: Connection, vehicle: int) -> int:
    """The dictionary version that a vehicle is to be read in: an older one until all is decoded with this one."""
    return decoded_version(connection, vehicle, DICTIONARY.version)
