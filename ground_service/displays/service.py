"""Stored display objects: kept by version, so that nobody replaces a change that he has not seen."""

from __future__ import annotations

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.displays import store
from ground_service.displays.core import signed
from ground_service.displays.model import OBJECTS_LIMIT, Display, DisplayIn
from ground_service.errors import Conflict, InvalidInput, NotFound
from ground_service.events import DisplayChanged, publish
from ground_service.ground import Ground


def keep_display(ground: Ground, key: str, given: DisplayIn, *, actor: str) -> Display:
    """Store an object: a new one with version 0, else the next version of the one with the given version.

    Authors in its document are those of the previous version and `actor`.

    Raises
    ------
    Conflict
        The stored object has another version.
    InvalidInput
        There are `OBJECTS_LIMIT` objects already.
    NotFound
        The object to be replaced does not exist.
    """
    now = utc_now_ns()
    with ground.database.writing() as connection:
        previous = store.get(connection, key).document if given.version else None
        given = given.model_copy(update={"document": signed(given.document, previous, actor=actor)})
        if given.version == 0:
            total = store.count(connection)
            if total >= OBJECTS_LIMIT:
                raise InvalidInput("display", "", f"at most {OBJECTS_LIMIT} stored objects", str(total))
            done = store.add(connection, key, given, actor=actor, now_utc_ns=now)
        else:
            done = store.replace(connection, key, given, actor=actor, now_utc_ns=now)
        kept = store.get(connection, key)
        if not done:
            raise Conflict(
                f"display {key}: expected version {given.version}, found {kept.version} of {kept.changed_by}"
            )
        detail = {"name": kept.name, "type": kept.type, "version": kept.version}
        audit(connection, actor, "keep display", f"display {key}", detail)
        publish(connection, DisplayChanged(key=key, version=kept.version))
        return kept


def delete_display(ground: Ground, key: str, *, actor: str) -> None:
    """Delete a stored object."""
    with ground.database.writing() as connection:
        if not store.remove(connection, key):
            raise NotFound("display", key)
        audit(connection, actor, "delete display", f"display {key}", {})
        publish(connection, DisplayChanged(key=key))
