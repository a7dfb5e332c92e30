"""Memory that radiation may change: what is loaded is hashed, checked now and then, and restored from its kept copy."""

from __future__ import annotations

from dataclasses import dataclass, field

from payload_emulator.flight.ports import Board, Memory
from tmtc.tables import table_hash


@dataclass(slots=True, eq=False)
class ProtectedMemory:
    """Regions of working memory, by number of the dictionary's table of tables.

    Attributes
    ----------
    repairs
        Regions restored since boot.
    """

    board: Board
    repairs: int = 0
    _regions: dict[int, Memory] = field(default_factory=dict)
    _hashes: dict[int, int] = field(default_factory=dict)

    def load(self, number: int, octets: bytes, *, keep: bool = True) -> None:
        """Put octets into working memory, and keep a copy that survives resets."""
        if keep and self.board.read_table(number) != octets:
            self.board.write_table(number, octets)
        self._regions[number] = self.board.load(number, octets)
        self._hashes[number] = table_hash(octets)

    def hash_of(self, number: int) -> int:
        """First 32 bits of the SHA-256 of what was loaded, 0 where nothing was."""
        return self._hashes.get(number, 0)

    def damaged(self) -> list[tuple[int, int]]:
        """(region, hash found) of every region that is not what was loaded."""
        found = [(number, table_hash(memory.tobytes())) for number, memory in self._regions.items()]
        return [(number, value) for number, value in found if value != self._hashes[number]]

    def repair(self, number: int) -> bytes | None:
        """Restore a region from its kept copy; its octets, None where that copy is damaged too."""
        octets = self.board.read_table(number)
        if not octets or table_hash(octets) != self._hashes[number]:
            return None
        self._regions[number] = self.board.load(number, octets)
        self.repairs += 1
        return octets

    @property
    def octets(self) -> int:
        """Octets of all regions."""
        return sum(memory.size for memory in self._regions.values())
