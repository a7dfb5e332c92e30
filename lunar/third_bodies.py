"""Positions of the Earth and the Sun seen from the Moon, ICRF axes, metres, without any ephemeris file.

The Moon's place is the truncated ELP2000-82 of Meeus, the Earth's the VSOP2000 fit of ERFA (``moon98``, ``epv00``):
some km in the Moon's distance and arcseconds in direction, far below what the tide on a low orbit can feel.

References
----------
ERFA (BSD re-issue of IAU SOFA), functions eraMoon98 and eraEpv00, with their accuracy statements.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lunar.constants import ASTRONOMICAL_UNIT_M, SECONDS_PER_DAY

FloatArray = NDArray[np.float64]

_J2000_JD = 2_451_545.0


def earth_position_icrf_m(tdb_s: ArrayLike) -> FloatArray:
    """Return the Earth's position from the Moon's centre, shape ``(..., 3)``, at TDB seconds past J2000 ``(...)``."""
    import erfa

    # TT would be asked for; the Moon moves 2 m in the 2 ms between TT and TDB.
    days = np.asarray(tdb_s, dtype=np.float64) / SECONDS_PER_DAY
    return np.asarray(-ASTRONOMICAL_UNIT_M * erfa.moon98(_J2000_JD, days)["p"], dtype=np.float64)


def sun_position_icrf_m(tdb_s: ArrayLike) -> FloatArray:
    """Return the Sun's position from the Moon's centre, shape ``(..., 3)``, at TDB seconds past J2000 ``(...)``."""
    import erfa

    days = np.asarray(tdb_s, dtype=np.float64) / SECONDS_PER_DAY
    heliocentric, _ = erfa.epv00(_J2000_JD, days)
    moon = erfa.moon98(_J2000_JD, days)["p"]
    return np.asarray(-ASTRONOMICAL_UNIT_M * (heliocentric["p"] + moon), dtype=np.float64)
