"""Exact state of a spacecraft process in a file, from which it goes on as if it had not ended.

The file has two lines, `LINNA spacecraft state, version N, SHA-256 HEX` and a JSON document, and then octets; the
checksum is that of everything after the first line. A number, text or null stands for itself. Every other value is a
list that begins with its kind; a value that occurs again is `["ref", n]`, the n-th of these lists. Octets are numbered:
the last item of the document has their lengths, and equal ones are written once. Arrays keep their views: flight
software holds views of the memory of its board, and a later fault of the memory has to reach it.

Nothing in the file is executed: it names classes of this program, whose attributes are set without a call.
A class or attribute of the state that changes needs a new `VERSION`.
"""

import hashlib
import importlib
import json
import os
import re
import struct
from collections import Counter, OrderedDict, deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from io import BytesIO
from pathlib import Path
from types import MethodType, ModuleType
from typing import Any

import numpy as np

from lunar.propagation import Trajectory
from payload_emulator.errors import RecordError

VERSION = 8
_HEADER = re.compile(rb"LINNA spacecraft state, version (\d{1,9}), SHA-256 ([0-9a-f]{64})\n")
_EXPECTED = "the state of a spacecraft process (linna emulate --live --state)"
_PACKAGES = ("payload_emulator", "lunar", "tmtc")
_PLAIN = (type(None), bool, int, float, str)
_SEQUENCES: dict[str, type] = {one.__name__: one for one in (list, tuple, set, frozenset, dict, Counter, OrderedDict)}
_PLAIN_NEW: object = object.__new__
_MAPPINGS = (dict, Counter, OrderedDict)
_UNSET = object()
_CLOCK = struct.Struct("<q")


def pack_state(scenario: str, values: Mapping[str, Any], known: Mapping[str, object]) -> bytes:
    """Return values as octets.

    Parameters
    ----------
    known
        Objects that the reader has, by name: they are not copied.

    Raises
    ------
    RecordError
        A value is of a kind that cannot be kept.
    """
    writer = _Writer(known)
    root = writer.node(dict(values))
    document = json.dumps([scenario, root, [*map(len, writer.octets)]], separators=(",", ":")).encode()
    body = b"".join([document, b"\n", *writer.octets])
    digest = hashlib.sha256(body).hexdigest()
    return f"LINNA spacecraft state, version {VERSION}, SHA-256 {digest}\n".encode() + body


def unpack_state(octets: bytes, scenario: str, known: Mapping[str, object]) -> dict[str, Any]:
    """Return the values of a state of this program.

    Raises
    ------
    RecordError
        It is damaged, or belongs to another scenario or version.
    """
    header = _HEADER.match(octets)
    if header is None:
        raise RecordError(f"expected {_EXPECTED}, found octets that begin with {octets[:24]!r}")
    if int(header[1]) != VERSION:
        raise RecordError(f"expected version {VERSION} of the state, found {int(header[1])}")
    body = octets[header.end() :]
    if hashlib.sha256(body).hexdigest().encode() != header[2]:
        raise RecordError(f"expected {_EXPECTED} with the checksum of line 1, found damage")
    try:
        document, _, rest = body.partition(b"\n")
        name, root, lengths = json.loads(document)
        found = dict(_Reader(known, rest, lengths).value(root))
    except (ValueError, TypeError, LookupError, AttributeError, ImportError, OverflowError) as error:
        reason = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise RecordError(f"expected {_EXPECTED}, found damage ({reason})") from None
    if name != scenario:
        raise RecordError(f"expected the state of scenario {scenario}, found that of {name}")
    return found


def save_state(path: Path, scenario: str, values: Mapping[str, Any], known: Mapping[str, object]) -> None:
    """Replace the file by one with these values; after a loss of power either the old or the new one is whole."""
    octets = pack_state(scenario, values, known)
    path.parent.mkdir(parents=True, exist_ok=True)
    new_file = path.with_name(path.name + ".new")
    with new_file.open("wb") as stream:
        stream.write(octets)
        stream.flush()
        os.fsync(stream.fileno())
    new_file.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def load_state(path: Path, scenario: str, known: Mapping[str, object]) -> dict[str, Any] | None:
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
        return unpack_state(octets, scenario, known)
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from None


@dataclass(slots=True)
class ClockFile:
    """File of the mission time, which other processes map into memory; without a path, none."""

    path: Path | None
    _map: Any = None

    def write(self, utc_ns: int) -> None:
        """Write the time."""
        if self.path is None:
            return
        if self._map is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # Other processes have mapped the file of an earlier session: it must not become shorter.
            with self.path.open("r+b" if self.path.exists() else "w+b") as file:
                file.write(_CLOCK.pack(utc_ns))
            self._map = np.memmap(self.path, dtype="<i8", mode="r+", shape=(1,))
        self._map[0] = utc_ns


class _Writer:
    """Values to JSON; the order of the numbers of references is that of the lists in the text."""

    def __init__(self, known: Mapping[str, object]) -> None:
        self._known = {id(value): name for name, value in known.items()}
        self._numbers: dict[int, int] = {}
        # A value that is dropped while others are written would give away its id.
        self._kept: list[object] = []
        self._classes: dict[type, tuple[str, list[str]]] = {}
        self.octets: dict[bytes, int] = {}

    def node(self, value: Any) -> Any:
        if type(value) in _PLAIN:
            return value
        if id(value) in self._known:
            return ["known", self._known[id(value)]]
        if id(value) in self._numbers:
            return ["ref", self._numbers[id(value)]]
        self._numbers[id(value)] = len(self._kept)
        self._kept.append(value)
        kind = type(value)
        if kind in self._classes:
            return self._object(value)
        if isinstance(value, Enum):
            return ["enum", _name(kind), self.node(value.value)]
        if kind in (bytes, bytearray):
            return [kind.__name__, self._number_of(bytes(value))]
        if isinstance(value, np.ndarray | np.generic):
            return self._numbers_of(value)
        if kind is deque:
            return ["deque", value.maxlen, *map(self.node, value)]
        if kind in _MAPPINGS:
            return [kind.__name__, *([self.node(key), self.node(one)] for key, one in value.items())]
        if _SEQUENCES.get(kind.__name__) is kind:
            return [kind.__name__, *map(self.node, value)]
        if kind is MethodType and isinstance(value.__self__, Trajectory):
            return ["trajectory", self.node(value.__self__)]
        if kind is np.random.Generator and isinstance(value.bit_generator, np.random.PCG64):
            return ["PCG64", self.node(dict(value.bit_generator.state))]
        if kind is ModuleType and value.__name__.partition(".")[0] in _PACKAGES:
            return ["module", value.__name__]
        if kind.__module__.partition(".")[0] in _PACKAGES and kind.__new__ is _PLAIN_NEW:
            self._classes[kind] = _name(kind), _slots(kind)
            return self._object(value)
        raise RecordError(f"state: expected values that can be kept, found {kind.__name__}")

    def _object(self, value: object) -> list[Any]:
        """Return the attributes of an instance of a class whose slots are known."""
        name, slots = self._classes[type(value)]
        found = [(slot, getattr(value, slot, _UNSET)) for slot in (*slots, *getattr(value, "__dict__", ()))]
        nodes = ([slot, one if type(one) in _PLAIN else self.node(one)] for slot, one in found if one is not _UNSET)
        return ["object", name, *nodes]

    def _numbers_of(self, value: Any) -> list[Any]:
        """Return an array, a view of one, or a number of numpy."""
        if value.dtype.hasobject or value.dtype.fields:
            raise RecordError(f"state: expected arrays of numbers, found one of {value.dtype}")
        if isinstance(value, np.generic):
            return ["number", value.dtype.str, self._number_of(value.tobytes())]
        owner = value.base
        if isinstance(owner, np.ndarray) and owner.flags.forc and not owner.dtype.hasobject:
            offset = value.__array_interface__["data"][0] - owner.__array_interface__["data"][0]
            return ["view", self.node(owner), offset, value.shape, value.strides, value.dtype.str]
        order = "F" if value.flags.fnc else "C"
        return ["array", value.dtype.str, value.shape, order, self._number_of(value.tobytes(order))]

    def _number_of(self, octets: bytes) -> int:
        return self.octets.setdefault(octets, len(self.octets))


class _Reader:
    """JSON to values, which are made without calls of their classes."""

    def __init__(self, known: Mapping[str, object], octets: bytes, lengths: list[int]) -> None:
        self._known = known
        self._made: list[Any] = []
        self._octets = list(map(BytesIO(octets).read, lengths))

    def value(self, node: Any) -> Any:
        if type(node) in _PLAIN:
            return node
        kind, *rest = node
        if kind == "known":
            return self._known[rest[0]]
        if kind == "ref":
            return self._made[rest[0]]
        at = len(self._made)
        self._made.append(None)
        if kind == "object":
            return self._object(at, *rest)
        if kind == "deque":
            made: Any = deque(maxlen=rest[0])
            self._made[at] = made
            made.extend(map(self.value, rest[1:]))
            return made
        if kind in ("list", *(one.__name__ for one in _MAPPINGS)):
            made = self._made[at] = _SEQUENCES[kind]()
            if kind == "list":
                made.extend(map(self.value, rest))
            else:
                for key_node, value_node in rest:
                    key = self.value(key_node)  # before the value: references are numbered in this order
                    made[key] = self.value(value_node)
            return made
        self._made[at] = self._whole(kind, *rest)
        return self._made[at]

    def _whole(self, kind: str, *rest: Any) -> Any:
        """Return a value that cannot contain itself."""
        if kind in ("tuple", "set", "frozenset"):
            return _SEQUENCES[kind](map(self.value, rest))
        if kind == "enum":
            return _class(rest[0], Enum)(self.value(rest[1]))
        if kind in ("bytes", "bytearray"):
            return {"bytes": bytes, "bytearray": bytearray}[kind](self._octets[rest[0]])
        if kind == "trajectory":
            trajectory = self.value(rest[0])
            if not isinstance(trajectory, Trajectory):
                raise ValueError("expected a trajectory")
            return trajectory.state
        if kind == "module":
            return _module(rest[0])
        if kind == "PCG64":
            generator = np.random.Generator(np.random.PCG64(0))
            generator.bit_generator.state = self.value(rest[0])
            return generator
        return self._array(kind, *rest)

    def _array(self, kind: str, *rest: Any) -> Any:
        if kind == "number":
            return np.frombuffer(self._octets[rest[1]], _numeric(rest[0]))[0]
        if kind == "array":
            name, shape, order, octets = rest
            flat = np.frombuffer(self._octets[octets], _numeric(name))
            return np.array(flat.reshape(shape, order=order), order=order)
        if kind != "view":
            raise ValueError(f"unknown kind {kind!r}")
        owner, offset, shape, strides, name = rest
        return np.ndarray(shape, _numeric(name), self.value(owner).data, offset, strides)

    def _object(self, at: int, name: str, *attributes: tuple[str, Any]) -> Any:
        made = _class(name, object)
        one = self._made[at] = object.__new__(made)
        for attribute, node in attributes:
            object.__setattr__(one, attribute, self.value(node))
        return one


def _slots(kind: type) -> list[str]:
    slots = [name for one in kind.__mro__ for name in getattr(one, "__slots__", ())]
    return [name for name in slots if name not in ("__weakref__", "__dict__")]


def _name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _class(name: str, base: type) -> Any:
    """Return a class that a module of this program defines."""
    module_name, _, place = name.partition(":")
    found = getattr(_module(module_name), place)
    if not isinstance(found, type) or not issubclass(found, base) or _name(found) != name:
        raise ValueError(f"expected a class of {module_name}, found {place}")
    return found


def _module(name: str) -> ModuleType:
    """Import a module of this program."""
    if name.partition(".")[0] not in _PACKAGES:
        raise ValueError(f"expected a module of this program, found {name}")
    return importlib.import_module(name)


def _numeric(name: str) -> np.dtype[Any]:
    dtype = np.dtype(name)
    if dtype.hasobject:
        raise ValueError("expected an array of numbers, found one of objects")
    return dtype
