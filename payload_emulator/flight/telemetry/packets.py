"""Telemetry of the payload: packets of the dictionary with their counts, into the store; events as they are wanted."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from payload_emulator.flight.telemetry.store import PacketStore, StoreClass
from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import TmtcError
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
