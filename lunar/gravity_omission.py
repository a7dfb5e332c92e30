"""What a lunar gravity field leaves out along a low orbit, or has wrong, as white noise that a filter can carry.

A filter that gets a fix every few seconds smooths over minutes, a coast lasts an hour: what disturbs both is the slow
part of the acceleration that is missing. A field cut at a degree misses waves of higher degrees, which pass in a minute
or less; of an acceleration of 8 mGal (cut at 100) hardly anything is slow, along the track nothing at all, since that
part is the slope of the potential that the spacecraft flies over. So densities are taken from the spectrum below some
thirty waves a revolution, not from the root mean square and a correlation time, which give four times as much.
"""

from __future__ import annotations

import numpy as np

Densities = tuple[float, float, float]

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
# Fields made before GRAIL: tracked over the near side only, since no orbiter is in sight of the Earth over the other.
_OLDER = ("LP", "GLGM", "JGL")
# LP165P against GRAIL, both to degree 100, on 30 such revolutions: 2 to 6 mGal over the near side, 30 to 43 over the
# far side in waves of some 300 s, of which a fifth is left over the time of a coast; how much of it was set on the NEES
# of the tuning track.
_NEAR_SIDE_M2_S3 = (5e-8, 3e-9, 5e-8)
_FAR_SIDE_M2_S3 = (1.3e-6, 2e-7, 6.5e-7)


def omission_psd_m2_s3(degree: int) -> Densities:
    """Spectral density of the white acceleration that stands for the omitted one: radial, transverse, normal."""
    degrees = sorted(_OMITTED_M2_S3)
    r, t, n = (
        float(np.exp(np.interp(degree, degrees, [np.log(_OMITTED_M2_S3[known][axis]) for known in degrees])))
        for axis in range(3)
    )
    return r, t, n


def field_psd_m2_s3(name: str, degree: int) -> tuple[Densities, Densities]:
    """Spectral densities of what a field by its name, cut at a degree, lacks or has wrong: near side and far side."""
    omitted = omission_psd_m2_s3(degree)
    if not name.upper().startswith(_OLDER):
        return omitted, omitted
    return _sum(omitted, _NEAR_SIDE_M2_S3), _sum(omitted, _FAR_SIDE_M2_S3)


def _sum(one: Densities, other: Densities) -> Densities:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]
