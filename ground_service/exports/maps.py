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

import json
import struct
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ground_service.errors import EvaluationError
from ground_service.evaluation.core import PassInputs
from ground_service.exports.messages import Poses, poses_of
from ground_service.exports.tables import identified_craters
from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera, ground_point_sphere
from lunar.constants import MOON_RADIUS_M, NS
from lunar.frames import continuous_quaternions, mcmf_from_spherical, quaternion_from_matrix, spherical_from_mcmf
from lunar.timescales import format_utc
from tmtc.errors import MissingLibrary

CRS = "IAU_2015:30100"
"""Moon (2015), sphere, planetocentric latitude and east longitude."""

CRS_URN = "urn:ogc:def:crs:IAU:2015:30100"
EDGE_POINTS = 12
"""Points of a footprint on each edge of the image."""

Ring = FloatArray
"""Longitudes and latitudes (n, 2) in degrees."""


@dataclass(frozen=True, slots=True, eq=False)
class Feature:
    """A feature: `parts` are the points, lines or rings of its geometry."""

    parts: tuple[Ring, ...]
    fields: Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """Features of one kind: `geometry` is Point, MultiLineString or MultiPolygon."""

    name: str
    geometry: str
    fields: tuple[str, ...]
    features: tuple[Feature, ...]


def layers_of(inputs: PassInputs, poses: Poses) -> tuple[Layer, ...]:
    """Return the layers of a pass; detections and footprints are located with the given poses."""
    footprints = _footprints(inputs.viewing.camera, poses)
    return (
        _tracks(inputs, poses),
        footprints,
        _detections(inputs, poses),
        _landmarks(inputs),
        _craters(inputs, poses, footprints),
    )


def degrees_of(position_mcmf_m: FloatArray) -> FloatArray:
    """Return longitudes and latitudes (..., 2) in degrees of positions (..., 3)."""
    latitude, longitude, _ = spherical_from_mcmf(position_mcmf_m)
    east = np.mod(np.degrees(longitude) + 180.0, 360.0) - 180.0
    return np.stack([east, np.degrees(latitude)], axis=-1)


def _layer(name: str, geometry: str, fields: tuple[str, ...], features: Sequence[Feature]) -> Layer:
    return Layer(name, geometry, fields, tuple(features))


def _tracks(inputs: PassInputs, poses: Poses) -> Layer:
    tracks = []
    if poses.states == "reference":
        tracks.append(("reference", poses.utc_ns, degrees_of(poses.position_mcmf_m)))
    for one in inputs.navigation:
        known = np.isfinite(one.latitude_deg) & np.isfinite(one.longitude_deg)
        east = np.mod(one.longitude_deg + 180.0, 360.0) - 180.0
        tracks.append((one.estimator, one.utc_ns[known], np.column_stack([east, one.latitude_deg])[known]))
    features = [
        Feature(
            cut_line(places),
            {
                "states": name,
                "start": format_utc(int(utc_ns[0])),
                "stop": format_utc(int(utc_ns[-1])),
                "frames": len(utc_ns),
            },
        )
        for name, utc_ns, places in tracks
        if len(places) > 1
    ]
    return _layer("tracks", "MultiLineString", ("states", "start", "stop", "frames"), features)


def _footprints(camera: PinholeCamera, poses: Poses) -> Layer:
    border = _border_px(camera)
    points = ground_point_sphere(camera, poses.camera_from_mcmf[:, None], poses.position_mcmf_m[:, None], border[None])
    features = []
    for k, ring in enumerate(points):
        on_ground = np.isfinite(ring).all(axis=1)
        if np.count_nonzero(on_ground) < 3:
            continue
        fields = {
            "frame": int(poses.frame_number[k]),
            "utc": format_utc(int(poses.utc_ns[k])),
            "complete": bool(on_ground.all()),
            "states": poses.states,
        }
        features.append(Feature(cut_ring(degrees_of(ring[on_ground])), fields))
    return _layer("footprints", "MultiPolygon", ("frame", "utc", "complete", "states"), features)


def _border_px(camera: PinholeCamera) -> FloatArray:
    """Return points (n, 2) along the outer edges of the image."""
    corners = camera.corners_px()
    steps = np.arange(EDGE_POINTS)[:, None] / EDGE_POINTS
    return np.concatenate([a + (b - a) * steps for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])


def _detections(inputs: PassInputs, poses: Poses) -> Layer:
    samples, craters = inputs.detections, identified_craters(inputs)
    fields = ("frame", "utc", "u_px", "v_px", "diameter_px", "score", "size_class", "crater_id", "states")
    features = []
    for k, row in enumerate(poses.row.tolist()):
        first, last = int(samples.offsets[row]), int(samples.offsets[row + 1])
        uv = np.column_stack([samples.u_px[first:last], samples.v_px[first:last]])
        ground = ground_point_sphere(inputs.viewing.camera, poses.camera_from_mcmf[k], poses.position_mcmf_m[k], uv)
        places = degrees_of(ground)
        for item in np.flatnonzero(np.isfinite(places).all(axis=1)).tolist():
            number = first + item
            values = {
                "frame": int(poses.frame_number[k]),
                "utc": format_utc(int(poses.utc_ns[k])),
                "u_px": float(samples.u_px[number]),
                "v_px": float(samples.v_px[number]),
                "diameter_px": float(samples.diameter_px[number]),
                "score": float(samples.score[number]),
                "size_class": int(samples.size_class[number]),
                "crater_id": int(craters[number]),
                "states": poses.states,
            }
            features.append(Feature((places[item : item + 1],), values))
    return _layer("detections", "Point", fields, features)


def _landmarks(inputs: PassInputs) -> Layer:
    found = inputs.landmarks
    fields = ("landmark", "height_m", "diameter_m", "sigma_east_m", "sigma_north_m", "sigma_up_m", "passes")
    features = []
    if found is not None and len(found):
        # The last report of each landmark is the best one.
        _, back = np.unique(found.landmark_id[::-1], return_index=True)
        for k in (len(found) - 1 - back).tolist():
            east = (float(found.longitude_deg[k]) + 180.0) % 360.0 - 180.0
            values = (
                int(found.landmark_id[k]),
                float(found.height_m[k]),
                float(found.diameter_m[k]),
                *(float(value) for value in found.sigma_m[k]),
                int(found.passes[k]),
            )
            place = np.array([[east, float(found.latitude_deg[k])]])
            features.append(Feature((place,), dict(zip(fields, values, strict=True))))
    return _layer("landmarks", "Point", fields, features)


def _craters(inputs: PassInputs, poses: Poses, footprints: Layer) -> Layer:
    """Craters of the catalogue within the largest footprint radius of a sub-camera point."""
    fields = ("crater", "diameter_m", "size_class")
    catalogue = inputs.catalogue
    if catalogue is None or not len(poses.utc_ns):
        return _layer("craters", "Point", fields, ())
    border = ground_point_sphere(
        inputs.viewing.camera,
        poses.camera_from_mcmf[:, None],
        poses.position_mcmf_m[:, None],
        _border_px(inputs.viewing.camera)[None],
    )
    below = poses.position_mcmf_m / np.linalg.norm(poses.position_mcmf_m, axis=1, keepdims=True)
    chord = np.linalg.norm(border / MOON_RADIUS_M - below[:, None], axis=2)
    reach = np.nanmax(np.where(np.isfinite(chord), chord, np.nan), axis=1, initial=0.0)
    radius_m = 2.0 * MOON_RADIUS_M * np.arcsin(np.minimum(reach / 2.0, 1.0))
    latitude, longitude, _ = spherical_from_mcmf(poses.position_mcmf_m)
    near = [catalogue.near(float(a), float(b), float(r)) for a, b, r in zip(latitude, longitude, radius_m, strict=True)]
    features = []
    for k in np.unique(np.concatenate(near)).tolist():
        east = (np.degrees(catalogue.longitude_rad[k]) + 180.0) % 360.0 - 180.0
        values = (int(catalogue.ids[k]), float(catalogue.diameter_m[k]), int(catalogue.size_class[k]))
        place = np.array([[east, np.degrees(catalogue.latitude_rad[k])]])
        features.append(Feature((place,), dict(zip(fields, values, strict=True))))
    return _layer("craters", "Point", fields, features)


# The 180th meridian


def _unwrapped(places: Ring) -> Ring:
    """Return places with continuous longitudes."""
    return np.column_stack([np.degrees(np.unwrap(np.radians(places[:, 0]))), places[:, 1]])


def cut_line(places: Ring) -> tuple[Ring, ...]:
    """Return a line (n, 2) as parts that do not cross the 180th meridian; each part has at least two points."""
    line = _unwrapped(places)
    world = np.floor((line[:, 0] + 180.0) / 360.0)
    parts: list[list[FloatArray]] = [[line[0]]]
    for a, b, first, last in zip(line[:-1], line[1:], world[:-1], world[1:], strict=True):
        if first != last:
            meridian = 360.0 * max(first, last) - 180.0
            crossing = a + (b - a) * (meridian - a[0]) / (b[0] - a[0])
            crossing[0] = meridian
            parts[-1].append(crossing)
            parts.append([crossing])
        parts[-1].append(b)
    return tuple(_in_world(np.array(part)) for part in parts if len(part) > 1)


def cut_ring(places: Ring) -> tuple[Ring, ...]:
    """Return a ring (n, 2), not closed, as closed rings that do not cross the 180th meridian."""
    ring = _unwrapped(np.concatenate([places, places[:1]]))
    if abs(float(ring[-1, 0] - ring[0, 0])) > 180.0:
        # Around a pole: along the meridians of both ends to the pole.
        pole = 90.0 if ring[:, 1].mean() > 0.0 else -90.0
        ring = np.concatenate([ring, [[ring[-1, 0], pole], [ring[0, 0], pole]]])
    else:
        ring = ring[:-1]
    worlds = np.arange(np.floor((ring[:, 0].min() + 180.0) / 360.0), np.floor((ring[:, 0].max() + 180.0) / 360.0) + 1)
    parts = []
    for world in worlds.tolist():
        part = _clipped(ring, 360.0 * world - 180.0, 1.0)
        part = _clipped(part, 360.0 * world + 180.0, -1.0)
        if len(part) > 2 and np.ptp(part[:, 0]) > 0.0:
            parts.append(_counterclockwise(_in_world(np.concatenate([part, part[:1]]))))
    return tuple(parts)


def _clipped(ring: Ring, meridian: float, side: float) -> Ring:
    """Return the part of a ring east (side 1) or west (side -1) of a meridian (Sutherland and Hodgman 1974)."""
    kept: list[FloatArray] = []
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        inside, next_inside = side * (a[0] - meridian) >= 0.0, side * (b[0] - meridian) >= 0.0
        if inside:
            kept.append(a)
        if inside != next_inside:
            crossing = a + (b - a) * (meridian - a[0]) / (b[0] - a[0])
            crossing[0] = meridian
            kept.append(crossing)
    return np.array(kept) if kept else np.zeros((0, 2))


def _in_world(part: Ring) -> Ring:
    """Return a part shifted to longitudes from -180 to 180."""
    shift = 360.0 * np.floor((part[:, 0].mean() + 180.0) / 360.0)
    return np.asarray(part - np.array([shift, 0.0]))


def _counterclockwise(ring: Ring) -> Ring:
    x, y = ring.T
    area = float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))
    return ring if area > 0.0 else ring[::-1]


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
            mcmf_from_spherical(np.radians(one.latitude_deg), np.radians(one.longitude_deg), one.altitude_m)[known],
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
