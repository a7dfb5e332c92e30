"""Craters found in a camera frame by the on-board network: centre, diameter, score and predicted error in pixels.

The network (MobileNetV3 backbone, CenterNet heads) sees one gray plane of 512 x 512, Sun-up, and gives two maps at a
quarter of that resolution (half of it if the network enlarges the image first, for high altitudes): the probability
that a crater is centred in a cell, and its geometry (offset of the centre from the cell, logarithm of the diameter,
logarithm of the one-sigma centre error, and from newer networks ten times the depth/diameter). Size in kilometres is
not its business: that needs the altitude.

What the eye (and the network) takes for the centre of a crater is the middle of its walls, which lies some way below
the rim; away from the middle of a wide picture that displaces it inward, by parallax. The network cannot know where in
the picture it looks, so the detector puts it right with the share of the depth that the model's metadata carry.
Standard deviations are corrected by the calibration in the same metadata
(`flight.vision.calibration`); a network without one is taken as it is.

The paper's own design, "classified detections only", is flown too: a network that gives three heatmaps, one for each
size class, and the offset of the centre, and no size. A detection then carries its class, and the median diameter of
that class (in the model's metadata) as a prior of its size.

Pixel centres are integers; a cell (row i, column j) of stride 4 is centred at (4 j + 1.5, 4 i + 1.5).

References
----------
X. Zhou, D. Wang, P. Kraehenbuehl, "Objects as Points", 2019, section 4 (peaks by a 3 x 3 maximum, no box suppression).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, IntArray
from payload_emulator.errors import ModelError
from payload_emulator.flight.vision.calibration import SigmaModel, load_calibration, sigma_features, with_sigma
from payload_emulator.flight.vision.detections import Detections, no_detections
from payload_emulator.flight.vision.preprocess import ImageQuality, Preparation, prepare_image, sun_up_turns, turn_back

if TYPE_CHECKING:
    import onnxruntime

INPUT_SIZE_PX = 512
STRIDE_PX = 4
STRIDES_PX = (4, 2)
UNSTATED_SIGMA_PX = 2.0
"""Error of a centre whose network does not tell it: half a cell of stride 4."""

SAME_PLACE_CELLS = 1.5
"""Peaks of different classes nearer than this are one crater: neighbouring cells of one offset."""

CLASSES = 3
REFERENCE_DIAMETER_PX = 16.0  # the network gives ln(diameter / this)
INPUT_NAME = "image"
HEATMAP_NAME = "heatmap"
GEOMETRY_NAME = "geometry"


@dataclass(frozen=True, slots=True)
class DetectorParameters:
    """Parameters of the detector that may change on board without a new network.

    score_threshold : None takes the threshold that the network's own metadata carry (fixed on its validation set).
    max_detections : the detections packet counts in one octet; 120 exceeds the craters of any frame seen.
    duplicate_distance, duplicate_ratio : a weaker detection within this share of the smaller radius of a better one,
        and with a diameter within this ratio of it, is the same crater found from two cells.
    """

    score_threshold: float | None = None
    max_detections: int = 120
    duplicate_distance: float = 0.6
    duplicate_ratio: float = 1.6
    width_px: int = INPUT_SIZE_PX
    height_px: int = INPUT_SIZE_PX


@dataclass(slots=True, eq=False)
class OnnxDetector:
    """The network as octets (so that it can be uploaded), run on one thread of ONNX Runtime.

    Raises
    ------
    ModelError
        The octets do not load, their hash is not `expected_sha256`, or inputs and outputs are of another network.
    """

    model_octets: bytes
    parameters: DetectorParameters = field(default_factory=DetectorParameters)
    expected_sha256: str = ""
    threads: int = 1
    sha256: str = field(init=False)
    metadata: dict[str, str] = field(init=False)
    stride_px: int = field(init=False)
    preparation: Preparation = field(init=False)
    class_medians_m: FloatArray | None = field(init=False)
    score_threshold: float = field(init=False)
    parallax_per_px: float = field(init=False)
    calibration: SigmaModel | None = field(init=False)
    _session: onnxruntime.InferenceSession = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.sha256 = hashlib.sha256(self.model_octets).hexdigest()
        if self.expected_sha256 and self.expected_sha256.lower() != self.sha256:
            raise ModelError(f"detector network: expected SHA-256 {self.expected_sha256.lower()}, found {self.sha256}")
        self._session = _open_session(self.model_octets, self.threads)
        self.stride_px = INPUT_SIZE_PX // int(self._session.get_outputs()[0].shape[-1])
        self.metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        self.preparation = Preparation(self.metadata.get("preparation", Preparation.gray_first))
        self.class_medians_m = _class_medians(self._session, self.metadata)
        chosen = self.parameters.score_threshold
        self.score_threshold = float(self.metadata.get("score_threshold", "0.4")) if chosen is None else chosen
        self.parallax_per_px = float(self.metadata.get("parallax_per_px", "0.0"))
        self.calibration = load_calibration(self.metadata, self.model_octets)

    @property
    def model_hash(self) -> int:
        """First 32 bits of the SHA-256, as housekeeping carries it."""
        return int(self.sha256[:8], 16)

    def detect(self, image: NDArray[np.generic], sun_in_camera: FloatArray | None = None) -> Detections:
        """Craters in a frame of the size in `parameters`; none in a frame that cannot be searched (see `examine`).

        Parameters
        ----------
        image : (H, W) or (H, W, 3), unsigned integer of any depth, or float in 0..1.
        sun_in_camera : direction to the Sun, (3,), camera frame; None or NaN: the frame is searched as it comes.
        """
        return self.examine(image, sun_in_camera)[1]

    def examine(
        self, image: NDArray[np.generic], sun_in_camera: FloatArray | None = None
    ) -> tuple[ImageQuality, Detections]:
        """Verdict on a frame, and its craters where the verdict is OK; never raises for what a camera may deliver."""
        image = np.asarray(image)
        if image.ndim < 2 or image.shape[:2] != (self.parameters.height_px, self.parameters.width_px):
            return ImageQuality.INVALID, no_detections()
        return self.examine_any_size(image, sun_in_camera)

    def examine_any_size(
        self, image: NDArray[np.generic], sun_in_camera: FloatArray | None = None
    ) -> tuple[ImageQuality, Detections]:
        """As `examine`, any size: smaller images are padded, larger ones searched in overlapping tiles."""
        prepared = prepare_image(image, self.preparation)
        if prepared.quality is not ImageQuality.OK:
            return prepared.quality, no_detections()
        height_px, width_px = prepared.gray.shape
        turns = sun_up_turns(sun_in_camera)
        found = self.search(np.rot90(prepared.gray, turns))
        u_px, v_px = turn_back(found.u_px, found.v_px, turns, height_px, width_px)
        found = replace(found, u_px=u_px, v_px=v_px)
        return ImageQuality.OK, self.corrected(found, height_px, width_px, sun_in_camera)

    def corrected(
        self, found: Detections, height_px: int, width_px: int, sun_in_camera: FloatArray | None
    ) -> Detections:
        """Detections of an image (H, W) with calibrated centres and standard deviations.

        Parallax is removed if the image has the size of the camera's frames.
        """
        whole = (height_px, width_px) == (self.parameters.height_px, self.parameters.width_px)
        if self.calibration is not None:
            features = sigma_features(found, sun_in_camera, width_px, height_px, whole=whole)
            found = with_sigma(found, self.calibration, features)
        return remove_parallax(found, self.parallax_per_px, height_px, width_px) if whole else found

    def run_network(self, tile: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Heatmap and geometry maps of one prepared tile (1, 1, 512, 512)."""
        heatmap, geometry = self._session.run([HEATMAP_NAME, GEOMETRY_NAME], {INPUT_NAME: tile})
        return heatmap, geometry

    def search(self, gray: NDArray[np.float32], score_threshold: float | None = None) -> Detections:
        """Detections of a prepared plane (H, W) of any size with the Sun at its top, best first.

        `score_threshold` None takes that of the detector.
        """
        least = self.score_threshold if score_threshold is None else score_threshold
        rows, columns = gray.shape
        found = [
            self._search_tile(gray, top, left, least) for top in _tile_starts(rows) for left in _tile_starts(columns)
        ]
        every = found[0] if len(found) == 1 else join(found)
        order = np.argsort(-every.score, kind="stable")
        kept = drop_duplicates(every.select(order), self.parameters)
        return kept.select(np.arange(min(len(kept), self.parameters.max_detections * len(found))))

    def _search_tile(self, gray: NDArray[np.float32], top: int, left: int, score_threshold: float) -> Detections:
        tile = gray[top : top + INPUT_SIZE_PX, left : left + INPUT_SIZE_PX]
        rows, columns = tile.shape
        if tile.shape != (INPUT_SIZE_PX, INPUT_SIZE_PX):
            padded = np.zeros((INPUT_SIZE_PX, INPUT_SIZE_PX), np.float32)
            padded[:rows, :columns] = tile
            tile = padded
        heatmap, geometry = self.run_network(np.ascontiguousarray(tile)[None, None])
        if self.class_medians_m is None:
            found = decode(heatmap[0, 0], geometry[0], score_threshold, self.stride_px)
        else:
            found = decode_classes(heatmap[0], geometry[0], self.class_medians_m, score_threshold, self.stride_px)
        inside = (found.u_px < columns) & (found.v_px < rows)
        found = found.select(inside)
        return replace(found, u_px=found.u_px + left, v_px=found.v_px + top)


def decode(
    heatmap: NDArray[np.float32], geometry: NDArray[np.float32], score_threshold: float, stride_px: int = STRIDE_PX
) -> Detections:
    """Detections of one image from heatmap (h, w) and geometry (2, 4 or 5, h, w): see the head of this module.

    A peak is a cell not below its eight neighbours. Its centre and diameter are the score-weighted means of what the
    nine cells around it say, since each was trained to point at the same centre.
    """
    rows, columns = heatmap.shape
    padded = np.zeros((rows + 2, columns + 2), np.float32)
    padded[1:-1, 1:-1] = heatmap
    highest = heatmap
    for down in range(3):
        for right in range(3):
            if (down, right) != (1, 1):
                highest = np.maximum(highest, padded[down : down + rows, right : right + columns])
    row, column = np.nonzero((heatmap >= highest) & (heatmap >= np.float32(score_threshold)))
    score = heatmap[row, column].astype(np.float64)

    step = np.arange(-1, 2)
    near_row = np.clip(row[:, None, None] + step[None, :, None], 0, rows - 1)
    near_column = np.clip(column[:, None, None] + step[None, None, :], 0, columns - 1)
    weight = heatmap[near_row, near_column].astype(np.float64)
    centre_column = near_column + geometry[0][near_row, near_column].astype(np.float64)
    centre_row = near_row + geometry[1][near_row, near_column].astype(np.float64)
    sized = geometry.shape[0] > 2
    total = weight.sum(axis=(1, 2))
    total = np.where(total > 0.0, total, 1.0)

    def mean(values: FloatArray) -> FloatArray:
        averaged: FloatArray = (values * weight).sum(axis=(1, 2)) / total
        return averaged

    centre_of_cell = (stride_px - 1) / 2.0
    return Detections(
        stride_px * mean(centre_column) + centre_of_cell,
        stride_px * mean(centre_row) + centre_of_cell,
        REFERENCE_DIAMETER_PX * np.exp(mean(geometry[2][near_row, near_column].astype(np.float64)))
        if sized
        else np.full(row.size, np.nan),
        score,
        np.exp(mean(geometry[3][near_row, near_column].astype(np.float64)))
        if sized
        else np.full(row.size, UNSTATED_SIGMA_PX),
        np.clip(0.1 * mean(geometry[4][near_row, near_column].astype(np.float64)), 0.0, 0.25)
        if geometry.shape[0] > 4
        else None,
    )


def decode_classes(
    heatmaps: NDArray[np.float32],
    geometry: NDArray[np.float32],
    medians_m: FloatArray,
    score_threshold: float,
    stride_px: int = STRIDE_PX,
) -> Detections:
    """Classified detections of one image from heatmaps (3, h, w) and offsets (2, h, w), best first.

    Of detections of several classes at one place, the best counts.
    """
    parts = [decode(heatmap, geometry, score_threshold, stride_px) for heatmap in heatmaps]
    classes = np.concatenate([np.full(len(part), k, dtype=np.int64) for k, part in enumerate(parts)])
    found = replace(join(parts), size_class=classes, diameter_m=medians_m[classes])
    found = found.select(np.argsort(-found.score, kind="stable"))
    distance = np.hypot(found.u_px[:, None] - found.u_px, found.v_px[:, None] - found.v_px)
    repeated = np.triu(distance < SAME_PLACE_CELLS * stride_px, 1)
    keep = np.ones(len(found), bool)
    for k in range(len(found)):
        if keep[k]:
            keep &= ~repeated[k]
    return found.select(keep)


TYPICAL_DEPTH_RATIO = 0.1  # of craters that are found, where the network does not tell


def remove_parallax(found: Detections, share_per_px: float, height_px: int, width_px: int) -> Detections:
    """Detections with their centres brought from the middle of the walls up to the plane of the rim.

    A point that lies d below the rim appears nearer the middle of the picture by the fraction d / range of its distance
    from there; d is a share of the crater's depth, and depth / range = depth/diameter times diameter_px / focal_px.
    `share_per_px` is that share over the focal length in pixels; zero leaves the detections as they are.
    """
    if share_per_px == 0.0 or len(found) == 0:
        return found
    ratio = TYPICAL_DEPTH_RATIO if found.depth_ratio is None else found.depth_ratio
    outward = np.nan_to_num(share_per_px * ratio * found.diameter_px)  # unknown sizes: no correction
    return replace(
        found,
        u_px=found.u_px + outward * (found.u_px - 0.5 * (width_px - 1)),
        v_px=found.v_px + outward * (found.v_px - 0.5 * (height_px - 1)),
    )


def join(parts: list[Detections]) -> Detections:
    """Detections of several searches in one; columns that one of them lacks are left out."""

    def column(name: str) -> Any:
        values = [getattr(part, name) for part in parts]
        return None if any(value is None for value in values) else np.concatenate(values)

    return Detections(**{item.name: column(item.name) for item in fields(Detections)})


def _tile_starts(length: int) -> list[int]:
    """First pixels of tiles that cover `length` with an overlap of at least half a tile."""
    if length <= INPUT_SIZE_PX:
        return [0]
    count = -(-(length - INPUT_SIZE_PX) // (INPUT_SIZE_PX // 2)) + 1
    return [int(start) for start in np.rint(np.linspace(0, length - INPUT_SIZE_PX, count))]


MANY_DETECTIONS = 512  # from here on, comparing each with each other takes longer than a search for neighbours


def drop_duplicates(found: Detections, parameters: DetectorParameters) -> Detections:
    """Detections (best first) without those that repeat a better one; of unknown sizes, all.

    Time grows with n log n, so that mosaics with a hundred thousand craters can be searched.
    """
    if len(found) <= MANY_DETECTIONS:
        better, worse = np.nonzero(np.triu(np.ones((len(found), len(found)), bool), 1))
    else:
        better, worse = _neighbours(found, parameters)
    radius = 0.5 * found.diameter_px
    distance = np.hypot(found.u_px[better] - found.u_px[worse], found.v_px[better] - found.v_px[worse])
    size = np.log(found.diameter_px)
    same = (distance < parameters.duplicate_distance * np.minimum(radius[better], radius[worse])) & (
        np.abs(size[better] - size[worse]) < np.log(parameters.duplicate_ratio)
    )
    keep = np.ones(len(found), bool)
    for first, second in zip(better[same], worse[same], strict=True):  # in order of the better one's rank
        if keep[first]:
            keep[second] = False
    return found.select(keep)


def _neighbours(found: Detections, parameters: DetectorParameters) -> tuple[IntArray, IntArray]:
    """Pairs (better, worse) in rank order that include every pair that may be one crater found twice.

    Sizes are sorted into bins as wide as the greatest ratio of such a pair, so it lies in one bin or in two adjacent
    ones, and its distance is at most a share of the greatest radius of the smaller bin.
    """
    from scipy.spatial import cKDTree

    known = np.flatnonzero(np.isfinite(found.diameter_px) & (found.diameter_px > 0.0))
    bins = np.floor(np.log(found.diameter_px[known]) / np.log(parameters.duplicate_ratio))
    places = np.stack([found.u_px, found.v_px], axis=1)
    pairs = [np.zeros((0, 2), np.int64)]
    for low in np.unique(bins):
        near = known[(bins == low) | (bins == low + 1.0)]
        reach = 0.5 * parameters.duplicate_distance * parameters.duplicate_ratio ** (low + 1.0)
        pairs.append(near[cKDTree(places[near]).query_pairs(reach, output_type="ndarray")])
    every = np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)
    return every[:, 0], every[:, 1]


def _class_medians(session: onnxruntime.InferenceSession, metadata: dict[str, str]) -> FloatArray | None:
    """Median diameters of the classes of a network that gives classes only, m; None for one that gives sizes."""
    if session.get_outputs()[0].shape[1] != CLASSES:
        return None
    text = metadata.get("class_median_diameter_m", "")
    try:
        medians = np.array(json.loads(text), dtype=np.float64)
    except ValueError:
        medians = np.zeros(0)
    if medians.shape != (CLASSES,) or not (np.isfinite(medians).all() and (medians > 0.0).all()):
        raise ModelError(
            f"detector network: expected three median diameters in class_median_diameter_m, found {text!r}"
        )
    return medians


def _open_session(model_octets: bytes, threads: int) -> onnxruntime.InferenceSession:
    import onnxruntime
    from onnxruntime.capi import onnxruntime_pybind11_state as library

    kinds = ("Fail", "InvalidArgument", "InvalidGraph", "InvalidProtobuf", "NotImplemented", "RuntimeException")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.enable_mem_pattern = False  # a plan of all buffers keeps twice the memory and saves no time
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(model_octets, options, providers=["CPUExecutionProvider"])
    except tuple(getattr(library, kind) for kind in kinds) as error:
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise ModelError(
            f"detector network ({len(model_octets)} octets): expected an ONNX model, found none ({reason})"
        ) from error
    inputs = [(item.name, list(item.shape)) for item in session.get_inputs()]
    outputs = {item.name: list(item.shape) for item in session.get_outputs()}
    heat = outputs.get(HEATMAP_NAME, [])
    cells = [INPUT_SIZE_PX // stride for stride in STRIDES_PX]
    if (
        inputs != [(INPUT_NAME, [1, 1, INPUT_SIZE_PX, INPUT_SIZE_PX])]
        or heat[2:] not in [[n, n] for n in cells]
        or outputs.get(GEOMETRY_NAME) not in [[1, maps, *heat[2:]] for maps in (2, 4, 5)]
        or (heat[1] == CLASSES) != (outputs[GEOMETRY_NAME][1] == 2)
    ):
        raise ModelError(
            f"detector network: expected input {INPUT_NAME} [1, 1, {INPUT_SIZE_PX}, {INPUT_SIZE_PX}] and outputs "
            f"{HEATMAP_NAME}, {GEOMETRY_NAME} of {' or '.join(f'{n} x {n}' for n in cells)} cells, "
            f"found {inputs} and {outputs}"
        )
    return session
