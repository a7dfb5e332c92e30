"""SQL of stored display objects."""

from __future__ import annotations

import json
from typing import Any

from sqlalchemy import Connection, delete, func, select, update

from ground_service.displays.model import Display, DisplayIn, DisplaySummary, packed
from ground_service.errors import NotFound
from ground_service.http.model import PageOf, Paging
from ground_service.store import models, repository
from ground_service.store.repository import add_new

_OBJECTS = models.DISPLAY_OBJECTS
_LISTED = [column for column in _OBJECTS.c if column.name != "document"]


def count(connection: Connection) -> int:
    """Return the number of stored objects."""
    return int(connection.execute(select(func.count()).select_from(_OBJECTS)).scalar_one())


def list_displays(connection: Connection, asked: Paging) -> PageOf[DisplaySummary]:
    """List the stored objects of the telemetry displays, the one that changed last first."""
    order = (_OBJECTS.c.changed_utc_ns.desc(), _OBJECTS.c.key)
    rows, total = repository.page(connection, select(*_LISTED), asked, *order)
    return asked.page(map(DisplaySummary.of, rows), total)


def get(connection: Connection, key: str) -> Display:
    """Return a stored object."""
    row = connection.execute(select(_OBJECTS).where(_OBJECTS.c.key == key)).mappings().first()
    if row is None:
        raise NotFound("display", key)
    return Display.of(row, document=json.loads(row["document"]))


def add(connection: Connection, key: str, given: DisplayIn, *, actor: str, now_utc_ns: int) -> bool:
    """Add an object as version 1; return False if the key is in use."""
    values = _values(given, actor, now_utc_ns) | {"created_by": actor, "created_utc_ns": now_utc_ns}
    return add_new(connection, _OBJECTS, key=key, version=1, **values) is not None


def replace(connection: Connection, key: str, given: DisplayIn, *, actor: str, now_utc_ns: int) -> bool:
    """Replace a version of an object by the next one; return False if that version is not the current one."""
    where = (_OBJECTS.c.key == key, _OBJECTS.c.version == given.version)
    values = _values(given, actor, now_utc_ns) | {"version": given.version + 1}
    return connection.execute(update(_OBJECTS).where(*where).values(**values)).rowcount == 1


def remove(connection: Connection, key: str) -> bool:
    """Delete an object; return False if there is none."""
    return connection.execute(delete(_OBJECTS).where(_OBJECTS.c.key == key)).rowcount == 1


def _values(given: DisplayIn, actor: str, now_utc_ns: int) -> dict[str, Any]:
    document = packed(given.document)
    return {
        "name": given.name,
        "type": given.type,
        "document": document,
        "octets": len(document.encode()),
        "changed_by": actor,
        "changed_utc_ns": now_utc_ns,
    }
