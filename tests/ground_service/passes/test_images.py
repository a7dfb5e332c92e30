"""Images of a spacecraft: downlinked thumbnails and frames of pass archives, on spacecraft time."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from ground_service.errors import InvalidInput, NotFound
from ground_service.ground import Ground
from ground_service.http.model import Paging
from ground_service.ingest.service import ingest_file
from ground_service.missions.service import add_mission
from ground_service.passes import images, store
from ground_service.passes.archive_import import import_archive
from ground_service.passes.live import list_spacecraft
from ground_service.passes.parameters import spacecraft_parameters
from ground_service.passes.service import detections, trend_series
from ground_service.store.stored_files import register_file
from lunar.timescales import parse_utc, ticks_from_utc_ns
from tests.ground_service.conftest import NS, SPACECRAFT, SyntheticPass, encode_downlink
from tmtc.dictionary.payload import DICTIONARY
from tmtc.packets.large_data import split
from tmtc.packets.thumbnails import Thumbnail, pack_thumbnail

START = parse_utc("2029-08-07T06:00:00Z")
TICKS = int(ticks_from_utc_ns(START))
SECOND = 1 << 16
HOUR_NS = 3600 * NS


def thumbnail(frame_number: int, ticks: int) -> tuple[Thumbnail, bytes]:
    levels = np.random.default_rng(frame_number).integers(0, 256, (8, 12), dtype=np.uint8)
    made = Thumbnail(frame_number, ticks, levels)
    return made, pack_thumbnail(made)


def large_data(octets: bytes, transaction: int, ticks: int, table: str = "thumbnail") -> list[bytes]:
    """Packets of a transfer; their sequence counts continue those of earlier transfers."""
    parts = split(octets, transaction=transaction, table=table, part_length=50)
    return [
        DICTIONARY.pack(name, values, ticks=ticks + k, sequence_count=100 * transaction + k)
        for k, (name, values) in enumerate(parts)
    ]


def receive(ground: Ground, folder: Path, packets: list[bytes]) -> None:
    file = folder / "downlink.cadu"
    file.write_bytes(encode_downlink(packets))
    ingest_file(ground, file, spacecraft_id=SPACECRAFT)


def test_complete_thumbnails_are_listed_at_the_time_of_their_frame(ground: Ground, tmp_path: Path) -> None:
    first, octets = thumbnail(1, TICKS)
    second, others = thumbnail(2, TICKS + 15 * SECOND)
    _, incomplete = thumbnail(3, TICKS + 30 * SECOND)
    later = TICKS + 600 * SECOND
    receive(
        ground,
        tmp_path,
        [
            *large_data(octets, 1, later),
            *large_data(thumbnail(9, TICKS + SECOND)[1], 2, later + 100, table="landmark_map"),
            *large_data(others, 3, later + 200),
            *large_data(incomplete, 4, later + 300)[:-1],
        ],
    )
    found = images.list_images(ground, SPACECRAFT, "flight", START, START + HOUR_NS)
    assert [(one.frame_number, one.time.utc_ns, one.source) for one in found] == [
        (1, START, "thumbnail"),
        (2, START + 15 * NS, "thumbnail"),
    ]
    assert images.list_images(ground, SPACECRAFT, "flight", START + NS, START + HOUR_NS) == found[1:]
    for one, levels in ((found[0], first.levels), (found[1], second.levels)):
        ticks = int(one.address.split("/thumbnails/")[1].split("?")[0])
        png = images.thumbnail_image(ground, SPACECRAFT, "flight", ticks)
        decoded = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(decoded, levels)
    with pytest.raises(NotFound):
        images.thumbnail_image(ground, SPACECRAFT, "flight", TICKS + 30 * SECOND)
    with pytest.raises(InvalidInput, match="at most 31 days"):
        images.list_images(ground, SPACECRAFT, "flight", START, START + 32 * 24 * HOUR_NS)


def test_frames_of_an_archive_are_listed_and_read(ground: Ground, synthetic_pass: SyntheticPass) -> None:
    pass_id = import_archive(ground, synthetic_pass.folder)
    _, png = cv2.imencode(".png", np.full((1024, 1024), 77, np.uint8))
    stored = ground.files.put_octets(png.tobytes())
    with ground.database.writing() as connection:
        register_file(connection, stored, "frame", "3.png", START)
        store.add_frames(connection, pass_id, {3: stored.sha256})
        record = store.get_pass(connection, pass_id)
    (vehicle,) = {one.instance for one in list_spacecraft(ground)}
    (found,) = images.list_images(ground, SPACECRAFT, vehicle, record.start_utc_ns, record.stop_utc_ns)
    assert (found.frame_number, found.source, found.pass_id) == (3, "archive", pass_id)
    assert record.start_utc_ns < found.time.utc_ns < record.stop_utc_ns
    assert found.address == f"/api/v1/passes/{pass_id}/images/3"
    assert found.overlay == f"{found.address}?detections=true"
    assert images.archived_image(ground, pass_id, 3) == png.tobytes()
    items = detections(ground, pass_id, Paging(limit=1000)).items
    own = [one for one in items if one.frame_number == 3]
    drawn = images.archived_image(ground, pass_id, 3, detections=True)
    picture = cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR)
    assert own and set(map(tuple, picture.reshape(-1, 3).tolist())) == {(77, 77, 77), images.ORANGE_BGR}
    for one in own:
        rim = (round(one.v_px), round(one.u_px) + max(round(one.diameter_px / 2), 1))
        if max(rim) < 1024:
            assert tuple(picture[rim].tolist()) == images.ORANGE_BGR
    with pytest.raises(NotFound, match="image of frame"):
        images.archived_image(ground, pass_id, 4)


MISSION = 'name = "camera"\n[spacecraft]\nid = 76\n[camera]\nwidth_px = 96\nheight_px = 64\n'


def detection(frame_number: int, ticks: int, count: int = 1) -> bytes:
    """A report with detections at u = 55.5 and v = 31.5, with a diameter of 16 pixels."""
    shape = {"u_px": 55.5, "v_px": 31.5, "diameter_px": 16.0, "score": 0.9, "size_class": 0, "sigma_px": 1.0}
    items = {name: np.full(count, value) for name, value in shape.items()}
    frame = {"frame_number": frame_number, "image_ticks": ticks, "image_quality": 0, "items": items}
    return DICTIONARY.pack("detections", frame, ticks=ticks + 100, sequence_count=frame_number)


def test_detections_are_drawn_on_an_enlarged_thumbnail_of_a_known_camera(
    ground: Ground, tmp_path: Path
) -> None:
    made, octets = thumbnail(1, TICKS)  # 12 by 8: one pixel for 8 by 8 of the camera
    later = TICKS + 600 * SECOND
    others = large_data(thumbnail(2, TICKS + 15 * SECOND)[1], 2, later + 200)
    # A report of the same frame number from another time belongs to another frame.
    reports = [detection(1, TICKS), detection(2, TICKS + 40 * SECOND)]
    receive(ground, tmp_path, [*reports, *large_data(octets, 1, later), *others])
    found = images.list_images(ground, SPACECRAFT, "flight", START, START + HOUR_NS)
    assert [one.overlay for one in found] == [None, None]
    with pytest.raises(InvalidInput, match=r"camera\.width_px"):
        images.thumbnail_image(ground, SPACECRAFT, "flight", TICKS, detections=True)
    add_mission(ground, MISSION.encode(), actor="ann")
    found = images.list_images(ground, SPACECRAFT, "flight", START, START + HOUR_NS)
    assert [one.overlay for one in found] == [f"{found[0].address}&detections=true", None]
    png = images.thumbnail_image(ground, SPACECRAFT, "flight", TICKS, detections=True)
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (8 * 43, 12 * 43, 3)  # at least 512 wide
    rim = np.argwhere((picture == images.ORANGE_BGR).all(axis=2))
    scale = 43 / 8
    np.testing.assert_allclose(rim.mean(axis=0)[::-1], [56.0 * scale - 0.5, 32.0 * scale - 0.5], atol=1.0)
    np.testing.assert_allclose(np.ptp(rim, axis=0) + 1, 16.0 * scale, atol=2.0)
    grey = picture[::43, ::43, 0]
    np.testing.assert_array_equal(grey[:2], made.levels[:2])  # far from the circle


def test_a_thumbnail_of_a_dark_frame_is_enlarged_without_circles(ground: Ground, tmp_path: Path) -> None:
    add_mission(ground, MISSION.encode(), actor="ann")
    made, octets = thumbnail(1, TICKS)
    receive(ground, tmp_path, [detection(1, TICKS, count=0), *large_data(octets, 1, TICKS + SECOND)])
    (found,) = images.list_images(ground, SPACECRAFT, "flight", START, START + HOUR_NS)
    assert found.overlay
    png = images.thumbnail_image(ground, SPACECRAFT, "flight", TICKS, detections=True)
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(picture[::43, ::43, 0], made.levels)


def test_states_of_each_estimator_are_parameters_of_the_spacecraft(
    ground: Ground, synthetic_pass: SyntheticPass
) -> None:
    import_archive(ground, synthetic_pass.folder)
    (one,) = list_spacecraft(ground)
    listed = {found.name: found for found in spacecraft_parameters(ground, SPACECRAFT, one.instance)}
    name = "navigation_state.spherical.altitude_m"
    assert listed[name].unit == "m" and listed["temperature_c"].packet == "housekeeping"
    assert listed["navigation_state.spherical.velocity_x_m_s"].unit == "m/s"
    found = trend_series(ground, SPACECRAFT, one.instance, name, 1000)
    assert found.samples == 40 and 20e3 < found.buckets.mean.min() < 40e3
    none = trend_series(ground, SPACECRAFT, one.instance, "navigation_state.anchored.altitude_m", 1000)
    assert none.samples == 0
    with pytest.raises(NotFound):
        spacecraft_parameters(ground, SPACECRAFT, "flight")
