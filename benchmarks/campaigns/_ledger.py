"""Acknowledgements of telecommands received by clients, and their comparison with the final archive."""

import threading
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

FAULTS = (
    "commands_lost",
    "commands_doubled",
    "states_lost",
    "shared_counts",
    "double_hand_outs",
    "hand_outs_wrong",
    "audit_wrong",
    "chain_broken",
    "heads_lost",
    "rows_damaged",
)
AFTER = {
    "released": ("released", "sent"),
    "rejected": ("rejected",),
    "sent": ("sent",),
    "queued": ("queued", "released", "rejected", "sent"),
}
"""Permitted final states of a telecommand, by the acknowledged state."""

DECISIONS = {"released": "release", "sent": "release", "rejected": "reject"}


@dataclass(frozen=True, slots=True)
class Entered:
    """Telecommand whose addition was acknowledged."""

    mark: int
    command: int
    actor: str


@dataclass(frozen=True, slots=True)
class Decision:
    """Acknowledged state; `decided_by` is set if it is the decision of that client."""

    command: int
    state: str
    decided_by: str | None = None


@dataclass(frozen=True, slots=True)
class HandOut:
    """Telecommands fetched by a client, as bare packets."""

    actor: str
    commands: tuple[int, ...]
    octets: bytes


@dataclass(frozen=True, slots=True)
class AuditLine:
    """Audit entry about a telecommand: actor, action and target."""

    action: str
    command: int
    actor: str


@dataclass
class Ledger:
    """Acknowledgements of all clients of a run; filled by several threads."""

    entered: list[Entered] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    hand_outs: list[HandOut] = field(default_factory=list)
    unanswered_hand_outs: int = 0
    changed_answers: int = 0
    heads: list[tuple[int, str]] = field(default_factory=list)
    jobs: list[str] = field(default_factory=list)
    marks: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def count(self, name: str) -> int:
        """Count in one of the numbers; return it. `marks` are unique numbers for the arguments of telecommands."""
        with self._lock:
            setattr(self, name, getattr(self, name) + 1)
            return int(getattr(self, name))


def mark_of(row: Mapping[str, Any]) -> int:
    """Return the number that identifies a telecommand: its first argument."""
    return int(row["arguments"]["argument_1"])


def judge(ledger: Ledger, rows: Sequence[Mapping[str, Any]], lines: Iterable[AuditLine]) -> Counter[str]:
    """Return the number of differences between the archive and the acknowledgements, by kind of fault.

    Parameters
    ----------
    rows
        All telecommands of the archive, with the columns of the table.
    lines
        All audit entries about telecommands.
    """
    faults: Counter[str] = Counter()
    by_id = {int(row["id"]): row for row in rows}
    marks = Counter(mark_of(row) for row in rows)
    faults["commands_doubled"] = sum(count - 1 for count in marks.values())
    for one in ledger.entered:
        row = by_id.get(one.command)
        faults["commands_lost"] += row is None or mark_of(row) != one.mark
    for decision in ledger.decisions:
        row = by_id.get(decision.command)
        kept = row is not None and row["state"] in AFTER[decision.state]
        if row is not None and decision.decided_by is not None:
            kept = kept and row["decided_by"] == decision.decided_by
        faults["states_lost"] += not kept
    counts = Counter((row["vehicle_id"], row["sequence_count"]) for row in rows if row["sequence_count"] is not None)
    faults["shared_counts"] = sum(count - 1 for count in counts.values())
    faults.update(_judge_hand_outs(ledger, by_id))
    faults["audit_wrong"] = _wrong_lines(ledger, by_id, lines)
    return faults


def _judge_hand_outs(ledger: Ledger, by_id: Mapping[int, Mapping[str, Any]]) -> Counter[str]:
    faults: Counter[str] = Counter(hand_outs_wrong=ledger.changed_answers)
    times = Counter(command for one in ledger.hand_outs for command in one.commands)
    faults["double_hand_outs"] = sum(count - 1 for count in times.values())
    for one in ledger.hand_outs:
        found = [by_id.get(command) for command in one.commands]
        sent = b"".join(bytes(row["octets"]) for row in found if row is not None and row["state"] == "sent")
        faults["hand_outs_wrong"] += sent != one.octets
    if ledger.unanswered_hand_outs == 0:
        nowhere = {command for command, row in by_id.items() if row["state"] == "sent"} - set(times)
        faults["hand_outs_wrong"] += len(nowhere)
    return faults


def _wrong_lines(ledger: Ledger, by_id: Mapping[int, Mapping[str, Any]], lines: Iterable[AuditLine]) -> int:
    """Return the number of audit entries about telecommands that are missing, superfluous, or have a wrong actor."""
    found: Counter[tuple[str, int]] = Counter()
    actors: dict[tuple[str, int], str] = {}
    for line in lines:
        found[line.action, line.command] += 1
        actors[line.action, line.command] = line.actor
    expected: dict[tuple[str, int], str | None] = {}
    for command, row in by_id.items():
        expected["enter", command] = row["requested_by"]
        if row["state"] in DECISIONS:
            expected[DECISIONS[row["state"]], command] = row["decided_by"]
        if row["state"] == "sent":
            expected["send", command] = None
    for one in ledger.entered:
        expected["enter", one.command] = one.actor
    for decision in ledger.decisions:
        if decision.decided_by is not None:
            expected[DECISIONS[decision.state], decision.command] = decision.decided_by
    for hand_out in ledger.hand_outs:
        expected.update({("send", command): hand_out.actor for command in hand_out.commands})
    wrong = sum(abs(found[key] - 1) for key in expected) + sum(
        count for key, count in found.items() if key not in expected
    )
    return wrong + sum(actors[key] != actor for key, actor in expected.items() if actor is not None and key in actors)
