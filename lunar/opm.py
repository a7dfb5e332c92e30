"""CCSDS Orbit Parameter Message 2.0 in keyword notation: one state of an ephemeris.

References
----------
CCSDS 502.0-B-2 (2009), Orbit Data Messages, section 3.
"""

from __future__ import annotations

import numpy as np

from lunar.ephemeris import Ephemeris
from lunar.kvn import epoch_texts
from lunar.timescales import format_utc

_KEYS = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
_UNITS = ("km", "km", "km", "km/s", "km/s", "km/s")


def format_opm(ephemeris: Ephemeris, utc_ns: int, *, creation_utc_ns: int | None = None) -> str:
    """Return OPM 2.0 text with the state of an ephemeris at an epoch; positions to 1 um, velocities to 1 nm/s.

    CREATION_DATE is the epoch of the state unless given.

    Raises
    ------
    EphemerisCoverageError
        Where the ephemeris has no state at the epoch.
    """
    position_m, velocity_m_s = ephemeris.at(utc_ns)
    segment = next(one for one in reversed(ephemeris.segments) if one.start_utc_ns <= utc_ns)
    epoch = epoch_texts(np.array([utc_ns], dtype=np.int64))[0]
    created = utc_ns if creation_utc_ns is None else creation_utc_ns
    lines = [
        "CCSDS_OPM_VERS = 2.0",
        f"CREATION_DATE = {format_utc(created).rstrip('Z')}",
        f"ORIGINATOR = {ephemeris.originator}",
        "",
        f"OBJECT_NAME = {segment.object_name}",
        f"OBJECT_ID = {segment.object_id or segment.object_name}",
        f"CENTER_NAME = {segment.centre}",
        f"REF_FRAME = {segment.frame}",
        "TIME_SYSTEM = UTC",
        "",
        f"EPOCH = {epoch}",
    ]
    values = (np.concatenate([position_m, velocity_m_s]) / 1e3).tolist()
    lines += [
        f"{key} = {value:.{9 if unit == 'km' else 12}f} [{unit}]"
        for key, value, unit in zip(_KEYS, values, _UNITS, strict=True)
    ]
    return "\n".join([*lines, ""])
