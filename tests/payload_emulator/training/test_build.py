"""Rendered data sets: the same frames whatever the order, resumable, kept apart by footprint; places along a track."""

import dataclasses
import functools
import json
import math
import os
import resource
import subprocess
import sys
import time
from math import pi, radians
from pathlib import Path

import numpy as np
from numpy import cos, hypot, sin
from numpy.testing import assert_allclose, assert_array_equal
from pytest import fixture, mark, raises

from lunar.boxes import Box
from lunar.camera import PinholeCamera
from lunar.datafolder import find_data
from lunar.ephemeris import ephemeris_from_states
from lunar.frames import IauOrientation, mcmf_from_spherical, spherical_from_mcmf
from lunar.messages.oem import save_oem
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from payload_emulator.errors import DatasetError, RendererError, ScenarioError
from payload_emulator.session.world.recipe import PAPER_SPLIT, Recipe, Source, load_recipe
from payload_emulator.training.data import dataset as store
from payload_emulator.training.data.build import _runs, build, make_shard, plan_shards
from payload_emulator.training.data.integrity import check
from payload_emulator.training.data.shots import pose_at
from payload_emulator.training.data.track import lay_track, order_by_ground, split_track

ROOT = Path(__file__).parents[3]
RECIPE = Recipe(
    "tiny",
    7,
    (
        Source("world", "train", "procedural", 0.5, (41,), altitude_km=(14.0, 16.0)),
        Source("world-test", "test", "procedural", 0.5, (41,), light="low", vary=False, altitude_km=(14.0, 16.0)),
    ),
    frames_per_shard=1,
)

TOML = """[dataset]
name = "tiny"
seed = 7
frames_per_shard = 1
[[dataset.source]]
name = "world"
split = "train"
terrain = "procedural"
share = 0.5
seeds = [41]
altitude_km = [14.0, 16.0]
[[dataset.source]]
name = "world-test"
split = "test"
terrain = "procedural"
share = 0.5
seeds = [41]
light = "low"
vary = false
altitude_km = [14.0, 16.0]
"""


def made(folder, *more, **changes):
    """Return the steps of a build of the recipe, changed."""
    return build(dataclasses.replace(RECIPE, **changes), folder, 3, find_data(None), *more)


def empty_set(folder):
    for name in ("images", "metadata", "shards"):
        (folder / name).mkdir(parents=True)
    return folder


@fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("built") / "set"
    list(made(folder))
    return folder


def test_a_shard_does_not_depend_on_what_was_made_before(built, tmp_path):
    empty_set(tmp_path)
    for shard in reversed(plan_shards(RECIPE, 3)[-2:]):
        make_shard(RECIPE, shard, tmp_path, "")
        for path in (f"images/{shard.frame_numbers[0]:06d}.png", f"shards/{shard.name}.npz"):
            assert (tmp_path / path).read_bytes() == (built / path).read_bytes(), path


def test_a_finished_data_set_is_not_made_again(built, monkeypatch):

    def refuse(*arguments):
        raise AssertionError("a finished shard was rendered again")

    monkeypatch.setattr("payload_emulator.training.data.build.make_shard", refuse)
    assert list(made(built)) == [(4, 4)]


def test_a_build_killed_at_work_goes_on_to_the_same_bytes(built, tmp_path):
    """SIGKILL, so that nothing can tidy up."""
    recipe = tmp_path / "tiny.toml"
    recipe.write_text(TOML)
    assert load_recipe(recipe).digest == RECIPE.digest
    target = tmp_path / "set"
    command = [
        sys.executable, "-m", "linna", "dataset", "build", str(recipe), "--out", str(target), "--frames", "3",
    ]  # fmt: skip
    environment = {key: value for key, value in os.environ.items() if key != "LINNA_DATA"}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": ROOT, "env": environment}
    with subprocess.Popen(command, **quiet) as first:
        while first.poll() is None and not list(target.glob("shards/*.npz")):
            time.sleep(0.02)
        first.kill()
    (target / "images/.000002.png.4711").write_bytes(b"half a picture")
    assert 1 <= len(list(target.glob("shards/*.npz"))) < 4
    list(build(load_recipe(recipe), target, 3, find_data(None)))
    assert check(target) == []
    ours, theirs = ({p.relative_to(f): p.read_bytes() for p in f.rglob("*") if p.is_file()} for f in (built, target))
    assert ours == theirs


def test_a_full_disk_loses_nothing_that_was_finished(tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    folder = tmp_path / "set"
    steps = made(folder)
    next(steps), next(steps)
    try:
        # A picture has more than a hundred thousand octets.
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
        with raises(DatasetError, match=r"File too large.*; 1 of 4 frames are kept, the same command goes on"):
            list(steps)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in folder.rglob(".*")] == []
    assert next(made(folder)) == (1, 4)


def test_a_dead_worker_is_said_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("payload_emulator.training.data.build._follow_parent", functools.partial(os._exit, 9))
    with raises(DatasetError, match=r"a worker process died .*; 0 of 4 frames are kept"):
        list(made(tmp_path / "set", 2))


def test_two_builds_do_not_write_to_one_folder(tmp_path):
    steps = made(tmp_path / "set")
    assert next(steps) == (0, 4)
    with raises(DatasetError, match="found a build in progress"):
        next(made(tmp_path / "set"))
    steps.close()
    assert next(made(tmp_path / "set")) == (0, 4)


def test_neighbouring_shards_go_to_one_worker():
    runs = list(_runs(plan_shards(RECIPE, 80), 2))
    assert [shard.number for run in runs for shard in run] == list(range(80))
    assert max(map(len, runs)) == 8
    assert all(len({(s.source.name, s.seed) for s in run}) == 1 for run in runs)


def test_sixteen_bits_show_what_eight_do(built, tmp_path):
    import cv2

    empty_set(tmp_path)
    shard = plan_shards(RECIPE, 3)[-1]
    make_shard(dataclasses.replace(RECIPE, bits=16), shard, tmp_path, "")
    name = f"images/{shard.frame_numbers[0]:06d}.png"
    deep = cv2.imread(str(tmp_path / name), cv2.IMREAD_UNCHANGED)
    plain = cv2.imread(str(built / name), cv2.IMREAD_UNCHANGED)
    assert deep.dtype == np.uint16 and np.unique(deep).size > 2000
    # One step of eight bits.
    assert np.abs(deep / 257.0 - plain).max() < 1.5


def test_metadata_tell_pose_corners_and_sun(built):
    document = json.loads((built / "metadata/000003.json").read_text())
    for key in ("latitude_deg", "longitude_deg", "altitude_km", "tilt_deg", "azimuth_deg", "corners_deg"):
        assert key in document
    assert_allclose(np.array(document["camera_from_mcmf"]) @ document["sun_mcmf"], document["sun_camera"], atol=1e-12)
    assert len(document["corners_deg"]) == 4


def test_ellipses_of_coco_lie_in_their_boxes(built):
    annotations = json.loads((built / "coco_train.json").read_text())["annotations"]
    assert len(annotations) >= 15
    whole = 0
    for a in annotations:
        u, v, half_major, half_minor, angle_deg = a["ellipse"]
        angle, around = np.radians(angle_deg), np.linspace(0.0, 2.0 * np.pi, 181)
        x = u + half_major * cos(around) * cos(angle) - half_minor * sin(around) * sin(angle) + 0.5
        y = v + half_major * cos(around) * sin(angle) + half_minor * sin(around) * cos(angle) + 0.5
        assert half_major >= half_minor > 0.0 and 0.0 < a["visible"] <= 1.0
        left, top, width, height = a["bbox"]
        assert min(left, top) >= 0.0 and max(left + width, top + height) <= RECIPE.width_px + 0.01
        if min(x.min(), y.min()) < 0.0 or max(x.max(), y.max()) > RECIPE.width_px:
            continue
        whole += 1
        box = [x.min(), y.min(), np.ptp(x), np.ptp(y)]
        # Rounded to a hundredth of a pixel and of a degree, and looked at every two degrees.
        assert_allclose(box, a["bbox"], atol=0.03 + 2e-4 * half_major)
    assert whole >= 10


def test_another_data_set_in_the_folder_is_refused(built):
    with raises(DatasetError, match="expected an empty folder or the same data set"):
        list(made(built, seed=8))


def test_other_files_in_the_folder_are_left_alone(tmp_path):
    (tmp_path / "letter.txt").write_text("mine")
    with raises(DatasetError, match="found other files"):
        list(made(tmp_path))
    assert (tmp_path / "letter.txt").read_text() == "mine"


def test_real_terrain_without_data_is_refused(tmp_path):
    recipe = load_recipe(ROOT / "scenarios/detector-dataset.toml")
    with raises(DatasetError, match="expected terrain tiles"):
        list(build(recipe, tmp_path / "set", 40, find_data(None)))


def test_labels_of_fresh_craters_sit_on_dark_and_bright_walls(built):
    """Along the Sun's direction the wall toward the Sun is the darker: the label's centre parts them."""
    dataset = store.Dataset(built)
    contrast = []
    for frame in dataset.frames():
        image = dataset.image(frame).astype(float)
        toward = frame.sun_camera[:2] / hypot(*frame.sun_camera[:2])
        c = frame.craters
        for k in np.flatnonzero((c["depth_ratio"] > 0.08) & (c["diameter_px"] > 12) & (c["id"] >= 0)):
            step = 0.3 * c["diameter_px"][k] * toward
            places = [(c["u_px"][k] + s * step[0], c["v_px"][k] + s * step[1]) for s in (1.0, -1.0)]
            if all(3 < u < 508 and 3 < v < 508 for u, v in places):
                near, far = (image[round(float(v)), round(float(u))] for u, v in places)
                contrast.append(far - near)
    assert len(contrast) >= 5
    assert np.mean(np.array(contrast) > 0) > 0.85


@mark.real_data
def test_training_frames_keep_sixty_kilometres_from_every_held_out_box(tmp_path, data_path):
    recipe = load_recipe(ROOT / "scenarios/detector-dataset.toml")
    empty_set(tmp_path)
    shard = plan_shards(recipe, 400)[0]
    shard = dataclasses.replace(shard, frame_numbers=shard.frame_numbers[:2])
    make_shard(recipe, shard, tmp_path, str(data_path))
    km_per_degree = 1737.4 * np.pi / 180.0
    for path in (tmp_path / "metadata").glob("*.json"):
        for corner in json.loads(path.read_text())["corners_deg"]:
            for box in shard.source.avoid:
                middle = 0.5 * (box.west_deg + box.east_deg)
                east = abs((corner["longitude"] - middle + 180) % 360 - 180) - 0.5 * (box.east_deg - box.west_deg)
                east_km = max(east, 0.0) * km_per_degree * cos(np.radians(corner["latitude"]))
                north = max(box.south_deg - corner["latitude"], corner["latitude"] - box.north_deg, 0.0)
                # A parallel is no great circle: up to 1 % short over such distances.
                assert hypot(east_km, north * km_per_degree) >= 59.4


def test_the_renderers_of_a_recipe_get_the_same_scenes_and_an_unknown_one_is_refused(tmp_path):
    shard = plan_shards(RECIPE, 3)[-1]
    frames = {}
    for name in ("fast", "raymarch"):
        folder = empty_set(tmp_path / name)
        make_shard(dataclasses.replace(RECIPE, renderer=name), shard, folder, "")
        frames[name] = store.load_shard(folder / "shards" / f"{shard.name}.npz")
    fast, slow = frames["fast"], frames["raymarch"]
    assert_array_equal(fast.position_mcmf_m, slow.position_mcmf_m)
    assert_array_equal(fast.sun_camera, slow.sun_camera)
    assert fast.image_sha256 != slow.image_sha256
    with raises(ScenarioError, match="expected one of fast, raymarch, cycles, found 'pov'"):
        list(made(tmp_path / "x", renderer="pov"))


def test_a_build_by_cycles_without_blender_says_what_is_missing(tmp_path):
    with raises(RendererError, match="expected a Python interpreter with Blender"):
        list(made(tmp_path / "x", 1, str(tmp_path / "none"), renderer="cycles"))


START = parse_utc("2029-08-07T00:00:00Z")
RADIUS_M = 1_737_400.0 + 30_000.0
PERIOD_S = 2.0 * pi * math.sqrt(RADIUS_M**3 / 4.902_800e12)
CAMERA = PinholeCamera(512, 512, radians(120.0))


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


@fixture(scope="module")
def polar_orbit(tmp_path_factory):
    """One revolution over the poles, a state every 30 s."""
    time_s = np.arange(0.0, PERIOD_S, 30.0)
    angle = 2.0 * pi * time_s / PERIOD_S
    position = RADIUS_M * np.stack([cos(angle), np.zeros_like(angle), sin(angle)], axis=1)
    speed = 2.0 * pi * RADIUS_M / PERIOD_S
    velocity = speed * np.stack([-sin(angle), np.zeros_like(angle), cos(angle)], axis=1)
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
    with raises(DatasetError, match=r"expected 200 places .* found 14\d of 2\d\d"):
        laid(source(polar_orbit), 200)
    steps = np.diff(track.utc_ns) / 1e9
    assert set(np.round(steps[steps < 60.0], 6)) == {30.0}
    # Once over each pole a third of half a revolution is left out.
    assert np.count_nonzero(steps > 15 * 60.0) >= 1


def test_places_follow_the_ephemeris_and_not_its_step_within_boxes_and_buffers(polar_orbit):
    fine = laid(source(polar_orbit, step_s=15.0), 40)
    coarse = laid(source(polar_orbit), 20)
    assert_array_equal(fine.utc_ns[::2], coarse.utc_ns)
    assert_allclose(fine.position_mcmf_m[::2], coarse.position_mcmf_m, atol=1e-3)
    track = laid(source(polar_orbit, boxes=(Box(0.0, 360.0, 10.0, 60.0),), avoid=(Box(0.0, 360.0, 40.0, 50.0),)), 20)
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
    with raises(DatasetError, match=r"frame 3: expected a place above the ground at .* found the camera at"):
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
        with raises(DatasetError, match=message):
            load_recipe(path)


def test_the_shipped_recipe_of_the_papers_data_set_flies_the_shipped_orbit():
    recipe = load_recipe(ROOT / "scenarios/paper-dataset.toml")
    (along,) = recipe.sources
    assert (along.split, along.light, along.step_s, along.days) == ("80/15/5", "paper", 30.0, 30.0)
    track = laid(dataclasses.replace(along, days=0.1, step_s=60.0), 60, recipe.seed)
    altitude_km = spherical_from_mcmf(track.position_mcmf_m)[2] / 1e3
    # The paper's orbit flies between 14.0 and 48.6 km.
    assert altitude_km.min() > 13.0 and altitude_km.max() < 50.0


def test_places_are_ordered_so_that_neighbours_on_the_ground_follow_each_other():
    """53 revolutions, each 0.3 degrees west of the one before, low on the way north and high on the way south."""
    step = np.arange(20_000)
    latitude = 0.8 * sin(step / 60.0)
    longitude = -step / 377.0 * radians(0.3)
    altitude_m = np.where(cos(step / 60.0) > 0.0, 14e3, 48e3)
    order = order_by_ground(np.asarray(mcmf_from_spherical(latitude, longitude, altitude_m)), CAMERA, Everywhere())
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
