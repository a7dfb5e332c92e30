"""Requests of the client: retries, problem details, streamed bodies and paging."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, Self, TypeVar, cast

import httpx
from pydantic import BaseModel, TypeAdapter, ValidationError

from ground_service.client.problems import ServiceProblem, Unreachable, problem_of
from ground_service.errors import InvalidInput
from ground_service.http.model import PageOf

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

Model = TypeVar("Model", bound=BaseModel)
Item = TypeVar("Item", bound=BaseModel)
Result = TypeVar("Result")
Value = str | int | float | Sequence[str] | None
"""Value of a query key; None leaves the key out."""

Body = Path | bytes | Mapping[str, Any] | BaseModel


class Connection:
    """A service at `server` (http://host:port), called as the owner of `token`.

    Parameters
    ----------
    transport
        Replaces the network, for a service in this process or for tests.
    """

    def __init__(
        self, server: str, token: str | None = None, *, transport: httpx.BaseTransport | None = None
    ) -> None:
        if not server.startswith(("http://", "https://")):
            raise InvalidInput("--server", "", "a URL such as http://127.0.0.1:8042", repr(server))
        self._server = server.rstrip("/")
        self._http = httpx.Client(
            headers={"Accept": "application/json"} | ({"Authorization": f"Bearer {token}"} if token else {}),
            timeout=TIMEOUT_S,
            transport=transport,
            verify=server.startswith("https://"),  # certificates take time to load
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    # Requests with a typed response

    def _get(self, model: type[Model], path: str, **query: Value) -> Model:
        return self._call(model, "GET", path, query=query)

    def _post(
        self,
        model: type[Model],
        path: str,
        body: Body | None = None,
        *,
        key: str | None = None,
        **query: Value,
    ) -> Model:
        return self._call(model, "POST", path, query=query, body=body, key=key)

    def _call(self, model: type[Model], method: str, path: str, **request: Any) -> Model:
        return self._validated(TypeAdapter(model), self._octets(method, path, **request))

    def _items(
        self, model: type[Item], path: str, body: Mapping[str, Any] | None = None, **query: Value
    ) -> list[Item]:
        """Return the items that a POST request yields."""
        return self._call(_page_type(model), "POST", path, query=query, body=body).items

    def _all(self, model: type[Item], path: str, **query: Value) -> list[Item]:
        """Return a list that the service sends in one response."""
        adapter: TypeAdapter[list[Item]] = TypeAdapter(list[model])  # type: ignore[valid-type] # built at run time
        return self._validated(adapter, self._octets("GET", path, query=query))

    def _list(self, model: type[Item], path: str, *, paged: bool = True, **query: Value) -> Listing[Item]:
        """Return a list; one that is not paged comes in one response."""
        page_type = _page_type(model)

        def fetch(limit: int, offset: int) -> PageOf[Item]:
            span = {"limit": limit, "offset": offset} if paged else {}
            return self._get(page_type, path, **span, **query)

        return Listing(fetch)

    def _octets(self, method: str, path: str, **request: Any) -> bytes:
        return self._send(method, path, **request).content

    def _validated(self, adapter: TypeAdapter[Result], octets: bytes) -> Result:
        try:
            # A newer service may send further fields.
            return adapter.validate_json(octets, extra="ignore")
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise ServiceProblem(
                0,
                f"{self._server}: expected JSON of a LINNA service, found other: {where or 'body'}: {first['msg']}",
            ) from None

    # Streams

    def _download(self, path: str, target: Path, *, body: Body | None = None, **query: Value) -> None:
        """Write a response to a file in blocks; the file is complete or absent."""
        partial = target.with_name(f".{target.name}.{uuid.uuid4().hex}.partial")
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._send("GET" if body is None else "POST", path, query=query, body=body, sink=partial)
            partial.replace(target)
        finally:
            partial.unlink(missing_ok=True)

    # The exchange

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


def _page_type(model: type[Item]) -> type[PageOf[Item]]:
    return cast("type[PageOf[Item]]", PageOf.__class_getitem__(model))


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
