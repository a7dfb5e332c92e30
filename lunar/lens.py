"""Camera with a distorting lens (Brown's radial and tangential model), and its mounting on the spacecraft.

The undistorted image plane has x = X / Z, y = Y / Z in camera axes and r^2 = x^2 + y^2; a lens moves a point to

    x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

(Brown 1966, Photogrammetric Engineering 32, 444-462, with the coefficients in the order of common calibration tools).
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.errors import LensError
from lunar.frames import axis_rotation

NEWTON_STEPS = 12
SETTLED = 1.0e-10
"""Convergence limit of the inverse distortion in focal lengths, about a millionth of a pixel."""


@dataclass(frozen=True, slots=True)
class BrownCamera(PinholeCamera):
    """Camera with a distorting lens; ``fov_rad`` is the field of view without distortion.

    Raises
    ------
    LensError
        The distortion is not invertible: some pixel has no unique ray.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        u = np.linspace(-0.5, self.width_px - 0.5, 33)
        v = np.linspace(-0.5, self.height_px - 0.5, 33)
        if not np.isfinite(self.rays(np.stack(np.meshgrid(u, v), axis=-1))).all():
            raise LensError(
                "lens: expected an invertible distortion, found one that folds the image "
                f"(k1 {self.k1:g}, k2 {self.k2:g}, k3 {self.k3:g}, p1 {self.p1:g}, p2 {self.p2:g})"
            )

    def project(self, points_camera_m: npt.ArrayLike) -> FloatArray:
        """Return the pixel coordinates ``(..., 2)`` of points ``(..., 3)``; NaN where there are none."""
        points = np.asarray(points_camera_m, dtype=np.float64)
        depth = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
        x, y = points[..., 0] / depth, points[..., 1] / depth
        square = x * x + y * y
        place = np.stack(self._distorted(x, y), axis=-1)
        place[~(square < _largest_square(self.k1, self.k2, self.k3))] = np.nan
        return np.asarray(self.focal_px * place + np.array(self.centre_px))

    def rays(self, uv: npt.ArrayLike) -> FloatArray:
        """Return unit directions ``(..., 3)`` in camera axes of pixels ``(..., 2)``; NaN if there is none."""
        plane = self.undistorted(uv)
        directions = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
        return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))

    def undistorted(self, uv: npt.ArrayLike) -> FloatArray:
        """Return undistorted image-plane coordinates ``(..., 2)`` of pixels ``(..., 2)``, in focal lengths."""
        wanted = (np.asarray(uv, dtype=np.float64) - np.array(self.centre_px)) / self.focal_px
        goal_x, goal_y = wanted[..., 0], wanted[..., 1]
        x, y = goal_x.copy(), goal_y.copy()
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):
                found_x, found_y = self._distorted(x, y)
                miss_x, miss_y = found_x - goal_x, found_y - goal_y
                square = x * x + y * y
                radial = 1.0 + square * (self.k1 + square * (self.k2 + square * self.k3))
                slope = 2.0 * (self.k1 + square * (2.0 * self.k2 + 3.0 * square * self.k3))
                xx = radial + x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x
                yy = radial + y * y * slope + 6.0 * self.p1 * y + 2.0 * self.p2 * x
                xy = x * y * slope + 2.0 * self.p1 * x + 2.0 * self.p2 * y
                determinant = xx * yy - xy * xy
                x = x - (yy * miss_x - xy * miss_y) / determinant
                y = y - (xx * miss_y - xy * miss_x) / determinant
            found_x, found_y = self._distorted(x, y)
            good = np.hypot(found_x - goal_x, found_y - goal_y) < SETTLED
            good &= x * x + y * y < _largest_square(self.k1, self.k2, self.k3)
        return np.where(good[..., None], np.stack([x, y], axis=-1), np.nan)

    def _distorted(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        square = x * x + y * y
        radial = 1.0 + square * (self.k1 + square * (self.k2 + square * self.k3))
        return (
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (square + 2.0 * x * x),
            y * radial + self.p1 * (square + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        )


def pointed_camera_from_mcmf(position_mcmf_m: npt.ArrayLike, tilt_rad: float = 0.0, yaw_rad: float = 0.0) -> FloatArray:
    """Return the rotation (..., 3, 3) to a camera at positions (..., 3), turned from nadir with image up to the north.

    ``yaw`` turns the camera clockwise seen from above (image up to that azimuth), then ``tilt`` leans its boresight
    toward image up.
    """
    nadir = nadir_camera_from_mcmf(position_mcmf_m)
    return np.asarray(axis_rotation(1, tilt_rad) @ axis_rotation(3, yaw_rad) @ nadir)


@lru_cache(maxsize=16)
def _largest_square(k1: float, k2: float, k3: float) -> float:
    """Return the squared radius at which the distorted radius stops increasing; infinity if it never does."""
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0]) if (k1 or k2 or k3) else np.empty(0)
    real = roots[np.abs(roots.imag) < 1.0e-9 * np.abs(roots)].real
    real = real[real > 0.0]
    return float(real.min()) if real.size else math.inf
