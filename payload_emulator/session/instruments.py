"""Instruments of a scenario: their sections, their samples before each frame, and their parameters on board."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lunar.arrays import FloatArray
from lunar.frames import rotation_vector_from_matrix
from lunar.timescales import tdb_s_from_utc_ns
from payload_emulator.flight.instruments import flight_instruments
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.world import NO_SAMPLES, Samples, World, clock_ticks
from payload_emulator.sim.instruments import Situation, Surroundings, simulated_instruments
from payload_emulator.sim.orbit.truth import perturbed
from tmtc.dictionary import DICTIONARY
from tmtc.errors import TmtcError
from tmtc.instruments import ATTITUDE, instrument_telemetry

_NS = 1_000_000_000


def flight_parameters(scenario: Scenario) -> dict[str, Any]:
    """Return the on-board parameters of the instruments of a scenario, as the ground knows them from data sheets."""
    declared = flight_instruments()
    return {
        name: declared[name].parameters(**simulated_instruments()[name].data_sheet(settings))
        for name, settings in scenario.instruments.items()
    }


def onboard_attitudes(packets: Iterable[bytes]) -> dict[int, FloatArray]:
    """Return the attitudes that instruments gave: quaternion q_wxyz (4,) of camera from ICRF by time of the frame."""
    giving = {
        one.name for one in instrument_telemetry() if any(item.name == ATTITUDE for item in one.packet.fields)
    }
    found: dict[int, FloatArray] = {}
    for packet in packets if giving else ():
        try:
            name, values = DICTIONARY.unpack(packet)
        except TmtcError:
            continue
        if name in giving:
            found[int(values["frame_ticks"])] = np.asarray(values[ATTITUDE], dtype=np.float64)
    return found


@dataclass(slots=True, eq=False)
class InstrumentBench:
    """The instruments of a world, sampled frame after frame in order of time, in the thread that renders.

    An instrument is on while frames are taken: its samples before a frame reach back no further than one interval.
    """

    world: World
    _states: dict[str, Any] = field(default_factory=dict)
    _sampled_utc_ns: dict[str, int] = field(default_factory=dict)
    _frame: tuple[int, FloatArray] | None = None

    @property
    def state(self) -> tuple[dict[str, Any], dict[str, int], tuple[int, FloatArray] | None]:
        """What the samples to come depend on."""
        return self._states, self._sampled_utc_ns, self._frame

    @state.setter
    def state(self, value: tuple[dict[str, Any], dict[str, int], tuple[int, FloatArray] | None]) -> None:
        self._states, self._sampled_utc_ns, self._frame = value

    def sample(self, utc_ns: int, camera_from_mcmf: FloatArray) -> Samples:
        """Return the samples before a frame, the on-board time first; `camera_from_mcmf` is its true attitude."""
        scenario = self.world.scenario
        if not scenario.instruments:
            return NO_SAMPLES
        interval_ns = round(scenario.camera.frame_interval_s * _NS)
        here = self.world.truth.positions_mcmf(utc_ns)[0]
        offset = rotation_vector_from_matrix(camera_from_mcmf @ self.world.camera_from_mcmf(here).T)
        if self._frame is None or utc_ns - self._frame[0] > 1.5 * interval_ns:
            # Before the first frame of an arc the pointing error is that of the frame.
            self._frame = (utc_ns - interval_ns, offset)
        since = max(self._frame[0], self.world.truth.start_utc_ns)
        samples = {
            name: self._samples_of(name, settings, since, utc_ns, offset)
            for name, settings in scenario.instruments.items()
        }
        self._frame = (utc_ns, offset)
        return samples

    def _samples_of(
        self, name: str, settings: Any, since_utc_ns: int, utc_ns: int, offset: FloatArray
    ) -> FloatArray:
        instrument = simulated_instruments()[name]
        surroundings = Surroundings(self.world.terrain, self.world.scenario.seed)
        if name not in self._states:
            self._states[name] = instrument.start(settings, surroundings)
        cadence_ns = round(instrument.cadence_s(settings) * _NS)
        newest = utc_ns - round(instrument.delay_s(settings) * _NS)
        times = np.arange(newest, since_utc_ns, -cadence_ns, dtype=np.int64)[::-1]
        rows = []
        for time in times.tolist():
            before = self._sampled_utc_ns.get(name)
            elapsed_ns = None if before is None else time - before
            if elapsed_ns is not None and elapsed_ns > 1.5 * cadence_ns:
                elapsed_ns = None
            situation = self._situation(time, elapsed_ns, utc_ns, offset)
            self._states[name], values = instrument.measure(
                settings, self._states[name], surroundings, situation
            )
            self._sampled_utc_ns[name] = time
            rows.append((float(clock_ticks(self.world, time)), *values))
        return np.array(rows, dtype=np.float64).reshape(len(rows), len(flight_instruments()[name].columns))

    def _situation(
        self, utc_ns: int, elapsed_ns: int | None, frame_utc_ns: int, offset: FloatArray
    ) -> Situation:
        """Return the true situation; the pointing error changes linearly from one frame to the next."""
        assert self._frame is not None
        before_utc_ns, before_offset = self._frame
        share = (utc_ns - before_utc_ns) / (frame_utc_ns - before_utc_ns)
        truth = self.world.truth
        position = truth.states(utc_ns)[0][0]
        mcmf_from_icrf = truth.orientation.mcmf_from_icrf(float(tdb_s_from_utc_ns(utc_ns)))
        fixed = mcmf_from_icrf @ position
        pointed = perturbed(
            self.world.camera_from_mcmf(fixed), before_offset + share * (offset - before_offset)
        )
        return Situation(
            utc_ns,
            None if elapsed_ns is None else elapsed_ns / _NS,
            position,
            fixed,
            pointed @ mcmf_from_icrf,
            mcmf_from_icrf,
        )
