"""`python -m linna`, and the console script."""

import gc
import sys

from linna.cli import run


def main() -> None:
    gc.set_threshold(50_000)  # a short command is not interrupted by collections while it imports
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
