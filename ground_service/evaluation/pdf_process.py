"""A second process that sets a long report as PDF while the first writes its page and its JSON.

Both draw every figure again, and drawing keeps to one core: of a day's report each of the two takes about as long as
the other. The process is started before the pass is evaluated, so that it is ready when there is something to print.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
from types import TracebackType
from typing import Any

WORTHWHILE_FRAMES = 1_000
"""A shorter pass is printed sooner than a second process has come up."""


class Press:
    """Sets one report in a process of its own; use it in a with statement."""

    def __init__(self) -> None:
        # The process finds its packages where this one does, and nothing in the folder that this one was started in.
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "ground_service.evaluation.pdf_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
        )

    def __enter__(self) -> Press:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()

    def begin(self, report: Any) -> None:
        """Hand over the report; the process sets it while this one goes on."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # `finish` finds nothing printed
            self._process.stdin.write(pickle.dumps(report, pickle.HIGHEST_PROTOCOL))
            self._process.stdin.close()

    def finish(self) -> bytes | None:
        """The octets of the PDF; None where the process failed, whatever the cause."""
        assert self._process.stdout is not None
        octets = self._process.stdout.read()
        return octets if self._process.wait() == 0 and octets else None


def worthwhile(frames: int) -> bool:
    """Whether a second process helps with a pass of so many frames on this machine."""
    return frames >= WORTHWHILE_FRAMES and len(os.sched_getaffinity(0)) > 1


def main() -> None:
    """Print the report that comes on the standard input onto the standard output."""
    # Everything that printing needs, before there is something to print.
    import matplotlib.backends.backend_pdf
    import matplotlib.figure  # noqa: F401

    import reports.pass_report
    import reports.pdf_pages  # noqa: F401
    from reports.render import render_pdf

    report = pickle.loads(sys.stdin.buffer.read())
    sys.stdout.buffer.write(render_pdf(report))


if __name__ == "__main__":
    main()
