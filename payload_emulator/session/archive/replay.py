"""An archived pass flown again: the current flight code, with the model and parameters of a build, on its record.

A replay sees its archive and its build, nothing else: no data folder, no clock, no network. The same build on the same
archive gives the same octets. What it costs is measured around the payload, in the CPU time of this thread, and never
enters the downlink.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray
from lunar.datafolder import DataFolder
from payload_emulator.errors import ModelError, ParameterError, RecordError, TerrainError
from payload_emulator.flight.models import DEFAULT_NETWORK, NETWORKS, load_shipped_model
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.flight.payload import Payload
from payload_emulator.flight.ports import UNLIMITED, BareBoard, ResetCause
from payload_emulator.flight.vision.detections import Detections, no_detections
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.flight.vision.preprocess import ImageQuality
from payload_emulator.session.archive import recording
from payload_emulator.session.spacecraft.parameter_file import BuildParameters, parse_parameters
from tmtc.downlink import encode_cadus

if TYPE_CHECKING:
    from payload_emulator.session.scenario import Scenario
    from payload_emulator.session.world.world import World

Image = NDArray[Any]
Progress = Callable[[Iterable[Any], int], Iterator[Any]]
CpuClock = Callable[[], float]
Recorded = tuple[ImageQuality, Detections]

DETECTIONS = "payload/detections.jsonl"
"""Received detections of an archive without frames, a line for each image."""

STAGES = ("network", "detector", "navigation")
"""The network; the rest of the detector (image preparation, decoding); everything after it, telemetry included."""


@dataclass(frozen=True, slots=True)
class FlightBuild:
    """A build on the current flight code: a network and changes to the flown parameters.

    Without a network, the shipped one that the pass was flown with is used, or the default network if that is unknown.
    """

    name: str = "current"
    version: str = ""
    model: bytes | None = None
    parameters: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """Result of a replay: packets, counts of the payload, and CPU milliseconds of stages by frame."""

    packets: list[bytes]
    summary: dict[str, Any]
    stages_ms: dict[str, FloatArray]


def load_flight_build(path: Path) -> FlightBuild:
    """Load a build from its TOML file: `name`, `version`, `model` and `parameters` (files in the same folder).

    Raises
    ------
    ParameterError
        The file is no build on the flight code.
    """
    table = _build_table(path)
    if "command" in table:
        raise ParameterError(str(path), "command", "a build of a model and parameters", "one with a command")

    def octets_of(key: str) -> bytes:
        try:
            return (path.parent / str(table[key])).read_bytes()
        except OSError as error:
            raise ParameterError(str(path), key, f"a file {table[key]}", f"none ({error.strerror})") from None

    return FlightBuild(
        str(table.get("name", path.stem)),
        str(table.get("version", "")),
        octets_of("model") if "model" in table else None,
        octets_of("parameters").decode() if "parameters" in table else "",
    )


def check_parameters(path: Path) -> None:
    """Refuse a build file with parameters that are unknown to this flight code or have invalid values.

    Raises
    ------
    ParameterError
        The message names the parameter file, the key, what was expected and what was found.
    """
    name = str(_build_table(path).get("parameters", ""))
    if not name:
        return
    try:
        text = (path.parent / name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError(name, "", "parameters (TOML, UTF-8)", str(error)) from None
    parse_parameters(text, source=name)


def names_command(path: Path) -> bool:
    """Return whether a build file names a program instead of a network and parameters."""
    return "command" in _build_table(path)


def replay_archive(
    archive: Path, build: FlightBuild, out: Path, *, data: DataFolder | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Fly an archived pass again and write `downlink.cadu`, `performance.json` and `summary.json` into `out`.

    Parameters
    ----------
    data
        Products to render frames from that the archive does not hold; None refuses such an archive.

    Raises
    ------
    RecordError
        The archive cannot be flown again, or an image of it is not the recorded one.
    """
    manifest = _manifest(archive)
    record = recording.load_record(archive)
    recorded = load_detections(archive)
    lacking = recording.missing_frames(archive, record.inputs) if recorded is None else []
    if lacking and data is None:
        raise RecordError(
            f"{archive}: expected every frame, found {len(lacking)} missing, the first {lacking[0]}; "
            "complete the archive first (linna replay --complete)"
        )
    if recorded is not None:
        images: Iterable[Image] = (np.zeros(item.image_shape, np.uint8) for item in record.inputs)
    elif lacking and data:
        images = rendered_images(archive, record, data)
    else:
        images = stored_images(archive, record)
    started = time.monotonic()
    flown = replay(record, images, _with_network(build, manifest), progress=progress, recorded=recorded)
    wall_s = time.monotonic() - started
    out.mkdir(parents=True, exist_ok=True)
    octets = encode_cadus(flown.packets, spacecraft_id=int(manifest["spacecraft_id"]), coding=_coding(manifest))
    (out / "downlink.cadu").write_bytes(octets)
    _write_json(
        out / "performance.json",
        {
            "clock": "CPU time of the thread",
            "unit": "ms",
            "stages": {name: values.tolist() for name, values in flown.stages_ms.items()},
        },
    )
    cpu_ms = float(sum(values.sum() for values in flown.stages_ms.values()))
    frames = len(flown.stages_ms[STAGES[0]])
    summary = {
        "archive": str(manifest.get("pass_name", "")),
        "build": {"name": build.name, "version": build.version},
        "frames": frames,
        "packets": len(flown.packets),
        "downlink_octets": len(octets),
        "dropped": list(record.dropped),
        **flown.summary,
        # a replay uses only the recording; it has no truth to read
        "truth_reads_after_start": 0,
        "cpu_ms_per_frame": cpu_ms / max(frames, 1),
        "wall_s": round(wall_s, 3),
        "realtime_factor": round(frames * float(manifest.get("cadence_s") or 0.0) / max(wall_s, 1e-9), 2),
    }
    _write_json(out / "summary.json", summary)
    return summary


def replay(
    record: recording.PassRecord,
    images: Iterable[Image],
    build: FlightBuild = FlightBuild(),
    *,
    progress: Progress | None = None,
    cpu_clock: CpuClock = time.thread_time,
    recorded: Mapping[int, Recorded] | None = None,
) -> Replay:
    """Return the packets that a build makes of a recorded pass.

    Parameters
    ----------
    recorded
        Received detections by on-board time of the image, in place of the detector; None: the images are examined.
    """
    parameters = parse_parameters(build.parameters, record.parameters, source=f"parameters of {build.name}")
    model = load_shipped_model() if build.model is None else build.model
    detector = _TimedDetector(model, parameters, cpu_clock, recorded)
    board = RecordedBoard()

    def started() -> Payload:
        return Payload(
            detector,
            parameters.flight,
            record.tables,
            model_hash=detector.onnx.model_hash,
            model_octets=detector.onnx.model_octets,
            board=board,
            mode=PayloadMode.standby,
            make_detector=lambda octets: _TimedDetector(octets, parameters, cpu_clock, recorded),
        )

    payload = started()
    packets: list[bytes] = []
    rows: list[tuple[float, float, float]] = []
    pairs: Iterable[tuple[recording.RecordedStep, Image]] = zip(record.inputs, images, strict=True)
    for item, image in progress(pairs, len(record.inputs)) if progress else pairs:
        if board.enter_step(item) and item is not record.inputs[0]:
            payload = started()
        detector.reset()
        detector.image_ticks = item.clock_ticks
        began = cpu_clock()
        taken = None if item.number < 0 else image
        packets += payload.step(taken, item.attitude, item.clock_ticks, item.telecommands)
        step_s = cpu_clock() - began
        if item.number < 0:
            continue
        rows.append((detector.network_s, detector.examine_s - detector.network_s, step_s - detector.examine_s))
    stages = 1e3 * np.array(rows, dtype=np.float64).reshape(-1, len(STAGES))
    return Replay(packets, payload.summary(), {name: stages[:, i] for i, name in enumerate(STAGES)})


def _with_network(build: FlightBuild, manifest: dict[str, Any]) -> FlightBuild:
    if build.model is not None:
        return build
    flown = str(dict(manifest.get("build") or {}).get("model_sha256", ""))
    shipped = {name: load_shipped_model(name) for name in NETWORKS}
    same = [octets for octets in shipped.values() if hashlib.sha256(octets).hexdigest() == flown]
    return replace(build, model=same[0] if same else shipped[DEFAULT_NETWORK])


def stored_images(archive: Path, record: recording.PassRecord) -> Iterator[Image]:
    """Yield the images of a pass from its archive; the next one is read while one is processed."""
    return _ahead(lambda item: recording.load_image(archive, item), record.inputs)


def rendered_images(archive: Path, record: recording.PassRecord, data: DataFolder) -> Iterator[Image]:
    """Yield the images of a pass; those that its archive lacks are rendered from scenario and seed, and verified."""
    from payload_emulator.session.scenario import parse_scenario
    from payload_emulator.session.world.camera import expose

    manifest = _manifest(archive)
    text = manifest.get("scenario_toml")
    if not text:
        raise RecordError(f"{archive}: expected frames, or a scenario to render them from, found neither")
    scenario = parse_scenario(str(text), source=f"scenario of {archive}")
    world = _declared_world(scenario, data, manifest.get("data_sources") or ())
    world.terrain.release_thread()
    absent = set(recording.missing_frames(archive, record.inputs))

    def image_of(item: recording.RecordedStep) -> Image:
        if item.number not in absent or not item.image_sha256:
            return recording.load_image(archive, item)
        if item.number >= world.frame_utc_ns.size:
            raise RecordError(
                f"{archive}: expected a scenario with frame {item.number}, found {world.frame_utc_ns.size} frames"
            )
        image = expose(world, int(world.frame_utc_ns[item.number])).image
        recording.check_image(item, image, f"frame {item.number} rendered from the scenario of {archive}")
        return image

    return _ahead(image_of, record.inputs)


def _declared_world(scenario: Scenario, data: DataFolder, declared: Collection[str]) -> World:
    """Return the world of a scenario with the declared data products; `RecordError` without them."""
    from payload_emulator.session.world.world import REGISTRATION, build_world

    lacking = needed = [name for name in declared if ", seed " not in name and not name.startswith(REGISTRATION)]
    for folder in (data, DataFolder(None)):
        try:
            world = build_world(scenario, folder)
        except TerrainError:
            continue
        if not (lacking := [name for name in needed if name not in world.data_names]):
            return world
    raise RecordError(f"data product missing: {', '.join(lacking) or 'terrain'}")


def load_detections(archive: Path) -> dict[int, Recorded] | None:
    """Return the received detections of an archive without frames by on-board time; None for an archive with frames.

    Raises
    ------
    RecordError
        The file has another form.
    """
    path = archive / DETECTIONS
    if not path.is_file():
        return None
    found: dict[int, Recorded] = {}
    try:
        for line in path.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            u_px, v_px, diameter_px, score, sigma_px = (
                np.array([np.nan if value is None else value for value in row[name]], dtype=np.float64)
                for name in ("u_px", "v_px", "diameter_px", "score", "sigma_px")
            )
            detections = Detections(u_px, v_px, diameter_px, score, sigma_px)
            found[int(row["ticks"])] = ImageQuality(row["quality"]), detections
    except (ValueError, KeyError, TypeError) as error:
        raise RecordError(f"{path}: expected the detections of each image, found something else ({error})") from None
    return found


def complete_archive(archive: Path, out: Path, data: DataFolder, progress: Progress | None = None) -> dict[str, Any]:
    """Write a copy of an archive that holds all its frames; the new manifest comes back.

    The archive of a live pass that declares its world gets the inputs of the payload as well, see `reconstruction`.
    """
    from payload_emulator.session.archive.emulator import file_entries
    from payload_emulator.session.archive.reconstruction import reconstruct

    manifest = _manifest(archive)
    if out.exists():
        raise RecordError(f"{out}: expected a new folder, found something there; choose another --out")
    if manifest.get("scenario_toml") and not (archive / recording.INPUTS).is_file():
        return reconstruct(archive, out, data, progress)
    record = recording.load_record(archive)
    shutil.copytree(archive, out)
    absent = set(recording.missing_frames(archive, record.inputs))
    pairs = zip(record.inputs, rendered_images(archive, record, data), strict=True)
    for item, image in progress(pairs, len(record.inputs)) if progress else pairs:
        if item.number in absent:
            recording.save_image(out, item.number, image)
    manifest["files"] = file_entries(out)
    _write_json(out / "manifest.json", manifest)
    return manifest


@dataclass(slots=True, eq=False)
class RecordedBoard(BareBoard):
    """The board as it was when the pass was flown: its readings and its link, whatever the build does with it."""

    uptime: int = -1
    downlink: int = UNLIMITED
    asked_to_reset: bool = False

    def enter_step(self, item: recording.RecordedStep) -> bool:
        """Take the place of the board in a step; whether the processor restarts before it."""
        self.uptime, self.downlink = item.uptime_ticks, item.downlink_octets
        if np.isfinite(item.sensors).all():
            self.readings = item.sensors
        starts = item.boot is not None or self.asked_to_reset
        if item.boot is not None:
            self.reset_cause = ResetCause(item.boot)
        self.asked_to_reset = False
        return starts

    def uptime_ticks(self) -> int:
        return self.uptime

    def downlink_octets(self) -> int:
        return self.downlink

    def request_reset(self, cause: int) -> None:
        self.reset_cause, self.asked_to_reset = ResetCause(cause), True


@dataclass(slots=True, eq=False)
class _TimedDetector:
    """The detector of flight with the CPU time that it takes."""

    model: bytes
    parameters: BuildParameters
    clock: CpuClock
    recorded: Mapping[int, Recorded] | None = None
    image_ticks: int = 0
    onnx: OnnxDetector = field(init=False)
    examine_s: float = field(default=0.0, init=False)
    network_s: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        timed = self

        class Onnx(OnnxDetector):
            def run_network(self, tile: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
                began = timed.clock()
                maps = OnnxDetector.run_network(self, tile)
                timed.network_s += timed.clock() - began
                return maps

        if not self.model:
            raise ModelError("detector model: expected an ONNX file, found no octets")
        self.onnx = Onnx(self.model, self.parameters.detector)

    def reset(self) -> None:
        self.examine_s = self.network_s = 0.0

    def examine(self, image: NDArray[Any], sun_in_camera: FloatArray | None = None) -> tuple[ImageQuality, Detections]:
        if self.recorded is not None:
            return self.recorded.get(self.image_ticks, (ImageQuality.INVALID, no_detections()))
        began = self.clock()
        found = self.onnx.examine(image, sun_in_camera)
        self.examine_s += self.clock() - began
        return found


def _ahead(
    load: Callable[[recording.RecordedStep], Image], inputs: tuple[recording.RecordedStep, ...]
) -> Iterator[Image]:
    with ThreadPoolExecutor(max_workers=1) as reader:
        pending = [reader.submit(load, item) for item in inputs[:2]]
        for number in range(len(inputs)):
            if number + 2 < len(inputs):
                pending.append(reader.submit(load, inputs[number + 2]))
            yield pending.pop(0).result()


def _build_table(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ParameterError(str(path), "", "a build file", f"none ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise ParameterError(str(path), "", "a build file (TOML)", str(error)) from None


def _manifest(archive: Path) -> dict[str, Any]:
    try:
        manifest = json.loads((archive / "manifest.json").read_text())
        int(manifest["spacecraft_id"])
    except FileNotFoundError:
        raise RecordError(f"{archive}: expected a pass archive with manifest.json, found none") from None
    except (ValueError, KeyError, TypeError) as error:
        raise RecordError(
            f"{archive / 'manifest.json'}: expected a pass manifest, found something else ({error})"
        ) from None
    return dict(manifest)


def _coding(manifest: dict[str, Any]) -> Literal["rs", "none"]:
    """Coding of the archived downlink, as its manifest or its scenario says."""
    text = str(manifest.get("scenario_toml") or "")
    said = manifest.get("coding") or tomllib.loads(text).get("link", {}).get("coding", "rs")
    return "none" if said == "none" else "rs"


def _write_json(path: Path, value: dict[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n")
