"""Compiled search for the first craters that enter a widening field of view."""

import math

import numpy as np

from kernels.compiled import njit
from lunar.arrays import FloatArray, IntArray


@njit
def first_craters_in_view(
    latitude_rad: FloatArray,
    longitude_rad: FloatArray,
    distance_ratio: FloatArray,
    keys: FloatArray,
    crater: FloatArray,
    band_rad: float,
    count: int,
) -> tuple[FloatArray, IntArray]:
    """Return ascending tangents (n, count) of the half field of view at which craters enter a square image.

    The second array holds the rows (n, count) of these craters in ``crater``. If fewer craters are within the horizon,
    the remaining rows are -1 and their tangents infinite. ``distance_ratio`` (n,) is the distance from the centre of
    the Moon in lunar radii. ``keys`` (m,) are ascending values of latitude band times 2 pi plus longitude; the unit
    vectors ``crater`` (m, 3) have the same order.
    """
    two_pi = 2.0 * math.pi
    tangents = np.full((len(latitude_rad), count), np.inf)
    rows = np.full((len(latitude_rad), count), -1, dtype=np.int64)
    for i in range(len(latitude_rad)):
        ratio = distance_ratio[i]
        if ratio <= 1.0:
            continue
        horizon = math.acos(1.0 / ratio)
        lat, lon = latitude_rad[i], longitude_rad[i] % two_pi
        cp, sp, cl, sl = math.cos(lat), math.sin(lat), math.cos(lon), math.sin(lon)
        low, high = lat - horizon, lat + horizon
        first_band = max(math.floor((low + math.pi / 2) / band_rad), 0)
        last_band = math.floor((min(high, math.pi / 2) + math.pi / 2) / band_rad)
        half_width = math.pi
        if low > -math.pi / 2 and high < math.pi / 2:
            half_width = math.asin(min(1.0, math.sin(horizon) / cp))
        west, east = lon - half_width, lon + half_width
        # A span across the 0/360 deg meridian has a second piece, which is empty otherwise.
        begin, end, begin_2, end_2 = west, east, 0.0, -1.0
        if half_width >= math.pi:
            begin, end = 0.0, two_pi
        elif west < 0.0:
            begin, begin_2, end_2 = 0.0, west + two_pi, two_pi
        elif east > two_pi:
            end, end_2 = two_pi, east - two_pi
        for band in range(first_band, last_band + 1):
            for piece in range(2):
                if piece == 1 and end_2 < begin_2:
                    continue
                low_key = band * two_pi + (begin if piece == 0 else begin_2)
                high_key = band * two_pi + (end if piece == 0 else end_2)
                start = np.searchsorted(keys, low_key)
                stop = np.searchsorted(keys, high_key, side="right")
                for j in range(start, stop):
                    x, y, z = crater[j, 0], crater[j, 1], crater[j, 2]
                    equatorial = cl * x + sl * y
                    up = cp * equatorial + sp * z
                    if up * ratio < 1.0:
                        continue
                    tangent = max(abs(cl * y - sl * x), abs(cp * z - sp * equatorial)) / (ratio - up)
                    if tangent < tangents[i, count - 1]:
                        k = count - 1
                        while k > 0 and tangents[i, k - 1] > tangent:
                            tangents[i, k], rows[i, k] = tangents[i, k - 1], rows[i, k - 1]
                            k -= 1
                        tangents[i, k], rows[i, k] = tangent, j
    return tangents, rows
