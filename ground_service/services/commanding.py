"""Telecommands: entered, released or rejected, sent, and followed to their end.

queued → released → sent → (accepted → started → completed | failed), or queued → rejected. A critical command is
released by somebody other than who entered it. Every step goes into the audit log in the transaction that makes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, func, select

from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, InvalidInput
from ground_service.processing.verification import CommandFate, SentCommand, VerificationReport, fate_of
from ground_service.services.feed import publish
from ground_service.services.ground import Ground
from ground_service.services.ingest import FLOWN
from ground_service.services.users import audit
from ground_service.store import repository
from tmtc.dictionary import DICTIONARY
from tmtc.errors import TmtcError
from tmtc.packets import SEQUENCE_COUNT_LIMIT
from tmtc.uplink import UplinkEncoder

DEFAULT_TIMEOUT_S = 600

CRITICAL_COMMANDS = ("reset_schedule", "delete_store", "uplink_first", "uplink_middle", "uplink_last")
CRITICAL_FUNCTIONS = ("clear_store", "reboot", "abort_uplink")
"""What destroys data or changes what the payload is: a second person has to agree."""

COMMANDS = tuple(definition.name for definition in DICTIONARY.telecommands)


@dataclass(frozen=True, slots=True)
class CommandView:
    """A telecommand as it stands now; `fate` is None before it is sent."""

    row: dict[str, Any]
    spacecraft_id: int
    instance: str
    fate: CommandFate | None

    @property
    def state(self) -> str:
        """Where the command is on its way."""
        return self.fate.state if self.fate is not None else str(self.row["state"])


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
    _packed(name, arguments, 0)
    critical = _is_critical(name, arguments)
    with ground.database.writing() as connection:
        key = int(
            repository.add(
                connection,
                repository.TELECOMMANDS,
                vehicle_id=repository.vehicle_id(connection, spacecraft_id, instance),
                name=name,
                arguments=dict(arguments),
                state="queued",
                critical=int(critical),
                timeout_s=timeout_s,
                requested_by=actor,
                created_utc_ns=utc_now_ns(),
            )
        )
        _note(connection, actor, "enter", key, "queued", {"name": name, "arguments": dict(arguments)})
    return key


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
        count = _next_count(connection, row["vehicle_id"])
        octets = _packed(row["name"], row["arguments"], count)
        repository.change(
            connection,
            repository.TELECOMMANDS,
            command_id,
            state="released",
            decided_by=actor,
            decided_utc_ns=utc_now_ns(),
            sequence_count=count,
            request_id=int.from_bytes(octets[:4], "big"),
            octets=octets,
        )
        _note(connection, actor, "release", command_id, "released", {"sequence_count": count})


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
            _note(connection, actor, "send", row[0], "sent", {})
    packets = [bytes(row[1]) for row in rows]
    stream = UplinkEncoder(spacecraft_id).encode(packets) if framed else b"".join(packets)
    return stream, [int(row[0]) for row in rows]


def get_command(ground: Ground, command_id: int) -> CommandView:
    """A telecommand as it stands now."""
    with ground.database.reading() as connection:
        row = repository.get(connection, repository.TELECOMMANDS, command_id, "telecommand")
        return _view(connection, row)


def list_commands(
    ground: Ground, *, state: str | None = None, limit: int = 100, offset: int = 0
) -> tuple[list[CommandView], int]:
    """Telecommands, the newest first; `state` keeps those in one stored state (queued, released, rejected, sent)."""
    equal = {"state": state} if state is not None else {}
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.TELECOMMANDS, limit=limit, offset=offset, **equal)
        return [_view(connection, row) for row in page.rows], page.total


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
    return name in CRITICAL_COMMANDS


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
            table.c.vehicle_id == vehicle, table.c.dictionary_version == DICTIONARY.version
        )
    ).scalar()
    return int(newest) if newest is not None else -1


def _view(connection: Connection, row: repository.Row) -> CommandView:
    vehicle = repository.get(connection, repository.VEHICLES, row["vehicle_id"], "vehicle")
    fate = None
    if row["state"] == "sent":
        table, commands = repository.SAMPLES["verifications"], repository.TELECOMMANDS
        reports = connection.execute(
            select(
                table.c.subtype, table.c.request_id, table.c.ticks, table.c.step, table.c.failure_code
            ).where(
                table.c.vehicle_id == row["vehicle_id"],
                table.c.dictionary_version == DICTIONARY.version,
                table.c.ticks > row["sent_after_ticks"],
                table.c.request_id == row["request_id"],
            )
        )
        repeated = connection.execute(
            select(func.min(commands.c.sent_after_ticks)).where(
                commands.c.vehicle_id == row["vehicle_id"],
                commands.c.request_id == row["request_id"],
                commands.c.id > row["id"],
            )
        ).scalar()
        fate = fate_of(
            SentCommand(
                request_id=row["request_id"],
                sent_utc_ns=row["sent_utc_ns"],
                sent_after_ticks=row["sent_after_ticks"],
                repeated_after_ticks=repeated,
                timeout_ns=row["timeout_s"] * 1_000_000_000,
            ),
            [VerificationReport(*report) for report in reports],
            utc_now_ns(),
        )
    return CommandView(row, vehicle["ccsds_id"], vehicle["instance"], fate)


def _note(
    connection: Connection, actor: str, action: str, command_id: int, state: str, detail: dict[str, Any]
) -> None:
    audit(connection, actor, f"{action} telecommand", str(command_id), detail)
    publish(connection, "telecommand", {"id": command_id, "state": state})
