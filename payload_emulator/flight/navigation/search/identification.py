"""Identification of detections with craters of the catalogue, around a predicted pose.

The prediction errs by much the same amount for every crater of a frame, so craters are not gated one by one: each
possible pair of a detection and a crater is taken as a hypothesis, the prediction is corrected by it, and the
hypothesis that explains most of the other detections wins (consensus of one pair; Civera et al. 2010). The set it
explains is then tested as a whole, and each member against all the others.

How many members a set needs follows from how easily chance would make it up: from the number of detections, the
density of the map and the size of the search. A pair by chance does harm only where the prediction is worth less than
the pair: around a good prediction one crater is enough, around a poor one a lone pair by chance would be a wrong fix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray, IntArray
from payload_emulator.flight.navigation.sighting import Sighting
from payload_emulator.flight.vision.detections import Detections

# Chi-square of 2 degrees of freedom at 0.999: a true pair is lost once in a thousand.
GATE = 13.8
# A wrong fix contradicts the truth by more than its claim allows once in 1e5 (25.9, three degrees of freedom); half of
# that is left to the error that the prediction had before.
_HARMLESS = 12.0


@dataclass(frozen=True, slots=True)
class IdentificationParameters:
    """Tests of a set of pairs.

    Attributes
    ----------
    log_diameter_gate
        Largest difference of the logarithms of measured and catalogued diameter; catalogues and detectors agree to
        0.1 to 0.15.
    false_set_limit
        Largest expected number of sets that chance makes up per frame, for a set to be believed while tracking. It
        holds for up to three detections and falls with the square of those beyond two: a frame full of detections
        that hardly any crater explains speaks against the set, a mirrored image for example.
    harmful_set_limit
        The same for sets that would move the estimate farther than it then claims.
    hypothesis_limit
        Pairs tried as hypotheses.
    """

    log_diameter_gate: float = 0.4
    false_set_limit: float = 0.03
    harmful_set_limit: float = 1e-4
    hypothesis_limit: int = 200


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """Pairs of a detection and a crater.

    Attributes
    ----------
    detection, sighted
        Indices into the detections and into the sighting, same length.
    candidates
        Pairs that the gates left to choose from.
    needed
        Members that a set had to have to be believed.
    """

    detection: IntArray
    sighted: IntArray
    candidates: int
    needed: int

    def __len__(self) -> int:
        return int(self.detection.shape[0])

    def select(self, which: IntArray) -> Identification:
        """Return some of the pairs, believed as all of them were."""
        return Identification(self.detection[which], self.sighted[which], self.candidates, self.needed)

    @property
    def believed(self) -> bool:
        return len(self) >= self.needed > 0


def identify(
    found: Detections,
    sighting: Sighting,
    prior_px2: FloatArray,
    crater_noise_px2: FloatArray,
    detection_variance_px2: FloatArray,
    image_area_px2: float,
    parameters: IdentificationParameters,
    place_px2: FloatArray | None = None,
) -> Identification:
    """Return the pairs of detections and craters that agree on one correction of the prediction.

    Parameters
    ----------
    found
        Detections, n of them.
    sighting
        Craters around the predicted image, m of them.
    prior_px2
        Covariance of the predicted places by the error of the prediction, shape (m, 2, m, 2).
    crater_noise_px2
        Covariance of each crater's own place, shape (m, 2, 2).
    detection_variance_px2
        Variance of each detection, per axis, shape (n,).
    place_px2
        The part of the prediction's covariance that the camera's place is behind, shape (m, 2, 2); None for all of it.
    """
    place_px2 = np.einsum("jajb->jab", prior_px2) if place_px2 is None else place_px2
    detection, sighted, offset, spread, chance, harm = _candidates(
        found, sighting, prior_px2, crater_noise_px2, detection_variance_px2, image_area_px2, parameters, place_px2
    )
    count = int(detection.size)
    if not count:
        nothing = np.empty(0, dtype=np.int64)
        return Identification(nothing, nothing, 0, 1)
    chosen, tight_chance = _consensus(
        detection, sighted, offset, spread, prior_px2, chance, parameters.hypothesis_limit
    )
    chosen = _consistent(chosen, sighted, offset, prior_px2, crater_noise_px2, detection_variance_px2[detection])
    limit = parameters.false_set_limit / max(1, len(found) - 2) ** 2
    needed = max(
        minimum_members(float(chance.sum()), tight_chance, limit),
        minimum_members(float(harm), tight_chance, parameters.harmful_set_limit),
    )
    return Identification(detection[chosen], sighted[chosen], count, needed)


def minimum_members(loose_chance: float, tight_chance: float, limit: float) -> int:
    """Return how many agreeing pairs make a set that chance is expected to make up less often than the limit.

    Parameters
    ----------
    loose_chance
        Expected number of chance pairs in the search: each is a hypothesis.
    tight_chance
        Expected number of further chance pairs that agree with one hypothesis (Poisson).
    """
    tail, term, members = 1.0, np.exp(-tight_chance), 1
    while loose_chance * tail >= limit and members < 50:
        tail -= term
        term *= tight_chance / members
        tail = max(tail, 0.0)
        members += 1
    return members


def _candidates(
    found: Detections,
    sighting: Sighting,
    prior_px2: FloatArray,
    crater_noise_px2: FloatArray,
    detection_variance_px2: FloatArray,
    image_area_px2: float,
    parameters: IdentificationParameters,
    place_px2: FloatArray,
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray, float]:
    """Return detection, crater, offset (k, 2), spread (k, 2, 2) of gated pairs, the chance of each, and of all harm.

    Chances cover every pair that the diameters allow, gated or not: the area of its gate over that of the image is the
    probability that a detection lying anywhere falls into it. Let the place bring the covariance P to a pair and all
    else R. A detection that lies f from where the crater is moves the place to a normalised error of
    f^2 P / (R (P + R)): the part of the gate where that exceeds a limit is the harmful one, none where P is below R.
    """
    uv = np.stack([found.u_px, found.v_px], axis=1)
    own = np.einsum("jajb->jab", prior_px2) + crater_noise_px2
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(np.log(found.diameter_px[:, None] / sighting.diameter_px[None, :]))
        alike = ratio < parameters.log_diameter_gate
    rows, columns = np.nonzero(alike & np.all(np.isfinite(sighting.uv_px), axis=1)[None, :])
    spread = own[columns] + detection_variance_px2[rows, None, None] * np.eye(2)
    offset = uv[rows] - sighting.uv_px[columns]
    determinant = _determinant(spread)
    inside = _distance(offset, spread, determinant) < GATE
    chance = np.minimum(np.pi * GATE * np.sqrt(determinant) / image_area_px2, 1.0)
    rest = spread - place_px2[columns]
    ratio = np.sqrt(_determinant(rest) / np.maximum(_determinant(place_px2[columns]), 1e-12))
    harm = float(np.sum(chance * np.maximum(1.0 - _HARMLESS / GATE * ratio, 0.0)))
    return rows[inside], columns[inside], offset[inside], spread[inside], chance, harm


def _consensus(
    detection: IntArray,
    sighted: IntArray,
    offset: FloatArray,
    spread: FloatArray,
    prior_px2: FloatArray,
    chance: FloatArray,
    limit: int,
) -> tuple[IntArray, float]:
    """Return the pairs that the best hypothesis explains, and the expected number of chance pairs that agree."""
    count = detection.size
    tried = np.arange(count) if count <= limit else np.linspace(0, count - 1, limit).astype(np.int64)
    # Correction of pair l by hypothesis h: prior(l, h) spread(h)^-1, for all l and h.
    between = prior_px2[sighted[None, :], :, sighted[tried][:, None], :]
    gain = np.einsum("hlab,hbc->hlac", between, np.linalg.inv(spread[tried]))
    left = offset[None] - np.einsum("hlab,hb->hla", gain, offset[tried])
    narrowed = spread[None] - np.einsum("hlab,hlcb->hlac", gain, between)
    determinant = _determinant(narrowed)
    distance = _distance(left, narrowed, np.maximum(determinant, 1e-9))
    # One vote per detection: its nearest crater under the hypothesis. Pairs are ordered by detection.
    starts = np.flatnonzero(np.r_[True, detection[1:] != detection[:-1]])
    nearest = np.minimum.reduceat(distance, starts, axis=1)
    # A hypothesis explains its own pair by construction.
    best = int(np.argmax(np.maximum(GATE - nearest, 0.0).sum(axis=1)))
    hypothesis = int(tried[best])
    row = distance[best].copy()
    row[hypothesis] = -1.0
    taken_detection: set[int] = set()
    taken_crater: set[int] = set()
    chosen = []
    for k in np.argsort(row, kind="stable"):
        if row[k] >= GATE:
            break
        if int(detection[k]) not in taken_detection and int(sighted[k]) not in taken_crater:
            taken_detection.add(int(detection[k]))
            taken_crater.add(int(sighted[k]))
            chosen.append(int(k))
    before = np.sqrt(_determinant(spread))
    shrink = float(np.median(np.sqrt(np.maximum(determinant[best], 0.0)) / before))
    return np.array(sorted(chosen), dtype=np.int64), float(chance.sum()) * shrink


def _consistent(
    chosen: IntArray,
    sighted: IntArray,
    offset: FloatArray,
    prior_px2: FloatArray,
    crater_noise_px2: FloatArray,
    variance_px2: FloatArray,
) -> IntArray:
    """Return the pairs left after those are removed, worst first, that all the others together contradict."""
    while chosen.size > 1:
        craters = sighted[chosen]
        size = 2 * chosen.size
        full = prior_px2[craters][:, :, craters].reshape(size, size).copy()
        own = crater_noise_px2[craters] + variance_px2[chosen, None, None] * np.eye(2)
        for k in range(chosen.size):
            full[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += own[k]
        inverse = np.linalg.inv(full)
        pull = (inverse @ offset[chosen].reshape(size)).reshape(-1, 2)
        blocks = np.stack([inverse[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(chosen.size)])
        contradiction = np.einsum("ka,kab,kb->k", pull, np.linalg.inv(blocks), pull)
        worst = int(np.argmax(contradiction))
        if contradiction[worst] < GATE:
            break
        chosen = np.delete(chosen, worst)
    return chosen


def _determinant(matrix: FloatArray) -> FloatArray:
    """Return determinants of (..., 2, 2); zero where rounding makes them negative."""
    value = matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]
    return np.asarray(np.maximum(value, 0.0), dtype=np.float64)


def _distance(offset: FloatArray, spread: FloatArray, determinant: FloatArray) -> FloatArray:
    """Return squared Mahalanobis distances of offsets (..., 2) under covariances (..., 2, 2)."""
    a, b = offset[..., 0], offset[..., 1]
    return np.asarray(
        (spread[..., 1, 1] * a * a - 2.0 * spread[..., 0, 1] * a * b + spread[..., 0, 0] * b * b) / determinant,
        dtype=np.float64,
    )
