"""Telemetry of the payload: packets of the dictionary with their counts, into the store; events as they are wanted."""

import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray
from payload_emulator.flight.telemetry.store import PacketStore, StoreClass
from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import TmtcError
from tmtc.packets.large_data import Thumbnail, pack_thumbnail
from tmtc.packets.space_packets import PacketSequencer, unpack_primary_header

_CLASSES = {
    "detections": StoreClass.detections,
    "navigation_state": StoreClass.navigation,
    "frame_outcome": StoreClass.navigation,
    "filter_estimate": StoreClass.navigation,
    "identifications": StoreClass.navigation,
    "landmarks": StoreClass.navigation,
    "large_data_first": StoreClass.bulk,
    "large_data_middle": StoreClass.bulk,
    "large_data_last": StoreClass.bulk,
}
_CRITICAL_SERVICES = (1, 5)
_EVENT_CODES = {name: code for code, name in DICTIONARY.labels("event_info", "event_id").items()}
_SEQUENCE_LIMIT = 1 << 14


@dataclass(slots=True, eq=False)
class Telemetry:
    """The sending side of the payload.

    Attributes
    ----------
    ticks, frame_number
        On-board time of this step, and the frame it looks at.
    disabled
        Codes of events that are not to be reported.
    counts
        `packets` and `events` since boot.
    """

    store: PacketStore
    ticks: int = 0
    frame_number: int = 0
    disabled: set[int] = field(default_factory=set)
    counts: Counter[str] = field(default_factory=Counter)
    _sequencer: PacketSequencer = field(default_factory=PacketSequencer)
    _messages: Counter[tuple[int, int]] = field(default_factory=Counter)

    def send(self, name: str, values: Mapping[str, object]) -> None:
        """Make a packet and put it into the store."""
        definition = DICTIONARY.packet(name)
        kind = (definition.service, definition.subtype)
        packet = DICTIONARY.pack(
            name,
            values,
            ticks=max(self.ticks, 0),
            sequence_count=self._sequencer.next(definition.apid),
            message_counter=self._messages[kind] & 0xFFFF,
        )
        self._messages[kind] += 1
        self.counts["packets"] += 1
        default = StoreClass.critical if definition.service in _CRITICAL_SERVICES else StoreClass.housekeeping
        self.store.append(packet, _CLASSES.get(name, default))

    def event(self, severity: str, event: str, value_1: float = 0.0, value_2: float = 0.0) -> None:
        """Report an event of a severity (`info`, `low`, `medium`, `high`), unless it is disabled."""
        if _EVENT_CODES[event] in self.disabled:
            return
        self.counts["events"] += 1
        self.send(
            f"event_{severity}",
            {"event_id": event, "frame_number": self.frame_number, "value_1": value_1, "value_2": value_2},
        )

    def resume(self) -> tuple[int, int]:
        """Go on with the counts of the packets in the store; (next frame number, newest time) as far as it tells."""
        newest_ticks, frame_number = -1, -1
        seen: set[int] = set()
        for packet in self.store.newest():
            header = unpack_primary_header(packet)
            newest_ticks = max(newest_ticks, int.from_bytes(packet[14:20], "big"))
            if header.apid not in seen:
                seen.add(header.apid)
                self._sequencer.counts[header.apid] = (header.sequence_count + 1) % _SEQUENCE_LIMIT
            if frame_number < 0:
                frame_number = _frame_of(packet)
        self.frame_number = frame_number + 1
        return self.frame_number, newest_ticks


def _frame_of(packet: bytes) -> int:
    """The frame that a detections packet is about, -1 for any other packet."""
    try:
        name, values = DICTIONARY.unpack(packet)
    except TmtcError:
        return -1
    found: Any = values["frame_number"] if name == "detections" else -1
    return int(found)


_LANDMARK = np.dtype([("crater_id", ">u4"), ("frames", ">u2")])


def thumbnail_octets(image: NDArray[Any], factor: int, frame_number: int, ticks: int) -> bytes:
    """The image in gray, averaged over squares of `factor` pixels; edges that fill no square are left out.

    Integer levels are scaled to 8 bits, fractions to 0..255.
    """
    gray = image.astype(np.float64)
    gray = gray.mean(axis=2) if gray.ndim == 3 else gray
    full = float(np.iinfo(image.dtype).max) if image.dtype.kind in "ui" else 1.0
    rows, columns = (size // factor for size in gray.shape)
    squares = gray[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
    levels = np.nan_to_num(squares.mean(axis=(1, 3)) * (255.0 / full)) if squares.size else squares[:, 0, :, 0]
    return pack_thumbnail(Thumbnail(frame_number, ticks, np.clip(np.rint(levels), 0, 255).astype(np.uint8)))


def image_report(image: NDArray[Any], attitude: FloatArray) -> dict[str, int]:
    """Return size and checksums of an image and its attitude message, as the packet `image_report` has them."""
    rows, columns = image.shape[:2] if image.ndim >= 2 and image.size else (0, 0)
    return {
        "width_px": columns,
        "height_px": rows,
        "image_crc": zlib.crc32(np.ascontiguousarray(image).tobytes()) if image.size else 0,
        "inputs_crc": zlib.crc32(np.ascontiguousarray(attitude, dtype=">f8").tobytes()),
    }


def map_octets(sightings: Mapping[int, int]) -> bytes:
    """Return the octets of the landmark map: how many frames used each crater."""
    rows = np.array([(crater, min(count, 0xFFFF)) for crater, count in sorted(sightings.items())], dtype=_LANDMARK)
    return rows.tobytes()
