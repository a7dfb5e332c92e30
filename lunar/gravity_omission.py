"""What a lunar gravity field leaves out along a low orbit, or has wrong, as white noise that a filter can carry.

A filter that gets a fix every few seconds smooths over minutes, a coast lasts an hour: what disturbs both is the slow
part of the acceleration that is missing. A field cut at a degree misses waves of higher degrees, which pass in a minute
or less; of an acceleration of 8 mGal (cut at 100) hardly anything is slow, along the track nothing at all, since that
part is the slope of the potential that the spacecraft flies over. So densities are taken from the spectrum below some
thirty waves a revolution, not from the root mean square and a correlation time, which give four times as much.

`measured_omission` makes such densities from any two fields (`linna orbit omission`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray
from lunar.constants import MOON_RADIUS_M
from lunar.gravity import GravityField, acceleration

Densities = tuple[float, float, float]

FAR_SIDE_COSINE = float(np.cos(np.radians(105.0)))
"""Cosine of the angle from the middle of the near side beyond which no orbiter of old was in sight of the Earth:
errors of LP165P at 30 km grow from 6 mGal at 97 degrees of longitude to 30 at 127."""

# The orbit of the study: the paper's semi-major axis and eccentricity, polar.
_SEMI_MAJOR_M, _ECCENTRICITY = 1_768_180.0, 0.006908

# GRAIL's field to degree 150 beyond the degree, 16 revolutions of an orbit like the paper's at 30 km, nodes drawn at
# random: two-sided spectral density, m^2/s^3, radial, transverse, normal (transverse from the faster half: the slower
# is nothing), made by `linna orbit omission --degree N`. The first row is for a point mass.
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
# A constant and a term in the cosine of the inclination fit these values (`linna orbit omission --flown FILE
# --inclination-deg I`).
_NEAR_SIDE_M2_S3 = (2.2e-8, 9e-10, 1.8e-8)
_FAR_SIDE_M2_S3 = (1.7e-6, 2.8e-7, 1.4e-6)
_FAR_SIDE_OBLIQUE_M2_S3 = (3.0e-5, 1.4e-6, 2.6e-5)
# The part omitted by a truncation is larger over the highlands of the far side: at 30 km, truncated at degree 100, the
# radial density is 5.9e-8 m^2/s^3 over the near side and 1.2e-7 over the far side.
_NEAR_SIDE_OMISSION, _FAR_SIDE_OMISSION = 0.7, 1.4


# The acceleration of a harmonic of degree n decreases with height as (R/r)^(n+2), its spectral density as the square.
# The part omitted by a truncation at degree N decreases like degree N + 14 within 6 %. This was measured with the
# method of `linna orbit omission` on circular orbits at 15 and 46 km, for GRAIL's field to degree 150 truncated at
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

    The densities of `field_psd_m2_s3` are means over the altitudes of an orbit like the paper's. If the density
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
        total = _sum(*densities)
        sides.append((total, total[0] / slope))
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


def field_psd_m2_s3(
    name: str, degree: int, inclination_rad: float = 0.5 * np.pi
) -> tuple[Densities, Densities]:
    """Spectral densities of what a field by its name, cut at a degree, lacks or has wrong: near side and far side."""
    omitted = omission_psd_m2_s3(degree)
    if not name.upper().startswith(_OLDER):
        return omitted, omitted
    oblique = _times(_FAR_SIDE_OBLIQUE_M2_S3, abs(float(np.cos(inclination_rad))))
    near = _sum(_times(omitted, _NEAR_SIDE_OMISSION), _NEAR_SIDE_M2_S3)
    return near, _sum(_sum(_times(omitted, _FAR_SIDE_OMISSION), _FAR_SIDE_M2_S3), oblique)


def _sum(one: Densities, other: Densities) -> Densities:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _times(one: Densities, factor: float) -> Densities:
    return factor * one[0], factor * one[1], factor * one[2]


_MOON_TURN_RAD_S = 2.6617e-6
_SAMPLES, _WAVES = 960, 30
_PIECES = 12


@dataclass(frozen=True, slots=True, eq=False)
class Omission:
    """Acceleration by which two gravity fields differ along low orbits: radial, transverse, normal.

    Attributes
    ----------
    psd_m2_s3
        Two-sided spectral density over 1 to 30 waves a revolution, transverse over 16 to 30; shape (3,).
    near_psd_m2_s3, far_psd_m2_s3
        The same by side of the Moon, from means over a twelfth of a revolution that lies on one side.
    rms_m_s2, near_rms_m_s2, far_rms_m_s2
        Root mean square, all waves.
    """

    revolutions: int
    psd_m2_s3: FloatArray
    near_psd_m2_s3: FloatArray
    far_psd_m2_s3: FloatArray
    rms_m_s2: FloatArray
    near_rms_m_s2: FloatArray
    far_rms_m_s2: FloatArray


def measured_omission(
    truth: GravityField,
    flown: GravityField,
    revolutions: int = 16,
    seed: int = 1,
    inclination_rad: float = 0.5 * np.pi,
) -> Omission:
    """Measure the errors of `flown` relative to `truth`, over revolutions with random nodes and perilunes."""
    rng = np.random.default_rng(seed)
    period_s = float(2.0 * np.pi * np.sqrt(_SEMI_MAJOR_M**3 / truth.gm_m3_s2))
    differences, far = [], []
    for node_rad, perilune_rad in rng.uniform(0.0, 2.0 * np.pi, (revolutions, 2)):
        position, rtn = _revolution(inclination_rad, node_rad, perilune_rad, period_s)
        missing = acceleration(truth, position) - acceleration(flown, position)
        differences.append(np.einsum("nij,nj->ni", rtn, missing))
        far.append(position[:, 0] < FAR_SIDE_COSINE * np.linalg.norm(position, axis=1))
    along, beyond = np.stack(differences), np.stack(far)
    spectrum = np.abs(np.fft.fft(along, axis=1)) ** 2 * period_s / _SAMPLES**2
    slow = spectrum[:, 1 : _WAVES + 1].mean(axis=(0, 1))
    slow[1] = spectrum[:, 1 + _WAVES // 2 : _WAVES + 1, 1].mean()
    pieces = along.reshape(-1, _SAMPLES // _PIECES, 3).mean(axis=1) ** 2 * period_s / _PIECES
    piece_beyond = beyond.reshape(-1, _SAMPLES // _PIECES).mean(axis=1)
    rows, row_beyond = along.reshape(-1, 3), beyond.reshape(-1)
    return Omission(
        revolutions,
        slow,
        pieces[piece_beyond == 0.0].mean(axis=0),
        pieces[piece_beyond == 1.0].mean(axis=0),
        _rms(rows),
        _rms(rows[~row_beyond]),
        _rms(rows[row_beyond]),
    )


def _revolution(
    inclination_rad: float, node_rad: float, perilune_rad: float, period_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return positions (n, 3) in Moon-fixed axes over a revolution, and the axes R, T, N there (n, 3, 3)."""
    # Even steps of the argument of latitude: at this eccentricity within 1 % of even steps of time.
    angle = np.arange(_SAMPLES) / _SAMPLES * 2.0 * np.pi
    node = node_rad - _MOON_TURN_RAD_S * period_s * angle / (2.0 * np.pi)
    zero = np.zeros_like(node)
    outwards = np.stack([np.cos(node), np.sin(node), zero], axis=1)
    east = np.stack([-np.sin(node), np.cos(node), zero], axis=1)
    ahead = np.cos(inclination_rad) * east + np.sin(inclination_rad) * np.array([0.0, 0.0, 1.0])
    radial = np.cos(angle)[:, None] * outwards + np.sin(angle)[:, None] * ahead
    transverse = -np.sin(angle)[:, None] * outwards + np.cos(angle)[:, None] * ahead
    rtn = np.stack([radial, transverse, np.cross(radial, transverse)], axis=1)
    radius = _SEMI_MAJOR_M * (1.0 - _ECCENTRICITY**2) / (1.0 + _ECCENTRICITY * np.cos(angle - perilune_rad))
    return radius[:, None] * radial, rtn


def _rms(rows: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(rows**2, axis=0)), dtype=np.float64)
