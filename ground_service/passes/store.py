"""SQL of passes."""

from collections.abc import Hashable, Mapping
from typing import Any

from sqlalchemy import Connection, ScalarSelect, bindparam, func, insert, select

from ground_service.http.model import PageOf
from ground_service.passes.model import PassDetail, PassFilter, PassRecord, PassSummary
from ground_service.store import repository

_PASSES = repository.PASSES
_FRAMES = repository.PASS_FRAMES
_REPORTS_LISTED = 20


def get_pass(connection: Connection, pass_id: int) -> PassRecord:
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


def passes_of_vehicle(connection: Connection, vehicle: int) -> list[PassRecord]:
    """Return the passes of a vehicle, oldest first."""
    query = select(_PASSES).where(_PASSES.c.vehicle_id == vehicle).order_by(_PASSES.c.id)
    return [PassRecord.of(row) for row in connection.execute(query).mappings()]


def reported_times(connection: Connection, vehicle: int) -> list[tuple[int, int, int]]:
    """Return id, start and stop of the passes of a vehicle that have a report, oldest first."""
    columns = _PASSES.c.id, _PASSES.c.start_utc_ns, _PASSES.c.stop_utc_ns
    known = _PASSES.c.id.in_(select(repository.REPORTS.c.pass_id))
    rows = connection.execute(select(*columns).where(_PASSES.c.vehicle_id == vehicle, known).order_by(_PASSES.c.id))
    return [(key, start, stop) for key, start, stop in rows]


def previous_pass(connection: Connection, record: PassRecord, spacecraft_id: int) -> PassRecord | None:
    """Return the last pass of a spacecraft, live or from any archive, that started before a pass; None if none did."""
    query = (
        select(_PASSES)
        .join(repository.VEHICLES, repository.VEHICLES.c.id == _PASSES.c.vehicle_id)
        .where(repository.VEHICLES.c.ccsds_id == spacecraft_id, _PASSES.c.start_utc_ns < record.start_utc_ns)
        .order_by(_PASSES.c.start_utc_ns.desc(), _PASSES.c.id.desc())
    )
    found = connection.execute(query.limit(1)).mappings().first()
    return None if found is None else PassRecord.of(found)


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


def passes_with_images(connection: Connection, vehicle: int, start_utc_ns: int, stop_utc_ns: int) -> list[PassRecord]:
    """Return the passes of a vehicle with archived images that overlap an interval, oldest first."""
    query = select(_PASSES).where(
        _PASSES.c.vehicle_id == vehicle,
        _PASSES.c.start_utc_ns <= stop_utc_ns,
        _PASSES.c.stop_utc_ns >= start_utc_ns,
        _PASSES.c.id.in_(select(_FRAMES.c.pass_id)),
    )
    rows = connection.execute(query.order_by(_PASSES.c.start_utc_ns, _PASSES.c.id)).mappings()
    return [PassRecord.of(row) for row in rows]


def approved_windows(
    connection: Connection, vehicle: int, start_utc_ns: int, stop_utc_ns: int
) -> list[tuple[int, int, int]]:
    """Return number, start and end (UTC, ns) of the approved windows of a vehicle that overlap an interval."""
    windows = repository.WINDOWS
    query = select(windows.c.id, windows.c.start_utc_ns, windows.c.stop_utc_ns).where(
        windows.c.vehicle_id == vehicle,
        windows.c.decision == "approved",
        windows.c.start_utc_ns <= stop_utc_ns,
        windows.c.stop_utc_ns >= start_utc_ns,
    )
    return [(key, start, stop) for key, start, stop in connection.execute(query)]


def received_frames(connection: Connection, vehicle: int, version: int, start_ticks: int, stop_ticks: int) -> int:
    """Return the number of images of an interval in the science packet with the most of them."""
    tables = [repository.SAMPLES[kind] for kind in ("detections", "navigation_states", "frame_outcomes")]
    queries = [
        select(func.count(func.distinct(table.c.ticks))).where(
            repository.within(table, (vehicle, start_ticks, stop_ticks, version))
        )
        for table in tables
    ]
    return max(int(connection.execute(query).scalar_one()) for query in queries)


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
