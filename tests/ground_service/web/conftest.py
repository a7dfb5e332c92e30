"""A served ground service with one pass, and a real browser to look at it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from ground_service.services.archive_import import import_archive
from ground_service.services.ground import open_ground

CHROMIUM = "/usr/bin/chromium"
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


class Service:
    """A running `linna serve`."""

    def __init__(self, home: Path, log: Path) -> None:
        self.home = home
        environment = {key: value for key, value in os.environ.items() if not key.startswith("LINNA_")}
        environment["XDG_DATA_HOME"] = str(home / "nothing")
        self._log = log.open("wb")
        command = [sys.executable, "-m", "linna", "serve", "--port", "0", "--home", str(home)]
        self._process = subprocess.Popen(command, stdout=self._log, stderr=subprocess.STDOUT, env=environment)
        try:
            self.url = self._wait_for_address(log)
        except BaseException:
            self.stop()
            raise

    def _wait_for_address(self, log: Path) -> str:
        for _ in range(300):
            text = log.read_text(errors="replace")
            if "startup complete" in text:
                return text.split("ground service on ", 1)[1].split()[0].rstrip("/")
            if self._process.poll() is not None:
                break
            time.sleep(0.1)
        raise RuntimeError(f"the service did not start:\n{log.read_text(errors='replace')}")

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait(30)
        self._log.close()


@pytest.fixture(scope="session")
def service(tmp_path_factory, synthetic_pass) -> Iterator[Service]:
    """A service without users, with the synthetic pass imported."""
    home = tmp_path_factory.mktemp("web") / "home"
    with open_ground(home) as ground:
        import_archive(ground, synthetic_pass.folder)
    running = Service(home, home / "serve.log")
    yield running
    running.stop()


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """The system's Chromium, without a screen."""
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser: Browser, service: Service) -> Iterator[Page]:
    """A fresh page of the service; the test fails if a script of it did, or if it asked another host."""
    context = browser.new_context(base_url=service.url, viewport={"width": 1280, "height": 900})
    opened = context.new_page()
    opened.set_default_timeout(20_000)
    errors: list[str] = []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.on("request", lambda request: _note_foreign(request.url, service.url, errors))
    yield opened
    context.close()
    assert errors == []


def _note_foreign(url: str, own: str, errors: list[str]) -> None:
    if not url.startswith((own, own.replace("http", "ws", 1), "blob:", "data:")):
        errors.append(f"asked another host: {url}")


def ask(url: str, token: str = "") -> tuple[int, bytes, dict[str, str]]:
    """Status, body and headers of a GET."""
    request = urllib.request.Request(url, headers={"Authorization": f"Bearer {token}"} if token else {})
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.read(), dict(answer.headers)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read(), dict(error.headers)
