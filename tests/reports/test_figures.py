"""Content of figures, checked by the drawn geometry."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from reports.figures import consistency, navigation
from reports.figures.canvas import Canvas, TimeScale
from reports.figures.theme import REFERENCE, color, series_styles
from reports.render import render_html
from reports.values import BinScore, NavigationSeries, TrackSeries
from tests.lazy import Lazy
from tests.reports import example
from tests.reports.page import Page

N = 240
STEP_NS = 15_000_000_000
TIMES = example.START_UTC_NS + np.arange(N, dtype=np.int64) * STEP_NS
TIME = TimeScale(int(TIMES[0]), int(TIMES[-1]))


def series(name: str = "anchored", **more: object) -> NavigationSeries:
    fields: dict[str, object] = {
        "name": name,
        "kind": "estimate",
        "utc_ns": TIMES,
        "latitude_deg": np.linspace(-10.0, 10.0, N),
        "longitude_deg": np.full(N, 300.0),
        "altitude_m": np.linspace(20_000.0, 30_000.0, N),
        "error_rtn_m": np.full((N, 3), 20.0),
        **more,
    }
    return NavigationSeries(**fields)


TRACK = TrackSeries(TIMES, np.linspace(-10.0, 10.0, N), np.full(N, 300.0), np.linspace(20_000.0, 30_000.0, N))


def drawn(draw: Callable[[Canvas], None], height_in: float = 3.6) -> Any:
    """Return the figure that a function draws."""
    figure = Lazy("matplotlib.figure").Figure(figsize=(9.0, height_in))
    draw(Canvas(figure, 9.0, height_in))
    return figure


@pytest.mark.parametrize("sigma_m", [0.5, 8.0, 40.0, 4_000.0])
def test_the_edges_of_three_sigma_are_inside_the_axis(sigma_m: float) -> None:
    rng = np.random.default_rng(1)
    one = series(error_rtn_m=20.0 * rng.standard_normal((N, 3)), sigma_rtn_m=np.full((N, 3), sigma_m))
    styles = series_styles([("anchored", "estimate")])
    figure = drawn(lambda canvas: navigation.draw_rtn(canvas, one, styles, TIME, ()))
    assert len(figure.axes) == 3
    for axes in figure.axes:
        low, high = axes.get_ylim()
        edges = [line for line in axes.lines if line.get_color() == color("gray2")]
        heights = sorted(float(np.mean(np.asarray(line.get_ydata(), dtype=float))) for line in edges)
        assert len(heights) == 2
        factor = 1000.0 if 3 * sigma_m * 1.15 >= 1500 else 1.0
        assert heights == pytest.approx([-3 * sigma_m / factor, 3 * sigma_m / factor])
        assert low < heights[0] and heights[1] < high


def test_no_estimate_has_the_colour_of_the_reference() -> None:
    names = ["paper", "spherical", "anchored", "smoothed", "another", "third", "fourth", "fifth"]
    styles = series_styles([(name, "estimate") for name in names] + [(f"b{i}", "baseline") for i in range(9)])
    assert color(REFERENCE) not in {tint for tint, _ in styles.values()}
    shown = [series(name) for name in ("anchored", "smoothed")]
    figure = drawn(lambda canvas: navigation.draw_altitude(canvas, shown, TRACK, styles, TIME, ()), 3.9)
    wide = [line for line in figure.axes[0].lines if line.get_linewidth() > 3.0]
    assert [line.get_color() for line in wide] == [color(REFERENCE)]


def test_errors_are_binned_by_the_altitude_of_the_reference() -> None:
    """An estimate whose altitude is wrong by ten kilometres belongs to the bin of the true altitude."""
    one = series(altitude_m=np.linspace(20_000.0, 30_000.0, N) + 10_000.0)
    ((name, label, bins),) = consistency.dependences(one, TRACK)
    assert (name, label) == ("altitude", "reference altitude, km")
    assert bins.centre.min() > 19.0 and bins.centre.max() < 31.0
    assert consistency.dependences(one, None) == []


def test_a_quantity_with_one_bin_is_a_sentence_and_no_plot() -> None:
    report = example.pass_report()
    assert report.detector is not None
    one = (BinScore(15.0, 20.0, 300, 0.8, 0.7), BinScore(20.0, 25.0, 0, float("nan"), float("nan")))
    score = replace(report.detector, by_altitude_km=one)
    words = Page(render_html(replace(report, detector=score))).text
    assert "All craters were expected at one altitude, 15 to 20 km" in words
    assert "Precision and recall by light, over the craters" in words
    score = replace(report.detector, by_altitude_km=one, by_sun_elevation_deg=())
    words = Page(render_html(replace(report, detector=score))).text
    assert "over the craters expected in each bin" not in words


def test_no_column_is_without_a_name() -> None:
    for kind in ("pass", "regression", "detector"):
        text = render_html(getattr(example, f"{kind}_report")())
        heads = [part.split("</thead>")[0] for part in text.split("<thead>")[1:]]
        assert heads
        assert not [head for head in heads if re.search(r"<th[^>]*></th>", head)], kind


def test_a_line_is_broken_where_nothing_was_estimated() -> None:
    x = np.array([0.0, 15.0, 30.0, 45.0, 1000.0, 1015.0])
    at, error = navigation.broken(x, np.arange(6.0))
    assert at.tolist() == [0.0, 15.0, 30.0, 45.0, 45.0, 1000.0, 1015.0]
    assert np.isnan(error[4]) and np.nansum(error) == 15.0
    even = np.arange(0.0, 100.0, 15.0)
    assert navigation.broken(even, even)[1].tolist() == even.tolist()
