"""Mutation testing of decision code: `python -m benchmarks.mutation [--group NAME] [--sample N] [--seed S]`.

mutmut changes one expression at a time in a copy of the tree and runs the tests that reach it. Each group names its
modules and the tests that must protect them. A seeded sample of the mutants of every group estimates its score; the
interval is Wilson's at 95 %. Survivors are printed as differences, so that each can be judged.

Two kinds of mutant are left out because no test should detect them: the element type of an array that NumPy would
choose anyway, and the wording of a message (a text with blanks).
"""

import argparse
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SOURCES = (
    "tmtc",
    "lunar",
    "kernels",
    "reports",
    "ground_service",
    "payload_emulator",
    "studies",
    "linna",
    "db",
    "scenarios",
    "benchmarks",
)
UNTESTED = "not checked"
LIMIT = 0.85
"""Lowest score accepted."""

_SHOW = """
import json, sys
from mutmut.mutation.diff_apply import get_diff_for_mutant
print(json.dumps({name: get_diff_for_mutant(name) for name in sys.argv[1:]}))
"""
_PLUGIN = "benchmarks.mutation_plugin"
KILLED = frozenset({"killed", "timeout", "suspicious", "segfault"})


@dataclass(frozen=True, slots=True)
class Group:
    """Modules of one responsibility and the tests that protect them (paths from the root of the tree)."""

    modules: tuple[str, ...]
    tests: tuple[str, ...]


_TABLE = """\
accounting|ground_service/ingest/core ground_service/passes/downlink_accounting tmtc/packets/sequence\
|ground_service/ingest/test_sequence ground_service/passes/test_downlink_accounting tmtc/test_sequence
verdicts|ground_service/evaluation/verdict ground_service/evaluation/alignment ground_service/evaluation/recall\
|ground_service/evaluation/test_verdict ground_service/evaluation/test_pass_data \
ground_service/evaluation/test_pass_extras
evaluation|ground_service/evaluation/core ground_service/evaluation/alignment ground_service/evaluation/recall \
ground_service/evaluation/smoother ground_service/evaluation/fixes\
|ground_service/evaluation/test_pass_evaluation ground_service/evaluation/test_alignment \
ground_service/evaluation/test_recall ground_service/evaluation/test_baseline ground_service/evaluation/test_fixes \
ground_service/evaluation/test_pass_data ground_service/evaluation/test_pass_extras \
ground_service/evaluation/test_smoother \
ground_service/evaluation/test_golden_reports
smoother|ground_service/evaluation/smoother\
|ground_service/evaluation/test_smoother ground_service/exports/test_exports
gates|ground_service/regression/gates/core ground_service/regression/gates/statistics\
|ground_service/regression/test_regression_gates
filter|payload_emulator/flight/navigation/filter/filter payload_emulator/flight/navigation/filter/map_offset \
payload_emulator/flight/navigation/filter/attitude_monitor payload_emulator/flight/navigation/filter/dynamics \
payload_emulator/flight/navigation/anchored/anchored payload_emulator/flight/navigation/anchored/correction \
payload_emulator/flight/navigation/anchored/recovery \
payload_emulator/flight/onboard/observer payload_emulator/flight/navigation/search/acquisition\
|payload_emulator/flight/test_navigation_filter payload_emulator/flight/test_anchored \
payload_emulator/flight/test_anchored_navigator payload_emulator/flight/test_observer \
payload_emulator/flight/test_acquisition payload_emulator/flight/test_landmark_map \
payload_emulator/flight/test_attitude_monitor payload_emulator/flight/test_dynamics
authorisation|ground_service/access/service ground_service/access/security|ground_service/access
commanding|ground_service/contacts/commanding/service ground_service/contacts/commanding/core \
payload_emulator/flight/onboard/commanding\
|ground_service/contacts/commanding/test_commanding payload_emulator/flight/test_commanding
flight|payload_emulator/flight|payload_emulator/flight"""
"""Groups: name, modules, and tests below `tests`; a folder stands for all that it contains."""


def _files(name: str) -> list[str]:
    """Return a module, or those of a folder that run mutated: mutmut renames functions, and numba compiles by name."""
    if not (ROOT / name).is_dir():
        return [f"{name}.py"]
    found = sorted((ROOT / name).rglob("*.py"))
    return [str(file.relative_to(ROOT)) for file in found if "njit" not in file.read_text(encoding="utf-8")]


GROUPS = {
    name: Group(
        tuple(file for one in modules.split() for file in _files(one)),
        tuple(one if (ROOT / one).is_dir() else f"{one}.py" for one in (f"tests/{test}" for test in tests.split())),
    )
    for name, modules, tests in (line.split("|") for line in _TABLE.splitlines())
}

_ELEMENT_TYPE = re.compile(r",? ?dtype=[\w.]+|\.astype\([\w.]+\)")
_TEXT = re.compile(r"f?\"[^\"]*\"|f?'[^']*'")


def _without_messages(code: str) -> str:
    return _TEXT.sub(lambda text: "" if " " in text.group() else text.group(), code)


_LEFT_OUT: tuple[tuple[Callable[[str], str], str], ...] = (
    (lambda code: _ELEMENT_TYPE.sub("", code), "element type that NumPy chooses anyway"),
    (_without_messages, "wording of a message (a text with blanks)"),
)
"""Pattern removed from the code before and after a mutation; equal results are not tested."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the requested groups and print one line for each; return 1 if a score is below the limit."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mutation", description=__doc__.splitlines()[0])
    parser.add_argument("--group", action="append", choices=sorted(GROUPS), help="group to run; default: all")
    parser.add_argument("--sample", type=int, default=60, help="mutants of a group; 0: every one (default 60)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the sample (default 1)")
    parser.add_argument("--json", type=Path, help="file for the figures and the survivors")
    options = parser.parse_args(arguments)
    results = {}
    for name in options.group or GROUPS:
        results[name] = run_group(name, options.sample, options.seed)
        print(line_of(name, results[name]), flush=True)
        for survivor in results[name]["survivors"]:
            print(f"  survived: {survivor['name']}\n{survivor['difference']}", file=sys.stderr)
        if options.json is not None:
            options.json.write_text(json.dumps(results, indent=1) + "\n")
    return int(any(result["score"] < LIMIT for result in results.values()))


def run_group(name: str, sample: int, seed: int) -> dict[str, object]:
    """Return the mutants, the killed ones, the score with its interval and the survivors of a group."""
    group = GROUPS[name]
    with tempfile.TemporaryDirectory(prefix="linna-mutation-") as folder:
        tree = Path(folder)
        _copy_tree(tree, group)
        generated = _mutmut(tree, "run", "--max-children", "1", "no such mutant")
        known = sorted(_states(tree))
        if not known:
            raise SystemExit(f"mutation: group {name}: no mutants were made:\n{generated[-2000:]}")
        random.Random(seed).shuffle(known)
        wanted = sample or len(known)
        differences: dict[str, str] = {}
        chosen: list[str] = []
        for first in range(0, len(known), wanted):
            differences |= _differences(tree, known[first : first + wanted])
            chosen = [mutant for mutant in differences if reason_left_out(differences[mutant]) is None]
            if len(chosen) >= wanted:
                break
        chosen = chosen[:wanted]
        said = _mutmut(tree, "run", "--max-children", "1", *chosen)
        found = _states(tree)
        states = {mutant: found.get(mutant, UNTESTED) for mutant in chosen}
        if UNTESTED in states.values():
            raise SystemExit(f"mutation: group {name}: mutants were not tested:\n{said[-2000:]}")
        survivors = [
            {"name": mutant, "state": state, "difference": differences[mutant]}
            for mutant, state in sorted(states.items())
            if state not in KILLED
        ]
    from scipy.stats import binomtest

    killed = len(chosen) - len(survivors)
    low, high = binomtest(killed, len(chosen)).proportion_ci(method="wilson")
    return {
        "mutants": len(known),
        "tested": len(chosen),
        "killed": killed,
        "score": killed / len(chosen),
        "interval": [low, high],
        "states": dict(Counter(states.values())),
        "survivors": survivors,
    }


def line_of(name: str, result: dict[str, Any]) -> str:
    """Return the figures of a group as one line."""
    low, high = result["interval"]
    return (
        f"{name}: {result['killed']} of {result['tested']} mutants killed "
        f"(score {result['score']:.2f}, 95 % interval {low:.2f} to {high:.2f}; {result['mutants']} mutants in all)"
    )


def _copy_tree(tree: Path, group: Group) -> None:
    """Copy the tracked files and write mutmut's settings for a group."""
    files = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split("\0")
    for file in filter(None, files):
        if (ROOT / file).is_file():
            target = tree / file
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / file, target)
    settings = {
        "source_paths": [source for source in SOURCES if (tree / source).is_dir()],
        "only_mutate": list(group.modules),
        "pytest_add_cli_args_test_selection": list(group.tests),
        "pytest_add_cli_args": ["-p", "no:cacheprovider", "-p", "no:randomly", "-p", _PLUGIN],
        "also_copy": ["docs", "requirements", "docker-compose.yml", "Dockerfile", "Makefile", "README.md"],
    }
    lines = ["", "[tool.mutmut]", *(f"{key} = {json.dumps(value)}" for key, value in settings.items())]
    with (tree / "pyproject.toml").open("a") as project:
        project.write("\n".join(lines) + "\n")


def _differences(tree: Path, mutants: Sequence[str]) -> dict[str, str]:
    """Return the changed lines of mutants by their names, without the headers of the differences."""
    shown = _python(tree, "-c", _SHOW, *mutants)
    try:
        found: dict[str, str] = json.loads(shown)
    except ValueError:
        raise SystemExit(f"mutation: mutants cannot be shown:\n{shown[-2000:]}") from None
    return {
        mutant: "\n".join(line for line in lines.splitlines() if re.match(r"[-+](?![-+]{2})", line))
        for mutant, lines in found.items()
    }


def reason_left_out(difference: str) -> str | None:
    """Return why a mutant is not tested; None if it is."""
    before = [line[1:] for line in difference.splitlines() if line.startswith("-")]
    after = [line[1:] for line in difference.splitlines() if line.startswith("+")]
    for without, reason in _LEFT_OUT:
        reduced = [re.sub(r"[\s,]", "", without(" ".join(lines))) for lines in (before, after)]
        if reduced[0] == reduced[1]:
            return reason
    return None


def _states(tree: Path) -> dict[str, str]:
    """Return the state of every mutant of the copy by its name."""
    listing = _mutmut(tree, "results", "--all", "true")
    return {name: state.strip() for name, state in re.findall(r"^\s*(\S+__mutmut_\d+): (.+)$", listing, re.M)}


def _mutmut(tree: Path, *arguments: str) -> str:
    """Return what mutmut prints, run in a copy of the tree."""
    return _python(tree, "-m", "mutmut", *arguments)


def _python(tree: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=tree,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": "", "COLUMNS": "200"},
    )
    return done.stdout + done.stderr


if __name__ == "__main__":
    raise SystemExit(main())
