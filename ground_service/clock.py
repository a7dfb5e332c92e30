"""The wall clock of the service, in the one form it is stored in."""

from __future__ import annotations

import time


def utc_now_ns() -> int:
    """Nanoseconds since 1970-01-01T00:00:00 UTC."""
    return time.time_ns()
