"""Pseudo-random sequences that are added to frames so that the link always sees transitions.

References
----------
CCSDS 131.0-B section 10: `legacy` h(x) = x^8 + x^7 + x^5 + x^3 + 1, all ones at the start, 255 bits; `long`
h(x) = x^17 + x^14 + 1, 131071 bits. CCSDS 231.0-B section 6 (telecommand): h(x) = x^8 + x^6 + x^4 + x^3 +
x^2 + x + 1, all ones at the start, 255 bits.
"""

import functools
from typing import Literal

import numpy as np

from tmtc.arrays import OctetArray
from tmtc.errors import LinkFormatError

Randomiser = Literal["none", "legacy", "long", "telecommand"]

# s[n + degree] is the sum of s[n + tap] over the taps; first bits of the sequence
_REGISTERS: dict[str, tuple[int, tuple[int, ...], str]] = {
    "legacy": (8, (0, 3, 5, 7), "11111111"),
    "long": (17, (0, 14), "00011100011100011"),
    "telecommand": (8, (0, 1, 2, 3, 4, 6), "11111111"),
}


def sequence(randomiser: str, length: int) -> OctetArray:
    """The first `length` octets of the sequence; zeros for `none`."""
    if randomiser == "none":
        return np.zeros(length, dtype=np.uint8)
    period = _period(randomiser)
    return period[np.arange(length) % period.size]


def randomise(frames: OctetArray, randomiser: str) -> OctetArray:
    """`frames` (..., n) with the sequence added to each, which also takes it away again."""
    if randomiser == "none":
        return frames
    return frames ^ sequence(randomiser, frames.shape[-1])


@functools.cache
def _period(randomiser: str) -> OctetArray:
    try:
        degree, taps, start = _REGISTERS[randomiser]
    except KeyError:
        known = ", ".join(("none", *_REGISTERS))
        raise LinkFormatError(f"randomiser: expected one of {known}, found {randomiser!r}") from None
    bits = [int(digit) for digit in start]
    # a period of an odd number of bits fills whole octets after eight of them
    count = 8 * ((1 << degree) - 1)
    for n in range(len(bits), count):
        bit = 0
        for tap in taps:
            bit ^= bits[n - degree + tap]
        bits.append(bit)
    return np.packbits(np.array(bits[:count], dtype=np.uint8))
