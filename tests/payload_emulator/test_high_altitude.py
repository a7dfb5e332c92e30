"""Navigation from 150 km with simulated detections: from the first frame, with an initial error of 2 km."""

from lunar.datafolder import DataFolder
from payload_emulator.session.archive.emulator import emulate
from payload_emulator.session.scenario import parse_scenario

SCENARIO = """
name = "high"
seed = 20150
[orbit]
epoch = "2029-08-07T00:00:00Z"
semi_major_axis_km = 1887.4
eccentricity = 0.001
inclination_deg = 89.076
raan_deg = 3.164
argument_of_perilune_deg = 333.604
true_anomaly_deg = 8.882
[dynamics]
gravity = "builtin"
orientation = "iau"
[maneuvers]
enabled = false
[window]
search = "none"
start = "2029-08-07T02:00:00Z"
duration_s = 240.0
[terrain]
source = "procedural"
[camera]
frame_interval_s = 30.0
images = "reduced"
[navigation]
estimators = ["anchored"]
filter_gravity = "builtin"
filter_degree = 8
initial_position_error_m = 2000.0
initial_velocity_error_m_s = 1.0
catalogue_min_diameter_km = 5.0
"""


def test_every_frame_is_fixed_and_the_error_is_below_a_pixel(tmp_path):
    summary = emulate(parse_scenario(SCENARIO), DataFolder(), tmp_path / "pass")
    assert summary["altitude_km"]["min"] > 140.0
    assert summary["outcomes"]["fixed"] == summary["frames"] == 8
    # A fix is wrong with an error above 1 km, which is the ground that a pixel covers.
    assert summary["navigation"]["wrong_fixes"] == 0
