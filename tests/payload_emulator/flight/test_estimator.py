"""The table of estimators: another filter is a module and a row."""

from pathlib import Path
from typing import Any

import pytest

from lunar.datafolder import find_data
from payload_emulator.flight.navigation.estimator import ESTIMATORS, AnchoredEstimator
from payload_emulator.flight.navigation.outcomes import Mode
from payload_emulator.session.archive.emulator import emulate
from payload_emulator.session.scenario import parse_scenario
from tests.payload_emulator.flight import unscented
from tests.scenarios import short_scenario


def test_each_mode_has_a_row() -> None:
    assert set(ESTIMATORS) == set(Mode)


def test_a_sigma_point_filter_in_the_row_of_the_filter_flies_the_demo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five frames that start with an error of 1 km, which the shipped filter reduces to 42 m at most."""
    craters: list[int] = []
    update = unscented.update

    def counted(*given: Any) -> Any:
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
