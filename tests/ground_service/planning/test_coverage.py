"""Windows outside the reference ephemerides: refused where the ground needs the ephemeris."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ground_service.access.model import AuditFilter
from ground_service.access.store import list_audit
from ground_service.errors import Conflict, InvalidInput, PlanConflicts
from ground_service.ground import Ground
from ground_service.missions.ephemerides.service import add_ephemeris, withdraw_ephemeris
from ground_service.missions.ephemerides.store import covering_ephemerides
from ground_service.missions.service import add_mission
from ground_service.planning.service import WindowEntry, add_window
from lunar.ephemeris import Ephemeris
from lunar.messages.oem import load_oem, save_oem
from lunar.timescales import parse_utc
from tests.ground_service.conftest import add_reference, save_circle

OUTSIDE = parse_utc("2031-01-01T00:00:00Z")
MISSION = """name = "covered"
[spacecraft]
id = 76
"""


def window(ephemeris_id: int | None = None) -> WindowEntry:
    return WindowEntry("w", OUTSIDE, OUTSIDE + 600 * 10**9, 15.0, 76, ephemeris_id=ephemeris_id)


def test_a_window_outside_the_ephemerides_has_no_prediction(ground: Ground, synthetic_pass: Any) -> None:
    add_reference(ground, synthetic_pass.folder / "reference.oem")
    predicted = add_window(ground, window(), actor="ann").predicted
    assert (predicted.frames, predicted.battery_minimum, predicted.downlinked_by) == (40, None, None)


def test_a_window_whose_tables_need_the_ephemeris_is_refused_outside_it(
    ground: Ground, synthetic_pass: Any
) -> None:
    add_reference(ground, synthetic_pass.folder / "reference.oem")
    add_mission(ground, (MISSION + "[uploads]\n").encode())
    with pytest.raises(PlanConflicts, match="expected a time that a reference ephemeris covers"):
        add_window(ground, window(), actor="ann")


def test_a_window_must_lie_in_the_ephemeris_that_it_names(ground: Ground, synthetic_pass: Any) -> None:
    file = ground.files.put_file(synthetic_pass.folder / "reference.oem")
    named = add_ephemeris(ground, file, name="reference")
    with pytest.raises(PlanConflicts, match="expected a time that a reference ephemeris covers"):
        add_window(ground, window(named.id), actor="ann")


def test_an_ephemeris_that_gravity_does_not_move_is_refused_with_the_accelerations(
    ground: Ground, tmp_path: Path
) -> None:
    (one,) = load_oem(save_circle(tmp_path / "km.oem")).segments
    metres = replace(one, position_m=1e3 * one.position_m, velocity_m_s=1e3 * one.velocity_m_s)
    save_oem(Ephemeris((metres,)), tmp_path / "m.oem")
    message = (
        r"ephemeris, states of SELENITA: expected an acceleration of \S+ m/s2 .* found .*metres for kilo"
    )
    with pytest.raises(InvalidInput, match=message):
        add_ephemeris(ground, ground.files.put_file(tmp_path / "m.oem"), name="metres")
    assert add_ephemeris(ground, ground.files.put_file(tmp_path / "km.oem"), name="km").states == 240


def test_an_ephemeris_belongs_to_a_spacecraft_and_can_be_withdrawn(
    ground: Ground, synthetic_pass: Any, tmp_path: Path
) -> None:
    text = (synthetic_pass.folder / "reference.oem").read_text()
    (tmp_path / "other.oem").write_text(text.replace("OBJECT_NAME = SELENITA", "OBJECT_NAME = OTHER"))
    own = add_ephemeris(ground, ground.files.put_file(synthetic_pass.folder / "reference.oem"), name="own")
    add_mission(ground, (MISSION + 'name = "SelenITA"\n').encode())
    other = ground.files.put_file(tmp_path / "other.oem")
    with pytest.raises(
        InvalidInput, match=r"OBJECT_NAME: expected a spacecraft .* \(SelenITA, .*, found OTHER"
    ):
        add_ephemeris(ground, other, name="other", precedence=9)
    add_mission(ground, b'name = "second"\n[spacecraft]\nid = 77\nobject_names = ["Other"]\n')
    foreign = add_ephemeris(ground, other, name="other", precedence=9)

    def used(spacecraft: int) -> list[int]:
        found = covering_ephemerides
        return [one.id for one in ground.read(found, own.start.utc_ns, own.stop.utc_ns, spacecraft)]

    assert (used(76), used(77)) == ([own.id], [foreign.id])
    withdraw_ephemeris(ground, foreign.id, actor="ann")
    assert (used(76), used(77)) == ([own.id], [])
    assert ground.files.path(other.sha256).exists()
    (entry,) = [one for one in ground.read(list_audit, AuditFilter()).items if "withdraw" in one.action]
    assert (entry.actor, entry.target) == ("ann", "other") and entry.detail["sha256"] == other.sha256
    span = own.start.utc_ns + 60 * 10**9, own.start.utc_ns + 120 * 10**9
    window = add_window(ground, WindowEntry("w", *span, 15.0, 76, ephemeris_id=own.id), actor="ann")
    with pytest.raises(Conflict, match=f"is that of window {window.id}"):
        withdraw_ephemeris(ground, own.id, actor="ann")
