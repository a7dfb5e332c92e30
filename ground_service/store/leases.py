"""Leases, the rights of one process among many that end if the process is killed; wake-ups between processes.

A table with leases has the columns `name` (key), `owner` and `lease_utc_ns`, the end of the lease.
"""

import asyncio
import contextlib
import logging
import threading
import time
import uuid
from collections.abc import Callable
from typing import Any

from sqlalchemy import Connection, Table, delete, or_, select, text, update

from ground_service.clock import utc_now_ns
from ground_service.store import repository

_LEASES = repository.LEASES

LONGEST_NS = 3_600_000_000_000
"""No lease is longer: one that ends later was taken while a clock was ahead, and has ended."""

_CLOCKS_NS = 60_000_000_000
"""Difference of the clocks of hosts that compete for a lease."""


def renew_or_take(
    connection: Connection, table: Table, name: str, owner: str, *, now_utc_ns: int, until_utc_ns: int, **taken: Any
) -> bool:
    """Renew the lease of `owner`, or take one that is free or has ended; return whether `owner` has it now.

    A lease that has ended is renewed as long as no other process has taken it: its owner stood still. One that ends
    later than its own length is of a clock that was ahead, and is free.

    Parameters
    ----------
    taken
        Columns that are set when the lease is taken, not when it is renewed.
    """
    rows = table.c
    renewal = update(table).where(rows.name == name, rows.owner == owner).values(lease_utc_ns=until_utc_ns)
    ahead = rows.lease_utc_ns > until_utc_ns + _CLOCKS_NS
    free = or_(rows.owner.is_(None), rows.lease_utc_ns < now_utc_ns, ahead)
    taking = update(table).where(rows.name == name, free).values(owner=owner, lease_utc_ns=until_utc_ns, **taken)
    return connection.execute(renewal).rowcount == 1 or connection.execute(taking).rowcount == 1


def acquire(connection: Connection, name: str, owner: str, duration_ns: int) -> bool:
    """Take or renew a lease of the table `leases`; return whether `owner` has it.

    Processes compare the end of the lease with the clock of the database, so that hosts with different clocks agree.
    """
    now = database_now_ns(connection)
    repository.add_new(connection, _LEASES, name=name, owner=None, lease_utc_ns=0)
    return renew_or_take(connection, _LEASES, name, owner, now_utc_ns=now, until_utc_ns=now + duration_ns)


def release(connection: Connection, name: str, owner: str) -> None:
    """Give a lease back, so that another process need not wait for its end."""
    mine = (_LEASES.c.name == name, _LEASES.c.owner == owner)
    connection.execute(update(_LEASES).where(*mine).values(owner=None, lease_utc_ns=0))


def owner_of(connection: Connection, name: str) -> str | None:
    """Return the process that has a lease now; None without any."""
    row = connection.execute(select(_LEASES).where(_LEASES.c.name == name)).mappings().first()
    now = database_now_ns(connection)
    if row is None or not now <= row["lease_utc_ns"] <= now + LONGEST_NS:
        return None
    return None if row["owner"] is None else str(row["owner"])


def database_now_ns(connection: Connection) -> int:
    """Return the time of the database server; that of this machine with SQLite."""
    if connection.dialect.name != "postgresql":
        return utc_now_ns()
    query = text("SELECT CAST(extract(epoch FROM clock_timestamp()) * 1000000 AS bigint)")
    return 1000 * int(connection.execute(query).scalar_one())


def state(connection: Connection, name: str, owner: str, duration_ns: int) -> None:
    """Set the owner of a lease that no other process competes for."""
    until = database_now_ns(connection) + duration_ns
    repository.add_new(connection, _LEASES, name=name, owner=owner, lease_utc_ns=until)
    connection.execute(update(_LEASES).where(_LEASES.c.name == name).values(owner=owner, lease_utc_ns=until))


def owners(connection: Connection, prefix: str) -> dict[str, str]:
    """Return the owners of the leases in force whose names begin with `prefix`."""
    rows = _LEASES.c
    now = database_now_ns(connection)
    query = select(rows.name, rows.owner).where(
        rows.name.startswith(prefix), rows.lease_utc_ns.between(now, now + LONGEST_NS)
    )
    return {str(name): str(owner) for name, owner in connection.execute(query)}


def remove(connection: Connection, name: str) -> None:
    """Remove a lease."""
    connection.execute(delete(_LEASES).where(_LEASES.c.name == name))


def remove_ended(connection: Connection, prefix: str) -> None:
    """Remove the leases whose names begin with `prefix` and that have ended."""
    rows, now = _LEASES.c, database_now_ns(connection)
    in_force = rows.lease_utc_ns.between(now, now + LONGEST_NS)
    connection.execute(delete(_LEASES).where(rows.name.startswith(prefix), ~in_force))


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
