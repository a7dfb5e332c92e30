"""Values of a report: frozen values of plain arrays, numbers and text.

Conventions: times are ``utc_ns`` (int64, POSIX nanoseconds), angles are degrees, lengths metres, image
coordinates pixels with pixel centres at integers, speeds metres per second. Vectors in R/T/N are radial,
transverse (along-track) and normal (cross-track) of the reference orbit. NaN means "no value here". Where a
field is ``None`` or empty its section says that it is not available, with the reason from
``PassReport.not_available`` when one is given there.

A report reads no clock: the same value gives the same octets.
"""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Interval
from numpy.typing import NDArray

from reports.arrays import BoolArray, FloatArray, IntArray

ByteArray = NDArray[np.uint8]

ODOMETRY_OUTCOMES = ("anchored", "multi", "single", "predicted", "missed", "rejected")
FIX_OUTCOMES = ("fixed", "coasted", "refused", "no_image")
RESET_TRIGGERS = ("none", "initialization", "time_gap", "manual_step", "safety_timeout")

Positive = Annotated[float, Gt(0.0)]
NotNegative = Annotated[float, Ge(0.0)]
Percent = Annotated[float, Interval(ge=0.0, le=100.0)]
Share = Annotated[float, Interval(ge=0.0, le=1.0)]
Estimator = Literal["paper", "spherical", "anchored"]


@dataclass(frozen=True, slots=True)
class Requirements:
    """Limits of the verdict; a requirement without a limit is shown without judgement.

    A negative limit of a scenario is not stated, except `temperature_min_c`; its estimator is the filter if it is used,
    otherwise the first one, where none is stated.

    Attributes
    ----------
    estimator
        Name of the estimator whose accuracy is judged.
    better_than
        Names of baselines whose median error must be larger than that of the estimator.
    consistency_inside_percent
        Share of the passes of a consistent filter whose mean NEES or NIS is inside the bounds for the number of its
        independent draws. A mean above the upper bound is a failure.
    """

    estimator: Estimator | None = None
    median_error_m: Positive | None = None
    p95_error_m: Positive | None = None
    better_than: tuple[str, ...] | None = None
    consistency_inside_percent: Percent | None = None
    packets_percent: Percent | None = None
    frames_percent: Percent | None = None
    images_percent: Percent | None = None
    recall: Share | None = None
    precision: Share | None = None
    anchor_reads: NotNegative | None = None
    resets: NotNegative | None = None
    cpu_percent: Percent | None = None
    memory_mib: Positive | None = None
    storage_percent: Percent | None = None
    temperature_max_c: float | None = None
    temperature_min_c: float | None = None
    convergence_s: Positive | None = None
    drift_percent: Positive | None = None
    offset_px: Positive | None = None
    clock_step_s: Positive | None = None


@dataclass(frozen=True, slots=True)
class HeadlineFigure:
    """One of the five numbers of the first page.

    ``value`` is a number (printed with three significant digits), text (printed as it is) or None ("not
    available"). ``evidence_level`` overrides the level of the report for a figure with other evidence.
    """

    label: str
    value: float | int | str | None
    unit: str = ""
    note: str = ""
    evidence_level: str = ""


@dataclass(frozen=True, slots=True)
class Requirement:
    """Row of the verdict table.

    ``value`` must be at most (``at_most``) or at least ``limit``. ``status`` is one of `REQUIREMENT_STATUSES`. An
    unknown value or limit is None and never "met"; a requirement without judgement is "not judged". ``question`` is
    "operations" (is the payload healthy and within its requirements) or "experiment" (how well does it navigate alone).
    """

    key: str
    name: str
    unit: str
    value: float | None
    limit: float | None
    at_most: bool
    status: str
    note: str = ""
    question: str = "operations"

    @property
    def margin(self) -> float | None:
        """Distance of the value from the limit; negative beyond it, None if either is unknown."""
        if self.value is None or self.limit is None:
            return None
        return self.limit - self.value if self.at_most else self.value - self.limit


@dataclass(frozen=True, slots=True)
class ErrorBudget:
    """Root mean square of the 3-D error of an estimate, split: observed² = estimate² + reference².

    ``reference_rms_m`` is what the mission description declares; ``estimate_rms_m`` is NaN where the observed error is
    smaller than that.
    """

    observed_rms_m: float
    reference_rms_m: float
    estimate_rms_m: float


@dataclass(frozen=True, slots=True)
class FrameAccounting:
    """Accounting of the frames of a pass; None if a count is unknown."""

    expected: int | None = None
    acquired: int | None = None
    lit: int | None = None
    processed: int | None = None
    with_detections: int | None = None
    navigated: int | None = None
    bad_image: int | None = None
    downlinked: int | None = None
    quality: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ApidAccounting:
    """Packets of one application process; None where a count was not computed.

    ``lost`` are packets missing between received packets, by sequence count. ``lost_at_edges`` are packets missing
    before the first and after the last received packet, by the planned frames.
    """

    name: str
    packets: int
    lost: int = 0
    duplicates: int | None = None
    conflicts: int = 0
    crc_errors: int | None = None
    lost_at_edges: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CompletenessSeries:
    """Packets expected and received in each interval of the pass: edges (n+1,), counts (n,)."""

    edges_utc_ns: IntArray
    expected: IntArray
    received: IntArray


@dataclass(frozen=True, slots=True)
class ReceptionQuality:
    """Link quality of one file that a station received; None where unknown.

    `station` and `source` (of the link settings) are empty if they are not stated. `bit_error_rate` is that of the
    codewords that could be corrected and of the markers, a lower bound. `lock_losses` counts frames that do not follow
    the previous one at the usual distance. `octets_other` belong to no frame and to no record of the station.
    """

    station: str
    source: str
    frames: int
    frames_good: int
    symbols_corrected: int
    bit_error_rate: float | None
    lock_losses: int
    octets: int
    octets_other: int
    first_utc_ns: int | None = None
    last_utc_ns: int | None = None


@dataclass(frozen=True, slots=True)
class PacketAccounting:
    """Octet accounting of the downlink of a pass; None where a count was not computed.

    ``lost`` and ``lost_at_edges`` are the sums over application processes. ``receptions`` are the files with frames
    that may contain packets of the pass.
    """

    packets: int
    lost: int = 0
    duplicates: int | None = None
    conflicts: int = 0
    crc_errors: int | None = None
    octets_skipped: int | None = None
    frames: int | None = None
    frames_bad: int | None = None
    symbols_corrected: int | None = None
    lost_at_edges: int | None = None
    octets: int | None = None
    receptions: tuple[ReceptionQuality, ...] = ()
    by_apid: Mapping[int, ApidAccounting] = field(default_factory=dict)
    completeness: CompletenessSeries | None = None

    @property
    def missing(self) -> int:
        """Packets known to be missing, within the pass and at its edges."""
        return self.lost + (self.lost_at_edges or 0)

    @property
    def expected(self) -> int:
        """Received packets plus packets known to be missing."""
        return self.packets + self.missing


@dataclass(frozen=True, slots=True)
class TimeSpan:
    """A half-open interval of UTC."""

    start_utc_ns: int
    stop_utc_ns: int
    label: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class TrackSeries:
    """A track over the Moon: mean-Earth latitude and longitude in degrees, altitude in metres."""

    utc_ns: IntArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    altitude_m: FloatArray


@dataclass(frozen=True, slots=True)
class NavigationStatistics:
    """Figures of one navigation solution over the pass; NaN where there is none."""

    median_3d_m: float = float("nan")
    p68_3d_m: float = float("nan")
    p95_3d_m: float = float("nan")
    p99_3d_m: float = float("nan")
    max_3d_m: float = float("nan")
    drift_percent: float = float("nan")
    end_of_pass_m: float = float("nan")
    path_length_m: float = float("nan")


@dataclass(frozen=True, slots=True)
class DriftSample:
    """Relative drift over sub-tracks of one length."""

    path_length_m: float
    median_percent: float
    p95_percent: float
    samples: int


@dataclass(frozen=True, slots=True, eq=False)
class NavigationSeries:
    """Errors of one estimate or baseline relative to the reference, sampled at ``utc_ns`` (n,).

    ``kind`` is "estimate" (flown on board), "smoothed" (an estimate improved on the ground with later data) or
    "baseline" (computed on the ground for comparison).
    ``error_rtn_m`` and ``sigma_rtn_m`` are (n, 3), estimate minus reference. ``outcome`` and
    ``reset_trigger`` name the outcome of the matcher at each sample (see `ODOMETRY_OUTCOMES`, `FIX_OUTCOMES`,
    `RESET_TRIGGERS`); empty tuples if the solution has none. ``error_rtn_m`` at a reset is the
    error after it; ``reset_error_m`` (n,) holds the horizontal error at the instant before, NaN elsewhere.
    The optional arrays (n,) are quantities on which the error may depend; ``nees`` (of the position under its full
    covariance) has three degrees of freedom, ``nis`` ``nis_dof``. ``squared_normalised_errors`` replaces ``nees`` if
    only standard deviations are known: squared errors over variances, summed over the axes. ``not_applicable`` says
    which assumption of the estimator the pass does not meet; empty if all are met.
    """

    name: str
    kind: str
    utc_ns: IntArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    altitude_m: FloatArray
    error_rtn_m: FloatArray
    sigma_rtn_m: FloatArray | None = None
    outcome: tuple[str, ...] = ()
    reset_trigger: tuple[str, ...] = ()
    anchor_reads: int = 0
    anchor_reads_after_start: int | None = None
    statistics: NavigationStatistics = field(default_factory=NavigationStatistics)
    description: str = ""
    reset_error_m: FloatArray | None = None
    matched: IntArray | None = None
    candidates: IntArray | None = None
    nis: FloatArray | None = None
    nis_dof: IntArray | None = None
    nees: FloatArray | None = None
    squared_normalised_errors: FloatArray | None = None
    sun_elevation_deg: FloatArray | None = None
    time_since_fix_s: FloatArray | None = None
    terrain: tuple[str, ...] = ()
    wrong_fixes: int | None = None
    error_budget: ErrorBudget | None = None
    drift_by_length: tuple[DriftSample, ...] = ()
    not_applicable: str = ""


@dataclass(frozen=True, slots=True)
class ClassScore:
    """Detection against the catalogue for one size class (or all, size_class = -1)."""

    size_class: int
    label: str
    expected: int
    detected_true: int
    false_alarms: int
    precision: float
    recall: float
    localisation_px: float


@dataclass(frozen=True, slots=True)
class BinScore:
    """Precision and recall in one bin of a quantity such as altitude or Sun elevation."""

    low: float
    high: float
    expected: int
    precision: float
    recall: float
    localisation_px: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class PrecisionRecallCurve:
    """Precision and recall against the score threshold for one class (or all)."""

    label: str
    threshold: FloatArray
    precision: FloatArray
    recall: FloatArray


@dataclass(frozen=True, slots=True)
class CalibrationBin:
    """Detections whose score lies in a bin: mean score and the share of them that are true."""

    mean_score: float
    fraction_true: float
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class ResidualSeries:
    """Detected minus expected centre of matched craters: arrays (n,) in pixels; Sun azimuth in the image,
    degrees clockwise from up."""

    u_px: FloatArray
    v_px: FloatArray
    du_px: FloatArray
    dv_px: FloatArray
    sun_azimuth_deg: FloatArray | None = None
    diameter_px: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class DetectorScore:
    """The detector judged by the ground: detections against catalogue, reference orbit and camera."""

    per_class: tuple[ClassScore, ...] = ()
    micro: ClassScore | None = None
    method: str = ""
    by_altitude_km: tuple[BinScore, ...] = ()
    by_sun_elevation_deg: tuple[BinScore, ...] = ()
    curves: tuple[PrecisionRecallCurve, ...] = ()
    calibration: tuple[CalibrationBin, ...] = ()
    residuals: ResidualSeries | None = None


@dataclass(frozen=True, slots=True, eq=False)
class GalleryFrame:
    """One image with what was detected and what the catalogue says should be there.

    ``image`` is uint8 (H, W) or (H, W, 3). Detection arrays are (n,), catalogue arrays (m,).
    ``detection_matched`` (n,) and ``catalogue_matched`` (m,) are True where the two agree; None where nobody
    matched them.
    """

    frame_number: int
    utc_ns: int | None
    image: ByteArray
    detection_u_px: FloatArray
    detection_v_px: FloatArray
    detection_diameter_px: FloatArray
    detection_class: IntArray
    catalogue_u_px: FloatArray
    catalogue_v_px: FloatArray
    catalogue_diameter_px: FloatArray
    catalogue_class: IntArray
    detection_matched: BoolArray | None = None
    catalogue_matched: BoolArray | None = None
    caption: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class CraterMap:
    """Craters around the ground track, arrays (n,): how often each should have been and was detected."""

    latitude_deg: FloatArray
    longitude_deg: FloatArray
    diameter_m: FloatArray
    expected: IntArray | None = None
    detected: IntArray | None = None
    source: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class PayloadMap:
    """Crater map made by the payload, compared with the ground's catalogue.

    ``mapped_again`` were mapped on a later pass too, ``used`` served in fixes, in ``pairs`` of ``pairs_of_all``
    detections. ``catalogued`` are known to the catalogue: ``offset_m`` and ``sigma_m`` (k, 2) are landmark minus
    catalogue, east and north, and what the payload claims; ``median_offset_m`` is east, north, up. The mean of the
    squares of offset over claim is ``normalised_square``, 1 where the claims hold.
    """

    mapped: int
    mapped_again: int
    used: int
    pairs: int
    pairs_of_all: int
    catalogued: int
    offset_m: FloatArray
    sigma_m: FloatArray
    median_offset_m: tuple[float, float, float]
    normalised_square: float
    source: str = ""

    @property
    def horizontal_rms_m(self) -> float:
        """Root mean square of the horizontal distance from the catalogue; NaN where that knows none."""
        if not len(self.offset_m):
            return float("nan")
        return float(np.sqrt(np.mean(np.sum(self.offset_m**2, axis=1))))


@dataclass(frozen=True, slots=True, eq=False)
class TerrainMap:
    """A gray shaded relief (H, W) uint8, row 0 north, as the ground of the track map; bounds in degrees, east
    longitudes."""

    image: ByteArray
    west_deg: float
    east_deg: float
    south_deg: float
    north_deg: float
    source: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class HousekeepingParameter:
    """One engineering parameter over time: ``utc_ns`` and ``values`` (n,)."""

    name: str
    unit: str
    utc_ns: IntArray
    values: FloatArray


@dataclass(frozen=True, slots=True)
class PassEvent:
    """An event report of the payload."""

    utc_ns: int
    severity: str
    name: str
    detail: str = ""
    correlation_id: int = 0


@dataclass(frozen=True, slots=True)
class SettingsComparison:
    """Settings that differ from those of the previous pass: dotted name, value before and now (None: not stated)."""

    previous_pass: str
    changes: tuple[tuple[str, Any, Any], ...]


@dataclass(frozen=True, slots=True)
class AnchorRead:
    """One use of the anchor ephemeris (truth, or what the ground uploaded as truth) by an on-board
    estimator."""

    estimator: str
    utc_ns: int
    trigger: str
    frame_number: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ReportCommon:
    """Content that every report has.

    ``verdict_level`` is a key of `reports.document.VERDICT_ROLES` or "" and sets the colour of the
    rule next to the verdict.
    ``evidence_level`` is the evidence level of the accuracy figures. ``not_available`` gives the reason why a section
    is missing; its keys are field names of the report.
    """

    title: str
    _: KW_ONLY
    verdict: str = ""
    verdict_level: str = ""
    generated_for: str = ""
    created_utc: str = ""
    evidence_level: str = ""
    headline: tuple[HeadlineFigure, ...] = ()
    provenance: Mapping[str, str] = field(default_factory=dict)
    data_sources: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    not_available: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class PassReport(ReportCommon):
    """Content of the report of one pass.

    ``verdict`` is the sentence on the table of ``requirements`` for operations, ``experiment`` that for the experiment;
    empty: the pass belongs to none. ``configuration`` maps a group ("camera") to its settings.
    """

    pass_id: str
    experiment: str = ""
    experiment_level: str = ""
    requirements: tuple[Requirement, ...] = ()
    span: TimeSpan | None = None
    accounting: FrameAccounting | None = None
    packets: PacketAccounting | None = None
    reference: TrackSeries | None = None
    navigation: tuple[NavigationSeries, ...] = ()
    imaging_arcs: tuple[TimeSpan, ...] = ()
    gaps: tuple[TimeSpan, ...] = ()
    detector: DetectorScore | None = None
    gallery: tuple[GalleryFrame, ...] = ()
    worst_frames: tuple[GalleryFrame, ...] = ()
    craters: CraterMap | None = None
    terrain: TerrainMap | None = None
    payload_map: PayloadMap | None = None
    housekeeping: tuple[HousekeepingParameter, ...] = ()
    events: tuple[PassEvent, ...] = ()
    truth_ledger: tuple[AnchorRead, ...] = ()
    configuration: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    comparison: SettingsComparison | None = None
    scenario_text: str = ""


@dataclass(frozen=True, slots=True)
class RegressionPass:
    """One pass with both builds; pairs are of baseline and candidate.

    `first_difference` is the first frame with different packets; None: there is none.
    """

    pass_id: str
    frames: int
    first_difference: int | None = None
    recall: tuple[float, float] = (float("nan"), float("nan"))
    precision: tuple[float, float] = (float("nan"), float("nan"))
    median_3d_m: tuple[float, float] = (float("nan"), float("nan"))


@dataclass(frozen=True, slots=True)
class NamedScore:
    """Precision, recall and localisation of one named group, such as a state of degradation or a renderer.

    The fair ones are scored without what hardly anyone could see; NaN where only strict scores are given.
    """

    label: str
    expected: int
    precision: float
    recall: float
    localisation_px: float = float("nan")
    fair_precision: float = float("nan")
    fair_recall: float = float("nan")


@dataclass(frozen=True, slots=True)
class ScoreGroup:
    """Scores by one quantity: a heading, a row for each value of it, what should be known about them."""

    heading: str
    scores: tuple[NamedScore, ...]
    caption: str


@dataclass(frozen=True, slots=True)
class SigmaBin:
    """Centre errors compared with their predicted sigma: rms of error over sigma, shares inside."""

    label: str
    pairs: int
    mean_sigma_px: float
    rms: float
    inside_one_sigma: float
    inside_three_sigma: float


@dataclass(frozen=True, slots=True)
class BiasBin:
    """Mean signed centre errors, px, each with the ends of its 95 % interval: (mean, low, high).

    ``median_length_px`` is the length of the two medians, which a few wrong pairs hardly move.
    """

    label: str
    pairs: int
    right_px: tuple[float, float, float]
    down_px: tuple[float, float, float]
    sunward_px: tuple[float, float, float]
    across_px: tuple[float, float, float]
    median_length_px: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class TrainingCurve:
    """One quantity over a training run, ``epoch`` and ``values`` (n,); ``axis`` names what is counted if not epochs."""

    name: str
    epoch: FloatArray
    values: FloatArray
    axis: str = "epoch"


@dataclass(frozen=True, slots=True, eq=False)
class DetectorReport(ReportCommon):
    """A detector judged on a data set: scores by class, curves, calibration, bias, what it costs."""

    model_id: str
    score: DetectorScore | None = None
    by_degradation: tuple[NamedScore, ...] = ()
    by_source: tuple[NamedScore, ...] = ()
    groups: tuple[ScoreGroup, ...] = ()
    bias: tuple[BiasBin, ...] = ()
    sigma: tuple[SigmaBin, ...] = ()
    training: tuple[TrainingCurve, ...] = ()
    cost: Mapping[str, str] = field(default_factory=dict)
    gallery: tuple[GalleryFrame, ...] = ()
    worst_frames: tuple[GalleryFrame, ...] = ()
    configuration: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Gate:
    """Decision of one gate, or the change of a metric that informs.

    Attributes
    ----------
    outcome
        "pass", "fail", "inconclusive", "not judged" or "informs".
    pass_id
        Pass or kind of terrain; empty for all passes.
    baseline, candidate
        Values of the metric; NaN where unknown.
    margin, limit
        Tolerated loss, and the baseline with this loss.
    change_low, change_high
        One-sided 95 % bounds of the loss: a difference, or a share of the baseline. Positive is worse.
    p_value, level
        Of the test against no loss, and the level of the fail claim; NaN for exact gates.
    resolution
        Loss that these frames find with a power of 0.8; infinite if none.
    frames, frames_needed
        Number of compared frames, and number that decides an inconclusive gate; None if unknown.
    evidence
        Number and name of the units.
    reason
        The fact in words, where the figures alone do not state it.
    relative
        Whether margin, change and resolution are shares of the baseline.
    """

    name: str
    outcome: str
    baseline: float
    candidate: float
    margin: float
    limit: float
    unit: str = ""
    pass_id: str = ""
    change_low: float = float("nan")
    change_high: float = float("nan")
    p_value: float = float("nan")
    level: float = float("nan")
    resolution: float = 0.0
    frames: int = 0
    frames_needed: int | None = None
    evidence: str = ""
    reason: str = ""
    relative: bool = False

    @property
    def passed(self) -> bool:
        """Return whether the gate passed."""
        return self.outcome == "pass"


@dataclass(frozen=True, slots=True, eq=False)
class ChangedTrack:
    """One crater in one visit with what each build found, around the crater in the image of one frame.

    `lost` and `gained` are numbers of frames of `frames` in which one build alone detected the crater.
    """

    pass_id: str
    latitude_deg: float
    longitude_deg: float
    diameter_km: float
    frames: int
    lost: int
    gained: int
    baseline: GalleryFrame
    candidate: GalleryFrame


@dataclass(frozen=True, slots=True, eq=False)
class ChangedCraters:
    """Tracks of craters (n,) by place, with the frames gained less those lost; new false detections (m,) by place."""

    latitude_deg: FloatArray
    longitude_deg: FloatArray
    change: FloatArray
    false_latitude_deg: FloatArray
    false_longitude_deg: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RegressionReport(ReportCommon):
    """A candidate build against a baseline over archived passes."""

    regression_id: str
    candidate: str = ""
    baseline: str = ""
    gates: tuple[Gate, ...] = ()
    passes: tuple[RegressionPass, ...] = ()
    craters: ChangedCraters | None = None
    changed_tracks: tuple[ChangedTrack, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MonthPass:
    """Figures and conditions of one pass from its newest report; None and empty texts: not known.

    ``start`` is in RFC 3339, UTC. ``estimator`` is that of error and drift, the latter in percent of the ground path.
    Altitude and elevation of the Sun at the sub-satellite point are medians. ``map_offset_m`` is the offset of the
    crater list as learned on board, 1 sigma east and north. ``terrain`` is the evidence level of the world, ``build``
    the hashes of model and parameters in housekeeping.
    """

    pass_id: int
    name: str
    start: str
    estimator: str | None
    recall: float | None
    drift_percent: float | None
    median_error_m: float | None
    altitude_km: float | None
    sun_elevation_deg: float | None
    terrain: str
    build: str
    packets: int
    packets_lost: int
    verdict_level: str
    map_offset_m: float | None = None


@dataclass(frozen=True, slots=True)
class MeanByGroup:
    """Mean of a metric over the passes of a group, with its 95 % confidence interval; None: unknown.

    ``factor`` is altitude, sun elevation, terrain or build; ``passes`` have a value of the metric.
    """

    factor: str
    group: str
    metric: str
    passes: int
    mean: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True, slots=True)
class LevelChange:
    """Significant change of the level of a metric.

    ``pass_id`` is the first pass after it and ``time`` the start of this pass, ``before`` and ``after`` are medians up
    to the adjacent changes. ``p_value`` is the probability of such a change by chance.
    """

    metric: str
    pass_id: int
    time: str
    before: float
    after: float
    passes_before: int
    passes_after: int
    p_value: float


@dataclass(frozen=True, slots=True)
class RequirementOverTime:
    """Requirement over the passes of a rolling window; None: unknown.

    ``limit`` is that of the newest report. ``share_met`` is the share of the judged passes, ``low`` to ``high`` its
    95 % confidence interval, ``lowest_share`` the smallest share of all windows that end at a pass. ``remark`` says
    that the mean of a NEES or NIS over the passes is outside its bounds.
    """

    key: str
    name: str
    unit: str
    limit: float | None
    passes: int
    met: int
    not_met: int
    unknown: int
    share_met: float | None
    low: float | None
    high: float | None
    lowest_share: float | None = None
    remark: str = ""


@dataclass(frozen=True, slots=True)
class MonthlyReportValue(ReportCommon):
    """Performance of a spacecraft in a month."""

    month: str
    passes: tuple[MonthPass, ...] = ()
    groups: tuple[MeanByGroup, ...] = ()
    changes: tuple[LevelChange, ...] = ()
    requirements: tuple[RequirementOverTime, ...] = ()
    window_days: float = 7.0
    false_alarm_rate: float = 0.01
