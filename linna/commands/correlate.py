"""`linna correlate list | residuals | run | receptions`: time correlation of a spacecraft."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from linna.commands._table import Command, Option
from linna.output import log

if TYPE_CHECKING:
    from ground_service.client import Client
    from ground_service.ingest.model import ImplausiblePacket
    from ground_service.missions.timekeeping.model import Correlation, TimeReport

BLOCK = 10_000
"""Number of receptions in one request."""


def _list(service: Client, *, spacecraft_id: int, instance: str = "flight", all: bool = False) -> list[Correlation]:
    rows = service.list_correlations(spacecraft_id, instance=instance)
    return rows if all else sorted((row for row in rows if row.in_force), key=lambda row: row.start_ticks)


def _receptions(service: Client, file: Path, *, spacecraft_id: int, instance: str = "flight") -> list[Correlation]:
    from ground_service.missions.timekeeping.recorrelation import read_receptions
    from lunar.timescales import format_utc

    given = [
        {
            "packet_ticks": one.ticks,
            "sequence_count": one.sequence_count,
            "received": format_utc(one.earth_utc_ns),
            "station": one.station,
        }
        for one in read_receptions(file)
    ]
    rows: list[Correlation] = []
    for start in range(0, len(given), BLOCK):
        rows = service.add_receptions(spacecraft_id, given[start : start + BLOCK], instance=instance)
    reports = service.list_time_reports(spacecraft_id, instance=instance)
    for remark in sorted({one.remark for one in reports} - {""}):
        log(f"linna: warning: {remark}: {sum(one.remark == remark for one in reports)} time reports do not count")
    return rows


def _segment(row: Correlation) -> str:
    return (
        f"{row.id:>5}  boot {row.boot_count}  from {row.reference}  drift {row.drift_ppb:+.1f} ppb  "
        f"{row.points} reports ({row.rejected} rejected)  rms {(row.residual_rms_ns or 0.0) * 1e-3:.1f} us"
        f"{'' if row.in_force else '  not in force'}"
    )


def _residual(row: TimeReport) -> str:
    return (
        f"{row.received}  boot {row.boot_count}  light time {row.light_time_s:.6f} s  "
        f"correlation {row.correlation_id}  residual {row.residual_ns * 1e-3:+.1f} us"
        f"{f'  {row.remark}' if row.remark else ''}"
    )


def _implausible(row: ImplausiblePacket) -> str:
    return f"{row.time}  APID {row.apid}  count {row.sequence_count}  ingest {row.ingest_id}: {row.reason}"


SEGMENTS = (_segment, "correlations", "no time correlation: the on-board clock is assumed to be ideal")
CORRELATE = {
    "list": Command(
        _list,
        "list the segments in force, one for each run of the clock",
        *SEGMENTS,
        options={"all": "also segments that are no longer in force"},
    ),
    "residuals": Command(
        "list_time_reports",
        "list the received time reports and their residuals",
        _residual,
        "time_reports",
        "no time reports with a known reception time",
    ),
    "implausible": Command(
        "list_implausible",
        "list the packets that are kept apart because their on-board time is implausible",
        _implausible,
        "packets",
        "no packets with an implausible on-board time",
    ),
    "withdraw-ingest": Command(
        "withdraw_ingest",
        "withdraw a received file, such as one of another flight: everything is derived again without it",
        lambda row: f"ingest {row.id}: {row.state}",
        options={"reason": "what is wrong with it"},
    ),
    "run": Command(
        "run_correlation",
        "fit the segments again from the received time reports; this replaces segments entered by hand",
        *SEGMENTS,
    ),
    "withdraw": Command(
        "withdraw_correlations",
        "withdraw segments entered by hand; those of the received time reports are in force again",
        *SEGMENTS,
    ),
    "receptions": Command(
        _receptions,
        "enter reception times of time reports (CSV)",
        *SEGMENTS,
        options={"file": Option("columns packet_ticks, sequence_count, received_utc; optional: station", "file")},
    ),
}
