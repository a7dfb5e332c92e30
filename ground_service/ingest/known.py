"""What is known before a piece of a downlink is read: links, declared packets, and whether something waits.

Links, good settings and mission descriptions are only ever added. They are kept in memory and read again when one query
shows that something was added.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from weakref import WeakKeyDictionary

from sqlalchemy import Connection, Engine

from ground_service.ingest import edge_store as edges
from ground_service.ingest.edge_store import Piece, Surroundings
from ground_service.ingest.parameters import definitions_of_spacecraft
from ground_service.ingest.reception import ExpectedLink, expected_link
from ground_service.ingest.stream import Link
from ground_service.missions.definitions import PacketDefinitions
from tmtc.dictionary import DICTIONARY

KEPT = 64
"""Largest number of scopes, spacecraft and stations whose knowledge is kept."""


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What is known before a piece is read; `definitions` is None for a piece of any spacecraft."""

    links: list[Link]
    expected: ExpectedLink
    definitions: PacketDefinitions | None
    around: Surroundings

    @property
    def is_settled(self) -> bool:
        """Whether nothing waits for this piece, and its spacecraft is decoded with the dictionary of this version."""
        return (
            self.definitions is not None
            and not self.definitions.declared
            and not self.around.waits
            and self.around.vehicle_id is not None
            and self.around.decoded_version == DICTIONARY.version
            and self.around.redecoding_version is None
        )


_Key = tuple[str, int | None, str, str | None]
_Kept = tuple[tuple[int, ...], list[Link], ExpectedLink, PacketDefinitions | None]

_kept: WeakKeyDictionary[Engine, dict[_Key, _Kept]] = WeakKeyDictionary()
_lock = threading.Lock()


def known_before(connection: Connection, piece: Piece) -> Known:
    """Return what is known before a piece is read."""
    around = edges.surroundings(connection, piece)
    key = (piece.scope, piece.spacecraft_id, piece.station, piece.link)
    with _lock:
        kept = _kept.setdefault(connection.engine, {})
        found = kept.get(key)
    if found is None or found[0] != around.revision:
        definitions = None
        if piece.spacecraft_id is not None:
            definitions, _ = definitions_of_spacecraft(connection, piece.spacecraft_id, piece.scope)
        links = edges.known_links(connection, piece.scope)
        found = (around.revision, links, expected_link(connection, piece), definitions)
        with _lock:
            if len(kept) >= KEPT:
                kept.clear()
            kept[key] = found
    return Known(list(found[1]), found[2], found[3], around)
