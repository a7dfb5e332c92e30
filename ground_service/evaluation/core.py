"""One pass, evaluated: decoded samples, reference, catalogue and camera in, a `PassReport` out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_service.evaluation.alignment import (
    ReferenceStates,
    angle_from_meridian_deg,
    drift_by_length,
    error_before_reset_m,
    error_budget,
    error_of_places_rtn_m,
    error_of_positions_rtn_m,
    ground_path_m,
    navigation_statistics,
    nees,
    places_of_positions,
    reference_covariance_m2,
    reference_states,
    squared_normalised_errors,
)
from ground_service.evaluation.extras import (
    FILTER,
    snapshot_series,
    sun_angles,
    with_sun,
    with_terrain,
    with_wrong_fixes,
)
from ground_service.evaluation.fixes import IdentificationSamples, MappedCraters, join_pairs, payload_map
from ground_service.evaluation.recall import (
    ExpectedCraters,
    Matches,
    Viewing,
    expected_craters,
    match_detections,
    score_detections,
)
from ground_service.evaluation.smoother import (
    BASELINE_DEGREE,
    SMOOTHED,
    CommandedBurn,
    FilterStates,
    MapOffset,
    StartState,
    propagated_positions,
    smoothed_series,
    smoother_model,
)
from ground_service.evaluation.verdict import (
    Evaluated,
    StartOrbit,
    consistency_remarks,
    requirements,
    verdict_of,
    without_mission,
)
from ground_service.telemetry.samples import DetectionSamples, NavigationSamples, OutcomeSamples
from lunar.arrays import FloatArray, IntArray
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M, NS
from lunar.ephemeris import Ephemeris
from lunar.errors import LunarError
from lunar.frames import Orientation
from lunar.gravity import GravityField
from lunar.timescales import format_utc
from reports.text import count_text
from reports.values import (
    AnchorRead,
    ByteArray,
    CraterMap,
    DetectorScore,
    FrameAccounting,
    GalleryFrame,
    HeadlineFigure,
    HousekeepingParameter,
    NavigationSeries,
    NavigationStatistics,
    PacketAccounting,
    PassEvent,
    PassReport,
    Requirements,
    SettingsComparison,
    TerrainMap,
    TimeSpan,
    TrackSeries,
)

ESTIMATOR_DESCRIPTIONS = {
    "paper": "the paper's visual odometry on a flat Moon, for passes to the north or south",
    "spherical": "the same odometry with exact spherical back-projection, for passes to the north or south",
    "anchored": "navigation filter on catalogued craters",
}

PAPER_TRACK_DEG = 4.1
"""Angle with the meridian beyond which the paper's matching finds no motion: in 30 s it allows 2.5 km to the east and
at least 35 km to the north (paper, section VI-A)."""

GALLERY_FRAMES = 6
NO_BASELINE = "no propagate-only baseline"

WORST_FRAMES = 6
WORST_MINIMUM_EXPECTED = 3
"""A frame with fewer expected craters says nothing about the detector and is no candidate for the worst ones."""

RESETS = ("initialization", "time_gap", "manual_step", "safety_timeout")


PERFECT_START = "propagate-only, perfect start"
PERFECT_START_M = 1.0
"""A start state this close to the reference is equivalent to it, so it gives no separate baseline."""

SAME_INSTANT_NS = 100_000
"""Ticks of the clock and time correlations move a sample by less, and the spacecraft by 0.2 m in that time."""


@dataclass(frozen=True, slots=True, eq=False)
class PassInputs:
    """Inputs of the evaluation of a pass; None or empty if unknown.

    Attributes
    ----------
    orientation, onboard_orientation, gravity, onboard_gravity
        Lunar orientation of the pass and that of the on-board tables, gravity field of the reference and that of the
        on-board filter, as declared.
    refused
        Reasons for models that are None, by name.
    reference_sigma_rtn_m
        Declared 1-sigma error of the reference in radial, transverse and normal.
    map_offset
        Offset of the crater list that the payload uses; None where neither it nor the mission description states one.
    limits
        Limits of the verdict.
    experiment
        Orbit that the pass starts from, of a stated error; None: the best known orbit.
    clock_step_s
        Largest step of the on-board clock since the pass before; None without a time correlation.
    no_mission
        Where the pass refers to no mission description: what is missing and the remedy.
    cpu_percent
        Largest processor time of a step over the cadence.
    build
        Hashes of model and parameters on board.
    """

    pass_id: str
    title: str
    start_utc_ns: int
    stop_utc_ns: int
    packets: PacketAccounting
    viewing: Viewing
    orientation: Orientation | None
    reference: Ephemeris | None
    catalogue: CraterCatalogue | None
    detections: DetectionSamples
    navigation: tuple[NavigationSamples, ...] = ()
    outcomes: tuple[OutcomeSamples, ...] = ()
    start_state: StartState | None = None
    filter_states: FilterStates | None = None
    identifications: IdentificationSamples | None = None
    landmarks: MappedCraters | None = None
    sun_known: bool = False
    burns: tuple[CommandedBurn, ...] = ()
    onboard_orientation: Orientation | None = None
    gravity: GravityField | None = None
    onboard_gravity: GravityField | None = None
    refused: Mapping[str, str] = field(default_factory=dict)
    reference_sigma_rtn_m: tuple[float, float, float] | None = None
    map_offset: MapOffset | None = None
    limits: Requirements = field(default_factory=Requirements)
    experiment: StartOrbit | None = None
    clock_step_s: float | None = None
    no_mission: str = ""
    cpu_percent: float | None = None
    build: str = ""
    frames_expected: int | None = None
    cadence_s: float | None = None
    housekeeping: tuple[HousekeepingParameter, ...] = ()
    events: tuple[PassEvent, ...] = ()
    images: Mapping[int, NDArray[np.uint8]] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)
    data_sources: tuple[str, ...] = ()
    evidence_level: str = ""
    configuration: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    comparison: SettingsComparison | None = None
    scenario_text: str = ""
    generated_for: str = ""
    created_utc: str = ""
    surface: TerrainMap | None = None


def evaluate_pass(inputs: PassInputs) -> PassReport:
    """The report of a pass: navigation against reference and baselines, detector against catalogue, accounting.

    What cannot be evaluated (no reference, no catalogue, no images) is left out with its reason.
    """
    missing: dict[str, str] = {}
    remarks: list[str] = []
    provenance = dict(inputs.provenance)
    reference: TrackSeries | None = None
    navigation: tuple[NavigationSeries, ...] = ()
    refusal = _refusal(inputs)
    if inputs.reference is None or refusal:
        missing["error"] = missing["reference"] = refusal
        track = reference_states(None, None, _sample_times(inputs))
        navigation = tuple(_estimates(inputs, track, np.full(len(track.utc_ns), np.nan)))
    else:
        reference, navigation = _navigation(inputs, inputs.reference, provenance, remarks)
        if not any(one.kind == "baseline" for one in navigation):
            reasons = [one.partition(": ")[2] for one in remarks if one.startswith(NO_BASELINE)]
            missing["baselines"] = reasons[0] if reasons else "no position of them could be computed"
        if len(reference.utc_ns) == 0:
            missing["reference"] = "no frame came down to set against the reference"
    detector, gallery, worst, craters = _detector(inputs, missing, remarks)
    if not inputs.images:
        missing["gallery"] = missing["worst_frames"] = "no images came down with this pass"
    remarks += event_remarks(inputs.events)
    accounting = _frame_accounting(inputs)
    evaluated = Evaluated(
        navigation,
        detector,
        accounting,
        inputs.packets,
        inputs.housekeeping,
        inputs.cpu_percent,
        inputs.experiment,
        _reference_px(inputs, reference),
        inputs.clock_step_s,
    )
    table = requirements(inputs.limits, evaluated)
    remarks += consistency_remarks(table)
    if inputs.no_mission:
        table = without_mission(table, inputs.no_mission)
    verdict, level = verdict_of(table)
    experiment, experiment_level = verdict_of(table, "experiment") if inputs.experiment else ("", "")
    return PassReport(
        title=inputs.title,
        pass_id=inputs.pass_id,
        verdict=verdict,
        verdict_level=level,
        experiment=experiment,
        experiment_level=experiment_level,
        requirements=table,
        **_named(inputs, "generated_for", "created_utc", "evidence_level", "data_sources", "packets"),
        **_named(inputs, "housekeeping", "events", "configuration", "comparison", "scenario_text"),
        headline=_headline(inputs, navigation, detector),
        provenance=provenance,
        span=TimeSpan(inputs.start_utc_ns, inputs.stop_utc_ns, "pass"),
        accounting=accounting,
        reference=reference,
        navigation=navigation,
        imaging_arcs=_imaging_arcs(inputs),
        gaps=_gaps(inputs),
        detector=detector,
        gallery=gallery,
        worst_frames=worst,
        craters=craters,
        terrain=inputs.surface,
        payload_map=payload_map(inputs.landmarks, inputs.identifications, inputs.catalogue),
        truth_ledger=_anchor_reads(inputs.outcomes),
        remarks=tuple(remarks),
        not_available=missing,
    )


def _reference_px(inputs: PassInputs, reference: TrackSeries | None) -> float:
    """Return the declared horizontal error of the reference at the median altitude, in pixels at nadir."""
    sigma = inputs.reference_sigma_rtn_m
    if sigma is None or reference is None or not np.isfinite(reference.altitude_m).any():
        return 0.0
    return inputs.viewing.camera.focal_px * float(np.hypot(*sigma[1:])) / float(np.nanmedian(reference.altitude_m))


_LEARNED = {
    "map_offset": "offset of the crater list used on board, 1 sigma",
    "detection_noise": "noise of detections used on board",
}


def event_remarks(events: Sequence[PassEvent]) -> list[str]:
    """Return remarks on what was learned last on board, and on times of an attitude noisier than declared."""
    newest = {one.name: one for one in sorted(events, key=lambda event: event.utc_ns) if one.name in _LEARNED}
    found = [f"{_LEARNED[name]}: {one.detail}" for name, one in sorted(newest.items(), reverse=True)]
    lasting = False
    for one in sorted(events, key=lambda event: event.utc_ns):
        if one.name == "attitude_degraded":
            found.append(
                f"attitude judged noisier than declared from {format_utc(one.utc_ns)} on ({one.detail}): the payload "
                "used the estimated noise"
            )
        elif one.name == "attitude_restored" and lasting:
            found[-1] += f", until {format_utc(one.utc_ns)}"
        lasting = one.name == "attitude_degraded" or (lasting and one.name != "attitude_restored")
    return found


def summary_of(report: PassReport) -> dict[str, Any]:
    """The figures of a report that a script asks for: frames, packets, detector and navigation by mode."""
    micro = report.detector.micro if report.detector else None
    return {
        "pass_id": report.pass_id,
        "frames": report.accounting.processed if report.accounting else None,
        "packets": report.packets.packets if report.packets else 0,
        "packets_lost": report.packets.missing if report.packets else 0,
        "packets_expected": report.packets.expected if report.packets else 0,
        "detector": {
            "precision": micro.precision if micro else None,
            "recall": micro.recall if micro else None,
            "loc_px": micro.localisation_px if micro else None,
            "per_class": [
                {
                    "class": score.size_class,
                    "expected": score.expected,
                    "precision": score.precision,
                    "recall": score.recall,
                    "loc_px": score.localisation_px,
                }
                for score in (report.detector.per_class if report.detector else ())
            ],
        },
        "navigation": {s.name: _figures(s.statistics) for s in report.navigation if s.kind == "estimate"},
        "smoothed": {s.name: _figures(s.statistics) for s in report.navigation if s.kind == SMOOTHED},
        "baselines": {s.name: _figures(s.statistics) for s in report.navigation if s.kind == "baseline"},
        "verdict": report.verdict,
        "verdict_level": report.verdict_level,
        "experiment": report.experiment,
        "experiment_level": report.experiment_level,
        "requirements": [
            {
                **_named(one, "key", "name", "value", "limit"),
                "relation": "<=" if one.at_most else ">=",
                **_named(one, "unit", "margin", "status", "note", "question"),
            }
            for one in report.requirements
        ],
        "error_budget": {
            s.name: _named(s.error_budget, "observed_rms_m", "reference_rms_m", "estimate_rms_m")
            for s in report.navigation
            if s.error_budget is not None
        },
        "evidence_level": report.evidence_level,
        "data": list(report.data_sources),
        "not_available": dict(report.not_available),
    }


def _named(value: object, *names: str) -> dict[str, Any]:
    return {name: getattr(value, name) for name in names}


def _figures(statistics: NavigationStatistics) -> dict[str, Any]:
    names = ("median_3d_m", "p68_3d_m", "p95_3d_m", "p99_3d_m", "max_3d_m", "drift_percent", "end_of_pass_m")
    return _named(statistics, *names)


def _navigation(
    inputs: PassInputs, reference: Ephemeris, provenance: dict[str, str], remarks: list[str]
) -> tuple[TrackSeries, tuple[NavigationSeries, ...]]:
    times = _sample_times(inputs)
    track = reference_states(reference, inputs.orientation, times)
    path_m = _path(track)
    series = _estimates(inputs, track, path_m)
    series += _smoothed(inputs, track, path_m, provenance, remarks)
    uncovered = int(np.count_nonzero(~track.covered))
    if uncovered:
        remarks.append(
            f"{uncovered} of {len(times)} sample times lie outside the reference ephemeris and have no error"
        )
    if inputs.start_state is not None and inputs.gravity is not None and inputs.orientation is not None:
        try:
            series += _baselines(inputs, inputs.start_state, inputs.gravity, inputs.orientation, track, path_m)
            provenance["gravity of the baseline"] = (
                f"{inputs.gravity.name}, degree {min(BASELINE_DEGREE, inputs.gravity.degree)}, with Earth and Sun"
            )
        except LunarError as error:
            remarks.append(f"{NO_BASELINE}: {error}")
    else:
        reason = inputs.refused.get("gravity") if inputs.start_state is not None else None
        remarks.append(f"{NO_BASELINE}: {reason or 'the pass names no start state'}")
    series = _with_extras(inputs, series, track, path_m)
    return (TrackSeries(times, track.latitude_deg, track.longitude_deg, track.altitude_m), tuple(series))


def _estimates(inputs: PassInputs, track: ReferenceStates, path_m: FloatArray) -> list[NavigationSeries]:
    return [_estimate_series(inputs, one, track, path_m) for one in inputs.navigation if len(one.utc_ns)]


def _with_extras(
    inputs: PassInputs, series: list[NavigationSeries], track: ReferenceStates, path_m: FloatArray
) -> list[NavigationSeries]:
    """Series with the Sun and the wrong fixes, and the snapshot baseline, where there is what they need."""
    if inputs.sun_known:
        sun = sun_angles(track)
        series = [with_sun(one, track, sun) for one in series]
    if inputs.surface is not None:
        series = [with_terrain(one, track, inputs.surface) for one in series]
    if inputs.identifications is None or inputs.catalogue is None:
        return series
    pairs = join_pairs(inputs.identifications, inputs.detections, inputs.catalogue)
    series = [with_wrong_fixes(one, pairs, inputs.viewing, track) for one in series]
    filtered = next((samples for samples in inputs.navigation if samples.estimator == FILTER), None)
    snapshot = None
    if filtered is not None:
        snapshot = snapshot_series(pairs, filtered, inputs.viewing, track, path_m)
    return series if snapshot is None else [*series, snapshot]


def _sample_times(inputs: PassInputs) -> IntArray:
    """Every time at which anything of the pass was sampled, ascending."""
    times = [samples.utc_ns for samples in inputs.navigation] + [inputs.detections.utc_ns]
    return np.unique(np.concatenate(times)).astype(np.int64)


def _path(track: ReferenceStates) -> FloatArray:
    """Ground path to each sample; NaN where the reference does not cover."""
    path = np.full(len(track.utc_ns), np.nan)
    path[track.covered] = ground_path_m(track.at_rows(np.flatnonzero(track.covered)), MOON_RADIUS_M)
    return path


def _estimate_series(
    inputs: PassInputs, samples: NavigationSamples, track: ReferenceStates, path_m: FloatArray
) -> NavigationSeries:
    outcomes = next((one for one in inputs.outcomes if one.estimator == samples.estimator), None)
    rows = np.searchsorted(track.utc_ns, samples.utc_ns)
    error = error_of_places_rtn_m(track.at_rows(rows), samples.latitude_deg, samples.longitude_deg, samples.altitude_m)
    triggers, candidates, reads = _joined(samples, outcomes)
    is_reset = np.array([trigger in RESETS for trigger in triggers], dtype=np.bool_)
    if not triggers:
        is_reset = np.zeros(len(samples.utc_ns), dtype=np.bool_)
    sigma = samples.sigma_rtn_m
    has_sigma = bool(np.isfinite(sigma).any())
    filtered = inputs.filter_states if samples.estimator == FILTER else None
    nees_of_samples, degrees = _consistency(
        samples, filtered, error, reference_covariance_m2(inputs.reference_sigma_rtn_m)
    )
    return NavigationSeries(
        name=samples.estimator,
        kind="estimate",
        utc_ns=samples.utc_ns,
        latitude_deg=samples.latitude_deg,
        longitude_deg=samples.longitude_deg % 360.0,
        altitude_m=samples.altitude_m,
        error_rtn_m=error,
        sigma_rtn_m=sigma if has_sigma else None,
        outcome=samples.outcome,
        reset_trigger=triggers,
        anchor_reads=int(reads[-1]) if len(reads) else 0,
        anchor_reads_after_start=int(reads[-1] - reads[0]) if len(reads) else None,
        statistics=navigation_statistics(error, path_m[rows], is_reset),
        description=ESTIMATOR_DESCRIPTIONS.get(samples.estimator, ""),
        reset_error_m=error_before_reset_m(error, is_reset) if triggers else None,
        matched=samples.matched,
        candidates=candidates,
        nis=samples.nis if bool(np.isfinite(samples.nis).any()) else None,
        nees=nees_of_samples,
        squared_normalised_errors=(
            squared_normalised_errors(error, sigma) if has_sigma and nees_of_samples is None else None
        ),
        nis_dof=degrees,
        time_since_fix_s=_time_since_fix_s(samples),
        error_budget=error_budget(error, inputs.reference_sigma_rtn_m),
        drift_by_length=drift_by_length(error, path_m[rows], is_reset),
        not_applicable=_not_applicable(samples.estimator, track.at_rows(rows)),
    )


def _not_applicable(estimator: str, track: ReferenceStates) -> str:
    """Return which assumption of an estimator a track does not meet, "" if it meets all."""
    angle = angle_from_meridian_deg(track) if estimator in ("paper", "spherical") else 0.0
    if not angle > PAPER_TRACK_DEG:
        return ""
    return f"{estimator} assumes a pass to the north or south, this track runs {angle:.0f}° from the meridian"


def _consistency(
    samples: NavigationSamples, filtered: FilterStates | None, error_rtn_m: FloatArray, reference_covariance: FloatArray
) -> tuple[FloatArray | None, IntArray | None]:
    """Return the NEES of the position (n,; None without a covariance) and the degrees of freedom of each NIS.

    The covariance of the reference (3, 3), R/T/N, is added to that of the estimate.

    A NIS has two degrees for every crater that a fix used: as downlinked, or derived from the number of craters.
    """
    known = np.isfinite(samples.nis)
    degrees = np.where(known, 2 * samples.matched, 0).astype(np.int64) if known.any() else None
    if filtered is None or not len(filtered):
        return None, degrees
    at = np.minimum(np.searchsorted(filtered.utc_ns, samples.utc_ns), len(filtered) - 1)
    same = filtered.utc_ns[at] == samples.utc_ns
    if not same.any():
        return None, degrees
    covariance = np.where(same[:, None, None], filtered.position_covariance_rtn_m2[at], np.nan)
    if degrees is not None and filtered.innovation_degrees is not None:
        reported = filtered.innovation_degrees[at]
        degrees = np.where(known & same & (reported >= 0), reported, degrees).astype(np.int64)
    return nees(error_rtn_m, covariance + reference_covariance), degrees


def _smoothed(
    inputs: PassInputs, track: ReferenceStates, path_m: FloatArray, provenance: dict[str, str], remarks: list[str]
) -> list[NavigationSeries]:
    """Return the filter's orbit smoothed on the ground, if complete states and a reference are available.

    The gravity field is that of the filter and not that of the truth, so that a common error remains visible.
    """
    filtered = inputs.filter_states
    if filtered is None or not len(filtered):
        return []
    gravity, onboard = inputs.onboard_gravity, inputs.onboard_orientation
    if gravity is None or onboard is None or inputs.orientation is None:
        reasons = (inputs.refused.get(name) for name in ("onboard_gravity", "onboard_orientation"))
        remarks.append(f"no smoothed orbit: {next(filter(None, reasons), 'no field or orientation on board is given')}")
        return []
    rows = np.minimum(np.searchsorted(track.utc_ns, filtered.utc_ns), len(track.utc_ns) - 1)
    kept = track.covered[rows] & (track.utc_ns[rows] == filtered.utc_ns)
    filtered, rows = filtered.select(kept).in_icrf(inputs.orientation, onboard), rows[kept]
    model = smoother_model(gravity, inputs.orientation, inputs.burns, inputs.map_offset)
    series = smoothed_series(
        filtered, track.at_rows(rows), path_m[rows], model, reference_covariance_m2(inputs.reference_sigma_rtn_m)
    )
    if series is None:
        return []
    provenance["gravity of the smoother"] = f"{gravity.name}, degree {model.forces.degree}, with Earth and Sun"
    return [replace(series, error_budget=error_budget(series.error_rtn_m, inputs.reference_sigma_rtn_m))]


def _joined(
    samples: NavigationSamples, outcomes: OutcomeSamples | None
) -> tuple[tuple[str, ...], IntArray | None, IntArray]:
    """Reset triggers and candidate pairs of the estimator's outcomes at the frames of its states, and all its reads."""
    if outcomes is None or len(outcomes.frame_number) == 0:
        return (), None, np.zeros(0, dtype=np.int64)
    order = np.argsort(outcomes.frame_number, kind="stable")
    numbers = outcomes.frame_number[order]
    at = np.minimum(np.searchsorted(numbers, samples.frame_number), len(numbers) - 1)
    same = numbers[at] == samples.frame_number
    rows = order[at]
    triggers = tuple(outcomes.reset_trigger[row] if hit else "none" for row, hit in zip(rows, same, strict=True))
    candidates = np.where(same, outcomes.candidate_pairs[rows], 0).astype(np.int64)
    return triggers, candidates, outcomes.anchor_reads


def _time_since_fix_s(samples: NavigationSamples) -> FloatArray | None:
    fixed = np.array([outcome == "fixed" for outcome in samples.outcome], dtype=np.bool_)
    if not fixed.any():
        return None
    last = np.maximum.accumulate(np.where(fixed, np.arange(len(fixed)), -1))
    since = (samples.utc_ns - samples.utc_ns[np.maximum(last, 0)]) / NS
    return np.where(last >= 0, since, np.nan)


def _baselines(
    inputs: PassInputs,
    start: StartState,
    gravity: GravityField,
    orientation: Orientation,
    track: ReferenceStates,
    path_m: FloatArray,
) -> list[NavigationSeries]:
    rows = np.flatnonzero(track.covered & (track.utc_ns >= start.utc_ns - SAME_INSTANT_NS))
    if len(rows) == 0:
        return []
    here = track.at_rows(rows)
    series = []
    runs = [("propagate-only", start, gravity, min(BASELINE_DEGREE, gravity.degree))]
    other = inputs.onboard_gravity
    if other is not None and other.name != gravity.name:
        runs.append((f"propagate-only, {other.name}", start, other, min(BASELINE_DEGREE, other.degree)))
    perfect = StartState(int(here.utc_ns[0]), here.position_icrf_m[0], here.velocity_icrf_m_s[0])
    if _apart_m(start, perfect) > PERFECT_START_M:
        runs.append((PERFECT_START, perfect, gravity, runs[0][3]))
    for name, begin, field_used, degree in (*runs, ("Kepler", start, gravity, 0)):
        since = np.maximum(here.utc_ns, begin.utc_ns)
        position = propagated_positions(begin, since, field_used, degree, orientation, third_bodies=degree > 0)
        origin = "state of the reference" if begin is perfect else "start state of the filter"
        text = (
            f"{origin} propagated with {field_used.name} to degree {degree}, Earth and Sun"
            if degree
            else f"{origin} on its two-body orbit"
        )
        error = error_of_positions_rtn_m(here, position)
        latitude, longitude, altitude = places_of_positions(here, position)
        never = np.zeros(len(rows), dtype=np.bool_)
        series.append(
            NavigationSeries(
                name=name,
                kind="baseline",
                utc_ns=here.utc_ns,
                latitude_deg=latitude,
                longitude_deg=longitude,
                altitude_m=altitude,
                error_rtn_m=error,
                statistics=navigation_statistics(error, path_m[rows], never),
                description=text,
                drift_by_length=drift_by_length(error, path_m[rows], never),
            )
        )
    return series


def _apart_m(start: StartState, other: StartState) -> float:
    """Distance of two states of the same instant; not a number (never "apart") for states of different instants."""
    if abs(start.utc_ns - other.utc_ns) > SAME_INSTANT_NS:
        return float("nan")
    return float(np.linalg.norm(np.asarray(start.position_icrf_m) - other.position_icrf_m))


def _detector(
    inputs: PassInputs, missing: dict[str, str], remarks: list[str]
) -> tuple[DetectorScore | None, tuple[GalleryFrame, ...], tuple[GalleryFrame, ...], CraterMap | None]:
    detections = inputs.detections
    if len(detections) == 0:
        missing["detector"] = missing["craters"] = "no detections came down"
        return None, (), (), None
    if inputs.catalogue is None or inputs.reference is None or inputs.orientation is None:
        reason = "it needs a crater catalogue and a reference ephemeris"
        if inputs.orientation is None:
            reason = _refusal(inputs)
        missing["detector"] = missing["craters"] = reason
        return None, (), (), None
    unknown = np.count_nonzero(~np.isfinite(inputs.catalogue.rim_height_m))
    if unknown:
        remarks.append(f"rim heights unknown for {unknown} of {len(inputs.catalogue)} craters: they are not scored")
    if "camera sizes" in inputs.refused:
        remarks.append(inputs.refused["camera sizes"])
    track = reference_states(inputs.reference, inputs.orientation, detections.utc_ns)
    viewing = inputs.viewing
    rotations = viewing.camera_from_mcmf(detections.utc_ns, track.position_mcmf_m, track.mcmf_from_icrf)
    expected = expected_craters(inputs.catalogue, viewing.camera, track.position_mcmf_m, rotations)
    matches = match_detections(detections, expected)
    sun = sun_angles(track) if inputs.sun_known else None
    score = score_detections(
        detections,
        expected,
        matches,
        track.altitude_m,
        None if sun is None else sun.elevation_deg,
        None if sun is None else sun.azimuth_deg,
        pointing=_pointing_text(inputs, remarks),
    )
    if score.micro is None or score.micro.expected == 0:
        missing["recall"] = (
            "no usable image came down"
            if not detections.usable.any()
            else "rim heights unknown"
            if unknown == len(inputs.catalogue) > 0
            else "the crater catalogue has no complete crater of 5 to 30 km in view"
        )
    chosen, worst = _choose_frames(inputs, expected, matches)
    unseen = [str(number) for number in detections.frame_number[worst] if int(number) not in inputs.images]
    if unseen:
        missing["worst_frames"] = (
            f"{len(unseen)} of the {len(worst)} frames with the lowest recall came down without their images: "
            f"{', '.join(unseen)}"
        )
    return (
        score,
        _frames_shown(inputs, expected, matches, chosen),
        _frames_shown(inputs, expected, matches, worst),
        _crater_map(inputs.catalogue, expected, matches),
    )


def _refusal(inputs: PassInputs) -> str:
    """Return why no comparison with a reference is possible; empty if it is."""
    if inputs.reference is None:
        return "no reference ephemeris covers this pass"
    if inputs.orientation is None:
        return inputs.refused.get("orientation", "no lunar orientation is given")
    return ""


def _pointing_text(inputs: PassInputs, remarks: list[str]) -> str:
    """Return a text on the camera pointing; add a remark for unknown attitudes."""
    known = int(np.count_nonzero(inputs.viewing.known(inputs.detections.utc_ns)))
    total = len(inputs.detections)
    if known == total:
        return "the camera in its telemetered attitude"
    if "camera" in inputs.refused:
        remarks.append(inputs.refused["camera"])
    if known:
        remarks.append(f"the attitude of {total - known} of {total} frames is unknown; the declared attitude is used")
        return "the camera in its telemetered attitude, if available"
    return "the camera in its declared attitude" if "camera" not in inputs.refused else "a nadir camera"


def _choose_frames(inputs: PassInputs, expected: ExpectedCraters, matches: Matches) -> tuple[list[int], list[int]]:
    """Rows of frames for the galleries: some spread over the pass, and those where the detector did worst."""
    detections = inputs.detections
    with_image = np.array([int(n) in inputs.images for n in detections.frame_number], dtype=np.bool_)
    rows = np.flatnonzero(with_image)
    if len(rows) == 0:
        return [], []
    spread = rows[np.unique(np.linspace(0, len(rows) - 1, min(GALLERY_FRAMES, len(rows))).round().astype(np.int64))]
    owner = np.repeat(np.arange(len(detections)), np.diff(expected.offsets))
    scored = np.isin(expected.size_class, (0, 1, 2)) & expected.complete
    total = np.bincount(owner[scored], minlength=len(detections))
    hit = np.bincount(owner[scored & (matches.detection_of_crater >= 0)], minlength=len(detections))
    # Every frame is a candidate, not only the few frames with a received image.
    every = np.flatnonzero(detections.usable)
    candidates = every[(total[every] >= WORST_MINIMUM_EXPECTED) & (hit[every] < total[every])]
    recall = hit[candidates] / np.maximum(total[candidates], 1)
    worst = candidates[np.lexsort((candidates, recall))][:WORST_FRAMES]
    return [int(row) for row in spread], sorted(int(row) for row in worst)


def _frames_shown(
    inputs: PassInputs, expected: ExpectedCraters, matches: Matches, rows: Sequence[int]
) -> tuple[GalleryFrame, ...]:
    """Return those of these frames whose images were received."""
    numbers = inputs.detections.frame_number
    return tuple(
        gallery_frame(inputs.detections, expected, matches, row, inputs.images[int(numbers[row])])
        for row in rows
        if int(numbers[row]) in inputs.images
    )


def gallery_frame(
    detections: DetectionSamples, expected: ExpectedCraters, matches: Matches, row: int, image: ByteArray
) -> GalleryFrame:
    """Return the image of a frame with its detections and its expected craters of 5 to 30 km."""
    d = slice(int(detections.offsets[row]), int(detections.offsets[row + 1]))
    c = np.arange(expected.offsets[row], expected.offsets[row + 1])
    c = c[np.isin(expected.size_class[c], (0, 1, 2))]
    found = matches.detection_of_crater[c] >= 0
    return GalleryFrame(
        frame_number=int(detections.frame_number[row]),
        utc_ns=int(detections.utc_ns[row]),
        image=image,
        detection_u_px=detections.u_px[d],
        detection_v_px=detections.v_px[d],
        detection_diameter_px=detections.diameter_px[d],
        detection_class=detections.size_class[d],
        catalogue_u_px=expected.u_px[c],
        catalogue_v_px=expected.v_px[c],
        catalogue_diameter_px=expected.diameter_px[c],
        catalogue_class=expected.size_class[c],
        detection_matched=matches.crater_of_detection[d] >= 0,
        catalogue_matched=found,
        caption=f"{int(found.sum())} of {len(c)} craters of 5–30 km detected",
    )


def _crater_map(catalogue: CraterCatalogue, expected: ExpectedCraters, matches: Matches) -> CraterMap:
    scored = np.isin(expected.size_class, (0, 1, 2))
    index, inverse = np.unique(expected.index[scored], return_inverse=True)
    times = np.bincount(inverse, minlength=len(index))
    found = np.bincount(inverse[matches.detection_of_crater[scored] >= 0], minlength=len(index))
    return CraterMap(
        latitude_deg=np.degrees(catalogue.latitude_rad[index]),
        longitude_deg=np.degrees(catalogue.longitude_rad[index]) % 360.0,
        diameter_m=catalogue.diameter_m[index],
        expected=times.astype(np.int64),
        detected=found.astype(np.int64),
        source=catalogue.source,
    )


def _frame_accounting(inputs: PassInputs) -> FrameAccounting:
    detections = inputs.detections
    quality: dict[str, int] = {}
    for name in detections.quality:
        quality[name] = quality.get(name, 0) + 1
    processed = int(np.count_nonzero(detections.usable))
    navigated = max((len(np.unique(s.frame_number)) for s in inputs.navigation), default=None)
    return FrameAccounting(
        expected=inputs.frames_expected,
        acquired=len(detections),
        processed=processed,
        with_detections=int(np.count_nonzero(np.diff(detections.offsets) > 0)),
        navigated=navigated,
        bad_image=len(detections) - processed,
        quality=quality,
    )


def _imaging_arcs(inputs: PassInputs) -> tuple[TimeSpan, ...]:
    """Stretches in which downlinked frames follow one another without a silence, their last frame included."""
    times = inputs.detections.utc_ns
    if len(times) == 0:
        return ()
    edges = [int(times[0]), *(t for gap in _gaps(inputs) for t in (gap.start_utc_ns, gap.stop_utc_ns)), int(times[-1])]
    return tuple(TimeSpan(a, b + 1, "frames") for a, b in zip(edges[::2], edges[1::2], strict=True))


def _gaps(inputs: PassInputs) -> tuple[TimeSpan, ...]:
    """Silences of more than one and a half cadences between downlinked frames."""
    times = inputs.detections.utc_ns
    if inputs.cadence_s is None or len(times) < 2:
        return ()
    limit = 1.5 * inputs.cadence_s * NS
    return tuple(
        TimeSpan(int(times[i]), int(times[i + 1]), "no frames") for i in np.flatnonzero(np.diff(times) > limit)
    )


def _anchor_reads(outcomes: tuple[OutcomeSamples, ...]) -> tuple[AnchorRead, ...]:
    """Every frame at which an estimator's count of anchor reads rose, in time order."""
    reads = []
    for samples in outcomes:
        rose = np.flatnonzero(np.diff(samples.anchor_reads, prepend=0) > 0)
        reads += [
            AnchorRead(
                samples.estimator, int(samples.utc_ns[i]), samples.reset_trigger[i], int(samples.frame_number[i])
            )
            for i in rose
        ]
    return tuple(sorted(reads, key=lambda read: (read.utc_ns, read.estimator)))


def _headline(
    inputs: PassInputs, navigation: tuple[NavigationSeries, ...], detector: DetectorScore | None
) -> tuple[HeadlineFigure, ...]:
    """Return the five headline figures; accuracy is that of the declared estimator, not of the best one."""
    name = inputs.limits.estimator
    own = next((s for s in navigation if s.kind == "estimate" and s.name == name and len(s.utc_ns) > 1), None)
    only = next((s for s in navigation if s.name == "propagate-only"), None)
    micro = detector.micro if detector else None
    packets = inputs.packets
    absent = "no estimator is declared" if name is None else f"{name} is not known"
    return (
        HeadlineFigure(
            "Median position error",
            own.statistics.median_3d_m if own else None,
            "m",
            f"{own.name}; {_below(own.statistics.p95_3d_m)}" if own else absent,
        ),
        HeadlineFigure(
            "Propagation alone, same start",
            only.statistics.median_3d_m if only else None,
            "m",
            _below(only.statistics.p95_3d_m)
            if only
            else "no start state"
            if inputs.start_state is None
            else "not computed",
        ),
        HeadlineFigure(
            "Drift",
            own.statistics.drift_percent if own else None,
            "% of path",
            f"{own.name}, horizontal" if own else absent,
        ),
        HeadlineFigure(
            "Craters detected",
            100.0 * micro.recall if micro and np.isfinite(micro.recall) else None,
            "%",
            f"precision {100.0 * micro.precision:.0f} %, centre {micro.localisation_px:.2f} px"
            if micro
            else "not evaluated",
        ),
        HeadlineFigure("Packets missing", packets.missing, "", f"of {count_text(packets.expected)} expected"),
    )


def _below(p95_m: float) -> str:
    return f"95 % below {_length(p95_m)}" if np.isfinite(p95_m) else "no error is known"


def _length(value_m: float) -> str:
    return f"{value_m / 1e3:.1f} km" if value_m >= 9_950.0 else f"{value_m:.0f} m"
