"""Ground evaluation of the detector: catalogued craters expected in each image, and detected craters.

A crater is expected if its centre, at rim height, projects into the image of the camera at the reference position and
in the attitude of the frame. A detection is true if it lies within half a radius of the crater and within the paper's
pixel limit, with at most one detection per crater. Detections of craters outside the scored size classes are not
counted.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ground_service.telemetry.samples import DetectionSamples
from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import (
    PinholeCamera,
    above_horizon,
    ground_arc_m,
    horizon_arc_m,
    nadir_camera_from_mcmf,
    pointed_camera_from_mcmf,
)
from lunar.catalogue import CraterCatalogue, size_class
from lunar.frames import matrix_from_quaternion, mcmf_from_spherical
from reports.values import BinScore, CalibrationBin, ClassScore, DetectorScore, PrecisionRecallCurve, ResidualSeries

CLASS_LABELS = ("5–10 km", "10–15 km", "15–30 km")
SCORED_CLASSES = (0, 1, 2)

CENTRE_TOLERANCE_RADII = 0.5
"""A centre further off than half a radius is another crater."""

CENTRE_TOLERANCE_PX = 10.0
"""The paper's limit on the centre, in pixels of its 512-pixel image."""

DIAMETER_TOLERANCE = 2.0
"""A detection more than twice or less than half as wide is of another crater (one inside it, or around it)."""

FRAMES_AT_ONCE = 500
"""Frames whose craters are projected together: some 200,000 candidates."""

ALTITUDE_BIN_KM = 10.0
SUN_ELEVATION_BIN_DEG = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedCraters:
    """Craters that should be seen: rows ``offsets[i]`` to ``offsets[i + 1]`` of the arrays (m,) belong to frame i."""

    offsets: IntArray
    index: IntArray
    u_px: FloatArray
    v_px: FloatArray
    diameter_px: FloatArray
    size_class: IntArray
    complete: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Matches: for each detection its row of `ExpectedCraters`, for each of those its detection; -1: none."""

    crater_of_detection: IntArray
    detection_of_crater: IntArray


def expected_craters(
    catalogue: CraterCatalogue,
    camera: PinholeCamera,
    position_mcmf_m: FloatArray,
    camera_from_mcmf: FloatArray | None = None,
) -> ExpectedCraters:
    """Return the craters of the catalogue whose centres the camera sees from each of the positions (f, 3), MCMF.

    `camera_from_mcmf` (f, 3, 3) is the attitude of each frame; None means a nadir camera with image up to the north.
    A crater of unknown rim height is placed at the median height of the others and is not scored.
    """
    known = np.isfinite(catalogue.rim_height_m)
    usual_m = float(np.median(catalogue.rim_height_m[known])) if known.any() else 0.0
    height_m = np.where(known, catalogue.rim_height_m, usual_m)
    points = mcmf_from_spherical(catalogue.latitude_rad, catalogue.longitude_rad, height_m)
    scored = catalogue.complete & known
    classes = size_class(catalogue.diameter_m).astype(np.int64)
    rotations = nadir_camera_from_mcmf(position_mcmf_m) if camera_from_mcmf is None else camera_from_mcmf
    distance = np.linalg.norm(position_mcmf_m, axis=-1)
    radius_m = float(np.mean(np.linalg.norm(points, axis=-1))) if len(points) else 1.0
    reach_m = _view_radius_m(camera, distance - radius_m, _off_nadir_rad(rotations, position_mcmf_m))
    counts = np.zeros(len(position_mcmf_m) + 1, dtype=np.int64)
    pieces = [(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros(0))]
    seeing = (
        np.flatnonzero(np.isfinite(distance) & np.isfinite(rotations).all(axis=(1, 2)))
        if len(points)
        else np.zeros(0, dtype=np.int64)
    )
    for frames in np.array_split(seeing, -(-len(seeing) // FRAMES_AT_ONCE) or 1):
        nearby, lines = [], []
        for position, rotation, range_m, reach in zip(
            position_mcmf_m[frames], rotations[frames], distance[frames], reach_m[frames], strict=True
        ):
            near = catalogue.near(math.asin(position[2] / range_m), math.atan2(position[1], position[0]), float(reach))
            nearby.append(near)
            lines.append((points[near] - position) @ rotation.T)
        if not nearby:
            continue
        near, in_camera = np.concatenate(nearby), np.concatenate(lines)
        owner = np.repeat(frames, [len(one) for one in nearby])
        uv = camera.project(in_camera)
        inside = np.flatnonzero(camera.contains(uv))
        inside = inside[above_horizon(position_mcmf_m[owner[inside]], points[near[inside]])]
        diameter = camera.focal_px * catalogue.diameter_m[near[inside]] / in_camera[inside, 2]
        pieces.append((near[inside], uv[inside], diameter))
        counts[1:] += np.bincount(owner[inside], minlength=len(counts) - 1)
    index, uv, diameter = map(np.concatenate, zip(*pieces, strict=True))
    return ExpectedCraters(
        np.cumsum(counts, dtype=np.int64), index, uv[:, 0], uv[:, 1], diameter, classes[index], scored[index]
    )


def match_detections(detections: DetectionSamples, expected: ExpectedCraters) -> Matches:
    """Pair detections with expected craters of their frames one to one, the closest pairs (in radii) first."""
    crater_of = np.full(len(detections.u_px), -1, dtype=np.int64)
    detection_of = np.full(len(expected.index), -1, dtype=np.int64)
    for frame in range(len(detections)):
        d0, d1 = detections.offsets[frame], detections.offsets[frame + 1]
        c0, c1 = expected.offsets[frame], expected.offsets[frame + 1]
        if d1 == d0 or c1 == c0:
            continue
        separation = np.hypot(
            detections.u_px[d0:d1, None] - expected.u_px[None, c0:c1],
            detections.v_px[d0:d1, None] - expected.v_px[None, c0:c1],
        )
        radius = expected.diameter_px[None, c0:c1] / 2.0
        with np.errstate(divide="ignore"):
            ratio = np.abs(np.log2(detections.diameter_px[d0:d1, None] / expected.diameter_px[None, c0:c1]))
        allowed = (separation <= np.minimum(CENTRE_TOLERANCE_RADII * radius, CENTRE_TOLERANCE_PX)) & (
            ratio <= math.log2(DIAMETER_TOLERANCE)
        )
        rows, columns = np.nonzero(allowed)
        for pair in np.lexsort((columns, rows, (separation / radius)[rows, columns])):
            row, column = int(rows[pair]) + int(d0), int(columns[pair]) + int(c0)
            if crater_of[row] < 0 and detection_of[column] < 0:
                crater_of[row] = column
                detection_of[column] = row
    return Matches(crater_of, detection_of)


def score_detections(
    detections: DetectionSamples,
    expected: ExpectedCraters,
    matches: Matches,
    altitude_m: FloatArray,
    sun_elevation_deg: FloatArray | None = None,
    sun_azimuth_deg: FloatArray | None = None,
    pointing: str = "a nadir camera",
) -> DetectorScore:
    """Precision, recall and localisation per size class, with bins, curves and residuals.

    Altitudes and Sun angles are those of the frames (f,); the Sun's are None where its light is not known.

    Frames whose image the payload judged unfit are left out; so are craters of regions where the catalogue is not
    complete, since a detection there can be neither confirmed nor refuted.
    """
    tally = _tally(detections, expected, matches)
    per_class = tuple(_class_score(tally, (k,), k, CLASS_LABELS[k]) for k in SCORED_CLASSES)
    micro = _class_score(tally, SCORED_CLASSES, -1, "5–30 km")
    return DetectorScore(
        per_class=per_class,
        micro=micro,
        method=(
            f"catalogue projected at rim height from the reference orbit into {pointing}; a detection is true "
            f"within {CENTRE_TOLERANCE_RADII:g} radii and {CENTRE_TOLERANCE_PX:g} px of the centre, one to one"
        ),
        by_altitude_km=_bins(tally, altitude_m / 1e3, ALTITUDE_BIN_KM),
        by_sun_elevation_deg=()
        if sun_elevation_deg is None
        else _bins(tally, sun_elevation_deg, SUN_ELEVATION_BIN_DEG),
        curves=tuple(
            curve
            for curve in (
                *(_curve(tally, (k,), CLASS_LABELS[k]) for k in SCORED_CLASSES),
                _curve(tally, SCORED_CLASSES, "5–30 km"),
            )
            if curve is not None
        ),
        calibration=_calibration(tally),
        residuals=_residuals(detections, expected, tally, sun_azimuth_deg),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Tally:
    """Expected craters and detections that count, each with its class, frame and verdict."""

    crater_class: IntArray
    crater_frame: IntArray
    crater_score: FloatArray
    crater_error_px: FloatArray
    crater_rows: IntArray
    crater_detection: IntArray
    alarm_class: IntArray
    alarm_frame: IntArray
    alarm_score: FloatArray


def _tally(detections: DetectionSamples, expected: ExpectedCraters, matches: Matches) -> _Tally:
    frames = np.arange(len(detections))
    crater_frame = np.repeat(frames, np.diff(expected.offsets))
    detection_frame = np.repeat(frames, np.diff(detections.offsets))
    in_usable = detections.usable[crater_frame] if len(frames) else np.zeros(0, dtype=np.bool_)
    counts = np.isin(expected.size_class, SCORED_CLASSES) & expected.complete & in_usable
    rows = np.flatnonzero(counts)
    partner = matches.detection_of_crater[rows]
    found = partner >= 0
    score = np.where(found, detections.score[partner] if len(detections.score) else 0.0, np.nan)
    error = np.full(len(rows), np.nan)
    at, by = rows[found], partner[found]
    error[found] = np.hypot(detections.u_px[by] - expected.u_px[at], detections.v_px[by] - expected.v_px[at])
    alarms = np.flatnonzero(
        (matches.crater_of_detection < 0)
        & np.isin(detections.size_class, SCORED_CLASSES)
        & (detections.usable[detection_frame] if len(frames) else False)
        & (_complete_share(expected)[detection_frame] > 0.5 if len(frames) else False)
    )
    return _Tally(
        expected.size_class[rows],
        crater_frame[rows],
        score,
        error,
        rows,
        partner,
        detections.size_class[alarms],
        detection_frame[alarms],
        detections.score[alarms],
    )


def _complete_share(expected: ExpectedCraters) -> FloatArray:
    """Return the share of the craters of each frame (f,) that lie where the catalogue is complete.

    For a frame without craters it is 1, or 0 if the catalogue is complete nowhere along the pass.
    """
    total = np.diff(expected.offsets)
    frame = np.repeat(np.arange(len(total)), total)
    complete = np.bincount(frame, weights=expected.complete.astype(np.float64), minlength=len(total))
    return np.where(total > 0, complete / np.maximum(total, 1), float(expected.complete.any()))


def _class_score(tally: _Tally, classes: Sequence[int], number: int, label: str) -> ClassScore:
    craters = np.isin(tally.crater_class, classes)
    found = craters & np.isfinite(tally.crater_error_px)
    alarms = int(np.count_nonzero(np.isin(tally.alarm_class, classes)))
    expected, true = int(np.count_nonzero(craters)), int(np.count_nonzero(found))
    return ClassScore(
        size_class=number,
        label=label,
        expected=expected,
        detected_true=true,
        false_alarms=alarms,
        precision=_share(true, true + alarms),
        recall=_share(true, expected),
        localisation_px=float(np.mean(tally.crater_error_px[found])) if true else float("nan"),
    )


def _bins(tally: _Tally, values: FloatArray, width: float) -> tuple[BinScore, ...]:
    """Scores by bins of a value of the frames (f,)."""
    if len(tally.crater_frame) == 0:
        return ()
    crater_bin = np.floor(values[tally.crater_frame] / width)
    alarm_bin = np.floor(values[tally.alarm_frame] / width)
    found = np.isfinite(tally.crater_error_px)
    bins = []
    for number in np.unique(crater_bin[np.isfinite(crater_bin)]):
        here = crater_bin == number
        true = int(np.count_nonzero(here & found))
        alarms = int(np.count_nonzero(alarm_bin == number))
        bins.append(
            BinScore(
                low=float(number * width),
                high=float((number + 1) * width),
                expected=int(np.count_nonzero(here)),
                precision=_share(true, true + alarms),
                recall=_share(true, int(np.count_nonzero(here))),
                localisation_px=float(np.mean(tally.crater_error_px[here & found])) if true else float("nan"),
            )
        )
    return tuple(bins)


def _curve(tally: _Tally, classes: Sequence[int], label: str) -> PrecisionRecallCurve | None:
    """Precision and recall as the score threshold rises; None where nothing was detected."""
    craters = np.isin(tally.crater_class, classes)
    true = np.sort(tally.crater_score[craters & np.isfinite(tally.crater_error_px)])
    alarms = np.sort(tally.alarm_score[np.isin(tally.alarm_class, classes)])
    expected = int(np.count_nonzero(craters))
    thresholds = np.unique(np.concatenate((true, alarms)))
    if expected == 0 or len(thresholds) == 0:
        return None
    above_true = len(true) - np.searchsorted(true, thresholds)
    above_all = above_true + len(alarms) - np.searchsorted(alarms, thresholds)
    return PrecisionRecallCurve(label, thresholds, above_true / above_all, above_true / expected)


def _calibration(tally: _Tally) -> tuple[CalibrationBin, ...]:
    true = tally.crater_score[np.isfinite(tally.crater_error_px)]
    score = np.concatenate((true, tally.alarm_score))
    is_true = np.concatenate((np.ones(len(true)), np.zeros(len(tally.alarm_score))))
    number = np.clip((score * 10.0).astype(np.int64), 0, 9)
    return tuple(
        CalibrationBin(float(score[number == k].mean()), float(is_true[number == k].mean()), int((number == k).sum()))
        for k in np.unique(number)
    )


def _residuals(
    detections: DetectionSamples, expected: ExpectedCraters, tally: _Tally, sun_azimuth_deg: FloatArray | None
) -> ResidualSeries | None:
    found = np.isfinite(tally.crater_error_px)
    at, by = tally.crater_rows[found], tally.crater_detection[found]
    if len(at) == 0:
        return None
    # Telemetry tells places to 1/64 px: more decimals would only make the report longer.
    return ResidualSeries(
        u_px=np.round(expected.u_px[at], 2),
        v_px=np.round(expected.v_px[at], 2),
        du_px=np.round(detections.u_px[by] - expected.u_px[at], 3),
        dv_px=np.round(detections.v_px[by] - expected.v_px[at], 3),
        # The image's up is north, so an azimuth on the ground is one in the image.
        sun_azimuth_deg=None if sun_azimuth_deg is None else sun_azimuth_deg[tally.crater_frame[found]],
        diameter_px=np.round(expected.diameter_px[at], 2),
    )


def _off_nadir_rad(rotations: FloatArray, position_mcmf_m: FloatArray) -> FloatArray:
    """Return the angle (f,) between boresight and nadir."""
    with np.errstate(invalid="ignore"):
        down = -position_mcmf_m / np.linalg.norm(position_mcmf_m, axis=-1, keepdims=True)
    return np.asarray(np.arccos(np.clip(np.einsum("ni,ni->n", rotations[:, 2], down), -1.0, 1.0)))


def _view_radius_m(camera: PinholeCamera, altitude_m: FloatArray, off_nadir_rad: FloatArray) -> FloatArray:
    """Arcs (f,) on the ground to the furthest corner of the image, or to the horizon where a corner sees the sky.

    A twentieth is added for relief: rims stand up to some km above and below the sphere.
    """
    corner = off_nadir_rad + float(np.arccos(camera.rays(camera.corners_px())[:, 2].min()))
    # Beyond a right angle the sine decreases again: such a corner does not see the ground.
    arc = np.where(corner < np.pi / 2.0, ground_arc_m(corner, altitude_m), np.nan)
    with np.errstate(invalid="ignore"):
        horizon = horizon_arc_m(altitude_m)
    return np.asarray(1.05 * np.where(np.isfinite(arc), arc, horizon) + 5e3)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


GAP_STEPS = 10.0
"""Attitudes of a motion further apart than so many median steps are not interpolated."""


@dataclass(frozen=True, slots=True, eq=False)
class Viewing:
    """Camera and its pointing.

    Attributes
    ----------
    camera
        Camera with the declared lens distortion, if any.
    tilt_rad, yaw_rad
        Mounting from nadir with image up to the north: yaw clockwise, then tilt from the boresight toward image up.
    attitude_utc_ns, q_wxyz
        Times (n,), ascending, and quaternions (n, 4) from ICRF to camera axes of the frames whose attitude is known.
        Other frames use the declared pointing.
    interpolated
        The attitudes are samples of a motion: frames between two of them, at most `GAP_STEPS` median steps apart, have
        the interpolated attitude. Otherwise each attitude is that of one frame.
    """

    camera: PinholeCamera = field(default_factory=PinholeCamera)
    tilt_rad: float = 0.0
    yaw_rad: float = 0.0
    attitude_utc_ns: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    q_wxyz: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    interpolated: bool = False

    def pointed(self, position_mcmf_m: FloatArray) -> FloatArray:
        """Return the rotations (..., 3, 3) from MCMF to the camera in the declared pointing, at positions (..., 3)."""
        return pointed_camera_from_mcmf(position_mcmf_m, self.tilt_rad, self.yaw_rad)

    def known(self, utc_ns: IntArray) -> BoolArray:
        """Return whether the attitude of the frames at `utc_ns` (n,) was telemetered."""
        return self._attitudes(utc_ns)[1]

    def camera_from_mcmf(self, utc_ns: IntArray, position_mcmf_m: FloatArray, mcmf_from_icrf: FloatArray) -> FloatArray:
        """Return the rotations (n, 3, 3) from MCMF to the camera of frames.

        Parameters
        ----------
        utc_ns, position_mcmf_m, mcmf_from_icrf
            Times (n,), positions (n, 3) and rotations (n, 3, 3) of the frames; NaN (unknown) gives NaN.
        """
        rotations = self.pointed(position_mcmf_m)
        q_wxyz, known = self._attitudes(utc_ns)
        if known.any():
            camera_from_icrf = matrix_from_quaternion(q_wxyz[known])
            rotations[known] = camera_from_icrf @ np.swapaxes(mcmf_from_icrf[known], -1, -2)
        return rotations

    def _attitudes(self, utc_ns: IntArray) -> tuple[FloatArray, BoolArray]:
        """Return quaternions (n, 4) of frames and whether they are known."""
        times = self.attitude_utc_ns
        if not len(times):
            return np.zeros((len(utc_ns), 4)), np.zeros(len(utc_ns), dtype=np.bool_)
        after = np.minimum(np.searchsorted(times, utc_ns), len(times) - 1)
        at = np.asarray(times[after] == utc_ns, dtype=np.bool_)
        if not self.interpolated or len(times) < 2:
            return self.q_wxyz[after], at
        before = np.maximum(after - 1, 0)
        step = times[after] - times[before]
        inside = (times[before] < utc_ns) & (utc_ns < times[after])
        inside &= step <= GAP_STEPS * np.median(np.diff(times))
        part = np.where(inside, (utc_ns - times[before]) / np.maximum(step, 1), 1.0)
        return _slerp(self.q_wxyz[before], self.q_wxyz[after], part), at | inside


def _slerp(first: FloatArray, last: FloatArray, part: FloatArray) -> FloatArray:
    """Return unit quaternions (n, 4) a part (n,) of the shorter way from the first to the last ones."""
    cosine = np.sum(first * last, axis=1)
    last = np.where(cosine[:, None] < 0.0, -last, last)
    angle = np.arccos(np.minimum(np.abs(cosine), 1.0))
    small = angle < 1e-6
    sine = np.where(small, 1.0, np.sin(angle))
    weight_first = np.where(small, 1.0 - part, np.sin((1.0 - part) * angle) / sine)
    weight_last = np.where(small, part, np.sin(part * angle) / sine)
    return np.asarray(weight_first[:, None] * first + weight_last[:, None] * last)
