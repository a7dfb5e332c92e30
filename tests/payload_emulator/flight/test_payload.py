"""The payload: frames and telecommands in, packets out; modes, settings that survive, and its document."""

import re

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx, mark

from payload_emulator.flight.navigation.outcomes import Mode
from payload_emulator.flight.onboard.icd import format_interfaces
from payload_emulator.flight.onboard.modes import ALLOWED, TRANSITIONS, PayloadMode
from payload_emulator.flight.onboard.settings import Recovery, Settings
from payload_emulator.flight.payload import FlightParameters, FlightTables, Payload
from payload_emulator.flight.ports import Board
from payload_emulator.flight.vision.detections import Detections, no_detections
from payload_emulator.flight.vision.preprocess import ImageQuality
from tmtc.dictionary.fields import PARAMETERS
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.tables import table_hash

IMAGE = np.zeros((4, 4, 3), np.uint8)
ATTITUDE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
FIRST_S = 6_600.0


DARK = (ImageQuality.DARK, no_detections())
EMPTY = (ImageQuality.OK, no_detections())


class ScriptedDetector:
    """Hands out prepared detections, one set per image."""

    def __init__(self, frames):
        self.frames = list(frames)

    def examine(self, image, sun_in_camera=None):
        frame = self.frames.pop(0)
        return frame if isinstance(frame, tuple) else (ImageQuality.OK, frame)


def anchor_octets(moon):
    seconds = np.arange(6_000.0, 9_000.0, 30.0)
    return moon.anchor(seconds)


def true_frames(moon, count):
    field = moon.crater_field(1)
    return [field.perfect_detections(moon.orbit([FIRST_S + 15.0 * k])[0]) for k in range(count)]


def payload(moon, frames, **options):
    tables = FlightTables(anchor_ephemeris=anchor_octets(moon))
    return Payload(ScriptedDetector(frames), FlightParameters(), tables, **options)


def fly(moon, flown, count):
    packets = []
    for k in range(count):
        packets += flown.step(IMAGE, ATTITUDE, moon.ticks_at(FIRST_S + 15.0 * k), b"")
    return packets


def named(packets, name):
    decoded = [DICTIONARY.unpack(packet) for packet in packets]
    return [values for found, values in decoded if found == name]


def command(name, count=5, **values):
    return DICTIONARY.pack_command(name, values, sequence_count=count)


def test_each_frame_reports_detections_states_and_outcomes_of_every_estimator(moon):
    frames = true_frames(moon, 4)
    packets = fly(moon, payload(moon, frames, model_hash=0xDEADBEEF), 4)
    detections = named(packets, "detections")
    assert [values["frame_number"] for values in detections] == [0, 1, 2, 3]
    assert [values["count"] for values in detections] == [len(frame) for frame in frames]
    # 1/64 px quantisation.
    assert_allclose(detections[2]["items"]["u_px"], frames[2].u_px, atol=1 / 128)
    assert set(detections[2]["items"]["size_class"].tolist()) <= {0, 1, 2}
    outcomes = named(packets, "frame_outcome")
    assert [(v["estimator"], v["outcome"]) for v in outcomes[:2]] == [(0, 0), (1, 0)]
    assert [v["outcome"] for v in outcomes[2:]] == [1] * 6
    assert [v["anchor_reads"] for v in outcomes if v["estimator"] == 0] == [1, 2, 3, 4]
    states = named(packets, "navigation_state")
    truth = moon.place(moon.orbit([FIRST_S + 45.0])[0])
    last = next(v for v in states if v["frame_number"] == 3 and v["estimator"] == 1)
    assert last["latitude_deg"] == approx(np.degrees(truth[0]), abs=1e-4)
    assert last["longitude_deg"] == approx(np.degrees(truth[1]) % 360.0, abs=1e-4)
    assert np.all(np.isnan(last["velocity_icrf_m_s"]))


def test_housekeeping_counts_what_happened(moon):
    octets = anchor_octets(moon)
    frames = [*true_frames(moon, 5), DARK]
    flown = payload(moon, frames, model_hash=0xDEADBEEF, boot_count=3)
    packets = fly(moon, flown, 6)
    # One at boot, one a minute later.
    first, second = named(packets, "housekeeping")
    assert (first["boot_count"], first["mode"], first["model_hash"]) == (3, 2, 0xDEADBEEF)
    assert second["anchor_table_hash"] == table_hash(octets)
    assert second["frames_processed"] == 5
    assert second["detections_total"] == sum(len(frame) for frame in frames[:5])
    # Two estimators: five altitudes and one reset each.
    assert second["anchor_reads"] == 12
    fly_on = named(fly(moon, payload(moon, [DARK]), 1), "housekeeping")[0]
    assert (fly_on["frames_bad"], fly_on["last_image_quality"]) == (1, 1)
    summary = flown.summary()
    assert summary["frames_bad"] == 1
    assert summary["estimators"]["paper"]["outcomes"] == {
        "anchored": 1, "multi": 4, "single": 0, "predicted": 1, "missed": 0, "rejected": 0
    }  # fmt: skip
    assert summary["estimators"]["paper"]["reset_triggers"] == {"initialization": 1}
    assert summary["anchor_reads_after_start"] == 5


def test_a_manual_step_command_resets_both_estimators_and_is_verified(moon):
    flown = payload(moon, true_frames(moon, 3))
    fly(moon, flown, 2)
    order = command("perform_function", function_id="manual_step", argument_1=0.0, argument_2=0.0)
    packets = flown.step(IMAGE, ATTITUDE, moon.ticks_at(FIRST_S + 30.0), order)
    assert [v["reset_trigger"] for v in named(packets, "frame_outcome")] == [3, 3]
    request = int.from_bytes(order[:4], "big")
    for stage in ("accepted", "started", "completed"):
        assert named(packets, f"verification_{stage}") == [{"request_id": request}]


def test_a_damaged_telecommand_is_refused_and_counted(moon):
    good = command("test_connection")
    packets = payload(moon, [EMPTY]).step(IMAGE, ATTITUDE, moon.ticks_at(FIRST_S), good[:-1] + bytes([good[-1] ^ 1]))
    assert [v["failure_code"] for v in named(packets, "verification_not_accepted")] == [2]
    assert named(packets, "housekeeping")[0]["telecommands_rejected"] == 1


def test_nothing_a_camera_or_adcs_can_send_stops_the_payload(moon):
    nan = np.full(7, np.nan)
    wild = Detections(
        np.array([-3.0, 5e3, np.nan, np.inf]), np.array([4.0, -9.0, 1.0, 2.0]), np.array([1e9, -5.0, 30.0, 1.0]),
        np.array([2.0, -1.0, np.nan, 0.5]), np.array([np.nan, 1e9, 0.1, 0.1])
    )  # fmt: skip
    flown = payload(moon, [wild, wild, (ImageQuality.INVALID, no_detections()), wild])
    packets = []
    for k, attitude in enumerate([nan, np.empty(0), ATTITUDE, ATTITUDE]):
        # The clock jumps back at the last frame.
        second = FIRST_S + 15.0 * k if k < 3 else FIRST_S - 1_000.0
        packets += flown.step(np.empty((0, 0)), attitude, moon.ticks_at(second), b"")
    events = [v["event_id"] for v in named(packets, "event_low")]
    assert events.count(21) == 2
    assert named(packets, "event_medium")[0]["value_1"] == approx(-1_030.0)
    assert named(packets, "housekeeping")[-1]["clock_status"] == 2


def test_parameters_have_a_hash_that_changes_with_them():
    one, two = FlightParameters(), FlightParameters(modes=(Mode.paper,))
    assert one.hash == FlightParameters().hash != two.hash
    assert one.sha256.startswith(f"{one.hash:08x}")


SAFE, STANDBY, OBSERVING, DOWNLINKING = PayloadMode
# Written out here a second time on purpose: who may follow whom.
ALLOWED_CHANGES = {
    (SAFE, SAFE), (SAFE, STANDBY),
    (STANDBY, SAFE), (STANDBY, STANDBY), (STANDBY, OBSERVING), (STANDBY, DOWNLINKING),
    (OBSERVING, SAFE), (OBSERVING, STANDBY), (OBSERVING, OBSERVING),
    (DOWNLINKING, SAFE), (DOWNLINKING, STANDBY), (DOWNLINKING, DOWNLINKING)
}  # fmt: skip
PATHS = {SAFE: [SAFE], STANDBY: [], OBSERVING: [OBSERVING], DOWNLINKING: [DOWNLINKING]}


def set_mode(rig, mode):
    rig.step(b"".join(rig.function("set_mode", step) for step in PATHS[mode]))
    assert rig.mode is mode


@mark.parametrize("present", PayloadMode)
@mark.parametrize("wanted", PayloadMode)
def test_a_mode_follows_another_only_as_the_table_says(rig, present, wanted):
    set_mode(rig, present)
    packets = rig.perform("set_mode", wanted)
    if (present, wanted) in ALLOWED_CHANGES:
        assert rig.mode is wanted
        assert rig.refusals(packets) == []
        assert ("mode_changed" in rig.events(packets)) is (present is not wanted)
    else:
        assert rig.mode is present
        assert rig.refusals(packets) == ["wrong_mode"]
    assert (wanted in TRANSITIONS[present]) is ((present, wanted) in ALLOWED_CHANGES)


PART = {"transaction": 1, "table": 1, "items": {"octet": [1]}}
COMMANDS = {
    "replay_store": {"start_ticks": 1, "stop_ticks": 2}, "delete_store": {"stop_ticks": 1},
    **{f"uplink_{part}": PART | {"part": k} for k, part in enumerate(("first", "middle", "last"), 1)}
}  # fmt: skip


@mark.parametrize("name", sorted(ALLOWED))
@mark.parametrize("mode", PayloadMode)
def test_a_command_out_of_its_mode_is_refused_and_does_nothing(rig, name, mode):
    set_mode(rig, mode)
    packets = rig.step(rig.command(name, **COMMANDS[name]) if name in COMMANDS else rig.function(name))
    refused = rig.refusals(packets)
    assert ("wrong_mode" in refused) is (mode not in ALLOWED[name])
    if refused:
        assert rig.mode is mode
        assert not rig.named(packets, "verification_completed")


def test_the_table_names_only_what_the_dictionary_has():
    functions = set(DICTIONARY.labels("perform_function", "function_id").values())
    commands = {definition.name for definition in DICTIONARY.telecommands}
    assert set(ALLOWED) <= functions | commands
    assert set(TRANSITIONS) == set(PayloadMode)


VALUES = {"boot_count": 3, "parameters": {"scrub_interval_s": 5.0}, "schedule": [[17, "18a0"]]}


def written(*every):
    memory = np.zeros(1000, np.uint8)
    settings = Settings(memory)
    for values in every:
        assert settings.write(values)
    return memory


def test_new_memory_is_blank_and_the_newest_of_many_is_read():
    assert Settings(np.zeros(1000, np.uint8)).read() == (Recovery.blank, {})
    memory = written({"a": 1}, {"a": 2}, VALUES)
    settings = Settings(memory)
    assert settings.read() == (Recovery.whole, VALUES)
    assert settings.write({"a": 4})
    assert Settings(memory).read() == (Recovery.whole, {"a": 4})


@mark.parametrize("half", [0, 1])
@mark.parametrize("octet", [0, 5, 9, 13, 20, 60])
def test_a_flipped_bit_in_either_copy_costs_nothing(half, octet):
    memory = written({"a": 1}, VALUES)
    memory[500 * half + octet] ^= 0x04
    assert Settings(memory).read() == (Recovery.older, VALUES)


def test_writing_interrupted_anywhere_leaves_the_old_or_the_new():
    before, after = written(VALUES), written(VALUES, {"a": 2})
    changed = np.flatnonzero(before != after)
    # The copy with the lower generation is written first: the half that held generation 1.
    order = np.concatenate([changed[changed >= 500], changed[changed < 500]])
    for stop in range(order.size + 1):
        memory = before.copy()
        memory[order[:stop]] = after[order[:stop]]
        verdict, values = Settings(memory).read()
        assert values in (VALUES, {"a": 2}), stop
        assert verdict in (Recovery.whole, Recovery.older)


def test_two_damaged_copies_are_lost_and_what_does_not_fit_is_refused():
    memory = written(VALUES)
    memory[[20, 520]] ^= 1
    assert Settings(memory).read() == (Recovery.lost, {})
    memory = written(VALUES)
    settings = Settings(memory)
    settings.read()
    assert not settings.write({"much": "x" * 500})
    assert Settings(memory).read() == (Recovery.whole, VALUES)


def test_a_set_of_settings_knows_the_generation_that_it_wrote():
    memory = np.zeros(1000, np.uint8)
    settings = Settings(memory)
    for _ in range(3):
        assert settings.write(VALUES)
        found = Settings(memory)
        found.read()
        assert found.generation == settings.generation


def test_every_port_parameter_and_command_and_the_events_of_faults_are_in_the_document():
    text = format_interfaces()
    ports = [name for name in vars(Board) if not name.startswith("_") and callable(getattr(Board, name))]
    assert len(ports) > 8
    for name in ports:
        assert f"| `{name}(" in text
    for parameter in PARAMETERS:
        assert f"| {parameter.number} | {parameter.name} |" in text
    for name in ALLOWED:
        assert f"| {name} |" in text
    known = set(DICTIONARY.labels("event_info", "event_id").values())
    rows = format_interfaces().split("## Faults")[1].splitlines()[4:]
    named = {event for row in rows if row for event in re.findall(r"\w+", row.split("|")[2])}
    assert len(named) > 25
    assert named <= known
