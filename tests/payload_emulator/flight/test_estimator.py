"""The table of estimators: another filter is a module and a row."""

import re
from dataclasses import replace

import numpy as np
import pytest

from lunar.datafolder import find_data
from payload_emulator.flight.navigation.anchored.parameters import AnchoredParameters
from payload_emulator.flight.navigation.estimator import ESTIMATORS, AnchoredEstimator
from payload_emulator.flight.navigation.filter.map_offset import OffsetRule, OffsetSize
from payload_emulator.flight.navigation.outcomes import Mode
from payload_emulator.flight.onboard.loads import FlightParameters
from payload_emulator.flight.vision.detector import DetectorParameters
from payload_emulator.session.archive.emulator import emulate
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.spacecraft.loading import BuildParameters, format_parameters, parse_parameters
from tests.payload_emulator.flight import unscented
from tests.scenarios import short_scenario
from tmtc.dictionary.tables import CatalogueTable, GravityTable, InitialState, OrientationTable


def test_each_mode_has_a_row():
    assert set(ESTIMATORS) == set(Mode)


def test_a_sigma_point_filter_in_the_row_of_the_filter_flies_the_demo(tmp_path, monkeypatch):
    """Five frames that start with an error of 1 km, which the shipped filter reduces to 42 m at most."""
    craters = []
    update = unscented.update

    def counted(*given):
        craters.append(given[4].size)
        return update(*given)

    monkeypatch.setattr(unscented, "update", counted)
    monkeypatch.setitem(ESTIMATORS, Mode.anchored, AnchoredEstimator(unscented))
    flown = emulate(parse_scenario(short_scenario(75.0)), find_data(None), tmp_path)["navigation"]
    assert len(craters) == 5 and min(craters) > 10
    assert flown["fixed_share_imaging"] == 1.0 and flown["wrong_fixes"] == 0
    (arc,) = flown["per_arc"]
    assert arc["propagate_only_m"] > 900.0 > 100.0 > arc["max_m"]
    assert flown["nis_per_degree"] == pytest.approx(0.603, abs=0.005)


def test_what_was_learned_of_a_catalogue_is_kept_until_another_one_is_loaded():
    """A new start state comes with each pass: the size of the offset stays, with another list it is the prior."""
    two = np.array([0.1, 0.2])
    catalogue = CatalogueTable(np.arange(2), two, two, 5e3 * np.ones(2), np.zeros(2), 50.0 * np.ones((2, 3)))
    gravity = GravityTable("test", 4.9e12, 1_738e3, np.eye(3), np.zeros((3, 3)))
    tables = {
        "catalogue": catalogue, "gravity": gravity, "burns": None,
        "orientation": OrientationTable(np.array([0, 65_536]), np.tile(np.eye(3), (2, 1, 1)), np.eye(3)),
        "initial_state": InitialState(0, np.array([1.77e6, 0.0, 0.0]), np.array([0.0, 1.6e3, 0.0]), 1e3, 1.0)
    }  # fmt: skip
    parameters = FlightParameters(anchored=AnchoredParameters(offset=OffsetRule()))
    estimator = AnchoredEstimator()

    def size_m(before, **changed):
        setup, state = estimator.start(tables | changed, parameters, before)
        assert setup.initial.covariance[14, 14] == state.offset.sigma_m**2
        assert setup.parameters.errors.catalogue_correlation_rad == OffsetRule().correlation_rad
        assert setup.parameters.errors.noise_factor == (0.7 if state.offset.fixes else 1.0)
        return float(state.offset.sigma_m)

    setup, state = estimator.start(tables, parameters, None)
    assert state.offset == OffsetSize(60.0, 1.0)
    learned = setup, replace(state, offset=OffsetSize(22.0, 3.0, 80, noise_factor=0.7))
    assert size_m(learned, catalogue=replace(catalogue)) == 22.0
    assert size_m(learned, catalogue=replace(catalogue, latitude_rad=catalogue.latitude_rad + 1e-9)) == 60.0
    fixed = FlightParameters(anchored=AnchoredParameters())
    assert estimator.start(tables, fixed, learned)[1].offset is None


def test_a_parameter_file_of_before_learns_nothing_and_keeps_its_hash():
    learning = FlightParameters(anchored=AnchoredParameters(offset=OffsetRule()))
    text = format_parameters(BuildParameters(DetectorParameters(), learning))
    read = parse_parameters(text).flight
    assert read.anchored.offset == OffsetRule() and read.sha256 == learning.sha256
    older = re.sub(r"\[flight\.anchored\.offset\]\n(?:[^\[\n]+\n)*", "", text)
    before = parse_parameters(older).flight
    assert len(older) < len(text) and before.anchored.offset is None
    assert before.sha256 == FlightParameters().sha256 != learning.sha256
    assert "OffsetRule" not in repr(before)
