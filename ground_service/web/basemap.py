"""A background for maps, made from the albedo product of the data folder."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from ground_service.errors import InvalidInput

WIDTH_PX = 2048


@lru_cache(maxsize=2)
def basemap_jpeg(path: Path) -> bytes:
    """The map, half as high as it is wide, its grey values stretched over the whole range.

    Raises
    ------
    InvalidInput
        If the file is no picture.
    """
    import cv2

    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise InvalidInput(str(path), "", "an albedo map as a picture", "a file that cannot be read as one")
    small = cv2.resize(grey, (WIDTH_PX, WIDTH_PX // 2), interpolation=cv2.INTER_AREA).astype(np.float32)
    low, high = np.percentile(small, (0.5, 99.5))
    stretched = np.clip((small - low) / max(float(high - low), 1.0), 0.0, 1.0)
    good, octets = cv2.imencode(".jpg", np.rint(40.0 + 180.0 * stretched).astype(np.uint8))
    if not good:
        raise InvalidInput(str(path), "", "a map that can be written as JPEG", str(grey.shape))
    return octets.tobytes()
