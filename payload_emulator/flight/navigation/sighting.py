"""Craters of the on-board catalogue as the camera should see them: places, projections, derivatives, noise.

Errors that are common to a frame or last over many frames are parameters of the projection, next to the position:

- attitude: a rotation of the camera by a vector theta in its own axes, C_true = exp(-[theta x]) C_measured;
- pixel bias: a shift of every detection, as an uneven response to slanting light would cause;
- catalogue offset: a shift of the whole catalogue east, north and up;
- scale: all detections drawn towards the image centre or away from it, as a focal length in error or a detector that
  leans towards the middle would; for a camera that looks straight down it is an error of altitude.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from lunar.frames import enu_from_mcmf
from tmtc.dictionary.tables import CatalogueTable

# A crater is in sight if its centre is above the limb by this much: on the very limb a degree is many pixels.
_LIMB_MARGIN_RAD = np.radians(5.0)

DESIGN_ALTITUDE_M = 100_000.0
"""Altitude up to which limits in metres on the ground were evaluated; they apply there as they are."""


def ground_scale(altitude_m: float) -> float:
    """Return the factor of limits in metres on the ground at an altitude: max(1, altitude / DESIGN_ALTITUDE_M).

    A pixel at nadir covers altitude / focal length. Above the design altitude limits grow with it, so that they remain
    the same in pixels: 1,500 m are 2.2 px at 100 km and would be 1.5 px at 150 km.
    """
    return max(1.0, altitude_m / DESIGN_ALTITUDE_M)


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMap:
    """The anchoring catalogue made ready for search and projection, ordered by latitude.

    Attributes
    ----------
    position_mcmf_m
        Centres at rim height, shape (n, 3).
    enu_from_mcmf
        Local axes at each crater, shape (n, 3, 3).
    """

    ids: IntArray
    latitude_rad: FloatArray
    position_mcmf_m: FloatArray
    enu_from_mcmf: FloatArray
    diameter_m: FloatArray
    sigma_m: FloatArray

    def __len__(self) -> int:
        return int(self.ids.shape[0])

    def near(self, direction_mcmf: FloatArray, angle_rad: float) -> IntArray:
        """Return the craters whose centre lies within an angle of a direction from the Moon's centre."""
        latitude = float(np.arcsin(np.clip(direction_mcmf[2], -1.0, 1.0)))
        low, high = np.searchsorted(self.latitude_rad, [latitude - angle_rad, latitude + angle_rad])
        points = self.position_mcmf_m[low:high]
        reach = np.cos(angle_rad) * np.linalg.norm(points, axis=1)
        return np.asarray(np.flatnonzero(points @ direction_mcmf >= reach) + low, dtype=np.int64)


def landmark_map(table: CatalogueTable) -> LandmarkMap:
    """Return the catalogue table ready for use."""
    order = np.argsort(table.latitude_rad, kind="stable")
    latitude = table.latitude_rad[order]
    axes = enu_from_mcmf(latitude, table.longitude_rad[order])
    radius = MOON_RADIUS_M + table.rim_height_m[order]
    return LandmarkMap(
        table.ids[order], latitude, radius[:, None] * axes[:, 2], axes, table.diameter_m[order], table.sigma_m[order]
    )


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Position and attitude of the camera, with the values that are common to the frame.

    Attributes
    ----------
    position_icrf_m
        Shape (3,).
    camera_from_icrf, mcmf_from_icrf
        Measured attitude and the Moon's orientation, shape (3, 3).
    attitude_rad, pixel_bias_px, catalogue_offset_m
        Common errors as estimated, shapes (3,), (2,), (3,).
    scale
        Relative stretch of the image about its centre.
    """

    position_icrf_m: FloatArray
    camera_from_icrf: FloatArray
    mcmf_from_icrf: FloatArray
    attitude_rad: FloatArray
    pixel_bias_px: FloatArray
    catalogue_offset_m: FloatArray
    scale: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Craters of the map in the image plane of a pose.

    Attributes
    ----------
    index
        Into the map, shape (n,).
    uv_px
        Predicted centres, shape (n, 2).
    diameter_px
        Predicted diameters.
    by_position, by_attitude, by_offset
        Derivatives of `uv_px`, shape (n, 2, 3), by position (ICRF), attitude and catalogue offset (ENU).
    by_scale
        Derivatives by the scale, shape (n, 2).
    """

    index: IntArray
    uv_px: FloatArray
    diameter_px: FloatArray
    by_position: FloatArray
    by_attitude: FloatArray
    by_offset: FloatArray
    by_scale: FloatArray

    def __len__(self) -> int:
        return int(self.index.shape[0])

    def select(self, which: BoolArray | IntArray) -> Sighting:
        return Sighting(*(getattr(self, one.name)[which] for one in fields(self)))


def in_view(landmarks: LandmarkMap, pose: Pose, camera: PinholeCamera, margin_px: float) -> Sighting:
    """Return the craters that a pose should see, with those up to a margin outside the image."""
    position = pose.mcmf_from_icrf @ pose.position_icrf_m
    radius = float(np.linalg.norm(position))
    if not radius > MOON_RADIUS_M:
        return look(landmarks, np.empty(0, dtype=np.int64), pose, camera)
    index = landmarks.near(position / radius, _reach_rad(radius, pose, camera, margin_px))
    away = position - landmarks.position_mcmf_m[index]
    height = np.einsum("ij,ij->i", away, landmarks.enu_from_mcmf[index, 2])
    sine = np.sin(_LIMB_MARGIN_RAD)
    index = index[(height > 0.0) & (height**2 > sine**2 * np.einsum("ij,ij->i", away, away))]
    sighting = look(landmarks, index, pose, camera)
    return sighting.select(inside_image(sighting, camera, margin_px))


def inside_image(sighting: Sighting, camera: PinholeCamera, margin_px: float = 0.0) -> BoolArray:
    """Return which craters lie in the image, or up to a margin outside it; False for NaN."""
    u, v = sighting.uv_px[:, 0] - camera.centre_px[0], sighting.uv_px[:, 1] - camera.centre_px[1]
    with np.errstate(invalid="ignore"):
        inside = (np.abs(u) < camera.width_px / 2 + margin_px) & (np.abs(v) < camera.height_px / 2 + margin_px)
    return np.asarray(inside, dtype=np.bool_)


def _reach_rad(radius_m: float, pose: Pose, camera: PinholeCamera, margin_px: float) -> float:
    """Return the angle at the Moon's centre within which the image sees ground, for any pointing near nadir.

    The farthest ray is that of a corner, tilted outwards by the angle between boresight and nadir; rays past the
    limb see as far as the horizon. Terrain of several kilometres is allowed for by a tenth more.
    """
    horizon = float(np.arccos(MOON_RADIUS_M / radius_m))
    corner = 0.5 * np.hypot(camera.width_px, camera.height_px) + margin_px
    down = -pose.position_icrf_m / np.linalg.norm(pose.position_icrf_m)
    tilt = np.arccos(np.clip(pose.camera_from_icrf[2] @ down, -1.0, 1.0))
    angle = float(np.arctan(corner / camera.focal_px) + tilt)
    sine = radius_m / MOON_RADIUS_M * np.sin(min(angle, 0.5 * np.pi))
    if sine >= 1.0 or angle >= 0.5 * np.pi:
        return 1.1 * horizon
    return min(1.1 * (float(np.arcsin(sine)) - angle), 1.1 * horizon)


def look(
    landmarks: LandmarkMap, index: IntArray, pose: Pose, camera: PinholeCamera, shift_enu_m: FloatArray | None = None
) -> Sighting:
    """Return the given craters as a pose sees them; NaN behind the camera.

    `shift_enu_m`, shape (n, 3), moves each crater from its catalogued place.
    """
    axes = landmarks.enu_from_mcmf[index]
    turned = turned_by(-pose.attitude_rad) @ pose.camera_from_icrf
    camera_from_mcmf = turned @ pose.mcmf_from_icrf.T
    shift = pose.catalogue_offset_m if shift_enu_m is None else shift_enu_m + pose.catalogue_offset_m
    point = landmarks.position_mcmf_m[index] + np.einsum(
        "...i,...ij->...j", np.broadcast_to(shift, (index.size, 3)), axes
    )
    seen = (point - pose.mcmf_from_icrf @ pose.position_icrf_m) @ camera_from_mcmf.T
    f, count = camera.focal_px * (1.0 + pose.scale), index.size
    depth = np.where(seen[:, 2] > 0.0, seen[:, 2], np.nan)
    x, y, scale = seen[:, 0] / depth, seen[:, 1] / depth, f / depth
    uv = np.empty((count, 2))
    uv[:, 0] = f * x + (camera.centre_px[0] + pose.pixel_bias_px[0])
    uv[:, 1] = f * y + (camera.centre_px[1] + pose.pixel_bias_px[1])
    by_point = np.zeros((count, 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = scale
    by_point[:, 0, 2], by_point[:, 1, 2] = -scale * x, -scale * y
    # From d(seen)/d(theta) = [seen x], for theta well below a radian.
    by_attitude = np.empty((count, 2, 3))
    by_attitude[:, 0, 0], by_attitude[:, 0, 1], by_attitude[:, 0, 2] = f * x * y, -f * (1.0 + x * x), f * y
    by_attitude[:, 1, 0], by_attitude[:, 1, 1], by_attitude[:, 1, 2] = f * (1.0 + y * y), -f * x * y, -f * x
    by_mcmf = by_point @ camera_from_mcmf
    return Sighting(
        index,
        uv,
        landmarks.diameter_m[index] * scale,
        -(by_point @ turned),
        by_attitude,
        by_mcmf @ np.swapaxes(axes, 1, 2),
        camera.focal_px * np.stack([x, y], axis=1),
    )


def cross_matrix(vector: FloatArray) -> FloatArray:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def turned_by(vector_rad: FloatArray) -> FloatArray:
    """Return the rotation matrix of a rotation vector (3,), by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector_rad))
    if not angle > 0.0:
        return np.eye(3)
    cross = cross_matrix(vector_rad / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross))
