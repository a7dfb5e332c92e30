"""Fragments of units cut at the ends of a run of octets, and the rules to match them.

A unit (a CADU or a packet) that was cut leaves an opener (its start), a closer (its end) and possibly middles (octets
with neither end). Candidates are selected by the frame counts before and after the cut and by the number of missing
octets; the codes and checksums of the unit decide.
"""

from __future__ import annotations

from dataclasses import dataclass

from tmtc.packets import PRIMARY_HEADER_LENGTH

OPENER, MIDDLE, CLOSER, PLACED = 0, 1, 2, 3
"""Role of a middle whose position in its stream is stated: it is joined by position only."""

UNKNOWN = -1
"""Value of an unknown count or number of octets."""


@dataclass(frozen=True, slots=True)
class Edge:
    """Octets of an incomplete unit.

    `count` is the frame count of the first frame of a closer or middle, `next_count` that of the frame after an opener
    or middle. `start` is the position of the octets in their file, if they are contiguous. `missing` is the number of
    octets that follow an opener, `UNKNOWN` if its header does not give it.
    """

    role: int
    count: int
    next_count: int
    octets: bytes
    start: int | None = None
    missing: int = UNKNOWN

    @property
    def fit(self) -> int:
        """Return the key that must be equal for an opener and a closer to match: a number of octets."""
        if self.role != OPENER:
            return len(self.octets)
        return self.missing if self.missing != UNKNOWN else packet_octets_missing(self.octets)

    def followed_by(self, octets: bytes, next_count: int) -> Edge:
        """Return the edge extended by the octets that follow it."""
        return Edge(self.role, self.count, next_count, self.octets + octets, self.start)


def packet_octets_missing(octets: bytes) -> int:
    """Return the number of octets missing from the packet that begins here; `UNKNOWN` without a full header."""
    if len(octets) < PRIMARY_HEADER_LENGTH:
        return UNKNOWN
    return max(int.from_bytes(octets[4:6], "big") + PRIMARY_HEADER_LENGTH + 1 - len(octets), 0)
