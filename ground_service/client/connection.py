"""Requests of the client: retries, errors from problem details, streamed bodies and paging."""

from __future__ import annotations

import functools
import inspect
import re
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar, cast, get_args, get_origin, get_type_hints
from urllib.parse import quote

from pydantic import BaseModel, TypeAdapter, ValidationError

from ground_service.errors import GroundError, InvalidInput
from ground_service.http.model import PageOf, Problem

if TYPE_CHECKING:
    import httpx


class ServiceProblem(GroundError):
    """A request without a successful response.

    Attributes
    ----------
    status
        HTTP status; 0 if there was no response.
    problem
        Problem details (RFC 9457) of the response; None if it has none.
    """

    def __init__(self, status: int, detail: str, problem: Problem | None = None) -> None:
        super().__init__(detail)
        self.status = status
        self.problem = problem


class Unreachable(ServiceProblem):
    """No connection to the service, or a connection that broke."""


class NotAuthenticated(ServiceProblem):
    """The service requires a valid token."""


class NotPermitted(ServiceProblem):
    """The role of the user does not permit the operation."""


class NotFound(ServiceProblem):
    """The resource does not exist."""


class Conflict(ServiceProblem):
    """The request contradicts the stored state; `problem.state` is that state where one state is the reason."""


class InvalidRequest(ServiceProblem):
    """The service refused the input."""


class Unavailable(ServiceProblem):
    """The service is busy or cannot store; the same request may succeed later."""


class JobFailed(ServiceProblem):
    """The job of the request failed."""


_KINDS: dict[int, type[ServiceProblem]] = {
    401: NotAuthenticated,
    403: NotPermitted,
    404: NotFound,
    **dict.fromkeys((409, 412), Conflict),
    **dict.fromkeys((400, 413, 415, 422), InvalidRequest),
    **dict.fromkeys((429, 503, 507), Unavailable),
}


def problem_of(response: httpx.Response) -> ServiceProblem:
    """Return the exception for a response that is not a success; its body must have been read."""
    status = response.status_code
    kind = _KINDS.get(status, ServiceProblem)
    absent = {"type": "about:blank", "title": response.reason_phrase, "status": status}
    try:
        problem = Problem.model_validate({**absent, **response.json()}, extra="ignore")
    except (ValueError, TypeError):  # not a problem document: for example the page of a proxy
        return kind(status, f"{response.request.url}: {status} {response.reason_phrase}")
    return kind(status, problem.detail, problem)


API_PREFIX = "/api/v1"

TIMEOUT_S = 120.0
BUSY_S = 120.0
"""Total time for which a request is repeated after a response with Retry-After."""

LONGEST_RETRY_S = 10
ATTEMPTS = 3
"""Number of attempts after broken connections, for requests that may be repeated."""

RECONNECT_S = 0.5
PAGE_LIMIT = 1000
BLOCK_OCTETS = 1 << 18

Method = TypeVar("Method", bound=Callable[..., Any])
Item = TypeVar("Item", bound=BaseModel)
Result = TypeVar("Result")
Value = str | int | float | Sequence[str] | None
"""Value of a query key; None leaves the key out."""

Document = Mapping[str, Any] | BaseModel
Body = Path | bytes | Document


class Connection:
    """A service at `server` (http://host:port), called as the owner of `token`.

    Parameters
    ----------
    transport
        Replaces the network, for a service in this process or for tests.
    """

    def __init__(self, server: str, token: str | None = None, *, transport: httpx.BaseTransport | None = None) -> None:
        if not server.startswith(("http://", "https://")):
            raise InvalidInput("--server", "", "a URL such as http://127.0.0.1:8042", repr(server))
        self._server = server.rstrip("/")
        self._token = token
        self._given = transport

    @cached_property
    def _http(self) -> httpx.Client:
        import httpx

        token = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        return httpx.Client(
            headers={"Accept": "application/json"} | token,
            timeout=TIMEOUT_S,
            transport=self._transport(),
            verify=self._server.startswith("https://"),  # certificates take time to load
        )

    def _transport(self) -> httpx.BaseTransport | None:
        return self._given

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        if "_http" in vars(self):
            self._http.close()

    def _answer(self, kind: Any, verb: str, path: str, *, reads: str = "", **request: Any) -> Any:
        """Return the response to a request as an entity, a list of entities, a listing, or nothing."""
        if kind is type(None):
            self._send(verb, path, **request)
            return None
        item = next(iter(get_args(kind)), None)
        if get_origin(kind) is list:  # in one response, as a page or not
            found = self._validated(PageOf[item] | kind, self._send(verb, path, **request))  # type: ignore[valid-type]
            return found.items if isinstance(found, PageOf) else found
        if get_origin(kind) is not Listing:
            return self._validated(kind, self._send(verb, path, **request))
        query = request["query"]
        return Listing(lambda limit, offset: self._page(reads, item, path, query | {"limit": limit, "offset": offset}))

    def _page(self, reads: str, item: Any, path: str, query: dict[str, Any]) -> PageOf[Any]:
        """Return a page of a list; `reads` is the function of the service that reads it, if one alone does."""
        found: PageOf[Any] = self._validated(PageOf[item], self._send("GET", path, query=query))
        return found

    def _validated(self, kind: Any, response: httpx.Response) -> Any:
        try:
            # A newer service may send further fields.
            return TypeAdapter(kind).validate_json(response.content, extra="ignore")
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise ServiceProblem(
                0, f"{self._server}: expected JSON of a LINNA service, found other: {where or 'body'}: {first['msg']}"
            ) from None

    def _download(self, verb: str, path: str, target: Path, **request: Any) -> None:
        """Write a response to a file in blocks; the file is complete or absent."""
        partial = target.with_name(f".{target.name}.{uuid.uuid4().hex}.partial")
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._send(verb, path, sink=partial, **request)
            partial.replace(target)
        finally:
            partial.unlink(missing_ok=True)

    def _send(
        self,
        method: str,
        path: str,
        *,
        query: Mapping[str, Value] | None = None,
        body: Body | None = None,
        key: str | None = None,
        sink: Path | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> httpx.Response:
        """Return a successful response with its body read, or written to `sink`.

        Responses with Retry-After (the request was not processed) are repeated for `BUSY_S`. After a broken connection
        only safe requests and requests with an idempotency key are repeated: others may have been processed.
        """
        import httpx

        repeatable = method == "GET" or key is not None
        given = dict(headers or {}) | ({} if key is None else {"Idempotency-Key": key})
        if isinstance(body, (bytes, Path)):
            given["Content-Type"] = "application/octet-stream"
        values = {name: value for name, value in (query or {}).items() if value is not None}
        until, attempt = time.monotonic() + BUSY_S, 1
        while True:
            try:
                with _content(body) as content:
                    request = self._http.build_request(
                        method, f"{self._server}{API_PREFIX}{path}", params=values, headers=given, **content
                    )
                    response = self._http.send(request, stream=True)
                    try:
                        _take(response, sink)
                    finally:
                        response.close()
            except (httpx.ConnectError, httpx.ConnectTimeout) as error:
                raise Unreachable(0, f"{self._server}: cannot be reached: {error}") from None
            except httpx.TransportError as error:
                if not repeatable or attempt == ATTEMPTS:
                    text = str(error) or type(error).__name__
                    raise Unreachable(0, f"{self._server}: the connection broke: {text}") from None
                time.sleep(attempt * RECONNECT_S)
                attempt += 1
                continue
            if response.is_success:
                return response
            wait = _retry_after_s(response)
            if wait is None or time.monotonic() + wait > until:
                raise problem_of(response)
            time.sleep(wait)


class Listing(Generic[Item]):
    """A list of the service, fetched page by page as it is iterated."""

    def __init__(self, fetch: Callable[[int, int], PageOf[Item]]) -> None:
        self._fetch = fetch
        self._known: PageOf[Item] | None = None

    def __iter__(self) -> Iterator[Item]:
        offset = 0
        while True:
            page = self._fetch(PAGE_LIMIT, offset)
            yield from page.items
            offset += len(page.items)
            if not page.items or offset >= page.total:
                return

    def page(self, limit: int, offset: int = 0) -> PageOf[Item]:
        """Return up to `limit` items from `offset` on, of any number of pages, and the total."""
        page = self._fetch(min(max(limit, 1), PAGE_LIMIT), offset)
        items = list(page.items)
        while len(items) < limit and offset + len(items) < page.total:
            further = self._fetch(min(limit - len(items), PAGE_LIMIT), offset + len(items)).items
            if not further:
                break
            items += further
        return page.model_copy(update={"items": items, "limit": limit})

    @property
    def total(self) -> int:
        """Number of items now."""
        return self._fetch(1, 0).total


def operation(request: str, body: str | tuple[str, ...] = (), reads: str = "") -> Callable[[Method], Method]:
    """Return a decorator of a method without statements, which then sends the request of an operation.

    Parameters
    ----------
    request
        Verb and path, such as ``GET /passes/{pass_id}``.
    body
        Argument that is the JSON body, or arguments that are its fields; None is left out.
    reads
        Function of the service that reads the list.

    Notes
    -----
    Other arguments are parts of the path, the file to send (`file`), the file to write (`out`), headers (`key`,
    `if_match`) or keys of the query. The annotation of the result states how the response is read.
    """
    verb, path = request.split(" ")
    parts = set(re.findall(r"{(\w+)}", path))

    def decorate(method: Method) -> Method:
        signature = inspect.signature(method)

        @functools.wraps(method)
        def send(self: Connection, *given: Any, **named: Any) -> Any:
            bound = signature.bind(self, *given, **named)
            bound.apply_defaults()
            _, *values = bound.arguments.items()
            arguments = dict(values)
            where = path.format_map({name: quote(str(arguments.pop(name)), safe="") for name in parts})
            options: dict[str, Any] = {}
            if "file" in arguments:
                options["body"] = file = arguments.pop("file")
                if "name" in arguments and arguments["name"] is None and isinstance(file, Path):
                    arguments["name"] = file.name
            elif isinstance(body, str):
                options["body"] = arguments.pop(body)
            elif body:
                fields = {name: arguments.pop(name) for name in body}
                options["body"] = {name: value for name, value in fields.items() if value is not None}
            if "key" in arguments:
                options["key"] = arguments.pop("key") or new_key()
            tag = arguments.pop("if_match", None)
            if tag is not None:
                options["headers"] = {"If-Match": tag}
            out = arguments.pop("out", None)
            if out is not None:
                return self._download(verb, where, out, query=arguments, **options)
            kind = get_type_hints(method)["return"]
            return self._answer(kind, verb, where, reads=reads, query=arguments, **options)

        return cast("Method", send)

    return decorate


class Lazy:
    """Module that is imported when one of its names is used."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self._name), name)


def import_lazily(namespace: dict[str, Any], modules: str) -> None:
    """Add modules of entities under the name of their capability, or of the module if it is not `model`."""
    for name in modules.split():
        namespace[name.removesuffix(".model").rpartition(".")[2]] = Lazy(f"ground_service.{name}")


def new_key() -> str:
    """Return a new idempotency key, so that a request can be repeated after a broken connection."""
    return uuid.uuid4().hex


@contextmanager
def _content(body: Body | None) -> Iterator[dict[str, Any]]:
    """Yield the body as arguments of httpx, which reads a file in blocks while it sends it."""
    if body is None:
        yield {}
    elif isinstance(body, bytes):
        yield {"content": body}
    elif isinstance(body, Path):
        if not body.is_file():
            raise InvalidInput(str(body), "", "a file", "a folder" if body.is_dir() else "nothing there")
        with body.open("rb") as stream:
            yield {"content": stream}
    elif isinstance(body, BaseModel):
        yield {"json": body.model_dump(mode="json", exclude_unset=True)}
    else:
        yield {"json": dict(body)}


def _take(response: httpx.Response, sink: Path | None) -> None:
    if sink is None or not response.is_success:
        response.read()
        return
    with sink.open("wb") as file:
        for block in response.iter_bytes(BLOCK_OCTETS):
            file.write(block)


def _retry_after_s(response: httpx.Response) -> float | None:
    """Return the time after which a request that was not processed may be repeated; None for other responses."""
    text = response.headers.get("Retry-After", "")
    if response.status_code not in (429, 503) or not text.isdigit():
        return None
    return float(min(int(text), LONGEST_RETRY_S))
