"""Cache of repeated archive queries, invalidated by new data that can change the results."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from sqlalchemy import Connection, Engine

from ground_service.ground import Ground
from ground_service.passes.store import archive_state

KEPT = 64
"""Answers kept of a database."""

LONGEST_OCTETS = 1 << 20
"""Answers in octets longer than that are made each time."""

T = TypeVar("T")

_answers: WeakKeyDictionary[Engine, OrderedDict[Hashable, tuple[Hashable, Any]]] = WeakKeyDictionary()
_lock = threading.Lock()


def remembered(ground: Ground, connection: Connection, key: Hashable, make: Callable[[], T]) -> T:
    """What `make` gives with `connection`, made again only when packets, ingests, decodings or correlations are new.

    What is stored while `make` reads is a newer state than the one noted, so that it is made again the next time.
    """
    state = archive_state(connection)
    engine = ground.database.engine
    with _lock:
        known = _answers.setdefault(engine, OrderedDict())
        found = known.get(key)
        if found is not None and found[0] == state:
            known.move_to_end(key)
            return found[1]  # type: ignore[no-any-return]
    made = make()
    if isinstance(made, bytes) and len(made) > LONGEST_OCTETS:
        return made
    with _lock:
        known[key] = (state, made)
        known.move_to_end(key)
        while len(known) > KEPT:
            known.popitem(last=False)
    return made
