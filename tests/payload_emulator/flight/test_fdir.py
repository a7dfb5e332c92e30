"""Faults of the machine: each is reported by an event, and answered."""

import numpy as np
from pytest import approx, fixture, mark

from payload_emulator.flight.onboard.loads import MODEL_NUMBER, FlightTables
from payload_emulator.flight.onboard.machine import PARAMETERS_NUMBER
from payload_emulator.flight.onboard.settings import Settings
from payload_emulator.flight.payload import PayloadMode
from payload_emulator.flight.ports import ResetCause
from payload_emulator.flight.vision.preprocess import ImageQuality
from tmtc.dictionary.fields import PARAMETERS

NUMBERS = {parameter.name: parameter.number for parameter in PARAMETERS}
NO_IMAGE = np.zeros((0, 0), np.uint8)


@fixture
def observing(rig):
    rig.perform("start_observation")
    rig.step()
    assert rig.mode is PayloadMode.observing
    return rig


def steps(rig, count, **options):
    return [packet for _ in range(count) for packet in rig.step(**options)]


def test_a_streak_of_dark_images_is_reported_at_its_beginning_and_its_end_only(observing):
    observing.quality = ImageQuality.DARK
    packets = steps(observing, 30)
    events = observing.events(packets)
    assert events.count("image_dark") == 8
    assert events.count("image_streak") == 1
    streak = next(v for v in observing.named(packets, "event_medium") if v["value_1"] == ImageQuality.DARK)
    assert streak["value_2"] == 8
    observing.quality = ImageQuality.OK
    packets = steps(observing, 3)
    assert observing.events(packets).count("image_streak") == 1
    assert observing.named(packets, "event_info")[0]["value_2"] == 30
    assert observing.mode is PayloadMode.observing


def test_a_saturated_streak_shorter_than_the_limit_is_reported_frame_by_frame(observing):
    observing.quality = ImageQuality.SATURATED
    events = observing.events(steps(observing, 5))
    assert events.count("image_saturated") == 5 and "image_streak" not in events


def test_a_camera_without_images_is_cycled_and_recovers(observing):
    packets = steps(observing, 3, image=NO_IMAGE)
    assert observing.events(packets).count("camera_fault") == 1
    assert not observing.board.camera_on
    packets = observing.step()
    assert "camera_recovered" in observing.events(packets)
    assert observing.board.camera_on
    assert observing.mode is PayloadMode.observing


def test_a_camera_that_stays_dead_ends_the_observation(observing):
    events = observing.events(steps(observing, 12, image=NO_IMAGE))
    assert events.count("camera_fault") == 4
    assert "observation_stopped" in events
    assert observing.mode is PayloadMode.standby


def test_late_detections_are_not_used_and_a_detector_that_stays_slow_ends_in_safe(observing):
    observing.board.detector_factor = 30.0
    packets = steps(observing, 4)
    assert observing.events(packets).count("detector_timeout") == 4
    assert observing.mode is PayloadMode.observing
    assert {v["count"] for v in observing.named(packets, "detections")} == {0}
    packets = steps(observing, 1)
    assert "safe_mode_entered" in observing.events(packets)
    assert observing.mode is PayloadMode.safe


def test_an_inference_library_that_throws_costs_frames_not_the_payload(observing):
    observing.failing = True
    assert observing.events(steps(observing, 4)).count("detector_error") == 4
    observing.failing = False
    assert len(observing.named(observing.step(), "detections")) == 1
    assert observing.mode is PayloadMode.observing
    observing.failing = True
    steps(observing, 5)
    assert observing.mode is PayloadMode.safe


@mark.parametrize(
    "region, event", [(MODEL_NUMBER, "model_hash_mismatch"), (PARAMETERS_NUMBER, "parameters_hash_mismatch")]
)
def test_flipped_bits_in_memory_are_found_reported_and_restored(observing, region, event):
    observing.board.memory[region][1] ^= 0x08
    packets = steps(observing, 5)
    assert observing.events(packets).count(event) == 1
    assert observing.events(packets).count("memory_repaired") == 1
    assert observing.mode is PayloadMode.observing
    assert observing.detectors_made == (1 if region == MODEL_NUMBER else 0)
    assert event not in observing.events(steps(observing, 5))


@mark.parametrize(
    "table, event",
    [
        ("catalogue", "catalogue_hash_mismatch"),
        ("anchor_ephemeris", "anchor_table_hash_mismatch"),
        ("gravity", "table_hash_mismatch"),
    ],
)
def test_every_table_is_scrubbed(make_rig, table, event):
    rig = make_rig(FlightTables(**{table: b"octets of a table"}))
    rig.step()
    number = {"catalogue": 2, "anchor_ephemeris": 1, "gravity": 3}[table]
    rig.board.memory[number][0] ^= 1
    assert event in rig.events(steps(rig, 5))
    assert rig.board.memory[number].tobytes() == b"octets of a table"


def test_memory_whose_kept_copy_is_damaged_too_ends_in_safe(observing):
    observing.board.memory[MODEL_NUMBER][3] ^= 1
    observing.board.tables[MODEL_NUMBER][7] ^= 1
    packets = steps(observing, 5)
    assert "memory_unrepairable" in observing.events(packets)
    assert observing.mode is PayloadMode.safe
    # Back in service once a good model is there again.
    observing.board.write_table(MODEL_NUMBER, observing.model)
    steps(observing, 5)
    observing.perform("set_mode", PayloadMode.standby)
    assert observing.mode is PayloadMode.standby


def test_a_watchdog_reset_resumes_the_observation_and_too_many_end_in_safe(observing):
    frames = observing.named(observing.step(), "detections")[0]["frame_number"]
    for number in (1, 2):
        observing.boot(ResetCause.watchdog)
        packets = observing.step()
        events = observing.events(packets)
        assert {"boot", "watchdog_reset", "state_recovered"} <= set(events)
        assert observing.mode is PayloadMode.observing
        # Frames and sequence counts go on where they were.
        frames += 1
        assert [v["frame_number"] for v in observing.named(packets, "detections")] == [frames]
        assert observing.named(packets, "housekeeping")[0]["watchdog_resets"] == number
    observing.boot(ResetCause.watchdog)
    packets = observing.step()
    assert observing.mode is PayloadMode.safe
    assert "safe_mode_entered" in observing.events(packets)


def test_watchdog_resets_an_hour_apart_do_not_add_up(observing):
    for _ in range(4):
        observing.boot(ResetCause.watchdog)
        observing.step(seconds=4_000.0)
        assert observing.mode is PayloadMode.observing


def test_a_commanded_reset_comes_up_in_standby_with_the_next_boot_count(observing):
    packets = observing.perform("reboot")
    assert len(observing.named(packets, "verification_completed")) == 1
    after = observing.step()
    assert observing.mode is PayloadMode.standby
    assert next(v["value_1"] for v in observing.named(after, "event_info")) == 2.0


def test_an_observation_whose_time_is_over_is_not_resumed(rig):
    rig.perform("start_observation", 60.0)
    rig.boot(ResetCause.brown_out)
    rig.step(seconds=100.0)
    assert rig.mode is PayloadMode.standby


def test_settings_lost_in_both_copies_end_in_safe(observing):
    observing.board.settings[:] ^= 0xA5
    observing.boot(ResetCause.brown_out)
    packets = observing.step()
    assert "state_lost" in observing.events(packets)
    assert observing.mode is PayloadMode.safe


@mark.parametrize("values", [{"boot_count": 3}, {"boot_count": "many"}, {"mode": 9, "boot_count": 1}])
def test_settings_that_another_build_wrote_count_as_lost(rig, values):
    Settings(rig.board.settings).write(values)
    packets = rig.step()
    assert "state_lost" in rig.events(packets)
    assert rig.mode is PayloadMode.safe


def test_settings_damaged_in_one_copy_are_recovered_from_the_other(observing):
    observing.board.settings[20] ^= 0x01
    observing.boot(ResetCause.brown_out)
    packets = observing.step()
    assert "state_recovered" in observing.events(packets)
    assert observing.named(packets, "event_low")[0]["value_1"] == 2.0
    assert observing.mode is PayloadMode.observing


def test_packets_damaged_in_the_store_are_found_reported_and_never_sent(observing):
    observing.board.downlink = 0
    steps(observing, 3)
    used = np.flatnonzero(observing.board.store)
    # Inside the newest packet of the largest class.
    observing.board.store[used[-4]] ^= 0x40
    observing.board.downlink = 1 << 30
    packets = observing.step(seconds=60.0)
    assert "storage_corrupt" in observing.events(packets)


@mark.parametrize("jump_s", [3_600.0, 5.0, -5.0, -3_600.0])
def test_a_clock_that_jumps_is_reported_and_housekeeping_begins_again(observing, jump_s):
    observing.skew_ticks += round(jump_s * 65_536)
    packets = observing.step()
    assert [v["value_1"] for v in observing.named(packets, "event_medium")] == [approx(jump_s, abs=1e-3)]
    assert observing.named(packets, "housekeeping")[0]["clock_status"] == 2
    assert len(observing.named(observing.step(), "detections")) == 1


def test_the_drift_of_a_good_clock_is_no_jump(observing):
    observing.skew_ticks += 65_536
    assert "clock_jump" not in observing.events(observing.step())


def test_a_clock_that_jumps_ahead_does_not_release_what_it_has_passed(rig):
    ping = rig.command("test_connection")
    rig.step(rig.at(600.0, ping))
    rig.skew_ticks += 3_600 * 65_536
    packets = rig.step()
    assert "activity_expired" in rig.events(packets)
    assert not rig.named(packets, "connection_report")


LIMITS = """52 0 temperature_high
90 0 temperature_high safe
-50 0 temperature_low
0 2.3 power_low
0 3.5 power_low safe"""


@mark.parametrize("row", LIMITS.splitlines())
def test_power_and_heat_out_of_limits_are_reported_once_and_end_in_safe_beyond(observing, row):
    heat, drop, event, *beyond = row.split()
    heat_c, drop_v, safe = float(heat), float(drop), bool(beyond)
    observing.board.heat_c, observing.board.drop_v = heat_c, drop_v
    packets = steps(observing, 6)
    assert observing.events(packets).count(event) == 1
    assert (observing.mode is PayloadMode.safe) is safe
    assert observing.board.camera_on is not safe
    observing.board.heat_c = observing.board.drop_v = 0.0
    steps(observing, 3)
    observing.board.heat_c, observing.board.drop_v = heat_c, drop_v
    assert observing.events(steps(observing, 3)).count(event) == 1


def test_too_much_memory_is_reported(rig):
    order = rig.command("set_parameter", parameter_id=NUMBERS["memory_high_kib"], value=1024.0)
    assert rig.events(rig.step(order)).count("memory_high") == 1


def test_a_flooded_store_is_reported_each_time_that_the_loss_has_doubled(rig):
    rig.board.downlink = 0
    rig.send("set_housekeeping_interval", structure_id=1, interval_s=1)
    for _ in range(700):
        rig.step(seconds=1.0, image=None)
    rig.board.downlink = 1 << 30
    packets = rig.step(image=None)
    lost = [v["value_1"] for v in rig.named(packets, "event_medium")]
    assert 0 < len(lost) < 12
    assert lost == sorted(lost)


def test_dead_sensors_break_no_limit(observing, monkeypatch):
    monkeypatch.setattr(type(observing.board), "sensors", lambda board: np.full(4, np.nan))
    packets = steps(observing, 6)
    assert observing.named(packets, "housekeeping")[0]["temperature_c"] == 0.0
    assert observing.mode is PayloadMode.observing
