"""Numbers, times and names as they are printed; JSON and figures; regression and detector reports."""

import hashlib
import json
import math
import re
from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx, fixture, mark

from reports.document import evidence_label, evidence_number, evidence_text
from reports.figures import consistency, navigation
from reports.figures.canvas import Canvas, TimeScale
from reports.figures.housekeeping import parameter_title
from reports.figures.theme import REFERENCE, color, series_styles
from reports.json_form import to_json
from reports.pdf_pages import pdf_of
from reports.render import render_html, render_pages
from reports.text import (
    NOT_A_VALUE,
    count_text,
    duration_text,
    headline_text,
    length_text,
    number_text,
    percent_text,
    rate_text,
    significant_text,
    utc_text,
)
from reports.values import (
    BinScore,
    DetectorReport,
    DetectorScore,
    HeadlineFigure,
    HousekeepingParameter,
    NavigationSeries,
    PassReport,
    RegressionReport,
    TrackSeries,
)
from tests.lazy import Lazy
from tests.reports import example
from tests.reports.page import Page


def texts(write, *values):
    return "; ".join(map(write, values))


def test_numbers_have_three_significant_digits_groups_and_the_unit_that_fits():
    found = texts(significant_text, 51.23, 0.70444, 0.0996, 0.9996, 148.4, 59_012.0, 9, 12_345, -3.14159, 0.0)
    assert found == "51.2; 0.704; 0.0996; 1.00; 148; 59\u202f000; 9; 12\u202f345; −3.14; 0"
    assert texts(significant_text, math.nan, None, "words", 1e-9) == "–; –; words; 1.00e−09"
    assert texts(length_text, 84.0, 999.4, 1_310.0, 58_960.0, math.nan) == "84.0 m; 999 m; 1.31 km; 59.0 km; –"
    assert count_text(1_234_567) == "1\u202f234\u202f567"
    assert number_text(-1234.5, 1) == "−1\u202f234.5"
    assert count_text(None) == "–"


def test_shares_of_nothing_are_no_number_and_times_and_durations_fit_their_size():
    assert percent_text(3, 0) == "–"
    assert percent_text(1, 3) == "33.3\u202f%"
    # The leap day and the last second before 1970 are the edges of the calendar arithmetic.
    assert utc_text(951_782_400_000_000_000) == "2000-02-29 00:00:00 UTC"
    assert utc_text(-1) == "1969-12-31 23:59:59 UTC"
    assert utc_text(None) == "–"
    assert texts(duration_text, 42.0, 2_220.0, 86_400.0, 864_000.0) == "42 s; 37.0 min; 24.0 h; 10.0 d"


@mark.parametrize(
    "level, number",
    [
        ("3", 3), ("level 2", 2), ("(4) another renderer", 4), ("3s (real terrain seen in training)", 3),
        ("real terrain", None), ("flown over 3 craters", None), ("31", None), ("", None),
    ],
)  # fmt: skip
def test_evidence_levels_are_read_from_their_number_and_never_guessed_from_words(level, number):
    assert evidence_number(level) == number


def test_a_level_on_terrain_seen_in_training_keeps_its_mark_and_words():
    text = "3s (real terrain seen in training; 25 % of frames over unseen terrain)"
    assert evidence_label(text) == "3s" and evidence_label("3 (real terrain)") == "3" and evidence_label("") == ""
    assert evidence_text(text) == f"level 3s of 5, {text[4:-1]}"
    assert evidence_text("3s") == "level 3s of 5, real terrain seen in training"
    assert evidence_text("3") == "level 3 of 5, real terrain never used in training"
    assert evidence_text("2") == "level 2 of 5, procedural Moon" and evidence_text("") == "evidence not stated"


def test_what_is_next_to_nothing_is_said_so_and_a_rate_of_zero_has_no_power_of_ten():
    found = texts(headline_text, 1.1e-5, -1.1e-5, 1.23e-3, 0.0, 28.14, 0)
    assert found == "< 0.001; > −0.001; 0.00123; 0; 28.1; 0"
    assert texts(rate_text, None, 0.0, 2.5e-5) == f"{NOT_A_VALUE}; 0; 2.5e-05"


@mark.parametrize(
    "name, unit, title",
    [
        ("bus_voltage_v", "V", "bus voltage, V"), ("temperature_c", "°C", "temperature, °C"),
        ("storage_used_permille", "‰", "storage used, ‰"), ("vitamin_c", "", "vitamin c"), ("v", "V", "v, V"),
    ],
)  # fmt: skip
def test_a_unit_is_named_once(name, unit, title):
    nothing = np.zeros(0)
    assert parameter_title(HousekeepingParameter(name, unit, nothing.astype(np.int64), nothing)) == title


def test_all_fields_are_there_with_whole_nanoseconds_and_nine_digits_in_the_same_text(whole_pass):
    assert to_json(whole_pass) == to_json(example.pass_report(gallery=3, worst=5))
    body = json.loads(to_json(whole_pass))
    assert body["kind"] == "PassReport" and body["schema_version"] == 1
    assert set(PassReport.__dataclass_fields__) <= set(body)
    assert [s["name"] for s in body["navigation"]][:3] == ["paper", "spherical", "anchored"]
    assert body["packets"]["by_apid"]["160"]["name"] == "housekeeping"
    assert body["reference"]["utc_ns"][0] == int(whole_pass.navigation[0].utc_ns[0])
    assert isinstance(body["reference"]["utc_ns"][0], int)
    back = np.array(json.loads(to_json(whole_pass))["reference"]["latitude_deg"])
    assert_allclose(back, whole_pass.reference.latitude_deg, rtol=5.1e-9, atol=0)


def test_a_fraction_has_at_most_nine_digits_and_whole_or_very_small_numbers_stay():
    signs = np.random.default_rng(1).choice((-1.0, 1.0), 2000)
    values = signs * 10.0 ** np.random.default_rng(2).uniform(-11, 8, 2000)
    edges = [0.1, 1 / 3, 9.9999999996, 0.99999999951, 123456.7890123, 1e-5, 99999999.96]
    ours = np.concatenate([values, edges])
    report = PassReport("a", "b", configuration={"x": {"y": ours}})
    text = to_json(report).split('"y":[', 1)[1].split("]", 1)[0].split(",")
    assert [float(one) for one in text] == [float(f"{value:.9g}") for value in ours]
    assert max(len(one.split("e")[0].removesuffix(".0").replace(".", "").lstrip("-0")) for one in text) == 9
    values = [1.8e18 + 256.0, 2_000_000_001.0, 0.0, 1.2345678912345e-13]
    report = PassReport("a", "b", configuration={"x": {"y": np.array(values), "z": 2_000_000_001.0}})
    assert json.loads(to_json(report))["configuration"]["x"] == {"y": values, "z": values[1]}


def test_values_that_are_no_number_become_null_and_images_are_named_by_their_hash(whole_pass):
    text = to_json(whole_pass)
    assert "NaN" not in text and "Infinity" not in text
    snapshot = next(s for s in json.loads(text)["navigation"] if s["name"] == "snapshot fix")
    assert any(row == [None, None, None] for row in snapshot["error_rtn_m"])
    assert snapshot["statistics"]["drift_percent"] is None
    frame = whole_pass.gallery[0]
    image = json.loads(to_json(whole_pass))["gallery"][0]["image"]
    assert image == {"shape": [512, 512], "sha256": hashlib.sha256(frame.image.tobytes()).hexdigest()}


N = 240
STEP_NS = 15_000_000_000
TIMES = example.START_UTC_NS + np.arange(N, dtype=np.int64) * STEP_NS
TIME = TimeScale(int(TIMES[0]), int(TIMES[-1]))


def series(name="anchored", **more):
    fields = {
        "name": name, "kind": "estimate", "utc_ns": TIMES, "latitude_deg": np.linspace(-10.0, 10.0, N),
        "longitude_deg": np.full(N, 300.0), "altitude_m": np.linspace(20_000.0, 30_000.0, N),
        "error_rtn_m": np.full((N, 3), 20.0), **more,
    }  # fmt: skip
    return NavigationSeries(**fields)


TRACK = TrackSeries(TIMES, np.linspace(-10.0, 10.0, N), np.full(N, 300.0), np.linspace(20_000.0, 30_000.0, N))


def drawn(draw, height_in=3.6):
    """Return the figure that a function draws."""
    figure = Lazy("matplotlib.figure").Figure(figsize=(9.0, height_in))
    draw(Canvas(figure, 9.0, height_in))
    return figure


@mark.parametrize("sigma_m", [0.5, 8.0, 40.0, 4_000.0])
def test_the_edges_of_three_sigma_are_inside_the_axis(sigma_m):
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
        assert heights == approx([-3 * sigma_m / factor, 3 * sigma_m / factor])
        assert low < heights[0] and heights[1] < high


def test_no_estimate_has_the_colour_of_the_reference():
    names = ["paper", "spherical", "anchored", "smoothed", "another", "third", "fourth", "fifth"]
    styles = series_styles([(name, "estimate") for name in names] + [(f"b{i}", "baseline") for i in range(9)])
    assert color(REFERENCE) not in {tint for tint, _ in styles.values()}
    shown = [series(name) for name in ("anchored", "smoothed")]
    figure = drawn(lambda canvas: navigation.draw_altitude(canvas, shown, TRACK, styles, TIME, ()), 3.9)
    wide = [line for line in figure.axes[0].lines if line.get_linewidth() > 3.0]
    assert [line.get_color() for line in wide] == [color(REFERENCE)]


def test_errors_are_binned_by_the_altitude_of_the_reference():
    """An estimate whose altitude is wrong by ten kilometres belongs to the bin of the true altitude."""
    one = series(altitude_m=np.linspace(20_000.0, 30_000.0, N) + 10_000.0)
    ((name, label, bins),) = consistency.dependences(one, TRACK)
    assert (name, label) == ("altitude", "reference altitude, km")
    assert bins.centre.min() > 19.0 and bins.centre.max() < 31.0
    assert consistency.dependences(one, None) == []


def test_a_quantity_with_one_bin_is_a_sentence_and_no_plot():
    report = example.pass_report()
    one = (BinScore(15.0, 20.0, 300, 0.8, 0.7), BinScore(20.0, 25.0, 0, float("nan"), float("nan")))
    score = replace(report.detector, by_altitude_km=one)
    words = Page(render_html(replace(report, detector=score))).text
    assert "All craters were expected at one altitude, 15 to 20 km" in words
    assert "Precision and recall by light, over the craters" in words
    score = replace(report.detector, by_altitude_km=one, by_sun_elevation_deg=())
    words = Page(render_html(replace(report, detector=score))).text
    assert "over the craters expected in each bin" not in words


def test_a_line_is_broken_where_nothing_was_estimated():
    x = np.array([0.0, 15.0, 30.0, 45.0, 1000.0, 1015.0])
    at, error = navigation.broken(x, np.arange(6.0))
    assert at.tolist() == [0.0, 15.0, 30.0, 45.0, 45.0, 1000.0, 1015.0]
    assert np.isnan(error[4]) and np.nansum(error) == 15.0
    even = np.arange(0.0, 100.0, 15.0)
    assert navigation.broken(even, even)[1].tolist() == even.tolist()


KINDS = ("regression", "detector")


def _report(kind):
    return getattr(example, f"{kind}_report")()


@fixture(scope="module", params=KINDS)
def kind(request):
    return str(request.param)


@fixture(scope="module")
def text(kind):
    return render_html(_report(kind))


@mark.parametrize("kind", ("pass", *KINDS), indirect=True)
def test_the_page_is_whole_self_contained_and_repeatable(kind, text):
    page = Page(text)
    assert page.left_open == []
    assert len(page.ids) == len(set(page.ids)) and page.references <= set(page.ids)
    assert all(a.startswith("data:") for a in page.addresses) and "script" not in page.tags
    assert render_html(_report(kind)) == text
    heads = [part.split("</thead>")[0] for part in text.split("<thead>")[1:]]
    assert heads and not [head for head in heads if re.search(r"<th[^>]*></th>", head)]


def test_the_verdict_and_the_figures_come_first(kind, text):
    report, words = _report(kind), Page(text).text
    assert report.verdict in words
    assert f"Verdict: {report.verdict_level}" in words
    assert all(figure.label in words for figure in report.headline)


def test_the_pdf_repeats_and_the_json_names_its_kind(kind):
    report = _report(kind)
    assert render_pages(report)[1] == render_pages(_report(kind))[1]
    assert json.loads(to_json(report))["kind"] == type(report).__name__


@mark.parametrize(
    "empty",
    [
        RegressionReport("Empty", "r0"),
        DetectorReport("Empty", "m0"),
        DetectorReport("Empty", "m1", score=DetectorScore()),
    ],
)
def test_a_report_of_nothing_says_what_is_missing(empty):
    page = Page(render_html(empty))
    assert page.left_open == []
    assert page.text.count("not available: ") >= 4
    assert pdf_of(*reversed(render_pages(empty))).startswith(b"%PDF-")


def test_failed_gates_stand_first():
    words = Page(render_html(example.regression_report())).text
    table = words[words.index("Gates, failed gates first.") :]
    assert table.index("recall, class 0") < table.index("median error, anchored")
    assert "gates 1 failed, 0 inconclusive, 2 passed" in words


def test_bias_of_octants_both_scores_and_predicted_uncertainty_are_in_tables():
    words = Page(render_html(example.detector_report())).text
    table = words[words.index("Mean residual by octant of Sun azimuth") :]
    assert "0–45°" in table and "315–360°" in table and "180–225°" not in table
    table = words[words.index("By type of terrain") :]
    assert "precision, ignore-aware" in table and "recall, ignore-aware" in table
    lowland = table[table.index("lowland") :]
    assert lowland.index("0.870") < lowland.index("0.930") < lowland.index("0.610")
    table = words[words.index("Predicted uncertainty") :]
    for figure in ("14–20 km up", "1.33", "0.655", "0.941", "0.683"):
        assert figure in table


@mark.parametrize(
    "level, role",
    [("met", "green"), ("not met", "vermillion"), ("unknown", "orange"), ("fail", "vermillion"), ("", "")],
)
def test_a_verdict_is_named_by_its_level_and_has_its_colour(level, role):
    text = render_html(replace(example.regression_report(), verdict_level=level))
    heading = f"Verdict: {level}" if level else "Verdict"
    assert f'<div class="verdict {role}"><p class="word">{heading}</p>' in text
    if role:
        assert f".verdict.{role} .word{{color:" in text


def test_accuracies_without_an_evidence_level_are_marked():
    figures = (HeadlineFigure("Frames", 3),)
    assert "No evidence level was stated" in Page(render_html(DetectorReport("M", "m", headline=figures))).text
