"""The anchored estimator in the payload: no truth, no anchor reads, nothing that stops it; recovery."""

from dataclasses import replace

import numpy as np
from numpy import degrees, flatnonzero, inf, isfinite
from numpy.linalg import norm
from numpy.testing import assert_allclose
from pytest import approx, fixture, mark

from lunar.camera import nadir_camera_from_mcmf
from lunar.frames import quaternion_from_matrix
from lunar.propagation import ForceModel, propagate
from lunar.timescales import tdb_s_from_utc_ns, ticks_from_utc_ns
from payload_emulator.flight.navigation.anchored.parameters import AnchoredParameters
from payload_emulator.flight.navigation.outcomes import Mode, Outcome
from payload_emulator.flight.navigation.search.lost_in_space import LostParameters
from payload_emulator.flight.navigation.sighting import Pose, in_view, landmark_map
from payload_emulator.flight.payload import FlightParameters, FlightTables, Payload
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.preprocess import ImageQuality
from studies.montecarlo import CatalogueErrors, Kidnap, catalogue_table, fly
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.tables import (
    GravityTable,
    InitialState,
    pack_catalogue_table,
    pack_gravity_table,
    pack_initial_state,
    pack_orientation_table,
)

IMAGE = np.zeros((4, 4), np.uint8)
FRAMES = 14


class Flight:
    """Perfect sightings along a true orbit, and the tables of a payload that does not know it."""

    def __init__(self, case):
        self.ticks = [int(ticks_from_utc_ns(int(utc_ns))) for utc_ns in case.frame_utc_ns]
        tdb_s = np.asarray(tdb_s_from_utc_ns(case.frame_utc_ns), float)
        orbit = propagate(
            float(tdb_s[0]), case.position_icrf_m, case.velocity_icrf_m_s, float(tdb_s[-1] - tdb_s[0]) + 1.0,
            ForceModel(case.gravity, case.orientation)
        )  # fmt: skip
        self.states, self.rotations = orbit.state(tdb_s), case.orientation.mcmf_from_icrf(tdb_s)
        true_map = landmark_map(catalogue_table(case.craters))
        self.frames = []
        self.attitudes = []
        for state, rotation in zip(self.states, self.rotations, strict=True):
            camera = nadir_camera_from_mcmf(rotation @ state[:3]) @ rotation
            pose = Pose(state[:3], camera, rotation, np.zeros(3), np.zeros(2), np.zeros(3))
            seen = in_view(true_map, pose, case.camera, 0.0)
            one = np.ones(len(seen))
            self.frames.append(
                (ImageQuality.OK, Detections(seen.uv_px[:, 0], seen.uv_px[:, 1], seen.diameter_px, one, one))
            )
            self.attitudes.append(np.concatenate([quaternion_from_matrix(camera), [0.0, 0.0, -1.0]]))
        hours = case.epoch_utc_ns + np.arange(-8, 9) * 3_600 * 10**9
        rotations = case.orientation.mcmf_from_icrf(np.asarray(tdb_s_from_utc_ns(hours), float))
        pa_from_mcmf = case.orientation.pa_from_icrf(float(tdb_s_from_utc_ns(int(hours[0])))) @ rotations[0].T
        uncertain = replace(catalogue_table(case.craters), sigma_m=np.full((len(case.craters), 3), 80.0))
        field = case.filter_gravity
        self.tables = FlightTables(
            catalogue=pack_catalogue_table(uncertain),
            gravity=pack_gravity_table(
                GravityTable(field.name, field.gm_m3_s2, field.radius_m, field.c_bar, field.s_bar)
            ),
            orientation=pack_orientation_table(np.asarray(ticks_from_utc_ns(hours)), rotations, pa_from_mcmf),
            initial_state=pack_initial_state(
                InitialState(
                    self.ticks[0], self.states[0, :3] + np.array([600.0, -500.0, 400.0]),
                    self.states[0, 3:] + np.array([0.5, 0.4, -0.3]), 600.0, 0.6
                )
            )
        )  # fmt: skip

    def payload(self, **changes):
        return Payload(Script(self.frames), FlightParameters(modes=(Mode.anchored,)), replace(self.tables, **changes))

    def fly(self, payload):
        return [
            packet
            for attitude, ticks in zip(self.attitudes, self.ticks, strict=True)
            for packet in payload.step(IMAGE, attitude, ticks, b"")
        ]


class Script:
    def __init__(self, frames):
        self.frames = list(frames)

    def examine(self, image, sun_in_camera=None):
        return self.frames.pop(0)


@fixture()
def flight(navigation_case):
    return Flight(navigation_case(FRAMES))


def named(packets, name):
    return [values for found, values in map(DICTIONARY.unpack, packets) if found == name]


def test_the_payload_navigates_by_its_catalogue_and_reads_no_anchor(flight):
    payload = flight.payload()
    packets = flight.fly(payload)
    outcomes = named(packets, "frame_outcome")
    assert {values["outcome"] for values in outcomes} == {int(Outcome.fixed)}
    assert {values["anchor_reads"] for values in outcomes} == {0}
    last = named(packets, "navigation_state")[-1]
    position = flight.rotations[-1] @ flight.states[-1, :3]
    radius = float(norm(position))
    # Sightings here are exact: what is left is the gravity left out of the filter and the weight it gives to it.
    assert last["latitude_deg"] == approx(degrees(np.arcsin(position[2] / radius)), abs=0.003)
    assert last["altitude_m"] == approx(radius - 1_737_400.0, abs=60.0)
    assert_allclose(last["velocity_icrf_m_s"], flight.states[-1, 3:], atol=0.5)
    assert max(last["sigma_rtn_m"]) < 150.0
    summary = payload.summary()
    assert summary["anchor_reads_after_start"] == 0
    assert summary["fixes"]["fixed"] == FRAMES


@mark.parametrize("name", ["catalogue", "gravity", "orientation", "initial_state"])
def test_a_damaged_table_is_reported_and_every_frame_refused(flight, name):
    damaged = bytearray(getattr(flight.tables, name))
    damaged[-1] ^= 1
    packets = flight.fly(flight.payload(**{name: bytes(damaged)}))
    assert {values["outcome"] for values in named(packets, "frame_outcome")} == {int(Outcome.refused)}
    assert len(named(packets, "event_high")) == 1
    assert not named(packets, "navigation_state")


def test_detections_with_numbers_that_are_none_are_passed_over_and_nothing_becomes_nan(flight):
    bad = np.array([np.nan, inf, -inf, -5.0, 0.0, 1e300])
    for k in range(4, 9):
        found = flight.frames[k][1]
        columns = {}
        for shift, name in enumerate(("u_px", "v_px", "diameter_px", "score", "sigma_px")):
            column = getattr(found, name).copy()
            # Each kind of number in each column, in a third of the detections.
            rows = np.arange(shift, len(found), 15)
            column[rows] = np.resize(np.roll(bad, k + shift), rows.size)
            columns[name] = column
        flight.frames[k] = (ImageQuality.OK, Detections(**columns))
    packets = flight.fly(flight.payload())
    assert {values["outcome"] for values in named(packets, "frame_outcome")} == {int(Outcome.fixed)}
    for values in named(packets, "filter_estimate"):
        assert np.all(isfinite(values["position_icrf_m"])) and np.all(isfinite(values["covariance"]))
    position = flight.rotations[-1] @ flight.states[-1, :3]
    assert named(packets, "navigation_state")[-1]["altitude_m"] == approx(float(norm(position)) - 1_737_400.0, abs=60.0)


@mark.parametrize("turn", ["mirrored", "rotated"])
def test_a_mirrored_or_rotated_image_is_no_fix_and_moves_nothing(flight, turn):
    for k in range(6, FRAMES):
        found = flight.frames[k][1]
        u, v = (511.0 - found.u_px, found.v_px) if turn == "mirrored" else (found.v_px, 511.0 - found.u_px)
        flight.frames[k] = (ImageQuality.OK, replace(found, u_px=u, v_px=v))
    packets = flight.fly(flight.payload())
    outcomes = [values["outcome"] for values in named(packets, "frame_outcome")]
    assert outcomes[6:].count(int(Outcome.fixed)) <= 2
    last = named(packets, "navigation_state")[-1]
    position = flight.rotations[-1] @ flight.states[-1, :3]
    assert last["altitude_m"] == approx(float(norm(position)) - 1_737_400.0, abs=300.0)


def test_a_clock_that_jumps_leaves_the_estimate_finite(flight):
    flight.ticks[6] -= 3_600 * 65_536
    flight.ticks[9] += 86_400 * 65_536 * 400
    packets = flight.fly(flight.payload())
    assert len(named(packets, "frame_outcome")) == FRAMES
    for values in named(packets, "navigation_state"):
        assert isfinite(values["latitude_deg"]) and isfinite(values["altitude_m"])


FRAME = 20
PARAMETERS = AnchoredParameters(gravity_degree=50)


def frames_until_back(run):
    """Frames from the kidnap, itself included, to the first with an error below 500 m; 999 for never."""
    good = flatnonzero(run.error_m[FRAME:] < 500.0)
    return int(good[0]) + 1 if good.size else 999


@mark.parametrize("distance_m, announced, limit", [(5e3, False, 8), (20e3, True, 4), (20e3, False, 8)])
def test_a_kidnapped_spacecraft_is_back_within_the_frames_allowed(navigation_case, distance_m, announced, limit):
    case = navigation_case(FRAME + 16, kidnap=Kidnap(FRAME, distance_m, announced), parameters=PARAMETERS)
    for seed in (1, 2):
        run = fly(case, seed)
        assert run.error_m[FRAME] > 0.5 * distance_m or frames_until_back(run) == 1
        assert frames_until_back(run) <= limit
        assert run.error_m[-1] < 500.0


def test_farther_than_any_widened_search_the_place_is_found_without_a_prior(navigation_case):
    case = navigation_case(FRAME + 24, kidnap=Kidnap(FRAME, 200e3, announced=False), parameters=PARAMETERS)
    # The part of the Moon about the track, so that a search takes moments.
    near = flatnonzero(np.abs(degrees(case.craters.latitude_rad) - about_deg(case)[0]) < 35.0)
    case = replace(case, craters=case.craters.select(near[turn_deg(case, near) < 25.0]))
    without = fly(replace(case, parameters=replace(PARAMETERS, lost_frames=10_000)), 1)
    found = fly(replace(case, parameters=replace(PARAMETERS, lost=LostParameters())), 1)
    assert frames_until_back(without) == 999
    assert frames_until_back(found) <= 16
    assert found.error_m[-1] < 500.0


def about_deg(case):
    """Latitude and longitude below the frame of the kidnap."""
    from lunar.propagation import ForceModel, propagate
    from lunar.timescales import tdb_s_from_utc_ns

    start, at = (float(tdb_s_from_utc_ns(int(case.frame_utc_ns[k]))) for k in (0, FRAME))
    model = ForceModel(case.gravity, case.orientation, 10)
    flown = propagate(start, case.position_icrf_m, case.velocity_icrf_m_s, at - start + 1.0, model)
    place = case.orientation.mcmf_from_icrf(at) @ flown.state(at)[:3]
    return degrees([np.arcsin(place[2] / norm(place)), np.arctan2(place[1], place[0])])


def turn_deg(case, rows):
    longitude = degrees(case.craters.longitude_rad[rows]) - about_deg(case)[1]
    return np.abs(np.mod(longitude + 180.0, 360.0) - 180.0)


@mark.parametrize("wrong_share", [0.3, 1.0])
def test_a_stale_catalogue_misleads_nobody(navigation_case, wrong_share):
    errors = CatalogueErrors(wrong_share=wrong_share)
    # Without the search of the whole Moon, which takes a second a frame on this map.
    run = fly(navigation_case(40, catalogue_errors=errors, parameters=replace(PARAMETERS, lost_frames=10_000)), 3)
    assert np.all(isfinite(run.error_rtn_m))
    late = slice(20, None)
    if wrong_share < 1.0:
        assert np.median(run.error_m[late]) < 200.0
    else:
        # Nothing on board is where it should be: hardly a fix is believed, and the claimed sigma grows past the error.
        assert np.mean(run.fixed) < 0.2
        assert np.median(run.error_m[late]) < 4.0 * np.median(norm(run.sigma_rtn_m[late], axis=1))
