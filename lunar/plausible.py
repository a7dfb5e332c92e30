"""Limits of plausibility of times: what an on-board clock or the clock of a station can show, with sources."""

from __future__ import annotations

CLOCK_ERROR_S = 3600.0
"""Largest error of a clock in use: time zones, leap seconds and unset offsets of stations stay below, a wrong date does
not. Also the longest silence within one stretch of telemetry, shorter than an orbit of two hours."""

SILENCE_S = 400.0 * 86_400.0
"""Longest silence of a spacecraft that flies on: a year of hibernation."""

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
    3600: "another time zone",
}
"""Differences in s between clocks that have a usual cause, with the leap seconds since 2017 (IERS Bulletin C)."""
