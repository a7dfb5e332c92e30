"""Database access for links, contacts and transmissions."""

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, RowMapping, func, or_, select, update

from ground_service.contacts.links.model import ContactState, LinkState
from ground_service.store import repository
from ground_service.store.leases import renew_or_take
from ground_service.store.states import change_if

_LINKS, _CONTACTS, _TRANSMISSIONS = repository.LINKS, repository.CONTACTS, repository.TRANSMISSIONS


@dataclass(frozen=True, slots=True)
class LinkRow:
    """Stored state of a link."""

    name: str
    ccsds_id: int
    instance: str
    owner: str | None
    lease_utc_ns: int
    state: LinkState
    reason: str | None
    octets: int
    heard_utc_ns: int | None
    clock_offset_ns: int | None
    considered_utc_ns: int
    send_requested: int
    send_done: int
    changed_utc_ns: int


@dataclass(frozen=True, slots=True)
class ContactRow:
    """Stored contact."""

    id: int
    link: str
    station: str
    vehicle_id: int
    state: ContactState
    reason: str | None
    start_utc_ns: int
    stop_utc_ns: int | None
    predicted_start_utc_ns: int | None
    predicted_stop_utc_ns: int | None
    octets: int
    telecommands: int


@dataclass(frozen=True, slots=True)
class TransmissionRow:
    """Octets of telecommands that were taken for a link."""

    id: int
    link: str
    vehicle_id: int
    contact_id: int | None
    octets: bytes
    telecommands: tuple[int, ...]
    attempts: int
    taken_utc_ns: int
    transmitted_utc_ns: int | None


def find_link(connection: Connection, name: str) -> LinkRow | None:
    """Return the state of a link; None if no process has operated it."""
    row = connection.execute(select(_LINKS).where(_LINKS.c.name == name)).mappings().first()
    return None if row is None else LinkRow(**row)


def acquire(
    connection: Connection,
    name: str,
    ccsds_id: int,
    instance: str,
    *,
    owner: str,
    wall_utc_ns: int,
    until_utc_ns: int,
    mission_utc_ns: int,
) -> bool:
    """Take a link that nobody owns or whose lease has ended, or renew the own lease; whether the owner has it now.

    A new owner starts with the state "waiting".
    """
    repository.add_new(
        connection,
        _LINKS,
        name=name,
        ccsds_id=ccsds_id,
        instance=instance,
        owner=None,
        lease_utc_ns=0,
        state="waiting",
        octets=0,
        considered_utc_ns=mission_utc_ns,
        send_requested=0,
        send_done=0,
        changed_utc_ns=wall_utc_ns,
    )
    return renew_or_take(
        connection,
        _LINKS,
        name,
        owner,
        now_utc_ns=wall_utc_ns,
        until_utc_ns=until_utc_ns,
        ccsds_id=ccsds_id,
        instance=instance,
        state="waiting",
        reason=None,
        changed_utc_ns=wall_utc_ns,
    )


def release(connection: Connection, name: str, owner: str, wall_utc_ns: int) -> None:
    """Give a link back, so that another process need not wait for the end of the lease."""
    mine = (_LINKS.c.name == name, _LINKS.c.owner == owner)
    values = {"owner": None, "lease_utc_ns": 0, "state": "waiting", "reason": None, "changed_utc_ns": wall_utc_ns}
    connection.execute(update(_LINKS).where(*mine).values(**values))


def change_link(connection: Connection, /, name: str, owner: str, **values: Any) -> bool:
    """Change columns of a link that `owner` has; return whether it has it."""
    mine = (_LINKS.c.name == name, _LINKS.c.owner == owner)
    return connection.execute(update(_LINKS).where(*mine).values(**values)).rowcount == 1


def add_octets(connection: Connection, name: str, octets: int) -> None:
    """Count received octets of a link."""
    statement = update(_LINKS).where(_LINKS.c.name == name).values(octets=_LINKS.c.octets + octets)
    connection.execute(statement)


def note_reception(connection: Connection, name: str, heard_utc_ns: int | None, offset_ns: int | None) -> None:
    """Record when something was received over a link, and the offset of the station's clock; None changes nothing."""
    given = {"heard_utc_ns": heard_utc_ns, "clock_offset_ns": offset_ns}
    values = {key: value for key, value in given.items() if value is not None}
    if values:
        connection.execute(update(_LINKS).where(_LINKS.c.name == name).values(**values))


def request_send(connection: Connection, name: str) -> None:
    """Request that the owner of a link sends what is released, in a contact or not."""
    statement = update(_LINKS).where(_LINKS.c.name == name)
    connection.execute(statement.values(send_requested=_LINKS.c.send_requested + 1))


def open_contact(connection: Connection, link: str) -> ContactRow | None:
    """Return the open contact of a link; None without any."""
    query = select(_CONTACTS).where(_CONTACTS.c.link == link, _CONTACTS.c.state == "open")
    row = connection.execute(query.order_by(_CONTACTS.c.id.desc()).limit(1)).mappings().first()
    return None if row is None else ContactRow(**row)


def add_contact(connection: Connection, **columns: Any) -> int:
    """Add a contact; return its id."""
    return int(repository.add(connection, _CONTACTS, **columns))


def end_contact(connection: Connection, contact_id: int, stop_utc_ns: int) -> bool:
    """End a contact if it is open; return whether this call ended it."""
    return change_if(connection, _CONTACTS, contact_id, {"state": "open"}, state="ended", stop_utc_ns=stop_utc_ns)


def count_in_contact(connection: Connection, contact_id: int, *, octets: int = 0, telecommands: int = 0) -> None:
    """Count octets received and telecommands sent in a contact."""
    connection.execute(
        update(_CONTACTS)
        .where(_CONTACTS.c.id == contact_id)
        .values(octets=_CONTACTS.c.octets + octets, telecommands=_CONTACTS.c.telecommands + telecommands)
    )


def contacts_between(
    connection: Connection, start_utc_ns: int, stop_utc_ns: int, link: str | None = None
) -> list[ContactRow]:
    """Return the stored contacts that overlap a span, in order of time."""
    query = select(_CONTACTS).where(
        _CONTACTS.c.start_utc_ns <= stop_utc_ns,
        or_(_CONTACTS.c.stop_utc_ns.is_(None), _CONTACTS.c.stop_utc_ns >= start_utc_ns),
    )
    if link is not None:
        query = query.where(_CONTACTS.c.link == link)
    rows = connection.execute(query.order_by(_CONTACTS.c.start_utc_ns, _CONTACTS.c.id)).mappings()
    return [ContactRow(**row) for row in rows]


def last_contact_stop(connection: Connection, vehicle: int, before_id: int) -> int | None:
    """Return the end of the last contact with telemetry of a vehicle before another one; None without any."""
    query = select(func.max(_CONTACTS.c.stop_utc_ns)).where(
        _CONTACTS.c.vehicle_id == vehicle,
        _CONTACTS.c.state == "ended",
        _CONTACTS.c.octets > 0,
        _CONTACTS.c.id < before_id,
    )
    found = connection.execute(query).scalar()
    return None if found is None else int(found)


def add_transmission(connection: Connection, **columns: Any) -> int:
    """Add a transmission; return its id."""
    return int(repository.add(connection, _TRANSMISSIONS, **columns))


def pending_transmissions(connection: Connection, link: str) -> list[TransmissionRow]:
    """Return the transmissions of a link that may not be on the wire, in order."""
    query = select(_TRANSMISSIONS).where(_TRANSMISSIONS.c.link == link, _TRANSMISSIONS.c.transmitted_utc_ns.is_(None))
    return [_transmission(row) for row in connection.execute(query.order_by(_TRANSMISSIONS.c.id)).mappings()]


def links_with_earlier(connection: Connection, transmission: TransmissionRow) -> list[str]:
    """Return the other links at which earlier transmissions of the same spacecraft may not be on the wire."""
    query = select(_TRANSMISSIONS.c.link).where(
        _TRANSMISSIONS.c.vehicle_id == transmission.vehicle_id,
        _TRANSMISSIONS.c.id < transmission.id,
        _TRANSMISSIONS.c.link != transmission.link,
        _TRANSMISSIONS.c.transmitted_utc_ns.is_(None),
    )
    return [str(name) for name in connection.execute(query.distinct().order_by("link")).scalars()]


def transmitted_before(
    connection: Connection, vehicle: int, before_utc_ns: int, since_utc_ns: int, attempts: int
) -> list[TransmissionRow]:
    """Return the transmissions of a vehicle within a span that were sent less often than `attempts`."""
    query = select(_TRANSMISSIONS).where(
        _TRANSMISSIONS.c.vehicle_id == vehicle,
        _TRANSMISSIONS.c.transmitted_utc_ns < before_utc_ns,
        _TRANSMISSIONS.c.transmitted_utc_ns >= since_utc_ns,
        _TRANSMISSIONS.c.attempts < attempts,
    )
    return [_transmission(row) for row in connection.execute(query.order_by(_TRANSMISSIONS.c.id)).mappings()]


def repeat_transmission(connection: Connection, transmission_id: int, link: str, *, seen: int | None) -> bool:
    """Have a transmission sent again over a link if its time is still `seen`; return whether this call did it."""
    found = {"transmitted_utc_ns": seen}
    return change_if(connection, _TRANSMISSIONS, transmission_id, found, transmitted_utc_ns=None, link=link)


def hand_over(connection: Connection, transmission_id: int, link: str, other: str) -> bool:
    """Give a transmission that is not on the wire from one link to another; return whether this call did it."""
    found = {"transmitted_utc_ns": None, "link": link}
    return change_if(connection, _TRANSMISSIONS, transmission_id, found, link=other)


def note_transmitted(connection: Connection, transmission_id: int, contact_id: int | None, utc_ns: int) -> None:
    """Record that the octets of a transmission are on the wire."""
    connection.execute(
        update(_TRANSMISSIONS)
        .where(_TRANSMISSIONS.c.id == transmission_id)
        .values(transmitted_utc_ns=utc_ns, contact_id=contact_id, attempts=_TRANSMISSIONS.c.attempts + 1)
    )


def _transmission(row: RowMapping) -> TransmissionRow:
    return TransmissionRow(**{**row, "octets": bytes(row["octets"]), "telecommands": tuple(row["telecommands"])})
