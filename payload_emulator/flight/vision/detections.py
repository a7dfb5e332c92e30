"""Output of a detector for navigation: crater positions and sizes in one image, in pixels.

Pixel centres lie at integer coordinates, u to the right, v down.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, IntArray
from payload_emulator.flight.vision.preprocess import ImageQuality

FRESH_DEPTH_RATIO = 0.10
DEGRADED_DEPTH_RATIO = 0.06
"""Above the first a crater is called fresh, below the second degraded: the bins of degradation used in scoring."""


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Craters found in one image; arrays of one length n, float64 (classes int64), NaN where a quantity is not known.

    `depth_ratio` is None where the network does not tell it.

    Attributes
    ----------
    u_px, v_px
        Centre of the crater.
    diameter_px
        Diameter across the line of sight: focal length times diameter over depth along the boresight.
    score
        Confidence, 0 to 1.
    sigma_px
        Standard deviation of the centre along each axis, errors of the catalogue not included.
    depth_ratio
        Depth over diameter as it looks: about 0.2 fresh, under `DEGRADED_DEPTH_RATIO` worn down.
    persistence
        Share of the variance `sigma_px**2` that is the same in every frame of the crater; None where it is not known.
    size_class, diameter_m
        Of a detector that gives classes and no sizes: the class (0, 1, 2), and as a prior of the size the median
        diameter of that class; None otherwise. Its `diameter_px` is NaN until `with_prior_sizes`.
    """

    u_px: FloatArray
    v_px: FloatArray
    diameter_px: FloatArray
    score: FloatArray
    sigma_px: FloatArray
    depth_ratio: FloatArray | None = None
    size_class: IntArray | None = None
    diameter_m: FloatArray | None = None
    persistence: FloatArray | None = None

    def __len__(self) -> int:
        return int(self.u_px.shape[0])

    def select(self, which: NDArray[Any]) -> Detections:
        """Return the detections of a mask or of indices, in that order."""
        columns = (getattr(self, one.name) for one in fields(self))
        chosen: list[Any] = [None if values is None else values[which] for values in columns]
        return Detections(*chosen)

    def with_prior_sizes(self, depth_m: FloatArray, focal_px: float) -> Detections:
        """Return the detections with apparent diameters of their priors at a depth (n,) along the boresight."""
        if self.diameter_m is None:
            return self
        return replace(self, diameter_px=focal_px * self.diameter_m / depth_m)


def states(found: Detections) -> list[str]:
    """Return "fresh", "worn" or "degraded" for each detection, "" where the network does not tell."""
    if found.depth_ratio is None:
        return [""] * len(found)
    return [
        "fresh" if ratio >= FRESH_DEPTH_RATIO else "worn" if ratio >= DEGRADED_DEPTH_RATIO else "degraded"
        for ratio in found.depth_ratio
    ]


def no_detections() -> Detections:
    """Return an empty set of detections."""
    none = np.empty(0)
    return Detections(none, none, none, none, none)


class Detector(Protocol):
    """Anything that finds craters in a camera frame."""

    def examine(self, image: NDArray[Any], sun_in_camera: FloatArray | None = None) -> tuple[ImageQuality, Detections]:
        """Return the verdict on an image (H, W) or (H, W, 3) and its craters; none unless the verdict is OK.

        The Sun vector, camera frame, helps and may be absent.
        """
        ...
