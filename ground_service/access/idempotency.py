"""Idempotency keys: stored responses, so that a repeated request has no effect and gets the same response.

A key is stored before the work starts. If a crash leaves it without a response, it is unknown whether the work was
done: the key is then refused, and the caller must check the state.
"""

import hashlib
import json
from collections.abc import Callable
from typing import Any, TypeVar

from pydantic import BaseModel

from ground_service.access import store
from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, GroundError, StoreError
from ground_service.ground import Ground

Work = Callable[[], dict[str, Any]]
Added = TypeVar("Added", bound=BaseModel)


def added_once(
    ground: Ground, kind: type[Added], actor: str, key: str | None, given: BaseModel, work: Callable[[], Added]
) -> Added:
    """Return the entity that `work` adds as `once` does; its kind is the operation."""
    answer = once(
        ground,
        actor=actor,
        operation=kind.__name__,
        key=key,
        request=given.model_dump(mode="json"),
        work=lambda: work().model_dump(mode="json"),
    )
    return kind.model_validate(answer, strict=False)


def once(
    ground: Ground, *, actor: str, operation: str, key: str | None, request: dict[str, Any], work: Work
) -> dict[str, Any]:
    """Return the result of `work`, or its earlier result for this actor and key.

    Work that ends with an error leaves the key free: it may be asked for again. Without a key the work is simply done.

    Raises
    ------
    Conflict
        If the key stands for another request, or for one that was begun and whose end is not known.
    """
    if key is None:
        return work()
    identity = _digest([actor, operation, key])
    known = _take(ground, identity, _digest(request))
    if known is not None:
        return known
    try:
        answer = work()
    except StoreError:
        raise  # it may have been done all the same
    except GroundError:
        ground.write(store.free_key, identity)
        raise
    ground.write(store.set_answer, identity, answer)
    return answer


def _take(ground: Ground, identity: str, asked: str) -> dict[str, Any] | None:
    """The answer that is known already; None when the key is now this caller's to use."""
    known = ground.write(store.take_key, identity, asked, utc_now_ns())
    if known is None:
        return None
    if known.request != asked:
        raise Conflict("Idempotency-Key: expected the request that it was first sent with, found another")
    if known.answer is None:
        raise Conflict(
            "Idempotency-Key: the request was begun and its end is not known; look whether it was done, "
            "and use another key if it was not"
        )
    return known.answer


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
