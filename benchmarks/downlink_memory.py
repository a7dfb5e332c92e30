"""Memory of the ingest over large files of any content: python -m benchmarks.downlink_memory [--octets N].

Zeros, noise, markers only and CADUs are planned and read as the ingest does, without a database. The peak of the
anonymous memory is measured; pages of the mapped file can be dropped at any time.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks._rows import Row
from benchmarks.downlink import cadus
from ground_service.ingest.frames import FrameReader, Section
from ground_service.ingest.quality import NO_RECORD, Found
from ground_service.ingest.reception import WINDOW_OCTETS
from ground_service.store.files import mapped_octets
from tmtc.downlink import plan_of
from tmtc.errors import TmtcError

PART = 16 << 20


def contents() -> Iterator[tuple[str, bytes | None]]:
    """Yield names and repeated parts; None: a sparse file."""
    yield "zeros", None
    yield "noise", np.random.default_rng(1).bytes(PART)
    yield "markers only", bytes.fromhex("1ACFFC1D") * (PART // 4)
    yield "CADUs", cadus(2000).tobytes()


def read(path: Path) -> int:
    """Plan and read a file; return the number of packets."""
    octets = mapped_octets(path)
    try:
        plan = plan_of(octets)
    except TmtcError:
        return 0
    packets = 0
    for one in plan.sections:
        section = Section(one.settings, one.start, one.stop, one.start, one.stop)
        reader = FrameReader(section, one.settings, Found(), spacecraft_id=76, record=NO_RECORD)
        starts = range(one.start, one.stop, WINDOW_OCTETS)
        windows = ((octets[at : min(at + WINDOW_OCTETS, one.stop)], at == starts[-1]) for at in starts)
        for _ in reader.batches(windows):
            reader.take_fragments()
        packets += reader.found.packets
    return packets


def anonymous_mib() -> float:
    """Return the anonymous memory of this process in MiB."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1024


def measure(octets: int) -> list[dict[str, float | int | str]]:
    """Return the peak of the memory and the rate for each content."""
    rows: list[dict[str, float | int | str]] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "large.bin")
        path.write_bytes(cadus(60).tobytes())
        read(path)  # compiles
        for name, part in contents():
            with path.open("wb") as stream:
                if part is None:
                    stream.truncate(octets)
                else:
                    for _ in range(octets // len(part)):
                        stream.write(part)
            before, peak, done = anonymous_mib(), 0.0, threading.Event()

            def watch(done: threading.Event = done) -> None:
                nonlocal peak
                while not done.wait(0.02):
                    peak = max(peak, anonymous_mib())

            watcher = threading.Thread(target=watch)
            watcher.start()
            started = time.perf_counter()
            packets = read(path)
            seconds = time.perf_counter() - started
            done.set()
            watcher.join()
            rows.append(
                {
                    "content": name,
                    "octets": path.stat().st_size,
                    "packets": packets,
                    "peak_mib": round(peak - before, 1),
                    "mb_per_s": round(path.stat().st_size / 1e6 / seconds, 1),
                }
            )
    return rows


def rows() -> Iterator[Row]:
    """Yield peak and rate of each content at two sizes; a peak that grows with the file is an error."""
    small, large = (measure(size) for size in (32 << 20, 128 << 20))
    for before, one in zip(small, large, strict=True):
        low, high = float(before["peak_mib"]), float(one["peak_mib"])
        wrong = "" if high < low + 64 else "the peak grows with the file"
        yield Row(f"{one['content']}, 128 MiB: anonymous memory", high, "MiB", "a file of 32 MiB", low, wrong)
        yield Row(f"{one['content']}, 128 MiB", float(one["mb_per_s"]), "MB/s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.downlink_memory", description=__doc__)
    parser.add_argument("--octets", type=int, default=64 << 20)
    print(json.dumps(measure(parser.parse_args().octets), indent=1))
