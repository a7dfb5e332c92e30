"""Regression and detector reports: the same promises as the report of a pass."""

import json
import re
from dataclasses import replace

import pytest

from reports.json_form import to_json
from reports.pdf_pages import pdf_of
from reports.render import render_html, render_pages
from reports.values import DetectorReport, DetectorScore, HeadlineFigure, RegressionReport
from tests.reports import example
from tests.reports.page import Page

KINDS = ("regression", "detector")


def _report(kind):
    return getattr(example, f"{kind}_report")()


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return str(request.param)


@pytest.fixture(scope="module")
def text(kind):
    return render_html(_report(kind))


@pytest.mark.parametrize("kind", ("pass", *KINDS), indirect=True)
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


@pytest.mark.parametrize(
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


def test_the_bias_of_every_octant_met_is_in_the_table():
    words = Page(render_html(example.detector_report())).text
    table = words[words.index("Mean residual by octant of Sun azimuth") :]
    assert "0–45°" in table and "315–360°" in table and "180–225°" not in table


def test_strict_and_ignore_aware_scores_stand_side_by_side():
    words = Page(render_html(example.detector_report())).text
    table = words[words.index("By type of terrain") :]
    assert "precision, ignore-aware" in table and "recall, ignore-aware" in table
    lowland = table[table.index("lowland") :]
    assert lowland.index("0.870") < lowland.index("0.930") < lowland.index("0.610")


def test_predicted_uncertainty_is_compared_with_what_it_should_be():
    words = Page(render_html(example.detector_report())).text
    table = words[words.index("Predicted uncertainty") :]
    for figure in ("14–20 km up", "1.33", "0.655", "0.941", "0.683"):
        assert figure in table


@pytest.mark.parametrize(
    ("level", "role"),
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
