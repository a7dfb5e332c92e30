"""The closing report of a mission run as an HTML page."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

_STYLE = (
    "body{font-family:sans-serif;margin:2em;max-width:70em}table{border-collapse:collapse;margin:1em 0}"
    "td,th{border-bottom:1px solid #ccc;padding:.25em .8em;text-align:left}"
)

SECTIONS = (
    "windows", "navigation", "detector", "verdicts", "requirements", "trends", "evidence", "reports_lack",
    "time_correlation", "memory_mib", "cpu_s",
)  # fmt: skip
COLUMNS = (
    "window", "start", "state", "contacts_to_processed", "frames", "packets_lost", "verdict", "recall",
    "median_m", "drift_percent", "nees_inside_percent", "not_met", "lacks", "evidence",
)  # fmt: skip
INCIDENT = ("utc", "kind", "text", "recovery")


def save_document(figures: Mapping[str, Any], path: Path) -> None:
    """Write the page of closing figures."""
    plain = [(name, value) for name, value in figures.items() if not isinstance(value, dict | list)]
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        f"<title>Mission run {_text(figures['scenario'])}</title><style>{_STYLE}</style></head><body>",
        f"<h1>Mission run {_text(figures['scenario'])}, {figures['days']:g} days</h1>",
        _table(("figure", "value"), plain),
    ]
    for name in SECTIONS:
        rows = [(key, _flat(value)) for key, value in figures[name].items()]
        parts += [f"<h2>{_text(name.replace('_', ' '))}</h2>", _table(("", "value"), rows)]
    trend = figures["trend"]
    parts += [
        "<h2>Windows in order of time</h2>",
        _table(COLUMNS, [[_flat(row.get(column)) for column in COLUMNS] for row in trend]),
        "<h2>Incidents</h2>",
        _table(
            INCIDENT,
            [
                [_flat(one[column]) if column != "recovery" else one[column] or "none" for column in INCIDENT]
                for one in figures["incidents"]
            ],
        ),
        "<h2>Interventions</h2>",
        _table(("utc", "text"), [(one["utc"], one["text"]) for one in figures["interventions_list"]]),
        "</body></html>\n",
    ]
    path.write_text("\n".join(parts), encoding="utf-8")


def _table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    top = "".join(f"<th>{_text(one)}</th>" for one in head)
    body = "".join("<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{top}</tr>{body}</table>"


def _flat(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_flat(one)}" for name, one in value.items())
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return "unknown" if value is None else str(value)


def _text(value: Any) -> str:
    return html.escape("unknown" if value is None else str(value))
