"""Statistics of the residuals that the payload reported for its optional instruments."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lunar.arrays import FloatArray
from reports.values import InstrumentReport, QuantityStatistics, ResidualStatistics
from tmtc.fields import Field
from tmtc.instruments import SAMPLE_STATUSES, InstrumentTelemetry, Residual, instrument_telemetry
from tmtc.schema import Table

_CODES = {name: code for code, name in SAMPLE_STATUSES}


def instrument_reports(tables: Mapping[str, Table]) -> tuple[InstrumentReport, ...]:
    """Return the statistics of each instrument that reported samples.

    Parameters
    ----------
    tables
        Decoded packets of instruments by name.
    """
    return tuple(
        _report(one, tables[one.name])
        for one in instrument_telemetry()
        if one.name in tables and tables[one.name].items["sample_status"].size
    )


def _report(instrument: InstrumentTelemetry, table: Table) -> InstrumentReport:
    status = np.asarray(table.items["sample_status"])
    counts = {name: int(np.count_nonzero(status == code)) for name, code in _CODES.items()}
    used = status == _CODES["used"]
    return InstrumentReport(
        instrument.name,
        instrument.title,
        frames=len(table),
        samples=int(status.size),
        used=counts["used"],
        gated=counts["gated"],
        no_data=counts["no_data"],
        no_model=counts["no_model"],
        residuals=tuple(
            _statistics(
                one,
                np.asarray(table.items[one.field], dtype=np.float64)[used],
                np.asarray(table.items[one.sigma_field], dtype=np.float64)[used],
            )
            for one in instrument.residuals
        ),
        quantities=tuple(
            _quantity(field, np.asarray(table.items[field.name], dtype=np.float64))
            for field in instrument.sample_fields
            if field.name in instrument.quantities
        ),
    )


def _quantity(field: Field, values: FloatArray) -> QuantityStatistics:
    values = values[np.isfinite(values)]
    if not values.size:
        nan = float("nan")
        return QuantityStatistics(field.description, field.unit, 0, nan, nan, nan)
    return QuantityStatistics(
        field.description,
        field.unit,
        int(values.size),
        float(np.min(values)),
        float(np.mean(values)),
        float(np.max(values)),
    )


def _statistics(residual: Residual, values: FloatArray, sigma: FloatArray) -> ResidualStatistics:
    """Return the statistics of the residuals that the estimator used; NaN without any."""
    known = np.isfinite(values) & np.isfinite(sigma) & (sigma > 0.0)
    values, sigma = values[known], sigma[known]
    if not values.size:
        nan = float("nan")
        return ResidualStatistics(residual.label, residual.unit, 0, nan, nan, nan, nan)
    scaled = residual.scale * values
    return ResidualStatistics(
        residual.label,
        residual.unit,
        int(values.size),
        float(np.mean(scaled)),
        float(np.sqrt(np.mean(scaled**2))),
        float(np.percentile(np.abs(scaled), 95.0)),
        float(np.mean((values / sigma) ** 2)),
    )
