"""Completeness of a packet stream: sequence counts unwrapped to 64 bits, then gaps, duplicates and conflicts.

The link carries 14 bits of count, so the same number returns every 16384 packets. Counts are therefore first
extended, separately for every boot and APID and in the order of on-board time (arrival means nothing: dumps
come late, interleaved and twice). Only extended counts are compared.

Between two packets that follow each other in on-board time the count is taken to have moved by the least
number of steps that explains what is seen: a loss of 8192 packets or more in one stretch looks like a
shorter one. A sender that restarts begins to count again: a count that falls far, or falls among counts that
packets of other content had, is a restart.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tmtc.arrays import BoolArray, IntArray
from tmtc.packets.space_packets import SEQUENCE_COUNT_LIMIT

FIRST, DUPLICATE, CONFLICT = 0, 1, 2

# A sender that restarts counts from zero; a count that falls far, to nearly zero, as time goes on is such a start
_RESET_FALL = 64
_RESET_COUNT = 64
_REPEATED = 2
"""Packets with counts of earlier ones and other content that are a restart; a single one is a conflict."""


@dataclass(frozen=True, slots=True, eq=False)
class ApidAccount:
    """Packet counts of one APID during one boot.

    `missing_ranges` (m, 2) are ranges [first, last] of extended counts that never came; `received` counts
    different packets, not copies; `restarts` tells how often the counter restarted.
    """

    boot: int
    apid: int
    received: int
    first_count: int
    last_count: int
    missing_ranges: IntArray
    duplicates: int
    conflicts: int
    restarts: int

    @property
    def gaps(self) -> int:
        """Stretches of missing packets."""
        return int(self.missing_ranges.shape[0])

    @property
    def missing(self) -> int:
        """Missing packets."""
        return int((self.missing_ranges[:, 1] - self.missing_ranges[:, 0] + 1).sum())


@dataclass(frozen=True, slots=True, eq=False)
class SequenceReport:
    """Accounts by boot and APID, and for every packet its extended count (n,) and whether it is a copy (n,)."""

    accounts: tuple[ApidAccount, ...]
    extended_count: IntArray
    verdict: npt.NDArray[np.int8]

    @property
    def gaps(self) -> int:
        """Stretches of missing packets, all APIDs."""
        return sum(account.gaps for account in self.accounts)

    @property
    def missing(self) -> int:
        """Missing packets, all APIDs."""
        return sum(account.missing for account in self.accounts)

    @property
    def duplicates(self) -> int:
        """Packets that came again with the same octets."""
        return sum(account.duplicates for account in self.accounts)

    @property
    def conflicts(self) -> int:
        """Packets with the count of another one but other octets."""
        return sum(account.conflicts for account in self.accounts)

    @property
    def restarts(self) -> int:
        """Restarts of counters, all APIDs; how many packets are missing around them is unknown."""
        return sum(account.restarts for account in self.accounts)


def extend_counts(
    sequence_count: IntArray, ticks: IntArray, same: Callable[[int, int], bool] | None = None
) -> tuple[IntArray, IntArray]:
    """(extended counts (n,), extended counts at which the counter restarted (r,)) of one APID and boot.

    Parameters
    ----------
    sequence_count, ticks : (n,)
        The 14-bit counts and the on-board times, in any order.
    same
        Whether two packets, by index, hold the same octets; if given, restarts are found by content as well.
    """
    if not sequence_count.size:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    order = np.lexsort((np.arange(ticks.size), ticks))
    count, time = sequence_count[order], ticks[order]
    # the step congruent to the difference that lies nearest to 0
    half = SEQUENCE_COUNT_LIMIT // 2
    step = (np.diff(count) + half) % SEQUENCE_COUNT_LIMIT - half
    restart = (step < -_RESET_FALL) & (count[1:] < _RESET_COUNT) & (np.diff(time) > 0)
    extended = np.cumsum(np.append(count[0], step))
    if same is not None and (step < 1).any() and np.unique(extended).size < extended.size:  # quick for rising counts
        later = np.append(False, np.diff(time) > 0)
        restart[_begins_again(extended, later, restart, lambda a, b: same(order[a], order[b]))] = True
    # after a restart the extended count begins at the next multiple of the limit above all before it
    bases = []
    for at in (np.flatnonzero(restart) + 1).tolist():
        highest = int(extended[:at].max())
        base = (highest // SEQUENCE_COUNT_LIMIT + 1) * SEQUENCE_COUNT_LIMIT
        extended[at:] += base + int(count[at]) - int(extended[at])
        bases.append(base)
    result = np.empty_like(extended)
    result[order] = extended
    return result, np.array(bases, dtype=np.int64)


def _begins_again(
    extended: IntArray, later: BoolArray, restart: BoolArray, same: Callable[[int, int], bool]
) -> list[int]:
    """Return the steps at which counts (n,) in time order fall among counts that other content had, copies of none."""
    counts, found = extended.tolist(), []
    seen: dict[int, int] = {}
    highest = counts[0] - 1
    for k, count in enumerate(counts):
        begins = k > 0 and bool(restart[k - 1])
        if not begins and later[k] and count <= highest and count <= counts[k - 1]:
            conflicts = copies = 0
            stop = k
            while stop < len(counts) and counts[stop] <= highest and (stop == k or counts[stop] > counts[stop - 1]):
                if (earlier := seen.get(counts[stop])) is not None:
                    is_copy = same(earlier, stop)
                    copies, conflicts = copies + is_copy, conflicts + (not is_copy)
                stop += 1
            begins = conflicts >= _REPEATED and not copies
            if begins:
                found.append(k - 1)
        if begins:
            seen, highest = {}, count
        seen.setdefault(count, k)
        highest = max(highest, count)
    return found


def account(
    apid: IntArray,
    sequence_count: IntArray,
    ticks: IntArray,
    same: Callable[[int, int], bool],
    boot: IntArray | None = None,
) -> SequenceReport:
    """Completeness of n packets in order of arrival.

    Parameters
    ----------
    apid, sequence_count, ticks, boot : (n,)
        `boot` tells which run of the sender made the packet (all the same by default).
    same
        Whether two packets, by index, hold the same octets.
    """
    n = apid.size
    boots = np.zeros(n, dtype=np.int64) if boot is None else boot
    extended = np.zeros(n, dtype=np.int64)
    verdict = np.zeros(n, dtype=np.int8)
    accounts = []
    for key in np.unique(boots * (1 << 16) + apid).tolist():
        this_boot, this_apid = divmod(key, 1 << 16)
        rows = np.flatnonzero((boots == this_boot) & (apid == this_apid))
        content = None if boot is not None else lambda a, b, rows=rows: same(int(rows[a]), int(rows[b]))
        counts, restarts = extend_counts(sequence_count[rows], ticks[rows], content)
        extended[rows] = counts
        by_count = np.lexsort((rows, counts))
        ordered = counts[by_count]
        repeated = np.append(False, ordered[1:] == ordered[:-1])
        original = -1
        for at in np.flatnonzero(repeated).tolist():
            if not repeated[at - 1]:
                original = int(rows[by_count[at - 1]])
            row = int(rows[by_count[at]])
            verdict[row] = DUPLICATE if same(original, row) else CONFLICT
        present = ordered[~repeated]
        jump = np.flatnonzero(np.diff(present) > 1)
        missing = np.stack((present[jump] + 1, present[jump + 1] - 1), axis=1)
        # a restart is no gap: what was lost around it cannot be known
        for base in restarts.tolist():
            missing = missing[(missing[:, 0] > base) | (base > missing[:, 1] + 1)]
        accounts.append(
            ApidAccount(
                boot=this_boot,
                apid=this_apid,
                received=int(present.size),
                first_count=int(present[0]),
                last_count=int(present[-1]),
                missing_ranges=missing,
                duplicates=int(np.count_nonzero(verdict[rows] == DUPLICATE)),
                conflicts=int(np.count_nonzero(verdict[rows] == CONFLICT)),
                restarts=int(restarts.size),
            )
        )
    return SequenceReport(tuple(accounts), extended, verdict)
