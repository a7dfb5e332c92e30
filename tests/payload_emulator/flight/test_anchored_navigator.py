"""The anchored navigator with its shipped parameters, frame by frame, against the true orbit and hand-made limits."""

from dataclasses import replace

import numpy as np
from numpy import cross, diag, eye, hypot, inf, isnan, nan, radians, sqrt, tan
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark
from scipy.spatial.transform import Rotation
from scipy.special import chdtri, ndtr

from lunar.camera import nadir_camera_from_mcmf
from lunar.propagation import ForceModel, propagate
from lunar.timescales import tdb_s_from_utc_ns, ticks_from_utc_ns
from payload_emulator.flight.navigation.anchored import anchored, correction, recovery
from payload_emulator.flight.navigation.anchored.anchored import Observation
from payload_emulator.flight.navigation.anchored.correction import frame_limit, is_usable
from payload_emulator.flight.navigation.anchored.parameters import AnchoredLimits, AnchoredParameters
from payload_emulator.flight.navigation.filter import filter as kalman
from payload_emulator.flight.navigation.filter.filter import FilterState
from payload_emulator.flight.navigation.filter.map_offset import OffsetRule
from payload_emulator.flight.navigation.landmark_map import MapState
from payload_emulator.flight.navigation.outcomes import Outcome
from payload_emulator.flight.navigation.search.acquisition import Acquisition
from payload_emulator.flight.navigation.search.identification import Identification
from payload_emulator.flight.navigation.search.lost_in_space import PoseHypothesis
from payload_emulator.flight.navigation.sighting import Pose, in_view, landmark_map
from payload_emulator.flight.vision.detections import Detections
from studies import montecarlo
from tmtc.dictionary.tables import BurnTable

SECOND = 65_536


class Navigator:
    """Set-up and current state of the estimator under test, with the last report."""

    def __init__(self, orbit, setup, state):
        self.orbit, self.setup, self.state = orbit, setup, state

    @property
    def estimate(self):
        return self.state.estimate

    @property
    def fix(self):
        return self.report.fix

    def step(self, ticks, found, camera_from_icrf):
        given = self.state
        before = given.estimate.mean.copy(), given.estimate.covariance.copy()
        self.state, self.report = anchored.step(given, Observation(int(ticks), found, camera_from_icrf), self.setup)
        # A step changes nothing of the state that it is given.
        assert_array_equal(given.estimate.mean, before[0])
        assert_array_equal(given.estimate.covariance, before[1])
        return self.report

    def frame(self, k, *seen):
        """Step to a frame, with its exact detections and attitude or with those given."""
        return self.step(self.orbit.ticks[k], *(seen or (self.orbit.detections(k), self.orbit.attitude(k))))


class Orbit:
    """True states at frames of 15 s, exact detections, and a navigator that starts near the truth."""

    def __init__(self, case):
        self.case = case
        tdb_s = np.asarray(tdb_s_from_utc_ns(case.frame_utc_ns), float)
        model = ForceModel(case.gravity, case.orientation, case.gravity_degree)
        span_s = float(tdb_s[-1] - tdb_s[0]) + 1.0
        flown = propagate(float(tdb_s[0]), case.position_icrf_m, case.velocity_icrf_m_s, span_s, model)
        self.states = flown.state(tdb_s)
        self.rotations = case.orientation.mcmf_from_icrf(tdb_s)
        self.ticks = np.asarray(ticks_from_utc_ns(case.frame_utc_ns), int)
        self.map = landmark_map(montecarlo.catalogue_table(case.craters))

    def attitude(self, k):
        return nadir_camera_from_mcmf(self.rotations[k] @ self.states[k, :3]) @ self.rotations[k]

    def pose(self, position=None, k=0):
        position = self.states[k, :3] if position is None else position
        return Pose(position, self.attitude(k), self.rotations[k], np.zeros(3), np.zeros(2), np.zeros(3))

    def detections(self, k, shift_px=0.0):
        seen = in_view(self.map, self.pose(k=k), self.case.camera, 0.0)
        one = np.ones(len(seen))
        return Detections(seen.uv_px[:, 0] + shift_px, seen.uv_px[:, 1], seen.diameter_px, one, one)

    def navigator(self, **changes):
        case = replace(
            self.case,
            start_position_m=changes.pop("start_position_m", 300.0),
            start_velocity_m_s=0.3,
            parameters=replace(AnchoredParameters(gravity_degree=50), **changes),
        )
        table = replace(montecarlo.catalogue_table(case.craters), sigma_m=np.full((len(case.craters), 3), 60.0))
        return Navigator(
            self, *montecarlo._started(case, table, self.states[0], int(self.ticks[0]), np.random.default_rng(1))
        )

    def flown(self, frames, **changes):
        """A navigator after its first frames."""
        navigator = self.navigator(**changes)
        for k in range(frames):
            navigator.frame(k)
        return navigator

    def error_m(self, navigator, k):
        return float(norm(navigator.estimate.mean[:3] - self.states[k, :3]))


@fixture(scope="module")
def orbit(navigation_case):
    return Orbit(navigation_case(40))


def test_the_gate_of_a_frame_is_the_chi_square_quantile_it_says():
    probability = ndtr(AnchoredLimits().frame_gate_sigmas)
    assert 1.0 - probability == approx(1e-5, rel=0.01)
    # The cube-root approximation is too wide by 7 % at two degrees and by 2 % at ten.
    for degrees, excess in ((2, 0.072), (4, 0.042), (10, 0.018), (24, 0.007), (64, 0.0025)):
        assert frame_limit(degrees, 4.265) == approx(chdtri(degrees, 1.0 - probability), rel=excess)


def test_shipped_parameters_hold_the_orbit_and_report_what_the_state_says(orbit):
    navigator = orbit.navigator()
    assert {navigator.frame(k).outcome for k in range(12)} == {Outcome.fixed}
    # Exact detections: what is left is the start, weighed with 60 m of catalogue and 15 m of its offset.
    assert orbit.error_m(navigator, 11) < 60.0
    last, state = navigator.report, navigator.estimate
    place = orbit.rotations[11] @ state.mean[:3]
    radius = float(norm(place))
    assert last.altitude_m == approx(radius - 1_737_400.0, abs=1e-6)
    assert np.sin(last.latitude_rad) == approx(place[2] / radius, abs=1e-12)
    assert tan(last.longitude_rad) == approx(place[1] / place[0], rel=1e-9)
    radial = state.mean[:3] / norm(state.mean[:3])
    normal = cross(state.mean[:3], state.mean[3:6])
    normal /= norm(normal)
    axes = np.stack([radial, cross(normal, radial), normal])
    expected = [sqrt(axis @ state.covariance[:3, :3] @ axis) for axis in axes]
    assert_allclose(last.sigma_rtn_m, expected, rtol=1e-9)
    assert last.velocity_icrf_m_s == tuple(state.mean[3:6])
    fix = navigator.fix
    assert last.matched == fix.index.size and last.nis == fix.update.nis
    assert last.nis < chdtri(2 * last.matched, 0.001)


def test_without_an_image_attitude_or_detections_the_orbit_is_coasted(orbit):
    navigator = orbit.flown(6)
    before = navigator.estimate
    none = navigator.frame(6, None, orbit.attitude(6))
    assert none.outcome is Outcome.no_image and isnan(none.nis) and none.matched == 0
    assert navigator.estimate.position_sigma_m > before.position_sigma_m
    blind = navigator.frame(7, orbit.detections(7), None)
    empty = navigator.frame(8, orbit.detections(8).select(slice(0)), orbit.attitude(8))
    assert blind.outcome is Outcome.coasted and empty.outcome is Outcome.coasted
    assert orbit.error_m(navigator, 8) < 100.0


def test_outside_the_orientation_table_the_old_state_stays(orbit):
    navigator = orbit.flown(3)
    before = navigator.state
    report = navigator.step(orbit.ticks[3] + 400 * 86_400 * SECOND, orbit.detections(3), orbit.attitude(3))
    assert report.outcome is Outcome.refused and isnan(report.latitude_rad)
    assert navigator.state is before


def test_craters_stay_among_the_states_for_their_memory_and_no_longer(orbit):
    limit_s = AnchoredLimits().crater_memory_s
    for gap, kept in ((15, True), (17, False)):
        navigator = orbit.flown(6)
        assert navigator.estimate.craters.size > 5
        k = 5 + gap
        assert (gap * 15.0 <= limit_s) is kept
        navigator.frame(k, None, None)
        assert (navigator.estimate.craters.size > 0) is kept


def test_only_so_many_craters_are_used_the_surest(orbit):
    navigator = orbit.flown(1, crater_limit=5)
    found = orbit.detections(1)
    sigma = np.linspace(3.0, 0.6, len(found))
    report = navigator.frame(1, replace(found, sigma_px=sigma), orbit.attitude(1))
    fix = navigator.fix
    assert report.matched == 5
    # Exact detections are all identified: the five smallest sigmas are the last five.
    assert fix.identification.detection.tolist() == list(range(len(found) - 5, len(found)))


def test_detection_noise_is_split_between_frame_and_crater(orbit):
    navigator = orbit.navigator(detection_persistence=0.3, detection_sigma_scale=2.0)
    found = orbit.detections(0)
    count = len(found)
    sigma = np.full(count, 0.1)
    sigma[:2] = [nan, 1.0]
    parameters = navigator.setup.parameters
    variance = correction.detection_variance_px2(replace(found, sigma_px=sigma), parameters)
    # Unknown: 1.5 px; given: twice what it says; never below 0.5 px.
    assert_allclose(variance[:3], [9.0, 4.0, 0.25])
    share = correction.detection_persistence(found, parameters)
    assert_allclose(share, 0.3)
    # A share that the detector states replaces the parameter.
    stated = np.linspace(0.0, 0.95, count)
    assert_allclose(correction.detection_persistence(replace(found, persistence=stated), parameters), stated)

    fresh, lasting = correction.split_variance_px2(variance, share, parameters)
    assert_allclose(fresh[:3], [6.3, 2.8, 0.175])
    assert_allclose(lasting[:3], [2.7, 1.2, 0.075])
    # Less noise than stated lasts, so that the sum stays; more adds to it.
    for factor, parts in ((0.5, (1.575, 7.425)), (2.0, (25.2, 2.7)), (0.01, (0.04, 8.96))):
        learned = replace(parameters, errors=replace(parameters.errors, noise_factor=factor))
        found_parts = correction.split_variance_px2(variance, share, learned)
        assert_allclose((found_parts[0][0], found_parts[1][0]), parts)
    index = np.array([3, 8])
    altitude_m, low_m = 30_000.0, 400.0
    catalogue_m = navigator.state.landmarks.sigma_m[index]
    lasting = correction.crater_sigma_m(catalogue_m, np.array([1.2, 2.7]), altitude_m, orbit.case.camera, parameters)
    low = correction.crater_sigma_m(catalogue_m, np.array([1.2, 2.7]), low_m, orbit.case.camera, parameters)
    focal_px = 256.0 / tan(radians(60.0))
    for row, px2 in enumerate((4.0, 9.0)):
        across = hypot(60.0, sqrt(0.3 * px2) * altitude_m / focal_px)
        assert_allclose(lasting[row], [across, across, 60.0], rtol=1e-12)
        # Below the lowest altitude the scale of that altitude is used.
        across = hypot(60.0, sqrt(0.3 * px2) * 1_000.0 / focal_px)
        assert_allclose(low[row], [across, across, 60.0], rtol=1e-12)
    # The map itself is left alone.
    assert_allclose(navigator.state.landmarks.sigma_m[index], 60.0)


def test_exact_detections_are_learned_to_have_less_noise_than_stated(orbit):
    offset = orbit.flown(8, offset=OffsetRule(noise_fixes=4)).state.offset
    assert (offset.pending, offset.fixes) == (8, 0) and 0.5 <= offset.noise_factor < 0.9


def test_craters_enter_the_state_with_the_lasting_share_of_the_detection_error(orbit):
    """Detections of 3 px are worth 600 m at 30 km: nearly all of it lasts, or all of it is new in each frame."""
    found = replace(orbit.detections(0), sigma_px=np.full(len(orbit.detections(0)), 3.0))
    spread = []
    for share in (0.0, 0.9):
        navigator = orbit.navigator(detection_persistence=share)
        navigator.frame(0, found, orbit.attitude(0))
        assert navigator.estimate.craters.size > 5
        covariance, east = navigator.estimate.covariance, np.arange(kalman.SIZE, navigator.estimate.mean.size, 3)
        beyond = covariance[east, east] + covariance[14, 14] - 2.0 * covariance[14, east]
        spread.append(sqrt(beyond))
    assert spread[0].max() <= 60.0  # the catalogue's own, beyond the common offset
    assert spread[1].min() > 120.0


def test_an_image_that_contradicts_the_prediction_is_refused_until_it_has_done_so_often(orbit):
    navigator = orbit.flown(8)
    error = orbit.error_m(navigator, 7)
    for k in range(8, 8 + 3):
        report = navigator.frame(k, orbit.detections(k, shift_px=60.0), orbit.attitude(k))
        assert report.outcome in (Outcome.refused, Outcome.coasted) or report.matched <= 2
        assert orbit.error_m(navigator, k) < error + 100.0
    assert navigator.state.disagreements == 3
    # Frames that agree take the suspicion away.
    navigator.frame(11)
    assert navigator.state.disagreements == 0


# matched (- without a fix), expected, detections, counts; a fix uses 32 craters at most
FRAMES = "- 10 10 1, - 3 10 0, - 10 3 0, - 4 4 1, 2 10 10 1, 3 10 10 -1, 1 3 9 -1, 31 400 250 1, 32 400 250 -1"


@mark.parametrize("row", FRAMES.split(","))
def test_frames_are_judged_by_the_share_they_explain(row):
    matched, *others = row.split()
    expected, detections, counts = map(int, others)
    fix = None if matched == "-" else type("Fix", (), {"index": np.arange(int(matched))})()
    after = recovery.disagreements(5, fix, expected, detections, AnchoredParameters())
    assert after == (0 if counts < 0 else 5 + counts)


def test_corrections_that_are_no_corrections_are_refused(orbit):
    prior, limits = orbit.navigator().estimate, AnchoredLimits()
    sigma = prior.position_sigma_m
    assert sigma == approx(300.0 / sqrt(3.0))

    def moved(metres):
        mean = prior.mean.copy()
        mean[1] += metres
        return replace(prior, mean=mean)

    assert correction.is_plausible(prior, moved(6.9 * sigma), limits)
    assert not correction.is_plausible(prior, moved(7.1 * sigma), limits)
    bad = replace(prior, covariance=prior.covariance.copy())
    bad.covariance[4, 4] = -1e-9
    assert not correction.is_plausible(prior, bad, limits)
    assert not correction.is_plausible(prior, replace(prior, mean=np.full(18, nan)), limits)
    for radius, usable in ((1_727.3e3, False), (1_727.5e3, True), (2_737.3e3, True), (2_737.5e3, False)):
        mean = prior.mean.copy()
        mean[:3] *= radius / norm(mean[:3])
        assert is_usable(replace(prior, mean=mean), limits) is usable


def test_a_burn_on_the_way_is_flown_and_its_uncertainty_added(orbit):
    plain, burning = orbit.navigator(), orbit.navigator()
    at = orbit.ticks[0] + 20 * SECOND
    push = np.array([0.0, 2.0, 0.0])
    burning.setup = replace(burning.setup, burns=BurnTable(np.array([at]), push[None], np.array([0.05])))
    for navigator in (plain, burning):
        navigator.frame(2, None, None)
    moved = burning.estimate.mean - plain.estimate.mean
    # Ten seconds after the burn: 20 m along its axis; gravity changes that by a millionth.
    assert_allclose(moved[:3], 10.0 * push, atol=1e-2)
    assert_allclose(moved[3:6], push, atol=1e-3)
    added = burning.estimate.covariance - plain.estimate.covariance
    assert_allclose(diag(added)[3:6], 0.05**2, rtol=1e-3)
    assert_allclose(diag(added)[:3], (10.0 * 0.05) ** 2, rtol=1e-3)
    # Back before the burn it is undone.
    burning.frame(0, None, None)
    plain.frame(0, None, None)
    assert_allclose(burning.estimate.mean[3:6], plain.estimate.mean[3:6], atol=1e-3)


def test_it_is_lost_beyond_its_limit(orbit):
    navigator = orbit.navigator()
    parameters = navigator.setup.parameters
    assert not anchored.is_lost(navigator.state, parameters)
    wide = anchored.widened(navigator.state, 4_900.0, 1.0)
    assert not anchored.is_lost(wide, parameters)
    wider = anchored.widened(wide, 1_500.0, 1.0)
    assert anchored.is_lost(wider, parameters)
    assert wider.estimate.position_sigma_m == approx(5_127.3, abs=1.0)
    unknown = replace(wide, estimate=replace(wide.estimate, mean=np.full(18, nan)))
    assert anchored.is_lost(unknown, parameters)
    # The report of a frame says so.
    navigator.state = wider
    assert navigator.frame(1, None, None).lost and not orbit.navigator().frame(1, None, None).lost


def test_a_wide_prior_is_searched_by_votes_and_says_so(orbit):
    navigator = orbit.navigator(start_position_m=9_000.0)
    assert navigator.estimate.position_sigma_m > AnchoredParameters().tracking_limit_m
    report = navigator.frame(0)
    assert report.outcome is Outcome.fixed and report.reacquired
    assert orbit.error_m(navigator, 0) < 300.0
    following = navigator.frame(1)
    assert following.outcome is Outcome.fixed and not following.reacquired


def recorded(monkeypatch, owner, name, answer=None):
    """Put a stand-in in place of a function that keeps what it is given."""
    calls = []

    def keep(*given, **more):
        calls.append((*given, more) if more else given)
        return answer

    monkeypatch.setattr(owner, name, keep)
    return calls


def test_a_place_found_without_a_prior_turns_the_orbit_with_it(orbit, monkeypatch):
    """The velocity turns by the shortest rotation from the believed place to the one that was found."""
    navigator = orbit.navigator()
    prior = navigator.estimate
    found = orbit.detections(0)
    axis = cross(prior.mean[:3], [0.3, -0.5, 0.8])
    turn = Rotation.from_rotvec(0.4 * axis / norm(axis))
    there = 1.01 * turn.apply(prior.mean[:3])
    place = PoseHypothesis(
        orbit.rotations[0] @ there, np.zeros(3), np.array([30.0, 80.0, 50.0]), np.array([2, 5, 7]), np.array([4, 1, 9]),
        -20.0
    )  # fmt: skip
    search = recorded(monkeypatch, recovery, "find_place", place)
    updated = recorded(monkeypatch, recovery, "correct", "the fix")
    setup, landmarks, index = navigator.setup, navigator.state.landmarks, object()

    def found_anywhere():
        return recovery.search_everywhere(
            prior, pose, found, landmarks, setup.camera, setup.parameters, setup.markov_sigma_m_s2, index
        )

    pose = orbit.pose(prior.mean[:3])
    assert found_anywhere() == "the fix"
    ((given, sigma_px, places, camera, parameters),) = search
    assert given is found and camera is orbit.case.camera and parameters is setup.parameters.lost
    assert_allclose(sigma_px, 1.0)
    assert places is index
    ((fresh, moved, detected, identification, sighting, *rest, altitude_m, more),) = updated
    assert more == {"reacquired": True, "method": kalman} and detected is found
    assert rest == [landmarks, setup.camera, setup.parameters]
    # Detections are scaled to the ground by the altitude that was predicted.
    assert altitude_m == approx(norm(prior.mean[:3]) - 1_737_400.0)
    assert_allclose(fresh.mean[:3], there, rtol=1e-12)
    assert_allclose(fresh.mean[3:6], turn.apply(prior.mean[3:6]), rtol=1e-9)
    assert fresh.ticks == prior.ticks and not fresh.craters.size
    sigma = sqrt(diag(fresh.covariance))
    # Three times the worst of 30, 80 and 50 m, and 200 m; a metre a second and 1e-3/s of the way.
    assert_allclose(sigma[:3], 440.0)
    assert_allclose(sigma[3:6], 1.0 + 1e-3 * norm(there - prior.mean[:3]))
    assert_allclose(sigma[6:9], setup.markov_sigma_m_s2)
    assert_allclose(moved.position_icrf_m, there)
    assert_array_equal(moved.camera_from_icrf, pose.camera_from_icrf)
    assert identification.detection.tolist() == [2, 5, 7] and identification.sighted.tolist() == [0, 1, 2]
    assert (identification.candidates, identification.needed) == (len(found), 3)
    assert sighting.index.tolist() == [4, 1, 9]
    monkeypatch.setattr(recovery, "find_place", lambda *_: None)
    assert found_anywhere() is None


@mark.parametrize(
    "moved_m, unseen_s, velocity_m_s",
    [
        (2_000.0, inf, 2.0),  # no fix so far: 1e-3/s of the distance
        (2_000.0, 4_000.0, 2.0),  # the last fix is a coast ago
        (2_000.0, 500.0, 4.0),  # what moved the estimate came after the last fix
        (2_000.0, 60.0, 8.0),  # not more than the radius of the search stands for
        (2_000.0, -5.0, 8.0),  # a clock that was set back says nothing of the motion
        (20_000.0, 60.0, 20.0),
    ],
)
def test_a_widened_search_adds_the_distance_of_the_place_to_the_uncertainty(
    orbit, monkeypatch, moved_m, unseen_s, velocity_m_s
):
    """Half a width of 24 km is three sigma: 8 km, and a velocity of 8 m/s."""
    navigator = orbit.navigator(search_radius_m=24_000.0)
    prior, found = navigator.estimate, orbit.detections(0)
    pose = orbit.pose(prior.mean[:3])
    away = replace(pose, position_icrf_m=pose.position_icrf_m + np.array([0.0, moved_m, 0.0]))
    none = np.empty(0, int)
    acquired = recorded(monkeypatch, recovery, "acquire", Acquisition(none, none, away, 5, 3))
    corrected = []
    monkeypatch.setattr(recovery, "correct", lambda *given, **named: corrected.append((given, named)))
    parameters = navigator.setup.parameters
    chosen = (found, navigator.state.landmarks, orbit.case.camera, parameters)
    recovery.search_widely(prior, pose, *chosen, unseen_s)
    assert acquired[0][4] == 8_000.0
    (given, named) = corrected[0]
    added = np.zeros_like(prior.covariance)
    added[:3, :3], added[3:6, 3:6] = eye(3) * moved_m**2, eye(3) * velocity_m_s**2
    assert_allclose(given[0].covariance - prior.covariance, added, rtol=1e-9, atol=1e-6)
    assert_array_equal(given[0].mean, prior.mean)
    assert named == {"reacquired": True, "method": kalman}
    # A search within what the estimate claims adds nothing, and covers 28 km (1 sigma) at most.
    recovery.search_by_votes(prior, pose, *chosen, 90_000.0)
    assert acquired[1][4] == 28_000.0
    assert_array_equal(corrected[1][0][0].covariance, prior.covariance)


def test_a_reacquisition_leaves_out_the_pair_that_all_others_contradict(orbit, monkeypatch):
    navigator = orbit.navigator()
    prior, found = navigator.estimate, orbit.detections(0)
    landmarks, camera, parameters = navigator.state.landmarks, orbit.case.camera, navigator.setup.parameters
    pose = orbit.pose(prior.mean[:3])
    sighting = in_view(landmarks, pose, camera, 0.0)
    true = orbit.pose()
    seen = in_view(orbit.map, true, camera, 0.0).index.tolist()
    pairs = [(seen.index(crater), k) for k, crater in enumerate(sighting.index.tolist()) if crater in seen]
    detection, sighted = (np.array(column) for column in zip(*pairs, strict=True))
    count = len(pairs)
    shifted = found.u_px.copy()
    shifted[detection[2]] += 25.0
    wrong = replace(found, u_px=shifted)

    def fix(needed, given):
        pairs = Identification(detection, sighted, count, needed)
        return correction.correct(
            prior, pose, given, pairs, sighting, landmarks, camera, parameters, 30e3, reacquired=True
        )

    kept = fix(count - 1, wrong)
    assert kept.index.tolist() == np.delete(sighting.index[sighted], 2).tolist()
    assert kept.update.contradiction.max() < 13.8
    # Without it too few pairs remain, or no pair is left out.
    assert fix(count, wrong) is None
    whole = fix(count, found)
    assert len(whole.index) == count
    # The pairs as a whole must agree with the prediction.
    limits = parameters.limits
    limit = frame_limit(2 * count, limits.frame_gate_sigmas)
    for nis, credible in ((0.999 * limit, True), (1.001 * limit, False)):
        judged = replace(whole, update=replace(whole.update, nis=nis))
        assert correction._is_credible(prior, judged, limits) is credible
    # What a linear correction leaves of the velocity is added to its uncertainty.
    monkeypatch.setattr(correction, "curvature_m_s", lambda *_: 7.0)
    added = diag(fix(count, found).update.state.covariance - whole.update.state.covariance)
    assert_allclose(added[:6], [0.0, 0.0, 0.0, 49.0, 49.0, 49.0], rtol=1e-4)


def test_a_long_correction_leaves_the_curvature_of_the_orbit_to_the_velocity():
    prior = at_altitude(30e3)
    moved = prior.mean.copy()
    moved[3:6] = [0.0, 1_650.0, 0.0]
    prior = replace(prior, mean=moved)
    after = replace(prior, mean=moved + np.r_[[0.0, 60e3, 0.0], np.zeros(15)])
    radius = norm(prior.mean[:3])
    # What the velocity turned by the angle differs by along its first direction: 1 - cos.
    exact = 1_650.0 * (1.0 - np.cos(60e3 / radius))
    assert correction.curvature_m_s(prior, after) == approx(exact, rel=1e-3)
    assert correction.curvature_m_s(prior, prior) == 0.0


def test_the_time_since_the_last_fix_goes_into_the_widened_search(orbit, monkeypatch):
    navigator = orbit.navigator(suspicion_frames=1, lost_frames=100)
    widened = recorded(monkeypatch, recovery, "search_widely")
    monkeypatch.setattr(anchored, "rotation_evidence", lambda *_: None)
    empty = Detections(*np.full((5, 6), 5.0))
    navigator.frame(0, empty, orbit.attitude(0))
    for k in (1, 2):
        navigator.frame(k)

    assert navigator.state.fixed_ticks == orbit.ticks[2]
    navigator.frame(4, empty, orbit.attitude(4))
    assert [given[-2] for given in widened] == [inf, 30.0]


def test_a_reset_of_the_filter_drops_the_predictions_of_the_window(orbit, monkeypatch):
    navigator = orbit.flown(4)
    assert len(navigator.state.trusted) == 4 == len(navigator.state.attitude.window)
    fix = replace(navigator.fix, reacquired=True)
    monkeypatch.setattr(anchored, "search_around", lambda state, *_: anchored.Search(state.estimate, None, 5, 5))
    monkeypatch.setattr(anchored, "rotation_evidence", lambda *_: None)
    monkeypatch.setattr(anchored, "recovered", lambda state, *_: (state, fix))
    navigator.frame(4)
    assert navigator.state.trusted == () and len(navigator.state.attitude.window) == 4


def test_frames_under_examination_by_the_monitor_are_not_searched_widely(orbit, monkeypatch):
    navigator = orbit.flown(3, suspicion_frames=1, lost_frames=100)
    evidence = replace(navigator.fix.update.rotation, trial=True)
    monkeypatch.setattr(anchored, "search_around", lambda state, *_: anchored.Search(state.estimate, None, 9, 9))
    monkeypatch.setattr(anchored, "rotation_evidence", lambda *_: evidence)
    widened = recorded(monkeypatch, recovery, "search_widely")
    searches = []
    for k in range(3, 9):
        navigator.frame(k)
        searches.append(len(widened))
    # Four frames tell noise from a common rotation too poorly; from the fifth on the position is searched.
    assert searches == [0, 0, 0, 0, 1, 2]


def test_an_estimate_that_left_the_moon_starts_again_from_the_tables(orbit):
    navigator = orbit.flown(3)
    below = navigator.estimate.mean.copy()
    below[:3] *= 0.9
    broken = FilterState(navigator.estimate.ticks, below, navigator.estimate.covariance, navigator.estimate.craters)
    navigator.state = replace(navigator.state, estimate=broken)
    assert navigator.frame(3).outcome is Outcome.fixed and orbit.error_m(navigator, 3) < 200.0


def test_disagreeing_frames_widen_the_search_and_then_give_the_prior_up(orbit, monkeypatch):
    """From the fourth on the search is widened; from the sixth on every third goes without a prior."""
    navigator = orbit.navigator(map_landmarks=False)
    candidates = 7

    def nothing(state, *_):
        return anchored.Search(state.estimate, None, candidates, 10)

    monkeypatch.setattr(anchored, "search_around", nothing)
    widened = recorded(monkeypatch, recovery, "search_widely")
    anywhere = recorded(monkeypatch, recovery, "search_everywhere")
    counts = []
    for k in range(13):
        report = navigator.frame(k)
        assert (report.outcome, report.candidates, report.expected) == (Outcome.refused, 7, 10)
        counts.append((len(widened), len(anywhere)))
    assert counts == list(zip([0, 0, *range(11)], np.repeat(range(4), [5, 3, 3, 2]).tolist(), strict=True))
    # The search index is made once.
    assert navigator.state.places is not None
    assert {id(given[-2]) for given in anywhere} == {id(navigator.state.places)}
    candidates = 0
    report = navigator.frame(13)
    assert report.outcome is Outcome.coasted


def test_craters_are_looked_for_as_far_outside_as_the_position_may_be_off(orbit, monkeypatch):
    """3.5 sigma over the altitude times the focal length, and 200 px at most."""
    focal_px = 256.0 / tan(radians(60.0))
    for sigma_m in (300.0, 1_400.0, 3_500.0):
        navigator = orbit.navigator(tracking_limit_m=5_000.0)
        prior = navigator.estimate
        wide = np.zeros_like(prior.covariance)
        wide[:3, :3] = eye(3) * sigma_m**2
        prior = replace(prior, covariance=wide)
        pose = orbit.pose(prior.mean[:3])
        nothing = in_view(orbit.map, pose, orbit.case.camera, 0.0).select(slice(0))
        calls = recorded(monkeypatch, anchored, "in_view", nothing)
        state = replace(navigator.state, estimate=prior)
        search = anchored.search_around(state, pose, orbit.detections(0), navigator.setup)
        assert (search.fix, search.candidates, search.expected) == (None, 0, 0)
        monkeypatch.undo()
        altitude_m = norm(prior.mean[:3]) - 1_737_400.0
        assert calls[0][3] == approx(min(3.5 * sigma_m / altitude_m * focal_px, 200.0))


def test_what_identification_is_given_is_the_spread_of_prediction_and_catalogue(orbit, monkeypatch):
    navigator = orbit.flown(3)
    # Some craters are among the states, others are not.
    prior = navigator.estimate.only_craters(navigator.estimate.craters[::2])
    pose = orbit.pose(prior.mean[:3], 2)
    landmarks, parameters = navigator.state.landmarks, navigator.setup.parameters
    sighting = in_view(landmarks, pose, orbit.case.camera, 0.0)
    calls = recorded(monkeypatch, correction, "identify", "pairs")
    found = orbit.detections(2)
    assert correction.associate(prior, sighting, found, landmarks, orbit.case.camera, parameters) == "pairs"
    ((given, seen, spread, own, variance, area_px2, rules, place),) = calls
    assert given is found and seen is sighting and rules is parameters.identification
    assert area_px2 == 512.0 * 512.0
    assert_allclose(variance, 1.0)
    count = len(sighting)
    rows = np.zeros((2 * count, prior.mean.size))
    slots = prior.slots(sighting.index)
    assert np.any(slots >= 0) and np.any(slots < 0)
    for k in range(count):
        here = slice(2 * k, 2 * k + 2)
        rows[here, :3], rows[here, 9:12] = sighting.by_position[k], sighting.by_attitude[k]
        rows[here, 12:14], rows[here, 17] = eye(2), sighting.by_scale[k]
        column = slots[k] if slots[k] >= 0 else 14
        rows[here, column : column + 3] = sighting.by_offset[k]
    noise = parameters.errors.attitude_noise_rad
    tilt = np.concatenate([sighting.by_attitude[k] for k in range(count)]) * noise
    dense = (rows @ prior.covariance @ rows.T + tilt @ tilt.T).reshape(count, 2, count, 2)
    assert_allclose(spread, dense, rtol=1e-9, atol=1e-9)
    for k in range(count):
        expected = np.zeros((2, 2))
        if slots[k] < 0:
            expected = sighting.by_offset[k] @ diag([3_600.0] * 3) @ sighting.by_offset[k].T
        assert_allclose(own[k], expected, rtol=1e-9, atol=1e-12)
        at = sighting.by_position[k]
        assert_allclose(place[k], at @ prior.covariance[:3, :3] @ at.T, rtol=1e-9)


def at_altitude(altitude_m):
    mean = np.zeros(18)
    mean[0] = 1_737_400.0 + altitude_m
    return FilterState(0, mean, eye(18), np.empty(0, int))


def test_limits_of_a_search_grow_with_the_altitude():
    """The ground in a pixel sets the limit of the linear search; one without a prior covers the predicted altitude."""
    parameters = AnchoredParameters()
    limits = [correction.tracking_limit_m(at_altitude(1e3 * km), parameters) for km in (14, 50, 100, 150, 200)]
    assert limits == approx([1_500.0, 1_500.0, 1_500.0, 2_250.0, 3_000.0])
    assert recovery._lost_parameters(at_altitude(45e3), parameters) is parameters.lost
    high = recovery._lost_parameters(at_altitude(150e3), parameters)
    assert high == replace(parameters.lost, maximum_altitude_m=approx(180e3))


def test_the_map_is_shown_the_frame_as_corrected_and_what_no_crater_explains(orbit, monkeypatch):
    """The attitude turned back by what the filter found of it, the pixels less their bias."""
    navigator = orbit.flown(3)
    found = orbit.detections(2)
    stray = Detections(*(np.append(column, 300.0) for column in (found.u_px, found.v_px)),
        np.append(found.diameter_px, 200.0), np.ones(len(found) + 1), np.ones(len(found) + 1))  # fmt: skip
    state, fix = navigator.estimate, navigator.fix
    grown = MapState(next_identity=7)
    calls = recorded(monkeypatch, anchored.mapping, "observe", (grown, ("a landmark",)))
    attitude, setup = orbit.attitude(2), navigator.setup
    after, made = anchored.map_frame(navigator.state, fix, stray, attitude, orbit.rotations[2], setup)
    assert made == ("a landmark",) and after.mapped is grown and after.estimate is state
    ((mapped, view, shifted, variance, free, surface_m, camera, rules),) = calls
    assert mapped is navigator.state.mapped and after.surface_m == surface_m
    assert camera is setup.camera and rules is setup.parameters.mapping
    rotation = orbit.rotations[2]
    turn = Rotation.from_rotvec(-(state.mean[9:12] + fix.update.attitude_rad)).as_matrix()
    assert_allclose(view.camera_from_mcmf, turn @ orbit.attitude(2) @ rotation.T, atol=1e-12)
    assert_allclose(view.position_mcmf_m, rotation @ state.mean[:3])
    assert_allclose(view.covariance_m2, rotation @ state.covariance[:3, :3] @ rotation.T)
    assert (view.ticks, view.attitude_sigma_rad) == (state.ticks, fix.update.attitude_sigma_rad)
    assert_allclose(shifted.u_px, stray.u_px - state.mean[12])
    assert_allclose(shifted.v_px, stray.v_px - state.mean[13])
    assert_allclose(variance, 1.0)
    # All detections are of craters of the catalogue but the last.
    assert np.flatnonzero(free).tolist() == [len(found)]
    heights = norm(orbit.map.position_mcmf_m[fix.index], axis=1) - 1_737_400.0
    assert heights.min() - 1_000.0 < surface_m < heights.max() + 1_000.0
    # Without a fix the attitude is taken as measured, with its bias and its noise.
    anchored.map_frame(navigator.state, None, stray, attitude, orbit.rotations[2], setup)
    errors = setup.parameters.errors
    assert calls[1][1].attitude_sigma_rad == approx(hypot(errors.attitude_bias_rad, errors.attitude_noise_rad))
    turn = Rotation.from_rotvec(-state.mean[9:12]).as_matrix()
    assert_allclose(calls[1][1].camera_from_mcmf, turn @ orbit.attitude(2) @ rotation.T, atol=1e-12)


def coasted_then_empty(orbit, navigator, seconds):
    start, nothing = orbit.ticks[2], orbit.detections(3).select(slice(0))
    return [navigator.step(start + 100 * SECOND, None, None), navigator.step(start + seconds * SECOND, nothing, None)]


def test_a_pass_ends_when_nothing_was_seen_for_the_memory_of_craters(orbit, monkeypatch):
    """240 s without an image, or a clock that went back; coasted frames in between change nothing of that."""
    for seconds, ended in ((240, 0), (241, 1), (-1, 1)):
        navigator = orbit.flown(3)
        with monkeypatch.context() as patched:
            calls = recorded(patched, anchored.mapping, "close", (navigator.state.mapped, ("new",)))
            reports = coasted_then_empty(orbit, navigator, seconds)
        assert [report.new_landmarks for report in reports] == [(), ("new",) * ended]
        assert len(calls) == ended, seconds
        # The search takes up where the image was, not where it was coasted to.
        assert navigator.state.image_ticks == orbit.ticks[2] + seconds * SECOND


def test_the_landmarks_of_a_pass_serve_from_its_end_on(orbit, monkeypatch):
    navigator = orbit.navigator()
    before = replace(navigator.state, places="searched before")
    after, made = anchored.end_pass(before, navigator.setup)
    # Nothing was mapped: the map stays.
    assert made == () and after.landmarks is before.landmarks and after.places is before.places
    mapped = MapState(landmarks=("one",))
    recorded(monkeypatch, anchored.mapping, "close", (mapped, ("new",)))
    joined = recorded(monkeypatch, anchored.mapping, "with_catalogue", "both")
    after, made = anchored.end_pass(before, navigator.setup)
    assert made == ("new",) and after.mapped is mapped
    assert after.landmarks == "both" and joined == [(("one",), navigator.setup.catalogue)]
    assert after.places is None
