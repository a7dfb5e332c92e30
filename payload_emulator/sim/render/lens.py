"""Pixel shifts caused by the lens distortion of the simulated camera."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from lunar.lens import BrownCamera

Image = npt.NDArray[np.float32]


@lru_cache(maxsize=4)
def pixel_shifts(camera: BrownCamera) -> tuple[Image, Image]:
    """Where every pixel of the picture would lie without distortion, less where it lies: u and v (H, W) in pixels."""
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px].astype(np.float64)
    ideal = camera.focal_px * camera.undistorted(np.stack([u, v], axis=-1)) + np.array(camera.centre_px)
    shift_u, shift_v = (ideal[..., 0] - u).astype(np.float32), (ideal[..., 1] - v).astype(np.float32)
    shift_u.setflags(write=False)
    shift_v.setflags(write=False)
    return shift_u, shift_v
