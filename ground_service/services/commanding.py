"""Telecommands: entered, released or rejected, sent, and followed to their end.

queued → released → sent → (accepted → started → completed | failed), or queued → rejected. A critical command is
released by somebody other than who entered it. Every step goes into the audit log in the transaction that makes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from sqlalchemy import BigInteger, Connection, cast, func, select

from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, InvalidInput
from ground_service.services.command_state import CommandView, command_view
from ground_service.services.feed import publish
from ground_service.services.ground import Ground
from ground_service.services.ingest import FLOWN
from ground_service.services.pass_data import readable_version
from ground_service.services.users import audit
from ground_service.services.window_progress import advance_windows
from ground_service.store import repository
from tmtc.dictionary import DICTIONARY
from tmtc.errors import TmtcError
from tmtc.packets import SEQUENCE_COUNT_LIMIT
from tmtc.uplink import UplinkEncoder

DEFAULT_TIMEOUT_S = 600

CRITICAL_COMMANDS = ("reset_schedule", "delete_store", "uplink_first", "uplink_middle", "uplink_last")
CRITICAL_FUNCTIONS = ("clear_store", "reboot", "abort_uplink")
"""What destroys data or changes what the payload is: a second person has to agree."""

_SERVICE, _TIME_OUT = "service", "time out"

COMMANDS = tuple(definition.name for definition in DICTIONARY.telecommands)


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
        vehicle = repository.vehicle_id(connection, spacecraft_id, instance)
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
) -> int:
    """Add a telecommand that is released already, within the caller's transaction; its id.

    Raises
    ------
    Conflict
        If it is critical: such a one has to be entered and then released by somebody else.
    """
    if _is_critical(name, arguments):
        raise Conflict(f"telecommand {name}: is critical; it has to be released by a second person")
    key = _add(connection, vehicle, name, arguments, "queued", actor, timeout_s, window_id)
    _release(connection, key, actor)
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
) -> int:
    """Add a released `insert_activity` that carries a telecommand to be done at an on-board time; its id.

    The telecommand inside has a sequence count and a row of its own, so that the reports about it are found.
    """
    if _is_critical(name, arguments):
        raise Conflict(f"telecommand {name}: is critical; it has to be released by a second person")
    inner = _add(connection, vehicle, name, arguments, "carried", actor, timeout_s, window_id)
    octets = _commit(connection, inner, "carried", actor)
    outer = add_released(
        connection,
        vehicle,
        "insert_activity",
        {"release_ticks": release_ticks, "items": [{"octet": octet} for octet in octets]},
        actor=actor,
        timeout_s=timeout_s,
        window_id=window_id,
    )
    repository.change(connection, repository.TELECOMMANDS, inner, carrier_id=outer)
    return outer


def release_command(ground: Ground, command_id: int, *, actor: str) -> None:
    """Release a queued command for uplink: its octets are made and never change again.

    Raises
    ------
    Conflict
        If it is not queued, or is critical and was entered by the same person.
    """
    with ground.database.writing() as connection:
        row = _queued(connection, command_id)
        if row["critical"] and row["requested_by"] == actor:
            raise Conflict(
                f"telecommand {command_id} ({row['name']}): is critical; "
                f"expected another person than {actor} to release it"
            )
        _release(connection, command_id, actor)


def reject_command(ground: Ground, command_id: int, *, actor: str, reason: str) -> None:
    """Take a queued command out of the queue."""
    with ground.database.writing() as connection:
        _queued(connection, command_id)
        repository.change(
            connection,
            repository.TELECOMMANDS,
            command_id,
            state="rejected",
            decided_by=actor,
            decided_utc_ns=utc_now_ns(),
            reason=reason,
        )
        _note(connection, actor, "reject", command_id, "rejected", {"reason": reason})


def take_uplink(
    ground: Ground, *, spacecraft_id: int, instance: str = FLOWN, framed: bool = True, actor: str
) -> tuple[bytes, list[int]]:
    """What is to be sent now: all released commands in order, as CLTUs or bare packets, and their ids.

    They count as sent from then on.
    """
    table = repository.TELECOMMANDS
    with ground.database.writing() as connection:
        vehicle = repository.vehicle_id(connection, spacecraft_id, instance)
        rows = connection.execute(
            select(table.c.id, table.c.octets)
            .where(table.c.vehicle_id == vehicle, table.c.state == "released")
            .order_by(table.c.decided_utc_ns, table.c.id)
            .with_for_update()
        ).all()
        now = utc_now_ns()
        newest = _newest_ticks(connection, vehicle)
        for row in rows:
            repository.change(
                connection, table, row[0], state="sent", sent_utc_ns=now, sent_after_ticks=newest
            )
            connection.execute(
                table.update()
                .where(table.c.carrier_id == row[0], table.c.state == "carried")
                .values(state="sent", sent_utc_ns=now, sent_after_ticks=newest)
            )
            _note(connection, actor, "send", row[0], "sent", {})
    advance_windows(ground, vehicle)
    packets = [bytes(row[1]) for row in rows]
    stream = UplinkEncoder(spacecraft_id).encode(packets) if framed else b"".join(packets)
    return stream, [int(row[0]) for row in rows]


def note_timeouts(ground: Ground, since_utc_ns: int, until_utc_ns: int) -> list[int]:
    """Put on record, and tell those who watch, which telecommands should have ended in between and did not; their ids.

    Each is noted once, however often it is asked for. What is reported late counts all the same.
    """
    table, log = repository.TELECOMMANDS, repository.AUDIT
    due = table.c.sent_utc_ns + cast(table.c.timeout_s, BigInteger) * 1_000_000_000
    with ground.database.reading() as connection:
        rows = connection.execute(
            select(table).where(table.c.state == "sent", due >= since_utc_ns, due < until_utc_ns)
        ).mappings()
        views = [command_view(connection, dict(row)) for row in rows.all()]
    overdue = [view for view in views if view.fate is not None and view.fate.timed_out]
    noted = []
    for view in overdue:
        command_id = int(view.row["id"])
        with ground.database.writing() as connection:
            known = connection.execute(
                select(log.c.id).where(
                    log.c.utc_ns >= view.row["sent_utc_ns"],
                    log.c.action == f"{_TIME_OUT} telecommand",
                    log.c.target == str(command_id),
                )
            ).first()
            if known is None:
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
    equal = {"state": state} if state is not None else {}
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
) -> int:
    """Enter a telecommand that the dictionary accepts; its id."""
    _packed(name, arguments, 0)
    key = int(
        repository.add(
            connection,
            repository.TELECOMMANDS,
            vehicle_id=vehicle,
            name=name,
            arguments=dict(arguments),
            state=state,
            critical=int(_is_critical(name, arguments)),
            timeout_s=timeout_s,
            requested_by=actor,
            created_utc_ns=utc_now_ns(),
            window_id=window_id,
        )
    )
    _note(connection, actor, "enter", key, state, {"name": name, "arguments": dict(arguments)})
    return key


def _release(connection: Connection, command_id: int, actor: str) -> None:
    octets = _commit(connection, command_id, "released", actor)
    count = int.from_bytes(octets[2:4], "big") % SEQUENCE_COUNT_LIMIT
    _note(connection, actor, "release", command_id, "released", {"sequence_count": count})


def _commit(connection: Connection, command_id: int, state: str, actor: str) -> bytes:
    """Give a telecommand its sequence count and its octets, which never change again."""
    row = repository.get(connection, repository.TELECOMMANDS, command_id, "telecommand")
    count = _next_count(connection, row["vehicle_id"])
    octets = _packed(row["name"], row["arguments"], count)
    repository.change(
        connection,
        repository.TELECOMMANDS,
        command_id,
        state=state,
        decided_by=actor,
        decided_utc_ns=utc_now_ns(),
        sequence_count=count,
        request_id=int.from_bytes(octets[:4], "big"),
        octets=octets,
    )
    return octets


def _packed(name: str, arguments: Mapping[str, Any], count: int) -> bytes:
    if name not in COMMANDS:
        raise InvalidInput("telecommand", "name", ", ".join(COMMANDS), repr(name)[:80])
    try:
        return DICTIONARY.pack_command(name, dict(arguments), sequence_count=count)
    except TmtcError as error:
        raise InvalidInput("telecommand", name, "arguments as the dictionary says", str(error)) from None
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidInput("telecommand", name, "numbers or names as arguments", str(error)[:200]) from None


def _is_critical(name: str, arguments: Mapping[str, Any]) -> bool:
    if name == "perform_function":
        labels = DICTIONARY.labels("perform_function", "function_id")
        function = arguments.get("function_id")
        return (labels.get(function) if isinstance(function, int) else function) in CRITICAL_FUNCTIONS
    if name == "insert_activity":
        return _carries_critical(name, arguments)
    return name in CRITICAL_COMMANDS


def _carries_critical(name: str, arguments: Mapping[str, Any]) -> bool:
    """Whether a telecommand is in a scheduled one that needs a second person, or one that cannot be read."""
    carrier = DICTIONARY.unpack_command(_packed(name, arguments, 0))
    octets = bytes(np.asarray(carrier.values["items"]["octet"], dtype=np.uint8))
    try:
        inner = DICTIONARY.unpack_command(octets)
    except TmtcError:
        return True
    return _is_critical(inner.name, inner.values)


def _queued(connection: Connection, command_id: int) -> repository.Row:
    row = repository.get(connection, repository.TELECOMMANDS, command_id, "telecommand")
    if row["state"] != "queued":
        raise Conflict(f"telecommand {command_id}: expected state queued, found {row['state']}")
    return row


def _next_count(connection: Connection, vehicle: int) -> int:
    """The 14-bit sequence count after that of the newest released command."""
    table = repository.TELECOMMANDS
    connection.execute(
        select(repository.VEHICLES.c.id).where(repository.VEHICLES.c.id == vehicle).with_for_update()
    )
    released = connection.execute(
        select(func.count()).where(table.c.vehicle_id == vehicle, table.c.sequence_count.is_not(None))
    ).scalar_one()
    return int(released) % SEQUENCE_COUNT_LIMIT


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
    publish(connection, "telecommand", {"id": command_id, "state": state})
