"""When the spacecraft observes and how it points, on an orbit simple enough to check by hand."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from lunar.camera import nadir_camera_from_mcmf
from lunar.constants import MOON_RADIUS_M
from lunar.frames import matrix_from_quaternion, spherical_from_mcmf
from lunar.timescales import tdb_s_from_utc_ns
from payload_emulator.errors import ScenarioError
from payload_emulator.sim.orbit.truth import (
    ReadCount,
    Truth,
    attitude_message,
    counted_reads,
    find_windows,
    frame_times,
    perturbed,
    require_above_ground,
)

PERIOD_S = 6600.0
RADIUS_M = MOON_RADIUS_M + 30_000.0
START_NS = 1_880_000_000 * 10**9
NS = 10**9


class StillMoon:
    """A Moon that does not turn: MCMF axes are ICRF axes."""

    name = "still"

    def mcmf_from_icrf(self, tdb_s):
        return np.broadcast_to(np.eye(3), (*np.shape(tdb_s), 3, 3))

    pa_from_icrf = mcmf_from_icrf


@pytest.fixture()
def polar_truth() -> Truth:
    """A circular polar orbit over longitude 0 (northwards) and 180 degrees, northward over the equator at the start."""
    start_s = float(tdb_s_from_utc_ns(START_NS))

    def state(tdb_s):
        angle = 2.0 * np.pi * (tdb_s - start_s) / PERIOD_S
        zero = np.zeros_like(angle)
        position = RADIUS_M * np.stack([np.cos(angle), zero, np.sin(angle)], axis=-1)
        velocity = (
            RADIUS_M * 2.0 * np.pi / PERIOD_S * np.stack([-np.sin(angle), zero, np.cos(angle)], axis=-1)
        )
        return np.concatenate([position, velocity], axis=-1)

    return Truth(state, START_NS, START_NS + int(3 * PERIOD_S) * NS, StillMoon())


def test_frames_are_taken_at_the_cadence_within_the_latitude_limit(polar_truth: Truth) -> None:
    times = frame_times(polar_truth, START_NS, START_NS + int(PERIOD_S) * NS, 15 * NS, np.radians(60.0))
    latitude, _, _ = spherical_from_mcmf(polar_truth.positions_mcmf(times))
    assert np.abs(latitude).max() <= np.radians(60.0)
    assert np.all(np.diff(times) % (15 * NS) == 0)
    # Two thirds of the orbit lie within 60 degrees: 440 frames at 15 s less up to one at each of four edges.
    assert 6600 / 15 * 2 / 3 - 4 <= times.size <= 6600 / 15 * 2 / 3 + 4


@pytest.mark.parametrize(("direction", "longitude_deg"), [("ascending", 0.0), ("descending", 180.0)])
def test_a_window_runs_across_the_band_in_the_wanted_direction(polar_truth, direction, longitude_deg) -> None:
    windows = find_windows(
        polar_truth,
        lambda latitude, longitude: np.ones(latitude.shape, dtype=bool),
        not_before_utc_ns=START_NS,
        latitude_limit_rad=np.radians(60.0),
        direction=direction,
        half_fov_rad=np.radians(60.0),
        count=1,
    )
    ((first, last),) = windows
    assert (last - first) / NS == pytest.approx(
        PERIOD_S / 3.0, abs=61.0
    )  # a search step and a margin at each end, s
    _, longitude, _ = spherical_from_mcmf(polar_truth.positions_mcmf([first, (first + last) // 2, last]))
    assert np.degrees(longitude) % 360.0 == pytest.approx(longitude_deg, abs=1e-6)


def test_a_window_whose_swath_leaves_the_terrain_is_not_taken(polar_truth: Truth) -> None:
    # At 30 km the swath reaches 30 km x tan 60 deg = 52 km, 1.7 degrees at the equator and 3.4 at 60 degrees.
    def narrow(latitude, longitude):
        return np.abs(np.degrees(longitude)) < 2.5

    def wide(latitude, longitude):
        return np.abs(np.degrees(longitude)) < 4.0

    def windows_over(covers):
        return find_windows(
            polar_truth,
            covers,
            not_before_utc_ns=START_NS,
            latitude_limit_rad=np.radians(60.0),
            direction="ascending",
            half_fov_rad=np.radians(60.0),
            count=1,
        )

    assert windows_over(narrow) == []
    assert len(windows_over(wide)) == 1


def test_the_attitude_message_carries_attitude_and_sun() -> None:
    camera_from_mcmf = nadir_camera_from_mcmf(np.array([RADIUS_M, 0.0, 0.0]))
    sun_mcmf = np.array([0.6, 0.0, 0.8])
    message = attitude_message(camera_from_mcmf, camera_from_mcmf @ sun_mcmf)
    np.testing.assert_allclose(matrix_from_quaternion(message[:4]), camera_from_mcmf, atol=1e-12)
    # Camera: x east, y south, z down. The Sun stands 0.6 up and 0.8 north.
    np.testing.assert_allclose(message[4:], [0.0, -0.8, -0.6], atol=1e-12)


def test_a_pointing_error_turns_the_camera_by_its_size() -> None:
    camera = nadir_camera_from_mcmf(np.array([RADIUS_M, 0.0, 0.0]))
    turned = perturbed(camera, np.array([0.0, np.radians(2.0), 0.0]))
    angle = np.arccos((np.trace(turned @ camera.T) - 1.0) / 2.0)
    assert np.degrees(angle) == pytest.approx(2.0)
    assert perturbed(camera, np.zeros(3)) is camera


def test_the_terrain_is_not_looked_up_from_above_its_highest_point(polar_truth: Truth) -> None:
    asked: list[int] = []

    def height_m(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
        asked.append(latitude.size)
        return np.zeros(latitude.shape)

    # The orbit of this flight keeps 30 km.
    require_above_ground(polar_truth, np.array([START_NS]), height_m, highest_m=25_000.0)
    assert not asked
    require_above_ground(polar_truth, np.array([START_NS]), height_m, highest_m=35_000.0)
    assert asked == [1]


def test_a_trajectory_below_the_terrain_is_refused_with_epoch_and_depth(polar_truth: Truth) -> None:
    times = np.array([START_NS, START_NS + 60 * NS])
    require_above_ground(polar_truth, times, lambda latitude, longitude: np.full(latitude.shape, 29_000.0))
    with pytest.raises(ScenarioError, match=r"1000 m below at 2029-07-2\dT.*latitude .*longitude"):
        require_above_ground(
            polar_truth, times, lambda latitude, longitude: np.full(latitude.shape, 31_000.0)
        )


def test_reads_of_the_truth_are_counted_by_the_thread_that_asks_for_it(polar_truth: Truth) -> None:
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
