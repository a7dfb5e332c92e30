"""Uploads: bodies that are streamed into the archive of files, a bounded number of them at once.

A body is received on the event loop and written by a few threads of its own, a block at a time. A client that sends
slowly or not at all therefore holds a place and an open file, but no thread. Requests other than uploads do not
depend on these threads.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from random import random
from typing import Annotated, TypeVar

from fastapi import Depends, Request
from starlette.requests import ClientDisconnect

from ground_service.api.problems import BrokenOff, Busy, TooLarge, UnsupportedEncoding
from ground_service.api.security import requires
from ground_service.services.users import Caller
from ground_service.store.files import FileArchive, StoredFile

BLOCK_OCTETS = 1 << 19
WRITERS = 2
WAITING_LIMIT = 256
WAIT_S = 5.0

Result = TypeVar("Result")


class UploadPool:
    """The uploads of one process: how many there may be at once, and the threads that write them."""

    def __init__(self, at_once: int) -> None:
        self._places = asyncio.Semaphore(at_once)
        self._waiting = 0
        self._threads = ThreadPoolExecutor(WRITERS, thread_name_prefix="upload")

    @asynccontextmanager
    async def place(self) -> AsyncIterator[None]:
        """A place for one upload, waited for a little.

        Raises
        ------
        Busy
            If none is free.
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
        """The result of a function, called in a thread of the uploads."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)

    def close(self) -> None:
        """Wait for what is being written."""
        self._threads.shutdown(wait=True, cancel_futures=True)


class Upload:
    """One upload that has a place."""

    def __init__(self, request: Request, pool: UploadPool) -> None:
        self._request = request
        self._pool = pool

    async def run(self, function: Callable[..., Result], *arguments: object) -> Result:
        """The result of a function, called in a thread of the uploads."""
        return await self._pool.run(function, *arguments)

    async def stored(self) -> StoredFile:
        """The body, in the archive of files. Nothing of it stays if it does not come whole.

        Raises
        ------
        TooLarge
            If there is more of it than the service takes.
        UnsupportedEncoding
            If it is compressed for the transfer: what is archived has to be what was recorded.
        BrokenOff
            If the client goes, or is too slow.
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
            raise BrokenOff(f"body: expected to its end, found {taken} octets") from None
        finally:
            incoming.discard()


async def upload_of(
    request: Request, _: Annotated[Caller, Depends(requires("operator"))]
) -> AsyncIterator[Upload]:
    """A place for the body of a request whose caller may upload."""
    pool: UploadPool = request.app.state.uploads
    async with pool.place():
        yield Upload(request, pool)


UploadOf = Annotated[Upload, Depends(upload_of)]
