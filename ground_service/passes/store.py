"""SQL of passes and of their telemetry."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, ScalarSelect, bindparam, func, insert, select

from ground_service.http.model import PageOf, Paging
from ground_service.passes.model import PassDetail, PassFilter, PassRecord, PassSummary
from ground_service.passes.samples import DetectionSamples, no_detections
from ground_service.store import repository, telemetry
from ground_service.store.codec import DETECTION_ITEM, unpack_detections
from ground_service.timekeeping.core import utc_ns_of_ticks
from lunar.arrays import IntArray
from tmtc.dictionary import DICTIONARY
from tmtc.event_texts import event_text

if TYPE_CHECKING:
    from ground_service.passes.span import PassSpan
    from reports.values import PassEvent

_PASSES = repository.PASSES
_FRAMES = repository.PASS_FRAMES
_SEVERITIES = {1: "info", 2: "low", 3: "medium", 4: "high"}
_REPORTS_LISTED = 20


def get_pass(connection: Connection, pass_id: int) -> PassRecord:
    """Return a pass.

    Raises
    ------
    NotFound
        There is no such pass.
    """
    return PassRecord.of(repository.get(connection, _PASSES, pass_id, "pass"))


def pass_detail(connection: Connection, pass_id: int) -> PassDetail:
    """Return a pass with its spacecraft, mission and newest reports."""
    vehicles, missions, reports = repository.VEHICLES, repository.MISSIONS, repository.REPORTS
    query = (
        select(
            vehicles.c.ccsds_id.label("spacecraft_id"),
            vehicles.c.instance,
            missions.c.name.label("mission"),
            missions.c.revision.label("mission_revision"),
        )
        .select_from(_PASSES)
        .join(vehicles, vehicles.c.id == _PASSES.c.vehicle_id)
        .outerjoin(missions, missions.c.id == _PASSES.c.mission_id)
        .where(_PASSES.c.id == pass_id)
    )
    newest = (
        select(reports.c.id)
        .where(reports.c.pass_id == pass_id)
        .order_by(reports.c.created_utc_ns.desc(), reports.c.id.desc())
        .limit(_REPORTS_LISTED)
    )
    row = repository.get(connection, _PASSES, pass_id, "pass")
    return PassDetail.of(
        row,
        archive_sha256=row["archive_digest"],
        reports=list(connection.execute(newest).scalars()),
        **connection.execute(query).mappings().one(),
    )


def list_passes(connection: Connection, asked: PassFilter) -> PageOf[PassSummary]:
    """List the passes, newest first."""
    vehicles = repository.VEHICLES
    query = select(_PASSES, vehicles.c.ccsds_id.label("spacecraft_id"), vehicles.c.instance).join(
        vehicles, vehicles.c.id == _PASSES.c.vehicle_id
    )
    if asked.search is not None:
        query = query.where(func.lower(_PASSES.c.name).contains(asked.search.lower(), autoescape=True))
    if asked.spacecraft_id is not None:
        query = query.where(vehicles.c.ccsds_id == asked.spacecraft_id)
    if asked.instance is not None:
        query = query.where(vehicles.c.instance == asked.instance)
    if asked.verdict == "none":
        query = query.where(_PASSES.c.id.not_in(select(repository.REPORTS.c.pass_id)))
    elif asked.verdict is not None:
        query = query.where(_newest_verdict() == asked.verdict)
    order = (_PASSES.c.created_utc_ns.desc(), _PASSES.c.id.desc())
    rows, total = repository.page(connection, query, asked, *order)
    return asked.page(map(PassSummary.of, rows), total)


def _newest_verdict() -> ScalarSelect[str]:
    """Return the verdict level of the newest report of a pass, as a subquery of a query of passes."""
    reports = repository.REPORTS
    return (
        select(reports.c.summary["verdict_level"].as_string())
        .where(reports.c.pass_id == _PASSES.c.id)
        .order_by(reports.c.created_utc_ns.desc(), reports.c.id)
        .limit(1)
        .correlate(_PASSES)
        .scalar_subquery()
    )


def passes_of_vehicle(connection: Connection, vehicle: int, *, reported: bool) -> list[PassRecord]:
    """Return the passes of a vehicle, oldest first; only those with a report if `reported`."""
    query = select(_PASSES).where(_PASSES.c.vehicle_id == vehicle).order_by(_PASSES.c.id)
    if reported:
        query = query.where(_PASSES.c.id.in_(select(repository.REPORTS.c.pass_id)))
    return [PassRecord.of(row) for row in connection.execute(query).mappings()]


def reported_without_ephemeris(connection: Connection, start_utc_ns: int, stop_utc_ns: int) -> list[int]:
    """Return the passes with a report but no ephemeris of their own that overlap an interval."""
    query = select(_PASSES.c.id).where(
        _PASSES.c.ephemeris_id.is_(None),
        _PASSES.c.start_utc_ns <= stop_utc_ns,
        _PASSES.c.stop_utc_ns >= start_utc_ns,
        _PASSES.c.id.in_(select(repository.REPORTS.c.pass_id)),
    )
    return [int(key) for key in connection.execute(query.order_by(_PASSES.c.id)).scalars()]


def archived_pass(connection: Connection, digest: str) -> int | None:
    """Return the id of the pass of an archive; None if it was not imported."""
    return connection.execute(select(_PASSES.c.id).where(_PASSES.c.archive_digest == digest)).scalar()


def add_pass(
    connection: Connection,
    *,
    vehicle_id: int,
    name: str,
    start_utc_ns: int,
    stop_utc_ns: int,
    mission_id: int | None,
    now_utc_ns: int,
    manifest: Mapping[str, Any] | None = None,
    archive_digest: str | None = None,
    ephemeris_id: int | None = None,
    catalogue_sha256: str | None = None,
    attitude_sha256: str | None = None,
) -> int:
    """Add a pass; return its id."""
    return int(
        repository.add(
            connection,
            _PASSES,
            vehicle_id=vehicle_id,
            name=name,
            start_utc_ns=start_utc_ns,
            stop_utc_ns=stop_utc_ns,
            archive_digest=archive_digest,
            manifest=dict(manifest or {}),
            ephemeris_id=ephemeris_id,
            catalogue_sha256=catalogue_sha256,
            attitude_sha256=attitude_sha256,
            mission_id=mission_id,
            created_utc_ns=now_utc_ns,
        )
    )


def set_catalogue(connection: Connection, record: PassRecord, sha256: str, source: str) -> None:
    """Store the crater catalogue of a pass and its source."""
    sources = [*record.manifest.get("data_sources", ()), f"crater catalogue {source}"]
    manifest = {**record.manifest, "data_sources": sources}
    repository.change(connection, repository.PASSES, record.id, catalogue_sha256=sha256, manifest=manifest)


def add_frames(connection: Connection, pass_id: int, sha256_by_frame: Mapping[int, str]) -> None:
    """Add the archived images of a pass by frame number."""
    rows = [
        {"pass_id": pass_id, "frame_number": number, "file_sha256": sha256}
        for number, sha256 in sha256_by_frame.items()
    ]
    if rows:
        connection.execute(insert(_FRAMES), rows)


def frame_files(connection: Connection, pass_id: int) -> dict[int, str]:
    """Return the hashes of the archived images of a pass by frame number, ascending."""
    query = select(_FRAMES.c.frame_number, _FRAMES.c.file_sha256).where(_FRAMES.c.pass_id == pass_id)
    rows = connection.execute(query.order_by(_FRAMES.c.frame_number))
    return {int(number): sha256 for number, sha256 in rows}


def passes_with_images(
    connection: Connection, vehicle: int, start_utc_ns: int, stop_utc_ns: int
) -> list[PassRecord]:
    """Return the passes of a vehicle with archived images that overlap an interval, oldest first."""
    query = select(_PASSES).where(
        _PASSES.c.vehicle_id == vehicle,
        _PASSES.c.start_utc_ns <= stop_utc_ns,
        _PASSES.c.stop_utc_ns >= start_utc_ns,
        _PASSES.c.id.in_(select(_FRAMES.c.pass_id)),
    )
    rows = connection.execute(query.order_by(_PASSES.c.start_utc_ns, _PASSES.c.id)).mappings()
    return [PassRecord.of(row) for row in rows]


def decoding_state(connection: Connection, vehicle: int) -> Hashable:
    """Return a value that differs after another decoding of the packets of a vehicle."""
    return tuple(connection.execute(_DECODED, {"vehicle": vehicle}).one())


def declared_state(connection: Connection, vehicle: int) -> Hashable:
    """Return a value that differs after more packets were decoded that mission descriptions declare."""
    return tuple(tuple(row) for row in connection.execute(_DECLARED, {"vehicle": vehicle}))


_DECODED = select(repository.VEHICLES.c.decoded_version, repository.VEHICLES.c.redecoding_version).where(
    repository.VEHICLES.c.id == bindparam("vehicle")
)
_DECLARED = (
    select(
        repository.PACKET_DECODINGS.c.definition_id,
        repository.PACKET_DECODINGS.c.decoded_to,
        repository.PACKET_DECODINGS.c.complete,
    )
    .where(repository.PACKET_DECODINGS.c.vehicle_id == bindparam("vehicle"))
    .order_by(repository.PACKET_DECODINGS.c.definition_id)
)


def samples(connection: Connection, span: PassSpan, kind: str, names: Sequence[str]) -> dict[str, list[Any]]:
    """Return columns of the samples of one kind in a span, in order of time."""
    return telemetry.samples(
        connection, kind, span.vehicle, span.start_ticks, span.stop_ticks, span.dictionary_version, names
    )


def sample_arrays(
    connection: Connection, span: PassSpan, kind: str, names: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """As `samples`, as arrays: whole numbers as int64, all else as float64 with NaN for NULL."""
    return telemetry.sample_arrays(
        connection, kind, span.vehicle, span.start_ticks, span.stop_ticks, span.dictionary_version, names
    )


def packet_octets(connection: Connection, span: PassSpan, apid: int) -> bytes:
    """Return the packets of one APID in a span, end to end in order of time."""
    return telemetry.packet_octets(connection, span.vehicle, apid, span.start_ticks, span.stop_ticks)


def detection_samples(connection: Connection, span: PassSpan) -> DetectionSamples:
    """Detections of every frame, in time order; of two reports on one image the first by content counts."""
    rows = samples(connection, span, "detections", ("ticks", "frame_number", "image_quality", "items"))
    if not rows["ticks"]:
        return no_detections()
    chosen = _first_reports(rows)
    items, offsets = unpack_detections([bytes(rows["items"][i]) for i in chosen])
    quality = [rows["image_quality"][i] for i in chosen]
    utc_ns, correlation_ids = utc_ns_of_ticks(
        np.array([rows["ticks"][i] for i in chosen], dtype=np.int64), span.correlations
    )
    return DetectionSamples(
        frame_number=np.array([rows["frame_number"][i] for i in chosen], dtype=np.int64),
        utc_ns=utc_ns,
        correlation_id=correlation_ids,
        usable=np.array([code == 0 for code in quality], dtype=np.bool_),
        quality=code_labels(DICTIONARY.labels("detections", "image_quality"), np.array(quality)),
        offsets=offsets,
        u_px=items["u_px"].astype(np.float64),
        v_px=items["v_px"].astype(np.float64),
        diameter_px=items["diameter_px"].astype(np.float64),
        score=items["score"].astype(np.float64),
        size_class=items["size_class"].astype(np.int64),
    )


def _first_reports(rows: Mapping[str, list[Any]]) -> list[int]:
    """Numbers of the rows to count, in time order: of those on one image the first by content."""
    order = sorted(
        range(len(rows["ticks"])),
        key=lambda i: (rows["ticks"][i], rows["frame_number"][i], bytes(rows["items"][i])),
    )
    return [
        i
        for place, i in enumerate(order)
        if place == 0
        or (rows["ticks"][i], rows["frame_number"][i])
        != (rows["ticks"][order[place - 1]], rows["frame_number"][order[place - 1]])
    ]


def detection_frames(connection: Connection, span: PassSpan) -> tuple[IntArray, IntArray]:
    """On-board time of every frame (n,), ascending, and where its detections begin among all of the span (n + 1,)."""
    table = repository.SAMPLES["detections"]
    query = (
        select(table.c.ticks, table.c.frame_number, func.length(table.c["items"]))
        .where(
            table.c.vehicle_id == span.vehicle,
            table.c.dictionary_version == span.dictionary_version,
            table.c.ticks.between(span.start_ticks, span.stop_ticks),
        )
        .order_by(table.c.ticks, table.c.frame_number)
    )
    rows = telemetry.whole_numbers(connection, query)
    if (np.diff(rows[:, :2], axis=0) == 0).all(axis=1).any():
        return _detection_frames_by_content(connection, span)
    return rows[:, 0], np.concatenate(([0], np.cumsum(rows[:, 2] // DETECTION_ITEM.itemsize)))


def _detection_frames_by_content(connection: Connection, span: PassSpan) -> tuple[IntArray, IntArray]:
    """As `detection_frames`, where images were reported twice: of two reports the first by content counts."""
    rows = samples(connection, span, "detections", ("ticks", "frame_number", "items"))
    chosen = _first_reports(rows)
    _, offsets = unpack_detections([bytes(rows["items"][i]) for i in chosen])
    return np.array([rows["ticks"][i] for i in chosen], dtype=np.int64), offsets


def code_labels(labels: Mapping[int, str], codes: NDArray[Any]) -> tuple[str, ...]:
    return tuple(labels.get(int(code), str(int(code))) for code in codes)


_EVENT_COLUMNS = ("ticks", "severity", "event_id", "frame_number", "value_1", "value_2")


def event_list(connection: Connection, span: PassSpan) -> tuple[PassEvent, ...]:
    """Event reports of a pass, in time order."""
    rows = samples(connection, span, "events", _EVENT_COLUMNS)
    events = _pass_events(list(zip(*rows.values(), strict=True)), span)
    return tuple(sorted(events, key=lambda event: (event.utc_ns, event.name, event.detail)))


def event_page(
    connection: Connection,
    span: PassSpan,
    asked: Paging,
    *,
    severities: Sequence[str] | None = None,
    name: str | None = None,
    newest_first: bool = True,
) -> tuple[list[PassEvent], int]:
    """Return a page of the event reports of a span that match, in time order, and their number.

    No severities: all. `name` is a part of the name of the event. Reports of one time are in the order of their
    content, whatever the order in which they came.
    """
    table = repository.SAMPLES["events"]
    query = select(*(table.c[column] for column in _EVENT_COLUMNS)).where(
        table.c.vehicle_id == span.vehicle,
        table.c.dictionary_version == span.dictionary_version,
        table.c.ticks.between(span.start_ticks, span.stop_ticks),
    )
    if severities:
        codes = [code for code, one in _SEVERITIES.items() if one in severities]
        query = query.where(table.c.severity.in_(codes))
    if name is not None:
        part = name.strip().lower().replace(" ", "_")
        labels = DICTIONARY.labels("event_info", "event_id")
        query = query.where(table.c.event_id.in_([code for code, label in labels.items() if part in label]))
    order = [
        table.c[column] for column in ("ticks", "event_id", "frame_number", "value_1", "value_2", "packet_id")
    ]
    rows, total = repository.page(
        connection, query, asked, *(column.desc() if newest_first else column for column in order)
    )
    return _pass_events([tuple(row.values()) for row in rows], span), total


def _pass_events(rows: Sequence[tuple[Any, ...]], span: PassSpan) -> list[PassEvent]:
    """Return event reports of rows of `_EVENT_COLUMNS`."""
    from reports.values import PassEvent  # a list of passes does not need it

    labels = DICTIONARY.labels("event_info", "event_id")
    utc_ns, correlation_ids = utc_ns_of_ticks(
        np.array([row[0] for row in rows], dtype=np.int64), span.correlations
    )
    return [
        PassEvent(
            utc_ns=int(utc),
            severity=_SEVERITIES.get(severity, str(severity)),
            name=labels.get(event_id, str(event_id)),
            detail=_event_detail(labels.get(event_id, ""), *values),
            correlation_id=int(correlation),
        )
        for (_, severity, event_id, *values), utc, correlation in zip(
            rows, utc_ns, correlation_ids, strict=True
        )
    ]


def _event_detail(name: str, frame_number: int, *values: float | None) -> str:
    text = event_text(name, *values)
    return f"frame {frame_number}: {text}" if text else f"frame {frame_number}"
