"""Reduced images: detections drawn from the catalogue where no image is rendered."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, IntArray
from lunar.camera import project_mcmf
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from payload_emulator.flight.vision.detections import Detections, no_detections
from payload_emulator.flight.vision.preprocess import ImageQuality
from payload_emulator.session.world.camera import Exposure
from payload_emulator.session.world.world import World
from payload_emulator.sim.detector import SimulatedDetector

# A detector as the one that flies, roughly: what is drawn where no image is rendered.
_REDUCED_RECALL, _SMALLEST_PX = 0.7, 5.0
_REDUCED_DETECTOR = SimulatedDetector(precision=1.0, sigma_px=0.6, log_diameter_sigma=0.0)


@dataclass(slots=True, eq=False)
class CatalogueDetector:
    """In place of the network where no images are rendered: the craters in view, some missed, all a little off."""

    seed: int
    _rng: np.random.Generator = field(init=False)
    _next: Detections = field(default_factory=no_detections)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng((self.seed, 2**43))

    def show(self, world: World, exposure: Exposure) -> None:
        """Prepare what is found in the next frame."""
        _, uv, diameter_px = craters_in_view(world, exposure, _SMALLEST_PX)
        seen = self._rng.random(diameter_px.size) < _REDUCED_RECALL
        camera = world.camera
        corner = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
        places, sizes = _REDUCED_DETECTOR.detect(uv[seen], diameter_px[seen], corner, self._rng)
        sigma = np.full(sizes.size, _REDUCED_DETECTOR.stated_sigma_px)
        self._next = Detections(places[:, 0], places[:, 1], sizes, np.full(sizes.size, 0.9), sigma)

    def examine(
        self, image: NDArray[Any], sun_in_camera: FloatArray | None = None
    ) -> tuple[ImageQuality, Detections]:
        found, self._next = self._next, no_detections()
        if not image.size:
            return ImageQuality.INVALID, no_detections()
        if not image.any():
            return ImageQuality.DARK, no_detections()
        if image.min() == 255:
            return ImageQuality.SATURATED, no_detections()
        return ImageQuality.OK, found


def craters_in_view(
    world: World, exposure: Exposure, smallest_px: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the craters in an image: index, place (n, 2) and diameter (n,) in pixels; unknown heights are 0."""
    position = world.truth.positions_mcmf(exposure.utc_ns)[0]
    latitude, longitude, altitude = (float(value) for value in spherical_from_mcmf(position))
    craters, camera = world.terrain.catalogue, world.true_camera
    reach_m = min(2.5 * altitude * np.tan(camera.fov_rad / 2.0), 0.1 * MOON_RADIUS_M)
    near = craters.near(latitude, longitude, reach_m)
    height_m = np.nan_to_num(craters.rim_height_m[near], nan=0.0)
    points = mcmf_from_spherical(craters.latitude_rad[near], craters.longitude_rad[near], height_m)
    uv = project_mcmf(camera, exposure.camera_from_mcmf, position, points)
    depth_m = (points - position) @ exposure.camera_from_mcmf[2]
    with np.errstate(invalid="ignore", divide="ignore"):
        diameter_px = camera.focal_px * craters.diameter_m[near] / depth_m
        inside = np.all((uv > 0.0) & (uv < np.array([camera.width_px, camera.height_px]) - 1), axis=1)
        seen = np.flatnonzero(inside & (diameter_px > smallest_px))
    return near[seen], uv[seen], diameter_px[seen]
