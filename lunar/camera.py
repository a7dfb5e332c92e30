"""Camera over the sphere, pinhole or with a distorting lens: projection, rays, ground points and footprints.

Camera axes: x right (image u), y down (image v), z along the boresight.  Pixel centres have integer
coordinates, so 512 pixels reach from -0.5 to 511.5 and their centre is at 255.5.  The nadir camera looks down
with image up to the north: x = east, y = south, z = down.  All lengths in m, angles in rad.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

from lunar.arrays import BoolArray, FloatArray
from lunar.constants import MOON_RADIUS_M
from lunar.errors import LensError
from lunar.frames import axis_rotation, enu_from_mcmf, spherical_from_mcmf

CAMERA_FROM_ENU: FloatArray = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""Nadir camera, image up to the north: x = east, y = south, z = down."""


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """An ideal camera with square pixels; ``fov_rad`` is the full horizontal field of view.

    The default is the paper's camera: 512 x 512 pixels over 120 degrees.
    """

    width_px: int = 512
    height_px: int = 512
    fov_rad: float = 2.0 * math.pi / 3.0

    @property
    def focal_px(self) -> float:
        """Return the focal length in pixels, f = (width / 2) / tan(fov / 2)."""
        return self.width_px / 2.0 / math.tan(self.fov_rad / 2.0)

    @property
    def centre_px(self) -> tuple[float, float]:
        """Return the principal point (u, v)."""
        return (self.width_px - 1) / 2.0, (self.height_px - 1) / 2.0

    def project(self, points_camera_m: ArrayLike) -> FloatArray:
        """Return pixel coordinates ``(..., 2)`` of points ``(..., 3)``; NaN behind the camera."""
        points = np.asarray(points_camera_m, dtype=np.float64)
        depth = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
        return np.asarray(self.focal_px * points[..., :2] / depth[..., None] + np.array(self.centre_px))

    def rays(self, uv: ArrayLike) -> FloatArray:
        """Return unit directions ``(..., 3)`` in camera axes of pixel coordinates ``(..., 2)``."""
        plane = (np.asarray(uv, dtype=np.float64) - np.array(self.centre_px)) / self.focal_px
        directions = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
        return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))

    def contains(self, uv: ArrayLike, margin_px: float = 0.0) -> BoolArray:
        """Return whether pixels ``(..., 2)`` lie in the image, ``margin_px`` inside its edges."""
        u, v = np.moveaxis(np.asarray(uv, dtype=np.float64), -1, 0)
        low = -0.5 + margin_px
        inside_u = (u >= low) & (u <= self.width_px - 1 - low)
        return np.asarray(inside_u & (v >= low) & (v <= self.height_px - 1 - low))

    def corners_px(self) -> FloatArray:
        """Return the outer corners of the image, (4, 2), clockwise from the top left."""
        right, bottom = self.width_px - 0.5, self.height_px - 0.5
        return np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])


def nadir_camera_from_mcmf(position_mcmf_m: ArrayLike) -> FloatArray:
    """Return the rotation ``(..., 3, 3)`` to the north-up nadir camera at positions ``(..., 3)``."""
    latitude_rad, longitude_rad, _ = spherical_from_mcmf(position_mcmf_m)
    return np.asarray(CAMERA_FROM_ENU @ enu_from_mcmf(latitude_rad, longitude_rad))


def intersect_sphere(origin_m: ArrayLike, direction: ArrayLike, radius_m: ArrayLike = MOON_RADIUS_M) -> FloatArray:
    """Return the range ``(...)`` in m along unit directions to a sphere about the frame's origin.

    NaN where the line misses the sphere or the sphere lies behind.  From inside the sphere, the range to the
    way out.
    """
    origin = np.asarray(origin_m, dtype=np.float64)
    heading = np.asarray(direction, dtype=np.float64)
    radius = np.asarray(radius_m, dtype=np.float64)
    along = -np.sum(origin * heading, axis=-1)
    closest = np.linalg.norm(origin + along[..., None] * heading, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        half_chord = np.sqrt((radius - closest) * (radius + closest))
        distance = np.linalg.norm(origin, axis=-1)
        power = (distance - radius) * (distance + radius)
        # The nearer root is written as power / (along + half chord): no difference of nearly equal numbers.
        outside = np.where(along > 0.0, power / (along + half_chord), np.nan)
    return np.asarray(np.where(power > 0.0, outside, along + half_chord))


def project_mcmf(
    camera: PinholeCamera, camera_from_mcmf: ArrayLike, position_mcmf_m: ArrayLike, points_mcmf_m: ArrayLike
) -> FloatArray:
    """Return pixel coordinates ``(..., 2)`` of points ``(..., 3)``; pose and points broadcast.

    One pose, shapes (3, 3) and (3,), serves any number of points; n poses serve (n, 3) points one each, or
    (n, m, 3) points when given as (n, 1, 3, 3) and (n, 1, 3).  Points behind the limb are projected too: see
    `above_horizon`.
    """
    rotation = np.asarray(camera_from_mcmf, dtype=np.float64)
    line_of_sight = np.asarray(points_mcmf_m, dtype=np.float64) - np.asarray(position_mcmf_m, dtype=np.float64)
    return camera.project(np.einsum("...ij,...j->...i", rotation, line_of_sight))


def above_horizon(position_mcmf_m: ArrayLike, points_mcmf_m: ArrayLike) -> BoolArray:
    """Return whether the ground leaves points ``(..., 3)`` in sight of a position ``(..., 3)``."""
    position = np.asarray(position_mcmf_m, dtype=np.float64)
    points = np.asarray(points_mcmf_m, dtype=np.float64)
    leg = position - points
    length = np.linalg.norm(leg, axis=-1)
    # Closest approach of the segment to the centre: hidden only where it is inside the segment and under the
    # ground.
    toward = -np.sum(points * leg, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        fraction = np.clip(toward / length**2, 0.0, 1.0)
    lowest = np.linalg.norm(points + fraction[..., None] * leg, axis=-1)
    ground = np.minimum(MOON_RADIUS_M, np.linalg.norm(points, axis=-1))
    return np.asarray(lowest >= ground * (1.0 - 1e-12))


def ground_point_sphere(
    camera: PinholeCamera,
    camera_from_mcmf: ArrayLike,
    position_mcmf_m: ArrayLike,
    uv: ArrayLike,
    height_m: ArrayLike = 0.0,
) -> FloatArray:
    """Return points ``(..., 3)`` where pixels ``(..., 2)`` see the sphere ``height_m`` up; NaN off it."""
    rotation = np.asarray(camera_from_mcmf, dtype=np.float64)
    position = np.asarray(position_mcmf_m, dtype=np.float64)
    direction = np.einsum("...ji,...j->...i", rotation, camera.rays(uv))
    range_m = intersect_sphere(position, direction, MOON_RADIUS_M + np.asarray(height_m, dtype=np.float64))
    return np.asarray(position + range_m[..., None] * direction)


def ground_arc_m(off_nadir_rad: ArrayLike, altitude_m: ArrayLike) -> FloatArray:
    """Return the ground arc in m from the sub-camera point to where a ray lands; NaN past the limb."""
    off_nadir = np.asarray(off_nadir_rad, dtype=np.float64)
    ratio = 1.0 + np.asarray(altitude_m, dtype=np.float64) / MOON_RADIUS_M
    with np.errstate(invalid="ignore"):
        return np.asarray(MOON_RADIUS_M * (np.arcsin(ratio * np.sin(off_nadir)) - off_nadir))


def horizon_arc_m(altitude_m: ArrayLike) -> FloatArray:
    """Return the arc in m on the sphere from the sub-camera point to the horizon."""
    return np.asarray(MOON_RADIUS_M * np.arccos(1.0 / (1.0 + np.asarray(altitude_m, dtype=np.float64) / MOON_RADIUS_M)))


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
