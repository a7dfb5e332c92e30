"""Parts of a frame that reach the estimators, reports of it, and counts of reads and troubles."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from numpy import degrees, nan, radians
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark

from lunar.datafolder import find_data
from payload_emulator.flight.navigation.anchored import anchored
from payload_emulator.flight.navigation.anchored.anchored import AnchoredReport
from payload_emulator.flight.navigation.anchored.parameters import AnchoredParameters
from payload_emulator.flight.navigation.estimator import ESTIMATORS, AnchoredEstimator
from payload_emulator.flight.navigation.filter.map_offset import OffsetRule, OffsetSize
from payload_emulator.flight.navigation.outcomes import Mode, Outcome, ResetTrigger
from payload_emulator.flight.onboard.loads import FlightParameters, FlightTables
from payload_emulator.flight.onboard.observer import Observer
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.detector import DetectorParameters
from payload_emulator.flight.vision.preprocess import ImageQuality
from payload_emulator.session.archive.emulator import emulate
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.spacecraft.loading import BuildParameters, format_parameters, parse_parameters
from tests.payload_emulator.flight import unscented
from tests.scenarios import short_scenario
from tmtc.dictionary.tables import CatalogueTable, GravityTable, InitialState, OrientationTable, table_hash

ATTITUDE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
IMAGE = np.zeros((4, 4), np.uint8)
RNG = np.random.default_rng(4)


class Recorder:
    """Telemetry that keeps what it is sent."""

    def __init__(self):
        self.sent = []
        self.events = []
        self.ticks, self.frame_number = 65_536 * 1_000, 0
        self.counts = {"events": 0, "packets": 0}

    def send(self, name, values):
        self.sent.append((name, values))

    def event(self, severity, event, value_1=0.0, value_2=0.0):
        self.events.append((severity, event, value_1, value_2))

    def named(self, name):
        return [values for found, values in self.sent if found == name]

    def names(self):
        return [event for _, event, _, _ in self.events]


class Clock:
    """A timer that says how long the detector takes."""

    def __init__(self):
        self.now_ns, self.detector_ns = 0, 0

    def enter(self, stage):
        if stage.name == "telemetry":
            self.now_ns += self.detector_ns
        return self.now_ns


class ScriptedDetector:
    """A detector that returns given detections."""

    def __init__(self):
        self.quality, self.found, self.fails = ImageQuality.OK, detections(6), False

    def examine(self, image, sun=None):
        self.sun = sun
        if self.fails:
            raise RuntimeError("twelve chars")
        return self.quality, self.found


class Navigator:
    """An anchored estimator that keeps what it is given and returns given reports."""

    def __init__(self):
        self.given = []
        self.outcome, self.lost, self.fix, self.new_landmarks = Outcome.coasted, False, None, ()
        self.breaks = self.reacquired = False
        self.attitude_noise_rad, self.offset = 0.0, None
        root = RNG.standard_normal((18, 18))
        self.start = SimpleNamespace(estimate=None, landmarks=None)
        self.state = SimpleNamespace(
            estimate=SimpleNamespace(mean=np.arange(18.0), covariance=root @ root.T),
            landmarks=SimpleNamespace(ids=np.arange(100) + 1_000),
        )
        self.widened = []

    def step(self, state, observation, setup):
        assert setup == "the tables" and state is (self.state if self.given else self.start)
        self.given.append((observation.ticks, observation.found, observation.camera_from_icrf))
        if self.breaks:
            raise np.linalg.LinAlgError
        return self.state, AnchoredReport(
            self.outcome, 0.1, -0.2, 30e3, (1.0, 2.0, 3.0), (4.0, 6.0, 5.0), 7.0, 3, 9, 11, self.reacquired,
            self.lost, self.fix, self.new_landmarks, radians(0.01), self.attitude_noise_rad, self.offset
        )  # fmt: skip

    def widen(self, state, position_m, velocity_m_s):
        assert state is self.start
        self.widened.append((position_m, velocity_m_s))
        return self.start


def detections(count):
    return Detections(
        100.0 + 10.0 * np.arange(count), np.full(count, 200.0), np.full(count, 30.0), np.linspace(0.9, 0.4, count),
        np.full(count, 0.7)
    )  # fmt: skip


@fixture
def rig(monkeypatch):
    eye, telemetry, clock, navigator = ScriptedDetector(), Recorder(), Clock(), Navigator()
    observer = Observer(eye, FlightParameters(modes=(Mode.anchored,)), telemetry, clock)
    observer._states[Mode.anchored] = ("the tables", navigator.start)
    monkeypatch.setattr(anchored, "step", navigator.step)
    monkeypatch.setattr(anchored, "widened", navigator.widen)
    parts = {"eye": eye, "telemetry": telemetry, "clock": clock, "navigator": navigator, "observer": observer}
    return SimpleNamespace(**parts, named=telemetry.named)


def observing(rig, mode):
    rig.observer = Observer(rig.eye, FlightParameters(modes=(mode,)), rig.telemetry, rig.clock)
    return rig.observer


def look(rig, score_floor=0.0, attitude=ATTITUDE, quiet=False):
    rig.observer.frame(IMAGE, attitude, score_floor, 1.0, quiet)


def look_fixed(rig, detection, index):
    rig.navigator.outcome = Outcome.fixed
    identification = SimpleNamespace(detection=np.array(detection))
    rig.navigator.fix = SimpleNamespace(identification=identification, index=np.array(index))
    look(rig)


def items(rig, name, *fields):
    """Fields of the items of the only packet of a name."""
    (sent,) = rig.named(name)
    return [sent["items"][field].tolist() for field in fields]


def outcome_of(rig, **values):
    """The packet `frame_outcome` with these values and those of a frame without estimate."""
    nothing = approx(nan, nan_ok=True)
    return {
        "frame_number": 0, "image_ticks": rig.telemetry.ticks, "estimator": 0, "reset_trigger": 0, "detections": 6,
        "candidate_pairs": 0, "pairs": 0, "shift_east_m": nothing, "shift_north_m": nothing, "anchor_reads": 0, **values
    }  # fmt: skip


def test_the_estimate_goes_down_with_the_upper_triangle_and_the_degrees_of_its_innovation(rig):
    look_fixed(rig, [0, 3, 5], [7, 2, 40])
    (sent,) = rig.named("filter_estimate")
    covariance = rig.navigator.state.estimate.covariance
    assert sent["covariance"].tolist() == [covariance[i, j] for i in range(9) for j in range(i, 9)]
    assert [*sent["position_icrf_m"], *sent["velocity_icrf_m_s"], *sent["acceleration_rtn_m_s2"]] == list(range(9))
    assert sent["innovation_degrees"] == 6
    pairs = [[0, 3, 5], [1_007, 1_002, 1_040]]
    assert items(rig, "identifications", "detection", "crater_id") == pairs
    assert rig.observer.sightings == {1_007: 1, 1_002: 1, 1_040: 1}


def test_pairs_name_the_detection_by_its_place_among_those_reported(rig):
    """Of 300 detections the 255 strongest go down, in their order."""
    score = np.linspace(0.2, 0.9, 300)
    rig.eye.found = Detections(*(np.full(300, 50.0),) * 3, score, np.full(300, 0.7))
    look_fixed(rig, [10, 45, 299], [1, 2, 3])
    # Rows 0 to 44 are the weakest: the first is not reported, row 45 is the first that is.
    assert items(rig, "identifications", "detection", "crater_id") == [[0, 254], [1_002, 1_003]]
    assert items(rig, "detections", "score") == [score[45:].tolist()]


def test_weak_detections_and_those_far_outside_reach_nobody(rig):
    u = np.array([100.0, 2e5, nan, 120.0, 130.0, 140.0])
    rig.eye.found = Detections(u, *(np.full(6, 50.0),) * 2, np.array([0.9, 0.9, 0.9, 0.3, nan, 0.5]), np.ones(6))
    look(rig, score_floor=0.5)
    ((_, given, _),) = rig.navigator.given
    # A score at the floor is used; one that is no number is not below it.
    assert given.u_px.tolist() == [100.0, 130.0, 140.0]
    assert items(rig, "detections", "u_px", "score") == [[100.0, 130.0, 140.0], [0.9, 0.0, 0.5]]
    assert rig.observer.counts["detections"] == 3


@mark.parametrize("quiet", [False, True])
def test_a_bad_image_is_counted_reported_and_kept_from_the_filter(rig, quiet):
    rig.eye.quality = ImageQuality.DARK
    look(rig, quiet=quiet)
    assert rig.navigator.given[0][1] is None
    assert rig.observer.counts["frames_bad"] == 1 and rig.observer.last_quality is ImageQuality.DARK
    assert ("image_dark" in rig.telemetry.names()) is not quiet
    assert rig.observer.summary()["no_image_reasons"] == {"dark": 1}


def test_a_detector_that_fails_or_is_late_gives_no_detections(rig):
    rig.eye.fails = True
    look(rig)
    assert rig.telemetry.events[0] == ("high", "detector_error", 12.0, 0.0)
    assert rig.observer.detector_failed and rig.navigator.given[-1][1] is None
    rig.eye.fails, rig.clock.detector_ns = False, 1_000_000_001
    look(rig)
    assert rig.telemetry.names()[-1] == "detector_timeout" and rig.navigator.given[-1][1] is None
    assert rig.observer.counts["detector_timeouts"] == 1
    rig.clock.detector_ns = 999_999_999
    look(rig)
    assert not rig.observer.detector_failed and len(rig.navigator.given[-1][1]) == 6
    assert rig.observer.summary()["no_image_reasons"] == {"detector failed": 2}


@mark.parametrize("length, known", [(1.0, True), (1.0009, True), (1.0011, False), (nan, False), (None, False)])
def test_an_attitude_is_a_unit_quaternion_or_none(rig, length, known):
    look(rig, attitude=np.zeros(0) if length is None else np.r_[length, ATTITUDE[1:]])
    given = rig.navigator.given[0][2]
    assert (given is not None) is known
    assert ("attitude_missing" in rig.telemetry.names()) is not known
    if known:
        assert_allclose(given, np.eye(3), atol=1e-12)


def test_the_sun_is_handed_on_where_it_is_known(rig):
    look(rig)
    assert_array_equal(rig.eye.sun, [0.0, 0.0, -1.0])
    look(rig, attitude=np.array([1.0, 0, 0, 0, nan, 0, 0]))
    assert rig.eye.sun is None


def test_lasting_trouble_is_reported_at_its_beginning(rig):
    for lost, refused in ((0, 0), (1, 1), (1, 1), (0, 0), (1, 0)):
        rig.navigator.lost, rig.navigator.outcome = lost, Outcome.refused if refused else Outcome.coasted
        look(rig)
    names = rig.telemetry.names()
    assert names.count("filter_divergence") == 2 and names.count("fix_refused") == 1
    assert ("medium", "filter_divergence", 6.0, 0.0) in rig.telemetry.events


def test_an_attitude_noisier_than_declared_is_reported_at_its_beginning_and_end(rig):
    for noise_deg in (0.0, 0.2, 0.3, 0.0, 0.0, 1.0):
        rig.navigator.attitude_noise_rad = radians(noise_deg)
        look(rig)
    found = [event for event in rig.telemetry.events if event[1].startswith("attitude")]
    degraded, restored = ("medium", "attitude_degraded"), ("info", "attitude_restored")
    assert [event[:2] for event in found] == [degraded, restored, degraded]
    assert_allclose([event[2:] for event in found], [(0.2, 0.01), (0.01, 0.0), (1.0, 0.01)])


def test_the_size_of_the_map_offset_and_the_noise_are_sent_when_the_size_changes(rig):
    for sigma_m, fixes, pending in ((60.0, 0, 0), (60.0, 0, 7), (31.0, 40, 0), (31.0, 40, 9), (31.0, 80, 0)):
        rig.navigator.offset = OffsetSize(sigma_m, 0.5, fixes, pending=pending, noise_factor=0.8)
        look(rig)
    for name, values in (("map_offset", (60.0, 31.0, 31.0)), ("detection_noise", (0.8, 0.8, 0.8))):
        sent = [event[2:] for event in rig.telemetry.events if event[:2] == ("info", name)]
        assert sent == list(zip(values, (0.0, 40.0, 80.0), strict=True))


def test_a_reset_of_the_filter_is_reported_and_counted(rig):
    rig.navigator.reacquired = True
    look(rig)
    assert ("medium", "filter_reset", 3.0, 6.0) in rig.telemetry.events
    assert rig.observer.summary()["fixes"]["reacquired"] == 1


def test_what_cannot_be_inverted_ends_in_a_fresh_start(rig):
    rig.navigator.breaks = True
    look(rig)
    assert ("high", "estimator_error", 2.0, 0.0) in rig.telemetry.events
    # No tables are loaded: there is nothing to begin again with, and frames are refused.
    look(rig)
    assert [values["outcome"] for values in rig.named("frame_outcome")] == [int(Outcome.refused)] * 2
    assert rig.observer.summary()["outcomes"]["refused"] == 2


def test_a_frame_of_odometry_is_reported_in_full(rig, monkeypatch):
    """Longitude -0.3 rad is 342.8 degrees east; velocities, sigmas and NIS do not exist for odometry."""
    observer = observing(rig, Mode.spherical)
    anchor = object()
    observer._states[Mode.spherical] = (anchor, None)
    observer.manual_step = True
    state = SimpleNamespace(
        latitude_rad=0.2, longitude_rad=-0.3, altitude_m=31e3, altitude_reads=7, resets=2,
        features=SimpleNamespace(altitude_m=30e3)
    )  # fmt: skip
    report = SimpleNamespace(
        outcome=Outcome.multi, reset_trigger=ResetTrigger.time_gap, candidate_pairs=9, pairs=4, shift_east_m=12.0,
        shift_north_m=-5.0
    )  # fmt: skip
    calls = []

    def step(*given, **more):
        calls.append((given, more))
        return state, report

    monkeypatch.setattr("payload_emulator.flight.navigation.odometry.odometry.step", step)
    rig.telemetry.frame_number = 5
    look(rig)
    look(rig)
    parameters = observer._parameters
    for k, (before, manual) in enumerate(((None, True), (state, False))):
        (was, ticks, found, table, camera, mode, tuned), more = calls[k]
        assert was is before and more == {"manual_step": manual}
        assert (ticks, mode) == (rig.telemetry.ticks, Mode.spherical) and len(found) == 6
        assert table is anchor and camera is parameters.camera and tuned is parameters.odometry
    nothing = (nan,) * 3
    expected = {
        "frame_number": 5, "image_ticks": rig.telemetry.ticks, "estimator": 1, "outcome": 1,
        "latitude_deg": approx(degrees(0.2)), "longitude_deg": approx(360.0 - degrees(0.3)),
        "altitude_m": 31e3, "velocity_icrf_m_s": approx(nothing, nan_ok=True),
        "sigma_rtn_m": approx(nothing, nan_ok=True), "nis": approx(nan, nan_ok=True), "matched": 4
    }  # fmt: skip
    first, second = rig.named("navigation_state")
    assert first == expected and second == {**expected, "frame_number": 6}
    assert rig.named("frame_outcome")[0] == outcome_of(
        rig, frame_number=5, estimator=1, outcome=1, reset_trigger=2, candidate_pairs=9, pairs=4, shift_east_m=12.0,
        shift_north_m=-5.0, anchor_reads=7
    )  # fmt: skip
    assert rig.telemetry.events == [("info", "anchor_read", 2.0, 1.0)] * 2
    assert observer.anchor_reads == 9
    assert observer.summary()["estimators"]["spherical"] == {
        "outcomes": {"anchored": 0, "multi": 2, "single": 0, "predicted": 0, "missed": 0, "rejected": 0},
        "reset_triggers": {"time_gap": 2},
        "resets": 2,
        "altitude_reads": 7,
        # The first of each is the start.
        "anchor_reads_after_start": 7,
    }


def test_odometry_without_a_position_reports_its_outcome_alone(rig, monkeypatch):
    observer = observing(rig, Mode.paper)
    look(rig)
    assert rig.named("frame_outcome") == [outcome_of(rig, outcome=Outcome.missed)]
    observer._states[Mode.paper] = (object(), None)
    report = SimpleNamespace(
        outcome=Outcome.rejected, reset_trigger=ResetTrigger.none, candidate_pairs=3, pairs=0, shift_east_m=nan,
        shift_north_m=nan
    )  # fmt: skip
    monkeypatch.setattr("payload_emulator.flight.navigation.odometry.odometry.step", lambda *_, **__: (None, report))
    look(rig)
    rejected = outcome_of(rig, frame_number=1, outcome=Outcome.rejected, candidate_pairs=3)
    assert rig.named("frame_outcome")[1] == rejected
    assert rig.named("navigation_state") == [] and rig.telemetry.events == []
    assert observer.summary()["outcomes"] == {
        "anchored": 0, "multi": 0, "single": 0, "predicted": 0, "missed": 1, "rejected": 1
    }  # fmt: skip


def test_a_frame_of_the_filter_is_reported_in_full(rig):
    rig.telemetry.frame_number, rig.navigator.outcome = 8, Outcome.fixed
    look(rig)
    ticks = rig.telemetry.ticks
    fixed = outcome_of(rig, frame_number=8, estimator=2, outcome=Outcome.fixed, candidate_pairs=9, pairs=3)
    assert rig.named("frame_outcome") == [fixed]
    assert rig.named("navigation_state") == [
        {
            "frame_number": 8, "image_ticks": ticks, "estimator": 2, "outcome": int(Outcome.fixed),
            "latitude_deg": approx(degrees(0.1)), "longitude_deg": approx(360.0 - degrees(0.2)),
            "altitude_m": 30e3, "velocity_icrf_m_s": (1.0, 2.0, 3.0), "sigma_rtn_m": (4.0, 6.0, 5.0), "nis": 7.0,
            "matched": 3
        }
    ]  # fmt: skip
    (sent,) = rig.named("filter_estimate")
    # A frame without a fix has no degrees and no pairs.
    assert (sent["frame_number"], sent["image_ticks"], sent["innovation_degrees"]) == (8, ticks, 0)
    assert rig.named("identifications") == []
    assert rig.navigator.given[0][0] == ticks
    summary = rig.observer.summary()
    assert summary["estimators"]["anchored"]["outcomes"] == {"fixed": 1, "coasted": 0, "refused": 0, "no_image": 0}
    assert summary["fixes"] == {"fixed": 1, "coasted": 0, "refused": 0, "no_image": 0, "reacquired": 0}
    assert {name: summary[name] for name in ("frames_processed", "frames_bad", "detections", "events")} == {
        "frames_processed": 1, "frames_bad": 0, "detections": 6, "events": 0
    }  # fmt: skip


def test_new_landmarks_go_down_forty_to_a_packet(rig, monkeypatch):
    def rows(landmarks):
        n = np.array(landmarks, float)
        return SimpleNamespace(
            identity=n, latitude_rad=0.01 * n, longitude_rad=-0.01 * n, height_m=n + 1.0, diameter_m=n + 2.0,
            sigma_m=np.stack([n + 3.0, n + 4.0, n + 5.0], axis=1), sightings=n + 6.0, passes=n + 7.0
        )  # fmt: skip

    monkeypatch.setattr("payload_emulator.flight.onboard.observer.map_rows", rows)
    rig.navigator.new_landmarks = tuple(range(41))
    look(rig)
    first, second = rig.named("landmarks")
    assert first["items"]["landmark_id"].tolist() == list(range(40))
    assert (second["frame_number"], second["image_ticks"]) == (0, rig.telemetry.ticks)
    assert {name: values.tolist() for name, values in second["items"].items()} == {
        "landmark_id": [40.0], "latitude_deg": [approx(degrees(0.4))],
        "longitude_deg": [approx(360.0 - degrees(0.4))], "height_m": [41.0], "diameter_m": [42.0],
        "sigma_east_m": [43.0], "sigma_north_m": [44.0], "sigma_up_m": [45.0], "sightings": [46.0], "passes": [47.0]
    }  # fmt: skip


def test_detections_are_reported_within_the_range_of_their_fields_and_with_their_class(rig):
    """From 30 km a crater in the centre of 6, 12 and 20 km is as wide as f D / h; 4 km is no class of 5 to 30 km."""
    focal_px = 256.0 / np.tan(radians(60.0))
    diameter = focal_px * np.array([6e3, 12e3, 20e3, 4e3, 6e3]) / 30e3
    rig.eye.found = Detections(
        np.array([255.5, 255.5, 255.5, 255.5, -3.0]), np.array([255.5, 255.5, 255.5, 255.5, 2_000.0]), diameter,
        np.array([0.5, 1.5, -0.5, 0.4, 0.3]), np.arange(5.0)
    )  # fmt: skip
    look(rig, score_floor=-1.0)
    (sent,) = rig.named("detections")
    assert (sent["frame_number"], sent["image_ticks"], sent["image_quality"]) == (0, rig.telemetry.ticks, 0)
    items = sent["items"]
    assert items["u_px"].tolist() == [255.5] * 4 + [0.0]
    # A field of 16 bits in 1/64 px.
    assert items["v_px"].tolist() == [255.5] * 4 + [65_535 / 64.0]
    assert_array_equal(items["diameter_px"], diameter)
    assert items["score"].tolist() == [0.5, 1.0, 0.0, 0.4, 0.3]
    assert items["sigma_px"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert items["size_class"][:3].tolist() == [0, 1, 2] and items["size_class"][3] not in (0, 1, 2)


def test_without_an_altitude_no_detection_has_a_class(rig):
    rig.observer._states.clear()
    look(rig)
    assert items(rig, "detections", "size_class") == [[-1] * 6]


def test_a_damaged_table_is_reported_by_its_number_and_its_hash(rig):
    octets = b"no table at all"
    observer = observing(rig, Mode.anchored)
    observer.load_tables(FlightTables(catalogue=octets, burns=octets, anchor_ephemeris=octets))
    assert rig.telemetry.events == [
        ("high", "table_refused", float(number), float(table_hash(octets))) for number in (1, 2, 10)
    ]
    assert observer._states == {Mode.anchored: None}


def test_a_widened_orbit_and_a_reset_reach_the_navigator(rig):
    calls = rig.navigator.widened
    rig.observer.widen(500.0, 0.5)
    assert calls == [(500.0, 0.5)]
    rig.observer.reset()
    # There are no tables to start a new one from.
    assert rig.observer._states == {Mode.anchored: None}
    rig.observer.widen(500.0, 0.5)
    assert len(calls) == 1


def test_each_mode_has_a_row():
    assert set(ESTIMATORS) == set(Mode)


def test_a_sigma_point_filter_in_the_row_of_the_filter_flies_the_demo(tmp_path, monkeypatch):
    """Five frames that start with an error of 1 km, which the shipped filter reduces to 42 m at most."""
    craters = []
    update = unscented.update

    def counted(*given):
        craters.append(given[4].size)
        return update(*given)

    monkeypatch.setattr(unscented, "update", counted)
    monkeypatch.setitem(ESTIMATORS, Mode.anchored, AnchoredEstimator(unscented))
    flown = emulate(parse_scenario(short_scenario(75.0)), find_data(None), tmp_path)["navigation"]
    assert len(craters) == 5 and min(craters) > 10
    assert flown["fixed_share_imaging"] == 1.0 and flown["wrong_fixes"] == 0
    (arc,) = flown["per_arc"]
    assert arc["propagate_only_m"] > 900.0 > 100.0 > arc["max_m"]
    assert flown["nis_per_degree"] == approx(0.603, abs=0.005)


def test_what_was_learned_of_a_catalogue_is_kept_until_another_one_is_loaded():
    """A new start state comes with each pass: the size of the offset stays, with another list it is the prior."""
    two = np.array([0.1, 0.2])
    catalogue = CatalogueTable(np.arange(2), two, two, 5e3 * np.ones(2), np.zeros(2), 50.0 * np.ones((2, 3)))
    gravity = GravityTable("test", 4.9e12, 1_738e3, np.eye(3), np.zeros((3, 3)))
    tables = {
        "catalogue": catalogue, "gravity": gravity, "burns": None,
        "orientation": OrientationTable(np.array([0, 65_536]), np.tile(np.eye(3), (2, 1, 1)), np.eye(3)),
        "initial_state": InitialState(0, np.array([1.77e6, 0.0, 0.0]), np.array([0.0, 1.6e3, 0.0]), 1e3, 1.0)
    }  # fmt: skip
    parameters = FlightParameters(anchored=AnchoredParameters(offset=OffsetRule()))
    estimator = AnchoredEstimator()

    def size_m(before, **changed):
        setup, state = estimator.start(tables | changed, parameters, before)
        assert setup.initial.covariance[14, 14] == state.offset.sigma_m**2
        assert setup.parameters.errors.catalogue_correlation_rad == OffsetRule().correlation_rad
        assert setup.parameters.errors.noise_factor == (0.7 if state.offset.fixes else 1.0)
        return float(state.offset.sigma_m)

    setup, state = estimator.start(tables, parameters, None)
    assert state.offset == OffsetSize(60.0, 1.0)
    learned = setup, replace(state, offset=OffsetSize(22.0, 3.0, 80, noise_factor=0.7))
    assert size_m(learned, catalogue=replace(catalogue)) == 22.0
    assert size_m(learned, catalogue=replace(catalogue, latitude_rad=catalogue.latitude_rad + 1e-9)) == 60.0
    fixed = FlightParameters(anchored=AnchoredParameters())
    assert estimator.start(tables, fixed, learned)[1].offset is None


def test_a_parameter_file_of_before_learns_nothing_and_keeps_its_hash():
    learning = FlightParameters(anchored=AnchoredParameters(offset=OffsetRule()))
    text = format_parameters(BuildParameters(DetectorParameters(), learning))
    read = parse_parameters(text).flight
    assert read.anchored.offset == OffsetRule() and read.sha256 == learning.sha256
    older = re.sub(r"\[flight\.anchored\.offset\]\n(?:[^\[\n]+\n)*", "", text)
    before = parse_parameters(older).flight
    assert len(older) < len(text) and before.anchored.offset is None
    assert before.sha256 == FlightParameters().sha256 != learning.sha256
    assert "OffsetRule" not in repr(before)
