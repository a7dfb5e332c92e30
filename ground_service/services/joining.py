"""Putting together what was cut apart between two files: a packet or a frame that ends in one and goes on in the next.

Every ingested file leaves a note of how it begins and ends. When two of them fit (the loose octets make up one whole
frame, the frame counts follow each other, or the loose octets make up one packet), the octets around the cut are
read as one stream and stored like any others. Since all pairs are tried whichever file came first, the archive does
not depend on the order. A file has to hold at least one whole frame (or packet) to be placed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from sqlalchemy import Connection, select

from ground_service.link.packets import PacketBatch
from ground_service.link.stream import DownlinkReader, StreamEdges, reach_octets
from ground_service.store import repository
from ground_service.store.files import FileArchive
from ground_service.store.packets import store_batch
from tmtc.downlink import LinkSettings
from tmtc.packets import PRIMARY_HEADER_LENGTH

COUNT_MODULUS = 256

Edge = dict[str, Any]


def join_with_others(
    connection: Connection,
    files: FileArchive,
    vehicle: int,
    spacecraft_id: int,
    sha256: str,
    edges: StreamEdges,
) -> int:
    """Note how a file begins and ends, and store what it completes together with files noted before.

    Returns how many packets that gave.
    """
    # One file at a time: of two that are ingested at once, the later has to see the edges of the earlier.
    vehicles = repository.VEHICLES
    connection.execute(select(vehicles.c.id).where(vehicles.c.id == vehicle).with_for_update())
    table = repository.STREAM_EDGES
    known = connection.execute(select(table).where(table.c.vehicle_id == vehicle)).mappings()
    others = [dict(row) for row in known]
    mine = next((row for row in others if row["file_sha256"] == sha256), None)
    if mine is None:
        mine = {
            "vehicle_id": vehicle,
            "file_sha256": sha256,
            "link": asdict(edges.settings) if edges.settings is not None else None,
            "octets": edges.octets,
            "head_loose": edges.head_loose,
            "tail_loose": edges.tail_loose,
            "head_count": edges.head_count,
            "tail_count": edges.tail_count,
        }
        repository.add(connection, table, **mine)
        others.append(mine)
    new = 0
    for before in others:
        for after in others:
            if (before is mine or after is mine) and _fit(files, before, after):
                for batch in _across(files, others, before, after, spacecraft_id):
                    new += store_batch(connection, vehicle, batch).new
    return new


def _fit(files: FileArchive, before: Edge, after: Edge) -> bool:
    """Whether `after` may go on where `before` ends."""
    if before is after or before["link"] != after["link"]:
        return False
    loose = before["tail_loose"] + after["head_loose"]
    if before["link"] is None:
        return (
            before["tail_loose"] > 0
            and after["head_loose"] > 0
            and _makes_a_packet(files, before, after, loose)
        )
    cadu_length = LinkSettings(**before["link"]).cadu_length
    if loose not in (0, cadu_length):
        return False
    if before["tail_count"] is None or after["head_count"] is None:
        return True
    step = 2 if loose else 1
    return bool((before["tail_count"] + step) % COUNT_MODULUS == after["head_count"])


def _makes_a_packet(files: FileArchive, before: Edge, after: Edge, loose: int) -> bool:
    """Whether the loose octets are as long as the packet header at their beginning says."""
    head = _end(files, before, before["tail_loose"]) + _start(files, after, min(after["head_loose"], 8))
    if len(head) < PRIMARY_HEADER_LENGTH:
        return False
    return int.from_bytes(head[4:6], "big") + 7 == loose


def _across(
    files: FileArchive, others: list[Edge], before: Edge, after: Edge, spacecraft_id: int
) -> Iterator[PacketBatch]:
    """What the octets around a cut hold, read as one stream."""
    if before["link"] is None:
        stream = _end(files, before, before["tail_loose"]) + _start(files, after, after["head_loose"])
    else:
        reach = reach_octets(LinkSettings(**before["link"]))
        stream = _back(files, others, before, reach) + _forth(files, others, after, reach)
    yield from DownlinkReader(spacecraft_id).batches([stream])


def _back(files: FileArchive, others: list[Edge], edge: Edge, octets: int) -> bytes:
    """The last octets up to the end of a file, with those of the files before it where it is short."""
    stream = b""
    seen: list[str] = []
    while True:
        stream = _end(files, edge, octets - len(stream)) + stream
        seen.append(edge["file_sha256"])
        if len(stream) >= octets:
            return stream
        earlier = [o for o in others if o["file_sha256"] not in seen and _fit(files, o, edge)]
        if len(earlier) != 1:
            return stream
        edge = earlier[0]


def _forth(files: FileArchive, others: list[Edge], edge: Edge, octets: int) -> bytes:
    """The first octets of a file, with those of the files after it where it is short."""
    stream = b""
    seen: list[str] = []
    while True:
        stream += _start(files, edge, octets - len(stream))
        seen.append(edge["file_sha256"])
        if len(stream) >= octets:
            return stream
        later = [o for o in others if o["file_sha256"] not in seen and _fit(files, edge, o)]
        if len(later) != 1:
            return stream
        edge = later[0]


def _start(files: FileArchive, edge: Edge, octets: int) -> bytes:
    with files.path(edge["file_sha256"]).open("rb") as stream:
        return stream.read(octets)


def _end(files: FileArchive, edge: Edge, octets: int) -> bytes:
    with files.path(edge["file_sha256"]).open("rb") as stream:
        stream.seek(max(edge["octets"] - octets, 0))
        return stream.read()
