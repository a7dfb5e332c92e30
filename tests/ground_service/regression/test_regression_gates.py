"""Gates and paired statistics on simulated passes of known figures: what they claim, and what not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from pytest import approx, mark

from ground_service.evaluation.recall import ExpectedCraters
from ground_service.regression.documents import changed_craters, stretched
from ground_service.regression.gates.calibration import calibrations, gate_noise, pass_noise
from ground_service.regression.gates.core import (
    COSTS,
    FEWEST_PASSES,
    FEWEST_TRACKS,
    PASS_SPREAD,
    detectable,
    judge,
    power_text,
    verdict_of,
)
from ground_service.regression.gates.policy import load_policy, read_policy
from ground_service.regression.gates.samples import (
    KINDS,
    VISIT_GAP_FRAMES,
    CraterRows,
    DetectionRows,
    EstimatorFrames,
    PassFrames,
    TimeTags,
    _cells,
    _estimator,
    _tracks,
    terrain_kinds,
)
from ground_service.regression.gates.statistics import (
    UnitSums,
    aligned,
    frames_needed,
    holm_levels,
    joined_sums,
    mean_change,
    ratio_change,
    ratio_error,
    student_upper_tail,
    unit_sums,
)
from ground_service.regression.outcome import PassVerdict, RegressionOutcome
from lunar.catalogue import make_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical
from reports.text import loss_text
from reports.values import Gate
from tests.lazy import Lazy

stats = Lazy("scipy.stats")

POLICY = load_policy().policy
NARROW = read_policy(
    b"""schema_version = 3
    version = "1"
    fail = { level = 0.01, reason = "usual" }
    gate = [{ metric = "detector.recall", weight = 1.0, margin = 0.1, reason = "usual" }]""",
    "narrow",
).policy
FRAMES = 49


def simulated(
    scene,
    noise,
    *,
    frames=FRAMES,
    tracks=150,
    recall=0.7,
    other_kind_recall=None,
    false_cells=12,
    off_px=0.0,
    fixes=0.95,
    error=1.0,
    **more,
):
    """Return a pass over a scene with the noise of one camera and filter run.

    Each crater is in view for 3 frames. The scene determines how easily each is detected; noise changes one row in
    fifty. Half of the craters are in each kind of terrain.
    """
    world, rng = np.random.default_rng((1, scene)), np.random.default_rng((2, scene, noise))
    track = np.repeat(np.arange(tracks), 3)
    frame = (world.integers(0, frames - 2, tracks)[:, None] + np.arange(3)).ravel()
    ease = np.repeat(world.random(tracks), 3) + 0.1 * world.standard_normal(3 * tracks)
    ease = np.where(rng.random(3 * tracks) < 0.02, rng.random(3 * tracks), ease)
    kind = track % 2
    hit = ease < np.where(kind == 1, recall, recall if other_kind_recall is None else other_kind_recall)
    centre = 1.0 + 0.3 * world.standard_normal(3 * tracks) + 0.1 * rng.standard_normal(3 * tracks) + off_px
    cells = np.concatenate((track[hit], np.repeat(1000 + np.arange(false_cells), 4)))
    length = error * 40.0 * np.exp(0.3 * world.standard_normal() + 0.5 * rng.standard_normal(frames))
    fixed = np.where(world.random(frames) + 0.02 * rng.standard_normal(frames) < fixes, "fixed", "coasted")
    nothing, one = np.full(frames, np.nan), np.ones(frames)
    return PassFrames(
        answered=one.astype(np.bool_),
        packets=8.0 * one,
        octets=900.0 * one,
        estimators={
            "anchored": EstimatorFrames(
                one > 0, length, nothing + 43.0, (length / 25.0) ** 2, tuple(map(str, fixed)), 0.0 * one
            )
        },
        craters=CraterRows(frame, track, track, kind, np.where(hit, centre, np.nan), np.zeros(3 * tracks)),
        detections=DetectionRows(np.zeros(len(cells), np.int64), cells, cells < 1000),
        **{"memory_mib": 250.0, "digests": (bytes([noise % 256]),), **more},
    )


def suite(noise, passes=5, first_scene=0, **faults):
    return {f"pass {k}": simulated(first_scene + k, noise, **faults) for k in range(passes)}


def by_name(gates):
    return {gate.name: gate for gate in gates if not gate.pass_id}


def judged(before, after, name="detector.recall"):
    return by_name(judge(before, after, POLICY))[name]


def failed(before, after, policy=POLICY):
    return {gate.name for gate in judge(before, after, policy) if gate.outcome == "fail"}


def changed(passes, **values):
    """Return the passes with another pass 0."""
    return {**passes, "pass 0": replace(passes["pass 0"], **values)}


def places(gates):
    return {gate.pass_id for gate in gates if gate.outcome == "fail"}


def largest_count(trials, rate):
    """Count that a binomial of this rate exceeds once in ten thousand tests."""
    return int(stats.binom.isf(1e-4, trials, rate))


@mark.parametrize("passes", [1, 5])
def test_equal_builds_fail_once_in_a_hundred_at_most_and_pass_on_five_windows(passes):
    outcomes = [verdict_of(judge(suite(0, passes, 100 * k), suite(1, passes, 100 * k), POLICY)) for k in range(100)]
    assert outcomes.count("fail") <= largest_count(100, 0.01)
    assert outcomes.count("pass") >= 95


@mark.parametrize(
    "passes, faults, name",
    [
        (1, {"recall": 0.5}, "detector.recall"),
        (5, {"recall": 0.65, "false_cells": 11}, "detector.recall"),
        (5, {"false_cells": 24}, "detector.precision"),
        (1, {"off_px": 0.5}, "detector.localisation"),
        (5, {"fixes": 0.8}, "navigation.anchored.fixes"),
        (5, {"error": 2.0}, "navigation.anchored.p50"),
        (20, {"error": 1.25}, "navigation.anchored.p50"),
    ],
)
def test_a_degraded_build_fails_by_the_metric_that_is_worse(passes, faults, name):
    for noise in range(1, 6):
        assert failed(suite(0, passes), suite(noise, passes, **faults)) == {name}


def test_a_better_build_passes_on_one_window_and_a_loss_in_one_terrain_or_pass_fails_there():
    gates = judge(suite(0, 1), suite(1, 1, recall=0.8), POLICY)
    assert verdict_of(gates) == "pass"
    assert by_name(gates)["detector.recall"].change_high < 0.0
    gates = judge(suite(0), suite(1, recall=0.72, other_kind_recall=0.58), POLICY)
    assert "sparse terrain" in places(gates)
    assert "cratered terrain" not in {gate.pass_id for gate in gates}
    found = places(judge(suite(0), {**suite(1), "pass 3": simulated(3, 1, recall=0.5)}, POLICY))
    assert "pass 3" in found and not found & {"pass 0", "pass 1", "pass 2", "pass 4"}


def test_identical_octets_pass_at_once_and_few_tracks_say_how_many_frames_are_needed():
    few = suite(0, 1, frames=6, tracks=4)
    assert verdict_of(judge(few, few, POLICY)) == "pass"
    assert judged(few, few).reason == "identical in every octet"
    # The same values with another octet somewhere are compared by chance: four tracks claim nothing.
    assert judged(few, changed(few, digests=(b"other",))).outcome == "inconclusive"
    assert judged(few, changed(few, undecodable=1)).reason.startswith("4 of 90")
    before, after, slight, great = (
        suite(noise, 1, tracks=30, recall=recall) for noise, recall in ((0, 0.7), (1, 0.7), (1, 0.6), (1, 0.2))
    )
    recall = judged(before, after)
    assert (recall.outcome, recall.reason) == ("inconclusive", "30 of 90 tracks")
    assert recall.frames_needed == FRAMES * FEWEST_TRACKS // 30
    assert "detector.recall" in failed(before, great) and "detector.recall" not in failed(before, slight)


def rows(before, after, copies=30):
    """Return a pass of two builds with these hits of each track, repeated."""
    frames = simulated(0, 0, frames=300)
    track = np.repeat(np.arange(len(before) * copies), [len(one) for one in before] * copies)

    def made(hits, digest):
        hit = np.array([value for one in hits for value in one] * copies, dtype=np.bool_)
        none = np.zeros_like(track)
        craters = CraterRows(none, track, track, none, np.where(hit, 1.0, np.nan), 0.0 * none)
        return {"only": replace(frames, craters=craters, digests=(digest,))}

    return made(before, b"a"), made(after, b"b")


def test_the_test_of_recall_is_mcnemars_over_tracks():
    """By the formula: d_k = c_k - b_k, D = sum d / N, s^2 = K / (K - 1) sum (d_k - n_k D)^2 / N^2."""
    pair = rows([[1, 1, 0], [1, 0], [1, 1, 1, 1], [0]], [[1, 0, 0], [1, 0], [1, 1, 0, 0], [1]])
    n, d = np.tile([3.0, 2.0, 4.0, 1.0], 30), np.tile([-1.0, 0.0, -2.0, 1.0], 30)
    change = d.sum() / n.sum()
    error = np.sqrt(120.0 / 119.0 * np.sum((d - n * change) ** 2)) / n.sum()
    recall, t = judged(*pair), stats.t(119)
    assert (recall.baseline, recall.candidate) == approx((0.7, 0.5))
    assert recall.p_value == approx(t.sf(-change / error), rel=1e-6)
    assert recall.change_low == approx(-change - t.ppf(0.95) * error)
    assert recall.change_high == approx(-change + t.ppf(0.95) * error)
    # One pass has the whole level; recall has 0.3 of it. 300 frames: the sizes of a suite.
    assert recall.level == approx(0.003)
    assert (recall.margin, recall.limit) == (0.02, approx(0.68))
    assert recall.resolution == approx(0.005 + (t.ppf(0.997) + t.ppf(0.8)) * error)
    assert (recall.outcome, recall.evidence, recall.frames) == ("fail", "120 tracks", 300)


def test_a_failure_needs_a_lower_bound_above_what_is_material_and_unseen_pairs_have_their_error():
    """Every thousandth row lost: certain, and not material."""
    whole = [1] * 50
    recall = judged(*rows([whole] * 4, [[0, *whole[1:]], *[whole] * 3]))
    assert recall.baseline - recall.candidate == approx(0.005)
    assert recall.p_value < 1e-6 and recall.outcome == "pass"
    recall = judged(*rows([[1, 0]], [[1, 0]], copies=100))
    assert recall.change_high == approx(stats.t(99).ppf(0.95) * 1.8 / 200)
    assert recall.outcome == "pass"


def test_an_open_gate_says_how_many_frames_decide_it():
    """A loss near nothing with an error of 0.0157 needs (t + t) s / (margin - loss) to be excluded."""
    rng = np.random.default_rng(5)
    recall = judged(*rows(*(rng.random((2, 200, 1)) < 0.7).tolist(), copies=4))
    loss, t = recall.baseline - recall.candidate, stats.t(799)
    error = (recall.change_high - loss) / t.ppf(0.95)
    assert recall.outcome == "inconclusive"
    to_pass = 300 * ((t.ppf(0.95) + t.ppf(0.8)) * error / (0.02 - max(loss, 0.0))) ** 2
    to_fail = 300 * ((t.ppf(0.997) + t.ppf(0.8)) * error / (loss - 0.005)) ** 2 if loss > 0.005 else np.inf
    assert recall.frames_needed == np.ceil(min(to_pass, to_fail))


def test_position_errors_are_judged_by_passes_from_ten_on():
    before, after = suite(0, 12), suite(1, 12, error=1.2)
    medians = [[np.median(one.estimators["anchored"].error_m) for one in build.values()] for build in (before, after)]
    change = np.diff(np.log(medians), axis=0)
    error = np.std(change, ddof=1) / np.sqrt(12)
    median = "navigation.anchored.p50"
    gate = judged(before, after, median)
    assert gate.p_value == approx(stats.t(11).sf(change.mean() / error), rel=1e-6)
    assert gate.change_low == approx(np.expm1(change.mean() - stats.t(11).ppf(0.95) * error))
    assert gate.evidence == "12 passes"
    fewer = judge(suite(0, FEWEST_PASSES - 1), suite(1, FEWEST_PASSES - 1, error=1.2), POLICY)
    gate = by_name(fewer)[median]
    assert gate.outcome == "not judged"
    assert gate.reason.endswith("%; fewer than 10 passes inform only")
    assert judged(suite(0, 1), suite(1, 1), median).evidence == "1 pass"
    assert PASS_SPREAD / 3.0 > 0.1 and verdict_of(fewer) == "pass"


TIMES = {"latency_ms": {"a": np.full(FRAMES, 40.0)}, "cpu_s": 3.0 + 0.04 * (FRAMES - 2)}
EXACT = [
    ("telemetry.undecodable", {"undecodable": 3}, "3 packets cannot be decoded"),
    (
        "telemetry.times",
        {"times": TimeTags({"x": 9}, {"x": 4}, {"x": np.zeros(9)})},
        "4 of 9 x packets name a time at which no image was taken",
    ),
    (
        "telemetry.times",
        {"times": TimeTags({"x": 3}, {}, {"x": np.array([0.0, 0.5, 7.0])})},
        "the header times of 1 of 3 packets contradict the image or step that they report, by up to 7.0 s",
    ),
    (
        "telemetry.times",
        {"times": TimeTags(backwards=2)},
        "2 packets more than in the baseline are out of order in time",
    ),
    (
        "telemetry.frames_without_value",
        {"answered": np.arange(FRAMES) > 0},
        "no detections in 1 of 49 frames on which the baseline has one",
    ),
    (
        "telemetry.frames_without_value",
        {"estimators": {}},
        "no state of the estimator anchored in 49 of 49 frames on which the baseline has one",
    ),
    ("navigation.wrong_fixes", {"wrong": 3}, "3 fixes are wrong, against 0 of the baseline"),
    ("memory", {"memory_mib": 320.0}, "peak memory rises from 250 to 320 MiB"),
    ("latency.total", {"latency_ms": {"a": np.full(FRAMES, 56.0)}}, "processor time of a frame rises from 40 to 56 ms"),
    ("latency.start", {"cpu_s": TIMES["cpu_s"] + 2.0}, "processor time of the start rises from 3 to 5 s"),
]


def wrong(passes, count):
    """Return the passes with so many wrong fixes in pass 0."""
    of = passes["pass 0"].estimators["anchored"]
    return changed(passes, estimators={"anchored": replace(of, wrong=(np.arange(FRAMES) < count) * 1.0)})


@mark.parametrize("name, fault, reason", EXACT)
def test_a_gross_failure_on_one_pass_fails_in_one_sentence(name, fault, reason):
    before = suite(0, 1, 1, **TIMES)
    after = wrong(before, fault["wrong"]) if "wrong" in fault else changed(before, **fault)
    assert name in failed(before, after)
    assert judged(before, after, name).reason == (reason if name in COSTS else f"pass 0: {reason}")
    # It is one of both builds' if the baseline has it too.
    assert name not in failed(after, after)
    # Faults of the telemetry fail under a policy that names other gates only.
    narrow = failed(before, after, NARROW)
    assert narrow <= failed(before, after)
    assert (name in narrow) == name.startswith("telemetry.")


def test_processor_times_are_compared_by_the_median_of_their_ratios_from_five_passes_on():
    """Below five passes 35 % are tolerated, then 15 %; one pass of five on a busy machine decides nothing."""

    def slower(factor):
        return {**TIMES, "latency_ms": {"a": np.full(FRAMES, 40.0 * factor)}}

    for passes, factor, outcome in (4, 1.3, "pass"), (4, 1.4, "fail"), (5, 1.2, "fail"), (5, 1.1, "pass"):
        after = suite(1, passes, **slower(factor))
        assert judged(suite(0, passes, **TIMES), after, "latency.total").outcome == outcome
    busy = {**suite(1, **TIMES), "pass 0": simulated(0, 1, **slower(10.0))}
    assert judged(suite(0, **TIMES), busy, "latency.total").outcome == "pass"


def test_a_program_without_times_is_judged_by_its_run_and_a_share_of_the_baseline_is_a_percentage():
    """Four times the processor time fails although all packets are the same; half a second more is tolerated."""
    before = suite(0, 2, cpu_s=5.0)
    for cpu_s, outcome in (20.0, "fail"), (5.4, "pass"), (float("nan"), "not judged"):
        gates = by_name(judge(before, suite(0, 2, cpu_s=cpu_s), POLICY))
        assert (gates["latency.run"].outcome, gates["latency.total"].outcome) == (outcome, "not judged")
    assert judged(suite(0, 2, cpu_s=0.1), suite(0, 2, cpu_s=0.4), "latency.run").passed
    gates = by_name(judge(suite(0, 12), suite(1, 12), POLICY))
    assert (gates["navigation.anchored.p50"].relative, gates["detector.recall"].relative) == (True, False)
    assert [loss_text(one, True) for one in (0.005, 0.15, 70.7)] == ["0.5 %", "15 %", "7,070 %"]
    assert loss_text(0.0153, False) == "0.0153"


def test_placebos_are_rejected_as_often_as_their_level_allows_and_a_noisier_metric_is_uncalibrated():
    before, after = suite(0, 60), suite(1, 60)
    noise = [
        one
        for name in before
        for one in pass_noise(before[name], after[name], POLICY, "sparse" if name < "pass 3" else "cratered")
    ]
    found = {(one.metric, one.condition): one for one in calibrations(noise)}
    recall = found["detector.recall", ""]
    assert recall.calibrated and recall.placebos == 60 and 0.3 < recall.mean_square < 2.0
    assert recall.rejected <= largest_count(60, 0.05)
    parts = [found["detector.recall", kind].placebos for kind in ("cratered", "sparse")]
    assert sum(parts) == 60 and min(parts) > 20
    worse = [one.model_copy(update={"p_value": 0.01}) if k < 60 else one for k, one in enumerate(noise)]
    noisy = {one.metric: one for one in calibrations(worse) if not one.condition}["detector.recall"]
    assert not noisy.calibrated
    assert noisy.text == f"uncalibrated: detector.recall: {noisy.rejected} of 60 placebos rejected at 0.05"


def test_exact_gates_and_the_verdict_of_a_placebo_are_rejected_if_they_fail():
    gates = judge(suite(0, 1), changed(suite(1, 1), undecodable=1), POLICY)
    noise = gate_noise(gates, POLICY)
    assert gate_noise([], POLICY) == []
    rows = {one.metric: one.p_value for one in noise}
    assert rows["telemetry.undecodable"] == rows["verdict"] == 0.0 < rows["memory"]
    assert "latency.total" not in rows  # not measured
    assert all(one.calibrated for one in calibrations(noise))  # one failure may be chance
    doubted = {one.metric for one in calibrations(2 * noise) if not one.calibrated}
    assert doubted == {"telemetry.undecodable", "verdict"}


def test_a_position_without_a_reference_is_a_value_and_its_wrong_fixes_are_not_judged():
    before, silence = suite(0, 1), "telemetry.frames_without_value"
    anchored = replace(before["pass 0"].estimators["anchored"], error_m=np.full(FRAMES, np.nan))
    unknown = changed(before, estimators={"anchored": anchored})
    assert silence not in failed(before, unknown)
    silent = replace(anchored, stated=np.arange(FRAMES) > 3)
    assert silence in failed(unknown, changed(before, estimators={"anchored": silent}))
    before = suite(1, passes=1)
    unknown = _estimator(np.ones(FRAMES, np.bool_), np.full((FRAMES, 3), np.nan), np.ones((FRAMES, 3)), {0: "fixed"})
    after = changed(before, estimators={"anchored": unknown})
    assert judged(before, after, "navigation.wrong_fixes").outcome == "not judged"


def test_exact_gates_tolerate_what_the_policy_says():
    one, five = suite(0, 1), suite(0, 5)
    # One in a hundred of 49 frames is none; a quarter of 250 MiB is 312.5.
    assert "navigation.wrong_fixes" in failed(one, wrong(one, 1))
    assert failed(five, wrong(five, 2)) == failed(one, changed(one, memory_mib=312.0)) == set()
    # With a wrong reference the fixes of both builds are wrong: 9 of them vary by 2.33 times their root, which is 7.
    others = {name: wrong({"pass 0": frames}, 1)["pass 0"] for name, frames in five.items()}
    for count, rest, names in (
        (16, five, set()),
        (19, five, {"navigation.wrong_fixes"}),
        (16, others, {"navigation.wrong_fixes"}),
    ):
        assert failed(wrong(five, 9), wrong(rest, count)) == names


def test_passes_without_images_judge_fixes_and_telemetry_and_no_metric_that_builds_lack():
    gates = by_name(judge(suite(0, 2), suite(1, 2, recall=0.2, fixes=0.5), POLICY, imaged=()))
    assert gates["detector.recall"].reason == "no pass was replayed from images"
    assert gates["detector.recall"].outcome == gates["memory"].outcome == "not judged"
    assert gates["navigation.anchored.fixes"].outcome == "fail"
    assert "latency.network" not in gates and "detector.bias" not in gates
    before, after = (changed(suite(noise, 1), estimators={}) for noise in (0, 1))
    gates = judge(before, after, POLICY)
    assert by_name(gates)["navigation.anchored.fixes"].reason == "neither build has this metric"
    assert verdict_of(gates) == "pass"


def test_other_metrics_inform_and_never_decide():
    before = suite(0, 12)
    after = {
        name: replace(one, octets=one.octets * (1.5 + 0.01 * k)) for k, (name, one) in enumerate(suite(1, 12).items())
    }
    gates = judge(before, after, POLICY)
    volume = by_name(gates)["telemetry.octets_per_frame"]
    assert (volume.outcome, volume.reason) == ("informs", "worse (+55%, 12 passes)")
    assert volume.level == approx(0.01 / sum(gate.outcome == "informs" for gate in gates))
    assert verdict_of(gates) == "pass"
    few = judge(suite(0, 3), suite(1, 3), POLICY)
    assert {gate.reason for gate in few if gate.outcome == "informs"} == {""}


def test_levels_are_shared_by_weight_and_between_all_passes_and_parts():
    gates = by_name(judge(suite(0, 2), suite(1, 2), POLICY))
    levels = {name: gate.level for name, gate in gates.items() if gate.level < 0.005 and gate.outcome == "pass"}
    assert levels == approx(
        {
            "detector.recall": 0.0015,
            "detector.precision": 0.00075,
            "detector.localisation": 0.00075,
            "navigation.anchored.fixes": 0.001,
        }
    )


@mark.parametrize(
    "outcomes, verdict",
    [
        ("", "inconclusive"),
        ("pass", "pass"),
        ("memory:pass", "inconclusive"),
        ("pass inconclusive", "inconclusive"),
        ("inconclusive fail", "fail"),
        ("pass not_judged informs", "pass"),
    ],
)
def test_the_verdict_is_that_of_the_worst_deciding_gate(outcomes, verdict):
    parts = [one.replace("_", " ").rpartition(":") for one in outcomes.split()]
    gates = [Gate(name or "x", outcome, 1.0, 1.0, 0.1, 0.9) for name, _, outcome in parts]
    assert verdict_of(gates) == verdict


def test_a_pass_that_is_not_judged_leaves_the_verdict_to_the_others():
    gate = Gate("x", "pass", 1.0, 1.0, 0.1, 0.9)
    for states, verdict in (
        ("judged, not judged", "pass"),
        ("not judged", "inconclusive"),
        ("judged, unusable", "inconclusive"),
        ("judged, candidate failed", "fail"),
    ):
        passes = tuple(PassVerdict(state, "", state, "") for state in states.split(", "))
        assert RegressionOutcome(None, None, None, (gate,), passes).verdict == verdict


def test_changed_craters_are_counted_by_track():
    """Two passes over the zero meridian, and a build that finds fewer craters on them."""
    before, after = suite(0, 2), suite(1, 2, recall=0.5)
    places = np.radians(np.linspace(-10.0, 10.0, 150))
    context = SimpleNamespace(catalogue=make_catalogue(places, places, np.full(150, 6_000.0), source="test"))
    reads = [[SimpleNamespace(frames=one) for one in build.values()] for build in (before, after)]
    judged = [SimpleNamespace(context=context, baseline_read=a, candidate_read=b) for a, b in zip(*reads, strict=True)]
    found = changed_craters(judged)
    hits = [sum(one.craters.hit.sum() for one in build.values()) for build in (before, after)]
    assert len(found.change) == 300 and found.change.sum() == hits[1] - hits[0] < 0
    assert np.ptp(found.longitude_deg) == approx(20.0)
    dark = stretched(np.arange(10, 30, dtype=np.uint8))
    assert (dark[0], dark[-1]) == (0, 255)


def test_only_passes_of_both_builds_are_compared_and_what_the_baseline_lacks_is_open():
    assert judge({}, {}, POLICY) == []
    before, after = suite(0, 2), suite(1, 2)
    del after["pass 0"]
    assert judged(before, after).frames == FRAMES
    fixes = judged(changed(suite(0, 1), estimators={}), suite(1, 1), "navigation.anchored.fixes")
    assert (fixes.outcome, fixes.reason) == ("inconclusive", "unknown: the baseline has no value")


def test_what_the_frames_can_detect_is_stated_before_a_run():
    few, many = detectable(POLICY, 80, 2), detectable(POLICY, 1000, 20)
    weighted = [rule.metric for rule in POLICY.rules if rule.weight]
    assert [one["metric"] for one in few] == weighted[:-1]  # position errors need ten passes
    assert all(a["change"] > b["change"] for a, b in zip(few, many, strict=True))
    assert power_text(few).startswith(
        "all passes together (80 frames, 0.4 minutes of a core for the candidate) find with a power of 0.8 a loss of: "
    )
    assert detectable(POLICY, 0, 0) == []


def test_squared_normalised_errors_are_summed_over_the_axes_and_unknown_without_every_sigma():
    error = np.array([[3.0, 8.0, 10.0], [3.0, 8.0, 10.0], [3.0, 8.0, 10.0], [np.nan, 8.0, 10.0]])
    sigma = np.array([[1.0, 2.0, 5.0], [1.0, 2.0, np.nan], [1.0, 0.0, 5.0], [1.0, 2.0, 5.0]])
    frames = _estimator(np.ones(4, np.bool_), error, sigma, {})
    # 3^2 + 4^2 + 2^2; a sigma of zero is no claim that can be judged.
    assert frames.squared_normalised_error[0] == approx(29.0)
    assert np.isnan(frames.squared_normalised_error[1:]).all()
    assert not hasattr(frames, "nees")


def test_a_track_is_one_crater_in_one_visit_and_a_cell_is_where_its_sight_meets_the_sphere():
    crater = np.array([7, 3, 7, 7, 3, 7])
    frame = np.array([0, 0, 1, 2 + VISIT_GAP_FRAMES, 1, 1 + VISIT_GAP_FRAMES])
    # Crater 7 is out of view for as long as a visit may have gaps, and is then seen twice: still one track.
    assert _tracks(crater, frame).tolist() == [1, 0, 1, 1, 0, 1]
    frame[[3, 5]] += 1
    assert _tracks(crater, frame).tolist() == [1, 0, 1, 2, 0, 2]
    # From 100 km above 10.1 N 20 E: nadir, 3 degrees off nadir (5.2 km, below a cell), and above the horizon.
    up = mcmf_from_spherical(np.radians(10.1), np.radians(20.0))
    up = up / np.linalg.norm(up)
    east = np.cross([0.0, 0.0, 1.0], up) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], up))
    tilt = np.radians(3.0)
    lines = np.array([-up, -np.cos(tilt) * up + np.sin(tilt) * east, east])
    cells = _cells(np.tile((MOON_RADIUS_M + 100e3) * up, (3, 1)), lines)
    # Rows of 0.25 degrees; columns of 0.25 degrees of arc, 20 cos 10 at this latitude.
    assert cells.tolist() == [40 * 100_000 + 78, 40 * 100_000 + 79, -1]


def test_terrain_is_cratered_by_its_density_and_holm_steps_down_as_in_the_textbook():
    """Forty craters of 6 km around 0 N 0 E, 32 within 100 km are the limit; one alone at 0 N 90 E."""
    around = np.linspace(-1.0, 1.0, 40)
    longitude = np.radians(np.append(around, 90.0))
    catalogue = make_catalogue(0.0 * longitude, longitude, np.full(41, 6_000.0), source="test")
    expected = ExpectedCraters(*(np.array([5, 40]) for _ in range(7)))
    kinds = terrain_kinds(catalogue, expected, np.array([0, 1]))
    assert [KINDS[kind] for kind in kinds] == ["cratered", "sparse"]
    # Four p-values at 0.05: 0.005 and 0.01 are refused (0.0125, 0.0167), 0.03 is kept at 0.025, all after it too.
    p_values = [0.01, 0.04, 0.03, 0.005]
    levels = holm_levels(p_values, 0.05)
    assert [p <= level for p, level in zip(p_values, levels, strict=True)] == [True, False, False, True]
    assert levels == approx([0.05 / 3, 0.025, 0.025, 0.0125])
    assert holm_levels([], 0.05) == []


def sums(unit, numerator, denominator, stratum=0):
    return unit_sums(
        np.array(unit), np.full(len(unit), stratum), np.array(numerator, float), np.array(denominator, float)
    )


def test_rows_are_summed_by_unit_and_units_of_either_build_are_aligned():
    before, after = sums([7, 3, 7], [1, 1, 0], [1, 1, 1]), sums([3, 9], [1, 0], [1, 1])
    assert (before.unit.tolist(), before.numerator.tolist(), before.denominator.tolist()) == ([3, 7], [1, 1], [1, 2])
    first, second = aligned(before, after)
    assert first.unit.tolist() == second.unit.tolist() == [3, 7, 9]
    assert (first.denominator.tolist(), second.denominator.tolist()) == ([1, 2, 0], [1, 0, 1])
    assert joined_sums([first, second]).value == approx(3 / 5)
    assert np.isnan(sums([], [], []).value)


def test_the_error_of_a_ratio_is_that_of_a_mean_without_differences_between_kinds_of_terrain():
    values = np.random.default_rng(1).standard_normal(400)
    one = UnitSums(np.arange(400), np.zeros(400, np.int64), values, np.ones(400))
    assert ratio_error(one) == approx(np.std(values, ddof=1) / 20.0)
    assert np.isnan(ratio_error(sums([1], [1], [1])))
    # All units of one kind change by 1, all of the other by 0: within each kind nothing varies.
    kind = np.repeat([0, 1], 50)
    before = UnitSums(np.arange(100), kind, np.zeros(100), np.ones(100))
    after = UnitSums(np.arange(100), kind, kind.astype(float), np.ones(100))
    change = ratio_change(before, after)
    assert (change.estimate, change.error, change.units) == (0.5, approx(1.8 / 100), 100)


@mark.parametrize("correlated", [False, True])
def test_a_one_sided_test_is_wrong_as_often_as_it_says(correlated):
    """400 pairs of equal builds, rows of a track alike or independent, at 5 %."""
    rng, wrong = np.random.default_rng(3), 0
    size = rng.integers(1, 8, 120)
    track = np.repeat(np.arange(120), size)
    for _ in range(400):
        draws = rng.random((2, 120))[:, track] if correlated else rng.random((2, len(track)))
        before, after = (
            unit_sums(track, np.zeros_like(track), (row < 0.7).astype(float), np.ones(len(track))) for row in draws
        )
        change = ratio_change(before, after)
        wrong += student_upper_tail(-change.estimate / change.error, change.units - 1) < 0.05
    assert 0 < wrong <= stats.binom.isf(1e-4, 400, 0.05)


def test_the_change_of_passes_is_a_ratio_or_a_difference_and_frames_follow_the_square_of_its_error():
    before, after = np.array([1.0, 2.0, 4.0, np.nan]), np.array([2.0, 4.0, 8.0, 1.0])
    assert mean_change(before, after, relative=True).estimate == approx(np.log(2.0))
    change = mean_change(before, after, relative=False)
    assert (change.estimate, change.units) == (approx(7.0 / 3.0), 3)
    assert change.error == approx(np.std([1.0, 2.0, 4.0], ddof=1) / np.sqrt(3.0))
    assert (change.baseline, change.candidate) == (2.0, 3.0)
    assert mean_change(before[3:], after[3:], relative=True).units == 0
    assert frames_needed(100, 0.05, 0.01, 1.0) == 2500
    assert frames_needed(100, 0.05, 0.0, 1.0) is None
    assert frames_needed(10, 1.0, 1e-6, 1.0) is None
    assert frames_needed(0, 0.05, 0.01, 1.0) is None
