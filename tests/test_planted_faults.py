"""Faults that are planted in short flights are flagged by the requirement that they break, and by no other."""

from dataclasses import replace

import pytest

from ground_service.evaluation.service import evaluate
from ground_service.ground import open_ground
from ground_service.missions.timekeeping.recorrelation import recorrelate
from ground_service.passes.archive_import import import_archive
from ground_service.passes.store import get_pass
from lunar.datafolder import DataFolder
from payload_emulator.session.archive.emulator import emulate
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.world import camera
from tests.scenarios import live_scenario

# The simulated detector finds 70 % of the craters in view; the limit of the recall is a tenth below.
LIMITS = """
[reference]
transverse_m = 10.0
normal_m = 5.0
[requirements]
median_error_m = 5000.0
p95_error_m = 20000.0
better_than = []
recall = 0.63
offset_px = 0.25
clock_step_s = 0.1
anchor_reads = -1.0
consistency_inside_percent = -1.0
[clock]
drift_ppm = 5.0
"""
SCENARIO = parse_scenario(live_scenario("planted", 3, 600.0) + LIMITS)


@pytest.fixture(scope="module")
def fly(tmp_path_factory):
    """Emulate a flight, import its archive and evaluate it."""

    def flown(scenario):
        folder = tmp_path_factory.mktemp("planted")
        emulate(scenario, DataFolder(None), folder / "pass", frames_kept=0)
        with open_ground(folder / "home") as ground:
            pass_id = import_archive(ground, folder / "pass")
            recorrelate(ground, ground.read(get_pass, pass_id).vehicle_id)
            return evaluate(ground, pass_id)

    return flown


def statuses(report):
    return {one.key: one.status for one in report.requirements if one.status != "not judged"}


@pytest.fixture(scope="module")
def healthy(fly):
    return fly(SCENARIO)


def test_a_healthy_pass_is_met(healthy):
    assert healthy.verdict_level == "met", healthy.verdict
    assert {"detector.recall", "pointing.offset", "time.step"} <= statuses(healthy).keys()


@pytest.mark.parametrize(
    ("fault", "requirement"),
    [
        ("camera bias of 0.5 px", "pointing.offset"), ("undeclared attitude bias of 0.2 deg", "pointing.offset"),
        ("recall of four fifths", "detector.recall"), ("clock step of 1 s", "time.step"),
    ],
)  # fmt: skip
def test_a_planted_fault_is_flagged_in_the_first_pass_by_its_requirement(fault, requirement, healthy, fly, monkeypatch):
    scenario = SCENARIO
    if fault.startswith("camera"):
        monkeypatch.setattr(camera, "_REDUCED_DETECTOR", replace(camera._REDUCED_DETECTOR, bias_px=(0.5, 0.0)))
    elif fault.startswith("undeclared"):
        attitude = replace(scenario.attitude, knowledge_bias_deg=0.2, declared_bias_deg=0.0)
        scenario = replace(scenario, attitude=attitude)
    elif fault.startswith("recall"):
        monkeypatch.setattr(camera, "_REDUCED_RECALL", 0.8 * camera._REDUCED_RECALL)
    else:
        scenario = replace(scenario, faults=replace(scenario.faults, events=("clock_jump at 300 size 1.0",)))
    report = fly(scenario)
    found = statuses(report)
    assert found[requirement] == "not met", report.verdict
    assert report.verdict_level == "not met" and report.verdict.startswith("1 of ")
    assert {key for key, status in found.items() if status != statuses(healthy)[key]} == {requirement}
