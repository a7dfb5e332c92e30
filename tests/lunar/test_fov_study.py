"""The field-of-view study against plain projection with the camera and against Poisson statistics."""

import math

import numpy as np
import pytest
from scipy.special import pdtrc

from lunar.camera import PinholeCamera, above_horizon, intersect_sphere, nadir_camera_from_mcmf, project_mcmf
from lunar.catalogue import make_catalogue, paper_density_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.errors import LunarError
from lunar.fov_study import PAPER_FOV_DEG, study_field_of_view
from lunar.frames import mcmf_from_spherical

UNIFORM = paper_density_catalogue(1, uniform=True)


def random_positions(n, seed, low_m=14e3, high_m=48e3):
    rng = np.random.default_rng(seed)
    latitude, longitude = np.arcsin(rng.uniform(-1, 1, n)), rng.uniform(-np.pi, np.pi, n)
    return mcmf_from_spherical(latitude, longitude, rng.uniform(low_m, high_m, n))


def test_counts_in_the_footprint_are_those_of_projecting_every_crater():
    positions = random_positions(25, 4)
    study = study_field_of_view(positions, UNIFORM)
    ground = mcmf_from_spherical(UNIFORM.latitude_rad, UNIFORM.longitude_rad)
    for fov_deg in (60.0, 120.0, 150.0):
        camera = PinholeCamera(fov_rad=math.radians(fov_deg))
        seen = []
        for position in positions:
            uv = project_mcmf(camera, nadir_camera_from_mcmf(position), position, ground)
            seen.append(np.count_nonzero(camera.contains(uv) & above_horizon(position, ground)))
        at = list(study.fov_deg).index(fov_deg)
        for n in (1, 3, 5):
            assert study.probability_at_least[n][at] == np.mean(np.array(seen) >= n)


def test_uniform_craters_follow_poisson_in_the_true_footprint():
    altitude_m, fov_deg = 20e3, 90.0
    study = study_field_of_view(random_positions(20_000, 5, altitude_m, altitude_m), UNIFORM, (fov_deg,))
    # Ground area of the image: each pixel's solid angle times range^2 over the cosine of incidence.
    camera = PinholeCamera(200, 200, math.radians(fov_deg))
    position = mcmf_from_spherical(0.0, 0.0, altitude_m)
    v, u = np.mgrid[0:200, 0:200]
    rays = camera.rays(np.stack([u, v], -1)) @ nadir_camera_from_mcmf(position)
    range_m = intersect_sphere(position, rays)
    normal = (position + range_m[..., None] * rays) / MOON_RADIUS_M
    solid = (rays @ -position / np.linalg.norm(position)) ** 3 / camera.focal_px**2
    area_m2 = np.sum(range_m**2 * solid / np.abs(np.sum(normal * rays, -1)))
    expected = len(UNIFORM) / (4 * np.pi * MOON_RADIUS_M**2) * area_m2
    for n in (1, 3, 5):
        chance = pdtrc(n - 1, expected)
        # 20,000 overlapping positions over a catalogue of 79,387: three standard errors are 0.02 at most.
        assert study.probability_at_least[n][0] == pytest.approx(chance, abs=0.02)


def test_probabilities_grow_with_the_field_of_view_and_fall_with_the_count():
    study = study_field_of_view(random_positions(500, 6), paper_density_catalogue(2))
    assert study.fov_deg.tolist() == list(PAPER_FOV_DEG)
    for values in study.probability_at_least.values():
        assert np.all(np.diff(values) >= 0.0)
    assert np.all(study.probability_at_least[1] >= study.probability_at_least[3])
    enough = study.probability_at_least[3] > 0.9
    assert study.selected_fov_deg == study.fov_deg[np.argmax(enough)]
    assert study.selected_every_altitude_deg >= study.selected_fov_deg


def test_no_field_of_view_is_selected_where_none_suffices():
    study = study_field_of_view(random_positions(200, 7), UNIFORM, (10.0, 20.0))
    assert math.isnan(study.selected_fov_deg)


def test_positions_over_regions_that_the_catalogue_leaves_out_do_not_count():
    west = UNIFORM.longitude_rad > np.pi
    half = UNIFORM.select(west)
    study = study_field_of_view(random_positions(2000, 8), half)
    assert study.positions == 2000
    # 100 km of grace around the edge of half the Moon: 6 % more than half.
    assert 950 < study.positions_covered < 1150
    flagged = make_catalogue(
        UNIFORM.latitude_rad, UNIFORM.longitude_rad, UNIFORM.diameter_m, source="flagged", complete=west
    )
    assert 900 < study_field_of_view(random_positions(2000, 8), flagged).positions_covered < 1100


def test_over_the_meridian_and_the_pole_craters_are_found():
    catalogue = make_catalogue(
        np.radians([0.0, 0.0, 89.9, 89.9, 0.2]), np.radians([359.9, 0.1, 10.0, 190.0, 0.0]), [6e3] * 5,
        source="five",
    )  # fmt: skip
    positions = mcmf_from_spherical(np.radians([0.0, 90.0]), np.radians([0.0, 0.0]), 30e3)
    study = study_field_of_view(positions, catalogue)
    assert np.count_nonzero(np.isfinite(np.tan(np.radians(study.required_fov_deg / 2)))[0]) >= 3
    assert study.required_fov_deg[0][2] < 30.0 and study.required_fov_deg[1][1] < 30.0


def test_nothing_to_study_is_refused():
    with pytest.raises(LunarError, match="expected craters of 5-30 km under the orbit"):
        study_field_of_view(random_positions(5, 9), UNIFORM.select([]))
    with pytest.raises(LunarError, match=r"expected fields of view in 0\.\.180 deg"):
        study_field_of_view(random_positions(5, 9), UNIFORM, (190.0,))
