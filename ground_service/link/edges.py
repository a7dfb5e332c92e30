"""What is cut off at the end of a run of octets, and the rules by which two ends fit.

A unit (a CADU, or a packet) that was cut apart leaves an opener (its beginning), a closer (its end) and perhaps middles
(octets of which neither end is known). The counts before and after it and the octets that are missing say which may
belong together; the codes and checksums of the unit decide.
"""

from __future__ import annotations

from dataclasses import dataclass

from tmtc.packets import PRIMARY_HEADER_LENGTH

OPENER, MIDDLE, CLOSER, PLACED = 0, 1, 2, 3
"""A placed edge is a middle whose place in its stream is stated: it is joined by that alone."""

UNKNOWN = -1
"""A count or a number of octets that is not known."""


@dataclass(frozen=True, slots=True)
class Edge:
    """Octets of a unit that is not whole.

    `count` is that of the first frame of a closer or middle, `next_count` that of the frame behind an opener or middle.
    `start` is where the octets stand in their file, where they stand in one place.
    `missing` is how many octets an opener lacks, `UNKNOWN` where its header does not say.
    """

    role: int
    count: int
    next_count: int
    octets: bytes
    start: int | None = None
    missing: int = UNKNOWN

    @property
    def fit(self) -> int:
        """What has to be equal for an opener and a closer to fit: octets missing there, octets there are here."""
        if self.role != OPENER:
            return len(self.octets)
        return self.missing if self.missing != UNKNOWN else packet_octets_missing(self.octets)

    def followed_by(self, octets: bytes, next_count: int) -> Edge:
        """The edge with the octets behind it."""
        return Edge(self.role, self.count, next_count, self.octets + octets, self.start)


def packet_octets_missing(octets: bytes) -> int:
    """Octets that a packet lacks that begins with these; `UNKNOWN` where its header is not whole."""
    if len(octets) < PRIMARY_HEADER_LENGTH:
        return UNKNOWN
    return max(int.from_bytes(octets[4:6], "big") + PRIMARY_HEADER_LENGTH + 1 - len(octets), 0)
