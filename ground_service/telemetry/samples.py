"""Decoded samples of one pass as plain arrays, on correlated UTC: the input of the evaluation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class NavigationSamples:
    """States of one on-board estimator in time order, arrays (n,); sigma_rtn_m (n, 3), NaN where there is none."""

    estimator: str
    frame_number: IntArray
    utc_ns: IntArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    altitude_m: FloatArray
    sigma_rtn_m: FloatArray
    nis: FloatArray
    matched: IntArray
    outcome: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class OutcomeSamples:
    """Outcomes of one estimator by frame, in time order, arrays (n,); `anchor_reads` is cumulative."""

    estimator: str
    frame_number: IntArray
    utc_ns: IntArray
    outcome: tuple[str, ...]
    reset_trigger: tuple[str, ...]
    candidate_pairs: IntArray
    anchor_reads: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class DetectionSamples:
    """Detections of all frames, in time order.

    Frame arrays are (f,); the detections of frame ``i`` are rows ``offsets[i]`` to ``offsets[i + 1]`` of the item
    arrays (n,). `usable` is False if the payload rejected the image; `correlation_id` (f,) tells which time
    correlation gave `utc_ns`, where that is known.
    """

    frame_number: IntArray
    utc_ns: IntArray
    usable: NDArray[np.bool_]
    quality: tuple[str, ...]
    offsets: IntArray
    u_px: FloatArray
    v_px: FloatArray
    diameter_px: FloatArray
    score: FloatArray
    size_class: IntArray
    correlation_id: IntArray | None = None

    def __len__(self) -> int:
        return len(self.frame_number)


def no_detections() -> DetectionSamples:
    """Detections of no frame at all."""
    none, whole = np.zeros(0), np.zeros(0, dtype=np.int64)
    return DetectionSamples(
        whole, whole, np.zeros(0, dtype=np.bool_), (), np.zeros(1, dtype=np.int64), none, none, none, none, whole
    )
