"""Optional instruments of the payload: use of their samples and residuals."""

from __future__ import annotations

import math

from reports.document import Block, Column, Heading, Table
from reports.sections.common import PassView
from reports.text import count_text, percent_text
from reports.values import QuantityStatistics, ResidualStatistics

_UNKNOWN = "unknown"


def instruments(view: PassView) -> list[Block]:
    """Return the tables of samples and of residuals; where no instrument reported, the reason."""
    found = view.report.instruments
    heading = Heading("Instruments")
    if not found:
        return [heading, view.absent("instruments", "Instruments")]
    samples = tuple(
        (
            one.title,
            count_text(one.samples),
            percent_text(one.used, one.samples),
            percent_text(one.gated, one.samples),
            percent_text(one.no_data, one.samples),
            percent_text(one.no_model, one.samples),
        )
        for one in found
        if one.residuals
    )
    residuals = tuple(
        (f"{one.title}: {residual.label}", count_text(residual.samples), *_numbers(residual))
        for one in found
        for residual in one.residuals
    )
    measured = tuple(
        (f"{one.title}: {quantity.label}", count_text(quantity.samples), *_range(quantity))
        for one in found
        for quantity in one.quantities
    )
    tables = (
        Table(
            "Samples of the optional instruments, as the payload reported their use.",
            (
                Column("instrument", numeric=False),
                Column("samples"),
                Column("used"),
                Column("refused by the gate"),
                Column("no value"),
                Column("not predicted"),
            ),
            samples,
            note="Not predicted: the estimator had no attitude, no surface or no orbit for the sample.",
        ),
        Table(
            "Residuals of the used samples: measurement minus prediction before the update.",
            (
                Column("residual", numeric=False),
                Column("samples"),
                Column("mean"),
                Column("rms"),
                Column("95 %"),
                Column("square over variance"),
            ),
            residuals,
            note="The last column is the mean of (residual / predicted sigma)\u00b2, 1 for a consistent estimator.",
        ),
        Table(
            "Measured quantities.",
            (
                Column("quantity", numeric=False),
                Column("samples"),
                Column("minimum"),
                Column("mean"),
                Column("maximum"),
            ),
            measured,
        ),
    )
    return [heading, *(table for table in tables if table.rows)]


def _range(quantity: QuantityStatistics) -> tuple[str, str, str]:
    form = f",.4g {quantity.unit}"
    return (_text(quantity.minimum, form), _text(quantity.mean, form), _text(quantity.maximum, form))


def _numbers(residual: ResidualStatistics) -> tuple[str, str, str, str]:
    unit = residual.unit
    return (
        _text(residual.mean, f"+,.3g {unit}"),
        _text(residual.rms, f",.3g {unit}"),
        _text(residual.p95_absolute, f",.3g {unit}"),
        _text(residual.normalised_square, ".2f"),
    )


def _text(value: float, form: str) -> str:
    if math.isnan(value):
        return _UNKNOWN
    layout, _, unit = form.partition(" ")
    return f"{value:{layout}} {unit}".strip()
