"""Record of an hour of a new user: what the documents state and what happened."""

import contextlib
import json
import os
import re
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from studies.harness.parts import bare_environment, descendants

ROOT = Path(__file__).resolve().parents[2]
MARK = re.compile(
    r"^ *<!-- (?P<kind>file|run|tour)(?:: (?P<name>[\w.-]+))?(?:, status (?P<status>[\d,]+))?[^\n]*-->\n"
    r" *```\w+\n(?P<text>.*?)^ *```$",
    re.MULTILINE | re.DOTALL,
)
"""A file or commands of a page that are used as printed."""


@dataclass(slots=True)
class Diary:
    """Steps of an hour, and the wrong turns by kind: A harms operations, B misleads, C costs minutes."""

    name: str
    started: float = field(default_factory=time.monotonic)
    turns: list[str] = field(default_factory=list)
    steps: int = 0

    def expect(self, kind: str, step: str, held: bool, found: object = "") -> bool:
        """Record a step, and a wrong turn if what the documents state did not happen."""
        self.steps += 1
        text = "ok" if held else f"WRONG TURN {kind}, found {str(found)[-600:]}"
        print(f"[{time.monotonic() - self.started:5.0f} s] {step}: {text}", file=sys.stderr, flush=True)
        if not held:
            self.turns.append(f"{kind}: {step}; found {str(found)[-300:]}")
        return held

    def close(self) -> int:
        """Print the result; 1 if there was a wrong turn of the classes A or B."""
        wall = round(time.monotonic() - self.started)
        spent = {"wall_s": wall, "processor_s": round(processor_s()), "load": round(os.getloadavg()[1], 1)}
        print(json.dumps({"hour": self.name, **spent, "steps": self.steps, "wrong_turns": self.turns}))
        return int(any(one[0] in "AB" for one in self.turns))


def processor_s() -> float:
    """Return the processor time of this process and of its descendants, those that have ended included, s."""
    spent = 0
    for pid in (os.getpid(), *descendants(os.getpid())):
        with contextlib.suppress(OSError):
            spent += sum(map(int, Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:15]))
    return spent / os.sysconf("SC_CLK_TCK")


def is_loaded() -> bool:
    """Return whether other programs need the processors too, so that minutes do not count."""
    return os.getloadavg()[1] > (os.cpu_count() or 1) + 1


def commands_of(page: str, folder: Path) -> Iterator[str]:
    """Write the files that a page prints into a folder; yield its commands."""
    for mark in MARK.finditer((ROOT / "docs" / page).read_text()):
        if mark["kind"] == "file":
            (folder / mark["name"]).write_text(mark["text"])
            continue
        allowed = f' || [[ ",{mark["status"]}," == *",$?,"* ]]' if mark["status"] else ""
        yield from (line.strip() + allowed for line in mark["text"].splitlines())


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of a new user without data, with `linna` in the path."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    made = bare_environment(PATH=path, PYTHONPATH=str(ROOT), XDG_DATA_HOME=str(folder / "data"))
    return {name: value for name, value in made.items() if name != "LINNA_DATA"}
