"""A background for maps, made from the albedo product of the data folder."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from ground_service.errors import InvalidInput
from ground_service.evaluation.surface import albedo_picture


@lru_cache(maxsize=2)
def basemap_jpeg(path: Path) -> bytes:
    """The map, half as high as it is wide, its grey values stretched over the whole range.

    Raises
    ------
    InvalidInput
        If the file is no picture.
    """
    import cv2

    picture = albedo_picture(path)
    good, octets = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
    if not good:
        raise InvalidInput(str(path), "", "a map that can be written as JPEG", str(picture.shape))
    return octets.tobytes()
