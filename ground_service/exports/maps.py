"""Layers as files: GeoJSON and GeoPackage in the coordinate reference system of the Moon.

References
----------
RFC 7946 (rings, cuts at the 180th meridian) with the `crs` member of the GeoJSON specification of 2008, which names
the lunar system: without it, readers assume the Earth.  OGC 12-128r18 (GeoPackage), written with GDAL.
"""

from __future__ import annotations

import json
import struct
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ground_service.errors import EvaluationError
from ground_service.evaluation.core import PassInputs
from ground_service.exports.czml import format_czml
from ground_service.exports.layers import CRS, CRS_URN, Feature, Layer, layers_of
from ground_service.exports.poses import poses_of
from tmtc.errors import MissingLibrary

MAPS = ("geojson", "gpkg", "czml")
"""Formats with the layers of a pass."""

_WKB = {"Point": 1, "LineString": 2, "Polygon": 3, "MultiLineString": 5, "MultiPolygon": 6}
_DECIMALS = 8


def map_octets(inputs: PassInputs, kind: str, states: str) -> bytes:
    """Return the layers of a pass in a format."""
    poses = poses_of(inputs, states)
    layers = layers_of(inputs, poses)
    if kind == "czml":
        return format_czml(inputs, poses, layers, inputs.title).encode()
    if not any(one.features for one in layers):
        raise EvaluationError(f"pass {inputs.pass_id}: expected frames with known positions, found none")
    return format_geojson(layers, inputs.title).encode() if kind == "geojson" else geopackage_octets(layers)


def format_geojson(layers: Sequence[Layer], name: str) -> str:
    """Return a feature collection; the property `layer` names the layer of each feature.  Degrees have 8 decimals."""
    features = [_geojson_feature(layer, one) for layer in layers for one in layer.features]
    document = {
        "type": "FeatureCollection",
        "name": name,
        "crs": {"type": "name", "properties": {"name": CRS_URN}},
        "features": features,
    }
    return json.dumps(document, separators=(",", ":"), allow_nan=False)


def _geojson_feature(layer: Layer, feature: Feature) -> dict[str, Any]:
    parts = [np.round(part, _DECIMALS).tolist() for part in feature.parts]
    coordinates: Any = parts
    if layer.geometry == "Point":
        coordinates = parts[0][0]
    elif layer.geometry == "MultiPolygon":
        coordinates = [[ring] for ring in parts]
    fields = {name: _known(value) for name, value in feature.fields.items()}
    return {
        "type": "Feature",
        "geometry": {"type": layer.geometry, "coordinates": coordinates},
        "properties": {"layer": layer.name, **fields},
    }


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def geopackage_octets(layers: Sequence[Layer]) -> bytes:
    """Return a GeoPackage with a table for each layer that has features.

    Raises
    ------
    MissingLibrary
        If pyogrio is not installed.
    """
    try:
        from pyogrio import raw
    except ImportError:
        raise MissingLibrary("GeoPackage", "pyogrio", "linna[geo]") from None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pass.gpkg"
        for layer in layers:
            if not layer.features:
                continue
            raw.write(
                path,
                np.array([_wkb(layer.geometry, one) for one in layer.features], dtype=object),
                [_field_array(layer, name) for name in layer.fields],
                list(layer.fields),
                geometry_type=layer.geometry,
                crs=CRS,
                layer=layer.name,
                driver="GPKG",
                append=path.exists(),
            )
        return path.read_bytes() if path.exists() else b""


def _field_array(layer: Layer, name: str) -> Any:
    values = [one.fields[name] for one in layer.features]
    return np.array(values, dtype=object) if isinstance(values[0], str) else np.array(values)


def _wkb(geometry: str, feature: Feature) -> bytes:
    """Return a geometry as well-known binary (OGC 06-103r4, section 8), little-endian."""
    if geometry == "Point":
        return _head("Point") + bytes(feature.parts[0][0].astype("<f8").tobytes())
    parts = []
    for part in feature.parts:
        points = struct.pack("<I", len(part)) + part.astype("<f8").tobytes()
        parts.append(
            _head("LineString") + points
            if geometry == "MultiLineString"
            else _head("Polygon") + struct.pack("<I", 1) + points
        )
    return _head(geometry) + struct.pack("<I", len(parts)) + b"".join(parts)


def _head(geometry: str) -> bytes:
    return struct.pack("<BI", 1, _WKB[geometry])
