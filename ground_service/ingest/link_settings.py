"""What is known before a piece is read: link settings, station records and declared packets.

The settings of a mission description or of earlier receptions are tried and used where they hold. Other settings follow
from the evidence of the octets. Only settings that the sender states are used without evidence. Settings and
descriptions are only ever added: they are kept in memory and read again when one query shows that something was added.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

from sqlalchemy import Connection, Engine

from ground_service.access.service import audit
from ground_service.ingest.parameters import definitions_of_spacecraft
from ground_service.ingest.quality import NO_RECORD, RecordFormat
from ground_service.ingest.recording_store import (
    Piece,
    Surroundings,
    add_good_link,
    good_links,
    surroundings,
)
from ground_service.missions.definitions import PacketDefinitions
from ground_service.missions.model import Link, StationLink
from ground_service.missions.store import links_in_force
from tmtc.link import LinkSettings
from tmtc.stream import CHECKED, PacketForm

STATED, MISSION, REMEMBERED, PROPOSED = "stated", "mission", "remembered", "proposed"
ACTOR = "ingest"

KEPT = 64
"""Largest number of scopes, spacecraft and stations whose knowledge is kept."""

DEFAULT_LINKS = (LinkSettings().explicit, LinkSettings(checksum=False).explicit)
"""Settings that are tried without any evidence."""

_NAMES = {
    "frame_length": "frame_length",
    "coding": "coding",
    "randomiser": "randomiser",
    "interleave": "interleave",
    "rs_errors": "rs_errors",
    "dual_basis": "dual_basis",
    "frame_checksum": "checksum",
}


@dataclass(frozen=True, slots=True)
class ExpectedLink:
    """What is known of the link of a piece before it is read.

    `stated` settings are used as they are. `mission` and `remembered` settings are tried in this order. `form` is that
    of the packets of the spacecraft.
    """

    stated: LinkSettings | None = None
    mission: tuple[LinkSettings, ...] = ()
    remembered: tuple[LinkSettings, ...] = ()
    record: RecordFormat = NO_RECORD
    form: PacketForm = CHECKED

    @property
    def candidates(self) -> list[LinkSettings]:
        """Settings to try, the most likely first."""
        return list(dict.fromkeys([*self.mission, *self.remembered, *DEFAULT_LINKS]))

    def source_of(self, settings: LinkSettings) -> str:
        """Return where settings come from."""
        same = describe(settings)
        if self.stated is not None:
            return STATED
        if same in [describe(one) for one in self.mission]:
            return MISSION
        return REMEMBERED if same in [describe(one) for one in self.remembered] else PROPOSED


def describe(settings: LinkSettings) -> dict[str, Any]:
    """Return settings by name; equal for settings that give equal frames."""
    return settings.describe()


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What is known before a piece is read; `definitions` is None for a piece of any spacecraft."""

    expected: ExpectedLink
    definitions: PacketDefinitions | None
    around: Surroundings


_Key = tuple[str, int | None, str, str | None]
_Kept = tuple[tuple[int, ...], ExpectedLink, PacketDefinitions | None]

_kept: WeakKeyDictionary[Engine, dict[_Key, _Kept]] = WeakKeyDictionary()
_lock = threading.Lock()


def known_before(connection: Connection, piece: Piece) -> Known:
    """Return what is known before a piece is read."""
    around = surroundings(connection, piece)
    key = (piece.scope, piece.spacecraft_id, piece.station, piece.link)
    with _lock:
        kept = _kept.setdefault(connection.engine, {})
        found = kept.get(key)
    if found is None or found[0] != around.revision:
        definitions = None
        if piece.spacecraft_id is not None:
            definitions, _ = definitions_of_spacecraft(connection, piece.spacecraft_id, piece.scope)
        found = (around.revision, expected_link(connection, piece), definitions)
        with _lock:
            if len(kept) >= KEPT:
                kept.clear()
            kept[key] = found
    return Known(found[1], found[2], around)


def expected_link(connection: Connection, piece: Piece) -> ExpectedLink:
    """Return what is known of the link of a piece."""
    links = links_in_force(connection, piece.spacecraft_id, piece.scope)
    found = [settings_of(link, piece.station) for link in links.values()]
    stations = [station for link in links.values() if (station := _station(link, piece.station))]
    remembered = [*good_links(connection, piece, piece.station), *good_links(connection, piece, None)]
    form = CHECKED
    if piece.spacecraft_id is not None:
        form = packet_form(connection, piece.spacecraft_id, piece.scope, piece.station)
    return ExpectedLink(
        stated=None if piece.link is None else LinkSettings.parse(piece.link).explicit,
        mission=tuple(dict.fromkeys(one for one in found if one is not None)),
        remembered=tuple(dict.fromkeys(remembered)),
        record=_record(stations[0]) if stations else NO_RECORD,
        form=form,
    )


def packet_form(connection: Connection, spacecraft: int, scope: str, station: str) -> PacketForm:
    """Return how the packets of a spacecraft stand in the recordings of a station."""
    link = links_in_force(connection, spacecraft, scope).get(spacecraft)
    stated = {} if link is None else _stated(link, station)
    definitions, _ = definitions_of_spacecraft(connection, spacecraft, scope)
    return replace(
        definitions.form,
        error_control=stated.get("packet_checksum") != "none",
        prefix_octets=stated.get("packet_prefix_octets", 0),
    )


def settings_of(link: Link, station: str) -> LinkSettings | None:
    """Return the settings that a description states for a station; None if coding or frame length are not stated."""
    stated = _stated(link, station)
    if not {"frame_length", "coding"} <= stated.keys():
        return None
    return LinkSettings(**{_NAMES[name]: value for name, value in stated.items() if name in _NAMES}).explicit


def _stated(link: Link, station: str) -> dict[str, Any]:
    """Return what a description states by name for a station."""
    special = _station(link, station)
    of_station = {} if special is None else special.model_dump(exclude_none=True)
    return link.model_dump(exclude_none=True) | of_station


def _station(link: Link, station: str) -> StationLink | None:
    return (link.stations or {}).get(station)


def _record(station: StationLink) -> RecordFormat:
    return RecordFormat(
        station.header_octets or 0,
        station.trailer_octets or 0,
        station.time_code,
        station.time_offset or 0,
    )


def remember_link(
    connection: Connection,
    piece: Piece,
    vehicles: Iterable[int],
    settings: LinkSettings,
    now_utc_ns: int,
) -> None:
    """Record settings under which frames of spacecraft were valid, if they differ from the last ones."""
    for vehicle in sorted(vehicles):
        if not add_good_link(connection, piece, vehicle, settings, now_utc_ns):
            continue
        detail = {"ingest_id": piece.ingest_id, "station": piece.station, "settings": describe(settings)}
        audit(connection, ACTOR, "remember link settings", f"vehicle {vehicle}", detail)
