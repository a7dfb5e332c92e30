"""Camera pointing in each frame: telemetered or declared attitude, mounting and lens.

Frames: ICRF, mean-Earth (MCMF) and camera axes (x right, y down, z along the boresight).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.frames import matrix_from_quaternion
from lunar.lens import pointed_camera_from_mcmf


def _no_times() -> IntArray:
    return np.zeros(0, dtype=np.int64)


def _no_quaternions() -> FloatArray:
    return np.zeros((0, 4))


@dataclass(frozen=True, slots=True, eq=False)
class Viewing:
    """Camera and its pointing.

    Attributes
    ----------
    camera
        Camera with the declared lens distortion, if any.
    tilt_rad, yaw_rad
        Mounting from nadir with image up to the north: yaw clockwise, then tilt from the boresight toward image up.
    attitude_utc_ns, q_wxyz
        Times (n,), ascending, and quaternions (n, 4) from ICRF to camera axes of the frames whose attitude is known.
        Other frames use the declared pointing.
    """

    camera: PinholeCamera = field(default_factory=PinholeCamera)
    tilt_rad: float = 0.0
    yaw_rad: float = 0.0
    attitude_utc_ns: IntArray = field(default_factory=_no_times)
    q_wxyz: FloatArray = field(default_factory=_no_quaternions)

    def pointed(self, position_mcmf_m: FloatArray) -> FloatArray:
        """Return the rotations (..., 3, 3) from MCMF to the camera in the declared pointing, at positions (..., 3)."""
        return pointed_camera_from_mcmf(position_mcmf_m, self.tilt_rad, self.yaw_rad)

    def known(self, utc_ns: IntArray) -> BoolArray:
        """Return whether the attitude of the frames at `utc_ns` (n,) was telemetered."""
        return self._rows(utc_ns)[1]

    def camera_from_mcmf(
        self, utc_ns: IntArray, position_mcmf_m: FloatArray, mcmf_from_icrf: FloatArray
    ) -> FloatArray:
        """Return the rotations (n, 3, 3) from MCMF to the camera of frames.

        Parameters
        ----------
        utc_ns, position_mcmf_m, mcmf_from_icrf
            Times (n,), positions (n, 3) and rotations (n, 3, 3) of the frames; NaN (unknown) gives NaN.
        """
        rotations = self.pointed(position_mcmf_m)
        rows, known = self._rows(utc_ns)
        if known.any():
            camera_from_icrf = matrix_from_quaternion(self.q_wxyz[rows[known]])
            rotations[known] = camera_from_icrf @ np.swapaxes(mcmf_from_icrf[known], -1, -2)
        return rotations

    def _rows(self, utc_ns: IntArray) -> tuple[IntArray, BoolArray]:
        times = self.attitude_utc_ns
        if not len(times):
            return np.zeros(len(utc_ns), dtype=np.int64), np.zeros(len(utc_ns), dtype=np.bool_)
        rows = np.minimum(np.searchsorted(times, utc_ns), len(times) - 1)
        return rows, np.asarray(times[rows] == utc_ns, dtype=np.bool_)
