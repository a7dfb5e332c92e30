"""Integrity check of an archive: raw files, packets, the audit chain and the database itself.

With `rebuild`, what follows from the raw files is derived again in a scratch database and compared. Entered rows
(users, windows, telecommands) follow from nothing and are not checked; a backup has a digest of each table. A person
who can write to the database can forge the chain; a head of the chain that was stored elsewhere detects that.
"""

import hashlib
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import Connection, and_, func, literal, select, text
from sqlalchemy import Table as Table

from ground_service.errors import GroundError
from ground_service.ground import Ground
from ground_service.ingest.service import run_ingest
from ground_service.missions.timekeeping.core import utc_ns_of_ticks
from ground_service.missions.timekeeping.recorrelation import AUTOMATIC, recorrelate
from ground_service.missions.timekeeping.store import correlations_in_force, load_correlations
from ground_service.store import audit, events, models
from ground_service.store.database import prepare_database
from ground_service.store.files import FileArchive
from ground_service.store.rows import insert_rows, row_blocks
from ground_service.store.vehicles import FLOWN, all_vehicles
from ground_service.telemetry.decoding import decode_declared
from ground_service.telemetry.packets import DIGEST_OCTETS
from ground_service.telemetry.rollups import PARAMETERS_CODE
from ground_service.worker.follow_up import CONSUMER
from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import TmtcError
from tmtc.packets.space_packets import PRIMARY_HEADER_LENGTH

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


def stored_files(connection: Connection) -> list[tuple[str, int]]:
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
        keyed = (((*row[: size - 1], b"" if row[size - 1] is None else row[size - 1]), row[size:]) for row in together)
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


LIMIT_OF_A_KIND = 200
"""Largest number of listed damages of each kind; the rest is only counted."""

SAME_TIME_NS = 1000
"""Difference of two time correlations that rounding can cause; the on-board clock counts steps of 15,259 ns."""

Say = Callable[[str], None]


class Damage(BaseModel):
    """Damaged or missing item of the archive."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: str = Field(description="Table, or files, audit, schema")
    key: str = Field(description="Row, file or entry")
    reason: str


class Verification(BaseModel):
    """Result of an integrity check."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    checked: dict[str, int] = Field(description="Rows, files and entries checked, by kind")
    unchecked: dict[str, int] = Field(description="Number of unchecked items, by reason")
    damaged: list[Damage]
    damaged_total: int = Field(description="Number of all damages, including unlisted ones")
    verdict: Literal["intact", "damaged"]
    audit_head: str | None = Field(description="NUMBER:SHA256 of the newest audit entry")


class _Findings:
    def __init__(self) -> None:
        self.checked: dict[str, int] = {}
        self.unchecked: dict[str, int] = {}
        self.damaged: list[Damage] = []
        self.counts: dict[str, int] = {}

    def count(self, kind: str, number: int = 1) -> None:
        self.checked[kind] = self.checked.get(kind, 0) + number

    def skip(self, reason: str) -> None:
        self.unchecked[reason] = self.unchecked.get(reason, 0) + 1

    def damage(self, kind: str, key: object, reason: str) -> None:
        self.counts[kind] = self.counts.get(kind, 0) + 1
        if self.counts[kind] <= LIMIT_OF_A_KIND:
            self.damaged.append(Damage(kind=kind, key=str(key), reason=reason))


def verify(
    ground: Ground, *, rebuild: bool = False, heads: Sequence[audit.Head] = (), say: Say | None = None
) -> Verification:
    """Check the integrity of an archive, in one snapshot of the database, without changes.

    Parameters
    ----------
    rebuild
        Ingest all raw files again into a scratch database and compare what is derived from them.
    heads
        Heads of the audit chain that were stored elsewhere: their entries must be in the chain.
    """
    found = _Findings()
    tell = say or (lambda _text: None)
    with ground.database.snapshot() as connection:
        tell("database")
        _check_database(connection, found)
        tell("audit chain")
        head = _check_audit(connection, heads, found)
        tell("files")
        good = _check_files(connection, ground.files, found)
        tell("packets")
        _check_packets(connection, found)
        if rebuild:
            tell("derivation from the raw files")
            _rebuild(connection, ground, good, found)
    total = sum(found.counts.values())
    return Verification(
        checked=dict(sorted(found.checked.items())),
        unchecked=found.unchecked,
        damaged=found.damaged,
        damaged_total=total,
        verdict="damaged" if total else "intact",
        audit_head=f"{head.number}:{head.sha256}" if head is not None else None,
    )


def _check_database(connection: Connection, found: _Findings) -> None:
    for name in audit.missing_guards(connection):
        found.damage("schema", name, "expected this trigger of the audit table, found none")
    for line in database_faults(connection):
        found.damage("schema", "linna.db", line)
    for table, key, parent in dangling_references(connection):
        found.damage(table, key, f"expected the row of {parent} that it names, found none")


def _check_audit(connection: Connection, heads: Sequence[audit.Head], found: _Findings) -> audit.Head | None:
    found.count("audit", audit.count_entries(connection))
    for broken in audit.broken_entries(connection):
        found.damage("audit", broken.number, broken.reason)
    for head in heads:
        stored = audit.read_entry_sha256(connection, head.number)
        if head.number > 0 and stored != head.sha256:
            what = "another" if stored is not None else "none"
            found.damage("audit", head.number, f"expected the entry of the stored head, found {what}")
    return audit.read_head(connection)


def _check_files(connection: Connection, files: FileArchive, found: _Findings) -> set[str]:
    """Check every file against its row; return the hashes of undamaged files."""
    good, known = set(), set()
    for sha256, octets in stored_files(connection):
        known.add(sha256)
        found.count("octets of files", octets)
        size = files.octets(sha256)
        if size is None:
            found.damage("files", sha256, "expected the file, found nothing")
        elif size != octets:
            found.damage("files", sha256, f"expected {octets} octets, found {size}")
        elif _sha256(files.blocks(sha256)) != sha256:
            found.damage("files", sha256, "expected octets with this SHA-256, found other octets")
        else:
            good.add(sha256)
    for name, in_place in files.names():
        if name in known:
            continue
        if in_place and _sha256(files.blocks(name)) == name:
            found.skip("files without a row, left by interrupted uploads")
        else:
            found.damage("files", name[:80], "expected no such file in the archive, found one")
    return good


def _sha256(blocks: Iterable[bytes]) -> str:
    digest = hashlib.sha256()
    for block in blocks:
        digest.update(block)
    return digest.hexdigest()


def _check_packets(connection: Connection, found: _Findings) -> None:
    for key, digest, octets in packets(connection):
        found.count("packets")
        if hashlib.blake2b(octets, digest_size=DIGEST_OCTETS).digest() != digest:
            found.damage("packets", key, "expected octets that match its digest, found other octets")
        elif PRIMARY_HEADER_LENGTH + 1 + int.from_bytes(octets[4:6], "big") != len(octets):
            found.damage("packets", key, "expected the length of its header, found another")


# What is derived


def _rebuild(connection: Connection, ground: Ground, good: set[str], found: _Findings) -> None:
    if found.counts.keys() - {"files", "packets", "audit"}:
        found.skip("derived rows, because the database is damaged")
        return
    with _scratch(ground) as scratch:
        with scratch.database.writing() as writing:
            copy_entered(connection, writing)
        for one in ingests(connection):
            ground.check_stopping()
            if one.state == "withdrawn":
                continue
            if one.state not in ("done", "failed"):
                found.skip("unfinished ingests")
            elif one.sha256 in good:
                found.count("raw files ingested again")
                try:
                    run_ingest(scratch, one.id, judged=True)
                except (GroundError, TmtcError) as error:
                    if one.state == "done":
                        reason = f"expected a file that can be ingested, found: {error}"
                        found.damage("ingests", one.id, reason)
        for vehicle in all_vehicles(connection):
            try:
                decode_declared(scratch, vehicle.id)
            except (GroundError, TmtcError) as error:
                reason = f"expected a usable mission description, found: {error}"
                found.damage("missions", f"spacecraft {vehicle.ccsds_id}", reason)
            _compare_times(connection, scratch, vehicle.id, found)
        with scratch.database.reading() as made:
            excuse = excuses(connection, made)
            for table in DERIVED:
                stored, derived = rows(connection, table), rows(made, table)
                _compare_rows(table, stored, derived, excuse, found)


@contextmanager
def _scratch(ground: Ground) -> Iterator[Ground]:
    """Yield a ground with an empty database and the files of the archive, which are only read."""
    with tempfile.TemporaryDirectory(prefix="linna-verify-") as folder:
        database = prepare_database(f"sqlite:///{folder}/linna.db")
        try:
            yield replace(ground, database=database, home=Path(folder))
        finally:
            database.engine.dispose()


def _compare_times(connection: Connection, scratch: Ground, vehicle: int, found: _Findings) -> None:
    """Fit the time correlations of a vehicle again and compare the times that they give."""
    if any(one.method != AUTOMATIC for one in correlations_in_force(connection, vehicle)):
        found.skip("vehicles with time correlations that a person entered")
        return
    if events.position_of(connection, CONSUMER) < events.last_number(connection):
        found.skip("vehicles with follow-up work that is not done")
        return
    recorrelate(scratch, vehicle)
    stored = load_correlations(connection, vehicle)
    derived = scratch.read(load_correlations, vehicle)
    found.count("correlations", len(stored))
    ends = [end for one in (*stored, *derived) for end in (one.start_ticks, one.stop_ticks)]
    ticks = np.array(ends, dtype=np.int64)
    difference = utc_ns_of_ticks(ticks, stored)[0] - utc_ns_of_ticks(ticks, derived)[0]
    if len(stored) != len(derived) or (np.abs(difference) > SAME_TIME_NS).any():
        reason = f"expected {len(derived)} lines that the time reports give, found {len(stored)} that differ"
        found.damage("correlations", f"vehicle {vehicle}", reason)


def _compare_rows(table: Table, stored: Rows, derived: Rows, excuse: Excuse, found: _Findings) -> None:
    """Merge two lists in the order of their keys and report their differences."""
    count = 0
    mine, other = next(stored, None), next(derived, None)
    while mine is not None or other is not None:
        key = min(one[0] for one in (mine, other) if one is not None)
        here = mine if mine is not None and mine[0] == key else None
        there = other if other is not None and other[0] == key else None
        count += here is not None
        if not same_values(table, here, there):
            reason = excuse(table, key, here is not None, there is not None)
            if reason is not None:
                found.skip(f"rows of {table.name} {reason}")
            elif here is None:
                found.damage(table.name, _words(key), "expected this row, found none")
            elif there is None:
                found.damage(table.name, _words(key), "expected no such row, found one that the raw data do not give")
            else:
                found.damage(table.name, _words(key), "expected the values of its packets, found others")
        mine = next(stored, None) if here is not None else mine
        other = next(derived, None) if there is not None else other
    found.checked[table.name] = count


def _words(key: tuple[Any, ...]) -> str:
    return " ".join(value.hex() if isinstance(value, bytes) else str(value) for value in key)
