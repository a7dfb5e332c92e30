"""Trajectories as plain tables: CSV for spreadsheets, TUM for trajectory tools.

References
----------
TUM format: Sturm et al. 2012, a benchmark for the evaluation of RGB-D SLAM systems: one pose a line,
``timestamp tx ty tz qx qy qz qw`` with the quaternion of the body in the world, scalar last.
"""

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.constants import NS
from lunar.ephemeris import Ephemeris, resampled
from lunar.frames import Orientation, continuous_quaternions, quaternion_from_matrix, rtn_from_inertial
from lunar.timescales import format_tai, tdb_s_from_tai_ns, utc_ns_from_tai_ns
from lunar.visibility import subsatellite

CSV_COLUMNS = (
    *("utc", "x_km", "y_km", "z_km", "vx_km_s", "vy_km_s", "vz_km_s"),
    *("latitude_deg", "longitude_deg", "altitude_km"),
)


def format_csv(ephemeris: Ephemeris, orientation: Orientation) -> str:
    """Return states (ICRF, Moon-centred) and sub-satellite points (mean-Earth, 0..360 E) as CSV text.

    An epoch that two arcs share has two lines.
    """
    tai_ns, position_m, velocity_m_s = _states(ephemeris)
    latitude, longitude, altitude_m = subsatellite(position_m, tdb_s_from_tai_ns(tai_ns), orientation)
    states = np.concatenate([position_m, velocity_m_s], axis=1) / 1e3
    places = np.stack([np.degrees(latitude), np.degrees(longitude) % 360.0, altitude_m / 1e3], axis=1)
    row = "%s,%.9f,%.9f,%.9f,%.12f,%.12f,%.12f,%.8f,%.8f,%.6f"
    values = np.concatenate([states, places], axis=1).tolist()
    lines = [
        row % (format_tai(t, 3 if t % 10**6 == 0 else 9), *v) for t, v in zip(tai_ns.tolist(), values, strict=True)
    ]
    return "\n".join([",".join(CSV_COLUMNS), *lines, ""])


def format_tum(ephemeris: Ephemeris) -> str:
    """Return poses in TUM form: seconds since 1970 UTC, ICRF metres, and the RTN axes as the body's attitude."""
    tai_ns, position_m, velocity_m_s = _states(ephemeris)
    icrf_from_rtn = np.swapaxes(rtn_from_inertial(position_m, velocity_m_s), -1, -2)
    # Scalar last in this format.
    attitude = np.roll(continuous_quaternions(quaternion_from_matrix(icrf_from_rtn)), -1, axis=-1)
    values = np.concatenate([position_m, attitude], axis=1).tolist()
    row = "%d.%09d %.6f %.6f %.6f %.12f %.12f %.12f %.12f"
    utc_ns = utc_ns_from_tai_ns(tai_ns).tolist()
    lines = [row % (*divmod(t, NS), *v) for t, v in zip(utc_ns, values, strict=True)]
    return "\n".join([*lines, ""])


def _states(ephemeris: Ephemeris) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the epochs, positions and velocities of all arcs."""
    segments = resampled(ephemeris).segments
    parts = zip(*((one.tai_ns, one.position_m, one.velocity_m_s) for one in segments), strict=True)
    tai_ns, position_m, velocity_m_s = map(np.concatenate, parts)
    return tai_ns, position_m, velocity_m_s
