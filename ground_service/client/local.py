"""In-process client of the ground service, without a server: its transport and its time limits."""

from __future__ import annotations

import inspect
import weakref
from importlib import import_module
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from ground_service.client.tasks import Client
from ground_service.errors import GroundError

if TYPE_CHECKING:
    import httpx

    from ground_service.ground import Ground
    from ground_service.http.model import PageOf

LOCAL_URL = "http://localhost"


class LocalClient(Client):
    """Client of an open ground service in this process, as administrator `actor`; closing it closes the service.

    Access to the local database implies full access. Lists are read directly, which takes no HTTP libraries.

    Parameters
    ----------
    background
        Run jobs in a thread, so that their progress can be followed; otherwise each job finishes before its request
        returns.
    """

    def __init__(self, ground: Ground, actor: str, *, background: bool = False) -> None:
        super().__init__(LOCAL_URL)
        self._ground = ground
        self._caller = (actor, background)
        self._end = weakref.finalize(self, ground.close)

    def close(self) -> None:
        """Close the service."""
        super().close()
        self._end()

    def _transport(self) -> httpx.BaseTransport:
        from ground_service.client.transport import LocalTransport

        actor, background = self._caller
        return LocalTransport(self._ground, actor, background=background)

    def _page(self, reads: str, item: Any, path: str, query: dict[str, Any]) -> PageOf[Any]:
        if not reads:
            return super()._page(reads, item, path, query)
        module, _, name = reads.rpartition(".")
        work = getattr(import_module(f"ground_service.{module}"), name)
        _, asked = inspect.signature(work, eval_str=True).parameters.values()
        stated = {key: value for key, value in query.items() if value is not None}
        try:
            found: PageOf[Any] = self._ground.read(work, asked.annotation.model_validate(stated))
        except (GroundError, ValidationError):  # the operation states the fault
            return super()._page("", item, path, query)
        return found


local_client = LocalClient
