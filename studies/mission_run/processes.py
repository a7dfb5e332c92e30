"""Memory and processor time of the processes of a mission run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from studies.mission_run.parts import descendants

WARM_UP_DAYS = 1.0
"""A process has done each kind of its daily work once after this time; its samples before are not judged."""

LEAST_SAMPLES = 9
FLAT_MIB, FLAT_SHARE = 10.0, 0.05
"""Memory that grows by less, from the first to the last third of the samples and by its slope over them, is flat."""

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
        return (int(words[11]) + int(words[12])) / _TICKS_PER_SECOND
    except (OSError, ValueError, IndexError):
        return None


@dataclass(frozen=True, slots=True)
class Memory:
    """Memory of a process and its descendants in MiB, pages that several processes use by their share.

    Attributes
    ----------
    private
        Heaps and stacks.
    shared
        Shared memory segments, such as the buffers of PostgreSQL.
    files
        Programs and libraries.
    largest
        Private memory of the process that has most of it.
    processes
        Number of processes.
    """

    private: float
    shared: float
    files: float
    largest: float
    processes: int

    @property
    def total(self) -> float:
        """Their sum, MiB."""
        return round(self.private + self.shared + self.files, 1)


_KINDS = ("Pss_Anon", "Pss_Shmem", "Pss_File")


def family_memory(process: int) -> Memory | None:
    """Return the memory of a process and its descendants by kind; None if it is not known."""
    rows: list[list[int]] = []
    for pid in (process, *descendants(process)):
        with suppress(OSError, ValueError, IndexError):
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
            known = {line.partition(":")[0]: int(line.split()[1]) for line in lines}
            rows.append([known.get(kind, 0) for kind in _KINDS])
    if not any(map(sum, rows)):
        return None
    private, shared, files = (round(sum(column) / 1024.0, 1) for column in zip(*rows, strict=True))
    return Memory(private, shared, files, round(max(row[0] for row in rows) / 1024.0, 1), len(rows))


def family_mib(process: int) -> float | None:
    """Return the memory of a process and its descendants in MiB, shared pages by their share; None if not known."""
    found = family_memory(process)
    return found.total if found else None


def family_cpu_s(process: int) -> float | None:
    """Return the processor time of a process and its running descendants in s; None if it is not known."""
    known = [one for one in map(cpu_s, (process, *descendants(process))) if one is not None]
    return sum(known) if known else None


@dataclass(slots=True)
class Usage:
    """Memory and processor time of processes by name, which can be replaced by others of the same name.

    Attributes
    ----------
    memory_mib
        Samples of the memory.
    memory_lives
        For each sample the mission day and the number of the process.
    cpu_s
        Processor time, with that of the processes before.
    """

    memory_mib: dict[str, list[float]] = field(default_factory=dict)
    cpu_s: dict[str, float] = field(default_factory=dict)
    memory_lives: dict[str, list[tuple[float, int]]] = field(default_factory=dict)
    _begun: dict[str, tuple[int, float]] = field(default_factory=dict)

    def note(self, name: str, process: int, day: float, *, family: bool) -> None:
        """Take a sample at a mission day."""
        used = family_mib(process) if family else resident_mib(process)
        if used is not None:
            self.memory_mib.setdefault(name, []).append(used)
            self.memory_lives.setdefault(name, []).append((round(day, 4), process))
        spent = family_cpu_s(process) if family else cpu_s(process)
        if spent is None:
            return
        known, before = self._begun.get(name, (0, 0.0))
        if known != process:
            before = self.cpu_s.get(name, 0.0)
            self._begun[name] = (process, before)
        # A child that has ended is not counted any more.
        self.cpu_s[name] = round(max(before + spent, self.cpu_s.get(name, 0.0)), 1)


def judged_memory(samples: Sequence[float], lives: Sequence[tuple[float, int]]) -> dict[str, Any]:
    """Return the figures of the memory of a process, and whether it is flat; what is not known is None.

    The first day after each start is left out of the medians of the first and the last third and of the slope, which
    is common to the processes that have had the name, each with a level of its own.

    Parameters
    ----------
    samples
        Memory in MiB in order of time.
    lives
        Mission day and number of the process of each sample.
    """
    found: dict[str, Any] = {
        "first": samples[0] if samples else None,
        "peak": max(samples, default=None),
        "last": samples[-1] if samples else None,
        "restarts": max(len(list(groupby(process for _, process in lives))) - 1, 0),
        "first_third": None,
        "last_third": None,
        "slope_per_day": None,
        "flat": None,
    }
    days: list[float] = []
    kept: list[float] = []
    offsets: list[list[float]] = []
    at = 0
    for _, group in groupby(lives, lambda one: one[1]):
        life = list(group)
        begun = life[0][0]
        rows = [(day, samples[at + k]) for k, (day, _) in enumerate(life) if day - begun >= WARM_UP_DAYS]
        at += len(life)
        if rows:
            level = np.mean(rows, axis=0)
            days += [day for day, _ in rows]
            kept += [used for _, used in rows]
            offsets += [level.tolist()] * len(rows)
    if len(kept) < LEAST_SAMPLES:
        return found
    third = len(kept) // 3
    first, last = float(np.median(kept[:third])), float(np.median(kept[-third:]))
    day_offset, level_offset = np.transpose(offsets)
    time, used = np.array(days) - day_offset, np.array(kept) - level_offset
    spread = float(time @ time)
    slope = float(time @ used) / spread if spread > 0.0 else None
    allowed = max(FLAT_MIB, FLAT_SHARE * first)
    growth = 0.0 if slope is None else slope * (max(days) - min(days))
    found |= {
        "first_third": first,
        "last_third": last,
        "slope_per_day": None if slope is None else round(slope, 3),
    }
    found["flat"] = last - first <= allowed and growth <= allowed
    return found
