"""Telecommands: entry, release or rejection, transmission, and verification.

queued → released → sent → (accepted → started → completed | failed), or queued → rejected. A command that
changes the state of the payload or destroys data (`tmtc.effects`) is critical: a second person must release
it. Every step is a compare-and-set in the database (`store.states`) and
goes into the audit log in the transaction that makes it.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import BigInteger, Connection, cast, func, select

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.commanding.approval import DEFAULT_POLICY, ApprovalPolicy
from ground_service.commanding.command_state import CommandView, command_view
from ground_service.errors import Conflict, InvalidInput
from ground_service.events import CommandsSent, CommandStateChanged, publish
from ground_service.ground import Ground
from ground_service.ingest.redecode import readable_version
from ground_service.ingest.service import FLOWN
from ground_service.missions.store import approval_in_force, in_force
from ground_service.store import repository
from ground_service.store.counters import lock_spacecraft, next_telecommand
from ground_service.store.states import TELECOMMAND, change_if, move, move_all
from ground_service.store.vehicles import vehicle_id
from ground_service.text import REASON_LIMIT, require_line
from tmtc.dictionary import DICTIONARY
from tmtc.effects import CommandEffect, effect_of
from tmtc.errors import TmtcError
from tmtc.packets import SEQUENCE_COUNT_LIMIT
from tmtc.uplink import UplinkEncoder

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
    instance: str = FLOWN,
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
        vehicle = vehicle_id(connection, spacecraft_id, instance)
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
    _release(connection, repository.get(connection, TELECOMMAND.table, key, TELECOMMAND.kind), actor)
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
    issued = _issued(connection, vehicle, name, arguments, actor)
    octets = bytes(issued["octets"])
    inner = _add(connection, vehicle, name, arguments, "carried", actor, timeout_s, window_id, **issued)
    outer = add_released(
        connection,
        vehicle,
        "insert_activity",
        {"release_ticks": release_ticks, "items": [{"octet": octet} for octet in octets]},
        actor=actor,
        timeout_s=timeout_s,
        window_id=window_id,
        approval=approval,
    )
    repository.change(connection, repository.TELECOMMANDS, inner, carrier_id=outer)
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
        row = repository.get(connection, repository.TELECOMMANDS, command_id, TELECOMMAND.kind)
        if row["state"] == "queued" and row["critical"] and row["requested_by"] == actor:
            effect = effect_of(
                DICTIONARY, row["name"], row["arguments"], _packed(row["name"], row["arguments"], 0)
            )
            raise Conflict(
                f"telecommand {command_id} ({row['name']}): critical; expected a person other than {actor} "
                f"to release it ({effect.effect}: {effect.reason})"
            )
        _release(connection, row, actor)


def reject_command(ground: Ground, command_id: int, *, actor: str, reason: str) -> None:
    """Reject a queued command.

    Raises
    ------
    StateConflict
        If it is not queued, or another request decided on it at the same time.
    """
    require_line(reason, "telecommand", "reason", REASON_LIMIT)
    with ground.database.writing() as connection:
        _decide(connection, command_id, "rejected", actor, reason=reason)
        _note(connection, actor, "reject", command_id, "rejected", {"reason": reason})


def take_uplink(
    ground: Ground, *, spacecraft_id: int, instance: str = FLOWN, framed: bool = True, actor: str
) -> tuple[bytes, list[int]]:
    """Return the released commands in order as CLTUs or bare packets, and their ids, and mark them as sent.

    Each command is returned exactly once, also to concurrent callers.
    """
    table = TELECOMMAND.table
    with ground.database.writing() as connection:
        vehicle = vehicle_id(connection, spacecraft_id, instance)
        lock_spacecraft(connection, vehicle)
        sent = {"sent_utc_ns": utc_now_ns(), "sent_after_ticks": _newest_ticks(connection, vehicle)}
        mine = [table.c.vehicle_id == vehicle, table.c.state == "released"]
        rows = move_all(connection, TELECOMMAND, mine, "sent", **sent)
        rows.sort(key=lambda row: (row["decided_utc_ns"], row["id"]))
        ids = [int(row["id"]) for row in rows]
        move_all(connection, TELECOMMAND, [table.c.carrier_id.in_(ids)], "sent", **sent)
        for command_id in ids:
            _note(connection, actor, "send", command_id, "sent", {})
        if ids:
            publish(connection, CommandsSent(vehicle_id=vehicle, telecommands=tuple(ids)))
    packets = [bytes(row["octets"]) for row in rows]
    stream = UplinkEncoder(spacecraft_id).encode(packets) if framed else b"".join(packets)
    return stream, ids


def note_timeouts(ground: Ground, since_utc_ns: int, until_utc_ns: int) -> list[int]:
    """Record and publish the telecommands whose timeout has passed; return their ids.

    Each timeout is recorded once, also with concurrent processes. Later verification reports are still accepted.
    """
    table = TELECOMMAND.table
    due = table.c.sent_utc_ns + cast(table.c.timeout_s, BigInteger) * 1_000_000_000
    with ground.database.reading() as connection:
        rows = connection.execute(
            select(table).where(
                table.c.state == "sent",
                table.c.timeout_noted_utc_ns.is_(None),
                due >= since_utc_ns,
                due < until_utc_ns,
            )
        ).mappings()
        views = [command_view(connection, dict(row)) for row in rows.all()]
    overdue = [view for view in views if view.fate is not None and view.fate.timed_out]
    noted = []
    for view in overdue:
        command_id = int(view.row["id"])
        with ground.database.writing() as connection:
            if change_if(
                connection,
                table,
                command_id,
                {"timeout_noted_utc_ns": None},
                timeout_noted_utc_ns=utc_now_ns(),
            ):
                detail = {"state": view.state, "timeout_s": view.row["timeout_s"]}
                _note(connection, _SERVICE, _TIME_OUT, command_id, "timed out", detail)
                noted.append(command_id)
    return noted


def get_command(ground: Ground, command_id: int) -> CommandView:
    """A telecommand as it stands now."""
    with ground.database.reading() as connection:
        row = repository.get(connection, repository.TELECOMMANDS, command_id, "telecommand")
        return command_view(connection, row)


def list_commands(
    ground: Ground, *, state: str | None = None, limit: int = 100, offset: int = 0
) -> tuple[list[CommandView], int]:
    """Telecommands, the newest first; `state` keeps those in one stored state (queued, released, rejected, sent)."""
    equal: dict[str, Any] = {"state": state} if state is not None else {}
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.TELECOMMANDS, limit=limit, offset=offset, **equal)
        return [command_view(connection, row) for row in page.rows], page.total


def _add(
    connection: Connection,
    vehicle: int,
    name: str,
    arguments: Mapping[str, Any],
    state: str,
    actor: str,
    timeout_s: int,
    window_id: int | None = None,
    **issued: Any,
) -> int:
    """Add a valid telecommand; return its id. `issued` holds its octets if it has them already."""
    _packed(name, arguments, 0)
    if isinstance(timeout_s, bool) or not 1 <= timeout_s <= TIMEOUT_LIMIT_S:
        raise InvalidInput("telecommand", "timeout_s", f"1 to {TIMEOUT_LIMIT_S}", str(timeout_s)[:40])
    key = int(
        repository.add(
            connection,
            repository.TELECOMMANDS,
            vehicle_id=vehicle,
            name=name,
            arguments=dict(arguments),
            state=state,
            critical=int(_second_person(connection, vehicle, name, arguments) is not None),
            timeout_s=timeout_s,
            requested_by=actor,
            created_utc_ns=utc_now_ns(),
            window_id=window_id,
            mission_id=in_force(connection, vehicle),
            **issued,
        )
    )
    _note(connection, actor, "enter", key, state, {"name": name, "arguments": dict(arguments)})
    return key


def _release(connection: Connection, row: repository.Row, actor: str) -> None:
    """Assign sequence count and octets to a queued telecommand; they never change again."""
    issued = _issued(connection, row["vehicle_id"], row["name"], row["arguments"], actor)
    _decide(connection, row["id"], "released", **issued)
    _note(
        connection,
        actor,
        "release",
        row["id"],
        "released",
        {"sequence_count": issued["sequence_count"]},
    )


def _decide(connection: Connection, command_id: int, state: str, decided_by: str, **values: Any) -> None:
    values.setdefault("decided_utc_ns", utc_now_ns())
    move(connection, TELECOMMAND, command_id, state, expected=("queued",), decided_by=decided_by, **values)


def _issued(
    connection: Connection, vehicle: int, name: str, arguments: Mapping[str, Any], actor: str
) -> dict[str, Any]:
    """Return the columns of a telecommand with the next sequence count of its spacecraft."""
    count = next_telecommand(connection, vehicle) % SEQUENCE_COUNT_LIMIT
    octets = _packed(name, arguments, count)
    return {
        "sequence_count": count,
        "request_id": int.from_bytes(octets[:4], "big"),
        "octets": octets,
        "decided_by": actor,
        "decided_utc_ns": utc_now_ns(),
    }


def _packed(name: str, arguments: Mapping[str, Any], count: int) -> bytes:
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, n=1) or COMMANDS[:1]
        expected = f"one of the {len(COMMANDS)} telecommands of the dictionary, such as {near[0]}"
        raise InvalidInput("telecommand", "name", expected, repr(name)[:80])
    try:
        return DICTIONARY.pack_command(name, dict(arguments), sequence_count=count)
    except TmtcError as error:
        raise InvalidInput("telecommand", name, "arguments as the dictionary says", str(error)) from None
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InvalidInput("telecommand", name, "numbers or names as arguments", str(error)[:200]) from None


def policy_of(connection: Connection, vehicle: int) -> ApprovalPolicy:
    """Return the approval policy of a spacecraft: that of the dictionary, modified by its mission description."""
    row = repository.get(connection, repository.VEHICLES, vehicle, "spacecraft")
    approval = approval_in_force(connection, int(row["ccsds_id"]))
    return DEFAULT_POLICY.raised(*(approval.second_person_for or ())).relaxed(
        *(approval.one_person_for or ())
    )


def _second_person(
    connection: Connection, vehicle: int, name: str, arguments: Mapping[str, Any]
) -> CommandEffect | None:
    """Return the effect for which a telecommand needs a second person; None if it needs none."""
    effect = effect_of(DICTIONARY, name, arguments, _packed(name, arguments, 0))
    return effect if policy_of(connection, vehicle).needs_second_person(effect) else None


def _require_approval(
    connection: Connection, vehicle: int, name: str, arguments: Mapping[str, Any], approval: Approval | None
) -> None:
    """Refuse the immediate release of a telecommand that needs a second person if no second person approved its window.

    Raises
    ------
    Conflict
        If the window was not approved, or approved by the person who entered it.
    """
    effect = _second_person(connection, vehicle, name, arguments)
    if effect is None or (approval is not None and approval.entered_by != approval.approved_by):
        return
    raise Conflict(
        f"telecommand {name}: critical; expected a window that a second person has approved "
        f"({effect.effect}: {effect.reason})"
    )


def _newest_ticks(connection: Connection, vehicle: int) -> int:
    """The newest on-board time that the verification reports so far tell of."""
    table = repository.SAMPLES["verifications"]
    newest = connection.execute(
        select(func.max(table.c.ticks)).where(
            table.c.vehicle_id == vehicle, table.c.dictionary_version == readable_version(connection, vehicle)
        )
    ).scalar()
    return int(newest) if newest is not None else -1


def _note(
    connection: Connection, actor: str, action: str, command_id: int, state: str, detail: dict[str, Any]
) -> None:
    audit(connection, actor, f"{action} telecommand", str(command_id), detail)
    publish(connection, CommandStateChanged(id=command_id, state=state))
