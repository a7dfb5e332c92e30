"""Telecommand channels as control words of a downlink show them."""

from __future__ import annotations

import numpy as np

from tmtc.link.clcw import uplink_seen
from tmtc.link.frames import Clcw, pack_clcw

TYPE_TWO_REPORT = 0x8000_0001


def words(*clcws: Clcw | int) -> np.ndarray:
    return np.array(
        [one if isinstance(one, int) else int.from_bytes(pack_clcw(one), "big") for one in clcws],
        dtype=np.uint32,
    )


def test_a_stretch_is_summed_up_and_its_newest_word_is_shown() -> None:
    locked = Clcw(0, 7, lockout=True, retransmit=True, farm_b_counter=2)
    (seen,) = uplink_seen(words(Clcw(0, 7), Clcw(0, 7), locked, locked, Clcw(0, 8, farm_b_counter=3)))
    assert (seen.frames, seen.changes) == (5, 2)
    assert (seen.frames_lockout, seen.frames_retransmit, seen.frames_wait, seen.frames_no_rf) == (2, 2, 0, 0)
    assert (seen.report_value, seen.farm_b_counter, seen.lockout) == (8, 3, False)


def test_channels_are_kept_apart_and_what_is_no_control_word_is_passed_over() -> None:
    seen = uplink_seen(words(Clcw(3, 1), 0, Clcw(0, 9), TYPE_TWO_REPORT, Clcw(3, 2), Clcw(0, 9)))
    assert [(one.virtual_channel, one.frames, one.changes, one.report_value) for one in seen] == [
        (0, 2, 0, 9),
        (3, 2, 1, 2),
    ]
    assert uplink_seen(words(0, TYPE_TWO_REPORT)) == () == uplink_seen(words())


def test_overlapping_stretches_add_up_to_the_whole() -> None:
    rng = np.random.default_rng(5)
    for _ in range(50):
        stream = words(*(Clcw(0, int(n), lockout=bool(n == 1)) for n in rng.integers(0, 3, 60)))
        first, last = sorted(rng.choice(np.arange(1, 60), 2, replace=False).tolist())
        (whole,), (head,), (tail,), (both,) = (
            uplink_seen(part) for part in (stream, stream[:last], stream[first:], stream[first:last])
        )
        assert head.followed_by(both, sign=-1).followed_by(tail) == whole
