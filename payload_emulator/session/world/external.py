"""Frames that others took: a folder of images with their times, an orbit (OEM) and, where known, attitudes (AEM).

The folder holds `frames.csv` (columns `file` and `utc`, in order of time), the images it names (PNG, JPEG, TIFF or NPY,
all of the size of the scenario's camera), one ephemeris `*.oem`, and at most one attitude file `*.aem` from ICRF to the
camera. Without attitudes the camera looks straight down, as the scenario points it.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.errors import LunarError
from lunar.frames import matrix_from_quaternion
from lunar.messages.aem import AttitudeSegment, parse_aem
from lunar.timescales import format_utc, parse_utc
from payload_emulator.errors import DatasetError, ScenarioError
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.world.picture_files import read_picture
from payload_emulator.sim.render.sensor import Picture

TABLE = "frames.csv"
SCENARIO = "scenario.toml"
_INERTIAL = ("ICRF", "EME2000")  # apart by .02 arc seconds, far less than a pixel

World = Literal["", "photographs", "other-renderer"]


@dataclass(frozen=True, slots=True, eq=False)
class ExternalFrames:
    """Frames of a folder: times (n,), files, attitudes (m,) and (m, 4), none of them where they are not known.

    `evidence` is the world that the user declares: "" where nothing is declared.
    """

    utc_ns: IntArray
    files: tuple[Path, ...]
    ephemeris: Path
    size_px: tuple[int, int]
    attitude_utc_ns: IntArray
    q_wxyz: FloatArray
    evidence: World = ""

    def image(self, utc_ns: int) -> Picture:
        """Pixels of the frame of a time, 8 or 16 bits.

        Raises
        ------
        ScenarioError
            The image is missing, cannot be read, or has another size than the camera.
        """
        path = self.files[int(np.searchsorted(self.utc_ns, utc_ns))]
        try:
            image, _ = read_picture(path)
        except DatasetError as error:
            raise ScenarioError(str(error)) from None
        width_px, height_px = self.size_px
        if image.shape[:2] != (height_px, width_px):
            raise ScenarioError(
                f"{path}: expected an image of the scenario's camera, {width_px} x {height_px} pixels, "
                f"found {image.shape[1]} x {image.shape[0]}"
            )
        if image.ndim == 3:
            image = image[..., :3] if image.shape[2] >= 3 else image[..., 0]
        if image.dtype == np.uint8:
            return np.asarray(image, dtype=np.uint8)
        if image.dtype.kind == "f":
            return np.asarray(np.rint(np.clip(np.nan_to_num(image), 0.0, 1.0) * 65_535.0), dtype=np.uint16)
        if image.dtype != np.uint16:
            raise ScenarioError(f"{path}: expected pixels of 8 or 16 bits or floats, found {image.dtype}")
        return np.asarray(image, dtype=np.uint16)

    def camera_from_icrf(self, utc_ns: int) -> FloatArray | None:
        """Attitude (3, 3) at a time, along the great arc between its neighbours; None where none is known."""
        if not self.attitude_utc_ns.size:
            return None
        after = int(np.clip(np.searchsorted(self.attitude_utc_ns, utc_ns), 0, self.attitude_utc_ns.size - 1))
        before = max(after - 1, 0) if self.attitude_utc_ns[after] > utc_ns else after
        span = int(self.attitude_utc_ns[after] - self.attitude_utc_ns[before])
        share = (utc_ns - int(self.attitude_utc_ns[before])) / span if span else 0.0
        return np.asarray(matrix_from_quaternion(_between(self.q_wxyz[before], self.q_wxyz[after], share)))


def load_external(folder: Path, scenario: Scenario, evidence: World = "") -> ExternalFrames:
    """The frames of a folder for the camera of a scenario.

    Raises
    ------
    ScenarioError
        A file is missing or broken, or attitudes do not reach over all frames; the message names the place.
    """
    utc_ns, files = _table(folder)
    attitude_utc_ns, q_wxyz = _attitudes(folder)
    if attitude_utc_ns.size and (utc_ns[0] < attitude_utc_ns[0] or utc_ns[-1] > attitude_utc_ns[-1]):
        raise ScenarioError(
            f"{folder}: expected attitudes from {format_utc(int(utc_ns[0]))} to {format_utc(int(utc_ns[-1]))}, "
            f"found {format_utc(int(attitude_utc_ns[0]))} to {format_utc(int(attitude_utc_ns[-1]))}"
        )
    return ExternalFrames(
        utc_ns,
        files,
        _only(folder, "*.oem", "ephemeris"),
        (scenario.camera.width_px, scenario.camera.height_px),
        attitude_utc_ns,
        q_wxyz,
        evidence,
    )


def external_scenario(scenario: Scenario, frames: ExternalFrames) -> Scenario:
    """The scenario with the orbit and times of external frames, the real Sun, and without pointing errors."""
    duration_s = float(frames.utc_ns[-1] - frames.utc_ns[0]) / 1e9
    return replace(
        scenario,
        orbit=replace(scenario.orbit, oem=str(frames.ephemeris)),
        window=replace(
            scenario.window,
            search="none",
            start=format_utc(int(frames.utc_ns[0])),
            duration_s=duration_s + 1.0,
        ),
        light=replace(scenario.light, mode="real"),
        attitude=replace(scenario.attitude, pointing_error_deg=0.0),
        maneuvers=replace(scenario.maneuvers, enabled=False),
    )


def _table(folder: Path) -> tuple[IntArray, tuple[Path, ...]]:
    path = folder / TABLE
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(
            f"{path}: expected a table with columns file and utc, found none ({error})"
        ) from None
    times: list[int] = []
    files: list[Path] = []
    for line, row in enumerate(rows, start=2):
        name, text = row.get("file"), row.get("utc")
        if not name or not text:
            raise ScenarioError(f"{path}, line {line}: expected a file and a UTC, found {dict(row)}")
        try:
            times.append(parse_utc(text))
        except (LunarError, ValueError):
            raise ScenarioError(f"{path}, line {line}: expected a UTC, found {text!r}") from None
        if len(times) > 1 and times[-1] <= times[-2]:
            raise ScenarioError(f"{path}, line {line}: expected a time after the line before, found {text}")
        if not (folder / name).is_file():
            raise ScenarioError(f"{path}, line {line}: expected the image {folder / name}, found none")
        if folder / name in files:
            first = files.index(folder / name) + 2
            raise ScenarioError(
                f"{path}, lines {first} and {line}: expected an image of its own, found {name} twice"
            )
        files.append(folder / name)
    if not files:
        raise ScenarioError(f"{path}: expected at least one frame, found none")
    return np.array(times, dtype=np.int64), tuple(files)


def _attitudes(folder: Path) -> tuple[IntArray, FloatArray]:
    if not any(folder.glob("*.aem")):
        return np.zeros(0, dtype=np.int64), np.zeros((0, 4))
    path = _only(folder, "*.aem", "attitude file")
    try:
        segments: tuple[AttitudeSegment, ...] = parse_aem(path.read_text(encoding="utf-8"), str(path))
    except LunarError as error:
        raise ScenarioError(str(error)) from None
    for one in segments:
        if one.frame_a not in _INERTIAL:
            raise ScenarioError(f"{path}: expected REF_FRAME_A {' or '.join(_INERTIAL)}, found {one.frame_a}")
    return np.concatenate([one.utc_ns for one in segments]), np.concatenate([one.q_wxyz for one in segments])


def _only(folder: Path, pattern: str, what: str) -> Path:
    found = sorted(folder.glob(pattern))
    if len(found) != 1:
        raise ScenarioError(f"{folder}: expected one {what} {pattern}, found {len(found)}")
    return found[0]


def _between(first: FloatArray, second: FloatArray, share: float) -> FloatArray:
    """Unit quaternion (4,) at a share of the shorter arc between two."""
    cosine = float(first @ second)
    second = second if cosine >= 0.0 else -second
    angle = float(np.arccos(np.clip(abs(cosine), 0.0, 1.0)))
    if angle < 1e-9:
        return first
    return np.asarray(
        (np.sin((1.0 - share) * angle) * first + np.sin(share * angle) * second) / np.sin(angle)
    )
