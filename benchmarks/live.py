"""Frames a second of the live view: python -m benchmarks.live [SCENARIO] [--skip N].

`linna serve`, `linna emulate SCENARIO --live` as quick as it goes and the live page in Chromium run on this machine
together. Once the first frames are through, the frames that the page has drawn are counted until the scenario ends,
by the clock and with the processor time of each of the three, which a busy machine does not stretch.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.pages import open_chromium, served
from studies.harness.parts import Part, free_port, listens

_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
_START_S = 180.0
_POLL_MS = 100
_SHOWN = "() => Number(document.getElementById('frame').dataset.shown ?? 0)"


@contextmanager
def flown(scenario: str, log: Path) -> Iterator[int]:
    """A payload flown live and paused; the port of its console."""
    ports = [free_port() for _ in range(4)]
    names = ("--port", "--tc-port", "--console-port", "--mission-port")
    words = ["--live", "--rate", "0", "--paused", "--stop-at-end"]
    words += [word for name, port in zip(names, ports, strict=True) for word in (name, str(port))]
    command = [sys.executable, "-m", "linna", "emulate", scenario, *words]
    with Part(command, log, lambda: listens(ports[2]), 1):
        yield ports[2]


def bench(scenario: str, skip: int) -> dict[str, Any]:
    """Frames drawn a second after the first `skip`, and processor time a frame of payload, service and browser."""
    folder = Path(tempfile.mkdtemp(prefix="linna-live-"))
    try:
        with flown(scenario, folder / "payload.log") as port:
            os.environ["LINNA_LIVE_CONSOLE"] = f"127.0.0.1:{port}"
            with served(folder) as url, open_chromium() as chromium:
                return _measured(chromium, url, skip)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _measured(chromium: Any, url: str, skip: int) -> dict[str, Any]:
    page = chromium.new_context(viewport={"width": 1280, "height": 900}).new_page()
    page.goto(f"{url}/live")
    page.wait_for_function("() => document.getElementById('state').textContent === 'connected'")
    page.click("#run")
    page.wait_for_function(f"() => ({_SHOWN})() >= {skip}", timeout=1e3 * _START_S)
    first, before, began = page.evaluate(_SHOWN), _processor_s(), time.perf_counter()
    last, after, stopped = first, before, began
    while "ended" not in (page.text_content("#state") or "") and time.perf_counter() - began < _START_S:
        page.wait_for_timeout(_POLL_MS)
        now = page.evaluate(_SHOWN)
        if now > last:
            last, after, stopped = now, _processor_s(), time.perf_counter()
    frames = max(last - first, 1)
    return {
        "frames": last - first,
        "frames_per_s": round(frames / max(stopped - began, 1e-3), 2),
        "processor_ms_per_frame": {
            name: round(1e3 * (after[name] - before[name]) / frames, 1) for name in after
        },
    }


def _processor_s() -> dict[str, float]:
    """Processor time so far of the payload, the service and the browser among this program's descendants."""
    parents, spent = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            command = (folder / "cmdline").read_bytes().split(b"\0")
        except OSError:  # it has ended
            continue
        number = int(folder.name)
        parents[number] = int(fields[1])
        spent[number] = (command, _TICK_S * (int(fields[11]) + int(fields[12])))
    totals = {"payload": 0.0, "service": 0.0, "browser": 0.0}
    for number, (command, seconds) in spent.items():
        above = number
        while above in parents and above != os.getpid():
            above = parents[above]
        if above == os.getpid() and number != above:
            name = "payload" if b"emulate" in command else "service" if b"serve" in command else "browser"
            totals[name] += seconds
    return totals


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", nargs="?", default="selenita")
    parser.add_argument("--skip", type=int, default=20, help="frames before the count begins")
    arguments = parser.parse_args()
    print(json.dumps(bench(arguments.scenario, arguments.skip), indent=2))


if __name__ == "__main__":
    main()
