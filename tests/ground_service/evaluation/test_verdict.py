"""Verdict tables: every requirement at, below and past its limit, and the sentence on them."""

from dataclasses import replace

import numpy as np
from pytest import approx, mark

from ground_service.evaluation.alignment import error_budget, reference_covariance_m2
from ground_service.evaluation.verdict import (
    Evaluated,
    StartOrbit,
    consistency_remarks,
    requirements,
    verdict_of,
    without_mission,
)
from reports.values import (
    ClassScore,
    DetectorScore,
    FrameAccounting,
    HousekeepingParameter,
    NavigationSeries,
    NavigationStatistics,
    PacketAccounting,
    Requirement,
    Requirements,
    ResidualSeries,
)

N = 10


def series(name, kind="estimate", median=50.0, p95=90.0, **more):
    nothing = np.zeros(N)
    return NavigationSeries(
        name,
        kind,
        np.arange(N, dtype=np.int64),
        nothing,
        nothing,
        nothing,
        np.zeros((N, 3)),
        statistics=NavigationStatistics(median_3d_m=median, p95_3d_m=p95),
        **more,
    )


def found(*navigation, **more):
    return Evaluated(navigation or (series("anchored"),), **more)


def row(key, limits, evaluated):
    return next(one for one in requirements(limits, evaluated) if one.key == key)


PLACES = np.zeros(3)
DETECTOR = DetectorScore(
    micro=ClassScore(-1, "5–30 km", 200, 60, 20, 0.75, 0.3, 1.0),
    residuals=ResidualSeries(PLACES, PLACES, np.array([0.3, 9.0, -5.0]), np.array([0.4, 0.4, 7.0])),
)
HOUSEKEEPING = tuple(
    HousekeepingParameter(name, "", np.arange(3), np.array(values))
    for name, values in (
        ("temperature_c", [10.0, 45.5, np.nan]),
        ("memory_used_kib", [1024.0, 4096.0, 2048.0]),
        ("storage_used_permille", [100.0, 250.0, 30.0]),
    )
)
HOUSED = {"housekeeping": HOUSEKEEPING}
FRAMES = FrameAccounting(40, 30, processed=10)
CONSISTENT = series(
    "anchored",
    nees=np.array([0.2, 0.22, 3.0, 3.0, 3.0, 3.0, 9.3, 9.4, np.nan, np.nan]),
    nis=np.array([0.04, 0.06, 2.0, 7.3, 7.5, np.nan, 2.0, 2.0, 2.0, 2.0]),
    nis_dof=np.array([2] * 9 + [0]),
    anchor_reads_after_start=3,
    reset_trigger=("initialization", "time_gap", "none", "none", "manual_step", *["none"] * 5),
)


@mark.parametrize(
    "gap_s, factor, status, draws, bounds, wrong",
    [
        (1800, 3.1, "met", 1, "0.07 to 3.12", ""),  # one draw: 0.2158 / 3, 9.348 / 3 (tables of chi-square)
        # Ten draws: 16.791 / 30, 46.979 / 30.
        (1801, 2.2, "not met", 10, "0.56 to 1.57", "; sigmas 1.5 times too small"),
        (1801, 0.31, "met", 10, "0.56 to 1.57", "; sigmas 1.8 times too large"),
    ],
)
def test_nees_is_judged_by_both_bounds_for_its_independent_draws(gap_s, factor, status, draws, bounds, wrong):
    """Too bold is a failure, too cautious a remark."""
    times = np.arange(N, dtype=np.int64) * gap_s * 10**9
    flown = replace(series("anchored", nees=np.full(N, 3.0 * factor)), utc_ns=times)
    judged = row("consistency.nees", Requirements(estimator="anchored", consistency_inside_percent=95.0), found(flown))
    assert (judged.value, judged.status) == (approx(factor), status)
    assert judged.note.endswith(f"; {bounds} with 95 % for {draws} independent draws{wrong}")
    cautious = ["mean NEES per degree of freedom 0.31: sigmas 1.8 times too large"]
    assert consistency_remarks([judged]) == (cautious if factor < 1.0 else [])


@mark.parametrize(
    "key, limit, at_limit, evaluated",
    [
        ("accuracy.median", "median_error_m", 50.0, {}),
        ("accuracy.p95", "p95_error_m", 90.0, {}),
        ("completeness.packets", "packets_percent", 80.0, {"packets": PacketAccounting(80, lost=15, lost_at_edges=5)}),
        ("completeness.frames", "frames_percent", 75.0, {"frames": FRAMES}),
        ("completeness.images", "images_percent", 25.0, {"frames": FRAMES}),
        ("detector.recall", "recall", 0.3, {"detector": DETECTOR}),
        ("detector.precision", "precision", 0.75, {"detector": DETECTOR}),
        ("anchor_reads", "anchor_reads", 3.0, {}),
        ("resets", "resets", 2.0, {}),
        ("resources.cpu", "cpu_percent", 40.0, {"cpu_percent": 40.0}),
        ("resources.memory", "memory_mib", 4.0, HOUSED),
        ("resources.storage", "storage_percent", 25.0, HOUSED),
        ("resources.temperature_max", "temperature_max_c", 45.5, HOUSED),
        ("resources.temperature_min", "temperature_min_c", 10.0, HOUSED),
    ],
)  # fmt: skip
def test_a_requirement_is_met_at_its_limit_not_past_it_and_unknown_without_a_value(key, limit, at_limit, evaluated):
    what = found(CONSISTENT, **evaluated)

    def judged(bound, what=what):
        return row(key, Requirements(**{"estimator": "anchored", limit: bound}), what)

    exact = judged(at_limit)
    assert exact.value == approx(at_limit) and exact.status == "met"
    assert exact.margin == approx(0.0, abs=1e-9)
    step = 0.01 * at_limit
    tighter, looser = (-step, step) if exact.at_most else (step, -step)
    assert judged(at_limit + tighter).status == "not met"
    assert judged(at_limit + tighter).margin == approx(-step)
    assert judged(at_limit + looser).status == "met"
    assert judged(at_limit, Evaluated()).status == "unknown"
    assert judged(None).status == "not judged" and judged(None).value == approx(at_limit)


def test_the_declared_estimator_is_judged_and_a_pass_for_which_it_is_not_made_named():
    evaluated = found(series("anchored", median=70.0), series("spherical", median=30.0))
    limits = Requirements(estimator="anchored", median_error_m=50.0)
    assert (row("accuracy.median", limits, evaluated).value, verdict_of(requirements(limits, evaluated))[1]) == (
        70.0, "not met",
    )  # fmt: skip
    undeclared = row("accuracy.median", replace(limits, estimator=None), evaluated)
    assert (undeclared.value, undeclared.status) == (None, "unknown")
    assert undeclared.note == "the mission description declares no estimator"
    words = "paper assumes a pass to the north or south, this track runs 50° from the meridian"
    limits = Requirements(estimator="paper", median_error_m=100.0)
    named = row("accuracy.median", limits, found(series("paper", not_applicable=words)))
    assert named.note == f"paper, 10 samples; not applicable: {words}"
    assert row("accuracy.median", limits, found(series("paper"))).note == "paper, 10 samples"


@mark.parametrize("baseline, status", [(51.0, "met"), (50.0, "not met"), (49.0, "not met"), (float("nan"), "unknown")])
def test_a_baseline_has_to_be_beaten_and_not_only_matched(baseline, status):
    limits = Requirements(estimator="anchored", better_than=("snapshot",))
    evaluated = found(series("anchored"), series("snapshot", "baseline", baseline))
    assert row("better_than.snapshot", limits, evaluated).status == status


def test_every_baseline_is_shown_and_one_that_is_missing_is_unknown():
    limits = Requirements(estimator="anchored", better_than=("snapshot",))
    evaluated = found(series("anchored"), series("Kepler", "baseline", 1.0), series("smoothed", "smoothed", 1.0))
    assert row("better_than.snapshot", limits, evaluated).status == "unknown"
    for name in "Kepler", "smoothed":
        shown = row(f"better_than.{name}", limits, evaluated)
        assert (shown.status, shown.value, shown.limit) == ("not judged", 50.0, 1.0)
    rival = replace(limits, better_than=("Kepler",))
    assert row("better_than.Kepler", rival, evaluated).status == "not judged"  # from the best known orbit
    assert row("better_than.Kepler", rival, replace(evaluated, experiment=StartOrbit(1e3))).status == "not met"


def test_an_experiment_is_judged_apart_and_its_accuracy_from_convergence_on():
    """Errors of 900 m, and 30 m from the fourth sample on, where the filter states it."""
    size = np.array([900.0] * 3 + [30.0, 31.0, 500.0] + [30.0, 31.0, 32.0, 33.0])
    flown = replace(
        series("anchored", median=32.0, p95=900.0),
        utc_ns=np.arange(N, dtype=np.int64) * 15 * 10**9,
        error_rtn_m=np.column_stack([size, 0 * size, 0 * size]),
        sigma_rtn_m=np.column_stack([np.where(np.arange(N) < 3, 100.0, 20.0)] * 3),
    )
    limits = Requirements(
        estimator="anchored", median_error_m=60.0, p95_error_m=100.0, better_than=("Kepler",), convergence_s=80.0
    )
    evaluated = replace(found(flown, series("Kepler", "baseline", 10.0)), experiment=StartOrbit(1e3, 24.0))
    table = {one.key: one for one in requirements(limits, evaluated)}
    # Seven samples, of which the 95th percentile is 0.3 of the way back from 500 m to 33 m.
    assert table["accuracy.p95"].value == approx(500.0 - 0.3 * 467.0)
    assert table["accuracy.median"].value == 31.0 and table["accuracy.median"].note.endswith(
        "7 of them from convergence on"
    )
    assert table["experiment.convergence"].value == 90.0  # 500 m interrupt the first two small errors
    assert table["experiment.convergence"].note.startswith(
        "from an orbit with an error of 1\u202f000 m per axis, 24 h old; until 4 successive errors"
    )
    exact = replace(limits, p95_error_m=33.0)  # the largest of the last four
    assert row("experiment.convergence", exact, evaluated).value == 90.0
    judged = list(table.values())
    assert verdict_of(judged)[0].startswith("1 of 2 requirements not met: 95th percentile")
    assert verdict_of(judged, "experiment") == (
        "2 of 2 requirements not met: better than Kepler 32.0 m (at most 10.0); time to convergence 90.0 s "
        "(at most 80.0). 0 of 2 requirements met.",
        "not met",
    )
    never = replace(flown, sigma_rtn_m=np.full((N, 3), 100.0), error_rtn_m=np.full((N, 3), 200.0))
    table = {one.key: one for one in requirements(limits, replace(evaluated, navigation=(never,)))}
    assert table["experiment.convergence"].status == "unknown"
    assert table["accuracy.median"].value == approx(200.0 * 3**0.5)


def test_packets_of_unknown_loss_are_never_complete_and_one_frame_is_not_judged():
    def judged(*counts):
        return row("completeness.packets", EVERY_LIMIT, found(packets=PacketAccounting(*counts)))

    assert judged(100).status == "unknown"
    few = judged(60, 40)
    assert few.status == "not met"
    assert few.note == "60 of 100 packets; without a plan, packets missing at the edges are unknown"
    assert judged(0).value is None
    for count, expected in (
        (2, ("met", "anchored, 2 samples")),
        (1, ("unknown", "only one frame was navigated, too few for a judgement")),
    ):
        flown = replace(series("anchored"), utc_ns=np.zeros(count, dtype=np.int64))
        judged = row("accuracy.median", EVERY_LIMIT, found(flown))
        assert (judged.status, judged.note) == expected


def table(*statuses):
    return [Requirement(f"k{i}", f"thing {i}", "m", 2.0, 1.0, True, s) for i, s in enumerate(statuses)]


@mark.parametrize(
    "statuses, level, sentence",
    [
        (["met", "met", "not judged"], "met", "2 of 2 requirements met."),
        (
            ["met", "unknown", "not met", "not judged"], "not met",
            "1 of 3 requirements not met: thing 2 2.00 m (at most 1.00). 1 unknown: thing 1. 1 of 3 requirements met.",
        ),
        (["met", "unknown"], "unknown", "1 unknown: thing 1. 1 of 2 requirements met."),
        (["not judged"], "unknown", "No requirement has a limit in the mission description: nothing is judged."),
        ([], "unknown", "No requirement has a limit in the mission description: nothing is judged."),
    ],
)  # fmt: skip
def test_the_sentence_is_derived_from_the_table_and_names_failures_first(statuses, level, sentence):
    assert verdict_of(table(*statuses)) == (sentence, level)


def test_many_failures_are_counted_and_the_budget_takes_the_reference_off_in_squares():
    text, _ = verdict_of(table(*["not met"] * 7))
    assert text.startswith("7 of 7 requirements not met: thing 0") and "; and 2 more." in text
    assert "thing 4" in text and "thing 5" not in text
    # A 3-4-12 error is 13 m long; a reference of 3, 4 and 0 m takes 5 m off in squares: 12 m are left.
    error = np.array([[3.0, 4.0, 12.0], [-3.0, 4.0, -12.0], [np.nan, 0.0, 0.0]])
    budget = error_budget(error, (3.0, 4.0, 0.0))
    assert (budget.observed_rms_m, budget.reference_rms_m, budget.estimate_rms_m) == approx((13.0, 5.0, 12.0))
    below = error_budget(error, (30.0, 0.0, 0.0))
    assert np.isnan(below.estimate_rms_m)
    assert error_budget(error, None) is None and error_budget(error[2:], (1.0, 1.0, 1.0)) is None
    assert reference_covariance_m2((1.0, 2.0, 3.0)).tolist() == [[1, 0, 0], [0, 4, 0], [0, 0, 9]]
    assert not reference_covariance_m2(None).any()


EVERY_LIMIT = Requirements(
    estimator="anchored",
    median_error_m=60.0,
    p95_error_m=80.0,
    better_than=("snapshot",),
    consistency_inside_percent=90.0,
    packets_percent=75.0,
    frames_percent=90.0,
    images_percent=25.0,
    recall=0.25,
    precision=0.8,
    anchor_reads=3.0,
    resets=1.0,
    cpu_percent=50.0,
    memory_mib=4.5,
    storage_percent=20.0,
    temperature_max_c=45.0,
    temperature_min_c=5.0,
    offset_px=0.3,
    clock_step_s=0.1,
)


def test_the_table_of_a_pass_in_full():
    """Each row as it is printed: key, name, unit, value, limit, whether at most, status and note."""
    evaluated = Evaluated(
        (replace(CONSISTENT, statistics=NavigationStatistics(median_3d_m=50.0, p95_3d_m=90.0)),
         series("snapshot", "baseline", 70.0), series("smoothed", "smoothed", 30.0),
         series("paper", reset_trigger=("none", "time_gap", "none"))),
        DETECTOR, FRAMES, PacketAccounting(1500, lost=400, lost_at_edges=100),
        HOUSEKEEPING, 40.0, reference_px=0.2, clock_step_s=1.0,
    )  # fmt: skip
    cpu = "processor time of a step over the cadence, largest mean between two reports"
    assert requirements(EVERY_LIMIT, evaluated) == tuple(
        Requirement(*one)
        for one in (
            ("accuracy.median", "median 3-D error", "m", 50.0, 60.0, True, "met", "anchored, 10 samples"),
            ("accuracy.p95", "95th percentile of the 3-D error", "m", 90.0, 80.0, True, "not met",
             "anchored, 10 samples"),
            ("better_than.snapshot", "better than snapshot", "m", 50.0, 70.0, True, "met", "median 3-D error"),
            ("better_than.smoothed", "better than smoothed", "m", 50.0, 30.0, True, "not judged",
             "median 3-D error"),
            ("consistency.nees", "mean NEES per degree of freedom", "", approx(31.12 / 24),
             approx(7.8147 / 3, abs=1e-4), True, "met",
             "position error against the covariance of estimate and reference; "
             "0.12 to 2.60 with 90 % for 1 independent draws"),
            ("consistency.nis", "mean NIS per degree of freedom", "", approx(22.9 / 16),
             approx(1.891, abs=1e-3), True, "met",
             "image innovations; 0.36 to 1.89 with 90 % for 4.4 independent draws"),
            ("completeness.packets", "packets received of those expected", "%", 75.0, 75.0, False, "met",
             "1\u202f500 of 2\u202f000 packets"),
            ("completeness.frames", "frames reported of those expected", "%", 75.0, 90.0, False, "not met",
             "30 of 40 frames"),
            ("completeness.images", "frames with a usable image of those expected", "%", 25.0, 25.0, False, "met",
             "10 of 40 frames"),
            ("detector.recall", "detector recall", "", 0.3, 0.25, False, "met", "200 craters of 5–30 km expected"),
            ("detector.precision", "detector precision", "", 0.75, 0.8, False, "not met",
             "200 craters of 5–30 km expected"),
            ("pointing.offset", "offset of the images from the catalogue", "px", approx(0.3), 0.3, True, "met",
             "camera or attitude: median of 3 craters 0.50 px, less 0.20 px of the reference"),
            ("time.step", "step of the on-board clock", "s", 1.0, 0.1, True, "not met",
             "largest since the pass before, by time correlation"),
            ("anchor_reads", "anchor reads after the start", "", 3, 3.0, True, "met", ""),
            ("resets", "resets after the start", "", 2.0, 1.0, True, "not met", ""),
            ("resets.paper", "resets of paper after the start", "", 1.0, None, True, "not judged", ""),
            ("resources.cpu", "CPU load", "%", 40.0, 50.0, True, "met", cpu),
            ("resources.memory", "memory in use", "MiB", 4.0, 4.5, True, "met", ""),
            ("resources.storage", "packet store in use", "%", 25.0, 20.0, True, "not met", ""),
            ("resources.temperature_max", "highest temperature", "°C", 45.5, 45.0, True, "not met", ""),
            ("resources.temperature_min", "lowest temperature", "°C", 10.0, 5.0, False, "met", ""),
        )
    )  # fmt: skip


def test_the_table_of_a_pass_of_which_nothing_is_known():
    table = requirements(EVERY_LIMIT, Evaluated())
    assert {(one.value, one.status) for one in table} == {(None, "unknown")}
    assert {one.key: one.note for one in table if one.note} == {
        "accuracy.median": "anchored reported nothing",
        "accuracy.p95": "anchored reported nothing",
        "better_than.snapshot": "this baseline was not computed",
        "consistency.nees": "position error against the covariance of estimate and reference",
        "consistency.nis": "image innovations",
        "completeness.frames": "no plan of the frames",
        "completeness.images": "no plan of the frames",
        "time.step": "largest since the pass before, by time correlation",
        "resources.cpu": "processor time of a step over the cadence, largest mean between two reports",
    }
    assert {one.status for one in requirements(Requirements(), Evaluated())} == {"not judged"}


def test_values_that_are_not_finite_are_unknown_and_the_first_sample_is_no_reset():
    cold = (HousekeepingParameter("temperature_c", "", np.arange(2), np.full(2, np.nan)),)
    for key in "resources.temperature_max", "resources.temperature_min":
        assert (row(key, EVERY_LIMIT, found(housekeeping=cold)).status) == "unknown"
    for triggers, resets in ((), None), (("initialization", "none"), 0.0):
        started = found(series("anchored", reset_trigger=triggers))
        assert row("resets", EVERY_LIMIT, started).value == resets


def test_an_offset_smaller_than_the_error_of_the_reference_is_none():
    for reference_px, offset in (0.4, approx(0.1)), (0.6, 0.0):
        one = row("pointing.offset", EVERY_LIMIT, found(detector=DETECTOR, reference_px=reference_px))
        assert (one.value, one.status) == (offset, "met")


@mark.parametrize("limit", [float("nan"), float("inf")])
def test_a_limit_that_is_no_number_judges_nothing_as_met(limit):
    one = row("accuracy.median", replace(EVERY_LIMIT, median_error_m=limit), found())
    assert (one.limit, one.status) == (None, "unknown")


def test_without_a_mission_description_every_requirement_is_unknown_and_the_remedy_is_said_first():
    plain = requirements(Requirements(), found(CONSISTENT, detector=DETECTOR, housekeeping=HOUSEKEEPING))
    assert {one.status for one in plain} == {"not judged"}
    table = without_mission(plain, "none is registered; enter one")
    assert {one.status for one in table} == {"unknown"}
    assert [one.key for one in table] == ["mission", *(one.key for one in plain)]
    assert [one.value for one in table[1:]] == [one.value for one in plain]
    assert verdict_of(table) == ("Nothing can be judged: none is registered; enter one", "unknown")
