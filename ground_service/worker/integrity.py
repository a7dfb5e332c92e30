"""Integrity check of an archive: files, rows, packets, decoded values, and the audit chain.

Derived data are generated again in a scratch archive and compared by content: from the stored packets, or (`deep`) from
the raw files, as in their first ingest. All other data have digests. The check does not detect changes by a person who
can write to the database and computes matching digests and a matching chain; for the audit log, a head of the chain
that was stored elsewhere detects them.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import Connection, Table, and_, func, insert, select, text

from ground_service.errors import GroundError, InvalidInput
from ground_service.ground import Ground, open_ground
from ground_service.ingest.packets import DIGEST_OCTETS, batch_of_cut
from ground_service.ingest.parameters import decode_declared
from ground_service.ingest.service import Place, ingest_stored
from ground_service.ingest.store import store_batch
from ground_service.store import audit, repository, row_digests
from ground_service.store.files import FileArchive, StoredFile, read_blocks
from ground_service.store.vehicles import FLOWN, vehicle_id
from tmtc.dictionary import DICTIONARY
from tmtc.errors import TmtcError
from tmtc.packets import PRIMARY_HEADER_LENGTH
from tmtc.stream import whole_packets

BLOCK_PACKETS = 20_000
LIMIT_OF_A_KIND = 200
"""Largest number of listed damages of each kind; the rest is only counted."""

INGESTED = ("done", "failed")

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

    def skip(self, reason: str, number: int = 1) -> None:
        self.unchecked[reason] = self.unchecked.get(reason, 0) + number

    def damage(self, kind: str, key: object, reason: str) -> None:
        self.counts[kind] = self.counts.get(kind, 0) + 1
        if self.counts[kind] <= LIMIT_OF_A_KIND:
            self.damaged.append(Damage(kind=kind, key=str(key), reason=reason))


def verify(
    ground: Ground, *, deep: bool = False, expected_head: audit.Head | None = None, say: Say | None = None
) -> Verification:
    """Check the integrity of an archive, in one snapshot of the database, without changes.

    Parameters
    ----------
    deep
        Ingest all raw files again into a scratch archive and compare; otherwise decode the stored packets again.
    expected_head
        Head of the audit chain that was stored elsewhere: its entry must be in the chain.
    """
    found = _Findings()
    tell = say or (lambda _text: None)
    with ground.database.snapshot() as connection:
        tell("schema and rows")
        _check_schema(connection, found)
        _check_rows(connection, found)
        tell("audit chain")
        head = _check_audit(connection, expected_head, found)
        tell("files")
        good = _check_files(connection, ground.files, found)
        tell("raw files ingested again" if deep else "packets decoded again")
        with _scratch(ground) as scratch:
            _copy_missions(connection, scratch)
            if deep:
                _ingest_again(connection, ground, scratch, good, found)
            else:
                _decode_again(connection, scratch, found)
            _decode_declared_again(scratch, found)
            tell("packets and values")
            with scratch.database.reading() as made:
                _compare(connection, made, found)
    total = sum(found.counts.values())
    return Verification(
        checked=dict(sorted(found.checked.items())),
        unchecked=found.unchecked,
        damaged=found.damaged,
        damaged_total=total,
        verdict="damaged" if total else "intact",
        audit_head=f"{head.number}:{head.sha256}" if head is not None else None,
    )


# Rows, chain, files


def _check_schema(connection: Connection, found: _Findings) -> None:
    for name in audit.missing_guards(connection):
        found.damage("schema", name, "expected this trigger of the audit table, found none")
    for name in row_digests.missing_triggers(connection):
        found.damage("schema", name, "expected the trigger of row digests, found none")
    if connection.dialect.name != "sqlite":
        return
    for (line,) in connection.execute(text("PRAGMA integrity_check")):
        if line != "ok":
            found.damage("schema", "linna.db", str(line))
    for row in connection.execute(text("PRAGMA foreign_key_check")):
        found.damage(str(row[0]), row[1], f"expected the row of {row[2]} that it names, found none")


def _check_rows(connection: Connection, found: _Findings) -> None:
    for table in row_digests.guarded_tables():
        found.count(table.name, int(connection.execute(select(func.count()).select_from(table)).scalar_one()))
        for stray in row_digests.stray_rows(connection, table):
            found.damage(stray.table, stray.key, stray.reason)
    for stray in row_digests.unknown_digests(connection):
        found.damage(stray.table, stray.key, stray.reason)


def _check_audit(connection: Connection, expected: audit.Head | None, found: _Findings) -> audit.Head | None:
    found.count("audit", audit.count_entries(connection))
    for broken in audit.broken_entries(connection):
        found.damage("audit", broken.number, broken.reason)
    if expected is not None and expected.number > 0:
        stored = audit.read_entry_sha256(connection, expected.number)
        if stored != expected.sha256:
            what = "another" if stored is not None else "none"
            found.damage("audit", expected.number, f"expected the entry of the stored head, found {what}")
    return audit.read_head(connection)


def _check_files(connection: Connection, files: FileArchive, found: _Findings) -> set[str]:
    """Check every file against its row; return the hashes of undamaged files."""
    good, known = set(), set()
    table = repository.FILES
    for sha256, octets in connection.execute(select(table.c.sha256, table.c.octets).order_by(table.c.sha256)):
        known.add(sha256)
        found.count("octets of files", int(octets))
        path = files.path(sha256)
        if not path.is_file():
            found.damage("files", sha256, "expected the file, found nothing")
        elif path.stat().st_size != octets:
            found.damage("files", sha256, f"expected {octets} octets, found {path.stat().st_size}")
        elif _sha256(path) != sha256:
            found.damage("files", sha256, "expected octets with this SHA-256, found other octets")
        else:
            good.add(sha256)
    for path in sorted(files.root.rglob("*")):
        if not path.is_file() or path.name.startswith(".") or path.name in known:
            continue
        if path == files.path(path.name) and _sha256(path) == path.name:
            found.skip("files without a row, left by interrupted uploads")
        else:
            found.damage("files", path.name[:80], "expected no such file in the archive, found one")
    return good


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    for block in read_blocks(path):
        digest.update(block)
    return digest.hexdigest()


# What is derived


@contextmanager
def _scratch(ground: Ground) -> Iterator[Ground]:
    with (
        tempfile.TemporaryDirectory(prefix="linna-verify-") as folder,
        open_ground(Path(folder), ground.data) as scratch,
    ):
        yield scratch


def _copy_missions(connection: Connection, scratch: Ground) -> None:
    """Copy the mission descriptions: they declare packets, and whether these end with a checksum."""
    missions = connection.execute(select(repository.MISSIONS)).mappings().all()
    if missions:
        with scratch.database.writing() as writing:
            writing.execute(insert(repository.MISSIONS), [dict(row) for row in missions])


def _decode_declared_again(scratch: Ground, found: _Findings) -> None:
    """Decode the declared packets of every vehicle of the scratch archive with the newest mission description."""
    vehicles = repository.VEHICLES
    with scratch.database.reading() as made:
        rows = made.execute(select(vehicles.c.id, vehicles.c.ccsds_id)).all()
    for vehicle, spacecraft in rows:
        try:
            decode_declared(scratch, int(vehicle))
        except (GroundError, TmtcError) as error:
            found.damage(
                "missions",
                f"spacecraft {spacecraft}",
                f"expected a usable mission description, found: {error}",
            )


def _ingest_again(
    connection: Connection, ground: Ground, scratch: Ground, good: set[str], found: _Findings
) -> None:
    """Ingest every raw file into the scratch archive, as in its first ingest."""
    ingests, vehicles, files, pieces = (
        repository.INGESTS,
        repository.VEHICLES,
        repository.FILES,
        repository.PIECES,
    )
    query = (
        select(
            ingests.c.id,
            ingests.c.file_sha256,
            ingests.c.state,
            vehicles.c.ccsds_id,
            vehicles.c.instance,
            files.c.name,
            files.c.octets,
            pieces.c.scope,
            pieces.c.spacecraft_id,
            pieces.c.stream,
            pieces.c.position,
            pieces.c.station,
            pieces.c.link,
        )
        .outerjoin(pieces, pieces.c.ingest_id == ingests.c.id)
        .outerjoin(vehicles, vehicles.c.id == ingests.c.vehicle_id)
        .outerjoin(files, files.c.sha256 == ingests.c.file_sha256)
        .order_by(ingests.c.id)
    )
    seen = set()
    for row in connection.execute(query).mappings().all():
        ground.check_stopping()
        place = Place(row["stream"], row["position"]) if row["stream"] else None
        reception = (row["station"] or "", row["link"])
        key = (row["file_sha256"], row["ccsds_id"], row["instance"], row["spacecraft_id"], place, reception)
        if row["state"] not in INGESTED:
            found.skip("unfinished ingests")
            continue
        if key in seen or row["file_sha256"] not in good:
            continue
        seen.add(key)
        found.count("raw files ingested again")
        source = ground.files.path(row["file_sha256"])
        linked = scratch.files.path(row["file_sha256"])
        linked.parent.mkdir(parents=True, exist_ok=True)
        if not linked.exists():
            linked.symlink_to(source)
        stored = StoredFile(row["file_sha256"], int(row["octets"]), linked)
        try:
            _ingest_one(scratch, stored, row, place)
        except (GroundError, TmtcError) as error:
            if row["state"] == "done":
                found.damage("ingests", row["id"], f"expected a file that can be ingested, found: {error}")


def _ingest_one(scratch: Ground, stored: StoredFile, row: Any, place: Place | None) -> None:
    instance = row["scope"] or row["instance"] or FLOWN
    spacecraft = row["spacecraft_id"]
    if row["scope"] is None and row["ccsds_id"] is not None:
        # an ingest older than the record of pieces: the statements of its sender are not known
        try:
            ingest_stored(scratch, stored, name=str(row["name"]), instance=instance)
            return
        except GroundError:
            spacecraft = int(row["ccsds_id"])  # bare packets carry no spacecraft id
    ingest_stored(
        scratch,
        stored,
        name=str(row["name"]),
        spacecraft_id=spacecraft,
        instance=instance,
        place=place,
        station=row["station"] or "",
        link=row["link"],
    )


def _decode_again(connection: Connection, scratch: Ground, found: _Findings) -> None:
    """Store the packets of this archive in the scratch archive, as in their first ingest."""
    table = repository.PACKETS
    for row in connection.execute(select(repository.VEHICLES)).mappings().all():
        vehicle, last = int(row["id"]), 0
        try:
            with scratch.database.writing() as writing:
                copy = vehicle_id(writing, row["ccsds_id"], row["instance"])
        except InvalidInput as error:
            found.damage("vehicles", vehicle, str(error))
            continue
        while True:
            block = connection.execute(
                select(table.c.id, table.c.digest, table.c.octets)
                .where(table.c.vehicle_id == vehicle, table.c.id > last)
                .order_by(table.c.id)
                .limit(BLOCK_PACKETS)
            ).all()
            if not block:
                break
            last = int(block[-1][0])
            whole = [bytes(octets) for key, digest, octets in block if _whole(key, digest, octets, found)]
            buffer = b"".join(whole)
            cut = whole_packets(np.array([len(octets) for octets in whole], dtype=np.int64))
            batch = batch_of_cut(buffer, cut, DICTIONARY, int(row["ccsds_id"]))
            with scratch.database.writing() as writing:
                store_batch(writing, copy, batch)


def _whole(key: int, digest: bytes, octets: bytes, found: _Findings) -> bool:
    """Return whether a stored packet matches its digest and the length in its header."""
    octets = bytes(octets)
    if hashlib.blake2b(octets, digest_size=DIGEST_OCTETS).digest() != bytes(digest):
        found.damage("packets", key, "expected octets that match its digest, found other octets")
        return False
    if len(octets) <= PRIMARY_HEADER_LENGTH or len(octets) != PRIMARY_HEADER_LENGTH + 1 + int.from_bytes(
        octets[4:6], "big"
    ):
        found.damage("packets", key, "expected the length of its header, found another")
        return False
    return True


def _compare(connection: Connection, made: Connection, found: _Findings) -> None:
    """Compare packets and values with those of the scratch archive."""
    vehicles = repository.VEHICLES
    known = {}
    for row in connection.execute(select(vehicles)).mappings().all():
        copy = repository.find(made, vehicles, ccsds_id=row["ccsds_id"], instance=row["instance"])
        known[int(row["id"])] = int(copy["id"]) if copy is not None else 0
        _compare_rows(
            "packets", _packets(connection, int(row["id"])), _packets(made, known[int(row["id"])]), found
        )
        _compare_parameters(connection, made, int(row["id"]), known[int(row["id"])], found)
        if row["decoded_version"] not in (None, DICTIONARY.version):
            found.skip("vehicles not yet decoded with this dictionary")
            continue
        for name, table in repository.SAMPLES.items():
            _check_packets_of(connection, name, table, int(row["id"]), found)
            _compare_rows(
                name,
                _values(connection, table, int(row["id"])),
                _values(made, table, known[int(row["id"])]),
                found,
            )
    derived = (repository.PACKETS, repository.PARAMETER_SAMPLES, *repository.SAMPLES.values())
    for name, table in ((one.name, one) for one in derived):
        for vehicle, count in connection.execute(
            select(table.c.vehicle_id, func.count())
            .where(table.c.vehicle_id.not_in(list(known)))
            .group_by(table.c.vehicle_id)
        ):
            found.damage(name, f"vehicle {vehicle}", f"expected no rows of an unknown vehicle, found {count}")
        if "dictionary_version" not in table.c:
            continue
        other = connection.execute(
            select(table.c.dictionary_version, func.count())
            .where(table.c.dictionary_version != DICTIONARY.version)
            .group_by(table.c.dictionary_version)
        )
        for version, count in other:
            if version > DICTIONARY.version:
                found.damage(
                    name, f"dictionary version {version}", f"expected no newer version, found {count} rows"
                )
            else:
                found.skip(f"values decoded with dictionary version {version}", int(count))


def _compare_parameters(
    connection: Connection, made: Connection, vehicle: int, copy: int, found: _Findings
) -> None:
    """Compare the values of declared packets of a vehicle with those of the scratch archive.

    The scratch archive decodes with the newest mission description only. Its definitions have other numbers, so
    definitions are compared by digest.
    """
    table, name = repository.PARAMETER_SAMPLES, repository.PARAMETER_SAMPLES.name
    _check_packets_of(connection, name, table, vehicle, found)
    digests, decoded_to = _definition_digests(connection), _decoded_to(connection, vehicle)
    made_digests, newest = _definition_digests(made), _decoded_to(made, copy)
    counted = connection.execute(
        select(table.c.definition_id, func.count())
        .where(table.c.vehicle_id == vehicle)
        .group_by(table.c.definition_id)
    )
    counts = {int(definition): int(count) for definition, count in counted}
    numbers = {digest: definition for definition, digest in digests.items()}
    compared = {numbers.get(made_digests[definition], 0): definition for definition in newest}
    for definition, count in counts.items():
        if definition in compared:
            continue
        if definition in digests and definition in decoded_to:
            found.skip("values decoded with an earlier mission description", count)
        else:
            found.damage(
                name,
                f"vehicle {vehicle}, definition {definition}",
                f"expected no rows of an unknown definition, found {count}",
            )
    for stored, definition in compared.items():
        pending: set[bytes] | None = set()
        if stored in decoded_to:
            pending = _pending_packets(connection, vehicle, decoded_to[stored])
        elif stored not in counts:  # not begun
            pending = None
        _compare_rows(
            name,
            _parameter_values(connection, vehicle, stored),
            _parameter_values(made, copy, definition),
            found,
            pending=pending,
        )


def _definition_digests(connection: Connection) -> dict[int, str]:
    table = repository.PACKET_DEFINITIONS
    return {int(key): str(digest) for key, digest in connection.execute(select(table.c.id, table.c.digest))}


def _decoded_to(connection: Connection, vehicle: int) -> dict[int, int]:
    """Return the last decoded packet of a vehicle by definition."""
    table = repository.PACKET_DECODINGS
    query = select(table.c.definition_id, table.c.decoded_to).where(table.c.vehicle_id == vehicle)
    return {int(definition): int(last) for definition, last in connection.execute(query)}


def _pending_packets(connection: Connection, vehicle: int, decoded_to: int) -> set[bytes]:
    """Return the digests of packets that are stored but not yet decoded."""
    table = repository.PACKETS
    query = select(table.c.digest).where(table.c.vehicle_id == vehicle, table.c.id > decoded_to)
    return {bytes(digest) for digest in connection.execute(query).scalars()}


def _check_packets_of(
    connection: Connection, name: str, table: Table, vehicle: int, found: _Findings
) -> None:
    """Report packets referenced by values that are missing or have another number."""
    packets = repository.PACKETS
    missing = connection.execute(
        select(table.c.packet_id, func.count())
        .outerjoin(packets, and_(packets.c.id == table.c.packet_id, packets.c.vehicle_id == vehicle))
        .where(table.c.vehicle_id == vehicle, packets.c.id.is_(None))
        .group_by(table.c.packet_id)
        .order_by(table.c.packet_id)
    )
    for packet, count in missing:
        found.damage("packets", packet, f"expected the packet of {count} rows of {name}, found none")


Keyed = Iterator[tuple[tuple[Any, ...], tuple[Any, ...]]]


def _packets(connection: Connection, vehicle: int) -> Keyed:
    table = repository.PACKETS
    names = ("apid", "ticks", "sequence_count", "digest")
    query = (
        select(*(table.c[name] for name in names), table.c.octets)
        .where(table.c.vehicle_id == vehicle)
        .order_by(*(table.c[name] for name in names))
    )
    return _keyed(connection, query, len(names))


def _values(connection: Connection, table: Table, vehicle: int) -> Keyed:
    packets = repository.PACKETS
    kept = [column for column in table.columns if column.name not in ("vehicle_id", "packet_id", "ticks")]
    query = (
        select(table.c.ticks, packets.c.digest, *kept)
        .outerjoin(
            packets, and_(packets.c.id == table.c.packet_id, packets.c.vehicle_id == table.c.vehicle_id)
        )
        .where(table.c.vehicle_id == vehicle, table.c.dictionary_version == DICTIONARY.version)
        .order_by(table.c.ticks, func.coalesce(packets.c.digest, b""))
    )
    return _keyed(connection, query, 2)


def _parameter_values(connection: Connection, vehicle: int, definition: int) -> Keyed:
    table, packets = repository.PARAMETER_SAMPLES, repository.PACKETS
    query = (
        select(table.c.ticks, packets.c.digest, table.c.container, table.c["values"])
        .outerjoin(
            packets, and_(packets.c.id == table.c.packet_id, packets.c.vehicle_id == table.c.vehicle_id)
        )
        .where(table.c.vehicle_id == vehicle, table.c.definition_id == definition)
        .order_by(table.c.ticks, func.coalesce(packets.c.digest, b""), table.c.container)
    )
    return _keyed(connection, query, 3)


def _keyed(connection: Connection, query: Any, key_columns: int) -> Keyed:
    rows: Iterable[Any] = connection.execution_options(yield_per=BLOCK_PACKETS).execute(query)
    for row in rows:
        values = tuple(bytes(value) if isinstance(value, memoryview) else value for value in row)
        key = tuple(b"" if value is None else value for value in values[:key_columns])
        yield key, values[key_columns:]


def _compare_rows(
    kind: str,
    stored: Keyed,
    expected: Keyed,
    found: _Findings,
    *,
    pending: Collection[bytes] | None = (),
) -> None:
    """Merge two lists in the order of their keys and report their differences.

    Rows of `pending` packets (digest, the second value of a key; None: of all packets) may be missing.
    """
    mine, other = next(stored, None), next(expected, None)
    while mine is not None or other is not None:
        if mine is None or (other is not None and other[0] < mine[0]):
            assert other is not None
            if pending is None or other[0][1] in pending:
                found.skip(f"packets not yet decoded to rows of {kind}")
            else:
                found.damage(kind, _words(other[0]), "expected this row, found none")
            other = next(expected, None)
            continue
        found.count(kind)
        if other is None or mine[0] < other[0]:
            found.damage(
                kind, _words(mine[0]), "expected no such row, found one that the raw data do not give"
            )
            mine = next(stored, None)
            continue
        if mine[1] != other[1]:
            found.damage(kind, _words(mine[0]), "expected the values of its packet, found others")
        mine, other = next(stored, None), next(expected, None)


def _words(key: tuple[Any, ...]) -> str:
    return " ".join(value.hex() if isinstance(value, bytes) else str(value) for value in key)
