"""Housekeeping (PUS service 3): which structures are sent when, and the processor time of every stage."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from payload_emulator.flight.ports import Board, Stage
from tmtc.packets.pus import TICKS_PER_SECOND

STATE, PERFORMANCE = 1, 2
FIRST_DEFINED = 16
MOST_DEFINED = 8
_MILLISECOND_NS = 1e6


@dataclass(slots=True)
class Structure:
    """A housekeeping structure; `quantities` are codes of the data pool, empty for the built-in ones."""

    interval_s: float
    quantities: tuple[int, ...] = ()
    enabled: bool = True
    next_ticks: int | None = None


@dataclass(slots=True)
class Housekeeping:
    """All structures by number."""

    structures: dict[int, Structure] = field(default_factory=dict)

    def due(self, ticks: int) -> list[int]:
        """The structures to be sent now; each counts from this time on."""
        now = [
            number
            for number, structure in sorted(self.structures.items())
            if structure.enabled
            and structure.interval_s > 0.0
            and (structure.next_ticks is None or ticks >= structure.next_ticks)
        ]
        for number in now:
            structure = self.structures[number]
            structure.next_ticks = ticks + round(structure.interval_s * TICKS_PER_SECOND)
        return now

    def restart(self) -> None:
        """Restart the intervals: the clock has moved."""
        for structure in self.structures.values():
            structure.next_ticks = None

    @property
    def defined(self) -> dict[int, Structure]:
        """The structures defined by telecommand."""
        return {n: structure for n, structure in self.structures.items() if n >= FIRST_DEFINED}

    def to_plain(self) -> list[list[Any]]:
        """The structures as numbers, for non-volatile memory."""
        return [[n, s.interval_s, list(s.quantities), s.enabled] for n, s in self.structures.items()]

    def restore(self, plain: Iterable[Iterable[Any]]) -> None:
        """Take what `to_plain` gave."""
        for number, interval_s, quantities, enabled in plain:
            self.structures[int(number)] = Structure(float(interval_s), tuple(quantities), bool(enabled))


@dataclass(slots=True, eq=False)
class StageTimer:
    """Processor time by stage since the last report."""

    board: Board
    detector_max_ms: float = 0.0
    steps: int = 0
    _spent_ns: dict[int, int] = field(default_factory=dict)
    _stage: int = Stage.idle
    _since_ns: int = 0

    def enter(self, stage: int) -> int:
        """Begin a stage; the processor's time counter in nanoseconds."""
        now = self.board.enter(stage)
        self._spent_ns[self._stage] = self._spent_ns.get(self._stage, 0) + now - self._since_ns
        self._stage, self._since_ns = stage, now
        return now

    def mean_ms(self, stage: Stage) -> float:
        """Mean per step."""
        return self._spent_ns.get(stage, 0) / _MILLISECOND_NS / max(self.steps, 1)

    def restart(self) -> None:
        """Count from here."""
        self._spent_ns.clear()
        self.steps, self.detector_max_ms = 0, 0.0
