"""Crater catalogues that the ground holds, and the one that a mission description names."""

import functools
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, InvalidInput
from ground_service.ground import Ground, run_apart
from ground_service.missions import store
from ground_service.missions.model import HeldCatalogue, Mission
from ground_service.store.files import StoredFile, register_file
from lunar.catalogue import CraterCatalogue, load_catalogue
from lunar.datafolder import DataFolder
from lunar.errors import LunarError

APART_OCTETS = 1 << 20
"""Catalogues of more octets are read in another process."""


def add_catalogue(ground: Ground, stored: StoredFile, name: str, *, actor: str = "local") -> HeldCatalogue:
    """Hold an archived crater catalogue (CSV, plain or gzip), for mission descriptions that name its SHA-256.

    Raises
    ------
    InvalidInput
        It is not a crater catalogue.
    """
    is_large = stored.path.stat().st_size > APART_OCTETS
    craters = run_apart(_craters_in, stored.path) if is_large else _craters_in(stored.path)
    if isinstance(craters, str):
        raise InvalidInput("catalogue", "", "a crater catalogue", craters.replace(str(stored.path), name))
    if not craters:
        raise InvalidInput("catalogue", "", "a crater catalogue", f"{name}: no crater")
    with ground.database.writing() as connection:
        register_file(connection, stored, store.CATALOGUE_KIND, name, utc_now_ns())
        store.set_catalogue_kind(connection, stored.sha256, store.CATALOGUE_KIND)
        audit(connection, actor, "add catalogue", name, {"sha256": stored.sha256, "craters": craters})
        return store.get_catalogue(connection, stored.sha256)


def _craters_in(path: Path) -> int | str:
    """Return the number of craters in a file, or why it is not a catalogue."""
    try:
        return len(load_catalogue(path))
    except LunarError as error:
        return str(error)


def withdraw_catalogue(ground: Ground, sha256: str, *, actor: str) -> None:
    """Withdraw a held catalogue: no description can use it; the audit log and its file are kept.

    Raises
    ------
    Conflict
        A mission description in force names it.
    """
    with ground.database.writing() as connection:
        held = store.get_catalogue(connection, sha256)
        for spacecraft, mission in store.missions_in_force(connection).items():
            if mission.catalogue.sha256 == sha256:
                raise Conflict(f"catalogue {sha256[:16]}: is that of the mission of spacecraft {spacecraft}")
        store.set_catalogue_kind(connection, sha256, store.WITHDRAWN_KIND)
        audit(connection, actor, "withdraw catalogue", held.name, {"sha256": sha256})


def catalogue_of(ground: Ground, mission: Mission) -> CraterCatalogue:
    """Return the catalogue that a mission description names: a held file, or an available public product.

    Raises
    ------
    InvalidInput
        It names none, or none that is available.
    """
    stated = mission.catalogue
    if stated.sha256 is not None:
        path = ground.files.path(stated.sha256)
        if not path.exists() or ground.read(store.is_withdrawn, stated.sha256):
            raise InvalidInput(
                mission.name, "catalogue.sha256", "a catalogue that the ground holds", stated.sha256[:16]
            )
        return replace(read_catalogue(path), source=stated.source or f"catalogue {stated.sha256[:16]}")
    if stated.source is None:
        raise InvalidInput(mission.name, "catalogue", "the source or SHA-256 of a crater catalogue", "neither")
    found = _public(ground.data, stated.source)
    if found is None:
        raise InvalidInput(
            mission.name,
            "catalogue.source",
            "a crater catalogue that is available (linna data fetch, or linna catalogue add FILE and catalogue.sha256)",
            stated.source,
        )
    return found


def listed_craters(ground: Ground, mission: Mission) -> list[CraterCatalogue]:
    """Return the available crater lists: that of a mission, and over the real Moon the largest public one."""
    found = []
    with suppress(InvalidInput):
        found.append(catalogue_of(ground, mission))
    data = ground.data
    path = data.catalogue_lu or data.catalogue_composite or data.catalogue_robbins
    if path is not None and mission.evidence.world not in ("unit-geometry", "procedural"):
        found.append(read_catalogue(path))
    return found


def _public(data: DataFolder, source: str) -> CraterCatalogue | None:
    for path in (data.catalogue_composite, data.catalogue_lu, data.catalogue_robbins):
        if path is not None:
            found = read_catalogue(path)
            if found.source == source:
                return found
    return None


@functools.lru_cache(maxsize=4)
def read_catalogue(path: Path) -> CraterCatalogue:
    """Return the craters of a file whose content does not change."""
    return load_catalogue(path)
