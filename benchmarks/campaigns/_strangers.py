"""Record of an hour of a new user: what the documents state and what happened."""

import json
import re
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

DOCS = Path(__file__).resolve().parents[2] / "docs"
MARK = re.compile(
    r"^ *<!-- (?P<kind>file|run|tour|output)(?:: (?P<name>[\w.-]+))?(?:, status (?P<status>[\d,]+))?[^\n]*-->\n"
    r" *```\w+\n(?P<text>.*?)^ *```$",
    re.MULTILINE | re.DOTALL,
)
"""A file or commands of a page that are to be used as printed."""

Kind = Literal["A", "B", "C"]


@dataclass(slots=True)
class Diary:
    """Steps of an hour, and the wrong turns: A harms operations, B misleads, C costs minutes."""

    name: str
    started: float = field(default_factory=time.monotonic)
    turns: list[tuple[Kind, str]] = field(default_factory=list)
    steps: int = 0

    def expect(self, kind: Kind, step: str, held: bool, found: object = "") -> bool:
        """Record a step, and a wrong turn if what the documents state did not happen."""
        self.steps += 1
        word = "ok" if held else f"wrong turn ({kind})"
        print(
            f"[{self.name} {time.monotonic() - self.started:5.0f} s] {word}: {step}",
            file=sys.stderr,
            flush=True,
        )
        if not held:
            print(f"    found: {str(found)[:600]}", file=sys.stderr, flush=True)
            self.turns.append((kind, f"{step}; found {str(found)[:300]}"))
        return held

    def close(self) -> int:
        """Print the result; 1 if there was a wrong turn of the classes A or B."""
        print(
            json.dumps(
                {
                    "hour": self.name,
                    "seconds": round(time.monotonic() - self.started),
                    "steps": self.steps,
                    "wrong_turns": {
                        kind: [text for one, text in self.turns if one == kind] for kind in "ABC"
                    },
                }
            )
        )
        return int(any(kind in "AB" for kind, _ in self.turns))


def commands_of(page: str, folder: Path) -> Iterator[str]:
    """Write the files that a page prints into a folder; yield its commands."""
    for mark in MARK.finditer((DOCS / page).read_text()):
        if mark["kind"] == "file":
            (folder / mark["name"]).write_text(mark["text"])
        elif mark["kind"] in ("run", "tour"):
            allowed = f' || [[ ",{mark["status"]}," == *",$?,"* ]]' if mark["status"] else ""
            yield from (line.strip() + allowed for line in mark["text"].splitlines())
