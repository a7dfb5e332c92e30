"""Figures that the LINNA paper prints, shown beside ours.

References
----------
"AI-Based Navigation for Lunar Satellites in VLLO", Table II (detection on its test set).
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
SOURCE = "LINNA paper, Table II"
