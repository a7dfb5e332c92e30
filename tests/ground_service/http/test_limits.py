"""Guards of the interface: the size of bodies, and what the log says."""

import asyncio
import json
import logging
import logging.config
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from starlette.requests import ClientDisconnect

from ground_service.http import limits
from ground_service.http.limits import BodyLimit
from ground_service.logs import JsonFormatter, logging_config


class Bodies:
    """Requests to a guarded application that reads bodies; the test sends each body in parts."""

    def __init__(self) -> None:
        self.guard = BodyLimit(self._read, upload_paths=("/upload",), upload_limit_octets=1 << 20)

    async def _read(self, _scope: Any, receive: Any, send: Any) -> None:
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                raise ClientDisconnect
            if not message.get("more_body"):
                break
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    def ask(self, path: str = "/x") -> tuple[asyncio.Queue[tuple[bytes, bool]], asyncio.Task[Any]]:
        """Start a request; the queue takes the parts of its body, and whether more follow."""
        parts: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
        started: list[Any] = []

        async def receive() -> dict[str, Any]:
            body, more = await parts.get()
            return {"type": "http.request", "body": body, "more_body": more}

        async def send(message: Any) -> None:
            if message["type"] == "http.response.start":
                started.append((message["status"], dict(message["headers"]).get(b"retry-after")))

        async def run() -> Any:
            scope = {"type": "http", "method": "POST", "path": path, "headers": [], "state": {}}
            await self.guard(scope, receive, send)
            return started[0]

        return parts, asyncio.create_task(run())


def test_bodies_of_all_requests_together_are_held_within_one_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "HELD_LIMIT_OCTETS", 1000)

    async def test() -> None:
        bodies = Bodies()
        first_parts, first = bodies.ask()
        first_parts.put_nowait((b"x" * 600, True))
        await asyncio.sleep(0.01)
        upload_parts, upload = bodies.ask("/upload")  # is streamed to the archive and not counted
        upload_parts.put_nowait((b"x" * 5000, False))
        assert await upload == (200, None)
        parts, second = bodies.ask()
        parts.put_nowait((b"x" * 401, False))
        assert await second == (503, b"1")
        parts, third = bodies.ask()
        parts.put_nowait((b"x" * 400, False))
        assert await third == (200, None)
        first_parts.put_nowait((b"", False))
        assert await first == (200, None)
        parts, after = bodies.ask()
        parts.put_nowait((b"x" * 1000, False))
        assert await after == (200, None)

    with ThreadPoolExecutor(1) as pool:
        pool.submit(asyncio.run, test()).result()


def test_a_log_entry_is_one_json_object_with_what_was_passed() -> None:
    try:
        raise ValueError("broken")
    except ValueError:
        record = logging.LogRecord(
            "linna", logging.ERROR, "f.py", 1, "job %s\nfailed", ("7",), sys.exc_info()
        )
    record.job = "7"
    line = JsonFormatter().format(record)
    assert "\n" not in line
    entry = json.loads(line)
    assert (entry["level"], entry["message"], entry["job"]) == ("error", "job 7\nfailed", "7")
    assert "ValueError: broken" in entry["trace"]
    assert entry["time"].endswith("+00:00")
    for style in ("text", "json"):
        logging.config.DictConfigurator(logging_config(style))


@pytest.mark.parametrize("style", ["text", "json"])
def test_what_a_client_sent_makes_neither_a_line_nor_a_terminal_sequence(style: str) -> None:
    """A path is decoded before it is logged: `GET /%0a2026-01-01 INFO forged`."""
    configuration = logging.config.DictConfigurator(logging_config(style))
    formatter = configuration.configure_formatter(configuration.config["formatters"]["line"])
    forged = "/x\n2026-01-01 INFO forged\r\x1b[2J\x7f\x9b31m\u2028"
    try:
        raise ValueError(forged)
    except ValueError:
        record = logging.LogRecord("linna", logging.INFO, "f.py", 1, "GET %s", (forged,), sys.exc_info())
    lines = formatter.format(record).split("\n")
    assert all(line.isprintable() for line in lines)
    assert not any(line.startswith("2026-01-01 INFO forged") for line in lines[:-1])


def test_addresses_of_webhooks_are_not_logged() -> None:
    """The HTTP client logs the address of each request at the level INFO."""
    assert logging_config("json")["loggers"]["httpx"]["level"] == "WARNING"
