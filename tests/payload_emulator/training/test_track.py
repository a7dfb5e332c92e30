"""Places along an ephemeris: the paper's rule and its split."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from lunar.boxes import Box
from lunar.camera import PinholeCamera
from lunar.datafolder import find_data
from lunar.ephemeris import ephemeris_from_states
from lunar.frames import IauOrientation, mcmf_from_spherical, spherical_from_mcmf
from lunar.messages.oem import save_oem
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from payload_emulator.errors import DatasetError
from payload_emulator.session.world.recipe import PAPER_SPLIT, Source, load_recipe
from payload_emulator.training.data.shots import pose_at
from payload_emulator.training.data.track import lay_track, order_by_ground, split_track

ROOT = Path(__file__).parents[3]
START = parse_utc("2029-08-07T00:00:00Z")
RADIUS_M = 1_737_400.0 + 30_000.0
PERIOD_S = 2.0 * math.pi * math.sqrt(RADIUS_M**3 / 4.902_800e12)
CAMERA = PinholeCamera(512, 512, math.radians(120.0))


class Everywhere:
    """A flat Moon at one height."""

    name = "flat"

    def __init__(self, height_m=0.0):
        self.height = height_m

    def covers(self, latitude_rad, longitude_rad):
        return np.ones(np.shape(latitude_rad), dtype=bool)

    def height_m(self, latitude_rad, longitude_rad, level=0):
        return np.full(np.shape(latitude_rad), self.height)

    def level_for(self, sample_m):
        return int(sample_m > 200.0)


@pytest.fixture(scope="module")
def polar_orbit(tmp_path_factory):
    """One revolution over the poles, a state every 30 s."""
    time_s = np.arange(0.0, PERIOD_S, 30.0)
    angle = 2.0 * math.pi * time_s / PERIOD_S
    position = RADIUS_M * np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
    speed = 2.0 * math.pi * RADIUS_M / PERIOD_S
    velocity = speed * np.stack([-np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=1)
    # Over the Moon's poles, not over the Earth's; the Moon turns by a degree meanwhile.
    icrf_from_mcmf = IauOrientation().mcmf_from_icrf(tdb_s_from_utc_ns(START)).T
    states = position @ icrf_from_mcmf.T, velocity @ icrf_from_mcmf.T
    path = tmp_path_factory.mktemp("orbit") / "orbit.oem"
    save_oem(ephemeris_from_states(START + (time_s * 1e9).astype(np.int64), *states), path)
    return path


def source(path, **changes):
    plain = Source("orbit", PAPER_SPLIT, "procedural", 1.0, ephemeris=str(path), step_s=30.0)
    return dataclasses.replace(plain, **changes)


def laid(along, count, seed=1):
    return lay_track(along, CAMERA, Everywhere(), find_data(None), count, seed)


def test_every_position_within_sixty_degrees_is_taken_and_no_other(polar_orbit):
    track = laid(source(polar_orbit), 140)
    latitude, _, altitude = spherical_from_mcmf(track.position_mcmf_m)
    assert np.abs(np.degrees(latitude)).max() <= 60.0
    assert np.allclose(altitude, 30_000.0, atol=5.0)
    # Two thirds of a polar revolution of 110 minutes at two frames a minute: 147.
    with pytest.raises(DatasetError, match=r"expected 200 places .* found 14\d of 2\d\d"):
        laid(source(polar_orbit), 200)
    steps = np.diff(track.utc_ns) / 1e9
    assert set(np.round(steps[steps < 60.0], 6)) == {30.0}
    # Once over each pole a third of half a revolution is left out.
    assert np.count_nonzero(steps > 15 * 60.0) >= 1


def test_places_follow_the_ephemeris_and_not_its_step(polar_orbit):
    fine = laid(source(polar_orbit, step_s=15.0), 40)
    coarse = laid(source(polar_orbit), 20)
    np.testing.assert_array_equal(fine.utc_ns[::2], coarse.utc_ns)
    np.testing.assert_allclose(fine.position_mcmf_m[::2], coarse.position_mcmf_m, atol=1e-3)


def test_boxes_and_buffers_hold_along_an_orbit_too(polar_orbit):
    north = source(polar_orbit, boxes=(Box(0.0, 360.0, 10.0, 60.0),), avoid=(Box(0.0, 360.0, 40.0, 50.0),))
    track = laid(north, 20)
    latitude = np.degrees(spherical_from_mcmf(track.position_mcmf_m)[0])
    # A footprint from 30 km reaches 1.76 degrees to each side at its edge, 2.5 in its corners; the buffer is 60 km.
    assert latitude.min() > 10.0 + 1.7
    assert not np.any((latitude > 40.0 - 1.7 - 1.97) & (latitude < 50.0 + 1.7 + 1.97))


def test_the_papers_split_keeps_one_arc_for_testing():
    names = split_track(PAPER_SPLIT, 2000, 7)
    assert names[-100:] == ("test",) * 100
    assert {name: names.count(name) for name in ("train", "val", "test")} == {"train": 1600, "val": 300, "test": 100}
    # Validation is drawn from all over the rest, by the seed.
    where = np.flatnonzero(np.array(names) == "val")
    assert where.min() < 100 and where.max() > 1800
    assert names == split_track(PAPER_SPLIT, 2000, 7) != split_track(PAPER_SPLIT, 2000, 8)
    assert split_track("train", 3, 7) == ("train",) * 3


def test_an_ephemeris_below_the_ground_is_refused_with_the_place(polar_orbit):
    along = source(polar_orbit)
    position = laid(along, 1).position_mcmf_m[0]
    rng = np.random.default_rng(1)
    assert pose_at(Everywhere(), CAMERA, along, position, "frame 3", rng).ground_m == 0.0
    with pytest.raises(DatasetError, match=r"frame 3: expected a place above the ground at .* found the camera at"):
        pose_at(Everywhere(31_000.0), CAMERA, along, position, "frame 3", rng)


def test_a_recipe_names_an_ephemeris_in_its_folder_and_only_that_may_split_as_the_paper(tmp_path, polar_orbit):
    (tmp_path / "orbit.oem").write_bytes(polar_orbit.read_bytes())
    text = """[dataset]
name = "a"
seed = 1
bits = 16
[[dataset.source]]
name = "x"
split = "80/15/5"
terrain = "catalogue"
share = 1.0
"""
    path = tmp_path / "recipe.toml"
    path.write_text(text + 'ephemeris = "orbit.oem"\nstep_s = 30\n')
    recipe = load_recipe(path)
    assert recipe.sources[0].ephemeris == str(tmp_path / "orbit.oem")
    # Where the file lies decides nothing about the frames.
    assert recipe.to_dict()["sources"][0]["ephemeris"] == "orbit.oem"
    for wrong, message in (
        (text, "expected one of train, val, test, found '80/15/5'"),
        (text + 'ephemeris = "orbit.oem"\nstep_s = 0.0\n', "step_s: expected more than 0"),
        (text.replace("16", "12").replace("80/15/5", "train"), "bits: expected one of 8, 16, found 12"),
    ):
        path.write_text(wrong)
        with pytest.raises(DatasetError, match=message):
            load_recipe(path)


def test_the_shipped_recipe_of_the_papers_data_set_flies_the_shipped_orbit():
    recipe = load_recipe(ROOT / "scenarios" / "paper-dataset.toml")
    (along,) = recipe.sources
    assert (along.split, along.light, along.step_s, along.days) == ("80/15/5", "paper", 30.0, 30.0)
    day = dataclasses.replace(along, days=0.1, step_s=60.0)
    track = laid(day, 60, recipe.seed)
    altitude_km = spherical_from_mcmf(track.position_mcmf_m)[2] / 1e3
    # The paper's orbit flies between 14.0 and 48.6 km.
    assert altitude_km.min() > 13.0 and altitude_km.max() < 50.0


def test_places_are_ordered_so_that_neighbours_on_the_ground_follow_each_other():
    """53 revolutions, each 0.3 degrees west of the one before, low on the way north and high on the way south."""
    step = np.arange(20_000)
    latitude = 0.8 * np.sin(step / 60.0)
    longitude = -step / 377.0 * math.radians(0.3)
    altitude_m = np.where(np.cos(step / 60.0) > 0.0, 14e3, 48e3)
    position = np.asarray(mcmf_from_spherical(latitude, longitude, altitude_m))
    order = order_by_ground(position, CAMERA, Everywhere())
    assert np.array_equal(np.sort(order), step)

    def tiles(order):
        """Squares of 3 degrees and levels within the last 100 frames, newly entered, per frame."""
        degrees = np.degrees(latitude) // 3.0, np.degrees(longitude) % 360.0 // 3.0
        keys = list(zip(degrees[0][order], degrees[1][order], altitude_m[order] > 30e3, strict=True))
        return np.mean([key not in keys[max(0, n - 100) : n] for n, key in enumerate(keys)])

    assert tiles(order) < 0.25 * tiles(step)


def test_the_order_of_making_is_part_of_the_digest(polar_orbit):
    track = laid(source(polar_orbit), 40, 7)
    assert dataclasses.replace(track, order=track.order[::-1]).digest != track.digest
