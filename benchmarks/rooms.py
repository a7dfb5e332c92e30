"""`python -m benchmarks rooms [--against COMMIT]`: size and import graph of each package.

A room is a module or package directly in a package, as in the import contracts; an arrow leads from a room to another
that it imports; floors are the rooms on the longest path of arrows. Files and lines are those of Python, imports the
share of lines in import statements. Exit status 2: the commit is unknown.
"""

import argparse
import ast
import sys
from collections.abc import Iterator, Mapping
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

from benchmarks._rows import ROOT, NotMeasured, checkout

PACKAGES = (
    "payload_emulator.session", "payload_emulator.flight.navigation", "tmtc", "ground_service",
    "payload_emulator", "studies", "linna", "lunar", "reports", "kernels",
)  # fmt: skip


class Rooms(NamedTuple):
    """Size and import graph of a package; `imports` is a share of its lines."""

    rooms: int
    floors: int
    arrows: int
    files: int
    lines: int
    imports: float


def measure(package: str, modules: Mapping[str, str]) -> Rooms:
    """Measure a package from the texts of modules by name; imports in a circle raise `graphlib.CycleError`."""
    own = {name: text for name, text in modules.items() if f"{name}.".startswith(f"{package}.")}
    graph: dict[str, set[str]] = {_room(package, name): set() for name in own}
    imports = 0
    for name, text in own.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Import | ast.ImportFrom):
                imports += (node.end_lineno or node.lineno) - node.lineno + 1
                graph[_room(package, name)] |= {_room(package, one) for one in _targets(node, modules)}
    rooms = {room: targets - {room, ""} for room, targets in graph.items() if room}
    height: dict[str, int] = {}
    for room in TopologicalSorter(rooms).static_order():
        height[room] = 1 + max((height[to] for to in rooms[room]), default=0)
    lines = sum(text.count("\n") for text in own.values())
    arrows = sum(map(len, rooms.values()))
    return Rooms(len(rooms), max(height.values(), default=0), arrows, len(own), lines, imports / max(lines, 1))


def _room(package: str, module: str) -> str:
    """Return the room of a module; no text outside of the package and for its `__init__`."""
    return module[len(package) + 1 :].partition(".")[0] if module.startswith(f"{package}.") else ""


def _targets(node: ast.Import | ast.ImportFrom, modules: Mapping[str, str]) -> Iterator[str]:
    """Yield the modules that a statement imports."""
    for alias in node.names:
        inner = f"{node.module}.{alias.name}" if isinstance(node, ast.ImportFrom) else alias.name
        yield inner if inner in modules or isinstance(node, ast.Import) else str(node.module)


def load_modules(root: Path) -> dict[str, str]:
    """Return the texts of all Python modules of a checkout by name."""
    paths = (path for top in {name.partition(".")[0] for name in PACKAGES} for path in (root / top).rglob("*.py"))
    texts = {str(path.relative_to(root)): path.read_text(encoding="utf-8") for path in paths}
    return {name[:-3].replace("/", ".").removesuffix(".__init__"): text for name, text in texts.items()}


def main(words: list[str]) -> int:
    """Print the table of the working tree, and that of a commit to compare with."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks rooms")
    parser.add_argument("--against", metavar="COMMIT")
    against = parser.parse_args(words).against
    try:
        trees = {"": load_modules(ROOT)}
        if against:
            with checkout(against) as before:
                trees = {against: load_modules(before), **trees}
        print(f"{'package':<46}" + "".join(f"{name:>8}" for name in Rooms._fields))
        for package in PACKAGES:
            for name, modules in trees.items():
                *counts, imports = measure(package, modules)
                label = f"{package} ({name})" if name else package
                print(f"{label:<46}{''.join(f'{n:>8}' for n in counts)}{imports:>8.1%}")
    except NotMeasured as error:
        print(f"--against: {error}", file=sys.stderr)
        return 2
    return 0
