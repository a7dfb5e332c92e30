"""Time correlation: whole nanoseconds, drift, offset and outliers; what depends on it moves at once."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from pytest import approx, mark, raises

from ground_service.errors import EvaluationError, InvalidInput, NotFound
from ground_service.ingest.service import ingest_file
from ground_service.missions.timekeeping.core import (
    IDEAL_CLOCK,
    TimeCorrelation,
    clock_runs,
    doubted_stations,
    fit_correlation,
    moved_ticks,
    ticks_of_utc_ns,
    utc_ns_of_ticks,
)
from ground_service.missions.timekeeping.recorrelation import TimePoint, TimeReports, correlate, fit_runs
from ground_service.missions.timekeeping.store import correlations_on_record
from ground_service.passes.service import define_pass, parameter_series
from lunar.timescales import parse_utc, ticks_from_utc_ns, utc_ns_from_ticks
from tests.ground_service.conftest import cells

START = parse_utc("2029-08-07T00:00:00Z")
NS = 1_000_000_000
TICK_NS = 1e9 / 65_536


def reports(drift_ppb, offset_ns, count=200, step_s=60):
    """Ticks, reception times and light times of a clock whose ticks are too long by `drift_ppb`."""
    utc = START + np.arange(count, dtype=np.int64) * step_s * NS
    shown = utc - offset_ns - np.rint((utc - START) * drift_ppb * 1e-9).astype(np.int64)
    light = np.full(count, 1_280_000_000) + np.arange(count) * 1000
    return np.asarray(ticks_from_utc_ns(shown)), utc + light, light


def line_of(fit):
    names = ("start_ticks", "stop_ticks", "reference_ticks", "reference_utc_ns", "drift_ppb")
    return TimeCorrelation(7, *(getattr(fit, name) for name in names))


@mark.parametrize("drift_ppb", [-20_000.0, 0.0, 350.0])
def test_offset_and_drift_of_a_clock_are_found_to_its_resolution(drift_ppb):
    """200 reports over 3.3 h, each rounded to a tick of 15 us: the drift is known to about 15 us / 6000 s = 2.5 ppb."""
    ticks, received, light = reports(drift_ppb, 3 * NS)
    fit = fit_correlation(ticks, received, light)
    assert fit.drift_ppb == approx(drift_ppb, abs=3.0)
    assert fit.residual_rms_ns < TICK_NS
    utc, used = utc_ns_of_ticks(ticks, [line_of(fit)])
    assert np.abs(utc - (received - light)).max() < 2 * TICK_NS
    assert set(used.tolist()) == {7}


def test_wrong_reports_are_left_out():
    ticks, received, light = reports(500.0, 0)
    received = received.copy()
    received[[5, 77, 150]] += np.array([2, -40, 7]) * NS
    fit = fit_correlation(ticks, received, light)
    assert (fit.points, fit.rejected) == (197, 3)
    assert fit.drift_ppb == approx(500.0, abs=3.0)


def test_one_report_gives_an_offset_and_none_is_refused():
    ticks, received, light = reports(0.0, NS, count=1)
    fit = fit_correlation(ticks, received, light)
    assert (fit.points, fit.drift_ppb) == (1, 0.0)
    assert line_of(fit).utc_ns(ticks)[0] == received[0] - light[0]
    with raises(EvaluationError, match="expected at least one time report"):
        fit_correlation(ticks[:0], received[:0], light[:0])


def test_the_correlation_nearest_in_time_is_used_and_without_any_the_clock_is_ideal():
    ticks = np.array([0, 1 << 40], dtype=np.int64)
    utc, used = utc_ns_of_ticks(ticks, [])
    assert utc.tolist() == [int(utc_ns_from_ticks(int(t))) for t in ticks]
    assert set(used.tolist()) == {IDEAL_CLOCK}
    one = TimeCorrelation(1, 0, 100, 0, START, 0.0)
    two = TimeCorrelation(2, 1000, 1100, 1000, START, 0.0)
    _, used = utc_ns_of_ticks(np.array([-5, 50, 400, 700, 2000]), [one, two])
    assert used.tolist() == [1, 1, 1, 2, 2]


@given(after_s=st.integers(-86_400 * 300, 86_400 * 300), drift_ppb=st.floats(-50_000, 50_000))
def test_ticks_and_time_are_inverse(after_s, drift_ppb):
    line = TimeCorrelation(1, 0, 1 << 50, int(ticks_from_utc_ns(START)), START, drift_ppb)
    utc = START + after_s * NS
    ticks = ticks_of_utc_ns(utc, [line])
    assert abs(int(line.utc_ns(np.array([ticks]))[0]) - utc) <= 2 * TICK_NS


MINUTE = 60 * 10**9
NAMES = {"a": "canberra", "b": "madrid", "c": "goldstone"}


def reports_of_stations(pattern, clocks_s, steps_s=None):
    """Time reports, one a minute: station, error of its clock and of the on-board clock by number of the report."""
    sent = START + np.arange(len(pattern), dtype=np.int64) * MINUTE
    on_board = np.asarray(steps_s if steps_s is not None else np.zeros(len(pattern)))
    wrong = np.array([clocks_s[name][k] for k, name in enumerate(pattern)])
    ticks = np.asarray(ticks_from_utc_ns(sent)) + np.rint(on_board * 65_536).astype(np.int64)
    zero = np.zeros(len(pattern), dtype=np.int64)
    received = sent + np.rint(wrong * 1e9).astype(np.int64)
    return ticks, received, zero, zero, [NAMES[name] for name in pattern]


CAUSES = """
37.0 | : TAI instead of UTC?
-18.0 | : GPS time instead of UTC?
1.0 | : a leap second?
5.5 |
"""


@mark.parametrize("difference, cause", cells(CAUSES))
@mark.parametrize("pattern", ["abababababababab", "bbbbaaaabbbbaaaa", "abcabcabcabcabca"])
def test_a_station_whose_clock_is_wrong_is_named_and_left_out(pattern, difference, cause):
    difference = float(difference)
    clocks = {"a": [difference] * 16, "b": [0.0] * 16, "c": [0.0] * 16}
    kept, doubts = doubted_stations(*reports_of_stations(pattern, clocks))
    assert kept.tolist() == [name != "a" for name in pattern]
    side = "ahead of" if difference > 0 else "behind"
    assert {str(one) for one in doubts.values()} == {
        f"the clock of station canberra is {abs(difference):.3f} s {side} the others{cause}"
    }


def test_two_stations_that_disagree_with_the_on_board_clock_as_well_are_both_left_out():
    clocks = {"a": [37.0] * 8, "b": [0.0] * 8}
    kept, _ = doubted_stations(*reports_of_stations("abababab", clocks, [90.0] * 8))
    assert not kept.any()


def test_a_clock_that_was_set_on_board_is_no_fault_of_a_station():
    right = {"a": [0.0] * 16, "b": [0.0] * 16}
    for pattern in "a" * 16, "abababababababab", "aaaabbbbaaaabbbb":
        given = reports_of_stations(pattern, right, [0.0] * 8 + [1.0] * 8)
        kept, doubts = doubted_stations(*given)
        assert kept.all() and not doubts
        assert len(clock_runs(*given[:4])) == 2


def test_a_station_whose_clock_changes_is_left_out_from_then_on():
    clocks = {"a": [0.0] * 8 + [37.0] * 8, "b": [0.0] * 16, "c": [0.0] * 16}
    kept, _ = doubted_stations(*reports_of_stations("abcabcabcabcabca", clocks))
    assert np.flatnonzero(~kept).tolist() == [9, 12, 15]


ALONE = """
aaaaaa | -18.0 | behind the on-board clock: GPS time instead of UTC?
a | 37.0 | ahead of the on-board clock: TAI instead of UTC?
aaaaaa | 7200.0 | ahead of the on-board clock: another time zone?
aaaaaa | 1.0 |
aaaaaa | 5.5 |
"""


@mark.parametrize("pattern, difference, remark", cells(ALONE))
def test_a_single_station_off_by_whole_seconds_of_a_usual_cause_decides_nothing(pattern, difference, remark):
    clocks = {"a": [float(difference)] * len(pattern)}
    kept, doubts = doubted_stations(*reports_of_stations(pattern, clocks))
    assert kept.all() if not remark else not kept.any()
    words = f"the clock of station canberra is {abs(float(difference)):.3f} s {remark}"
    assert {str(one) for one in doubts.values()} == ({words} if remark else set())


def test_the_station_that_agrees_with_the_on_board_clock_counts_and_a_corrected_one_from_then_on():
    clocks = {"a": [-18.0] * 12, "b": [37.0] * 12, "c": [0.0] * 12}
    for pattern in "aaaabbbbbccc", "abcabcabcabc":
        kept, doubts = doubted_stations(*reports_of_stations(pattern, clocks))
        assert np.flatnonzero(kept).tolist() == [k for k, name in enumerate(pattern) if name == "c"]
        assert {one.station: round(one.difference_s) for one in doubts.values()} == {"canberra": -18, "madrid": 37}
    given = reports_of_stations("a" * 8, {"a": [0.0] * 8}, [0.0] * 4 + [18.0] * 4)
    assert doubted_stations(*given)[0].all() and len(clock_runs(*given[:4])) == 2
    kept, _ = doubted_stations(*reports_of_stations("a" * 8, {"a": [-18.0] * 4 + [0.0] * 4}))
    assert kept.tolist() == [False] * 4 + [True] * 4


def test_two_stations_off_by_the_same_usual_seconds_do_not_outvote_one_that_agrees_with_the_on_board_clock():
    clocks = {"a": [37.0] * 12, "b": [37.0] * 12, "c": [0.0] * 12}
    given = reports_of_stations("abcabcabcabc", clocks)
    assert np.flatnonzero(doubted_stations(*given)[0]).tolist() == [2, 5, 8, 11]
    unset = reports_of_stations("abcabcabcabc", {**clocks, "c": [0.4] * 12}, [90.0] * 12)
    assert np.flatnonzero(~doubted_stations(*unset)[0]).tolist() == [2, 5, 8, 11]


def test_a_station_whose_clock_drifts_is_named_and_the_other_counts():
    drifting = [0.01 * k for k in range(40)]
    ticks, received, light, boot, names = reports_of_stations("ab" * 20, {"a": [0.0] * 40, "b": drifting})
    fits, doubts = fit_runs(TimeReports(ticks, boot, ticks, received, light, boot, tuple(names)))
    assert [(fit.points, fit.rejected) for _, fit in fits] == [(20, 19)] and sorted(doubts) == list(range(1, 40, 2))
    assert str(doubts[1]) == "the clock of station madrid is 0.390 s ahead of the others"


@mark.parametrize("step_s, runs", [(0.1, 1), (1.0, 2)])
def test_two_reports_hours_apart_show_a_drift_that_an_oscillator_can_have_and_otherwise_a_step(step_s, runs):
    ticks, sent, *zero = reports_of_stations("aa", {"a": [0.0] * 2}, [0.0, step_s])[:4]
    later = np.array([0, 3 * 3600 * NS])
    found = clock_runs(ticks + (later // NS << 16), sent + later, *zero)
    assert len(found) == runs


def test_reports_that_scatter_by_seconds_are_not_put_in_force_and_each_says_why():
    clocks = {"a": [0.0, 2.0, -1.5, 1.0, -2.0, 0.5, 1.5, -1.0]}
    ticks, received, light, boot, names = reports_of_stations("a" * 8, clocks)
    fits, doubts = fit_runs(TimeReports(ticks, boot, ticks, received, light, boot, tuple(names)))
    assert fits == [] and set(doubts) == set(range(8))
    assert str(doubts[0]).endswith(" s ahead of one line through all (rms)")


def test_a_new_correlation_moves_the_times_that_its_line_changes():
    one = TimeCorrelation(1, 0, 100 << 16, 0, START, 0.0)
    two = TimeCorrelation(2, 1000 << 16, 1100 << 16, 1000 << 16, START + 1000 * NS, 0.0)
    moved = TimeCorrelation(3, 1000 << 16, 1100 << 16, 1000 << 16, START + 1000 * NS + 11_000_000, 0.0)
    assert moved_ticks([one, two], [one, two]) == (None, None)
    assert moved_ticks([one, two], [one, moved]) == (550 << 16, (1 << 48) - 1)
    assert moved_ticks([moved], [one, moved]) == (0, 1000 << 16)
    ideal = TimeCorrelation(4, 0, 100 << 16, 0, int(utc_ns_of_ticks(np.array([0]), [])[0][0]), 0.0)
    assert moved_ticks([], [one]) == moved_ticks([ideal], []) == (0, (1 << 48) - 1)


def test_a_correlation_holds_years_away():
    line = TimeCorrelation(1, 0, 1, int(ticks_from_utc_ns(START)), START, 0.0)
    for years in -9, 5:
        utc_ns = START + years * 365 * 86_400 * NS
        assert ticks_of_utc_ns(utc_ns, [line]) == approx(int(ticks_from_utc_ns(utc_ns)), abs=2)


def test_times_of_samples_follow_the_correlation_in_force(ground, synthetic_pass):
    vehicle = ingest_file(ground, synthetic_pass.folder / "downlink.cadu").vehicle_id
    first, last = int(synthetic_pass.utc_ns[0]), int(synthetic_pass.utc_ns[-1])
    pass_id = define_pass(ground, name="p", start_utc_ns=first - 60 * NS, stop_utc_ns=last + 60 * NS, spacecraft_id=76)
    ideal = parameter_series(ground, pass_id, "power_w", 1000)
    points = [
        TimePoint(int(ticks_from_utc_ns(first + k * 60 * NS)), first + k * 60 * NS + 5 * NS + NS, NS) for k in range(10)
    ]
    correlate(ground, vehicle, points)
    moved = parameter_series(ground, pass_id, "power_w", 1000)
    # the clock is 5 s slow; one second of the reception times is light time
    shift = moved.buckets.start_utc_ns - ideal.buckets.start_utc_ns
    assert_allclose(shift, 5 * NS, atol=20_000)
    assert (ideal.correlation_id, moved.correlation_id) == (0, 1)
    correlate(ground, vehicle, points)
    record = ground.read(correlations_on_record, vehicle)
    assert [(row.id, row.in_force) for row in record] == [(2, True), (1, False)]


def test_every_boot_has_a_line_of_its_own(ground, synthetic_pass):
    vehicle = ingest_file(ground, synthetic_pass.folder / "downlink.cadu").vehicle_id
    points = [TimePoint(k * 65_536 * 60, k * 60 * NS, 0, boot_count=k // 5) for k in range(10)]
    assert len(correlate(ground, vehicle, points)) == 2


def test_no_points_and_no_vehicle_are_refused(ground):
    with raises(InvalidInput, match="expected at least one time report"):
        correlate(ground, 1, [])
    with raises(NotFound, match="vehicle 5"):
        correlate(ground, 5, [TimePoint(0, 0, 0)])
