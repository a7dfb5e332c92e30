"""What every service needs: the database, the archive of files and the public data products at hand."""

from __future__ import annotations

import functools
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ground_service.errors import Stopping, storage_error
from ground_service.store.database import Database, prepare_database
from ground_service.store.files import FileArchive
from lunar.datafolder import DataFolder, default_gravity, default_orientation, find_data

if TYPE_CHECKING:
    from ground_service.settings import Settings
    from lunar.frames import Orientation
    from lunar.gravity import GravityField


@dataclass(frozen=True, slots=True)
class Ground:
    """An opened ground service: pass it to the functions of `ground_service.services`.

    Whoever is about to close it sets `stopping`; long work then ends between two transactions.
    """

    database: Database
    files: FileArchive
    home: Path
    data: DataFolder
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

    @property
    def orientation(self) -> Orientation:
        """The lunar orientation of the data at hand."""
        return _orientation(self.data)

    @property
    def gravity(self) -> GravityField:
        """The gravity field of the data at hand."""
        return _gravity(self.data)

    @property
    def other_gravity(self) -> GravityField | None:
        """An independent gravity field, where the data at hand hold one."""
        return _other_gravity(self.data)

    def __enter__(self) -> Ground:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give the database connections back."""
        self.database.engine.dispose()


def open_ground(home: Path, data: DataFolder | None = None, *, database_url: str | None = None) -> Ground:
    """The ground service under `home`, its SQLite database created or brought up to date there.

    Parameters
    ----------
    home
        Folder of the database, the raw files and the reports; made when it does not exist.
    data
        Public data products; none means the built-in models.
    database_url
        Another database than ``home/linna.db``.
    """
    home = home.expanduser().absolute()
    try:
        home.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(error, home) from None
    database = prepare_database(database_url or f"sqlite:///{home / 'linna.db'}")
    return Ground(database, FileArchive(home / "files"), home, data if data is not None else DataFolder())


def ground_from_settings(settings: Settings) -> Ground:
    """The ground service that the deployment's settings describe."""
    data = find_data(settings.data) if settings.data is not None else DataFolder()
    return open_ground(settings.home, data, database_url=settings.resolved_database_url())


@functools.lru_cache(maxsize=4)
def _orientation(data: DataFolder) -> Orientation:
    return default_orientation(data)


@functools.lru_cache(maxsize=4)
def _other_gravity(data: DataFolder) -> GravityField | None:
    from lunar.gravity import load_gravity

    return load_gravity(data.gravity_alternative) if data.gravity_alternative is not None else None


@functools.lru_cache(maxsize=4)
def _gravity(data: DataFolder) -> GravityField:
    return default_gravity(data)
