"""Time correlation: whole nanoseconds in and out, drift and offset found, outliers left out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ground_service.errors import EvaluationError
from ground_service.missions.timekeeping.core import (
    IDEAL_CLOCK,
    TimeCorrelation,
    fit_correlation,
    ticks_of_utc_ns,
    utc_ns_of_ticks,
)
from lunar.timescales import parse_utc, ticks_from_utc_ns, utc_ns_from_ticks

START = parse_utc("2029-08-07T00:00:00Z")
NS = 1_000_000_000
TICK_NS = 1e9 / 65_536


def reports(drift_ppb: float, offset_ns: int, count: int = 200, step_s: int = 60) -> tuple[np.ndarray, ...]:
    """Ticks, reception times and light times of a clock whose ticks are too long by `drift_ppb`."""
    utc = START + np.arange(count, dtype=np.int64) * step_s * NS
    shown = utc - offset_ns - np.rint((utc - START) * drift_ppb * 1e-9).astype(np.int64)
    light = np.full(count, 1_280_000_000) + np.arange(count) * 1000
    return np.asarray(ticks_from_utc_ns(shown)), utc + light, light


def line_of(fit: object) -> TimeCorrelation:
    names = ("start_ticks", "stop_ticks", "reference_ticks", "reference_utc_ns", "drift_ppb")
    return TimeCorrelation(7, *(getattr(fit, name) for name in names))


@pytest.mark.parametrize("drift_ppb", [-20_000.0, 0.0, 350.0])
def test_offset_and_drift_of_a_clock_are_found_to_its_resolution(drift_ppb: float) -> None:
    """200 reports over 3.3 h, each rounded to a tick of 15 us: the drift is known to about 15 us / 6000 s = 2.5 ppb."""
    ticks, received, light = reports(drift_ppb, 3 * NS)
    fit = fit_correlation(ticks, received, light)
    assert fit.drift_ppb == pytest.approx(drift_ppb, abs=3.0)
    assert fit.residual_rms_ns < TICK_NS
    utc, used = utc_ns_of_ticks(ticks, [line_of(fit)])
    assert np.abs(utc - (received - light)).max() < 2 * TICK_NS
    assert set(used.tolist()) == {7}


def test_wrong_reports_are_left_out() -> None:
    ticks, received, light = reports(500.0, 0)
    received = received.copy()
    received[[5, 77, 150]] += np.array([2, -40, 7]) * NS
    fit = fit_correlation(ticks, received, light)
    assert (fit.points, fit.rejected) == (197, 3)
    assert fit.drift_ppb == pytest.approx(500.0, abs=3.0)


def test_one_report_gives_an_offset_and_none_is_refused() -> None:
    ticks, received, light = reports(0.0, NS, count=1)
    fit = fit_correlation(ticks, received, light)
    assert (fit.points, fit.drift_ppb) == (1, 0.0)
    assert line_of(fit).utc_ns(ticks)[0] == received[0] - light[0]
    with pytest.raises(EvaluationError, match="expected at least one time report"):
        fit_correlation(ticks[:0], received[:0], light[:0])


def test_without_correlations_the_clock_is_ideal() -> None:
    ticks = np.array([0, 1 << 40], dtype=np.int64)
    utc, used = utc_ns_of_ticks(ticks, [])
    assert utc.tolist() == [int(utc_ns_from_ticks(int(t))) for t in ticks]
    assert set(used.tolist()) == {IDEAL_CLOCK}


def test_the_correlation_nearest_in_time_is_used_outside_all_of_them() -> None:
    one = TimeCorrelation(1, 0, 100, 0, START, 0.0)
    two = TimeCorrelation(2, 1000, 1100, 1000, START, 0.0)
    _, used = utc_ns_of_ticks(np.array([-5, 50, 400, 700, 2000]), [one, two])
    assert used.tolist() == [1, 1, 1, 2, 2]


@given(after_s=st.integers(-86_400 * 300, 86_400 * 300), drift_ppb=st.floats(-50_000, 50_000))
def test_ticks_and_time_are_inverse(after_s: int, drift_ppb: float) -> None:
    line = TimeCorrelation(1, 0, 1 << 50, int(ticks_from_utc_ns(START)), START, drift_ppb)
    utc = START + after_s * NS
    ticks = ticks_of_utc_ns(utc, [line])
    assert abs(int(line.utc_ns(np.array([ticks]))[0]) - utc) <= 2 * TICK_NS
