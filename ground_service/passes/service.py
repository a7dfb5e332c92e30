"""Passes as a caller sees them: lists, completeness, detections, series of states and of housekeeping parameters."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sqlalchemy import Connection

from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput, NotFound
from ground_service.ground import Ground
from ground_service.http.views import series_view
from ground_service.ingest.redecode import readable_version
from ground_service.ingest.service import FLOWN
from ground_service.missions import store as missions
from ground_service.passes.cache import remembered
from ground_service.passes.packet_accounting import packet_accounting
from ground_service.passes.series import PARAMETERS, STATE_VALUES, Series, SeriesReading
from ground_service.passes.span import PassSpan, pass_span
from ground_service.passes.store import detection_frames, detection_samples, event_list
from ground_service.store import repository
from ground_service.text import require_line
from ground_service.timekeeping.core import ticks_of_utc_ns
from ground_service.timekeeping.store import load_correlations
from reports.values import PacketAccounting, PassEvent
from tmtc.dictionary import DICTIONARY

LAST_TICKS = (1 << 48) - 1


@dataclass(frozen=True, slots=True)
class Detection:
    """One detection of one frame."""

    frame_number: int
    utc_ns: int
    u_px: float
    v_px: float
    diameter_px: float
    score: float
    size_class: int
    correlation_id: int


def list_passes(ground: Ground, *, limit: int = 100, offset: int = 0) -> repository.Page:
    """Passes, the latest entered first."""
    with ground.database.reading() as connection:
        return repository.page(connection, repository.PASSES, limit=limit, offset=offset)


def get_pass(ground: Ground, pass_id: int) -> dict[str, Any]:
    """A pass with the spacecraft it is of and its packets counted."""
    with ground.database.reading() as connection:
        record = repository.get(connection, repository.PASSES, pass_id, "pass")
        vehicle = repository.get(connection, repository.VEHICLES, record["vehicle_id"], "vehicle")
        reports = repository.page(connection, repository.REPORTS, limit=20, pass_id=pass_id)
        mission = None if record["mission_id"] is None else missions.detail(connection, record["mission_id"])
    return {
        **record,
        "spacecraft_id": vehicle["ccsds_id"],
        "instance": vehicle["instance"],
        "mission": None if mission is None else mission.mission,
        "mission_revision": None if mission is None else mission.revision,
        "reports": [row["id"] for row in reports.rows],
    }


def define_pass(
    ground: Ground,
    *,
    name: str,
    start_utc_ns: int,
    stop_utc_ns: int,
    spacecraft_id: int,
    instance: str = FLOWN,
    manifest: Mapping[str, Any] | None = None,
) -> int:
    """Add an interval of a spacecraft's time as a pass; return its id.

    The pass refers to the newest mission description of the spacecraft, if there is one.
    """
    require_line(name, "pass", "name")
    if stop_utc_ns <= start_utc_ns:
        raise InvalidInput("pass", "stop", "a time after the start", str(stop_utc_ns))
    with ground.database.writing() as connection:
        return int(
            repository.add(
                connection,
                repository.PASSES,
                vehicle_id=repository.vehicle_id(connection, spacecraft_id, instance),
                name=name,
                start_utc_ns=start_utc_ns,
                stop_utc_ns=stop_utc_ns,
                archive_digest=None,
                manifest=dict(manifest or {}),
                ephemeris_id=None,
                catalogue_sha256=None,
                attitude_sha256=None,
                mission_id=missions.newest_of_spacecraft(connection, spacecraft_id),
                created_utc_ns=utc_now_ns(),
            )
        )


def completeness(ground: Ground, pass_id: int) -> PacketAccounting:
    """Packets of a pass that came and that did not."""
    with ground.database.reading() as connection:
        record = repository.get(connection, repository.PASSES, pass_id, "pass")
        return remembered(
            ground,
            connection,
            ("completeness", pass_id),
            lambda: packet_accounting(ground.files, connection, record, pass_span(connection, record)),
        )


def events(ground: Ground, pass_id: int) -> tuple[PassEvent, ...]:
    """Event reports of a pass, in time order."""
    with ground.database.reading() as connection:
        record = repository.get(connection, repository.PASSES, pass_id, "pass")
        return remembered(
            ground,
            connection,
            ("events", pass_id),
            lambda: event_list(connection, pass_span(connection, record)),
        )


def detections(ground: Ground, pass_id: int, *, limit: int, offset: int) -> tuple[list[Detection], int]:
    """Detections of a pass, a page of them in time order, and how many there are."""
    with ground.database.reading() as connection:
        record = repository.get(connection, repository.PASSES, pass_id, "pass")
        span = pass_span(connection, record)
        ticks, offsets = remembered(
            ground, connection, ("frames", pass_id), lambda: detection_frames(connection, span)
        )
        total = int(offsets[-1])
        rows = np.arange(min(offset, total), min(offset + limit, total))
        if len(rows) == 0:
            return [], total
        first, last = ticks[np.searchsorted(offsets, rows[[0, -1]], side="right") - 1].tolist()
        samples = detection_samples(connection, replace(span, start_ticks=first, stop_ticks=last))
    rows -= offsets[np.searchsorted(ticks, first)]
    frames = np.searchsorted(samples.offsets, rows, side="right") - 1
    return [
        Detection(
            frame_number=int(samples.frame_number[frame]),
            utc_ns=int(samples.utc_ns[frame]),
            u_px=float(samples.u_px[row]),
            v_px=float(samples.v_px[row]),
            diameter_px=float(samples.diameter_px[row]),
            score=float(samples.score[row]),
            size_class=int(samples.size_class[row]),
            correlation_id=0 if samples.correlation_id is None else int(samples.correlation_id[frame]),
        )
        for row, frame in zip(rows.tolist(), frames.tolist(), strict=True)
    ], total


def state_series(
    ground: Ground, pass_id: int, estimator: str, values: tuple[str, ...], max_points: int
) -> list[Series]:
    """Series of values of one estimator's states.

    Raises
    ------
    InvalidInput
        If a value cannot be asked for.
    NotFound
        If there is no such pass or no such estimator.
    """
    with ground.database.reading() as connection:
        record = repository.get(connection, repository.PASSES, pass_id, "pass")
        return _state_series(connection, record, estimator, values, max_points)


def states_document(
    ground: Ground, pass_id: int, estimator: str, values: tuple[str, ...], max_points: int
) -> bytes:
    """As `state_series`, as JSON, kept until something is new."""
    with ground.database.reading() as connection:
        record = repository.get(connection, repository.PASSES, pass_id, "pass")

        def make() -> bytes:
            found = _state_series(connection, record, estimator, values, max_points)
            return _json({"estimator": estimator, "series": [series_view(one) for one in found]})

        return remembered(ground, connection, ("states", pass_id, estimator, values, max_points), make)


def _state_series(
    connection: Connection,
    record: Mapping[str, Any],
    estimator: str,
    values: tuple[str, ...],
    max_points: int,
) -> list[Series]:
    unknown = [value for value in values if value not in STATE_VALUES]
    if unknown:
        raise InvalidInput("states", "value", ", ".join(STATE_VALUES), unknown[0][:80])
    codes = {name: code for code, name in DICTIONARY.labels("navigation_state", "estimator").items()}
    if estimator not in codes:
        raise NotFound("estimator", estimator[:80])
    units = {field.name: field.unit for field in DICTIONARY.packet("navigation_state").fields}
    reading = SeriesReading(
        connection, pass_span(connection, record), "navigation_states", codes[estimator], max_points
    )
    found = reading.series(
        {
            value: units.get(value, "m/s" if "_m_s" in value else "m" if value.endswith("_m") else "")
            for value in values
        }
    )
    by_name = {one.name: one for one in found}
    return [by_name[value] for value in values]


def parameter_series(ground: Ground, pass_id: int, parameter: str, max_points: int) -> Series:
    """The series of one housekeeping parameter of a pass."""
    _check_parameter(parameter)
    with ground.database.reading() as connection:
        record = repository.get(connection, repository.PASSES, pass_id, "pass")
        return _parameter_series(connection, pass_span(connection, record), parameter, max_points)


def parameter_document(ground: Ground, pass_id: int, parameter: str, max_points: int) -> bytes:
    """As `parameter_series`, as JSON, kept until something is new."""
    _check_parameter(parameter)
    with ground.database.reading() as connection:
        record = repository.get(connection, repository.PASSES, pass_id, "pass")

        def make() -> bytes:
            span = pass_span(connection, record)
            return _json(series_view(_parameter_series(connection, span, parameter, max_points)))

        return remembered(ground, connection, ("parameter", pass_id, parameter, max_points), make)


def _parameter_series(connection: Connection, span: PassSpan, parameter: str, max_points: int) -> Series:
    reading = SeriesReading(connection, span, "housekeeping", 0, max_points)
    return reading.series({parameter: DICTIONARY.packet("housekeeping").field(parameter).unit})[0]


def _json(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()


def trend_series(
    ground: Ground,
    spacecraft_id: int,
    instance: str,
    parameter: str,
    max_points: int,
    *,
    start_utc_ns: int | None = None,
    stop_utc_ns: int | None = None,
) -> Series:
    """The series of one housekeeping parameter of a spacecraft over any span, all there is by default."""
    _check_parameter(parameter)
    with ground.database.reading() as connection:
        vehicle = repository.find(connection, repository.VEHICLES, ccsds_id=spacecraft_id, instance=instance)
        if vehicle is None:
            raise NotFound("spacecraft", f"{spacecraft_id} ({instance})")
        correlations = load_correlations(connection, vehicle["id"])
        span = PassSpan(
            vehicle["id"],
            0 if start_utc_ns is None else ticks_of_utc_ns(start_utc_ns, correlations),
            LAST_TICKS if stop_utc_ns is None else ticks_of_utc_ns(stop_utc_ns, correlations),
            correlations,
            readable_version(connection, vehicle["id"]),
        )
        return _parameter_series(connection, span, parameter, max_points)


def _check_parameter(parameter: str) -> None:
    if parameter not in PARAMETERS:
        raise NotFound("parameter", parameter[:80])
