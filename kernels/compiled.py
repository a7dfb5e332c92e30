"""Compiled functions (numba) and their cache on disk; only modules with kernels import this module.

The import takes half a second, so that other modules import kernels inside the functions that call them. Superword-
level vectorisation can only be switched on before the first import of numba; it makes the gravity kernel several
times faster.

A file of the cache is named after the hash of all that its machine code depends on. Processes, clones and versions
of the program share one folder. This is the only place that uses private parts of numba.
"""

import functools
import gc
import hashlib
import importlib
import inspect
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, TypeVar, overload

import numpy as np

os.environ.setdefault("NUMBA_SLP_VECTORIZE", "1")

import numba
from numba.core import event, types
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.types.containers import BaseTuple
from numba.core.types.misc import unliteral

from kernels import cache_folder, keep, kept

__all__ = ["FAST", "compiling_ahead", "njit"]

FAST: dict[str, Any] = {"fastmath": True, "error_model": "numpy", "nogil": True}
"""Options of kernels whose sums may be reordered."""

Function = TypeVar("Function", bound=Callable[..., Any])

_texts: dict[str, str] = {}
_ahead: dict[str, dict[str, tuple[Any, str]]] = {}


@overload
def njit(function: Function, /) -> Function: ...
@overload
def njit(**options: Any) -> Callable[[Function], Function]: ...
def njit(function: Function | None = None, /, *, ahead: str = "", **options: Any) -> Any:
    """Return ``function`` compiled on first call and cached on disk; options as for ``numba.njit``.

    Only kernels call a function whose name begins with ``_``: no entry from Python is compiled for it.  ``ahead``
    has the types with which a flight calls it, in numba's notation, for `compiling_ahead`.
    """

    def compiled(source: Function) -> Any:
        inner = source.__name__.startswith("_")
        kernel = numba.njit(no_cpython_wrapper=inner, no_cfunc_wrapper=True, **options)(source)
        if isinstance(kernel, Dispatcher):  # not with NUMBA_DISABLE_JIT
            kernel.get_call_template = functools.partial(_call_template, kernel)  # type: ignore[method-assign]
            file = source.__code__.co_filename
            _texts[file] = _hash_of_file(file)  # as imported: it may change before the first call
            kernel._cache = _KernelCache(kernel)  # type: ignore[attr-defined]
            if ahead:
                _ahead.setdefault(source.__module__, {})[source.__name__] = kernel, ahead
        return kernel

    return compiled if function is None else compiled(function)


def _call_template(kernel: Any, arguments: Any, named: Any) -> Any:
    """Return what a kernel calls for the types of arguments: the same version for a constant and for a variable."""
    plain = tuple(unliteral(one) for one in arguments)
    return Dispatcher.get_call_template(kernel, plain, {name: unliteral(named[name]) for name in named})


class _Collection(event.Listener):  # type: ignore[misc]
    """Pause of the garbage collection while a kernel compiles: it takes a third of that time and finds little."""

    depth = 0
    was_on = False

    def on_start(self, _: Any) -> None:
        if not self.depth:
            self.was_on = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, _: Any) -> None:
        self.depth -= 1
        if not self.depth and self.was_on:
            gc.enable()


event.register("numba:compile", _Collection())


@contextmanager
def compiling_ahead(groups: Sequence[Sequence[str]], log: Callable[[str], None]) -> Iterator[Callable[[], None]]:
    """Compile the kernels of groups of modules that have no file, each group in a process of its own.

    Yields a function that waits for them and logs how many are done.  A kernel that fails there is compiled on its
    first call, as all are if files cannot be kept.
    """
    counts = [len(_not_kept(group)) for group in groups]
    keep("ahead-", b"")
    total = sum(counts) if kept("ahead-") is not None else 0
    reader, writer = os.pipe()
    code = "import sys; from kernels.compiled import compile_declared; compile_declared(sys.argv[1:])"
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", code, *group],
            stdout=writer,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        for group, count in zip(groups, counts, strict=True)
        if total and count
    ]
    os.close(writer)

    def wait() -> None:
        for done, _ in enumerate(lines, 1):
            log(f"compiling, once: {done} of {total}")

    with os.fdopen(reader) as lines:
        try:
            yield wait
        finally:
            for process in processes:
                process.kill()
                process.wait()


def compile_declared(group: Sequence[str]) -> None:
    """Compile the kernels of modules that have no file, and print a line after each."""
    for kernel, signature in _not_kept(group):
        kernel.compile(signature)
        print(flush=True)


def _not_kept(group: Sequence[str]) -> list[tuple[Any, tuple[Any, ...]]]:
    """Return the declared versions of which there is no file."""
    codegen = cpu_target.target_context.codegen()
    return [
        (kernel, signature)
        for kernel, signature in declared(group)
        if not (cache_folder() / kernel._cache._name(signature, codegen)).exists()
    ]


def declared(group: Sequence[str]) -> Iterator[tuple[Any, tuple[Any, ...]]]:
    """Yield the kernels of modules with the types declared for them; a named tuple stands for its numba type."""
    for module in group:
        importlib.import_module(module)
        for kernel, text in _ahead.get(module, {}).values():
            values = eval(f"[{text}]", {**vars(types), **kernel.py_func.__globals__})
            yield (kernel, tuple(BaseTuple.from_types(v, type(v)) if isinstance(v, tuple) else v for v in values))


class _KernelCache:
    """Cache of one kernel, in numba's terms: one file for each signature and processor, replaced in one piece."""

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel
        self.cache_path = str(cache_folder())

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the compiled version for a signature, or None.

        Code that is complete needs numba's runtime, not its implementations, whose import takes half a second.
        """
        rtsys.initialize(target)
        octets = kept(self._name(signature, target.codegen()))
        return None if octets is None else CompileResult._rebuild(target, *pickle.loads(octets))

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Store a compiled version, unless the folder cannot be written."""
        if compiled.library.has_dynamic_globals or not all(part.can_cache for part in compiled.lifted):
            return
        keep(self._name(signature, compiled.codegen), dumps(compiled._reduce()))

    def flush(self) -> None:
        """Delete nothing: a file never becomes wrong."""

    @functools.cached_property
    def _dependencies(self) -> str:
        """Hash of what determines the machine code apart from signature and processor."""
        versions = (numba.__version__, np.__version__, numba.config.SLP_VECTORIZE)
        return _hash("\n".join([repr(versions), *_parts(self._kernel, set())]))

    def _name(self, signature: Any, codegen: Any) -> str:
        types = [part for one in signature for part in _type_parts(one)]
        key = _hash(repr((types, codegen.magic_tuple(), self._dependencies)))
        return f"{self._kernel.py_func.__name__}-{key}"


def _type_parts(one: Any) -> Iterator[str]:
    """Yield the name of a numba type and the names of the fields of tuples, which are not part of it."""
    yield f"{one} {getattr(one, 'fields', '')}"
    for inner in getattr(one, "types", ()):
        yield from _type_parts(inner)


def _parts(value: Any, seen: set[int]) -> Iterator[str]:
    """Yield texts that differ if kernels compiled with this value may differ; follow the kernels that it calls."""
    if isinstance(value, Dispatcher):
        if id(value) in seen:
            return
        seen.add(id(value))
        function = value.py_func
        yield repr([(name, _ordered(option)) for name, option in sorted(value.targetoptions.items())])
        yield f"{function.__module__} {function.__defaults__}"
        names = set()
        for code in _codes(function.__code__):
            names |= set(code.co_names)
            constants = [one for one in code.co_consts if not isinstance(one, CodeType)]
            yield repr((code.co_code, code.co_exceptiontable, code.co_names, code.co_varnames, constants))
        for used in _used(function, sorted(names)):
            yield from _parts(used, seen)
    elif isinstance(value, np.ndarray):
        yield repr((value.dtype, value.shape, hashlib.sha256(value.tobytes()).hexdigest()))
    elif isinstance(value, tuple):
        yield f"{type(value)} {len(value)}"
        for one in value:
            yield from _parts(one, seen)
    elif not isinstance(value, ModuleType):
        try:  # a class, an intrinsic or a function: all of its file
            file = inspect.getfile(inspect.unwrap(value))
        except TypeError:
            yield repr(value)
        else:
            yield _texts.get(file) or _hash_of_file(file)


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Yield the code of a function and of those inside it."""
    yield code
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _codes(inner)


def _used(function: Any, names: list[str]) -> Iterator[Any]:
    """Yield the values outside a function that it names, also as members of modules."""
    for value in [function.__globals__[name] for name in names if name in function.__globals__]:
        yield value
        if isinstance(value, ModuleType):
            yield from (getattr(value, name) for name in names if hasattr(value, name))
    yield from (cell.cell_contents for cell in function.__closure__ or ())


def _ordered(option: Any) -> Any:
    return sorted(option) if isinstance(option, set | frozenset) else option


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _hash_of_file(name: str) -> str:
    try:
        return hashlib.sha256(Path(name).read_bytes()).hexdigest()
    except OSError:  # not from a file
        return name
