"""Rows of the store as plain values: what the interface sends and the commands print. Times are RFC 3339 UTC."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ground_service.commanding.core import STAGES
from ground_service.passes.series import Series
from ground_service.planning.core import Candidate, SearchResult
from ground_service.store.repository import Row
from lunar.timescales import format_utc
from tmtc.codes import FAILURES

_FAILURES = dict(FAILURES)

View = dict[str, Any]


def time_text(utc_ns: int) -> str:
    """A time as text, to the nanosecond."""
    return format_utc(int(utc_ns), 9)


def optional_time(utc_ns: int | None) -> str | None:
    """A time as text where there is one."""
    return None if utc_ns is None else time_text(utc_ns)


def ephemeris_view(row: Row) -> View:
    """A reference ephemeris."""
    return {
        "id": row["id"],
        "name": row["name"],
        "object_name": row["object_name"],
        "frame": row["frame"],
        "start": time_text(row["start_utc_ns"]),
        "stop": time_text(row["stop_utc_ns"]),
        "states": row["states"],
        "precedence": row["precedence"],
        "sha256": row["file_sha256"],
    }


def ingest_view(row: Row) -> View:
    """One ingest of one file."""
    return {
        "id": row["id"],
        "state": row["state"],
        "sha256": row["file_sha256"],
        "received": time_text(row["received_utc_ns"]),
        "finished": optional_time(row["finished_utc_ns"]),
        "error": row["error"],
        "dictionary_version": row["dictionary_version"],
        "accounting": row["accounting"],
    }


def pass_view(row: Row) -> View:
    """A pass in a list."""
    return {
        "id": row["id"],
        "name": row["name"],
        "start": time_text(row["start_utc_ns"]),
        "stop": time_text(row["stop_utc_ns"]),
    }


def pass_detail_view(row: Row) -> View:
    """A pass with its spacecraft, manifest and reports, as `services.passes.get_pass` gives it."""
    return {
        **pass_view(row),
        "spacecraft_id": row["spacecraft_id"],
        "instance": row["instance"],
        "archive_sha256": row["archive_digest"],
        "mission": row["mission"],
        "mission_revision": row["mission_revision"],
        "manifest": row["manifest"],
        "reports": row["reports"],
    }


def job_view(row: Row) -> View:
    """A piece of background work."""
    return {
        "id": row["id"],
        "kind": row["kind"],
        "state": row["state"],
        "progress": row["progress"],
        "attempts": row["attempts"],
        "arguments": row["arguments"],
        "result": row["result"],
        "error": row["error"],
        "created": time_text(row["created_utc_ns"]),
        "started": optional_time(row["started_utc_ns"]),
        "finished": optional_time(row["finished_utc_ns"]),
    }


def telecommand_view(view: Any) -> View:
    """Return a telecommand (`services.commanding.CommandView`) with its verification state."""
    row, fate = view.row, view.fate
    return {
        "id": row["id"],
        "name": row["name"],
        "arguments": row["arguments"],
        "spacecraft_id": view.spacecraft_id,
        "instance": view.instance,
        "state": view.state,
        "critical": bool(row["critical"]),
        "timed_out": fate is not None and fate.timed_out,
        "requested_by": row["requested_by"],
        "requested": time_text(row["created_utc_ns"]),
        "decided_by": row["decided_by"],
        "decided": optional_time(row["decided_utc_ns"]),
        "reason": row["reason"],
        "sequence_count": row["sequence_count"],
        "sent": optional_time(row["sent_utc_ns"]),
        "window_id": row["window_id"],
        "carrier_id": row["carrier_id"],
        "reports": [
            {
                "stage": STAGES.get(report.subtype, str(report.subtype)),
                "ticks": report.ticks,
                "step": report.step,
                "failure": None
                if report.failure_code is None
                else _FAILURES.get(report.failure_code, str(report.failure_code)),
            }
            for report in (fate.reports if fate is not None else ())
        ],
    }


def candidate_view(candidate: Candidate) -> dict[str, Any]:
    """A candidate as plain values, in the units of the interface."""

    def degrees(limits: tuple[float, float]) -> dict[str, float]:
        return {"min": math.degrees(limits[0]), "max": math.degrees(limits[1])}

    craters = candidate.craters_per_frame
    return {
        "start": time_text(candidate.start_utc_ns),
        "stop": time_text(candidate.stop_utc_ns),
        "frames": candidate.frames,
        "altitude_km": {"min": candidate.altitude_m[0] / 1e3, "max": candidate.altitude_m[1] / 1e3},
        "sun_elevation_deg": degrees(candidate.sun_elevation_rad),
        "latitude_deg": degrees(candidate.latitude_rad),
        "sunlit_share": candidate.sunlit_share,
        "craters_per_frame": None if craters is None else {"min": craters[0], "max": craters[1]},
        "mare_share": candidate.mare_share,
        "data_octets": candidate.data_octets,
        "energy_wh": candidate.energy_wh,
        "battery_minimum": candidate.battery_minimum,
        "storage_peak_octets": candidate.storage_peak_octets,
        "downlinked_by": optional_time(candidate.downlinked_by_utc_ns),
    }


def search_view(found: SearchResult, ephemeris: Row, names: tuple[str, ...]) -> View:
    """What a search of windows found."""
    return {
        "ephemeris_id": ephemeris["id"],
        "data": list(names),
        "candidates": [candidate_view(candidate) for candidate in found.candidates],
        "contacts": [
            {
                "station": contact.station,
                "start": time_text(contact.start_utc_ns),
                "stop": time_text(contact.stop_utc_ns),
            }
            for contact in found.contacts
        ],
        "refused": found.refused,
    }


def window_view(row: Row) -> View:
    """A planned window, as `services.planning.window_row` gives it."""
    kept = (
        "id", "name", "cadence_s", "state", "reason", "spacecraft_id", "instance", "predecessor_id",
        "ephemeris_id", "pass_id", "data_octets", "predicted", "telecommands", "version", "created_by",
    )  # fmt: skip
    return {
        **{name: row[name] for name in kept},
        "start": time_text(row["start_utc_ns"]),
        "stop": time_text(row["stop_utc_ns"]),
        "created": time_text(row["created_utc_ns"]),
        "changed": time_text(row["changed_utc_ns"]),
    }


def series_view(series: Series) -> View:
    """A series made short. Buckets are many, so their times are written all at once."""
    buckets = series.buckets
    columns = (
        _time_texts(buckets.start_utc_ns),
        _time_texts(buckets.stop_utc_ns),
        buckets.count.tolist(),
        buckets.low.tolist(),
        buckets.high.tolist(),
        buckets.mean.tolist(),
        buckets.after_gap.tolist(),
    )
    names = ("start", "stop", "count", "min", "max", "mean", "after_gap")
    return {
        "name": series.name,
        "unit": series.unit,
        "samples": series.samples,
        "correlation_id": series.correlation_id,
        "buckets": [dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True)],
    }


def _time_texts(utc_ns: Any) -> list[str]:
    """As `time_text`, of many times."""
    texts = np.datetime_as_string(np.asarray(utc_ns, dtype=np.int64).astype("datetime64[ns]"), unit="ns")
    return [f"{text}Z" for text in texts.tolist()]


def time_report_view(report: Mapping[str, Any]) -> View:
    """A received time report."""
    rest = {name: value for name, value in report.items() if name != "received_utc_ns"}
    return {**rest, "received": time_text(report["received_utc_ns"])}


def correlation_view(row: Row) -> View:
    """A time correlation."""
    kept = (
        "id", "boot_count", "start_ticks", "stop_ticks", "reference_ticks", "drift_ppb", "residual_rms_ns",
        "residual_max_ns", "points", "rejected", "method",
    )  # fmt: skip
    return {
        **{name: row[name] for name in kept},
        "reference": time_text(row["reference_utc_ns"]),
        "in_force": not row["superseded"],
        "created": time_text(row["created_utc_ns"]),
    }
