"""Database access for mission descriptions."""

from functools import lru_cache
from typing import Any

from sqlalchemy import Connection, func, select, update
from sqlalchemy.exc import IntegrityError

from ground_service.errors import NotFound
from ground_service.http.model import PageOf, Paging
from ground_service.missions.automation import Channel
from ground_service.missions.model import (
    Approval,
    HeldCatalogue,
    Link,
    Mission,
    MissionDetail,
    MissionRevision,
    parse_mission,
)
from ground_service.store import repository
from ground_service.store.vehicles import ARCHIVE_ACTOR

MISSIONS = repository.MISSIONS
CATALOGUE_KIND, WITHDRAWN_KIND = "catalogue", "withdrawn catalogue"
REVISION_PREFIX = 8
"""Smallest number of hash digits that identify a revision."""


def add_revision(
    connection: Connection, mission: Mission, text: str, *, actor: str, now_utc_ns: int
) -> tuple[int, bool]:
    """Enter a revision; its id, and whether it is new. The same content again gives the same entry.

    A revision that came with an archive becomes that of the person who enters it, from then on in force.
    """
    known = repository.find(connection, MISSIONS, revision=mission.revision)
    if known is not None:
        taken_over = (
            actor != ARCHIVE_ACTOR
            and connection.execute(
                update(MISSIONS)
                .where(MISSIONS.c.id == known["id"], MISSIONS.c.entered_by == ARCHIVE_ACTOR)
                .values(entered_by=actor, created_utc_ns=now_utc_ns)
            ).rowcount
        )
        return int(known["id"]), bool(taken_over)
    try:
        with connection.begin_nested():
            return int(
                repository.add(
                    connection,
                    MISSIONS,
                    revision=mission.revision,
                    name=mission.name,
                    ccsds_id=mission.spacecraft.id,
                    text=text,
                    entered_by=actor,
                    created_utc_ns=now_utc_ns,
                )
            ), True
    except IntegrityError:  # another process added the same content at the same time
        known = repository.find(connection, MISSIONS, revision=mission.revision)
        if known is None:
            raise
        return int(known["id"]), False


def get_mission(connection: Connection, mission_id: int) -> Mission:
    """Return the document of a stored revision."""
    return _document(repository.get(connection, MISSIONS, mission_id, "mission revision"))


def find_revision(connection: Connection, revision: str) -> MissionDetail:
    """Return the revision whose hash begins with `revision`.

    Raises
    ------
    NotFound
        No hash, or several, begin with these digits.
    """
    wanted = revision.strip().lower()
    rows: list[Any] = []
    if len(wanted) >= REVISION_PREFIX and all(c in "0123456789abcdef" for c in wanted):
        query = select(MISSIONS).where(MISSIONS.c.revision.startswith(wanted, autoescape=True)).limit(2)
        rows = list(connection.execute(query).mappings())
    if len(rows) != 1:
        raise NotFound("mission revision", revision[:80])
    return _detail(dict(rows[0]))


def detail(connection: Connection, mission_id: int) -> MissionDetail:
    """Return a stored revision with its document."""
    return _detail(repository.get(connection, MISSIONS, mission_id, "mission revision"))


def list_missions(connection: Connection, asked: Paging) -> PageOf[MissionRevision]:
    """List the revisions of mission descriptions, newest first."""
    rows, total = repository.newest(connection, MISSIONS, asked)
    return asked.page((MissionRevision(**_columns(row, _document(row))) for row in rows), total)


def links_in_force(connection: Connection, ccsds_id: int | None, instance: str) -> dict[int, Link]:
    """Return the links that the descriptions in force of a spacecraft, or of all, state, by spacecraft.

    The instance of an archive has the description that came with the archive.
    """
    found = {key: mission.link for key, mission in missions_in_force(connection, ccsds_id).items()}
    for spacecraft, key in _archived(connection, instance).items():
        if ccsds_id in (None, spacecraft):
            found[spacecraft] = get_mission(connection, key).link
    return found


def packets_in_force(connection: Connection, ccsds_id: int, instance: str) -> int | None:
    """Return the id of the revision that declares the packets of a spacecraft in one instance; None without any.

    The instance of an archive has the packets that the description of the archive declares, if it declares any.
    """
    key = _archived(connection, instance).get(ccsds_id)
    if key is not None and get_mission(connection, key).packets is not None:
        return key
    return newest_of_spacecraft(connection, ccsds_id)


def _archived(connection: Connection, instance: str) -> dict[int, int]:
    """Return the revisions that came with the archive of an instance, by spacecraft."""
    passes, vehicles = repository.PASSES, repository.VEHICLES
    query = (
        select(vehicles.c.ccsds_id, passes.c.mission_id)
        .join(vehicles, vehicles.c.id == passes.c.vehicle_id)
        .where(vehicles.c.instance == instance, passes.c.archive_digest.is_not(None), passes.c.mission_id.is_not(None))
        .order_by(passes.c.id)
    )
    return {int(spacecraft): int(key) for spacecraft, key in connection.execute(query)}


def missions_in_force(connection: Connection, ccsds_id: int | None = None) -> dict[int, Mission]:
    """Return the descriptions in force of a spacecraft, or of all, by spacecraft."""
    found = keys_in_force(connection, ccsds_id)
    return {spacecraft: get_mission(connection, key) for spacecraft, key in found.items()}


def channels_in_force(connection: Connection) -> list[tuple[int, str, Channel]]:
    """Return spacecraft, name and channel of notifications of all descriptions in force."""
    missions = missions_in_force(connection).items()
    return [(one, *found) for one, mission in missions for found in mission.notify.items()]


def keys_in_force(connection: Connection, ccsds_id: int | None = None) -> dict[int, int]:
    """Return the ids of the descriptions in force of a spacecraft, or of all, by spacecraft."""
    query = select(MISSIONS.c.ccsds_id).where(MISSIONS.c.ccsds_id.is_not(None)).distinct()
    if ccsds_id is not None:
        query = query.where(MISSIONS.c.ccsds_id == ccsds_id)
    found = {}
    for spacecraft in sorted(int(one) for one in connection.execute(query).scalars()):
        key = newest_of_spacecraft(connection, spacecraft)
        if key is not None:
            found[spacecraft] = key
    return found


def newest_of_spacecraft(connection: Connection, ccsds_id: int | None) -> int | None:
    """Return the id of the revision of a spacecraft (None: that states none) that a person entered last, or None.

    The description that comes with an archive holds for its own pass: another pass may have flown another world.
    """
    found = connection.execute(
        select(MISSIONS.c.id)
        .where(MISSIONS.c.ccsds_id == ccsds_id, MISSIONS.c.entered_by != ARCHIVE_ACTOR)
        .order_by(MISSIONS.c.created_utc_ns.desc(), MISSIONS.c.id.desc())
        .limit(1)
    ).scalar()
    return None if found is None else int(found)


def in_force(connection: Connection, vehicle: int) -> int | None:
    """Return the id of the revision in force for a vehicle; None without any."""
    row = repository.get(connection, repository.VEHICLES, vehicle, "vehicle")
    return newest_of_spacecraft(connection, int(row["ccsds_id"]))


def mission_in_force(connection: Connection, ccsds_id: int | None) -> Mission | None:
    """Return the description in force of a spacecraft; None without any."""
    return None if ccsds_id is None else missions_in_force(connection, ccsds_id).get(ccsds_id)


def stations_in_force(connection: Connection, ccsds_id: int | None) -> set[str]:
    """Return the stations that descriptions in force (of a spacecraft; None: of all) state; none if one states none."""
    found = [one.link.stations or {} for one in missions_in_force(connection, ccsds_id).values()]
    return {name for stations in found for name in stations} if all(found) else set()


def mission_of_vehicle(connection: Connection, vehicle: int) -> Mission | None:
    """Return the description of the newest pass of a vehicle, otherwise that in force of its spacecraft.

    The vehicle of an archive has passes of this archive only.
    """
    table = repository.PASSES
    query = select(table.c.mission_id).where(table.c.vehicle_id == vehicle, table.c.mission_id.is_not(None))
    key = connection.execute(query.order_by(table.c.id.desc()).limit(1)).scalar()
    key = in_force(connection, vehicle) if key is None else int(key)
    return None if key is None else get_mission(connection, key)


def newest_ticks(connection: Connection, vehicle: int) -> int | None:
    """Return the newest on-board time in the telemetry of a vehicle; None without any."""
    table = repository.INGESTS
    newest = select(func.max(table.c.last_ticks)).where(table.c.vehicle_id == vehicle)
    found = connection.execute(newest).scalar()
    return None if found is None else int(found)


def approval_in_force(connection: Connection, ccsds_id: int) -> Approval:
    """Return the approval rules of the newest revision of a spacecraft that was added by a person.

    Descriptions imported with archives do not change the approval rules.
    """
    mission = mission_in_force(connection, ccsds_id)
    return Approval() if mission is None else mission.approval


def get_catalogue(connection: Connection, sha256: str) -> HeldCatalogue:
    """Return a held crater catalogue."""
    row = repository.get(connection, repository.FILES, sha256, "catalogue")
    if row["kind"] != CATALOGUE_KIND:
        raise NotFound("catalogue", sha256)
    return HeldCatalogue.of(row)


def set_catalogue_kind(connection: Connection, sha256: str, kind: str) -> None:
    """Have a file as a held or as a withdrawn catalogue."""
    repository.change(connection, repository.FILES, sha256, kind=kind)


def is_withdrawn(connection: Connection, sha256: str) -> bool:
    """Return whether a catalogue was withdrawn."""
    return repository.find(connection, repository.FILES, sha256=sha256, kind=WITHDRAWN_KIND) is not None


def list_catalogues(connection: Connection, asked: Paging) -> PageOf[HeldCatalogue]:
    """List the crater catalogues that the ground holds, newest first."""
    files = repository.FILES
    query = select(files).where(files.c.kind == CATALOGUE_KIND)
    rows, total = repository.page(connection, query, asked, files.c.received_utc_ns.desc(), files.c.sha256)
    return asked.page(map(HeldCatalogue.of, rows), total)


def _document(row: repository.Row) -> Mission:
    return _parsed(row["text"], f"mission revision {row['revision'][:REVISION_PREFIX]}")


@lru_cache(maxsize=32)
def _parsed(text: str, source: str) -> Mission:
    return parse_mission(text, source, stored=True)


def _detail(row: repository.Row) -> MissionDetail:
    document = _document(row)
    return MissionDetail(**_columns(row, document), document=document, text=row["text"])


def _columns(row: repository.Row, document: Mission) -> dict[str, Any]:
    return {
        "id": row["id"],
        "mission": row["name"],
        "revision": row["revision"],
        "spacecraft_id": row["ccsds_id"],
        "unknown": document.unknown,
        "entered": row["created_utc_ns"],
        "entered_by": row["entered_by"],
    }
