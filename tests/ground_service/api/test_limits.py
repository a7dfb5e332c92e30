"""Guards of the interface: how often somebody may ask, and what the log says."""

import json
import logging
import logging.config
import sys

import anyio

from ground_service.api.limits import RateLimit
from ground_service.logs import JsonFormatter, logging_config


def statuses(guard: RateLimit, count: int, token: str) -> list[int]:
    """Statuses of requests that come all at once."""
    found: list[int] = []

    async def ask() -> None:
        async def receive() -> dict[str, object]:
            return {"type": "http.request"}

        async def send(message: dict[str, object]) -> None:
            if message["type"] == "http.response.start":
                found.append(int(message["status"]))  # type: ignore[call-overload]

        scope = {
            "type": "http",
            "path": "/x",
            "headers": [(b"authorization", token.encode())],
            "client": ("a", 1),
        }
        for _ in range(count):
            await guard(scope, receive, send)  # type: ignore[arg-type]

    anyio.run(ask)
    return found


async def answer(_scope: object, _receive: object, send: object) -> None:
    await send({"type": "http.response.start", "status": 200, "headers": []})  # type: ignore[operator]
    await send({"type": "http.response.body", "body": b""})  # type: ignore[operator]


def test_a_caller_who_asks_too_often_waits_and_another_does_not() -> None:
    guard = RateLimit(answer, per_second=0.001)  # type: ignore[arg-type]
    assert statuses(guard, 3, "Bearer one") == [200, 429, 429]
    assert statuses(guard, 1, "Bearer two") == [200]
    assert statuses(RateLimit(answer, per_second=0.0), 50, "Bearer one") == [200] * 50  # type: ignore[arg-type]


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
        logging.config.DictConfigurator(logging_config(style))  # type: ignore[attr-defined]
