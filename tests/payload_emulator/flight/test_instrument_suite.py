"""All instruments together, with two made by hand: order, attitude, samples that are passed on, telemetry."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from payload_emulator.flight.instruments import (
    AttitudeEstimate,
    FlightInstrument,
    Knowledge,
    Measured,
    Reading,
)
from payload_emulator.flight.navigation.scalar import Innovation, ScalarMeasurement
from payload_emulator.flight.onboard import instrument_suite
from payload_emulator.flight.onboard.instrument_suite import SuiteState, packets, read_frame, start_suite

SEEN: list[tuple[str, Any, Knowledge]] = []
TURNED = np.diag([1.0, -1.0, -1.0])
PARAMETERS = {"compass": "given", "sounder": None}


def compass_step(parameters: Any, state: Any, samples: Any, knowledge: Knowledge) -> Reading:
    SEEN.append(("compass", samples, knowledge))
    attitude = AttitudeEstimate(TURNED, 0.1) if len(samples) else None
    return Reading(
        state + 1, ({"sample_status": "used"},) * len(samples), {"heading": 5.0}, attitude=attitude
    )


def sounder_step(parameters: Any, state: Any, samples: Any, knowledge: Knowledge) -> Reading:
    SEEN.append(("sounder", samples, knowledge))
    measurements = [
        Measured(k, ScalarMeasurement(int(t), depth, lambda *_: None, 3.0))
        for k, (t, depth) in enumerate(samples)
    ]
    return Reading(
        state, tuple({"depth": depth} for _, depth in samples), measurements=tuple(reversed(measurements))
    )


@pytest.fixture(autouse=True)
def _declared(monkeypatch: pytest.MonkeyPatch) -> None:
    SEEN.clear()
    declared: Mapping[str, FlightInstrument] = {
        "compass": FlightInstrument(
            "compass", ("ticks",), object, lambda p: 0, compass_step, gives_attitude=True
        ),
        "sounder": FlightInstrument("sounder", ("ticks", "depth"), object, lambda p: None, sounder_step),
    }
    monkeypatch.setattr(instrument_suite, "flight_instruments", lambda: declared)


def frame(samples: Mapping[str, Any], state: SuiteState | None = None, parameters: Any = PARAMETERS) -> Any:
    state = start_suite(parameters) if state is None else state
    after, found = read_frame(parameters, state, samples, 100, np.eye(3))
    return SimpleNamespace(state=after, found=found)


def test_the_attitude_of_an_instrument_takes_the_place_of_the_message_for_those_after_it() -> None:
    result = frame({"compass": np.array([[90.0]])})
    np.testing.assert_array_equal(result.found.attitude.camera_from_icrf, TURNED)
    assert result.found.attitude.sigma_rad == 0.1
    assert SEEN[1][2].attitude is result.found.attitude
    assert SEEN[1][2].before is None
    assert result.state.states["compass"] == 1
    again = frame({}, result.state)
    # the newest attitude is handed on; without samples the compass gives none, and the message is not used
    ticks, rotation = SEEN[-1][2].before
    assert ticks == 100 and rotation is TURNED
    assert again.found.attitude.camera_from_icrf is None
    assert again.state.before == result.state.before


def test_without_such_an_instrument_the_message_of_the_adcs_is_the_attitude() -> None:
    result = frame({}, parameters={"sounder": None})
    np.testing.assert_array_equal(result.found.attitude.camera_from_icrf, np.eye(3))
    assert result.found.attitude.sigma_rad is None
    assert [name for name, *_ in SEEN] == ["sounder"]


def test_samples_are_given_in_order_of_time_up_to_the_frame_and_no_more_than_a_packet_holds() -> None:
    rows = np.array([[50.0, 2.0], [101.0, 3.0], [-1.0, 4.0], [np.nan, 5.0], [40.0, 1.0], [100.0, 6.0]])
    frame({"sounder": rows})
    np.testing.assert_array_equal(SEEN[1][1], [[40.0, 1.0], [50.0, 2.0], [100.0, 6.0]])
    many = np.stack([np.linspace(0.0, 99.0, 300), np.arange(300.0)], axis=1)
    frame({"sounder": many})
    assert SEEN[3][1][:, 1].tolist() == list(range(45, 300))


@pytest.mark.parametrize("rows", [np.zeros((2, 3)), np.zeros(2), np.zeros((0, 0))])
def test_samples_of_another_shape_or_instrument_are_ignored(rows: Any) -> None:
    frame({"sounder": rows, "thermometer": np.ones((1, 2))})
    assert [samples.shape for _, samples, _ in SEEN] == [(0, 1), (0, 2)]


def test_packets_hold_frame_fields_samples_and_what_the_filter_did_with_each() -> None:
    found = frame(
        {"compass": np.array([[90.0]]), "sounder": np.array([[10.0, 1.5], [20.0, 2.5], [30.0, 3.5]])}
    ).found
    assert [(name, row) for name, row, _ in found.measurements] == [("sounder", k) for k in range(3)]
    innovations = [Innovation(0.5, 1.0, used=True), Innovation(9.0, 1.0, used=False), None]
    (first, heading), (second, sounded) = packets(found, innovations, 7, 100)
    assert (first, second) == ("compass", "sounder")
    assert heading == {
        "frame_number": 7,
        "frame_ticks": 100,
        "heading": 5.0,
        "items": [{"sample_status": "used"}],
    }
    items: Any = sounded["items"]
    assert [row["sample_status"] for row in items] == ["used", "gated", "no_model"]
    assert [row["depth"] for row in items] == [1.5, 2.5, 3.5]
    assert [row["innovation"] for row in items[:2]] == [0.5, 9.0]
    assert np.isnan([items[2]["innovation"], items[2]["innovation_sigma"]]).all()


def test_an_instrument_without_samples_sends_nothing() -> None:
    assert list(packets(frame({}).found, [], 7, 100)) == []
