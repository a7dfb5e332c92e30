"""What a lunar gravity field cut at a degree leaves out along a low orbit, as noise that a filter can carry.

Root mean square acceleration at 30 km altitude, radial, transverse, normal, of GRAIL's field to degree 150 beyond the
degree, over a day of the paper's orbit.
"""

from __future__ import annotations

import numpy as np

_OMITTED_MGAL = {
    0: (72.0, 52.0, 49.0),
    8: (55.0, 38.0, 38.0),
    20: (44.0, 31.0, 30.0),
    30: (37.0, 26.0, 25.0),
    50: (25.0, 18.0, 18.0),
    70: (16.0, 12.0, 12.0),
    100: (8.0, 6.0, 6.0),
}
_MGAL_M_S2 = 1e-5
_CORRELATION_S = 40.0
# Waves longer than those of this degree take longer to fly over.
_CORRELATION_DEGREE = 50.0


def omission_rms_m_s2(degree: int) -> tuple[float, float, float]:
    """Root mean square of the omitted acceleration: radial, transverse, normal."""
    degrees = sorted(_OMITTED_MGAL)
    r, t, n = (
        _MGAL_M_S2 * float(np.interp(degree, degrees, [_OMITTED_MGAL[known][axis] for known in degrees]))
        for axis in range(3)
    )
    return r, t, n


def omission_psd_m2_s3(degree: int) -> tuple[float, float, float]:
    """Spectral density of the white acceleration that stands for the omitted one: radial, transverse, normal.

    Twice variance times correlation time. Omitted gravity has little power at low frequencies, where white noise has as
    much as anywhere: over an hour of coast the claim is too large by half, within imaging arcs it holds (normalised
    errors of separate runs at degree 100, on another track than any figure is given for).
    """
    correlation_s = _CORRELATION_S * max(1.0, _CORRELATION_DEGREE / max(degree, 4))
    r, t, n = (2.0 * rms**2 * correlation_s for rms in omission_rms_m_s2(degree))
    return r, t, n
