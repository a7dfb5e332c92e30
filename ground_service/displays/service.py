"""Stored display objects: kept by version, so that nobody replaces a change that he has not seen."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.displays import store
from ground_service.displays.model import OBJECTS_LIMIT, Display, DisplayIn
from ground_service.errors import Conflict, InvalidInput, NotFound
from ground_service.events import DisplayChanged, publish
from ground_service.ground import Ground

_AUTHORS = ("createdBy", "createdByRole", "modifiedBy", "modifiedByRole")
Document = dict[str, Any]


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


def signed(document: Document, previous: Document | None, *, actor: str) -> Document:
    """Return a document with true authors, as Open MCT names them in the object and in entries of notebooks.

    An object inside that states `createdBy` keeps the author that the previous version states under the same `id`;
    without one, `actor` is its author. `modifiedBy` is `actor` where its content differs from the previous version.
    Open MCT shows `createdBy` and `createdByRole` with an entry, so the latter names another user who changed it.
    """
    known = {one["id"]: one for one in _inside(previous) if isinstance(one.get("id"), str)}
    result: Document = {key: _signed(value, known, actor) for key, value in document.items()}
    return _authored(result, previous, actor) if _states_authors(document) else result


def _signed(value: Any, known: dict[str, Document], actor: str) -> Any:
    if isinstance(value, list):
        return [_signed(one, known, actor) for one in value]
    if not isinstance(value, dict):
        return value
    inside = {key: _signed(one, known, actor) for key, one in value.items()}
    if not _states_authors(value):
        return inside
    identifier = value.get("id")
    return _authored(inside, known.get(identifier) if isinstance(identifier, str) else None, actor)


def _states_authors(value: Document) -> bool:
    return any(name in value for name in _AUTHORS)


def _authored(value: Document, before: Document | None, actor: str) -> Document:
    result = _content(value)
    if before is None or "createdBy" not in before:
        return result | {"createdBy": actor} | ({"modifiedBy": actor} if "modifiedBy" in value else {})
    author = before["createdBy"]
    changed_by = before.get("modifiedBy") if result == _content(before) else actor
    result["createdBy"] = author
    if changed_by is not None:
        result["modifiedBy"] = changed_by
    if changed_by not in (None, author):
        result["createdByRole"] = f"changed by {changed_by}"
    return result


def _content(value: Document) -> Document:
    return {key: one for key, one in value.items() if key not in _AUTHORS}


def _inside(value: Any) -> Iterator[Document]:
    if isinstance(value, dict):
        yield value
    for one in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _inside(one)
