"""Attitudes of a pass archive: `attitude.csv` with a row for each frame, or `attitude.aem`, a CCSDS AEM or its XML."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ground_service.errors import InvalidInput
from lunar.errors import LunarError
from lunar.frames import ICRF_NAMES
from lunar.messages.aem import parse_aem

ATTITUDE_FILES = ("attitude.csv", "attitude.aem")
CAMERA_NAMES = ("INSTRUMENT", "CAMERA")
"""Beginnings of the names of the camera axes in an AEM."""

HEADER = "image_ticks,q_w,q_x,q_y,q_z"
UNIT_TOLERANCE = 1e-3
"""Accepted deviation of a quaternion from unit length: attitude control reports have few digits."""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeTable:
    """Times of attitudes and the quaternions (n, 4) from ICRF axes to the camera.

    Attributes
    ----------
    image_ticks
        On-board time of images (n,); empty for an AEM.
    utc_ns
        Times (n,), ascending, of an AEM, whose attitudes are interpolated; None for a table of images.
    """

    image_ticks: NDArray[np.int64]
    q_wxyz: NDArray[np.float64]
    utc_ns: NDArray[np.int64] | None = None


def no_attitudes() -> AttitudeTable:
    """Return an empty table."""
    return AttitudeTable(np.zeros(0, dtype=np.int64), np.zeros((0, 4)))


def attitude_file(names: Collection[str], source: str) -> str | None:
    """Return the name of the attitude file among the files of an archive, None without one.

    Raises
    ------
    InvalidInput
        There are two of them.
    """
    found = [name for name in ATTITUDE_FILES if name in names]
    if len(found) > 1:
        raise InvalidInput(source, "", f"one of {' and '.join(ATTITUDE_FILES)}", "both")
    return found[0] if found else None


def load_attitudes(path: Path, source: str = "attitude.csv") -> AttitudeTable:
    """Return the attitudes in a file, a table or an AEM.

    Raises
    ------
    InvalidInput
        The file is neither; the message states the first invalid line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise InvalidInput(source, "", "UTF-8 text", "other octets") from None
    if lines and lines[0].lstrip().startswith(("CCSDS_AEM_VERS", "<")):
        return _of_message("\n".join(lines), source)
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


def _of_message(text: str, source: str) -> AttitudeTable:
    try:
        segments = parse_aem(text, source)
    except LunarError as error:
        raise InvalidInput(source, "", "a CCSDS AEM", str(error).removeprefix(f"{source}: ")) from None
    times, quaternions = [], []
    for one in segments:
        frames = (one.frame_a.upper(), one.frame_b.upper())
        if frames[0] not in ICRF_NAMES or not frames[1].startswith(CAMERA_NAMES):
            expected = "REF_FRAME_A = ICRF and REF_FRAME_B = INSTRUMENT_1 (the camera)"
            raise InvalidInput(source, "", expected, f"{one.frame_a} and {one.frame_b}")
        times.append(one.utc_ns)
        quaternions.append(one.q_wxyz)
    utc_ns, first = np.unique(np.concatenate(times), return_index=True)
    return AttitudeTable(np.zeros(0, dtype=np.int64), np.concatenate(quaternions)[first], utc_ns)
