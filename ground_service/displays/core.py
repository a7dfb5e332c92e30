"""Authors inside stored objects: set from the sessions of those who stored them, never from the documents."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

_AUTHORS = ("createdBy", "createdByRole", "modifiedBy", "modifiedByRole")

Document = dict[str, Any]


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
