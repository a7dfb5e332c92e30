"""Logs of the service: one line an entry, as text or as JSON objects that a log store can read."""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime
from typing import Any

from ground_service.tracing import trace_id

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
        "handlers": {
            "stderr": {"class": "logging.StreamHandler", "formatter": "line", "stream": "ext://sys.stderr"}
        },
        "root": {"handlers": ["stderr"], "level": "INFO"},
        "loggers": {
            # Requests are counted and logged by `ground_service.worker.metrics`, with their times.
            "uvicorn.access": {"level": "WARNING"},
            # It would log the addresses of webhooks, which may contain a password or a token.
            "httpx": {"level": "WARNING"},
        },
    }
