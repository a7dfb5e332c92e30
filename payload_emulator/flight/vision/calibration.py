"""Calibration of a network's detections: standard deviations of their centres.

It is fitted on validation frames (`linna detector calibrate`) and stored in the metadata of the ONNX file under
`calibration`, so that it is loaded, uploaded and hashed with the network. It is valid for that network only: it names
the SHA-256 of the file without its metadata.

The standard deviation of a centre per axis has two parts, one that is new in every frame and one that lasts, the same
from frame to frame of a crater under one Sun. Each is log-linear in diameter, sigma and depth from the network,
elevation of the Sun above the image plane and distance from the middle of the image. The error of the catalogue on
board is not included.
"""

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

REFERENCE_DIAMETER_PX = 20.0
TYPICAL_DEPTH_RATIO = 0.1
TYPICAL_SUN_SINE = 0.17  # 10 degrees, where the direction of the Sun is not known
TYPICAL_RADIUS = 0.7  # of half the width: the mean distance from the middle of an image
SIGMA_FEATURES = 6
_LEAST_VARIANCE_PX2 = 1e-4
_METADATA_FIELD = 14  # of ModelProto in onnx.proto: metadata_props


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


def sigma_features(
    found: Detections, sun_in_camera: FloatArray | None, width_px: int, height_px: int, *, whole: bool = True
) -> FloatArray:
    """Return the features of sigma, (n, 6); `whole` False: the image is not a whole frame of the camera."""
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


def format_calibration(sigma: SigmaModel, model_octets: bytes, notes: Mapping[str, Any] | None = None) -> str:
    """The text that goes into a model's metadata."""
    document = {"version": CALIBRATION_VERSION, "network_sha256": network_sha256(model_octets)}
    return json.dumps(document | dict(notes or {}) | {"sigma": asdict(sigma)})


def load_calibration(metadata: Mapping[str, str], model_octets: bytes) -> SigmaModel | None:
    """The calibration that a model's metadata carry; None where they carry none.

    Raises
    ------
    ModelError
        It is not a calibration, of another version, or of another network.
    """
    text = metadata.get(CALIBRATION_KEY)
    if text is None:
        return None
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
    other = {"score", "sun"} & document.keys()
    if other:
        raise ModelError(
            f"{where}: expected standard deviations alone, found {', '.join(sorted(other))}: fit it again with "
            "`linna detector calibrate`"
        )
    kinds = ("fresh", "total", "low", "high")
    try:
        return SigmaModel(*(_numbers(document["sigma"], kind, SIGMA_FEATURES) for kind in kinds))
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{where}: expected finite numbers of every part, found: {error}") from None


def _numbers(part: Mapping[str, Any], name: str, count: int) -> tuple[float, ...]:
    values = tuple(float(value) for value in part[name])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{name}: {count} finite numbers expected, {len(values)} values found")
    return values


def _top_fields(model_octets: bytes) -> list[tuple[int, memoryview]]:
    """Number and octets (key included) of the fields of a protobuf message, in order."""
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
