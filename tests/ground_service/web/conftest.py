"""A served ground service with one pass, and a real browser to look at it."""

import base64
import io
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from PIL import Image
from pytest import fixture, skip

from ground_service.ground import open_ground
from ground_service.passes.archive_import import import_archive
from ground_service.web import pages
from lunar.ephemeris import ephemeris_from_states
from lunar.messages.oem import format_oem
from lunar.timescales import parse_utc
from tests.lazy import Lazy, expect
from tests.serving import wait_for

cv2 = Lazy("cv2")

CHROMIUM = "/usr/bin/chromium"
OPENMCT = Path(__file__).parents[3] / "deploy/openmct"
TIMEOUT_S = 900.0
NS = 1_000_000_000
# Counts the requests of a page's scripts until their answers are read, and notes what was refused.
COUNT_REQUESTS = """
window.underWay = 0;
window.refused = [];
const plainFetch = window.fetch;
window.fetch = async (...given) => {
  const ended = () => setTimeout(() => { window.underWay -= 1; }, 50);
  window.underWay += 1;
  try {
    const answer = await plainFetch(...given);
    if (answer.status === 403) window.refused.push(answer.url);
    answer.clone().arrayBuffer().then(ended, ended);
    return answer;
  } catch (error) {
    ended();
    throw error;
  }
};
"""
NOTE_VIOLATIONS = """document.addEventListener("securitypolicyviolation", (event) =>
    console.error(`policy: ${event.violatedDirective} ${event.blockedURI}`))"""
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip


def press(page, name):
    page.get_by_role("button", name=name).click()


def shows(page, place, text):
    expect(page.locator(place)).to_contain_text(text)


def end_socket(one):
    """Close a socket, and wake a thread that waits on it."""
    with suppress(OSError):
        one.shutdown(socket.SHUT_RDWR)
    one.close()


class Console:
    """The console of a payload flown live, without the payload: sends given lines, keeps received ones."""

    def __init__(self):
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.received = []
        self._clients = []
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self):
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            self._clients.append(client)
            threading.Thread(target=self._hear, args=(client,), daemon=True).start()

    def _hear(self, client):
        with client, suppress(OSError), client.makefile("r") as lines:
            for line in lines:
                self.received += [line.strip()] if line.strip() != "watch" else []
        self._clients.remove(client)

    def say(self, message):
        """One message to everyone connected, of whom there is at least one in time."""
        wait_for(lambda: bool(self._clients), "nobody has connected to the console")
        for client in list(self._clients):
            with suppress(OSError):  # one that has just hung up
                client.sendall(json.dumps(message).encode() + b"\n")

    def close(self):
        for one in self._listener, *self._clients:
            end_socket(one)
        self._thread.join(TIMEOUT_S)


FRAME = """{"kind": "frame", "mode": "observing", "paused": false, "rate": 1.0, "verifications": [],
    "altitude_km": 30.0, "detections": [{"u_px": 100.0, "v_px": 120.0, "diameter_px": 40.0, "score": 0.9}],
    "catalogue": [{"id": 1, "u_px": 101.0, "v_px": 121.0, "diameter_px": 41.0}]}"""
DARK = """{"severity": "medium", "event": "image_dark", "values": [1.0, 2.0], "text": "mean grey level 1"}"""


def live_frame(number):
    """A frame as the console of the emulator tells it."""
    _, jpeg = cv2.imencode(".jpg", np.full((512, 512), 20 + number, np.uint8))
    estimate = {
        "outcome": "fixed", "reset_trigger": "none", "latitude_deg": -50.0 + number, "longitude_deg": 294.001,
        "altitude_m": 30e3, "error_m": 80.0 + number,
    }  # fmt: skip
    return json.loads(FRAME) | {
        "utc": f"2029-08-07T06:{number // 4:02d}:{15 * (number % 4):02d}.000Z",
        "events": [json.loads(DARK)] if number == 3 else [],
        "frame": number,
        "reference": {"latitude_deg": -50.0 + number, "longitude_deg": 294.0, "altitude_m": 30e3},
        "estimates": {"anchored": estimate},
        "image_jpeg": base64.b64encode(jpeg.tobytes()).decode(),
    }


@fixture
def live_frames():
    """Five frames of a live payload."""
    return [live_frame(number) for number in range(5)]


class Service:
    """A running `linna serve`."""

    def __init__(self, home, console_port, openmct=None, settings=None):
        self.home = home
        environment = {key: value for key, value in os.environ.items() if not key.startswith("LINNA_")} | {
            "LINNA_LIVE_CONSOLE": f"127.0.0.1:{console_port}",
            "XDG_DATA_HOME": str(home / "nothing"),
            "LINNA_OPENMCT": str(openmct or home / "nothing"),
            "LINNA_PLACEBO_PASSES": "0",  # a regression that appears a minute after the start
            **(settings or {}),
        }
        log = home.with_suffix(".log")
        self._log = log.open("wb")
        command = [sys.executable, "-m", "linna", "serve", "--port", "0", "--home", str(home)]
        self._process = subprocess.Popen(command, stdout=self._log, stderr=subprocess.STDOUT, env=environment)
        try:
            self.url = self._wait_for_address(log)
        except BaseException:
            self.__exit__()
            raise

    def _wait_for_address(self, log):
        while True:
            text = log.read_text(errors="replace")
            if "startup complete" in text:
                return text.split("ground service on ", 1)[1].split()[0].rstrip("/")
            if self._process.poll() is not None:
                break
            time.sleep(0.1)
        raise RuntimeError(f"the service did not start:\n{log.read_text(errors='replace')}")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.terminate()
        self._process.wait(TIMEOUT_S)
        self._log.close()


@fixture(scope="session")
def console():
    """A payload's console."""
    opened = Console()
    yield opened
    opened.close()


@fixture(scope="session")
def service(tmp_path_factory, synthetic_pass, console):
    """A service without users, with the synthetic pass imported."""
    home = tmp_path_factory.mktemp("web") / "home"
    with open_ground(home) as ground:
        import_archive(ground, synthetic_pass.folder)
    with Service(home, console.port) as running:
        yield running


@fixture(scope="session")
def serve():
    """Start another service: ``with serve(home, console_port, openmct, settings)``."""
    return Service


@fixture(scope="session")
def openmct(tmp_path_factory):
    """The npm package: that of `make openmct`, else installed from the lock file for these tests."""
    if pages.FOLDER.is_dir():
        return pages.FOLDER
    folder = tmp_path_factory.mktemp("openmct")
    for name in "package.json", "package-lock.json":
        shutil.copy(OPENMCT / name, folder)
    command = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund"]
    try:
        subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=240)
    except (OSError, subprocess.SubprocessError) as error:
        if os.environ.get("CI"):
            raise
        skip(f"Open MCT cannot be installed: {error}")
    return folder / "node_modules/openmct"


class Pictures:
    """Pictures of the pages in 256 colours; documented ones are kept in the folder that LINNA_PICTURES names."""

    def __init__(self, folder, *, documented=True):
        self.folder = Path((documented and os.environ.get("LINNA_PICTURES")) or folder)

    def take(self, page, name, part="body"):
        """Take the upper 800 px of a part of the page."""
        picture = Image.open(io.BytesIO(page.locator(part).screenshot())).convert("RGB")
        picture = picture.crop((0, 0, picture.width, min(picture.height, 800)))
        assert np.asarray(picture).std() > 5.0, f"{name}: nothing but background"
        picture.quantize(256).save(self.folder / f"{name}.png", optimize=True)


@fixture(scope="module")
def browser():
    """The system's Chromium, without a screen; a state that is reached ends the wait for it.

    While it is driven, `asyncio.run` is refused in the thread of the tests, so it ends with its file.
    """
    sync_api = Lazy("playwright.sync_api")
    sync_api.expect.set_options(timeout=TIMEOUT_S * 1e3)
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


def patient(context):
    """Let the pages of a context wait long."""
    context.set_default_timeout(TIMEOUT_S * 1e3)
    return context


@contextmanager
def strict_page(browser, url, *, strict=True):
    """Open a page that permits no failure of a script and no request to another host.

    A strict one permits no error in the console and no violation of the policy; others count their requests.
    """
    context = patient(browser.new_context(base_url=url, viewport={"width": 1280, "height": 900}))
    opened = context.new_page()
    opened.add_init_script(NOTE_VIOLATIONS if strict else COUNT_REQUESTS)
    errors = []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.on("request", lambda request: _note_foreign(request.url, url, errors))
    if strict:
        opened.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    try:
        yield opened
    finally:
        context.close()
    assert errors == []


@fixture
def page(browser, service):
    """A fresh page of the service."""
    with strict_page(browser, service.url, strict=False) as opened:
        yield opened


def _note_foreign(url, own, errors):
    if not url.startswith((own, own.replace("http", "ws", 1), "blob:", "data:")):
        errors.append(f"asked another host: {url}")


@fixture
def day_of_orbits(tmp_path):
    """Six hours of a circular orbit as an OEM file."""
    start = parse_utc("2030-01-01T00:00:00Z")
    elapsed = np.arange(0.0, 6 * 3600.0 + 1.0, 60.0)
    angle = (elapsed * 2 * np.pi / 6672.0)[:, None]
    along, across = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.4, 0.9165])
    position = 1_768_180.0 * (np.cos(angle) * along + np.sin(angle) * across)
    velocity = 1_768_180.0 * 2 * np.pi / 6672.0 * (np.cos(angle) * across - np.sin(angle) * along)
    path = tmp_path / "orbits.oem"
    path.write_text(
        format_oem(ephemeris_from_states(start + np.rint(elapsed * NS).astype(np.int64), position, velocity))
    )
    return path
