"""Time and size of reports: python -m benchmarks report_pages.

The day is 5,760 frames at 15 s, 26 imaging arcs, three estimators, three baselines, sixteen images.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from benchmarks._rows import Row
from reports.render import render_html, render_pages, to_json
from tests.reports import example


def bench() -> dict[str, Any]:
    """Seconds (wall and processor) and megabytes of each form, after one small report that loads everything."""
    render_html(example.pass_report(hours=0.1, gallery=1, worst=0))
    figures: dict[str, Any] = {}
    for name, report in (
        ("pass", example.pass_report()),
        ("day", example.pass_report(hours=24.0)),
    ):
        figures[name] = {
            "html": _measured(lambda r=report: render_html(r).encode()),
            "pdf": _measured(lambda r=report: render_pages(r)[1]),
            "json": _measured(lambda r=report: to_json(r).encode()),
        }
    return figures


def rows() -> Iterator[Row]:
    """Yield the processor time of each document; the peer is the same report as data."""
    for report, documents in bench().items():
        for form in ("html", "pdf"):
            spent = documents[form]["cpu_s"]
            yield Row(
                f"report of {report.replace('_', ' ')}: {form}",
                spent,
                "s",
                "JSON",
                documents["json"]["cpu_s"],
            )


def _measured(make: Callable[[], bytes]) -> dict[str, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    octets = make()
    return {
        "wall_s": round(time.perf_counter() - wall, 2),
        "cpu_s": round(time.process_time() - cpu, 2),
        "mb": round(len(octets) / 1e6, 2),
    }
