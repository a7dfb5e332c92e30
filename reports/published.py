"""Figures published in the LINNA paper, for comparison.

References
----------
"AI-Based Navigation for Lunar Satellites in VLLO", Table I (orbit), Table II (detection on its test set), Section V-B
(altitudes, catalogue, labels of its data set) and Section VII (images of its session).
"""

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
TABLE_I = {
    "Semi-major axis": "1768.180 km",
    "Eccentricity": "0.006908",
    "Inclination": "89.076°",
    "RAAN": "3.164°",
    "Argument of perilune": "333.604°",
    "True anomaly": "8.882°",
}
ALTITUDE_KM = {"mean": 30.8, "min": 14.0, "max": 48.6}
CATALOGUE = (58_649, 12_830, 7_908)
SESSION_FRAMES = 5_196
SOURCE = "LINNA paper, Table II"
