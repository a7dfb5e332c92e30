"""Small statistics of the reports against numbers from outside."""

import numpy as np
from pytest import approx, mark

from reports.figures.canvas import TimeScale, thinned
from reports.figures.navigation import zoom_span
from reports.statistics import (
    binned,
    chi2_quantile,
    completed,
    containment,
    cumulative,
    inside,
    north_east_error_m,
    per_degree,
    quantiles,
    reference_at,
    round_edges,
    running_mean,
    runs,
)
from reports.values import NavigationSeries, NavigationStatistics, TimeSpan, TrackSeries


@mark.parametrize("dof", [1, 2, 3, 12, 60, 400])
@mark.parametrize("probability", [0.025, 0.5, 0.975])
def test_chi_squared_quantiles_are_those_of_scipy(dof, probability):
    from scipy import stats

    expected = float(stats.chi2.ppf(probability, dof))
    assert float(chi2_quantile(probability, dof)) == approx(expected, rel=1e-9)


def test_quantiles_pass_over_nan_and_say_nan_where_there_is_nothing():
    assert quantiles(np.array([np.nan, 3.0, 1.0, 2.0]), (0.5,)) == (2.0,)
    assert np.isnan(quantiles(np.array([np.nan]), (0.5,))[0])


def test_the_reference_between_samples_lies_on_the_great_circle_across_the_zero_meridian():
    track = TrackSeries(
        np.array([0, 10_000_000_000]), np.zeros(2), np.array([359.8, 0.2]), np.array([30_000.0, 31_000.0])
    )
    latitude, longitude, altitude = reference_at(track, np.array([5_000_000_000, 11_000_000_000]))
    assert latitude[0] == approx(0.0, abs=1e-12)
    assert (longitude[0] + 180.0) % 360.0 - 180.0 == approx(0.0, abs=1e-9)
    assert altitude[0] == approx(30_500.0)
    assert np.isnan(latitude[1]) and np.isnan(altitude[1])


def test_ground_error_is_metres_north_and_east_and_given_statistics_are_kept():
    # A degree of the 1737.4 km sphere is 2 pi 1737.4 / 360 = 30.3234 km; of longitude at 60 degrees, half of it.
    track = TrackSeries(np.array([0, 1]), np.full(2, 60.0), np.full(2, 359.5), np.full(2, 3e4))
    one = NavigationSeries(
        "x", "estimate", np.array([0]), np.array([61.0]), np.array([0.5]), np.array([3e4]), np.zeros((1, 3))
    )
    north, east = north_east_error_m(one, track)
    assert north[0] == approx(30_323.4, abs=1.0)
    assert east[0] == approx(15_161.7, abs=1.0)
    error = np.zeros((5, 3))
    error[:, 1] = [1.0, 2.0, 3.0, 4.0, np.nan]
    one = NavigationSeries(
        "x", "estimate", np.arange(5), np.zeros(5), np.zeros(5), np.zeros(5), error,
        statistics=NavigationStatistics(median_3d_m=99.0),
    )  # fmt: skip
    found = completed(one)
    assert (found.median_3d_m, found.max_3d_m, found.end_of_pass_m) == (99.0, 4.0, 4.0)
    assert np.isnan(found.drift_percent)


def test_containment_counts_samples_with_a_sigma_and_spans_hold_their_start_only():
    assert containment(np.array([1.0, 9.0, np.nan]), np.array([1.0, 1.0, 1.0])) == 0.5
    assert np.isnan(containment(np.array([1.0]), np.array([np.nan])))
    assert inside(np.array([9, 10, 19, 20]), [TimeSpan(10, 20)]).tolist() == [False, True, True, False]


def test_a_thinned_line_keeps_its_extremes_and_its_gaps():
    x = np.arange(50_000.0)
    y = np.sin(x / 300.0)
    y[20_000:20_200] = np.nan
    y[31_234] = 17.0
    few_x, few_y = thinned(x, y, 300)
    assert len(few_x) < 1_000
    assert np.nanmax(few_y) == 17.0 and few_x[np.nanargmax(few_y)] == 31_234.0
    assert np.nanmin(few_y) == np.nanmin(y)
    assert np.isnan(few_y).any()
    assert np.all(np.diff(few_x) > 0)


def test_short_lines_are_not_thinned_shares_end_at_one_and_bins_of_few_samples_are_left_out():
    x = np.arange(10.0)
    assert thinned(x, x)[0] is x
    value, share = cumulative(np.random.default_rng(1).normal(size=5_000), 50)
    assert len(value) <= 50 and share[-1] == 1.0
    assert np.all(np.diff(value) >= 0) and np.all(np.diff(share) > 0)
    found = binned(np.array([0.5] * 6 + [1.5] * 2), np.arange(8.0), np.array([0.0, 1.0, 2.0]))
    assert found.centre.tolist() == [0.5]
    assert found.median[0] == 2.5 and found.count.tolist() == [6]


@mark.parametrize("low, high", [(0.0, 1.0), (14.2, 48.6), (5.0, 5.0), (-3.0, 1e5)])
def test_bin_edges_hold_all_values(low, high):
    edges = round_edges(np.array([low, high, np.nan]))
    assert edges[0] <= low and edges[-1] > high
    assert len(edges) <= 11


def test_a_running_mean_bridges_gaps_and_runs_have_their_labels():
    smooth = running_mean(np.array([1.0, np.nan, 3.0, np.nan, np.nan, np.nan]), 3)
    assert len(smooth) == 6
    assert smooth[1] == 2.0 and np.isnan(smooth[5])
    assert len(running_mean(np.zeros(2), 9)) == 2
    assert runs(("a", "a", "b", "a")) == [(0, 2, "a"), (2, 3, "b"), (3, 4, "a")]
    assert runs(()) == []


def test_ticks_are_round_and_inside_a_label_names_both_days_and_only_long_spans_are_zoomed():
    start = 1_880_964_840_000_000_000  # 2029-08-09T10:14:00Z
    places, labels = TimeScale(start, start + 2_220_000_000_000).ticks()
    assert labels == ["10:15", "10:20", "10:25", "10:30", "10:35", "10:40", "10:45", "10:50"]
    assert places[0] == 60.0
    assert TimeScale(start, start + 86_400_000_000_000).label() == "UTC, 9–10 August 2029"
    assert zoom_span(TimeScale(start, start + 2_220_000_000_000), ()) is None
    day = TimeScale(start, start + 86_400_000_000_000)
    arc = TimeSpan(start + 43_000_000_000_000, start + 45_000_000_000_000)
    zoom = zoom_span(day, (arc,))
    assert zoom is not None and zoom.start_utc_ns < arc.start_utc_ns < arc.stop_utc_ns < zoom.stop_utc_ns
    assert zoom.length_s == 3_600.0


def test_a_zoom_shows_the_reset_nearest_the_middle_and_what_led_to_it():
    start = 1_880_964_840_000_000_000
    day = TimeScale(start, start + 86_400_000_000_000)
    arc = TimeSpan(start + 43_000_000_000_000, start + 45_000_000_000_000)
    reset = start + 60_000_000_000_000
    zoom = zoom_span(day, (arc,), resets=[start, start + 10_000_000_000_000, reset])
    assert zoom is not None and zoom.length_s == 3_600.0
    assert zoom.start_utc_ns == reset - 2_400_000_000_000
    # The initialisation at the start is no reset to be shown.
    assert zoom_span(day, (arc,), resets=[start]) == zoom_span(day, (arc,))
    late = day.stop_utc_ns - 60_000_000_000
    zoom = zoom_span(day, (), resets=[late])
    assert zoom is not None and zoom.start_utc_ns < late < zoom.stop_utc_ns == day.stop_utc_ns


def test_a_mean_per_degree_is_the_ratio_of_sums_and_not_the_mean_of_ratios():
    values, degrees = np.array([6.0, 8.0, np.nan, 5.0]), np.array([2, 16, 2, 0])
    count, mean, within = per_degree(values, degrees)
    assert (count, mean) == (2, approx(14.0 / 18.0))  # the mean of 6 / 2 and 8 / 16 is 1.75
    assert within == 1.0  # of 2 degrees 0.05 to 7.4, of 16 degrees 6.9 to 28.8
    assert per_degree(values[2:], degrees[2:])[0] == 0
