"""Packets with an implausible on-board time are kept, named, and decide nothing."""

import numpy as np
from pytest import mark, raises

from ground_service.access.model import AuditFilter
from ground_service.access.store import list_audit
from ground_service.clock import TelemetryTime, set_mission_clock
from ground_service.contacts.commanding.service import enter_command, get_command, release_command, take_uplink
from ground_service.contacts.links import store as links
from ground_service.errors import Conflict, StateConflict
from ground_service.ground import open_ground
from ground_service.ingest.core import fits_between, implausible_times
from ground_service.ingest.doubt_store import list_implausible
from ground_service.ingest.model import ImplausibleFilter
from ground_service.ingest.service import ingest_file, withdraw_ingest
from ground_service.ingest.store import get_ingest
from ground_service.missions.service import add_mission
from ground_service.missions.store import newest_ticks
from ground_service.passes.alarms.model import AlarmFilter
from ground_service.passes.alarms.service import list_alarms
from ground_service.worker.integrity import verify
from ground_service.worker.jobs import run_job
from lunar.timescales import parse_utc, ticks_from_utc_ns
from tests.ground_service.archive_hash import hash_of
from tests.ground_service.conftest import _housekeeping
from tmtc.dictionary.payload import DICTIONARY
from tmtc.packets.pus import NO_TICKS

NOW = parse_utc("2029-08-18T09:00:00Z")
TICKS = int(ticks_from_utc_ns(NOW))
HOUR = 3600 << 16
DAY = 24 * HOUR
YEARS = 70 * 365 * DAY


LAST = TICKS + 11 * (60 << 16)


def report(ticks, count, temperature_c=20.0, boot=1):
    values = _housekeeping(1) | {"temperature_c": temperature_c, "boot_count": boot}
    return DICTIONARY.pack("housekeeping", values, ticks=ticks, sequence_count=count)


def contact(start=TICKS, count=0, number=12, boot=1):
    """Reports of a contact, one a minute, the last one at `start` plus their time."""
    return b"".join(report(start + (60 << 16) * k, count + k, boot=boot) for k in range(number))


def receive(ground, octets):
    """Ingest packets; return the number of those that are kept apart."""
    file = ground.home / f"{abs(hash(octets))}.packets"
    file.write_bytes(octets)
    return ingest_file(ground, file, spacecraft_id=76).packets_implausible


def reasons(ground):
    return [one.reason for one in ground.read(list_implausible, ImplausibleFilter(limit=99)).items]


def alarms(ground):
    asked = AlarmFilter(limit=99, state=["raised", "acknowledged"])
    return {one.name: one.count for one in ground.read(list_alarms, asked).items}


@mark.parametrize("ahead", [2 * HOUR, 26 * HOUR, YEARS])
@mark.parametrize("source", ["telemetry", "simulated", "time of day"])
def test_a_report_from_the_future_is_kept_and_decides_nothing(ground, ahead, source):
    clocks = {"telemetry": TelemetryTime(NOW), "simulated": lambda: NOW, "time of day": None}
    set_mission_clock(clocks[source])
    receive(ground, contact())
    before = hash_of(ground)
    assert receive(ground, report(TICKS + ahead, 12, temperature_c=99.0)) == 1
    assert hash_of(ground) == before
    assert ground.read(newest_ticks, 1) == LAST
    assert alarms(ground) == {"implausible_time": 1}
    [reason] = reasons(ground)
    assert ("after the mission time" if source == "simulated" else "after all other telemetry") in reason


def test_the_same_report_again_is_kept_once(either):
    receive(either, contact())
    receive(either, report(TICKS + DAY, 12))
    assert receive(either, report(TICKS + DAY, 12)) == 0
    assert len(reasons(either)) == 1 and alarms(either) == {"implausible_time": 1}


def test_the_archive_does_not_depend_on_whether_the_wrong_report_came_first(either):
    receive(either, report(TICKS + DAY, 12, temperature_c=99.0))
    receive(either, report(TICKS + DAY + HOUR, 13, temperature_c=99.0) + report(TICKS + DAY + HOUR, 14))
    assert "temperature_c" in alarms(either)
    receive(either, report(5 << 16, 13, temperature_c=-99.0))
    receive(either, contact())
    assert len(reasons(either)) == 4
    assert either.read(newest_ticks, 1) == LAST
    assert "temperature_c" not in alarms(either)
    assert verify(either, rebuild=True).verdict == "intact"


def test_the_next_contact_is_believed_and_puts_back_what_was_kept_apart(either):
    receive(either, contact())
    assert receive(either, contact(TICKS + DAY, 1440, number=2)) == 2
    assert receive(either, contact(TICKS + DAY + (120 << 16), 1442)) == 0
    assert reasons(either) == []
    assert either.read(newest_ticks, 1) == TICKS + DAY + 13 * (60 << 16)


def test_a_wrong_report_does_not_become_right_when_its_time_comes(ground):
    receive(ground, contact())
    receive(ground, report(TICKS + DAY + (90 << 16), 12))
    receive(ground, contact(TICKS + DAY, 1440))
    assert len(reasons(ground)) == 1


def test_a_clock_of_the_mission_believes_a_single_report_after_a_silence(ground):
    receive(ground, contact())
    set_mission_clock(lambda: NOW + 86_400 * 10**9)
    assert receive(ground, report(TICKS + DAY, 12)) == 0


def test_a_clock_that_was_not_set_and_a_stamp_from_the_past_are_kept_apart(ground):
    receive(ground, contact(TICKS - DAY))
    receive(ground, contact(TICKS, 1440))
    assert receive(ground, report(100 << 16, 1452)) == 1
    assert receive(ground, report(TICKS - DAY + (90 << 16), 1453)) == 1
    assert reasons(ground) == ["its sequence count belongs to another time", "the clock was not set"]


def test_a_late_report_and_a_reboot_are_believed(ground):
    receive(ground, contact(TICKS - DAY) + contact(TICKS - DAY + 13 * (60 << 16), 13))
    receive(ground, contact(TICKS, 0))  # counts begin again with the boot
    assert receive(ground, report(TICKS - DAY + 12 * (60 << 16), 12)) == 0
    assert reasons(ground) == []


def test_reception_times_decide_for_single_packets_and_not_for_a_station_whose_clock_is_wrong():
    ticks = TICKS + np.array([0, 1, 2, DAY])
    received = np.full(4, TICKS)
    assert set(implausible_times(ticks, received, TICKS, None)) == {3}
    assert implausible_times(ticks[:3], received[:3] - DAY, TICKS, None) == {}
    assert implausible_times(ticks[3:], received[3:] + DAY, TICKS, None) == {}
    assert set(implausible_times(ticks[3:], np.array([NO_TICKS]), TICKS, None)) == {0}


@mark.parametrize("first", [TICKS, TICKS + YEARS, 100 << 16])
def test_the_first_packet_of_an_archive_decides_nothing_until_a_clock_or_a_second_one_supports_it(ground, first):
    set_mission_clock(TelemetryTime(NOW))
    assert receive(ground, report(first, 0, temperature_c=99.0)) == 1
    assert ground.read(newest_ticks, 1) is None and alarms(ground) == {"implausible_time": 1}
    assert reasons(ground)[0].startswith("not judged: ")
    assert receive(ground, report(first + (60 << 16), 1)) == 1  # the next review finds both
    assert reasons(ground) == [] and ground.read(newest_ticks, 1) == first + (60 << 16)


def test_without_a_stated_clock_the_first_packet_may_be_of_a_simulated_flight_and_not_of_another_century(ground):
    assert receive(ground, report(TICKS + YEARS, 0)) == 1
    assert receive(ground, report(TICKS, 1)) == 0
    assert ground.read(newest_ticks, 1) == TICKS


def test_a_clock_of_the_mission_judges_the_first_packet_and_counts_fit_between_their_neighbours():
    for late, doubted in ((-DAY, set()), (0, set()), (DAY, {0}), (100 - TICKS, set())):
        ticks = np.array([TICKS + late])
        assert set(implausible_times(ticks, None, None, TICKS)) == doubted
        assert implausible_times(ticks, ticks, None, TICKS) == {}
        assert implausible_times(np.append(ticks, ticks + HOUR), None, None, TICKS) == {}
    for given in ((5, 4, 6), (5, 5, 5), (0, 16_383, 1), (9, None, 1)):
        assert fits_between(*given) is True, given
    assert fits_between(7, 4, 6) is False


def test_a_withdrawn_ingest_leaves_no_trace_but_its_record(either):
    receive(either, contact())
    before, alone = hash_of(either), alarms(either)
    foreign = contact(TICKS - 9 * DAY) + contact(TICKS + (30 << 16), 500) + report(TICKS + 60, 600, 99.0)
    receive(either, foreign)
    assert hash_of(either) != before and alarms(either) != alone
    job = withdraw_ingest(either, 2, reason="another flight", actor="ann")
    with raises(StateConflict, match="expected state done, found withdrawing"):
        withdraw_ingest(either, 2, reason="another flight", actor="ann")
    assert run_job(either, job).state == "done"
    assert (hash_of(either), alarms(either)) == (before, alone)
    assert either.read(get_ingest, 2).state == "withdrawn"
    assert verify(either, rebuild=True).verdict == "intact"
    [entry] = either.read(list_audit, AuditFilter(action="withdraw ingest", limit=9)).items
    assert entry.detail["reason"] == "another flight"


def entered(ground):
    key = enter_command(ground, "test_connection", {}, spacecraft_id=76, actor="ann")
    release_command(ground, key, actor="ann")
    return key


def sent(ground):
    """Send a telecommand; return its keys on the ground and on board."""
    key = entered(ground)
    take_uplink(ground, spacecraft_id=76, actor="ann")
    return key, get_command(ground, key).record.request_id


def completed(ticks, request, count=0):
    return DICTIONARY.pack("verification_completed", {"request_id": request}, ticks=ticks, sequence_count=count)


def test_telecommands_are_verified_again_after_a_foreign_flight_is_withdrawn(either):
    receive(either, contact())
    receive(either, completed(TICKS + HOUR // 2, 5))  # of another flight
    key, request = sent(either)
    receive(either, completed(TICKS + HOUR // 4, request))
    assert get_command(either, key).state == "sent"
    run_job(either, withdraw_ingest(either, 2, reason="another flight", actor="ann"))
    assert get_command(either, key).state == "completed"


def test_reports_from_before_the_release_do_not_verify_a_telecommand(either):
    set_mission_clock(lambda: NOW)
    receive(either, contact())
    receive(either, completed(TICKS - DAY, 5))
    key, request = sent(either)
    receive(either, completed(TICKS - 2 * HOUR, request, 1))
    assert get_command(either, key).state == "sent"


def test_reports_of_an_earlier_boot_do_not_verify_a_telecommand(either):
    receive(either, contact(boot=3) + completed(TICKS + HOUR // 2, 5, 1))
    key, request = sent(either)
    later = TICKS + HOUR
    receive(either, report(later, 900, boot=1) + completed(later + 9, request, 1))  # of another flight
    assert get_command(either, key).state == "sent"
    receive(either, report(later + HOUR, 13, boot=4) + completed(later + HOUR + 9, request, 1))  # after a reboot
    assert get_command(either, key).state == "completed"


def test_reports_of_another_source_do_not_verify_a_telecommand(either):
    receive(either, contact() + completed(TICKS + HOUR // 2, 5, 40))
    key, request = sent(either)
    later = TICKS + HOUR
    receive(either, report(later, 900) + completed(later + 9, request, 7))  # of another flight
    assert get_command(either, key).state == "sent"
    receive(either, completed(later + 10, request, 41) + completed(later + 11, 5, 16_383))
    assert get_command(either, key).state == "completed"
    key, request = sent(either)
    receive(either, completed(later + HOUR, request, 2))  # the count has begun again at 0
    assert get_command(either, key).state == "completed"


def test_commanding_starts_from_the_count_that_the_payload_reports(either):
    fields = DICTIONARY.packet("performance").fields
    values = {one.name: 0 for one in fields} | {"structure_id": 2, "last_command_count": 41}
    receive(either, DICTIONARY.pack("performance", values, ticks=TICKS, sequence_count=0))
    key = entered(either)
    record = get_command(either, key).record
    assert record.sequence_count == 42
    take_uplink(either, spacecraft_id=76, actor="ann")
    refused = {"request_id": record.request_id, "failure_code": "out_of_sequence"}
    receive(either, DICTIONARY.pack("verification_not_accepted", refused, ticks=TICKS + 9, sequence_count=0))
    assert "send perform_function resynchronise_commands first" in get_command(either, key).remark


def test_a_station_that_the_description_does_not_have_is_refused(either, tmp_path):
    add_mission(either, b'name = "m"\n[spacecraft]\nid = 76\n[link.stations.madrid]\n')
    file = tmp_path / "a.packets"
    file.write_bytes(contact())
    with raises(Conflict, match=r"expected one of the mission description \(madrid\), found mars"):
        ingest_file(either, file, spacecraft_id=76, station="mars")


def test_a_lease_that_ended_in_a_standstill_is_renewed_with_its_state(either):
    given = {"owner": "a", "until_utc_ns": 15, "mission_utc_ns": 0}
    with either.database.writing() as connection:
        assert links.acquire(connection, "l", 76, "flight", wall_utc_ns=0, **given)
        links.change_link(connection, "l", "a", state="contact")
        assert links.acquire(connection, "l", 76, "flight", wall_utc_ns=40, **given | {"until_utc_ns": 55})
        found = links.find_link(connection, "l")
        assert (found.state, found.lease_utc_ns) == ("contact", 55)
        assert links.acquire(connection, "l", 76, "flight", wall_utc_ns=70, **given | {"owner": "b"})
        assert not links.acquire(connection, "l", 76, "flight", wall_utc_ns=10, **given)


@mark.parametrize("ahead", [26 * HOUR, YEARS, 100 * (1 << 16) - TICKS])
def test_a_detection_of_an_image_at_another_time_is_kept_apart(ground, ahead):
    def detections(image_ticks, count):
        values = {"frame_number": count, "image_ticks": image_ticks, "image_quality": 0, "items": []}
        return DICTIONARY.pack("detections", values, ticks=TICKS + (11 << 16), sequence_count=count)

    assert receive(ground, contact() + detections(TICKS, 0)) == 0
    before = hash_of(ground)
    assert receive(ground, detections(TICKS + ahead, 1)) == 1
    assert hash_of(ground) == before and alarms(ground) == {"implausible_time": 1}
    assert reasons(ground)[0].startswith("the time of its image is ")
    receive(ground, report(TICKS + 12 * (60 << 16), 12))
    assert len(reasons(ground)) == 1


def test_a_day_with_disturbances_ends_with_the_archive_of_the_day_without(tmp_path):
    contacts = [contact(TICKS + 2 * HOUR * k, 12 * k) for k in range(12)]
    with open_ground(tmp_path / "calm") as calm, open_ground(tmp_path / "disturbed") as disturbed:
        for octets in contacts:
            receive(calm, octets)
        late = contacts.copy()
        late[3], late[4], late[7], late[9] = late[4], late[3], late[9], late[7]
        for k, octets in enumerate(late):
            receive(disturbed, octets)
            wrong = (TICKS + 26 * HOUR * (k + 2), YEARS + TICKS, (100 + k) << 16)[k % 3]
            if k:
                receive(disturbed, report(wrong, 4000 + k, temperature_c=99.0))
            receive(disturbed, late[k // 2])
        assert hash_of(disturbed) == hash_of(calm)
        assert disturbed.read(newest_ticks, 1) == calm.read(newest_ticks, 1)
        assert len(reasons(disturbed)) == 11
