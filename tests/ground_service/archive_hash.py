"""One hash of everything a vehicle's archive holds, independent of the order in which it was filled."""

import hashlib
import struct

from sqlalchemy import select

from ground_service.store.repository import PACKETS, SAMPLES
from ground_service.store.vehicles import vehicle_id

_BOOKKEEPING = ("vehicle_id", "packet_id")


def hash_of(ground):
    """Return the hash of the archive of the spacecraft of the synthetic passes."""
    return ground.read(lambda connection: archive_hash(connection, vehicle_id(connection, 76, "flight")))


def archive_hash(connection, vehicle):
    """SHA-256 (hex) over the packets of a vehicle and all rows decoded from them, in an order of their content.

    Row numbers, times of arrival and the files that things came in are left out: they differ between two ways of
    ingesting the same octets, and nothing else may.
    """
    digest = hashlib.sha256()
    packets = (
        select(PACKETS.c.apid, PACKETS.c.ticks, PACKETS.c.sequence_count, PACKETS.c.digest, PACKETS.c.octets)
        .where(PACKETS.c.vehicle_id == vehicle)
        .order_by(PACKETS.c.apid, PACKETS.c.ticks, PACKETS.c.sequence_count, PACKETS.c.digest)
    )
    for row in connection.execute(packets):
        _update(digest, row)
    for name, table in sorted(SAMPLES.items()):
        digest.update(name.encode())
        values = [column for column in table.columns if column.name not in _BOOKKEEPING]
        rows = (
            select(PACKETS.c.digest, *values)
            .join(PACKETS, PACKETS.c.id == table.c.packet_id)
            .where(table.c.vehicle_id == vehicle)
            .order_by(table.c.dictionary_version, table.c.ticks, PACKETS.c.digest)
        )
        for row in connection.execute(rows):
            _update(digest, row)
    return digest.hexdigest()


def _update(digest, row):
    for value in row:
        if value is None or (isinstance(value, float) and value != value):
            digest.update(b"n")
        elif isinstance(value, (bytes, memoryview)):
            octets = bytes(value)
            digest.update(b"b" + struct.pack("<q", len(octets)) + octets)
        elif isinstance(value, float):
            digest.update(b"f" + struct.pack("<d", value))
        else:
            digest.update(b"i" + struct.pack("<q", int(value)))
    digest.update(b"|")
