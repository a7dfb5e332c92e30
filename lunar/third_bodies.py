"""Positions of the Earth and the Sun seen from the Moon, ICRF axes, metres, without any ephemeris file.

The Moon's place is the truncated ELP2000-82 of Meeus (``moon98`` of ERFA) with the largest 225 of the terms that it
leaves out, the Earth's place about the Sun the VSOP2000 fit of ERFA (``epv00``).  From 1990 to 2060 the Moon is within
5 km of the whole theory, which gives the tide on a low orbit to 4e-5 of itself; outside these years it is within some
tens of km.

References
----------
ERFA (BSD re-issue of IAU SOFA), functions eraMoon98 and eraEpv00, with their accuracy statements.
"""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import BoolArray, FloatArray
from lunar.constants import ASTRONOMICAL_UNIT_M, SECONDS_PER_DAY

_J2000_JD = 2_451_545.0
_CENTURY_S = 36_525.0 * SECONDS_PER_DAY
_OBLIQUITY_RAD = np.radians(84_381.406 / 3600.0)
_DENSE, _NODE_S = 2000, 3600.0


def earth_position_icrf_m(tdb_s: ArrayLike) -> FloatArray:
    """Return the Earth's position from the Moon's centre, shape ``(..., 3)``, at TDB seconds past J2000 ``(...)``."""
    return -_moon_from_earth_m(np.asarray(tdb_s, dtype=np.float64))


def moon_barycentric_icrf_m(tdb_s: ArrayLike) -> FloatArray:
    """Return the Moon's position from the barycentre of the solar system, shape ``(..., 3)``, to 20 km."""
    import erfa

    _, barycentric = erfa.epv00(_J2000_JD, np.asarray(tdb_s, dtype=np.float64) / SECONDS_PER_DAY)
    earth = ASTRONOMICAL_UNIT_M * np.asarray(barycentric["p"], dtype=np.float64)
    return earth - earth_position_icrf_m(tdb_s)


def sun_position_icrf_m(tdb_s: ArrayLike) -> FloatArray:
    """Return the Sun's position from the Moon's centre, shape ``(..., 3)``, at TDB seconds past J2000 ``(...)``."""
    seconds = np.asarray(tdb_s, dtype=np.float64)
    return -(_earth_from_sun_m(seconds) + _moon_from_earth_m(seconds))


def _earth_from_sun_m(tdb_s: FloatArray) -> FloatArray:
    """Return the Earth's position from the Sun; that of many epochs from one each hour (cubic Hermite, 1 cm)."""
    import erfa

    first, last = (tdb_s.min(), tdb_s.max()) if tdb_s.size > _DENSE else (0.0, np.inf)
    nodes = np.arange(first, last + _NODE_S, _NODE_S) if (last - first) / _NODE_S < tdb_s.size / 4 else tdb_s
    heliocentric, _ = erfa.epv00(_J2000_JD, nodes / SECONDS_PER_DAY)
    at = ASTRONOMICAL_UNIT_M * np.asarray(heliocentric["p"], dtype=np.float64)
    if nodes is tdb_s:
        return at
    step = ASTRONOMICAL_UNIT_M * np.asarray(heliocentric["v"], dtype=np.float64) * (_NODE_S / SECONDS_PER_DAY)
    k = np.minimum(((tdb_s - first) / _NODE_S).astype(np.int64), len(nodes) - 2)
    u = ((tdb_s - nodes[k]) / _NODE_S)[..., None]
    change = at[k + 1] - at[k]
    bend = (1.0 - u) * (step[k] - change) - u * (step[k + 1] - change)
    return np.asarray(at[k] + u * change + u * (1.0 - u) * bend)


def _moon_from_earth_m(tdb_s: FloatArray) -> FloatArray:
    import erfa

    # The theory asks for TT; the Moon moves 2 m in the 2 ms between TT and TDB.
    short = ASTRONOMICAL_UNIT_M * np.asarray(erfa.moon98(_J2000_JD, tdb_s / SECONDS_PER_DAY)["p"], dtype=np.float64)
    cos, sin = np.cos(_OBLIQUITY_RAD), np.sin(_OBLIQUITY_RAD)
    x, y = short[..., 0], cos * short[..., 1] + sin * short[..., 2]
    z = cos * short[..., 2] - sin * short[..., 1]
    longitude, distance = np.arctan2(y, x), np.sqrt(x * x + y * y + z * z)
    latitude = np.arcsin(z / distance)
    d_longitude, d_latitude, d_distance = _missing_terms(tdb_s)
    longitude, latitude, distance = longitude + d_longitude, latitude + d_latitude, distance + d_distance
    x = distance * np.cos(latitude) * np.cos(longitude)
    y = distance * np.cos(latitude) * np.sin(longitude)
    z = distance * np.sin(latitude)
    return np.stack([x, cos * y - sin * z, sin * y + cos * z], axis=-1)


def _missing_terms(tdb_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what is added to ecliptic longitude and latitude (rad) and distance (m)."""
    import erfa

    multipliers, cosine, secular, weights = _terms()
    centuries = tdb_s / _CENTURY_S
    arguments = np.stack(
        [
            *(erfa.fad03(centuries), erfa.falp03(centuries), erfa.fal03(centuries), erfa.faf03(centuries)),
            *(erfa.faom03(centuries), erfa.fave03(centuries), erfa.fae03(centuries), erfa.fama03(centuries)),
            erfa.faju03(centuries),
        ],
        axis=-1,
    )
    sums = np.empty((*centuries.shape, 3))
    for block in range(0, max(centuries.size, 1), _DENSE):  # 225 terms of many epochs take hundreds of megabytes
        part = (slice(block, block + _DENSE),) if centuries.ndim else ()
        angles = arguments[part] @ multipliers.T
        values = np.where(cosine, np.cos(angles), np.sin(angles))
        sums[part] = np.where(secular, centuries[part][..., None], values) @ weights
    return sums[..., 0], sums[..., 1], sums[..., 2]


@cache
def _terms() -> tuple[FloatArray, BoolArray, BoolArray, FloatArray]:
    """Return multipliers (n, 9), which are cosines or constants, which are secular, and weights (n, 3)."""
    from lunar._moon_terms import TERMS

    rows = [line.split() for line in TERMS.strip().split("\n")]
    multipliers = np.array([[float(word) for word in row[2:11]] for row in rows])
    forms = np.array([row[1] for row in rows])
    weights = np.zeros((len(rows), 3))
    for number, row in enumerate(rows):
        weights[number, "LBR".index(row[0])] = float(row[11]) * (1.0 if row[0] == "R" else 1e-9)
    return multipliers, (forms == "c") | (forms == "1"), forms == "T", weights
