"""`python -m linna`, and the console script."""

import gc
import sys

from linna.cli import run


def main() -> None:
    gc.set_threshold(50_000)  # a short command is not interrupted by collections while it imports
    status = run(sys.argv[1:])
    gc.freeze()  # the last collection at exit would look at every object of every module
    sys.exit(status)


if __name__ == "__main__":
    main()
