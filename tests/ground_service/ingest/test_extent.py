"""Ingests are found by the on-board times of their packets."""

from typing import Any

from ground_service.ground import Ground
from ground_service.ingest.service import ingest_file
from ground_service.ingest.store import recordings_of_vehicle
from ground_service.store import repository


def test_only_ingests_with_packets_in_the_time_are_returned(either: Ground, synthetic_pass: Any) -> None:
    result = ingest_file(either, synthetic_pass.folder / "downlink.cadu")
    first, last = result.first_ticks, result.last_ticks
    assert first is not None and last is not None and first < last and result.vehicle_id is not None

    def found(start_ticks: int, stop_ticks: int) -> int:
        with either.database.reading() as connection:
            return len(recordings_of_vehicle(connection, result.vehicle_id or 0, start_ticks, stop_ticks))

    assert found(first, last) == found(first - 9, first) == found(last, last + 9) == 1
    assert found(first + 1, first + 2) == 1
    assert found(first - 9, first - 1) == found(last + 1, last + 9) == 0

    def without_times(**counts: int) -> int:
        accounting = {"packets": 0, "vehicle_ids": [result.vehicle_id], **counts}
        changed = repository.INGESTS.update().values(first_ticks=None, last_ticks=None, accounting=accounting)
        with either.database.writing() as connection:
            connection.execute(changed)
        return found(last + 1, last + 9)

    assert without_times(frames=2) == 0  # without a packet, and without octets that could be of one
    assert without_times(packets=1) == without_times(frames_bad=1) == without_times(octets_pending=9) == 1
