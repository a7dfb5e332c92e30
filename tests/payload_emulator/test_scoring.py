"""What the scores of a session count, on errors made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from payload_emulator.session.archive.scoring import _absolute_percentiles, frames_to_recover


@pytest.mark.parametrize(
    ("error_m", "frames"),
    [
        ([20_000.0, 300.0, 80.0, 60.0, 50.0, 40.0], 2),
        ([100.0, 90.0, 80.0, 70.0], 1),
        # One frame that happens to be close is no recovery.
        ([5_000.0, 400.0, 5_000.0, 5_000.0, 300.0, 200.0, 100.0, 90.0], 5),
        ([5_000.0, 5_000.0], None),
        ([], None),
    ],
)
def test_a_recovery_is_the_first_frame_from_which_the_error_stays_small(
    error_m: list[float], frames: int | None
) -> None:
    assert frames_to_recover(np.array(error_m)) == frames


def test_percentiles_of_each_direction_are_of_absolute_errors_and_unknown_without_any() -> None:
    errors = np.array([[-3.0, 1.0, np.nan], [1.0, -1.0, 2.0], [2.0, 4.0, np.nan]])
    assert _absolute_percentiles(errors, 50.0) == [2.0, 1.0, 2.0]
    assert _absolute_percentiles(errors, 100.0) == [3.0, 4.0, 2.0]
    assert _absolute_percentiles(errors[:0], 95.0) == [None, None, None]
