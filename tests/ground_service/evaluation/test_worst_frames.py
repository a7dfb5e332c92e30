"""The choice of the frames with the lowest recall."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from ground_service.evaluation.core import WORST_FRAMES, _choose_frames
from ground_service.evaluation.detection.recall import ExpectedCraters, Matches

FRAMES, CRATERS = 40, 5


def test_the_worst_frames_are_chosen_from_all_frames_and_not_from_those_with_an_image() -> None:
    """Five craters a frame; 20 to 27 lose all, 30 is unfit, and only 0, 10 and 39 have an image."""
    found = np.zeros((FRAMES, CRATERS), dtype=np.int64)
    found[20:28] = -1
    found[30] = -1
    found[10, 0] = -1
    m = FRAMES * CRATERS
    expected = ExpectedCraters(
        offsets=np.arange(FRAMES + 1) * CRATERS,
        index=np.arange(m),
        u_px=np.zeros(m),
        v_px=np.zeros(m),
        diameter_px=np.ones(m),
        size_class=np.zeros(m, dtype=np.int64),
        complete=np.ones(m, dtype=np.bool_),
    )
    usable = np.ones(FRAMES, dtype=np.bool_)
    usable[30] = False

    class Detections(SimpleNamespace):
        def __len__(self) -> int:
            return FRAMES

    inputs = SimpleNamespace(
        detections=Detections(frame_number=np.arange(FRAMES), usable=usable),
        images={0: None, 10: None, 39: None},
    )
    matches = Matches(np.zeros(0, dtype=np.int64), found.ravel())
    spread, worst = _choose_frames(cast(Any, inputs), expected, matches)
    assert spread == [0, 10, 39]
    assert worst == list(range(20, 20 + WORST_FRAMES))
