"""Pieces of downlinks, their links, and octets that wait for adjacent pieces.

Every query uses an index and returns a bounded number of rows, so its cost does not depend on the number of pieces.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from sqlalchemy import Connection, and_, bindparam, func, insert, select, true, update
from sqlalchemy.dialects import postgresql, sqlite

from ground_service.ingest.edges import MIDDLE, OPENER, UNKNOWN, Edge
from ground_service.ingest.stream import BARE, Link
from ground_service.store.repository import (
    GOOD_LINKS,
    KNOWN_LINKS,
    MISSIONS,
    PACKET_DECODINGS,
    PASSES,
    PIECES,
    STREAM_EDGES,
    VEHICLES,
)
from tmtc.link import LinkSettings

DIGEST_OCTETS = 16

REUSABLE_OCTETS = 8
"""Length below which a piece may occur at several positions of a stream; it is kept after use."""

_BLOCK = 64

_WITHIN = select(STREAM_EDGES.c.id).where(
    STREAM_EDGES.c.file_sha256 == bindparam("file_sha256"),
    STREAM_EDGES.c.open == 1,
    STREAM_EDGES.c.domain == bindparam("domain"),
    STREAM_EDGES.c.start >= bindparam("start"),
    STREAM_EDGES.c.start + STREAM_EDGES.c.length <= bindparam("stop"),
    (STREAM_EDGES.c.length >= REUSABLE_OCTETS) | (STREAM_EDGES.c.role != MIDDLE),
)


@dataclass(frozen=True, slots=True)
class Piece:
    """File of a downlink and its position in a stream; see `models.PIECES`."""

    ingest_id: int
    scope: str
    spacecraft_id: int | None
    file_sha256: str
    octets: int
    stream: str
    position: int
    links_tried: int | None
    station: str = ""
    link: str | None = None


@dataclass(frozen=True, slots=True)
class Surroundings:
    """State of the archive before a piece is read.

    Attributes
    ----------
    revision
        Changes when a link, good settings, a mission description or the pass of an archive is added.
    waits
        Whether a piece waits for more links, octets of the same file wait for others, or declared packets are decoded.
    vehicle_id, decoded_version, redecoding_version
        Vehicle of the spacecraft of the piece; None if there is none.
    """

    revision: tuple[int, ...]
    waits: bool
    vehicle_id: int | None
    decoded_version: int | None
    redecoding_version: int | None


@dataclass(frozen=True, slots=True)
class StoredEdge:
    """Stored edge, waiting or used."""

    id: int
    domain: str
    file_sha256: str | None
    edge: Edge


@dataclass(frozen=True, slots=True)
class Part:
    """Octets [start, stop) of a file."""

    file_sha256: str
    start: int
    stop: int


def add_piece(connection: Connection, piece: Piece, packets: int = 0, samples: int = 0) -> None:
    """Add a piece, and what its ingest has stored."""
    stored = {"packets_stored": packets, "samples_stored": samples}
    connection.execute(insert(PIECES).values(**asdict(piece), **stored))


def piece_of(connection: Connection, ingest_id: int) -> Piece:
    """Return the piece of an ingest."""
    found = find_piece(connection, ingest_id)
    assert found is not None
    return found


def find_piece(connection: Connection, ingest_id: int) -> Piece | None:
    """Return the piece of an ingest; None if there is no such ingest."""
    columns = [PIECES.c[field.name] for field in fields(Piece)]
    row = connection.execute(select(*columns).where(PIECES.c.ingest_id == ingest_id)).mappings().first()
    return None if row is None else Piece(**row)


def surroundings(connection: Connection, piece: Piece) -> Surroundings:
    """Return the state of the archive before a piece is read, with one query."""
    values = {"scope": piece.scope, "spacecraft_id": piece.spacecraft_id, "file_sha256": piece.file_sha256}
    row = connection.execute(_SURROUNDINGS, values).one()
    (*revision, waiting, edges, decodings, vehicle, decoded, redecoding) = row
    return Surroundings(
        tuple(int(one or 0) for one in revision),
        bool(waiting or edges or decodings),
        None if vehicle is None else int(vehicle),
        decoded,
        redecoding,
    )


def _surroundings_query() -> Any:
    """Return the query of `surroundings`: aggregates of one row each, beside the vehicle if it exists."""
    scope: Any = bindparam("scope")
    links = select(
        func.count().label("links"), func.coalesce(func.max(KNOWN_LINKS.c.id), 0).label("last_link")
    ).where(KNOWN_LINKS.c.scope == scope)
    good = select(func.max(GOOD_LINKS.c.id).label("last_good"))
    missions = select(func.count().label("missions"), func.max(MISSIONS.c.id).label("last_mission"))
    vehicles = VEHICLES.alias()
    archived = (
        select(
            func.count().label("archived"),
            func.sum(PASSES.c.id).label("archives"),
            func.sum(PASSES.c.id * PASSES.c.mission_id).label("their_missions"),
        )
        .join(vehicles, vehicles.c.id == PASSES.c.vehicle_id)
        .where(
            vehicles.c.instance == scope,
            PASSES.c.archive_digest.is_not(None),
            PASSES.c.mission_id.is_not(None),
        )
    )
    counts = [one.subquery() for one in (links, good, missions, archived)]
    vehicle = and_(VEHICLES.c.ccsds_id == bindparam("spacecraft_id"), VEHICLES.c.instance == scope)
    waiting = select(PIECES.c.ingest_id).where(
        PIECES.c.scope == scope, PIECES.c.links_tried < counts[0].c.links
    )
    edges = select(STREAM_EDGES.c.id).where(STREAM_EDGES.c.file_sha256 == bindparam("file_sha256"))
    decodings = select(PACKET_DECODINGS.c.vehicle_id).where(PACKET_DECODINGS.c.vehicle_id == VEHICLES.c.id)
    return select(
        *(column for one in counts for column in one.c),
        waiting.exists(),
        edges.exists(),
        decodings.exists(),
        VEHICLES.c.id,
        VEHICLES.c.decoded_version,
        VEHICLES.c.redecoding_version,
    ).select_from(
        counts[0]
        .join(counts[1], true())
        .join(counts[2], true())
        .join(counts[3], true())
        .join(VEHICLES, vehicle, isouter=True)
    )


_SURROUNDINGS = _surroundings_query()


def count_stored(connection: Connection, ingest_id: int, packets: int, samples: int, *, joined: bool) -> None:
    """Add to the totals of an ingest, in the transaction that stores the packets.

    An ingest that is interrupted and run again finds its own packets in the archive: the totals stay complete.
    """
    if not packets and not samples:
        return
    added = {"packets_stored": packets, "samples_stored": samples, "packets_joined": packets if joined else 0}
    connection.execute(
        update(PIECES)
        .where(PIECES.c.ingest_id == ingest_id)
        .values({name: PIECES.c[name] + number for name, number in added.items()})
    )


def finish_piece(connection: Connection, ingest_id: int, packets: int, samples: int) -> tuple[int, int, int]:
    """Record that a piece has been read and add to its totals; return them as `stored_by` does."""
    added = {"packets_stored": packets, "samples_stored": samples}
    row = connection.execute(
        update(PIECES)
        .where(PIECES.c.ingest_id == ingest_id)
        .values(links_tried=None, **{name: PIECES.c[name] + number for name, number in added.items()})
        .returning(PIECES.c.packets_stored, PIECES.c.packets_joined, PIECES.c.samples_stored)
    ).one()
    return int(row[0]), int(row[1]), int(row[2])


def stored_by(connection: Connection, ingest_id: int) -> tuple[int, int, int]:
    """Return the new packets, those of them that were joined, and the samples that an ingest has stored."""
    columns = PIECES.c.packets_stored, PIECES.c.packets_joined, PIECES.c.samples_stored
    packets, joined, samples = connection.execute(
        select(*columns).where(PIECES.c.ingest_id == ingest_id)
    ).one()
    return int(packets), int(joined), int(samples)


def note_read(connection: Connection, ingest_id: int, links_tried: int | None) -> None:
    """Record that a piece has been read (None), or the number of links that could not read it."""
    connection.execute(update(PIECES).where(PIECES.c.ingest_id == ingest_id).values(links_tried=links_tried))


def pieces_to_read_again(connection: Connection, scope: str, links: int) -> list[int]:
    """Return the ingests whose pieces could not be read when fewer links were known."""
    rows = connection.execute(
        select(PIECES.c.ingest_id)
        .where(PIECES.c.scope == scope, PIECES.c.links_tried < links)
        .order_by(PIECES.c.ingest_id)
    )
    return [int(key) for key in rows.scalars()]


def octets_before(connection: Connection, piece: Piece, octets: int) -> list[Part]:
    """Return the parts of files with the octets before a piece, in order, as far as available."""
    parts: list[Part] = []
    end = piece.position
    while octets > 0:
        rows = _pieces(connection, piece, PIECES.c.position < end, newest_first=True)
        for row in rows:
            if not _may_follow(piece, row):
                continue
            covered = row["octets"] if not piece.stream else end - row["position"]
            if covered > row["octets"]:
                return parts  # octets between the two are missing
            taken = min(covered, octets)
            parts.insert(0, Part(row["file_sha256"], covered - taken, covered))
            octets -= taken
            end = row["position"]
            if octets <= 0:
                break
        if len(rows) < _BLOCK or end != rows[-1]["position"]:
            break
    return parts


def octets_behind(connection: Connection, piece: Piece, octets: int) -> list[Part]:
    """Return the parts of files with the octets after a piece, in order, as far as available."""
    parts: list[Part] = []
    after = piece.position
    end = piece.position + piece.octets
    while octets > 0:
        rows = _pieces(connection, piece, PIECES.c.position > after, newest_first=False)
        for row in rows:
            if not _may_follow(piece, row):
                continue
            skipped = 0
            if piece.stream:
                if row["position"] > end:
                    return parts
                skipped = end - row["position"]
            after = row["position"]
            if skipped >= row["octets"]:
                continue
            taken = min(row["octets"] - skipped, octets)
            parts.append(Part(row["file_sha256"], skipped, skipped + taken))
            octets -= taken
            end += taken
            if octets <= 0:
                return parts
        if len(rows) < _BLOCK or after != rows[-1]["position"]:
            break
    return parts


def _may_follow(piece: Piece, row: Any) -> bool:
    """Return whether a piece may be adjacent to another; pieces of different requested spacecraft are not."""
    asked = {piece.spacecraft_id, row["spacecraft_id"]} - {None}
    return bool(piece.stream) or len(asked) < 2


def _pieces(connection: Connection, piece: Piece, condition: Any, *, newest_first: bool) -> list[Any]:
    order = PIECES.c.position.desc() if newest_first else PIECES.c.position
    return list(
        connection.execute(
            select(PIECES.c.file_sha256, PIECES.c.spacecraft_id, PIECES.c.octets, PIECES.c.position)
            .where(PIECES.c.scope == piece.scope, PIECES.c.stream == piece.stream, condition)
            .order_by(order)
            .limit(_BLOCK)
        ).mappings()
    )


def known_links(connection: Connection, scope: str) -> list[Link]:
    """Return the known links of the downlinks of a scope, oldest first."""
    rows = connection.execute(
        select(KNOWN_LINKS.c.settings).where(KNOWN_LINKS.c.scope == scope).order_by(KNOWN_LINKS.c.id)
    )
    return [_link(settings) for settings in rows.scalars()]


def learn_link(connection: Connection, scope: str, link: Link) -> None:
    """Record a link of the downlinks of a scope."""
    _insert_new(
        connection,
        KNOWN_LINKS,
        [{"scope": scope, "digest": link_digest(link), "settings": _settings(link)}],
    )


def good_links(connection: Connection, piece: Piece, station: str | None) -> list[LinkSettings]:
    """Return the last good settings of the spacecraft of a piece, of one station or of any, newest first."""
    query = (
        select(GOOD_LINKS.c.vehicle_id, GOOD_LINKS.c.station, GOOD_LINKS.c.settings)
        .join(VEHICLES, VEHICLES.c.id == GOOD_LINKS.c.vehicle_id)
        .where(VEHICLES.c.instance == piece.scope)
        .order_by(GOOD_LINKS.c.id.desc())
        .limit(_BLOCK)
    )
    if station is not None:
        query = query.where(GOOD_LINKS.c.station == station)
    if piece.spacecraft_id is not None:
        query = query.where(VEHICLES.c.ccsds_id == piece.spacecraft_id)
    newest: dict[tuple[int, str], LinkSettings] = {}
    for vehicle, place, settings in connection.execute(query):
        newest.setdefault((vehicle, place), LinkSettings(**settings))
    return list(newest.values())


def add_good_link(
    connection: Connection, piece: Piece, vehicle: int, settings: LinkSettings, now_utc_ns: int
) -> bool:
    """Add good settings of a vehicle; return False if they are its last ones of the station of the piece."""
    last = connection.execute(
        select(GOOD_LINKS.c.settings)
        .where(GOOD_LINKS.c.vehicle_id == vehicle, GOOD_LINKS.c.station == piece.station)
        .order_by(GOOD_LINKS.c.id.desc())
        .limit(1)
    ).scalar()
    if last == asdict(settings):
        return False
    values = {
        "vehicle_id": vehicle,
        "station": piece.station,
        "settings": asdict(settings),
        "ingest_id": piece.ingest_id,
        "since_utc_ns": now_utc_ns,
    }
    connection.execute(insert(GOOD_LINKS).values(values))
    return True


def link_digest(link: Link) -> str:
    """Return a short identifier of a link, derived from its settings."""
    text = json.dumps(_settings(link), sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _settings(link: Link) -> dict[str, Any] | None:
    return None if link.settings is None else asdict(link.settings)


def _link(settings: dict[str, Any] | None) -> Link:
    return BARE if settings is None else Link(LinkSettings(**settings))


def add_edges(
    connection: Connection, domain: str, edges: Iterable[Edge], file_sha256: str | None = None
) -> list[bytes]:
    """Store the new edges of a domain; return the identities of all."""
    rows: list[dict[str, Any]] = [
        {
            "domain": domain,
            "identity": identity_of(edge, file_sha256),
            "role": edge.role,
            "open": 1,
            "count": edge.next_count if edge.role == OPENER else edge.count,
            "next_count": edge.next_count,
            "fit": edge.fit,
            "file_sha256": file_sha256,
            "start": edge.start,
            "length": len(edge.octets),
            "octets": edge.octets,
        }
        for edge in edges
    ]
    _insert_new(connection, STREAM_EDGES, sorted(rows, key=lambda row: row["identity"]))
    return [bytes(row["identity"]) for row in rows]


def identity_of(edge: Edge, file_sha256: str | None) -> bytes:
    """Return the identity of an edge in its domain: by position for octets of a file, otherwise by content."""
    digest = hashlib.blake2b(digest_size=DIGEST_OCTETS)
    place = (edge.role, edge.count, edge.next_count, file_sha256, edge.start, len(edge.octets))
    digest.update(repr(place).encode())
    if file_sha256 is None:
        digest.update(edge.octets)
    return digest.digest()


def open_edges(connection: Connection, domain: str, identities: Sequence[bytes]) -> list[StoredEdge]:
    """Return the edges that still wait."""
    found: list[StoredEdge] = []
    for first in range(0, len(identities), 500):
        rows = connection.execute(
            select(STREAM_EDGES).where(
                STREAM_EDGES.c.domain == domain,
                STREAM_EDGES.c.identity.in_(identities[first : first + 500]),
                STREAM_EDGES.c.open == 1,
            )
        )
        found += [_stored(row) for row in rows.mappings()]
    return found


def candidates(
    connection: Connection,
    domain: str,
    role: int,
    *,
    fit: Collection[int] | None = None,
    count: Collection[int] | None = None,
    next_count: int | None = None,
    limit: int = _BLOCK,
) -> list[StoredEdge]:
    """Return at most `limit` waiting edges with one of these values, newest first."""
    conditions = [STREAM_EDGES.c.domain == domain, STREAM_EDGES.c.role == role, STREAM_EDGES.c.open == 1]
    if fit is not None:
        conditions.append(STREAM_EDGES.c.fit.in_(fit))
    if count is not None:
        conditions.append(STREAM_EDGES.c.count.in_(count))
    if next_count is not None:
        conditions.append(STREAM_EDGES.c.next_count == next_count)
    rows = connection.execute(
        select(STREAM_EDGES).where(*conditions).order_by(STREAM_EDGES.c.id.desc()).limit(limit)
    )
    return [_stored(row) for row in rows.mappings()]


def open_starts(connection: Connection, domain: str, part: Part) -> list[int]:
    """Return the start positions of waiting openers within a part of a file."""
    rows = connection.execute(
        select(STREAM_EDGES.c.start)
        .where(
            STREAM_EDGES.c.file_sha256 == part.file_sha256,
            STREAM_EDGES.c.open == 1,
            STREAM_EDGES.c.domain == domain,
            STREAM_EDGES.c.role == OPENER,
            STREAM_EDGES.c.start >= part.start,
            STREAM_EDGES.c.start < part.stop,
        )
        .order_by(STREAM_EDGES.c.start)
    )
    return [int(start) for start in rows.scalars()]


def is_reusable(edge: Edge) -> bool:
    """Return whether octets may occur at several positions of a stream, so that they are kept after use."""
    return edge.role == MIDDLE and len(edge.octets) < REUSABLE_OCTETS


def use_edges(
    connection: Connection, edges: Iterable[StoredEdge], parts: Iterable[tuple[str, Part]] = ()
) -> None:
    """Mark edges as used, and edges of a domain that lie within parts of files.

    Rows are locked in the order of their ids, so that two transactions that use the same edges do not deadlock.
    """
    keys = {one.id for one in edges if not is_reusable(one.edge)}
    for domain, part in parts:
        keys.update(
            connection.execute(
                _WITHIN,
                {
                    "file_sha256": part.file_sha256,
                    "domain": domain,
                    "start": part.start,
                    "stop": part.stop,
                },
            ).scalars()
        )
    if not keys:
        return
    if connection.dialect.name == "postgresql":
        locked = select(STREAM_EDGES.c.id).where(STREAM_EDGES.c.id.in_(keys)).order_by(STREAM_EDGES.c.id)
        connection.execute(locked.with_for_update()).all()
    connection.execute(update(STREAM_EDGES).where(STREAM_EDGES.c.id.in_(keys)).values(open=0, octets=b""))


def octets_pending(connection: Connection, file_sha256: str) -> int:
    """Return the number of octets of a file that wait for adjacent pieces, for the link that explains most of it."""
    rows = connection.execute(
        select(STREAM_EDGES.c.domain, STREAM_EDGES.c.open, STREAM_EDGES.c.start, STREAM_EDGES.c.length).where(
            STREAM_EDGES.c.file_sha256 == file_sha256
        )
    ).all()
    waiting: dict[str, list[tuple[int, int]]] = {}
    for domain, is_open, start, length in rows:
        ranges = waiting.setdefault(domain, [])
        if is_open:
            ranges.append((int(start), int(start + length)))
    return min((_covered(ranges) for ranges in waiting.values()), default=0)


def _covered(ranges: list[tuple[int, int]]) -> int:
    total = reached = 0
    for start, stop in sorted(ranges):
        total += max(stop - max(start, reached), 0)
        reached = max(reached, stop)
    return total


def _stored(row: Any) -> StoredEdge:
    missing = row["fit"] if row["role"] == OPENER else UNKNOWN
    edge = Edge(row["role"], row["count"], row["next_count"], bytes(row["octets"]), row["start"], missing)
    return StoredEdge(row["id"], row["domain"], row["file_sha256"], edge)


def _insert_new(connection: Connection, table: Any, rows: Sequence[dict[str, Any]]) -> None:
    """Insert rows whose key does not exist yet."""
    if not rows:
        return
    dialect = postgresql if connection.dialect.name == "postgresql" else sqlite
    statement: Any = dialect.insert(table)
    connection.execute(statement.on_conflict_do_nothing(), list(rows))
