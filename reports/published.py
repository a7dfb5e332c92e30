"""Figures published in the LINNA paper, for comparison.

References
----------
"AI-Based Navigation for Lunar Satellites in VLLO", Table II (detection on its test set) and Section V-B (labels of its
data set).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PublishedScore:
    """A row of Table II."""

    label: str
    precision: float
    recall: float
    localisation_px: float


TABLE_II = {
    0: PublishedScore("Class 0 (5–10 km)", 0.7021, 0.3248, 3.50),
    1: PublishedScore("Class 1 (10–15 km)", 0.7362, 0.3586, 4.11),
    2: PublishedScore("Class 2 (15–30 km)", 0.8131, 0.4659, 4.75),
}
LABEL_SHARES = {0: 72.8, 1: 16.9, 2: 10.3}
LABELS = {0: 956_110, 1: 221_860, 2: 135_098}
FRAMES = 51_924
SOURCE = "LINNA paper, Table II"
