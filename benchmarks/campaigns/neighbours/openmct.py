"""Open MCT in Chromium on the pages of the service: series that its telemetry interface gives.

The campaign runs this with the interpreter of this project; `NODE_PATH` names the folder of the package.
"""

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

from _cells import run

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
READ = """async ([start, end, name]) => {
  const craft = (await (await fetch('/api/v1/spacecraft')).json()).items[0];
  const key = ['parameter', craft.spacecraft_id, craft.instance, name].join('~');
  const object = await openmct.objects.get({ namespace: 'linna', key });
  const found = await openmct.telemetry.request(object, { start, end, size: 100000 });
  return found.map((each) => [each.utc, each.value]);
}"""


def openmct(cells):
    """Compare series of housekeeping with the table of the pass."""
    home = cells.out / "home"
    shutil.copytree(cells.sample("ground"), home)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    package = Path(os.environ["NODE_PATH"]) / "openmct"
    command = [sys.executable, "-m", "linna", "serve", "--home", str(home), "--port", str(port)]
    environment = {**os.environ, "LINNA_OPENMCT": str(package), "LINNA_LINKS": "false"}
    server = subprocess.Popen(command, env=environment, stdout=sys.stderr, stderr=sys.stderr)
    try:
        _wait(f"http://127.0.0.1:{port}/mct")
        header, *rows = cells.expected["tables"]["housekeeping"]
        start, end = _milliseconds(rows[0][0]) - 1000, _milliseconds(rows[-1][0]) + 1000
        with _page(port) as page:
            for name in ("temperature_c", "bus_voltage_v"):
                place = header.index(name)
                right = [[float(_milliseconds(row[0])), row[place]] for row in rows]
                cells.reads(f"series {name}", right, lambda name=name: _series(page, start, end, name))
    finally:
        server.terminate()
        server.wait(30)


def _series(page, start, end, name):
    return [[float(at), float(value)] for at, value in page.evaluate(READ, [start, end, name])]


@contextlib.contextmanager
def _page(port):
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{port}/mct")
        page.get_by_role("tree", name="Main Tree").wait_for(timeout=120_000)
        yield page
        browser.close()


def _wait(url):
    for _ in range(240):
        with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=5):
            return
        time.sleep(0.5)
    raise TimeoutError(f"no answer of {url}")


def _milliseconds(text):
    from lunar.utc import parse_utc

    return parse_utc(text) // 1_000_000


run(globals())
