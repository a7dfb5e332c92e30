"""Verification state of a telecommand, from its received verification reports (PUS service 1).

A report names its telecommand by the first four octets of the packet, and those return after 16384 commands. So a
report counts for a command only when it was made after the command was sent, not in an earlier boot, with a sequence
count that follows those of the reports before, and before the same octets were sent again. Reports that come late,
even after a time-out was declared, still count; the time-out stays on record.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from tmtc.dictionary.codes import FAILURES as _CODES
from tmtc.packets.space_packets import SEQUENCE_COUNT_LIMIT

_FAILURE_CODES = {name: code for code, name in _CODES}

ACCEPTED, NOT_ACCEPTED, STARTED, NOT_STARTED = 1, 2, 3, 4
PROGRESS, PROGRESS_FAILED, COMPLETED, NOT_COMPLETED, NOT_ROUTED = 5, 6, 7, 8, 10

STAGES = {
    ACCEPTED: "accepted",
    NOT_ACCEPTED: "not accepted",
    STARTED: "started",
    NOT_STARTED: "not started",
    PROGRESS: "progress",
    PROGRESS_FAILED: "progress failed",
    COMPLETED: "completed",
    NOT_COMPLETED: "not completed",
    NOT_ROUTED: "not routed",
}
DUPLICATE = _FAILURE_CODES["duplicate"]
"""Failure code of a command that the payload had accepted before: it was transmitted again."""

OUT_OF_SEQUENCE = _FAILURE_CODES["out_of_sequence"]
"""Failure code of a command whose sequence count the payload does not expect."""

FAILURES = (NOT_ACCEPTED, NOT_STARTED, PROGRESS_FAILED, NOT_COMPLETED, NOT_ROUTED)


@dataclass(frozen=True, slots=True)
class VerificationReport:
    """One report as it was received, in the boot of the newest housekeeping before it (None: unknown)."""

    subtype: int
    request_id: int
    ticks: int
    step: int | None
    failure_code: int | None
    count: int | None = None
    boot: int | None = None


@dataclass(frozen=True, slots=True)
class SentCommand:
    """A telecommand that was sent when the newest on-board time known was `sent_after_ticks`, in `boot`.

    `count` is the sequence count of the newest report until then, and `count_boot` its boot (None: unknown).
    """

    request_id: int
    sent_utc_ns: int
    sent_after_ticks: int
    repeated_after_ticks: int | None
    timeout_ns: int
    boot: int | None = None
    count: int | None = None
    count_boot: int | None = None


@dataclass(frozen=True, slots=True)
class CommandFate:
    """Latest known stage of a command: sent, accepted, started, completed or failed, and its reports."""

    state: str
    timed_out: bool
    reports: tuple[VerificationReport, ...]


def fate_of(command: SentCommand, reports: Sequence[VerificationReport], now_utc_ns: int) -> CommandFate:
    """Return the fate of a command by its reports; `timed_out` when its end is overdue at `now_utc_ns`."""
    mine = tuple(
        sorted(
            (
                report
                for report in reports
                if report.request_id == command.request_id
                and report.ticks > command.sent_after_ticks
                and (command.repeated_after_ticks is None or report.ticks <= command.repeated_after_ticks)
                and (command.boot is None or report.boot is None or report.boot >= command.boot)
                and _is_of_the_source(command, report)
            ),
            key=lambda report: (report.ticks, report.subtype, report.step or 0),
        )
    )
    # A transmission that may have been lost is repeated: the second copy is refused as a duplicate of the first.
    seen = {
        ACCEPTED if report.subtype == NOT_ACCEPTED and report.failure_code == DUPLICATE else report.subtype
        for report in mine
    }
    if seen & set(FAILURES):
        state = "failed"
    elif COMPLETED in seen:
        state = "completed"
    elif seen & {STARTED, PROGRESS}:
        state = "started"
    elif ACCEPTED in seen:
        state = "accepted"
    else:
        state = "sent"
    ended = state in ("failed", "completed")
    return CommandFate(state, not ended and now_utc_ns > command.sent_utc_ns + command.timeout_ns, mine)


def _is_of_the_source(command: SentCommand, report: VerificationReport) -> bool:
    """Return whether the sequence count of a report follows that of the newest one before, unless a boot reset it."""
    if command.count is None or report.count is None or report.boot is None or report.boot != command.count_boot:
        return True
    return 0 < (report.count - command.count) % SEQUENCE_COUNT_LIMIT < SEQUENCE_COUNT_LIMIT // 2
