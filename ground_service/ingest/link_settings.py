"""Declarations that a piece is read with: link settings, station records and packets.

Link settings are those that the sender or the mission description states, otherwise the defaults of `LinkSettings`.
They are never inferred from the octets. Descriptions are only ever added: they are kept in memory and read again when
one query shows that something was added.
"""

import threading
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

from sqlalchemy import Connection, Engine

from ground_service.ingest.core import NO_RECORD, RecordFormat
from ground_service.ingest.recording_store import Piece, Surroundings, surroundings
from ground_service.missions.definitions import PacketDefinitions
from ground_service.missions.model import Link, StationLink
from ground_service.missions.store import links_in_force
from ground_service.telemetry.decoding import definitions_of_spacecraft
from tmtc.link.settings import LinkSettings
from tmtc.packets.stream import CHECKED, PacketForm

STATED, MISSION, DEFAULT = "stated", "mission", "default"

KEPT = 64
"""Largest number of scopes, spacecraft and stations whose knowledge is kept."""

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
    """Declared link of a piece: settings that its frames may have, station records and form of the packets.

    `settings` are those of its sender, or of the descriptions in force of its spacecraft, or of all spacecraft; the
    defaults come last where a spacecraft may have no description that states settings.
    """

    stated: LinkSettings | None
    mission: tuple[LinkSettings, ...]
    record: RecordFormat
    form: PacketForm
    has_default: bool

    @property
    def settings(self) -> tuple[LinkSettings, ...]:
        """Settings that frames may have, the most likely first."""
        if self.stated is not None:
            return (self.stated,)
        default = (LinkSettings().explicit,) if self.has_default else ()
        return tuple(dict.fromkeys((*self.mission, *default)))

    def source_of(self, settings: LinkSettings) -> str:
        """Return who declares settings."""
        if self.stated is not None:
            return STATED
        return MISSION if settings in self.mission else DEFAULT


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """Knowledge before a piece is read; `definitions` is None for a piece of any spacecraft."""

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
    form = CHECKED
    if piece.spacecraft_id is not None:
        form = packet_form(connection, piece.spacecraft_id, piece.scope, piece.station)
    mission = tuple(dict.fromkeys(one for one in found if one is not None))
    return ExpectedLink(
        stated=None if piece.link is None else LinkSettings.parse(piece.link).explicit,
        mission=mission,
        record=_record(stations[0]) if stations else NO_RECORD,
        form=form,
        has_default=piece.spacecraft_id is None or not mission,
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
    """Return the settings that a description states for a station, with defaults; None if it states none."""
    stated = {_NAMES[name]: value for name, value in _stated(link, station).items() if name in _NAMES}
    return LinkSettings(**stated).explicit if stated else None


def _stated(link: Link, station: str) -> dict[str, Any]:
    """Return what a description states by name for a station."""
    special = _station(link, station)
    of_station = {} if special is None else special.model_dump(exclude_none=True)
    return link.model_dump(exclude_none=True) | of_station


def _station(link: Link, station: str) -> StationLink | None:
    return (link.stations or {}).get(station)


def _record(station: StationLink) -> RecordFormat:
    return RecordFormat(
        station.header_octets or 0, station.trailer_octets or 0, station.time_code, station.time_offset or 0
    )
