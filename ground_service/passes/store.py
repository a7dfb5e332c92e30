"""SQL of the telemetry of a pass."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from ground_service.passes.samples import (
    DetectionSamples,
    no_detections,
)
from ground_service.passes.span import PassSpan
from ground_service.store import telemetry
from ground_service.store.codec import unpack_detections
from ground_service.timekeeping.core import utc_ns_of_ticks
from lunar.arrays import IntArray
from reports.values import (
    PassEvent,
)
from tmtc.dictionary import DICTIONARY
from tmtc.event_texts import event_text

_SEVERITIES = {1: "info", 2: "low", 3: "medium", 4: "high"}


def detection_samples(connection: Connection, span: PassSpan) -> DetectionSamples:
    """Detections of every frame, in time order; of two reports on one image the first by content counts."""
    rows = telemetry.samples(
        connection,
        "detections",
        span.vehicle,
        span.start_ticks,
        span.stop_ticks,
        span.dictionary_version,
        ("ticks", "frame_number", "image_quality", "items"),
    )
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
    rows = telemetry.samples(
        connection,
        "detections",
        span.vehicle,
        span.start_ticks,
        span.stop_ticks,
        span.dictionary_version,
        ("ticks", "frame_number", "items"),
    )
    if not rows["ticks"]:
        return np.zeros(0, dtype=np.int64), np.zeros(1, dtype=np.int64)
    chosen = _first_reports(rows)
    _, offsets = unpack_detections([bytes(rows["items"][i]) for i in chosen])
    return np.array([rows["ticks"][i] for i in chosen], dtype=np.int64), offsets


def code_labels(labels: Mapping[int, str], codes: NDArray[Any]) -> tuple[str, ...]:
    return tuple(labels.get(int(code), str(int(code))) for code in codes)


def event_list(connection: Connection, span: PassSpan) -> tuple[PassEvent, ...]:
    """Event reports of a pass, in time order."""
    names = ("ticks", "severity", "event_id", "frame_number", "value_1", "value_2")
    rows = telemetry.samples(
        connection, "events", span.vehicle, span.start_ticks, span.stop_ticks, span.dictionary_version, names
    )
    labels = DICTIONARY.labels("event_info", "event_id")
    utc_ns, correlation_ids = utc_ns_of_ticks(np.array(rows["ticks"], dtype=np.int64), span.correlations)
    events = [
        PassEvent(
            utc_ns=int(utc),
            severity=_SEVERITIES.get(rows["severity"][i], str(rows["severity"][i])),
            name=labels.get(rows["event_id"][i], str(rows["event_id"][i])),
            detail=_event_detail(
                labels.get(rows["event_id"][i], ""),
                rows["frame_number"][i],
                rows["value_1"][i],
                rows["value_2"][i],
            ),
            correlation_id=int(correlation_ids[i]),
        )
        for i, utc in enumerate(utc_ns)
    ]
    return tuple(sorted(events, key=lambda event: (event.utc_ns, event.name, event.detail)))


def _event_detail(name: str, frame_number: int, *values: float | None) -> str:
    text = event_text(name, *values)
    return f"frame {frame_number}: {text}" if text else f"frame {frame_number}"
