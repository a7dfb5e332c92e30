"""The document on the paper's figures: the paper's values next to ours, evidence levels, reasons for gaps."""

import dataclasses

import numpy as np
import pytest

from reports.document import Absent, Cell, Picture, Table
from reports.drawings import picture_files
from reports.paper_report import paper_document, paper_figures, paper_index
from reports.paper_values import CatalogueClasses, DetectorResult, Difference, PaperOrbit, PaperReport, PaperSession
from reports.pdf_pages import pdf_of
from reports.render import render_pages
from reports.text import count_text, percent_text
from reports.values import ClassScore, NavigationSeries, TrackSeries

UTC_NS = 1_880_964_840_000_000_000 + np.arange(4) * 15_000_000_000
TRACK = TrackSeries(UTC_NS, np.linspace(0.0, 2.4, 4), np.full(4, 80.0), np.full(4, 30e3))


def series(name, radial_m, outcome):
    error = np.zeros((4, 3))
    error[:, 0] = radial_m
    return NavigationSeries(
        name, "estimate", UTC_NS, TRACK.latitude_deg, TRACK.longitude_deg, TRACK.altitude_m + radial_m, error,
        outcome=("anchored", outcome, outcome, "predicted"),
        reset_trigger=("initialization", "none", "none", "none"), anchor_reads=5,
    )  # fmt: skip


def report(**changes):
    scores = tuple(ClassScore(k, "", 10, 5, 5, 0.5, 0.25 + k / 10, 1.5) for k in range(3))
    made = PaperReport(
        title="The figures of the LINNA paper",
        identity="test",
        quick=True,
        orbit=PaperOrbit({"Eccentricity": "0.006908"}, 30.71, 14.12, 48.43, 30.0, 8, 3834, "GRAIL"),
        catalogue=CatalogueClasses(np.array([5.5, 12.0, 20.0]), (1, 1, 1), "three craters"),
        detectors=(DetectorResult("class-only network", "as in the paper", 90, "3 (real)", scores, scores[2]),),
        sessions=(
            PaperSession(
                "own", "By the paper's method", "Four images.", "2 (procedural Moon)", True, 4, TRACK,
                (series("paper", 300.0, "multi"),), (), also=(series("spherical", 20.0, "multi"),),
            ),
        ),
        differences=(Difference("Images", "5,196", "4", "A test has few."),),
        verdict="a test",
        evidence_level="2 (procedural Moon)",
    )  # fmt: skip
    return dataclasses.replace(made, **changes)


def table(of, words):
    return next(b for b in paper_document(of).blocks if isinstance(b, Table) and words in b.caption)


def rows(of):
    return [[cell.text if isinstance(cell, Cell) else cell for cell in row] for row in of.rows]


def test_table_one_has_the_altitudes_of_the_paper_and_ours():
    found = rows(table(report(), "Table I:"))
    assert ["Eccentricity", "0.006908", "0.006908"] in found
    found = rows(table(report(), "Altitudes over"))
    assert ["altitude, mean, km", "30.8", "30.7", "−0.0900"] in found
    assert found[-1][1:] == [count_text(5196), count_text(3834), count_text(-1362)]


def test_table_two_has_the_scores_of_the_paper_and_ours():
    found = rows(table(report(), "Table II"))
    assert [row[1:] for row in found[6:]] == [
        ["0.813", "0.500", "−0.313"], ["0.466", "0.450", "−0.0159"], ["4.75", "1.50", "−3.25"],
    ]  # fmt: skip


def test_outcomes_and_errors_are_counted_by_estimator():
    assert ["Multi-pair match", "2", percent_text(2, 4)] in rows(table(report(), "Outcomes of all frames"))
    errors = rows(table(report(), "Position error of each estimator"))
    assert [row[0] for row in errors] == ["paper", "spherical"]
    assert errors[0][1] == errors[0][4] == "300 m"
    assert errors[0][5] == "5"


def test_every_figure_and_table_with_an_accuracy_states_its_evidence_level():
    for figure in paper_index(report())["figures"]:
        assert figure["level"].startswith("level "), figure["caption"]
    assert "level 2 of 5" in table(report(), "Position error").caption


def test_the_index_has_figures_tables_and_differences():
    index = paper_index(report())
    assert {"own-outcomes", "own-ground", "own-altitude", "classes"} <= {f["key"] for f in index["figures"]}
    assert index["differences"] == [{"subject": "Images", "paper": "5,196", "here": "4", "reason": "A test has few."}]
    values = {one["quantity"]: one for one in index["values"]}
    assert values["images of 24 h at 15 s within 60° of latitude"]["difference"] == 3834 - 5196
    assert values["own, paper, median error"] == {
        "place": "Figs. 7 to 10", "quantity": "own, paper, median error", "unit": "m", "paper": None,
        "here": 300.0, "level": "2 (procedural Moon)", "difference": None,
    }  # fmt: skip
    assert [t["number"] for t in index["tables"]] == list(range(1, len(index["tables"]) + 1))


def test_what_was_not_made_is_absent_with_its_reason():
    blocks = paper_document(report(region=None, not_available={"region": "no terrain"})).blocks
    found = [b for b in blocks if isinstance(b, Absent) and "Fig. 3" in b.what]
    assert [b.why for b in found] == ["no terrain"]
    empty = paper_document(report(orbit=None, detectors=(), sessions=(), catalogue=None)).blocks
    assert {"Table I", "Table II", "Sessions", "Fig. 4"} <= {b.what for b in empty if isinstance(b, Absent)}
    assert not [b for b in empty if isinstance(b, Picture)]


@pytest.mark.slow
def test_the_document_is_a_page_and_a_pdf_and_the_same_every_time():
    html, form = render_pages(report())
    assert pdf_of(form, html).startswith(b"%PDF") and "form of the paper" in html.lower()
    assert render_pages(report()) == (html, form)


def test_a_figure_is_a_png_and_a_table_of_what_it_plots():
    found = {picture.key: picture_files(picture) for picture in paper_figures(report())}
    assert all(octets.startswith(b"\x89PNG") for octets, _ in found.values())
    outcomes = found["own-outcomes"][1].splitlines()
    assert outcomes[0] == "panel,x_axis,series,x,y" and ',,"paper, anchored",0,0.25' in outcomes
    bars = [line.split(",") for line in found["classes"][1].splitlines()[1:]]
    assert sum(float(bar[-1]) for bar in bars) == 3
    assert ",paper,0,30.3" in found["own-altitude"][1] and ",reference,0,30" in found["own-altitude"][1]
