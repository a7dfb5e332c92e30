"""Trajectories in the form that public evaluators read.

A pose is the position in mean-Earth axes with the orientation of the reference orbit's radial, transverse and normal
axes: relative errors of the evaluators then split along the track and not along fixed axes. Nothing is aligned.
"""

from __future__ import annotations

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.constants import NANOSECONDS_PER_SECOND
from lunar.frames import continuous_quaternions, quaternion_from_matrix, rtn_from_inertial


def format_tum(utc_ns: IntArray, position_m: FloatArray, reference_m: FloatArray) -> str:
    """A trajectory in TUM form: a line "t x y z qx qy qz qw" per pose, seconds past the Unix epoch, metres.

    Parameters
    ----------
    position_m
        Mean-Earth axes, shape (n, 3).
    reference_m
        Positions of the reference at the same times, which give the orientation; n is at least 2.
    """
    seconds = (utc_ns - utc_ns[0]) / NANOSECONDS_PER_SECOND
    velocity = np.gradient(reference_m, seconds, axis=0)
    turns = quaternion_from_matrix(np.swapaxes(rtn_from_inertial(reference_m, velocity), 1, 2))
    lines = [
        f"{int(t) // NANOSECONDS_PER_SECOND}.{int(t) % NANOSECONDS_PER_SECOND:09d} "
        + " ".join(f"{value:.6f}" for value in position)
        + " "
        + " ".join(f"{value:.12f}" for value in turn)
        for t, position, turn in zip(
            utc_ns, position_m, np.roll(continuous_quaternions(turns), -1, axis=1), strict=True
        )
    ]
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n"
