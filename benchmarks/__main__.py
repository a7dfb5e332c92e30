"""`python -m benchmarks [NAME …] [--json] [--before COMMIT]`: benchmarks, each compared with its peers.

Exit status 1: a benchmark did not finish, or a row contradicts the expectation. What takes longer than minutes
(campaigns) has a command of its own and is not in this list. `python -m benchmarks rooms` prints the size
and the import graph of each package.
"""

import argparse
import sys

from benchmarks import rooms
from benchmarks._rows import NotMeasured, checkout, measure, report

NAMES = (
    "tmtc", "downlink", "ground", "orbit", "render", "pages", "yamcs",
)  # fmt: skip
"""Benchmarks of `make bench`, in this order."""


def main(words: list[str]) -> int:
    """Run the benchmarks that are named, all when none is."""
    if words[:1] == ["rooms"]:
        return rooms.main(words[1:])
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--before", metavar="COMMIT", help="add the ratio to this commit, run in turn")
    parser.add_argument("--rows-of", choices=NAMES, help=argparse.SUPPRESS)
    given = parser.parse_args(words)
    if given.rows_of:
        measure(given.rows_of)
        return 0
    if unknown := [name for name in given.names if name not in NAMES]:
        print(f"benchmarks: expected {', '.join(NAMES)}; found {', '.join(unknown)}", file=sys.stderr)
        return 2
    if not given.before:
        return report(given.names or NAMES, as_json=given.json)
    try:
        with checkout(given.before) as before:
            return report(given.names or NAMES, as_json=given.json, before=before)
    except NotMeasured as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
