"""Guards of the interface: how often somebody may ask, and what the log says."""

import asyncio
import json
import logging
import logging.config
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import anyio
import pytest
from starlette.requests import ClientDisconnect

from ground_service.http import limits
from ground_service.http.limits import (
    CALLERS_KEPT,
    VERIFIED_CALLER,
    BodyLimit,
    LocalBudgets,
    RateLimit,
    SharedBudgets,
)
from ground_service.logs import JsonFormatter, logging_config


def statuses(guard: RateLimit, count: int, token: str, address: str = "192.0.2.1") -> list[int]:
    """Statuses of requests that come all at once."""
    found: list[int] = []

    async def ask() -> None:
        async def receive() -> dict[str, object]:
            return {"type": "http.request"}

        async def send(message: dict[str, object]) -> None:
            if message["type"] == "http.response.start":
                found.append(int(message["status"]))

        for _ in range(count):
            scope = {
                "type": "http",
                "path": "/x",
                "headers": [(b"authorization", token.encode())] if token else [],
                "client": (address, 1),
                "state": {},
            }
            await guard(scope, receive, send)

    # In a thread of its own: tests in a browser leave a loop running in theirs.
    with ThreadPoolExecutor(1) as pool:
        pool.submit(anyio.run, ask).result()
    return found


async def answer(scope: Any, _receive: object, send: object) -> None:
    """Respond to every request, and verify the tokens of two users."""
    known = {b"Bearer one": "ann", b"Bearer new": "ann", b"Bearer two": "bob"}
    caller = known.get(dict(scope["headers"]).get(b"authorization"))
    if caller is not None:
        scope["state"][VERIFIED_CALLER] = caller
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b""})


def test_a_caller_who_asks_too_often_waits_and_another_does_not() -> None:
    guard = RateLimit(answer, per_second=1e-9)
    assert statuses(guard, 2, "") == [200, 429]
    assert statuses(guard, 1, "", address="192.0.2.2") == [200]
    assert statuses(guard, 1, "") == [429]
    assert statuses(RateLimit(answer, per_second=0.0), 50, "Bearer one") == [200] * 50


def test_invented_tokens_are_paid_for_by_their_address_even_where_no_token_is_needed() -> None:
    guard = RateLimit(answer, per_second=1.0)
    found = [statuses(guard, 1, f"Bearer {number}")[0] for number in range(6)]
    assert found == [200, 200, 429, 429, 429, 429]


def test_a_user_has_one_budget_however_many_tokens_and_addresses() -> None:
    guard = RateLimit(answer, per_second=1.0)
    assert statuses(guard, 1, "Bearer one", address="192.0.2.1") == [200]
    assert statuses(guard, 1, "Bearer new", address="192.0.2.2") == [200]
    found = [statuses(guard, 1, token, address="192.0.2.3")[0] for token in ("Bearer one", "Bearer new") * 2]
    assert found == [200, 200, 429, 429]


def test_a_user_is_not_held_up_by_others_at_the_same_address() -> None:
    guard = RateLimit(answer, per_second=1.0)
    assert statuses(guard, 1, "Bearer one") == [200]
    assert statuses(guard, 3, "") == [200, 429, 429]
    assert statuses(guard, 3, "Bearer one") == [200, 200, 429]


def test_the_addresses_of_one_ipv6_network_share_a_budget() -> None:
    guard = RateLimit(answer, per_second=1e-9)
    assert statuses(guard, 1, "", address="2001:db8::1") == [200]
    assert statuses(guard, 1, "", address="2001:db8::ffff:2") == [429]
    assert statuses(guard, 1, "", address="2001:db8:0:1::1") == [200]


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


def test_memory_for_callers_is_bounded() -> None:
    budgets = LocalBudgets(1.0)

    async def many() -> None:
        for number in range(CALLERS_KEPT + 50):
            await budgets.take(str(number))

    with ThreadPoolExecutor(1) as pool:
        pool.submit(anyio.run, many).result()
    assert len(budgets._left) == CALLERS_KEPT


def test_processes_with_a_broker_share_one_budget(redis_url: str) -> None:
    async def ask() -> tuple[list[bool], list[bool], float]:
        one, two = SharedBudgets(redis_url, 2.0), SharedBudgets(redis_url, 2.0)
        try:
            mine = [await budgets.take("ann") == 0.0 for budgets in (one, two) * 4]
            theirs = [await budgets.take("bob") == 0.0 for budgets in (two, one)]
            return mine, theirs, await one.take("ann")
        finally:
            await one.close()
            await two.close()

    with ThreadPoolExecutor(1) as pool:
        mine, theirs, wait_s = pool.submit(anyio.run, ask).result()
    # Four at once, and one more every half second; a slow machine may gain some during the requests.
    assert mine[:4] == [True] * 4 and not mine[-1]
    assert theirs == [True, True]
    assert 0.0 < wait_s <= 0.5


def test_a_broker_that_is_away_leaves_each_process_its_own_budget(caplog: pytest.LogCaptureFixture) -> None:
    async def ask() -> list[bool]:
        budgets = SharedBudgets("redis://127.0.0.1:1/0", 1.0)
        try:
            return [await budgets.take("ann") == 0.0 for _ in range(3)]
        finally:
            await budgets.close()

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(anyio.run, ask).result() == [True, True, False]
    assert sum("each process limits on its own" in record.message for record in caplog.records) == 1


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
