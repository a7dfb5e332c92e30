"""Resources of the ground service: database, file archive and available public data products."""

from __future__ import annotations

import functools
import logging
import stat
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from ipaddress import IPv4Network, IPv6Network, ip_network
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar

from ground_service.errors import Stopping, storage_error
from ground_service.store.database import Database, prepare_database
from ground_service.store.files import UNPACKING, FileArchive, files_of, make_durable_folder, remove_leftovers
from ground_service.store.leases import Waker
from ground_service.store.objects import ObjectStore, objects_of
from ground_service.store.roles import check_role
from lunar.datafolder import DataFolder, default_orientation, find_data

if TYPE_CHECKING:
    from sqlalchemy import Connection

    from ground_service.settings import Settings
    from lunar.frames import Orientation


Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

log = logging.getLogger(__name__)

WAIT_S = 0.2
_running: set[tuple[Path, str]] = set()
_changed = threading.Condition()
"""Work of `Ground.alone` in this process, and the notification of its changes."""


@dataclass(frozen=True, slots=True)
class Ground:
    """An opened ground service: pass it to the services of the capabilities.

    `networks` are those of receivers of notifications that are not public. `stopping` is set before it is closed; long
    work then ends between two transactions.
    """

    database: Database
    files: FileArchive
    home: Path
    stated_data: DataFolder
    runner: Path | None = None
    objects: ObjectStore | None = None
    networks: tuple[IPv4Network | IPv6Network, ...] = ()
    stopping: threading.Event = field(default_factory=threading.Event, compare=False, repr=False)

    def check_stopping(self) -> None:
        """Called by long work where it can be broken off.

        Raises
        ------
        Stopping
            If the service is being stopped.
        """
        if self.stopping.is_set():
            raise Stopping

    def read(
        self,
        work: Callable[Concatenate[Connection, Arguments], Result],
        *given: Arguments.args,
        **named: Arguments.kwargs,
    ) -> Result:
        """Return the result of a function of a store, called in a transaction that reads."""
        with self.database.reading() as connection:
            return work(connection, *given, **named)

    def write(
        self,
        work: Callable[Concatenate[Connection, Arguments], Result],
        *given: Arguments.args,
        **named: Arguments.kwargs,
    ) -> Result:
        """Return the result of a function of a store, called in a transaction that writes."""
        with self.database.writing() as connection:
            return work(connection, *given, **named)

    @contextmanager
    def alone(self, work: str) -> Iterator[None]:
        """Wait until no other thread or process does a piece of work, and keep others out."""
        mine = (self.home, work)
        with _changed:
            while mine in _running:
                self.check_stopping()
                _changed.wait(WAIT_S)
            _running.add(mine)
        try:
            while True:
                with self.database.alone(work) as alone:
                    if alone:
                        yield
                        return
                self.check_stopping()
                time.sleep(WAIT_S)
        finally:
            with _changed:
                _running.discard(mine)
                _changed.notify_all()

    @property
    def data(self) -> DataFolder:
        """Public data products that are available now: those that are mounted later are noticed."""
        root = self.stated_data.root
        return self.stated_data if root is None or not root.is_dir() else find_data(root)

    @property
    def orientation(self) -> Orientation:
        """Lunar orientation of the available data."""
        return _orientation(self.data)

    def __enter__(self) -> Ground:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give the database connections back."""
        self.database.engine.dispose()


def open_ground(
    home: Path,
    data: DataFolder | None = None,
    *,
    database_url: str | None = None,
    runner: Path | None = None,
    objects: ObjectStore | None = None,
    networks: Sequence[str] = (),
) -> Ground:
    """Return the ground service under `home`; its SQLite database is created or upgraded.

    Parameters
    ----------
    home
        Folder of the database, the raw files and the reports; created if missing.
    data
        Public data products; None: the built-in models.
    database_url
        Database URL; None: ``home/linna.db``.
    runner
        Exchange folder of the runner that executes payload builds; None: a local sandbox.
    objects
        Object store that has the files; None: folders under `home`.
    networks
        Networks of receivers of notifications that are not public.
    """
    home = home.expanduser().absolute()
    try:
        make_durable_folder(home)
        keep_private(home, 0o700)
    except OSError as error:
        raise storage_error(error, home) from None
    database = prepare_database(database_url or f"sqlite:///{home / 'linna.db'}")
    keep_private(home / "linna.db", 0o600)
    files = files_of(home, objects)
    if objects is not None:
        make_durable_folder(files.root)
    files.remove_leftovers()
    remove_leftovers(home, UNPACKING)
    listed = tuple(map(ip_network, networks))
    return Ground(database, files, home, data if data is not None else DataFolder(), runner, objects, listed)


def keep_private(path: Path, mode: int) -> None:
    """Remove permissions of group and others that are not in `mode`; log a warning if that is not permitted."""
    try:
        found = stat.S_IMODE(path.stat().st_mode)
        if found & ~mode & 0o077:
            path.chmod(found & mode)
    except FileNotFoundError:
        return
    except OSError:
        log.warning("%s: expected mode %o or less, found %o; run 'chmod %o'", path, mode, found, mode)


def ground_from_settings(settings: Settings) -> Ground:
    """Return the ground service for the settings of the deployment.

    Raises
    ------
    PowerfulRole
        Its database role can change the schema or the audit log, and the settings do not permit that.
    """
    data = find_data(settings.data) if settings.data is not None else DataFolder()
    url = settings.resolved_database_url()
    ground = open_ground(
        settings.home,
        data,
        database_url=url,
        runner=settings.runner_exchange,
        objects=objects_of(settings),
        networks=settings.notify_networks,
    )
    try:
        if not settings.allow_database_owner:
            check_role(ground.database)
    except BaseException:
        ground.close()
        raise
    if settings.redis_url is not None:
        ground.database.listeners.add(Waker(settings.redis_url))
    return ground


def run_apart(function: Callable[Arguments, Result], *given: Arguments.args, **named: Arguments.kwargs) -> Result:
    """Return the result of a function of a module in a process of its own, which takes its memory with it."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(function, *given, **named).result()


@functools.lru_cache(maxsize=4)
def _orientation(data: DataFolder) -> Orientation:
    return default_orientation(data)
