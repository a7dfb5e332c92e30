"""Telecommands: entry, release or rejection, transmission, and verification.

queued → released → sent → (accepted → started → completed | failed), or queued → rejected. A command that
changes the state of the payload or destroys data (`tmtc.dictionary.effects`) is critical: a second person must release
it. Every step is a compare-and-set in the database (`store.states`) and
goes into the audit log in the transaction that makes it.
"""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection

from ground_service.access.service import audit
from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.contacts.commanding import model, store
from ground_service.errors import Conflict, InvalidInput
from ground_service.ground import Ground
from ground_service.http.model import PageOf
from ground_service.missions.store import approval_in_force, in_force
from ground_service.store import vehicles
from ground_service.store.event_kinds import CommandsSent, CommandStateChanged, HandoverChanged, publish
from ground_service.toml import REASON_LIMIT, require_line
from tmtc.dictionary.arguments import argument_text, arguments_by_number
from tmtc.dictionary.effects import CommandEffect, effect_of
from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import TmtcError
from tmtc.link.uplink import UplinkEncoder
from tmtc.packets.space_packets import SEQUENCE_COUNT_LIMIT

DEFAULT_TIMEOUT_S = 600
TIMEOUT_LIMIT_S = 2**31 - 1
"""Largest timeout: commands of a planned window are verified until its end, which may be years ahead."""

_SERVICE, _TIME_OUT = "service", "time out"

COMMANDS = tuple(definition.name for definition in DICTIONARY.telecommands)


@dataclass(frozen=True, slots=True)
class Approval:
    """Persons who entered and approved the source of a telecommand, such as a window."""

    entered_by: str
    approved_by: str | None


def enter_command(
    ground: Ground,
    name: str,
    arguments: Mapping[str, Any],
    *,
    spacecraft_id: int,
    instance: str = vehicles.FLOWN,
    timeout_s: int = DEFAULT_TIMEOUT_S,
    actor: str,
) -> int:
    """Enter a telecommand into the queue; its id.

    Raises
    ------
    InvalidInput
        If the dictionary has no such command, or refuses its arguments.
    """
    with ground.database.writing() as connection:
        vehicle = vehicles.vehicle_id(connection, spacecraft_id, instance)
        return _add(connection, vehicle, name, arguments, "queued", actor, timeout_s)


def add_released(
    connection: Connection,
    vehicle: int,
    name: str,
    arguments: Mapping[str, Any],
    *,
    actor: str,
    timeout_s: int = DEFAULT_TIMEOUT_S,
    window_id: int | None = None,
    approval: Approval | None = None,
) -> int:
    """Add a telecommand in state released, within the caller's transaction; return its id.

    Raises
    ------
    Conflict
        If it needs a second person and `approval` names none.
    """
    _require_approval(connection, vehicle, name, arguments, approval)
    key = _add(connection, vehicle, name, arguments, "queued", actor, timeout_s, window_id)
    _release(connection, store.get_record(connection, key), actor)
    return key


def add_scheduled(
    connection: Connection,
    vehicle: int,
    name: str,
    arguments: Mapping[str, Any],
    *,
    release_ticks: int,
    actor: str,
    timeout_s: int,
    window_id: int | None = None,
    approval: Approval | None = None,
) -> int:
    """Add a released `insert_activity` that carries a telecommand to be done at an on-board time; its id.

    The telecommand inside has a sequence count and a row of its own, so that the reports about it are found.
    """
    _require_approval(connection, vehicle, name, arguments, approval)
    issued = _issued(connection, vehicle, name, arguments)
    inner = _add(connection, vehicle, name, arguments, "carried", actor, timeout_s, window_id, issued)
    outer = add_released(
        connection,
        vehicle,
        "insert_activity",
        {"release_ticks": release_ticks, "items": [{"octet": octet} for octet in issued.octets]},
        actor=actor,
        timeout_s=timeout_s,
        window_id=window_id,
        approval=approval,
    )
    store.set_carrier(connection, inner, outer)
    return outer


def release_command(ground: Ground, command_id: int, *, actor: str) -> None:
    """Release a queued command for uplink: its octets are generated and never change again.

    Raises
    ------
    StateConflict
        If it is not queued, or another request decided on it at the same time.
    Conflict
        If it is critical and was entered by the same person.
    """
    with ground.database.writing() as connection:
        record = store.get_record(connection, command_id)
        if record.state == "queued" and record.critical and record.requested_by == actor:
            packed = _packed(record.name, record.arguments, 0)
            effect = effect_of(DICTIONARY, record.name, record.arguments, packed)
            raise Conflict(
                f"telecommand {command_id} ({record.name}): critical; expected a person other than {actor} "
                f"to release it ({effect.effect}: {effect.reason})"
            )
        _release(connection, record, actor)


def reject_command(ground: Ground, command_id: int, *, actor: str, reason: str) -> None:
    """Reject a queued command.

    Raises
    ------
    StateConflict
        If it is not queued, or another request decided on it at the same time.
    """
    require_line(reason, "telecommand", "reason", REASON_LIMIT)
    with ground.database.writing() as connection:
        store.reject(connection, command_id, actor=actor, reason=reason, now_utc_ns=utc_now_ns())
        _note(connection, actor, "reject", command_id, "rejected", {"reason": reason})


def take_uplink(
    ground: Ground, *, spacecraft_id: int, instance: str = vehicles.FLOWN, framed: bool = True, actor: str
) -> tuple[bytes, list[int]]:
    """Return the released commands in order as CLTUs or bare packets, and their ids, and mark them as sent.

    Each command is returned exactly once, also to concurrent callers.
    """
    with ground.database.writing() as connection:
        vehicle = vehicles.vehicle_id(connection, spacecraft_id, instance)
        _require_not_held(connection, vehicle)
        return take_released(connection, vehicle, spacecraft_id, framed=framed, actor=actor)


def take_released(
    connection: Connection, vehicle: int, spacecraft_id: int, *, framed: bool, actor: str
) -> tuple[bytes, list[int]]:
    """Do what `take_uplink` does, within the caller's transaction.

    Commands whose time for transmission has passed stay released, and all commands of a spacecraft on hold.
    """
    vehicles.lock_spacecraft(connection, vehicle)
    if store.handover_of(connection, vehicle).held_by is not None:
        return b"", []
    records = store.send_released(connection, vehicle, utc_now_ns(), mission_now_ns())
    ids = [record.id for record in records]
    for command_id in ids:
        _note(connection, actor, "send", command_id, "sent", {})
    if ids:
        publish(connection, CommandsSent(vehicle_id=vehicle, telecommands=tuple(ids)))
    packets = [record.octets for record in records if record.octets is not None]
    stream = UplinkEncoder(spacecraft_id).encode(packets) if framed else b"".join(packets)
    return stream, ids


def hold_spacecraft(ground: Ground, spacecraft_id: int, instance: str, *, reason: str, actor: str) -> model.Handover:
    """Stop the release and the transmission of all telecommands of a spacecraft until `resume_spacecraft`.

    A transmission that a station has begun is not recalled.

    Raises
    ------
    Conflict
        If it is on hold already.
    """
    require_line(reason, "hold", "reason", REASON_LIMIT)
    return _change_hold(ground, spacecraft_id, instance, actor=actor, reason=reason)


def resume_spacecraft(ground: Ground, spacecraft_id: int, instance: str, *, actor: str) -> model.Handover:
    """End the hold of a spacecraft.

    Raises
    ------
    Conflict
        If it is not on hold.
    """
    return _change_hold(ground, spacecraft_id, instance, actor=actor, reason=None)


def _change_hold(
    ground: Ground, spacecraft_id: int, instance: str, *, actor: str, reason: str | None
) -> model.Handover:
    with ground.database.writing() as connection:
        vehicle = vehicles.find_vehicle(connection, spacecraft_id, instance).id
        vehicles.lock_spacecraft(connection, vehicle)  # what is being released or taken now comes before the hold
        holder = None if reason is None else actor
        changed = store.set_hold(connection, vehicle, holder, reason or "", now_utc_ns=utc_now_ns())
        if not changed:
            _require_not_held(connection, vehicle)
            raise Conflict(f"spacecraft {spacecraft_id} ({instance}): expected a hold, found none")
        return _handed_over(connection, vehicle, "resume" if reason is None else "hold", actor)


def change_handover(ground: Ground, spacecraft_id: int, instance: str, note: str, *, actor: str) -> model.Handover:
    """Replace the note for the next shift."""
    with ground.database.writing() as connection:
        vehicle = vehicles.find_vehicle(connection, spacecraft_id, instance).id
        store.note_handover(connection, vehicle, note, actor=actor, now_utc_ns=utc_now_ns())
        return _handed_over(connection, vehicle, "note", actor)


def _handed_over(connection: Connection, vehicle: int, action: str, actor: str) -> model.Handover:
    found = store.handover_of(connection, vehicle)
    detail = {"note": found.note} if action == "note" else {"reason": found.hold_reason}
    audit(connection, actor, f"{action} spacecraft", f"{found.spacecraft_id} {found.instance}", detail)
    publish(connection, HandoverChanged(**found.model_dump(include=set(HandoverChanged.model_fields))))
    return found


def is_held(connection: Connection, spacecraft_id: int, instance: str) -> bool:
    """Return whether the telecommands of a spacecraft are on hold."""
    asked = model.HandoverFilter(spacecraft_id=spacecraft_id, instance=instance)
    return any(one.held_by is not None for one in store.list_handovers(connection, asked).items)


def _require_not_held(connection: Connection, vehicle: int) -> None:
    found = store.handover_of(connection, vehicle)
    if found.held_by is not None:
        raise Conflict(
            f"spacecraft {found.spacecraft_id} ({found.instance}): on hold by {found.held_by} since {found.held}"
            f"{f': {found.hold_reason}' if found.hold_reason else ''}"
        )


def are_unreported(connection: Connection, ids: Sequence[int]) -> bool:
    """Return whether telemetry shows nothing of sent telecommands, and all of them may still be carried out."""
    for key in ids:
        view = store.get_view(connection, key, utc_now_ns())
        before = view.record.send_before_utc_ns
        if view.state != "sent" or (before is not None and before <= mission_now_ns()):
            return False
    return True


def note_timeouts(ground: Ground, since_utc_ns: int, until_utc_ns: int) -> list[int]:
    """Record and publish the telecommands whose timeout has passed; return their ids.

    Each timeout is recorded once, also with concurrent processes. Later verification reports are still accepted.
    """
    views = ground.read(store.views_of_unnoted_timeouts, since_utc_ns, until_utc_ns, utc_now_ns())
    noted = []
    for view in views:
        if view.fate is None or not view.fate.timed_out:
            continue
        command_id = view.record.id
        with ground.database.writing() as connection:
            if store.note_timeout(connection, command_id, utc_now_ns()):
                detail = {"state": view.state, "timeout_s": view.record.timeout_s}
                _note(connection, _SERVICE, _TIME_OUT, command_id, "timed out", detail)
                noted.append(command_id)
    return noted


def get_command(ground: Ground, command_id: int) -> model.CommandView:
    """Return a telecommand and its verification."""
    return ground.read(store.get_view, command_id, utc_now_ns())


def list_telecommands(connection: Connection, asked: model.TelecommandFilter) -> PageOf[model.Telecommand]:
    """List the telecommands with their verification, newest first."""
    views, total = store.list_views(connection, asked, utc_now_ns())
    return asked.page((view.telecommand for view in views), total)


def uplink_state(ground: Ground, spacecraft_id: int, instance: str) -> model.UplinkState:
    """Return the telecommand channels of a spacecraft as the ingest that was entered last shows them.

    Telemetry that is ingested late counts as new: `received` states its time of reception.
    """
    with ground.database.reading() as connection:
        vehicles.find_vehicle(connection, spacecraft_id, instance)
        channels = store.newest_channels(connection, spacecraft_id, instance)
    return model.UplinkState(spacecraft_id=spacecraft_id, instance=instance, channels=channels)


def _add(
    connection: Connection,
    vehicle: int,
    name: str,
    arguments: Mapping[str, Any],
    state: str,
    actor: str,
    timeout_s: int,
    window_id: int | None = None,
    issued: model.CommandOctets | None = None,
) -> int:
    """Add a valid telecommand; return its id."""
    _packed(name, arguments, 0)
    arguments = arguments_by_number(name, arguments)
    if isinstance(timeout_s, bool) or not 1 <= timeout_s <= TIMEOUT_LIMIT_S:
        raise InvalidInput("telecommand", "timeout_s", f"1 to {TIMEOUT_LIMIT_S}", str(timeout_s)[:40])
    key = store.add_command(
        connection,
        vehicle,
        name,
        arguments,
        state=state,
        critical=_second_person(connection, vehicle, name, arguments) is not None,
        timeout_s=timeout_s,
        actor=actor,
        now_utc_ns=utc_now_ns(),
        window_id=window_id,
        mission_id=in_force(connection, vehicle),
        issued=issued,
    )
    _note(
        connection,
        actor,
        "enter",
        key,
        state,
        {"name": name, "text": argument_text(name, arguments, model.onboard_time), "arguments": dict(arguments)},
    )
    return key


def _release(connection: Connection, record: model.CommandRecord, actor: str) -> None:
    """Assign sequence count and octets to a queued telecommand; they never change again."""
    issued = _issued(connection, record.vehicle_id, record.name, record.arguments)
    store.release(connection, record.id, issued, actor=actor, now_utc_ns=utc_now_ns())
    _note(connection, actor, "release", record.id, "released", {"sequence_count": issued.sequence_count})


def _issued(connection: Connection, vehicle: int, name: str, arguments: Mapping[str, Any]) -> model.CommandOctets:
    """Return the octets of a telecommand with the next sequence count of its spacecraft.

    The first one follows the newest telecommand that the payload reports: another ground may have sent it.
    """
    before = store.last_command_count(connection, vehicle)
    first = 0 if before is None else before + 1
    count = vehicles.next_telecommand(connection, vehicle, first) % SEQUENCE_COUNT_LIMIT
    _require_not_held(connection, vehicle)
    return model.CommandOctets(count, _packed(name, arguments, count))


def _packed(name: str, arguments: Mapping[str, Any], count: int) -> bytes:
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, n=1) or COMMANDS[:1]
        expected = f"one of the {len(COMMANDS)} telecommands of the dictionary, such as {near[0]}"
        raise InvalidInput("telecommand", "name", expected, repr(name)[:80])
    try:
        return DICTIONARY.pack_command(name, arguments_by_number(name, arguments), sequence_count=count)
    except TmtcError as error:
        raise InvalidInput("telecommand", name, "arguments as the dictionary says", str(error)) from None
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InvalidInput("telecommand", name, "numbers or names as arguments", str(error)[:200]) from None


def _second_person(
    connection: Connection, vehicle: int, name: str, arguments: Mapping[str, Any]
) -> CommandEffect | None:
    """Return the effect for which a telecommand needs a second person; None if it needs none."""
    effect = effect_of(DICTIONARY, name, arguments, _packed(name, arguments, 0))
    rules = approval_in_force(connection, vehicles.get_vehicle(connection, vehicle, "spacecraft").ccsds_id)
    return effect if rules.needs_second_person(effect.subject) else None


def _require_approval(
    connection: Connection, vehicle: int, name: str, arguments: Mapping[str, Any], approval: Approval | None
) -> None:
    """Refuse to release a telecommand that needs a second person if no second person approved its window."""
    effect = _second_person(connection, vehicle, name, arguments)
    if effect is None or (approval is not None and approval.entered_by != approval.approved_by):
        return
    raise Conflict(
        f"telecommand {name}: critical; expected a window that a second person has approved "
        f"({effect.effect}: {effect.reason})"
    )


def _note(connection: Connection, actor: str, action: str, command_id: int, state: str, detail: dict[str, Any]) -> None:
    audit(connection, actor, f"{action} telecommand", str(command_id), detail)
    publish(connection, CommandStateChanged(id=command_id, state=state))
