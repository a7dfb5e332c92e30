"""State of the uplink in the downlink: the command link control words (CLCW) of its frames, summed up.

References
----------
CCSDS 232.0-B 4.2 (the word), 232.1-B (what the receiver's FARM-1 makes of the frames that it reports on).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tmtc.errors import FrameError
from tmtc.link.frames import OCF_LENGTH, Clcw, unpack_clcw


@dataclass(frozen=True, slots=True)
class UplinkSeen:
    """The telecommand channel of a spacecraft as a stretch of its frames shows it.

    The first numbers count frames: with a CLCW of the channel, and with each flag set in it; `changes` counts words
    that differ from the one before. The others are those of the newest word: `report_value` is the number of the
    sequence-controlled frame that is expected next, `farm_b_counter` counts accepted expedited frames modulo 4.
    """

    virtual_channel: int
    frames: int
    changes: int
    frames_lockout: int
    frames_wait: int
    frames_retransmit: int
    frames_no_rf: int
    report_value: int
    farm_b_counter: int
    lockout: bool
    wait: bool
    retransmit: bool
    no_rf_available: bool
    no_bit_lock: bool

    def followed_by(self, later: UplinkSeen, sign: int = 1) -> UplinkSeen:
        """Both stretches, the newest word from `later`; `sign` -1 takes the counts of `later` off, and nothing else."""
        counts = {
            name: getattr(self, name) + sign * getattr(later, name)
            for name in (
                "frames", "changes", "frames_lockout", "frames_wait", "frames_retransmit", "frames_no_rf",
            )
        }  # fmt: skip
        return replace(later if sign > 0 else self, **counts)


def uplink_seen(words: npt.NDArray[np.uint32]) -> tuple[UplinkSeen, ...]:
    """Return the state of each telecommand channel from the control fields of frames (n,); 0 where there is none.

    Fields that are no CLCW (of another control word type or version) are passed over.
    """
    distinct, which = np.unique(words, return_inverse=True)
    known = [_clcw(int(word)) for word in distinct]
    by_channel: dict[int, list[int]] = {}
    for index, clcw in enumerate(known):
        if clcw is not None:
            by_channel.setdefault(clcw.virtual_channel, []).append(index)
    return tuple(_seen(which[np.isin(which, mine)], known) for _, mine in sorted(by_channel.items()))


def _seen(which: npt.NDArray[np.intp], known: list[Clcw | None]) -> UplinkSeen:
    """The channel whose words (n,), as indices of `known`, came in this order."""
    counts = np.bincount(which, minlength=len(known)).tolist()

    def frames_with(flag: str) -> int:
        return sum(n for n, clcw in zip(counts, known, strict=True) if n and getattr(clcw, flag))

    last = known[int(which[-1])]
    assert last is not None
    return UplinkSeen(
        virtual_channel=last.virtual_channel,
        frames=which.size,
        changes=int(np.count_nonzero(np.diff(which))),
        frames_lockout=frames_with("lockout"),
        frames_wait=frames_with("wait"),
        frames_retransmit=frames_with("retransmit"),
        frames_no_rf=frames_with("no_rf_available"),
        report_value=last.report_value,
        farm_b_counter=last.farm_b_counter,
        lockout=last.lockout,
        wait=last.wait,
        retransmit=last.retransmit,
        no_rf_available=last.no_rf_available,
        no_bit_lock=last.no_bit_lock,
    )


def _clcw(word: int) -> Clcw | None:
    if word == 0:
        return None
    try:
        return unpack_clcw(word.to_bytes(OCF_LENGTH, "big"))
    except FrameError:
        return None
