"""Operations of the API: their description, and validation of requests before they run."""

import inspect
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, get_args, get_origin
from urllib.parse import parse_qsl, unquote

from fastapi import APIRouter, Request, Response
from fastapi.dependencies.utils import get_dependant
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket

from ground_service.http.common import API_PREFIX, IDEMPOTENCY_HEADER, IF_MATCH_HEADER
from ground_service.http.limits import refuse
from ground_service.http.model import Paging
from ground_service.http.problems import problem

_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f]")
_SUSPECT = re.compile(rb"\\u(0000|[dD][89abAB])")
QUERY_KEYS_LIMIT = 100


class PlainText:
    """Refusal of paths and queries with control characters, which are unsafe in databases, logs and terminals."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket"):
            query = unquote(query_of(scope).replace("+", " "))
            where = "path" if _CONTROL.search(scope["path"]) else "query" if _CONTROL.search(query) else None
            if where is not None:
                response = problem(422, "invalid request", f"{where}: expected no control characters, found some")
                await refuse(response, scope, receive, send)
                return
        await self._app(scope, receive, send)


class StrictRequest(Request):
    """Request with unambiguous JSON: no NaN, infinite numbers, NUL characters or duplicate keys."""

    async def json(self) -> Any:
        if not hasattr(self, "_json"):
            self._json = parse_json(await self.body())
        return self._json


@dataclass(frozen=True, slots=True)
class QueryKeys:
    """Query keys of an operation: all keys, and the keys that may be repeated."""

    known: frozenset[str]
    lists: frozenset[str]


PROBLEMS = {
    400: "Malformed or incomplete body",
    401: "No valid token",
    403: "The role does not permit it",
    404: "Not found",
    409: "Conflict with the present state, or with an earlier request with the same Idempotency-Key",
    412: "Changed since the version in If-Match",
    413: "Body too large",
    415: "Content-Encoding not supported",
    421: "Host name not served",
    422: "Invalid parameter, body or unknown query key",
    429: "Too many requests; Retry-After tells when to repeat",
    503: "Busy, or the database or archive is unavailable",
    507: "No space left",
}
ALWAYS = (401, 403, 421, 422, 429, 503)
"""Errors of every operation."""


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the description of error responses."""
    return {
        status: {
            "content": {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}},
            "description": PROBLEMS[status],
        }
        for status in statuses
    }


class StrictRoute(APIRoute):
    """Operation that refuses unknown or duplicate query keys, and JSON that `StrictRequest` refuses.

    Its id is the name of the function, its summary the first sentence of the docstring. Errors that follow from
    method, path, body and headers are declared here; an operation declares only further ones (`problems`).
    """

    def __init__(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        summary, _, rest = inspect.cleandoc(endpoint.__doc__ or "").partition("\n\n")
        options["summary"] = " ".join(summary.split()).removesuffix(".")
        options["description"] = rest
        options["operation_id"] = endpoint.__name__
        dependant = get_dependant(path=path, call=endpoint)
        upload = "requestBody" in (options.get("openapi_extra") or {}) and not dependant.body_params
        body = upload or bool(dependant.body_params)
        headers = header_names(dependant)
        derived = {
            400: body,
            404: "{" in path,
            409: IDEMPOTENCY_HEADER in headers,
            412: IF_MATCH_HEADER in headers,
            413: body,
            415: upload,
            507: options.get("methods") not in (["GET"], {"GET"}),
        }
        found = problems(*ALWAYS, *(status for status, applies in derived.items() if applies))
        options["responses"] = {**found, **(options.get("responses") or {})}
        super().__init__(path, endpoint, **options)

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handler = super().get_route_handler()
        keys = query_keys(self.dependant)

        async def strict(request: Request) -> Response:
            check_query(query_of(request.scope), keys)
            return await handler(StrictRequest(request.scope, request.receive))

        return strict


def operations(tag: str) -> APIRouter:
    """Return a router for the operations of a capability."""
    return APIRouter(route_class=StrictRoute, prefix=API_PREFIX, tags=[tag])


def query_keys(dependant: Any) -> QueryKeys:
    """Return the query keys of an operation and its dependencies."""
    fields: dict[str, Any] = {}
    for field in dependant.query_params:
        annotation = field.field_info.annotation
        if isinstance(annotation, type) and issubclass(annotation, Paging):
            fields |= {name: one.annotation for name, one in annotation.model_fields.items()}
        else:
            fields[field.alias] = annotation
    inner = [query_keys(one) for one in dependant.dependencies]
    return QueryKeys(
        frozenset(fields).union(*(one.known for one in inner)),
        frozenset(name for name, one in fields.items() if _is_list(one)).union(*(one.lists for one in inner)),
    )


def header_names(dependant: Any) -> frozenset[str]:
    """Return the headers that an operation and its dependencies read."""
    found = frozenset(field.alias for field in dependant.header_params)
    return found.union(*map(header_names, dependant.dependencies))


def _is_list(annotation: Any) -> bool:
    return get_origin(annotation) is list or any(map(_is_list, get_args(annotation)))


async def query_is_known(socket: WebSocket, *known: str) -> bool:
    """Return whether a WebSocket query has only these keys, each at most once; refuse the handshake if not."""
    try:
        check_query(query_of(socket.scope), QueryKeys(frozenset(known), frozenset()))
    except HTTPException as error:
        response = problem(error.status_code, "invalid request", str(error.detail))
        await refuse(response, socket.scope, socket.receive, socket.send)
        return False
    return True


def query_of(scope: Scope) -> str:
    """Return the query of a request as it was sent."""
    octets: bytes = scope.get("query_string", b"")
    return octets.decode("latin-1")


def check_query(query: str, keys: QueryKeys) -> None:
    """Refuse a query with unknown keys or with a repeated key that has a single value.

    Raises
    ------
    HTTPException
        Status 422; the detail names the nearest known key.
    """
    try:
        pairs = parse_qsl(query, keep_blank_values=True, max_num_fields=QUERY_KEYS_LIMIT)
    except ValueError:
        raise HTTPException(422, f"query: expected at most {QUERY_KEYS_LIMIT} keys, found more") from None
    for key, count in Counter(key for key, _ in pairs).items():
        if key not in keys.known:
            near = get_close_matches(key, sorted(keys.known), 1, 0.5)
            expected = f"{near[0]!r}" if near else f"one of {', '.join(sorted(keys.known)) or 'none'}"
            raise HTTPException(422, f"query: expected {expected}, found {key[:80]!r}")
        if count > 1 and key not in keys.lists:
            raise HTTPException(422, f"query: expected {key!r} once, found it {count} times")


def parse_json(octets: bytes) -> Any:
    """Return the value of a JSON text.

    Raises
    ------
    HTTPException
        Status 422 if a number is not finite, a text has NUL or a lone surrogate, or a key is repeated.
    json.JSONDecodeError, UnicodeDecodeError, RecursionError
        If the text is not JSON, or nested too deeply.
    """
    value = json.loads(octets.decode("utf-8"), parse_constant=_constant, parse_float=_finite, object_pairs_hook=_once)
    if _SUSPECT.search(octets):
        _check_texts(value)
    return value


def _constant(name: str) -> Any:
    raise HTTPException(422, f"body: expected finite numbers, found {name}")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise HTTPException(422, f"body: expected finite numbers, found {text[:40]}")
    return number


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise HTTPException(422, "body: expected each key of an object once, found a duplicate")
    return found


def _check_texts(value: Any) -> None:
    if isinstance(value, str):
        if "\0" in value or any("\ud800" <= character <= "\udfff" for character in value):
            raise HTTPException(422, "body: expected texts without NUL and lone surrogates, found one")
    elif isinstance(value, dict):
        for key, item in value.items():
            _check_texts(key)
            _check_texts(item)
    elif isinstance(value, list):
        for item in value:
            _check_texts(item)
