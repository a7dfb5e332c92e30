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
from sqlalchemy import Connection

from ground_service.errors import GroundError, InvalidInput
from ground_service.ground import Ground, open_ground
from ground_service.ingest.packets import DIGEST_OCTETS, batch_of_cut
from ground_service.ingest.parameters import decode_declared
from ground_service.ingest.service import Place, ingest_stored
from ground_service.ingest.store import store_batch
from ground_service.store import audit, row_digests
from ground_service.store.files import FileArchive, StoredFile
from ground_service.store.vehicles import FLOWN, all_vehicles, vehicle_id
from ground_service.worker import integrity_store as store
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
            with scratch.database.writing() as writing:
                store.copy_missions(connection, writing)
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
    for line in store.database_faults(connection):
        found.damage("schema", "linna.db", line)
    for table, key, parent in store.dangling_references(connection):
        found.damage(table, key, f"expected the row of {parent} that it names, found none")


def _check_rows(connection: Connection, found: _Findings) -> None:
    for table in row_digests.guarded_tables():
        found.count(table.name, store.count_rows(connection, table))
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
    for sha256, octets in store.files(connection):
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


# What is derived


@contextmanager
def _scratch(ground: Ground) -> Iterator[Ground]:
    with (
        tempfile.TemporaryDirectory(prefix="linna-verify-") as folder,
        open_ground(Path(folder), ground.data) as scratch,
    ):
        yield scratch


def _decode_declared_again(scratch: Ground, found: _Findings) -> None:
    """Decode the declared packets of every vehicle of the scratch archive with the newest mission description."""
    with scratch.database.reading() as made:
        vehicles = all_vehicles(made)
    for vehicle in vehicles:
        try:
            decode_declared(scratch, vehicle.id)
        except (GroundError, TmtcError) as error:
            found.damage(
                "missions",
                f"spacecraft {vehicle.ccsds_id}",
                f"expected a usable mission description, found: {error}",
            )


def _ingest_again(
    connection: Connection, ground: Ground, scratch: Ground, good: set[str], found: _Findings
) -> None:
    """Ingest every raw file into the scratch archive, as in its first ingest."""
    seen = set()
    for one in store.recorded_ingests(connection):
        ground.check_stopping()
        place = Place(one.stream, one.position) if one.stream and one.position is not None else None
        key = (one.sha256, one.ccsds_id, one.instance, one.spacecraft_id, place, one.station or "", one.link)
        if one.state not in INGESTED:
            found.skip("unfinished ingests")
            continue
        if key in seen or one.sha256 not in good:
            continue
        seen.add(key)
        found.count("raw files ingested again")
        source = ground.files.path(one.sha256)
        linked = scratch.files.path(one.sha256)
        linked.parent.mkdir(parents=True, exist_ok=True)
        if not linked.exists():
            linked.symlink_to(source)
        try:
            _ingest_one(scratch, StoredFile(one.sha256, one.octets, linked), one, place)
        except (GroundError, TmtcError) as error:
            if one.state == "done":
                found.damage("ingests", one.id, f"expected a file that can be ingested, found: {error}")


def _ingest_one(scratch: Ground, stored: StoredFile, one: store.RecordedIngest, place: Place | None) -> None:
    instance = one.scope or one.instance or FLOWN
    spacecraft = one.spacecraft_id
    if one.scope is None and one.ccsds_id is not None:
        # an ingest older than the record of pieces: the statements of its sender are not known
        try:
            ingest_stored(scratch, stored, name=one.name, instance=instance)
            return
        except GroundError:
            spacecraft = one.ccsds_id  # bare packets carry no spacecraft id
    ingest_stored(
        scratch,
        stored,
        name=one.name,
        spacecraft_id=spacecraft,
        instance=instance,
        place=place,
        station=one.station or "",
        link=one.link,
    )


def _decode_again(connection: Connection, scratch: Ground, found: _Findings) -> None:
    """Store the packets of this archive in the scratch archive, as in their first ingest."""
    for vehicle in all_vehicles(connection):
        try:
            with scratch.database.writing() as writing:
                copy = vehicle_id(writing, vehicle.ccsds_id, vehicle.instance)
        except InvalidInput as error:
            found.damage("vehicles", vehicle.id, str(error))
            continue
        for block in store.packet_blocks(connection, vehicle.id, BLOCK_PACKETS):
            whole = [octets for key, digest, octets in block if _whole(key, digest, octets, found)]
            buffer = b"".join(whole)
            cut = whole_packets(np.array([len(octets) for octets in whole], dtype=np.int64))
            batch = batch_of_cut(buffer, cut, DICTIONARY, vehicle.ccsds_id)
            with scratch.database.writing() as writing:
                store_batch(writing, copy, batch)


def _whole(key: int, digest: bytes, octets: bytes, found: _Findings) -> bool:
    """Return whether a stored packet matches its digest and the length in its header."""
    if hashlib.blake2b(octets, digest_size=DIGEST_OCTETS).digest() != digest:
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
    copies = {(one.ccsds_id, one.instance): one.id for one in all_vehicles(made)}
    vehicles = all_vehicles(connection)
    for vehicle in vehicles:
        copy = copies.get((vehicle.ccsds_id, vehicle.instance), 0)
        _compare_rows("packets", store.packets(connection, vehicle.id), store.packets(made, copy), found)
        _compare_parameters(connection, made, vehicle.id, copy, found)
        if vehicle.decoded_version not in (None, DICTIONARY.version):
            found.skip("vehicles not yet decoded with this dictionary")
            continue
        for name, table in store.SAMPLES.items():
            _check_packets_of(connection, table, vehicle.id, found)
            _compare_rows(
                name, store.values(connection, table, vehicle.id), store.values(made, table, copy), found
            )
    for table in store.DERIVED:
        name = table.name
        for unknown, count in store.rows_of_others(connection, table, [one.id for one in vehicles]):
            found.damage(name, f"vehicle {unknown}", f"expected no rows of an unknown vehicle, found {count}")
        for version, count in store.rows_of_other_versions(connection, table):
            if version > DICTIONARY.version:
                found.damage(
                    name, f"dictionary version {version}", f"expected no newer version, found {count} rows"
                )
            else:
                found.skip(f"values decoded with dictionary version {version}", count)


def _compare_parameters(
    connection: Connection, made: Connection, vehicle: int, copy: int, found: _Findings
) -> None:
    """Compare the values of declared packets of a vehicle with those of the scratch archive.

    The scratch archive decodes with the newest mission description only. Its definitions have other numbers, so
    definitions are compared by digest.
    """
    name = store.PARAMETER_SAMPLES.name
    _check_packets_of(connection, store.PARAMETER_SAMPLES, vehicle, found)
    digests, decoded_to = store.definition_digests(connection), store.decoded_to(connection, vehicle)
    made_digests, newest = store.definition_digests(made), store.decoded_to(made, copy)
    counts = store.values_by_definition(connection, vehicle)
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
            pending = store.pending_packets(connection, vehicle, decoded_to[stored])
        elif stored not in counts:  # not begun
            pending = None
        _compare_rows(
            name,
            store.parameter_values(connection, vehicle, stored),
            store.parameter_values(made, copy, definition),
            found,
            pending=pending,
        )


def _check_packets_of(connection: Connection, table: store.Table, vehicle: int, found: _Findings) -> None:
    """Report packets referenced by values that are missing or have another number."""
    for packet, count in store.missing_packets(connection, table, vehicle):
        found.damage("packets", packet, f"expected the packet of {count} rows of {table.name}, found none")


def _compare_rows(
    kind: str,
    stored: store.Keyed,
    expected: store.Keyed,
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
