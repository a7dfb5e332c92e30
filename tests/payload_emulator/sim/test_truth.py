"""Observation times and pointing on an orbit that is checked by hand; the simulated board and its faults."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy import cos, pi, radians, sin
from numpy.testing import assert_allclose
from pytest import approx, fixture, mark, raises

from lunar.camera import nadir_camera_from_mcmf
from lunar.constants import MOON_RADIUS_M
from lunar.frames import matrix_from_quaternion, spherical_from_mcmf
from lunar.timescales import tdb_s_from_utc_ns
from payload_emulator.errors import ScenarioError
from payload_emulator.flight import ports
from payload_emulator.sim.board.platform import FAULT_KINDS, Fault, PlatformModel, SimulatedBoard, parse_fault
from payload_emulator.sim.orbit.truth import (
    ReadCount,
    Truth,
    attitude_message,
    counted_reads,
    find_crossings,
    frame_times,
    perturbed,
    require_above_ground,
)

PERIOD_S = 6600.0
RADIUS_M = MOON_RADIUS_M + 30_000.0
START_NS = 1_880_000_000 * 10**9
NS = 10**9
BAND_RAD = (radians(-60.0), radians(60.0))


def everywhere(latitude, longitude=None):
    return np.ones(latitude.shape, bool)


def crossings(truth, covers, in_reach=everywhere, direction="ascending", band_rad=BAND_RAD):
    return find_crossings(
        truth, covers, in_reach, not_before_utc_ns=START_NS, latitude_band_rad=band_rad, direction=direction,
        half_fov_rad=radians(60.0)
    )  # fmt: skip


def latitudes(truth, band_rad=BAND_RAD):
    """Times of frames of an orbit, and the latitudes there."""
    times = frame_times(truth, START_NS, START_NS + int(PERIOD_S) * NS, 15 * NS, band_rad)
    return times, spherical_from_mcmf(truth.positions_mcmf(times))[0]


class StillMoon:
    """A Moon that does not turn: MCMF axes are ICRF axes."""

    name = "still"

    def mcmf_from_icrf(self, tdb_s):
        return np.broadcast_to(np.eye(3), (*np.shape(tdb_s), 3, 3))

    pa_from_icrf = mcmf_from_icrf


@fixture()
def polar_truth():
    """A circular polar orbit over longitude 0 (northwards) and 180 degrees, northward over the equator at the start."""
    start_s = float(tdb_s_from_utc_ns(START_NS))

    def state(tdb_s):
        angle = 2.0 * pi * (tdb_s - start_s) / PERIOD_S
        zero = np.zeros_like(angle)
        position = RADIUS_M * np.stack([cos(angle), zero, sin(angle)], axis=-1)
        velocity = RADIUS_M * 2.0 * pi / PERIOD_S * np.stack([-sin(angle), zero, cos(angle)], axis=-1)
        return np.concatenate([position, velocity], axis=-1)

    return Truth(state, START_NS, START_NS + int(3 * PERIOD_S) * NS, StillMoon())


def test_frames_are_taken_at_the_cadence_within_the_latitude_limit(polar_truth):
    times, latitude = latitudes(polar_truth)
    assert np.abs(latitude).max() <= radians(60.0)
    assert np.all(np.diff(times) % (15 * NS) == 0)
    # Two thirds of the orbit lie within 60 degrees: 440 frames at 15 s less up to one at each of four edges.
    assert 6600 / 15 * 2 / 3 - 4 <= times.size <= 6600 / 15 * 2 / 3 + 4


@mark.parametrize("direction, longitude_deg", [("ascending", 0.0), ("descending", 180.0)])
def test_a_window_runs_across_the_band_in_the_wanted_direction(polar_truth, direction, longitude_deg):
    found = crossings(polar_truth, everywhere, direction=direction)[0]
    assert found.observable
    first, last = found.start_utc_ns, found.stop_utc_ns
    assert (last - first) / NS == approx(PERIOD_S / 3.0, abs=61.0)  # a search step and a margin at each end, s
    _, longitude, _ = spherical_from_mcmf(polar_truth.positions_mcmf([first, (first + last) // 2, last]))
    assert np.degrees(longitude) % 360.0 == approx(longitude_deg, abs=1e-6)


def test_a_window_whose_swath_leaves_the_terrain_is_not_taken_and_tells_the_latitudes(polar_truth):
    # At 30 km the swath reaches 30 km x tan 60 deg = 52 km, 1.7 degrees at the equator and 3.4 at 60 degrees.
    def narrow(latitude, longitude):
        return np.abs(np.degrees(longitude)) < 2.5

    def wide(latitude, longitude):
        return np.abs(np.degrees(longitude)) < 4.0

    assert not any(one.observable for one in crossings(polar_truth, narrow))
    assert crossings(polar_truth, wide)[0].observable

    def north_of_ten_degrees_without_a_hole(latitude, longitude):
        degrees = np.degrees(latitude)
        return (degrees > 10.0) & ~((degrees > 30.0) & (degrees < 40.0))

    found = crossings(polar_truth, north_of_ten_degrees_without_a_hole)[0]
    assert not found.observable and found.in_reach
    # A search step of 20 s moves the ground point by 1.1 degrees.
    assert_allclose(np.degrees(found.missing_rad), [[-60.0, 10.0], [30.0, 40.0]], atol=1.2)


def test_crossings_outside_the_longitudes_are_not_observable_and_bands_lie_on_one_side(polar_truth):
    found = crossings(polar_truth, everywhere, lambda longitude: np.degrees(longitude) > 1.0)[0]
    assert not found.in_reach and not found.observable and found.missing_rad.size == 0
    band_rad = (radians(20.0), radians(50.0))
    _, latitude = latitudes(polar_truth, band_rad)
    assert latitude.min() >= band_rad[0] and latitude.max() <= band_rad[1]
    assert np.degrees(latitude.max() - latitude.min()) > 28.0
    found = crossings(polar_truth, everywhere, band_rad=band_rad)[0]
    # 30 degrees of 360, with a search step and a margin at each end.
    assert (found.stop_utc_ns - found.start_utc_ns) / NS == approx(PERIOD_S / 12.0, abs=61.0)


def test_the_attitude_message_carries_attitude_and_sun_and_an_error_turns_the_camera_by_its_size():
    camera_from_mcmf = nadir_camera_from_mcmf(np.array([RADIUS_M, 0.0, 0.0]))
    message = attitude_message(camera_from_mcmf, camera_from_mcmf @ np.array([0.6, 0.0, 0.8]))
    assert_allclose(matrix_from_quaternion(message[:4]), camera_from_mcmf, atol=1e-12)
    # Camera: x east, y south, z down. The Sun stands 0.6 up and 0.8 north.
    assert_allclose(message[4:], [0.0, -0.8, -0.6], atol=1e-12)
    camera = nadir_camera_from_mcmf(np.array([RADIUS_M, 0.0, 0.0]))
    angle = np.arccos((np.trace(perturbed(camera, np.array([0.0, radians(2.0), 0.0])) @ camera.T) - 1.0) / 2.0)
    assert np.degrees(angle) == approx(2.0)
    assert perturbed(camera, np.zeros(3)) is camera


def test_the_terrain_is_not_looked_up_from_above_its_highest_point(polar_truth):
    asked = []

    def height_m(latitude, longitude):
        asked.append(latitude.size)
        return np.zeros(latitude.shape)

    # The orbit of this flight keeps 30 km.
    require_above_ground(polar_truth, np.array([START_NS]), height_m, highest_m=25_000.0)
    assert not asked
    require_above_ground(polar_truth, np.array([START_NS]), height_m, highest_m=35_000.0)
    assert asked == [1]


def test_a_trajectory_below_the_terrain_is_refused_with_epoch_and_depth(polar_truth):
    times = np.array([START_NS, START_NS + 60 * NS])
    require_above_ground(polar_truth, times, lambda latitude, longitude: np.full(latitude.shape, 29_000.0))
    with raises(ScenarioError, match=r"1000 m below at 2029-07-2\dT.*latitude .*longitude"):
        require_above_ground(polar_truth, times, lambda latitude, longitude: np.full(latitude.shape, 31_000.0))


def test_reads_of_the_truth_are_counted_by_the_thread_that_asks_for_it(polar_truth):
    counter = ReadCount()
    polar_truth.states(START_NS)
    with counted_reads(counter):
        polar_truth.states(START_NS)
        polar_truth.positions_mcmf([START_NS, START_NS + NS])
        # Frames are rendered ahead in other threads: what they read is not read by the payload.
        with ThreadPoolExecutor(1) as pool:
            pool.submit(polar_truth.states, START_NS).result()
    polar_truth.states(START_NS)
    assert counter.count == 2


def board(**options):
    return SimulatedBoard(PlatformModel(), 1, np.zeros(1000, np.uint8), np.zeros(1000, np.uint8), **options)


def run(simulated, steps, sunlight=1.0, minutes=1.0):
    """Let time pass with camera and accelerator on."""
    simulated.switch(ports.Load.camera | ports.Load.accelerator)
    for _ in range(steps):
        simulated.advance(60.0 * minutes, sunlight)


def test_the_sensors_and_stages_are_those_that_flight_reads():
    simulated = board()
    assert simulated.sensors().shape == (len(ports.SENSORS),)
    assert len(simulated.model.stage_ms) == len(ports.Stage)
    simulated.switch(ports.Load.camera)
    assert simulated.camera_on
    members = [name for name in vars(ports.Board) if not name.startswith("_")]
    assert all(hasattr(simulated, name) for name in [*members, "reset_cause", "store", "settings"])


def test_energy_is_kept_between_arrays_loads_and_battery_and_the_bus_obeys_ohms_law():
    simulated = board(charge=0.5)
    run(simulated, 60, 0.0)
    # An hour of 2.2 + 1.6 + 3.4 W out of 20 Wh, by hand.
    assert simulated.charge == approx(0.5 - 7.2 / 20.0, abs=1e-9)
    run(simulated, 60)

    assert simulated.charge == approx(0.5 - 7.2 / 20.0 + (9.0 - 7.2) / 20.0, abs=1e-9)
    simulated = board(charge=1.0)
    volts, amperes, _, _ = np.mean([simulated.sensors() for _ in range(400)], axis=0)
    # 12.6 V behind 0.15 ohm, 2.2 W drawn: V = 12.6 - 0.15 I, V I = 2.2; noise of 5 mV over 400 readings.
    assert volts == approx(12.5738, abs=2e-3)
    assert volts * amperes == approx(2.2, abs=2e-3)


def test_the_board_settles_at_the_temperature_of_its_balance():
    simulated = board()
    run(simulated, 500)

    # Structure 28 degC in sunlight, and the heat through the conductances.
    assert simulated.board_c == approx(28.0 + (2.2 + 3.4) / 0.35, abs=0.01)
    assert simulated.camera_c == approx(28.0 + 1.6 / 0.25, abs=0.01)
    # The step does not matter: exponentials, not differences.
    once = board()
    run(once, 1, minutes=500.0)
    assert once.board_c == approx(simulated.board_c, abs=0.01)


def test_the_counter_runs_on_by_the_time_of_each_stage():
    simulated = board()
    spent = []
    for _ in range(200):
        before = simulated.enter(ports.Stage.detector)
        spent.append((simulated.enter(ports.Stage.idle) - before) / 1e6)
    # 850 ms with a spread of a tenth; 4 sigma of a mean of 200.
    assert np.mean(spent) == approx(850.0, abs=4 * 85.0 / np.sqrt(200))
    assert 60.0 < np.std(spent) < 110.0


def test_flips_change_as_many_bits_as_asked_for():
    simulated = board()
    simulated.flip(simulated.store, 1, np.random.default_rng(2))
    assert np.unpackbits(simulated.store).sum() == 1


@mark.parametrize("kind", sorted(FAULT_KINDS))
def test_every_kind_of_fault_is_read(kind):
    lasts = " for 20" if FAULT_KINDS[kind].lasts else ""
    fault = parse_fault(f"  {kind} at 60{lasts} size 3 ")
    assert fault == Fault(kind, 60.0, 20.0 if lasts else 0.0, 3.0)
    assert fault.present(60.0) is bool(lasts) and not fault.present(80.0)


@mark.parametrize(
    "text, message",
    [
        ("camera_dark", "expected KIND at SECONDS"), ("camera_dark at soon for 3", "expected KIND at SECONDS"),
        ("camera_dark at 5", "expected how long it lasts"), ("meteor at 5", "expected one of camera_dark"),
        ("", "expected KIND at SECONDS")
    ]
)  # fmt: skip
def test_other_lines_are_refused_with_a_reason(text, message):
    with raises(ScenarioError, match=message):
        parse_fault(text)
