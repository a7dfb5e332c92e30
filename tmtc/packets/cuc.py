"""On-board time as octets: the CCSDS unsegmented time code (CUC).

Inside the project on-board time is `ticks`, an integer count of 2**-16 s since the on-board epoch
2000-01-01T00:00:00 TAI. On the link it is CUC with an agency epoch, four octets of seconds and two of
fraction, preceded by its P-field 0x2E.

References
----------
CCSDS 301.0-B-4 section 3.2.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from tmtc.arrays import IntArray

P_FIELD = 0x2E
TICKS_PER_SECOND = 1 << 16
TICKS_LIMIT = 1 << 48
CUC_LENGTH = 7

NO_TICKS = -1
"""On-board time of a packet that carries none, or none that is possible."""


def onboard_ticks(values: npt.NDArray[Any]) -> IntArray:
    """Return on-board times (n,) given as u64 in signed integers; `NO_TICKS` for those beyond 48 bits."""
    ticks = values.astype(np.int64)
    ticks[values >= TICKS_LIMIT] = NO_TICKS
    return ticks
