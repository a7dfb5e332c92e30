"""What one build did with one archived pass, frame by frame: the numbers that gates are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ground_service.evaluation.detection.recall import SCORED_CLASSES, expected_craters, match_detections
from ground_service.evaluation.detection.viewing import Viewing
from ground_service.evaluation.navigation.alignment import error_of_places_rtn_m, reference_states
from ground_service.evaluation.navigation.consistency import squared_normalised_errors
from ground_service.passes.samples import DetectionSamples, NavigationSamples
from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.ephemeris import Ephemeris
from lunar.frames import Orientation

WRONG_FIX_SIGMAS = 6.0
WRONG_FIX_M = 500.0
"""A fix is wrong when its error exceeds so many of the standard deviations claimed with it, and this length."""

BAD_OUTCOMES = ("missed", "rejected", "refused")
"""Outcomes of a frame with an image that left the estimator without help from it."""


@dataclass(frozen=True, slots=True, eq=False)
class EstimatorFrames:
    """Samples of one estimator, a row per frame (n,); NaN without a report.

    Attributes
    ----------
    error_m, sigma_m
        Length of the position error, and of the reported standard deviations.
    squared_normalised_error
        Sum of squared errors over variances of the three axes: 3 on average for a consistent estimator.
        Packets of most dictionaries hold sigmas and no covariance, so this ignores correlations and is not a NEES.
    drift_percent
        Growth of the horizontal error since the previous frame over the ground path between them.
    outcome
        Outcome by name; empty without a report.
    wrong
        1 for a wrong fix, 0 for another outcome.
    """

    error_m: FloatArray
    sigma_m: FloatArray
    squared_normalised_error: FloatArray
    drift_percent: FloatArray
    outcome: tuple[str, ...]
    wrong: FloatArray

    def share(self, *outcomes: str) -> FloatArray:
        """1 for frames of these outcomes, 0 for others, NaN for frames without any."""
        return np.array(
            [np.nan if not name else float(name in outcomes) for name in self.outcome], dtype=np.float64
        )


@dataclass(frozen=True, slots=True, eq=False)
class PassFrames:
    """One build on one pass, a row per frame of the archive (n,).

    Attributes
    ----------
    answered
        Whether a report on the image came down.
    expected, hits, alarms
        Craters of 5 to 30 km that should be seen, were detected, and detections of that size that are none.
    error_px, shift_u_px, shift_v_px
        Sums over the hits of the centre's distance, and of detected minus expected centre.
    packets, octets
        Telemetry that belongs to the frame.
    latency
        CPU time of each stage over that of the yardstick.
    latency_ms
        The same in milliseconds as measured.
    """

    answered: BoolArray
    expected: FloatArray
    hits: FloatArray
    alarms: FloatArray
    error_px: FloatArray
    shift_u_px: FloatArray
    shift_v_px: FloatArray
    packets: FloatArray
    octets: FloatArray
    estimators: Mapping[str, EstimatorFrames]
    latency: Mapping[str, FloatArray] = field(default_factory=dict)
    latency_ms: Mapping[str, FloatArray] = field(default_factory=dict)
    undecodable: int = 0
    memory_mib: float = float("nan")

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
    viewing: Viewing | None = None,
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
    track = reference_states(reference, orientation, frame_utc_ns)
    rotations = None
    if viewing is not None:
        rotations = viewing.camera_from_mcmf(frame_utc_ns, track.position_mcmf_m, track.mcmf_from_icrf)
    expected = expected_craters(catalogue, camera, track.position_mcmf_m, rotations)
    whole = _by_frame(detections, n)
    matches = match_detections(whole, expected)
    frame_of_crater = np.repeat(np.arange(n), np.diff(expected.offsets))
    frame_of_detection = np.repeat(np.arange(n), np.diff(whole.offsets))
    counted = np.isin(expected.size_class, SCORED_CLASSES) & expected.complete
    due = np.bincount(frame_of_crater[counted], minlength=n).astype(np.float64)
    at = np.flatnonzero(counted & (matches.detection_of_crater >= 0))
    by = matches.detection_of_crater[at]
    du, dv = whole.u_px[by] - expected.u_px[at], whole.v_px[by] - expected.v_px[at]
    owner = frame_of_crater[at]
    false = (matches.crater_of_detection < 0) & np.isin(whole.size_class, SCORED_CLASSES)
    answered = np.zeros(n, dtype=np.bool_)
    answered[detections.frame_number] = True
    row = np.clip(np.searchsorted(frame_ticks, packet_ticks, side="right") - 1, 0, max(n - 1, 0))
    estimators = {}
    for name, samples in navigation.items():
        rows = samples.frame_number
        error = np.full((n, 3), np.nan)
        latitude, longitude, altitude = (np.full(n, np.nan) for _ in range(3))
        latitude[rows], longitude[rows] = samples.latitude_deg, samples.longitude_deg
        altitude[rows] = samples.altitude_m
        sigma = np.full((n, 3), np.nan)
        sigma[rows] = samples.sigma_rtn_m
        error = error_of_places_rtn_m(track, latitude, longitude, altitude)
        estimators[name] = _estimator(error, sigma, track.position_mcmf_m, outcomes.get(name, {}))
    return PassFrames(
        answered=answered,
        expected=due,
        hits=_sums(owner, np.ones(len(at)), n),
        alarms=_sums(frame_of_detection[false], np.ones(int(np.count_nonzero(false))), n),
        error_px=_sums(owner, np.hypot(du, dv), n),
        shift_u_px=_sums(owner, du, n),
        shift_v_px=_sums(owner, dv, n),
        packets=_sums(row, np.ones(len(row)), n),
        octets=_sums(row, packet_octets.astype(np.float64), n),
        estimators=estimators,
    )


def _sums(owner: IntArray, values: FloatArray, frames: int) -> FloatArray:
    """Sum of the values of each frame (frames,)."""
    return np.asarray(np.bincount(owner, weights=values, minlength=frames)[:frames], dtype=np.float64)


def _estimator(
    error_rtn_m: FloatArray, sigma_rtn_m: FloatArray, position_mcmf_m: FloatArray, outcomes: Mapping[int, str]
) -> EstimatorFrames:
    n = len(error_rtn_m)
    length = np.linalg.norm(error_rtn_m, axis=1)
    direction = position_mcmf_m / np.linalg.norm(position_mcmf_m, axis=1, keepdims=True)
    path_m = np.full(n, np.nan)
    path_m[1:] = MOON_RADIUS_M * np.linalg.norm(np.diff(direction, axis=0), axis=1)
    gained = np.full(n, np.nan)
    gained[1:] = np.linalg.norm(np.diff(error_rtn_m[:, 1:], axis=0), axis=1)
    outcome = tuple(outcomes.get(i, "") for i in range(n))
    fixed = np.array([name == "fixed" for name in outcome], dtype=np.bool_)
    claimed = np.linalg.norm(sigma_rtn_m, axis=1)
    far = (length > WRONG_FIX_SIGMAS * claimed) & (length > WRONG_FIX_M)
    known = np.array([bool(name) for name in outcome], dtype=np.bool_)
    return EstimatorFrames(
        error_m=length,
        sigma_m=claimed,
        squared_normalised_error=squared_normalised_errors(error_rtn_m, sigma_rtn_m),
        drift_percent=np.where(path_m > 0.0, 100.0 * gained / np.where(path_m > 0.0, path_m, 1.0), np.nan),
        outcome=outcome,
        wrong=np.where(known, (fixed & far).astype(np.float64), np.nan),
    )


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
