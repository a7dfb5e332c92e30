"""Search of single pictures, such as photographs: direction of the Sun where it is not stated, and small craters.

The network is trained on images whose Sun is within 45 degrees of the top, so the direction of the Sun decides which of
the four quarter turns is searched. Where it is not stated, it is found in two steps. First, up to four squares of the
picture, enlarged twice, are searched in all four turns; the turn with the most evidence is taken. Evidence is the sum
over all craters of the picture of the fourth power of the score times how concave the ground is: the first harmonic of
the brightness toward the Sun inside the rim minus that outside. Second, the azimuth follows from the brightness inside
the craters found: the wall that faces the Sun is the bright one. A turn whose opposite has nearly as much evidence
leaves the direction undetermined.

The numbers of this module were fixed on rendered validation frames (`scenarios/detector-validation.toml`), never on
photographs; `docs/detector.md` has the figures.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray
from payload_emulator.flight.vision.detections import Detections, no_detections
from payload_emulator.flight.vision.detector import INPUT_SIZE_PX, OnnxDetector, drop_duplicates, join
from payload_emulator.flight.vision.preprocess import ImageQuality, prepare_image, sun_up_turns, turn_back

EVIDENCE_SCORE = 0.44
EVIDENCE_POWER = 4.0
LEAST_EVIDENCE = 0.3
ODDS_POWER = 7.3
"""Evidence of two opposite turns, each plus `LEAST_EVIDENCE`, to this power are as their probabilities (maximum
likelihood, squares of 96 to 256 px of the validation frames)."""
LEAST_CONFIDENCE = 0.95
"""Of the half turn; below it the direction is undetermined."""

_EVIDENCE_SQUARE_PX = INPUT_SIZE_PX // 2
_LEAST_DIPOLE_PX = 8.0  # inside a smaller crater, a few pixels decide
_INSIDE = 0.8  # of the radius: without the rim itself
_OUTSIDE = (1.1, 1.6)

SMALL_CRATERS_PX = 48.0
"""Up to this diameter, in pixels of the picture, craters are also taken from the enlarged picture. On every source of
the validation frames the F1 of both together from 16 to 64 px is at least that of the picture itself."""


@dataclass(frozen=True, slots=True)
class SunEstimate:
    """Direction of the Sun in a picture, from the picture.

    azimuth_deg : clockwise from the top of the picture, 0 to 360.
    confidence : probability that the Sun is not in the opposite direction; .5 would be a guess.
    evidence : of the turns that have the Sun at 0, 90, 180 and 270 degrees.
    craters : from which the azimuth was computed; 0 leaves the azimuth of the turn.
    """

    azimuth_deg: float
    confidence: float
    evidence: tuple[float, ...]
    craters: int

    @property
    def determined(self) -> bool:
        """Return whether the picture decides between the two opposite directions."""
        return self.confidence >= LEAST_CONFIDENCE


@dataclass(frozen=True, slots=True, eq=False)
class PictureSearch:
    """Outcome of the search of a picture; `sun` is None where its direction was stated or nothing shows it."""

    quality: ImageQuality
    detections: Detections
    sun: SunEstimate | None = None


def sun_at_azimuth(azimuth_deg: float) -> FloatArray:
    """Direction to the Sun in the camera frame, (3,), in the image plane, of an azimuth clockwise from the top."""
    azimuth = np.radians(azimuth_deg)
    return np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])


def search_picture(
    detector: OnnxDetector,
    image: NDArray[np.generic],
    sun_in_camera: FloatArray | None = None,
    *,
    two_scales: bool = False,
) -> PictureSearch:
    """Craters of a picture of any size; the direction of the Sun is found where it is not given.

    Parameters
    ----------
    image : as `OnnxDetector.detect` takes it.
    sun_in_camera : direction to the Sun, (3,), camera frame; None: it is found from the picture.
    two_scales : also search the picture enlarged twice, for craters of up to `SMALL_CRATERS_PX`; up to ten times
        the time.
    """
    prepared = prepare_image(image, detector.preparation)
    if prepared.quality is not ImageQuality.OK:
        return PictureSearch(prepared.quality, no_detections())
    estimate = find_sun(detector, prepared.gray) if sun_in_camera is None else None
    if estimate is not None:
        sun_in_camera = sun_at_azimuth(estimate.azimuth_deg)
    turns = sun_up_turns(sun_in_camera)
    upright = np.rot90(prepared.gray, turns)
    found = detector.search(upright)
    if two_scales:
        found = _merge(found, _search_enlarged(detector, upright), detector)
    height_px, width_px = prepared.gray.shape
    u_px, v_px = turn_back(found.u_px, found.v_px, turns, height_px, width_px)
    found = detector.corrected(replace(found, u_px=u_px, v_px=v_px), height_px, width_px, sun_in_camera)
    return PictureSearch(ImageQuality.OK, found, estimate)


def find_sun(detector: OnnxDetector, gray: NDArray[np.float32]) -> SunEstimate | None:
    """Direction of the Sun from a prepared plane (H, W); None where no turn shows a crater."""
    squares = [enlarge(square) for square in _squares(gray)]
    evidence = np.zeros(4)
    pulls: list[NDArray[np.complex128]] = []
    for turns in range(4):
        parts = [
            _walls(plane, detector.search(plane, EVIDENCE_SCORE))
            for plane in (np.rot90(square, turns) for square in squares)
        ]
        pulls.append(np.concatenate([pull for pull, _ in parts]))
        evidence[turns] = sum(float(concave.sum()) for _, concave in parts)
    if not evidence.any():
        return None
    best = int(np.argmax(evidence))
    away = complex(pulls[best].sum())
    # In the turned plane: the Sun is opposite to the bright walls. Clockwise from the top: right is +90 degrees.
    tilt = float(np.degrees(np.angle(complex(away.imag, -away.real)))) if away else 0.0
    odds = ((evidence[best] + LEAST_EVIDENCE) / (evidence[best - 2] + LEAST_EVIDENCE)) ** ODDS_POWER
    return SunEstimate(
        azimuth_deg=(90.0 * best + tilt) % 360.0,
        confidence=float(odds / (1.0 + odds)),
        evidence=tuple(evidence.tolist()),
        craters=int(pulls[best].size),
    )


def enlarge(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """A plane (H, W) at twice its size (2 H, 2 W), by cubic interpolation (Keys, a = -0.5).

    Pixel x of the plane lies at 2 x + 0.5 of the enlarged one.
    """
    return np.ascontiguousarray(_enlarge_rows(_enlarge_rows(plane).T).T)


def _enlarge_rows(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    # Weights of the neighbours at distances 1.25, 0.25, 0.75 and 1.75 of Keys' kernel, mirrored for the other half.
    weights = np.array([-0.0703125, 0.8671875, 0.2265625, -0.0234375], np.float32)
    rows = plane.shape[0]
    padded = np.pad(plane, ((2, 2), (0, 0)), mode="edge")
    larger = np.empty((2 * rows, plane.shape[1]), np.float32)
    part = [padded[k : k + rows] for k in range(5)]  # rows at -2, -1, 0, +1, +2
    larger[0::2] = weights[3] * part[0] + weights[2] * part[1] + weights[1] * part[2] + weights[0] * part[3]
    larger[1::2] = weights[0] * part[1] + weights[1] * part[2] + weights[2] * part[3] + weights[3] * part[4]
    return larger


def _squares(gray: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """One to four squares of half the network's input, spread over a plane; the whole of a smaller one."""
    starts = [
        [0] if length <= _EVIDENCE_SQUARE_PX else sorted({int(q * (length - _EVIDENCE_SQUARE_PX)) for q in spread})
        for length in gray.shape
        for spread in [(0.0, 1.0) if length <= 2 * _EVIDENCE_SQUARE_PX else (0.25, 0.75)]
    ]
    return [
        gray[top : top + _EVIDENCE_SQUARE_PX, left : left + _EVIDENCE_SQUARE_PX]
        for top in starts[0]
        for left in starts[1]
    ]


def _walls(plane: NDArray[np.float32], found: Detections) -> tuple[NDArray[np.complex128], FloatArray]:
    """For each crater of a plane: the direction of its bright wall (right + i down, unit) times its score, (n,), and
    its evidence that the Sun is at the top, (n,)."""
    pulls, evidence = [], []
    for u, v, diameter, score in zip(found.u_px, found.v_px, found.diameter_px, found.score, strict=True):
        radius = 0.5 * diameter
        if not diameter >= _LEAST_DIPOLE_PX:
            continue
        top, left = (int(max(0, np.ceil(x - _OUTSIDE[1] * radius))) for x in (v, u))
        values = plane[top : int(v + _OUTSIDE[1] * radius) + 1, left : int(u + _OUTSIDE[1] * radius) + 1]
        place = np.add.outer(1j * (np.arange(values.shape[0]) + top - v), np.arange(values.shape[1]) + left - u)
        share = np.abs(place) / radius
        inside, outside = share <= _INSIDE, (share > _OUTSIDE[0]) & (share <= _OUTSIDE[1])
        if np.count_nonzero(inside) < 2 or np.count_nonzero(outside) < 2:
            continue
        contrast = float(values[inside | outside].std(dtype=np.float64)) * radius
        within, beyond = (_harmonic(values[part], place[part]) for part in (inside, outside))
        if within and contrast:
            pulls.append(score * within / abs(within))
            evidence.append(score**EVIDENCE_POWER * max(0.0, (within - beyond).imag / contrast))
    return np.array(pulls, dtype=np.complex128), np.array(evidence, dtype=np.float64)


def _harmonic(values: NDArray[np.float32], place: NDArray[np.complex128]) -> complex:
    """Mean of the place weighted by the brightness above its mean."""
    return complex((place * (values - values.mean(dtype=np.float64))).mean())


def _search_enlarged(detector: OnnxDetector, upright: NDArray[np.float32]) -> Detections:
    """Small craters of an upright plane from the plane enlarged twice, in its own pixels."""
    found = detector.search(enlarge(upright))
    return replace(
        found,
        u_px=(found.u_px - 0.5) / 2.0,
        v_px=(found.v_px - 0.5) / 2.0,
        diameter_px=found.diameter_px / 2.0,
        sigma_px=found.sigma_px / 2.0,
    )


def _merge(coarse: Detections, fine: Detections, detector: OnnxDetector) -> Detections:
    """Craters of the plane and the smaller ones of the enlarged plane, best first, each once."""
    every = join([coarse, fine.select(fine.diameter_px <= SMALL_CRATERS_PX)])
    return drop_duplicates(every.select(np.argsort(-every.score, kind="stable")), detector.parameters)
