"""Reference ephemerides: uploaded, versioned by content, chosen by precedence and coverage."""

from __future__ import annotations

import functools
from pathlib import Path

from sqlalchemy import Connection

from ground_service.access.service import LOCAL_CALLER, Caller, audit
from ground_service.clock import utc_now_ns
from ground_service.errors import Forbidden, InvalidInput
from ground_service.events import EphemerisAdded, publish
from ground_service.ground import Ground
from ground_service.missions.ephemerides import store
from ground_service.missions.ephemerides.model import Ephemeris
from ground_service.missions.store import missions_in_force
from ground_service.store.files import StoredFile, register_file
from ground_service.store.vehicles import hold
from lunar.comparison import check_gravity
from lunar.ephemeris import Ephemeris as States
from lunar.errors import LunarError, UnmovedByGravity
from lunar.messages.ephemeris_files import load_ephemeris


def add_ephemeris(
    ground: Ground,
    stored: StoredFile,
    *,
    name: str,
    precedence: int = 0,
    actor: str = "local",
    caller: Caller = LOCAL_CALLER,
) -> Ephemeris:
    """Enter an archived ephemeris file as a reference ephemeris; the same file again gives the same entry.

    Raises
    ------
    InvalidInput
        If the file cannot be read as an ephemeris, gravity does not move its states, or it is that of an object that no
        mission description names.
    Forbidden
        If it is that of an object of another mission than those of the caller.
    """
    try:
        ephemeris = load_ephemeris(stored.path)
        check_gravity(ephemeris)
    except UnmovedByGravity as error:
        raise InvalidInput("ephemeris", error.where, error.expected, error.found) from None
    except LunarError as error:
        reason = str(error).replace(str(stored.path), name)
        raise InvalidInput("ephemeris", "", "a CCSDS OEM, STK .e or Horizons file", reason) from None
    now = utc_now_ns()
    with ground.database.writing() as connection:
        hold(connection, f"ephemeris {stored.sha256}")
        _check_object(connection, ephemeris.segments[0].object_name, caller)
        register_file(connection, stored, "ephemeris", name, now)
        known = store.find_ephemeris(connection, sha256=stored.sha256, precedence=precedence, name=name)
        if known is not None:
            return known
        added = store.add_ephemeris(
            connection, stored, ephemeris, name=name, precedence=precedence, now_utc_ns=now
        )
        audit(connection, actor, "add ephemeris", name, {"id": added.id, "sha256": stored.sha256})
        publish(
            connection,
            EphemerisAdded(
                id=added.id, start_utc_ns=ephemeris.start_utc_ns, stop_utc_ns=ephemeris.stop_utc_ns
            ),
        )
        return added


def _check_object(connection: Connection, name: str, caller: Caller) -> None:
    missions = missions_in_force(connection)
    owners = [number for number, one in missions.items() if one.spacecraft.is_object(name)]
    if caller.spacecraft is not None and not (owners and caller.may_use(*owners)):
        raise Forbidden(f"{caller.name}: expected an object of the caller's missions, found {name}")
    if missions and not owners:
        names = ", ".join(one.spacecraft.name or "" for one in missions.values())
        expected = f"a spacecraft with a mission description ({names}, or its spacecraft.object_names)"
        raise InvalidInput("ephemeris", "OBJECT_NAME", expected, name)


def withdraw_ephemeris(
    ground: Ground, ephemeris_id: int, *, actor: str, caller: Caller = LOCAL_CALLER
) -> None:
    """Withdraw a reference ephemeris: plans and reports no longer use it; the audit log and its file are kept."""
    with ground.database.writing() as connection:
        if caller.spacecraft is not None:
            _check_object(connection, store.get_ephemeris(connection, ephemeris_id).object_name, caller)
        found = store.withdraw_ephemeris(connection, ephemeris_id)
        audit(
            connection, actor, "withdraw ephemeris", found.name, {"id": ephemeris_id, "sha256": found.sha256}
        )
        publish(
            connection,
            EphemerisAdded(id=found.id, start_utc_ns=found.start.utc_ns, stop_utc_ns=found.stop.utc_ns),
        )


def open_ephemeris(ground: Ground, reference: Ephemeris) -> States:
    """Return the states of a reference ephemeris; callers share one object for each file.

    Raises
    ------
    LunarError
        The file cannot be read.
    """
    return _loaded(str(ground.files.path(reference.sha256)))


@functools.lru_cache(maxsize=8)
def _loaded(path: str) -> States:
    return load_ephemeris(Path(path))
