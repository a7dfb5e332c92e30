"""Trajectories in the form that public evaluators read, and the two errors those evaluators give.

A pose is the position in mean-Earth axes with the orientation of the reference orbit's radial, transverse and normal
axes: relative errors of the evaluators then split along the track and not along fixed axes. Nothing is aligned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.constants import NANOSECONDS_PER_SECOND
from lunar.frames import quaternion_from_matrix, rtn_from_inertial


@dataclass(frozen=True, slots=True)
class TrajectoryError:
    """Lengths of position errors, metres: root mean square, mean, median, largest, and how many."""

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    samples: int


def absolute_error(estimate_m: FloatArray, reference_m: FloatArray) -> TrajectoryError:
    """Absolute trajectory error of positions (n, 3), without alignment.

    References
    ----------
    Sturm et al. (2012), A benchmark for the evaluation of RGB-D SLAM systems, IROS, equation 2, with the identity for
    the alignment.
    """
    return _statistics(np.linalg.norm(estimate_m - reference_m, axis=1))


def relative_error(estimate_m: FloatArray, reference_m: FloatArray, frames: int) -> TrajectoryError:
    """Relative pose error (translation) of positions (n, 3) over a number of frames, every start counted.

    Both poses of a pair carry the same orientation, so that the length of the relative pose's error is that of the
    difference of the two displacements.

    References
    ----------
    Sturm et al. (2012), equation 1.
    """
    moved = (estimate_m[frames:] - estimate_m[:-frames]) - (reference_m[frames:] - reference_m[:-frames])
    return _statistics(np.linalg.norm(moved, axis=1))


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
    w, x, y, z = np.moveaxis(
        quaternion_from_matrix(np.swapaxes(rtn_from_inertial(reference_m, velocity), 1, 2)), -1, 0
    )
    lines = [
        f"{int(t) // NANOSECONDS_PER_SECOND}.{int(t) % NANOSECONDS_PER_SECOND:09d} "
        + " ".join(f"{value:.6f}" for value in position)
        + " "
        + " ".join(f"{value:.12f}" for value in turn)
        for t, position, turn in zip(utc_ns, position_m, np.stack([x, y, z, w], axis=1), strict=True)
    ]
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n"


def _statistics(length_m: FloatArray) -> TrajectoryError:
    if not length_m.size:
        nan = float("nan")
        return TrajectoryError(nan, nan, nan, nan, 0)
    return TrajectoryError(
        float(np.sqrt(np.mean(length_m**2))),
        float(np.mean(length_m)),
        float(np.median(length_m)),
        float(np.max(length_m)),
        int(length_m.size),
    )
