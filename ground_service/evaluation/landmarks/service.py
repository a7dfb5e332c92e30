"""Use cases and documents of landmarks: those of a pass, decisions of persons, images of the sightings."""

import csv
import io
import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from sqlalchemy import Connection, delete, func, select

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.contacts.commanding.store import sent_parts
from ground_service.errors import EvaluationError, InvalidInput, NotFound
from ground_service.evaluation.alignment import reference_states
from ground_service.evaluation.core import PassInputs
from ground_service.evaluation.inputs import load_pass_inputs
from ground_service.evaluation.landmarks import core
from ground_service.evaluation.landmarks.model import (
    Landmark,
    LandmarkDetail,
    LandmarkFilter,
    LandmarkUpdate,
    PassSightings,
    Sighting,
)
from ground_service.evaluation.recall import expected_craters, match_detections
from ground_service.ground import Ground
from ground_service.http.model import PageOf, UtcTime
from ground_service.missions.catalogues import listed_craters
from ground_service.missions.service import mission_of_pass
from ground_service.passes import store as passes
from ground_service.passes.archive_import import list_images
from ground_service.passes.sample_store import sample_arrays
from ground_service.passes.span import pass_span
from ground_service.store import repository
from ground_service.store.event_kinds import LandmarkChanged, publish
from ground_service.store.files import files_beginning
from ground_service.store.states import LANDMARK, change_if, move
from ground_service.store.vehicles import get_vehicle, lock_spacecraft
from ground_service.telemetry.samples import DetectionSamples
from lunar.arrays import FloatArray
from lunar.catalogue import CraterCatalogue, make_catalogue
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.tables import CatalogueTable, table_hash, unpack_catalogue_table
from tmtc.errors import TmtcError
from tmtc.packets.large_data import LargeDataReceiver, split
from tmtc.packets.space_packets import TYPE_TELECOMMAND
from tmtc.packets.stream import cut_packets

_LANDMARKS, _VEHICLES = repository.LANDMARKS, repository.VEHICLES


def lock_landmarks(connection: Connection, spacecraft_id: int) -> None:
    """Keep other processes from changing the landmarks of a spacecraft until the transaction ends."""
    query = select(func.min(_VEHICLES.c.id)).where(_VEHICLES.c.ccsds_id == spacecraft_id)
    lock_spacecraft(connection, int(connection.execute(query).scalar_one()))


def landmarks_of_spacecraft(connection: Connection, spacecraft_id: int) -> list[LandmarkDetail]:
    """Return all landmarks of a spacecraft with their sightings, in the order in which they were found."""
    query = select(_LANDMARKS).where(_LANDMARKS.c.spacecraft_id == spacecraft_id).order_by(_LANDMARKS.c.id)
    return [LandmarkDetail.of(row) for row in connection.execute(query).mappings()]


def select_landmark(connection: Connection, landmark_id: int) -> LandmarkDetail:
    """Return a landmark with its sightings."""
    return LandmarkDetail.of(repository.get(connection, _LANDMARKS, landmark_id, "landmark"))


def list_landmarks(connection: Connection, asked: LandmarkFilter) -> PageOf[Landmark]:
    """List the landmarks learned from flight, most passes first."""
    query = select(*(one for one in _LANDMARKS.c if one.name != "evidence"))
    order = (_LANDMARKS.c.passes.desc(), _LANDMARKS.c.sightings.desc(), _LANDMARKS.c.id)
    rows, total = repository.page(connection, query, asked, *order)
    return asked.page(map(Landmark.of, rows), total)


def add_landmark(
    connection: Connection,
    spacecraft_id: int,
    state: str,
    evidence: Sequence[PassSightings],
    now_utc_ns: int,
    **figures: Any,
) -> int:
    values = {"created_utc_ns": now_utc_ns, "changed_utc_ns": now_utc_ns, **figures}
    key = repository.add(
        connection, _LANDMARKS, spacecraft_id=spacecraft_id, state=state, evidence=_rows(evidence), **values
    )
    return int(key)


def change_landmark(
    connection: Connection,
    landmark_id: int,
    found: str,
    state: str,
    evidence: Sequence[PassSightings],
    now_utc_ns: int,
    **figures: Any,
) -> None:
    """Replace the sightings of a landmark; one that was decided since it was found in a state stays decided."""
    values = {"evidence": _rows(evidence), "changed_utc_ns": now_utc_ns, **figures}
    if not change_if(connection, _LANDMARKS, landmark_id, {"state": found}, state=state, **values):
        repository.change(connection, _LANDMARKS, landmark_id, **values)


def delete_landmark(connection: Connection, landmark_id: int) -> None:
    """Delete a landmark without sightings."""
    connection.execute(delete(_LANDMARKS).where(_LANDMARKS.c.id == landmark_id))


def set_decision(
    connection: Connection, landmark_id: int, state: str, *, actor: str, reason: str, now_utc_ns: int
) -> None:
    """Accept or reject a landmark.

    Raises
    ------
    StateConflict
        It is not proposed, or decided in the same way already.
    """
    move(
        connection,
        LANDMARK,
        landmark_id,
        state,
        decided_by=actor,
        decided_utc_ns=now_utc_ns,
        reason=reason,
        changed_utc_ns=now_utc_ns,
    )


def count_proposed(connection: Connection, spacecraft_id: int) -> int:
    """Return the number of landmarks that wait for a decision."""
    query = select(func.count()).where(_LANDMARKS.c.spacecraft_id == spacecraft_id, _LANDMARKS.c.state == "proposed")
    return int(connection.execute(query).scalar_one())


def _rows(evidence: Sequence[PassSightings]) -> list[dict[str, Any]]:
    return [one.model_dump(mode="json") for one in evidence]


DECIDED = ("accepted", "rejected")


def update_landmarks(ground: Ground, pass_id: int) -> LandmarkUpdate:
    """Bring the landmarks up to date with a pass; what the pass said before is replaced.

    Raises
    ------
    EvaluationError
        The pass lacks its reference, its crater catalogue or detections.
    """
    inputs = load_pass_inputs(ground, pass_id)
    found, frames = _places(inputs)
    with ground.database.reading() as connection:
        record = passes.get_pass(connection, pass_id)
        mission = mission_of_pass(connection, record.mission_id, record.manifest)
    lists = listed_craters(ground, mission)
    new = tuple(one for one in found.places if not any(core.is_listed(one, catalogue) for catalogue in lists))
    listed = len(found.places) - len(new)
    found = replace(found, places=new)
    with ground.database.writing() as connection:
        spacecraft = get_vehicle(connection, record.vehicle_id).ccsds_id
        lock_landmarks(connection, spacecraft)
        added = _entered(connection, spacecraft, pass_id, found, frames, inputs.detections)
        proposed = count_proposed(connection, spacecraft)
        publish(connection, LandmarkChanged(spacecraft_id=spacecraft, pass_id=pass_id, proposed=proposed))
    east, north, _ = found.offset_m
    return LandmarkUpdate(
        pass_id=pass_id,
        detections=len(inputs.detections.u_px),
        unmatched=found.unmatched,
        places=len(found.places),
        listed=listed,
        controls=found.controls,
        offset_east_m=east if math.isfinite(east) else None,
        offset_north_m=north if math.isfinite(north) else None,
        added=added,
        proposed=proposed,
    )


def get_landmark(ground: Ground, landmark_id: int) -> LandmarkDetail:
    """Return a landmark with its sightings and the addresses of their images."""
    with ground.database.reading() as connection:
        landmark = select_landmark(connection, landmark_id)
    return landmark.model_copy(update={"evidence": [_with_images(ground, one) for one in landmark.evidence]})


def decide_landmark(ground: Ground, landmark_id: int, *, accept: bool, reason: str, actor: str) -> LandmarkDetail:
    """Accept or reject a proposed landmark, or change the decision.

    Raises
    ------
    NotFound
        There is no such landmark.
    StateConflict
        It was not seen often enough, or is decided in this way already.
    """
    state = "accepted" if accept else "rejected"
    with ground.database.writing() as connection:
        now = utc_now_ns()
        set_decision(connection, landmark_id, state, actor=actor, reason=reason, now_utc_ns=now)
        verb = "accept" if accept else "reject"
        audit(connection, actor, f"{verb} landmark", str(landmark_id), {"reason": reason})
        decided = select_landmark(connection, landmark_id)
        proposed = count_proposed(connection, decided.spacecraft_id)
        publish(connection, LandmarkChanged(spacecraft_id=decided.spacecraft_id, pass_id=None, proposed=proposed))
    return get_landmark(ground, landmark_id)


def onboard_table(ground: Ground, pass_id: int) -> bytes:
    """Return the anchoring table that was on board at the end of a pass, of the hash that housekeeping reports.

    It is a file of an archive, or was uploaded by telecommands.

    Raises
    ------
    NotFound
        No housekeeping reports it, or the ground has no table of this hash.
    """
    with ground.database.reading() as connection:
        record = passes.get_pass(connection, pass_id)
        span = pass_span(connection, record)
        reported = sample_arrays(connection, span, "housekeeping", ("catalogue_hash",))["catalogue_hash"]
        if len(reported) == 0:
            raise NotFound("housekeeping of pass", pass_id)
        identity = f"{int(reported[-1]):08x}"
        archived = [ground.files.get(one) for one in files_beginning(connection, identity)]
        uploaded = list(uploaded_tables(sent_parts(connection, record.vehicle_id)))
    for octets in (*archived, *uploaded):
        with suppress(TmtcError):
            if f"{table_hash(octets):08x}" == identity and len(unpack_catalogue_table(octets)):
                return octets
    raise NotFound("archived or uploaded anchoring table of the reported hash", identity)


def uploaded_tables(telecommands: bytes) -> Iterator[bytes]:
    """Yield the tables that telecommand packets upload."""
    receiver, cut = LargeDataReceiver(), cut_packets(telecommands, packet_type=TYPE_TELECOMMAND)
    for start, length in zip(cut.offsets.tolist(), cut.lengths.tolist(), strict=True):
        command = DICTIONARY.unpack_command(telecommands[start : start + length])
        if command.name.startswith("uplink_") and (whole := receiver.accept(command.name, command.values)):
            yield whole.octets


def _places(inputs: PassInputs) -> tuple[core.PassPlaces, core.Frames]:
    needed = {
        "a reference ephemeris": inputs.reference,
        "a lunar orientation": inputs.orientation,
        "a crater catalogue": inputs.catalogue,
        "detections": inputs.detections if len(inputs.detections) else None,
    }
    missing = [name for name, value in needed.items() if value is None]
    if missing or inputs.catalogue is None:
        raise EvaluationError(f"landmarks of pass {inputs.pass_id}: expected {', '.join(missing)}, found none")
    detections, viewing = inputs.detections, inputs.viewing
    track = reference_states(inputs.reference, inputs.orientation, detections.utc_ns)
    rotation = viewing.camera_from_mcmf(detections.utc_ns, track.position_mcmf_m, track.mcmf_from_icrf)
    expected = expected_craters(inputs.catalogue, viewing.camera, track.position_mcmf_m, rotation)
    matches = match_detections(detections, expected)
    frames = core.Frames(viewing.camera, track.position_mcmf_m, rotation)
    sigma = inputs.reference_sigma_rtn_m or (0.0, 0.0, 0.0)
    error_m = math.hypot(sigma[1], sigma[2])
    return core.places_of_pass(detections, expected, matches, inputs.catalogue, frames, error_m), frames


def _entered(
    connection: Connection,
    spacecraft: int,
    pass_id: int,
    found: core.PassPlaces,
    frames: core.Frames,
    detections: DetectionSamples,
) -> int:
    """Replace what a pass says of the landmarks of its spacecraft; return the number of new ones."""
    now = utc_now_ns()
    left = list(found.places)
    for landmark in landmarks_of_spacecraft(connection, spacecraft):
        others = [one for one in landmark.evidence if one.pass_id != pass_id]
        near = [place for place in left if core.same_place(place, place_of(landmark))]
        evidence = list(others)
        if near:
            best = max(near, key=lambda one: (len(one.rows), one.score))
            left.remove(best)
            evidence.append(_evidence(pass_id, best, found.controls, frames, detections))
        elif others and landmark.state not in DECIDED:
            looks = int(np.count_nonzero(core.in_view(place_of(landmark), frames)))
            if looks:
                evidence.append(
                    _evidence(pass_id, _unseen(place_of(landmark), looks), found.controls, frames, detections)
                )
        if not any(one.sightings for one in evidence) and landmark.state not in DECIDED:
            delete_landmark(connection, landmark.id)
        elif evidence != landmark.evidence:
            _changed(connection, landmark, sorted(evidence, key=lambda one: one.pass_id), now)
    for place in left:
        evidence = [_evidence(pass_id, place, found.controls, frames, detections)]
        add_landmark(connection, spacecraft, "seen", evidence, now, **_figures(evidence))
    return len(left)


def _changed(connection: Connection, landmark: LandmarkDetail, evidence: Sequence[PassSightings], now: int) -> None:
    seen = [one for one in evidence if one.sightings]
    figures = _figures(evidence) if seen else {}
    state: str = landmark.state
    if state not in DECIDED:
        sightings, looks = sum(len(one.sightings) for one in seen), sum(one.looks for one in evidence)
        state = "proposed" if core.is_persistent(len(seen), sightings, looks) else "seen"
    change_landmark(connection, landmark.id, landmark.state, state, evidence, now, **figures)


def place_of(one: Landmark | PassSightings) -> core.LandmarkFix:
    """Return place and uncertainty of a landmark for computation."""
    return core.LandmarkFix(
        math.radians(one.latitude_deg),
        math.radians(one.longitude_deg),
        one.height_m,
        (one.sigma_east_m, one.sigma_north_m, one.sigma_up_m),
        one.diameter_m,
        one.diameter_sigma_m,
        one.score,
        np.arange(len(one.sightings) if isinstance(one, PassSightings) else one.sightings),
        one.looks,
    )


def _figures(evidence: Sequence[PassSightings]) -> dict[str, float]:
    """Return the columns of a landmark from its sightings on one pass or more."""
    seen = [one for one in evidence if one.sightings]
    place = core.combined([place_of(one) for one in seen])
    return {
        **_columns(place),
        "passes": len(seen),
        "sightings": sum(len(one.sightings) for one in seen),
        "looks": sum(one.looks for one in evidence),
    }


def _columns(place: core.LandmarkFix) -> dict[str, float]:
    return {
        "latitude_deg": math.degrees(place.latitude_rad),
        "longitude_deg": math.degrees(place.longitude_rad) % 360.0,
        "height_m": place.height_m,
        "sigma_east_m": place.sigma_m[0],
        "sigma_north_m": place.sigma_m[1],
        "sigma_up_m": place.sigma_m[2],
        "diameter_m": place.diameter_m,
        "diameter_sigma_m": place.diameter_sigma_m,
        "score": place.score,
    }


def _unseen(place: core.LandmarkFix, looks: int) -> core.LandmarkFix:
    nothing = np.zeros(0, dtype=np.int64)
    return core.LandmarkFix(
        place.latitude_rad, place.longitude_rad, place.height_m, place.sigma_m, place.diameter_m,
        place.diameter_sigma_m, 0.0, nothing, looks,
    )  # fmt: skip


def _evidence(
    pass_id: int, place: core.LandmarkFix, controls: int, frames: core.Frames, detections: DetectionSamples
) -> PassSightings:
    owner = np.searchsorted(detections.offsets, place.rows, side="right") - 1
    sightings = [
        Sighting(
            frame_number=int(detections.frame_number[frame]),
            time=UtcTime(int(detections.utc_ns[frame])),
            u_px=float(detections.u_px[row]),
            v_px=float(detections.v_px[row]),
            diameter_px=float(detections.diameter_px[row]),
            score=float(detections.score[row]),
        )
        for row, frame in zip(place.rows.tolist(), owner.tolist(), strict=True)
    ]
    figures = _columns(place)
    return PassSightings(
        pass_id=pass_id,
        looks=place.looks,
        controls=controls,
        frame_width_px=frames.camera.width_px,
        frame_height_px=frames.camera.height_px,
        sightings=sightings,
        **figures,
    )


def _with_images(ground: Ground, evidence: PassSightings) -> PassSightings:
    """Return the sightings with the addresses of archived frames, otherwise of thumbnails."""
    if not evidence.sightings:
        return evidence
    with ground.database.reading() as connection:
        record = passes.get_pass(connection, evidence.pass_id)
        vehicle = get_vehicle(connection, record.vehicle_id)
    images = list_images(ground, vehicle.ccsds_id, vehicle.instance, record.start_utc_ns, record.stop_utc_ns)
    address = {one.frame_number: one.address for one in images if one.source == "thumbnail"}
    address |= {one.frame_number: one.address for one in images if one.source == "archive"}
    sightings = [one.model_copy(update={"image": address.get(one.frame_number)}) for one in evidence.sightings]
    return evidence.model_copy(update={"sightings": sightings})


FIRST_ID = 2_000_000_000
"""Learned craters have identities from here on; catalogues have lower ones, the map of the payload has higher ones."""

PART_OCTETS = 16_000
LABEL_COLUMNS = ("latitude_deg", "longitude_deg", "height_m", "diameter_m", "sightings", "looks", "score")
LIMIT_SIGMA_M = 32_000.0


def extended_catalogue(catalogue: CraterCatalogue, landmarks: Sequence[Landmark]) -> CraterCatalogue:
    """Return a catalogue with the accepted landmarks; those that it has already are not added again."""
    new = _new(catalogue.ids.tolist(), landmarks)
    added = make_catalogue(
        np.radians(_column(new, "latitude_deg")),
        np.radians(_column(new, "longitude_deg")),
        _column(new, "diameter_m"),
        source=catalogue.source,
        ids=np.array([FIRST_ID + one.id for one in new], dtype=np.int64),
        rim_height_m=_column(new, "height_m"),
        complete=True,
    )
    return replace(
        catalogue,
        ids=np.concatenate([catalogue.ids, added.ids]),
        latitude_rad=np.concatenate([catalogue.latitude_rad, added.latitude_rad]),
        longitude_rad=np.concatenate([catalogue.longitude_rad, added.longitude_rad]),
        diameter_m=np.concatenate([catalogue.diameter_m, added.diameter_m]),
        rim_height_m=np.concatenate([catalogue.rim_height_m, added.rim_height_m]),
        depth_m=np.concatenate([catalogue.depth_m, added.depth_m]),
        complete=np.concatenate([catalogue.complete, added.complete]),
    )


def extended_table(table: CatalogueTable, landmarks: Sequence[Landmark]) -> CatalogueTable:
    """Return an anchoring table with the accepted landmarks and their uncertainties."""
    new = _new(table.ids.tolist(), landmarks)
    sigma = np.column_stack([_column(new, f"sigma_{axis}_m") for axis in ("east", "north", "up")])
    return CatalogueTable(
        np.concatenate([table.ids, np.array([FIRST_ID + one.id for one in new], dtype=np.int64)]),
        np.concatenate([table.latitude_rad, np.radians(_column(new, "latitude_deg"))]),
        np.concatenate([table.longitude_rad, np.radians(_column(new, "longitude_deg"))]),
        np.concatenate([table.diameter_m, _column(new, "diameter_m")]),
        np.concatenate([table.rim_height_m, _column(new, "height_m")]),
        np.concatenate([table.sigma_m, np.minimum(sigma, LIMIT_SIGMA_M)]),
    )


def format_labels(landmarks: Sequence[Landmark]) -> str:
    """Return CSV of accepted landmarks for `linna detector train --landmarks`."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(LABEL_COLUMNS)
    for one in _accepted(landmarks):
        writer.writerow(
            (
                f"{one.latitude_deg:.6f}", f"{one.longitude_deg % 360.0:.6f}", f"{one.height_m:.0f}",
                f"{one.diameter_m:.0f}", one.sightings, one.looks, f"{one.score:.3f}",
            )
        )  # fmt: skip
    return buffer.getvalue()


def upload_entries(octets: bytes, transaction: int) -> list[tuple[str, dict[str, object]]]:
    """Return names and arguments of the telecommands (PUS 13) that upload an anchoring table."""
    entries = []
    for name, values in split(
        octets, transaction=transaction, table="catalogue", part_length=PART_OCTETS, link="uplink"
    ):
        items = values["items"]
        assert isinstance(items, dict)
        entries.append((name, {**values, "items": [{"octet": octet} for octet in items["octet"].tolist()]}))
    return entries


def _accepted(landmarks: Sequence[Landmark]) -> list[Landmark]:
    """Return the accepted landmarks by their numbers; none is an error, as there is nothing to write."""
    accepted = sorted((one for one in landmarks if one.state == "accepted"), key=lambda found: found.id)
    if not accepted:
        raise InvalidInput("landmarks", "", "accepted landmarks", f"none among {len(landmarks)}")
    return accepted


def _new(ids: Sequence[int], landmarks: Sequence[Landmark]) -> list[Landmark]:
    """Return the accepted landmarks that a catalogue with these identities lacks."""
    known = set(ids)
    return [one for one in _accepted(landmarks) if FIRST_ID + one.id not in known]


def _column(landmarks: Sequence[Landmark], name: str) -> FloatArray:
    return np.array([getattr(one, name) for one in landmarks], dtype=np.float64)
