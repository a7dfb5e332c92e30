"""Image files of any common kind as arrays of pixels."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from payload_emulator.errors import DatasetError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy")


_NO_DATA_BELOW = -1_000.0
"""Special values for missing pixels (-9999, -32768, -3.4e38) lie below; counts of a calibrated image do not."""

_HOT = 4.0
"""Times the level of all but a thousandth of the pixels, from which a pixel is hot and decides no scale."""


def read_picture(path: Path) -> tuple[NDArray[np.generic], str]:
    """Pixels of an image file (PNG, JPEG, TIFF, NPY), and what was wrong with some of them; colours in RGB order.

    Pixels are 8 or 16 bits or float in 0..1, turned as EXIF states. Those without data (not finite, far below zero)
    become black. A 16-bit file whose greatest value would fit into 12 or 14 bits is taken for one of so many. Float
    pixels above 1 are divided by the greatest one. Hot pixels do not count for either, and are cut at full scale.

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
    if image.dtype.kind == "i":
        image = image.astype(np.float32)
    if image.dtype not in (np.uint16, np.float32, np.float64) or not image.size:
        return image, ""
    missing = ~(np.greater(image, _NO_DATA_BELOW) & np.isfinite(image))
    image = np.where(missing, image.dtype.type(0), image)
    limit = _HOT * float(np.quantile(image[~missing], 0.999)) if not missing.all() else 0.0
    hot = np.greater(image, limit if limit > 0.0 else np.inf)
    greatest = float(image[~hot].max())
    if image.dtype == np.uint16:
        held = next(bits for bits in (12, 14, 16) if greatest < 1 << bits)
        image = np.left_shift(np.minimum(image, (1 << held) - 1).astype(np.uint16), 16 - held)
    elif greatest > 1.0:
        image = np.divide(image, greatest)
    if image.dtype.kind == "f":
        image = np.minimum(image, 1.0)
    counts = ((missing, "without data (black)"), (hot, "hot (cut)"))
    words = [f"{np.count_nonzero(mask)} {name}" for mask, name in counts if mask.any()]
    return image, f"{' and '.join(words)} of {image.size} pixels" if words else ""


def _turned(image: NDArray[np.generic], octets: bytes) -> NDArray[np.generic]:
    """Return an image as its EXIF data state that it is to be shown (values 1 to 8 of the tag Orientation)."""
    from PIL import Image, UnidentifiedImageError

    if octets[:2] in (b"II", b"MM"):  # OpenCV turns TIFF images itself
        return image
    try:
        with Image.open(io.BytesIO(octets)) as opened:
            orientation = opened.getexif().get(0x0112, 1)
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError):
        return image
    if orientation in (5, 6, 7, 8):
        image = np.swapaxes(image, 0, 1)
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image[:, ::-1] if orientation in (2, 3, 6, 7) else image)


def _decode(octets: bytes) -> NDArray[np.generic] | None:
    import cv2

    data = np.frombuffer(octets, np.uint8)
    image: NDArray[np.generic] | None = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        return None
    image = _turned(image, octets)
    return image if image.ndim == 2 or image.shape[2] < 3 else image[..., [2, 1, 0]]


def _decode_npy(path: Path) -> NDArray[np.generic] | None:
    try:
        image = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError):
        return None
    if not isinstance(image, np.ndarray) or image.ndim not in (2, 3) or image.dtype.kind not in "uf":
        return None
    return image
