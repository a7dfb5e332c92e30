"""Memory and processor time of processes with their descendants."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from studies.harness.parts import descendants

_TICKS_PER_SECOND = os.sysconf("SC_CLK_TCK")


def _cpu_s(process: int) -> float | None:
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


def family_cpu_s(process: int) -> float | None:
    """Return the processor time of a process and its running descendants in s; None if it is not known."""
    known = [one for one in map(_cpu_s, (process, *descendants(process))) if one is not None]
    return sum(known) if known else None
