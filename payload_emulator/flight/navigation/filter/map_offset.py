"""Size of the common offset of the crater list and noise of detections, learned in flight by maximum likelihood.

The filter carries the derivatives of its mean and covariance by x, the logarithm of the variance of the offset
(`filter.Slope`). Each fix then gives the score of its innovations, d log L / dx, and its expected square. After some
fixes x moves by the sum of the scores over the information collected so far, which is a step of Fisher scoring. The
prior counts as information; older information fades, so that the size follows the ground.

The noise of detections, the part of their error that is new in every frame of a crater, is learned in the same way, in
shorter steps: noise that is stated too large would otherwise take the place of the offset. Its score is taken at the
covariance of the innovations as it is.
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
    noise_prior_information, noise_fixes, noise_largest
        Noise of detections: information of the prior, a factor of 1 on the stated standard deviation (a fix gives 1 to
        3); fixes of one step; largest factor, whose inverse is the smallest one.
    """

    prior_m: float = 60.0
    prior_information: float = 1.0
    correlation_rad: float = math.radians(15.0)
    fixes: int = 40
    smallest_m: float = 15.0
    largest_m: float = 100.0
    largest_factor: float = 2.0
    kept: float = 0.97
    noise_prior_information: float = 20.0
    noise_fixes: int = 10
    noise_largest: float = 2.0


@dataclass(frozen=True, slots=True)
class OffsetSize:
    """Size and noise in use, with the evidence for the next ones.

    Attributes
    ----------
    information
        Information in x that the size rests on.
    fixes
        Fixes that it was learned from; 0 for the prior.
    score, gained, pending
        Sums of score and information over the fixes since the last step, and their number.
    noise_factor, noise_information, noise_score, noise_gained
        The same of the noise of detections: a factor on its stated standard deviation.
    """

    sigma_m: float
    information: float
    fixes: int = 0
    score: float = 0.0
    gained: float = 0.0
    pending: int = 0
    noise_factor: float = 1.0
    noise_information: float = OffsetRule().noise_prior_information
    noise_score: float = 0.0
    noise_gained: float = 0.0


def first_size(rule: OffsetRule) -> OffsetSize:
    """Return the prior."""
    return OffsetSize(rule.prior_m, rule.prior_information, noise_information=rule.noise_prior_information)


def learned(
    size: OffsetSize, score: tuple[float, float], noise_score: tuple[float, float], rule: OffsetRule
) -> OffsetSize:
    """Return the size after one more fix: it changes with every `fixes`-th, its noise with every `noise_fixes`-th."""
    if not all(map(math.isfinite, score + noise_score)):
        return size
    size = replace(
        size,
        score=size.score + score[0],
        gained=size.gained + score[1],
        pending=size.pending + 1,
        noise_score=size.noise_score + noise_score[0],
        noise_gained=size.noise_gained + noise_score[1],
    )
    if size.pending % rule.noise_fixes == 0:
        information = rule.kept * size.noise_information + size.noise_gained
        factor = size.noise_factor * _change(size.noise_score / information, rule)
        factor = min(max(factor, 1.0 / rule.noise_largest), rule.noise_largest)
        size = replace(size, noise_factor=factor, noise_information=information, noise_score=0.0, noise_gained=0.0)
    if size.pending < rule.fixes:
        return size
    information = rule.kept * size.information + size.gained
    sigma_m = min(max(size.sigma_m * _change(size.score / information, rule), rule.smallest_m), rule.largest_m)
    fixes = size.fixes + size.pending
    return replace(size, sigma_m=sigma_m, information=information, fixes=fixes, score=0.0, gained=0.0, pending=0)


def _change(move: float, rule: OffsetRule) -> float:
    """Return the factor of a standard deviation whose log-variance moves by so much, bounded."""
    limit = 2.0 * math.log(rule.largest_factor)
    return math.exp(0.5 * min(max(move, -limit), limit))
