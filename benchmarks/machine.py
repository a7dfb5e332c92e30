"""The payload as a machine: memory when idle, and a year of housekeeping without growth: python -m benchmarks.machine.

Memory is the resident set of this process, which runs nothing but flight software (with its network loaded) on a board.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._rows import Row
from payload_emulator.flight.ports import BareBoard

_MINUTE_TICKS = 60 * 65_536
_MINUTES_A_DAY = 1440
_START_TICKS = 61_000_000_000_000
_CONTACT_TURNS, _CONTACT_OCTETS = 12, 4 << 20


class _Board(BareBoard):
    """A bare board whose link comes and goes."""

    takes = 0

    def downlink_octets(self) -> int:
        return self.takes


def bench(days: float = 365.0, minutes: int = 10) -> dict[str, Any]:
    """Resident memory idle and after every month of `days`, with a packet of housekeeping at an interval in minutes."""
    from payload_emulator.flight.models import load_shipped_model
    from payload_emulator.flight.payload import Payload, PayloadMode
    from payload_emulator.flight.vision.detector import OnnxDetector
    from tmtc.dictionary import DICTIONARY

    model = load_shipped_model()
    detector = OnnxDetector(model)
    board = _Board()
    payload = Payload(
        detector, model_hash=detector.model_hash, model_octets=model, board=board, mode=PayloadMode.standby
    )
    # Checking four megabytes of memory every ten minutes of a year would be all that is measured.
    orders = b"".join(
        DICTIONARY.pack_command("set_parameter", {"parameter_id": number, "value": value}, sequence_count=k)
        for k, (number, value) in enumerate(((1, 60.0 * min(minutes, 60)), (2, 3600.0), (15, 86_400.0)))
    )
    image, attitude = np.zeros((0, 0), np.uint8), np.full(7, np.nan)
    board.takes = _CONTACT_OCTETS
    payload.step(image, attitude, _START_TICKS, orders)
    idle_mib = _resident_mib()
    turns = round(days * _MINUTES_A_DAY / minutes)
    packets = octets = 0
    months: list[float] = []
    started = time.process_time()
    for turn in range(1, turns + 1):
        board.takes = _CONTACT_OCTETS if turn % _CONTACT_TURNS == 0 else 0
        sent = payload.step(image, attitude, _START_TICKS + turn * minutes * _MINUTE_TICKS, b"")
        packets += len(sent)
        octets += sum(map(len, sent))
        if turn % (30 * _MINUTES_A_DAY // minutes) == 0:
            months.append(round(_resident_mib(), 2))
    seconds = time.process_time() - started
    return {
        "idle_resident_mib": round(idle_mib, 1),
        "days": days,
        "turns": turns,
        "packets": packets,
        "octets": octets,
        "resident_mib_by_month": months,
        "growth_mib": round(months[-1] - months[0], 2) if months else 0.0,
        "waiting": payload.waiting,
        "cpu_s": round(seconds, 1),
        "turns_per_cpu_s": round(turns / seconds),
    }


def rows() -> Iterator[Row]:
    """Yield memory and speed of the flight software over 90 days; growth of a month is an error."""
    figures = bench(90.0)
    first, last = figures["resident_mib_by_month"][0], figures["resident_mib_by_month"][-1]
    wrong = "" if last - first < 1.0 else "memory grows by more than 1 MiB in two months"
    yield Row("resident memory after three months", last, "MiB", "after one month", first, wrong)
    yield Row("housekeeping", figures["turns_per_cpu_s"], "turns/s")


def _resident_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


if __name__ == "__main__":
    print(json.dumps(bench(float(sys.argv[1]) if len(sys.argv) > 1 else 365.0), indent=1))
