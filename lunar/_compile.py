"""The one door to numba: kernel modules take ``njit`` and ``prange`` from here.

Importing this module imports numba (about half a second), so only kernel modules do it, and the modules that
call kernels import those inside the function that needs them.  Superword-level vectorisation is off in numba
by default and can only be switched on before numba is first imported; it makes the unrolled gravity kernel
several times quicker. Compiled code is kept between runs beside the source, or in the user's cache folder
where that is read-only.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar, overload

os.environ.setdefault("NUMBA_SLP_VECTORIZE", "1")

import numba
from numba.core import cgutils, types
from numba.extending import intrinsic

__all__ = ["cgutils", "intrinsic", "njit", "prange", "types"]

Function = TypeVar("Function", bound=Callable[..., Any])

prange: Any = numba.prange


@overload
def njit(function: Function, /) -> Function: ...
@overload
def njit(**options: Any) -> Callable[[Function], Function]: ...
def njit(function: Function | None = None, /, **options: Any) -> Any:
    """Return ``function`` compiled on first call and cached on disk; options as for ``numba.njit``."""
    options.setdefault("cache", True)
    compiler = numba.njit(**options)
    return compiler if function is None else compiler(function)
