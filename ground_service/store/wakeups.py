"""Wake-ups over Redis: the other processes of a deployment read the event log as soon as events were committed.

A wake-up contains no event. The event log in the database is the record, and processes read it periodically as well, so
a lost wake-up or an unavailable broker only delays the feed.
"""

import asyncio
import contextlib
import logging
import threading
import time
import uuid
from collections.abc import Callable
from typing import Any

log = logging.getLogger(__name__)

CHANNEL = "linna:events"
TIMEOUT_S = 0.5
RETRY_S = 2.0
"""Time without a request after one that failed, so that an unavailable broker does not slow down each commit."""

HEALTH_CHECK_S = 10

SENDER = uuid.uuid4().hex.encode()
"""Name of this process, which ignores its own wake-ups: it is notified by its database object."""


class Waker:
    """Listener of a database that publishes a wake-up after each commit with events; faults are logged once."""

    def __init__(self, url: str, sender: bytes = SENDER) -> None:
        self._url, self._sender = url, sender
        self._client: Any = None
        self._away_until_s = 0.0
        self._lock = threading.Lock()

    def __call__(self, _kinds: frozenset[str]) -> None:
        """Publish a wake-up."""
        import redis

        if time.monotonic() < self._away_until_s:
            return
        try:
            with self._lock:
                if self._client is None:
                    self._client = redis.Redis.from_url(
                        self._url, socket_timeout=TIMEOUT_S, socket_connect_timeout=TIMEOUT_S
                    )
            self._client.publish(CHANNEL, self._sender)
            if self._away_until_s:
                self._away_until_s = 0.0
                log.info("live feed: the broker is available again")
        except (redis.RedisError, OSError) as error:
            if not self._away_until_s:
                log.warning("live feed: the broker is unavailable (%s); other processes poll the event log", error)
            self._away_until_s = time.monotonic() + RETRY_S


async def listen(url: str, wake: Callable[[], None]) -> None:
    """Call `wake` for each wake-up of another process, and after each connection to the broker, until cancelled."""
    import redis
    import redis.asyncio

    available = True
    while True:
        client = redis.asyncio.from_url(url, socket_connect_timeout=TIMEOUT_S, health_check_interval=HEALTH_CHECK_S)
        try:
            async with client.pubsub(ignore_subscribe_messages=True) as subscribed:
                await subscribed.subscribe(CHANNEL)
                if not available:
                    log.info("live feed: the broker is available again")
                available = True
                wake()  # for what was missed without a connection
                while True:
                    message = await subscribed.get_message(timeout=HEALTH_CHECK_S)
                    if message is not None and message["data"] != SENDER:
                        wake()
        except (redis.RedisError, OSError) as error:
            if available:
                log.warning("live feed: the broker is unavailable (%s); the event log is polled", error)
            available = False
        finally:
            with contextlib.suppress(redis.RedisError, OSError):
                await client.aclose()
        await asyncio.sleep(RETRY_S)
