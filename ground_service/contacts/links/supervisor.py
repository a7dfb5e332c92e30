"""All links of a deployment: this process operates those whose lease it gets, also after other processes have ended."""

import logging
import os
import socket
import threading
import uuid

from ground_service.contacts.links import service
from ground_service.contacts.links.runner import LEASE_NS, LinkRunner, ended_holder
from ground_service.contacts.links.service import DeclaredLink
from ground_service.errors import GroundError
from ground_service.ground import Ground
from kernels.memory import give_back, limit_heaps

log = logging.getLogger(__name__)

LOOK_S = 1.0


def process_name() -> str:
    """Return a name of this process as owner of links, which no other process has had."""
    return f"{socket.gethostname()[:48]}:{os.getpid()}:{uuid.uuid4().hex[:8]}"


class LinkSupervisor:
    """Operates declared links in threads of this process.

    Parameters
    ----------
    names
        Links that this process may operate; None: all.
    """

    def __init__(self, ground: Ground, names: frozenset[str] | None = None) -> None:
        self.owner = process_name()
        self._ground, self._names = ground, names
        self._runners: dict[str, LinkRunner] = {}
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="links", daemon=True)

    @property
    def runners(self) -> dict[str, LinkRunner]:
        """The links that this process operates now, by name."""
        with self._lock:
            return dict(self._runners)

    def start(self) -> None:
        """Look after the links in a thread."""
        limit_heaps()
        self._thread.start()

    def stop(self) -> None:
        """Stop all links, with received octets ingested, and give them back."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()
        for name in list(self._runners):
            self._end(name)

    def look(self) -> None:
        """Start links that are free, stop links that are no longer declared or declared differently."""
        declared = service.declared_links(self._ground)
        for name, runner in self.runners.items():
            if declared.get(name) != runner.declared or not runner.alive:
                self._end(name)
        for name, one in declared.items():
            wanted = self._names is None or name in self._names
            if wanted and name not in self._runners and self._acquire(one):
                self._begin(one)

    def _acquire(self, one: DeclaredLink) -> bool:
        """Take a link that is free, whose lease has ended, or whose owner on this machine has ended."""
        if service.acquire(self._ground, one, self.owner, LEASE_NS):
            return True
        ended = ended_holder(self._ground.home, one.link.name)
        if ended is None:
            return False
        service.release(self._ground, one.link.name, ended)
        return service.acquire(self._ground, one, self.owner, LEASE_NS)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self.look()
            except GroundError as error:
                log.warning("links could not be looked after: %s", error)
            except Exception:  # outermost loop of the thread
                log.exception("links could not be looked after")
            give_back()
            self._stopping.wait(LOOK_S)

    def _begin(self, declared: DeclaredLink) -> None:
        runner = LinkRunner(self._ground, declared, self.owner)
        with self._lock:
            self._runners[declared.link.name] = runner
        runner.start()

    def _end(self, name: str) -> None:
        with self._lock:
            runner = self._runners.pop(name)
        runner.stop()
