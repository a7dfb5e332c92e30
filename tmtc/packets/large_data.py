"""Large data in parts (PUS service 13): tables, maps and thumbnails cut up for packets, and put together again.

References
----------
ECSS-E-ST-70-41C section 6.13. Downlink parts are TM[13,1..3], uplink parts TC[13,9..11]; part numbers count from 1.
A transfer that fits into one part is sent as its last.
"""

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmtc.errors import ValueRefused

PART_LIMIT = 65_535


@dataclass(frozen=True, slots=True)
class LargeData:
    """A transfer that is complete."""

    transaction: int
    table: int
    octets: bytes


def split(
    octets: bytes, *, transaction: int, table: int | str, part_length: int, link: str = "large_data"
) -> list[tuple[str, dict[str, object]]]:
    """(packet name, values) of every part, to be packed in this order; `link` is `large_data` (down) or `uplink`."""
    if not 1 <= part_length <= PART_LIMIT:
        raise ValueRefused("large data", "part_length", part_length, f"1..{PART_LIMIT} octets")
    count = max(1, -(-len(octets) // part_length))
    if count > PART_LIMIT:
        raise ValueRefused("large data", "octets", f"{len(octets)} octets", f"at most {PART_LIMIT} parts")
    parts: list[tuple[str, dict[str, object]]] = []
    for k in range(count):
        name = "last" if k == count - 1 else "first" if k == 0 else "middle"
        piece = np.frombuffer(octets[k * part_length : (k + 1) * part_length], dtype=np.uint8)
        parts.append(
            (f"{link}_{name}", {"transaction": transaction, "part": k + 1, "table": table, "items": {"octet": piece}})
        )
    return parts


@dataclass(slots=True)
class LargeDataReceiver:
    """Reassembly of parts received in any order, with duplicates.

    Unfinished transfers are kept up to `most_octets` in all; beyond that the one begun first is given up.
    """

    most_octets: int = 64 << 20
    _parts: dict[int, dict[int, bytes]] = field(default_factory=dict)
    _tables: dict[int, int] = field(default_factory=dict)
    _last: dict[int, int] = field(default_factory=dict)
    _kept: int = 0

    def accept(self, name: str, values: Mapping[str, Any]) -> LargeData | None:
        """The transfer that this part completes, if it does; `name` and `values` as the dictionary unpacks them."""
        transaction, number = int(values["transaction"]), int(values["part"])
        if self._tables.get(transaction, values["table"]) != values["table"]:
            # the number is in use again for something else: what was begun under it will not be completed
            self.abort(transaction)
        parts = self._parts.setdefault(transaction, {})
        self._tables[transaction] = int(values["table"])
        octets = np.asarray(values["items"]["octet"], dtype=np.uint8).tobytes()
        self._kept += len(octets) - len(parts.get(number, b""))
        parts[number] = octets
        if name.endswith("_last"):
            self._last[transaction] = number
        last = self._last.get(transaction)
        if last is not None and len(parts) >= last and all(k in parts for k in range(1, last + 1)):
            whole = LargeData(transaction, self._tables[transaction], b"".join(parts[k] for k in range(1, last + 1)))
            self.abort(transaction)
            return whole
        while len(self._parts) > 1 and self._kept > self.most_octets:
            self.abort(next(iter(self._parts)))
        if self._kept > self.most_octets:
            self.abort(transaction)
        return None

    def abort(self, transaction: int) -> None:
        """Forget an unfinished transfer."""
        self._kept -= sum(map(len, self._parts.pop(transaction, {}).values()))
        self._tables.pop(transaction, None)
        self._last.pop(transaction, None)


HEADER = struct.Struct(">IQHH")


@dataclass(frozen=True, slots=True, eq=False)
class Thumbnail:
    """Reduced image of a frame: on-board time in ticks, gray levels (rows, columns)."""

    frame_number: int
    ticks: int
    levels: NDArray[np.uint8]


def pack_thumbnail(thumbnail: Thumbnail) -> bytes:
    """Return the octets of a thumbnail."""
    rows, columns = thumbnail.levels.shape
    head = HEADER.pack(thumbnail.frame_number & 0xFFFFFFFF, thumbnail.ticks, rows, columns)
    return head + zlib.compress(thumbnail.levels.astype(np.uint8).tobytes(), 9)


def unpack_thumbnail(octets: bytes) -> Thumbnail:
    """Return a thumbnail.

    Raises
    ------
    ValueRefused
        The octets are no thumbnail, or their levels are not as many as rows and columns.
    """
    if len(octets) < HEADER.size:
        raise ValueRefused("thumbnail", "header", f"{len(octets)} octets", f"{HEADER.size} octets")
    frame_number, ticks, rows, columns = HEADER.unpack_from(octets)
    wanted = rows * columns
    inflate: Any = zlib.decompressobj()
    try:
        levels = inflate.decompress(octets[HEADER.size :], wanted + 1)
    except zlib.error as error:
        raise ValueRefused("thumbnail", "levels", str(error), "levels compressed with zlib") from None
    if len(levels) != wanted or not inflate.eof:
        raise ValueRefused("thumbnail", "levels", f"{len(levels)} octets", f"{wanted} octets")
    return Thumbnail(frame_number, ticks, np.frombuffer(levels, dtype=np.uint8).reshape(rows, columns))
