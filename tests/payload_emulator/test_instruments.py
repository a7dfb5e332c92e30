"""Instruments as plug-ins: three files added from outside fly, are recorded, replayed, downlinked and refused."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lunar.frames import matrix_from_rotation_vector
from payload_emulator.errors import ParameterError, RecordError, ScenarioError
from payload_emulator.flight.onboard.loads import FlightParameters
from payload_emulator.session.parameter_file import parse_parameters
from payload_emulator.session.recording import _line, _parse, step_input
from payload_emulator.session.scenario import Scenario, parse_scenario
from payload_emulator.session.spacecraft import Given, _with_clock_error
from tests.scenarios import short_scenario

TELEMETRY = """
from tmtc.instruments import InstrumentTelemetry, Residual, sample_packet
from tmtc.fields import Field

TELEMETRY = InstrumentTelemetry(
    "plummet", "plummet", 9000,
    sample_packet("plummet", 200, "Length of a line to the sphere", (
        Field("length_m", "f32", "Length", "m"),
        Field("innovation", "f32", "Measurement minus prediction", "m"),
        Field("innovation_sigma", "f32", "Its standard deviation", "m"),
    )),
    (Residual("length", "innovation", "innovation_sigma", "m"),),
)
"""
SIMULATED = """
from dataclasses import dataclass
import numpy as np
from lunar.constants import MOON_RADIUS_M
from payload_emulator.sim.instruments import Limit, SimulatedInstrument

@dataclass(frozen=True, slots=True)
class Settings:
    noise_m: float = 2.0
    cadence_s: float = 5.0

def measure(settings, state, surroundings, situation):
    noise = settings.noise_m * surroundings.rng("plummet", situation.utc_ns).standard_normal()
    return state + 1, (float(np.linalg.norm(situation.position_mcmf_m)) - MOON_RADIUS_M + noise,)

INSTRUMENT = SimulatedInstrument(
    "plummet", Settings, lambda s: (Limit(s.noise_m >= 0.0, "noise_m", "zero or more", s.noise_m),),
    cadence_s=lambda s: s.cadence_s, delay_s=lambda s: 0.5 * s.cadence_s, data_sheet=lambda s: {"sigma_m": s.noise_m},
    start=lambda settings, surroundings: 0, measure=measure, replaces=("attitude.knowledge_bias_deg",),
)
"""
FLIGHT = """
from dataclasses import dataclass
import numpy as np
from lunar.constants import MOON_RADIUS_M
from payload_emulator.flight.instruments import FlightInstrument, Measured, Reading
from payload_emulator.flight.navigation.scalar import ScalarMeasurement, ScalarPrediction

@dataclass(frozen=True, slots=True)
class Parameters:
    sigma_m: float = 1.0

def step(parameters, state, samples, knowledge):
    def model(orbit, mcmf_from_icrf, landmarks):
        radius = float(np.linalg.norm(orbit.mean[:3]))
        design = np.zeros(orbit.mean.size)
        design[:3] = orbit.mean[:3] / radius
        return ScalarPrediction(radius - MOON_RADIUS_M, design, parameters.sigma_m)
    return Reading(
        state,
        tuple({"sample_ticks": int(t), "length_m": length} for t, length in samples),
        measurements=tuple(
            Measured(k, ScalarMeasurement(int(t), float(length), model, 5.0)) for k, (t, length) in enumerate(samples)
        ),
    )

INSTRUMENT = FlightInstrument("plummet", ("ticks", "length_m"), Parameters, lambda parameters: None, step)
"""
PROGRAM = """
import importlib, json, sys
from pathlib import Path

folder, out = Path(sys.argv[1]), Path(sys.argv[2])
for package in ("tmtc.instruments", "payload_emulator.sim.instruments", "payload_emulator.flight.instruments"):
    importlib.import_module(package).__path__.append(str(folder / package))

from lunar.datafolder import DataFolder
from payload_emulator.errors import ScenarioError
from payload_emulator.session.emulator import emulate
from payload_emulator.session.recording import load_record
from payload_emulator.session.replay import FlightBuild, replay_archive
from payload_emulator.session.scenario import format_scenario, parse_scenario
from ground_service.evaluation.instruments import instrument_reports
from tmtc.dictionary import DICTIONARY
from tmtc.downlink import decode

text = (folder / "scenario.toml").read_text()
refused = []
for wrong in (
    "[plummet]\\nnoise_m = -1.0",
    "[plummet]\\nnoise = 1.0",
    "[attitude]\\nknowledge_bias_deg = 1.0\\n[plummet]",
    "[plumet]",
):
    try:
        parse_scenario(text + wrong)
    except ScenarioError as error:
        refused.append(str(error))
scenario = parse_scenario(text + "[plummet]\\nnoise_m = 3.0\\n")
assert parse_scenario(format_scenario(scenario)) == scenario
results = {}
for name, one in (("with", scenario), ("without", parse_scenario(text))):
    results[name] = emulate(one, DataFolder(), out / name, frames_kept=None)["navigation"]
replay_archive(out / "with", FlightBuild(), out / "replay")
stricter = FlightBuild(parameters="[flight.instruments.plummet]\\nsigma_m = 1e-6\\n")
replay_archive(out / "with", stricter, out / "stricter")

replay_archive(out / "with", FlightBuild(), out / "again")

def of_name(octets, name):
    # housekeeping differs: the processor time of the flown board is not the payload's to repeat
    decoded = decode(octets)
    every = list(decoded.cut.packets(decoded.buffer))
    return [every[i] for i in decoded.tables()[name].packet_index.tolist()]

def reports(octets):
    return [
        [r.name, r.frames, r.samples, r.used, r.gated, [(s.samples, s.mean, s.rms) for s in r.residuals]]
        for r in instrument_reports(decode(octets).tables())
    ]

folders = ("with", "without", "replay", "again", "stricter")
octets = {name: (out / name / "downlink.cadu").read_bytes() for name in folders}
record = load_record(out / "with")
print(json.dumps({
    "refused": refused,
    "version": DICTIONARY.version,
    "replayed_the_same": octets["replay"] == octets["again"],
    "flown_the_same": [name for name in ("plummet", "filter_estimate", "navigation_state", "detections")
                       if of_name(octets["replay"], name) == of_name(octets["with"], name)],
    "ticks": [[item.clock_ticks, item.instruments["plummet"][:, 0].tolist()] for item in record.inputs
              if item.number >= 0],
    "reports": reports(octets["with"]),
    "stricter": reports(octets["stricter"]),
    "none": reports(octets["without"]),
    "manifest": "[plummet]" in json.loads((out / "with" / "manifest.json").read_text())["scenario_toml"],
}))
"""
SCENARIO = short_scenario(60.0)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("plug-in")
    for package, text in (
        ("tmtc.instruments", TELEMETRY),
        ("payload_emulator.sim.instruments", SIMULATED),
        ("payload_emulator.flight.instruments", FLIGHT),
    ):
        (folder / package).mkdir()
        (folder / package / "plummet.py").write_text(text)
    (folder / "scenario.toml").write_text(SCENARIO)
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(folder), str(folder / "out")],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).resolve().parents[2],
    )
    assert result.returncode == 0, result.stderr
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def test_three_files_add_an_instrument_that_is_flown_recorded_and_replayed_octet_for_octet(flown) -> None:
    assert flown["version"] == 9000
    assert flown["manifest"]
    assert flown["replayed_the_same"]
    assert flown["flown_the_same"] == ["plummet", "filter_estimate", "navigation_state", "detections"]


def test_samples_lie_between_the_frames_at_the_cadence_of_the_instrument(flown) -> None:
    second = 1 << 16
    assert len(flown["ticks"]) == 4
    for frame, ticks in flown["ticks"]:
        # half a cadence of 5 s before the frame, and back to the frame before
        assert ticks == pytest.approx(
            [frame - 12.5 * second, frame - 7.5 * second, frame - 2.5 * second], abs=1
        )


def test_the_filter_uses_the_samples_after_its_start_and_the_ground_reports_them(flown) -> None:
    ((name, frames, samples, used, gated, ((count, mean, rms),)),) = flown["reports"]
    assert (name, frames, samples, gated) == ("plummet", 4, 12, 0)
    # the samples before the first frame are older than the state that starts the filter
    assert used == count == 9
    assert abs(mean) < rms < 3_000.0


def test_another_build_may_change_the_parameters_of_an_instrument(flown) -> None:
    assert flown["stricter"] != flown["reports"]


def test_a_pass_without_the_instrument_reports_none(flown) -> None:
    assert flown["none"] == []


def test_a_wrong_section_of_an_instrument_is_refused_in_one_line(flown) -> None:
    assert flown["refused"] == [
        "scenario: plummet.noise_m must be zero or more, found -1.0",
        "scenario: unknown key 'plummet.noise'; did you mean 'noise_m'?",
        "scenario: attitude.knowledge_bias_deg must be left out because [plummet] takes its place, found 1.0",
        "scenario: unknown key 'plumet'; did you mean 'plummet'?",
    ]


def test_the_name_of_the_collection_is_no_section() -> None:
    with pytest.raises(ScenarioError, match="unknown key 'instruments'"):
        parse_scenario('name = "x"\n[instruments]')


def test_parameters_of_an_unknown_instrument_are_refused_or_dropped() -> None:
    text = "[flight.instruments.sextant]\nsigma_m = 1.0\n"
    with pytest.raises(ParameterError, match=r"flight\.instruments\.sextant.*unknown instrument"):
        parse_parameters(text)
    dropped: list[str] = []
    assert parse_parameters(text, dropped=dropped).flight.instruments == {}
    assert dropped == ["flight.instruments.sextant"]


def test_the_hash_of_parameters_knows_the_instruments_and_without_them_is_that_of_older_builds() -> None:
    import hashlib

    plain = FlightParameters()
    assert plain.sha256 == hashlib.sha256(repr(plain).encode()).hexdigest()
    assert "instruments" not in repr(plain)
    installed = FlightParameters(instruments={"sextant": 1.0})
    assert installed.hash != plain.hash
    assert installed.hash != FlightParameters(instruments={"sextant": 2.0}).hash


def test_a_record_keeps_samples_exactly_and_has_no_key_without_them(tmp_path: Path) -> None:
    def given(samples: dict[str, Any]) -> Given:
        return Given(np.zeros((2, 2), np.uint8), np.zeros(7), 5, b"", None, np.ones(4), 9, 10, samples)

    samples = {"a": np.array([[1.0 / 3.0, np.nan], [2.0**47, -0.1]]), "b": np.zeros((0, 3))}
    line = _line(step_input(0, given(samples)))
    read = _parse(line, tmp_path, 0).instruments
    np.testing.assert_array_equal(read["a"], samples["a"])
    assert read["b"].size == 0
    assert "instruments" not in json.loads(_line(step_input(0, given({}))))
    with pytest.raises(RecordError, match="line 1: expected the inputs of a step"):
        _parse(line.replace("[[", "["), tmp_path, 0)


def test_a_jump_of_the_clock_moves_the_times_of_samples_only() -> None:
    rows = np.array([[10.0, 1.0], [20.0, 2.0]])
    moved = _with_clock_error({"a": rows}, 7)["a"]
    np.testing.assert_array_equal(moved, [[17.0, 1.0], [27.0, 2.0]])
    assert _with_clock_error({"a": rows}, 0)["a"] is rows


def test_scenarios_stay_hashable_and_have_no_instruments_by_default() -> None:
    assert Scenario(name="x").instruments == {}
    assert isinstance(hash(Scenario(name="x")), int)


def test_rotation_helpers_of_the_bench_are_active_rotations() -> None:
    quarter = matrix_from_rotation_vector(np.array([0.0, 0.0, np.pi / 2.0]))
    np.testing.assert_allclose(quarter @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)
