"""CZML for Cesium: tracks, attitude of the camera, footprints, detections, landmarks and craters.

Positions are mean-Earth axes (`FIXED` of a viewer whose ellipsoid is the Moon, 1737.4 km).

References
----------
CZML Guide of AnalyticalGraphicsInc, CZML structure and content.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from ground_service.evaluation.core import PassInputs
from ground_service.exports.layers import Layer
from ground_service.exports.poses import Poses
from lunar.arrays import FloatArray, IntArray
from lunar.frames import mcmf_from_spherical, quaternion_from_matrix
from lunar.timescales import NS, format_utc

_COLOURS = {
    "reference": [255, 255, 255, 255],
    "paper": [230, 159, 0, 255],
    "spherical": [86, 180, 233, 255],
    "anchored": [0, 158, 115, 255],
}
_OTHER = [204, 121, 167, 255]
_POINTS = {"detections": [240, 228, 66, 255], "landmarks": [213, 94, 0, 255], "craters": [160, 160, 160, 160]}


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
            _positions(one.latitude_deg, one.longitude_deg, one.altitude_m)[known],
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


def _positions(latitude_deg: FloatArray, longitude_deg: FloatArray, altitude_m: FloatArray) -> FloatArray:
    return mcmf_from_spherical(np.radians(latitude_deg), np.radians(longitude_deg), altitude_m)


def _sampled(utc_ns: IntArray, values: FloatArray, decimals: int) -> tuple[str, list[float]]:
    """Return the epoch of the first sample, and seconds since then each followed by its values."""
    seconds = (utc_ns - utc_ns[0]) / NS
    table = np.column_stack([np.round(seconds, 6), np.round(values, decimals)])
    return format_utc(int(utc_ns[0]), 9), table.ravel().tolist()


def _spacecraft(poses: Poses) -> dict[str, Any]:
    packet = _track(poses.states, poses.utc_ns, poses.position_mcmf_m)
    # CZML turns body axes to fixed axes, scalar last.
    q_wxyz = quaternion_from_matrix(np.swapaxes(poses.camera_from_mcmf, -1, -2))
    signs = np.cumprod(
        np.concatenate([[1.0], np.where(np.sum(q_wxyz[1:] * q_wxyz[:-1], axis=1) < 0.0, -1.0, 1.0)])
    )
    epoch, values = _sampled(poses.utc_ns, np.roll(q_wxyz * signs[:, None], -1, axis=1), 12)
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
