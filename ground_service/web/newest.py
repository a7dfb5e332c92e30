"""Live message ``values``: newest values of a spacecraft, read and serialised once for all sockets of a process."""

from __future__ import annotations

from collections.abc import Iterable

from ground_service.errors import NotFound
from ground_service.ground import Ground
from ground_service.passes.live import newest_packets

Source = tuple[int, str]
"""Vehicle and kind of packet: a message replaces an older one of the same source that was not sent yet."""


class NewestValues:
    """Newest packets of the vehicles as they were last sent."""

    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        self._sent: dict[Source, str] = {}

    def changed(self, vehicles: Iterable[int]) -> list[tuple[Source, str]]:
        """Return the newest packets of vehicles that were not returned before, as JSON."""
        found = []
        for vehicle in sorted(vehicles):
            try:
                packets = newest_packets(self._ground, vehicle)
            except NotFound:
                continue
            for packet in packets:
                source = (vehicle, packet.packet)
                known = packet.model_dump_json(exclude={"age_s"})
                if self._sent.get(source) != known:
                    self._sent[source] = known
                    found.append((source, packet.model_dump_json()))
        return found
