"""Steps of a spacecraft for people who watch: image, detections and craters, estimates, events, and what is true."""

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from lunar.timescales import format_utc
from payload_emulator.session.spacecraft.loop import Spacecraft, StepResult
from payload_emulator.session.world.camera import Exposure, craters_in_view
from payload_emulator.session.world.world import World
from payload_emulator.sim.render.labels import label_frame
from tmtc.dictionary.event_texts import event_text
from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import TmtcError

_JPEG_QUALITY = 92
_SHOWN_CRATERS = 200
_SMALLEST_SHOWN_PX = 6.0


def step_message(
    spacecraft: Spacecraft, result: StepResult, craters: list[dict[str, float]] | None = None
) -> dict[str, Any]:
    """Return a step for a viewer: image, detections, catalogue, outcome and estimate of each estimator, and truth.

    `craters` are those of the catalogue in the image; None: on the sphere, as the detections of reduced images are.

    A detection that the payload identified has the `crater_id` that it reported.
    """
    world, exposure = spacecraft.world, result.exposure
    message: dict[str, Any] = {
        "kind": "turn" if exposure is None else "frame",
        "utc": format_utc(result.step.utc_ns),
        "mode": spacecraft.payload.mode.name,
        "packets": len(result.packets),
        "waiting": spacecraft.payload.waiting,
        "resets": len(spacecraft.resets),
        "events": [],
        "verifications": [],
    }
    estimates = _add_packets(message, result.packets)
    if exposure is not None:
        position = world.truth.positions_mcmf(exposure.utc_ns)[0]
        latitude, longitude, altitude = (float(value) for value in spherical_from_mcmf(position))
        message |= {
            "frame": spacecraft.payload.frames - 1 if result.step.frame < 0 else result.step.frame,
            "reference": {
                "latitude_deg": np.degrees(latitude),
                "longitude_deg": np.degrees(longitude) % 360.0,
                "altitude_m": altitude,
            },
            "altitude_km": altitude / 1e3,
            "terrain": {"name": world.terrain.name, "real": world.terrain.is_real},
            "catalogue": _on_sphere(world, exposure) if craters is None else craters,
            "image_jpeg": _jpeg(exposure.image),
        }
        for estimate in estimates.values():
            if "altitude_m" in estimate:
                place = mcmf_from_spherical(
                    np.radians(estimate["latitude_deg"]), np.radians(estimate["longitude_deg"]), estimate["altitude_m"]
                )
                estimate["error_m"] = float(np.linalg.norm(place - position))
        message["estimates"] = estimates
    return message


def _add_packets(message: dict[str, Any], packets: Sequence[bytes]) -> dict[str, dict[str, Any]]:
    """Add the contents of packets to a message; return the outcome and estimate of each estimator."""
    estimates: dict[str, dict[str, Any]] = {}
    identified: dict[int, int] = {}
    labels = DICTIONARY.labels
    for packet in packets:
        try:
            name, values = DICTIONARY.unpack(packet)
        except TmtcError:
            continue
        if name.startswith("event_"):
            event = labels(name, "event_id").get(values["event_id"], "")
            numbers = [values["value_1"], values["value_2"]]
            message["events"].append(
                {"severity": name[6:], "event": event, "values": numbers, "text": event_text(event, *numbers)}
            )
        elif name.startswith("verification_"):
            message["verifications"].append({"stage": name[13:], **values})
        elif name == "detections":
            items = values["items"]
            message["detections"] = [
                {"u_px": u, "v_px": v, "diameter_px": d, "score": s}
                for u, v, d, s in zip(
                    items["u_px"].tolist(),
                    items["v_px"].tolist(),
                    items["diameter_px"].tolist(),
                    items["score"].tolist(),
                    strict=True,
                )
            ]
        elif name == "identifications":
            items = values["items"]
            identified |= dict(zip(items["detection"].tolist(), items["crater_id"].tolist(), strict=True))
        elif name in ("frame_outcome", "navigation_state"):
            estimate = estimates.setdefault(labels(name, "estimator")[values["estimator"]], {})
            estimate["outcome"] = labels(name, "outcome")[values["outcome"]]
            if name == "frame_outcome":
                estimate["reset_trigger"] = labels(name, "reset_trigger")[values["reset_trigger"]]
            else:
                estimate |= {key: values[key] for key in ("latitude_deg", "longitude_deg", "altitude_m")}
    for number, detection in enumerate(message.get("detections", [])):
        if number in identified:
            detection["crater_id"] = identified[number]
    return estimates


def rims_in_view(world: World, utc_ns: int, camera_from_mcmf: FloatArray) -> list[dict[str, float]]:
    """Return the largest craters in an image of rendered ground: the ellipses of their rims at their heights."""
    camera, position = world.true_camera, world.truth.positions_mcmf(utc_ns)[0]
    altitude_m = float(spherical_from_mcmf(position)[2])
    smallest_m = _SMALLEST_SHOWN_PX * altitude_m / camera.focal_px
    labels = label_frame(world.terrain, camera, position, camera_from_mcmf, minimum_diameter_m=smallest_m)
    seen = np.flatnonzero(labels.inside & (labels.diameter_px > _SMALLEST_SHOWN_PX))
    names = ("u_px", "v_px", "diameter_px", "major_px", "minor_px", "angle_rad")
    return _largest(world, labels.index[seen], {name: getattr(labels, name)[seen] for name in names})


def _on_sphere(world: World, exposure: Exposure) -> list[dict[str, float]]:
    """Return the largest craters in a reduced image, whose detections are made of the catalogue on the sphere."""
    index, uv, diameter_px = craters_in_view(world, exposure, _SMALLEST_SHOWN_PX)
    return _largest(world, index, {"u_px": uv[:, 0], "v_px": uv[:, 1], "diameter_px": diameter_px})


def _largest(world: World, index: IntArray, columns: dict[str, FloatArray]) -> list[dict[str, float]]:
    shown = np.argsort(-columns["diameter_px"], kind="stable")[:_SHOWN_CRATERS].tolist()
    ids = world.terrain.catalogue.ids[index]
    return [{"id": int(ids[k]), **{name: float(column[k]) for name, column in columns.items()}} for k in shown]


def _jpeg(image: Any) -> str:
    """Return a JPEG image in base64, at a third of a PNG's time and half its size; "" without pixels."""
    if not image.size:
        return ""
    import cv2

    shown = image[..., ::-1] if image.ndim == 3 else image
    good, encoded = cv2.imencode(".jpg", shown, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))
    return base64.b64encode(encoded.tobytes()).decode() if good else ""
