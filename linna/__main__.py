"""`python -m linna`, and the console script."""

import sys

from linna.cli import run


def main() -> None:
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
