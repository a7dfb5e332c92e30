"""Results of one build on one archived pass, frame by frame: the inputs of the gates."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ground_service.evaluation import alignment, recall
from ground_service.telemetry.samples import DetectionSamples, NavigationSamples
from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import CraterCatalogue, size_class
from lunar.constants import MOON_RADIUS_M
from lunar.ephemeris import Ephemeris
from lunar.frames import Orientation, spherical_from_mcmf

WRONG_FIX_SIGMAS = 6.0
WRONG_FIX_M = 500.0
"""A fix is wrong when its error exceeds so many of the standard deviations claimed with it, and this length."""

BAD_OUTCOMES = ("missed", "rejected", "refused")
"""Outcomes of a frame with an image that left the estimator without help from it."""

VISIT_GAP_FRAMES = 40
"""A crater that was out of view for longer is another visit."""

CELL_DEG = 0.25
"""Ground cells of detections: a lasting feature that is detected again and again is one cell."""

KINDS = ("sparse", "cratered")
"""Kinds of terrain, by the density of catalogued craters."""

DENSITY_ARC_M = 100e3
CRATERED_PER_1E6_KM2 = 1000.0
"""Craters of 5 to 30 km within the arc: maria have some 300 per 10^6 km2, highlands some 2,000."""


@dataclass(frozen=True, slots=True, eq=False)
class CraterRows:
    """Expected craters of 5 to 30 km, a row for each frame that should show one (m,); the same for every build.

    Attributes
    ----------
    crater
        Index into the catalogue.
    track
        Number of the track: one crater in one visit.
    kind
        Index into `KINDS`.
    du_px, dv_px
        Detected minus expected centre; NaN for a crater that the build missed.
    """

    frame: IntArray
    crater: IntArray
    track: IntArray
    kind: IntArray
    du_px: FloatArray
    dv_px: FloatArray

    @property
    def hit(self) -> BoolArray:
        """Return whether the build detected it (m,)."""
        return np.isfinite(self.du_px)


@dataclass(frozen=True, slots=True, eq=False)
class DetectionRows:
    """Detections of 5 to 30 km (n,): frame, ground cell, and whether a catalogued crater explains them."""

    frame: IntArray
    cell: IntArray
    true: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class EstimatorFrames:
    """Samples of one estimator, a row per frame (n,); NaN without a report.

    Attributes
    ----------
    stated
        Whether the estimator sent a position; the error is unknown also where the reference has none.
    error_m, sigma_m
        Length of the position error, and of the reported standard deviations.
    squared_normalised_error
        Sum of squared errors over variances of the three axes: 3 on average for a consistent estimator.
        Packets of most dictionaries hold sigmas and no covariance, so this ignores correlations and is not a NEES.
    outcome
        Outcome by name; empty without a report.
    wrong
        1 for a wrong fix, 0 for another outcome, NaN where the error is unknown.
    """

    stated: BoolArray
    error_m: FloatArray
    sigma_m: FloatArray
    squared_normalised_error: FloatArray
    outcome: tuple[str, ...]
    wrong: FloatArray

    def share(self, *outcomes: str) -> FloatArray:
        """1 for frames of these outcomes, 0 for others, NaN for frames without any."""
        return np.array([np.nan if not name else float(name in outcomes) for name in self.outcome], dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class TimeTags:
    """Time tags of the packets of a pass.

    Attributes
    ----------
    packets, unknown_images
        Number of packets of each kind, and of those that name a time at which the payload was given no image.
    delays_s
        Time in the header of each packet since the image that it names, or since the last step of the payload.
    backwards
        Packets with an earlier header time than the packet before them of the same application process.
    """

    packets: Mapping[str, int] = field(default_factory=dict)
    unknown_images: Mapping[str, int] = field(default_factory=dict)
    delays_s: Mapping[str, FloatArray] = field(default_factory=dict)
    backwards: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class PassFrames:
    """One build on one pass, a row per frame of the archive (n,).

    Attributes
    ----------
    answered
        Whether a report on the image came down.
    packets, octets
        Telemetry that belongs to the frame.
    latency_ms
        CPU time of each stage, and of all together.
    digests
        Hash of the packets since each frame, in the order received; the first one of packets before all frames.
    cpu_s
        CPU time of the whole run as the sandbox measured it; NaN if that of the other build is of another time.
    times
        Time tags of the packets.
    """

    answered: BoolArray
    packets: FloatArray
    octets: FloatArray
    estimators: Mapping[str, EstimatorFrames]
    craters: CraterRows
    detections: DetectionRows
    latency_ms: Mapping[str, FloatArray] = field(default_factory=dict)
    undecodable: int = 0
    memory_mib: float = float("nan")
    cpu_s: float = float("nan")
    digests: tuple[bytes, ...] = ()
    times: TimeTags = TimeTags()

    def __len__(self) -> int:
        return len(self.answered)


def pass_frames(
    frame_ticks: IntArray,
    frame_utc_ns: IntArray,
    detections: DetectionSamples,
    navigation: Mapping[str, NavigationSamples],
    outcomes: Mapping[str, Mapping[int, str]],
    packet_ticks: IntArray,
    packet_octets: IntArray,
    reference: Ephemeris,
    catalogue: CraterCatalogue,
    camera: PinholeCamera,
    orientation: Orientation,
    viewing: recall.Viewing | None = None,
) -> PassFrames:
    """Return the frames of a pass with their received samples.

    Parameters
    ----------
    frame_ticks, frame_utc_ns
        On-board time of each frame in the payload input, and the corresponding UTC, (n,).
    detections, navigation
        Samples whose `frame_number` is the row of the frame.
    outcomes
        Outcome of each estimator by row of the frame.
    packet_ticks, packet_octets
        On-board time and length of every packet.
    viewing
        Mounting and attitudes of the camera; None: a nadir camera.
    """
    n = len(frame_ticks)
    track = alignment.reference_states(reference, orientation, frame_utc_ns)
    rotations = (
        nadir_camera_from_mcmf(track.position_mcmf_m)
        if viewing is None
        else viewing.camera_from_mcmf(frame_utc_ns, track.position_mcmf_m, track.mcmf_from_icrf)
    )
    expected = recall.expected_craters(catalogue, camera, track.position_mcmf_m, rotations)
    whole = _by_frame(detections, n)
    matches = recall.match_detections(whole, expected)
    frame_of_crater = np.repeat(np.arange(n), np.diff(expected.offsets))
    frame_of_detection = np.repeat(np.arange(n), np.diff(whole.offsets))
    counted = np.isin(expected.size_class, recall.SCORED_CLASSES) & expected.complete
    rows = np.flatnonzero(counted)
    by = matches.detection_of_crater[rows]
    # A missed crater has the row -1: the value after the last.
    du, dv = (
        np.append(seen, np.nan)[by] - there[rows]
        for seen, there in ((whole.u_px, expected.u_px), (whole.v_px, expected.v_px))
    )
    false = (matches.crater_of_detection < 0) & np.isin(whole.size_class, recall.SCORED_CLASSES)
    shown = np.concatenate((by[by >= 0], np.flatnonzero(false)))
    shown_frame = frame_of_detection[shown]
    lines = np.einsum(
        "nji,nj->ni", rotations[shown_frame], camera.rays(np.column_stack((whole.u_px, whole.v_px))[shown])
    )
    row = np.clip(np.searchsorted(frame_ticks, packet_ticks, side="right") - 1, 0, max(n - 1, 0))
    return PassFrames(
        answered=np.isin(np.arange(n), detections.frame_number),
        packets=_sums(row, np.ones(len(row)), n),
        octets=_sums(row, packet_octets.astype(np.float64), n),
        estimators=_estimators(navigation, outcomes, track, n),
        craters=CraterRows(
            frame_of_crater[rows],
            expected.index[rows],
            _tracks(expected.index[rows], frame_of_crater[rows]),
            terrain_kinds(catalogue, expected, rows),
            du,
            dv,
        ),
        detections=DetectionRows(
            shown_frame, _cells(track.position_mcmf_m[shown_frame], lines), matches.crater_of_detection[shown] >= 0
        ),
    )


def _estimators(
    navigation: Mapping[str, NavigationSamples],
    outcomes: Mapping[str, Mapping[int, str]],
    track: alignment.ReferenceStates,
    n: int,
) -> dict[str, EstimatorFrames]:
    estimators = {}
    for name, samples in navigation.items():
        at = samples.frame_number
        latitude, longitude, altitude = (np.full(n, np.nan) for _ in range(3))
        latitude[at], longitude[at] = samples.latitude_deg, samples.longitude_deg
        altitude[at] = samples.altitude_m
        sigma = np.full((n, 3), np.nan)
        sigma[at] = samples.sigma_rtn_m
        error = alignment.error_of_places_rtn_m(track, latitude, longitude, altitude)
        stated = np.isfinite(latitude + longitude + altitude)
        estimators[name] = _estimator(stated, error, sigma, outcomes.get(name, {}))
    return estimators


def _tracks(crater: IntArray, frame: IntArray) -> IntArray:
    """Return the number of the track (m,) of each row: one crater in one visit."""
    order = np.lexsort((frame, crater))
    first = np.ones(len(order), dtype=np.bool_)
    first[1:] = (np.diff(crater[order]) != 0) | (np.diff(frame[order]) > VISIT_GAP_FRAMES)
    track = np.empty(len(order), dtype=np.int64)
    track[order] = np.cumsum(first) - 1
    return track


def terrain_kinds(catalogue: CraterCatalogue, expected: recall.ExpectedCraters, rows: IntArray) -> IntArray:
    """Return the kind of terrain (m,) around the expected craters of these rows."""
    scored = np.isin(size_class(catalogue.diameter_m), recall.SCORED_CLASSES)
    area_1e6_km2 = math.pi * (DENSITY_ARC_M / 1e3) ** 2 / 1e6
    craters, row_of = np.unique(expected.index[rows], return_inverse=True)
    count = [
        np.count_nonzero(scored[catalogue.near(*place, DENSITY_ARC_M)])
        for place in zip(
            catalogue.latitude_rad[craters].tolist(), catalogue.longitude_rad[craters].tolist(), strict=True
        )
    ]
    kind = np.array(count, dtype=np.float64) > CRATERED_PER_1E6_KM2 * area_1e6_km2
    return kind[row_of].astype(np.int64)


def _cells(position_mcmf_m: FloatArray, line_mcmf: FloatArray) -> IntArray:
    """Return the ground cell (n,) where lines of sight meet the sphere; -1 above the horizon."""
    along = np.einsum("ni,ni->n", position_mcmf_m, line_mcmf)
    square = along**2 - np.einsum("ni,ni->n", position_mcmf_m, position_mcmf_m) + MOON_RADIUS_M**2
    with np.errstate(invalid="ignore"):
        place = position_mcmf_m - (along + np.sqrt(square))[:, None] * line_mcmf
    latitude, longitude, _ = spherical_from_mcmf(place)
    row = np.floor(np.nan_to_num(np.degrees(latitude)) / CELL_DEG)
    # Columns narrow with the latitude, so that cells have about the same area.
    column = np.floor(np.nan_to_num(np.degrees(longitude)) * np.cos(np.radians(row * CELL_DEG)) / CELL_DEG)
    cell = (row * 100_000 + column).astype(np.int64)
    return np.where(np.isfinite(square) & (square >= 0.0), cell, -1)


def cell_places_deg(cell: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return latitude and longitude of the centres of ground cells (n,); those above the horizon are left out."""
    row = np.rint(cell[cell != -1] / 100_000)
    column = cell[cell != -1] - 100_000 * row
    width = CELL_DEG / np.cos(np.radians(row * CELL_DEG))
    return (row + 0.5) * CELL_DEG, (column + 0.5) * width


def _sums(owner: IntArray, values: FloatArray, frames: int) -> FloatArray:
    return np.asarray(np.bincount(owner, weights=values, minlength=frames)[:frames], dtype=np.float64)


def _estimator(
    stated: BoolArray, error_rtn_m: FloatArray, sigma_rtn_m: FloatArray, outcomes: Mapping[int, str]
) -> EstimatorFrames:
    length, claimed = (np.linalg.norm(vectors, axis=1) for vectors in (error_rtn_m, sigma_rtn_m))
    far = (length > WRONG_FIX_SIGMAS * claimed) & (length > WRONG_FIX_M)
    found = EstimatorFrames(
        stated=stated,
        error_m=length,
        sigma_m=claimed,
        squared_normalised_error=alignment.squared_normalised_errors(error_rtn_m, sigma_rtn_m),
        outcome=tuple(outcomes.get(i, "") for i in range(len(length))),
        wrong=np.where(np.isfinite(length), far, np.nan),
    )
    return replace(found, wrong=found.share("fixed") * found.wrong)


def _by_frame(detections: DetectionSamples, frames: int) -> DetectionSamples:
    """Detections with a row for every frame of the pass, empty for those of which none came down."""
    count = np.zeros(frames, dtype=np.int64)
    per_report = np.diff(detections.offsets)
    count[detections.frame_number] = per_report
    usable = np.zeros(frames, dtype=np.bool_)
    usable[detections.frame_number] = detections.usable
    order = np.argsort(np.repeat(detections.frame_number, per_report), kind="stable")
    return DetectionSamples(
        frame_number=np.arange(frames, dtype=np.int64),
        utc_ns=np.zeros(frames, dtype=np.int64),
        usable=usable,
        quality=(),
        offsets=np.concatenate(([0], np.cumsum(count))).astype(np.int64),
        u_px=detections.u_px[order],
        v_px=detections.v_px[order],
        diameter_px=detections.diameter_px[order],
        score=detections.score[order],
        size_class=detections.size_class[order],
    )
