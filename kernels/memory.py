"""Memory of processes that run for days: few heaps, and free memory that is given back to the system.

The allocator of glibc keeps a heap for each of many threads, and free memory between blocks in use. Both grow with
changing work without a leak. With another C library nothing is changed.
"""

import ctypes
import functools
import threading
import time
from typing import Any

HEAPS = 2
"""Heaps of a process: threads hold the lock of the interpreter for most of their work and seldom allocate together."""

INTERVAL_S = 20.0
"""Shortest time between two returns of memory, each of which takes some milliseconds."""

_M_ARENA_MAX = -8

_lock = threading.Lock()
_last_s = -INTERVAL_S


def limit_heaps() -> None:
    """Limit the heaps of this process; call it before threads are started."""
    library = _c_library()
    if hasattr(library, "mallopt"):
        library.mallopt(_M_ARENA_MAX, HEAPS)


def give_back() -> bool:
    """Give free memory back to the system, at most once in `INTERVAL_S`; return whether that was done."""
    global _last_s
    with _lock:
        now_s = time.monotonic()
        if now_s - _last_s < INTERVAL_S:
            return False
        _last_s = now_s
    library = _c_library()
    if not hasattr(library, "malloc_trim"):
        return False
    library.malloc_trim(0)
    return True


@functools.cache
def _c_library() -> Any:
    return ctypes.CDLL(None)
