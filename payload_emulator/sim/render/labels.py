"""Exact labels: where each catalogue crater's rim lies in a picture."""

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera, project_mcmf
from lunar.catalogue import CraterCatalogue, size_class
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from payload_emulator.sim.terrain.tiles import Terrain

RIM_POINTS = 24
HIDDEN_SHARE = 0.1
"""A rim is hidden where the picture's ground is nearer by this share of the way: more than rims are uneven."""

LARGEST_LABEL_M = 120.0e3
"""Larger basins never fit in a picture and are not labelled."""


@dataclass(frozen=True, eq=False, slots=True)
class Labels:
    """Craters of one picture, arrays of one length.

    Attributes
    ----------
    index
        Row in the catalogue that was projected.
    u_px, v_px
        The crater's centre at rim height, moved with the middle of a tilted rim; pixel centres are integers.
    diameter_px
        Apparent diameter: geometric mean of the axes of the rim's ellipse.
    major_px, minor_px, angle_rad
        Full axes of that ellipse; angle of the major axis from +u toward +v.
    size_class
        0, 1, 2, 3 by diameter on the ground, -1 outside.
    diameter_m, depth_m
        From the catalogue, depth as measured there (NaN unknown).
    inside
        Whether the centre lies within the picture.
    visible_fraction
        Share of the rim within the picture (1 is not cut).
    lit_fraction
        Share of the visible ground within the rim that sees the Sun; NaN if no shadow picture was given.
    sight_fraction
        Share of the rim within the picture that no nearer ground hides; NaN if no ranges were given.
    """

    index: IntArray
    u_px: FloatArray
    v_px: FloatArray
    diameter_px: FloatArray
    major_px: FloatArray
    minor_px: FloatArray
    angle_rad: FloatArray
    size_class: npt.NDArray[np.int8]
    diameter_m: FloatArray
    depth_m: FloatArray
    inside: BoolArray
    visible_fraction: FloatArray
    lit_fraction: FloatArray
    sight_fraction: FloatArray

    def __len__(self) -> int:
        return self.index.size


def view_radius_m(camera: PinholeCamera, position_mcmf_m: npt.ArrayLike, camera_from_mcmf: npt.ArrayLike) -> float:
    """Ground distance from below the camera to the farthest ground in the picture, with room for relief of 5 km."""
    position = np.asarray(position_mcmf_m, dtype=np.float64)
    distance = float(np.linalg.norm(position))
    down = -position / distance
    rays = camera.rays(camera.corners_px()) @ np.asarray(camera_from_mcmf, dtype=np.float64)
    off_nadir = np.arccos(np.clip(rays @ down, -1.0, 1.0)).max()
    ground = MOON_RADIUS_M - 5_000.0
    horizon = math.acos(min(1.0, ground / distance))
    sine = distance / ground * math.sin(min(off_nadir, 0.5 * math.pi))
    arc = horizon if sine >= 1.0 or off_nadir > 0.5 * math.pi else math.asin(sine) - off_nadir
    return float(arc * MOON_RADIUS_M)


def label_frame(
    terrain: Terrain,
    camera: PinholeCamera,
    position_mcmf_m: npt.ArrayLike,
    camera_from_mcmf: npt.ArrayLike,
    minimum_diameter_m: float = 2_500.0,
    lit: npt.NDArray[np.float32] | None = None,
    range_m: npt.NDArray[np.float32] | None = None,
) -> Labels:
    """Labels of a terrain's own catalogue, rims at the heights the terrain shows; ``index`` is into that catalogue.

    Heights are measured on the terrain, once, for craters that can be in the picture, so nothing far away is made.
    """
    position = np.asarray(position_mcmf_m, dtype=np.float64)
    rotation = np.asarray(camera_from_mcmf, dtype=np.float64)
    latitude, longitude, _ = spherical_from_mcmf(position)
    catalogue = terrain.catalogue
    reach = view_radius_m(camera, position, rotation) + LARGEST_LABEL_M / 2.0
    near = np.asarray(catalogue.near(float(latitude), float(longitude), reach), dtype=np.int64)
    size = catalogue.diameter_m[near]
    near = near[(size >= minimum_diameter_m) & (size <= LARGEST_LABEL_M)]
    local = catalogue.select(near)
    up = mcmf_from_spherical(local.latitude_rad, local.longitude_rad, 0.0) / MOON_RADIUS_M
    # A crater can only be in the picture if it is at one of the heights that ground has.
    margin = 0.5 * local.diameter_m / max(float(np.linalg.norm(position)) - MOON_RADIUS_M, 1.0e3) * camera.focal_px
    possible = np.zeros(near.size, dtype=bool)
    for height in (-4_000.0, 0.0, 4_000.0):
        uv = project_mcmf(camera, rotation, position, up * (MOON_RADIUS_M + height))
        off = np.abs(uv - np.array(camera.centre_px)) - np.array([camera.width_px, camera.height_px]) / 2.0
        possible |= off.max(axis=1) <= 1.3 * margin + 4.0
    near = near[possible]
    tilts = terrain.rim_tilts_m(near)
    labels = project_craters(
        terrain.measured(near), camera, position, rotation, minimum_diameter_m, lit, range_m, tilts
    )
    return replace(labels, index=near[labels.index])


def project_craters(
    catalogue: CraterCatalogue,
    camera: PinholeCamera,
    position_mcmf_m: npt.ArrayLike,
    camera_from_mcmf: npt.ArrayLike,
    minimum_diameter_m: float = 2_500.0,
    lit: npt.NDArray[np.float32] | None = None,
    range_m: npt.NDArray[np.float32] | None = None,
    rim_tilt_m: FloatArray | None = None,
) -> Labels:
    """Labels of all craters of the catalogue with any part of the rim in the picture.

    Rims are circles at rim height (the map sphere where it is unknown) about the local vertical, higher by
    ``rim_tilt_m`` (n, 2) in the north and the east and lower opposite, projected point by point; centre and axes come
    from the ellipse through them.  ``lit`` and ``range_m`` (H, W) are a `Rendering`'s.
    """
    position = np.asarray(position_mcmf_m, dtype=np.float64)
    rotation = np.asarray(camera_from_mcmf, dtype=np.float64)
    latitude, longitude, _ = spherical_from_mcmf(position)
    radius = view_radius_m(camera, position, rotation)
    largest = float(catalogue.diameter_m.max()) if len(catalogue) else 0.0
    near = np.asarray(catalogue.near(float(latitude), float(longitude), radius + 0.5 * largest), dtype=np.int64)
    near = near[catalogue.diameter_m[near] >= minimum_diameter_m]
    chosen = catalogue.select(near)
    centre, rim = _rim_points(chosen)
    centre_uv = project_mcmf(camera, rotation, position, centre)
    rim_uv = project_mcmf(camera, rotation, position, rim)
    if rim_tilt_m is not None:
        level_uv = rim_uv
        _, rim = _rim_points(chosen, rim_tilt_m[near])
        rim_uv = project_mcmf(camera, rotation, position, rim)
        # The far side of a tilted rim is drawn smaller than the near one: its middle moves.
        centre_uv = centre_uv + (rim_uv - level_uv).mean(axis=1)
    within = camera.contains(rim_uv)
    # Beyond the limb the line of sight runs through the Moon: the surface normal there points away.
    facing = np.einsum("nki,nki->nk", position - rim, rim) > 0.0
    keep = (within & facing).any(axis=1) & np.isfinite(rim_uv).all(axis=(1, 2)) & facing.all(axis=1)
    keep |= camera.contains(centre_uv) & np.isfinite(rim_uv).all(axis=(1, 2)) & facing.all(axis=1)
    near, centre_uv, rim_uv, within = near[keep], centre_uv[keep], rim_uv[keep], within[keep]
    distance = np.linalg.norm(rim[keep] - position, axis=-1)
    major, minor, angle = _axes(rim_uv, centre_uv)
    return Labels(
        index=near,
        u_px=centre_uv[:, 0],
        v_px=centre_uv[:, 1],
        diameter_px=np.sqrt(major * minor),
        major_px=major,
        minor_px=minor,
        angle_rad=angle,
        size_class=np.asarray(size_class(catalogue.diameter_m[near]), dtype=np.int8),
        diameter_m=catalogue.diameter_m[near],
        depth_m=catalogue.depth_m[near],
        inside=camera.contains(centre_uv),
        visible_fraction=within.mean(axis=1) if near.size else np.empty(0),
        lit_fraction=np.full(near.size, np.nan) if lit is None else _lit_fraction(rim_uv, centre_uv, lit),
        sight_fraction=(
            np.full(near.size, np.nan) if range_m is None else _sight_fraction(rim_uv, within, distance, range_m)
        ),
    )


def _rim_points(catalogue: CraterCatalogue, tilt_m: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    """Centres (n, 3) and rims (n, 24, 3) in MCMF at rim height, on planes tilted by (n, 2) toward north and east."""
    height = np.nan_to_num(catalogue.rim_height_m, nan=0.0)
    latitude, longitude = catalogue.latitude_rad, catalogue.longitude_rad
    up = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=-1
    )
    east = np.stack([-np.sin(longitude), np.cos(longitude), np.zeros_like(longitude)], axis=-1)
    north = np.cross(up, east)
    arc = 0.5 * catalogue.diameter_m / MOON_RADIUS_M
    azimuth = np.arange(RIM_POINTS) * (2.0 * math.pi / RIM_POINTS)
    circle = np.cos(arc)[:, None, None] * up[:, None] + np.sin(arc)[:, None, None] * (
        np.cos(azimuth)[:, None] * north[:, None] + np.sin(azimuth)[:, None] * east[:, None]
    )
    distance = (MOON_RADIUS_M + height)[:, None]
    rim = np.broadcast_to(distance, (len(catalogue), RIM_POINTS))
    if tilt_m is not None:
        rim = rim + tilt_m @ np.stack([np.cos(azimuth), np.sin(azimuth)])
    return distance * up, rim[..., None] * circle


def _axes(rim_uv: FloatArray, centre_uv: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Full axes and angle of the ellipses through equally spaced rim points, from their second moments."""
    offset = rim_uv - rim_uv.mean(axis=1, keepdims=True) if rim_uv.size else rim_uv
    # Points equally spaced in parameter have covariance axis^2 / 2 along each axis.
    covariance = np.einsum("nki,nkj->nij", offset, offset) / RIM_POINTS
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    middle, spread = 0.5 * (a + c), np.hypot(0.5 * (a - c), b)
    major = 2.0 * np.sqrt(2.0 * (middle + spread))
    minor = 2.0 * np.sqrt(2.0 * np.maximum(middle - spread, 0.0))
    return major, minor, 0.5 * np.arctan2(2.0 * b, a - c)


def _lit_fraction(rim_uv: FloatArray, centre_uv: FloatArray, lit: npt.NDArray[np.float32]) -> FloatArray:
    """Mean of the shadow picture over the rim's inside, sampled on rings that halve the area."""
    if not rim_uv.size:
        return np.empty(0)
    rings = np.sqrt((np.arange(4) + 0.5) / 4.0)[:, None, None]
    points = centre_uv[:, None, None] + rings * (rim_uv - centre_uv[:, None])[:, None]
    u = np.rint(points[..., 0]).astype(np.int64)
    v = np.rint(points[..., 1]).astype(np.int64)
    height, width = lit.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    values = np.where(inside, lit[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)], 0.0)
    count = inside.sum(axis=(1, 2))
    return np.where(count > 0, values.sum(axis=(1, 2)) / np.maximum(count, 1), np.nan)


def _sight_fraction(
    rim_uv: FloatArray, within: BoolArray, distance_m: FloatArray, range_m: npt.NDArray[np.float32]
) -> FloatArray:
    """Share of the rim points within the picture at which the picture shows the rim and nothing nearer."""
    if not rim_uv.size:
        return np.empty(0)
    height, width = range_m.shape
    u = np.clip(np.rint(rim_uv[..., 0]).astype(np.int64), 0, width - 1)
    v = np.clip(np.rint(rim_uv[..., 1]).astype(np.int64), 0, height - 1)
    clear = within & (range_m[v, u] >= (1.0 - HIDDEN_SHARE) * distance_m)
    count = within.sum(axis=1)
    return np.where(count > 0, clear.sum(axis=1) / np.maximum(count, 1), np.nan)
