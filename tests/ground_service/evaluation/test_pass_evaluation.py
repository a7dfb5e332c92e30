"""A pass on a circular orbit over a Moon that does not turn: every figure of its report, worked out here.

The orbit is equatorial, 32 km up, and mean-Earth axes are those of ICRF: radial is along the longitude, transverse
east, normal north. Each frame sees three craters of its own: 6 km below, 12 km 0.1 degrees north, 20 km 0.1 degrees
south.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark

from ground_service.evaluation.core import PassInputs, _imaging_arcs, _joined, evaluate_pass, summary_of
from ground_service.evaluation.fixes import IdentificationSamples, MappedCraters
from ground_service.evaluation.model import PassFigures
from ground_service.evaluation.recall import Viewing
from ground_service.evaluation.smoother import ONBOARD, FilterStates, StartState
from ground_service.telemetry.samples import DetectionSamples, NavigationSamples, OutcomeSamples, no_detections
from lunar.camera import PinholeCamera
from lunar.catalogue import make_catalogue
from lunar.ephemeris import ephemeris_from_states
from lunar.errors import LunarError
from lunar.frames import axis_rotation, quaternion_from_matrix
from lunar.gravity import GravityField, builtin_gravity
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from reports.values import AnchorRead, FrameAccounting, PacketAccounting, Requirements, TerrainMap, TimeSpan
from tests.ground_service.evaluation.still import Still

SECOND = 1_000_000_000
EPOCH = parse_utc("2029-08-07T00:00:00Z")
FRAMES, CADENCE_S = 12, 15.0
TIMES = EPOCH + np.arange(FRAMES) * 15 * SECOND
MOON_M, ALTITUDE_M = 1_737_400.0, 32_000.0
RADIUS_M = MOON_M + ALTITUDE_M
GM = builtin_gravity().gm_m3_s2
RATE = math.sqrt(GM / RADIUS_M**3)
STEP_DEG = math.degrees(RATE * CADENCE_S)
STEP_M = MOON_M * RATE * CADENCE_S
LONGITUDE_DEG = STEP_DEG * np.arange(FRAMES)
CAMERA = PinholeCamera(512, 512, math.radians(30.0))
FOCAL_PX = 256.0 / math.tan(math.radians(15.0))
REFERENCE_SIGMA_M = (20.0, 10.0, 5.0)
POINT = GravityField("point", RATE**2 * (RADIUS_M + 30.0) ** 3, MOON_M, np.ones((1, 1)), np.zeros((1, 1)))
"""A field in which a circle 30 m higher is flown in the same time."""


def circle(seconds):
    """Position and velocity (n, 3) of the orbit so long after the epoch."""
    angle = RATE * np.asarray(seconds, dtype=np.float64)
    zero = np.zeros_like(angle)
    outward = np.stack([np.cos(angle), np.sin(angle), zero], axis=-1)
    ahead = np.stack([-np.sin(angle), np.cos(angle), zero], axis=-1)
    return RADIUS_M * outward, RADIUS_M * RATE * ahead


def reference(stop_s=600.0):
    seconds = np.arange(-300.0, stop_s + 1.0, 10.0)
    return ephemeris_from_states(EPOCH + (seconds * SECOND).astype(np.int64), *circle(seconds))


def catalogue():
    """Craters 10 k, 10 k + 1 and 10 k + 2 below, north and south of frame k."""
    return make_catalogue(
        np.radians(np.tile([0.0, 0.1, -0.1], FRAMES)),
        np.radians(np.repeat(LONGITUDE_DEG, 3)),
        np.tile([6e3, 12e3, 20e3], FRAMES),
        source="made",
        ids=(10 * np.arange(FRAMES)[:, None] + np.arange(3)).ravel(),
        rim_height_m=np.zeros(3 * FRAMES),
    )


UP_M = 3 * [ALTITUDE_M] + np.array([0.0, 1.0, 1.0]) * MOON_M * (1.0 - math.cos(math.radians(0.1)))
DIAMETER_PX = FOCAL_PX * np.array([6e3, 12e3, 20e3]) / UP_M
V_PX = 255.5 + FOCAL_PX * np.array([0.0, -1.0, 1.0]) * MOON_M * math.sin(math.radians(0.1)) / UP_M
LOST, PARTLY, DARK = 3, 5, 7
"""Frames in which the detector sees nothing but a false alarm; misses the 20 km crater; has no fit image."""


def detections():
    """Each crater is seen 0.6 px to the right of and 0.8 px below where it is."""
    frame, crater = np.divmod(np.arange(3 * FRAMES), 3)
    lost = frame == LOST
    seen = (frame != DARK) & ~(lost & (crater > 0)) & ~((frame == PARTLY) & (crater == 2))
    frame, crater, lost = frame[seen], crater[seen], lost[seen]
    return DetectionSamples(
        frame_number=100 + np.arange(FRAMES),
        utc_ns=TIMES,
        usable=np.arange(FRAMES) != DARK,
        quality=tuple("dark" if frame == DARK else "ok" for frame in range(FRAMES)),
        offsets=np.searchsorted(frame, np.arange(FRAMES + 1)),
        u_px=np.where(lost, 20.0, 256.1),
        v_px=np.where(lost, 20.0, V_PX[crater] + 0.8),
        diameter_px=np.where(lost, 60.0, DIAMETER_PX[crater]),
        score=np.full(len(frame), 0.75),
        size_class=crater,
    )


EAST_M = 200.0 * (np.arange(FRAMES) % 6)
"""Arc by which odometry runs ahead: 200 m a frame, taken back by a reset at the seventh."""


def paper(**changed):
    values = {
        "estimator": "paper",
        "frame_number": 100 + np.arange(FRAMES),
        "utc_ns": TIMES,
        "latitude_deg": np.zeros(FRAMES),
        "longitude_deg": LONGITUDE_DEG + np.degrees(EAST_M / RADIUS_M) - 360.0,
        "altitude_m": np.full(FRAMES, ALTITUDE_M),
        "sigma_rtn_m": np.full((FRAMES, 3), np.nan),
        "nis": np.full(FRAMES, np.nan),
        "matched": np.arange(FRAMES),
        "outcome": ("matched",) * FRAMES,
    }
    return NavigationSamples(**values | changed)


def anchored(**changed):
    """30 m too high, with a fix at the frames 1 and 4."""
    fixed = np.isin(np.arange(FRAMES), (1, 4))
    values = {
        "estimator": "anchored",
        "longitude_deg": LONGITUDE_DEG,
        "altitude_m": np.full(FRAMES, ALTITUDE_M + 30.0),
        "sigma_rtn_m": np.tile([10.0, 20.0, 30.0], (FRAMES, 1)),
        "nis": np.where(fixed, 7.0, np.nan),
        "matched": 4 * fixed,
        "outcome": tuple(np.where(fixed, "fixed", "predicted").tolist()),
    }
    return paper(**values | changed)


def first(count):
    """The first states of the paper's estimator."""
    _, *names = NavigationSamples.__slots__
    return paper(**{name: getattr(paper(), name)[:count] for name in names})


TRIGGERS = ("initialization", *["none"] * 5, "safety_timeout", *["none"] * 5)


def outcomes():
    """Of all frames but the third; the anchor is read at the start and at the reset."""
    kept = np.delete(np.arange(FRAMES), 2)
    triggers = tuple(TRIGGERS[k] for k in kept)
    matched = ("matched",) * len(kept)
    return OutcomeSamples("paper", 100 + kept, TIMES[kept], matched, triggers, 50 + kept, 1 + kept // 6)


def filter_states():
    """States 30 m above the circle, 10 m to each axis, and one between two frames."""
    seconds = np.sort(np.append(CADENCE_S * np.arange(FRAMES), 20.0))
    position, velocity = circle(seconds)
    position, velocity = position * (1.0 + 30.0 / RADIUS_M), velocity * (1.0 + 30.0 / RADIUS_M)
    state = np.concatenate([position, velocity, np.zeros((len(seconds), 3))], axis=1)
    covariance = np.tile(np.diag([100.0] * 3 + [1e-2] * 3 + [1e-12] * 3), (len(seconds), 1, 1))
    degrees = np.where(seconds == 15.0, 6, -1)
    return FilterStates(EPOCH + (seconds * SECOND).astype(np.int64), state, covariance, ONBOARD, degrees)


IMAGES = {100 + frame: np.full((512, 512), frame, dtype=np.uint8) for frame in (0, 2, 4, 5)}
PACKETS = PacketAccounting(1900, lost=80, lost_at_edges=20)
BASELINES = ("propagate-only", "propagate-only, perfect start", "Kepler")
START = StartState(EPOCH, circle(0.0)[0] + np.array([100.0, 0.0, 0.0]), circle(0.0)[1])


def inputs(**changed):
    values = {
        "pass_id": "7",
        "title": "a made pass",
        "start_utc_ns": EPOCH,
        "stop_utc_ns": EPOCH + 200 * SECOND,
        "packets": PACKETS,
        "viewing": Viewing(CAMERA),
        "orientation": Still(),
        "onboard_orientation": Still(),
        "reference": reference(),
        "catalogue": catalogue(),
        "detections": detections(),
        "navigation": (paper(), anchored()),
        "outcomes": (outcomes(),),
        "gravity": builtin_gravity(),
        "reference_sigma_rtn_m": REFERENCE_SIGMA_M,
        "limits": Requirements(estimator="paper", median_error_m=1_000.0),
        "frames_expected": 14,
        "cadence_s": CADENCE_S,
        "images": IMAGES,
    }
    return PassInputs(**values | changed)


def evaluated(**changed):
    return evaluate_pass(inputs(**changed))


@fixture(scope="module")
def report():
    return evaluated()


def series(report, name):
    (found,) = [one for one in report.navigation if one.name == name]
    return found


def scored(report):
    """The score over all classes and how it was made."""
    return report.detector.micro, report.detector.method


MEDIAN_M, MAX_M = approx(500.0, abs=0.01), approx(1_000.0, abs=0.01)
# 1000 m over five steps in each of the two stretches.
DRIFT = approx(100.0 * 200.0 / STEP_M, rel=1e-6)
# 20, 10 and 5 m make 22.91 m.
REFERENCE_M = approx(22.9129, abs=1e-4)


def test_odometry_is_compared_with_the_reference_in_its_axes(report):
    found = series(report, "paper")
    angle = EAST_M / RADIUS_M
    expected = RADIUS_M * np.stack([np.cos(angle) - 1.0, np.sin(angle), np.zeros(FRAMES)], axis=1)
    # The ephemeris is interpolated over 10 s: micrometres.
    assert_allclose(found.error_rtn_m, expected, atol=1e-4)
    assert (found.kind, found.description) == (
        "estimate",
        "the paper's visual odometry on a flat Moon, for passes to the north or south",
    )
    assert_allclose(found.longitude_deg, LONGITUDE_DEG + np.degrees(angle), atol=1e-9)
    size = 2.0 * RADIUS_M * np.sin(angle / 2.0)
    assert found.statistics.median_3d_m == approx(np.median(size), abs=1e-4)
    assert found.statistics.max_3d_m == approx(size.max(), abs=1e-4)
    assert found.statistics.path_length_m == approx(11 * STEP_M, rel=1e-9)
    assert found.statistics.drift_percent == DRIFT
    assert [one.path_length_m for one in found.drift_by_length] == [100e3]
    assert found.sigma_rtn_m is None and found.nees is None and found.squared_normalised_errors is None
    assert found.nis is None and found.nis_dof is None and found.time_since_fix_s is None
    rms = float(np.sqrt(np.mean(size**2)))
    assert found.error_budget.reference_rms_m == REFERENCE_M
    assert found.error_budget.estimate_rms_m == approx(math.sqrt(rms**2 - 525.0), rel=1e-6)


def test_what_the_matcher_did_stands_at_the_frames_it_did_it_at(report):
    found = series(report, "paper")
    assert found.reset_trigger == TRIGGERS
    assert found.candidates.tolist() == [50, 51, 0, *range(53, 62)]
    assert found.matched.tolist() == list(range(FRAMES))
    assert np.flatnonzero(np.isfinite(found.reset_error_m)).tolist() == [6]
    assert found.reset_error_m[6] == approx(RADIUS_M * math.sin(1_000.0 / RADIUS_M), abs=1e-4)
    assert (found.anchor_reads, found.anchor_reads_after_start) == (2, 1)
    assert report.truth_ledger == (
        AnchorRead("paper", int(TIMES[0]), "initialization", 100),
        AnchorRead("paper", int(TIMES[6]), "safety_timeout", 106),
    )


def test_the_filter_has_a_sum_over_its_sigmas_and_neither_resets_nor_reads(report):
    found = series(report, "anchored")
    assert_allclose(found.error_rtn_m, FRAMES * [[30.0, 0.0, 0.0]], atol=1e-4)
    assert found.nees is None and found.sigma_rtn_m is not None and found.nis is not None
    assert_allclose(found.squared_normalised_errors, 9.0, rtol=1e-5)
    assert found.nis_dof.tolist() == [0, 8, 0, 0, 8, *[0] * 7]
    assert_allclose(found.time_since_fix_s, [math.nan, 0.0, 15.0, 30.0, *(15.0 * np.arange(8))])
    assert (found.reset_trigger, found.candidates, found.reset_error_m) == ((), None, None)
    assert (found.anchor_reads, found.anchor_reads_after_start) == (0, None)
    assert found.description == "navigation filter on catalogued craters"


def test_full_covariances_of_filter_and_reference_make_a_nees():
    """Radially 10 m of the filter and 20 m of the reference: 30^2 / (10^2 + 20^2)."""
    states = filter_states()
    report = evaluated(filter_states=states)
    found = series(report, "anchored")
    assert_allclose(found.nees, 900.0 / 500.0, rtol=1e-5)
    assert found.squared_normalised_errors is None
    # Six degrees came down for the first fix; for the second twice its four craters count.
    assert found.nis_dof.tolist() == [0, 6, 0, 0, 8, *[0] * 7]
    none = replace(states, innovation_degrees=np.maximum(states.innovation_degrees, 0))
    assert series(evaluated(filter_states=none), "anchored").nis_dof.tolist() == [0, 6, *[0] * 10]
    assert series(report, "paper").nees is None
    without = series(evaluated(filter_states=states, reference_sigma_rtn_m=None), "anchored")
    assert_allclose(without.nees, 9.0, rtol=1e-5)
    assert without.error_budget is None
    # States of other instants say nothing of these.
    late = replace(states, utc_ns=states.utc_ns + 1)
    assert series(evaluated(filter_states=late), "anchored").nees is None
    # Every second of 13 states, of which the third is of no frame: 0, 20, 45, 75 s and so on.
    some = series(evaluated(filter_states=states.select(np.arange(FRAMES + 1) % 2 == 0)), "anchored")
    assert np.flatnonzero(np.isfinite(some.nees)).tolist() == [0, 3, 5, 7, 9, 11]


def test_the_filter_is_smoothed_in_icrf_with_its_own_field():
    """States that follow on one another need no correction: the smoothed orbit errs as the filter does.

    The inertial axes of the payload are turned against ICRF by a degree.
    """
    turn = np.kron(np.diag([1.0, 1.0, 0.0]), axis_rotation(3, -np.radians(1.0)))

    class Turned(Still):
        def mcmf_from_icrf(self, tdb_s):
            return turn[:3, :3].T @ super().mcmf_from_icrf(tdb_s)

    own = filter_states()
    own = replace(own, state=own.state @ turn.T)
    report = evaluated(filter_states=own, onboard_orientation=Turned(), onboard_gravity=POINT)
    found = series(report, "smoothed")
    assert (found.kind, found.utc_ns.tolist()) == ("smoothed", TIMES.tolist())
    # The Earth's tide, 1e-5 m/s^2, moves the orbit by 0.1 m over the pass.
    assert_allclose(found.error_rtn_m, FRAMES * [[30.0, 0.0, 0.0]], atol=0.2)
    assert report.provenance["gravity of the smoother"] == "point, degree 0, with Earth and Sun"
    assert found.error_budget.reference_rms_m == REFERENCE_M
    assert np.all(found.nees < 2.0)
    assert summary_of(report)["smoothed"]["smoothed"]["end_of_pass_m"] == approx(30.0, abs=0.2)


@mark.parametrize(
    "changed, reasons",
    [
        ({}, ["no field or orientation on board is given"]),
        ({"refused": {"onboard_gravity": "field X is not here"}}, ["field X is not here"]),
        ({"onboard_gravity": POINT, "onboard_orientation": None}, ["no field or orientation on board is given"]),
        ({"filter_states": filter_states().select(np.zeros(13, dtype=np.bool_))}, []),
    ],
)
def test_why_there_is_no_smoothed_orbit(changed, reasons):
    report = evaluated(**{"filter_states": filter_states(), **changed})
    assert "smoothed" not in [one.name for one in report.navigation]
    remarks = [one for one in report.remarks if "smoothed" in one]
    assert remarks == [f"no smoothed orbit: {reason}" for reason in reasons]


def of_baselines(report):
    return [one for one in report.navigation if one.kind == "baseline"]


def test_the_start_state_is_propagated_with_every_field_and_from_the_reference():
    """100 m too high at the same velocity: Clohessy and Wiltshire give 100 (2 - cos nt) and 200 sin nt - 300 nt."""
    report = evaluated(start_state=START, onboard_gravity=replace(builtin_gravity(), name="other"))
    baselines = of_baselines(report)
    field = builtin_gravity().name
    words = "propagated with {} to degree 12, Earth and Sun"
    assert [(one.name, one.description) for one in baselines] == [
        ("propagate-only", f"start state of the filter {words.format(field)}"),
        ("propagate-only, other", f"start state of the filter {words.format('other')}"),
        ("propagate-only, perfect start", f"state of the reference {words.format(field)}"),
        ("Kepler", "start state of the filter on its two-body orbit"),
    ]
    flown, other, perfect, kepler = baselines
    angle = RATE * CADENCE_S * np.arange(FRAMES)
    expected = np.stack(
        [100.0 * (2.0 - np.cos(angle)), 200.0 * np.sin(angle) - 300.0 * angle, np.zeros(FRAMES)], axis=1
    )
    # Second order: 100 m squared over the radius.
    assert_allclose(kepler.error_rtn_m, expected, atol=0.05)
    assert_allclose(kepler.altitude_m, ALTITUDE_M + expected[:, 0], atol=0.05)
    ahead = np.degrees(expected[:, 1] / RADIUS_M)
    assert_allclose(kepler.longitude_deg, (LONGITUDE_DEG + ahead) % 360.0, atol=1e-5)
    assert_allclose(kepler.latitude_deg, 0.0, atol=1e-6)
    assert kepler.statistics.path_length_m == approx(11 * STEP_M, rel=1e-9)
    assert [one.path_length_m for one in kepler.drift_by_length] == [100e3, 200e3]
    assert_allclose(flown.error_rtn_m[0], [100.0, 0.0, 0.0], atol=1e-4)
    # Lunar mass concentrations pull by some mm/s^2: metres to tens of metres in 165 s, the same for both fields.
    assert 1.0 < np.linalg.norm(perfect.error_rtn_m[-1]) < 100.0
    assert_array_equal(other.error_rtn_m, flown.error_rtn_m)
    assert_allclose(perfect.error_rtn_m[0], 0.0, atol=1e-4)
    assert report.provenance["gravity of the baseline"] == f"{field}, degree 12, with Earth and Sun"
    assert report.headline[1].value == approx(flown.statistics.median_3d_m)


def test_a_start_state_is_propagated_from_its_instant_with_a_perfect_one_if_it_is_worse():
    position, velocity = circle(0.0)
    for east_m, names in (0.9, ["propagate-only", "Kepler"]), (1.1, [*BASELINES]):
        start = StartState(EPOCH, position + np.array([0.0, east_m, 0.0]), velocity)
        report = evaluated(start_state=start, onboard_gravity=builtin_gravity())
        assert [one.name for one in of_baselines(report)] == names
    state = circle(20.0)
    report = evaluated(start_state=StartState(EPOCH + 20 * SECOND, *state))
    # The first sample is 10 s after the start: no distance of two states of one instant, and no perfect start.
    plain, kepler = of_baselines(report)
    assert (plain.name, kepler.name) == ("propagate-only", "Kepler")
    assert kepler.utc_ns.tolist() == TIMES[2:].tolist()
    assert_allclose(kepler.error_rtn_m, 0.0, atol=0.01)
    assert of_baselines(evaluated(start_state=StartState(int(TIMES[-1]) + SECOND, *state))) == []
    moved = position + np.array([0.0, 1.5, 0.0])
    exact, late = (of_baselines(evaluated(start_state=StartState(EPOCH + ns, moved, velocity))) for ns in (0, 12_000))
    assert [one.name for one in exact] == [one.name for one in late] == [*BASELINES]
    for one, other in zip(exact, late, strict=True):
        assert_allclose(one.error_rtn_m, other.error_rtn_m, atol=0.1)


def test_why_there_is_no_baseline(report, monkeypatch):
    assert report.remarks == ("no propagate-only baseline: the pass names no start state",)
    refused = evaluated(start_state=START, gravity=None, refused={"gravity": "field Y is not here"})
    assert refused.remarks == ("no propagate-only baseline: field Y is not here",)

    def fail(*_, **__):
        raise LunarError("it hit the ground")

    monkeypatch.setattr("ground_service.evaluation.core.propagated_positions", fail)
    crashed = evaluated(start_state=START)
    assert crashed.remarks == ("no propagate-only baseline: it hit the ground",)
    assert "gravity of the baseline" not in crashed.provenance


def test_the_reference_is_given_at_every_sample_time_and_samples_outside_have_no_error():
    """The reference ends at 150 s; the last sample is at 165 s."""
    report = evaluated(reference=reference(150.0))
    assert report.remarks[0] == "1 of 12 sample times lie outside the reference ephemeris and have no error"
    found = series(report, "anchored")
    assert np.isnan(found.error_rtn_m[-1]).all() and np.isfinite(found.error_rtn_m[:-1]).all()
    assert found.statistics.path_length_m == approx(10 * STEP_M, rel=1e-9)
    assert math.isnan(report.reference.altitude_m[-1])
    shifted = anchored(utc_ns=TIMES + SECOND)
    report = evaluated(navigation=(paper(), shifted))
    track = report.reference
    assert track.utc_ns.tolist() == sorted([*TIMES, *(TIMES + SECOND)])
    assert_allclose(track.altitude_m, ALTITUDE_M, atol=1e-4)
    assert_allclose(track.longitude_deg[::2], LONGITUDE_DEG, atol=1e-9)
    assert_allclose(track.latitude_deg, 0.0, atol=1e-9)


def test_without_reference_or_orientation_the_report_says_what_was_flown_and_why_no_more():
    report = evaluated(reference=None)
    assert report.not_available == {
        **dict.fromkeys(("error", "reference"), "no reference ephemeris covers this pass"),
        **dict.fromkeys(("detector", "craters"), "it needs a crater catalogue and a reference ephemeris"),
    }
    found, other = report.navigation
    assert (found.name, other.name) == ("paper", "anchored")
    assert np.isnan(found.error_rtn_m).all() and report.reference is None
    assert found.reset_trigger[6] == "safety_timeout"
    assert found.outcome == paper().outcome != ()
    assert report.verdict_level == "unknown"
    for refused, reason in (
        ({}, "no lunar orientation is given"),
        ({"orientation": "kernel Z is not here"}, "kernel Z is not here"),
    ):
        unturned = evaluated(orientation=None, refused=refused)
        assert unturned.not_available == dict.fromkeys(("error", "reference", "detector", "craters"), reason)


def test_a_pass_over_ground_without_a_catalogue_has_no_recall_and_no_precision_and_says_why(report):
    count = 3 * FRAMES
    unknown = evaluated(catalogue=replace(catalogue(), rim_height_m=np.full(count, np.nan)))
    assert unknown.not_available["recall"] == "rim heights unknown"
    assert any(one.startswith("rim heights unknown for 3") for one in unknown.remarks)
    nowhere = evaluated(catalogue=replace(catalogue(), complete=np.zeros(count, dtype=np.bool_)))
    micro, _ = scored(nowhere)
    assert np.isnan([micro.recall, micro.precision]).all()
    assert nowhere.not_available["recall"] == "the crater catalogue has no complete crater of 5 to 30 km in view"
    assert "recall" not in report.not_available


def test_what_did_not_come_down_is_named():
    nothing = evaluated(detections=no_detections(), navigation=(), images={})
    assert nothing.not_available == {
        "baselines": "the pass names no start state",
        "reference": "no frame came down to set against the reference",
        **dict.fromkeys(("detector", "craters"), "no detections came down"),
        **dict.fromkeys(("gallery", "worst_frames"), "no images came down with this pass"),
    }
    assert nothing.navigation == nothing.imaging_arcs == ()
    assert nothing.accounting == FrameAccounting(
        expected=14, acquired=0, processed=0, with_detections=0, navigated=None, bad_image=0
    )
    [only] = evaluated(navigation=(first(0), anchored())).navigation
    assert only.name == "anchored"
    assert evaluated(reference=None, navigation=(first(0),)).navigation == ()


def test_the_map_counts_each_crater_as_often_as_it_was_in_view(report):
    craters = report.craters
    detected = np.ones((FRAMES, 3), dtype=int)
    detected[[LOST, DARK]] = detected[PARTLY, 2] = 0
    assert craters.expected.tolist() == [1] * 36
    assert craters.detected.tolist() == detected.ravel().tolist()
    assert_allclose(craters.latitude_deg[:3], [0.0, 0.1, -0.1], atol=1e-12)
    assert_allclose(craters.longitude_deg[::3], LONGITUDE_DEG, atol=1e-12)
    assert (craters.diameter_m[:3].tolist(), craters.source) == ([6e3, 12e3, 20e3], "made")


def test_the_galleries_show_the_images_and_the_worst_frames(report):
    captions = [(one.frame_number, one.caption) for one in (*report.gallery, *report.worst_frames)]
    assert captions == [
        (frame, f"{hits} of 3 craters of 5–30 km detected")
        for frame, hits in ((100, 3), (102, 3), (104, 3), (105, 2), (105, 2))
    ]
    assert report.not_available["worst_frames"] == (
        "1 of the 2 frames with the lowest recall came down without their images: 103"
    )
    (partly,) = report.worst_frames
    assert partly.image is IMAGES[105] and partly.utc_ns == TIMES[5]
    assert partly.detection_matched.tolist() == [True, True]
    assert partly.catalogue_matched.tolist() == [True, True, False]
    assert partly.detection_class.tolist() == [0, 1] and partly.catalogue_class.tolist() == [0, 1, 2]
    drawn = {
        "detection": (np.full(2, 256.1), V_PX[:2] + 0.8, DIAMETER_PX[:2]),
        "catalogue": (np.full(3, 255.5), V_PX, DIAMETER_PX),
    }
    for kind, values in drawn.items():
        found = [getattr(partly, f"{kind}_{name}_px") for name in ("u", "v", "diameter")]
        assert_allclose(found, values, rtol=0, atol=1e-3)


def test_many_images_are_thinned_out_evenly():
    every = {100 + frame: np.zeros((2, 2), dtype=np.uint8) for frame in range(FRAMES)}
    report = evaluated(images=every)
    # Six of twelve: 0, 2.2, 4.4, 6.6, 8.8 and 11, rounded.
    assert [one.frame_number for one in report.gallery] == [100, 102, 104, 107, 109, 111]


def test_the_pointing_is_described_by_what_is_known_of_it():
    nadir = Viewing(CAMERA).pointed(circle(CADENCE_S * np.arange(FRAMES))[0])
    every = evaluated(viewing=Viewing(CAMERA, attitude_utc_ns=TIMES, q_wxyz=quaternion_from_matrix(nadir)))
    assert scored(every)[0].detected_true == 29
    assert "into the camera in its telemetered attitude;" in scored(every)[1]
    assert len(every.remarks) == 1
    # The attitude of five frames is a quarter of a turn off: of four that see anything, only the centre is found.
    turned = quaternion_from_matrix(axis_rotation(3, -math.pi / 2.0) @ nadir[:5])
    some = evaluated(viewing=Viewing(CAMERA, attitude_utc_ns=TIMES[:5], q_wxyz=turned))
    assert [one.detected_true for one in some.detector.per_class] == [10, 6, 5]
    assert "into the camera in its telemetered attitude, if available;" in scored(some)[1]
    assert some.remarks[-1] == "the attitude of 7 of 12 frames is unknown; the declared attitude is used"
    refused = evaluated(refused={"camera": "the camera is not declared"})
    assert "into a nadir camera;" in scored(refused)[1]
    assert refused.remarks[-1] == "the camera is not declared"


def identified():
    """Three craters of each of the frames 0, 1, 2 and 4; those of frame 4 are named wrongly."""
    frames = np.repeat([0, 1, 2, 4], 3)
    place = np.tile([0, 1, 2], 4)
    named = np.where(frames == 4, (place + 1) % 3, place)
    return IdentificationSamples(TIMES[frames], place, 10 * frames + named)


def test_fixes_are_repeated_from_single_frames_and_classified_as_right_or_wrong():
    """A shift of 0.6 and 0.8 px is one of 20 and 27 m over the ground, on a camera that looks straight down."""
    report = evaluated(identifications=identified())
    assert series(report, "anchored").wrong_fixes == 1
    assert series(report, "paper").wrong_fixes is None
    found = series(report, "snapshot")
    assert report.navigation[-1] is found and found.kind == "baseline"
    assert set(TIMES[:3]) <= set(found.utc_ns.tolist())
    pixel_m = ALTITUDE_M / FOCAL_PX
    # Right in the image is east: the camera sits west of where it is taken to be, and north by 0.8 px.
    assert_allclose(found.error_rtn_m[:3, 1], -0.6 * pixel_m, rtol=0.05)
    assert_allclose(found.error_rtn_m[:3, 2], 0.8 * pixel_m, rtol=0.05)
    assert "snapshot" not in [
        one.name for one in evaluated(identifications=identified(), navigation=(paper(),)).navigation
    ]
    bare = evaluated(identifications=identified(), catalogue=None)
    assert series(bare, "anchored").wrong_fixes is None


def test_the_map_of_the_payload_is_compared_with_the_catalogue(report):
    """One landmark 100 m north of the first crater, reported twice, and used in one pair of thirteen."""
    landmark = MappedCraters(
        np.full(2, 3_000_000_000), np.full(2, math.degrees(100.0 / MOON_M)), np.zeros(2), np.zeros(2), np.full(2, 6e3),
        np.full((2, 3), 50.0), np.array([1, 2]),
    )  # fmt: skip
    some = identified()
    own = IdentificationSamples(
        np.append(some.utc_ns, TIMES[5]), np.append(some.detection, 0), np.append(some.crater_id, 3_000_000_000)
    )
    found = evaluated(landmarks=landmark, identifications=own).payload_map
    assert (found.mapped, found.mapped_again, found.used, found.pairs, found.pairs_of_all) == (1, 1, 1, 1, 13)
    assert found.catalogued == 1 and found.source == "made"
    assert_allclose(found.offset_m, [[0.0, 100.0]], atol=1e-6)
    assert report.payload_map is None


def test_every_estimate_has_the_sun_and_the_ground():
    dark_west = np.full((4, 360), 200, dtype=np.uint8)
    dark_west[:, :4] = 50
    surface = TerrainMap(dark_west, 0.0, 360.0, -90.0, 90.0)
    report = evaluated(sun_known=True, surface=surface)
    sun = np.asarray(sun_position_icrf_m(np.asarray(tdb_s_from_utc_ns(TIMES))))
    position = circle(CADENCE_S * np.arange(FRAMES))[0]
    ground = position * (MOON_M / RADIUS_M)
    toward = sun - ground
    sine = np.einsum("ni,ni->n", toward, position) / np.linalg.norm(toward, axis=1) / RADIUS_M
    for name in "paper", "anchored":
        # The Sun is an astronomical unit away: whether seen from the ground or the centre makes 1e-5 rad.
        assert_allclose(series(report, name).sun_elevation_deg, np.degrees(np.arcsin(sine)), atol=2e-3)
        assert series(report, name).terrain == tuple("mare" if x < 4.0 else "highland" for x in LONGITUDE_DEG)
    bins = [(one.low, one.high) for one in report.detector.by_sun_elevation_deg]
    elevations = np.degrees(np.arcsin(sine))
    assert bins == [(5.0 * k, 5.0 * k + 5.0) for k in sorted({int(e // 5.0) for e in elevations})]
    assert report.terrain is surface


def test_the_headline_is_that_of_the_declared_estimator(report):
    size = 2.0 * RADIUS_M * np.sin(EAST_M / RADIUS_M / 2.0)
    p95 = float(np.percentile(size, 95.0))
    assert [(one.label, one.value, one.unit, one.note) for one in report.headline] == [
        ("Median position error", MEDIAN_M, "m", f"paper; 95 % below {p95:.0f} m"),
        ("Propagation alone, same start", None, "m", "no start state"),
        ("Drift", DRIFT, "% of path", "paper, horizontal"),
        ("Craters detected", approx(100.0 * 29 / 33), "%", "precision 97 %, centre 1.00 px"),
        ("Packets missing", 100, "", "of 2\u202f000 expected"),
    ]


@mark.parametrize("estimator, reason", [(None, "no estimator is declared"), ("spherical", "spherical is not known")])
def test_no_other_estimator_stands_in_for_the_declared_one(estimator, reason):
    report = evaluated(limits=Requirements(estimator=estimator), detections=no_detections())
    assert [(one.value, one.note) for one in report.headline[::2]] == [
        (None, reason), (None, reason), (100, "of 2\u202f000 expected"),
    ]  # fmt: skip
    assert (report.headline[3].value, report.headline[3].note) == (None, "not evaluated")


@mark.parametrize("error_m, text", [(9_940.0, "9940 m"), (9_960.0, "10.0 km"), (52_340.0, "52.3 km")])
def test_lengths_from_ten_kilometres_on_are_in_kilometres(error_m, text):
    high = paper(altitude_m=np.full(FRAMES, ALTITUDE_M + error_m), longitude_deg=LONGITUDE_DEG)
    report = evaluated(navigation=(high,))
    assert report.headline[0].note == f"paper; 95 % below {text}"


def test_one_sample_is_no_headline():
    assert evaluated(navigation=(first(1),)).headline[0].value is None


def test_the_verdict_is_that_of_the_limits(report):
    assert (report.verdict, report.verdict_level) == ("1 of 1 requirement met.", "met")
    failed = evaluated(limits=Requirements(estimator="paper", median_error_m=499.0))
    assert failed.verdict_level == "not met"
    table = {one.key: one for one in report.requirements}
    assert {key for key, one in table.items() if one.status == "met"} == {"accuracy.median"}
    # Of 1 px the horizontal error of the reference, 10 and 5 m, is 0.33 px.
    assert table["pointing.offset"].value == approx(1.0 - FOCAL_PX * math.hypot(10.0, 5.0) / ALTITUDE_M, abs=1e-3)


def test_silences_part_the_imaging_arcs(report):
    (arc,) = report.imaging_arcs
    assert arc == TimeSpan(int(TIMES[0]), int(TIMES[-1]) + 1, "frames") and report.gaps == ()
    some = detections()
    late = TIMES.copy()
    late[4:] += 8 * SECOND  # 23 s, past one and a half cadences
    late[8:] += 7 * SECOND  # 22 s, short of them
    gapped = inputs(detections=replace(some, utc_ns=late), navigation=())
    found = evaluate_pass(gapped)
    assert found.gaps == (TimeSpan(int(late[3]), int(late[4]), "no frames"),)
    assert found.imaging_arcs == (
        TimeSpan(int(late[0]), int(late[3]) + 1, "frames"),
        TimeSpan(int(late[4]), int(late[-1]) + 1, "frames"),
    )
    assert len(_imaging_arcs(replace(gapped, cadence_s=None))) == 1
    exact = TIMES.copy()
    exact[6:] += 15 * SECOND // 2  # one and a half cadences are no silence
    assert len(_imaging_arcs(inputs(detections=replace(some, utc_ns=exact)))) == 1


def test_what_is_given_is_passed_on():
    given = {
        "generated_for": "ann", "created_utc": "2029-08-08T00:00:00Z", "evidence_level": "procedural",
        "data_sources": ("a", "b"), "scenario_text": "[pass]", "configuration": {"x": {"y": 1}},
        "provenance": {"camera": "declared"},
    }  # fmt: skip
    report = evaluated(**given)
    assert {name: getattr(report, name) for name in given} == given
    assert (report.pass_id, report.title, report.packets) == ("7", "a made pass", PACKETS)
    assert report.span == TimeSpan(EPOCH, EPOCH + 200 * SECOND, "pass")


def test_the_summary_holds_the_figures_of_the_report(report):
    summary = summary_of(report)
    stored = {**summary, "instruments": {"altimeter": {"samples": 3}}}  # as older versions stored it
    assert PassFigures.model_validate(stored) == PassFigures.model_validate(summary)
    statistics = series(report, "paper").statistics
    named = {
        "pass_id": "7", "frames": 11, "packets": 1900, "packets_lost": 100, "packets_expected": 2000,
        "smoothed": {}, "baselines": {}, "verdict": report.verdict, "verdict_level": "met",
        "evidence_level": "", "data": [], "experiment": "", "experiment_level": "",
    }  # fmt: skip
    assert {name: summary[name] for name in named} == named
    others = {"detector", "navigation", "requirements", "error_budget", "not_available"}
    assert set(summary) == {*named, *others}
    assert summary["navigation"]["paper"] == {
        **{f"p{share}_3d_m": getattr(statistics, f"p{share}_3d_m") for share in (68, 95, 99)},
        "median_3d_m": MEDIAN_M,
        "max_3d_m": MAX_M,
        "drift_percent": DRIFT,
        "end_of_pass_m": MAX_M,
    }
    assert list(summary["navigation"]) == ["paper", "anchored"]
    # Eleven frames of three craters; one loses all three, one loses one, and one has a false alarm.
    per_class = [(11, approx(10 / 11), 10 / 11), (11, 1.0, 10 / 11), (11, 1.0, 9 / 11)]
    centre_px = approx(1.0, abs=1e-6)  # 0.6 and 0.8
    assert summary["detector"] == {
        "precision": approx(29 / 30), "recall": approx(29 / 33), "loc_px": centre_px,
        "per_class": [
            {"class": k, "expected": n, "precision": p, "recall": approx(r), "loc_px": centre_px}
            for k, (n, p, r) in enumerate(per_class)
        ],
    }  # fmt: skip
    assert summary["requirements"][0] == {
        "key": "accuracy.median", "name": "median 3-D error", "value": MEDIAN_M,
        "limit": 1000.0, "relation": "<=", "unit": "m", "margin": MEDIAN_M,
        "status": "met", "question": "operations",
        "note": "paper, 12 samples; not applicable: paper assumes a pass to the north or south, "
        "this track runs 90° from the meridian",
    }  # fmt: skip
    assert [(one.low, one.high) for one in report.detector.by_altitude_km] == [(30.0, 40.0)]
    assert report.detector.by_sun_elevation_deg == ()
    assert {one["key"]: one["relation"] for one in summary["requirements"]}["detector.recall"] == ">="
    assert summary["error_budget"]["anchored"] == {
        "observed_rms_m": approx(30.0, abs=1e-3),
        "reference_rms_m": REFERENCE_M,
        # 900 - 525 = 375.
        "estimate_rms_m": approx(math.sqrt(375.0), abs=1e-3),
    }


def test_the_summary_has_no_figures_without_a_pass_and_baselines_in_their_own_place():
    report = evaluated(detections=no_detections(), navigation=(), reference=None, catalogue=None)
    empty = {
        "frames": None, "packets": 0, "packets_lost": 0, "packets_expected": 0,
        "detector": {"precision": None, "recall": None, "loc_px": None, "per_class": []},
        "navigation": {}, "baselines": {}, "error_budget": {},
    }  # fmt: skip
    bare = summary_of(replace(report, accounting=None, packets=None))
    assert {name: bare[name] for name in empty} == empty
    baselines = summary_of(evaluated(start_state=START))["baselines"]
    assert tuple(baselines) == BASELINES
    assert baselines["Kepler"]["max_3d_m"] > 100.0


def test_outcomes_are_joined_by_frame_number_in_any_order():
    number, triggers = np.array([4, 1, 9]), ("time_gap", "none", "manual_step")
    found = OutcomeSamples(
        "paper", 100 + number, TIMES[:3], ("matched",) * 3, triggers, number, np.ones(3, dtype=np.int64)
    )
    triggers, candidates, reads = _joined(paper(), found)
    assert {k: one for k, one in enumerate(triggers) if one != "none"} == {4: "time_gap", 9: "manual_step"}
    assert candidates.tolist() == [0, 1, 0, 0, 4, 0, 0, 0, 0, 9, 0, 0]
    assert reads.tolist() == [1, 1, 1]
    none = replace(found, frame_number=np.zeros(0, dtype=np.int64))
    assert _joined(paper(), none)[:2] == _joined(paper(), None)[:2] == ((), None)


def test_reads_are_listed_in_order_of_time_and_estimator():
    both = (replace(outcomes(), estimator="spherical"), outcomes())
    ledger = evaluated(outcomes=both).truth_ledger
    assert [(one.utc_ns, one.estimator) for one in ledger] == [
        (TIMES[0], "paper"), (TIMES[0], "spherical"), (TIMES[6], "paper"), (TIMES[6], "spherical"),
    ]  # fmt: skip
