"""SQL of recordings: their pieces, fragments of packets that wait for others, and the state of the archive around them.

Every query uses an index and returns a bounded number of rows, so its cost does not depend on the number of pieces.
"""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from sqlalchemy import Connection, and_, bindparam, delete, func, insert, select, true, update

from ground_service.ingest.core import UNKNOWN, Fragment, fits
from ground_service.store import repository
from ground_service.store.repository import FRAGMENTS, INGESTS, MISSIONS, PACKET_DECODINGS, PASSES, PIECES, VEHICLES
from ground_service.store.vehicles import hold

DIGEST_OCTETS = 16
BLOCK = 64
"""Largest number of pieces or fragments that one query returns."""


@dataclass(frozen=True, slots=True)
class Piece:
    """File of a downlink and its position in its recording; see `models.PIECES`."""

    ingest_id: int
    scope: str
    spacecraft_id: int | None
    file_sha256: str
    octets: int
    stream: str
    position: int
    station: str = ""
    link: str | None = None


@dataclass(frozen=True, slots=True)
class Part:
    """Octets [start, stop) of a file."""

    file_sha256: str
    start: int
    stop: int


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Octets of earlier pieces directly before and behind a piece of a recording.

    `new`: ranges [start, stop) of the piece, as positions in the recording, that no earlier piece has; all of it if the
    piece itself was entered before. Pieces with other statements of their sender and those that failed do not count.
    """

    before: tuple[Part, ...] = ()
    behind: tuple[Part, ...] = ()
    new: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, slots=True)
class Surroundings:
    """State of the archive before a piece is read.

    `revision` changes when a mission description or the pass of an archive is added. The others are
    those of the vehicle of the piece, None if there is none; `has_decodings`: packets of it were decoded as declared.
    """

    revision: tuple[int, ...]
    has_decodings: bool
    vehicle_id: int | None
    decoded_version: int | None


def add_piece(connection: Connection, piece: Piece) -> None:
    """Add a piece; pieces of one recording are committed in the order of their ingests."""
    if piece.stream:
        hold(connection, f"recording {piece.scope} {piece.stream}")
    connection.execute(insert(PIECES).values(**asdict(piece)))


def get_piece(connection: Connection, ingest_id: int) -> Piece:
    (piece,) = _pieces(connection, PIECES.c.ingest_id == ingest_id)
    return piece


def waiting_pieces(connection: Connection, piece: Piece) -> list[Piece]:
    """Return the pieces of the recording of a piece that wait for its link."""
    here = PIECES.c.scope == piece.scope, PIECES.c.waits == 1, PIECES.c.stream == piece.stream
    return _pieces(connection, *here)


def _pieces(connection: Connection, *conditions: Any) -> list[Piece]:
    columns = [PIECES.c[field.name] for field in fields(Piece)]
    rows = connection.execute(select(*columns).where(*conditions).order_by(PIECES.c.ingest_id))
    return [Piece(**row) for row in rows.mappings()]


def neighbours(connection: Connection, piece: Piece, reach: int) -> Neighbours:
    """Return what earlier pieces of the recording have around a piece, at most `reach` octets on each side."""
    columns = ("file_sha256", "octets", "position", "spacecraft_id", "station", "link")
    query = (
        select(*(PIECES.c[name] for name in columns), INGESTS.c.state)
        .join(INGESTS, INGESTS.c.id == PIECES.c.ingest_id)
        .where(PIECES.c.scope == piece.scope, PIECES.c.stream == piece.stream, PIECES.c.ingest_id < piece.ingest_id)
    )
    start, stop = piece.position, piece.position + piece.octets
    before: list[Part] = []
    covering: list[Any] = []
    reached, wanted, border = start, max(start - reach, 0), start
    while reached > wanted:
        rows = connection.execute(
            query.where(PIECES.c.position < border).order_by(PIECES.c.position.desc()).limit(BLOCK)
        ).all()
        was = reached
        for row in rows:
            if row.position < reached <= row.position + row.octets:
                first = max(row.position, wanted)
                before.insert(0, Part(row.file_sha256, first - row.position, reached - row.position))
                reached = first
        covering += rows
        if len(rows) < BLOCK or reached == was:
            break
        border = rows[-1].position
    behind: list[Part] = []
    reached, wanted = stop, stop + reach
    rows = connection.execute(
        query.where(PIECES.c.position >= start, PIECES.c.position < wanted).order_by(PIECES.c.position)
    ).all()
    for row in (*covering[::-1], *rows):
        if row.position <= reached < row.position + row.octets:
            last = min(row.position + row.octets, wanted)
            behind.append(Part(row.file_sha256, reached - row.position, last - row.position))
            reached = last
    known = [
        (max(row.position, start), min(row.position + row.octets, stop))
        for row in (*covering, *rows)
        if row.state != "failed"
        and (row.position, row.file_sha256) != (start, piece.file_sha256)
        and (row.station, row.link) == (piece.station, piece.link)
        and row.spacecraft_id in (None, piece.spacecraft_id)
    ]
    return Neighbours(tuple(before), tuple(behind), _between(start, stop, known))


def _between(start: int, stop: int, known: Iterable[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Return the parts of [start, stop) outside of known ranges."""
    found = []
    for low, high in [*sorted(one for one in known if one[0] < one[1]), (stop, stop)]:
        if low > start:
            found.append((start, low))
        start = max(start, high)
    return tuple(found)


def count_stored(
    connection: Connection, ingest_id: int, added: Mapping[str, int], **changes: int | None
) -> tuple[int, int, int]:
    """Add to the totals of an ingest, in the transaction that stores the packets, and change other columns.

    Return the new packets, those of them that were joined, and the samples that the ingest has stored. An ingest that
    is interrupted and run again finds its own packets in the archive: the totals stay complete.
    """
    totals = PIECES.c.packets_stored, PIECES.c.packets_joined, PIECES.c.samples_stored
    values = {name: PIECES.c[name] + number for name, number in added.items()}
    query = update(PIECES).where(PIECES.c.ingest_id == ingest_id).values({**values, **changes})
    packets, joined, samples = connection.execute(query.returning(*totals)).one()
    return int(packets), int(joined), int(samples)


def accounting_of_recording(connection: Connection, piece: Piece) -> dict[str, Any] | None:
    """Return the accounting of the newest piece of a recording that was read with a known link."""
    query = (
        select(INGESTS.c.accounting)
        .join(PIECES, PIECES.c.ingest_id == INGESTS.c.id)
        .where(
            PIECES.c.scope == piece.scope,
            PIECES.c.stream == piece.stream,
            PIECES.c.waits.is_(None),
            INGESTS.c.state == "done",
            func.coalesce(INGESTS.c.accounting["octets_repeated"].as_integer(), 0) < PIECES.c.octets,
        )
    )
    found = connection.execute(query.order_by(INGESTS.c.id.desc()).limit(1)).scalar()
    return None if found is None else dict(found)


# Fragments of packets


def add_fragments(connection: Connection, vehicle: int, fragments: Iterable[Fragment]) -> None:
    """Store the fragments of a vehicle that are not stored yet."""
    rows: list[dict[str, Any]] = [
        {
            "vehicle_id": vehicle,
            "channel": _channel(one),
            "begins": int(one.begins),
            "ends": int(one.ends),
            "count": one.count,
            "next_count": one.next_count,
            "first": one.first,
            "last": one.last,
            "stream": one.stream,
            "fit": one.fit,
            "digest": _digest(one),
            "octets": one.octets,
        }
        for one in fragments
    ]
    if rows:
        statement = repository.insert_of(connection)(FRAGMENTS).on_conflict_do_nothing()
        connection.execute(statement, sorted(rows, key=lambda row: row["digest"]))


def fragments_behind(
    connection: Connection, vehicle: int, fragment: Fragment, counts: Mapping[int, int]
) -> list[Fragment]:
    """Return fragments that begin at the counts of a channel, newest first; an end has the stated octets."""
    others = (FRAGMENTS.c.ends == 0) | FRAGMENTS.c.fit.in_(list(counts.values()))
    wanted = true() if UNKNOWN in counts.values() else others
    found = _fragments(connection, vehicle, fragment, FRAGMENTS.c.count.in_(list(counts)), wanted)
    return [one for one in found if fits(one, counts[one.count])]


def fragments_before(
    connection: Connection, vehicle: int, fragment: Fragment, counts: Mapping[int, int]
) -> list[Fragment]:
    """Return fragments that reach to the counts of a channel, newest first; a beginning lacks the stated octets."""
    others = (FRAGMENTS.c.begins == 0) | FRAGMENTS.c.fit.in_([*counts.values(), UNKNOWN])
    wanted = true() if UNKNOWN in counts.values() else others
    found = _fragments(connection, vehicle, fragment, FRAGMENTS.c.next_count.in_(list(counts)), wanted)
    return [one for one in found if fits(one, counts[one.next_count])]


def remove_fragments(connection: Connection, vehicle: int, fragments: Iterable[Fragment]) -> None:
    """Remove the fragments of a vehicle that are part of a complete packet."""
    digests = sorted(_digest(one) for one in fragments)
    for first in range(0, len(digests), 500):
        chosen = FRAGMENTS.c.digest.in_(digests[first : first + 500])
        connection.execute(delete(FRAGMENTS).where(FRAGMENTS.c.vehicle_id == vehicle, chosen))


def _fragments(connection: Connection, vehicle: int, fragment: Fragment, *conditions: Any) -> list[Fragment]:
    here = FRAGMENTS.c.vehicle_id == vehicle, FRAGMENTS.c.channel == _channel(fragment)
    query = select(FRAGMENTS).where(*here, *conditions).order_by(FRAGMENTS.c.id.desc()).limit(BLOCK)
    return [
        replace(
            fragment,
            begins=bool(row["begins"]),
            ends=bool(row["ends"]),
            octets=bytes(row["octets"]),
            **{name: row[name] for name in ("count", "next_count", "first", "last", "stream")},
        )
        for row in connection.execute(query).mappings()
    ]


def _channel(fragment: Fragment) -> str:
    return " ".join(str(one) for one in fragment.channel[1:])


def _digest(fragment: Fragment) -> bytes:
    """Return the identity of a fragment."""
    return hashlib.blake2b(repr(fragment).encode(), digest_size=DIGEST_OCTETS).digest()


# State of the archive


def surroundings(connection: Connection, piece: Piece) -> Surroundings:
    """Return the state of the archive before a piece is read, with one query."""
    values = {"scope": piece.scope, "spacecraft_id": piece.spacecraft_id}
    (*revision, decodings, vehicle, decoded) = connection.execute(_SURROUNDINGS, values).one()
    return Surroundings(tuple(int(one or 0) for one in revision), bool(decodings), vehicle, decoded)


def _surroundings_query() -> Any:
    """Return the query of `surroundings`: aggregates of one row each, with the vehicle if it exists."""
    scope: Any = bindparam("scope")
    missions = select(func.count().label("missions"), func.max(MISSIONS.c.id).label("last_mission"))
    vehicles = VEHICLES.alias()
    archived = (
        select(
            func.count().label("archived"),
            func.sum(PASSES.c.id).label("archives"),
            func.sum(PASSES.c.id * PASSES.c.mission_id).label("their_missions"),
        )
        .join(vehicles, vehicles.c.id == PASSES.c.vehicle_id)
        .where(vehicles.c.instance == scope, PASSES.c.archive_digest.is_not(None), PASSES.c.mission_id.is_not(None))
    )
    counts = [one.subquery() for one in (missions, archived)]
    vehicle = and_(VEHICLES.c.ccsds_id == bindparam("spacecraft_id"), VEHICLES.c.instance == scope)
    decodings = select(PACKET_DECODINGS.c.vehicle_id).where(PACKET_DECODINGS.c.vehicle_id == VEHICLES.c.id)
    return select(
        *(column for one in counts for column in one.c), decodings.exists(), VEHICLES.c.id, VEHICLES.c.decoded_version
    ).select_from(counts[0].join(counts[1], true()).join(VEHICLES, vehicle, isouter=True))


_SURROUNDINGS = _surroundings_query()
