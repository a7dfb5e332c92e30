"""Omission and commission errors of a lunar gravity field along a low orbit, as white noise for a filter.

A filter that gets a fix every few seconds smooths over minutes, a coast lasts an hour: what disturbs both is the slow
part of the acceleration that is missing. A field cut at a degree misses waves of higher degrees, which pass in a minute
or less; of an acceleration of 8 mGal (cut at 100) hardly anything is slow, along the track nothing at all, since that
part is the slope of the potential that the spacecraft flies over. So densities are taken from the spectrum below some
thirty waves a revolution, not from the root mean square and a correlation time, which give four times as much.

The densities below were measured on GRAIL's field with the method that the tests repeat (`measured_omission`).
"""

from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray
from lunar.constants import MOON_RADIUS_M

Densities = tuple[float, float, float]

FAR_SIDE_COSINE = float(np.cos(np.radians(105.0)))
"""Cosine of the angle from the middle of the near side beyond which no orbiter of old was in sight of the Earth:
errors of LP165P at 30 km grow from 6 mGal at 97 degrees of longitude to 30 at 127."""

# The orbit of the study: the paper's semi-major axis and eccentricity, polar.
_SEMI_MAJOR_M, _ECCENTRICITY = 1_768_180.0, 0.006908

# GRAIL's field to degree 150 beyond the degree, 16 revolutions of an orbit like the paper's at 30 km, nodes drawn at
# random: two-sided spectral density, m^2/s^3, radial, transverse, normal (transverse from the faster half: the slower
# is nothing). The first row is for a point mass.
_OMITTED_M2_S3 = {
    0: (5e-4, 2.5e-4, 2.5e-4),
    8: (3e-5, 1.2e-5, 1.8e-5),
    20: (1.4e-5, 8.5e-6, 9.5e-6),
    30: (6.5e-6, 2.1e-6, 5.7e-6),
    50: (2.0e-6, 2.7e-7, 1.8e-6),
    70: (7.2e-7, 5e-8, 5.2e-7),
    100: (1.3e-7, 4e-9, 1.2e-7),
}
# Fields made before GRAIL: tracked over the near side only, because an orbiter over the far side is not visible from
# the Earth.
_OLDER = ("LP", "GLGM", "JGL")
# LP165P against GRAIL, both to degree 100, from means over 1/12 of a revolution (555 s, about the memory of a filter
# with a fix of some 50 m every 15 s) on circular orbits at 30 km. The difference is 2 to 6 mGal over the near side and
# 30 to 43 mGal over the far side. Its slow part depends on the track. The field was fitted to polar orbits: its
# far-side errors cancel along a meridian within minutes and accumulate on an oblique track. The radial density is 2.3,
# 3.7, 10, 12, 12, 17 and 25e-6 m^2/s^3 at inclinations of 89, 85, 80, 75, 70, 60 and 45 degrees (each known to 20 %).
# A constant and a term in the cosine of the inclination fit these values.
_NEAR_SIDE_M2_S3 = (2.2e-8, 9e-10, 1.8e-8)
_FAR_SIDE_M2_S3 = (1.7e-6, 2.8e-7, 1.4e-6)
_FAR_SIDE_OBLIQUE_M2_S3 = (3.0e-5, 1.4e-6, 2.6e-5)
# The part omitted by a truncation is larger over the highlands of the far side: at 30 km, truncated at degree 100, the
# radial density is 5.9e-8 m^2/s^3 over the near side and 1.2e-7 over the far side.
_NEAR_SIDE_OMISSION, _FAR_SIDE_OMISSION = 0.7, 1.4


# The acceleration of a harmonic of degree n decreases with height as (R/r)^(n+2), its spectral density as the square.
# The part omitted by a truncation at degree N decreases like degree N + 14 within 6 %. This was measured in the same
# way on circular orbits at 15 and 46 km, for GRAIL's field to degree 150 truncated at
# degrees 8 to 100.
_OMITTED_ABOVE = 14
# The error of LP165P decreases like degree 87 over the near side and 27 over the far side, measured in the same way.
_NEAR_SIDE_DEGREE, _FAR_SIDE_DEGREE = 87, 27

REFERENCE_ALTITUDE_M = 30_000.0
"""Reference altitude of the densities in `FieldNoise`."""

MEASURED_ALTITUDES_M = (10_000.0, 100_000.0)
"""Altitude range in which the decrease of the noise with altitude was measured."""


@dataclass(frozen=True, slots=True)
class FieldNoise:
    """White acceleration that models the omission and commission errors of a gravity field, by side and altitude.

    Attributes
    ----------
    near_psd_m2_s3, far_psd_m2_s3
        Two-sided spectral density at `REFERENCE_ALTITUDE_M` over the near and the far side, radial, transverse, normal,
        on a polar orbit.
    far_oblique_psd_m2_s3
        Density added over the far side, multiplied by the cosine of the inclination.
    near_scale_height_m, far_scale_height_m
        Height difference over which the density decreases to 1/e.
    """

    near_psd_m2_s3: Densities
    far_psd_m2_s3: Densities
    far_oblique_psd_m2_s3: Densities
    near_scale_height_m: float
    far_scale_height_m: float


def field_noise(name: str, degree: int) -> FieldNoise:
    """Return the error model of a named gravity field truncated at a degree, by side of the Moon and altitude.

    The measured densities are means over the altitudes of an orbit like the paper's. If the density
    decreases to 1/e over a height H, the mean over an orbit of mean altitude h and amplitude a e is exp((30 km - h) /
    H) I0(ae / H) times that at 30 km.
    """
    omitted, height_m = omission_psd_m2_s3(degree), _scale_height_m(degree + _OMITTED_ABOVE)
    if not name.upper().startswith(_OLDER):
        psd = _at_reference(omitted, height_m)
        return FieldNoise(psd, psd, (0.0, 0.0, 0.0), height_m, height_m)
    sides = []
    for wrong, wrong_degree, share in (
        (_NEAR_SIDE_M2_S3, _NEAR_SIDE_DEGREE, _NEAR_SIDE_OMISSION),
        (_FAR_SIDE_M2_S3, _FAR_SIDE_DEGREE, _FAR_SIDE_OMISSION),
    ):
        parts = [(_times(omitted, share), height_m), (wrong, _scale_height_m(wrong_degree))]
        densities = [_at_reference(*part) for part in parts]
        # Approximate the sum of two exponentials by one with the same slope at the reference altitude.
        slope = sum(psd[0] / height for psd, (_, height) in zip(densities, parts, strict=True))
        r, t, n = np.sum(densities, axis=0).tolist()
        sides.append(((r, t, n), r / slope))
    (near, near_height), (far, far_height) = sides
    oblique = _at_reference(_FAR_SIDE_OBLIQUE_M2_S3, _scale_height_m(_FAR_SIDE_DEGREE))
    return FieldNoise(near, far, oblique, near_height, far_height)


def densities_at(noise: FieldNoise, position_mcmf_m: FloatArray, velocity_mcmf_m_s: FloatArray) -> FloatArray:
    """Return the spectral densities (n, 3; R, T, N) at places (n, 3) of orbits with inertial velocities (n, 3)."""
    radius_m = np.linalg.norm(position_mcmf_m, axis=1)
    normal = np.cross(position_mcmf_m, velocity_mcmf_m_s)
    cosine = np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
    far = (position_mcmf_m[:, 0] <= FAR_SIDE_COSINE * radius_m)[:, None]
    densities = np.where(
        far,
        np.array(noise.far_psd_m2_s3) + cosine[:, None] * np.array(noise.far_oblique_psd_m2_s3),
        np.array(noise.near_psd_m2_s3),
    )
    height_m = np.where(far[:, 0], noise.far_scale_height_m, noise.near_scale_height_m)
    altitude_m = np.clip(radius_m - MOON_RADIUS_M, *MEASURED_ALTITUDES_M)
    factor = np.exp((REFERENCE_ALTITUDE_M - altitude_m) / height_m)
    return np.asarray(factor[:, None] * densities, dtype=np.float64)


def _scale_height_m(degree: float) -> float:
    return _SEMI_MAJOR_M / (2.0 * (degree + 2.0))


def _at_reference(mean: Densities, scale_height_m: float) -> Densities:
    """Return the density at the reference altitude from its mean over the orbit of the study."""
    altitude_m, amplitude_m = _SEMI_MAJOR_M - MOON_RADIUS_M, _SEMI_MAJOR_M * _ECCENTRICITY
    gain = np.exp((REFERENCE_ALTITUDE_M - altitude_m) / scale_height_m) * np.i0(amplitude_m / scale_height_m)
    return mean[0] / float(gain), mean[1] / float(gain), mean[2] / float(gain)


def omission_psd_m2_s3(degree: int) -> Densities:
    """Return the spectral density (R, T, N) of the white acceleration that represents the omitted gravity."""
    degrees = sorted(_OMITTED_M2_S3)
    r, t, n = (
        float(np.exp(np.interp(degree, degrees, [np.log(_OMITTED_M2_S3[known][axis]) for known in degrees])))
        for axis in range(3)
    )
    return r, t, n


def _times(one: Densities, factor: float) -> Densities:
    return factor * one[0], factor * one[1], factor * one[2]
