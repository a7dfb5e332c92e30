"""The paper's choice of the field of view: how likely is it that the footprint holds enough craters?

For every position the craters of 5 to 30 km are sorted by the field of view at which their centres come into
the square image of a north-up nadir camera over the sphere, short of the horizon.  The smallest fields of
view that hold one, three, five craters follow for all positions at once, and every probability is a count
over them.

A position counts only where the catalogue is complete: where the nearest crater is no farther than 100 km and
most of the nearest are of complete regions.

References
----------
The paper, section V-B.3: fields of view from 10 to 160 degrees; the smallest with more than 90 % for three
craters.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import ground_arc_m
from lunar.catalogue import BAND_RAD, CLASS_LIMITS_M, CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.errors import LunarError
from lunar.frames import spherical_from_mcmf

PAPER_FOV_DEG = tuple(float(v) for v in range(10, 161, 10))
PAPER_COUNTS = (1, 3, 5)
PAPER_NEEDED = 3
PAPER_PROBABILITY = 0.9
ALTITUDE_BAND_M = 5_000.0
COVERED_WITHIN_M = 100_000.0


@dataclass(frozen=True, slots=True, eq=False)
class FovStudy:
    """Probabilities over the positions that the catalogue covers.

    ``probability_at_least[n]`` belongs to ``fov_deg``, element by element.  ``selected_fov_deg`` is the
    smallest of them at which the probability of ``needed`` craters exceeds ``threshold`` over the whole
    orbit, and ``selected_every_altitude_deg`` the smallest at which it does in each altitude band of 5 km;
    NaN where none does. ``required_fov_deg`` (positions, 5) says at which field of view the first, second,
    ... crater comes into view.
    """

    fov_deg: FloatArray
    probability_at_least: dict[int, FloatArray]
    needed: int
    threshold: float
    selected_fov_deg: float
    selected_every_altitude_deg: float
    positions: int
    positions_covered: int
    craters: int
    source: str
    altitude_m: FloatArray
    required_fov_deg: FloatArray


def study_field_of_view(
    position_mcmf_m: ArrayLike,
    catalogue: CraterCatalogue,
    fov_deg: Sequence[float] = PAPER_FOV_DEG,
    counts: Sequence[int] = PAPER_COUNTS,
    needed: int = PAPER_NEEDED,
    threshold: float = PAPER_PROBABILITY,
) -> FovStudy:
    """Return the study over positions (n, 3) with the craters of 5 to 30 km of a catalogue.

    Raises
    ------
    LunarError
        Where a field of view is not in 0..180 degrees or the catalogue covers no position.
    """
    from lunar._fov_kernel import first_craters_in_view

    fields = np.unique(np.asarray(fov_deg, dtype=np.float64))
    if len(fields) == 0 or not (fields[0] > 0.0 and fields[-1] < 180.0):
        raise LunarError(f"field-of-view study: expected fields of view in 0..180 deg, found {list(fov_deg)}")
    in_range = (catalogue.diameter_m >= CLASS_LIMITS_M[0]) & (catalogue.diameter_m <= CLASS_LIMITS_M[-1])
    craters = catalogue.select(in_range)
    latitude_rad, longitude_rad, altitude_m = spherical_from_mcmf(np.atleast_2d(position_mcmf_m))
    keys, order, unit = craters._index
    kept = max(5, needed, *counts)
    tangents, rows = first_craters_in_view(
        latitude_rad,
        longitude_rad,
        1.0 + altitude_m / MOON_RADIUS_M,
        keys,
        np.ascontiguousarray(unit[order]),
        BAND_RAD,
        kept,
    )
    covered = _covered(tangents, rows, altitude_m, craters.complete[order])
    if not np.any(covered):
        raise LunarError(
            f"field-of-view study: expected craters of 5-30 km under the orbit, found none in {catalogue.source}"
        )
    required = np.degrees(2.0 * np.arctan(tangents[covered]))
    probability = {n: _share_within(required[:, n - 1], fields) for n in counts}
    enough = required[:, needed - 1]
    bands = np.floor(altitude_m[covered] / ALTITUDE_BAND_M).astype(np.int64)
    worst = np.min([_share_within(enough[bands == band], fields) for band in np.unique(bands)], axis=0)
    return FovStudy(
        fields,
        probability,
        needed,
        threshold,
        _smallest(fields, _share_within(enough, fields) > threshold),
        _smallest(fields, worst > threshold),
        len(altitude_m),
        int(np.count_nonzero(covered)),
        len(craters),
        catalogue.source,
        altitude_m[covered],
        required,
    )


def _covered(tangents: FloatArray, rows: IntArray, altitude_m: FloatArray, complete: BoolArray) -> BoolArray:
    known = rows[:, 0] >= 0
    # The nearest crater lies within the square of its tangent, so at most sqrt(2) farther than that along the
    # ground.
    arc_m = ground_arc_m(np.arctan(np.where(known, tangents[:, 0], 0.0)), altitude_m)
    near = known & ~(arc_m > COVERED_WITHIN_M)
    flags = np.where(rows >= 0, complete[rows] if len(complete) else False, False)
    return np.asarray(near & (2 * np.count_nonzero(flags, axis=1) > np.count_nonzero(rows >= 0, axis=1)))


def _share_within(required_deg: FloatArray, fields_deg: FloatArray) -> FloatArray:
    """Return for each field of view the share of positions that need no more."""
    counts = np.searchsorted(np.sort(required_deg), fields_deg, side="right")
    return np.asarray(counts / max(len(required_deg), 1), dtype=np.float64)


def _smallest(fields_deg: FloatArray, good: BoolArray) -> float:
    return float(fields_deg[np.argmax(good)]) if np.any(good) else math.nan
