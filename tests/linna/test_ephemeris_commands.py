"""The commands on ephemerides as users run them."""

from dataclasses import replace

import numpy as np
from pytest import approx, fixture, mark

from lunar.catalogue import PAPER_CLASS_COUNTS
from lunar.constants import NS
from lunar.ephemeris import Ephemeris
from lunar.messages.oem import save_oem
from lunar.messages.stk import format_stk
from tests.lunar.orbits import polar_orbit


@fixture(autouse=True)
def no_data(monkeypatch, tmp_path):
    """These commands must work on a machine without the data products."""
    monkeypatch.delenv("LINNA_DATA", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "nothing"))


@fixture
def oem_path(tmp_path):
    path = tmp_path / "orbit.oem"
    save_oem(polar_orbit(48.0), path)
    return path


def test_compare_tells_the_difference_of_an_oem_and_an_stk_file(oem_path, tmp_path, typed):
    other = tmp_path / "orbit.e"
    other.write_text(format_stk(polar_orbit(48.0, radius_m=1_768_190.0)))
    figures = typed(f"orbit compare {oem_path} {other} --json")
    assert figures["samples"] == 48 * 60 + 1
    assert figures["max_m"] == approx(10.0, abs=1e-5)
    assert figures["rms_rtn_m"] == approx([10.0, 0.0, 0.0], abs=1e-5)
    assert figures["mean_rtn_m"] == approx([10.0, 0.0, 0.0], abs=1e-5)
    text = typed(f"orbit compare {oem_path} {other} --step 3600")
    assert text.startswith(
        "A: SELENITA, epochs in UTC; B: SELENITA, epochs in UTC\n49 epochs from 2029-08-07T00:00:00.000Z"
    )
    assert "mean radial 10 m, transverse" in text and "rms  radial 10 m, transverse" in text


@mark.parametrize("ending", [".oem", ".xml", ".e", ".csv", ".tum"])
def test_an_ephemeris_converts_to_every_format(oem_path, tmp_path, typed, ending):
    out = tmp_path / f"converted{ending}"
    assert typed(f"orbit convert {oem_path} --out {out} --json")["states"] == 2881
    if ending in (".oem", ".xml", ".e"):
        assert typed(f"orbit compare {oem_path} {out} --json")["max_m"] < 1e-5
    else:
        assert len(out.read_text().splitlines()) == 2881 + (ending == ".csv")
    assert [path.name for path in tmp_path.glob("*.part")] == []


def test_an_ephemeris_goes_through_spice_and_back(oem_path, tmp_path, typed):
    kernel, back = tmp_path / "orbit.bsp", tmp_path / "back.oem"
    made = typed(f"orbit convert {oem_path} --out {kernel} --spice-id -85 --json")
    assert made["spk_type"] == 3 and made["error_m"] < 1e-4
    older = typed(f"orbit convert {oem_path} --out {kernel} --spice-id -85 --type 13 --json")
    assert (older["spk_type"], older["states"], older["error_m"]) == (13, 2881, None)
    typed(f"orbit convert {kernel} --out {back} --spice-id -85 --step 30 --json")
    # A float64 of seconds is good to 0.2 mm at orbital speed.
    assert typed(f"orbit compare {oem_path} {back} --json")["max_m"] < 1e-3


@mark.parametrize("ending, count", [(".oem", 242), (".csv", 223), (".tum", 223), (".e", 223)])
def test_a_conversion_prints_as_many_states_as_it_writes(tmp_path, typed, ending, count):
    """Two arcs of 121 states share an epoch; 20 states of the second are beyond its useable interval."""
    first = polar_orbit(2.0).segments[0]
    stop = int(first.utc_ns[-1])
    later = replace(first, utc_ns=first.utc_ns + 7200 * NS, useable_stop_utc_ns=stop + 6030 * NS, tai_ns=None)
    path, out = tmp_path / "two.oem", tmp_path / f"out{ending}"
    save_oem(Ephemeris((first, later)), path)
    assert typed(f"orbit convert {path} --out {out} --json")["states"] == count
    rows = [line for line in out.read_text().splitlines() if line[0:1].isdigit() and len(line) > 60]
    assert len(rows) == count


def test_figures_of_states_that_gravity_does_not_move_are_refused(tmp_path, typed):
    (one,) = polar_orbit(2.0).segments
    save_oem(Ephemeris((replace(one, velocity_m_s=0.9 * one.velocity_m_s),)), tmp_path / "slow.oem")
    line = typed(f"orbit convert {tmp_path}/slow.oem --out {tmp_path}/fast.oem", 2)
    assert "expected an acceleration of" in line and "% off" in line


def test_a_kernel_without_its_number_an_unknown_format_and_a_file_cut_short_are_one_line(oem_path, tmp_path, typed):
    line = typed(f"orbit convert {oem_path} --out {tmp_path}/orbit.bsp", 2)
    assert "--spice-id: expected the SPICE number of the spacecraft, such as -85, found none" in line
    line = typed(f"orbit convert {oem_path} --out {tmp_path}/orbit.json", 2)
    assert "expected a name ending in .oem, .xml, .bsp, .e, .csv, .tum, found 'orbit.json'" in line
    cut = tmp_path / "cut.oem"
    cut.write_text(oem_path.read_text()[:2000])
    assert "cut.oem: line" in typed(f"orbit compare {cut} {oem_path}", 2)


def test_interpolate_gives_states_at_the_epochs_of_a_file(oem_path, tmp_path, typed):
    epochs = tmp_path / "epochs.txt"
    epochs.write_text("\ufeff# two epochs\n2029-08-07T00:00:00Z\n\n2029-08-07T12:34:56.789123Z  # odd\n")
    figures = typed(f"orbit interpolate {oem_path} --epochs {epochs} --json")
    first, second = figures["states"]
    assert set(first) == {*("epoch", "position_km", "velocity_km_s", "latitude_deg", "longitude_deg", "altitude_km")}
    assert second["epoch"] == "2029-08-07T12:34:56.789123000Z"
    assert np.linalg.norm(second["position_km"]) == approx(1768.18, abs=1e-6)
    assert first["altitude_km"] == approx(30.78, abs=1e-6)
    assert abs(first["latitude_deg"]) < 0.1
    assert len(typed(f"orbit interpolate {oem_path} --epochs {epochs}").splitlines()) == 3


def test_interpolate_names_the_epoch_that_is_not_covered_and_the_line_that_is_no_epoch(oem_path, tmp_path, typed):
    epochs = tmp_path / "epochs.txt"
    epochs.write_text("2029-09-07T00:00:00Z\n")
    line = typed(f"orbit interpolate {oem_path} --epochs {epochs}", 2)
    assert "found 2029-09-07T00:00:00.000Z; nothing is extrapolated" in line
    epochs.write_text("2029-08-07T00:00:00Z\nnoon\n")
    line = typed(f"orbit interpolate {oem_path} --epochs {epochs}", 2)
    assert "epochs.txt: line 2: expected a UTC epoch" in line and line.endswith("found 'noon'")


def test_catalogue_stats_counts_the_classes_of_the_papers_density(typed):
    figures = typed("catalogue stats paper-density --json")
    assert figures["class_counts"] == list(PAPER_CLASS_COUNTS)
    assert figures["total"] == sum(PAPER_CLASS_COUNTS)
    assert figures["source"].startswith("synthetic")


def test_the_fov_study_gives_the_probabilities_and_the_smallest_field_of_view(oem_path, typed):
    study = f"camera fov-study --ephemeris {oem_path} --catalogue paper-density"
    figures = typed(f"{study} --json")
    assert figures["fov_deg"] == list(range(10, 161, 10))
    assert set(figures["probability_at_least"]) == {"1", "3", "5"}
    enough = [p > 0.9 for p in figures["probability_at_least"]["3"]]
    assert figures["selected_fov_deg"] == figures["fov_deg"][enough.index(True)]
    assert "--needed: expected" in typed(f"{study} --needed 0", 2)
