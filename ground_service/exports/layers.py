"""Geographic layers of a pass: tracks, footprints, detections, landmarks and craters.

Coordinates are mean-Earth longitude and latitude in degrees on the sphere of 1737.4 km (IAU_2015:30100), longitudes
from -180 to 180.  Lines and polygons are cut at the 180th meridian, and footprints around a pole are closed over it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ground_service.evaluation.core import PassInputs
from ground_service.exports.poses import Poses
from ground_service.exports.tables import identified_craters
from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera, ground_point_sphere
from lunar.constants import MOON_RADIUS_M
from lunar.frames import spherical_from_mcmf
from lunar.timescales import format_utc

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
    points = ground_point_sphere(
        camera, poses.camera_from_mcmf[:, None], poses.position_mcmf_m[:, None], border[None]
    )
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
    return np.concatenate(
        [a + (b - a) * steps for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )


def _detections(inputs: PassInputs, poses: Poses) -> Layer:
    samples, craters = inputs.detections, identified_craters(inputs)
    fields = ("frame", "utc", "u_px", "v_px", "diameter_px", "score", "size_class", "crater_id", "states")
    features = []
    for k, row in enumerate(poses.row.tolist()):
        first, last = int(samples.offsets[row]), int(samples.offsets[row + 1])
        uv = np.column_stack([samples.u_px[first:last], samples.v_px[first:last]])
        ground = ground_point_sphere(
            inputs.viewing.camera, poses.camera_from_mcmf[k], poses.position_mcmf_m[k], uv
        )
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
    near = [
        catalogue.near(float(a), float(b), float(r))
        for a, b, r in zip(latitude, longitude, radius_m, strict=True)
    ]
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
    worlds = np.arange(
        np.floor((ring[:, 0].min() + 180.0) / 360.0), np.floor((ring[:, 0].max() + 180.0) / 360.0) + 1
    )
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
