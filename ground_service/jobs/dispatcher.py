"""Interface of the dispatcher: what runs jobs, for the operations that enter them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Protocol

from fastapi import Depends, Request


class Dispatcher(Protocol):
    """Receives jobs and has them done, in this process or by workers."""

    def submit(self, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None) -> str:
        """Enter a job and have it done; return its id."""

    def start(self, job_id: str) -> None:
        """Have an entered job done."""

    def resume(self) -> None:
        """Start unfinished jobs of ended processes again; may be called repeatedly."""

    def close(self) -> None:
        """End running jobs: interruptible jobs continue at the next start, others finish."""


async def dispatcher_of(request: Request) -> Dispatcher:
    """Return the dispatcher of the application."""
    dispatcher: Dispatcher = request.app.state.dispatcher
    return dispatcher


DispatcherOf = Annotated[Dispatcher, Depends(dispatcher_of)]
