"""Decoding the archive again with another dictionary: its rows stand beside the old ones, packets stay as they are."""

from __future__ import annotations

from typing import Any

import numpy as np
from sqlalchemy import delete, select

from ground_service.link.packets import batch_of_cut
from ground_service.services.ground import Ground
from ground_service.store import repository
from ground_service.store.packets import store_samples
from ground_service.store.rollups import forget_rollups
from tmtc.dictionary import DICTIONARY
from tmtc.schema import Dictionary
from tmtc.stream import cut_packets

BLOCK_PACKETS = 20_000


def redecode(ground: Ground, vehicle: int, dictionary: Dictionary) -> int:
    """Decode all packets of a vehicle with `dictionary`; how many rows that gave.

    Rows that this dictionary version gave before are replaced, so running it again changes nothing.
    """
    with ground.database.writing() as connection:
        for table in repository.SAMPLES.values():
            connection.execute(
                delete(table).where(
                    table.c.vehicle_id == vehicle, table.c.dictionary_version == dictionary.version
                )
            )
        forget_rollups(connection, vehicle, dictionary.version)
    rows = 0
    last = 0
    table: Any = repository.PACKETS
    while True:
        with ground.database.writing() as connection:
            block = connection.execute(
                select(table.c.id, table.c.octets)
                .where(table.c.vehicle_id == vehicle, table.c.id > last)
                .order_by(table.c.id)
                .limit(BLOCK_PACKETS)
            ).all()
            if not block:
                return rows
            buffer = b"".join(bytes(row[1]) for row in block)
            batch = batch_of_cut(buffer, cut_packets(buffer), dictionary)
            ids = np.array([row[0] for row in block], dtype=np.int64)
            rows += store_samples(connection, vehicle, dictionary.version, batch.rows, ids)
            last = int(ids[-1])


def redecode_all(ground: Ground) -> int:
    """Decode everything with the dictionary of this version; how many rows that gave."""
    with ground.database.reading() as connection:
        vehicles = list(connection.execute(select(repository.VEHICLES.c.id)).scalars())
    return sum(redecode(ground, int(vehicle), DICTIONARY) for vehicle in vehicles)
