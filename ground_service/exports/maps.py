"""Layers as files: GeoJSON and GeoPackage in the coordinate reference system of the Moon.

References
----------
RFC 7946 (rings, cuts at the 180th meridian) with the `crs` member of the GeoJSON specification of 2008, which names
the lunar system: without it, readers assume the Earth.  OGC 12-128r18 (GeoPackage), written with GDAL.

Positions are mean-Earth axes (`FIXED` of a viewer whose ellipsoid is the Moon, 1737.4 km).

References
----------
CZML Guide of AnalyticalGraphicsInc, CZML structure and content.
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
from ground_service.exports.layers import CRS, CRS_URN, Feature, Layer, layers_of
from ground_service.exports.poses import Poses, poses_of
from lunar.arrays import FloatArray, IntArray
from lunar.frames import continuous_quaternions, mcmf_from_spherical, quaternion_from_matrix
from lunar.timescales import NS, format_utc
from tmtc.errors import MissingLibrary

_COLOURS = {
    "reference": [255, 255, 255, 255],
    "paper": [230, 159, 0, 255],
    "spherical": [86, 180, 233, 255],
    "anchored": [0, 158, 115, 255],
}
_OTHER = [204, 121, 167, 255]
_POINTS = {"detections": [240, 228, 66, 255], "landmarks": [213, 94, 0, 255], "craters": [160, 160, 160, 160]}


MAPS = ("geojson", "gpkg", "czml")
"""Formats with the layers of a pass."""

_WKB = {"Point": 1, "LineString": 2, "Polygon": 3, "MultiLineString": 5, "MultiPolygon": 6}
_DECIMALS = 8
_TIMES = ("utc", "start", "stop")
"""Fields with UTC texts, which are DATETIME in a GeoPackage."""

_GDAL_UTC = 100


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
                gdal_tz_offsets={
                    name: np.full(len(layer.features), _GDAL_UTC) for name in _TIMES if name in layer.fields
                },
            )
        return path.read_bytes() if path.exists() else b""


def _field_array(layer: Layer, name: str) -> Any:
    values = [one.fields[name] for one in layer.features]
    if name in _TIMES:
        return np.array([value.rstrip("Z") for value in values], dtype="datetime64[ms]")
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


def format_czml(inputs: PassInputs, poses: Poses, layers: tuple[Layer, ...], name: str) -> str:
    """Return the packets of a CZML document."""
    start, stop = (format_utc(int(value)) for value in (inputs.start_utc_ns, inputs.stop_utc_ns))
    interval = f"{start}/{stop}"
    packets: list[dict[str, Any]] = [
        {
            "id": "document",
            "name": name,
            "version": "1.0",
            "clock": {"interval": interval, "currentTime": start, "multiplier": 30},
        }
    ]
    if len(poses.utc_ns) > 1:
        packets.append(_spacecraft(poses))
    packets += [
        _track(
            one.estimator,
            one.utc_ns[known],
            mcmf_from_spherical(np.radians(one.latitude_deg), np.radians(one.longitude_deg), one.altitude_m)[
                known
            ],
        )
        for one in inputs.navigation
        if np.count_nonzero(known := np.isfinite(one.altitude_m)) > 1
    ]
    step_ns = int(np.median(np.diff(poses.utc_ns))) if len(poses.utc_ns) > 1 else NS
    shown = {
        int(number): f"{format_utc(int(utc))}/{format_utc(int(utc) + step_ns)}"
        for number, utc in zip(poses.frame_number, poses.utc_ns, strict=True)
    }
    for layer in layers:
        if layer.geometry == "MultiPolygon":
            packets += _polygons(layer, shown)
        elif layer.geometry == "Point":
            packets += _points(layer, shown)
    return json.dumps(packets, separators=(",", ":"), allow_nan=False)


def _sampled(utc_ns: IntArray, values: FloatArray, decimals: int) -> tuple[str, list[float]]:
    """Return the epoch of the first sample, and seconds since then each followed by its values."""
    seconds = (utc_ns - utc_ns[0]) / NS
    table = np.column_stack([np.round(seconds, 6), np.round(values, decimals)])
    return format_utc(int(utc_ns[0]), 9), table.ravel().tolist()


def _spacecraft(poses: Poses) -> dict[str, Any]:
    packet = _track(poses.states, poses.utc_ns, poses.position_mcmf_m)
    # CZML turns body axes to fixed axes, scalar last.
    q_wxyz = quaternion_from_matrix(np.swapaxes(poses.camera_from_mcmf, -1, -2))
    epoch, values = _sampled(poses.utc_ns, np.roll(continuous_quaternions(q_wxyz), -1, axis=1), 12)
    return packet | {
        "id": "spacecraft",
        "name": f"camera ({poses.states})",
        "orientation": {"epoch": epoch, "unitQuaternion": values, "interpolationAlgorithm": "LINEAR"},
        "point": {"pixelSize": 8, "color": {"rgba": _COLOURS.get(poses.states, _OTHER)}},
    }


def _track(name: str, utc_ns: IntArray, position_mcmf_m: FloatArray) -> dict[str, Any]:
    epoch, values = _sampled(utc_ns, position_mcmf_m, 3)
    return {
        "id": f"track {name}",
        "name": name,
        "availability": f"{format_utc(int(utc_ns[0]))}/{format_utc(int(utc_ns[-1]))}",
        "position": {
            "epoch": epoch,
            "referenceFrame": "FIXED",
            "interpolationAlgorithm": "LAGRANGE",
            "interpolationDegree": 5,
            "cartesian": values,
        },
        "path": {
            "width": 2,
            "resolution": 15,
            "material": {"solidColor": {"color": {"rgba": _COLOURS.get(name, _OTHER)}}},
        },
    }


def _polygons(layer: Layer, shown: dict[int, str]) -> list[dict[str, Any]]:
    packets = []
    for feature in layer.features:
        frame = int(feature.fields["frame"])
        for number, part in enumerate(feature.parts):
            heights = np.column_stack([np.round(part[:-1], 8), np.zeros(len(part) - 1)])
            packets.append(
                {
                    "id": f"footprint {frame}.{number}",
                    "name": f"footprint of frame {frame}",
                    "availability": shown[frame],
                    "polygon": {
                        "positions": {"cartographicDegrees": heights.ravel().tolist()},
                        "material": {"solidColor": {"color": {"rgba": [255, 255, 255, 40]}}},
                        "outline": True,
                        "height": 0,
                    },
                }
            )
    return packets


def _points(layer: Layer, shown: dict[int, str]) -> list[dict[str, Any]]:
    packets = []
    for number, feature in enumerate(layer.features):
        longitude, latitude = np.round(feature.parts[0][0], 8).tolist()
        position = mcmf_from_spherical(np.radians(latitude), np.radians(longitude), 0.0)
        known = feature.fields.get("crater", feature.fields.get("landmark", number))
        packet: dict[str, Any] = {
            "id": f"{layer.name} {number}",
            "name": f"{layer.name.removesuffix('s')} {known}",
            "position": {"referenceFrame": "FIXED", "cartesian": np.round(position, 3).tolist()},
            "point": {"pixelSize": 4, "color": {"rgba": _POINTS[layer.name]}},
        }
        if "frame" in feature.fields:
            packet["availability"] = shown[int(feature.fields["frame"])]
        packets.append(packet)
    return packets
