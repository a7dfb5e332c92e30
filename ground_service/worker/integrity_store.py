"""SQL of the integrity check: stored and derived rows in the order of keys that do not depend on row numbers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, and_, func, insert, select, text
from sqlalchemy import Table as Table

from ground_service.errors import InvalidInput
from ground_service.store import repository
from ground_service.store.vehicles import vehicle_id
from tmtc.dictionary import DICTIONARY

SAMPLES = repository.SAMPLES
PARAMETER_SAMPLES = repository.PARAMETER_SAMPLES
DERIVED = (repository.PACKETS, PARAMETER_SAMPLES, *SAMPLES.values())
"""Tables whose rows follow from the raw files."""

FETCHED_ROWS = 20_000
_PACKETS = repository.PACKETS

Keyed = Iterator[tuple[tuple[Any, ...], tuple[Any, ...]]]
"""Rows as keys and other values, in the order of the keys."""


@dataclass(frozen=True, slots=True)
class RecordedIngest:
    """Ingest with its file, its vehicle, and the statements of the sender; None: not recorded."""

    id: int
    sha256: str
    state: str
    ccsds_id: int | None
    instance: str | None
    name: str
    octets: int
    scope: str | None
    spacecraft_id: int | None
    stream: str | None
    position: int | None
    station: str | None
    link: str | None


def database_faults(connection: Connection) -> list[str]:
    """Return the faults that SQLite finds in its file; PostgreSQL has no such check."""
    if connection.dialect.name != "sqlite":
        return []
    lines = connection.execute(text("PRAGMA integrity_check")).scalars()
    return [str(line) for line in lines if line != "ok"]


def dangling_references(connection: Connection) -> list[tuple[str, Any, str]]:
    """Return table, row number and referenced table of foreign keys without a row; PostgreSQL permits none."""
    if connection.dialect.name != "sqlite":
        return []
    return [
        (str(row[0]), row[1], str(row[2])) for row in connection.execute(text("PRAGMA foreign_key_check"))
    ]


def count_rows(connection: Connection, table: Table) -> int:
    """Return the number of rows of a table."""
    return int(connection.execute(select(func.count()).select_from(table)).scalar_one())


def files(connection: Connection) -> list[tuple[str, int]]:
    """Return hash and octets of the files of the archive."""
    table = repository.FILES
    rows = connection.execute(select(table.c.sha256, table.c.octets).order_by(table.c.sha256))
    return [(sha256, int(octets)) for sha256, octets in rows]


def copy_missions(connection: Connection, writing: Connection) -> None:
    """Copy the mission descriptions to a scratch archive: they declare links and packets.

    The passes of archives are copied, too: the descriptions of archives hold for the instances of these passes.
    """
    missions, passes, vehicles = repository.MISSIONS, repository.PASSES, repository.VEHICLES
    rows = connection.execute(select(missions)).mappings().all()
    if rows:
        writing.execute(insert(missions), [dict(row) for row in rows])
    query = (
        select(passes, vehicles.c.ccsds_id, vehicles.c.instance)
        .join(vehicles, vehicles.c.id == passes.c.vehicle_id)
        .where(passes.c.archive_digest.is_not(None), passes.c.mission_id.in_(select(missions.c.id)))
        .order_by(passes.c.id)
    )
    for row in connection.execute(query).mappings().all():
        kept = {column.name: row[column] for column in passes.c if not column.name.endswith("_sha256")}
        with suppress(InvalidInput):  # a vehicle that is not valid is reported when its packets are decoded
            vehicle = vehicle_id(writing, row["ccsds_id"], row["instance"])
            kept |= {"vehicle_id": vehicle, "ephemeris_id": None}
            writing.execute(insert(passes).values(kept))


def recorded_ingests(connection: Connection) -> list[RecordedIngest]:
    """Return all ingests, oldest first."""
    ingests, vehicles, stored, pieces = (
        repository.INGESTS,
        repository.VEHICLES,
        repository.FILES,
        repository.PIECES,
    )
    query = (
        select(
            ingests.c.id,
            ingests.c.file_sha256.label("sha256"),
            ingests.c.state,
            vehicles.c.ccsds_id,
            vehicles.c.instance,
            func.coalesce(stored.c.name, "").label("name"),
            func.coalesce(stored.c.octets, 0).label("octets"),
            pieces.c.scope,
            pieces.c.spacecraft_id,
            pieces.c.stream,
            pieces.c.position,
            pieces.c.station,
            pieces.c.link,
        )
        .outerjoin(pieces, pieces.c.ingest_id == ingests.c.id)
        .outerjoin(vehicles, vehicles.c.id == ingests.c.vehicle_id)
        .outerjoin(stored, stored.c.sha256 == ingests.c.file_sha256)
        .order_by(ingests.c.id)
    )
    return [RecordedIngest(**row) for row in connection.execute(query).mappings()]


def packet_blocks(
    connection: Connection, vehicle: int, limit: int
) -> Iterator[list[tuple[int, bytes, bytes]]]:
    """Yield id, digest and octets of the packets of a vehicle in blocks, in the order of their ids."""
    last = 0
    while True:
        rows = connection.execute(
            select(_PACKETS.c.id, _PACKETS.c.digest, _PACKETS.c.octets)
            .where(_PACKETS.c.vehicle_id == vehicle, _PACKETS.c.id > last)
            .order_by(_PACKETS.c.id)
            .limit(limit)
        )
        block = [(int(key), bytes(digest), bytes(octets)) for key, digest, octets in rows]
        if not block:
            return
        yield block
        last = block[-1][0]


def rows_of_others(connection: Connection, table: Table, vehicles: Collection[int]) -> list[tuple[int, int]]:
    """Return vehicle and number of the rows of other vehicles."""
    query = (
        select(table.c.vehicle_id, func.count())
        .where(table.c.vehicle_id.not_in(list(vehicles)))
        .group_by(table.c.vehicle_id)
    )
    return [(int(vehicle), int(count)) for vehicle, count in connection.execute(query)]


def rows_of_other_versions(connection: Connection, table: Table) -> list[tuple[int, int]]:
    """Return version and number of the rows of other dictionary versions; none of a table without versions."""
    if "dictionary_version" not in table.c:
        return []
    query = (
        select(table.c.dictionary_version, func.count())
        .where(table.c.dictionary_version != DICTIONARY.version)
        .group_by(table.c.dictionary_version)
    )
    return [(int(version), int(count)) for version, count in connection.execute(query)]


def missing_packets(connection: Connection, table: Table, vehicle: int) -> list[tuple[int, int]]:
    """Return the packets of a vehicle that rows reference but that are missing, and the number of these rows."""
    query = (
        select(table.c.packet_id, func.count())
        .outerjoin(_PACKETS, and_(_PACKETS.c.id == table.c.packet_id, _PACKETS.c.vehicle_id == vehicle))
        .where(table.c.vehicle_id == vehicle, _PACKETS.c.id.is_(None))
        .group_by(table.c.packet_id)
        .order_by(table.c.packet_id)
    )
    return [(int(packet), int(count)) for packet, count in connection.execute(query)]


def values_by_definition(connection: Connection, vehicle: int) -> dict[int, int]:
    """Return the number of values of declared packets of a vehicle by definition."""
    table = PARAMETER_SAMPLES
    query = select(table.c.definition_id, func.count()).where(table.c.vehicle_id == vehicle)
    rows = connection.execute(query.group_by(table.c.definition_id))
    return {int(definition): int(count) for definition, count in rows}


def definition_digests(connection: Connection) -> dict[int, str]:
    """Return the digests of the definitions of packets."""
    table = repository.PACKET_DEFINITIONS
    return {int(key): str(digest) for key, digest in connection.execute(select(table.c.id, table.c.digest))}


def decoded_to(connection: Connection, vehicle: int) -> dict[int, int]:
    """Return the last decoded packet of a vehicle by definition."""
    table = repository.PACKET_DECODINGS
    query = select(table.c.definition_id, table.c.decoded_to).where(table.c.vehicle_id == vehicle)
    return {int(definition): int(last) for definition, last in connection.execute(query)}


def pending_packets(connection: Connection, vehicle: int, last: int) -> set[bytes]:
    """Return the digests of packets that are stored but not yet decoded."""
    query = select(_PACKETS.c.digest).where(_PACKETS.c.vehicle_id == vehicle, _PACKETS.c.id > last)
    return {bytes(digest) for digest in connection.execute(query).scalars()}


def packets(connection: Connection, vehicle: int) -> Keyed:
    """Return the packets of a vehicle."""
    names = ("apid", "ticks", "sequence_count", "digest")
    query = (
        select(*(_PACKETS.c[name] for name in names), _PACKETS.c.octets)
        .where(_PACKETS.c.vehicle_id == vehicle)
        .order_by(*(_PACKETS.c[name] for name in names))
    )
    return _keyed(connection, query, len(names))


def values(connection: Connection, table: Table, vehicle: int) -> Keyed:
    """Return the samples of a vehicle that this version's dictionary has decoded, by time and packet."""
    kept = [column for column in table.columns if column.name not in ("vehicle_id", "packet_id", "ticks")]
    query = _with_digest(table, kept).where(
        table.c.vehicle_id == vehicle, table.c.dictionary_version == DICTIONARY.version
    )
    return _keyed(connection, query.order_by(table.c.ticks, func.coalesce(_PACKETS.c.digest, b"")), 2)


def parameter_values(connection: Connection, vehicle: int, definition: int) -> Keyed:
    """Return the values that a definition has decoded from the packets of a vehicle."""
    table = PARAMETER_SAMPLES
    query = _with_digest(table, [table.c.container, table.c["values"]]).where(
        table.c.vehicle_id == vehicle, table.c.definition_id == definition
    )
    order = (table.c.ticks, func.coalesce(_PACKETS.c.digest, b""), table.c.container)
    return _keyed(connection, query.order_by(*order), 3)


def _with_digest(table: Table, columns: Iterable[Any]) -> Any:
    same = and_(_PACKETS.c.id == table.c.packet_id, _PACKETS.c.vehicle_id == table.c.vehicle_id)
    return select(table.c.ticks, _PACKETS.c.digest, *columns).outerjoin(_PACKETS, same)


def _keyed(connection: Connection, query: Any, key_columns: int) -> Keyed:
    rows: Iterable[Any] = connection.execution_options(yield_per=FETCHED_ROWS).execute(query)
    for row in rows:
        found = tuple(bytes(value) if isinstance(value, memoryview) else value for value in row)
        key = tuple(b"" if value is None else value for value in found[:key_columns])
        yield key, found[key_columns:]
