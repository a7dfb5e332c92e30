"""Comparison of a mission run with disturbances with the same run without them."""

from benchmarks.campaigns.arrivals import compare
from lunar.timescales import parse_utc

START = "2029-08-07T01:02:02.812499Z"
OTHER = "2029-08-08T02:00:00.000000Z"


def report(packets=900, errors=(98.0, 95.0), state="processed"):
    passes = [
        {"start": start, "median_error_m": error, "map_offset_m": error, "verdict_level": "met"}
        for start, error in zip((START, OTHER), errors, strict=True)
    ]
    return {
        "packets": packets,
        "packets_implausible": 0,
        "window_list": [{"start": START, "state": state, "reason": None}],
        "navigation": {"anchored": {"median_m": sum(errors) / 2}},
        "performance": {"passes": passes},
        "alarms": [],
        "wall_s": packets,
    }


def outcomes(disturbed, **given):
    found = compare(report(), disturbed, given.get("events", {}), given.get("causes", {}))
    return {one.name: one.outcome for one in found if one.outcome != "equal"}


def test_figures_are_flagged_by_events_of_their_pass_and_packets_kept_apart_and_others_different():
    assert outcomes(report(errors=(98.0, 95.001))) == {}
    assert outcomes(report(errors=(98.0, 96.0), packets=901)) == {
        f"performance.passes[{OTHER}].map_offset_m": "DIFFERENT",
        f"performance.passes[{OTHER}].median_error_m": "DIFFERENT",
        "navigation.anchored.median_m": "DIFFERENT",
        "packets": "DIFFERENT",
    }
    disturbed = report(errors=(98.0, 96.0))
    assert set(outcomes(disturbed, events={OTHER: {"clock_jump"}}).values()) == {"flagged"}
    assert set(outcomes(disturbed, events={START: {"clock_jump"}}).values()) == {"DIFFERENT"}
    disturbed = report(packets=901, errors=(98.0, 96.0)) | {"packets_implausible": 1}
    found = outcomes(disturbed)
    assert found["packets"] == found["packets_implausible"] == "flagged"
    assert found["navigation.anchored.median_m"] == "DIFFERENT"


def test_a_window_fails_for_a_false_reason_unless_a_cause_was_planted_before_it():
    name = f"window_list[{START}].state"
    early, late = parse_utc("2029-08-06T20:00:00Z"), parse_utc("2029-08-07T20:00:00Z")
    assert outcomes(report(state="failed"), causes={late: "clock step"}) == {name: "DIFFERENT"}
    assert outcomes(report(state="failed"), causes={early: "clock step"}) == {name: "flagged"}
