"""Memory and processor time of the processes of a mission run."""

from __future__ import annotations

import os
import resource
from collections.abc import Sequence
from pathlib import Path

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


def own_cpu_s() -> float:
    """Return the processor time of this process in s."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return round(used.ru_utime + used.ru_stime, 1)


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
