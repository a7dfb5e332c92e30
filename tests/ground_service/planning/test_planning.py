"""Candidate windows: every sample fulfils the constraints, computed here again by hand; preparation of windows."""

import os
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark, raises

from ground_service.access.model import AuditFilter
from ground_service.access.store import list_audit
from ground_service.contacts.links.core import PredictedContact
from ground_service.errors import Conflict, InvalidInput, PlanConflicts
from ground_service.ground import run_apart
from ground_service.missions.ephemerides.service import add_ephemeris, covering_ephemerides, withdraw_ephemeris
from ground_service.missions.model import Uploads
from ground_service.missions.service import add_mission
from ground_service.planning.core import Constraints, Planner, Resources, data_octets, frames_between, storage_peak
from ground_service.planning.filling import Option
from ground_service.planning.preparation import experiment_accuracy, experiment_state, prepare_window
from ground_service.planning.service import WindowEntry, add_window
from ground_service.planning.store import get_record
from ground_service.planning.window_states import PlannedSpan, WindowEvidence, span_conflicts, state_of
from lunar.camera import PinholeCamera
from lunar.catalogue import load_catalogue
from lunar.constants import GM_MOON_M3_S2, MOON_RADIUS_M
from lunar.ephemeris import Ephemeris, EphemerisSegment, ephemeris_from_states
from lunar.frames import IauOrientation
from lunar.messages.ephemeris_files import load_ephemeris
from lunar.messages.oem import save_oem
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from tests.ground_service.conftest import add_reference, save_circle
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.tables import unpack_anchor_table, unpack_initial_state, unpack_orientation_table
from tmtc.packets.large_data import LargeDataReceiver

NS = 1_000_000_000
START = parse_utc("2029-08-07T06:00:00Z")
RADIUS_M = MOON_RADIUS_M + 40e3
PERIOD_S = 2.0 * np.pi * np.sqrt(RADIUS_M**3 / GM_MOON_M3_S2)


def circle(eccentric_m=0.0):
    """Five hours on a polar circle of 40 km altitude; `eccentric_m` lets the altitude swing by so much."""
    utc_ns = START + np.arange(0, 5 * 3600, 20, dtype=np.int64) * NS
    rate = 2.0 * np.pi / PERIOD_S
    angle = rate * (utc_ns - START) / NS
    radius = RADIUS_M + eccentric_m * np.cos(angle)
    along, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    position = radius[:, None] * (c * along + s * up)
    slope = (-eccentric_m * rate * np.sin(angle))[:, None]
    velocity = slope * (c * along + s * up) + (radius * rate)[:, None] * (-s * along + c * up)
    return ephemeris_from_states(utc_ns, position, velocity)


def planner(ephemeris, **resources):
    return Planner(ephemeris, IauOrientation(), Resources(**resources), PinholeCamera())


def search(plan, **constraints):
    return plan.search(Constraints(**constraints), plan.ephemeris.start_utc_ns, plan.ephemeris.stop_utc_ns, 15.0)


def test_altitude_is_kept_all_along_and_missed_just_outside():
    plan = planner(circle(eccentric_m=20e3))
    found = search(plan, altitude_m=(45e3, 100e3), maximum_duration_s=7200.0).candidates
    assert len(found) >= 2
    for candidate in found:
        assert candidate.altitude_m[0] >= 45e3 - 20.0  # edges to 1 s, 20 m/s of climb at most
        for edge, step in (candidate.start_utc_ns, -5 * NS), (candidate.stop_utc_ns, 5 * NS):
            outside = edge + step
            if plan.ephemeris.start_utc_ns <= outside <= plan.ephemeris.stop_utc_ns:
                position, _ = plan.ephemeris.at(np.array([outside]))
                assert np.linalg.norm(position) - MOON_RADIUS_M < 45e3


def test_sunlight_on_the_ground_and_on_the_spacecraft():
    plan = planner(circle())
    found = search(plan, sun_elevation_rad=(np.radians(10.0), np.pi), sunlit=True).candidates
    assert found
    for candidate in found:
        epochs = np.linspace(candidate.start_utc_ns, candidate.stop_utc_ns, 20).astype(np.int64)
        position, _ = plan.ephemeris.at(epochs)
        sun = np.asarray(sun_position_icrf_m(np.asarray(tdb_s_from_utc_ns(epochs))))
        cosine = np.sum(position * sun, axis=1) / np.linalg.norm(position, axis=1) / np.linalg.norm(sun, axis=1)
        # The Sun stands at 90 degrees less the angle between the zenith and it, parallax below 0.01 degrees.
        assert np.all(np.degrees(np.arcsin(cosine)) > 9.98)
        assert candidate.sunlit_share == 1.0


def test_long_spans_are_cut_and_short_ones_left_out():
    plan = planner(circle())
    everything = search(plan, maximum_duration_s=1200.0)
    assert len(everything.candidates) == 15  # 17980 s in pieces of 1200 s at most
    assert everything.candidates[0].stop_utc_ns == everything.candidates[1].start_utc_ns
    apart = search(replace(plan, gap_ns=81 * NS), maximum_duration_s=1200.0).candidates
    assert [b.start_utc_ns - a.stop_utc_ns for a, b in pairwise(apart)] == [81 * NS] * 14
    assert all(one.stop_utc_ns - one.start_utc_ns <= 1200 * NS for one in apart)
    none = search(plan, minimum_duration_s=86_400.0)
    assert none.candidates == ()
    assert {one.reason for one in none.rejected} == {"too short"}
    assert "shorter than the minimum duration 86400 s" in none.reason


def test_an_empty_result_names_the_smallest_set_of_constraints_and_the_nearest_relaxation():
    plan = planner(circle(eccentric_m=20e3))
    north, low = (np.radians(60.0), np.radians(90.0)), (0.0, 35e3)
    assert search(plan, latitude_rad=north).candidates
    assert search(plan, altitude_m=low).candidates
    found = search(plan, latitude_rad=north, altitude_m=low)
    assert found.candidates == ()
    reason, _, possible = found.reason.partition("; possible: ")
    assert reason == (
        "no window: excluded by altitude 0 to 35 km, latitude 60 to 90 deg with the minimum duration 300 s"
    )
    # The spacecraft is at 40 km over the pole and lower on one side of it.
    (relaxed,) = re.findall(r"altitude 0 to 35 km relaxed by ([\d.]+) km", possible)
    wider = (0.0, 35e3 + 1e3 * float(relaxed) + 100.0)
    assert search(plan, latitude_rad=north, altitude_m=wider).candidates
    assert not search(plan, latitude_rad=north, altitude_m=(0.0, wider[1] - 1e3)).candidates
    high = search(plan, altitude_m=(80e3, 90e3), latitude_rad=north)
    assert "excluded by altitude 80 to 90 km with" in high.reason
    limited = search(plan, latitude_rad=north, limit_rad=np.radians(50.0))
    assert "excluded by latitude 60 to 90 deg, latitude limit of the mission description 50 deg" in limited.reason
    assert "latitude 60 to 90 deg relaxed by" in limited.reason and "without" not in limited.reason


def test_craters_are_counted_in_the_camera(make_pass):
    folder = make_pass(frames=6, seed=3).folder
    ephemeris, catalogue = load_ephemeris(folder / "reference.oem"), load_catalogue(folder / "catalogue.csv")
    plan = Planner(ephemeris, IauOrientation(), Resources(), PinholeCamera(), catalogue)
    (one,) = search(plan, craters_per_frame=30.0, minimum_duration_s=60.0).candidates
    assert one.craters_per_frame[0] >= 30.0
    # Craters were only placed around the six frames: the search has to find that stretch and no other.
    middle = (one.start_utc_ns + one.stop_utc_ns) // 2
    assert abs(middle - (START + 38 * NS)) < 60 * NS


@mark.parametrize("duration_s, frames", [(90.0, 6), (90.1, 7), (104.9, 7), (5.0, 1)])
def test_an_observation_has_a_frame_at_its_start_and_none_at_its_stop(duration_s, frames):
    assert frames_between(START, START + round(duration_s * NS), 15.0) == frames


def test_terrain_is_asked_of_the_map():
    north = Planner(circle(), IauOrientation(), Resources(), PinholeCamera(), mare=lambda latitude, _: latitude > 0.0)
    for wanted, sign in (True, 1.0), (False, -1.0):
        found = search(north, mare=wanted).candidates
        assert found
        assert all(sign * candidate.latitude_rad[0] > -1e-2 for candidate in found)
        assert all(candidate.mare_share == float(wanted) for candidate in found)


def test_the_battery_falls_with_the_load():
    weak = planner(circle(), battery_wh=4.0, generation_w=13.0)
    none = search(weak, minimum_battery=0.5)
    rejected = none.rejected
    assert "battery too low" in {one.reason for one in rejected} and not none.candidates
    (possible,) = re.findall(
        r"excluded by battery too low \(\d+\).*; possible: a minimum battery of ([\d.]+)", none.reason
    )
    assert search(weak, minimum_battery=float(possible)).candidates
    assert not search(weak, minimum_battery=float(possible) + 2e-3).candidates
    assert all(one.start_utc_ns < one.stop_utc_ns for one in rejected)
    strong = search(planner(circle(), generation_w=1000.0), maximum_duration_s=3600.0, sunlit=True)
    assert all(candidate.battery_minimum > 0.85 for candidate in strong.candidates)
    assert strong.candidates[0].energy_wh == approx(
        8.0 * (strong.candidates[0].stop_utc_ns - strong.candidates[0].start_utc_ns) / NS / 3600.0
    )


def test_data_are_as_long_as_their_packets_and_leave_the_store_in_the_order_they_came():
    first, second = Option(0, 100 * NS, 1000), Option(200 * NS, 300 * NS, 500)
    contacts = [
        PredictedContact(one, a * NS, b * NS) for one, a, b in zip("aba", (400, 450, 900), (460, 500, 960), strict=True)
    ]
    # 1000 octets at 80 bit/s take the 100 s of the two contacts that overlap; the next 50 s carry the other 500.
    assert storage_peak([first, second], contacts, 80.0, second) == (1500, 950 * NS)
    early = [PredictedContact("a", 100 * NS, 200 * NS)]
    assert storage_peak([first, second], early, 80.0, second) == (1000, None)
    assert storage_peak([first], contacts, 0.0, first) == (1000, None)
    # Packet lengths by the ICD: detections 35 + 9 n, navigation state 84, frame outcome 59, housekeeping 92 octets.
    names = ("detections", "navigation_state", "frame_outcome", "housekeeping")
    detections, state, outcome, housekeeping = (DICTIONARY.packet(name).base_length for name in names)
    assert data_octets(3, 10.0, 2) == 3 * (detections + 10 * 9 + 2 * (state + outcome) + housekeeping)


def test_windows_conflict_where_they_overlap():
    mine = PlannedSpan(1, 100, 200, "draft")
    others = [
        PlannedSpan(2, 50, 101, "approved"), PlannedSpan(3, 200, 300, "approved"),
        PlannedSpan(4, 120, 130, "draft"), PlannedSpan(5, 120, 130, "failed"), PlannedSpan(6, 199, 400, "executed"),
    ]  # fmt: skip
    assert [one.window_id for one in span_conflicts(mine, None, others)] == [2, 6]
    near = span_conflicts(mine, None, others, gap_ns=1)
    assert [one.window_id for one in near] == [2, 3, 6]
    assert near[1].detail.endswith("for their telecommands, found 0 s")
    assert span_conflicts(mine, PlannedSpan(7, 0, 100, "approved"), []) == []
    late = span_conflicts(mine, PlannedSpan(7, 0, 101, "failed"), [])
    assert [one.kind for one in late] == ["predecessor", "predecessor"]


SENT = ("completed", "accepted")
STATES = """\
draft draft started=True
failed failed frames=5
approved approved
approved approved command_states=("released", "carried")
approved uplinked command_states=SENT
approved failed command_states=("sent", "failed")
approved failed predecessor_failed=True, command_states=SENT
approved failed replaced=True, command_states=SENT, frames=2
approved failed command_states=SENT, received_after=True
approved executing command_states=SENT, started=True
approved executing command_states=SENT, frames=2
approved executed command_states=SENT, started=True, stopped=True, lost=2
approved executed command_states=SENT, frames=9, received_after=True, lost=1
approved downlinked command_states=SENT, frames=9, received_after=True, lost=0
approved processed command_states=SENT, frames=9, received_after=True, lost=0, reported=True"""


@mark.parametrize("row", STATES.splitlines())
def test_the_state_follows_from_the_facts(row):
    decision, expected, facts = f"{row} ".split(" ", 2)
    state, reason = state_of(WindowEvidence(decision, **eval(f"dict({facts})")))
    assert state == expected
    assert (reason is not None) == (state == "failed" and decision == "approved")


def test_a_window_that_failed_names_the_telecommand_and_its_failure():
    evidence = WindowEvidence("approved", command_states=("failed",), failure="insert_activity not accepted: busy")
    assert state_of(evidence)[1] == "a telecommand of it failed: insert_activity not accepted: busy"


OUTSIDE = parse_utc("2031-01-01T00:00:00Z")
MISSION = """name = "covered"
[spacecraft]
id = 76
"""


def window(ephemeris_id=None):
    return WindowEntry("w", OUTSIDE, OUTSIDE + 600 * 10**9, 15.0, 76, ephemeris_id=ephemeris_id)


def test_a_window_outside_the_ephemerides_has_no_prediction_and_is_refused_if_it_needs_one(ground, synthetic_pass):
    """It names the ephemeris, or its tables are made of one."""
    named = add_reference(ground, synthetic_pass.folder / "reference.oem")
    predicted = add_window(ground, window(), actor="ann").predicted
    assert (predicted.frames, predicted.battery_minimum, predicted.downlinked_by) == (40, None, None)
    for key in named, None:
        with raises(PlanConflicts, match="expected a time that a reference ephemeris covers"):
            add_window(ground, window(key), actor="ann")
        add_mission(ground, (MISSION + "[uploads]\n").encode())


def test_an_ephemeris_that_gravity_does_not_move_is_refused_with_the_accelerations(ground, tmp_path):
    (one,) = load_ephemeris(save_circle(tmp_path / "km.oem")).segments
    metres = replace(one, position_m=1e3 * one.position_m, velocity_m_s=1e3 * one.velocity_m_s)
    save_oem(Ephemeris((metres,)), tmp_path / "m.oem")
    message = r"ephemeris, states of SELENITA: expected an acceleration of \S+ m/s2 .* found .*metres for kilo"
    with raises(InvalidInput, match=message):
        add_ephemeris(ground, ground.files.put_file(tmp_path / "m.oem"), name="metres")
    assert add_ephemeris(ground, ground.files.put_file(tmp_path / "km.oem"), name="km").states == 240


def test_an_ephemeris_belongs_to_a_spacecraft_and_can_be_withdrawn(ground, synthetic_pass, tmp_path):
    text = (synthetic_pass.folder / "reference.oem").read_text()
    (tmp_path / "other.oem").write_text(text.replace("OBJECT_NAME = SELENITA", "OBJECT_NAME = OTHER"))
    own = add_ephemeris(ground, ground.files.put_file(synthetic_pass.folder / "reference.oem"), name="own")
    add_mission(ground, (MISSION + 'name = "SelenITA"\n').encode())
    other = ground.files.put_file(tmp_path / "other.oem")
    with raises(InvalidInput, match=r"OBJECT_NAME: expected a spacecraft .* \(SelenITA, .*, found OTHER"):
        add_ephemeris(ground, other, name="other", precedence=9)
    add_mission(ground, b'name = "second"\n[spacecraft]\nid = 77\nobject_names = ["Other"]\n')
    foreign = add_ephemeris(ground, other, name="other", precedence=9)

    def used(spacecraft):
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
    withdraw_ephemeris(ground, own.id, actor="ann")  # one action, also while a window names it
    assert ground.read(get_record, window.id).entry().ephemeris_id is None
    assert used(76) == []


def test_a_function_runs_apart_from_this_process():
    assert run_apart(os.getpid) != os.getpid()


BEGIN = parse_utc("2029-08-08T10:00:00Z")
STOP = BEGIN + 600 * NS
ALL = Uploads(
    tables=("orientation", "anchor_ephemeris", "initial_state"), sigma_position_m=500.0, sigma_velocity_m_s=0.5
)


def ticks_of(utc_ns):
    """Return the reading of a clock that is 7 s ahead, counted from the start of the window."""
    return 1_000_000 + (utc_ns - BEGIN + 7 * NS) * 65_536 // NS


@fixture(scope="module")
def reference():
    times = np.arange(BEGIN - 3_600 * NS, STOP + 3_600 * NS, 30 * NS)
    angle = 2.0 * np.pi * (times - BEGIN) / (6_672.0 * NS)
    rate = 2.0 * np.pi / 6_672.0
    zero = np.zeros_like(angle)
    position = 1.768e6 * np.stack([np.cos(angle), zero, np.sin(angle)], axis=1)
    velocity = 1.768e6 * rate * np.stack([-np.sin(angle), zero, np.cos(angle)], axis=1)
    segment = EphemerisSegment(times, position, velocity, object_name="A", object_id="A", degree=7)
    return Ephemeris((segment,))


def prepared(ephemeris, uploads=ALL, *start, late=0):
    return prepare_window(uploads, ephemeris, IauOrientation(), BEGIN + late, STOP + late, ticks_of, 8, *start)


def loaded(activities):
    """Octets by number of the table, as the payload puts the parts together."""
    receiver, found = LargeDataReceiver(), {}
    numbers = {"anchor_ephemeris": 1, "orientation": 8, "initial_state": 9}
    for _, name, arguments in activities:
        if name.startswith("uplink"):
            octets = np.array([one["octet"] for one in arguments["items"]], dtype=np.uint8)
            values = {**arguments, "table": numbers[arguments["table"]], "items": {"octet": octets}}
            whole = receiver.accept(name, values)
            found[whole.table] = whole.octets
    return found


def test_the_tables_hold_the_reference_at_on_board_times(reference):
    activities, state = prepared(reference)
    tables = loaded(activities)
    initial = unpack_initial_state(tables[9])
    assert initial.ticks == ticks_of(BEGIN)
    assert_allclose(initial.position_icrf_m, [1.768e6, 0.0, 0.0], atol=1e-3)
    assert_allclose(initial.velocity_icrf_m_s, [0.0, 0.0, 1664.97], atol=0.01)
    assert (initial.sigma_position_m, initial.sigma_velocity_m_s) == (500.0, 0.5)
    assert state.utc_ns == BEGIN
    anchor = unpack_anchor_table(tables[1])
    assert anchor.ticks[0] == ticks_of(BEGIN - 120 * NS) and anchor.ticks[-1] >= ticks_of(STOP + 100 * NS)
    k = int(np.flatnonzero(anchor.ticks == ticks_of(BEGIN))[0])
    expected = IauOrientation().mcmf_from_icrf(float(tdb_s_from_utc_ns(BEGIN))) @ [1.768e6, 0.0, 0.0]
    assert_allclose(anchor.position_mcmf_m[k], expected, atol=0.01)
    orientation = unpack_orientation_table(tables[8])
    assert orientation.ticks[0] < ticks_of(BEGIN) < ticks_of(STOP) < orientation.ticks[-1]


def test_a_window_of_the_experiment_starts_from_the_stated_error_with_its_declared_accuracy(reference):
    made = [experiment_state(reference, 1_000.0, BEGIN + k * NS, 76) for k in range(400)]
    known = [reference.at(np.array([one.utc_ns])) for one in made]
    position = np.array([a.position_icrf_m - b[0][0] for a, b in zip(made, known, strict=True)])
    velocity = np.array([a.velocity_icrf_m_s - b[1][0] for a, b in zip(made, known, strict=True)])
    # 400 draws: the standard deviation of each axis is known to 3.5 %, its mean to 5 %.
    assert_allclose(position.std(axis=0), 1_000.0, rtol=0.12)
    assert_allclose(position.mean(axis=0), 0.0, atol=180.0)
    assert_allclose(velocity.std(axis=0), 1_000.0 * 2.0 * np.pi / 6_672.0, rtol=0.12)
    again = experiment_state(reference, 1_000.0, BEGIN, 76)
    assert_array_equal(again.position_icrf_m, made[0].position_icrf_m)
    assert (experiment_state(reference, 1e3, BEGIN, 77).position_icrf_m != again.position_icrf_m).all()
    stated = experiment_accuracy(ALL, 1_000.0, again)
    activities, state = prepared(reference, stated, again)
    initial = unpack_initial_state(loaded(activities)[9])
    assert state is again and initial.sigma_position_m == 1_000.0
    assert initial.sigma_velocity_m_s == approx(0.9417, rel=5e-3)
    assert_allclose(initial.position_icrf_m, again.position_icrf_m, atol=1e-3)


def test_standby_comes_first_then_the_tables_with_the_start_state_last_and_the_downlink_after_the_window(reference):
    activities, _ = prepared(reference)
    times = [utc_ns for utc_ns, _, _ in activities]
    assert times == sorted(times)
    modes = [(utc_ns, one["argument_1"]) for utc_ns, name, one in activities if name == "perform_function"]
    assert modes == [(BEGIN - 60 * NS, 1.0), (STOP + 20 * NS, 3.0)]
    loads = [(utc_ns, one["table"]) for utc_ns, name, one in activities if name.startswith("uplink")]
    assert loads[-1][1] == "initial_state"
    assert all(BEGIN - 60 * NS < utc_ns < BEGIN for utc_ns, _ in loads)


def test_without_tables_only_the_mode_changes():
    activities, state = prepared(None, Uploads())
    assert [name for _, name, _ in activities] == ["perform_function"] * 2 and state is None


def test_a_window_without_a_reference_that_covers_it_is_refused(reference):
    for ephemeris, late in (None, 0), (reference, 7_800 * NS):
        with raises(Conflict, match="its tables need a reference ephemeris"):
            prepared(ephemeris, late=late)
