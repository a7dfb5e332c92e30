"""SQL of telecommands."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

from sqlalchemy import BigInteger, ColumnElement, Connection, ScalarSelect, and_, cast, func, or_, select, update
from sqlalchemy.sql import Select

from ground_service.contacts.commanding.core import CommandFate, SentCommand, VerificationReport, fate_of
from ground_service.contacts.commanding.model import (
    CommandOctets,
    CommandRecord,
    CommandView,
    Handover,
    HandoverFilter,
    TelecommandFilter,
    UplinkChannel,
)
from ground_service.http.model import PageOf, UtcTime
from ground_service.ingest.core import LONGEST_SILENCE, LONGEST_STEP
from ground_service.ingest.doubt_store import latest_ticks
from ground_service.store import repository
from ground_service.store.states import TELECOMMAND, change_if, move, move_all
from ground_service.store.vehicles import get_vehicle
from ground_service.telemetry import store as telemetry
from ground_service.telemetry.decoding import readable_version
from lunar.constants import NS
from tmtc.dictionary.payload import DICTIONARY
from tmtc.packets.stream import cut_packets

TELECOMMANDS, VERIFICATIONS = TELECOMMAND.table, repository.SAMPLES["verifications"]
PACKETS = repository.PACKETS
HANDOVERS = repository.HANDOVERS

COUNTED = "performance"
NO_COMMAND = 65_535
"""Packet that reports the count of the newest telecommand, and the count if there was none."""

REPORTED = DICTIONARY.packet("verification_completed").apid

SEARCHED_INGESTS = 200
"""Number of newest ingests that are searched for channels: some contain no frames of a channel."""


def add_command(
    connection: Connection,
    vehicle: int,
    name: str,
    arguments: Mapping[str, Any],
    *,
    state: str,
    critical: bool,
    timeout_s: int,
    actor: str,
    now_utc_ns: int,
    window_id: int | None,
    mission_id: int | None,
    issued: CommandOctets | None,
) -> int:
    """Add a telecommand; return its id. `issued` is given if it is decided already."""
    return int(
        repository.add(
            connection,
            TELECOMMANDS,
            vehicle_id=vehicle,
            name=name,
            arguments=dict(arguments),
            state=state,
            critical=int(critical),
            timeout_s=timeout_s,
            requested_by=actor,
            created_utc_ns=now_utc_ns,
            window_id=window_id,
            mission_id=mission_id,
            **({} if issued is None else _issued(issued, actor, now_utc_ns)),
        )
    )


def release(connection: Connection, command_id: int, issued: CommandOctets, *, actor: str, now_utc_ns: int) -> None:
    """Move a queued telecommand to released.

    Raises
    ------
    StateConflict
        It is not queued.
    """
    values = _issued(issued, actor, now_utc_ns)
    move(connection, TELECOMMAND, command_id, "released", expected=("queued",), **values)


def last_command_count(connection: Connection, vehicle: int) -> int | None:
    """Return the sequence count of the newest telecommand that the payload has reported; None if it has none."""
    octets = telemetry.newest_packet(connection, vehicle, DICTIONARY.packet(COUNTED).apid) or b""
    table = DICTIONARY.unpack_many(octets, cut_packets(octets)).get(COUNTED)
    count = NO_COMMAND if table is None else int(table.columns["last_command_count"][-1])
    return None if count == NO_COMMAND else count


def list_handovers(connection: Connection, asked: HandoverFilter) -> PageOf[Handover]:
    """List the notes of the last shift and the holds, by spacecraft."""
    vehicles = repository.VEHICLES
    query = select(HANDOVERS, vehicles.c.ccsds_id, vehicles.c.instance).join(vehicles)
    if asked.spacecraft_id is not None:
        query = query.where(vehicles.c.ccsds_id == asked.spacecraft_id)
    if asked.instance is not None:
        query = query.where(vehicles.c.instance == asked.instance)
    rows, total = repository.page(connection, query, asked, vehicles.c.ccsds_id, vehicles.c.instance)
    return asked.page((Handover.of(row, spacecraft_id=row["ccsds_id"]) for row in rows), total)


def handover_of(connection: Connection, vehicle: int) -> Handover:
    """Return note and hold of a vehicle."""
    one = get_vehicle(connection, vehicle)
    row = repository.find(connection, HANDOVERS, vehicle_id=vehicle) or {}
    return Handover.of(row, spacecraft_id=one.ccsds_id, instance=one.instance)


def note_handover(connection: Connection, vehicle: int, note: str, *, actor: str, now_utc_ns: int) -> None:
    """Replace the note of a vehicle."""
    repository.add_new(connection, HANDOVERS, vehicle_id=vehicle, note="", hold_reason="")
    repository.change(connection, HANDOVERS, vehicle, note=note, noted_by=actor, noted_utc_ns=now_utc_ns)


def set_hold(connection: Connection, vehicle: int, held_by: str | None, reason: str, *, now_utc_ns: int) -> bool:
    """Hold a vehicle, or end its hold if `held_by` is None; return whether this has changed anything."""
    repository.add_new(connection, HANDOVERS, vehicle_id=vehicle, note="", hold_reason="")
    before = HANDOVERS.c.held_by.is_not(None) if held_by is None else HANDOVERS.c.held_by.is_(None)
    values = {"held_by": held_by, "held_utc_ns": held_by and now_utc_ns, "hold_reason": reason}
    changed = update(HANDOVERS).where(HANDOVERS.c.vehicle_id == vehicle, before).values(**values)
    return connection.execute(changed).rowcount == 1


def reject(connection: Connection, command_id: int, *, actor: str, reason: str, now_utc_ns: int) -> None:
    """Move a queued telecommand to rejected.

    Raises
    ------
    StateConflict
        It is not queued.
    """
    values: dict[str, Any] = {"decided_by": actor, "decided_utc_ns": now_utc_ns, "reason": reason}
    move(connection, TELECOMMAND, command_id, "rejected", expected=("queued",), **values)


def set_carrier(connection: Connection, command_id: int, carrier_id: int) -> None:
    """Enter the telecommand that carries another one into the on-board schedule."""
    repository.change(connection, TELECOMMANDS, command_id, carrier_id=carrier_id)


def send_released(connection: Connection, vehicle: int, now_utc_ns: int, mission_utc_ns: int) -> list[CommandRecord]:
    """Move the released telecommands of a vehicle, and those that they carry, to sent.

    Those whose time for transmission has passed at `mission_utc_ns` stay released.

    Return the released ones in order of release. The caller holds the lock of the spacecraft. Verification
    reports after the newest one so far count, and after the time of release.
    """
    newest = connection.execute(
        select(func.max(VERIFICATIONS.c.ticks)).where(*_readable_reports(connection, vehicle))
    ).scalar()
    after = -1 if newest is None else int(newest)
    latest = latest_ticks(newest)
    if latest is not None and after > latest - LONGEST_SILENCE:  # the clock of the mission states when
        after = max(after, latest - 2 * LONGEST_STEP)
    sent = {"sent_utc_ns": now_utc_ns, "sent_after_ticks": after}
    mine = [TELECOMMANDS.c.vehicle_id == vehicle, *_sendable(mission_utc_ns)]
    rows = move_all(connection, TELECOMMAND, mine, "sent", **sent)
    rows.sort(key=lambda row: (row["decided_utc_ns"], row["id"]))
    carried = TELECOMMANDS.c.carrier_id.in_([row["id"] for row in rows])
    move_all(connection, TELECOMMAND, [carried], "sent", **sent)
    return [CommandRecord.of(row) for row in rows]


def count_released(connection: Connection, ccsds_id: int, instance: str, mission_utc_ns: int) -> int:
    """Return the number of released telecommands of a spacecraft that may still be sent."""
    vehicles = repository.VEHICLES
    query = (
        select(func.count())
        .select_from(TELECOMMANDS)
        .join(vehicles, vehicles.c.id == TELECOMMANDS.c.vehicle_id + 0)  # the index of states: few are released
        .where(vehicles.c.ccsds_id == ccsds_id, vehicles.c.instance == instance, *_sendable(mission_utc_ns))
    )
    return int(connection.execute(query).scalar_one())


def limit_sending(connection: Connection, ids: Sequence[int], before_utc_ns: int) -> None:
    """Enter the mission time from which telecommands are no longer sent."""
    connection.execute(update(TELECOMMANDS).where(TELECOMMANDS.c.id.in_(ids)).values(send_before_utc_ns=before_utc_ns))


def note_timeout(connection: Connection, command_id: int, now_utc_ns: int) -> bool:
    """Record the timeout of a telecommand; return whether it was not recorded before."""
    unnoted = {"timeout_noted_utc_ns": None}
    return change_if(connection, TELECOMMANDS, command_id, unnoted, timeout_noted_utc_ns=now_utc_ns)


def get_record(connection: Connection, command_id: int) -> CommandRecord:
    """Return the row of a telecommand."""
    return CommandRecord.of(repository.get(connection, TELECOMMANDS, command_id, TELECOMMAND.kind))


def get_view(connection: Connection, command_id: int, now_utc_ns: int) -> CommandView:
    """Return a telecommand and its verification."""
    return _views(connection, [get_record(connection, command_id)], now_utc_ns)[0]


def list_views(connection: Connection, asked: TelecommandFilter, now_utc_ns: int) -> tuple[list[CommandView], int]:
    """Return a page of the telecommands, newest first, and their number."""
    rows, total = repository.newest(connection, TELECOMMANDS, asked)
    return _views(connection, [CommandRecord.of(row) for row in rows], now_utc_ns), total


def views_of_window(connection: Connection, window_id: int, now_utc_ns: int) -> list[CommandView]:
    """Return the telecommands of a window that were not rejected."""
    query = select(TELECOMMANDS).where(TELECOMMANDS.c.window_id == window_id, TELECOMMANDS.c.state != "rejected")
    return _selected(connection, query, now_utc_ns)


def views_of_unnoted_timeouts(
    connection: Connection, since_utc_ns: int, until_utc_ns: int, now_utc_ns: int
) -> list[CommandView]:
    """Return the sent telecommands whose timeout ends in an interval and is not recorded."""
    due = TELECOMMANDS.c.sent_utc_ns + cast(TELECOMMANDS.c.timeout_s, BigInteger) * NS
    query = select(TELECOMMANDS).where(
        TELECOMMANDS.c.state == "sent",
        TELECOMMANDS.c.timeout_noted_utc_ns.is_(None),
        due >= since_utc_ns,
        due < until_utc_ns,
    )
    return _selected(connection, query, now_utc_ns)


def ids_of_windows(connection: Connection, windows: Sequence[int]) -> dict[int, list[int]]:
    """Return the ids of the telecommands of each of these windows, ascending."""
    query = select(TELECOMMANDS.c.window_id, TELECOMMANDS.c.id).where(TELECOMMANDS.c.window_id.in_(windows))
    found: dict[int, list[int]] = {window: [] for window in windows}
    for window, command in connection.execute(query.order_by(TELECOMMANDS.c.id)):
        found[window].append(int(command))
    return found


def carriers_of_window(connection: Connection, window_id: int) -> list[int]:
    """Return the ids of the telecommands that uplink a window, without rejected and carried ones."""
    query = select(TELECOMMANDS.c.id).where(
        TELECOMMANDS.c.window_id == window_id, TELECOMMANDS.c.carrier_id.is_(None), TELECOMMANDS.c.state != "rejected"
    )
    return [int(key) for key in connection.execute(query.order_by(TELECOMMANDS.c.id)).scalars()]


def activities_on_board(connection: Connection, window_id: int) -> list[int]:
    """Return the request ids of the activities of a window that were sent, in order of release."""
    query = select(TELECOMMANDS.c.request_id).where(
        TELECOMMANDS.c.window_id == window_id, TELECOMMANDS.c.carrier_id.is_not(None), TELECOMMANDS.c.state == "sent"
    )
    return [int(request) for request in connection.execute(query.order_by(TELECOMMANDS.c.id)).scalars()]


def sent_for_pass(connection: Connection, pass_id: int) -> bytes:
    """Return the telecommand packets that were sent for the window of a pass, in order of release.

    Parameters that were changed by telecommand before are in force in the pass: those packets come first.
    """
    windows = repository.WINDOWS
    window = connection.execute(select(windows.c.id, windows.c.vehicle_id).where(windows.c.pass_id == pass_id))
    found = window.first()
    if found is None:
        return b""
    concerned = or_(
        TELECOMMANDS.c.window_id == found.id,
        and_(TELECOMMANDS.c.window_id.is_(None), TELECOMMANDS.c.name == "set_parameter"),
    )
    rows = connection.execute(_sent_octets(found.vehicle_id, concerned, TELECOMMANDS.c.carrier_id.is_(None))).all()
    last = max((number for number, row in enumerate(rows) if row.window_id is not None), default=-1)
    return b"".join(row.octets for row in rows[: last + 1])


def sent_parts(connection: Connection, vehicle: int) -> bytes:
    """Return the telecommand packets of uploads that were sent to a vehicle, in order of release."""
    parts = _sent_octets(vehicle, TELECOMMANDS.c.name.startswith("uplink_"))
    return b"".join(connection.execute(parts).scalars())


def _sent_octets(vehicle: int, *conditions: ColumnElement[bool]) -> Select[Any]:
    return (
        select(TELECOMMANDS.c.octets, TELECOMMANDS.c.window_id)
        .where(TELECOMMANDS.c.vehicle_id == vehicle, TELECOMMANDS.c.sent_utc_ns.is_not(None))
        .where(TELECOMMANDS.c.octets.is_not(None), *conditions)
        .order_by(TELECOMMANDS.c.decided_utc_ns, TELECOMMANDS.c.id)
    )


def states_of_window(connection: Connection, window_id: int) -> set[str]:
    """Return the stored states of the telecommands of a window."""
    query = select(TELECOMMANDS.c.state).where(TELECOMMANDS.c.window_id == window_id)
    return set(connection.execute(query).scalars())


def withdraw_window(connection: Connection, window_id: int, *, actor: str, now_utc_ns: int) -> None:
    """Reject the telecommands of a window that were not sent."""
    move_all(
        connection,
        TELECOMMAND,
        [TELECOMMANDS.c.window_id == window_id],
        "rejected",
        decided_by=actor,
        decided_utc_ns=now_utc_ns,
        reason="the window was withdrawn",
    )


def unlink_window(connection: Connection, window_id: int) -> None:
    """Remove the reference to a window from its telecommands."""
    connection.execute(update(TELECOMMANDS).where(TELECOMMANDS.c.window_id == window_id).values(window_id=None))


def newest_channels(connection: Connection, spacecraft_id: int, instance: str) -> list[UplinkChannel]:
    """Return each telecommand channel of a spacecraft from the newest ingest that contains it, by number."""
    ingests, vehicles = repository.INGESTS, repository.VEHICLES
    # A file of several spacecraft is entered under one of them.
    rows = connection.execute(
        select(ingests.c.id, ingests.c.received_utc_ns, ingests.c.accounting)
        .join(vehicles, vehicles.c.id == ingests.c.vehicle_id)
        .where(vehicles.c.instance == instance, ingests.c.state == "done")
        .order_by(ingests.c.id.desc())
        .limit(SEARCHED_INGESTS)
    )
    newest: dict[int, UplinkChannel] = {}
    for ingest_id, received_utc_ns, accounting in rows:
        for seen in accounting.get("uplink", ()):
            if seen.pop("spacecraft_id") == spacecraft_id:
                channel = UplinkChannel(**seen, ingest_id=ingest_id, received=UtcTime(received_utc_ns))
                newest.setdefault(channel.virtual_channel, channel)
    return [newest[number] for number in sorted(newest)]


def _issued(issued: CommandOctets, actor: str, now_utc_ns: int) -> dict[str, Any]:
    return {
        "sequence_count": issued.sequence_count,
        "request_id": issued.request_id,
        "octets": issued.octets,
        "decided_by": actor,
        "decided_utc_ns": now_utc_ns,
    }


def _sendable(mission_utc_ns: int) -> tuple[Any, ...]:
    before = TELECOMMANDS.c.send_before_utc_ns
    return (TELECOMMANDS.c.state == "released", or_(before.is_(None), before > mission_utc_ns))


def _readable_reports(connection: Connection, vehicle: int) -> tuple[Any, ...]:
    return (
        VERIFICATIONS.c.vehicle_id == vehicle,
        VERIFICATIONS.c.dictionary_version == readable_version(connection, vehicle),
    )


def _selected(connection: Connection, query: Select[Any], now_utc_ns: int) -> list[CommandView]:
    records = [CommandRecord.of(row) for row in connection.execute(query).mappings().all()]
    return _views(connection, records, now_utc_ns)


def _views(connection: Connection, records: Sequence[CommandRecord], now_utc_ns: int) -> list[CommandView]:
    """Return telecommands with their verification, in the same order."""
    views: dict[int, CommandView] = {}
    for key in {record.vehicle_id for record in records}:
        vehicle = get_vehicle(connection, key)
        mine = [record for record in records if record.vehicle_id == key]
        fates = _fates(connection, key, mine, now_utc_ns)
        views |= {one.id: CommandView(one, vehicle.ccsds_id, vehicle.instance, fates.get(one.id)) for one in mine}
    return [views[record.id] for record in records]


def _fates(
    connection: Connection, vehicle: int, records: Sequence[CommandRecord], now_utc_ns: int
) -> dict[int, CommandFate]:
    """Return what telemetry says of the telecommands of a vehicle that were sent, by their ids."""
    sent = {one.id: known for one in records if (known := _sent(one)) is not None}
    if not sent:
        return {}
    requests = {one.request_id for one in sent.values()}
    reports = connection.execute(
        select(
            *(VERIFICATIONS.c[one.name] for one in fields(VerificationReport) if one.name not in ("count", "boot")),
            PACKETS.c.sequence_count,
            _boot_at(connection, vehicle, VERIFICATIONS.c.ticks),
        )
        .select_from(VERIFICATIONS.join(PACKETS, PACKETS.c.id == VERIFICATIONS.c.packet_id))
        .where(
            *_readable_reports(connection, vehicle),
            VERIFICATIONS.c.ticks > min(one.sent_after_ticks for one in sent.values()),
            VERIFICATIONS.c.request_id.in_(requests),
        )
    )
    by_request: dict[int, list[VerificationReport]] = {}
    for row in reports:
        by_request.setdefault(row.request_id, []).append(VerificationReport(*tuple(row)))
    before = PACKETS.alias()
    mine = (before.c.vehicle_id == vehicle, before.c.apid == REPORTED, before.c.ticks >= 0)
    newest = select(before.c.id).where(*mine, before.c.ticks <= TELECOMMANDS.c.sent_after_ticks)
    newest = newest.order_by(before.c.ticks.desc(), before.c.sequence_count.desc()).limit(1).correlate(TELECOMMANDS)
    copies = connection.execute(
        select(
            TELECOMMANDS.c.request_id,
            TELECOMMANDS.c.id,
            TELECOMMANDS.c.sent_after_ticks,
            _boot_at(connection, vehicle, TELECOMMANDS.c.sent_after_ticks),
            PACKETS.c.sequence_count,
            _boot_at(connection, vehicle, PACKETS.c.ticks),
        )
        .select_from(TELECOMMANDS.outerjoin(PACKETS, PACKETS.c.id == newest.scalar_subquery()))
        .where(
            TELECOMMANDS.c.vehicle_id == vehicle,
            TELECOMMANDS.c.request_id.in_(requests),
            TELECOMMANDS.c.sent_after_ticks.is_not(None),
        )
    ).all()
    fates = {}
    for key, one in sent.items():
        later = [row[2] for row in copies if row[0] == one.request_id and row[1] > key]
        boot, count, count_boot = next((row[3:] for row in copies if row[1] == key), (None, None, None))
        fates[key] = fate_of(
            replace(one, repeated_after_ticks=min(later, default=None), boot=boot, count=count, count_boot=count_boot),
            by_request.get(one.request_id, ()),
            now_utc_ns,
        )
    return fates


def _boot_at(connection: Connection, vehicle: int, ticks: ColumnElement[int]) -> ScalarSelect[int]:
    """Return the boot of the newest housekeeping of a vehicle at or before a time."""
    known = repository.SAMPLES["housekeeping"]
    # Without the version, which the index has before the time, each time would be a search through all rows.
    mine = known.c.vehicle_id == vehicle, known.c.dictionary_version == readable_version(connection, vehicle)
    query = select(known.c.boot_count).where(*mine, known.c.ticks <= ticks)
    return query.order_by(known.c.ticks.desc()).limit(1).scalar_subquery()


def _sent(record: CommandRecord) -> SentCommand | None:
    """Return what verification needs about a sent telecommand; None if it was not sent."""
    if record.request_id is None or record.sent_utc_ns is None or record.sent_after_ticks is None:
        return None
    return SentCommand(
        request_id=record.request_id,
        sent_utc_ns=record.sent_utc_ns,
        sent_after_ticks=record.sent_after_ticks,
        repeated_after_ticks=None,
        timeout_ns=record.timeout_s * NS,
    )
