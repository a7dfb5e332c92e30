"""Photometry of the regolith: Lambert, Lunar-Lambert and Hapke, as tables over the phase angle.

A fourth law, ``matt``, is Lambert without any fall of brightness with phase: what the paper's Principled BSDF comes to.

Radiance is in units of a white Lambert surface under a perpendicular Sun; the reflectance of every law is
``albedo * phase(g) * [2 w(g) mu0 / (mu0 + mu) + (1 - w(g)) mu0]``, Hapke's with an added multiple-scattering term.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from payload_emulator.errors import PayloadError

Cosines = npt.NDArray[np.float32]

LAWS = ("lunar-lambert", "lambert", "hapke", "matt")
TABLE_SIZE = 512
SMALLEST_EMISSION = 0.02
"""Ground is taken to face the camera with at least this cosine, by the renderers' kernels as well."""

HAPKE_SINGLE_SCATTERING = 0.21
HAPKE_SURGE = 2.01
HAPKE_SURGE_WIDTH = 0.07
"""Parameters of an average Moon after Helfenstein and Veverka (1987, Icarus 72, 342-357), smooth surface."""


@dataclass(frozen=True, slots=True)
class Photometry:
    """A photometric law.

    Attributes
    ----------
    law
        ``lunar-lambert`` (McEwen 1996 limb darkening), ``lambert``, ``hapke`` or ``matt``.
    phase_slope_per_rad
        Exponential fall of brightness with phase angle of the first two laws; 0.7 follows Hapke's lunar phase
        curve from 20 to 100 degrees.
    albedo_contrast
        Scales the departures of the albedo from its mean: 0 is a surface of one albedo.
    """

    law: str = "lunar-lambert"
    phase_slope_per_rad: float = 0.7
    albedo_contrast: float = 1.0

    def __post_init__(self) -> None:
        if self.law not in LAWS:
            raise PayloadError(f"photometry: expected a law out of {', '.join(LAWS)}, found {self.law!r}")

    def tables(self) -> npt.NDArray[np.float32]:
        """Table (3, 514) over ``(cos g + 1) * 256``: weight of Lommel-Seeliger, of Lambert, multiple scattering."""
        cosine = np.clip(np.arange(TABLE_SIZE + 2) / (TABLE_SIZE / 2) - 1.0, -1.0, 1.0)
        g = np.arccos(cosine)
        if self.law == "hapke":
            surge = HAPKE_SURGE / (1.0 + np.tan(np.minimum(0.5 * g, 1.55)) / HAPKE_SURGE_WIDTH)
            # Legendre phase function of Hapke's lunar fit: 1 + b cos g + c (1.5 cos^2 g - 0.5).
            single = np.maximum(1.0 + 0.29 * cosine + 0.39 * (1.5 * cosine**2 - 0.5), 0.0)
            # The normal reflectance at g = 0 is scaled to the albedo, so that laws agree in what albedo means.
            w = HAPKE_SINGLE_SCATTERING
            h_one = 3.0 / (1.0 + 2.0 * math.sqrt(1.0 - w))
            normal = 0.5 * ((1.0 + HAPKE_SURGE) * 1.68 + h_one * h_one - 1.0)
            return np.asarray(
                np.stack([((1.0 + surge) * single - 1.0) / normal, np.zeros_like(g), np.full_like(g, 1.0 / normal)]),
                dtype=np.float32,
            )
        phase = np.ones_like(g) if self.law == "matt" else np.exp(-self.phase_slope_per_rad * g)
        if self.law in ("lambert", "matt"):
            weight = np.zeros_like(g)
        else:
            degrees = np.degrees(g)
            # McEwen (1996, LPSC 27, 841): partition between Lommel-Seeliger and Lambert for the Moon.
            weight = np.clip(1.0 - 0.019 * degrees + 0.242e-3 * degrees**2 - 1.46e-6 * degrees**3, 0.0, 1.0)
        return np.asarray(np.stack([2.0 * weight * phase, (1.0 - weight) * phase, np.zeros_like(g)]), dtype=np.float32)

    def over_lambert(self, mu0: Cosines, mu: Cosines, cos_phase: Cosines) -> Cosines:
        """Reflectance of this law over that of a matt Lambert surface of the same albedo, per place.

        ``mu0``, ``mu``: cosines of incidence and emission, those below 0 and ``SMALLEST_EMISSION`` taken as these;
        ``cos_phase``: cosine of the phase angle.  The bound on ``mu`` bounds the ratio.
        """
        place = np.clip((cos_phase + 1.0) * (TABLE_SIZE / 2), 0.0, TABLE_SIZE)
        seeliger, lambert, multiple = (
            np.interp(place, np.arange(TABLE_SIZE + 2), row).astype(np.float32) for row in self.tables()
        )
        mu0, mu = np.maximum(mu0, 0.0), np.maximum(mu, SMALLEST_EMISSION)
        if self.law == "hapke":
            gamma = math.sqrt(1.0 - HAPKE_SINGLE_SCATTERING)
            seeliger = seeliger + multiple * (
                (1.0 + 2.0 * mu0) / (1.0 + 2.0 * gamma * mu0) * (1.0 + 2.0 * mu) / (1.0 + 2.0 * gamma * mu)
            )
        return np.asarray(lambert + seeliger / (mu0 + mu), dtype=np.float32)
