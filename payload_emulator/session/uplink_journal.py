"""Journal of the transmissions that emulated stations have confirmed: one JSON object a line.

With an exact state, it makes the inputs of a session complete: a session that was killed repeats them at their times.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

from payload_emulator.errors import RecordError


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """A transmission: simulated time at which a station took it, name of the station, number, octets."""

    utc_ns: int
    station: str
    number: int
    octets: bytes


def add_to_journal(path: Path, entry: JournalEntry) -> None:
    """Append an entry; it survives the end of the process."""
    line = json.dumps([entry.utc_ns, entry.station, entry.number, entry.octets.hex()])
    with path.open("ab", buffering=0) as file:
        file.write(line.encode() + b"\n")


def load_journal(path: Path) -> list[JournalEntry]:
    """Return the entries, and remove an incomplete last line, which was not confirmed.

    Raises
    ------
    RecordError
        A line is no entry.
    """
    try:
        octets = path.read_bytes()
    except FileNotFoundError:
        return []
    whole = octets.rfind(b"\n") + 1
    if whole < len(octets):
        os.truncate(path, whole)
    entries = []
    for number, line in enumerate(octets[:whole].splitlines(), start=1):
        try:
            utc_ns, station, key, text = json.loads(line)
            entries.append(JournalEntry(int(utc_ns), str(station), int(key), bytes.fromhex(text)))
        except (ValueError, TypeError):
            raise RecordError(
                f"{path}, line {number}: expected time, station, number and octets of a transmission, "
                f"found {line[:40]!r}"
            ) from None
    return entries
