"""Plots of the studies: every kind of file, the same octets again, long and empty input."""

import numpy as np
import pytest

from reports.errors import ReportError
from reports.studies import (
    save_altitude_plot,
    save_class_histogram,
    save_difference_plot,
    save_fov_study,
)

START = 1_880_755_200 * 10**9
UTC_NS = START + np.arange(2000) * 60 * 10**9
WAVE = np.sin(np.arange(2000) / 17.7)


def draw_all(folder, ending):
    fov_deg = np.arange(10.0, 161.0, 10.0)
    probability = {n: np.clip(fov_deg / 150.0 / n, 0.0, 1.0) for n in (1, 3, 5)}
    save_fov_study(folder / f"fov{ending}", fov_deg, probability, 0.9, 3, float("nan"), "a catalogue")
    save_class_histogram(
        folder / f"classes{ending}", np.random.default_rng(1).uniform(4, 35, 3000), "a catalogue"
    )
    save_altitude_plot(
        folder / f"altitude{ending}", UTC_NS, 30 + 15 * WAVE, 85 * WAVE, "an orbit", [int(UTC_NS[500])]
    )
    save_difference_plot(
        folder / f"rtn{ending}", UTC_NS, np.outer(WAVE, [1, 10, 0.1]), ("a.oem", "b.oem"), "two orbits"
    )


@pytest.mark.parametrize(("ending", "magic"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")])
def test_every_plot_is_drawn_in_every_format(tmp_path, ending, magic):
    draw_all(tmp_path, ending)
    paths = sorted(tmp_path.iterdir())
    assert len(paths) == 4
    assert all(path.read_bytes().startswith(magic) for path in paths)


@pytest.mark.parametrize("ending", [".png", ".svg", ".pdf"])
def test_the_same_figures_give_the_same_octets(tmp_path, ending):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        draw_all(tmp_path / name, ending)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_a_catalogue_without_craters_and_a_flat_orbit_are_drawn_too(tmp_path):
    save_class_histogram(tmp_path / "classes.png", np.zeros(0), "empty")
    save_altitude_plot(tmp_path / "altitude.png", UTC_NS[:2], np.full(2, 30.0), np.zeros(2), "flat")
    assert len(list(tmp_path.iterdir())) == 2


def test_other_endings_are_refused_and_leave_nothing_behind(tmp_path):
    with pytest.raises(ReportError, match=r"expected a picture name ending in \.png, \.svg, \.pdf"):
        save_class_histogram(tmp_path / "classes.gif", np.ones(3), "none")
    assert list(tmp_path.iterdir()) == []
