"""Errors as RFC 9457 problem details: one handler turns every error of the packages into a status and a document."""

import logging
import re
from difflib import get_close_matches
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from ground_service.errors import (
    BuildNotChecked,
    Conflict,
    EvaluationError,
    FileDamaged,
    Forbidden,
    GroundError,
    InvalidInput,
    NotAuthorised,
    NotFound,
    ObjectsUnavailable,
    PlanConflicts,
    ProviderUnavailable,
    SignInRefused,
    StateConflict,
    StorageFull,
    StorageReadOnly,
    StoreError,
    public_text,
)
from ground_service.toml import keys_at, table_in
from lunar.errors import LunarError
from lunar.errors import MissingLibrary as MissingLunarLibrary
from reports.errors import ReportError
from tmtc.errors import MissingLibrary, TmtcError

log = logging.getLogger(__name__)

_SHOULD = re.compile(r"^(?:Input|String|List|Tuple|Value) should (?:be|have) ")

MEDIA_TYPE = "application/problem+json"

RETRY_AFTER_S = 1


class TooLarge(GroundError):
    """More octets than the service takes."""


class Busy(GroundError):
    """Too many simultaneous requests; the same request may succeed later."""


class BrokenOff(GroundError):
    """Incomplete request body."""


class UnsupportedEncoding(GroundError):
    """Unsupported content encoding of a request body."""


class PreconditionFailed(GroundError):
    """Stored object that differs from the one that the caller read."""


STATUSES: tuple[tuple[type[Exception], int, str], ...] = (
    (Forbidden, 403, "forbidden"),
    (TooLarge, 413, "too large"),
    (BrokenOff, 400, "broken off"),
    (UnsupportedEncoding, 415, "unsupported encoding"),
    (PreconditionFailed, 412, "precondition failed"),
    (NotFound, 404, "not found"),
    (Conflict, 409, "conflict"),
    (InvalidInput, 422, "invalid input"),
    (EvaluationError, 422, "cannot be evaluated"),
    (BuildNotChecked, 503, "build not checked"),
    (NotAuthorised, 401, "not authorised"),
    (SignInRefused, 401, "not authorised"),
    (ProviderUnavailable, 503, "sign-in provider unavailable"),
    (StorageFull, 507, "no space left"),
    (StorageReadOnly, 503, "read-only"),
    (StoreError, 503, "store unavailable"),
    (MissingLibrary, 501, "missing library"),
    (TmtcError, 422, "invalid telemetry"),
    (MissingLunarLibrary, 501, "missing library"),
    (LunarError, 422, "invalid input"),
    (ReportError, 500, "report failed"),
    (GroundError, 400, "bad request"),
)

PUBLIC_TEXTS: tuple[tuple[type[Exception], str], ...] = (
    (StorageFull, "no space left; the data were not stored"),
    (StorageReadOnly, "the archive or the database cannot be written"),
    (FileDamaged, "the content of a stored file has changed"),
    (ObjectsUnavailable, "the object store cannot be reached; the data were not stored"),
    (StoreError, "database unavailable"),
    (BuildNotChecked, "the parameters of the build cannot be checked here, so it was not registered"),
    (Exception, "internal error; see the log of the service"),
)
"""Public text of internal errors, without paths and addresses."""


def problem(status: int, title: str, detail: str, request: Request | None = None, **extra: Any) -> JSONResponse:
    """A problem document."""
    body: dict[str, Any] = {"type": "about:blank", "title": title, "status": status, "detail": detail, **extra}
    if request is not None:
        body["instance"] = request.url.path
    headers = {"WWW-Authenticate": "Bearer"} if status == 401 else None
    return JSONResponse(body, status_code=status, media_type=MEDIA_TYPE, headers=headers)


def busy(detail: str, request: Request | None = None) -> JSONResponse:
    """Return a problem document with Retry-After."""
    response = problem(503, "busy", detail, request)
    response.headers["Retry-After"] = str(RETRY_AFTER_S)
    return response


def _allowed(app: FastAPI, request: Request) -> list[str]:
    """Return the methods of all operations at the path of a request."""
    methods: set[str] = set()
    for route in app.state.operations:
        if route.path_regex.match(request.scope["path"]):
            methods |= set(route.methods or ())
    return sorted(methods)


def _unknown_path(app: FastAPI, request: Request) -> str:
    """Return the path of the operation that is nearest to an unknown path."""
    path = request.url.path
    near = get_close_matches(path, [route.path for route in app.state.operations], n=1)
    such = f" such as {near[0]}" if near else ""
    return f"path: expected an operation of /api/v1/openapi.json{such}, found {path[:80]}"


def _expected(fault: dict[str, Any], request: Request) -> str:
    """Return what was expected of a part of a request, and what was found."""
    if fault["type"] == "missing":
        return "expected a value, found none"
    if fault["type"] == "extra_forbidden":
        body = getattr(request.scope.get("route"), "body_field", None)
        kind = None if body is None else table_in(body.field_info.annotation)
        known = [] if kind is None else keys_at(kind, fault["loc"][1:-1])
        near = get_close_matches(str(fault["loc"][-1]), known, n=1)
        return f"expected {near[0] if near else ', '.join(known) or 'no field'}, found an unknown field"
    if fault["type"] in ("model_attributes_type", "dict_type"):
        return "expected a JSON object, sent with Content-Type: application/json"
    message = str(fault["msg"]).removeprefix("Value error, ")
    message = _SHOULD.sub("expected ", message).replace("String should match pattern", "expected text like")
    value = fault.get("input")
    if "found" in message or not isinstance(value, (str, int, float, bool)):
        return message
    return f"{message}, found {str(value)[:40]!r}"


def install(app: FastAPI) -> None:
    """Make the application answer every error with a problem document."""

    async def known(request: Request, error: Exception) -> JSONResponse:
        if isinstance(error, Busy):
            return busy(str(error), request)
        is_local = getattr(request.app.state, "local_caller", None) is not None
        message = str(error) if is_local else public_text(error)  # the log contains the complete text
        if isinstance(error, PlanConflicts):
            found = [
                {"where": f"window {one.window_id}" if one.window_id else one.kind, "detail": one.detail}
                for one in error.conflicts
            ]
            return problem(409, "conflict", message, request, errors=found)
        if isinstance(error, StateConflict):
            return problem(409, "conflict", message, request, state=error.found)
        status, title = next((s, t) for kind, s, t in STATUSES if isinstance(error, kind))
        if status < 500 or is_local or status == HTTPStatus.NOT_IMPLEMENTED:  # names a library, no path
            return problem(status, title, message, request)
        # The message may contain paths or addresses: it is logged with the id of the request.
        request_id = getattr(request.state, "request_id", None)
        log.error("%s %s: %s", request.method, request.url.path, error, extra={"request_id": request_id})
        detail = next(text for kind, text in PUBLIC_TEXTS if isinstance(error, kind))
        return problem(status, title, detail, request, request_id=request_id)

    async def http(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, HTTPException)
        if error.status_code == 400:  # what the framework says of a body that its JSON reader gives up on
            detail = "body: expected JSON of ordinary depth with numbers of ordinary length, found none"
            return problem(400, "invalid request", detail, request)
        title = HTTPStatus(error.status_code).phrase.lower()
        allowed, detail = ", ".join(_allowed(app, request)), str(error.detail)
        if error.status_code == 405:
            detail = f"method: expected {allowed}, found {request.method}"
        elif error.status_code == 404 and detail == HTTPStatus.NOT_FOUND.phrase:
            detail = _unknown_path(app, request)
        answer = problem(error.status_code, title, detail, request)
        if error.status_code == 405:
            answer.headers["Allow"] = allowed
        return answer

    async def invalid(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, RequestValidationError)
        found = [
            {"where": ".".join(str(part) for part in item["loc"]), "expected": _expected(item, request)}
            for item in error.errors()
        ]
        detail = "; ".join(f"{item['where']}: {item['expected']}" for item in found[:5])
        return problem(422, "invalid request", detail, request, errors=found)

    async def unexpected(request: Request, error: Exception) -> JSONResponse:
        fields = {"request_id": getattr(request.state, "request_id", None)}
        log.exception("%s %s", request.method, request.url.path, exc_info=error, extra=fields)
        return problem(500, "internal error", "internal error; see the log of the service", request)

    for kind in (GroundError, TmtcError, LunarError, ReportError):
        app.add_exception_handler(kind, known)
    app.add_exception_handler(HTTPException, http)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(Exception, unexpected)
