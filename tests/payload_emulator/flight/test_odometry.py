"""The paper's odometry: what it gets right, what its plane costs, and every outcome and reset it can have."""

import math

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx, mark

from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from payload_emulator.flight.navigation.odometry import odometry
from payload_emulator.flight.navigation.odometry.matcher import GroundFeatures, Match
from payload_emulator.flight.navigation.odometry.odometry import OdometryParameters, frame_features
from payload_emulator.flight.navigation.outcomes import Mode, Outcome, ResetTrigger
from payload_emulator.flight.vision.detections import Detections
from tmtc.dictionary.tables import unpack_anchor_table

CAMERA = PinholeCamera()
# Two passes between -60 and 60 degrees of latitude, seconds after the epoch of Table I. The ascending one
# holds the perilune (19 to 30 km in altitude), the descending one the apolune (32 to 43 km), where the
# plane is worse.
ASCENDING = np.arange(5_895.0, 8_100.0, 15.0)
DESCENDING = np.arange(9_240.0, 11_430.0, 15.0)


def anchor_table(moon, start_s, stop_s):
    seconds = np.arange(start_s - 300.0, stop_s + 300.0, 30.0)
    return unpack_anchor_table(moon.anchor(seconds))


def fly(moon, mode, seconds, seed=1):
    """Return the last state, all reports, the horizontal error at the end and the path length, metres."""
    field, anchor = moon.crater_field(seed), anchor_table(moon, seconds[0], seconds[-1])
    state, reports, path_m, previous = None, [], 0.0, None
    for second in seconds:
        position = moon.orbit([second])[0]
        state, report = odometry.step(
            state, moon.ticks_at(second), field.perfect_detections(position), anchor, CAMERA, mode
        )  # fmt: skip
        reports.append(report)
        unit = position / np.linalg.norm(position)
        if previous is not None:
            path_m += moon.radius_m * np.arccos(unit @ previous)
        previous = unit
    latitude, longitude, _ = moon.place(position)
    turn = (state.longitude_rad - longitude + np.pi) % (2.0 * np.pi) - np.pi
    error = moon.radius_m * np.hypot(state.latitude_rad - latitude, turn * np.cos(latitude))
    return state, reports, float(error), path_m


def test_perfect_detections_drift_as_far_as_the_plane_is_wrong_and_not_on_the_sphere(moon):
    # An independent re-implementation of the paper's equations drifts 1.75 % of path, 59 km in a pass
    # like this.
    drifts = []
    for seed in (1, 2, 3):
        _, reports, error_m, path_m = fly(moon, Mode.paper, ASCENDING, seed)
        drifts.append(100.0 * error_m / path_m)
        assert path_m == approx(3.6e6, rel=0.03)
        assert sum(report.outcome is Outcome.multi for report in reports) >= 0.95 * len(reports)
    assert 1.6 <= np.mean(drifts) <= 1.9
    for seed in (1, 2):
        _, _, error_m, path_m = fly(moon, Mode.spherical, ASCENDING, seed)
        assert 100.0 * error_m / path_m <= 0.02


def test_a_descending_pass_is_followed_to_the_south_and_every_use_of_the_anchor_is_counted(moon):
    for mode, limit_percent in ((Mode.paper, 4.0), (Mode.spherical, 0.02)):
        state, reports, error_m, path_m = fly(moon, mode, DESCENDING)
        assert state.direction == -1
        assert sum(report.outcome is Outcome.multi for report in reports) >= 0.95 * len(reports)
        assert 100.0 * error_m / path_m <= limit_percent
    state, reports, _, _ = fly(moon, Mode.paper, ASCENDING[:40])
    assert state.altitude_reads == 40
    assert state.resets == 1
    assert reports[0].reset_trigger is ResetTrigger.initialization
    assert {report.reset_trigger for report in reports[1:]} == {ResetTrigger.none}


def test_the_planar_system_recovers_an_exact_planar_motion():
    # Ten points of a plane seen from h = 30 km and, moved (0.3, 24.5, 0.2) km, from h + 0.2 km.
    ground = np.random.default_rng(4).uniform(-25e3, 25e3, (10, 2)) + np.array([0.0, 12e3])
    h, move = 30_000.0, np.array([300.0, 24_500.0, 200.0])
    features = []
    for shift, altitude in ((np.zeros(2), h), (move[:2], h + move[2])):
        local = ground - shift
        u = 255.5 + CAMERA.focal_px * local[:, 0] / altitude
        v = 255.5 - CAMERA.focal_px * local[:, 1] / altitude
        kinds = np.zeros(10, int)
        features.append(odometry.FrameFeatures(u, v, GroundFeatures(local[:, 0], local[:, 1], kinds), altitude))
    match = Match(np.arange(10), np.arange(10), 10, True)
    motion = odometry.solve_planar(features[0], features[1], match, CAMERA, 15.0)
    # Rounding of a 20 x 3 least-squares problem with entries of 1e2 and right-hand sides of 1e6 m px.
    assert_allclose([motion.east_m, motion.north_m, motion.up_m], move, atol=1e-6)


def test_one_pair_locks_the_change_of_altitude_to_zero():
    plane = odometry.FrameFeatures(np.array([200.0]), np.array([150.0]), _one_place(1_000.0, 12_000.0), 30_000.0)
    later = odometry.FrameFeatures(np.array([198.0]), np.array([270.0]), _one_place(900.0, -12_000.0), 30_100.0)
    match = Match(np.array([0]), np.array([0]), 1, False)
    planar = odometry.solve_planar(plane, later, match, CAMERA, 15.0)
    spherical = odometry.solve_spherical(plane, later, match, CAMERA, 0.3, 15.0)
    assert planar.up_m == 0.0
    assert planar.north_m == approx(30_100.0 * 120.0 / CAMERA.focal_px)
    assert planar.east_m == approx(30_100.0 * 2.0 / CAMERA.focal_px)
    assert spherical.up_m == 0.0


def _one_place(east_m, north_m):
    return GroundFeatures(np.array([east_m]), np.array([north_m]), np.array([0]))


class Stream:
    """Frames every 15 s whose detections a test chooses: true ones, none, or craters that moved backwards."""

    def __init__(self, moon, frames=1, **parameters):
        self.moon, self.field = moon, moon.crater_field(1)
        self.anchor = anchor_table(moon, 6_000.0, 9_000.0)
        self.parameters = OdometryParameters(**parameters)
        self.state = None
        self.second = 6_600.0
        for _ in range(frames):
            self.frame()

    def frame(self, kind="true", wait_s=15.0, manual_step=False):
        self.second += wait_s
        seen = self.field.perfect_detections(self.moon.orbit([self.second])[0])
        if kind == "none":
            seen = seen.select(np.zeros(len(seen), bool))
        self.state, report = odometry.step(
            self.state, self.moon.ticks_at(self.second), seen, self.anchor, CAMERA, Mode.paper, self.parameters,
            manual_step=manual_step
        )  # fmt: skip
        return report


def test_frames_without_detections_repeat_the_last_motion_over_their_time_and_then_are_missed(moon):
    stream = Stream(moon)
    assert stream.frame().outcome is Outcome.multi
    latitude, step_north = stream.state.latitude_rad, stream.state.last_motion.north_m
    reports = [stream.frame("none") for _ in range(22)]
    assert [report.outcome for report in reports] == [Outcome.predicted] * 20 + [Outcome.missed] * 2
    assert moon.radius_m * (stream.state.latitude_rad - latitude) == approx(20 * step_north, rel=1e-9)
    stream = Stream(moon, 0)
    stream.frame("none")
    held = stream.state
    assert stream.frame("none").outcome is Outcome.missed
    assert stream.state.latitude_rad == held.latitude_rad
    stream = Stream(moon, 2)
    step_north = stream.state.last_motion.north_m
    assert stream.frame("none", wait_s=30.0).shift_north_m == approx(2.0 * step_north)


def test_motion_against_the_pass_is_rejected_and_predicted_over(moon):
    stream = Stream(moon, 2)
    before, good = stream.state, stream.state.last_motion
    stream.state = odometry.replace(before, direction=-1)
    # The craters now move backwards and the bounds let them: only the direction filter is left to stop it.
    backwards = stream.field.perfect_detections(moon.orbit([stream.second - 15.0])[0])
    state, report = odometry.step(
        stream.state, before.ticks + 15 * 65_536, backwards, stream.anchor, CAMERA, Mode.paper
    )
    assert report.outcome is Outcome.rejected
    assert report.pairs >= 2
    assert report.shift_north_m == approx(good.north_m)
    assert state.latitude_rad > before.latitude_rad


@mark.parametrize("wait_s, expected", [(60.0, ResetTrigger.none), (60.1, ResetTrigger.time_gap)])
def test_a_gap_longer_than_the_limit_puts_the_state_back_onto_the_anchor(moon, wait_s, expected):
    stream = Stream(moon)
    assert stream.frame(wait_s=wait_s).reset_trigger is expected
    assert stream.state.resets == (2 if expected is ResetTrigger.time_gap else 1)


def test_a_manual_step_and_a_clock_that_runs_backwards_both_reset(moon):
    stream = Stream(moon, 2)
    manual = stream.frame(manual_step=True)
    assert (manual.outcome, manual.reset_trigger) == (Outcome.anchored, ResetTrigger.manual_step)
    backwards = stream.frame(wait_s=-45.0)
    assert (backwards.outcome, backwards.reset_trigger) == (Outcome.anchored, ResetTrigger.time_gap)
    latitude, _, altitude = moon.place(moon.orbit([stream.second])[0])
    # The anchor table interpolates 30 s nodes; one tick of time is 0.03 m of motion.
    assert stream.state.latitude_rad * moon.radius_m == approx(latitude * moon.radius_m, abs=0.05)
    assert stream.state.altitude_m == approx(altitude, abs=0.05)


def test_the_safety_timeout_is_off_unless_asked_for_and_an_anchor_that_has_run_out_is_no_reset(moon):
    streams = Stream(moon, 2), Stream(moon, 2, safety_timeout_s=100.0)
    outcomes = [[stream.frame("none").reset_trigger for _ in range(8)] for stream in streams]
    assert set(outcomes[0]) == {ResetTrigger.none}
    assert outcomes[1].index(ResetTrigger.safety_timeout) == 6  # 7 x 15 s > 100 s
    stream = Stream(moon, 0)
    stream.second = 20_000.0
    report = stream.frame()
    assert (report.outcome, report.reset_trigger) == (Outcome.missed, ResetTrigger.none)
    assert stream.state is None


def test_detections_with_nan_or_beyond_the_horizon_match_nothing():
    nan = np.array([np.nan, 10.0, 20.0])
    seen = odometry.Detections(
        nan, np.array([5.0, np.nan, 20.0]), np.array([30.0, 30.0, np.nan]), np.ones(3), np.ones(3)
    )
    for mode in (Mode.paper, Mode.spherical):
        assert odometry.frame_features(seen, 30_000.0, CAMERA, mode).ground.size_class.tolist() == [-1, -1, -1]
    high = odometry.frame_features(
        odometry.Detections(*(np.array([value]) for value in (0.0, 0.0, 9.0, 1.0, 1.0))), 400_000.0, CAMERA,
        Mode.spherical
    )  # fmt: skip
    assert high.ground.size_class.tolist() == [-1]


def test_on_the_sphere_a_detection_lies_at_its_arc_from_the_place_below():
    # A ground point two degrees east at the height of the sphere, seen from 30 km: x / f = R sin a / (r - R cos a).
    camera, altitude_m, arc_rad = PinholeCamera(), 30_000.0, math.radians(2.0)
    down_m = MOON_RADIUS_M + altitude_m - MOON_RADIUS_M * math.cos(arc_rad)
    tangent = MOON_RADIUS_M * math.sin(arc_rad) / down_m
    u, v = camera.centre_px
    seen = Detections(
        np.array([u + camera.focal_px * tangent, u]), np.array([v, v]), np.full(2, 20.0), np.ones(2), np.ones(2)
    )  # fmt: skip
    ground = frame_features(seen, altitude_m, camera, Mode.spherical).ground
    assert ground.east_m == approx([MOON_RADIUS_M * arc_rad, 0.0], abs=1e-6)
    assert ground.north_m == approx([0.0, 0.0], abs=1e-6)
