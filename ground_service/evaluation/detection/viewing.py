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

GAP_STEPS = 10.0
"""Attitudes of a motion further apart than so many median steps are not interpolated."""


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
    interpolated
        The attitudes are samples of a motion: frames between two of them, at most `GAP_STEPS` median steps apart, have
        the interpolated attitude. Otherwise each attitude is that of one frame.
    """

    camera: PinholeCamera = field(default_factory=PinholeCamera)
    tilt_rad: float = 0.0
    yaw_rad: float = 0.0
    attitude_utc_ns: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    q_wxyz: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    interpolated: bool = False

    def pointed(self, position_mcmf_m: FloatArray) -> FloatArray:
        """Return the rotations (..., 3, 3) from MCMF to the camera in the declared pointing, at positions (..., 3)."""
        return pointed_camera_from_mcmf(position_mcmf_m, self.tilt_rad, self.yaw_rad)

    def known(self, utc_ns: IntArray) -> BoolArray:
        """Return whether the attitude of the frames at `utc_ns` (n,) was telemetered."""
        return self._attitudes(utc_ns)[1]

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
        q_wxyz, known = self._attitudes(utc_ns)
        if known.any():
            camera_from_icrf = matrix_from_quaternion(q_wxyz[known])
            rotations[known] = camera_from_icrf @ np.swapaxes(mcmf_from_icrf[known], -1, -2)
        return rotations

    def _attitudes(self, utc_ns: IntArray) -> tuple[FloatArray, BoolArray]:
        """Return quaternions (n, 4) of frames and whether they are known."""
        times = self.attitude_utc_ns
        if not len(times):
            return np.zeros((len(utc_ns), 4)), np.zeros(len(utc_ns), dtype=np.bool_)
        after = np.minimum(np.searchsorted(times, utc_ns), len(times) - 1)
        at = np.asarray(times[after] == utc_ns, dtype=np.bool_)
        if not self.interpolated or len(times) < 2:
            return self.q_wxyz[after], at
        before = np.maximum(after - 1, 0)
        step = times[after] - times[before]
        inside = (times[before] < utc_ns) & (utc_ns < times[after])
        inside &= step <= GAP_STEPS * np.median(np.diff(times))
        part = np.where(inside, (utc_ns - times[before]) / np.maximum(step, 1), 1.0)
        return _slerp(self.q_wxyz[before], self.q_wxyz[after], part), at | inside


def _slerp(first: FloatArray, last: FloatArray, part: FloatArray) -> FloatArray:
    """Return unit quaternions (n, 4) a part (n,) of the shorter way from the first to the last ones."""
    cosine = np.sum(first * last, axis=1)
    last = np.where(cosine[:, None] < 0.0, -last, last)
    angle = np.arccos(np.minimum(np.abs(cosine), 1.0))
    small = angle < 1e-6
    sine = np.where(small, 1.0, np.sin(angle))
    weight_first = np.where(small, 1.0 - part, np.sin((1.0 - part) * angle) / sine)
    weight_last = np.where(small, part, np.sin(part * angle) / sine)
    return np.asarray(weight_first[:, None] * first + weight_last[:, None] * last)
