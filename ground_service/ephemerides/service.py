"""Reference ephemerides: uploaded, versioned by content, chosen by precedence and coverage."""

from __future__ import annotations

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.ephemerides.model import Ephemeris
from ground_service.errors import InvalidInput
from ground_service.events import EphemerisAdded, publish
from ground_service.ground import Ground
from ground_service.store import repository
from ground_service.store.counters import hold
from ground_service.store.files import StoredFile
from ground_service.store.stored_files import register_file
from lunar.ephemeris_files import load_ephemeris
from lunar.errors import LunarError


def add_ephemeris(
    ground: Ground, stored: StoredFile, *, name: str, precedence: int = 0, actor: str = "local"
) -> Ephemeris:
    """Enter an archived OEM or STK file as a reference ephemeris; the same file again gives the same entry.

    Raises
    ------
    InvalidInput
        If the file cannot be read as an ephemeris.
    """
    try:
        ephemeris = load_ephemeris(stored.path)
    except LunarError as error:
        reason = str(error).replace(str(stored.path), name)
        raise InvalidInput("ephemeris", "", "a CCSDS OEM or STK .e file", reason) from None
    now = utc_now_ns()
    with ground.database.writing() as connection:
        hold(connection, f"ephemeris {stored.sha256}")
        register_file(connection, stored, "ephemeris", name, now)
        known = repository.find(
            connection, repository.EPHEMERIDES, file_sha256=stored.sha256, precedence=precedence, name=name
        )
        if known is not None:
            return _ephemeris(known)
        key = repository.add(
            connection,
            repository.EPHEMERIDES,
            file_sha256=stored.sha256,
            name=name,
            object_name=ephemeris.segments[0].object_name,
            frame=ephemeris.segments[0].frame,
            start_utc_ns=ephemeris.start_utc_ns,
            stop_utc_ns=ephemeris.stop_utc_ns,
            states=sum(len(segment.utc_ns) for segment in ephemeris.segments),
            precedence=precedence,
            created_utc_ns=now,
        )
        audit(connection, actor, "add ephemeris", name, {"id": key, "sha256": stored.sha256})
        publish(
            connection,
            EphemerisAdded(id=key, start_utc_ns=ephemeris.start_utc_ns, stop_utc_ns=ephemeris.stop_utc_ns),
        )
        return _ephemeris(repository.get(connection, repository.EPHEMERIDES, key, "ephemeris"))


def list_ephemerides(ground: Ground, *, limit: int = 100, offset: int = 0) -> tuple[list[Ephemeris], int]:
    """Return a page of the reference ephemerides, newest first, and the total number."""
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.EPHEMERIDES, limit=limit, offset=offset)
    return [_ephemeris(row) for row in page.rows], page.total


def _ephemeris(row: repository.Row) -> Ephemeris:
    return Ephemeris.of(row, sha256=row["file_sha256"])
