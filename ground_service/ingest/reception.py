"""Link settings and station records that apply to a piece: stated, of the mission description, or remembered.

The settings of a description or of earlier receptions are tried on the whole file and used where they hold. Other
settings follow from the evidence of the file. Only settings that the sender states are used without evidence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection

from ground_service.access.service import audit
from ground_service.ingest.edge_store import Piece, add_good_link, good_links
from ground_service.ingest.quality import NO_RECORD, RecordFormat
from ground_service.missions.model import FrameSettings, Link, StationLink
from ground_service.missions.store import links_in_force
from tmtc.link import LinkSettings

STATED, MISSION, REMEMBERED, PROPOSED = "stated", "mission", "remembered", "proposed"
ACTOR = "ingest"

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

    `stated` settings are used as they are. `mission` and `remembered` settings are tried in this order.
    `error_control` is False if the packets of the spacecraft do not end with a checksum.
    """

    stated: LinkSettings | None = None
    mission: tuple[LinkSettings, ...] = ()
    remembered: tuple[LinkSettings, ...] = ()
    record: RecordFormat = NO_RECORD
    error_control: bool = True

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


def expected_link(connection: Connection, piece: Piece) -> ExpectedLink:
    """Return what is known of the link of a piece."""
    links = links_in_force(connection, piece.spacecraft_id, piece.scope)
    found = [settings_of(link, piece.station) for link in links.values()]
    stations = [station for link in links.values() if (station := _station(link, piece.station))]
    remembered = [*good_links(connection, piece, piece.station), *good_links(connection, piece, None)]
    own = links.get(piece.spacecraft_id) if piece.spacecraft_id is not None else None
    return ExpectedLink(
        stated=None if piece.link is None else LinkSettings.parse(piece.link).explicit,
        mission=tuple(dict.fromkeys(one for one in found if one is not None)),
        remembered=tuple(dict.fromkeys(remembered)),
        record=_record(stations[0]) if stations else NO_RECORD,
        error_control=own is None or own.packet_checksum != "none",
    )


def settings_of(link: Link, station: str) -> LinkSettings | None:
    """Return the settings that a description states for a station; None if coding or frame length are not stated."""
    parts: list[FrameSettings] = [link]
    if (special := _station(link, station)) is not None:
        parts.append(special)
    values: dict[str, Any] = {}
    for part in parts:
        stated: Mapping[str, Any] = part.model_dump(exclude_none=True)
        values |= {_NAMES[name]: value for name, value in stated.items() if name in _NAMES}
    if not {"frame_length", "coding"} <= values.keys():
        return None
    return LinkSettings(**values).explicit


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
    vehicles: Sequence[int],
    settings: LinkSettings,
    now_utc_ns: int,
) -> None:
    """Record settings under which frames of spacecraft were valid, if they differ from the last ones."""
    for vehicle in vehicles:
        if not add_good_link(connection, piece, vehicle, settings, now_utc_ns):
            continue
        detail = {"ingest_id": piece.ingest_id, "station": piece.station, "settings": describe(settings)}
        audit(connection, ACTOR, "remember link settings", f"vehicle {vehicle}", detail)
