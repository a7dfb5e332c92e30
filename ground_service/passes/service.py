"""Passes as a caller sees them: lists, completeness, detections, series of states and of housekeeping parameters."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from sqlalchemy import Connection

from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput, NotFound
from ground_service.ground import Ground
from ground_service.http.model import PageOf, Paging, UtcTime, ns_of
from ground_service.ingest.store import results_state
from ground_service.missions import store as missions
from ground_service.missions.catalogues import read_catalogue
from ground_service.missions.timekeeping.core import ticks_of_utc_ns
from ground_service.missions.timekeeping.store import load_correlations
from ground_service.passes import model, sample_store, store
from ground_service.passes.core import Buckets
from ground_service.passes.packet_accounting import packet_accounting
from ground_service.passes.parameters import series_source, state_unit
from ground_service.passes.sample_store import detection_frames, detection_samples
from ground_service.passes.series import PARAMETERS, STATE_VALUES, Cache, Series, SeriesReading, kind_samples
from ground_service.passes.span import LAST_TICKS, REACH_NS, PassSpan, pass_span, vehicle_span
from ground_service.store.files import StoredFile, register_file
from ground_service.store.vehicles import FLOWN, find_vehicle, vehicle_id
from ground_service.telemetry import rollups
from ground_service.telemetry.decoding import readable_version
from ground_service.toml import require_line
from lunar.constants import DAY_NS
from lunar.timescales import format_utc
from reports.values import PacketAccounting
from tmtc.dictionary.fields import Field
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import limit_states

LIMIT_STATES = ("within", "warning", "alarm")
TREND_DAYS = 30
TREND_POINTS = 60


def get_pass(ground: Ground, pass_id: int) -> model.PassDetail:
    """Return a pass with its spacecraft, mission and newest reports."""
    return ground.read(store.pass_detail, pass_id)


def keep_archive(ground: Ground, stored: StoredFile, name: str) -> None:
    """Add an uploaded pass archive to the files of the archive."""
    ground.write(register_file, stored, "archive", name, utc_now_ns())


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
        raise InvalidInput("pass", "stop", "a time after the start", format_utc(stop_utc_ns))
    with ground.database.writing() as connection:
        return store.add_pass(
            connection,
            vehicle_id=vehicle_id(connection, spacecraft_id, instance),
            name=name,
            start_utc_ns=start_utc_ns,
            stop_utc_ns=stop_utc_ns,
            manifest=manifest,
            mission_id=missions.newest_of_spacecraft(connection, spacecraft_id),
            now_utc_ns=utc_now_ns(),
        )


def completeness(ground: Ground, pass_id: int) -> PacketAccounting:
    """Return the accounting of the received and missing packets of a pass, kept until data of it are new."""
    with ground.database.reading() as connection:
        record, span, cache = _opened(ground, connection, pass_id)
        where = (span.vehicle, span.start_ticks, span.stop_ticks)
        return cache.answer(
            ("completeness", pass_id),
            lambda: packet_accounting(ground.files, connection, record, span),
            start_ticks=span.start_ticks,
            stop_ticks=span.stop_ticks,
            state=results_state(connection, *where),
        )


def _opened(ground: Ground, connection: Connection, pass_id: int) -> tuple[model.PassRecord, PassSpan, Cache]:
    """Return a pass, its interval of on-board time, and the cached answers on its vehicle."""
    record = store.get_pass(connection, pass_id)
    cache = Cache(ground, connection, record.vehicle_id)
    # Reports of observations near it, and other windows, can change its interval.
    times = record.start_utc_ns - REACH_NS, record.stop_utc_ns + REACH_NS
    near = vehicle_span(connection, record.vehicle_id, *times)
    span = cache.answer(
        ("span", record.id),
        lambda: pass_span(connection, record),
        start_ticks=near.start_ticks,
        stop_ticks=near.stop_ticks,
        state=tuple(store.approved_windows(connection, record.vehicle_id, *times)),
    )
    return record, span, cache


def list_events(ground: Ground, pass_id: int, asked: Paging) -> PageOf[model.Event]:
    """Return a page of the event reports of a pass, in time order."""
    with ground.database.reading() as connection:
        _, span, _ = _opened(ground, connection, pass_id)
        found, total = sample_store.event_page(connection, span, asked, newest_first=False)
    return asked.page((model.Event.of(asdict(one), time=one.utc_ns) for one in found), total)


def spacecraft_events(ground: Ground, asked: model.EventFilter) -> PageOf[model.SpacecraftEvent]:
    """Return a page of the event reports of a spacecraft that match, newest first."""
    with ground.database.reading() as connection:
        vehicle = find_vehicle(connection, asked.spacecraft_id, asked.instance).id
        span = vehicle_span(connection, vehicle, ns_of(asked.start), ns_of(asked.stop))
        found, total = sample_store.event_page(connection, span, asked, severities=asked.severity, name=asked.name)
        spans = {
            one.id: pass_span(connection, one)
            for one in store.passes_of_vehicle(connection, vehicle)
            if any(one.start_utc_ns <= at.utc_ns + REACH_NS <= one.stop_utc_ns + 2 * REACH_NS for at in found)
        }

    def pass_at(utc_ns: int) -> int | None:
        """Return the newest of the passes that a time belongs to."""
        ticks = ticks_of_utc_ns(utc_ns, span.correlations)
        return max((key for key, one in spans.items() if one.start_ticks <= ticks <= one.stop_ticks), default=None)

    return asked.page(
        (model.SpacecraftEvent.of(asdict(one), time=one.utc_ns, pass_id=pass_at(one.utc_ns)) for one in found), total
    )


def detections(ground: Ground, pass_id: int, asked: Paging) -> PageOf[model.Detection]:
    """Return a page of the detections of a pass, in time order."""
    with ground.database.reading() as connection:
        _, span, cache = _opened(ground, connection, pass_id)
        ticks, offsets = cache.answer(
            ("frames", pass_id),
            lambda: detection_frames(connection, span),
            start_ticks=span.start_ticks,
            stop_ticks=span.stop_ticks,
        )
        total = int(offsets[-1])
        rows = np.arange(min(asked.offset, total), min(asked.offset + asked.limit, total))
        if len(rows) == 0:
            return asked.page([], total)
        first, last = ticks[np.searchsorted(offsets, rows[[0, -1]], side="right") - 1].tolist()
        samples = detection_samples(connection, replace(span, start_ticks=first, stop_ticks=last))
    rows -= offsets[np.searchsorted(ticks, first)]
    frames = np.searchsorted(samples.offsets, rows, side="right") - 1
    found = [
        model.Detection(
            frame_number=int(samples.frame_number[frame]),
            time=UtcTime(samples.utc_ns[frame]),
            u_px=float(samples.u_px[row]),
            v_px=float(samples.v_px[row]),
            diameter_px=float(samples.diameter_px[row]),
            score=float(samples.score[row]),
            size_class=int(samples.size_class[row]),
            correlation_id=0 if samples.correlation_id is None else int(samples.correlation_id[frame]),
        )
        for row, frame in zip(rows.tolist(), frames.tolist(), strict=True)
    ]
    return asked.page(found, total)


def craters(ground: Ground, pass_id: int, asked: Paging) -> PageOf[model.Crater]:
    """Return a page of the catalogue of a pass, the largest craters first; nothing without a catalogue.

    An imported pass has the craters of the terrain near its ground track.
    """
    with ground.database.reading() as connection:
        sha256 = store.get_pass(connection, pass_id).catalogue_sha256
    if sha256 is None:
        return asked.page([], 0)
    catalogue = read_catalogue(ground.files.path(sha256))
    order = np.lexsort((catalogue.ids, -catalogue.diameter_m))
    chosen = order[asked.offset : asked.offset + asked.limit]
    east = (np.degrees(catalogue.longitude_rad[chosen]) + 180.0) % 360.0 - 180.0
    columns = (catalogue.ids[chosen], np.degrees(catalogue.latitude_rad[chosen]), east, catalogue.diameter_m[chosen])
    names = ("id", "latitude_deg", "longitude_deg", "diameter_m")
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return asked.page((model.Crater(**dict(zip(names, row, strict=True))) for row in rows), len(catalogue))


def state_series(
    ground: Ground, pass_id: int, estimator: str, values: tuple[str, ...], max_points: int
) -> list[Series]:
    """Series of values of one estimator's states, kept until data of the pass are new.

    Raises
    ------
    InvalidInput
        If a value cannot be asked for.
    NotFound
        If there is no such pass or no such estimator.
    """
    unknown = [value for value in values if value not in STATE_VALUES]
    if unknown:
        raise InvalidInput("states", "value", ", ".join(STATE_VALUES), unknown[0][:80])
    codes = {name: code for code, name in DICTIONARY.labels("navigation_state", "estimator").items()}
    with ground.database.reading() as connection:
        _, span, cache = _opened(ground, connection, pass_id)
        if estimator not in codes:
            raise NotFound("estimator", estimator[:80])
        source = kind_samples("navigation_states", span.dictionary_version, codes[estimator])
        reading = SeriesReading(connection, span, source, max_points)
        found = cache.answer(
            ("states", pass_id, estimator, values, max_points),
            lambda: reading.series({value: state_unit(value) for value in values}),
            start_ticks=span.start_ticks,
            stop_ticks=span.stop_ticks,
        )
    by_name = {one.name: one for one in found}
    return [by_name[value] for value in values]


def parameter_series(ground: Ground, pass_id: int, parameter: str, max_points: int) -> Series:
    """The series of one parameter of a pass, kept until data of the pass are new."""
    with ground.database.reading() as connection:
        _, span, cache = _opened(ground, connection, pass_id)
        return cache.answer(
            ("parameter", pass_id, parameter, max_points),
            lambda: _parameter_series(connection, span, parameter, max_points),
            start_ticks=span.start_ticks,
            stop_ticks=span.stop_ticks,
            state=store.declared_state(connection, span.vehicle),
        )


def _parameter_series(connection: Connection, span: PassSpan, parameter: str, max_points: int) -> Series:
    source, own_span, name, unit = series_source(connection, span, parameter)
    return SeriesReading(connection, own_span, source, max_points).series({name: unit})[0]


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
    """The series of one parameter of a spacecraft over any span, all there is by default."""
    with ground.database.reading() as connection:
        vehicle = find_vehicle(connection, spacecraft_id, instance).id
        span = vehicle_span(connection, vehicle, start_utc_ns, stop_utc_ns)
        return _parameter_series(connection, span, parameter, max_points)


def spacecraft_trends(ground: Ground, spacecraft_id: int, instance: str) -> list[model.Trend]:
    """Return the trends of the housekeeping parameters of a spacecraft; see `vehicle_trends`."""
    with ground.database.reading() as connection:
        vehicle = find_vehicle(connection, spacecraft_id, instance).id
    return vehicle_trends(ground, vehicle)


def vehicle_trends(ground: Ground, vehicle: int) -> list[model.Trend]:
    """Return the trends over the last `TREND_DAYS` days of on-board time with housekeeping."""
    with ground.database.reading() as connection:
        return Cache(ground, connection, vehicle).answer("trends", lambda: _trends(connection, vehicle))


def _trends(connection: Connection, vehicle: int) -> list[model.Trend]:
    version = readable_version(connection, vehicle)
    _, _, last = rollups.rolled_extent(connection, rollups.KINDS["housekeeping"][0], vehicle, version, 0, 0, LAST_TICKS)
    if last == 0:
        return []
    first = max(last - (TREND_DAYS * 86_400 << 16), 0)
    span = PassSpan(vehicle, first, last, load_correlations(connection, vehicle), version)
    reading = SeriesReading(connection, span, kind_samples("housekeeping", version), TREND_POINTS)
    definition = DICTIONARY.packet("housekeeping")
    read = reading.series({name: definition.field(name).unit for name in PARAMETERS})
    trends = (trend_of(definition.field(one.name), one.buckets) for one in read)
    return [trend for trend in trends if trend is not None]


def trend_of(field: Field, buckets: Buckets) -> model.Trend | None:
    """The trend of a parameter from its stretches; None where there are no samples."""
    total = int(buckets.count.sum())
    if total == 0:
        return None
    low, high = float(buckets.low.min()), float(buckets.high.max())
    worst = int(limit_states(field, [low, high]).max())
    return model.Trend(
        parameter=field.name,
        unit=field.unit,
        samples=total,
        low=low,
        high=high,
        mean=float(np.sum(buckets.mean * buckets.count) / total),
        slope_per_day=_slope_per_day(buckets),
        limit_state=LIMIT_STATES[worst],
    )


def _slope_per_day(buckets: Buckets) -> float:
    """Least squares through the means at the middles of the stretches, weighted by their samples."""
    middle = (buckets.start_utc_ns // 2 + buckets.stop_utc_ns // 2).astype(np.float64)
    days = (middle - middle[0]) / DAY_NS
    weight = buckets.count.astype(np.float64)
    days = days - np.average(days, weights=weight)
    square = float(np.sum(weight * days**2))
    if len(days) < 2 or square <= 0.0:
        return float("nan")
    return float(np.sum(weight * days * (buckets.mean - np.average(buckets.mean, weights=weight))) / square)
