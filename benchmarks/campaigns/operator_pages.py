"""An operator's hour by the pages, in Chromium, after the two commands of the README.

`python -m benchmarks.campaigns.operator_pages [DEMO [PICTURES]]`: `linna demo` (or the folder of one), `linna serve`,
then the pages in the widths of a desk and a telephone, with pictures in a folder, a window that is planned, approved,
released and taken back, and mistakes. The exit status is 1 if there was a wrong turn of the classes A or B.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.campaigns._strangers import Diary
from benchmarks.pages import open_chromium, served
from lunar.timescales import format_utc, parse_utc

LOOKED_AT = {
    "shift": ("/", "SelenITA", "recorded", "Next step", "2029-"), "planner": ("/planner", "now"),
    "pass": ("/passes/1", "Report"), "help": ("/help/", "first pass"), "regression": ("/regression", "Run"),
}  # fmt: skip
"""Addresses of pages, and words that each has to say."""
QUIET_MS = 3000


def main(demo: str = "", pictures: str = "") -> int:
    """Spend the hour; 1 if there was a wrong turn."""
    diary = Diary("operator by pages")
    with tempfile.TemporaryDirectory(prefix="pages-") as name:
        folder = Path(demo or Path(name) / "linna-demo")
        if not demo:
            command = [sys.executable, "-m", "linna", "demo", "--out", str(folder)]
            made = subprocess.run(command, capture_output=True, text=True, check=False)
            if not diary.expect("B", "the demo ends with next steps", "next steps" in made.stdout, made.stderr):
                return diary.close()
        with served(folder / "ground") as url, open_chromium() as chromium:
            for width in (390, 1280):
                context = chromium.new_context(base_url=url, viewport={"width": width, "height": 900})
                page, errors = context.new_page(), list[str]()
                page.on("pageerror", lambda error, errors=errors: errors.append(str(error)))
                look(diary, page, width, pictures)
                if width > 1000:
                    operate(diary, page)
                diary.expect("B", f"no script fails at {width} px", not errors, errors)
    return diary.close()


def opened(page: Any, path: str, *named: str) -> str:
    """Open a page; return its text when it has these words, or after a minute."""
    page.goto(path)
    for _ in range(20):
        page.wait_for_timeout(QUIET_MS)
        text = str(page.locator("body").inner_text())
        if all(one.lower() in text.lower() for one in named):
            break
    return text


def look(diary: Diary, page: Any, width: int, pictures: str) -> None:
    """Look at the pages, which fit the screen, say where they are and link to help."""
    for name, (path, *named) in LOOKED_AT.items():
        text = opened(page, path, *named)
        missing = [one for one in named if one.lower() not in text.lower()]
        diary.expect("B", f"{name} at {width} px says {', '.join(named)}", not missing, text)
        over = page.evaluate("document.scrollingElement.scrollWidth - innerWidth")
        diary.expect("B", f"{name} fits {width} px", over <= 0, f"{over} px more")
        diary.expect("B", f"{name} leads to help", page.locator("a[href*='help'], .help").count() > 0)
        if pictures:
            Path(pictures).mkdir(parents=True, exist_ok=True)
            page.screenshot(path=Path(pictures) / f"{name}-{width}.png", full_page=True)


def operate(diary: Diary, page: Any) -> None:
    """Plan a window, approve it, release its telecommands and take it back, with a mistake on the way."""
    opened(page, "/planner")
    now = parse_utc(page.request.get("/api/v1/status").json()["mission_time"])
    page.get_by_text("Enter a window").click()
    for hours in (-2, 2):
        for name, minutes in (("start", 60 * hours), ("stop", 60 * hours + 10)):
            page.locator(f"#enter-{name}").fill(format_utc(now + minutes * 60 * 10**9, 0))
        page.locator("#enter button").click()
        page.wait_for_timeout(QUIET_MS)
        if hours < 0:
            text = page.locator("body").inner_text()
            diary.expect("A", "a window in the past is refused in words", "after the mission time" in text, text)
    windows = page.request.get("/api/v1/windows").json()["items"]
    if not diary.expect("A", "a window is entered", [one["state"] for one in windows] == ["draft"], windows):
        return
    path = f"/api/v1/windows/{windows[0]['id']}"
    opened(page, f"/planner?window={windows[0]['id']}")
    for button, shown, deed, states in (
        ("Approve", "an image every", "Approve", ("approved",)),
        ("Uplink", "start observation", "Release", ("approved", "uplinked")),
        ("Take back", "telecommands", "Take back", ("failed", "cancelling")),
    ):
        page.locator("#selected").get_by_role("button", name=re.compile(f"^{button}")).click()
        page.wait_for_timeout(QUIET_MS)
        dialog = page.get_by_role("dialog")
        asked = dialog.inner_text() if dialog.count() else "no question"
        if not diary.expect("A", f"{button} asks first", shown in asked, asked):
            return
        dialog.get_by_role("button", name=deed, exact=True).click()
        page.wait_for_timeout(QUIET_MS)
        found = page.request.get(path).json()
        diary.expect("A", f"the window is {' or '.join(states)}", found["state"] in states, found)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
