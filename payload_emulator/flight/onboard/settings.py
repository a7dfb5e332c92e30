"""On-board parameters, and settings that survive a reset: a text in two copies, of which the newer whole one counts.

Each half of the memory holds a block: magic `LNST`, generation (u32), length (u32), CRC-32 of generation, length and
content (u32), content (JSON, UTF-8); big-endian. Both are written at every change, one after the other: a reset in the
middle of writing costs that change at most, and flipped bits in one copy cost nothing.
"""

import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from payload_emulator.flight.ports import Memory
from tmtc.dictionary.fields import BY_NAME, Parameter

_MAGIC = b"LNST"
_HEADER = struct.Struct(">4sIII")


class Recovery(IntEnum):
    """State of the settings memory at boot."""

    blank = 0
    whole = 1
    older = 2
    lost = 3


@dataclass(slots=True, eq=False)
class Settings:
    """The settings memory of a board."""

    memory: Memory
    generation: int = 0

    def read(self) -> tuple[Recovery, dict[str, Any]]:
        """The newest whole copy, and whether it was the newest written."""
        found = [self._copy(half) for half in (0, 1)]
        if not self.memory.any():
            return Recovery.blank, {}
        whole = [copy for copy in found if copy is not None]
        if not whole:
            return Recovery.lost, {}
        generation, values = max(whole, key=lambda copy: copy[0])
        self.generation = generation
        intact = len(whole) == 2 and whole[0][1] == whole[1][1]
        return (Recovery.whole if intact else Recovery.older), values

    def write(self, values: Mapping[str, Any]) -> bool:
        """Keep a set of settings; False where it does not fit, in which case the memory stays as it is."""
        content = json.dumps(values, separators=(",", ":")).encode()
        if _HEADER.size + len(content) > self.memory.size // 2:
            return False
        # The copy that is the older one goes first.
        for generation in (self.generation + 1, self.generation + 2):
            half = self._half(generation & 1)
            checked = struct.pack(">II", generation, len(content)) + content
            block = _HEADER.pack(_MAGIC, generation, len(content), zlib.crc32(checked)) + content
            half[: len(block)] = np.frombuffer(block, dtype=np.uint8)
        self.generation += 2
        return True

    def _half(self, which: int) -> Memory:
        size = self.memory.size // 2
        return self.memory[which * size : (which + 1) * size]

    def _copy(self, which: int) -> tuple[int, dict[str, Any]] | None:
        half = self._half(which)
        magic, generation, length, checksum = _HEADER.unpack(half[: _HEADER.size].tobytes())
        if magic != _MAGIC or generation & 1 != which or length > half.size - _HEADER.size:
            return None
        content = half[_HEADER.size : _HEADER.size + length].tobytes()
        if zlib.crc32(struct.pack(">II", generation, length) + content) != checksum:
            return None
        return generation, json.loads(content)


@dataclass(slots=True)
class ParameterStore:
    """Values in force: the defaults and what was changed by telecommand."""

    changed: dict[str, float] = field(default_factory=dict)
    defaults: dict[str, float] = field(default_factory=dict)

    def __getitem__(self, name: str) -> float:
        if name in self.changed:
            return self.changed[name]
        return self.defaults.get(name, BY_NAME[name].default)

    def set(self, parameter: Parameter, value: float) -> None:
        """Put a value in force that the parameter accepts."""
        self.changed[parameter.name] = value

    def restore(self, changed: Mapping[str, float]) -> int:
        """Put kept values in force; how many were refused because this build has other limits or names."""
        good = {
            name: float(value)
            for name, value in changed.items()
            if name in BY_NAME and BY_NAME[name].accepts(float(value))
        }
        self.changed = good
        return len(changed) - len(good)
