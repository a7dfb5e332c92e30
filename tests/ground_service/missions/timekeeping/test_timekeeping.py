"""A correlation that is entered moves everything derived, at once, and says which it is."""

import numpy as np
import pytest

from ground_service.errors import InvalidInput, NotFound
from ground_service.ingest.service import ingest_file
from ground_service.missions.timekeeping.recorrelation import TimePoint, correlate
from ground_service.missions.timekeeping.store import correlations_on_record
from ground_service.passes.service import define_pass, parameter_series
from lunar.timescales import ticks_from_utc_ns

NS = 1_000_000_000


def test_times_of_samples_follow_the_correlation_in_force(ground, synthetic_pass):
    vehicle = ingest_file(ground, synthetic_pass.folder / "downlink.cadu").vehicle_id
    assert vehicle is not None
    first, last = int(synthetic_pass.utc_ns[0]), int(synthetic_pass.utc_ns[-1])
    pass_id = define_pass(ground, name="p", start_utc_ns=first - 60 * NS, stop_utc_ns=last + 60 * NS, spacecraft_id=76)
    ideal = parameter_series(ground, pass_id, "power_w", 1000)
    points = [
        TimePoint(int(ticks_from_utc_ns(first + k * 60 * NS)), first + k * 60 * NS + 5 * NS + NS, NS) for k in range(10)
    ]
    correlate(ground, vehicle, points)
    moved = parameter_series(ground, pass_id, "power_w", 1000)
    # the clock is 5 s slow; one second of the reception times is light time
    shift = moved.buckets.start_utc_ns - ideal.buckets.start_utc_ns
    np.testing.assert_allclose(shift, 5 * NS, atol=20_000)
    assert (ideal.correlation_id, moved.correlation_id) == (0, 1)
    correlate(ground, vehicle, points)
    record = ground.read(correlations_on_record, vehicle)
    assert [(row.id, row.in_force) for row in record] == [(2, True), (1, False)]


def test_every_boot_has_a_line_of_its_own(ground, synthetic_pass):
    vehicle = ingest_file(ground, synthetic_pass.folder / "downlink.cadu").vehicle_id
    assert vehicle is not None
    points = [TimePoint(k * 65_536 * 60, k * 60 * NS, 0, boot_count=k // 5) for k in range(10)]
    assert len(correlate(ground, vehicle, points)) == 2


def test_no_points_and_no_vehicle_are_refused(ground):
    with pytest.raises(InvalidInput, match="expected at least one time report"):
        correlate(ground, 1, [])
    with pytest.raises(NotFound, match="vehicle 5"):
        correlate(ground, 5, [TimePoint(0, 0, 0)])
