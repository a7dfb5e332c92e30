"""Compiled copies of stretches of octets."""

# numba wants numpy integers where annotations say int
# mypy: disable-error-code="return-value,arg-type,no-any-return"

from __future__ import annotations

from kernels.compiled import njit
from tmtc.arrays import RecordArray


@njit(nogil=True)
def copy_items(
    octets: RecordArray,
    starts: RecordArray,
    counts: RecordArray,
    length: int,
    result: RecordArray,
    owner: RecordArray,
) -> None:
    """Copy `counts` (n,) items of `length` octets from each of `starts` (n,) one after another to `result`.

    `owner` becomes the index of the start of each item.
    """
    at = item = 0
    for n in range(starts.size):
        size = counts[n] * length
        result[at : at + size] = octets[starts[n] : starts[n] + size]
        owner[item : item + counts[n]] = n
        at += size
        item += counts[n]
