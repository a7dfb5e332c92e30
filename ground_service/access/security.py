"""Authentication of requests, roles that operations require, and idempotency keys."""

import functools
import hashlib
import inspect
import json
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Depends, Query, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic import BaseModel
from sqlalchemy import Connection
from starlette.concurrency import run_in_threadpool

from ground_service.access import store
from ground_service.access.scopes import check_scope
from ground_service.access.service import LOCAL_CALLER, Caller, authenticate
from ground_service.access.store import has_users
from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, Forbidden, GroundError, NotAuthorised, StoreError
from ground_service.ground import Ground
from ground_service.http.common import GroundOf, linked
from ground_service.http.model import PageOf
from ground_service.http.uploads import Upload, UploadPool

SESSION_COOKIE = "linna_session"
"""Cookie of a browser session. Requests that change data with it must show their origin (`http.origins`)."""

_bearer = HTTPBearer(auto_error=False, description="Token issued by 'linna user add'")


def caller_of(request: Request, given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]) -> Caller:
    """Return the owner of the token or session cookie of a request; the local user of a service without users."""
    local: Caller | None = getattr(request.app.state, "local_caller", None)
    if local is not None:
        return local
    ground = request.app.state.ground
    token = given.credentials if given is not None else request.cookies.get(SESSION_COOKIE)
    if token is None:
        if request.app.state.open_without_users and not ground.read(has_users):
            request.state.caller = LOCAL_CALLER.name
            return LOCAL_CALLER
        raise NotAuthorised("expected a bearer token in the Authorization header, found none")
    caller = authenticate(ground, token)
    request.state.caller = caller.name
    return caller


def requires(role: str) -> Callable[..., Coroutine[Any, Any, Caller]]:
    """Return a dependency that rejects callers without this role or a higher one, or for other spacecraft."""

    async def check(request: Request, caller: Annotated[Caller, Depends(caller_of)]) -> Caller:
        if not caller.may(role):
            raise Forbidden(f"{caller.name}: expected the role {role} or higher, found {caller.role}")
        if caller.missions is not None:
            await run_in_threadpool(check_scope, request, caller)
        return caller

    return check


Viewer = Annotated[Caller, Depends(requires("viewer"))]
Operator = Annotated[Caller, Depends(requires("operator"))]
Admin = Annotated[Caller, Depends(requires("admin"))]


def add_list(router: APIRouter, path: str, work: Callable[[Connection, Any], PageOf[Any]]) -> None:
    """Add the operation of a list: the name, docstring, filter and entity of the function that reads it.

    A client in process calls the function without HTTP.
    """
    signature = inspect.signature(work, eval_str=True)
    asked = list(signature.parameters.values())[1].annotation

    def endpoint(ground: GroundOf, request: Request, asked: Any, caller: Caller) -> PageOf[Any]:
        with ground.database.reading() as connection:
            connection.execution_options(spacecraft=caller.spacecraft)
            return linked(request, work(connection, asked))

    keyword = inspect.Parameter.KEYWORD_ONLY
    kinds = {"ground": GroundOf, "caller": Viewer, "request": Request, "asked": Annotated[asked, Query()]}
    parameters = [inspect.Parameter(name, keyword, annotation=kind) for name, kind in kinds.items()]
    endpoint.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    functools.update_wrapper(endpoint, work, ("__name__", "__doc__"), ())
    router.add_api_route(path, endpoint, methods=["GET"])


async def upload_of(request: Request, _: Operator) -> AsyncIterator[Upload]:
    """Yield an upload slot for a request whose caller may upload."""
    pool: UploadPool = request.app.state.uploads
    async with pool.place():
        yield Upload(request, pool)


UploadOf = Annotated[Upload, Depends(upload_of)]


def idempotent_id(what: str, caller: Caller, key: str | None) -> str | None:
    """Return the job id for an idempotency key of this caller; None without a key."""
    if key is None:
        return None
    return hashlib.sha256(f"{caller.name}\0{what}\0{key}".encode()).hexdigest()[:32]


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
