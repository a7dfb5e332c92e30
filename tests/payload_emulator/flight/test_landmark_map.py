"""The map of uncatalogued craters: placed where they are, as uncertain as they are, bounded in number."""

from dataclasses import replace

import numpy as np
from numpy import diag, eye, nan
from numpy.linalg import eigvalsh, norm
from numpy.random import default_rng
from pytest import approx

from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.frames import mcmf_from_spherical
from payload_emulator.flight.navigation.landmark_map import (
    FIRST_LANDMARK_ID,
    Landmark,
    MappingParameters,
    MapState,
    View,
    close,
    intersected,
    observe,
    unclaimed,
    with_catalogue,
)
from payload_emulator.flight.navigation.sighting import Sighting
from payload_emulator.flight.vision.detections import Detections, no_detections
from tmtc.dictionary.tables import CatalogueTable

RADIUS_M = 1_737_400.0
CAMERA = PinholeCamera()
SECOND = 65_536
SIGMA_PX = 1.0
# 1.636 km/s on the ground: 24.5 km, 0.0141 rad, between frames of 15 s.
STEP_RAD = 24_540.0 / RADIUS_M
SPACECRAFT_M = 100.0


def ground(count, seed):
    rng = default_rng(seed)
    latitude, longitude = rng.uniform(-0.02, 0.09, count), rng.uniform(-0.02, 0.02, count)
    return mcmf_from_spherical(latitude, longitude, 300.0 + 400.0 * rng.standard_normal(count))


class Mapper:
    """A map under construction with its rules."""

    def __init__(self, **changes):
        self.parameters, self.state = MappingParameters(**changes), MapState()

    def __len__(self):
        return len(self.state.landmarks)

    def observe(self, view, found, variance, free, surface_m):
        self.state, made = observe(self.state, view, found, variance, free, surface_m, CAMERA, self.parameters)
        return made

    def close(self):
        self.state, made = close(self.state, CAMERA, self.parameters)
        return made


def offset_m(landmark, craters, shift_m=0.0):
    """Return the distance of a landmark from the crater that is nearest once all are shifted."""
    away = landmark.position_mcmf_m - craters
    return away[np.argmin(norm(away - shift_m, axis=1))]


def fly(mapper, craters, seed, frames=6, start_ticks=0, east_m=0.0, false=0, error_m=(0.0, 0.0, 0.0)):
    """One pass to the north at 30 km, believed to be `error_m` from where it is."""
    rng = default_rng(seed)

    made = []
    for k in range(frames):
        place = mcmf_from_spherical(k * STEP_RAD, east_m / RADIUS_M, 30e3)
        rotation = nadir_camera_from_mcmf(place)
        seen = (craters - place) @ rotation.T
        f = 256.0 / np.tan(np.radians(60.0))
        uv = 255.5 + f * seen[:, :2] / seen[:, 2:]
        inside = (seen[:, 2] > 0.0) & np.all(np.abs(uv - 255.5) < 256.0, axis=1)
        uv = uv[inside] + SIGMA_PX * rng.standard_normal((int(inside.sum()), 2))
        size = f * 5_000.0 / seen[inside, 2]
        uv = np.concatenate([uv, rng.uniform(0.0, 511.0, (false, 2))])
        size = np.concatenate([size, np.full(false, 25.0)])
        found = Detections(uv[:, 0], uv[:, 1], size, np.ones(len(uv)), np.full(len(uv), SIGMA_PX))
        view = View(start_ticks + k * 15 * SECOND, rotation, place + error_m, SPACECRAFT_M**2 * eye(3), 1e-4)
        free = np.ones(len(uv), bool)
        made += mapper.observe(view, found, np.full(len(uv), SIGMA_PX**2), free, 300.0)
    made += mapper.close()
    return made


def test_craters_become_landmarks_where_they_are_and_with_errors_as_claimed():
    craters = ground(25, 1)
    mapper = Mapper()
    made = fly(mapper, craters, 2)
    assert len(made) == len(mapper) >= 15
    errors, nees = [], []
    for landmark in made:
        offset = offset_m(landmark, craters)
        own = landmark.covariance_m2 - SPACECRAFT_M**2 * eye(3)
        errors.append(float(norm(offset)))
        nees.append(float(offset @ np.linalg.solve(own, offset)))
    # One pixel at 30 km is 203 m; three sightings under wide parallax place a crater to about that.
    assert np.median(errors) < 250.0
    # Three degrees of freedom each; the mean of 15 and more lies within 1 of 3 at two sigma, prior and gates aside.
    assert 1.0 < np.mean(nees) < 4.5


def test_the_spacecrafts_error_is_in_every_landmark_and_in_its_covariance():
    craters = ground(25, 1)
    wrong = np.array([0.0, 150.0, 120.0])
    made = fly(Mapper(), craters, 2, error_m=wrong)
    mean = np.mean([offset_m(landmark, craters, wrong) for landmark in made], axis=0)
    # East and north shift as the spacecraft does; the mean of 15 landmarks of 150 m each is good to 40 m.
    assert mean[1:] == approx(wrong[1:], abs=90.0)
    for landmark in made:
        assert eigvalsh(landmark.covariance_m2).min() >= SPACECRAFT_M**2


def test_false_detections_do_not_become_landmarks():
    mapper = Mapper()
    fly(mapper, np.empty((0, 3)) + RADIUS_M, 3, frames=8, false=12)
    # Ninety-six of them; chance lines up three now and then.
    assert len(mapper) <= 3


def test_a_second_pass_joins_the_landmarks_of_the_first_without_counting_its_error_twice():
    craters = ground(25, 1)
    mapper = Mapper()
    first = fly(mapper, craters, 2)
    count = len(mapper)
    second = fly(mapper, craters, 9, start_ticks=7_000 * SECOND, east_m=8_000.0)
    again = [landmark for landmark in second if landmark.passes == 2]
    assert len(again) >= 0.6 * min(count, len(second))
    assert {landmark.identity for landmark in again} <= {landmark.identity for landmark in first}
    for landmark in again:
        before = next(item for item in first if item.identity == landmark.identity)
        assert landmark.sightings > before.sightings
        # Both passes may have erred alike: the spacecraft's share does not shrink.
        assert eigvalsh(landmark.covariance_m2).min() >= 0.999 * SPACECRAFT_M**2


def test_the_intersection_never_claims_more_than_the_better_of_two_equal_directions():
    covariance = diag([100.0, 400.0, 900.0])
    first = Landmark(FIRST_LANDMARK_ID, np.zeros(3), covariance, 5e3, 3, 1, 0)
    second = replace(first, position_mcmf_m=np.array([1.0, 2.0, 3.0]))
    joined = intersected(first, second)
    assert np.allclose(joined.covariance_m2, covariance)
    assert (joined.sightings, joined.passes) == (6, 2)
    other = intersected(first, replace(second, covariance_m2=diag([900.0, 400.0, 100.0])))
    assert np.trace(other.covariance_m2) <= np.trace(covariance)
    # Julier and Uhlmann: for diag(100, 900) and diag(900, 100) the half and half mixture gives 2/(1/100+1/900) = 180.
    assert diag(other.covariance_m2)[[0, 2]] == approx([180.0, 180.0])


def test_memory_is_bounded():
    mapper = Mapper(tracks=10, landmarks=4)
    fly(mapper, ground(40, 1), 2, frames=6)
    assert len(mapper) <= 4
    assert min(landmark.sightings for landmark in mapper.state.landmarks) >= 3


def test_landmarks_complement_the_catalogue_with_identities_of_their_own():
    mapper = Mapper()
    fly(mapper, ground(25, 1), 2)
    one = np.ones(1)
    catalogue = CatalogueTable(np.array([7]), 0.1 * one, 0.2 * one, 6e3 * one, 50.0 * one, 80.0 * np.ones((1, 3)))
    merged = with_catalogue(mapper.state.landmarks, catalogue)
    assert len(merged) == 1 + len(mapper)
    assert set(merged.ids[merged.ids < FIRST_LANDMARK_ID].tolist()) == {7}
    assert np.all(np.diff(merged.latitude_rad) >= 0.0)
    own = merged.position_mcmf_m[merged.ids >= FIRST_LANDMARK_ID]
    assert {tuple(np.round(place)) for place in own} == {
        tuple(np.round(landmark.position_mcmf_m)) for landmark in mapper.state.landmarks
    }


def test_nothing_is_mapped_while_the_spacecraft_does_not_know_where_it_is_or_sees_nothing():
    assert fly(Mapper(position_limit_m=50.0), ground(25, 1), 2) == []
    nothing = no_detections()
    place = mcmf_from_spherical(0.0, 0.0, 30e3)
    view = View(0, nadir_camera_from_mcmf(place), place, eye(3), 1e-4)
    assert Mapper().observe(view, nothing, np.empty(0), np.empty(0, bool), 0.0) == ()
    lost = replace(view, covariance_m2=np.full((3, 3), nan))
    one = np.ones(1)
    found = Detections(200.0 * one, 200.0 * one, 20.0 * one, one, one)
    assert Mapper().observe(lost, found, one, np.ones(1, bool), 0.0) == ()


def test_detections_that_are_no_numbers_or_on_a_catalogued_crater_are_not_free():
    mapper = Mapper()
    place = mcmf_from_spherical(0.0, 0.0, 30e3)
    view = View(0, nadir_camera_from_mcmf(place), place, eye(3), 1e-4)
    values = np.array([nan, 200.0, 300.0])
    found = Detections(values, values, np.array([20.0, nan, 25.0]), np.ones(3), np.ones(3))
    for k in range(4):
        mapper.observe(replace(view, ticks=k * SECOND), found, np.ones(3), np.ones(3, bool), 0.0)
    assert len(mapper.close()) == 1
    nothing, uv, size_px = np.zeros((1, 2, 3)), np.array([[100.0, 100.0]]), np.array([30.0])
    seen = Sighting(np.arange(1), uv, size_px, nothing, nothing, nothing, nothing[:, :, 0])
    u = np.array([105.0, 105.0, 300.0, 400.0])
    found = Detections(u, np.full(4, 100.0), np.array([28.0, 60.0, 30.0, 30.0]), np.ones(4), np.ones(4))
    assert unclaimed(found, seen, np.array([3])).tolist() == [False, True, True, False]
