"""Catalogued craters in view of a frame: what detections are scored against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class FrameTruth:
    """Catalogued craters in view of one frame, arrays (n,); `block` names the independent piece of ground."""

    u_px: Floats
    v_px: Floats
    diameter_px: Floats
    diameter_m: Floats
    depth_ratio: Floats
    ids: NDArray[np.int64]
    width_px: int
    height_px: int
    sun_azimuth_image_rad: float
    block: int
