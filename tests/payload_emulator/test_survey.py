"""The survey of a region: what it flies, counts and resumes; labels and scores of a session."""

import json

import numpy as np
from pytest import approx, fixture, mark, raises

from linna.cli import run
from lunar.catalogue import make_catalogue
from payload_emulator.errors import ScenarioError
from payload_emulator.session.archive.scoring import _absolute_percentiles, frames_to_recover
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.training.evaluate.sheets import contact_sheet, draw_labels, save_png
from studies import survey
from studies.survey import SurveySession, SurveyWindow, format_survey, recall_counts, summary

SCENARIO = """
name = "plain"
seed = 5
[dynamics]
gravity = "builtin"
degree = 8
orientation = "iau"
[terrain]
source = "procedural"
[camera]
images = "reduced"
frame_interval_s = 30.0
[navigation]
estimators = ["anchored"]
filter_gravity = "builtin"
filter_degree = 8
"""


def window(seed=1, **changed):
    values = {
        "seed": seed, "longitude_deg": 10.0, "altitude_km": (20.0, 30.0), "frames": 4, "fixed": 3, "median_m": 25.0,
        "p95_m": 40.0, "bias_rtn_m": (1.0, 2.0, 3.0), "inside_2_sigma": (1.0, 0.5, 0.0), "nees": 6.0, "nis": 1.0,
        "coast_end_m": 100.0, "position_m": (10.0, 20.0, 30.0, 40.0),
    }  # fmt: skip
    return SurveyWindow.model_validate(values | changed)


def counts(*groups):
    return dict(zip(("5_30_km", "5_30_km_depth_06_10", "5_30_km_depth_above_10", "3_5_km"), groups, strict=True))


def session(*windows):
    return SurveySession(
        windows=windows,
        detections=200,
        findable=50,
        recall=counts((40, 30, 10, 8), (20, 8, 4, 1), (10, 9, 2, 2), (8, 1, 0, 0)),
        pairs=20,
        wrong_pairs=1,
        wrong_fixes=0,
        registered_share=0.5,
        level="3",
        data=("terrain",),
    )


def test_windows_of_all_seeds_are_counted_together_each_by_its_frames():
    longer = window(
        2, frames=12, fixed=12, nees=12.8, nis=2.0, bias_rtn_m=(5.0, 2.0, -1.0), inside_2_sigma=(0.6, 0.5, 1.0),
        coast_end_m=None, position_m=tuple(np.linspace(50.0, 60.0, 12)),
    )  # fmt: skip
    figures = summary([session(window(), window(nees=8.0)), session(longer)])
    assert figures["frames"] == 20
    assert figures["median_m"] == np.median([10, 20, 30, 40] * 2 + np.linspace(50, 60, 12).tolist())
    # Of three windows drawn again, all are the short ones in 8 of 27 cases, the long one three times in 1 of 27.
    assert figures["median_95_m"] == approx([25.0, 55.0])
    assert figures["max_m"] == 60.0
    assert figures["nees_mean"] == approx((6.0 + 8.0 + 12.8) / 3.0)
    # Chi-square with 18 degrees of freedom (Abramowitz and Stegun, table 26.8): 8.23075 and 31.5264.
    assert figures["bounds"] == approx([8.23075 / 3.0, 31.5264 / 3.0], abs=1e-4)
    # Sigmas are too large by the root of the mean per degree, too small likewise; within the bounds nothing is said.
    assert (figures["nees_remark"], "sigmas" in format_survey(figures)) == ("", False)
    for nees, remark in ((1.5, "sigmas 2.0 times too large"), (24.0, "sigmas 2.0 times too small")):
        assert f"NIS 1.00; {remark}\n" in format_survey(summary([session(*[window(nees=nees)] * 3)]))
    assert figures["nees_above_12_6_share"] == approx(1.0 / 3.0)
    assert figures["nees_trend"] == approx(8.0 - (6.0 + 12.8) / 2.0)
    assert figures["bias_rtn_m"] == approx([(8 * 1 + 12 * 5) / 20, 2.0, (8 * 3 - 12) / 20])
    assert figures["inside_2_sigma"] == approx({"r": 0.76, "t": 0.5, "n": 0.6})
    assert figures["nis"] == approx((3 + 3 + 2 * 12) / 18)
    assert figures["coast_end_p95_m"] == 100.0
    # Coasts after few frames are counted apart; an axis at 2 sigma is within, and a coast is three axes.
    after = [((2.0, 0.1, -2.1), 37, 900.0), ((0.5, 0.5, -0.5), 59, 300.0), ((9.0, 9.0, 9.0), 60, 50.0)]
    coasts = [window(coast_sigmas=sigmas, coast_frames=n, coast_end_m=end_m) for sigmas, n, end_m in after]
    few, many = summary([session(window(), *coasts)])["coasts"]
    assert few == {"frames_from": 1, "coasts": 2, "max_m": 900.0, "inside_2_sigma": approx(5 / 6)}
    assert many == {"frames_from": 60, "coasts": 1, "max_m": 50.0, "inside_2_sigma": 0.0}
    assert figures["fixed_share"] == 18 / 20
    assert (figures["catalogued_share"], figures["recall_5_30_km"]) == (0.25, 0.75)
    assert (figures["track_recall_5_30_km"], figures["recall_5_30_km_depth_06_10"]) == (0.8, 0.4)
    assert (figures["recall_3_5_km"], figures["track_recall_3_5_km"]) == (0.125, None)
    assert figures["wrong_pairs_share"] == 0.05
    assert "position_m" not in figures["windows"][0]
    text = format_survey(figures)
    assert "registered in 50 % of the frames" in text
    assert ": 5 to 30 km 75 % (80 %), of these with depth/diameter .06 to .10 40 % (25 %)," in text
    assert text.splitlines()[-2].endswith("above .10 90 % (100 %), 3 to 5 km 12 % (unknown)")


def test_recall_is_counted_by_size_and_by_depth_with_the_limits_in_their_groups():
    diameter_m = np.array([2.9e3, 3e3, 4.999e3, 5e3, 30e3, 30.1e3, 10e3, 10e3, 10e3, 10e3])
    depth_ratio = np.array([0.08, 0.08, 0.2, 0.0599, 0.06, 0.08, 0.0999, 0.10, 0.2, np.nan])
    catalogue = make_catalogue(np.zeros(10), np.zeros(10), diameter_m, source="test", depth_m=depth_ratio * diameter_m)
    in_image = np.array([7, 6, 4, 5, 5, 9, 4, 8, 5, 10])
    assert recall_counts(catalogue, np.stack([in_image, np.array([7, 1, 4, 2, 1, 9, 4, 3, 5, 0])], axis=1)) == counts(
        (37, 15, 5, 3), (9, 5, 1, 0), (13, 8, 2, 2), (10, 5, 1, 0)
    )


def test_what_is_unknown_has_no_figure_and_a_session_without_settled_windows_is_refused():
    figures = summary([session(window(nis=None, coast_end_m=None)).model_copy(update={"registered_share": 0.0})])
    assert {figures[name] for name in ("nis", "nees_trend", "coast_end_p95_m")} == {None}
    text = format_survey(figures)
    assert "not registered" in text and "NIS unknown" in text
    with raises(ScenarioError, match="expected windows with more than 20 frames"):
        summary([session()])


def test_a_survey_is_flown_over_its_region_alone():
    region = survey.Region(300.0, 330.0, -20.0, 40.0)
    found = survey.survey_scenario(parse_scenario(SCENARIO), region, 2, 9)
    assert (found.seed, found.window.passes) == (9, 2)
    assert (found.window.longitude_min_deg, found.window.longitude_max_deg) == (300.0, 330.0)
    assert (found.window.latitude_min_deg, found.window.latitude_max_deg) == (-20.0, 40.0)


@fixture
def survey_of(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("LINNA_DATA", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "none"))
    scenario = tmp_path / "plain.toml"
    scenario.write_text(SCENARIO)

    def flown(*words, status=0):
        options = ("--scenario", str(scenario), "--windows", "2", "--json", *words)
        assert run(["navigation", "survey", *options]) == status
        captured = capsys.readouterr()
        return json.loads(captured.out) if status == 0 else captured.err

    return flown


def test_windows_over_the_region_are_flown_and_a_finished_seed_is_not_flown_again(survey_of, tmp_path, monkeypatch):
    words = ("--region", "300,330,-30,30", "--out", str(tmp_path / "kept"))
    figures = survey_of(*words, "--seeds", "1")
    assert figures["seeds"] == [5] and len(figures["windows"]) == 2
    assert figures["frames"] == sum(row["frames"] for row in figures["windows"]) > 40
    assert all(300.0 <= row["longitude_deg"] <= 330.0 for row in figures["windows"])
    # Simulated detections: recall of 0.7, all of them craters; what is missed once is missed again more often.
    assert 0.5 < figures["recall_5_30_km"] < 0.8 < figures["track_recall_5_30_km"] < 0.95
    assert figures["windows"][0]["coast_end_m"] is None and figures["windows"][1]["coast_end_m"] > 0.0
    assert figures["level"].startswith("2") and figures["registered_share"] == 0.0
    with monkeypatch.context() as forbidden:
        forbidden.setattr(survey, "build_world", None)
        assert survey_of(*words, "--seeds", "1") == figures
    (kept,) = (tmp_path / "kept").iterdir()
    kept.write_text("{}")
    assert "expected a session of a survey" in survey_of(*words, "--seeds", "1", status=2)


def test_bad_options_are_one_line(survey_of):
    assert "--region: expected four numbers" in survey_of("--region", "5", status=2)
    for option in ("--seeds", "--windows"):
        error = survey_of("--region", "0,10,0,10", option, "0", status=2)
        assert f"{option}: expected a number from 1, found '0'" in error


def label(size_class, u, inside=True):
    ellipse = {"major_px": 20.0, "minor_px": 20.0, "angle_deg": 0.0}
    return {"class": size_class, "u_px": u, "v_px": 32.0, "inside": inside, "ellipse": ellipse}


def test_classes_have_the_papers_colours_and_labels_outside_are_not_drawn():
    image = np.zeros((64, 200, 3), np.uint8)
    drawn = draw_labels(image, [label(0, 30.0), label(1, 80.0), label(2, 130.0), label(3, 180.0)])
    # The rightmost point of each circle of 20 pixels; the line is smoothed, so it may not be at full strength.
    cyan, lime, yellow = (drawn[32, u].astype(int) for u in (40, 90, 140))
    assert cyan[0] == 0 and cyan[1] == cyan[2] > 180
    assert lime[1] > 180 and lime[0] == lime[2] == 0
    assert yellow[0] == yellow[1] > 180 and yellow[2] == 0
    assert drawn[:, 165:].max() == 0 and image.max() == 0
    image = np.full((64, 64, 3), 256 * 7 + 3, np.uint16)
    drawn = draw_labels(image, [label(0, 30.0, inside=False)])
    assert drawn.dtype == np.uint8 and (drawn == 7).all()


def test_a_sheet_has_a_place_for_every_picture_and_its_caption():
    sheet = contact_sheet([np.full((40, 50, 3), 30 + 50 * n, np.uint8) for n in range(4)], ["a", "b", "c", "d"], 3)
    assert sheet.shape == (2 * (40 + 22 + 4) + 4, 3 * (50 + 4) + 4, 3)
    assert (sheet[4:44, 58:108] == 80).all()
    # The fourth picture begins the second row.
    assert (sheet[70:110, 4:54] == 180).all()


def test_a_picture_is_written_whole_or_not_at_all(tmp_path):
    save_png(np.zeros((8, 8, 3), np.uint16), tmp_path / "a.png")
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]
    with raises(OSError):
        save_png(np.zeros((8, 8, 3), np.uint8), tmp_path / "missing/a.png")


# One frame that happens to be close is no recovery.
ERRORS = """20000 300 80 60 50 40: 2
100 90 80 70: 1
5000 400 5000 5000 300 200 100 90: 5
5000 5000: None
: None"""


@mark.parametrize("row", ERRORS.splitlines())
def test_a_recovery_is_the_first_frame_from_which_the_error_stays_small(row):
    errors, frames = row.split(":")
    assert str(frames_to_recover(np.array(errors.split(), float))) == frames.strip()


def test_percentiles_of_each_direction_are_of_absolute_errors_and_unknown_without_any():
    errors = np.array([[-3.0, 1.0, np.nan], [1.0, -1.0, 2.0], [2.0, 4.0, np.nan]])
    assert _absolute_percentiles(errors, 50.0) == [2.0, 1.0, 2.0]
    assert _absolute_percentiles(errors, 100.0) == [3.0, 4.0, 2.0]
    assert _absolute_percentiles(errors[:0], 95.0) == [None] * 3
