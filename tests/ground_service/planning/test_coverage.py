"""Windows outside the reference ephemerides: refused where the ground needs the ephemeris."""

from typing import Any

import pytest

from ground_service.ephemerides.service import add_ephemeris
from ground_service.errors import PlanConflicts
from ground_service.ground import Ground
from ground_service.missions.service import add_mission
from ground_service.planning.service import WindowEntry, add_window
from lunar.timescales import parse_utc

OUTSIDE = parse_utc("2031-01-01T00:00:00Z")
MISSION = """name = "covered"
[spacecraft]
id = 76
"""


def window(ephemeris_id: int | None = None) -> WindowEntry:
    return WindowEntry("w", OUTSIDE, OUTSIDE + 600 * 10**9, 15.0, 76, ephemeris_id=ephemeris_id)


def test_a_window_outside_the_ephemerides_has_no_prediction(ground: Ground, synthetic_pass: Any) -> None:
    add_ephemeris(ground, ground.files.put_file(synthetic_pass.folder / "reference.oem"), name="reference")
    predicted = add_window(ground, window(), actor="ann").predicted
    assert (predicted.frames, predicted.battery_minimum, predicted.downlinked_by) == (40, None, None)


def test_a_window_whose_tables_need_the_ephemeris_is_refused_outside_it(
    ground: Ground, synthetic_pass: Any
) -> None:
    add_ephemeris(ground, ground.files.put_file(synthetic_pass.folder / "reference.oem"), name="reference")
    add_mission(ground, (MISSION + "[uploads]\n").encode())
    with pytest.raises(PlanConflicts, match="expected a time that a reference ephemeris covers"):
        add_window(ground, window(), actor="ann")


def test_a_window_must_lie_in_the_ephemeris_that_it_names(ground: Ground, synthetic_pass: Any) -> None:
    file = ground.files.put_file(synthetic_pass.folder / "reference.oem")
    named = add_ephemeris(ground, file, name="reference")
    with pytest.raises(PlanConflicts, match="expected a time that a reference ephemeris covers"):
        add_window(ground, window(named.id), actor="ann")
