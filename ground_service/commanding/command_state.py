"""Where a telecommand has come, from its row and the verification reports in the archive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, func, select

from ground_service.clock import utc_now_ns
from ground_service.commanding.core import STAGES, CommandFate, SentCommand, VerificationReport, fate_of
from ground_service.commanding.model import CommandReport, Telecommand
from ground_service.ingest.redecode import readable_version
from ground_service.store import repository
from tmtc.codes import FAILURES

_FAILURES = dict(FAILURES)


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

    @property
    def telecommand(self) -> Telecommand:
        """The telecommand as an entity."""
        reports = self.fate.reports if self.fate is not None else ()
        return Telecommand.of(
            self.row,
            spacecraft_id=self.spacecraft_id,
            instance=self.instance,
            state=self.state,
            critical=bool(self.row["critical"]),
            timed_out=self.fate is not None and self.fate.timed_out,
            requested=self.row["created_utc_ns"],
            reports=[
                CommandReport(
                    stage=STAGES.get(report.subtype, str(report.subtype)),
                    ticks=report.ticks,
                    step=report.step,
                    failure=None
                    if report.failure_code is None
                    else _FAILURES.get(report.failure_code, str(report.failure_code)),
                )
                for report in reports
            ],
        )


def command_view(connection: Connection, row: repository.Row) -> CommandView:
    """A telecommand with its spacecraft, and what the reports so far say about it."""
    vehicle = repository.get(connection, repository.VEHICLES, row["vehicle_id"], "vehicle")
    fate = None
    if row["state"] == "sent":
        table, commands = repository.SAMPLES["verifications"], repository.TELECOMMANDS
        reports = connection.execute(
            select(
                table.c.subtype, table.c.request_id, table.c.ticks, table.c.step, table.c.failure_code
            ).where(
                table.c.vehicle_id == row["vehicle_id"],
                table.c.dictionary_version == readable_version(connection, row["vehicle_id"]),
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


def views_of_window(connection: Connection, window_id: int) -> list[CommandView]:
    """Return the telecommands of a window that were not rejected."""
    table = repository.TELECOMMANDS
    query = select(table).where(table.c.window_id == window_id, table.c.state != "rejected")
    return [command_view(connection, dict(row)) for row in connection.execute(query).mappings()]
