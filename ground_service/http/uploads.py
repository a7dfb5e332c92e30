"""Uploads: bodies that are streamed into the file archive, with a limit of simultaneous uploads.

A body is received on the event loop and written block by block by a few dedicated threads. A client that sends slowly
or not at all therefore uses an upload slot and an open file, but no thread. Other requests do not depend on these
threads.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from random import random
from typing import TypeVar

from fastapi import Request
from starlette.requests import ClientDisconnect

from ground_service.http.problems import BrokenOff, Busy, TooLarge, UnsupportedEncoding
from ground_service.store.files import FileArchive, StoredFile

BLOCK_OCTETS = 1 << 19
UPLOADS_AT_ONCE = 64
WRITERS = 2
WAITING_LIMIT = 256
WAIT_S = 5.0

Result = TypeVar("Result")


class UploadPool:
    """Upload slots of one process, and the threads that write uploads."""

    def __init__(self, at_once: int = UPLOADS_AT_ONCE) -> None:
        self._places = asyncio.Semaphore(at_once)
        self._waiting = 0
        self._threads = ThreadPoolExecutor(WRITERS, thread_name_prefix="upload")

    @asynccontextmanager
    async def place(self) -> AsyncIterator[None]:
        """Reserve an upload slot, after a short wait if needed.

        Raises
        ------
        Busy
            If no slot is free.
        """
        if self._places.locked():
            if self._waiting >= WAITING_LIMIT:
                raise Busy("uploads: expected fewer at once; try again later")
            self._waiting += 1
            try:
                await asyncio.wait_for(self._places.acquire(), WAIT_S * (0.5 + random()))
            except TimeoutError:
                raise Busy("uploads: expected fewer at once; try again later") from None
            finally:
                self._waiting -= 1
        else:
            await self._places.acquire()
        try:
            yield
        finally:
            self._places.release()

    async def run(self, function: Callable[..., Result], *arguments: object) -> Result:
        """Run a function in an upload thread and return its result."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)

    def close(self) -> None:
        """Wait for pending writes."""
        self._threads.shutdown(wait=True, cancel_futures=True)


class Upload:
    """Upload with a reserved slot."""

    def __init__(self, request: Request, pool: UploadPool) -> None:
        self._request = request
        self._pool = pool

    async def run(self, function: Callable[..., Result], *arguments: object) -> Result:
        """Run a function in an upload thread and return its result."""
        return await self._pool.run(function, *arguments)

    async def stored(self) -> StoredFile:
        """Store the body in the file archive. Nothing is stored if the body is incomplete.

        Raises
        ------
        TooLarge
            If the body is larger than the limit.
        UnsupportedEncoding
            If the transfer is compressed: the archive must hold the recorded octets.
        BrokenOff
            If the client disconnects or is too slow.
        """
        coding = self._request.headers.get("content-encoding", "identity").strip().lower()
        if coding != "identity":
            raise UnsupportedEncoding(f"Content-Encoding: expected identity, found {coding[:40]}")
        archive: FileArchive = self._request.app.state.ground.files
        limit: int = self._request.app.state.upload_limit_octets
        incoming = archive.incoming()
        taken = 0
        held = bytearray()
        try:
            async for block in self._request.stream():
                taken += len(block)
                if taken > limit:
                    raise TooLarge(f"body: expected at most {limit} octets")
                held += block
                if len(held) >= BLOCK_OCTETS:
                    await self._pool.run(incoming.append, bytes(held))
                    held.clear()

            def finish() -> StoredFile:
                incoming.append(bytes(held))
                return incoming.keep()

            return await self._pool.run(finish)
        except ClientDisconnect:
            raise BrokenOff(f"body: expected a complete body, found {taken} octets") from None
        finally:
            incoming.discard()
