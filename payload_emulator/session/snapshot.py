"""Exact states of simulated objects as octets: arrays keep their views, and large known objects are named only.

Flight software holds views of the memory of its board. A plain pickle would copy each view, and a later fault of the
memory would no longer reach the software.

The file has a line `LINNA exact state, version N, SHA-256 HEX` and a pickle whose checksum this is. The checksum finds
damage; it does not say who wrote the file. The pickle can name only classes that modules of this program define, and
the functions and classes listed here. What remains trusted: it can call the constructors and set the attributes of
these classes with any values, and have modules of this program imported. Keep the file where only the user of the
session can write, and read none that somebody else made.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import re
from collections.abc import Callable, Mapping
from enum import Enum
from pathlib import Path
from types import MappingProxyType, MethodType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray
from lunar.propagation import Trajectory
from payload_emulator.errors import RecordError
from payload_emulator.session.checkpoint import replace_file

VERSION = 3
_HEADER = re.compile(rb"LINNA exact state, version (\d{1,9}), SHA-256 ([0-9a-f]{64})\n")
_EXPECTED = "the exact state of a session (linna emulate --continuous --snapshot)"
_PACKAGES = ("payload_emulator", "lunar", "tmtc")
_NAMED = frozenset(
    {
        (__name__, "_view"),
        (__name__, "_proxy"),
        (__name__, "_state_of"),
        *(("builtins", name) for name in ("set", "frozenset", "bytearray", "complex", "slice", "range")),
        *(("collections", name) for name in ("deque", "Counter", "OrderedDict", "defaultdict")),
        ("numpy", "ndarray"),
        ("numpy", "dtype"),
        *(("numpy._core.multiarray", name) for name in ("_reconstruct", "scalar")),
        ("numpy._core.numeric", "_frombuffer"),
        *(("numpy.random._pickle", name) for name in ("__generator_ctor", "__bit_generator_ctor")),
        ("numpy.random._pcg64", "PCG64"),
        ("numpy.random.bit_generator", "SeedSequence"),
        ("numpy.random.bit_generator", "__pyx_unpickle_SeedSequence"),
    }
)
"""Functions and classes outside of this program that a snapshot may name."""


def pack_snapshot(scenario: str, values: Mapping[str, Any], known: Mapping[str, object]) -> bytes:
    """Return values as octets.

    Parameters
    ----------
    known
        Objects that the reader has, by name: they are not copied.

    Raises
    ------
    RecordError
        A value cannot be kept.
    """
    octets = io.BytesIO()
    try:
        _Pickler(octets, known).dump((scenario, dict(values)))
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        raise RecordError(
            f"state of scenario {scenario}: expected values that can be kept, found {error}"
        ) from None
    document = octets.getvalue()
    header = f"LINNA exact state, version {VERSION}, SHA-256 {hashlib.sha256(document).hexdigest()}\n"
    return header.encode() + document


def unpack_snapshot(octets: bytes, scenario: str, known: Mapping[str, object]) -> dict[str, Any]:
    """Return the values of a snapshot of this program.

    Raises
    ------
    RecordError
        It is damaged, or belongs to another scenario or version.
    """
    header = _HEADER.match(octets)
    if header is None:
        raise RecordError(f"expected {_EXPECTED}, found octets that begin with {octets[:24]!r}")
    if int(header[1]) != VERSION:
        raise RecordError(f"expected version {VERSION} of the exact state, found {int(header[1])}")
    document = octets[header.end() :]
    if hashlib.sha256(document).hexdigest().encode() != header[2]:
        raise RecordError(f"expected {_EXPECTED} with the checksum of line 1, found damage")
    try:
        name, values = _Unpickler(io.BytesIO(document), known).load()
        found = dict(values)
    except Exception as error:  # classes raise whatever they meet in values that are not theirs
        reason = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise RecordError(f"expected {_EXPECTED}, found damage ({reason})") from None
    if name != scenario:
        raise RecordError(f"expected the exact state of scenario {scenario}, found that of {name}")
    return found


def save_snapshot(path: Path, scenario: str, values: Mapping[str, Any], known: Mapping[str, object]) -> None:
    """Replace the file by one with these values, see `pack_snapshot`."""
    replace_file(path, pack_snapshot(scenario, values, known))


def load_snapshot(path: Path, scenario: str, known: Mapping[str, object]) -> dict[str, Any] | None:
    """Return the values of a file; None without a file.

    Raises
    ------
    RecordError
        The file cannot be read or is damaged, or belongs to another scenario or version.
    """
    try:
        octets = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RecordError(f"{path}: expected {_EXPECTED}, found {error.strerror}") from None
    try:
        return unpack_snapshot(octets, scenario, known)
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from None


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, known: Mapping[str, object]) -> None:
        super().__init__(file, protocol=5)
        self._known = {id(value): name for name, value in known.items()}

    def persistent_id(self, obj: object) -> str | None:
        return self._known.get(id(obj))

    def reducer_override(self, obj: object) -> Any:
        if isinstance(obj, MappingProxyType):
            return _proxy, (dict(obj),)
        if isinstance(obj, Enum):
            # The first releases of Python 3.11 name members by getattr, which a snapshot may not call.
            return type(obj), (obj.value,)
        if isinstance(obj, MethodType) and isinstance(obj.__self__, Trajectory):
            return _state_of, (obj.__self__,)
        if not isinstance(obj, np.ndarray) or not isinstance(obj.base, np.ndarray):
            return NotImplemented
        owner = obj.base
        if not owner.flags.c_contiguous or obj.dtype.hasobject:
            return NotImplemented
        offset = obj.__array_interface__["data"][0] - owner.__array_interface__["data"][0]
        return _view, (owner, offset, obj.shape, obj.strides, obj.dtype)


class _Unpickler(pickle.Unpickler):
    """Reads classes of this program and of the arrays only: a file cannot name anything else to be called."""

    def __init__(self, file: io.BytesIO, known: Mapping[str, object]) -> None:
        super().__init__(file)
        self._known = known

    def find_class(self, module_name: str, name: str) -> Any:
        if (module_name, name) in _NAMED:
            return super().find_class(module_name, name)
        if module_name.partition(".")[0] not in _PACKAGES:
            raise pickle.UnpicklingError(f"expected a class of this program, found {module_name}.{name}")
        found = super().find_class(module_name, name)
        # A name with dots reaches what a module imports: the class itself has to be of this module.
        is_class = isinstance(found, type)
        if not is_class or (found.__module__, found.__qualname__) != (module_name, name):
            raise pickle.UnpicklingError(f"expected a class of {module_name}, found {name}")
        return found

    def persistent_load(self, pid: str) -> object:
        if pid not in self._known:
            raise pickle.UnpicklingError(f"unknown object {pid}")
        return self._known[pid]


def _state_of(trajectory: Trajectory) -> Callable[..., FloatArray]:
    return trajectory.state


def _proxy(values: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(values)


def _view(
    owner: NDArray[Any], offset: int, shape: tuple[int, ...], strides: tuple[int, ...], dtype: np.dtype[Any]
) -> NDArray[Any]:
    """Return a view of an array that owns its memory."""
    if dtype.hasobject or owner.dtype.hasobject:
        raise pickle.UnpicklingError("expected a view of numbers, found one of objects")
    return np.ndarray(shape, dtype, buffer=owner.data, offset=offset, strides=strides)
