"""Figures of the benchmark of viewers."""

import pytest

from benchmarks.viewers import figures, memory


def test_a_skipped_packet_is_shown_by_the_next_newer_values() -> None:
    sent = {1: 0.0, 2: 10.0, 3: 10.1, 4: 10.2}
    found = figures(sent, [[(1, 0.5), (2, 10.3), (4, 10.4)]], first=2)
    assert found == {
        "latency_ms": {"p50": 300.0, "p95": 300.0},  # 300, 300 and 200 ms
        "shown_one_by_one_percent": 66.7,
        "never_shown": 0,
    }


def test_older_values_show_no_newer_packet() -> None:
    sent = {1: 10.0, 2: 11.0}
    found = figures(sent, [[(2, 11.2), (1, 11.3)], [(1, 10.1)], []], first=1)
    assert found["never_shown"] == 3
    assert found["latency_ms"]["p95"] == pytest.approx(1100.0)  # of 100, 200 and 1200 ms


def test_memory_growth_is_the_slope_of_the_last_two_thirds() -> None:
    samples = [(float(k), 100.0 + (50.0 if k < 10 else 50.0 + (k - 10) / 30.0)) for k in range(30)]
    found = memory(samples)
    assert found["memory_growth_mib_per_min"] == pytest.approx(2.0)
    assert memory(samples[:2])["memory_growth_mib_per_min"] is None
