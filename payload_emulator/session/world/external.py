"""Frames that others took: a folder of images with their times, an orbit (OEM) and, where known, attitudes (AEM).

The folder holds `frames.csv` (columns `file` and `utc`, in order of time), the images it names (PNG, JPEG, TIFF or NPY,
all of the size of the scenario's camera), one ephemeris `*.oem`, and at most one attitude file `*.aem` from ICRF to the
camera. Without attitudes the camera looks straight down, as the scenario points it.
"""

import csv
import io
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, IntArray
from lunar.errors import LunarError
from lunar.frames import matrix_from_quaternion
from lunar.messages.aem import CAMERA_NAMES, AttitudeSegment, parse_aem
from lunar.timescales import format_utc, parse_utc
from payload_emulator.errors import DatasetError, ScenarioError
from payload_emulator.session.scenario import Scenario
from payload_emulator.sim.render.sensor import Picture

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy")


_NO_DATA_BELOW, _NO_DATA_ABOVE = -1_000.0, 1e9
"""Special values for missing pixels (-9999, -32768, -3.4e38; 1e20, 3.4e38) lie beyond; counts of an image do not."""

_GDAL_NODATA = 42113
"""Tag of a TIFF file with the value of pixels without data, as text."""

_HOT = 4.0
"""Times the level of all but a thousandth of the pixels, from which a pixel is hot and decides no scale."""


def read_picture(path: Path) -> tuple[NDArray[np.generic], str]:
    """Read the pixels of an image file (PNG, JPEG, TIFF, NPY) and the faults of some; colours in RGB order.

    Pixels are 8 or 16 bits or float in 0..1, turned as EXIF states. Those without data (not finite, far below zero,
    above 1e9, or of the value that a TIFF file states) and below zero become black. A 16-bit file whose greatest value
    would fit into 12 or 14 bits is taken for one of so many. Float pixels above 1 are divided by the greatest one. Hot
    pixels do not count for either, and are cut at full scale.

    Raises
    ------
    DatasetError
        The file cannot be read as an image.
    """
    try:
        octets = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path}: expected an image file, found none ({error.strerror})") from error
    image = _decode_npy(path) if path.suffix.lower() == ".npy" else _decode(octets)
    if image is None:
        raise DatasetError(f"{path}: expected an image (PNG, TIFF, JPEG, NPY), found none that can be read")
    if image.dtype.kind == "i" or image.dtype.itemsize > 2:
        image = image.astype(np.float32)
    if not image.size:
        return image, ""
    is_number = np.greater(image, _NO_DATA_BELOW) & np.less(image, _NO_DATA_ABOVE)
    missing = ~is_number | np.equal(image, _stated_nodata(octets))
    image = np.where(missing, image.dtype.type(0), image)
    has_levels = image.dtype != np.uint8 and not missing.all()
    limit = _HOT * float(np.quantile(image[~missing], 0.999)) if has_levels else 0.0
    hot = np.greater(image, limit if limit > 0.0 else np.inf)
    greatest = float(image[~hot].max())
    if image.dtype == np.uint16:
        held = next(bits for bits in (12, 14, 16) if greatest < 1 << bits)
        image = np.left_shift(np.minimum(image, (1 << held) - 1).astype(np.uint16), 16 - held)
    elif image.dtype.kind == "f" and greatest > 1.0:
        image = np.divide(image, greatest)
    if image.dtype.kind == "f":
        image = np.clip(image, 0.0, 1.0)
    counts = ((missing, "without data (black)"), (hot, "hot (cut)"))
    words = [f"{np.count_nonzero(mask)} {name}" for mask, name in counts if mask.any()]
    return image, f"{' and '.join(words)} of {image.size} pixels" if words else ""


def _turned(image: NDArray[np.generic], octets: bytes) -> NDArray[np.generic]:
    """Return an image as its EXIF data state that it is to be shown (values 1 to 8 of the tag Orientation)."""
    from PIL import Image, UnidentifiedImageError

    if octets[:2] in (b"II", b"MM"):  # OpenCV turns TIFF images itself
        return image
    try:
        with Image.open(io.BytesIO(octets)) as opened:
            orientation = opened.getexif().get(0x0112, 1)
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError):
        return image
    if orientation in (5, 6, 7, 8):
        image = np.swapaxes(image, 0, 1)
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image[:, ::-1] if orientation in (2, 3, 6, 7) else image)


def _stated_nodata(octets: bytes) -> float:
    """Return the value of pixels without data that a TIFF file states; NaN where none is stated."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(octets)) as opened:
            return float(getattr(opened, "tag_v2", {}).get(_GDAL_NODATA, math.nan))
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError):
        return math.nan


def _decode(octets: bytes) -> NDArray[np.generic] | None:
    import cv2

    cv2.setLogLevel(0)  # it prints what an error of ours says
    data = np.frombuffer(octets, np.uint8)
    image: NDArray[np.generic] | None = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        return None
    image = _turned(image, octets)
    return image if image.ndim == 2 or image.shape[2] < 3 else image[..., [2, 1, 0]]


def _decode_npy(path: Path) -> NDArray[np.generic] | None:
    try:
        image = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError):
        return None
    if not isinstance(image, np.ndarray) or image.ndim not in (2, 3) or image.dtype.kind not in "uf":
        return None
    return image if image.ndim == 2 or image.shape[2] <= 4 else None


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
    attitude_scales: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """Return times of the frames and time scales of the attitudes, as printed with figures of them."""
        first, last = (format_utc(int(one)) for one in self.utc_ns[[0, -1]])
        scales = " and ".join(self.attitude_scales) or "none stated"
        return f"{self.files[0].name} {first} to {self.files[-1].name} {last}, epochs of attitudes: {scales}"

    def image(self, utc_ns: int) -> Picture:
        """Return the pixels of the frame of a time, 8 or 16 bits.

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
    """Load the frames of a folder for the camera of a scenario.

    Raises
    ------
    ScenarioError
        A file is missing or broken, or attitudes do not reach over all frames; the message names the place.
    """
    utc_ns, files = _table(folder)
    attitude_utc_ns, q_wxyz, scales = _attitudes(folder)
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
        scales,
    )


def external_scenario(scenario: Scenario, frames: ExternalFrames) -> Scenario:
    """Return the scenario with the orbit and times of external frames, the real Sun, and without pointing errors."""
    duration_s = float(frames.utc_ns[-1] - frames.utc_ns[0]) / 1e9
    return replace(
        scenario,
        orbit=replace(scenario.orbit, oem=str(frames.ephemeris)),
        window=replace(
            scenario.window, search="none", start=format_utc(int(frames.utc_ns[0])), duration_s=duration_s + 1.0
        ),
        light=replace(scenario.light, mode="real"),
        attitude=replace(scenario.attitude, pointing_error_deg=0.0),
        maneuvers=replace(scenario.maneuvers, enabled=False),
    )


def _table(folder: Path) -> tuple[IntArray, tuple[Path, ...]]:
    path = folder / TABLE
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: expected a table with columns file and utc, found none ({error})") from None
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
            raise ScenarioError(f"{path}, lines {first} and {line}: expected an image of its own, found {name} twice")
        files.append(folder / name)
    if not files:
        raise ScenarioError(f"{path}: expected at least one frame, found none")
    return np.array(times, dtype=np.int64), tuple(files)


def _attitudes(folder: Path) -> tuple[IntArray, FloatArray, tuple[str, ...]]:
    if not any(folder.glob("*.aem")):
        return np.zeros(0, dtype=np.int64), np.zeros((0, 4)), ()
    path = _only(folder, "*.aem", "attitude file")
    try:
        segments: tuple[AttitudeSegment, ...] = parse_aem(path.read_text(encoding="utf-8"), str(path))
    except LunarError as error:
        raise ScenarioError(str(error)) from None
    for one in segments:
        if one.frame_a not in _INERTIAL:
            raise ScenarioError(f"{path}: expected REF_FRAME_A {' or '.join(_INERTIAL)}, found {one.frame_a}")
        if not one.frame_b.upper().startswith(CAMERA_NAMES):
            raise ScenarioError(f"{path}: expected REF_FRAME_B INSTRUMENT_1 (the camera), found {one.frame_b}")
    scales = tuple(dict.fromkeys(one.time_system for one in segments))
    return (np.concatenate([one.utc_ns for one in segments]), np.concatenate([one.q_wxyz for one in segments]), scales)


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
    return np.asarray((np.sin((1.0 - share) * angle) * first + np.sin(share * angle) * second) / np.sin(angle))
