"""Growth of the memory of a service with viewers."""

from benchmarks.campaigns.viewers import SAMPLES, SETTLED, growth


def test_memory_that_grows_after_the_second_minute_counts_and_not_before():
    settling = [100] * (SETTLED - SAMPLES) + [200] * SAMPLES
    assert growth(settling + [900] * 3 + [200] * SAMPLES) == 1.0
    assert growth(settling + [200] * 3 + [220] * SAMPLES) == 1.1
