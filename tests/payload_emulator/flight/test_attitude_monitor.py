"""Innovation monitoring of the attitude: variance from innovations, decisions, and what the estimator makes of them."""

from dataclasses import replace

import numpy as np
from numpy import diag, radians
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, mark
from scipy.spatial.transform import Rotation

from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.timescales import ticks_from_utc_ns
from payload_emulator.flight.navigation.anchored import anchored, recovery
from payload_emulator.flight.navigation.anchored.anchored import Observation
from payload_emulator.flight.navigation.anchored.parameters import AnchoredParameters
from payload_emulator.flight.navigation.filter import filter as kalman
from payload_emulator.flight.navigation.filter.attitude_monitor import (
    AttitudeMonitor,
    DetectionRule,
    MonitorParameters,
    RotationEvidence,
    frame_variances,
    is_examined,
    monitored,
)
from payload_emulator.flight.navigation.outcomes import Outcome
from payload_emulator.flight.navigation.sighting import landmark_map
from studies import montecarlo

FOCAL_PX = PinholeCamera().focal_px
DECLARED = radians(0.01)
RULES = MonitorParameters()
FLOOR = RULES.floor_px / FOCAL_PX
# What else is uncertain about a rotation in a usual frame, about each axis.
OTHERS = radians([0.15, 0.2, 0.1])


def frames(count, noise_rad, seed=1, common_rad=(0.0, 0.0, 0.0), used_rad=DECLARED, trial=False):
    """Return evidence drawn as innovations have it: the rotation seen is the true one plus what else is uncertain."""
    rng, found = default_rng(seed), []
    for _ in range(count):
        axes = Rotation.random(rng=rng).as_matrix()
        variance = axes @ diag(OTHERS**2) @ axes.T
        information = np.linalg.inv(variance + used_rad**2 * np.eye(3))
        seen = np.array(common_rad) + noise_rad * rng.standard_normal(3)
        seen = seen + axes @ (OTHERS * rng.standard_normal(3))
        found.append(RotationEvidence(information @ seen, information, used_rad, trial))
    return found


def judged(evidence, monitor=None):
    monitor, after = monitor or AttitudeMonitor(), []
    for one in evidence:
        monitor = monitored(monitor, one, DECLARED, FOCAL_PX, RULES)
        after.append(monitor)
    return after


@mark.parametrize("noise_deg", [0.01, 0.2, 1.0])
@mark.parametrize("used_deg", [0.01, 1.0])
def test_the_variance_of_the_attitude_is_estimated_without_bias(noise_deg, used_deg):
    shown = frame_variances(tuple(frames(3_000, radians(noise_deg), used_rad=radians(used_deg))), FLOOR)
    # 3,000 frames; the best known axis counts most, so that the three count as one and a half.
    error = radians(0.25) ** 2 if noise_deg < 0.5 else radians(1.03) ** 2
    used = max(error, radians(used_deg) ** 2)
    assert shown.mean == approx(radians(noise_deg) ** 2, abs=4.0 * used * np.sqrt(2.0 / 4_500.0))


def test_frames_count_less_the_more_else_is_uncertain_about_a_rotation():
    variance = np.array([1.0, 1.0, 4.0]) * radians(0.2) ** 2
    shown = frame_variances(tuple(RotationEvidence(np.zeros(3), np.eye(3) / one, DECLARED) for one in variance), FLOOR)
    assert_allclose(shown.weights, 1.0 / (variance - DECLARED**2 + FLOOR**2) ** 2)


def test_a_rotation_common_to_all_frames_is_no_noise():
    turn = radians([0.8, -0.5, 0.3])
    assert frame_variances(tuple(frames(24, 0.0, common_rad=turn)), FLOOR).mean < radians(0.1) ** 2
    # Agreeing frames and frames that have to be turned are two groups: the second has the shift of a wrong position.
    mixed = frames(12, 0.0) + frames(12, 0.0, seed=2, common_rad=turn, trial=True)
    assert not any(one.degraded for one in judged(mixed))
    apart = [replace(one, trial=False) for one in mixed]
    assert any(one.degraded for one in judged(apart))


def test_single_frames_have_no_weight_and_no_evidence_changes_nothing():
    one = frames(1, 1.0)
    assert frame_variances(tuple(one), FLOOR).mean == 0.0
    monitor = judged(frames(3, 0.0))[-1]
    assert monitored(monitor, None, DECLARED, FOCAL_PX, RULES) is monitor
    broken = replace(one[0], gradient=np.array([np.nan, 0.0, 0.0]))
    assert monitored(monitor, broken, DECLARED, FOCAL_PX, RULES) is monitor
    assert len(judged(frames(60, 0.0))[-1].window) == RULES.window_frames == 24


def test_a_sensor_as_declared_or_better_is_left_alone():
    for seed in range(40):
        for noise in (DECLARED, 0.1 * DECLARED, 3.0 * DECLARED):
            assert not any(one.degraded for one in judged(frames(60, noise, seed)))


@mark.parametrize("noise_deg, within", [(0.2, 24), (1.0, 6)])
def test_more_noise_is_detected_and_estimated(noise_deg, within):
    for seed in range(10):
        after = judged(frames(60, DECLARED, seed) + frames(40, radians(noise_deg), seed + 100))
        assert 60 <= next(k for k, one in enumerate(after) if one.degraded) < 60 + within
        # The mean of 24 frames is known to a quarter, and one standard error is added.
        assert 0.8 < after[-1].noise_rad / radians(noise_deg) < 1.6
        assert after[-1].sigma_rad(DECLARED) == after[-1].noise_rad


def test_wrong_pairs_in_two_of_five_frames_are_no_bad_sensor():
    good, bad = frames(30, 0.0), frames(2, radians(2.0), seed=9)
    assert not any(one.degraded for one in judged(good + bad[:1] + good[:1] + bad[1:] + good[:5]))


def test_the_declared_noise_is_used_again_once_the_sensor_is_restored_and_none_above_the_limit():
    noisy = judged(frames(40, radians(0.5)))[-1]
    assert noisy.degraded
    after = judged(frames(30, DECLARED, seed=5, used_rad=noisy.noise_rad), noisy)
    assert after[0].degraded and not after[-1].degraded
    assert after[-1].noise_rad == 0.0 and after[-1].sigma_rad(DECLARED) == DECLARED
    assert judged(frames(30, radians(6.0)))[-1].noise_rad == RULES.largest_rad


def test_frames_that_need_a_turn_are_examined_until_there_are_enough_of_them():
    trials = judged(frames(6, 0.0, trial=True, used_rad=RULES.trial_rad))
    assert [is_examined(one, RULES) for one in trials] == [True] * 4 + [False] * 2
    assert not is_examined(judged(frames(2, 0.0))[-1], RULES)
    assert not is_examined(AttitudeMonitor(), RULES)


def flown(navigation_case, seed, noise_deg, watched=True):
    parameters = AnchoredParameters(gravity_degree=50)
    if not watched:
        never = DetectionRule(24, 0.2, np.inf)
        parameters = replace(parameters, monitor=replace(parameters.monitor, moderate=never, sudden=never))
    return montecarlo.fly(navigation_case(60, attitude_noise_rad=radians(noise_deg), parameters=parameters), seed)


@mark.parametrize("noise_deg", [0.001, 0.01])
def test_passes_with_a_sensor_as_declared_or_better_are_those_without_the_monitor(navigation_case, noise_deg):
    for seed in (31, 32, 33):
        run = flown(navigation_case, seed, noise_deg)
        assert not run.attitude_noise_rad.any()
        without = flown(navigation_case, seed, noise_deg, watched=False)
        assert_array_equal(run.error_rtn_m, without.error_rtn_m)


def test_a_bad_sensor_is_detected_and_tolerated_on_passes(navigation_case, monkeypatch):
    searches = []
    usual = recovery.search_everywhere
    monkeypatch.setattr(recovery, "search_everywhere", lambda *a: searches.append(a) or usual(*a))
    runs = [flown(navigation_case, seed, 1.0) for seed in (31, 32, 33)]
    assert not searches
    for run in runs:
        assert np.flatnonzero(run.attitude_noise_rad)[0] < 15
        assert np.degrees(run.attitude_noise_rad[-1]) == approx(1.0, rel=0.4)
        assert np.median(run.error_m[20:]) < 250.0 and run.error_m[20:].max() < 500.0
    # One run is one independent draw of six degrees of freedom: three of them exceed 11 once in a thousand.
    assert np.mean([run.nees[20:].mean() for run in runs]) < 11.0
    assert flown(navigation_case, 31, 1.0, watched=False).nees[20:].mean() > 30.0


def test_moderate_noise_is_detected_within_a_window_of_frames(navigation_case):
    for seed in (41, 42, 43):
        run = flown(navigation_case, seed, 0.2)
        assert np.flatnonzero(run.attitude_noise_rad)[0] < 45
        assert run.nees[20:].mean() < 12.0


def test_a_degraded_attitude_takes_back_the_fixes_of_the_window_and_counts_with_its_noise(navigation_case, monkeypatch):
    noise = radians(0.5)
    used = []
    usual = kalman.update

    def update(*arguments, **more):
        used.append(arguments[8].attitude_noise_rad)
        return usual(*arguments, **more)

    case = navigation_case(3, start_position_m=100.0, start_velocity_m_s=0.1)
    table = montecarlo.catalogue_table(case.craters)
    states, rotations = montecarlo._truth(case, default_rng(1), default_rng(2))
    ticks = np.asarray(ticks_from_utc_ns(case.frame_utc_ns), int)
    setup, state = montecarlo._started(case, table, states[0], int(ticks[0]), default_rng(1))
    degraded = AttitudeMonitor(noise_rad=noise)
    before = state.estimate
    # The estimate goes back to the oldest prediction that the window still has, here one without any error.
    exact = replace(before, mean=before.mean + 1.0, covariance=2.0 * before.covariance)
    full = (exact, *[replace(exact, ticks=int(ticks[1]))] * (setup.parameters.monitor.window_frames - 1))
    watching = replace(state, trusted=full, attitude=AttitudeMonitor(window=tuple(frames(24, 0.0))))
    back = anchored.with_judged_attitude(watching, degraded, None, setup)
    assert_allclose(back.estimate.mean, exact.mean, rtol=1e-6)
    assert_allclose(back.estimate.covariance, exact.covariance, rtol=1e-6, atol=1e-9)
    assert back.trusted == () and back.attitude is degraded
    # After a reset of the filter within the window nothing is left to go back to: the uncertainty grows.
    after = anchored.with_judged_attitude(state, degraded, None, setup)
    shift = noise * anchored.altitude_above_sphere_m(before)
    added = diag(after.estimate.covariance - before.covariance)
    assert_allclose(added[:3], shift**2)
    assert_allclose(added[3:6], (1e-3 * shift) ** 2)
    assert_allclose(added[6:], 0.0)
    assert anchored.with_judged_attitude(after, degraded, before, setup).estimate is after.estimate
    # While the attitude is as declared, predictions are kept; an announced change of the orbit drops them.
    usual_one = anchored.with_judged_attitude(state, AttitudeMonitor(), before, setup)
    assert len(usual_one.trusted) == 1 and anchored.widened(usual_one, 1.0, 1.0).trusted == ()
    monkeypatch.setattr(kalman, "update", update)
    camera_from_icrf = nadir_camera_from_mcmf(rotations[0] @ states[0, :3]) @ rotations[0]
    craters, lasting = landmark_map(table), np.zeros((len(case.craters), 2))
    found, _ = montecarlo._detect(
        case, craters, states[0, :3], camera_from_icrf, rotations[0], lasting, np.zeros(2), default_rng(3)
    )
    _, report = anchored.step(after, Observation(int(ticks[0]), found, camera_from_icrf), setup)
    assert report.outcome is Outcome.fixed and set(used) == {noise}
    assert (report.attitude_declared_rad, report.attitude_noise_rad) == (DECLARED, noise)
