"""Guards of the interface: how often somebody may ask, and what the log says."""

import json
import logging
import logging.config
import sys
from concurrent.futures import ThreadPoolExecutor

import anyio

from ground_service.api.limits import RateLimit
from ground_service.logs import JsonFormatter, logging_config


def statuses(guard: RateLimit, count: int, token: str, address: str = "a") -> list[int]:
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
            "headers": [(b"authorization", token.encode())] if token else [],
            "client": (address, 1),
        }
        for _ in range(count):
            await guard(scope, receive, send)  # type: ignore[arg-type]

    # In a thread of its own: tests in a browser leave a loop running in theirs.
    with ThreadPoolExecutor(1) as pool:
        pool.submit(anyio.run, ask).result()
    return found


async def answer(_scope: object, _receive: object, send: object) -> None:
    await send({"type": "http.response.start", "status": 200, "headers": []})  # type: ignore[operator]
    await send({"type": "http.response.body", "body": b""})  # type: ignore[operator]


def test_a_caller_who_asks_too_often_waits_and_another_does_not() -> None:
    guard = RateLimit(answer, per_second=0.001)  # type: ignore[arg-type]
    assert statuses(guard, 4, "Bearer one") == [200, 200, 429, 429]
    assert statuses(guard, 1, "", address="b") == [200]
    assert statuses(guard, 1, "", address="a") == [429]
    assert statuses(RateLimit(answer, per_second=0.0), 50, "Bearer one") == [200] * 50  # type: ignore[arg-type]


async def refuse(_scope: object, _receive: object, send: object) -> None:
    await send({"type": "http.response.start", "status": 401, "headers": []})  # type: ignore[operator]
    await send({"type": "http.response.body", "body": b""})  # type: ignore[operator]


def test_tokens_made_up_one_after_the_other_earn_nothing() -> None:
    guard = RateLimit(refuse, per_second=1.0)  # type: ignore[arg-type]
    found = [statuses(guard, 1, f"Bearer {number}")[0] for number in range(6)]
    assert found == [401, 401, 429, 429, 429, 429]


def test_a_caller_whose_token_is_accepted_is_not_held_up_by_others_at_its_address() -> None:
    guard = RateLimit(answer, per_second=0.001)  # type: ignore[arg-type]
    guard._rate, guard._depth = 0.001, 2.0
    assert statuses(guard, 1, "Bearer one") == [200]
    assert statuses(guard, 3, "") == [200, 429, 429]
    assert statuses(guard, 3, "Bearer one") == [200, 200, 429]


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
