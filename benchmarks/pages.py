"""First paint and time to interactive of every page: python -m benchmarks pages.

A service with passes of one spacecraft and rows of housekeeping is seeded and served, and every page is
opened in Chromium with an empty cache, three times. A page is interactive when it has handled the last answer it asked
for and its main thread is idle; the middle of the three is printed, with the processor time that the page's main thread
took, which a busy machine does not stretch.
"""

import statistics
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._rows import Row, needs
from ground_service.ground import open_ground
from ground_service.passes.service import define_pass
from ground_service.store.vehicles import vehicle_id
from ground_service.telemetry.rollups import HOUSEKEEPING_VALUES, add_to_rollups
from ground_service.web.pages import PAGES
from lunar.timescales import parse_utc, ticks_from_utc_ns
from studies.harness.parts import Part, answers_http, free_port
from tmtc.dictionary.payload import DICTIONARY

SPACECRAFT = 76
START = parse_utc("2029-08-07T00:00:00Z")
TICKS_A_SECOND = 65_536
PASS_S = 7_200
PASSES, ROWS = 200, 200_000
_CHUNK = 500_000
_TIMES = 3
_QUIET_MS = 400
_LIMIT_MS = 60_000
_CHROMIUM = "/usr/bin/chromium"
_FLAGS = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update")

# Notes when nothing that was asked for is missing any more and the main thread has come to rest.
_WATCH = """
(() => {
  const asked = window.fetch;
  const state = (window.linnaBench = { open: 0, idle: null });
  const rest = () => requestIdleCallback(() => { if (state.open === 0) state.idle = performance.now(); });
  window.fetch = async (...words) => {
    state.open += 1;
    state.idle = null;
    try {
      const answer = await asked(...words);
      await answer.clone().arrayBuffer();
      return answer;
    } finally {
      state.open -= 1;
      setTimeout(rest, 0);
    }
  };
  window.addEventListener("load", () => setTimeout(rest, 0));
})();
"""


def seed(home: Path, passes: int, rows: int) -> None:
    """A database of passes one after another, and a housekeeping report every second from the first on."""
    with open_ground(home) as ground:
        for number in range(passes):
            start = START + number * 3 * PASS_S * 1_000_000_000
            define_pass(
                ground,
                name=f"pass {number + 1}",
                start_utc_ns=start,
                stop_utc_ns=start + PASS_S * 1_000_000_000,
                spacecraft_id=SPACECRAFT,
            )
        first = int(ticks_from_utc_ns(START))
        for begin in range(0, rows, _CHUNK):
            with ground.database.writing() as connection:
                vehicle = vehicle_id(connection, SPACECRAFT, "flown")
                _housekeeping(connection, vehicle, first, begin, min(_CHUNK, rows - begin))


def _housekeeping(connection: Any, vehicle: int, first: int, begin: int, count: int) -> None:
    """Add rows and roll-ups of a number of seconds; the temperature follows the orbit, all else is constant."""
    version = DICTIONARY.version
    names = ", ".join(HOUSEKEEPING_VALUES)
    values = ", ".join("abs(i % 7000 - 3500) / 100.0" if n == "temperature_c" else "1" for n in HOUSEKEEPING_VALUES)
    connection.exec_driver_sql(
        f"WITH RECURSIVE n(i) AS (SELECT {begin} UNION ALL SELECT i + 1 FROM n WHERE i + 1 < {begin + count}) "
        f"INSERT INTO housekeeping (vehicle_id, dictionary_version, ticks, packet_id, {names}) "
        f"SELECT {vehicle}, {version}, {first} + i * {TICKS_A_SECOND}, i + 1, {values} FROM n"
    )
    i = np.arange(begin, begin + count)
    columns = {name: np.ones(count) for name in HOUSEKEEPING_VALUES}
    columns["temperature_c"] = np.abs(i % 7000 - 3500) / 100.0
    add_to_rollups(connection, vehicle, version, "housekeeping", {**columns, "ticks": first + i * TICKS_A_SECOND})


@contextmanager
def served(home: Path) -> Iterator[str]:
    """The address of `linna serve` over a home."""
    port = free_port()
    address = f"http://127.0.0.1:{port}"
    command = [sys.executable, "-m", "linna", "serve", "--port", str(port), "--home", str(home)]
    with Part(command, home / "serve.log", lambda: answers_http(f"{address}/readyz"), 1):
        yield address


@contextmanager
def open_chromium() -> Iterator[Any]:
    """The system's Chromium, without a screen."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=_CHROMIUM, args=list(_FLAGS))
        yield chromium
        chromium.close()


def measure(url: str, paths: Sequence[str]) -> dict[str, dict[str, int]]:
    """Milliseconds to the first paint, to interactive, and of the main thread's processor, of each page."""
    found: dict[str, dict[str, int]] = {}
    with open_chromium() as chromium:
        for path in paths:
            opened = [_opened(chromium, url + path) for _ in range(_TIMES)]
            found[path] = {
                name: round(statistics.median(one))
                for name, *one in zip(("paint", "clock", "main_thread"), *opened, strict=True)
            }
    return found


def _opened(chromium: Any, address: str) -> tuple[float, float, float]:
    context = chromium.new_context(viewport={"width": 1280, "height": 900})
    page = context.new_page()
    page.add_init_script(_WATCH)
    session = context.new_cdp_session(page)
    session.send("Performance.enable", {"timeDomain": "threadTicks"})
    page.goto(address)
    page.wait_for_function(
        f"() => linnaBench.open === 0 && linnaBench.idle !== null && performance.now() - linnaBench.idle > {_QUIET_MS}",
        timeout=_LIMIT_MS,
    )
    paint = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? NaN"
    painted, at = map(float, page.evaluate(f"() => [{paint}, linnaBench.idle]"))
    metrics = {one["name"]: one["value"] for one in session.send("Performance.getMetrics")["metrics"]}
    context.close()
    return painted, at, 1e3 * metrics["TaskDuration"]


def rows() -> Iterator[Row]:
    """Yield the time to interactive of each page; the peer is the limit of one second."""
    needs("Chromium", "chromium", "chromium-browser", "google-chrome")
    pages = [one.path for one in PAGES if "{" not in one.path] + ["/passes/1", f"/telemetry?pass={PASSES}"]
    with tempfile.TemporaryDirectory(prefix="linna-pages-") as name:
        seed(Path(name), PASSES, ROWS)
        with served(Path(name)) as url:
            found = measure(url, pages)
    for path, one in found.items():
        yield Row(f"{path}: interactive", one["clock"], "ms", "limit", 1000.0)
