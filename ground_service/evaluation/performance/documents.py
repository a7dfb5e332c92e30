"""The performance of a month as a value for the report."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any, TypeVar

from ground_service.evaluation.performance.model import Performance
from ground_service.http.model import Entity
from reports.values import (
    HeadlineFigure,
    LevelChange,
    MeanByGroup,
    MonthlyReportValue,
    MonthPass,
    RequirementOverTime,
)

Value = TypeVar("Value", MonthPass, MeanByGroup, LevelChange, RequirementOverTime)


def monthly_value(found: Performance, month: str) -> MonthlyReportValue:
    """Return the report of a month as a value; it follows from the performance alone."""
    verdict, level = _verdict(found)
    if found.changes:
        count = len(found.changes)
        verdict += f"; {count} {'change' if count == 1 else 'changes'} of level"
    levels = sorted({one.terrain for one in found.passes})
    return MonthlyReportValue(
        title=f"Spacecraft {found.spacecraft_id} ({found.instance or 'all instances'}), {month}",
        month=month,
        verdict=verdict,
        verdict_level=level,
        evidence_level=levels[0] if len(levels) == 1 else "",
        headline=_headline(found),
        passes=tuple(
            _value(MonthPass, one, start_utc_ns=one.start.utc_ns, estimator=one.estimator or "")
            for one in found.passes
        ),
        groups=tuple(_value(MeanByGroup, one) for one in found.groups),
        changes=tuple(_value(LevelChange, one, utc_ns=one.time.utc_ns) for one in found.changes),
        requirements=tuple(_value(RequirementOverTime, one, limit=one.limit) for one in found.requirements),
        window_days=found.window_days,
        false_alarm_rate=found.false_alarm_rate,
        provenance={
            "reports": f"{_coverage(found)}; the newest report of each",
            "evidence levels": "; ".join(one or "not stated" for one in levels),
        },
        not_available={"data_sources": "stated in the reports of the passes"},
    )


def _verdict(found: Performance) -> tuple[str, str]:
    """Return verdict and level; "met" only if every pass is judged on every requirement with a limit."""
    failed = sum(one.not_met > 0 for one in found.requirements)
    judged = [one for one in found.requirements if one.met + one.not_met]
    unknown = [one for one in found.requirements if one.limit is not None and one.unknown]
    missing = found.passes_in_span - len(found.passes)
    if failed:
        verdict, level = f"requirements not met in every pass: {failed} of {len(judged)} judged", "not met"
    elif judged and not unknown and not missing:
        verdict, level = f"requirements met in every pass: {len(judged)} of {len(judged)} judged", "met"
    else:
        verdict, level = (
            f"requirements judged: {len(judged)} of {len(found.requirements)}, none missed",
            "unknown",
        )
    if unknown:
        worst = max(unknown, key=lambda one: one.unknown)
        verdict += f"; {worst.name} not judged on {worst.unknown} of {worst.passes} passes"
    if len(unknown) > 1:
        verdict += f", {len(unknown) - 1} more not judged on every pass"
    if missing:
        verdict += f"; {_coverage(found)}"
    return verdict, level


def _coverage(found: Performance) -> str:
    return f"{len(found.passes)} of {found.passes_in_span} passes have a report"


def _headline(found: Performance) -> tuple[HeadlineFigure, ...]:
    def mean(name: str) -> float | None:
        known = [float(value) for one in found.passes if (value := getattr(one, name)) is not None]
        return sum(known) / len(known) if known else None

    recall = mean("recall")
    return (
        HeadlineFigure("Passes", len(found.passes)),
        HeadlineFigure("Packets lost", sum(one.packets_lost for one in found.passes)),
        HeadlineFigure("Recall", None if recall is None else 100.0 * recall, "%", "mean of the passes"),
        HeadlineFigure("Drift", mean("drift_percent"), "% of path", "mean of the passes"),
        HeadlineFigure("Median error", mean("median_error_m"), "m", "mean of the passes"),
    )


def _value(kind: type[Value], entity: Entity, **values: Any) -> Value:
    """Return the fields of an entity as a value of a report, NaN where unknown; `values` replace them."""
    names = (one.name for one in fields(kind))
    found = {name: values[name] if name in values else getattr(entity, name) for name in names}
    unknown = {name: math.nan for name, value in found.items() if value is None and name not in values}
    return kind(**found | unknown)
