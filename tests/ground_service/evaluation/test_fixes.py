"""Fixes repeated from single frames and classified, on exact projections; landmarks of the payload."""

import math
from dataclasses import replace

import numpy as np
from pytest import approx, mark

from ground_service.evaluation.fixes import (
    FIRST_LANDMARK_ID,
    IdentificationSamples,
    MappedCraters,
    Pairs,
    compare_map,
    join_pairs,
    latest,
    mapped_craters,
    payload_map,
    snapshot_positions,
    wrong_fixes,
)
from ground_service.telemetry.samples import DetectionSamples, no_detections
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import make_catalogue
from lunar.frames import mcmf_from_spherical

CAMERA = PinholeCamera()
POSITION = mcmf_from_spherical(np.radians([20.0, 21.0]), np.radians([40.0, 40.5]), np.array([30e3, 31e3]))
UTC_NS = np.array([1000, 2000], dtype=np.int64)


def craters(seed=2):
    rng = np.random.default_rng(seed)
    places = np.radians(rng.uniform([19.8, 39.7], [21.2, 40.8], (8, 2)))
    return mcmf_from_spherical(places[:, 0], places[:, 1], rng.uniform(-800.0, 800.0, 8))


def pairs(noise_px=0.0, seed=3):
    """Eight craters seen in both of two frames."""
    rng = np.random.default_rng(seed)
    uv = [
        CAMERA.project((craters() - place) @ nadir_camera_from_mcmf(place).T) + rng.normal(0.0, noise_px, (8, 2))
        for place in POSITION
    ]
    frame = np.repeat([0, 1], 8)
    return Pairs(frame, UTC_NS[frame], np.concatenate(uv), np.full(16, 40.0), np.tile(craters(), (2, 1)))


def some(values, rows):
    """Return rows of pairs or of mapped craters."""
    return type(values)(*(getattr(values, name)[rows] for name in values.__slots__))


def test_a_frame_gives_its_position_back_with_the_noise_of_a_pixel_and_not_from_few_craters():
    start = POSITION + np.array([[1500.0, -900.0, 700.0], [-400.0, 2500.0, 100.0]])
    solved = snapshot_positions(pairs(), CAMERA, UTC_NS, start)
    # exact projections: the residue is that of the last step, a centimetre at most
    assert np.abs(solved - POSITION).max() < 0.02
    solved = snapshot_positions(pairs(noise_px=1.0), CAMERA, UTC_NS, POSITION + 500.0)
    error = np.linalg.norm(solved - POSITION, axis=1)
    # a pixel is 203 m at nadir from 30 km (design figure); eight craters halve it, the geometry may triple it
    assert np.all((error > 1.0) & (error < 1000.0))
    solved = snapshot_positions(some(pairs(), np.array([0, 1, 8, 9, 10])), CAMERA, UTC_NS, POSITION)
    assert np.isnan(solved[0]).all()
    assert np.isfinite(solved[1]).all()


@mark.parametrize("swapped, expected", [(0, 0), (3, 0), (4, 1), (8, 1)])
def test_a_fix_is_wrong_when_half_of_its_identifications_are(swapped, expected):
    found = pairs()
    moved = found.uv_px.copy()
    moved[:swapped] += 30.0
    found = replace(found, uv_px=moved)
    assert wrong_fixes(found, CAMERA, UTC_NS, POSITION) == expected


@mark.parametrize("frame", [0, 1])
def test_a_wrong_fix_counts_in_whichever_frame_it_is(frame):
    found = pairs()
    moved = found.uv_px + np.where(found.frame == frame, 30.0, 0.0)[:, None]
    found = replace(found, uv_px=moved)
    assert wrong_fixes(found, CAMERA, UTC_NS, POSITION) == 1
    # A frame at whose time there is no reference is neither right nor wrong.
    other = [1 - frame]
    assert wrong_fixes(found, CAMERA, UTC_NS[other], POSITION[other]) == 0
    lost = np.where(np.arange(2)[:, None] == frame, np.nan, POSITION)
    assert wrong_fixes(found, CAMERA, UTC_NS, lost) == 0


@mark.parametrize("offset_px, diameter_px, wrong", [(4.9, 20.0, 0), (5.1, 20.0, 1), (9.9, 100.0, 0), (10.1, 100.0, 1)])
def test_an_identification_is_right_within_half_a_radius_and_ten_pixels(offset_px, diameter_px, wrong):
    found = pairs()
    moved = found.uv_px + np.array([offset_px, 0.0]) * (found.frame == 0)[:, None]
    found = replace(found, uv_px=moved, diameter_px=np.full(16, diameter_px))
    assert wrong_fixes(found, CAMERA, UTC_NS, POSITION) == wrong


def test_without_times_or_pairs_no_fix_is_wrong():
    assert wrong_fixes(pairs(), CAMERA, UTC_NS[:0], POSITION[:0]) == 0
    assert wrong_fixes(some(pairs(), slice(0)), CAMERA, UTC_NS, POSITION) == 0


def test_identifications_are_joined_by_time_place_and_number():
    latitude, heights = np.radians([10.0, 11.0, 12.0, 13.0]), [0.0, 0.0, 0.0, np.nan]
    catalogue = make_catalogue(latitude, np.zeros(4), np.full(4, 5e3), source="test", rim_height_m=heights)
    detections = DetectionSamples(
        frame_number=np.array([0, 1]),
        utc_ns=UTC_NS,
        usable=np.ones(2, dtype=np.bool_),
        quality=("ok", "ok"),
        offsets=np.array([0, 2, 3]),
        u_px=1.0 + np.arange(3),
        v_px=4.0 + np.arange(3),
        diameter_px=np.full(3, 7.0),
        score=np.ones(3),
        size_class=np.zeros(3, dtype=np.int64),
    )
    ids = catalogue.ids
    found = IdentificationSamples(
        utc_ns=np.array([1000, 2000, 2000, 1500, 2500, 1000, 1000]),
        # the third names a detection that is not there, the next two a time
        detection=np.array([1, 0, 1, 0, 0, 0, 0]),
        # the last two a crater that is not there, and one of unknown height
        crater_id=np.array([ids[2], ids[0], ids[1], ids[1], ids[1], 10**6, ids[3]]),
    )
    joined = join_pairs(found, detections, catalogue)
    assert joined.frame.tolist() == [0, 1]
    assert joined.uv_px.tolist() == [[2.0, 5.0], [3.0, 6.0]]
    assert np.array_equal(joined.crater_mcmf_m, catalogue.position_mcmf_m[[2, 0]])
    for given in (no_detections(), catalogue), (detections, catalogue.select(np.zeros(0, dtype=np.int64))):
        assert join_pairs(found, *given).frame.tolist() == []


METRES_PER_DEG = math.radians(1.0) * 1_737_400.0


def catalogue(count=200):
    rng = np.random.default_rng(1)
    # A grid of a degree, over the zero meridian: no two craters near each other.
    latitude, longitude = np.arange(count) % 20 - 10.0, (355.0 + np.arange(count) // 20) % 360.0
    return make_catalogue(
        np.radians(latitude), np.radians(longitude), rng.uniform(5e3, 9e3, count), source="grid",
        rim_height_m=np.full(count, 100.0),
    )  # fmt: skip


def mapped(known, sigma_m, seed=2, shift_m=0.0):
    rng = np.random.default_rng(seed)
    east, north, up = sigma_m * rng.standard_normal((3, len(known)))
    latitude = np.degrees(known.latitude_rad) + (north + shift_m) / METRES_PER_DEG
    longitude = np.degrees(known.longitude_rad) + east / (METRES_PER_DEG * np.cos(known.latitude_rad))
    return MappedCraters(
        3_000_000_000 + np.arange(len(known)),
        latitude,
        longitude % 360.0,
        known.rim_height_m + up,
        known.diameter_m * np.exp(0.05 * rng.standard_normal(len(known))),
        np.full((len(known), 3), sigma_m),
        np.ones(len(known), dtype=np.int64),
    )


def test_landmarks_are_found_in_the_catalogue_on_both_sides_of_the_meridian_with_honest_sigmas():
    craters = catalogue()
    result = compare_map(mapped(craters, 150.0), craters)
    assert result.crater.tolist() == list(range(len(craters)))
    # Median distance of a plane Gaussian: 1.177 sigma; 400 draws leave 5 %.
    assert result.median_horizontal_m == approx(1.177 * 150.0, rel=0.15)
    assert result.normalised_square == approx(1.0, abs=0.15)
    shifted = compare_map(mapped(craters, 100.0, shift_m=-250.0), craters)
    assert shifted.median_offset_m[1] == approx(-250.0, abs=30.0)
    assert shifted.normalised_square > 3.0


def test_a_crater_serves_one_landmark_others_are_new_and_the_last_report_counts():
    craters = catalogue()
    listed = craters.select(np.arange(0, 200, 2))
    result = compare_map(mapped(craters, 100.0), listed)
    assert result.known == 100
    assert np.all(np.isnan(result.offset_m[result.crater < 0]))
    early, late = mapped(catalogue(4), 300.0, 3), mapped(catalogue(4), 50.0, 4)
    both = (np.concatenate([getattr(one, name) for one in (early, late)]) for name in early.__slots__)
    assert np.array_equal(latest(MappedCraters(*both)).latitude_deg, late.latitude_deg)


def near_zero(north_m, east_m=(0.0,), sigma_m=10.0, diameter_m=6e3):
    """Landmarks near latitude 0, longitude 0, 50 m above the rims; the uncertainty is greatest upwards."""
    north, east = np.array(north_m) / METRES_PER_DEG, np.array(east_m) / METRES_PER_DEG
    count = len(north)
    sigma = np.tile([0.5 * sigma_m, sigma_m, 9.0 * sigma_m], (count, 1))
    return MappedCraters(
        np.arange(count), north, east % 360.0, np.full(count, 150.0), np.full(count, diameter_m), sigma, np.ones(count)
    )


@mark.parametrize(
    "place_m, sigma_m, diameter_m, crater",
    [
        # Half a radius is 1500 m, five sigma are 2000 m.
        ((1490.0, 0.0), 10.0, 6e3, 0), ((1510.0, 0.0), 10.0, 6e3, -1),
        ((1990.0, 0.0), 400.0, 6e3, 0), ((2010.0, 0.0), 400.0, 6e3, -1),
        ((0.0, -90.0), 10.0, 6e3 * math.exp(0.39), 0), ((0.0, -90.0), 10.0, 6e3 * math.exp(0.41), -1),
        ((0.0, -90.0), 10.0, 6e3 * math.exp(-0.39), 0), ((0.0, -90.0), 10.0, 6e3 * math.exp(-0.41), -1),
        ((0.0, 1590.0), 400.0, 6e3, 1), ((0.0, 1410.0), 400.0, 6e3, 0),
    ],
)  # fmt: skip
def test_a_landmark_is_the_nearest_crater_of_its_size_within_half_a_radius_or_five_sigma(
    place_m, sigma_m, diameter_m, crater
):
    """The second crater is 3000 m east of the first."""
    longitude = np.radians([0.0, 3000.0 / METRES_PER_DEG])
    two = make_catalogue(np.zeros(2), longitude, np.full(2, 6e3), source="two", rim_height_m=np.full(2, 100.0))
    north, east = place_m
    found = compare_map(near_zero([north], [east], sigma_m, diameter_m), two)
    assert found.crater.tolist() == [crater]
    if crater >= 0:
        assert found.offset_m[0] == approx([east - 3000.0 * crater, north, 50.0], abs=0.01)


def test_of_two_landmarks_on_one_crater_the_nearer_one_is_known():
    one = make_catalogue([0.0], [0.0], [6e3], source="one", rim_height_m=[100.0])
    for north_m, crater in ([300.0, -100.0], [-1, 0]), ([-100.0, 300.0], [0, -1]):
        found = compare_map(near_zero(north_m, [0.0, 0.0]), one)
        assert found.crater.tolist() == crater and np.isnan(found.offset_m[np.array(crater) < 0]).all()


def test_a_report_counts_the_landmarks_the_fixes_that_used_them_and_their_distance_from_the_catalogue():
    craters = catalogue()
    reports = mapped(craters, 100.0)
    # The catalogue's crater 7, and landmark 0 twice and landmark 1 once.
    named = np.array([7, FIRST_LANDMARK_ID, FIRST_LANDMARK_ID, FIRST_LANDMARK_ID + 1])
    pairs = IdentificationSamples(np.arange(4), np.zeros(4, dtype=np.int64), named)
    result = payload_map(reports, pairs, craters.select(np.arange(100)))
    assert (result.mapped, result.used, result.pairs, result.pairs_of_all) == (200, 2, 3, 4)
    assert (result.mapped_again, result.catalogued) == (0, 100)
    # Two axes of 100 m: the root mean square of the distance is 141 m; 200 draws leave 5 %.
    assert result.horizontal_rms_m == approx(141.0, rel=0.15)


def test_a_pass_without_landmarks_has_no_map():
    result = compare_map(mapped(catalogue(0), 100.0), catalogue())
    assert result.known == 0 and math.isnan(result.median_horizontal_m)
    assert payload_map(None, None, catalogue()) is None
    assert payload_map(mapped_craters(None), None, catalogue()) is None
