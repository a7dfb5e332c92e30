"""Exact states of simulated objects as octets: arrays keep their views, and large known objects are named only.

Flight software holds views of the memory of its board. A plain pickle would copy each view, and a later fault of the
memory would no longer reach the software.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Mapping
from types import MappingProxyType, MethodType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray
from lunar.propagation import Trajectory
from payload_emulator.errors import RecordError

_VERSION = 1
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
        _Pickler(octets, known).dump((_VERSION, scenario, dict(values)))
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        raise RecordError(
            f"state of scenario {scenario}: expected values that can be kept, found {error}"
        ) from None
    return octets.getvalue()


def unpack_snapshot(octets: bytes, scenario: str, known: Mapping[str, object]) -> dict[str, Any]:
    """Return the values of a snapshot of this program.

    Raises
    ------
    RecordError
        It is damaged, or belongs to another scenario or version.
    """
    try:
        version, name, values = _Unpickler(io.BytesIO(octets), known).load()
    except (ValueError, EOFError, TypeError, AttributeError, ImportError, pickle.UnpicklingError) as error:
        raise RecordError(f"exact state: expected that of a session, found damage ({error})") from None
    if version != _VERSION or name != scenario:
        raise RecordError(f"exact state: expected that of scenario {scenario}, found that of {name}")
    return dict(values)


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, known: Mapping[str, object]) -> None:
        super().__init__(file, protocol=5)
        self._known = {id(value): name for name, value in known.items()}

    def persistent_id(self, obj: object) -> str | None:
        return self._known.get(id(obj))

    def reducer_override(self, obj: object) -> Any:
        if isinstance(obj, MappingProxyType):
            return _proxy, (dict(obj),)
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
        if (module_name, name) not in _NAMED and module_name.partition(".")[0] not in _PACKAGES:
            raise pickle.UnpicklingError(f"expected a class of this program, found {module_name}.{name}")
        found = super().find_class(module_name, name)
        if (module_name, name) not in _NAMED and not isinstance(found, type):
            raise pickle.UnpicklingError(f"expected a class, found {module_name}.{name}")
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
    return np.ndarray(shape, dtype, buffer=owner.data, offset=offset, strides=strides)
