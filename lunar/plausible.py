"""Limits of plausibility: what a value about the Moon, an orbit, a time, a camera or a crater can be, with sources.

Readers of files compare what they find with these limits; no other module repeats one of them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import BoolArray
from lunar.constants import MOON_RADIUS_M


@dataclass(frozen=True, slots=True)
class Limit:
    """Least and greatest plausible value of a quantity, both included, in `unit`."""

    low: float
    high: float
    unit: str

    def holds(self, values: ArrayLike) -> BoolArray:
        """Return whether each value lies within the limits, (...); False for NaN."""
        found = np.asarray(values)
        return np.asarray((found >= self.low) & (found <= self.high))

    def __str__(self) -> str:
        return f"{self.low:.10g} to {self.high:.10g} {self.unit}".strip()


HEIGHT_M = Limit(-9_200.0, 10_800.0, "m")
"""Heights of the ground above `MOON_RADIUS_M` (LOLA: -9.12 km in Antoniadi, 10.79 km near Engel'gardt; Smith et al.
2017, Icarus 283)."""

RADIUS_M = Limit(MOON_RADIUS_M + HEIGHT_M.low, MOON_RADIUS_M + HEIGHT_M.high, "m")
"""Distances of the ground from the Moon's centre."""

SPHERE_TOLERANCE = 0.01
"""Greatest relative difference of a reference sphere of the Moon from `MOON_RADIUS_M`: those in use have 1735 to 1738.1
km, other bodies of the solar system differ by more."""

RELIEF_M = 3.0
"""Least standard deviation of heights over ground of 20 km: the flattest of all 136,000 cells of that size of GLD100
has 4.6 m, the median 300 m."""

RASTER_PIXEL_M = Limit(0.2, 500_000.0, "m")
"""Size of the pixels of a map: images from orbit have 0.25 m and more, ten pixels about the Moon 1,100 km."""

SLOPE_DEG, STEEP_SHARE, SLOPE_BASE_M = 45.0, 0.01, 50.0
"""Slope that at most this share of the ground exceeds over a pixel of this size or more: of 608 windows of 121 km on
GLD100 at 237 m none has 38 degrees on more than 0.06 %; the angle of repose is 32 to 37 degrees (Kreslavsky & Head
2016, Icarus 273).  Heights that are twice too great have it on about 1 % of cratered ground."""

MAP_SHIFT_M = 5_000.0
"""More than any offset between published height models of the Moon."""

CRATER_DIAMETER_M = Limit(1.0, 2_600_000.0, "m")
"""The greatest is South Pole-Aitken: 2,400 km by 2,050 km (Garrick-Bethell & Zuber 2009, Icarus 204)."""

CRATER_MEDIAN_M = Limit(100.0, 300_000.0, "m")
"""Medians of the diameters of a list: published ones have 1 km (Robbins 2019) to 31 km (over 20 km), lists of basins
200 km."""

CRATER_DEPTH_RATIO = Limit(0.003, 0.3, "")
"""Medians of depth over diameter: fresh simple craters have 0.20 (Pike 1977), those of 2 km or more in LU1319381 0.076,
with 0.02 and 0.21 as first and last percentile."""

CRATER_DEPTH = Limit(-0.1, 0.5, "")
"""Depth over diameter of any crater: the deepest of 222,447 in LU1319381 has 0.32. On a height raster, a
crater under the ejecta or in the wall of another one has less than zero: -0.04 on the procedural Moon."""

LISTED_DEPTH_RATIO = Limit(0.45, 1.5, "")
"""Medians of depths measured on a height raster over those in a list: on GLD100 at 128 pixels per degree, which smooths
small craters, 0.59 (3 to 6 km) and 0.78 (6 to 30 km) of those of LU1319381."""

CRATER_COVER = 0.6
"""Greatest ground that the craters of a list cover, all with its median diameter, over the ground that they span: 0.06
for the 222,447 craters of LU1319381 from 2 km on; saturated ground has 0.3."""

ORBIT_RADIUS_M = Limit(MOON_RADIUS_M, 66_000_000.0, "m")
"""From the ground to the sphere of influence of the Moon (Laplace)."""

ORBIT_SPEED_M_S = Limit(0.0, 3_500.0, "m/s")
"""Arrivals from the Earth pass low over the Moon with 2.3 to 2.6 km/s; escape at the ground is at 2.376 km/s."""

ORIENTATION_RAD = 2e-4
"""Greatest difference of an orientation of the Moon from the IAU series: DE421 has 9e-5 at most from 1900 to 2050."""

GRAVITY_ALIKE, GRAVITY_ALIKE_DEGREE = 0.3, 6
"""Greatest relative difference of the terms of each degree up to this one from GRAIL's: LP165P differs by 0.7 %."""

GRAVITY_TERM = 25.0 * 2.5e-4
"""Greatest normalised coefficient, times the square of its degree: Kaula's rule has 2.5e-4, GRGM660PRIM 5 times that,
the noise of LP165P 11 times."""

UTC_NS = Limit(63_072_000_000_000_000, 4_102_444_800_000_000_000, "ns")
"""From 1972-01-01, when UTC got whole leap seconds, to 2100-01-01."""

CAMERA_FIELD_DEG = Limit(1.0, 170.0, "deg")
"""Field of view of a camera with a plane image: wider, a pixel at the edge has 130 times the scale of the middle."""

CAMERA_PIXELS = Limit(16, 8192, "pixels")
"""Width and height of an image: from one cell of the detector to the largest sensors of small spacecraft."""

OFF_NADIR_DEG, VIEWS_OF_MOON = 60.0, 0.9
"""Angle from nadir within which a camera looks in this share of the frames of a pass: from 30 km the horizon is 79
degrees from nadir.  Quaternions of another order or direction turn it through all directions."""

EXPOSURE_S = Limit(0.0, 60.0, "s")
"""Exposure of an image of the sunlit ground, which moves by 1.6 km in a second, or of the night side."""

REFERENCE_SIGMA_M = Limit(0.0, 100_000.0, "m")
"""Error of an orbit determination that is used as a reference."""

CLOCK_ERROR_S = 3600.0
"""Largest error of a clock in use: time zones, leap seconds and unset offsets of stations stay below, a wrong date does
not. Also the longest silence within one stretch of telemetry, shorter than an orbit of two hours."""

SILENCE_S = 400.0 * 86_400.0
"""Longest silence of a spacecraft that flies on: a year of hibernation."""

SIMULATED_AHEAD_S = 20.0 * 365.25 * 86_400.0
"""Simulated flights, whose recordings arrive before their time, are no further ahead."""

UNSET_CLOCK_S = 366.0 * 86_400.0
"""A clock that shows less than this after its epoch was not set since the boot."""

AGREEING_PACKETS = 10
"""So many packets of one stretch are not wrong by one time stamp."""

CORRELATION_RMS_NS = 100e6
"""Largest scatter of time reports about a correlation: without an ephemeris light times are wrong by 27 ms (radii of
Earth and orbit), clocks of stations that disagree scatter by more."""

STATION_DIFFERENCE_NS = 50e6
"""Largest difference between the reports of two stations, for the same reason: their clocks on GNSS time agree to less
than a microsecond."""

WHOLE_SECONDS = {
    1: "a leap second",
    18: "GPS time instead of UTC",
    19: "GPS time instead of TAI",
    37: "TAI instead of UTC",
    **dict.fromkeys(range(900, 14 * 3600 + 1, 900), "another time zone"),
}
"""Differences in s between clocks that have a usual cause, with the leap seconds since 2017 (IERS Bulletin C)."""
