"""Landmarks learned from synthetic passes whose ground catalogue lacks known craters."""

import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from pytest import approx, fixture, mark, raises

from ground_service.errors import EvaluationError, InvalidInput, NotFound, StateConflict
from ground_service.evaluation.landmarks.core import (
    Frames,
    LandmarkFix,
    combined,
    distance_m,
    is_persistent,
    places_of_pass,
    same_place,
)
from ground_service.evaluation.landmarks.model import Landmark, LandmarkFilter
from ground_service.evaluation.landmarks.service import (
    FIRST_ID,
    decide_landmark,
    extended_catalogue,
    extended_table,
    format_labels,
    get_landmark,
    list_landmarks,
    update_landmarks,
    upload_entries,
)
from ground_service.evaluation.recall import expected_craters, match_detections
from ground_service.ground import open_ground
from ground_service.missions.catalogues import add_catalogue
from ground_service.passes.archive_import import import_archive
from ground_service.telemetry.samples import DetectionSamples
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import load_catalogue, make_catalogue, save_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder
from lunar.frames import mcmf_from_spherical
from payload_emulator.training.data.landmarks import load_landmarks
from tests.ground_service.conftest import enter_files
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.tables import CatalogueTable, pack_catalogue_table, unpack_catalogue_table
from tmtc.packets.large_data import LargeDataReceiver

FRAMES = 24


@fixture(scope="module")
def thinned(make_pass):
    """An archive whose catalogue lacks every third crater; the catalogue with all craters, and the withheld ones.

    Synthetic detections leave out every fourth scored crater of a frame, whichever it is.
    """
    made = make_pass(frames=FRAMES, seed=4)
    full = load_catalogue(made.folder / "catalogue.csv")
    withheld = np.arange(len(full)) % 3 == 0
    save_catalogue(full.select(~withheld), made.folder / "catalogue.csv")
    enter_files(made.folder, pass_name="first pass")
    return made.folder, full, full.select(withheld)


def distances_m(catalogue, one):
    latitude, longitude = np.radians([one.latitude_deg, one.longitude_deg])
    turn = np.mod(longitude - catalogue.longitude_rad + np.pi, 2.0 * np.pi) - np.pi
    east = turn * np.cos(latitude)
    return MOON_RADIUS_M * np.hypot(east, latitude - catalogue.latitude_rad)


def both_passes(ground, thinned):
    """Import one archive under two names, as two passes over the same ground."""
    folder, ids = thinned[0], []
    for name in ("first pass", "second pass"):
        enter_files(folder, pass_name=name)
        ids.append(import_archive(ground, folder))
    return ids


def landmarks(ground, **terms):
    page = ground.read(list_landmarks, LandmarkFilter(limit=1000, **terms))
    assert page.total == len(page.items)
    return page.items


def test_withheld_craters_become_proposals_at_their_places(either, thinned):
    _, _, withheld = thinned
    first, second = both_passes(either, thinned)
    update = update_landmarks(either, first)
    assert update.unmatched > update.places > 30 and update.controls > 30
    assert update.proposed == 0 and update.added == update.places  # one pass is not enough
    assert {one.state for one in landmarks(either)} == {"seen"}
    # the detections of these passes are all half a pixel right and 1.25 pixels up of the craters
    assert 60.0 < update.offset_east_m < 140.0 and 170.0 < update.offset_north_m < 340.0
    update = update_landmarks(either, second)
    assert update.added == 0 and update.proposed > 30
    proposed = landmarks(either, state="proposed")
    assert len(proposed) == update.proposed
    errors = np.array([distances_m(withheld, one).min() for one in proposed])
    sigma = np.array([np.hypot(one.sigma_east_m, one.sigma_north_m) for one in proposed])
    assert np.median(errors) < 60.0
    # Both passes have the same errors: 1 / .65 of the variance that the share of persistent errors leaves, within half.
    assert 0.77 < np.mean((errors / sigma) ** 2) < 2.3
    for one in proposed:
        nearest = int(np.argmin(distances_m(withheld, one)))
        assert one.diameter_m == approx(withheld.diameter_m[nearest], rel=0.05)
        assert one.passes == 2 and one.sightings >= 4 and one.looks >= one.sightings
        assert min(one.sigma_east_m, one.sigma_north_m, one.sigma_up_m) >= 20.0


MISSION = """name = "listed"
spacecraft.id = 76
frames.orientation = "IAU WGCCRE 2009"
camera = { pointing = "nadir", width_px = 512, height_px = 512, fov_deg = 120.0 }
"""


@mark.parametrize(
    "stated, listed",
    [
        ('catalogue.sha256 = "{held}"', True),
        ('evidence.world = "real-terrain"', True),
        ('evidence.world = "procedural"', False),
    ],
)
def test_craters_of_the_full_list_are_not_proposed_where_the_catalogue_of_the_pass_lacks_them(
    thinned, tmp_path, stated, listed
):
    """The list of the mission, or on the real Moon a public one, has every second of the withheld craters."""
    folder, full, withheld = thinned
    shutil.copytree(folder, tmp_path / "pass")
    save_catalogue(full.select(~np.isin(full.ids, withheld.ids[::2])), tmp_path / "list.csv")
    with open_ground(tmp_path / "home", DataFolder(catalogue_lu=tmp_path / "list.csv")) as ground:
        held = ground.files.put_file(tmp_path / "list.csv")
        add_catalogue(ground, held, "list.csv")
        (tmp_path / "pass/mission.toml").write_text(MISSION + stated.format(held=held.sha256))
        updates = [update_landmarks(ground, one) for one in both_passes(ground, (tmp_path / "pass",))]
        proposed = landmarks(ground, state="proposed")
    assert [one.listed > 15 for one in updates] == [listed, listed]
    found = {int(distances_m(withheld, one).argmin()) % 2 for one in proposed}
    assert len(proposed) > 15 and found == ({0} if listed else {0, 1})


def test_a_place_is_in_view_of_every_frame_that_saw_it(ground, thinned, monkeypatch):
    """Also if its mean place lies just outside the image: here it always does."""
    first, _ = both_passes(ground, thinned)
    nowhere = "ground_service.evaluation.landmarks.core.in_view"
    monkeypatch.setattr(nowhere, lambda _, frames: np.zeros(len(frames.position_mcmf_m), dtype=np.bool_))
    update_landmarks(ground, first)
    found = landmarks(ground)
    assert found and all(one.looks == one.sightings > 0 for one in found)


def test_the_same_pass_from_two_processes_adds_each_landmark_once(either, thinned):
    first, _ = both_passes(either, thinned)

    with ThreadPoolExecutor(3) as pool:
        for one in [pool.submit(update_landmarks, either, first) for _ in range(3)]:
            one.result()
    found = landmarks(either)
    assert len(found) == update_landmarks(either, first).places
    assert {one.passes for one in found} == {1}


def test_only_proposed_landmarks_are_decided_and_decisions_remain(ground, thinned):
    first, second = both_passes(ground, thinned)
    update_landmarks(ground, first)
    seen = landmarks(ground)[0].id

    def decide(actor, accept=True, key=seen):
        return decide_landmark(ground, key, accept=accept, reason="a rim in all frames", actor=actor)

    with raises(StateConflict, match="proposed or rejected"):
        decide("ann")
    update_landmarks(ground, second)
    decided = decide("ann")
    assert (decided.state, decided.decided_by, decided.reason) == ("accepted", "ann", "a rim in all frames")
    with raises(StateConflict):
        decide("bob")
    update_landmarks(ground, second)
    assert get_landmark(ground, seen).state == "accepted"
    assert decide("bob", accept=False).decided_by == "bob"
    with raises(NotFound):
        decide("ann", key=99_999)


def test_a_place_that_later_frames_do_not_see_again_is_not_proposed(ground, thinned, make_pass):
    """The second pass has no detections at the withheld craters: its catalogue has them, and its frames look."""
    folder, _, _ = thinned
    enter_files(folder, pass_name="first pass")
    first = import_archive(ground, folder)
    update_landmarks(ground, first)
    before = {one.id: one.looks for one in landmarks(ground)}
    complete = make_pass(frames=FRAMES, seed=4)
    update_landmarks(ground, import_archive(ground, complete.folder))
    after = landmarks(ground)
    assert {one.state for one in after} == {"seen"} and {one.passes for one in after} == {1}
    assert all(one.looks > before[one.id] for one in after)
    blind = get_landmark(ground, after[0].id).evidence[1]
    assert blind.sightings == [] and blind.looks > 0


def test_a_pass_without_a_catalogue_is_refused_with_the_reason(ground, make_pass):
    folder = make_pass(frames=4).folder
    (folder / "catalogue.csv").unlink()
    enter_files(folder, pass_name="bare")
    with raises(EvaluationError, match="expected a crater catalogue, found none"):
        update_landmarks(ground, import_archive(ground, folder))


def _place(east_m=0.0, sigma_m=50.0, diameter_m=8000.0, looks=4):
    rows = np.arange(3)
    return LandmarkFix(0.0, east_m / MOON_RADIUS_M, 100.0, (sigma_m,) * 3, diameter_m, 200.0, 0.8, rows, looks)


def test_passes_that_agree_reduce_the_variance_not_common_to_them_and_others_enlarge_it():
    """The error of the catalogue, and the 30 % of the variance that the detector repeats on every pass."""
    common = 20.0
    place = _place(sigma_m=float(np.hypot(100.0, common)))
    for count in (1, 4, 10_000):
        left = np.sqrt(100.0**2 * (0.3 + 0.7 / count) + common**2)
        assert combined([place] * count).sigma_m[0] == approx(left)
    apart = combined([_place(-300.0), _place(300.0)])
    assert apart.longitude_rad == approx(0.0, abs=1e-12)
    assert apart.sigma_m[0] == approx(np.hypot(300.0, 20.0), rel=0.01)
    assert apart.sigma_m[1] < 50.0


@mark.parametrize(
    "passes, sightings, looks, expected", [(2, 4, 16, True), (1, 9, 9, False), (2, 3, 3, False), (2, 4, 17, False)]
)
def test_a_landmark_is_persistent_on_two_passes_in_a_quarter_of_its_frames(passes, sightings, looks, expected):
    assert is_persistent(passes, sightings, looks) is expected


def test_places_are_the_same_within_a_quarter_of_the_diameter_or_the_uncertainty():
    assert same_place(_place(), _place(1900.0))
    assert not same_place(_place(), _place(2100.0))
    assert same_place(_place(sigma_m=600.0), _place(2100.0))
    assert not same_place(_place(sigma_m=9000.0), _place(4100.0))
    assert not same_place(_place(), _place(diameter_m=12_000.0))


@mark.parametrize("error_px", [0.4, 3.0])
def test_the_uncertainty_is_that_of_the_errors_on_one_pass_and_on_three(error_px):
    """Withheld craters over a simulated track; the detector repeats 30 % of its variance on every pass."""
    rng = np.random.default_rng(7)
    grid = np.array([(a, b) for a in np.arange(-16, 17) for b in np.arange(-5, 6)]) * 0.5
    latitude, longitude = np.radians(grid + rng.uniform(-0.08, 0.08, grid.shape)).T
    sizes, heights = rng.choice([5e3, 7e3], len(grid)), rng.normal(0.0, 300.0, len(grid))
    craters = make_catalogue(latitude, longitude, sizes, source="grid", rim_height_m=heights)
    withheld = np.arange(len(grid)) % 3 == 0
    camera, frames = PinholeCamera(), 44
    along = np.radians(np.linspace(-8.0, 8.0, frames))
    own = rng.normal(0.0, np.sqrt(0.3) * error_px, (len(grid), 2))
    found = []
    for track_deg in (-0.6, 0.0, 0.6):
        position = mcmf_from_spherical(along, np.full(frames, np.radians(track_deg)), np.full(frames, 3e4))
        turned = nadir_camera_from_mcmf(position)
        seen = expected_craters(craters, camera, position, turned)
        errors = (own + rng.normal(0.0, np.sqrt(0.7) * error_px, own.shape))[seen.index]
        noise = rng.normal(0.0, 0.1 * error_px, errors.shape)
        u, v = (np.stack((seen.u_px, seen.v_px), axis=1) + errors + noise).T
        flags, number = np.ones(frames, dtype=np.bool_), np.arange(frames)
        detections = DetectionSamples(
            number, number, flags, ("good",) * frames, seen.offsets, u, v, seen.diameter_px,
            np.full(len(u), 0.8), np.zeros(len(u), dtype=np.int64),
        )  # fmt: skip
        known, declared = craters.select(~withheld), position + rng.normal(0.0, 100.0, 3)
        expected = expected_craters(known, camera, declared, turned)
        matches = match_detections(detections, expected)
        view = Frames(camera, declared, turned)
        found.append(places_of_pass(detections, expected, matches, known, view, 100.0).places)
    columns = (latitude[withheld], longitude[withheld], heights[withheld], sizes[withheld])
    squares = {1: [], 3: []}
    for a, b, height, size in zip(*columns, strict=True):
        crater = LandmarkFix(a, b, height, (0.0, 0.0, 0.0), size, 0.0, 1.0, np.zeros(0, dtype=np.int64), 0)
        some = [one for places in found for one in places if same_place(one, crater)]
        for count in squares:
            if len(some) >= count:
                place = combined(some[:count])
                squares[count].append((distance_m(crater, place) / np.hypot(*place.sigma_m[:2])) ** 2)
    for count, some in squares.items():
        assert len(some) > 50 and 0.7 < np.mean(some) < 1.4, count


def _landmark(key, state="accepted"):
    return Landmark.of(
        {
            "id": key, "spacecraft_id": 76, "state": state, "latitude_deg": 10.0 + key, "longitude_deg": 359.5,
            "height_m": -1200.4, "sigma_east_m": 80.2, "sigma_north_m": 90.0, "sigma_up_m": 300.0,
            "diameter_m": 8000.0, "diameter_sigma_m": 400.0, "passes": 2, "sightings": 5, "looks": 8, "score": 0.71,
            "decided_by": "ann", "decided_utc_ns": 0, "reason": "", "created_utc_ns": 0, "changed_utc_ns": 0,
        }
    )  # fmt: skip


def _table():
    one = np.array([0.1])
    return CatalogueTable(np.array([7]), one, one, np.array([5000.0]), np.array([10.0]), np.full((1, 3), 60.0))


def test_the_anchoring_table_gets_accepted_landmarks_once_with_their_uncertainty():
    found = [_landmark(2), _landmark(1), _landmark(3, "rejected"), _landmark(4, "proposed")]
    table = extended_table(_table(), found)
    assert table.ids.tolist() == [7, FIRST_ID + 1, FIRST_ID + 2]
    back = unpack_catalogue_table(pack_catalogue_table(table))
    assert back.sigma_m[1].tolist() == [80.5, 90.0, 300.0]  # rounded upwards
    assert back.rim_height_m[1] == approx(-1200.5, abs=0.5)
    assert len(extended_table(table, found)) == 3
    with raises(InvalidInput, match="expected accepted landmarks, found none among 1"):
        extended_table(_table(), [_landmark(3, "rejected")])


def test_the_catalogue_gets_accepted_landmarks(tmp_path):
    path = tmp_path / "old.csv"
    path.write_text("id,latitude_deg,longitude_deg,diameter_m,rim_height_m,depth_m,complete\n5,1,2,6000,10,300,1\n")
    base = load_catalogue(path)
    extended = extended_catalogue(base, [_landmark(1), _landmark(2, "seen")])
    save_catalogue(extended, tmp_path / "new.csv")
    again = load_catalogue(tmp_path / "new.csv")
    assert again.ids.tolist() == [5, FIRST_ID + 1]
    assert np.degrees(again.latitude_rad[1]) == approx(11.0)
    assert np.isnan(again.depth_m[1]) and again.complete.all()


def test_labels_are_what_training_reads(tmp_path):
    (tmp_path / "labels.csv").write_text(format_labels([_landmark(1), _landmark(2, "rejected")]))
    with raises(InvalidInput, match="expected accepted landmarks, found none among 1"):
        format_labels([_landmark(2, "rejected")])
    labels = load_landmarks(tmp_path / "labels.csv")
    assert np.degrees(labels.latitude_rad).tolist() == [11.0]
    assert labels.diameter_m.tolist() == [8000.0]
    assert (labels.sightings[0], labels.looks[0], labels.score[0]) == (5, 8, 0.71)


def test_an_upload_puts_the_table_together_again_on_board():
    assert [name for name, _ in upload_entries(pack_catalogue_table(_table()), 3)] == ["uplink_last"]
    octets = bytes(range(256)) * 150
    receiver, names = LargeDataReceiver(), []
    for count, entry in enumerate(upload_entries(octets, 3)):
        command = DICTIONARY.unpack_command(DICTIONARY.pack_command(*entry, sequence_count=count))
        names.append(command.name)
        whole = receiver.accept(command.name, command.values)
    assert names == ["uplink_first", "uplink_middle", "uplink_last"]
    assert whole.octets == octets and whole.transaction == 3
