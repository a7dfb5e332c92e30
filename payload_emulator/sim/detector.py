"""The simulated detector: detections drawn from the craters in view, without an image.

All simulations without images use it: reduced flights of the session, the Monte Carlo of navigation, and the study of
identification.
"""

from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.catalogue import size_class

_FALSE_DIAMETERS_PX = (15.0, 60.0)
"""Sizes of false detections where no true one lends its size: craters of 5 to 15 km from 30 to 50 km."""


@dataclass(frozen=True, slots=True)
class SimulatedDetector:
    """Detector model given by its confusion table.

    Attributes
    ----------
    recall
        By size class 0, 1, 2 and 3 (3 to 5 km); craters of other sizes are not found.
    precision
        Share of detections that are craters; the others are distributed uniformly, with the diameters of true ones.
    sigma_px
        Error of centres, per axis; `claimed_sigma_px` is the value that the detector reports (None: the true one).
    persistence
        Share of the variance that is common to all frames of a crater.
    bias_px, bias_sigma_px, bias_correlation_s
        Shift of all detections, right and down: a given value plus a first-order Gauss-Markov process with this
        correlation time (infinite: constant for a run).
    scale, scale_sigma
        Scale error of all detections about the image centre: a given value plus a random value for each run.
    log_diameter_sigma
        Error of the logarithm of the diameter.
    """

    recall: tuple[float, float, float, float] = (0.6, 0.6, 0.7, 0.6)
    precision: float = 0.85
    sigma_px: float = 1.5
    claimed_sigma_px: float | None = None
    persistence: float = 0.0
    bias_px: tuple[float, float] = (0.0, 0.0)
    bias_sigma_px: float = 0.0
    bias_correlation_s: float = float("inf")
    scale: float = 0.0
    scale_sigma: float = 0.0
    log_diameter_sigma: float = 0.1

    @property
    def stated_sigma_px(self) -> float:
        """Error of centres that the detector reports."""
        return self.sigma_px if self.claimed_sigma_px is None else self.claimed_sigma_px

    def found(self, diameter_m: FloatArray, rng: np.random.Generator) -> IntArray:
        """Return the indices of the craters (n,) that are found."""
        recall = np.array([*self.recall, 0.0])[size_class(diameter_m)]
        return np.flatnonzero(rng.uniform(size=diameter_m.size) < recall)

    def detect(
        self,
        uv_px: FloatArray,
        diameter_px: FloatArray,
        corner_px: FloatArray,
        rng: np.random.Generator,
        lasting: FloatArray | None = None,
        bias_px: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return places (m, 2) and apparent diameters (m,) of detections: of the craters found (n,), then false ones.

        Parameters
        ----------
        uv_px, diameter_px
            True places (n, 2) and apparent diameters of the craters that are found.
        corner_px
            Last pixel of the image, right and down; false detections lie between the first and it.
        lasting
            Part of the errors (n, 2) that stays with each crater, of unit variance; None for none.
        bias_px
            Shift of all true detections (2,) at this moment; None for the constant `bias_px` of the detector.
        """
        count = diameter_px.size
        noise = rng.standard_normal((count, 2))
        if lasting is not None:
            noise = np.sqrt(1.0 - self.persistence) * noise + np.sqrt(self.persistence) * lasting
        places = uv_px + self.sigma_px * noise + (np.array(self.bias_px) if bias_px is None else bias_px)
        sizes = diameter_px
        if self.log_diameter_sigma > 0.0:
            sizes = sizes * np.exp(self.log_diameter_sigma * rng.standard_normal(count))
        if self.precision < 1.0:
            false = int(rng.poisson(max(count, 1) * (1.0 / self.precision - 1.0)))
            places = np.concatenate([places, rng.uniform(size=(false, 2)) * corner_px])
            lent = rng.choice(sizes, false) if count else rng.uniform(*_FALSE_DIAMETERS_PX, false)
            sizes = np.concatenate([sizes, lent])
        return places, sizes
