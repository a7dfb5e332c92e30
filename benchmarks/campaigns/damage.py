"""Campaign of deliberate damage to derived rows, the audit log and files, to test `linna verify --rebuild`.

    python -m benchmarks.campaigns.damage [--postgresql] [--single] [--packets N] [--only TABLE...] [--json]

Fills an archive with telemetry of every kind, and then, on copies of it: changes every column of a row, removes a row,
puts a row in, changes, shortens, lengthens, exchanges and removes files, and puts a file in, each as another program
would. A copy takes at most one damage of each table and is then verified; with `--single` one damage in all. Exit
status 1 where damage was not found.
"""

from __future__ import annotations

import argparse
import json
import shutil
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import (
    JSON,
    Connection,
    Engine,
    Float,
    LargeBinary,
    SmallInteger,
    String,
    Table,
    create_engine,
    insert,
    select,
    text,
)
from sqlalchemy.exc import SQLAlchemyError

from benchmarks.ground import START, mixed_downlink
from ground_service.ground import Ground, open_ground
from ground_service.ingest.service import ingest_file
from ground_service.missions.service import add_mission
from ground_service.store.audit import GUARD_NAMES
from ground_service.store.models import AUDIT, AUDIT_HEAD, FILES, HOUSEKEEPING, PACKETS
from ground_service.worker.integrity import Verification, verify
from ground_service.worker.integrity_store import DERIVED
from lunar.timescales import parse_utc
from studies.harness.parts import PostgresServer
from tests.tmtc import foreign
from tmtc.dictionary import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.packets import PacketSequencer

SPACECRAFT = 76
NS = 1_000_000_000
DECLARED_APID, DECLARED_PACKETS = 100, 8
CHANGES = ("changed", "removed", "put in")


@dataclass(frozen=True, slots=True)
class Harm:
    """One damage: its target, its kind, and the function that causes it."""

    kind: str
    change: str
    place: str
    do: Callable[[Connection, Path], None]


def fill(ground: Ground, folder: Path, packets: int) -> None:
    """Fill an archive with telemetry of every kind."""
    add_mission(ground, _mission().encode())
    (folder / "mixed.cadu").write_bytes(mixed_downlink(packets))
    (folder / "rest.cadu").write_bytes(_rest_of_the_dictionary())
    (folder / "declared.cadu").write_bytes(_declared_packets())
    for name in ("mixed.cadu", "rest.cadu", "declared.cadu"):
        ingest_file(ground, folder / name)


def _mission() -> str:
    """Return a mission description that declares packets of one APID with their XTCE definition."""
    values = {"DAY": "U16", "MILLISECOND": "U32", "MICROSECOND": "U16", "VALUE": "F32"}
    definition = foreign.document(
        foreign.HEADER_TYPES + foreign.floating("F32", 32),
        {**foreign.HEADER_PARAMETERS, **values},
        foreign.HEADER_CONTAINER
        + foreign.container(
            "Status", list(values), "CCSDSPacket", foreign.comparison("PKT_APID", DECLARED_APID)
        ),
    )
    return (
        f"name = 'damage'\nspacecraft = {{ id = {SPACECRAFT} }}\n"
        f"[[packets]]\nname = 'bus'\napids = [{DECLARED_APID}]\npacket_checksum = 'none'\n"
        f"xtce = ['''{definition}''']\n"
        "[packets.time]\ncode = 'cds'\noffset = 6\np_field = false\nwhole_octets = 2\nfraction_octets = 2\n"
        "epoch = '1958-01-01T00:00:00Z'\nclock = 'own'\n"
    )


def _declared_packets() -> bytes:
    """Return a downlink of packets that the mission description declares, one each second."""
    packets = []
    for k in range(DECLARED_PACKETS):
        day, rest = divmod(START + k * NS - parse_utc("1958-01-01T00:00:00Z"), 86_400 * NS)
        octets = struct.pack(">HIHf", day, rest // 1_000_000, rest // 1_000 % 1_000, 0.5 * k)
        packets.append(foreign.space_packet(DECLARED_APID, octets, k))
    return encode_cadus(packets, spacecraft_id=SPACECRAFT)


def _rest_of_the_dictionary() -> bytes:
    """Return one packet of every kind that `mixed_downlink` does not contain."""
    sequencer, packets = PacketSequencer(), []
    for definition in DICTIONARY.telemetry:
        if definition.name in ("housekeeping", "detections", "navigation_state", "event_info"):
            continue
        values: dict[str, Any] = {field.name: _value(field) for field in definition.fields}
        if definition.group is not None:
            values[definition.group.name] = [{field.name: _value(field) for field in definition.group.fields}]
            del values[definition.group.count]
        packets.append(
            DICTIONARY.pack(
                definition.name, values, ticks=1 << 40, sequence_count=sequencer.next(definition.apid)
            )
        )
    return encode_cadus(packets, spacecraft_id=SPACECRAFT)


def _value(field: Any) -> Any:
    one = field.labels[0][0] if field.labels else max(field.minimum or 0.0, 0.0)
    value = float(one) if field.is_float or field.is_calibrated else int(one)
    return value if field.size == 1 else [value] * field.size


def _plain_value(column: Any) -> Any:
    if isinstance(column.type, JSON):
        return {"a": [1, 0.5, None, "ü"]}
    if isinstance(column.type, Float):
        return 0.1
    if isinstance(column.type, LargeBinary):
        return b"\x00\x01\xfe\xff"
    if isinstance(column.type, String):
        return "x"
    return 1


# Damage


def harms(engine: Engine, home: Path, only: Sequence[str] = ()) -> Iterator[Harm]:
    """Yield all damages: to each column and row of each protected table, and to files."""
    for table in PROTECTED:
        if only and table.name not in only:
            continue
        with engine.connect() as connection:
            query = select(table).order_by(*table.primary_key.columns)
            if table is PACKETS:  # the number of a packet without values means nothing
                query = query.where(table.c.id.in_(select(HOUSEKEEPING.c.packet_id)))
            rows = connection.execute(query).mappings().all()
        row = dict(rows[len(rows) // 2])
        here = _where(table, row)
        for column in table.columns:
            if table is FILES and column.name not in ("sha256", "octets"):
                continue  # what a sender states
            yield Harm(table.name, "changed", column.name, _change(table, here, column, row[column.name]))
        yield Harm(table.name, "removed", "one row", _statement(table.delete().where(here)))
        other = dict(row)
        for column in table.primary_key.columns:
            other[column.name] = _another(column, row[column.name], far=True)
        yield Harm(table.name, "put in", "one row", _put_in(table, other))
        if table.name == "audit":
            last = dict(rows[-1])
            yield Harm(table.name, "removed", "newest", _statement(table.delete().where(_where(table, last))))
    if only and "files on disk" not in only:
        return
    for path in (file for file in sorted((home / "files").rglob("*")) if file.is_file()):
        for place, change, do in FILE_HARM:
            yield Harm("files on disk", change, place, _file_harm(path.relative_to(home), do))
    yield Harm("files on disk", "put in", "a file of another name", _foreign_file)


def _where(table: Table, row: dict[str, Any]) -> Any:
    condition = None
    for column in table.primary_key.columns:
        one = column == row[column.name]
        condition = one if condition is None else condition & one
    return condition


def _another(column: Any, value: Any, *, far: bool = False) -> Any:
    """Return a value of the same type with the smallest possible difference."""
    if value is None:
        return _plain_value(column)
    if isinstance(column.type, JSON):
        return {**value, "damage": 1} if isinstance(value, dict) else {"damage": 1}
    if isinstance(column.type, Float):
        return float(np.nextafter(value, np.inf))
    if isinstance(column.type, LargeBinary):
        octets = bytes(value)
        return bytes([octets[0] ^ 1, *octets[1:]]) if octets else b"\x00"
    if isinstance(column.type, String):
        return ("y" if value[:1] != "y" else "z") + value[1:]
    step = 17 if isinstance(column.type, SmallInteger) else 100_003
    return value + step if far else value ^ 1


def _statement(statement: Any) -> Callable[[Connection, Path], None]:
    def do(connection: Connection, _home: Path) -> None:
        if connection.execute(statement).rowcount not in (1, -1):  # -1: unknown to the database
            raise RuntimeError(f"expected one row to be damaged by {statement}")

    return do


def _change(table: Table, here: Any, column: Any, value: Any) -> Callable[[Connection, Path], None]:
    return _statement(
        table.update().where(here).values({column.name: _another(column, value, far=column.primary_key)})
    )


def _put_in(table: Table, row: dict[str, Any]) -> Callable[[Connection, Path], None]:
    unique = {
        column.name
        for constraint in (*table.constraints, *table.indexes)
        if constraint.__class__.__name__ == "UniqueConstraint" or getattr(constraint, "unique", False)
        for column in constraint.columns
    }
    for name in unique:
        if not table.c[name].primary_key and not table.c[name].foreign_keys:
            row[name] = _another(table.c[name], row[name], far=True)
    return _statement(insert(table).values(row))


def _flip(path: Path) -> None:
    octets = bytearray(path.read_bytes())
    octets[len(octets) // 2] ^= 0x10
    path.write_bytes(octets)


def _shorten(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def _lengthen(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\x00")


def _exchange(path: Path) -> None:
    path.write_bytes(bytes(len(path.read_bytes())))


FILE_HARM: tuple[tuple[str, str, Callable[[Path], None]], ...] = (
    ("one bit", "changed", _flip),
    ("one octet less", "changed", _shorten),
    ("one octet more", "changed", _lengthen),
    ("all octets", "changed", _exchange),
    ("the file", "removed", Path.unlink),
)


def _file_harm(name: Path, do: Callable[[Path], None]) -> Callable[[Connection, Path], None]:
    def harm(_connection: Connection, home: Path) -> None:
        path = home / name
        path.chmod(0o644)
        do(path)

    return harm


def _foreign_file(_connection: Connection, home: Path) -> None:
    (home / "files" / "notes.txt").write_text("what somebody left here")


@contextmanager
def outside(url: Any, *, guards: bool = False) -> Iterator[Connection]:
    """Yield a connection of another program, without triggers and foreign keys unless `guards`."""
    engine = create_engine(url)
    try:
        with engine.begin() as connection:
            if not guards and engine.dialect.name == "postgresql":
                connection.execute(text("SET session_replication_role = replica"))
            elif not guards:
                for name in GUARD_NAMES:
                    connection.execute(text(f"DROP TRIGGER IF EXISTS {name}"))
            yield connection
            if not guards and engine.dialect.name == "sqlite":
                _guards_again(connection)
    finally:
        engine.dispose()


def _guards_again(connection: Connection) -> None:
    """Restore the triggers of the audit table, because missing triggers would be detected as damage."""
    from ground_service.store.audit import install_guards

    install_guards(connection)


# The campaign


class SqliteCopies:
    """Fresh copies of a filled archive with SQLite."""

    def __init__(self, folder: Path, packets: int) -> None:
        self._folder = folder
        self._pristine = folder / "pristine"
        with open_ground(self._pristine) as ground:
            fill(ground, folder, packets)
        with create_engine(f"sqlite:///{self._pristine / 'linna.db'}").connect() as connection:
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")

    @property
    def pristine(self) -> Ground:
        return open_ground(self._pristine)

    @contextmanager
    def copy(self) -> Iterator[Ground]:
        home = self._folder / "copy"
        shutil.rmtree(home, ignore_errors=True)
        shutil.copytree(self._pristine, home)
        with open_ground(home) as ground:
            yield ground


class PostgresCopies:
    """Fresh copies of a filled archive with PostgreSQL: databases created from a template."""

    def __init__(self, folder: Path, packets: int, server_url: str) -> None:
        self._folder, self._server = folder, server_url
        self._pristine = folder / "pristine"
        self._admin = create_engine(f"{server_url}/postgres", isolation_level="AUTOCOMMIT")
        self._create("pristine", "template1")
        from ground_service.store.database import prepare_database

        prepare_database(f"{server_url}/pristine", upgrade=True).engine.dispose()
        with self.pristine as ground:
            fill(ground, folder, packets)

    def _create(self, name: str, template: str) -> None:
        with self._admin.connect() as connection:
            connection.execute(text(f"DROP DATABASE IF EXISTS {name} WITH (FORCE)"))
            connection.execute(text(f"CREATE DATABASE {name} TEMPLATE {template}"))

    @property
    def pristine(self) -> Ground:
        return open_ground(self._pristine, database_url=f"{self._server}/pristine")

    @contextmanager
    def copy(self) -> Iterator[Ground]:
        home = self._folder / "copy"
        shutil.rmtree(home, ignore_errors=True)
        shutil.copytree(self._pristine, home)
        self._create("copy", "pristine")
        with open_ground(home, database_url=f"{self._server}/copy") as ground:
            yield ground


PROTECTED = (AUDIT, AUDIT_HEAD, FILES, *DERIVED)
"""Tables of which every damage is found."""

SOURCES = frozenset({"files"})
"""Tables that select what is ingested again; combined with damaged values, their damage would hide that damage."""

ALONE = frozenset({"audit_head", "files on disk"})
"""Kinds whose damage is also reported for other kinds."""

ELSEWHERE = frozenset({("packets", "id"), ("files", "one row")})
"""Damage that is reported for the rows that refer to this one."""


def rounds(wanted: Sequence[Harm], *, single: bool) -> list[list[Harm]]:
    """Return groups of damages for one copy: at most one of each kind, so that reports can be assigned."""
    if single:
        return [[harm] for harm in wanted]
    made: dict[tuple[Any, ...], list[Harm]] = {}
    turns: Counter[tuple[str, str]] = Counter()
    for number, harm in enumerate(wanted):
        turns[harm.kind, harm.change] += 1
        group: tuple[Any, ...] = (harm.change, harm.kind in SOURCES, turns[harm.kind, harm.change])
        made.setdefault((number,) if harm.kind in ALONE else group, []).append(harm)
    return list(made.values())


def campaign(
    copies: SqliteCopies | PostgresCopies, *, single: bool = False, only: Sequence[str] = ()
) -> dict[str, Any]:
    """Apply every damage to a copy and verify it; return detected and undetected damages."""
    with copies.pristine as ground:
        clean = verify(ground, rebuild=True)
        if clean.damaged:
            raise SystemExit(f"expected an archive without damage, found {clean.damaged[0]}")
        wanted = list(harms(ground.database.engine, ground.home, only))
    done: Counter[tuple[str, str]] = Counter()
    missed, refused, seconds = [], [], []
    for together in rounds(wanted, single=single):
        applied = []
        with copies.copy() as ground:
            for harm in together:
                try:
                    with outside(ground.database.engine.url) as connection:
                        harm.do(connection, ground.home)
                    applied.append(harm)
                except SQLAlchemyError as error:
                    line = str(error).splitlines()[0][:120]
                    refused.append(f"{harm.kind}, {harm.place} {harm.change}: {line}")
            began = time.monotonic()
            result = verify(ground, rebuild=True)
            seconds.append(time.monotonic() - began)
        for harm in applied:
            done[harm.kind, harm.change] += 1
            if not _names(result, harm):
                missed.append(f"{harm.kind}, {harm.place} {harm.change}")
        print(f"{sum(done.values())} of {len(wanted)} done, {len(missed)} not found", file=sys.stderr)
    table = {
        kind: {change: done[kind, change] for change in CHANGES if done[kind, change]}
        for kind in dict.fromkeys(harm.kind for harm in wanted)
    }
    return {
        "damage": sum(done.values()),
        "found": sum(done.values()) - len(missed),
        "missed": missed,
        "refused_by_the_database": refused,
        "kinds": table,
        "rows_and_files": sum(clean.checked.values()),
        "verify_s_median": round(float(np.median(seconds)), 3) if seconds else None,
    }


def _names(result: Verification, harm: Harm) -> bool:
    """Return whether a damage is detected with its location."""
    kinds = {one.kind for one in result.damaged}
    if harm.kind == "files on disk":
        return "files" in kinds
    if harm.kind == "audit_head":
        return "audit" in kinds
    return bool(kinds) if (harm.kind, harm.place) in ELSEWHERE else harm.kind in kinds


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--postgresql", action="store_true", help="use a temporary PostgreSQL server")
    parser.add_argument(
        "--single", action="store_true", help="one damage to each copy (default: at most one of each kind)"
    )
    parser.add_argument(
        "--packets", type=int, default=400, metavar="N", help="packets of the archive (default: 400)"
    )
    parser.add_argument(
        "--only", nargs="*", default=[], metavar="TABLE", help="only these tables, or 'files on disk'"
    )
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args(words)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if arguments.postgresql:
            with PostgresServer(folder) as server:
                url = server.url.rpartition("/")[0]
                copies: Any = PostgresCopies(folder, arguments.packets, url)
                figures = campaign(copies, single=arguments.single, only=arguments.only)
        else:
            copies = SqliteCopies(folder, arguments.packets)
            figures = campaign(copies, single=arguments.single, only=arguments.only)
    print(json.dumps(figures) if arguments.json else _as_text(figures))
    return 1 if figures["missed"] else 0


def _as_text(figures: dict[str, Any]) -> str:
    lines = [f"{'':<22}" + "".join(f"{change:>10}" for change in CHANGES)]
    lines += [
        f"{kind:<22}" + "".join(f"{counts.get(change, 0) or '':>10}" for change in CHANGES)
        for kind, counts in figures["kinds"].items()
    ]
    lines += [f"not found: {text_}" for text_ in figures["missed"]]
    lines += [f"refused by the database: {text_}" for text_ in figures["refused_by_the_database"]]
    lines.append(
        f"{figures['found']} of {figures['damage']} found; an archive of {figures['rows_and_files']} rows and files "
        f"is verified in {figures['verify_s_median']} s (median)"
    )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
