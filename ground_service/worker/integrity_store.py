"""SQL of the integrity check: derived rows in the order of keys that do not depend on row numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy import Connection, and_, func, literal, select, text
from sqlalchemy import Table as Table

from ground_service.store import models
from ground_service.store.rollups import PARAMETERS_CODE
from ground_service.store.rows import insert_rows, row_blocks
from ground_service.store.vehicles import FLOWN
from tmtc.dictionary.payload import DICTIONARY

DERIVED = (models.PACKETS, models.PARAMETER_SAMPLES, *models.SAMPLE_TABLES, models.ROLLUPS)
"""Tables whose rows follow from the raw files."""

ENTERED = (
    models.FILES, models.VEHICLES, models.INGESTS, models.PIECES, models.MISSIONS, models.EPHEMERIDES,
    models.PASSES, models.RECEPTIONS, models.PACKET_DEFINITIONS, models.IMPLAUSIBLE_PACKETS,
)  # fmt: skip
"""Tables that decide what follows from the raw files."""

COUNTS = ("packets_stored", "packets_joined", "samples_stored")
"""Columns of a piece that count what it gave."""

FETCHED_ROWS = 20_000
ROUNDING = 1e-9
"""Relative difference of two sums of the same numbers in another order."""

_PACKETS: Any = models.PACKETS

Row = tuple[tuple[Any, ...], tuple[Any, ...]]
Rows = Iterator[Row]
"""Keys and other values, in the order of the keys."""

Excuse = Callable[[Table, tuple[Any, ...], bool, bool], str | None]
"""Reason why a row of this key, stored or not and derived or not, may differ; None: it may not."""


class RecordedIngest(NamedTuple):
    """Ingest as recorded."""

    id: int
    sha256: str
    state: str


def database_faults(connection: Connection) -> list[str]:
    """Return the faults that SQLite finds in its file; PostgreSQL has no such check."""
    if connection.dialect.name != "sqlite":
        return []
    lines = connection.execute(text("PRAGMA integrity_check")).scalars()
    return [str(line) for line in lines if line != "ok"]


def dangling_references(connection: Connection) -> Iterator[tuple[str, Any, str]]:
    """Yield table, key and referenced table of foreign keys without a row."""
    for table in models.METADATA.sorted_tables:
        for reference in table.foreign_keys:
            parent = reference.column.table
            other = parent.alias()
            found = other.c[reference.column.name]
            query = (
                select(*table.primary_key)
                .outerjoin_from(table, other, found == reference.parent)
                .where(reference.parent.is_not(None), found.is_(None))
            )
            for key in connection.execute(query):
                yield table.name, " ".join(map(str, key)), parent.name


def files(connection: Connection) -> list[tuple[str, int]]:
    """Return hash and octets of the files of the archive."""
    table = models.FILES
    rows = connection.execute(select(table.c.sha256, table.c.octets).order_by(table.c.sha256))
    return [(sha256, int(octets)) for sha256, octets in rows]


def packets(connection: Connection) -> Iterator[tuple[int, bytes, bytes]]:
    """Yield id, digest and octets of all packets."""
    query = select(_PACKETS.c.id, _PACKETS.c.digest, _PACKETS.c.octets)
    for key, digest, octets in connection.execution_options(yield_per=FETCHED_ROWS).execute(query):
        yield int(key), bytes(digest), bytes(octets)


def ingests(connection: Connection) -> list[RecordedIngest]:
    """Return all ingests, oldest first."""
    table = models.INGESTS
    query = select(table.c.id, table.c.file_sha256, table.c.state).order_by(table.c.id)
    return [RecordedIngest(*row) for row in connection.execute(query)]


def copy_entered(connection: Connection, writing: Connection) -> None:
    """Copy the rows that decide what follows from the raw files, with their keys, to an empty database."""
    for table in models.METADATA.sorted_tables:
        if table in ENTERED:
            insert_rows(writing, table, row_blocks(connection, table))
    ingests, pieces, vehicles, stored = models.INGESTS, models.PIECES, models.VEHICLES, models.FILES
    # Ingests before version 1.0 have no piece: what their sender stated is not known.
    piece = {
        "ingest_id": ingests.c.id,
        "scope": func.coalesce(vehicles.c.instance, FLOWN),
        "spacecraft_id": vehicles.c.ccsds_id,
        "file_sha256": ingests.c.file_sha256,
        "octets": stored.c.octets,
        "stream": literal(""),
        "position": ingests.c.id,
        "station": literal(""),
    }
    query = (
        select(*piece.values(), *(literal(0) for _ in COUNTS))
        .join(stored, stored.c.sha256 == ingests.c.file_sha256)
        .outerjoin(vehicles, vehicles.c.id == ingests.c.vehicle_id)
        .where(ingests.c.id.not_in(select(pieces.c.ingest_id)))
    )
    writing.execute(pieces.insert().from_select([*piece, *COUNTS], query))
    fresh = ("decoded_version", "redecoding_version", "redecoded_to", "redecode_until")
    writing.execute(vehicles.update().values(dict.fromkeys(fresh)))
    writing.execute(pieces.update().values(waits=None, **dict.fromkeys(COUNTS, 0)))


def rows(connection: Connection, table: Table) -> Rows:
    """Return the rows of a derived table; the digest of its packet stands for the number of a packet."""
    if table is _PACKETS:
        key = [table.c[name] for name in ("vehicle_id", "apid", "ticks", "sequence_count", "digest")]
        query = select(*key, table.c.octets).order_by(*key)
    elif "packet_id" in table.c:
        key = [one for one in table.primary_key if one.name != "packet_id"]
        others = [one for one in table.c if not one.primary_key]
        same = and_(_PACKETS.c.id == table.c.packet_id, _PACKETS.c.vehicle_id == table.c.vehicle_id)
        query = select(*key, _PACKETS.c.digest, *others).outerjoin(_PACKETS, same).order_by(*key)
        key.append(_PACKETS.c.digest)
    else:
        key = list(table.primary_key)
        query = select(*key, *(one for one in table.c if not one.primary_key)).order_by(*key)
    size = len(key)
    found = (
        tuple(bytes(value) if isinstance(value, memoryview) else value for value in row)
        for row in connection.execution_options(yield_per=FETCHED_ROWS).execute(query)
    )
    # The digest is the last part of a key: an index gives the order of the others.
    for _, together in groupby(found, key=lambda row: row[: size - 1]):
        keyed = (
            ((*row[: size - 1], b"" if row[size - 1] is None else row[size - 1]), row[size:])
            for row in together
        )
        yield from sorted(keyed, key=lambda one: one[0])


def same_values(table: Table, stored: Row | None, derived: Row | None) -> bool:
    """Return whether two rows agree; sums of roll-ups up to the order of addition."""
    if stored is None or derived is None or table is not models.ROLLUPS:
        return stored == derived
    *counts, statistics = stored[1]
    *others, expected = derived[1]
    if counts != others or len(statistics) != len(expected):
        return False
    found, made = np.frombuffer(statistics, "<f8"), np.frombuffer(expected, "<f8")
    extremes = np.abs(made.reshape(-1, 4)[:, 2:])
    scale = np.where(np.isfinite(extremes), extremes, 0.0).max(axis=1) * made[0::4]
    is_sum = np.arange(len(made)) % 4 == 1
    close = np.abs(found[1::4] - made[1::4]) <= ROUNDING * scale
    return bool(close.all()) and found[~is_sum].tobytes() == made[~is_sum].tobytes()


def excuses(connection: Connection, made: Connection) -> Excuse:
    """Return the function that says why a row may differ: it is not decoded yet, or by an earlier definition."""
    vehicles, decodings = models.VEHICLES, models.PACKET_DECODINGS
    older = vehicles.c.decoded_version < DICTIONARY.version
    behind = set(connection.execute(select(vehicles.c.id).where(older)).scalars())
    newest_packet = select(_PACKETS.c.vehicle_id, func.max(_PACKETS.c.id)).group_by(_PACKETS.c.vehicle_id)
    last = {int(row[0]): int(row[1]) for row in connection.execute(newest_packet)}
    columns = select(decodings.c.vehicle_id, decodings.c.definition_id, decodings.c.decoded_to)
    decoded = {(one, other): to for one, other, to in connection.execute(columns)}
    newest = {(one, other) for one, other, _ in made.execute(columns)}

    def excuse(table: Table, key: tuple[Any, ...], stored: bool, derived: bool) -> str | None:
        rolled = table is models.ROLLUPS
        if table is _PACKETS:
            return None
        vehicle, version = key[:2]
        if table is models.PARAMETER_SAMPLES or (rolled and key[2] == PARAMETERS_CODE):
            to = decoded.get((vehicle, version))
            if stored and not derived and to is not None and (vehicle, version) not in newest:
                return "decoded with an earlier mission description"
            is_pending = to < last.get(vehicle, 0) if to is not None else not stored
            return "not yet decoded" if is_pending and (rolled or not stored) else None
        if version < DICTIONARY.version and not derived:
            return f"decoded with dictionary version {version}"
        return "not yet decoded" if vehicle in behind and not stored else None

    return excuse
