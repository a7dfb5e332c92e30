"""Trajectories as plain tables: CSV for spreadsheets, TUM for trajectory tools.

References
----------
TUM format: Sturm et al. 2012, a benchmark for the evaluation of RGB-D SLAM systems: one pose a line,
``timestamp tx ty tz qx qy qz qw`` with the quaternion of the body in the world, scalar last.
"""

from __future__ import annotations

import numpy as np

from lunar.ephemeris import Ephemeris
from lunar.frames import Orientation, continuous_quaternions, quaternion_from_matrix, rtn_from_inertial
from lunar.ground_track import ground_track
from lunar.timescales import NS, format_utc

CSV_COLUMNS = (
    *("utc", "x_km", "y_km", "z_km", "vx_km_s", "vy_km_s", "vz_km_s"),
    *("latitude_deg", "longitude_deg", "altitude_km"),
)


def format_csv(ephemeris: Ephemeris, orientation: Orientation) -> str:
    """Return states (ICRF, Moon-centred) and sub-satellite points (mean-Earth, 0..360 E) as CSV text."""
    epochs = ephemeris.utc_ns
    position_m, velocity_m_s = ephemeris.at(epochs)
    track = ground_track(ephemeris, orientation, epochs)
    states = np.concatenate([position_m, velocity_m_s], axis=1) / 1e3
    places = np.stack(
        [np.degrees(track.latitude_rad), np.degrees(track.longitude_rad), track.altitude_m / 1e3], axis=1
    )
    row = "%s,%.9f,%.9f,%.9f,%.12f,%.12f,%.12f,%.8f,%.8f,%.6f"
    values = np.concatenate([states, places], axis=1).tolist()
    lines = [
        row % (format_utc(int(t), 3 if t % 10**6 == 0 else 9), *v)
        for t, v in zip(epochs, values, strict=True)
    ]
    return "\n".join([",".join(CSV_COLUMNS), *lines, ""])


def format_tum(ephemeris: Ephemeris) -> str:
    """Return poses in TUM form: seconds since 1970 UTC, ICRF metres, and the RTN axes as the body's attitude."""
    epochs = ephemeris.utc_ns
    position_m, velocity_m_s = ephemeris.at(epochs)
    icrf_from_rtn = np.swapaxes(rtn_from_inertial(position_m, velocity_m_s), -1, -2)
    # Scalar last in this format.
    attitude = np.roll(continuous_quaternions(quaternion_from_matrix(icrf_from_rtn)), -1, axis=-1)
    values = np.concatenate([position_m, attitude], axis=1).tolist()
    row = "%d.%09d %.6f %.6f %.6f %.12f %.12f %.12f %.12f"
    lines = [row % (*divmod(int(t), NS), *v) for t, v in zip(epochs, values, strict=True)]
    return "\n".join([*lines, ""])
