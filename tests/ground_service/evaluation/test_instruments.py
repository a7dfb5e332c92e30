"""Statistics of instruments from decoded packets, counted by hand, and their section of the report."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ground_service.evaluation import instruments as module
from ground_service.evaluation.core import evaluate_pass, summary_of
from ground_service.evaluation.instruments import instrument_reports
from reports.document import Absent, Table
from reports.sections.instruments import instruments
from reports.values import InstrumentReport, PassReport, QuantityStatistics, ResidualStatistics
from tests.ground_service.evaluation.test_pass_evaluation import inputs
from tmtc.fields import Field
from tmtc.instruments import InstrumentTelemetry, Residual, sample_packet
from tmtc.schema import Dictionary
from tmtc.stream import cut_packets

PACKET = sample_packet(
    "sextant",
    200,
    "Angles",
    (Field("angle", "f64", "Residual", "rad"), Field("sigma", "f64", "Sigma", "rad")),
)
SEXTANT = InstrumentTelemetry(
    "sextant", "sextant", 4, PACKET, (Residual("angle", "angle", "sigma", "arcsec", 206_264.806),)
)


def tables(rows: list[list[tuple[int, float, float]]]) -> Any:
    dictionary = Dictionary(9, (PACKET,))
    octets = b"".join(
        dictionary.pack(
            "sextant",
            {
                "frame_number": k,
                "frame_ticks": 100 * k,
                "items": [
                    {"sample_ticks": 1, "sample_status": status, "angle": angle, "sigma": sigma}
                    for status, angle, sigma in samples
                ],
            },
            ticks=k,
            sequence_count=k,
        )
        for k, samples in enumerate(rows)
    )
    return dictionary.unpack_many(octets, cut_packets(octets))


@pytest.fixture(autouse=True)
def _declared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "instrument_telemetry", lambda: (SEXTANT,))


def test_samples_are_counted_by_status_and_only_used_ones_have_residuals() -> None:
    nan = math.nan
    (found,) = instrument_reports(
        tables(
            [
                [(0, 1e-5, 1e-5), (0, -3e-5, 1e-5), (1, 9.0, 1e-5)],
                [(2, nan, nan), (3, nan, nan), (0, nan, 1e-5)],
            ]
        )
    )
    assert (found.frames, found.samples) == (2, 6)
    assert (found.used, found.gated, found.no_data, found.no_model) == (3, 1, 1, 1)
    (angle,) = found.residuals
    assert (angle.label, angle.unit, angle.samples) == ("angle", "arcsec", 2)
    arcsec = 206_264.806
    assert angle.mean == pytest.approx(-1e-5 * arcsec)
    assert angle.rms == pytest.approx(math.sqrt(5.0) * 1e-5 * arcsec)
    assert angle.p95_absolute == pytest.approx(2.9e-5 * arcsec)
    assert angle.normalised_square == pytest.approx(5.0)


def test_the_range_of_a_declared_quantity_is_taken_over_all_known_samples(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        module, "instrument_telemetry", lambda: (replace(SEXTANT, residuals=(), quantities=("angle",)),)
    )
    (found,) = instrument_reports(tables([[(3, 1.0, 0.0), (1, math.nan, 0.0)], [(0, 4.0, 0.0)]]))
    assert found.residuals == ()
    assert found.quantities == (QuantityStatistics("Residual", "rad", 2, 1.0, 2.5, 4.0),)
    (none,) = instrument_reports(tables([[(2, math.nan, 0.0)]]))
    assert none.quantities[0].samples == 0
    _, table = section(found, none)
    assert isinstance(table, Table)
    assert table.rows == (
        ("sextant: Residual", "2", "1 rad", "2.5 rad", "4 rad"),
        ("sextant: Residual", "0", "unknown", "unknown", "unknown"),
    )


def test_without_packets_or_samples_there_is_no_report() -> None:
    assert instrument_reports({}) == ()
    assert instrument_reports(tables([[]])) == ()


def test_residuals_are_unknown_where_no_sample_was_used() -> None:
    ((angle,),) = (one.residuals for one in instrument_reports(tables([[(2, math.nan, math.nan)]])))
    assert angle.samples == 0
    assert np.isnan([angle.mean, angle.rms, angle.p95_absolute, angle.normalised_square]).all()


def section(*found: InstrumentReport) -> list[Any]:
    from reports.sections.common import PassView

    view = PassView.__new__(PassView)
    object.__setattr__(view, "report", PassReport("t", "1", instruments=found))
    return instruments(view)


def test_the_section_shows_shares_and_residuals_and_says_unknown_without_a_number() -> None:
    known = ResidualStatistics("angle", "arcsec", 2, -2.0626, 4.612, 5.98, 5.0)
    unknown = ResidualStatistics("roll", "arcsec", 0, math.nan, math.nan, math.nan, math.nan)
    _, samples, residuals = section(
        InstrumentReport("sextant", "sextant", 2, 6, 3, 1, 1, 1, (known, unknown))
    )
    assert isinstance(samples, Table) and isinstance(residuals, Table)
    assert samples.rows == (("sextant", "6", "50.0\u202f%", "16.7\u202f%", "16.7\u202f%", "16.7\u202f%"),)
    assert residuals.rows[0] == ("sextant: angle", "2", "-2.06 arcsec", "4.61 arcsec", "5.98 arcsec", "5.00")
    assert residuals.rows[1] == ("sextant: roll", "0", "unknown", "unknown", "unknown", "unknown")


def test_the_section_says_that_no_instrument_reported() -> None:
    _, absent = section()
    assert isinstance(absent, Absent)
    assert absent.why == "no packet of an optional instrument was received"


def test_the_pass_report_and_its_summary_carry_the_statistics() -> None:
    found = instrument_reports(tables([[(0, 1e-5, 1e-5)]]))
    report = evaluate_pass(inputs(instruments=found))
    assert report.instruments == found
    assert summary_of(report)["instruments"]["sextant"]["used"] == 1
    assert summary_of(evaluate_pass(inputs()))["instruments"] == {}
