"""Power, heat and processor time of the simulated board; faults as text."""

from __future__ import annotations

import numpy as np
import pytest

from payload_emulator.errors import ScenarioError
from payload_emulator.flight import ports
from payload_emulator.sim.board.faults import FAULT_KINDS, Fault, parse_fault
from payload_emulator.sim.board.platform import PlatformModel, SimulatedBoard


def board(**options: object) -> SimulatedBoard:
    return SimulatedBoard(
        PlatformModel(), 1, np.zeros(1000, dtype=np.uint8), np.zeros(1000, dtype=np.uint8), **options
    )


def test_the_sensors_and_stages_are_those_that_flight_reads() -> None:
    simulated = board()
    assert simulated.sensors().shape == (len(ports.SENSORS),)
    assert len(simulated.model.stage_ms) == len(ports.Stage)
    simulated.switch(ports.Load.camera)
    assert simulated.camera_on
    members = [name for name in vars(ports.Board) if not name.startswith("_")]
    assert all(hasattr(simulated, name) for name in [*members, "reset_cause", "store", "settings"])


def test_energy_is_kept_between_arrays_loads_and_battery() -> None:
    simulated = board(charge=0.5)
    simulated.switch(ports.Load.camera | ports.Load.accelerator)
    for _ in range(60):
        simulated.advance(60.0, 0.0)
    # An hour of 2.2 + 1.6 + 3.4 W out of 20 Wh, by hand.
    assert simulated.charge == pytest.approx(0.5 - 7.2 / 20.0, abs=1e-9)
    for _ in range(60):
        simulated.advance(60.0, 1.0)
    assert simulated.charge == pytest.approx(0.5 - 7.2 / 20.0 + (9.0 - 7.2) / 20.0, abs=1e-9)


def test_the_bus_obeys_ohms_law() -> None:
    simulated = board(charge=1.0)
    volts, amperes, _, _ = np.mean([simulated.sensors() for _ in range(400)], axis=0)
    # 12.6 V behind 0.15 ohm, 2.2 W drawn: V = 12.6 - 0.15 I, V I = 2.2; noise of 5 mV over 400 readings.
    assert volts == pytest.approx(12.5738, abs=2e-3)
    assert volts * amperes == pytest.approx(2.2, abs=2e-3)


def test_the_board_settles_at_the_temperature_of_its_balance() -> None:
    simulated = board()
    simulated.switch(ports.Load.camera | ports.Load.accelerator)
    for _ in range(500):
        simulated.advance(60.0, 1.0)
    # Structure 28 degC in sunlight, and the heat through the conductances.
    assert simulated.board_c == pytest.approx(28.0 + (2.2 + 3.4) / 0.35, abs=0.01)
    assert simulated.camera_c == pytest.approx(28.0 + 1.6 / 0.25, abs=0.01)
    # The step does not matter: exponentials, not differences.
    once = board()
    once.switch(ports.Load.camera | ports.Load.accelerator)
    once.advance(30_000.0, 1.0)
    assert once.board_c == pytest.approx(simulated.board_c, abs=0.01)


def test_the_counter_runs_on_by_the_time_of_each_stage() -> None:
    simulated = board()
    spent = []
    for _ in range(200):
        before = simulated.enter(ports.Stage.detector)
        spent.append((simulated.enter(ports.Stage.idle) - before) / 1e6)
    # 850 ms with a spread of a tenth; 4 sigma of a mean of 200.
    assert np.mean(spent) == pytest.approx(850.0, abs=4 * 85.0 / np.sqrt(200))
    assert 60.0 < np.std(spent) < 110.0


def test_flips_change_as_many_bits_as_asked_for() -> None:
    simulated = board()
    simulated.flip(simulated.store, 1, np.random.default_rng(2))
    assert np.unpackbits(simulated.store).sum() == 1


@pytest.mark.parametrize("kind", sorted(FAULT_KINDS))
def test_every_kind_of_fault_is_read(kind: str) -> None:
    lasts = " for 20" if FAULT_KINDS[kind].lasts else ""
    fault = parse_fault(f"  {kind} at 60{lasts} size 3 ")
    assert fault == Fault(kind, 60.0, 20.0 if lasts else 0.0, 3.0)
    assert fault.present(60.0) is bool(lasts) and not fault.present(80.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("camera_dark", "expected KIND at SECONDS"),
        ("camera_dark at soon for 3", "expected KIND at SECONDS"),
        ("camera_dark at 5", "expected how long it lasts"),
        ("meteor at 5", "expected one of camera_dark"),
        ("", "expected KIND at SECONDS"),
    ],
)
def test_other_lines_are_refused_with_a_reason(text: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        parse_fault(text)
