"""A report value as JSON: every field under its own name, the same bytes every time."""

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from reports.arrays import FloatArray

SCHEMA_VERSION = 1
DIGITS = 9
_POWERS = np.array([float(f"1e{k}") for k in range(-12, 23)])


def to_json(report: Any) -> str:
    """JSON text of any value of `reports.values`.

    NaN and infinities become null; times stay integers; numbers with a fraction are rounded to `DIGITS` significant
    digits (0.03 m of the Moon's longitude), which halves the text, whole numbers stay as they are; an image becomes
    its shape and the SHA-256 of its octets.
    """
    body = {"kind": type(report).__name__, "schema_version": SCHEMA_VERSION, **_fields(report)}
    return json.dumps(body, ensure_ascii=False, allow_nan=False, separators=(",", ":")) + "\n"


def _fields(value: Any) -> dict[str, Any]:
    return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        return float(_rounded(np.asarray(value))) if math.isfinite(value) else None
    if dataclasses.is_dataclass(value):
        return _fields(value)
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return str(value)


def _array(array: np.ndarray[Any, Any]) -> Any:
    if array.dtype == np.uint8 and array.ndim >= 2:
        octets = np.ascontiguousarray(array).tobytes()
        return {"shape": list(array.shape), "sha256": hashlib.sha256(octets).hexdigest()}
    if array.dtype.kind == "f":
        values = _rounded(array.astype(np.float64)).tolist()
        return values if np.isfinite(array).all() else _without_nan(values)
    return array.tolist()


def _rounded(values: FloatArray) -> FloatArray:
    """Numbers to so many significant digits; as they are where whole, not finite, or outside 1e-12 to 1e22.

    A whole number of at most `DIGITS` digits over an exact power of ten is the float nearest to that decimal, so the
    text is as short as the decimal.
    """
    size = np.abs(values)
    place = np.searchsorted(_POWERS, size, side="right") - 1  # 10^(place - 12) <= size
    away = DIGITS - 1 - (place - 12)  # decimals that are kept
    fraction = np.isfinite(values) & (values != np.rint(values)) & (place >= 0) & (away >= 0)
    scale = _POWERS[np.where(fraction, away, 0) + 12]
    return np.where(fraction, np.rint(np.where(fraction, values, 0.0) * scale) / scale, values)


def _without_nan(nested: Any) -> Any:
    if isinstance(nested, list):
        return [_without_nan(v) for v in nested]
    return nested if math.isfinite(nested) else None
