"""State of a planned window, from decisions and telemetry, and its conflicts.

draft → approved → uplinked → executing → executed → downlinked → processed, or failed; a window whose telecommands were
sent is cancelled by others that delete them on board: it is cancelling until their verification, then failed

The state is a function of evidence, not of the order in which they became known: late telemetry mends a state that was
concluded without it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from ground_service.errors import PlanConflict

STATES = (
    "draft", "approved", "uplinked", "cancelling", "executing", "executed", "downlinked", "processed", "failed",
)  # fmt: skip
DECISIONS = ("draft", "approved", "cancelling", "failed")
COMMITTED = ("approved", "uplinked", "cancelling", "executing", "executed", "downlinked")
"""States in which a window claims its time and its storage."""

FLOWN = "it was flown although it was cancelled"
CANCELLED = "it was cancelled, its activities were deleted on board"
REPLACED = "it failed, and another window has its time"


@dataclass(frozen=True, slots=True)
class WindowEvidence:
    """Known evidence about a window.

    Attributes
    ----------
    decision
        What people decided last: draft, approved, cancelling or failed.
    predecessor_failed
        Whether the window that has to come before it failed.
    replaced
        Whether a later window that has not failed covers part of its time: data of that time belong to the later one.
    command_states
        States of the telecommands that carry it up and of those they carry.
    deletion_states
        States of the telecommands that delete its activities on board.
    failure
        Name of the first of them that failed, with the reason.
    frames
        Frames of it that came down.
    started, stopped
        Whether an event report or a verification report shows the start, and the end, of the observation.
    received_after
        Whether telemetry from after its end has come down.
    ended
        Whether it has ended by the mission clock: telemetry does not fail a window before that.
    awaited
        Whether packets of its time are missing that may still come down.
    lost
        Packets missing from its span; None where none came at all.
    reported
        Whether a report of its pass was made.
    closed
        Whether it was decided not to wait for the packets that are missing.
    """

    decision: str
    predecessor_failed: bool = False
    replaced: bool = False
    command_states: tuple[str, ...] = ()
    deletion_states: tuple[str, ...] = ()
    failure: str = ""
    frames: int = 0
    started: bool = False
    stopped: bool = False
    received_after: bool = False
    ended: bool = True
    awaited: bool = False
    lost: int | None = None
    reported: bool = False
    closed: bool = False


def state_of(evidence: WindowEvidence) -> tuple[str, str | None]:
    """The state of a window, and the reason where it failed."""
    if evidence.decision == "cancelling":
        return _cancelled(evidence)
    if evidence.decision != "approved":
        return evidence.decision, None
    if evidence.replaced:
        return "failed", REPLACED
    return _flown(evidence) or _awaiting(evidence)


def _cancelled(evidence: WindowEvidence) -> tuple[str, str | None]:
    """Return state and reason of a window that is cancelled: what flies all the same becomes a pass."""
    flown = _flown(evidence)
    if flown is not None:
        return flown[0], FLOWN
    if set(evidence.deletion_states) == {"completed"}:
        return "failed", CANCELLED
    if evidence.received_after and evidence.ended and not evidence.awaited:
        return "failed", "it was cancelled, telemetry from after its end shows no observation"
    refused = evidence.deletion_states.count("failed")
    return ("cancelling", f"{refused} of its activities could not be deleted: {evidence.failure}" if refused else None)


def _flown(evidence: WindowEvidence) -> tuple[str, str | None] | None:
    """Return the state of a window whose observation has begun; None if it has not."""
    begun = evidence.started or evidence.frames > 0
    over = begun and (evidence.stopped or evidence.received_after)
    if over and evidence.received_after and (evidence.lost == 0 or evidence.closed):
        return ("processed" if evidence.reported else "downlinked"), None
    if over:
        return "executed", None
    return ("executing", None) if begun else None


def _awaiting(evidence: WindowEvidence) -> tuple[str, str | None]:
    """Return the state of an approved window whose observation has not begun."""
    if "failed" in evidence.command_states:
        return "failed", f"a telecommand of it failed: {evidence.failure or 'no reason is known'}"
    if evidence.predecessor_failed:
        return "failed", "its predecessor failed"
    sent = bool(evidence.command_states) and not {"queued", "released", "carried"} & set(evidence.command_states)
    if sent and evidence.received_after and evidence.ended and not evidence.awaited:
        return "failed", "telemetry from after its end shows no observation"
    return ("uplinked" if sent else "approved"), None


@dataclass(frozen=True, slots=True)
class PlannedSpan:
    """A window as conflicts see it."""

    id: int
    start_utc_ns: int
    stop_utc_ns: int
    state: str


def span_conflicts(
    window: PlannedSpan, predecessor: PlannedSpan | None, others: Sequence[PlannedSpan], gap_ns: int = 0
) -> list[PlanConflict]:
    """Return overlaps with committed windows, and a predecessor that does not come before.

    The sequences of telecommands overlap if there is less than `gap_ns` between the windows.
    """
    found = []
    for other in others:
        between = max(other.start_utc_ns - window.stop_utc_ns, window.start_utc_ns - other.stop_utc_ns)
        if other.id != window.id and other.state in COMMITTED and between < gap_ns:
            what = f"window {other.id} ({other.state}) covers part of the same time"
            if between >= 0:
                what = (
                    f"expected at least {gap_ns / 1e9:g} s between the window and window {other.id} "
                    f"({other.state}) for their telecommands, found {between / 1e9:g} s"
                )
            found.append(PlanConflict("overlap", other.id, what))
    if predecessor is not None:
        if predecessor.stop_utc_ns > window.start_utc_ns or predecessor.id == window.id:
            found.append(
                PlanConflict(
                    "predecessor", predecessor.id, f"window {predecessor.id} does not end before this one starts"
                )
            )
        if predecessor.state == "failed":
            found.append(PlanConflict("predecessor", predecessor.id, f"window {predecessor.id} failed"))
    return found
