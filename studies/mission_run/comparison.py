"""Comparison of the closing figures of two mission runs, without those of processes and of the wall clock."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from payload_emulator.errors import ScenarioError

REPORT = "report.json"

OF_PROCESSES = frozenset(
    {"alarms", "form", "interventions_list", "kills", "monthly_reports", "starts", "wall_s"}
)
"""Figures that depend on processes and the wall clock; the numbers of interventions and alarms are compared."""

SKIPPED = frozenset({"pass_id", "report_id", "limit"})
"""Numbers that a database gives, and limits of requirements, some of which are the errors of a baseline."""

MISSING = "missing"
SHOWN_LIMIT = 60


@dataclass(frozen=True, slots=True)
class Difference:
    """A figure by its path in the report, and its values in both runs; `MISSING` where a report does not have it."""

    figure: str
    first: Any
    second: Any


def load_report(place: Path) -> dict[str, Any]:
    """Return the closing figures of a run by its folder or its file.

    Raises
    ------
    ScenarioError
        There is no closing report.
    """
    path = place / REPORT if place.is_dir() else place
    try:
        figures = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ScenarioError(
            f"{path}: expected the closing report of a mission run, found none ({error})"
        ) from None
    if not isinstance(figures, dict) or not {"scenario", "days", "windows", "performance"} <= figures.keys():
        raise ScenarioError(f"{path}: expected the closing report of a mission run, found another file")
    return figures


def compare_reports(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[int, list[Difference]]:
    """Return the number of compared values, and those that are not identical."""
    found = [dict(_values("", _compared(one))) for one in (first, second)]
    names = list(dict.fromkeys([*found[0], *found[1]]))
    pairs = [(name, found[0].get(name, MISSING), found[1].get(name, MISSING)) for name in names]
    return len(names), [Difference(*one) for one in pairs if not _are_same(one[1], one[2])]


def comparison(first: Path, second: Path) -> dict[str, Any]:
    """Return the comparison of two runs, with the figures that are not compared side by side."""
    reports = load_report(first), load_report(second)
    values, differences = compare_reports(*reports)
    return {
        "runs": [str(first), str(second)],
        "values": values,
        "differences": [asdict(one) for one in differences],
        "largest_relative": largest_relative(differences),
        "figures": _side_by_side(reports, "compared"),
        "not_compared": _side_by_side(reports, "not compared"),
        "kills": [one.get("kills") for one in reports],
    }


def described(found: Mapping[str, Any]) -> str:
    """Return a comparison as text."""
    lines = [_line("figure", "first run", "second run")]
    lines += [_line(name, *values) for name, values in found["figures"].items()]
    lines += ["", "not compared:"]
    lines += [_line(name, *values) for name, values in found["not_compared"].items()]
    for name, kills in zip(("first", "second"), found["kills"], strict=True):
        if kills:
            lines += ["", f"kills of the {name} run: {json.dumps(kills)}"]
    lines.append("")
    differences = found["differences"]
    for one in differences[:SHOWN_LIMIT]:
        lines.append(f"{one['figure']}: {one['first']} in the first run, {one['second']} in the second")
    if len(differences) > SHOWN_LIMIT:
        lines.append(f"... and {len(differences) - SHOWN_LIMIT} more")
    largest = found["largest_relative"]
    by = ""
    if differences and largest is not None:
        by = f", all of them numbers, by at most {largest:.1e} of their value"
    lines.append(f"{found['values']} values compared, {len(differences)} differ{by}")
    return "\n".join(lines)


def _compared(report: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in report.items() if name not in OF_PROCESSES}


def largest_relative(differences: Sequence[Difference]) -> float | None:
    """Return the largest difference of two numbers relative to the larger one; None if other values differ."""
    largest = 0.0
    for one in differences:
        if type(one.first) is not float or type(one.second) is not float:
            return None
        if not (math.isfinite(one.first) and math.isfinite(one.second)):
            return None
        largest = max(largest, abs(one.first - one.second) / max(abs(one.first), abs(one.second)))
    return largest


def _values(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the values in a part of a report by their paths; an empty list or object is a value."""
    if isinstance(value, dict) and value:
        for key, one in value.items():
            if key not in SKIPPED:
                yield from _values(f"{name}.{key}" if name else key, one)
    elif isinstance(value, list) and value:
        for k, one in enumerate(value):
            yield from _values(f"{name}[{k}]", one)
    else:
        yield name, value


def _are_same(first: Any, second: Any) -> bool:
    """Return whether two values are identical; NaN is identical to NaN, 1 is not to true."""
    return type(first) is type(second) and (first == second or (first != first and second != second))


def _side_by_side(reports: tuple[dict[str, Any], dict[str, Any]], which: str) -> dict[str, list[Any]]:
    """Return the numbers and texts at the top of two reports, and those one level below, by name."""
    rows = []
    for report in reports:
        plain: dict[str, Any] = {}
        for name, value in report.items():
            if (name in OF_PROCESSES) != (which == "not compared"):
                continue
            if name in ("windows", "detector"):
                plain |= {f"{name}.{key}": one for key, one in value.items() if not isinstance(one, dict)}
            elif name == "navigation":
                plain |= {f"{key} median_m": one["median_m"] for key, one in value.items()}
            elif not isinstance(value, dict | list):
                plain[name] = value
        rows.append(plain)
    names = dict.fromkeys([*rows[0], *rows[1]])
    return {name: [row.get(name, MISSING) for row in rows] for name in names}


def _line(name: str, first: Any, second: Any) -> str:
    return f"{name:<28} {first!s:>24} {second!s:>24}"
