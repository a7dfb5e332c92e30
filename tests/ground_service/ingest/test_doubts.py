"""Packets with an implausible on-board time are kept, named, and decide nothing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ground_service.clock import TelemetryTime, set_mission_clock
from ground_service.ground import Ground
from ground_service.ingest.core import fits_between, implausible_times
from ground_service.ingest.doubts import list_implausible
from ground_service.ingest.model import ImplausibleFilter
from ground_service.ingest.service import ingest_file
from ground_service.missions.store import newest_ticks
from ground_service.passes.alarms.model import AlarmFilter
from ground_service.passes.alarms.service import list_alarms
from ground_service.worker.integrity import verify
from lunar.timescales import parse_utc, ticks_from_utc_ns
from tests.ground_service.archive_hash import hash_of
from tests.ground_service.conftest import _housekeeping
from tmtc.cuc import NO_TICKS
from tmtc.dictionary import DICTIONARY

NOW = parse_utc("2029-08-18T09:00:00Z")
TICKS = int(ticks_from_utc_ns(NOW))
HOUR = 3600 << 16
DAY = 24 * HOUR
YEARS = 70 * 365 * DAY


@pytest.fixture(autouse=True)
def clock() -> Iterator[None]:
    yield
    set_mission_clock()


def report(ticks: int, count: int, temperature_c: float = 20.0) -> bytes:
    values = _housekeeping(1) | {"temperature_c": temperature_c}
    return DICTIONARY.pack("housekeeping", values, ticks=ticks, sequence_count=count)


def contact(start: int = TICKS, count: int = 0, number: int = 12) -> bytes:
    """Reports of a contact, one a minute, the last one at `start` plus their time."""
    return b"".join(report(start + (60 << 16) * k, count + k) for k in range(number))


def receive(ground: Ground, path: Path, octets: bytes) -> int:
    """Ingest packets; return the number of those that are kept apart."""
    file = path / f"{abs(hash(octets))}.packets"
    file.write_bytes(octets)
    return ingest_file(ground, file, spacecraft_id=76).packets_implausible


def reasons(ground: Ground) -> list[str]:
    return [one.reason for one in ground.read(list_implausible, ImplausibleFilter(limit=99)).items]


def alarms(ground: Ground) -> dict[str, int]:
    asked = AlarmFilter(limit=99, state=["raised", "acknowledged"])
    return {one.name: one.count for one in ground.read(list_alarms, asked).items}


@pytest.mark.parametrize("ahead", [2 * HOUR, 26 * HOUR, YEARS])
@pytest.mark.parametrize("source", ["telemetry", "simulated", "time of day"])
def test_a_report_from_the_future_is_kept_and_decides_nothing(
    ground: Ground, tmp_path: Path, ahead: int, source: str
) -> None:
    clocks = {"telemetry": TelemetryTime(NOW), "simulated": lambda: NOW, "time of day": None}
    set_mission_clock(clocks[source])
    receive(ground, tmp_path, contact())
    before = hash_of(ground)
    assert receive(ground, tmp_path, report(TICKS + ahead, 12, temperature_c=99.0)) == 1
    assert hash_of(ground) == before
    assert ground.read(newest_ticks, 1) == TICKS + 11 * (60 << 16)
    assert alarms(ground) == {"implausible_time": 1}
    [reason] = reasons(ground)
    assert ("after the mission time" if source == "simulated" else "after all other telemetry") in reason


def test_the_same_report_again_is_kept_once(either: Ground, tmp_path: Path) -> None:
    receive(either, tmp_path, contact())
    receive(either, tmp_path, report(TICKS + DAY, 12))
    assert receive(either, tmp_path, report(TICKS + DAY, 12)) == 0
    assert len(reasons(either)) == 1 and alarms(either) == {"implausible_time": 1}


def test_the_archive_does_not_depend_on_whether_the_wrong_report_came_first(
    either: Ground, tmp_path: Path
) -> None:
    receive(either, tmp_path, report(TICKS + DAY, 12, temperature_c=99.0))
    receive(either, tmp_path, report(5 << 16, 13, temperature_c=-99.0))
    assert "temperature_c" in alarms(either)
    receive(either, tmp_path, contact())
    assert len(reasons(either)) == 2
    assert either.read(newest_ticks, 1) == TICKS + 11 * (60 << 16)
    assert "temperature_c" not in alarms(either)
    assert verify(either, rebuild=True).verdict == "intact"


def test_the_next_contact_is_believed_and_puts_back_what_was_kept_apart(
    either: Ground, tmp_path: Path
) -> None:
    receive(either, tmp_path, contact())
    assert receive(either, tmp_path, contact(TICKS + DAY, 1440, number=2)) == 2
    assert receive(either, tmp_path, contact(TICKS + DAY + (120 << 16), 1442)) == 0
    assert reasons(either) == []
    assert either.read(newest_ticks, 1) == TICKS + DAY + 13 * (60 << 16)


def test_a_wrong_report_does_not_become_right_when_its_time_comes(ground: Ground, tmp_path: Path) -> None:
    receive(ground, tmp_path, contact())
    receive(ground, tmp_path, report(TICKS + DAY + (90 << 16), 12))
    receive(ground, tmp_path, contact(TICKS + DAY, 1440))
    assert len(reasons(ground)) == 1


def test_a_clock_of_the_mission_believes_a_single_report_after_a_silence(
    ground: Ground, tmp_path: Path
) -> None:
    receive(ground, tmp_path, contact())
    set_mission_clock(lambda: NOW + 86_400 * 10**9)
    assert receive(ground, tmp_path, report(TICKS + DAY, 12)) == 0


def test_a_clock_that_was_not_set_and_a_stamp_from_the_past_are_kept_apart(
    ground: Ground, tmp_path: Path
) -> None:
    receive(ground, tmp_path, contact(TICKS - DAY))
    receive(ground, tmp_path, contact(TICKS, 1440))
    assert receive(ground, tmp_path, report(100 << 16, 1452)) == 1
    assert receive(ground, tmp_path, report(TICKS - DAY + (90 << 16), 1453)) == 1
    assert reasons(ground) == ["its sequence count belongs to another time", "the clock was not set"]


def test_a_late_report_and_a_reboot_are_believed(ground: Ground, tmp_path: Path) -> None:
    receive(ground, tmp_path, contact(TICKS - DAY) + contact(TICKS - DAY + 13 * (60 << 16), 13))
    receive(ground, tmp_path, contact(TICKS, 0))  # counts begin again with the boot
    assert receive(ground, tmp_path, report(TICKS - DAY + 12 * (60 << 16), 12)) == 0
    assert reasons(ground) == []


def test_reception_times_decide_for_single_packets_and_not_for_a_station_whose_clock_is_wrong() -> None:
    ticks = TICKS + np.array([0, 1, 2, DAY])
    received = np.full(4, TICKS)
    assert set(implausible_times(ticks, received, TICKS, None)) == {3}
    assert implausible_times(ticks[:3], received[:3] - DAY, TICKS, None) == {}
    assert implausible_times(ticks[3:], received[3:] + DAY, TICKS, None) == {}
    assert set(implausible_times(ticks[3:], np.array([NO_TICKS]), TICKS, None)) == {0}


@pytest.mark.parametrize(
    ("count", "before", "after", "fits"),
    [(5, 4, 6, True), (5, 5, 5, True), (7, 4, 6, False), (0, 16_383, 1, True), (9, None, 1, True)],
)
def test_a_sequence_count_fits_between_its_neighbours(
    count: int, before: int | None, after: int | None, fits: bool
) -> None:
    assert fits_between(count, before, after) is fits
