"""Authentication of requests, and roles that operations require."""

import functools
import hashlib
import inspect
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from sqlalchemy import Connection
from starlette.concurrency import run_in_threadpool

from ground_service.access.scopes import check_scope
from ground_service.access.service import LOCAL_CALLER, Caller, authenticate
from ground_service.access.store import has_users
from ground_service.errors import Forbidden, NotAuthorised
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
