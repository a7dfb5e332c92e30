"""Difference of two ephemerides on common epochs, in radial, transverse and normal axes of the first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import FloatArray, IntArray
from lunar.ephemeris import Ephemeris
from lunar.errors import EphemerisCoverageError
from lunar.frames import rtn_from_inertial
from lunar.timescales import format_utc


@dataclass(frozen=True, slots=True, eq=False)
class EphemerisDifference:
    """Difference (second minus first) at ``samples`` epochs; ``rms_rtn_m`` is radial, transverse, normal."""

    max_m: float
    rms_m: float
    rms_rtn_m: tuple[float, float, float]
    samples: int
    utc_ns: IntArray
    position_rtn_m: FloatArray
    velocity_rtn_m_s: FloatArray


def compare(first: Ephemeris, second: Ephemeris, utc_ns: ArrayLike | None = None) -> EphemerisDifference:
    """Return the difference at epochs (n,), or at the states of the first that the second covers.

    Velocities are differenced in inertial axes and then rotated. They are not the rates of ``position_rtn_m``.

    Raises
    ------
    EphemerisCoverageError
        If the ephemerides have no common epoch, or do not both cover a given epoch.
    """
    if utc_ns is None:
        epochs = first.utc_ns[second.covers(first.utc_ns)]
        if len(epochs) == 0:
            raise EphemerisCoverageError(
                f"{format_utc(first.start_utc_ns)}..{format_utc(first.stop_utc_ns)}",
                f"{format_utc(second.start_utc_ns)}..{format_utc(second.stop_utc_ns)}",
                "comparison",
            )
    else:
        epochs = np.atleast_1d(np.asarray(utc_ns, dtype=np.int64))
    position_m, velocity_m_s = first.at(epochs)
    other_m, other_m_s = second.at(epochs)
    rtn = rtn_from_inertial(position_m, velocity_m_s)
    position_rtn_m = np.einsum("nij,nj->ni", rtn, other_m - position_m)
    velocity_rtn_m_s = np.einsum("nij,nj->ni", rtn, other_m_s - velocity_m_s)
    distance_m = np.linalg.norm(position_rtn_m, axis=1)
    radial, transverse, normal = np.sqrt(np.mean(position_rtn_m**2, axis=0))
    return EphemerisDifference(
        float(np.max(distance_m)),
        float(np.sqrt(np.mean(distance_m**2))),
        (float(radial), float(transverse), float(normal)),
        len(epochs),
        epochs,
        position_rtn_m,
        velocity_rtn_m_s,
    )
