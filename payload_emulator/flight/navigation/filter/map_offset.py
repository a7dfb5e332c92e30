"""Size of the common offset of the crater list, learned in flight by maximum likelihood.

The filter carries the derivatives of its mean and covariance by x, the logarithm of the variance of the offset
(`filter.Slope`). Each fix then gives the score of its innovations, d log L / dx, and its expected square. After some
fixes x moves by the sum of the scores over the information collected so far, which is a step of Fisher scoring. The
prior counts as information; older information fades, so that the size follows the ground.
"""

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class OffsetRule:
    """Prior and limits of the size, which is the standard deviation east and north.

    Attributes
    ----------
    prior_m, prior_information
        Size at the start, wide enough for the worst map that was considered (60 m over 10 degrees), and its information
        in x: 1 is a factor of 1.6 in the size at 1 sigma. A window of 37 frames gives a tenth of that to 1.
    correlation_rad
        Angle at the Moon's centre over which the offset is similar (1/e), in place of that of `CommonErrors`. On tuning
        ground 15 degrees give twice the information of 30 and smaller errors on a distorted map.
    fixes
        Fixes of one step: from fewer nothing is learned.
    smallest_m, largest_m
        Limits of the size. The smaller one is the standard deviation that a registration states.
    largest_factor
        Largest change of the size in a step.
    kept
        Share of the older information that is kept at each step.
    """

    prior_m: float = 60.0
    prior_information: float = 1.0
    correlation_rad: float = math.radians(15.0)
    fixes: int = 40
    smallest_m: float = 15.0
    largest_m: float = 100.0
    largest_factor: float = 2.0
    kept: float = 0.97


@dataclass(frozen=True, slots=True)
class OffsetSize:
    """Size in use, with the evidence for the next one.

    Attributes
    ----------
    information
        Information in x that the size rests on.
    fixes
        Fixes that it was learned from; 0 for the prior.
    score, gained, pending
        Sums of score and information over the fixes since the last step, and their number.
    """

    sigma_m: float
    information: float
    fixes: int = 0
    score: float = 0.0
    gained: float = 0.0
    pending: int = 0


def first_size(rule: OffsetRule) -> OffsetSize:
    """Return the prior."""
    return OffsetSize(rule.prior_m, rule.prior_information)


def learned(size: OffsetSize, score: tuple[float, float], rule: OffsetRule) -> OffsetSize:
    """Return the size after one more fix; it changes with every `fixes`-th one."""
    if not all(map(math.isfinite, score)):
        return size
    size = replace(size, score=size.score + score[0], gained=size.gained + score[1], pending=size.pending + 1)
    if size.pending < rule.fixes:
        return size
    information = rule.kept * size.information + size.gained
    limit = 2.0 * math.log(rule.largest_factor)
    move = min(max(size.score / information, -limit), limit)
    sigma_m = min(max(size.sigma_m * math.exp(0.5 * move), rule.smallest_m), rule.largest_m)
    return OffsetSize(sigma_m, information, size.fixes + size.pending)
