"""Figures of the memory under load."""

from benchmarks.load import memory_figures
from studies.harness.usage import Memory


def test_growth_of_shared_memory_is_not_growth_of_private_memory() -> None:
    samples = [(10.0 * number, Memory(40.0, min(5.0 * number, 128.0), 9.0, 8.0, 5)) for number in range(60)]
    figures = memory_figures(samples)
    assert figures["private"] == {"first": 40.0, "last": 40.0, "max": 40.0, "max_at_s": 0, "per_h": 0.0}
    assert (figures["shared"]["max"], figures["shared"]["max_at_s"]) == (128.0, 260)
    assert figures["shared"]["per_h"] > 0.0
    assert figures["total"]["last"] == 177.0
    assert figures["largest"]["max"] == 8.0 and figures["processes"]["last"] == 5.0


def test_growth_is_the_slope_after_the_first_quarter() -> None:
    samples = [
        (36.0 * number, Memory(100.0 if number < 20 else 100.0 + number, 0.0, 0.0, 0.0, 1))
        for number in range(101)
    ]
    start = [(at, one) for at, one in samples if at > 900.0]
    assert all(one.private == 100.0 + at / 36.0 for at, one in start)
    assert memory_figures(samples)["private"]["per_h"] == 100.0
