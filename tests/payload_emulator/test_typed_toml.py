"""Tables read into frozen values: what is converted, what is refused and in which words."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Literal

from pytest import mark, raises

from payload_emulator.session.typed_toml import TableFault, read_table, toml_text


class Colour(IntEnum):
    """Members by name."""

    red = 1
    blue = 2


@dataclass(frozen=True, slots=True)
class Inner:
    """A section."""

    length_m: float = 2.0
    limits: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Outer:
    """A table of every supported type."""

    name: str
    count: int = 1
    share: float = 0.5
    on: bool = False
    mode: Literal["slow", "fast"] = "slow"
    colours: tuple[Colour, ...] = ()
    inner: Inner = field(default_factory=Inner)
    rest: Inner | None = None
    items: tuple[Inner, ...] = ()
    free: Mapping[str, Any] = field(default_factory=dict)


def test_values_keep_their_types_and_only_whole_numbers_become_floats():
    found = read_table(
        Outer,
        {
            "name": "a", "share": 1, "mode": "fast", "colours": ["blue", "red"], "inner": {"limits": [0, 3.5]},
            "rest": {"length_m": 4}, "items": [{"length_m": 1.0}, {}], "free": {"any": 1},
        },
    )  # fmt: skip
    assert found == Outer(
        "a", 1, 1.0, False, "fast", (Colour.blue, Colour.red), Inner(2.0, (0.0, 3.5)), Inner(4.0),
        (Inner(1.0), Inner()), {"any": 1},
    )  # fmt: skip
    assert type(found.share) is float and type(found.inner.limits[0]) is float


def test_what_a_table_does_not_name_stays_as_it_was():
    before = Outer("a", 7, inner=Inner(9.0, (1.0, 2.0)))
    after = read_table(Outer, {"inner": {"length_m": 8.0}}, present=before)
    assert after == Outer("a", 7, inner=Inner(8.0, (1.0, 2.0)))
    assert before.inner.length_m == 9.0


WRONG = """
name = 3 | name | a text | 3
count = 1.0 | count | a whole number | 1.0
count = true | count | a whole number | True
share = "much" | share | a number | 'much'
share = true | share | a number | True
share = inf | share | finite | inf
on = 1 | on | true or false | 1
mode = "swift" | mode | one of 'slow', 'fast' | 'swift'
colours = "red" | colours | a list | 'red'
colours = ["red", "green"] | colours[1] | one of red, blue | 'green'
inner = 3.0 | inner | a table | 3.0
inner = {limits = [1.0]} | inner.limits | 2 values | 1
inner = {limits = [1.0, "x"]} | inner.limits[1] | a number | 'x'
items = [{}, {length_m = "x"}] | items[1].length_m | a number | 'x'
rest = {length_m = "x"} | rest.length_m | a number | 'x'
"""


@mark.parametrize("table, place, expected, found", [line.split(" | ") for line in WRONG.strip().splitlines()])
def test_a_wrong_value_is_reported_by_place_expectation_and_finding(table, place, expected, found):
    with raises(TableFault) as fault:
        read_table(Outer, {"name": "a"} | tomllib.loads(table), "top")
    assert (fault.value.place, fault.value.expected, fault.value.found) == (f"top.{place}", expected, found)
    assert fault.value.known == () and fault.value.nearest is None


def test_an_unknown_key_a_missing_value_and_a_table_that_is_none_are_reported():
    with raises(TableFault) as fault:
        read_table(Outer, {"name": "a", "inner": {"lenght_m": 1.0}})
    assert (fault.value.place, fault.value.nearest) == ("inner.lenght_m", "length_m")
    assert fault.value.known == ("length_m", "limits")
    with raises(TableFault) as fault:
        read_table(Outer, {"name": "a", "zzz": 1.0})
    assert fault.value.place == "zzz" and fault.value.nearest is None and "count" in fault.value.known
    with raises(TableFault, match=r"expected all of name, count, .*, found none"):
        read_table(Outer, {})
    with raises(TableFault, match="top: expected a table, found 3"):
        read_table(Outer, 3, "top")


def test_bounds_hold_for_numbers_by_their_name_also_in_lists():
    def bounds(name):
        return (0.0, 1.0) if name == "limits" else (0.0, float("inf"))

    assert read_table(Inner, {"length_m": 0.0, "limits": [0.0, 1.0]}, bounds=bounds).limits == (0.0, 1.0)
    for table, message in (
        ({"limits": [0.0, 1.5]}, r"limits\[1\]: expected a finite number from 0 to 1, found 1.5"),
        ({"length_m": -1}, "length_m: expected a finite number from 0, found -1"),
        ({"length_m": float("nan")}, "length_m: expected a finite number from 0, found nan"),
    ):
        with raises(TableFault, match=message):
            read_table(Inner, table, bounds=bounds)


def test_values_are_written_as_toml_that_reads_the_same():
    values = {"a": True, "b": 'two "quoted"\nlines \\ here', "c": (1.5, 2.0), "d": 3}
    text = "\n".join(f"{key} = {toml_text(value)}" for key, value in values.items())
    assert tomllib.loads(text) == {**values, "c": [1.5, 2.0]}
