"""Images of the payload: downlinked thumbnails, and full frames that came with pass archives."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from ground_service.errors import InvalidInput, NotFound
from ground_service.ground import Ground
from ground_service.missions import store as missions
from ground_service.missions.timekeeping.core import utc_ns_of_ticks
from ground_service.passes import sample_store, store
from ground_service.passes.model import Image
from ground_service.passes.span import PassSpan, pass_span, vehicle_span
from ground_service.store.vehicles import find_vehicle
from lunar.arrays import FloatArray
from lunar.timescales import TICKS_PER_SECOND
from tmtc.dictionary.payload import APID_LARGE_DATA, DICTIONARY
from tmtc.errors import ValueRefused
from tmtc.packets.large_data import LargeDataReceiver
from tmtc.packets.stream import cut_packets
from tmtc.packets.thumbnails import Thumbnail, unpack_thumbnail

IMAGES_LIMIT = 2000
"""Largest number of images in a list; the newest of an interval are listed."""

ORANGE_BGR = (0, 159, 230)

DRAWN_PX = 512
"""Least width of a thumbnail with detections: circles of a few pixels show nothing."""

FRAME_MARGIN_S = 1
"""A frame and the report of its detections have times that differ by less."""

DAY_NS = 86_400_000_000_000
DAYS_LIMIT = 31
DELAY_NS = DAY_NS
"""Thumbnails are looked for in packets up to a day later than their frame."""

THUMBNAIL = {name: code for code, name in DICTIONARY.labels("large_data_last", "table").items()}["thumbnail"]


def list_images(
    ground: Ground, spacecraft_id: int, instance: str, start_utc_ns: int, stop_utc_ns: int
) -> list[Image]:
    """Return the images of a spacecraft in an interval, in time order; of more than `IMAGES_LIMIT` the newest.

    Raises
    ------
    NotFound
        There is no such spacecraft.
    InvalidInput
        The interval is longer than `DAYS_LIMIT`.
    """
    if stop_utc_ns - start_utc_ns > DAYS_LIMIT * DAY_NS:
        found_days = f"{(stop_utc_ns - start_utc_ns) / DAY_NS:.0f} days"
        raise InvalidInput("images", "stop", f"at most {DAYS_LIMIT} days after start", found_days)
    with ground.database.reading() as connection:
        vehicle = find_vehicle(connection, spacecraft_id, instance).id
        found = [
            *_archived(connection, vehicle, start_utc_ns, stop_utc_ns),
            *_downlinked(connection, vehicle, spacecraft_id, instance, start_utc_ns, stop_utc_ns),
        ]
    inside = [one for one in found if start_utc_ns <= one.time.utc_ns <= stop_utc_ns]
    return sorted(inside, key=lambda one: (one.time.utc_ns, one.source, one.frame_number))[-IMAGES_LIMIT:]


def archived_image(ground: Ground, pass_id: int, frame_number: int, *, detections: bool = False) -> bytes:
    """Return a full frame of a pass archive as PNG, with circles around the detections of the payload if required.

    Raises
    ------
    NotFound
        There is no such pass, or its archive has no such frame.
    InvalidInput
        Detections cannot be drawn because the archived file is no image.
    """
    with ground.database.reading() as connection:
        record = store.get_pass(connection, pass_id)
        sha256 = store.frame_files(connection, pass_id).get(frame_number)
        found = _circles(connection, pass_span(connection, record), frame_number) if detections else None
    if sha256 is None:
        raise NotFound(f"pass {pass_id}: image of frame", frame_number)
    octets = ground.files.get(sha256)
    if found is None:
        return octets
    import cv2

    picture = cv2.imdecode(np.frombuffer(octets, dtype=np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise InvalidInput("archived image", "", "a PNG image", "another file")
    return _drawn(picture, found)


def _circles(connection: Connection, span: PassSpan, frame_number: int) -> FloatArray:
    """Return the detections of a frame (n, 3): u, v and diameter in pixels."""
    samples = sample_store.detection_samples(connection, span)
    rows = [
        np.arange(samples.offsets[k], samples.offsets[k + 1])
        for k in np.flatnonzero(samples.frame_number == frame_number)
    ]
    chosen = np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)
    circles: FloatArray = np.column_stack([samples.u_px, samples.v_px, samples.diameter_px])[chosen]
    return circles


def _drawn(picture: NDArray[np.uint8], circles: FloatArray) -> bytes:
    import cv2

    for u_px, v_px, diameter_px in circles.tolist():
        cv2.circle(picture, (round(u_px), round(v_px)), max(round(diameter_px / 2.0), 1), ORANGE_BGR, 1)
    _, drawn = cv2.imencode(".png", picture)
    return drawn.tobytes()


def thumbnail_image(
    ground: Ground, spacecraft_id: int, instance: str, ticks: int, *, detections: bool = False
) -> bytes:
    """Return the thumbnail of the frame with an on-board time as PNG.

    With `detections` it is enlarged to at least `DRAWN_PX`, with circles around the detections of the payload.

    Raises
    ------
    NotFound
        There is no such spacecraft, or no such thumbnail was received completely.
    InvalidInput
        Detections cannot be drawn because the mission description does not state the width of the camera.
    """
    import cv2

    with ground.database.reading() as connection:
        vehicle = find_vehicle(connection, spacecraft_id, instance).id
        time_ns = int(vehicle_span(connection, vehicle, None, None).utc_ns([ticks])[0])
        span = vehicle_span(connection, vehicle, time_ns, time_ns + DELAY_NS)
        found = next((one for one in _thumbnails(connection, span) if one.ticks == ticks), None)
        if found is None:
            raise NotFound("thumbnail", ticks)
        if detections:
            width_px = _camera_width_px(connection, vehicle)
            if width_px is None:
                raise InvalidInput("detections", "camera.width_px", "a stated value", "not stated")
            margin_ns = FRAME_MARGIN_S * 1_000_000_000
            span = vehicle_span(connection, vehicle, time_ns - margin_ns, time_ns + margin_ns)
            return _enlarged(found, _circles(connection, span, found.frame_number), width_px)
    _, octets = cv2.imencode(".png", found.levels)
    return octets.tobytes()


def _enlarged(thumbnail: Thumbnail, circles: FloatArray, width_px: int) -> bytes:
    """Return a thumbnail with squares as pixels, and circles given in pixels of the whole image."""
    import cv2

    columns = thumbnail.levels.shape[1]
    factor = max(-(-DRAWN_PX // columns), 1)
    picture = cv2.cvtColor(np.kron(thumbnail.levels, np.ones((factor, factor), np.uint8)), cv2.COLOR_GRAY2BGR)
    # Pixels of the thumbnail are means of whole squares; what is left over at the edge is missing.
    scale = factor / max(width_px // columns, 1)
    drawn = np.column_stack([(circles[:, :2] + 0.5) * scale - 0.5, circles[:, 2] * scale])
    return _drawn(picture, drawn)


def _camera_width_px(connection: Connection, vehicle: int) -> int | None:
    mission = missions.mission_of_vehicle(connection, vehicle)
    return None if mission is None else mission.camera.width_px


def _archived(connection: Connection, vehicle: int, start_utc_ns: int, stop_utc_ns: int) -> Iterator[Image]:
    for record in store.passes_with_images(connection, vehicle, start_utc_ns, stop_utc_ns):
        span = pass_span(connection, record)
        rows = sample_store.samples(connection, span, "detections", ("frame_number", "ticks"))
        ticks = dict(zip(rows["frame_number"], rows["ticks"], strict=True))
        numbers = [number for number in store.frame_files(connection, record.id) if number in ticks]
        for number, time_ns in zip(
            numbers, span.utc_ns([ticks[number] for number in numbers]).tolist(), strict=True
        ):
            address = f"/api/v1/passes/{record.id}/images/{number}"
            yield Image.of(
                {},
                frame_number=number,
                time=time_ns,
                source="archive",
                pass_id=record.id,
                address=address,
                overlay=f"{address}?detections=true",
            )


def _downlinked(
    connection: Connection,
    vehicle: int,
    spacecraft_id: int,
    instance: str,
    start_utc_ns: int,
    stop_utc_ns: int,
) -> Iterator[Image]:
    span = vehicle_span(connection, vehicle, start_utc_ns, stop_utc_ns + DELAY_NS)
    rows = sample_store.samples(connection, span, "detections", ("frame_number", "ticks"))
    reported = np.array([rows["frame_number"], rows["ticks"]], dtype=np.int64)
    drawable = _camera_width_px(connection, vehicle) is not None
    for one in {found.ticks: found for found in _thumbnails(connection, span)}.values():
        time_ns = int(utc_ns_of_ticks(np.array([one.ticks]), span.correlations)[0][0])
        address = f"/api/v1/spacecraft/{spacecraft_id}/thumbnails/{one.ticks}?instance={instance}"
        of_frame = reported[1, reported[0] == one.frame_number]
        known = drawable and bool((np.abs(of_frame - one.ticks) <= FRAME_MARGIN_S * TICKS_PER_SECOND).any())
        yield Image.of(
            {},
            frame_number=one.frame_number,
            time=time_ns,
            source="thumbnail",
            pass_id=None,
            address=address,
            overlay=f"{address}&detections=true" if known else None,
        )


def _thumbnails(connection: Connection, span: PassSpan) -> Iterator[Thumbnail]:
    """Yield the thumbnails that were received completely in a span."""
    receiver = LargeDataReceiver()
    octets = sample_store.packet_octets(connection, span, APID_LARGE_DATA)
    cut = cut_packets(octets)
    for start, length in zip(cut.offsets.tolist(), cut.lengths.tolist(), strict=True):
        name, values = DICTIONARY.unpack(octets[start : start + length])
        whole = receiver.accept(name, values) if name.startswith("large_data_") else None
        if whole is not None and whole.table == THUMBNAIL:
            try:
                found = unpack_thumbnail(whole.octets)
            except ValueRefused:
                continue  # the parts of two transfers with one number
            if found.levels.size:
                yield found
