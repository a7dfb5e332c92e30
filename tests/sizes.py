"""Sizes of the packages: lines and code tokens, and the table that limits them.

`python tests/sizes.py` prints the sizes, and what the uncommitted change adds; `--write` lowers the table to them.
"""

import ast
import csv
import io
import re
import subprocess
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "tests/sizes.csv"
PACKAGES = (
    "ground_service", "payload_emulator", "tmtc", "lunar", "kernels", "reports", "linna", "studies",
    "benchmarks", "db", "deploy", "tests",
)  # fmt: skip
_STRING = "|".join(rf"{q}(?:[^\\]|\\.)*?{q}" for q in ('"""', "'''", '"', "'"))
TOKEN = re.compile(
    rf"#[^\n]*|(?:\b[rRbBfFuU]{{1,2}})?(?:{_STRING})|{tokenize.Number}|{tokenize.Name}|{tokenize.Special}", re.DOTALL
)
"""A comment or a code token, as `tokenize` cuts them; layout is passed over."""
Sizes = dict[str, tuple[int, int]]


def size_of(source):
    """Return lines and code tokens of a module; comments, docstrings and layout are no tokens."""
    tokens = sum(not found.group().startswith("#") for found in TOKEN.finditer(source))
    return len(source.splitlines()), tokens - _docstrings(ast.parse(source))


def _docstrings(node):
    """Return the number of docstrings of a module, class, function or other statement and of all that it contains."""
    count = 0
    if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
        count += ast.get_docstring(node, clean=False) is not None
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):
        statements = getattr(node, part, ())
        count += sum(map(_docstrings, statements)) if isinstance(statements, list) else 0
    return count


def sizes_of(root):
    """Return lines and code tokens of each package of a checkout."""
    found = {}
    for package in PACKAGES:
        sizes = [
            size_of(file.read_text(encoding="utf-8"))
            for file in sorted((root / package).rglob("*.py"))
            if not {"node_modules", "__pycache__"} & set(file.parts)
        ]
        found[package] = (sum(lines for lines, _ in sizes), sum(tokens for _, tokens in sizes))
    return found


def load_table(text):
    """Return the limits by package from a table with the columns package, lines and tokens."""
    return {row["package"]: (int(row["lines"]), int(row["tokens"])) for row in csv.DictReader(io.StringIO(text))}


def above(sizes, limits):
    """Return a line for each package that is larger than its limit, or has none."""
    excess = []
    for package, measured in sizes.items():
        for unit, size, limit in zip(("lines", "tokens"), measured, limits.get(package, (0, 0)), strict=True):
            if size > limit:
                excess.append(
                    f"{package}: {size} {unit}, limit {limit}: "
                    f"remove {size - limit} there, or lower another entry by more"
                )
    return excess


def unpaid(before, after):
    """Return why a change of the table is refused: entries it raises need others that fall by more."""
    refused = []
    for place, unit in enumerate(("lines", "tokens")):
        change = {package: after[package][place] - before.get(package, (0, 0))[place] for package in after}
        raised = sum(step for step in change.values() if step > 0)
        lowered = -sum(step for step in change.values() if step < 0)
        gone = sum(before[package][place] for package in before if package not in after)
        if raised and lowered + gone <= raised:
            refused.append(
                f"limits of {unit} rise by {raised} and fall by {lowered + gone}: a rise needs a larger fall"
            )
    return refused


def committed_table(revision):
    """Return the table of a revision; None where it had none or there is no repository."""
    command = ["git", "-C", str(ROOT), "show", f"{revision}:tests/sizes.csv"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    return load_table(result.stdout) if result.returncode == 0 else None


def main(arguments):
    """Print the sizes with their limits; with `--write`, store them as the limits."""
    sizes = sizes_of(ROOT)
    limits = load_table(TABLE.read_text(encoding="utf-8")) if TABLE.exists() else {}
    for package, (lines, tokens) in sizes.items():
        limit = limits.get(package, (0, 0))
        print(f"{package:18} {lines:7} lines ({lines - limit[0]:+}) {tokens:8} tokens ({tokens - limit[1]:+})")
    if "--write" in arguments:
        rows = "".join(f"{package},{lines},{tokens}\n" for package, (lines, tokens) in sizes.items())
        TABLE.write_text("package,lines,tokens\n" + rows, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
