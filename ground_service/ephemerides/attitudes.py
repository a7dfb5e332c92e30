"""Attitude table of a pass archive (`attitude.csv`), one row per frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ground_service.errors import InvalidInput

HEADER = "image_ticks,q_w,q_x,q_y,q_z"
UNIT_TOLERANCE = 1e-3
"""Accepted deviation of a quaternion from unit length: attitude control reports have few digits."""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeTable:
    """On-board time of images (n,) and the quaternions (n, 4) from ICRF axes to the camera."""

    image_ticks: NDArray[np.int64]
    q_wxyz: NDArray[np.float64]


def no_attitudes() -> AttitudeTable:
    """Return an empty table."""
    return AttitudeTable(np.zeros(0, dtype=np.int64), np.zeros((0, 4)))


def load_attitudes(path: Path, source: str = "attitude.csv") -> AttitudeTable:
    """Return the table in a file.

    Raises
    ------
    InvalidInput
        The file is not an attitude table; the message states the first invalid line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise InvalidInput(source, "", "UTF-8 text", "other octets") from None
    if not lines or lines[0] != HEADER:
        raise InvalidInput(source, "line 1", HEADER, repr(lines[0][:80]) if lines else "nothing")
    ticks, quaternions = [], []
    for number, line in enumerate(lines[1:], 2):
        fields = line.split(",")
        try:
            time, quaternion = int(fields[0]), [float(value) for value in fields[1:]]
        except ValueError:
            time, quaternion = -1, []
        length = float(np.linalg.norm(quaternion)) if len(quaternion) == 4 else float("nan")
        if not 0 <= time < 1 << 48 or not abs(length - 1.0) <= UNIT_TOLERANCE:
            raise InvalidInput(
                source, f"line {number}", "on-board ticks and a unit quaternion", repr(line[:80])
            )
        ticks.append(time)
        quaternions.append(quaternion)
    return AttitudeTable(np.array(ticks, dtype=np.int64), np.array(quaternions).reshape(-1, 4))
