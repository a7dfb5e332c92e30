"""An operator's hour by the pages, in Chromium, after the two commands of the README.

`python -m benchmarks.campaigns.operator_pages [--demo FOLDER] [--pictures FOLDER]`: `linna demo` and `linna serve`,
then the pages in the widths of a desk and a telephone, a window that is planned, approved, released and taken back,
and mistakes. The exit status is 1 if there was a wrong turn of the classes A or B.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.campaigns._strangers import Diary
from benchmarks.pages import open_chromium, served
from lunar.timescales import format_utc, parse_utc

WIDTHS = (1280, 390)
PAGES = {
    "shift": "/",
    "planner": "/planner",
    "pass": "/passes/1",
    "help": "/help/",
    "regression": "/regression",
}
QUIET_MS = 3000


def main(words: Sequence[str] | None = None) -> int:
    """Spend the hour; 1 if there was a wrong turn."""
    parser = argparse.ArgumentParser(prog="operator_pages", description=__doc__.splitlines()[0])
    parser.add_argument("--demo", type=Path, help="output folder of `linna demo`; default: it is flown now")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the pages in both widths")
    given = parser.parse_args(words)
    diary = Diary("operator by pages")
    with tempfile.TemporaryDirectory(prefix="pages-") as name:
        demo = given.demo or Path(name) / "linna-demo"
        if given.demo is None:
            command = [sys.executable, "-m", "linna", "demo", "--out", str(demo)]
            made = subprocess.run(command, capture_output=True, text=True, check=False)
            if not diary.expect(
                "B", "the demo ends with next steps", "next steps" in made.stdout, made.stderr
            ):
                return diary.close()
        with served(demo / "ground") as url, open_chromium() as chromium:
            for width in WIDTHS:
                look(diary, chromium, url, width, given.pictures)
            with opened(diary, chromium, url, WIDTHS[0]) as page:
                operate(diary, page)
    return diary.close()


@contextmanager
def opened(diary: Diary, chromium: Any, url: str, width: int) -> Iterator[Any]:
    """Open a page on which an error of a script is a wrong turn."""
    context = chromium.new_context(base_url=url, viewport={"width": width, "height": 900})
    page, errors = context.new_page(), list[str]()
    page.on("pageerror", lambda error: errors.append(str(error)))
    yield page
    context.close()
    diary.expect("B", f"no script fails at {width} px", not errors, errors)


def look(diary: Diary, chromium: Any, url: str, width: int, pictures: Path | None) -> None:
    """Look at the pages, which fit the screen and say where they are."""
    with opened(diary, chromium, url, width) as page:
        for name, path in PAGES.items():
            page.goto(path)
            page.wait_for_timeout(QUIET_MS)
            over = page.evaluate("document.scrollingElement.scrollWidth - innerWidth")
            diary.expect("B", f"{name} fits {width} px", over <= 0, f"{over} px more")
            text = page.locator("body").inner_text()
            if name == "shift":
                for word in ("SelenITA", "recorded", "Next step"):
                    diary.expect("B", f"the shift says {word!r}", word in text, text)
                diary.expect(
                    "B", "its clock is that of the data", "2029-" in page.locator("header").inner_text()
                )
            if name == "help":
                diary.expect("B", "help has the first pass", "first pass" in text.lower(), text)
            else:
                is_linked = page.locator("a[href^='/help']").count() > 0
                diary.expect("B", f"{name} links to help", is_linked)
            if pictures is not None:
                pictures.mkdir(parents=True, exist_ok=True)
                page.screenshot(path=pictures / f"{name}-{width}.png", full_page=True)


def enter(page: Any, start_ns: int) -> None:
    """Enter a window of ten minutes on the planner."""
    for name, value in (("start", start_ns), ("stop", start_ns + 600 * 10**9)):
        page.locator(f"#enter-{name}").fill(format_utc(value, 0))
    page.locator("#enter button").click()
    page.wait_for_timeout(QUIET_MS)


def operate(diary: Diary, page: Any) -> None:
    """Plan a window, approve it, release its telecommands and take it back, with mistakes on the way."""
    page.goto("/planner")
    page.wait_for_timeout(QUIET_MS)
    diary.expect("B", "the timeline marks now", page.locator("#timeline line.now").count() == 1)
    now = parse_utc(page.request.get("/api/v1/status").json()["mission_time"])
    page.get_by_text("Enter a window").click()
    enter(page, now - 7200 * 10**9)
    shown = page.locator("body").inner_text()
    diary.expect(
        "A", "a window in the past is refused in words", "after the mission time" in shown, shown[-500:]
    )
    enter(page, now + 7200 * 10**9)
    windows = page.request.get("/api/v1/windows").json()["items"]
    if not diary.expect("A", "a window is entered", [one["state"] for one in windows] == ["draft"], windows):
        return
    path = f"/api/v1/windows/{windows[0]['id']}"

    def state() -> str:
        page.wait_for_timeout(QUIET_MS)
        return str(page.request.get(path).json()["state"])

    page.goto(f"/planner?window={windows[0]['id']}")
    page.wait_for_timeout(QUIET_MS)
    chosen = page.locator("#selected")
    chosen.get_by_role("button", name=re.compile("^Approve")).click()
    dialog = page.get_by_role("dialog")
    diary.expect("A", "the page asks before it approves", dialog.count() == 1 and state() == "draft")
    dialog.get_by_role("button", name="Approve").click()
    diary.expect("A", "the window is approved", state() == "approved")
    chosen.get_by_role("button", name=re.compile("^Uplink")).click()
    page.wait_for_timeout(QUIET_MS)
    diary.expect(
        "A", "the page lists what it releases", "start observation" in dialog.inner_text(), dialog.count()
    )
    dialog.get_by_role("button", name="Release", exact=True).click()
    page.wait_for_timeout(QUIET_MS)
    carried = page.request.get("/api/v1/telecommands").json()["items"]
    diary.expect(
        "A", "its telecommands are released", bool(carried) and carried[0]["state"] != "queued", carried
    )
    chosen.get_by_role("button", name=re.compile("^Take back")).first.click()
    page.wait_for_timeout(QUIET_MS)
    dialog.get_by_role("button", name="Take back").click()
    diary.expect("A", "it can be taken back", state() in ("failed", "cancelling"))
    page.goto("/passes/1")
    page.wait_for_timeout(QUIET_MS)
    diary.expect(
        "B", "the pass leads to its report", page.get_by_role("link", name=re.compile("eport")).count() > 0
    )


if __name__ == "__main__":
    sys.exit(main())
