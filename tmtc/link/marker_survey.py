"""Survey of the undamaged sync markers of a whole stream, in bounded memory."""

from dataclasses import dataclass

import numpy as np

from tmtc.arrays import BoolArray, IntArray, OctetArray
from tmtc.link import cadu

BLOCK_OCTETS = 1 << 16
"""Octets of a block; link settings that hold for less than a block are not looked for."""

KEPT_PER_BLOCK = 16
"""Largest number of markers of a block whose position is kept."""

LONGEST_DISTANCE = 1 << 14
"""Largest distance of markers that is counted, in octets."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerSurvey:
    """Undamaged markers of a stream.

    `start_bits` (n,) and `inverted` (n,) hold at most `KEPT_PER_BLOCK` markers of each block in order, `markers` is the
    number of all. `distances`: how often each distance in octets occurs between consecutive markers, the most frequent
    first.
    """

    start_bits: IntArray
    inverted: BoolArray
    markers: int
    distances: dict[int, int]

    @property
    def block(self) -> IntArray:
        """Block (n,) of each kept marker."""
        return (self.start_bits >> 3) // BLOCK_OCTETS

    @property
    def is_regular(self) -> bool:
        """Return whether the stream has more, or more regular, markers than random data."""
        return self.markers >= 3 or max(self.distances.values(), default=0) >= 2


def survey_markers(stream: OctetArray) -> MarkerSurvey:
    """Return the survey of a stream (n,)."""
    histogram = np.zeros(LONGEST_DISTANCE + 1, dtype=np.int64)
    kept: list[IntArray] = [np.empty(0, dtype=np.int64)]
    markers, last_block, in_block = 0, -1, 0
    last = np.empty(0, dtype=np.int64)
    for found in cadu.undamaged_candidates(stream):
        markers += found.size
        starts = np.concatenate((last, found))
        distance = starts[1:] - starts[:-1]
        whole = distance[(distance & 7 == 0) & (distance >= 8 * cadu.ASM_LENGTH)] >> 3
        histogram += np.bincount(whole[whole <= LONGEST_DISTANCE], minlength=histogram.size)
        last = found[-1:]
        block = (found >> 3) // BLOCK_OCTETS
        rank = np.arange(found.size) - np.searchsorted(block, block)
        rank += np.where(block == last_block, in_block, 0)
        kept.append(found[rank < KEPT_PER_BLOCK])
        last_block, in_block = int(block[-1]), int(rank[-1]) + 1
    kept_starts = np.concatenate(kept)
    order = np.argsort(-histogram, kind="stable")
    order = order[histogram[order] > 0]
    return MarkerSurvey(
        kept_starts,
        cadu.are_inverted(stream, kept_starts),
        markers,
        {int(octets): int(histogram[octets]) for octets in order},
    )
