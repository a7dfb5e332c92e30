"""Console of a live session and its viewers: one word a line in, one JSON object a line out.

The words control the flow of simulated time: `run`, `pause`, `step`, `until UTC`, `rate X`; or ask for something:
`state`, `watch`, `save`, `quit`.
"""

import base64
import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.errors import LunarError
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from lunar.timescales import format_utc, parse_utc
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.flight.payload import Payload
from payload_emulator.session.live.station_ports import Server
from payload_emulator.session.spacecraft.loop import Spacecraft, StepResult
from payload_emulator.session.world.camera import Exposure, craters_in_view
from payload_emulator.session.world.world import World
from payload_emulator.sim.render.labels import label_frame
from tmtc.dictionary.event_texts import event_text
from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import TmtcError

CONSOLE_EXACT = {"_discontinuous": "_discontinuous", "_console_count": "_count"}
"""Attributes of `Console` in an exact state, by their names there."""

_SOURCE = 2
_COUNTS = 1 << 13  # the ground's counts begin at 0: reports name a telecommand by its count


@dataclass(slots=True, eq=False)
class Console:
    """Console and the flow of time that it controls.

    Attributes
    ----------
    answers
        Functions of the session that return the answer to a word.
    ends_session
        Whether the session ends when the last connection ends.
    rate
        Simulated seconds per second; 0: as fast as possible.
    held
        Whether time stands still at the beginning or end of a contact until `run`.
    steps
        Steps by hand that are due.
    """

    answers: Mapping[str, Callable[[], dict[str, Any]]]
    stopping: threading.Event
    ends_session: bool = False
    rate: float = 0.0
    paused: bool = False
    held: bool = False
    steps: int = 0
    until_ns: int | None = None
    server: Server = field(init=False)
    _lines: dict[int, bytes] = field(default_factory=dict)
    _watching: set[int] = field(default_factory=set)
    _discontinuous: bool = False
    _count: int = _COUNTS

    def open(self, host: str, port: int) -> None:
        """Open the port; 0: a free one."""
        self.server = Server("console", port, host, self._receive, self._end)

    @property
    def is_watched(self) -> bool:
        """Return whether a connection watches the steps."""
        return bool(self._watching)

    def send(self, message: dict[str, Any]) -> None:
        """Send a message to every connection."""
        self.server.send(_line(message))

    def show(self, message: dict[str, Any]) -> None:
        """Send a step to the connections that watch."""
        line = _line(message | {"paused": self.paused, "rate": self.rate})
        for number in self._watching:
            self.server.reply(number, line)

    def pause_at(self, utc_ns: int) -> None:
        """Pause if the time of `until` is reached."""
        if self.until_ns is not None and utc_ns >= self.until_ns:
            self.until_ns, self.paused = None, True
            self.send({"kind": "paused", "utc": format_utc(utc_ns)})

    def manual_step(self, payload: Payload) -> bytes:
        """Return the telecommand that reports a step by hand to an observing payload; no octets without one."""
        self._discontinuous &= payload.mode is PayloadMode.observing
        if not self._discontinuous or not payload.frames:
            return b""
        self._discontinuous = False
        count = self._count
        self._count = _COUNTS | (count + 1) & (_COUNTS - 1)
        values = {"function_id": "manual_step", "argument_1": 0.0, "argument_2": 0.0}
        return DICTIONARY.pack_command("perform_function", values, sequence_count=count, source=_SOURCE)

    def _receive(self, connection: int, octets: bytes) -> None:
        *lines, rest = (self._lines.get(connection, b"") + octets)[-4096:].split(b"\n")
        self._lines[connection] = rest
        for line in lines:
            self._execute(connection, line.decode("utf-8", "replace").split())

    def _end(self, connection: int) -> None:
        """Remove a connection, and end the session with the last one."""
        self._lines.pop(connection, None)
        self._watching.discard(connection)
        if self.ends_session and not self.server.clients:
            self.stopping.set()

    def _execute(self, connection: int, words: list[str]) -> None:
        if words == ["run"]:
            self.held = self.paused = False
        elif words == ["pause"]:
            self.paused = self._discontinuous = True
        elif words == ["step"]:
            self.paused = self._discontinuous = True
            self.steps += 1
        elif words == ["watch"]:
            self._watching.add(connection)
        elif words == ["quit"]:
            self.stopping.set()
        elif len(words) == 1 and words[0] in self.answers:
            self.send(self.answers[words[0]]())
        elif len(words) == 2 and words[0] == "rate" and _number(words[1]) is not None:
            self.rate = _number(words[1]) or 0.0
        elif len(words) == 2 and words[0] == "until":
            try:
                self.until_ns = parse_utc(words[1])
                self.held = self.paused = False
            except LunarError as error:
                self.send({"kind": "error", "text": str(error)})
        elif words:
            text = " ".join(words)[:80]
            expected = "expected run, pause, step, state, watch, save, until UTC, rate X or quit"
            self.send({"kind": "error", "text": f"{expected}, found {text!r}"})


def _line(message: dict[str, Any]) -> bytes:
    return json.dumps(message).encode() + b"\n"


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0.0 <= value < 1e9 else None


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
