"""What runs jobs, for the operations that enter them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import Depends, Request

from ground_service.ground import Ground
from ground_service.jobs.service import enter_job


class Dispatcher(ABC):
    """Receives jobs and has them done, in this process or by workers."""

    def __init__(self, ground: Ground) -> None:
        self._ground = ground

    def submit(self, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None) -> str:
        """Enter a job and have it done; return its id."""
        identity = enter_job(self._ground, kind, arguments, job_id=job_id)
        self.start(identity)
        return identity

    @abstractmethod
    def start(self, job_id: str) -> None:
        """Have an entered job done."""

    @abstractmethod
    def resume(self) -> None:
        """Start unfinished jobs of ended processes again; may be called repeatedly."""

    @abstractmethod
    def close(self) -> None:
        """End running jobs: interruptible jobs continue at the next start, others finish."""


async def dispatcher_of(request: Request) -> Dispatcher:
    """Return the dispatcher of the application."""
    dispatcher: Dispatcher = request.app.state.dispatcher
    return dispatcher


DispatcherOf = Annotated[Dispatcher, Depends(dispatcher_of)]
