"""Fixes repeated from single frames, and told right from wrong, on exact projections."""

import numpy as np
import pytest

from ground_service.evaluation.detection.fixes import (
    IdentificationSamples,
    Pairs,
    join_pairs,
    snapshot_positions,
    wrong_fixes,
)
from ground_service.passes.samples import DetectionSamples
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import make_catalogue
from lunar.frames import mcmf_from_spherical

CAMERA = PinholeCamera()
POSITION = mcmf_from_spherical(np.radians([20.0, 21.0]), np.radians([40.0, 40.5]), np.array([30e3, 31e3]))
UTC_NS = np.array([1000, 2000], dtype=np.int64)


def craters(seed: int = 2) -> np.ndarray:
    rng = np.random.default_rng(seed)
    places = np.radians(rng.uniform([19.8, 39.7], [21.2, 40.8], (8, 2)))
    return mcmf_from_spherical(places[:, 0], places[:, 1], rng.uniform(-800.0, 800.0, 8))


def pairs(noise_px: float = 0.0, seed: int = 3) -> Pairs:
    """Eight craters seen in both of two frames."""
    rng = np.random.default_rng(seed)
    uv = [
        CAMERA.project((craters() - place) @ nadir_camera_from_mcmf(place).T)
        + rng.normal(0.0, noise_px, (8, 2))
        for place in POSITION
    ]
    frame = np.repeat([0, 1], 8)
    return Pairs(frame, UTC_NS[frame], np.concatenate(uv), np.full(16, 40.0), np.tile(craters(), (2, 1)))


def test_a_frame_gives_its_position_back_from_a_start_kilometres_off() -> None:
    start = POSITION + np.array([[1500.0, -900.0, 700.0], [-400.0, 2500.0, 100.0]])
    solved = snapshot_positions(pairs(), CAMERA, UTC_NS, start)
    # exact projections: the residue is that of the last step, a centimetre at most
    assert np.abs(solved - POSITION).max() < 0.02


def test_noise_of_a_pixel_moves_it_by_hundreds_of_metres_at_most() -> None:
    solved = snapshot_positions(pairs(noise_px=1.0), CAMERA, UTC_NS, POSITION + 500.0)
    error = np.linalg.norm(solved - POSITION, axis=1)
    # a pixel is 203 m at nadir from 30 km (design figure); eight craters halve it, the geometry may triple it
    assert np.all((error > 1.0) & (error < 1000.0))


def test_too_few_craters_give_no_position() -> None:
    few = pairs()
    keep = np.array([0, 1, 8, 9, 10])
    few = Pairs(
        *(getattr(few, name)[keep] for name in ("frame", "utc_ns", "uv_px", "diameter_px", "crater_mcmf_m"))
    )
    solved = snapshot_positions(few, CAMERA, UTC_NS, POSITION)
    assert np.isnan(solved[0]).all()
    assert np.isfinite(solved[1]).all()


@pytest.mark.parametrize(("swapped", "expected"), [(0, 0), (3, 0), (4, 1), (8, 1)])
def test_a_fix_is_wrong_when_half_of_its_identifications_are(swapped: int, expected: int) -> None:
    found = pairs()
    moved = found.uv_px.copy()
    moved[:swapped] += 30.0
    found = Pairs(found.frame, found.utc_ns, moved, found.diameter_px, found.crater_mcmf_m)
    assert wrong_fixes(found, CAMERA, UTC_NS, POSITION) == expected


@pytest.mark.parametrize("frame", [0, 1])
def test_a_wrong_fix_counts_in_whichever_frame_it_is(frame: int) -> None:
    found = pairs()
    moved = found.uv_px + np.where(found.frame == frame, 30.0, 0.0)[:, None]
    found = Pairs(found.frame, found.utc_ns, moved, found.diameter_px, found.crater_mcmf_m)
    assert wrong_fixes(found, CAMERA, UTC_NS, POSITION) == 1
    # A frame at whose time there is no reference is neither right nor wrong.
    other = 1 - frame
    assert wrong_fixes(found, CAMERA, UTC_NS[[other]], POSITION[[other]]) == 0
    lost = POSITION.copy()
    lost[frame] = np.nan
    assert wrong_fixes(found, CAMERA, UTC_NS, lost) == 0


@pytest.mark.parametrize(
    ("offset_px", "diameter_px", "wrong"), [(4.9, 20.0, 0), (5.1, 20.0, 1), (9.9, 100.0, 0), (10.1, 100.0, 1)]
)
def test_an_identification_is_right_within_half_a_radius_and_ten_pixels(
    offset_px: float, diameter_px: float, wrong: int
) -> None:
    found = pairs()
    moved = found.uv_px + np.array([offset_px, 0.0]) * (found.frame == 0)[:, None]
    found = Pairs(found.frame, found.utc_ns, moved, np.full(16, diameter_px), found.crater_mcmf_m)
    assert wrong_fixes(found, CAMERA, UTC_NS, POSITION) == wrong


def test_without_times_or_pairs_no_fix_is_wrong() -> None:
    assert wrong_fixes(pairs(), CAMERA, UTC_NS[:0], POSITION[:0]) == 0
    none = Pairs(*(getattr(pairs(), name)[:0] for name in Pairs.__slots__))
    assert wrong_fixes(none, CAMERA, UTC_NS, POSITION) == 0


def test_identifications_are_joined_by_time_place_and_number() -> None:
    latitude, heights = np.radians([10.0, 11.0, 12.0, 13.0]), [0.0, 0.0, 0.0, np.nan]
    catalogue = make_catalogue(latitude, np.zeros(4), np.full(4, 5e3), source="test", rim_height_m=heights)
    detections = DetectionSamples(
        frame_number=np.array([0, 1]),
        utc_ns=UTC_NS,
        usable=np.ones(2, dtype=np.bool_),
        quality=("ok", "ok"),
        offsets=np.array([0, 2, 3]),
        u_px=np.array([1.0, 2.0, 3.0]),
        v_px=np.array([4.0, 5.0, 6.0]),
        diameter_px=np.array([7.0, 8.0, 9.0]),
        score=np.ones(3),
        size_class=np.zeros(3, dtype=np.int64),
    )
    ids = catalogue.ids
    found = IdentificationSamples(
        utc_ns=np.array([1000, 2000, 2000, 1500, 1000, 1000]),
        detection=np.array(
            [1, 0, 1, 0, 0, 0]
        ),  # the third names a detection that is not there, the fourth a time
        # the last two a crater that is not there, and one of unknown height
        crater_id=np.array([ids[2], ids[0], ids[1], ids[1], 10**6, ids[3]]),
    )
    joined = join_pairs(found, detections, catalogue)
    assert joined.frame.tolist() == [0, 1]
    assert joined.uv_px.tolist() == [[2.0, 5.0], [3.0, 6.0]]
    assert np.array_equal(joined.crater_mcmf_m, catalogue.position_mcmf_m[[2, 0]])
