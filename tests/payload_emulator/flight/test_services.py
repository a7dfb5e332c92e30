"""The services of the payload as a machine: what telecommands do, and why some do nothing."""

import math
import struct

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from pytest import approx, mark

from payload_emulator.flight.onboard.loads import TABLE_NUMBERS
from payload_emulator.flight.payload import PayloadMode
from payload_emulator.flight.ports import ResetCause
from payload_emulator.flight.telemetry.packets import map_octets
from tmtc.dictionary.fields import PARAMETERS, find_parameter
from tmtc.dictionary.payload import DICTIONARY
from tmtc.packets.large_data import LargeDataReceiver, split, unpack_thumbnail
from tmtc.packets.space_packets import append_crc

NUMBERS = {parameter.name: parameter.number for parameter in PARAMETERS}


# Telecommand verification (service 1)


def test_every_stage_that_was_asked_for_is_reported_and_no_other(rig):
    for flags, stages in ((0b1111, 3), (0b0001, 1), (0b1000, 1), (0b0000, 0)):
        rig.count += 1
        order = DICTIONARY.pack_command("test_connection", {}, sequence_count=rig.count, acknowledgements=flags)
        packets = rig.step(order)
        found = [DICTIONARY.unpack(packet)[0] for packet in packets]
        assert sum(name.startswith("verification_") for name in found) == stages
        assert found.count("connection_report") == 1


def test_counts_go_forward_only_until_they_are_synchronised_again(rig):
    def ping(count):
        return DICTIONARY.pack_command("test_connection", {}, sequence_count=count)

    assert [rig.refused(ping(count)) for count in (16_380, 16_370)] == [[], ["out_of_sequence"]]
    rig.count = 15_999
    assert rig.refused(rig.function("resynchronise_commands")) == []
    assert rig.refused(ping(16_001)) == []


def with_number(command, packed, sent):
    """A telecommand with another number than the dictionary would pack, and a right checksum."""
    for form in (">d", ">f"):
        if struct.pack(form, packed) in command:
            return append_crc(command.replace(struct.pack(form, packed), struct.pack(form, sent), 1)[:-2])
    raise AssertionError("the number is not in the telecommand")


def test_values_out_of_range_are_refused_at_acceptance(rig):
    values = bytearray(rig.command("set_time_report_rate", rate_exponent=8))
    values[11] = 9
    assert rig.refused(append_crc(bytes(values[:-2]))) == ["value_out_of_range"]
    for order in (
        rig.function("set_mode", 4.0),
        with_number(rig.function("start_observation", 1.5), 1.5, math.nan),
        rig.function("widen_estimate", -1.0),
        rig.command("replay_store", start_ticks=5, stop_ticks=5),
        with_number(rig.command("set_parameter", parameter_id=NUMBERS["scrub_interval_s"], value=1.5), 1.5, math.inf),
        rig.command("set_parameter", parameter_id=NUMBERS["store_overwrite"], value=0.5),
    ):
        assert rig.refused(order) == ["value_out_of_range"]
    assert rig.mode is PayloadMode.standby


def test_octets_that_are_no_telecommand_never_stop_the_payload(rig):
    rng = np.random.default_rng(4)
    for _ in range(300):
        good = bytearray(rig.command("set_parameter", parameter_id=1, value=30.0))
        kind = rng.integers(0, 3)
        if kind == 0:
            good[rng.integers(0, len(good))] ^= 1 << rng.integers(0, 8)
        elif kind == 1:
            good = good[: rng.integers(0, len(good))]
        else:
            good = bytearray(rng.bytes(int(rng.integers(1, 60))))
        packets = rig.step(bytes(good), seconds=1.0)
        assert not rig.named(packets, "parameter_report")


# The schedule (service 11)


def test_a_window_is_observed_by_the_schedule_and_ends_by_itself(rig):
    window = rig.function("start_observation", 30.0)
    rig.step(rig.at(60.0, window), image=None)
    assert not rig.named(rig.step(), "detections")  # 30 s
    assert not rig.named(rig.step(), "detections")
    packets = rig.step()  # 60 s
    assert rig.events(packets).count("activity_released") == 1
    assert len(rig.named(packets, "detections")) == 1
    assert {v["request_id"] for v in rig.named(packets, "verification_completed")} == {
        int.from_bytes(window[:4], "big")
    }
    assert len(rig.named(rig.step(), "detections")) == 1
    ended = rig.step()  # 90 s
    assert "observation_stopped" in rig.events(ended)
    assert rig.mode is PayloadMode.standby


def test_the_cadence_of_a_window_thins_the_frames(rig):
    rig.step(rig.function("start_observation", 0.0, 30.0), image=None, seconds=0.5)
    assert sum([len(rig.named(rig.step(), "detections")) for _ in range(6)]) == 3


def test_scheduled_telecommands_are_refused_when_expired_copied_nested_or_too_many(rig):
    ping = rig.command("test_connection")
    assert rig.refused(rig.at(1.0, ping)) == ["expired"]
    assert rig.refused(rig.at(1e4, ping)) == []
    assert rig.refused(rig.at(2e4, ping)) == ["duplicate"]
    assert rig.refused(ping) == ["duplicate"]
    assert rig.refused(rig.at(1e4, rig.at(2e4, ping))) == ["unknown_function"]
    assert rig.refused(rig.at(1e4, ping[:-1])) == ["bad_length"]
    assert rig.refused(rig.at(1e4, ping[:-1] + b"\0")) == ["bad_checksum"]
    for k in range(63):
        assert rig.refused(rig.at(1e4 + k, rig.command("test_connection")), seconds=1.0) == []
    full = rig.step(rig.at(1e4, rig.command("test_connection")))
    assert rig.refusals(full) == ["schedule_full"]
    report = rig.report("report_schedule")
    assert report["count"] == 64 and report["enabled"] == 1
    assert sorted(report["items"]["release_ticks"]) == list(report["items"]["release_ticks"])


def test_a_held_schedule_releases_nothing_and_what_is_late_then_expires(rig):
    soon, later = rig.command("test_connection"), rig.command("test_connection")
    gone = rig.command("test_connection")
    orders = rig.at(20.0, soon) + rig.at(40.0, later) + rig.at(40.0, gone)
    rig.step(orders + rig.command("disable_schedule"))
    assert not rig.named(rig.step(), "connection_report")  # 30 s
    removed = rig.command("delete_activity", request_id=int.from_bytes(gone[:4], "big"))
    assert rig.refused(removed) == []  # 45 s
    packets = rig.send("enable_schedule")  # 60 s: one is 40 s late, one 20 s
    assert rig.events(packets).count("activity_expired") == 1
    assert rig.refusals(packets) == ["expired"]
    assert len(rig.named(packets, "connection_report")) == 1
    assert rig.refused(rig.command("delete_activity", request_id=1)) == ["no_such_activity"]
    rig.step(rig.at(500.0, rig.command("test_connection")) + rig.command("reset_schedule"))
    assert rig.report("report_schedule")["count"] == 0


def test_the_schedule_survives_a_reset(rig):
    rig.step(rig.at(100.0, rig.function("start_observation", 60.0)))
    rig.boot(ResetCause.brown_out)
    assert rig.mode is PayloadMode.standby
    rig.step(seconds=90.0)
    assert rig.mode is PayloadMode.observing


# Parameters (service 20)


@mark.parametrize("parameter", PARAMETERS, ids=lambda p: p.name)
def test_every_parameter_takes_its_limits_and_nothing_beyond(parameter):
    assert parameter.accepts(parameter.default)
    step = 1.0 if parameter.whole else 1e-3
    assert parameter.accepts(parameter.minimum) and parameter.accepts(parameter.maximum)
    for value in (parameter.minimum - step, parameter.maximum + step, float("nan")):
        assert not parameter.accepts(value)


def test_a_parameter_is_changed_reported_and_kept_through_resets(rig):
    number = NUMBERS["clock_jump_s"]
    packets = rig.step(
        rig.command("set_parameter", parameter_id=number, value=7.5)
        + rig.command("request_parameter", parameter_id=number)
    )
    assert rig.named(packets, "parameter_report") == [{"parameter_id": number, "value": 7.5}]
    assert "parameter_changed" in rig.events(packets)
    hashes = [v["parameters_hash"] for v in rig.named(packets, "housekeeping")]
    rig.boot(ResetCause.commanded)
    after = rig.step(rig.command("request_parameter", parameter_id=number), seconds=60.0)
    assert rig.named(after, "parameter_report")[0]["value"] == 7.5
    assert rig.named(after, "housekeeping")[0]["parameters_hash"] == hashes[-1]
    assert find_parameter(0) is None
    assert rig.refused(rig.command("set_parameter", parameter_id=999, value=1.0)) == ["unknown_parameter"]
    assert rig.refused(rig.command("request_parameter", parameter_id=999)) == ["unknown_parameter"]


# Housekeeping (service 3) and events (service 5)


def test_a_structure_defined_by_telecommand_is_sent_reported_and_deleted(rig):
    quantities = ["boot_count", "queue_depth", "camera_temperature_c", "cpu_detector_ms"]
    create = rig.command("create_housekeeping", structure_id=16, interval_s=30, items={"quantity": quantities})
    first = rig.named(rig.step(create), "housekeeping_report")
    assert [v["structure_id"] for v in first] == [16]
    labels = DICTIONARY.labels("housekeeping_report", "quantity")
    assert [labels[code] for code in first[0]["items"]["quantity"]] == quantities
    assert first[0]["items"]["value"][0] == 1.0
    assert sum([len(rig.named(rig.step(), "housekeeping_report")) for _ in range(6)]) == 3
    rig.boot(ResetCause.brown_out)
    report = rig.send("report_housekeeping_definition", structure_id=16)
    definition = rig.named(report, "housekeeping_definition")[0]
    assert (definition["interval_s"], definition["count"]) == (30, 4)
    assert rig.refused(rig.command("delete_housekeeping", structure_id=16)) == []
    assert not any(rig.named(rig.step(), "housekeeping_report") for _ in range(4))
    for name in ("delete_housekeeping", "report_housekeeping_definition", "request_housekeeping"):
        assert rig.refused(rig.command(name, structure_id=17)) == ["unknown_structure"]


def test_only_so_many_structures_can_be_defined(rig):
    def create(number):
        return rig.command("create_housekeeping", structure_id=number, interval_s=0, items={"quantity": ["mode"]})

    assert rig.refused(b"".join(create(16 + k) for k in range(8))) == []
    assert rig.refused(create(24)) == ["structures_full"]
    assert rig.refused(create(23)) == []


def test_housekeeping_can_be_stopped_asked_for_and_sent_more_often(rig):
    rig.send("disable_housekeeping", structure_id=1)
    assert not any(rig.named(rig.step(), "housekeeping") for _ in range(8))
    asked = rig.send("request_housekeeping", structure_id=1)
    assert len(rig.named(asked, "housekeeping")) == 1
    rig.step(
        rig.command("enable_housekeeping", structure_id=1)
        + rig.command("set_housekeeping_interval", structure_id=1, interval_s=15)
    )
    assert all(rig.named(rig.step(), "housekeeping") for _ in range(4))


def test_performance_tells_the_time_of_every_stage_and_the_levels_of_the_store(rig):
    rig.perform("start_observation")
    for _ in range(3):
        rig.step()
    report = rig.named(rig.send("request_housekeeping", structure_id=2), "performance")[0]
    # The board's model: 850 ms of detector, 40 ms of navigation a frame, a tenth of spread.
    assert report["cpu_detector_ms"] == approx(850.0, rel=0.25)
    assert report["cpu_navigation_ms"] == approx(40.0, rel=0.25)
    assert report["detector_latency_max_ms"] >= report["cpu_detector_ms"]
    assert report["last_command_count"] == rig.count
    assert report["store_critical_permille"] > 0 and report["queue_bulk"] == 0


def test_an_event_that_is_disabled_is_not_reported_until_it_is_enabled(rig):
    rig.send("disable_event", event_id="frame_skipped")
    packets = rig.send("report_disabled_events")
    assert "frame_skipped" not in rig.events(packets)
    assert list(rig.named(packets, "disabled_events")[0]["items"]["event_id"]) == [22]
    rig.boot(ResetCause.brown_out)
    assert "frame_skipped" not in rig.events(rig.step())
    assert "frame_skipped" in rig.events(rig.send("enable_event", event_id="frame_skipped"))


def test_a_change_of_the_reported_events_is_itself_an_event_also_for_that_event(rig):
    changed = 70  # event_reporting_changed
    for command, value in (("disable_event", 0.0), ("enable_event", 1.0)):
        packets = rig.send(command, event_id="event_reporting_changed")
        said = [one for one in rig.named(packets, "event_info") if one["event_id"] == changed]
        assert [(one["value_1"], one["value_2"]) for one in said] == [(float(changed), value)]


# Time (9), large data (13), the store (15)


def test_time_is_reported_every_so_many_frames_of_downlink(rig):
    assert not rig.named(rig.step(), "time_report")
    rig.step(rig.command("set_time_report_rate", rate_exponent=0) + rig.function("start_observation"))
    reports = [v for _ in range(40) for v in rig.named(rig.step(), "time_report")]
    assert 2 <= len(reports) <= 40
    assert all(v["rate_exponent"] == 0 for v in reports)
    assert reports[-1]["reported_ticks"] == approx(rig.ticks, abs=40 * 15 * 65_536)


def test_a_thumbnail_comes_down_as_large_data(rig):
    image = np.arange(64 * 64 * 3, dtype=np.uint8).reshape(64, 64, 3)
    packets = rig.step(rig.function("start_observation") + rig.function("downlink_thumbnail"), image=image)
    assert "thumbnail_stored" in rig.events(packets)
    receiver, whole = LargeDataReceiver(), None
    for packet in packets:
        name, values = DICTIONARY.unpack(packet)
        if name.startswith("large_data_"):
            whole = receiver.accept(name, values) or whole
    assert whole.table == 6
    found = unpack_thumbnail(whole.octets)
    assert (found.frame_number, found.ticks, found.levels.shape) == (0, rig.ticks, (8, 8))
    expected = image.astype(float).mean(axis=2).reshape(8, 8, 8, 8).mean(axis=(1, 3))
    assert_allclose(found.levels, expected, atol=0.5)


def test_the_map_of_landmarks_has_its_documented_octets(rig):
    # Crater (4 octets) and number of frames (2), big-endian; the count stays at its largest value.
    assert map_octets({7: 3, 4_000_000_000: 70_000}).hex(" ", 2) == "0000 0007 0003 ee6b 2800 ffff"
    assert map_octets({}) == b""
    packets = rig.perform("downlink_map")
    assert [v["table"] for v in rig.named(packets, "large_data_last")] == []
    assert rig.payload.waiting == 1  # bulk waits for a mode that sends it
    down = rig.perform("set_mode", PayloadMode.downlinking)
    assert [v["table"] for v in rig.named(down, "large_data_last")] == [7]


def test_a_table_is_uplinked_in_parts_in_any_order_and_used_after_resets(moon, rig):
    seconds = np.arange(0.0, 3000.0, 30.0)
    octets = moon.anchor(seconds)
    parts = split(octets, transaction=9, table=1, part_length=500, link="uplink")
    orders = [rig.command(name, **values) for name, values in [parts[2], parts[0], parts[1], *parts[3:]]]
    packets = rig.step(b"".join(orders))
    assert rig.refusals(packets) == []
    assert "table_loaded" in rig.events(packets)
    assert rig.board.read_table(TABLE_NUMBERS["anchor_ephemeris"]) == octets
    rig.boot(ResetCause.watchdog)
    assert "table_loaded" in rig.events(rig.step())
    observed = rig.perform("start_observation")
    assert {v["outcome"] for v in rig.named(observed, "frame_outcome")} == {0}


def test_a_damaged_or_unknown_table_is_refused_and_the_old_one_stays(moon, rig):
    octets = moon.anchor([0.0, 30.0, 60.0])
    for table, content, reason, events in (
        (1, octets[:-1] + b"\0", "table_corrupt", 1),
        (6, b"x", "value_out_of_range", 0),
    ):
        (name, values), *_ = split(content, transaction=table, table=table, part_length=4096, link="uplink")
        packets = rig.send(name, **values)
        assert rig.refusals(packets) == [reason]
        assert rig.events(packets).count("table_refused") == events
    assert rig.board.read_table(1) == b""


def test_the_store_keeps_what_no_link_takes_and_plays_it_again_by_time(rig):
    rig.board.downlink = 0
    rig.perform("start_observation")
    from_ticks = rig.ticks
    for _ in range(4):
        assert rig.step() == []
    assert rig.payload.waiting > 8
    rig.board.downlink = 1 << 30
    late = rig.step(rig.function("stop_observation") + rig.function("set_mode", PayloadMode.downlinking))
    assert len(rig.named(late, "detections")) == 5
    to_ticks = rig.ticks
    again = rig.send("replay_store", start_ticks=from_ticks, stop_ticks=to_ticks)
    repeated = set(late) & set(again)
    assert len([p for p in repeated if DICTIONARY.unpack(p)[0] == "detections"]) == 5
    report = rig.report("report_store")
    assert report["items"]["packets"][3] == 5 and report["items"]["unsent"][3] == 0
    rig.send("delete_store", stop_ticks=to_ticks)
    report = rig.report("report_store")
    assert report["items"]["packets"][3] == 0
    rig.perform("clear_store")
    assert rig.payload.waiting == 0


def test_standby_sends_what_is_small_and_keeps_the_rest(rig):
    rig.board.downlink = 0
    rig.perform("start_observation")
    rig.perform("stop_observation")
    rig.board.downlink = 1 << 30
    packets = rig.step(image=None)
    assert packets and not rig.named(packets, "detections")
    assert "observation_stopped" in rig.events(packets)
    assert rig.payload.waiting > 0


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(0, 11), st.booleans()), max_size=40))
def test_whatever_order_and_repetition_no_telecommand_executes_twice(make_rig, arrivals):
    rig = make_rig()
    pings = [rig.command("test_connection") for _ in range(12)]
    done = []
    for which, reset in arrivals:
        if reset:
            rig.boot(ResetCause.watchdog)
        packets = rig.step(pings[which], seconds=4_000.0, image=None)
        executed = len(rig.named(packets, "connection_report"))
        assert executed == (which not in done and which > max(done, default=-1))
        assert bool(rig.refusals(packets)) is not bool(executed)
        done += [which] * executed
    assert len(set(done)) == len(done)
