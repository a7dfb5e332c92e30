"""The Moon's albedo as a picture under maps, and as what tells mare from highland."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ground_service.errors import InvalidInput
from reports.values import TerrainMap

WIDTH_PX = 2048


@lru_cache(maxsize=2)
def albedo_picture(path: Path) -> NDArray[np.uint8]:
    """Grey values (1024, 2048) over the whole range, -180 to 180 degrees east, 90 to -90 north.

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
    grey_levels: NDArray[np.uint8] = np.rint(40.0 + 180.0 * stretched).astype(np.uint8)
    return grey_levels


def surface_map(path: Path) -> TerrainMap:
    """The albedo as the ground of a report's maps, 0 to 360 degrees east."""
    picture = np.roll(albedo_picture(path), WIDTH_PX // 2, axis=1)
    return TerrainMap(picture, 0.0, 360.0, -90.0, 90.0, source="the albedo of the Moon")
