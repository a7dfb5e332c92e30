"""Image files of any common kind as arrays of pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from payload_emulator.errors import DatasetError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy")


def read_picture(path: Path) -> NDArray[np.generic]:
    """Pixels of an image file (PNG, JPEG, TIFF, NPY), 8 or 16 bits or float in 0..1; colours in RGB order.

    A 16-bit file whose greatest value would fit into 12 or 14 bits is taken for one of so many. Float pixels above 1
    are divided by the greatest one.

    Raises
    ------
    DatasetError
        The file cannot be read as an image.
    """
    try:
        octets = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path}: expected an image file, found none ({error.strerror})") from error
    image = _decode_npy(path) if path.suffix.lower() == ".npy" else _decode(octets)
    if image is None:
        raise DatasetError(f"{path}: expected an image (PNG, TIFF, JPEG, NPY), found none that can be read")
    if image.dtype == np.uint16 and image.size:
        held = next(bits for bits in (12, 14, 16) if int(image.max()) < 1 << bits)
        image = np.left_shift(image.astype(np.uint16), 16 - held)
    if image.dtype.kind == "f" and image.size and float(image.max()) > 1.0:
        image = np.divide(image, float(image.max()))
    return image


def _decode(octets: bytes) -> NDArray[np.generic] | None:
    import cv2

    data = np.frombuffer(octets, np.uint8)
    image: NDArray[np.generic] | None = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None or image.ndim == 2 or image.shape[2] < 3:
        return image
    return image[..., [2, 1, 0]]


def _decode_npy(path: Path) -> NDArray[np.generic] | None:
    try:
        image = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError):
        return None
    if not isinstance(image, np.ndarray) or image.ndim not in (2, 3) or image.dtype.kind not in "uf":
        return None
    return image
