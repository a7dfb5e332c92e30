"""Search by votes on constructed scenes: craters by chance on a sphere, detections by a projection written here."""

from dataclasses import replace

import numpy as np
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from pytest import approx, mark
from scipy.special import pdtrc

from lunar.camera import PinholeCamera
from payload_emulator.flight.navigation.search import acquisition
from payload_emulator.flight.navigation.search.acquisition import AcquisitionParameters, acquire
from payload_emulator.flight.navigation.sighting import Pose, landmark_map
from payload_emulator.flight.vision.detections import Detections
from tmtc.dictionary.tables import CatalogueTable

CAMERA = PinholeCamera()
FOCAL_PX = 256.0 / np.tan(np.radians(60.0))
RADIUS_M = 1_737_400.0
# Over the equator at longitude 0: x east, y south, z down.
NADIR = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
ALTITUDE_M = 30_000.0
PARAMETERS = AcquisitionParameters()
ATTITUDE_SIGMA_RAD = 2e-4


def crater_map(reach_rad=0.08, mean_in_image=22.0):
    """About so many craters within the image, of 5 to 20 km; heights of a kilometre."""
    rng = default_rng(3)
    density = mean_in_image / (2.0 * ALTITUDE_M * np.sqrt(3.0)) ** 2
    count = int(density * (2.0 * reach_rad * RADIUS_M) ** 2)
    place = rng.uniform(-reach_rad, reach_rad, (2, count))
    return landmark_map(
        CatalogueTable(
            np.arange(count), place[0], place[1], 5e3 * rng.uniform(0.07, 1.0, count) ** (-1.0 / 1.77),
            rng.uniform(-1e3, 1e3, count), np.full((count, 3), 50.0)
        )
    )  # fmt: skip


def pose_at(east_m=0.0, north_m=0.0, altitude_m=ALTITUDE_M):
    position = np.array([1.0, east_m / RADIUS_M, north_m / RADIUS_M])
    position *= (RADIUS_M + altitude_m) / norm(position)
    return Pose(position, NADIR, np.eye(3), np.zeros(3), np.zeros(2), np.zeros(3))


def detected(landmarks, pose, keep=0.7, noise_px=0.5, false=4, seed=1):
    """Some of the craters in the image with noise, false detections among them; which crater each is, -1 for none."""
    rng = default_rng(seed)
    seen = (landmarks.position_mcmf_m - pose.position_icrf_m) @ NADIR.T
    uv = 255.5 + FOCAL_PX * seen[:, :2] / seen[:, 2:]
    index = np.flatnonzero((seen[:, 2] > 0.0) & np.all(np.abs(uv - 255.5) < 255.0, axis=1))
    index = index[rng.uniform(size=index.size) < keep]
    noisy = uv[index] + noise_px * rng.standard_normal((index.size, 2))
    diameter = landmarks.diameter_m[index] * FOCAL_PX / seen[index, 2] * np.exp(0.1 * rng.standard_normal(index.size))
    noisy = np.concatenate([noisy, rng.uniform(0.0, 511.0, (false, 2))])
    diameter = np.concatenate([diameter, rng.uniform(20.0, 60.0, false)])
    order = rng.permutation(len(noisy))
    one = np.ones(len(noisy))
    owner = np.concatenate([index, np.full(false, -1)])
    return Detections(noisy[order, 0], noisy[order, 1], diameter[order], one, one), owner[order]


def search(found, landmarks, prior, sigma_m, **changes):
    parameters = replace(PARAMETERS, **changes)
    sigma_px = np.full(len(found), 0.7)
    return acquire(found, landmarks, prior, CAMERA, sigma_m, sigma_px, ATTITUDE_SIGMA_RAD, parameters)


@mark.parametrize(
    "east_m, north_m, up_m, seed",
    [(6_000.0, -9_000.0, 2_000.0, 1), (-12_000.0, 4_000.0, -3_000.0, 2), (0.0, 0.0, 5_000.0, 3)],
)
def test_a_place_kilometres_off_is_found_with_the_right_craters(east_m, north_m, up_m, seed):
    landmarks, true = crater_map(), pose_at(1_500.0, -800.0)
    found, owner = detected(landmarks, true, seed=seed)
    prior = pose_at(1_500.0 + east_m, -800.0 + north_m, ALTITUDE_M + up_m)
    fix = search(found, landmarks, prior, 5_000.0)
    assert_array_equal(owner[fix.detection], fix.index)
    # Every true detection but those thrown far by the noise: 3.5 sigma in the first choice, mutual nearest later.
    assert fix.detection.size >= 0.9 * np.count_nonzero(owner >= 0)
    # Half a pixel is 100 m, averaged over a dozen craters, with the attitude among the unknowns.
    assert norm(fix.pose.position_icrf_m - true.position_icrf_m) < 200.0
    assert fix.detection.size >= fix.needed >= 4


@mark.parametrize("altitude_m", [150_000.0, 110_000.0])
def test_a_place_is_found_from_high_orbits(altitude_m):
    landmarks = crater_map(reach_rad=0.28, mean_in_image=2.0)
    true = pose_at(1_500.0, -800.0, altitude_m)
    found, owner = detected(landmarks, true, seed=4)
    fix = search(found, landmarks, pose_at(7_500.0, -9_800.0, altitude_m + 2_000.0), 5_000.0)
    assert_array_equal(owner[fix.detection], fix.index)
    # Half a pixel is 500 m at 150 km, averaged over dozens of craters.
    assert norm(fix.pose.position_icrf_m - true.position_icrf_m) < 600.0


@mark.parametrize("altitude_km", [120.0, 150.0, 200.0])
def test_the_sag_is_that_of_the_ground_in_the_corner_or_of_the_horizon(altitude_km):
    distance, corner = 1_737.4 + altitude_km, np.arctan(256.0 * np.sqrt(2.0) / FOCAL_PX)
    angle = min(corner, np.arcsin(1_737.4 / distance))
    # Sine rule in the triangle of centre, camera and ground.
    at_centre = np.arcsin(distance * np.sin(angle) / 1_737.4) - angle
    depth = distance - 1_737.4 * np.cos(at_centre)
    found = acquisition._sag(1e3 * altitude_km, float(corner))
    assert found == approx(0.5 * np.log(depth / altitude_km), rel=1e-4)


def test_the_sag_is_constant_up_to_the_design_altitude():
    assert {acquisition._sag(1e3 * km, 1.18) for km in (14.0, 50.0, 100.0)} == {0.05}


def test_a_place_outside_the_search_false_detections_and_two_detections_give_no_place():
    landmarks, true = crater_map(), pose_at()
    found, _ = detected(landmarks, true)
    prior = pose_at(20_000.0)
    assert search(found, landmarks, prior, 7_000.0) is not None
    # 3.5 sigma are 7 km; cells at the edge of the search and the fit reach 5 km farther.
    assert search(found, landmarks, prior, 2_000.0) is None
    for seed in range(12):
        found, _ = detected(landmarks, pose_at(), keep=0.0, false=14, seed=seed)
        assert search(found, landmarks, pose_at(), 5_000.0) is None
    found, owner = detected(landmarks, pose_at(), noise_px=0.0, false=0)
    for count in (0, 1, 2):
        assert search(found.select(np.arange(count)), landmarks, pose_at(), 3_000.0) is None
    assert acquisition.SEARCHABLE_DETECTIONS == 3 and owner.size > 3


def test_two_places_that_explain_as_much_are_no_place():
    """The same pattern of craters twice, 20 km apart: which one is seen is ambiguous."""
    rng = default_rng(5)
    place = rng.uniform(-0.006, 0.006, (2, 9))
    apart = 20_000.0 / RADIUS_M
    diameter = rng.uniform(5e3, 9e3, 9)

    def table(longitudes):
        count = 9 * len(longitudes)
        return landmark_map(
            CatalogueTable(
                np.arange(count), np.tile(place[0], len(longitudes)),
                np.concatenate([place[1] + shift for shift in longitudes]), np.tile(diameter, len(longitudes)),
                np.zeros(count), np.full((count, 3), 50.0)
            )
        )  # fmt: skip

    single, double = table([-apart / 2.0]), table([-apart / 2.0, apart / 2.0])
    true = pose_at(-10_000.0)
    found, _ = detected(single, true, keep=1.0, noise_px=0.2, false=0)
    assert len(found) == 9
    prior = pose_at()
    alone = search(found, single, prior, 5_000.0)
    assert alone.detection.size == 9 and norm(alone.pose.position_icrf_m - true.position_icrf_m) < 300.0
    assert search(found, double, prior, 5_000.0) is None


def test_sizes_that_do_not_fit_and_a_mirrored_image_give_no_place():
    landmarks, true = crater_map(), pose_at()
    found, _ = detected(landmarks, true, false=0)
    assert search(found, landmarks, pose_at(3_000.0), 3_000.0) is not None
    # Three times the size is 1.1 in the logarithm, beyond a gate of 0.45 at any altitude of the search.
    grown = replace(found, diameter_px=3.0 * found.diameter_px)
    assert search(grown, landmarks, pose_at(3_000.0), 1_000.0) is None
    landmarks = crater_map()
    found, _ = detected(landmarks, pose_at())
    assert search(replace(found, u_px=511.0 - found.u_px), landmarks, pose_at(), 5_000.0) is None


def test_detections_without_a_size_take_no_part():
    landmarks = crater_map()
    found, _ = detected(landmarks, pose_at(), false=3)
    sizes = found.diameter_px.copy()
    sizes[:3] = -1.0, 0.0, np.nan
    place = search(replace(found, diameter_px=sizes), landmarks, pose_at(3_000.0), 3_000.0)
    assert place is not None and not set(place.detection) & {0, 1, 2}


def test_more_is_asked_of_a_wider_search_and_of_a_smaller_risk():
    landmarks, true = crater_map(), pose_at()
    found, _ = detected(landmarks, true)
    needed = []
    for sigma_m, limit in ((500.0, 1e-5), (5_000.0, 1e-5), (5_000.0, 1e-12)):
        fix = search(found, landmarks, true, sigma_m, false_fix_limit=limit)
        needed.append(fix.needed)
    assert needed[0] < needed[1] < needed[2]
    # What the formula promises: with so many places tried and so likely a chance pair each, a false fix is rarer than
    # the limit. Places: the disc of the search in cells of the tolerance, times steps of altitude.
    tight_px = 3.5 * 0.7 + FOCAL_PX * ATTITUDE_SIGMA_RAD
    cell_m = tight_px * ALTITUDE_M / FOCAL_PX
    reach_m = 3.5 * 5_000.0
    low, high = max(ALTITUDE_M - reach_m, 8e3), ALTITUDE_M + reach_m
    places = (2.0 * reach_m / cell_m) ** 2 / np.pi * np.log(high / low) * 256.0 * np.sqrt(2.0) / tight_px
    seen = (landmarks.position_mcmf_m - true.position_icrf_m) @ NADIR.T
    uv = 255.5 + FOCAL_PX * seen[:, :2] / seen[:, 2:]
    inside = np.flatnonzero((seen[:, 2] > 0.0) & np.all(np.abs(uv - 255.5) < 256.0, axis=1))
    ratio = np.abs(np.log(found.diameter_px[:, None] * seen[inside, 2] / (landmarks.diameter_m[inside] * FOCAL_PX)))
    pairs = np.count_nonzero(ratio < 0.45)
    share = pairs * np.pi * tight_px**2 / 512.0**2 / len(found)
    # Poisson in the expected number of chance pairs at a place, all detections together; the pair that makes the place
    # counts among the members.
    mean = share * len(found)
    least = next(k for k in range(3, 40) if places * mean * pdtrc(k - 2, mean) < 1e-5)
    assert needed[1] == least


def test_altitudes_below_the_lowest_are_not_searched():
    landmarks, true = crater_map(), pose_at(0.0, 0.0, 20_000.0)
    found, _ = detected(landmarks, true, keep=1.0, false=0)
    assert search(found, landmarks, true, 1_000.0) is not None
    assert search(found, landmarks, true, 1_000.0, minimum_altitude_m=27_000.0) is None
