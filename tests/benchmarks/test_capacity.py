"""The arithmetic of the capacity plan."""

from __future__ import annotations

import pytest

from benchmarks.capacity import Cost, Offered, plan, slope


def test_the_cost_of_a_pass_is_a_slope_without_the_fixed_part() -> None:
    growth, residual = slope([1100.0, 1200.0, 1300.0, 1400.0])
    assert growth == pytest.approx(100.0) and residual == pytest.approx(0.0, abs=1e-9)
    # A pass that costs nothing shows as a distance from the line.
    growth, residual = slope([100.0, 100.0, 300.0])
    assert growth == pytest.approx(100.0) and residual == pytest.approx(2.0 / 3.0)


COST = Cost(cpu_s=8.64, wall_s=9.0, database_octets=1e6, file_octets=4e6, worst_residual_passes=0.0)


def test_the_first_bottleneck_is_what_is_used_up_first() -> None:
    # 100 passes a day: 0.01 cores, 0.1 GB of database and 0.4 GB of files a day.
    offered = Offered(cores=2.0, database_octets=1e12, archive_octets=1e12)
    one = plan(COST, 100.0, 1, 10.0, offered)
    assert one["passes"] == 365_250 and one["cores_busy"] == 0.01
    assert (one["database_gb"], one["archive_gb"]) == (365.2, 1461.0)
    assert one["first_bottleneck"] == "disk of the archive" and one["after_years"] == pytest.approx(
        6.84, abs=0.01
    )
    assert plan(COST, 10.0, 1, 10.0, offered)["first_bottleneck"] == "none within the time"
    many = plan(COST, 100.0, 300, 10.0, offered)
    assert (many["cores_busy"], many["first_bottleneck"], many["after_years"]) == (3.0, "processor", 0.0)
