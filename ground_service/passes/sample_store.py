"""SQL of the telemetry of a pass: samples, packets, detections and event reports in a span."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, func, select

from ground_service.http.model import Paging
from ground_service.missions.timekeeping.core import utc_ns_of_ticks
from ground_service.passes.span import PassSpan
from ground_service.store import repository
from ground_service.store.models import TELECOMMANDS
from ground_service.telemetry import store as telemetry
from ground_service.telemetry.samples import DetectionSamples, no_detections
from ground_service.telemetry.store import DETECTION_ITEM, unpack_detections
from lunar.arrays import IntArray
from lunar.timescales import format_utc
from reports.values import PassEvent
from tmtc.dictionary.event_texts import event_text, request_text
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import PacketDefinition
from tmtc.packets.stream import cut_packets

_SEVERITIES = {1: "info", 2: "low", 3: "medium", 4: "high"}


def samples(connection: Connection, span: PassSpan, kind: str, names: Sequence[str]) -> dict[str, list[Any]]:
    """Return columns of the samples of one kind in a span, in order of time."""
    return telemetry.samples(connection, kind, span.where, names)


def sample_arrays(connection: Connection, span: PassSpan, kind: str, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """As `samples`, as arrays: whole numbers as int64, all else as float64 with NaN for NULL."""
    return telemetry.sample_arrays(connection, kind, span.where, names)


def packet_octets(connection: Connection, span: PassSpan, apid: int) -> bytes:
    """Return the packets of one APID in a span, end to end in order of time."""
    return telemetry.packet_octets(connection, span.vehicle, apid, span.start_ticks, span.stop_ticks)


def packet_values(
    connection: Connection, span: PassSpan, packet: PacketDefinition, field: str
) -> tuple[IntArray, NDArray[Any]]:
    """Return ticks and values (n,) of a field of stored packets, in order of time."""
    octets = packet_octets(connection, span, packet.apid)
    table = DICTIONARY.unpack_many(octets, cut_packets(octets)).get(packet.name)
    if table is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    order = np.argsort(table.ticks, kind="stable")
    return table.ticks[order], table.columns[field][order]


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
        range(len(rows["ticks"])), key=lambda i: (rows["ticks"][i], rows["frame_number"][i], bytes(rows["items"][i]))
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
        .where(repository.within(table, span.where))
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


def learned_offset_m(connection: Connection, span: PassSpan) -> float | None:
    """Return the newest size of the offset of the crater list that the payload reported; None without one."""
    labels = DICTIONARY.labels("event_info", "event_id")
    rows = samples(connection, span, "events", ("ticks", "event_id", "value_1"))
    found = (row for row in zip(*rows.values(), strict=True) if labels.get(row[1]) == "map_offset")
    return max(((ticks, size_m) for ticks, _, size_m in found if size_m is not None), default=(0, None))[1]


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
    query = select(*(table.c[column] for column in _EVENT_COLUMNS)).where(repository.within(table, span.where))
    if severities:
        codes = [code for code, one in _SEVERITIES.items() if one in severities]
        query = query.where(table.c.severity.in_(codes))
    if name is not None:
        part = name.strip().lower().replace(" ", "_")
        labels = DICTIONARY.labels("event_info", "event_id")
        query = query.where(table.c.event_id.in_([code for code, label in labels.items() if part in label]))
    order = [table.c[column] for column in ("ticks", "event_id", "frame_number", "value_1", "value_2", "packet_id")]
    sorting = (column.desc() if newest_first else column for column in order)
    rows, total = repository.page(connection, query, asked, *sorting, others=["severity"])
    found = [tuple(row.values()) for row in rows]
    return _pass_events(found, span, _telecommands(connection, span.vehicle, found)), total


def _telecommands(connection: Connection, vehicle: int, rows: Sequence[tuple[Any, ...]]) -> Callable[[int, float], str]:
    """Return a function that writes a telecommand that an event of these rows names, by ticks and first four octets.

    Sequence counts return after 16384 telecommands: the last one that was sent before the event counts.
    """
    wanted = {value for row in rows for value in row[-2:] if value is not None and 0.0 <= value < 2.0**32}
    sent = func.coalesce(TELECOMMANDS.c.sent_after_ticks, 0)
    query = select(TELECOMMANDS.c.request_id, sent, TELECOMMANDS.c.id).where(
        TELECOMMANDS.c.vehicle_id == vehicle, TELECOMMANDS.c.request_id.in_([int(value) for value in wanted])
    )
    known = connection.execute(query.order_by(TELECOMMANDS.c.id)).all() if wanted else []

    def text(ticks: int, request_id: float) -> str:
        numbers = [number for request, after, number in known if request == request_id and after <= ticks]
        return f"telecommand {numbers[-1]}" if numbers else request_text(request_id)

    return text


def _pass_events(
    rows: Sequence[tuple[Any, ...]],
    span: PassSpan,
    telecommand: Callable[[int, float], str] = lambda _, request_id: request_text(request_id),
) -> list[PassEvent]:
    """Return event reports of rows of `_EVENT_COLUMNS`."""

    def time(ticks: float) -> str:
        return format_utc(int(utc_ns_of_ticks(np.array([ticks], dtype=np.int64), span.correlations)[0][0]), 0)

    def detail(ticks: int, event_id: int, frame: int, *values: float | None) -> str:
        text = event_text(labels.get(event_id, ""), *values, time=time, telecommand=partial(telecommand, ticks))
        return f"frame {frame}: {text}" if text else f"frame {frame}"

    labels = DICTIONARY.labels("event_info", "event_id")
    utc_ns, correlation_ids = utc_ns_of_ticks(np.array([row[0] for row in rows], dtype=np.int64), span.correlations)
    return [
        PassEvent(
            utc_ns=int(utc),
            severity=_SEVERITIES.get(severity, str(severity)),
            name=labels.get(event_id, str(event_id)),
            detail=detail(ticks, event_id, *values),
            correlation_id=int(correlation),
        )
        for (ticks, severity, event_id, *values), utc, correlation in zip(rows, utc_ns, correlation_ids, strict=True)
    ]
