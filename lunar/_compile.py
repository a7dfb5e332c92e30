"""The one door to numba: kernel modules take ``njit`` and ``prange`` from here.

Importing this module imports numba (about half a second), so only kernel modules do it, and the modules that
call kernels import those inside the function that needs them.  Superword-level vectorisation is off in numba
by default and can only be switched on before numba is first imported; it makes the unrolled gravity kernel
several times quicker. Compiled code is kept between runs in the folder of the source, or in the user's cache folder
where that is read-only.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from types import ModuleType
from typing import Any, TypeVar, overload

os.environ.setdefault("NUMBA_SLP_VECTORIZE", "1")

import numba
from numba.core.dispatcher import Dispatcher

__all__ = ["njit", "prange"]

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

    def compiled(source: Function) -> Any:
        kernel = compiler(source)
        _stamp_with_callees(kernel, source)
        return kernel

    return compiled if function is None else compiled(function)


def _stamp_with_callees(kernel: Any, source: Callable[..., Any]) -> None:
    """Make a cached kernel depend on the files of the kernels it may call, not on its own file alone.

    This is the only place of the project that touches private parts of numba; tests/lunar/test_compile.py fails where
    they have changed.

    Numba judges a cached kernel by the age of its own file. A kernel compiled in from another file would go on living
    in it after that file has changed, with arrays laid out for the new one.
    """
    file = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
    if file is None:  # not cached, or another layout of numba's private parts
        return
    files = {source.__code__.co_filename}
    for value in source.__globals__.values():
        members = vars(value).values() if isinstance(value, ModuleType) else (value,)
        files |= {member.py_func.__code__.co_filename for member in members if isinstance(member, Dispatcher)}
    stamps = [os.stat(name) for name in sorted(files)]
    file._source_stamp = tuple((stamp.st_mtime_ns, stamp.st_size) for stamp in stamps)
