"""Verdict of a pass: the requirements with limit, value and status, and a summary sentence.

Limits are those of the mission description. A requirement without a limit is shown without judgement. A value that is
not known never counts as met. The accuracy is that of the declared estimator, also if another one is better.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ground_service.evaluation.alignment import bounds_per_degree, independent_samples
from lunar.arrays import FloatArray
from lunar.constants import NS
from reports.statistics import per_degree, sigma_remark
from reports.text import count_text, significant_text
from reports.values import (
    DetectorScore,
    FrameAccounting,
    HousekeepingParameter,
    NavigationSeries,
    PacketAccounting,
    Requirement,
    Requirements,
)

FROM_START = ("propagate-only", "Kepler")
"""Baselines that propagate the start state; they are rivals where the start state was made worse for an experiment."""
LASTING = 4
"""Successive samples with a small error that show that an estimator has converged."""
NEES_DEGREES = 3
DRAW_GAP_NS = 1_800_000_000_000
"""Frames this far apart have independent errors of the position."""
NO_MISSION = "mission"
"""Key of the row that says that a pass has no mission description."""
LARGEST_SENTENCE = 5
"""Largest number of failed requirements named in the sentence; the table has all."""


@dataclass(frozen=True, slots=True)
class StartOrbit:
    """Orbit that a pass of the experiment starts from: 1-sigma error per axis, and age where stated."""

    orbit_error_m: float
    orbit_age_h: float | None = None

    @property
    def text(self) -> str:
        age = "" if self.orbit_age_h is None else f", {self.orbit_age_h:g} h old"
        return f"from an orbit with an error of {significant_text(self.orbit_error_m)} m per axis{age}"


@dataclass(frozen=True, slots=True, eq=False)
class Evaluated:
    """Results of a pass that requirements refer to.

    Attributes
    ----------
    experiment
        None: the pass starts from the best known orbit.
    reference_px
        Horizontal 1-sigma error of the reference in the image.
    clock_step_s
        Largest step of the on-board clock since the pass before; None without a time correlation.
    """

    navigation: tuple[NavigationSeries, ...] = ()
    detector: DetectorScore | None = None
    frames: FrameAccounting | None = None
    packets: PacketAccounting | None = None
    housekeeping: tuple[HousekeepingParameter, ...] = ()
    cpu_percent: float | None = None
    experiment: StartOrbit | None = None
    reference_px: float = 0.0
    clock_step_s: float | None = None


def requirements(limits: Requirements, found: Evaluated) -> tuple[Requirement, ...]:
    """Return the verdict table of a pass."""
    return (
        *_accuracy(limits, found),
        *_comparisons(limits, found),
        *_experiment(limits, found),
        *_consistency(limits, found),
        *_completeness(limits, found),
        *_detector(limits, found),
        *_pointing(limits, found),
        *_clock(limits, found),
        *_independence(limits, found),
        *_resources(limits, found),
    )


def without_mission(table: Sequence[Requirement], remedy: str) -> tuple[Requirement, ...]:
    """Return the verdict table of a pass without a mission description: no limit is known, so that all is unknown."""
    missing = Requirement(NO_MISSION, "mission description", "", None, None, True, "unknown", remedy)
    return missing, *(
        replace(one, status="unknown", note=one.note or "no limit") if one.status == "not judged" else one
        for one in table
    )


def verdict_of(table: Sequence[Requirement], question: str = "operations") -> tuple[str, str]:
    """Return the sentence on a verdict table, failures first, and its level: "met", "not met" or "unknown"."""
    judged = [one for one in table if one.status != "not judged" and one.question == question]
    failed = [one for one in judged if one.status == "not met"]
    unknown = [one for one in judged if one.status == "unknown"]
    met = len(judged) - len(failed) - len(unknown)
    if not judged:
        return "No requirement has a limit in the mission description: nothing is judged.", "unknown"
    if judged[0].key == NO_MISSION:
        return f"Nothing can be judged: {judged[0].note}", "unknown"
    parts = []
    if failed:
        named = "; ".join(_said(one) for one in failed[:LARGEST_SENTENCE])
        more = "" if len(failed) <= LARGEST_SENTENCE else f"; and {len(failed) - LARGEST_SENTENCE} more"
        parts.append(f"{_of(len(failed), len(judged))} not met: {named}{more}.")
    if unknown:
        names = ", ".join(one.name for one in unknown)
        parts.append(f"{count_text(len(unknown))} unknown: {names}.")
    parts.append(f"{_of(met, len(judged))} met.")
    return " ".join(parts), "not met" if failed else "unknown" if unknown else "met"


def _of(count: int, total: int) -> str:
    noun = "requirement" if total == 1 else "requirements"
    return f"{count_text(count)} of {count_text(total)} {noun}"


def _said(one: Requirement) -> str:
    unit = f" {one.unit}" if one.unit else ""
    bound = "at most" if one.at_most else "at least"
    return f"{one.name} {significant_text(one.value)}{unit} ({bound} {significant_text(one.limit)})"


def _row(
    key: str,
    name: str,
    unit: str,
    value: float | None,
    limit: float | None,
    *,
    at_most: bool,
    strict: bool = False,
    known: bool = True,
    judged: bool | None = None,
    note: str = "",
    question: str = "operations",
) -> Requirement:
    """Return a requirement, judged if the mission states its limit unless `judged` says otherwise.

    `strict` excludes equality; with `known` False the value never counts as met.
    """
    judged = limit is not None if judged is None else judged
    if value is not None and not math.isfinite(value):
        value = None
    if limit is not None and not math.isfinite(limit):
        limit = None
    if not judged:
        status = "not judged"
    elif value is None or limit is None:
        status = "unknown"
    else:
        margin = limit - value if at_most else value - limit
        good = margin > 0.0 if strict else margin >= 0.0
        status = "not met" if not good else "met" if known else "unknown"
    return Requirement(key, name, unit, value, limit, at_most, status, note, question)


def _declared(limits: Requirements, found: Evaluated) -> NavigationSeries | None:
    return next((one for one in found.navigation if one.kind == "estimate" and one.name == limits.estimator), None)


def _converged_errors(series: NavigationSeries, limit_m: float | None) -> FloatArray:
    """Return the finite 3-D errors from the sample on where the estimator states a 3-D sigma below a limit.

    All errors where it never does, so that an estimator that does not converge is judged by its start.
    """
    errors = np.linalg.norm(series.error_rtn_m, axis=1)
    if limit_m is not None and series.sigma_rtn_m is not None:
        errors = errors[int(np.argmax(np.linalg.norm(series.sigma_rtn_m, axis=1) < limit_m)) :]
    return np.asarray(errors[np.isfinite(errors)])


def _median(series: NavigationSeries | None) -> float | None:
    """Return the median error; None for a single frame, where the error is that of the start position."""
    return None if series is None or len(series.utc_ns) < 2 else series.statistics.median_3d_m


def _accuracy(limits: Requirements, found: Evaluated) -> Iterable[Requirement]:
    series = _declared(limits, found)
    if limits.estimator is None:
        note = "the mission description declares no estimator"
    elif series is None:
        note = f"{limits.estimator} reported nothing"
    elif len(series.utc_ns) < 2:
        note = "only one frame was navigated, too few for a judgement"
    else:
        note = f"{limits.estimator}, {count_text(len(series.utc_ns))} samples"
    if series is not None and series.not_applicable:
        note += f"; not applicable: {series.not_applicable}"
    median = _median(series)
    p95 = None if median is None or series is None else series.statistics.p95_3d_m
    if found.experiment is not None and p95 is not None and series is not None:
        errors = _converged_errors(series, limits.p95_error_m)
        if len(errors):
            median, p95 = (float(one) for one in np.percentile(errors, (50.0, 95.0)))
            note += f", {count_text(len(errors))} of them from convergence on"
    yield _row("accuracy.median", "median 3-D error", "m", median, limits.median_error_m, at_most=True, note=note)
    yield _row(
        "accuracy.p95", "95th percentile of the 3-D error", "m", p95, limits.p95_error_m, at_most=True, note=note
    )


def _comparisons(limits: Requirements, found: Evaluated) -> Iterable[Requirement]:
    """Yield the comparisons of the declared estimator with every computed or required baseline."""
    wanted = limits.better_than or ()
    others = {one.name: one for one in found.navigation if one.kind in ("baseline", "smoothed")}
    own = _median(_declared(limits, found))
    for name in dict.fromkeys((*wanted, *others)):
        baseline = _median(others.get(name))
        from_start = name.startswith(FROM_START)
        yield _row(
            f"better_than.{name}",
            f"better than {name}",
            "m",
            own,
            baseline,
            at_most=True,
            strict=True,
            judged=name in wanted and (found.experiment is not None or not from_start),
            note="this baseline was not computed"
            if name not in others
            else "no experiment: the pass starts from the best known orbit"
            if from_start and found.experiment is None
            else "median 3-D error",
            question="experiment" if from_start else "operations",
        )


def _experiment(limits: Requirements, found: Evaluated) -> Iterable[Requirement]:
    """Yield convergence and drift of a pass that starts from an orbit of a stated error."""
    if found.experiment is None:
        return
    series, text = _declared(limits, found), found.experiment.text
    seconds = drift = None
    if series is not None and limits.p95_error_m is not None:
        seconds = _convergence_s(series, limits.p95_error_m)
        bound = significant_text(limits.p95_error_m)
        text += f"; until {LASTING} successive errors are at most {bound} m"
    if series is not None:
        drift = series.statistics.drift_percent
        budget = series.error_budget
        if budget is not None:
            text += f"; reference {significant_text(budget.reference_rms_m)} m rms"
    yield _row(
        "experiment.convergence",
        "time to convergence",
        "s",
        seconds,
        limits.convergence_s,
        at_most=True,
        note=text,
        question="experiment",
    )
    yield _row(
        "experiment.drift",
        "drift of the ground path",
        "%",
        drift,
        limits.drift_percent,
        at_most=True,
        note="end of the pass against the reference",
        question="experiment",
    )


def _convergence_s(series: NavigationSeries, limit_m: float) -> float | None:
    """Return the time from the first sample until `LASTING` successive errors are at most a limit; None if never."""
    good = np.linalg.norm(series.error_rtn_m, axis=1) <= limit_m
    if len(good) < LASTING:
        return None
    lasting = np.asarray(np.lib.stride_tricks.sliding_window_view(good, LASTING).all(axis=1))
    first = int(np.argmax(lasting))
    return float(series.utc_ns[first] - series.utc_ns[0]) / NS if lasting[first] else None


def _consistency(limits: Requirements, found: Evaluated) -> Iterable[Requirement]:
    """Yield the mean NEES and NIS against the bounds for the number of independent draws in the pass.

    Above the upper bound the requirement is not met; below the lower one it is met, with a remark.
    """
    series = _declared(limits, found)
    nees = nis = None
    if series is not None and series.nees is not None:
        # Errors of successive frames are almost one draw: each stretch without a long gap is one.
        draws = 1.0 + float(np.sum(np.diff(series.utc_ns) > DRAW_GAP_NS))
        nees = series.nees, np.full(len(series.nees), NEES_DEGREES), draws
    if series is not None and series.nis is not None and series.nis_dof is not None:
        ratio = series.nis / np.where(series.nis_dof > 0, series.nis_dof, np.nan)
        nis = series.nis, series.nis_dof, independent_samples(ratio)
    for key, values, note in (
        ("nees", nees, "position error against the covariance of estimate and reference"),
        ("nis", nis, "image innovations"),
    ):
        share, mean, bound = limits.consistency_inside_percent, None, None
        if values is not None:
            count, mean, _ = per_degree(*values[:2])
            if share is not None and count:
                degrees = float(values[1][values[1] > 0].mean())
                low, bound = bounds_per_degree(degrees, values[2], share / 100.0)
                note += f"; {low:.2f} to {bound:.2f} with {share:g} % for {values[2]:.3g} independent draws"
                wrong = sigma_remark(mean, low, bound)
                note += f"; {wrong}" if wrong else ""
        yield _row(
            f"consistency.{key}",
            f"mean {key.upper()} per degree of freedom",
            "",
            mean,
            bound,
            at_most=True,
            judged=share is not None,
            note=note,
        )


def consistency_remarks(table: Sequence[Requirement]) -> list[str]:
    """Return a remark for each mean NEES or NIS that shows a filter that is too cautious."""
    wrong = ((one, one.note.rpartition("; ")[2]) for one in table if one.key.startswith("consistency."))
    return [f"{one.name} {one.value:.2f}: {text}" for one, text in wrong if text.endswith("too large")]


def _completeness(limits: Requirements, found: Evaluated) -> Iterable[Requirement]:
    packets, frames = found.packets, found.frames
    share = edges = None
    note = ""
    if packets is not None:
        edges = packets.lost_at_edges
        share = 100.0 * packets.packets / packets.expected if packets.expected else None
        note = f"{count_text(packets.packets)} of {count_text(packets.expected)} packets"
        if edges is None:
            note += "; without a plan, packets missing at the edges are unknown"
    yield _row(
        "completeness.packets",
        "packets received of those expected",
        "%",
        share,
        limits.packets_percent,
        at_most=False,
        known=edges is not None,
        note=note,
    )
    expected = None if frames is None else frames.expected
    counts = (
        ("frames", "frames reported of those expected", limits.frames_percent, frames.acquired if frames else None),
        (
            "images",
            "frames with a usable image of those expected",
            limits.images_percent,
            frames.processed if frames else None,
        ),
    )
    for key, name, limit, count in counts:
        value = 100.0 * count / expected if expected and count is not None else None
        yield _row(
            f"completeness.{key}",
            name,
            "%",
            value,
            limit,
            at_most=False,
            note="no plan of the frames" if value is None else f"{count_text(count)} of {count_text(expected)} frames",
        )


def _detector(limits: Requirements, found: Evaluated) -> Iterable[Requirement]:
    micro = None if found.detector is None else found.detector.micro
    note = "" if micro is None else f"{count_text(micro.expected)} craters of {micro.label} expected"
    recall, precision = (None, None) if micro is None else (micro.recall, micro.precision)
    yield _row("detector.recall", "detector recall", "", recall, limits.recall, at_most=False, note=note)
    yield _row("detector.precision", "detector precision", "", precision, limits.precision, at_most=False, note=note)


def _pointing(limits: Requirements, found: Evaluated) -> Iterable[Requirement]:
    """Yield the offset of the images from the catalogue: an error of the camera or of the attitude."""
    residuals = None if found.detector is None else found.detector.residuals
    offset, note = None, ""
    if residuals is not None and len(residuals.du_px):
        mean = math.hypot(float(np.median(residuals.du_px)), float(np.median(residuals.dv_px)))
        offset = max(mean - found.reference_px, 0.0)
        note = (
            f"camera or attitude: median of {count_text(len(residuals.du_px))} craters {mean:.2f} px, less "
            f"{found.reference_px:.2f} px of the reference"
        )
    yield _row(
        "pointing.offset",
        "offset of the images from the catalogue",
        "px",
        offset,
        limits.offset_px,
        at_most=True,
        note=note,
    )


def _clock(limits: Requirements, found: Evaluated) -> Iterable[Requirement]:
    yield _row(
        "time.step",
        "step of the on-board clock",
        "s",
        found.clock_step_s,
        limits.clock_step_s,
        at_most=True,
        note="largest since the pass before, by time correlation",
    )


def _independence(limits: Requirements, found: Evaluated) -> Iterable[Requirement]:
    series = _declared(limits, found)
    reads = None if series is None else series.anchor_reads_after_start
    resets = _resets(series)
    yield _row("anchor_reads", "anchor reads after the start", "", reads, limits.anchor_reads, at_most=True)
    yield _row("resets", "resets after the start", "", resets, limits.resets, at_most=True)
    for other in found.navigation:
        if other.kind == "estimate" and other is not series:
            yield _row(
                f"resets.{other.name}",
                f"resets of {other.name} after the start",
                "",
                _resets(other),
                None,
                at_most=True,
                judged=False,
            )


def _resets(series: NavigationSeries | None) -> float | None:
    """Return the number of resets of an estimator after its first sample; None if it reported no outcomes."""
    if series is None or not series.reset_trigger:
        return None
    return float(sum(trigger != "none" for trigger in series.reset_trigger[1:]))


def _resources(limits: Requirements, found: Evaluated) -> Iterable[Requirement]:
    values = {one.name: one.values[np.isfinite(one.values)] for one in found.housekeeping}

    def greatest(name: str, scale: float = 1.0) -> float | None:
        known = values.get(name)
        return None if known is None or not len(known) else float(known.max()) * scale

    coldest = values.get("temperature_c")
    yield _row(
        "resources.cpu",
        "CPU load",
        "%",
        found.cpu_percent,
        limits.cpu_percent,
        at_most=True,
        note="processor time of a step over the cadence, largest mean between two reports",
    )
    yield _row(
        "resources.memory",
        "memory in use",
        "MiB",
        greatest("memory_used_kib", 1.0 / 1024.0),
        limits.memory_mib,
        at_most=True,
    )
    yield _row(
        "resources.storage",
        "packet store in use",
        "%",
        greatest("storage_used_permille", 0.1),
        limits.storage_percent,
        at_most=True,
    )
    yield _row(
        "resources.temperature_max",
        "highest temperature",
        "°C",
        greatest("temperature_c"),
        limits.temperature_max_c,
        at_most=True,
    )
    yield _row(
        "resources.temperature_min",
        "lowest temperature",
        "°C",
        float(coldest.min()) if coldest is not None and len(coldest) else None,
        limits.temperature_min_c,
        at_most=False,
    )
