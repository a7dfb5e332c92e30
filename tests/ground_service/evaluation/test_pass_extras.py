"""Parts of a pass report: ground, attitude, worst frames, TUM, drift, consistency, against values from outside."""

import math
from types import SimpleNamespace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from pytest import approx, mark, raises

from ground_service.errors import InvalidInput
from ground_service.evaluation import extras
from ground_service.evaluation.alignment import (
    bounds,
    bounds_per_degree,
    drift_by_length,
    drift_percent,
    error_before_reset_m,
    format_tum,
    independent_samples,
    navigation_statistics,
    nees,
    squared_normalised_errors,
)
from ground_service.evaluation.core import WORST_FRAMES, _choose_frames, event_remarks
from ground_service.evaluation.extras import albedo_picture, dark_limit, surface_map, with_terrain
from ground_service.evaluation.fixes import Pairs, snapshot_positions, wrong_fixes
from ground_service.evaluation.recall import ExpectedCraters, Matches, Viewing, expected_craters
from lunar.camera import BrownCamera
from lunar.catalogue import make_catalogue
from lunar.datafolder import find_data
from lunar.frames import quaternion_from_matrix
from lunar.timescales import parse_utc
from reports.values import NavigationSeries, PassEvent, TerrainMap


def two_tones(dark_rows):
    """A map whose northern rows are dark (grey 50 to 59) and whose rest is bright (200 to 209)."""
    image = np.full((180, 360), 200, dtype=np.uint8)
    image[:dark_rows] = 50
    image += (np.arange(360) % 10).astype(np.uint8)
    return TerrainMap(image, 0.0, 360.0, -90.0, 90.0)


@mark.parametrize("dark_rows", [20, 90, 160])
def test_the_limit_lies_between_two_tones_however_much_there_is_of_each(dark_rows):
    assert 59 < dark_limit(two_tones(dark_rows)) <= 200


@mark.parametrize(
    "latitude_deg, longitude_deg, terrain",
    [
        ([80.0, 80.0, -10.0, math.nan], [10.0, -10.0, 359.9, 5.0], ("mare", "mare", "highland", "")),
        ([90.0, -90.0, 0.0], [0.0, 360.0, 359.999999], ("mare", "highland", "highland")),
    ],
    ids=["outside the reference", "edges of the map"],
)
def test_samples_over_dark_ground_are_mare_and_those_outside_the_reference_nothing(
    latitude_deg, longitude_deg, terrain
):
    times = np.arange(len(terrain))
    nothing = np.full(len(terrain), np.nan)
    series = NavigationSeries(
        "anchored", "estimate", times, nothing, nothing, nothing, np.full((len(terrain), 3), np.nan)
    )
    track = SimpleNamespace(utc_ns=times, latitude_deg=np.array(latitude_deg), longitude_deg=np.array(longitude_deg))
    assert with_terrain(series, track, two_tones(45)).terrain == terrain


START = parse_utc("2029-08-07T00:00:00Z")


def event(seconds, name, detail=""):
    return PassEvent(START + seconds * 10**9, "medium", name, detail)


def test_times_with_a_degraded_attitude_and_the_newest_offset_of_the_list_on_board_are_remarks():
    noise = "noise 0.2 deg per axis, declared 0.01 deg"
    events = (
        event(5, "attitude_restored"),
        event(300, "attitude_degraded", noise),
        event(30, "attitude_degraded", noise),
        event(40, "boot"),
        event(90, "attitude_restored"),
        event(95, "attitude_restored"),
    )
    text = f"on ({noise}): the payload used the estimated noise"
    assert event_remarks(events) == [
        f"attitude judged noisier than declared from 2029-08-07T00:00:30.000Z {text}, until 2029-08-07T00:01:30.000Z",
        f"attitude judged noisier than declared from 2029-08-07T00:05:00.000Z {text}",
    ]
    newest = "frame 80: 31.2 m east and north, from 80 fixes"
    offsets = (
        event(90, "map_offset", newest),
        event(5, "map_offset", "frame 0: 60 m east and north, from 0 fixes"),
        event(90, "detection_noise", "frame 80: 0.8 times the stated noise, from 80 fixes"),
        event(99, "boot"),
    )
    assert event_remarks(offsets) == [
        f"offset of the crater list used on board, 1 sigma: {newest}",
        "noise of detections used on board: frame 80: 0.8 times the stated noise, from 80 fixes",
    ]
    assert event_remarks(()) == []


FRAMES, CRATERS = 40, 5


def test_the_worst_frames_are_chosen_from_all_frames_and_not_from_those_with_an_image():
    """Five craters a frame; 20 to 27 lose all, 30 is unfit, and only 0, 10 and 39 have an image.

    Frames 11 and 12 lose all as well, but have three and two craters that count.
    """
    number, row = np.arange(FRAMES), np.arange(FRAMES * CRATERS)
    frame, zeros = row // CRATERS, 0.0 * row
    found = -1 * (np.isin(frame, [11, 12, *range(20, 28), 30]) | (row == 10 * CRATERS))
    size = 3 * ((frame == 11) & (row % CRATERS >= 3) | (frame == 12) & (row % CRATERS >= 2))
    offsets = np.arange(FRAMES + 1) * CRATERS
    expected = ExpectedCraters(offsets, row, zeros, zeros, zeros + 1.0, size, zeros == 0.0)

    class Detections(SimpleNamespace):
        def __len__(self):
            return FRAMES

    inputs = SimpleNamespace(
        detections=Detections(frame_number=number, usable=number != 30), images=dict.fromkeys((0, 10, 39))
    )
    spread, worst = _choose_frames(inputs, expected, Matches(row[:0], found))
    assert spread == [0, 10, 39]
    assert worst == [11, *range(20, 19 + WORST_FRAMES)]


COUNT = 60
UTC_NS = 1_881_735_115_000_000_000 + np.arange(COUNT) * 15 * 10**9


def orbit():
    angle = 1e-3 * 15.0 * np.arange(COUNT)
    flat = 1_768e3 * np.stack([np.cos(angle), np.sin(angle), 0.1 * np.sin(angle)], axis=1)
    return np.asarray(flat)


def poses(text):
    """Return times (n,) and 4 x 4 poses (n, 4, 4) of TUM text, from the definition of a quaternion's rotation."""
    rows = np.array([[float(word) for word in line.split()] for line in text.splitlines() if line[0] != "#"])
    matrices = np.zeros((len(rows), 4, 4))
    x, y, z, w = rows[:, 4:].T
    matrices[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=1)
    matrices[:, 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=1)
    matrices[:, 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1)
    matrices[:, :3, 3], matrices[:, 3, 3] = rows[:, 1:4], 1.0
    return rows[:, 0], matrices


def test_orientations_are_those_of_the_orbit_and_times_keep_their_nanoseconds():
    _, true = poses(format_tum(UTC_NS, orbit(), orbit()))
    radial, normal = true[:, :3, 0], true[:, :3, 2]
    assert_allclose(radial, orbit() / np.linalg.norm(orbit(), axis=1)[:, None], atol=1e-9)
    # The plane of the made orbit is tilted by atan 0.1 about x.
    assert_allclose(normal, [[0.0, -0.0995037, 0.9950372]] * COUNT, atol=1e-4)
    line = format_tum(UTC_NS[:2] + 123_456_789, orbit()[:2], orbit()[:2]).splitlines()[1]
    assert line.split()[0] == "1881735115.123456789"


def test_a_map_of_minus_180_to_180_is_turned_to_begin_at_0(tmp_path):
    columns = np.repeat(np.linspace(0, 255, 64).astype(np.uint8)[None], 32, axis=0)
    Image.fromarray(columns).save(tmp_path / "albedo.png")
    found = surface_map(tmp_path / "albedo.png")
    assert (found.image.shape, found.west_deg, found.east_deg) == ((1024, 2048), 0.0, 360.0)
    assert int(found.image[512, 1020]) > 210  # just west of 180 degrees: the eastern edge of the file
    assert int(found.image[512, 1030]) < 50


def test_an_albedo_map_is_read_once_by_all_processes_until_its_file_changes(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    albedo = tmp_path / "albedo.png"

    def shown(columns):
        Image.fromarray(np.repeat(columns.astype(np.uint8)[None], 32, axis=0)).save(albedo)
        albedo_picture.cache_clear()
        return albedo_picture(albedo)

    even = np.linspace(0, 255, 64)
    first = shown(even)
    with monkeypatch.context() as patch:
        patch.setattr(extras, "_grey_levels", None)
        assert_array_equal(shown(even), first)
    assert shown(even[::-1])[512, 0] > 200 > 50 > first[512, 0]


def test_a_file_that_is_no_picture_is_reported(tmp_path):
    (tmp_path / "albedo.jpg").write_text("no picture")
    with raises(InvalidInput, match="cannot be read"):
        surface_map(tmp_path / "albedo.jpg")


@mark.real_data
def test_a_fifth_of_the_real_moon_is_dark_and_the_sea_of_tranquillity_is(data_path):
    # Maria cover about 17 % of the Moon (Head 1976, Reviews of Geophysics 14, 265); other ground is darker.
    albedo = find_data(data_path).albedo
    found = surface_map(albedo)
    limit = dark_limit(found)
    area = np.cos(np.radians(90.0 - (np.arange(1024) + 0.5) * 180.0 / 1024))[:, None] / 2048
    share = float((area * (found.image < limit)).sum() / (area * 2048).sum())
    assert 0.14 < share < 0.25

    def grey(latitude_deg, longitude_deg):
        return int(found.image[int((90.0 - latitude_deg) / 180.0 * 1024), int(longitude_deg / 360.0 * 2048)])

    # Mare Tranquillitatis and Oceanus Procellarum; Tycho and the far side.
    assert max(grey(8.5, 31.4), grey(18.4, 302.6)) < limit < min(grey(-43.3, 348.6), grey(20.0, 180.0))


PATH_M = 24_500.0 * np.arange(100)
NEVER = np.zeros(100, dtype=bool)
STEADY = np.arange(100)[:, None] * np.array([0.0, 245.0, 0.0])


def test_a_drift_is_its_share_of_the_path_a_reset_hides_none_and_the_error_before_it_is_known():
    """Sawtooth: 2 % between resets, although the error at the end of the pass is nearly nothing."""
    assert drift_percent(STEADY, PATH_M, NEVER) == approx(1.0, rel=1e-12)
    height = STEADY[:, [1, 0, 2]]
    assert drift_percent(height, PATH_M, NEVER) == 0.0
    phase = np.arange(100) % 20
    sawtooth = phase[:, None] * np.array([0.0, 490.0, 0.0])
    assert drift_percent(sawtooth, PATH_M, phase == 0) == approx(2.0, rel=1e-12)
    error = np.arange(6)[:, None] * np.array([0.0, 3.0, 4.0])
    before = error_before_reset_m(error, np.isin(np.arange(6), (0, 3)))
    assert_allclose(before, [np.nan, np.nan, np.nan, 10.0, np.nan, np.nan])
    place = np.arange(100)
    samples = drift_by_length(STEADY * (place < 50)[:, None], PATH_M, place == 50)
    assert [sample.path_length_m for sample in samples] == [100e3, 200e3, 500e3, 1000e3]
    # 100 km are nearest to 4 steps of 24.5 km: 46 sub-tracks in each half of 50 samples, drifting and standing still.
    assert samples[0].samples == 92
    assert samples[0].p95_percent == approx(1.0)


def test_statistics_leave_out_samples_without_reference_and_weigh_with_the_whole_matrix():
    error = np.array([[3.0, 4.0, 0.0], [np.nan] * 3, [0.0, 0.0, 10.0]])
    found = navigation_statistics(error, np.array([0.0, np.nan, 1000.0]), NEVER[:3])
    assert (found.median_3d_m, found.max_3d_m, found.end_of_pass_m, found.path_length_m) == approx(
        (7.5, 10.0, 10.0, 1000.0)
    )
    for count in 0, 1:
        few = navigation_statistics(np.zeros((count, 3)), np.zeros(count), NEVER[:count])
        assert np.isnan(few.drift_percent)
    # P = [[4, 2], [2, 3]], inverse [[3, -2], [-2, 4]] / 8; e = (2, -1): (12 + 8 + 4) / 8 = 3. The diagonal alone gives
    # 4/4 + 1/3.
    covariance = [[4.0, 2.0], [2.0, 3.0]]
    assert nees([2.0, -1.0], covariance) == approx(3.0, rel=1e-12)
    assert squared_normalised_errors([2.0, -1.0], np.sqrt([4.0, 3.0])) == approx(4.0 / 3.0, rel=1e-12)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 6))
def test_it_does_not_depend_on_the_axes_or_units(seed, size):
    rng = np.random.default_rng(seed)
    root, turn = rng.standard_normal((2, size, size)) + 2.0 * np.eye(size)
    error, covariance = rng.standard_normal(size), root @ root.T + 0.1 * np.eye(size)
    change = turn @ np.diag(10.0 ** rng.uniform(-3.0, 3.0, size))
    expected = float(error @ np.linalg.inv(covariance) @ error)
    assert nees(error, covariance) == approx(expected, rel=1e-8)
    if np.linalg.cond(change) < 1e5:
        assert nees(change @ error, change @ covariance @ change.T) == approx(expected, rel=1e-4)


def test_what_is_not_known_is_not_guessed():
    good, error = np.diag([4.0, 9.0]), np.array([2.0, 3.0])
    singular = np.array([[1.0, 1.0], [1.0, 1.0]])
    indefinite = np.array([[1.0, 2.0], [2.0, 1.0]])
    lopsided = np.array([[1.0, 0.5], [0.0, 1.0]])
    negative = np.diag([-1.0, 1.0])
    missing = np.array([[np.nan, 0.0], [0.0, 1.0]])
    matrices = np.stack([good, singular, indefinite, lopsided, negative, missing, np.zeros((2, 2))])
    values = nees(np.broadcast_to(error, (7, 2)), matrices)
    assert values[0] == approx(2.0)
    assert np.isnan(values[1:]).all()
    assert np.isnan(nees([np.nan, 1.0], good))
    assert np.isnan(squared_normalised_errors([[1.0, 1.0], [np.nan, 1.0]], [[0.0, 1.0], [1.0, 1.0]])).all()


def test_no_samples_have_no_sums_and_bounds_are_those_of_printed_tables():
    assert nees(np.zeros((0, 3)), np.zeros((0, 3, 3))).shape == (0,)
    assert nees(np.ones((4, 5, 3)), np.eye(3)).shape == (4, 5)
    with raises(ValueError, match=r"expected errors \(..., d\)"):
        nees(np.ones(3), np.eye(2))
    # Quantiles of chi-square at 0.025 and 0.975 as tables print them (NIST/SEMATECH e-Handbook, 1.3.6.7.4).
    low, high = bounds([1, 3, 6, 100])
    assert_allclose(high, [5.024, 9.348, 14.449, 129.561], atol=6e-4)
    assert_allclose(low, [0.001, 0.216, 1.237, 74.222], atol=6e-4)
    # Bar-Shalom, Li, Kirubarajan, example 5.4.2: 50 runs of 2 degrees, [1.5, 2.6] (74.22/50 and 129.56/50).
    assert bounds_per_degree(2, 50, 0.95) == approx((1.4844 / 2, 2.5912 / 2), abs=1e-4)
    assert np.isnan(bounds(0)[0]) and np.isnan(bounds_per_degree(6, 0.5, 0.95)).all()


def test_correlated_samples_are_worth_fewer():
    rng = np.random.default_rng(1)
    white = rng.standard_normal(4_000)
    assert independent_samples(white) > 2_000
    # First-order autoregression with 0.9: the integrated time is (1 + 0.9) / (1 - 0.9) = 19.
    slow = np.zeros(40_000)
    for k in range(1, slow.size):
        slow[k] = 0.9 * slow[k - 1] + rng.standard_normal()
    assert independent_samples(slow) == approx(slow.size / 19.0, rel=0.25)
    assert independent_samples(np.ones(50)) == 1.0
    assert independent_samples([np.nan, 1.0]) == 1.0


RADIUS_M = 1_737_400.0
ALTITUDE_M = 30_000.0
K1, P1 = -0.02, 1e-3
TILT_RAD = math.radians(15.0)
RIM_HEIGHT_M = 5_000.0
POSITION = np.array([[RADIUS_M + ALTITUDE_M, 0.0, 0.0]])  # above latitude 0, longitude 0
CAMERA = BrownCamera(512, 512, 2.0 * math.pi / 3.0, k1=K1, p1=P1)
FOCAL_PX = 256.0 / math.tan(math.radians(60.0))


def pixel(latitude_deg, longitude_deg, height_m):
    """Pixel of a place, seen from above (0, 0) by a camera that leans 15 degrees from nadir to the north."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    radius = RADIUS_M + height_m
    up = radius * math.cos(latitude) * math.cos(longitude) - (RADIUS_M + ALTITUDE_M)
    east = radius * math.cos(latitude) * math.sin(longitude)
    north = radius * math.sin(latitude)
    along = -up * math.cos(TILT_RAD) + north * math.sin(TILT_RAD)  # boresight
    down = -north * math.cos(TILT_RAD) - up * math.sin(TILT_RAD)  # image v
    x, y = east / along, down / along
    square = x * x + y * y
    radial = 1.0 + K1 * square
    u = x * radial + 2.0 * P1 * x * y
    v = y * radial + P1 * (square + 2.0 * y * y)
    return 255.5 + FOCAL_PX * u, 255.5 + FOCAL_PX * v


PLACES_DEG = [(0.0, 0.1), (0.5, -0.4), (1.0, 0.6), (-0.2, 0.3)]


def catalogue():
    places = np.radians(np.array(PLACES_DEG))
    return make_catalogue(
        places[:, 0], places[:, 1], np.full(4, 8e3), source="made", rim_height_m=np.full(4, RIM_HEIGHT_M)
    )


def test_a_tilted_camera_sees_craters_on_high_ground_and_beyond_a_nadir_footprint():
    viewing = Viewing(CAMERA, TILT_RAD)
    expected = expected_craters(catalogue(), CAMERA, POSITION, viewing.pointed(POSITION))
    assert expected.index.tolist() == [0, 1, 2, 3]
    found = np.column_stack([expected.u_px, expected.v_px])
    assert_allclose(found, [pixel(*place, RIM_HEIGHT_M) for place in PLACES_DEG], rtol=0, atol=1e-6)
    lost = np.full((1, 3), np.nan)
    assert len(expected_craters(catalogue(), CAMERA, lost, viewing.pointed(lost)).index) == 0
    # 2.5 degrees north of the track is 76 km, past the corner of a nadir image from 30 km (73 km).
    far = make_catalogue(np.radians([3.0]), np.radians([0.0]), np.array([9e3]), source="made", rim_height_m=np.zeros(1))
    narrow = BrownCamera(512, 512, math.radians(60.0))
    assert len(expected_craters(far, narrow, POSITION).index) == 0
    leaning = Viewing(narrow, math.radians(65.0)).pointed(POSITION)
    assert expected_craters(far, narrow, POSITION, leaning).index.tolist() == [0]


def test_a_telemetered_attitude_wins_over_the_declared_pointing():
    tilted = Viewing(CAMERA, TILT_RAD).pointed(POSITION)
    mcmf_from_icrf = np.array([[[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    q = quaternion_from_matrix(tilted @ mcmf_from_icrf)
    viewing = Viewing(CAMERA, attitude_utc_ns=np.array([1_000]), q_wxyz=q)
    rotation = viewing.camera_from_mcmf(np.array([1_000]), POSITION, mcmf_from_icrf)
    assert_allclose(rotation, tilted, atol=1e-12)
    other = viewing.camera_from_mcmf(np.array([1_001]), POSITION, mcmf_from_icrf)
    assert_allclose(other, Viewing(CAMERA).pointed(POSITION), atol=1e-12)
    assert viewing.known(np.array([999, 1_000, 1_001])).tolist() == [False, True, False]


@mark.parametrize("telemetered", [True, False])
def test_a_snapshot_of_a_tilted_distorted_camera_finds_its_place(telemetered):
    craters = catalogue()
    pairs = Pairs(
        np.zeros(4, dtype=np.int64),
        np.zeros(4, dtype=np.int64),
        np.array([pixel(*place, RIM_HEIGHT_M) for place in PLACES_DEG]),
        np.full(4, 40.0),
        craters.position_mcmf_m,
    )
    viewing = Viewing(CAMERA, TILT_RAD)
    attitude = viewing.pointed(POSITION) if telemetered else None
    start = POSITION + np.array([[800.0, -500.0, 300.0]])
    times = np.zeros(1, dtype=np.int64)
    found = snapshot_positions(pairs, CAMERA, times, start, viewing.pointed, attitude)
    assert_allclose(found, POSITION, atol=0.01)
    assert wrong_fixes(pairs, CAMERA, times, POSITION, viewing.pointed(POSITION)) == 0
    assert wrong_fixes(pairs, CAMERA, times, POSITION) == 1
