"""Calibration of a network's detections: scores by size, position errors, and the pull of the Sun.

It is fitted on validation frames (`linna detector calibrate`) and stored in the metadata of the ONNX file under
`calibration`, so that it is loaded, uploaded and hashed with the network. It is valid for that network only: it names
the SHA-256 of the file without its metadata.

- Score: probability that a detection is a catalogued crater, a logistic function of the network's score with an offset
  that depends on the diameter in pixels. One threshold of the probability is thus a threshold of the score by size.
- Sigma: the standard deviation of a centre per axis in two parts, one that is new in every frame and one that lasts,
  the same from frame to frame of a crater under one Sun. Each is log-linear in diameter, sigma and depth from the
  network, elevation of the Sun above the image plane and distance from the middle of the image. The error of the
  catalogue on board is not included.
- Sun: mean displacement of centres toward the Sun and across, by diameter and by the angle between the Sun and the top
  of the turned image.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from lunar.arrays import FloatArray
from payload_emulator.errors import ModelError
from payload_emulator.flight.vision.detections import Detections

CALIBRATION_KEY = "calibration"
CALIBRATION_VERSION = 1
PARTS = ("score", "sigma", "sun")

REFERENCE_DIAMETER_PX = 20.0
TYPICAL_DEPTH_RATIO = 0.1
TYPICAL_SUN_SINE = 0.17  # 10 degrees, where the direction of the Sun is not known
TYPICAL_RADIUS = 0.7  # of half the width: the mean distance from the middle of an image
SIGMA_FEATURES = 6
SUN_FEATURES = 3
_LARGEST_PULLED_PX = 60.0
_LEAST_VARIANCE_PX2 = 1e-4
_METADATA_FIELD = 14  # of ModelProto in onnx.proto: metadata_props


@dataclass(frozen=True, slots=True)
class ScoreModel:
    """Logit of the probability: an offset, linear between knots of ln diameter_px, plus slope times logit of score."""

    log_diameter_px: tuple[float, ...]
    offset: tuple[float, ...]
    slope: float

    def probability(self, score: FloatArray, diameter_px: FloatArray) -> FloatArray:
        """Probabilities (n,) of scores and diameters (n,)."""
        size = np.log(np.maximum(diameter_px, 1e-3))
        offset = np.interp(size, self.log_diameter_px, self.offset)
        return np.asarray(1.0 / (1.0 + np.exp(-(offset + self.slope * logit(score)))))

    def least_score(self, probability: float) -> float:
        """The lowest score that has this probability at some diameter."""
        wanted = float(logit(np.array(probability))) - max(self.offset)
        return float(1.0 / (1.0 + np.exp(-wanted / self.slope)))


@dataclass(frozen=True, slots=True)
class SigmaModel:
    """Coefficients of ln sigma, as `sigma_features` orders them, and the range of each feature that was seen."""

    fresh: tuple[float, ...]
    total: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]

    def variances_px2(self, features: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Variance in all and its part that is new in every frame, of features (n, 6), (n,) each."""
        seen = np.clip(features, self.low, self.high)
        total = np.exp(2.0 * seen @ np.array(self.total))
        fresh = np.exp(2.0 * seen @ np.array(self.fresh))
        return np.maximum(total, _LEAST_VARIANCE_PX2), np.clip(fresh, _LEAST_VARIANCE_PX2, total)


@dataclass(frozen=True, slots=True)
class SunModel:
    """Coefficients of the mean displacement, px, as `sun_directions` orders them."""

    coefficients: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Calibration:
    """What was fitted; a part that is None leaves detections as the network gives them."""

    score: ScoreModel | None = None
    sigma: SigmaModel | None = None
    sun: SunModel | None = None


def logit(probability: FloatArray) -> FloatArray:
    """Logarithm of the odds."""
    inside = np.clip(probability, 1e-6, 1.0 - 1e-6)
    return np.asarray(np.log(inside / (1.0 - inside)))


def sigma_features(
    found: Detections, sun_in_camera: FloatArray | None, width_px: int, height_px: int, *, whole: bool = True
) -> FloatArray:
    """What sigma depends on, (n, 6); `whole` False: the place in the image is not that of the camera's frames."""
    count = len(found)
    depth = np.full(count, TYPICAL_DEPTH_RATIO) if found.depth_ratio is None else found.depth_ratio
    sine = TYPICAL_SUN_SINE
    if sun_in_camera is not None and np.isfinite(sun_in_camera).all() and sun_in_camera[2] != 0.0:
        sine = float(np.clip(-sun_in_camera[2] / np.linalg.norm(sun_in_camera), 0.0, 1.0))
    middle = 0.5 * (width_px - 1), 0.5 * (height_px - 1)
    radius = np.hypot(found.u_px - middle[0], found.v_px - middle[1]) / (0.5 * width_px)
    return np.stack(
        [
            np.ones(count),
            np.log(np.maximum(found.diameter_px, 1.0) / REFERENCE_DIAMETER_PX),
            np.log(np.maximum(found.sigma_px, 1e-3)),
            10.0 * depth,
            np.full(count, 10.0 * sine),
            radius if whole else np.full(count, TYPICAL_RADIUS),
        ],
        axis=1,
    )


def sun_directions(diameter_px: FloatArray, sun_in_camera: FloatArray) -> FloatArray:
    """Displacements (n, 2, 3) in the image, right and down, of one unit of each coefficient of a `SunModel`.

    The first is toward the Sun, the second too but in proportion to the diameter (20 px: 1), the third across, to the
    right of who looks toward the Sun, times the sine of twice the angle by which the Sun is to the right of the top of
    the turned image.
    """
    azimuth = float(np.arctan2(sun_in_camera[0], -sun_in_camera[1]))
    tilt = azimuth - 0.5 * np.pi * np.rint(azimuth / (0.5 * np.pi))
    toward = np.array([np.sin(azimuth), -np.cos(azimuth)])
    across = np.array([np.cos(azimuth), np.sin(azimuth)])
    size = np.minimum(diameter_px, _LARGEST_PULLED_PX) / REFERENCE_DIAMETER_PX
    one = np.ones_like(size)
    return np.stack(
        [one[:, None] * toward, size[:, None] * toward, one[:, None] * np.sin(2.0 * tilt) * across], axis=-1
    )


def without_pull(found: Detections, model: SunModel, sun_in_camera: FloatArray | None) -> Detections:
    """Detections without the mean displacement that the direction of the Sun causes."""
    if sun_in_camera is None or len(found) == 0:
        return found
    if not np.isfinite(sun_in_camera).all() or np.hypot(sun_in_camera[0], sun_in_camera[1]) == 0.0:
        return found
    pull = sun_directions(found.diameter_px, sun_in_camera) @ np.array(model.coefficients)
    return replace(found, u_px=found.u_px - pull[:, 0], v_px=found.v_px - pull[:, 1])


def with_sigma(found: Detections, model: SigmaModel, features: FloatArray) -> Detections:
    """Detections with calibrated standard deviations and the share of the variance that lasts."""
    total, fresh = model.variances_px2(features)
    return replace(found, sigma_px=np.sqrt(total), persistence=1.0 - fresh / total)


def network_sha256(model_octets: bytes) -> str:
    """SHA-256 of an ONNX file without its metadata: what a calibration belongs to."""
    digest = hashlib.sha256()
    for number, field in _top_fields(model_octets):
        if number != _METADATA_FIELD:
            digest.update(field)
    return digest.hexdigest()


def with_metadata(model_octets: bytes, metadata: Mapping[str, str]) -> bytes:
    """An ONNX file with this metadata and no other, by key, otherwise octet by octet the same."""
    kept = [bytes(field) for number, field in _top_fields(model_octets) if number != _METADATA_FIELD]
    for key, value in sorted(metadata.items()):
        pair = b"".join(_text_field(number, text) for number, text in ((1, key), (2, value)))
        kept.append(_text_field(_METADATA_FIELD, pair))
    return b"".join(kept)


def format_calibration(
    calibration: Calibration, model_octets: bytes, notes: Mapping[str, Any] | None = None
) -> str:
    """The text that goes into a model's metadata."""
    parts = {name: part for name, part in asdict(calibration).items() if part is not None}
    document = {"version": CALIBRATION_VERSION, "network_sha256": network_sha256(model_octets)}
    return json.dumps(document | dict(notes or {}) | parts)


def load_calibration(metadata: Mapping[str, str], model_octets: bytes) -> Calibration:
    """The calibration that a model's metadata carry; an empty one where they carry none.

    Raises
    ------
    ModelError
        It is not a calibration, of another version, or of another network.
    """
    text = metadata.get(CALIBRATION_KEY)
    if text is None:
        return Calibration()
    where = f"detector network: {CALIBRATION_KEY} in its metadata"
    try:
        document = json.loads(text)
    except ValueError as error:
        raise ModelError(f"{where}: expected a JSON object, found: {error}") from None
    if not isinstance(document, dict) or document.get("version") != CALIBRATION_VERSION:
        found = document.get("version") if isinstance(document, dict) else document
        raise ModelError(f"{where}: expected version {CALIBRATION_VERSION}, found {found!r}")
    own = network_sha256(model_octets)
    if document.get("network_sha256") != own:
        raise ModelError(
            f"{where}: expected a calibration of this network ({own[:12]}), found one of "
            f"{str(document.get('network_sha256'))[:12]}: fit it again with `linna detector calibrate`"
        )
    kinds = ("fresh", "total", "low", "high")
    try:
        return Calibration(
            _score_model(document["score"]) if "score" in document else None,
            SigmaModel(*(_numbers(document["sigma"], kind, SIGMA_FEATURES) for kind in kinds))
            if "sigma" in document
            else None,
            SunModel(_numbers(document["sun"], "coefficients", SUN_FEATURES)) if "sun" in document else None,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{where}: expected finite numbers of every part, found: {error}") from None


def _score_model(part: Mapping[str, Any]) -> ScoreModel:
    knots = _numbers(part, "log_diameter_px", len(part["log_diameter_px"]))
    slope = float(part["slope"])
    if not (len(knots) >= 1 and np.all(np.diff(knots) > 0.0) and np.isfinite(slope) and slope > 0.0):
        raise ValueError("score: knots that do not rise, or a slope that is not above zero")
    return ScoreModel(knots, _numbers(part, "offset", len(knots)), slope)


def _numbers(part: Mapping[str, Any], name: str, count: int) -> tuple[float, ...]:
    values = tuple(float(value) for value in part[name])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{name}: {count} finite numbers expected, {len(values)} values found")
    return values


def _top_fields(model_octets: bytes) -> list[tuple[int, memoryview]]:
    """Number and octets (key included) of the fields of a protobuf message, in order.

    Raises
    ------
    ModelError
        The octets are no protobuf message.
    """
    view = memoryview(model_octets)
    fields: list[tuple[int, memoryview]] = []
    place = 0
    try:
        while place < len(view):
            first = place
            key, place = _varint(view, place)
            kind = key & 7
            if kind == 0:
                _, place = _varint(view, place)
            elif kind == 2:
                length, place = _varint(view, place)
                place += length
            elif kind in (1, 5):
                place += 8 if kind == 1 else 4
            else:
                raise ValueError(f"field of kind {kind}")
            if place > len(view):
                raise ValueError("field past the end")
            fields.append((key >> 3, view[first:place]))
    except (IndexError, ValueError) as error:
        raise ModelError(f"detector network: expected an ONNX file, found: {error}") from None
    return fields


def _varint(view: memoryview, place: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        octet = view[place]
        place += 1
        value |= (octet & 0x7F) << shift
        if octet < 0x80:
            return value, place
        shift += 7


def _text_field(number: int, text: str | bytes) -> bytes:
    octets = text.encode() if isinstance(text, str) else text
    return _to_varint(number << 3 | 2) + _to_varint(len(octets)) + octets


def _to_varint(value: int) -> bytes:
    octets = bytearray()
    while value > 0x7F:
        octets.append(value & 0x7F | 0x80)
        value >>= 7
    octets.append(value)
    return bytes(octets)
