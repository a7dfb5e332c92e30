"""Use cases of links: declared links with their state, contacts, and transmissions of released telecommands.

A transmission is taken in one transaction with the state "sent" of its telecommands, and marked when its octets are on
the wire. A process that ends between the two leaves a pending transmission, which the next owner of the link sends.
Telecommands without a report by the next contact are transmitted again: the payload refuses the second copy
of a command that it has accepted. A transmission that its station refuses, because another one has the contact now, is
given to the link of that station.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

from sqlalchemy import Connection

from ground_service.access.service import audit
from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.contacts.commanding import service as commanding
from ground_service.contacts.commanding.store import count_released
from ground_service.contacts.links import core, store
from ground_service.contacts.links.core import PredictedContact
from ground_service.contacts.links.model import Contacts, LinkContact, LinkState, LinkStatus
from ground_service.contacts.links.store import ContactRow, LinkRow, TransmissionRow
from ground_service.errors import Conflict, InvalidInput, NotFound
from ground_service.ground import Ground
from ground_service.http.model import UtcTime
from ground_service.missions import store as missions
from ground_service.missions.ephemerides import service
from ground_service.missions.ephemerides.service import open_ephemeris
from ground_service.missions.model import Link as LinkSection
from ground_service.missions.model import StationConnection
from ground_service.missions.places import outages_of, station_of
from ground_service.store.event_kinds import ContactEnded, ContactMissed, ContactStarted, LinkChanged, publish
from ground_service.store.vehicles import get_vehicle, vehicle_id
from lunar.constants import NS
from lunar.errors import LunarError

ACTOR = "link"
REPEAT_ATTEMPTS = 3
REPEAT_WITHIN_NS = 7 * 86_400 * NS
"""Older transmissions are not repeated: their commands have timed out."""

PREDICT_LIMIT_NS = 31 * 86_400 * NS
MISSED_SHORTEST_NS = 120 * NS
"""Shorter predicted contacts may be lost in the error of the ephemeris: they are not reported as missed."""

MARGIN_NS = 120 * NS
"""Receptions this long before or after a predicted contact belong to it."""


@dataclass(frozen=True, slots=True)
class DeclaredLink:
    """A link of a mission description in force; `stations` is its section `link`."""

    spacecraft_id: int
    link: StationConnection
    stations: LinkSection

    @property
    def station(self) -> str:
        """Name of the station; that of the link if it is not stated."""
        return self.link.station or self.link.name


@dataclass(frozen=True, slots=True)
class SendDue:
    """Requested transmission, the number of the request, and whether transmissions are pending."""

    requested: bool
    request: int
    pending: bool


def declared_links(ground: Ground) -> dict[str, DeclaredLink]:
    """Return the links of the mission descriptions in force by name."""
    return ground.read(_declared)


def list_links(ground: Ground) -> list[LinkStatus]:
    """Return all declared links with their state, by name."""
    with ground.database.reading() as connection:
        return [_link(connection, one) for _, one in sorted(_declared(connection).items())]


def get_link(ground: Ground, name: str) -> LinkStatus:
    """Return a declared link with its state.

    Raises
    ------
    NotFound
        No mission description in force declares it.
    """
    with ground.database.reading() as connection:
        return _link(connection, _find(connection, name))


def request_send(ground: Ground, name: str, *, actor: str) -> LinkStatus:
    """Request that released telecommands are sent now, in a contact or not.

    Raises
    ------
    NotFound
        There is no such link.
    Conflict
        It has no uplink, no process operates it, or its spacecraft is on hold.
    """
    with ground.database.writing() as connection:
        declared = _find(connection, name)
        if declared.link.uplink is None:
            raise Conflict(f"link {name}: expected an uplink in the mission description, found none")
        found = store.find_link(connection, name)
        if found is None or found.owner is None or found.lease_utc_ns < utc_now_ns():
            raise Conflict(
                f"link {name}: expected a process that operates it ('linna serve' or 'linna link run'), found none"
            )
        if commanding.is_held(connection, declared.spacecraft_id, declared.link.instance):
            raise Conflict(f"link {name}: spacecraft {declared.spacecraft_id} is on hold")
        store.request_send(connection, name)
        audit(connection, actor, "send link", name, {})
        return _link(connection, declared)


def list_contacts(
    ground: Ground,
    start_utc_ns: int,
    stop_utc_ns: int,
    link: str | None = None,
    may_use: Callable[[int], bool] = lambda _: True,
) -> Contacts:
    """Return stored and predicted contacts, of spacecraft that may be used, between two times.

    Raises
    ------
    InvalidInput
        The span is empty or too long.
    NotFound
        There is no such link.
    """
    if not 0 < stop_utc_ns - start_utc_ns <= PREDICT_LIMIT_NS:
        days = PREDICT_LIMIT_NS // (86_400 * NS)
        found = f"{(stop_utc_ns - start_utc_ns) / NS:.0f} s"
        raise InvalidInput("contacts", "until", f"a time after since, by at most {days} days", found)
    with ground.database.reading() as connection:
        declared = _declared(connection) if link is None else {link: _find(connection, link)}
        declared = {name: one for name, one in declared.items() if may_use(one.spacecraft_id)}
        rows = store.contacts_between(connection, start_utc_ns, stop_utc_ns, link)
        spacecraft = {
            vehicle: get_vehicle(connection, vehicle).ccsds_id for vehicle in {row.vehicle_id for row in rows}
        }
    rows = [row for row in rows if may_use(spacecraft[row.vehicle_id])]
    contacts = [LinkContact.of(asdict(row), spacecraft_id=spacecraft[row.vehicle_id]) for row in rows]
    unpredicted = {}
    for name, one in declared.items():
        predicted, reason = predict(ground, one, start_utc_ns, stop_utc_ns)
        if reason is not None:
            unpredicted[name] = reason
        mine = [row for row in rows if row.link == name]
        contacts += [
            _predicted(one, contact) for contact in predicted if not any(_belongs(row, contact) for row in mine)
        ]
    contacts.sort(key=lambda one: (one.start.utc_ns, one.link))
    return Contacts(contacts=contacts, unpredicted=unpredicted)


def predict(
    ground: Ground, declared: DeclaredLink, start_utc_ns: int, stop_utc_ns: int
) -> tuple[tuple[PredictedContact, ...], str | None]:
    """Return the contacts of a link between two times, and the reason if they cannot be predicted."""
    station = station_of(declared.stations, declared.link.station)
    if station is None:
        return (), "the mission description states no place of the station"
    references = ground.read(service.covering_ephemerides, start_utc_ns, stop_utc_ns, declared.spacecraft_id)
    if not references:
        return (), "no reference ephemeris covers the time"
    outages = outages_of(declared.stations)
    try:
        ephemeris = open_ephemeris(ground, references[0])
        return core.predict_contacts(ephemeris, [station], start_utc_ns, stop_utc_ns, outages), None
    except LunarError as error:
        return (), f"reference ephemeris {references[0].name}: {error}"


def acquire(ground: Ground, declared: DeclaredLink, owner: str, lease_ns: int) -> bool:
    """Take or renew the lease of a link; return whether `owner` has it."""
    now = utc_now_ns()
    return ground.write(
        store.acquire,
        declared.link.name,
        declared.spacecraft_id,
        declared.link.instance,
        owner=owner,
        wall_utc_ns=now,
        until_utc_ns=now + lease_ns,
        mission_utc_ns=mission_now_ns(),
    )


def release(ground: Ground, name: str, owner: str) -> None:
    """Give a link back."""
    ground.write(store.release, name, owner, utc_now_ns())


def change_state(ground: Ground, name: str, owner: str, state: str, reason: str | None) -> bool:
    """Change the state of a link; return whether `owner` still has it."""
    with ground.database.writing() as connection:
        changed = store.change_link(connection, name, owner, state=state, reason=reason, changed_utc_ns=utc_now_ns())
        if changed:
            publish(connection, LinkChanged(link=name, state=state, reason=reason))
        return changed


def owners(ground: Ground) -> dict[str, str | None]:
    """Return the process that has the lease of each declared link; None without any."""
    now = utc_now_ns()
    with ground.database.reading() as connection:
        rows = {name: store.find_link(connection, name) for name in _declared(connection)}
    return {name: row.owner if row is not None and row.lease_utc_ns >= now else None for name, row in rows.items()}


def last_reception_ns(ground: Ground, name: str) -> int | None:
    """Return the mission time of the newest ingested reception of a link; None if nothing was received."""
    found = ground.read(store.find_link, name)
    return None if found is None else found.heard_utc_ns


def silent_contacts(ground: Ground) -> list[str]:
    """Return the links with an open contact that was silent for so long that it has to end."""
    now = mission_now_ns()
    with ground.database.reading() as connection:
        found = []
        for name, declared in _declared(connection).items():
            row, contact = store.find_link(connection, name), store.open_contact(connection, name)
            if row is None or contact is None:
                continue
            received_ns = max(contact.start_utc_ns, row.heard_utc_ns or 0)
            if core.is_silent(received_ns, now, declared.link.silence_s):
                found.append(name)
    return found


def start_contact(ground: Ground, declared: DeclaredLink, utc_ns: int) -> ContactRow | None:
    """Enter a contact that starts at a mission time and return it."""
    predicted, _ = predict(ground, declared, utc_ns - MARGIN_NS, utc_ns + PREDICT_LIMIT_NS // 31)
    now = core.contact_at(predicted, utc_ns, MARGIN_NS)
    with ground.database.writing() as connection:
        vehicle = vehicle_id(connection, declared.spacecraft_id, declared.link.instance)
        key = store.add_contact(
            connection,
            link=declared.link.name,
            station=declared.station,
            vehicle_id=vehicle,
            state="open",
            start_utc_ns=utc_ns,
            predicted_start_utc_ns=None if now is None else now.start_utc_ns,
            predicted_stop_utc_ns=None if now is None else now.stop_utc_ns,
            octets=0,
            telecommands=0,
        )
        publish(
            connection,
            ContactStarted(
                contact_id=key,
                link=declared.link.name,
                station=declared.station,
                vehicle_id=vehicle,
                start_utc_ns=utc_ns,
            ),
        )
        return store.open_contact(connection, declared.link.name)


def end_contact(ground: Ground, contact_id: int, name: str, stop_utc_ns: int) -> None:
    """End the open contact of a link."""
    with ground.database.writing() as connection:
        found = store.open_contact(connection, name)
        if found is None or found.id != contact_id:
            return
        stop = max(stop_utc_ns, found.start_utc_ns)
        if not store.end_contact(connection, contact_id, stop):
            return
        publish(
            connection,
            ContactEnded(
                contact_id=contact_id,
                link=name,
                station=found.station,
                vehicle_id=found.vehicle_id,
                start_utc_ns=found.start_utc_ns,
                stop_utc_ns=stop,
                octets=found.octets,
                telecommands=found.telecommands,
            ),
        )


def note_reception(
    ground: Ground, name: str, contact_id: int | None, octets: int, heard_utc_ns: int | None, offset_ns: int | None
) -> None:
    """Count ingested octets of a link; `offset_ns` is that of the station's clock, None if unknown."""
    with ground.database.writing() as connection:
        store.add_octets(connection, name, octets)
        if contact_id is not None:
            store.count_in_contact(connection, contact_id, octets=octets)
        store.note_reception(connection, name, heard_utc_ns, offset_ns)


def note_missed(ground: Ground, declared: DeclaredLink, owner: str, now_utc_ns: int, why: str) -> int:
    """Record the predicted contacts before a mission time in which nothing was received; return their number.

    A contact is not missed while another station received the spacecraft, which has one transmitter.
    """
    name = declared.link.name
    found = ground.read(store.find_link, name)
    if found is None or declared.link.downlink is None or now_utc_ns <= found.considered_utc_ns:
        return 0
    since = max(found.considered_utc_ns, now_utc_ns - PREDICT_LIMIT_NS)
    predicted, _ = predict(ground, declared, since - 2 * MARGIN_NS, now_utc_ns)
    over = [
        one
        for one in predicted
        if one.stop_utc_ns + MARGIN_NS <= now_utc_ns and one.stop_utc_ns - one.start_utc_ns >= MISSED_SHORTEST_NS
    ]
    # A contact that may still go on is looked at again from its start.
    going_on = [one.start_utc_ns for one in predicted if one.stop_utc_ns + MARGIN_NS > now_utc_ns]
    considered = max(min([now_utc_ns, *(start - MARGIN_NS for start in going_on)]), since)
    with ground.database.writing() as connection:
        if not store.change_link(connection, name, owner, considered_utc_ns=considered):
            return 0
        rows = store.contacts_between(connection, since - 3 * MARGIN_NS, now_utc_ns)
        mine = [row for row in rows if row.link == name]
        elsewhere = _of_other_links(connection, declared, rows)
        missed = [one for one in over if not any(_belongs(row, one) for row in mine) and _is_unheard(one, elsewhere)]
        vehicle = vehicle_id(connection, declared.spacecraft_id, declared.link.instance) if missed else 0
        for one in missed:
            _add_missed(connection, declared, vehicle, one, why)
    return len(missed)


def send_due(ground: Ground, name: str) -> SendDue:
    """Return what is to be sent over a link."""
    with ground.database.reading() as connection:
        found = store.find_link(connection, name)
        pending = bool(store.pending_transmissions(connection, name))
        if found is None or found.send_requested <= found.send_done:
            return SendDue(requested=False, request=0, pending=pending)
        held = commanding.is_held(connection, found.ccsds_id, found.instance)
    return SendDue(not held, found.send_requested, pending)


def unsent(ground: Ground, declared: DeclaredLink) -> int:
    """Return the number of telecommands that could be sent now: released ones, and pending transmissions."""
    with ground.database.reading() as connection:
        return _unsent(connection, declared) + sum(
            len(one.telecommands) for one in store.pending_transmissions(connection, declared.link.name)
        )


def take_transmissions(ground: Ground, declared: DeclaredLink, owner: str) -> list[TransmissionRow]:
    """Take the released telecommands for a link that `owner` has; return all its pending transmissions, in order."""
    name = declared.link.name
    with ground.database.reading() as connection:
        if commanding.is_held(connection, declared.spacecraft_id, declared.link.instance):
            return []
        if not _unsent(connection, declared):
            return store.pending_transmissions(connection, name)
    with ground.database.writing() as connection:
        if not store.change_link(connection, name, owner, changed_utc_ns=utc_now_ns()):
            return []
        vehicle = vehicle_id(connection, declared.spacecraft_id, declared.link.instance)
        octets, ids = commanding.take_released(
            connection, vehicle, declared.spacecraft_id, framed=declared.link.format == "cltu", actor=ACTOR
        )
        if commanding.is_held(connection, declared.spacecraft_id, declared.link.instance):
            return []
        if ids:
            store.add_transmission(
                connection,
                link=name,
                vehicle_id=vehicle,
                octets=octets,
                telecommands=ids,
                attempts=0,
                taken_utc_ns=mission_now_ns(),
            )
        return store.pending_transmissions(connection, name)


def hand_over(ground: Ground, declared: DeclaredLink, transmission: TransmissionRow) -> str | None:
    """Give a transmission that the station of a link has refused to the link that has the contact; its name.

    None: no other link of the spacecraft has a contact now and sends by itself in the same format.
    """
    name = declared.link.name
    with ground.database.writing() as connection:
        other = _other_in_contact(connection, declared)
        if other is None or not store.hand_over(connection, transmission.id, name, other):
            return None
        detail = {"telecommands": list(transmission.telecommands), "from": name, "to": other}
        audit(connection, ACTOR, "hand over transmission", str(transmission.id), detail)
    return other


def note_transmitted(ground: Ground, transmission: TransmissionRow, contact_id: int | None) -> None:
    """Record that a transmission is on the wire."""
    with ground.database.writing() as connection:
        store.note_transmitted(connection, transmission.id, contact_id, mission_now_ns())
        if contact_id is not None:
            store.count_in_contact(connection, contact_id, telecommands=len(transmission.telecommands))


def repeat_unconfirmed(ground: Ground, declared: DeclaredLink, contact: ContactRow) -> int:
    """Have transmissions of earlier contacts sent again of which telemetry has shown nothing since; their number.

    A transmission counts as lost when a contact with telemetry has ended after it and none of its telecommands was
    reported. It is repeated in a later contact, at most `REPEAT_ATTEMPTS` times in total.
    """
    if declared.link.uplink is None:
        return 0
    with ground.database.reading() as connection:
        received_ns = store.last_contact_stop(connection, contact.vehicle_id, contact.id)
        if received_ns is None:
            return 0
        earlier = store.transmitted_before(
            connection,
            contact.vehicle_id,
            min(received_ns, contact.start_utc_ns),
            contact.start_utc_ns - REPEAT_WITHIN_NS,
            REPEAT_ATTEMPTS,
        )
        lost = [one for one in earlier if commanding.are_unreported(connection, one.telecommands)]
    repeated = 0
    if lost:
        with ground.database.writing() as connection:
            for one in lost:
                name, seen = declared.link.name, one.transmitted_utc_ns
                if not store.repeat_transmission(connection, one.id, name, seen=seen):
                    continue
                repeated += 1
                audit(connection, ACTOR, "repeat transmission", str(one.id), {"telecommands": list(one.telecommands)})
    return repeated


def _add_missed(
    connection: Connection, declared: DeclaredLink, vehicle: int, contact: PredictedContact, why: str
) -> None:
    key = store.add_contact(
        connection,
        link=declared.link.name,
        station=declared.station,
        vehicle_id=vehicle,
        state="missed",
        reason=why,
        start_utc_ns=contact.start_utc_ns,
        stop_utc_ns=contact.stop_utc_ns,
        predicted_start_utc_ns=contact.start_utc_ns,
        predicted_stop_utc_ns=contact.stop_utc_ns,
        octets=0,
        telecommands=0,
    )
    publish(
        connection,
        ContactMissed(
            contact_id=key,
            link=declared.link.name,
            station=declared.station,
            vehicle_id=vehicle,
            start_utc_ns=contact.start_utc_ns,
            stop_utc_ns=contact.stop_utc_ns,
            reason=why,
        ),
    )


def _declared(connection: Connection) -> dict[str, DeclaredLink]:
    return {
        link.name: DeclaredLink(spacecraft, link, mission.link)
        for spacecraft, mission in missions.missions_in_force(connection).items()
        for link in mission.links or ()
    }


def _find(connection: Connection, name: str) -> DeclaredLink:
    declared = _declared(connection)
    if name not in declared:
        raise NotFound("link", name[:80])
    return declared[name]


def _link(connection: Connection, declared: DeclaredLink) -> LinkStatus:
    link = declared.link
    row = store.find_link(connection, link.name)
    pending = store.pending_transmissions(connection, link.name)
    owned = row is not None and row.owner is not None and row.lease_utc_ns >= utc_now_ns()
    state, reason = _state(row, owned)
    fault = core.clock_fault(None if row is None else row.clock_offset_ns)
    offset = None if row is None else row.clock_offset_ns
    return LinkStatus.of(
        {"octets": 0, "heard_utc_ns": None, "changed_utc_ns": 0}
        | ({} if row is None else asdict(row))
        | link.model_dump(),
        spacecraft_id=declared.spacecraft_id,
        state=state,
        reason="; ".join(one for one in (reason, fault) if one) or None,
        owner=row.owner if row is not None and owned else None,
        clock_offset_s=None if offset is None else offset / NS,
        unsent=_unsent(connection, declared),
        unconfirmed=len(pending),
    )


def _state(row: LinkRow | None, owned: bool) -> tuple[LinkState, str | None]:
    if row is None or not owned:
        return "waiting", "no process operates it"
    return row.state, row.reason


def _unsent(connection: Connection, declared: DeclaredLink) -> int:
    if declared.link.uplink is None:
        return 0
    return count_released(connection, declared.spacecraft_id, declared.link.instance, mission_now_ns())


def _predicted(declared: DeclaredLink, contact: PredictedContact) -> LinkContact:
    start, stop = UtcTime(contact.start_utc_ns), UtcTime(contact.stop_utc_ns)
    return LinkContact(
        link=declared.link.name,
        station=declared.station,
        spacecraft_id=declared.spacecraft_id,
        state="predicted",
        start=start,
        stop=stop,
        predicted_start=start,
        predicted_stop=stop,
    )


def _of_other_links(connection: Connection, declared: DeclaredLink, rows: Sequence[ContactRow]) -> list[core.Span]:
    """Return the spans, with margins, of the contacts over the other links of a spacecraft."""
    names = {
        name
        for name, one in _declared(connection).items()
        if (one.spacecraft_id, one.link.instance) == (declared.spacecraft_id, declared.link.instance)
        and name != declared.link.name
    }
    return [
        (row.start_utc_ns - MARGIN_NS, MARGIN_NS + (mission_now_ns() if row.stop_utc_ns is None else row.stop_utc_ns))
        for row in rows
        if row.link in names and row.state != "missed"
    ]


def _other_in_contact(connection: Connection, declared: DeclaredLink) -> str | None:
    """Return the operated link of the same spacecraft whose contact began last, other than this link."""
    found: list[tuple[int, str]] = []
    for name, one in _declared(connection).items():
        same = (one.spacecraft_id, one.link.instance) == (declared.spacecraft_id, declared.link.instance)
        sends = one.link.uplink is not None and one.link.send == "automatic"
        if name == declared.link.name or not same or not sends or one.link.format != declared.link.format:
            continue
        row, contact = store.find_link(connection, name), store.open_contact(connection, name)
        if contact is not None and row is not None and row.owner and row.lease_utc_ns >= utc_now_ns():
            found.append((contact.start_utc_ns, name))
    return max(found)[1] if found else None


def _is_unheard(contact: PredictedContact, elsewhere: Sequence[core.Span]) -> bool:
    """Return whether a part of a contact that counts lies outside all spans."""
    parts = core.without((contact.start_utc_ns, contact.stop_utc_ns), elsewhere)
    return any(stop - start >= MISSED_SHORTEST_NS for start, stop in parts)


def _belongs(row: ContactRow, contact: PredictedContact) -> bool:
    """Return whether a stored contact is a predicted one."""
    stop = row.stop_utc_ns if row.stop_utc_ns is not None else max(row.start_utc_ns, contact.start_utc_ns)
    return row.start_utc_ns <= contact.stop_utc_ns + MARGIN_NS and contact.start_utc_ns - MARGIN_NS <= stop
