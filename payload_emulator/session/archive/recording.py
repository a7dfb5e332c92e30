"""Recorded inputs of a payload during a pass, from which another build flies the same pass.

In a pass archive this is the folder `payload/`: `inputs.jsonl` (one line per step: on-board time, message of the ADCS,
telecommands, hash of the image, readings of the board), `parameters.toml`, `tables/*.bin` as uploaded, and
`dictionary.json` (the packet definitions the downlink was made with); images lie in `frames/`. Nothing of the truth is
here.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, IntArray
from payload_emulator.errors import RecordError
from payload_emulator.flight.payload import FlightTables
from payload_emulator.session.spacecraft.parameter_file import BuildParameters, format_parameters, parse_parameters
from tmtc.dictionary.definitions import format_dictionary
from tmtc.dictionary.payload import DICTIONARY

if TYPE_CHECKING:
    from payload_emulator.session.spacecraft.loop import PayloadInput

FOLDER = "payload"
INPUTS = f"{FOLDER}/inputs.jsonl"
PARAMETERS = f"{FOLDER}/parameters.toml"
TABLES = f"{FOLDER}/tables"
FRAME_TIMES = "frame_times.csv"
DICTIONARY_FILE = f"{FOLDER}/dictionary.json"

Image = NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class RecordedStep:
    """Inputs of one call of `Payload.step`, the image by its hash.

    Attributes
    ----------
    number
        Frame of the pass; -1 for a step without one.
    boot
        Cause of the start of the processor before this step, None without one.
    sensors, uptime_ticks, downlink_octets
        Values of the board: readings (4,), time since power-on, room on the link.
    image_shape, image_sha256
        Shape of the pixels and SHA-256 of their octets, row by row; an empty shape and hash for a camera that gave
        none.
    """

    number: int
    clock_ticks: int
    attitude: FloatArray
    telecommands: bytes
    image_shape: tuple[int, ...]
    image_sha256: str
    boot: int | None
    sensors: FloatArray
    uptime_ticks: int
    downlink_octets: int


@dataclass(frozen=True, slots=True, eq=False)
class PassRecord:
    """Everything but the images that a payload was given during a pass.

    Attributes
    ----------
    dropped
        Parameters and tables of the record that the present flight code no longer has.
    """

    inputs: tuple[RecordedStep, ...]
    parameters: BuildParameters
    tables: FlightTables
    dropped: tuple[str, ...] = ()


def recorded_step(number: int, payload_input: PayloadInput) -> RecordedStep:
    """Return the record of one step."""
    return RecordedStep(
        number,
        payload_input.clock_ticks,
        np.asarray(payload_input.attitude, np.float64),
        payload_input.telecommands,
        payload_input.image.shape,
        pixel_hash(payload_input.image) if number >= 0 else "",
        payload_input.boot,
        np.asarray(payload_input.sensors, np.float64),
        payload_input.uptime_ticks,
        payload_input.downlink_octets,
    )


def pixel_hash(image: NDArray[Any]) -> str:
    """Return the SHA-256 of the pixels, row by row; empty for an image without any."""
    return hashlib.sha256(np.ascontiguousarray(image).data).hexdigest() if image.size else ""


def save_record(
    folder: Path, inputs: Iterable[RecordedStep], parameters: BuildParameters, tables: FlightTables
) -> None:
    """Write the record of a pass into its archive `folder`."""
    (folder / TABLES).mkdir(parents=True, exist_ok=True)
    (folder / INPUTS).write_text("".join(_line(item) for item in inputs))
    (folder / PARAMETERS).write_text(format_parameters(parameters))
    (folder / DICTIONARY_FILE).write_text(format_dictionary(DICTIONARY))
    for item in fields(tables):
        octets: bytes = getattr(tables, item.name)
        if octets:
            (folder / TABLES / f"{item.name}.bin").write_bytes(octets)


def save_frame_times(folder: Path, utc_ns: IntArray) -> None:
    """Write the UTC (n,) of every frame, which is the ground's to know: a payload is given its own clock only."""
    rows = [f"{number},{utc}\n" for number, utc in enumerate(utc_ns.tolist())]
    (folder / FRAME_TIMES).write_text("frame_number,utc_ns\n" + "".join(rows))


def load_record(folder: Path) -> PassRecord:
    """Load the record of a pass archive.

    Raises
    ------
    RecordError
        The archive holds no record, or not all of it.
    """
    try:
        lines = (folder / INPUTS).read_text().splitlines()
        text = (folder / PARAMETERS).read_text()
    except FileNotFoundError as error:
        raise RecordError(
            f"{folder}: expected {Path(error.filename).relative_to(folder)}, found none: this pass was archived "
            "without what its payload was given and cannot be flown again"
        ) from None
    except UnicodeDecodeError:
        raise RecordError(f"{folder / INPUTS}: expected UTF-8 text, found other octets") from None
    known = {item.name for item in fields(FlightTables)}
    tables, dropped = {}, list[str]()
    for path in sorted((folder / TABLES).glob("*.bin")):
        if path.stem in known:
            tables[path.stem] = path.read_bytes()
        else:
            dropped.append(f"tables.{path.stem}")
    parameters = parse_parameters(text, source=str(folder / PARAMETERS), dropped=dropped)
    return PassRecord(
        tuple(_parse(line, folder / INPUTS, i) for i, line in enumerate(lines)),
        parameters,
        FlightTables(**tables),
        tuple(dropped),
    )


def frame_path(number: int) -> str:
    """Return the name of the image of a frame in an archive."""
    return f"frames/{number:06d}.png"


def missing_frames(folder: Path, inputs: Sequence[RecordedStep]) -> list[int]:
    """Return the frames that had an image which is not in the archive."""
    return [item.number for item in inputs if item.image_sha256 and not (folder / frame_path(item.number)).is_file()]


def save_image(folder: Path, number: int, image: Image) -> None:
    """Write one frame into an archive; an image without pixels leaves no file."""
    if image.size == 0:
        return
    import cv2

    path = folder / frame_path(number)
    path.parent.mkdir(parents=True, exist_ok=True)
    good, encoded = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not good:
        raise OSError(f"PNG encoder refused an image of shape {image.shape}")
    path.write_bytes(encoded.tobytes())


def load_image(folder: Path, item: RecordedStep) -> Image:
    """Load the image of a frame as the payload received it, checked against its hash; no pixels if it had none.

    Raises
    ------
    RecordError
        The image is missing, or is another one.
    """
    if not item.image_sha256:
        return np.zeros(item.image_shape, np.uint8)
    import cv2

    path = folder / frame_path(item.number)
    try:
        octets = np.frombuffer(path.read_bytes(), np.uint8)
    except FileNotFoundError:
        raise RecordError(f"{path}: expected the image of frame {item.number}, found none") from None
    pixels = cv2.imdecode(octets, cv2.IMREAD_UNCHANGED) if octets.size else None
    if pixels is None:
        raise RecordError(f"{path}: expected a PNG image, found something else")
    image: Image = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB) if pixels.ndim == 3 else pixels
    check_image(item, image, str(path))
    return image


def check_image(item: RecordedStep, image: Image, source: str) -> None:
    """Refuse an image that is not the one that the payload was given."""
    if image.shape != item.image_shape:
        raise RecordError(
            f"{source}: expected {_size(item.image_shape)} as recorded for frame {item.number}, "
            f"found {_size(image.shape)}"
        )
    found = pixel_hash(image)
    if found != item.image_sha256:
        raise RecordError(
            f"{source}: expected pixels with SHA-256 {item.image_sha256[:16]}… for frame {item.number}, "
            f"found {found[:16]}…"
        )


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape)) + " pixels"


def _line(item: RecordedStep) -> str:
    row = {
        "frame": item.number,
        "ticks": item.clock_ticks,
        "attitude": _numbers(item.attitude),
        "telecommands": base64.b64encode(item.telecommands).decode(),
        "image": frame_path(item.number) if item.image_sha256 else None,
        "shape": list(item.image_shape),
        "pixels_sha256": item.image_sha256,
        "boot": item.boot,
        "sensors": _numbers(item.sensors),
        "uptime_ticks": item.uptime_ticks,
        "downlink_octets": item.downlink_octets,
    }
    return json.dumps(row) + "\n"


def _numbers(values: FloatArray) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]


def _array(values: list[float | None]) -> FloatArray:
    return np.array([math.nan if value is None else float(value) for value in values], dtype=np.float64)


def _parse(line: str, path: Path, index: int) -> RecordedStep:
    try:
        row = json.loads(line)
        if "instruments" in row:
            raise RecordError(
                f"{path}, line {index + 1}: expected the inputs of a camera, found samples of "
                f"{', '.join(row['instruments'])}: other instruments were withdrawn; the version that recorded "
                "this pass can replay it"
            )
        return RecordedStep(
            int(row["frame"]),
            int(row["ticks"]),
            _array(row["attitude"]),
            base64.b64decode(row["telecommands"], validate=True),
            tuple(int(value) for value in row["shape"]),
            str(row["pixels_sha256"]),
            None if row["boot"] is None else int(row["boot"]),
            _array(row["sensors"]),
            int(row["uptime_ticks"]),
            int(row["downlink_octets"]),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise RecordError(
            f"{path}, line {index + 1}: expected the inputs of a step, found something else ({error})"
        ) from None
