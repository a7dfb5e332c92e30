"""`njit` with its compiled code kept on disk."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

_F = TypeVar("_F", bound=Callable[..., Any])


def njit(function: _F) -> _F:
    """Compile on the first call and cache the result next to the module."""
    compiled: _F = numba.njit(cache=True, nogil=True)(function)
    return compiled
