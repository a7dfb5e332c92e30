"""The page of a pass: complete, self-contained, the same bytes; the document on the paper's figures."""

import dataclasses
from dataclasses import replace

import numpy as np
from pytest import fixture, mark, raises

from reports.document import Absent, Cell, Picture, Table
from reports.drawings import picture_files
from reports.errors import InconsistentReport, UnknownReportKind
from reports.paper_report import paper_document, paper_figures, paper_index
from reports.paper_values import CatalogueClasses, DetectorResult, Difference, PaperOrbit, PaperReport, PaperSession
from reports.pdf_pages import pdf_of
from reports.render import render_html, render_pages
from reports.text import count_text, percent_text
from reports.values import (
    AnchorRead,
    ClassScore,
    FrameAccounting,
    HeadlineFigure,
    NavigationSeries,
    PassReport,
    SettingsComparison,
    TrackSeries,
)  # fmt: skip
from tests.reports import example
from tests.reports.page import Page


@fixture(scope="module")
def page(whole_page):
    return Page(whole_page)


def shown(report, **changes):
    return Page(render_html(replace(report, **changes)))


def of_pass(title="T", pass_id="p", **values):
    return shown(PassReport(title, pass_id, **values))


def _series(n, **more):
    """A navigation series of n samples at ten seconds, every value finite unless replaced."""
    return NavigationSeries(
        **{
            "name": "anchored", "kind": "estimate",
            "utc_ns": example.START_UTC_NS + np.arange(n, dtype=np.int64) * 10_000_000_000,
            "latitude_deg": np.linspace(-10.0, 10.0, n), "longitude_deg": np.full(n, 300.0),
            "altitude_m": np.full(n, 30_000.0), "error_rtn_m": np.full((n, 3), 20.0), **more,
        }
    )  # fmt: skip


def test_colours_of_figures_are_roles_so_that_they_follow_the_theme(whole_page):
    from reports.figures.theme import DARK, LIGHT

    assert LIGHT.keys() == DARK.keys()
    assert len(set(LIGHT.values())) == len(LIGHT), "a shared light colour would merge two roles"
    figures = whole_page[whole_page.index("<main") :]
    assert not any(tint in figures for tint in LIGHT.values())
    for role, tint in DARK.items():
        assert f"--f-{role}:{tint};" in whole_page


def test_the_first_page_has_verdict_figures_and_level_and_the_detector_those_of_the_paper(page):
    start = page.text[: page.text.index("At a glance", page.text.index("Verdict"))]
    assert "Verdict: met" in start and "without reading the anchor ephemeris" in start
    for text in ("51.2 m", "148 m", "1.71 % of path", "0.704", "9 of 1 204"):
        assert text in start
    assert start.count("level 3") == 5 + 1
    assert "3 real terrain" in start
    # LINNA paper, Table II.
    for figure in ("0.7021", "0.7362", "0.8131", "0.3248", "0.3586", "0.4659", "3.50", "4.11", "4.75"):
        assert figure in page.text


def test_outcomes_triggers_and_times_have_their_names_and_the_ledger_counts_every_read(page):
    for name in ("Anchored match", "Multi-pair match", "Singleton match", "Prediction only", "Missed"):
        assert name in page.text
    for trigger in ("initialization", "time gap", "manual step", "safety timeout"):
        assert trigger in page.text
    # 1,880,964,872.5 s after 1970-01-01 is 2029-08-09 10:14:32 UTC (GNU date -u -d @1880964872).
    assert "2029-08-09 10:14:32 UTC" in page.text
    assert "UTC, 9 August 2029" in page.text
    ledger = page.text[page.text.rindex("Never read") :]
    assert "Never read the anchor ephemeris: anchored." in ledger
    assert "Read it: paper, spherical." in ledger


def test_the_list_of_evidence_levels_has_terrain_seen_in_training(page):
    assert "2 procedural Moon, 3s real terrain seen in training, 3 real terrain never used" in page.text


def test_the_ledger_lists_the_reads_that_reset_an_estimator_and_a_title_with_markup_is_text(whole_pass):
    reads = tuple(
        AnchorRead("paper", whole_pass.truth_ledger[0].utc_ns, trigger, 700 + number)
        for number, trigger in enumerate(("none", "safety_timeout", "none"))
    )
    text = shown(whole_pass, truth_ledger=reads).text
    resets = text[text.index("Reads that reset an estimator.") : text.index("Every read is in the JSON form")]
    assert "701 safety timeout" in resets
    assert "700" not in resets and "702" not in resets
    title, series = '<script>alert("x")</script> $\\alpha$ 月', _series(3, name="<b>&</b> $x^2$ 月")
    page = of_pass(title, '";} body{display:none}</style>', navigation=(series,))
    assert page.left_open == []
    assert "script" not in page.tags and "b" in page.tags
    assert title in page.text


def test_an_empty_pass_says_what_is_missing_and_why():
    page = of_pass()
    assert page.left_open == []
    missing = """
Verdict not available: there is no verdict
Navigation not available: no navigation telemetry was received
Frame accounting not available: the frames of the pass were not counted
Packet accounting not available: the pass has no packet accounting
Matcher outcomes not available: no estimator reported matching outcomes
Altitude against the reference not available: no reference ephemeris covers the pass
Ground track not available: no reference ephemeris covers the pass
Gallery of detections not available: the pass has no images on the ground
Housekeeping not available: no housekeeping packet was received
Configuration not available: none was archived with the pass
"""
    for line in missing.strip().splitlines():
        assert line in page.text


def test_without_imaging_arcs_errors_are_those_of_the_whole_pass():
    words = of_pass(navigation=(_series(30),)).text
    table = words[words.index("The same errors by direction in the reference orbit.") :]
    assert "whole" in table and "imaging arcs and between them" not in words


def test_the_caption_tells_the_best_flown_solution_from_the_best_baseline(page):
    assert "Smallest median: of those flown anchored, 39.7 m; of the baselines" in page.text


def test_only_false_alarms_of_the_scored_classes_are_marked_as_false(whole_pass):
    from reports.figures.gallery import FALSE_TINT, draw_gallery
    from reports.figures.svg import draw_svg

    frame = whole_pass.gallery[0]
    nothing = np.zeros(len(frame.detection_u_px), np.bool_)

    def marks(size_class):
        shown = replace(frame, detection_matched=nothing, detection_class=np.full(len(nothing), size_class, np.int64))
        return draw_svg("g", 3.0, 3.5, lambda c: draw_gallery(c, (shown,), 1), "one frame").count(FALSE_TINT)

    assert marks(0) == 1, "one compound path holds all crosses of a colour"
    assert marks(3) == 0


def test_a_given_reason_replaces_the_usual_one_and_a_pass_without_a_reference_shows_what_it_has():
    text = of_pass(not_available={"gallery": "images were not asked for in this window"}).text
    assert "Gallery of detections not available: images were not asked for in this window" in text
    assert "gallery: images were not asked for in this window" in text
    one = _series(40, error_rtn_m=np.full((40, 3), np.nan), outcome=("fixed",) * 30 + ("coasted",) * 10)
    text = of_pass(navigation=(one,)).text
    assert "Position error not available: no reference ephemeris covers the pass" in text
    assert "Fixed on the catalogue" in text and "75.0 %" in text


def test_a_pass_without_frames_or_navigation_says_so_and_shows_the_rest(whole_pass):
    page = shown(whole_pass, accounting=None, gallery=(), worst_frames=(), detector=None, craters=None)
    assert page.left_open == []
    assert "Frame accounting not available: the frames of the pass were not counted" in page.text
    assert "Recall, precision, localisation not available" in page.text
    assert "Gallery of detections not available: the pass has no images on the ground" in page.text
    assert "Filter consistency" in page.text and "worst 5 frames" not in page.text
    page = shown(whole_pass, navigation=(), truth_ledger=())
    assert page.left_open == []
    assert "Navigation not available: no navigation telemetry was received" in page.text
    assert "Detection by size class" in page.text and "Filter consistency" not in page.text


def test_a_pass_of_one_frame_is_reported():
    report = example.pass_report(hours=15.0 / 3600.0, gallery=1, worst=0)
    assert len(report.navigation[0].utc_ns) == 1
    page = shown(report)
    assert page.left_open == []
    assert "Of 1 expected" in page.text


@mark.parametrize("changes", [(), (("link.coding", "rs", None),)])
def test_settings_are_compared_with_those_of_the_previous_pass(changes):
    _, _, text = of_pass(comparison=SettingsComparison("W-1", changes)).text.rpartition(
        "those of the previous pass, W-1. "
    )
    row = "setting previous pass this pass link.coding rs not stated "
    assert text.startswith(row if changes else "LINNA · Pass report")


def test_series_of_nothing_but_nan_are_dashes_not_numbers():
    n = 25
    numbers = dict.fromkeys(("latitude_deg", "longitude_deg", "altitude_m", "nees", "nis"), np.full(n, np.nan))
    vectors = dict.fromkeys(("error_rtn_m", "sigma_rtn_m"), np.full((n, 3), np.nan))
    one = _series(n, **numbers, **vectors, nis_dof=np.zeros(n, np.int64))
    track = TrackSeries(one.utc_ns, np.linspace(-5, 5, n), np.full(n, 10.0), np.full(n, np.nan))
    headline = (HeadlineFigure("Error", float("nan"), "m"), HeadlineFigure("Recall", None))
    text = of_pass("NaN", navigation=(one,), reference=track, headline=headline).text
    assert text.count("not available") >= 4
    absent = "Position error not available: no downlinked state has both values and a reference"
    assert text.count(absent) == 2
    assert "Altitude of the reference; no estimate of it came down." in text
    assert "nan" not in text.lower().replace("nan ", "", 1).split("pass report")[-1]


def test_single_wild_values_do_not_break_a_page():
    n = 60
    error = np.full((n, 3), 12.0)
    error[[7, 9, 11]] = [[1e12], [np.inf], [0.0]]
    assert of_pass(navigation=(_series(n, error_rtn_m=error, sigma_rtn_m=np.full((n, 3), 1e-9)),)).left_open == []


def test_half_a_downlink_shows_the_share_that_came():
    text = of_pass(accounting=FrameAccounting(expected=148, processed=74)).text
    assert "Of 148 expected, 74 (50.0 %) are processed." in text


def test_arrays_of_different_lengths_and_values_that_are_no_report_are_refused():
    with raises(InconsistentReport) as caught:
        of_pass(navigation=(_series(4, altitude_m=np.zeros(3)),))
    message = str(caught.value)
    assert "'anchored', altitude_m" in message and "(4,)" in message and "(3,)" in message
    with raises(InconsistentReport, match="4 labels"):
        of_pass(navigation=(_series(4, outcome=("fixed",)),))
    with raises(UnknownReportKind, match="dict"):
        render_html({"title": "not a report"})


@mark.campaign
def test_a_day_of_passes_stays_under_eight_megabytes():
    report = example.pass_report(hours=24.0)
    assert sum(len(s.utc_ns) for s in report.navigation if s.kind == "estimate") == 3 * 5_760
    text = render_html(report)
    assert len(text.encode()) < 8_000_000
    page = Page(text)
    assert page.left_open == [] and page.references <= set(page.ids)
    assert "One hour of it" in page.text


def test_the_link_quality_of_each_reception_is_a_row_of_the_page(whole_page):
    start = whole_page.index("Link quality by reception")
    table = whole_page[start : whole_page.index("</table>", start)]
    assert "madrid" in table and "2.5e-05" in table
    assert "not stated" in table and "default" in table


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


def test_tables_have_the_altitudes_and_scores_of_the_paper_and_ours():
    found = rows(table(report(), "Table I:"))
    assert ["Eccentricity", "0.006908", "0.006908"] in found
    found = rows(table(report(), "Altitudes over"))
    assert ["altitude, mean, km", "30.8", "30.7", "−0.0900"] in found
    assert found[-1][1:] == [count_text(5196), count_text(3834), count_text(-1362)]
    found = rows(table(report(), "Table II"))
    assert [row[1:] for row in found[6:]] == [
        ["0.813", "0.500", "−0.313"], ["0.466", "0.450", "−0.0159"], ["4.75", "1.50", "−3.25"],
    ]  # fmt: skip


def test_outcomes_and_errors_are_counted_by_estimator_and_accuracies_state_their_level():
    assert ["Multi-pair match", "2", percent_text(2, 4)] in rows(table(report(), "Outcomes of all frames"))
    errors = rows(table(report(), "Position error of each estimator"))
    assert [row[0] for row in errors] == ["paper", "spherical"]
    assert errors[0][1] == errors[0][4] == "300 m"
    assert errors[0][5] == "5"
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


@mark.slow
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
