"""Memory and processor time of the processes of a mission run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from studies.mission_run.parts import descendants

_TICKS_PER_SECOND = os.sysconf("SC_CLK_TCK")


def resident_mib(process: int) -> float | None:
    """Return the resident memory of a process in MiB; None if it is not known."""
    try:
        for line in Path(f"/proc/{process}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return round(int(line.split()[1]) / 1024.0, 1)
    except (OSError, ValueError):
        pass
    return None


def cpu_s(process: int) -> float | None:
    """Return the processor time of a running process in s; None if it is not known."""
    try:
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return round((int(words[11]) + int(words[12])) / _TICKS_PER_SECOND, 1)
    except (OSError, ValueError, IndexError):
        return None


def family_mib(process: int) -> float | None:
    """Return the memory of a process and its descendants in MiB, shared pages by their share; None if not known."""
    octets = 0
    for pid in (process, *descendants(process)):
        with suppress(OSError, ValueError, IndexError):
            rows = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
            octets += next(int(row.split()[1]) for row in rows if row.startswith("Pss:"))
    return round(octets / 1024.0, 1) or None


def family_cpu_s(process: int) -> float | None:
    """Return the processor time of a process and its running descendants in s; None if it is not known."""
    known = [one for one in map(cpu_s, (process, *descendants(process))) if one is not None]
    return round(sum(known), 1) if known else None


@dataclass(slots=True)
class Usage:
    """Memory and processor time of processes by name, which can be replaced by others of the same name.

    Attributes
    ----------
    memory_mib
        Samples of the memory.
    cpu_s
        Processor time, with that of the processes before.
    """

    memory_mib: dict[str, list[float]] = field(default_factory=dict)
    cpu_s: dict[str, float] = field(default_factory=dict)
    _begun: dict[str, tuple[int, float]] = field(default_factory=dict)

    def note(self, name: str, process: int, *, family: bool) -> None:
        """Take a sample."""
        used = family_mib(process) if family else resident_mib(process)
        if used is not None:
            self.memory_mib.setdefault(name, []).append(used)
        spent = family_cpu_s(process) if family else cpu_s(process)
        if spent is None:
            return
        known, before = self._begun.get(name, (0, 0.0))
        if known != process:
            before = self.cpu_s.get(name, 0.0)
            self._begun[name] = (process, before)
        # A child that has ended is not counted any more.
        self.cpu_s[name] = round(max(before + spent, self.cpu_s.get(name, 0.0)), 1)


def summary(samples: Sequence[float]) -> dict[str, float | None]:
    """Return the first, largest and last of some samples; `early` is that after a tenth of them."""
    if not samples:
        return {"first": None, "early": None, "peak": None, "last": None}
    return {
        "first": samples[0],
        "early": samples[len(samples) // 10],
        "peak": max(samples),
        "last": samples[-1],
    }
