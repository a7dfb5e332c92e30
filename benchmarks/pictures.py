"""Pictures of the README: overview and pass of a running service, and the first page of a report.

Command: `python -m benchmarks.pictures HOME [--out docs/pictures]`, with the home folder of a demo
(`linna-demo/ground`). Needs playwright and Chromium.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from benchmarks.pages import served

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
WIDTH_PX, HEIGHT_PX = 1200, 800
COLORS = 128


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("home", type=Path, help="home folder of a service with one pass")
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"), metavar="DIR")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    with served(arguments.home) as url:
        pages = {"overview": f"{url}/", "pass": f"{url}/passes/1"}
        report = next((arguments.home / "reports").rglob("report.html"), None)
        if report is not None:
            pages["report"] = report.resolve().as_uri()
        take(pages, arguments.out)


def take(pages: dict[str, str], out: Path) -> None:
    """Write one small PNG for each page."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for name, url in pages.items():
            page = browser.new_page(viewport={"width": WIDTH_PX, "height": HEIGHT_PX}, color_scheme="light")
            page.goto(url, wait_until="networkidle")
            page.wait_for_timeout(1500)
            page.screenshot(path=out / f"{name}.png")
            _shrink(out / f"{name}.png")
        browser.close()


def _shrink(path: Path) -> None:
    """Fewer colours: a picture of a page loses nothing visible and two thirds of its size."""
    from PIL import Image

    with Image.open(path) as picture:
        picture.convert("RGB").quantize(COLORS).save(path, optimize=True)


if __name__ == "__main__":
    main()
