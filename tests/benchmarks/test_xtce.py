"""The benchmark of imported XTCE compares every value that the interpreter reads."""

from benchmarks import xtce


def test_all_values_of_all_captures_are_compared_and_equal():
    figures = xtce.bench(packets=120, interpreted=60)
    assert len(figures) == 3
    for capture in figures.values():
        assert capture["values_equal"] is True and capture["values_compared"] > 60 * 8


def test_a_value_that_differs_is_noticed(monkeypatch):
    monkeypatch.setattr("tmtc.xtce.decode._floats", lambda records, bit, encoding: records[:, 0] * 0.5)
    figures = xtce.bench(packets=60, interpreted=60)
    assert not any(capture["values_equal"] for capture in figures.values())
