"""Logs and traces of the service: one line an entry, as text or as JSON objects that a log store can read."""

from __future__ import annotations

import json
import logging
import os
import re
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from opentelemetry.sdk.trace.export import SpanExporter
    from opentelemetry.trace import Tracer


_TRACEPARENT = re.compile(r"00-(?!0{32})([0-9a-f]{32})-(?!0{16})[0-9a-f]{16}-[0-9a-f]{2}")

_current: ContextVar[str | None] = ContextVar("traceparent", default=None)
_tracers: dict[int, Tracer] = {}
"""Tracer of this process by process id: a forked process needs one of its own."""


def current() -> str | None:
    """Return the `traceparent` of the running step; None outside of any."""
    return _current.get()


def trace_id() -> str | None:
    """Return the id of the running trace; None outside of any."""
    return trace_id_of(_current.get())


def trace_id_of(traceparent: str | None) -> str | None:
    """Return the trace id in a `traceparent`; None if there is none or it is invalid."""
    found = _TRACEPARENT.fullmatch(traceparent or "")
    return None if found is None else found.group(1)


@contextmanager
def span(
    name: str, *, parent: str | None = None, attributes: Mapping[str, Any] | None = None
) -> Iterator[dict[str, Any]]:
    """Run a step of a trace; yield a dictionary for further attributes (`name` in it renames the step).

    Parameters
    ----------
    parent
        `traceparent` of the step that caused this one; None or invalid: the running step, or a new trace.
    """
    before = parent if trace_id_of(parent) is not None else _current.get()
    tracer = _tracers.get(os.getpid())
    further: dict[str, Any] = {}
    if tracer is None:
        token = _current.set(f"00-{trace_id_of(before) or secrets.token_hex(16)}-{secrets.token_hex(8)}-00")
        try:
            yield further
        finally:
            _current.reset(token)
        return
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    context = TraceContextTextMapPropagator().extract({"traceparent": before} if before else {})
    with tracer.start_as_current_span(name, context=context, attributes=attributes) as one:
        made = one.get_span_context()
        token = _current.set(f"00-{made.trace_id:032x}-{made.span_id:016x}-{made.trace_flags:02x}")
        try:
            yield further
        finally:
            _current.reset(token)
            one.update_name(further.pop("name", name))
            one.set_attributes(further)


def configure(endpoint: str | None, *, exporter: SpanExporter | None = None) -> None:
    """Send the spans of this process to a collector; a repeated call, and one without an endpoint, changes nothing.

    Parameters
    ----------
    endpoint
        URL of an OpenTelemetry collector, OTLP over HTTP.
    exporter
        Destination in place of the collector, which gets each span at its end.

    Raises
    ------
    ModuleNotFoundError
        If OpenTelemetry is not installed (extra `traces`).
    """
    if os.getpid() in _tracers or (endpoint is None and exporter is None):
        return
    from opentelemetry.sdk.resources import Resource
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import BatchSpanProcessor, SimpleSpanProcessor

    provider = TracerProvider(resource=Resource.create({"service.name": "linna"}))
    if exporter is not None:
        provider.add_span_processor(SimpleSpanProcessor(exporter))
    else:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter

        provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter(endpoint=endpoint)))
    _tracers[os.getpid()] = provider.get_tracer("linna")


def stop() -> None:
    """Send no more spans from this process."""
    _tracers.pop(os.getpid(), None)


_OWN = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName", "color_message"}


class LineFormatter(logging.Formatter):
    """An entry as one line, and the traceback if any; other control characters are escaped.

    A message contains what clients sent, such as decoded paths: it must neither look like another entry nor change the
    state of a terminal.
    """

    def formatMessage(self, record: logging.LogRecord) -> str:
        record.message = _escaped(record.message)
        return super().formatMessage(record)

    def formatException(self, ei: Any) -> str:
        return "\n".join(_escaped(line) for line in super().formatException(ei).split("\n"))


class JsonFormatter(logging.Formatter):
    """An entry as one JSON object: time, level, logger, message, trace id, `extra` values, and the traceback if any."""

    def format(self, record: logging.LogRecord) -> str:
        entry: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if (trace := trace_id()) is not None:
            entry["trace_id"] = trace
        entry.update({key: value for key, value in vars(record).items() if key not in _OWN})
        if record.exc_info:
            entry["trace"] = self.formatException(record.exc_info)
        return json.dumps(entry, default=str).replace("\x7f", "\\u007f")


def _escaped(text: str) -> str:
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text)


def logging_config(style: str) -> dict[str, Any]:
    """A configuration of `logging` for the service and its HTTP server; `style` is text or json."""
    formatter = (
        {"()": f"{__name__}.JsonFormatter"}
        if style == "json"
        else {"()": f"{__name__}.LineFormatter", "format": "%(asctime)s %(levelname)s %(name)s: %(message)s"}
    )
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"line": formatter},
        "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "line", "stream": "ext://sys.stderr"}},
        "root": {"handlers": ["stderr"], "level": "INFO"},
        "loggers": {
            # Requests are counted and logged by `ground_service.worker.metrics`, with their times.
            "uvicorn.access": {"level": "WARNING"},
            # It would log the addresses of webhooks, which may contain a password or a token.
            "httpx": {"level": "WARNING"},
        },
    }
