"""The packages stay within the table of sizes, and the table only falls."""

import importlib.util
import itertools
import sys
from pathlib import Path

from pytest import mark

from tests.serving import ran

_SPEC = importlib.util.spec_from_file_location("sizes", Path(__file__).with_name("sizes.py"))
sizes = importlib.util.module_from_spec(_SPEC)
sys.modules["sizes"] = sizes
_SPEC.loader.exec_module(sizes)


def test_no_package_is_larger_than_the_table_allows():
    limits = sizes.load_table(sizes.TABLE.read_text(encoding="utf-8"))
    assert sizes.above(sizes.sizes_of(sizes.ROOT), limits) == []


def test_a_change_of_the_table_that_raises_an_entry_lowers_another_by_more():
    """Both the uncommitted change and the newest committed one."""
    log = ["git", "-C", str(sizes.ROOT), "log", "-2", "--format=%H", "--", "tests/sizes.csv"]
    revisions = ran(log).stdout.split()
    tables = [sizes.load_table(sizes.TABLE.read_text(encoding="utf-8"))]
    tables += [table for table in map(sizes.committed_table, revisions) if table is not None]
    assert [sizes.unpaid(before, after) for after, before in itertools.pairwise(tables)] in ([], [[]], [[], []])


def test_tokens_do_not_count_comments_docstrings_and_line_breaks():
    long = '"""A module."""\n\n\ndef f(a):  # why\n    """Return a."""\n    return (\n        a\n    )\n'
    assert sizes.size_of("def f(a): return (a)\n")[1] == sizes.size_of(long)[1] == 10
    assert sizes.size_of(long)[0] == 8
    assert sizes.size_of("a = '''text'''\n")[1] == 3


@mark.parametrize(
    "sized, expected",
    [
        ((10, 100), []),
        ((9, 101), ["p: 101 tokens, limit 100: remove 1 there, or lower another entry by more"]),
        ((11, 100), ["p: 11 lines, limit 10: remove 1 there, or lower another entry by more"]),
    ],
)
def test_a_package_above_its_limit_is_named(sized, expected):
    assert sizes.above({"p": sized}, {"p": (10, 100)}) == expected


def test_a_package_that_the_table_does_not_know_is_above_its_limit():
    assert len(sizes.above({"new": (1, 1)}, {"p": (10, 100)})) == 2


# as much as it rises is not more; renamed and smaller is
CHANGES = """a 9 9 b 10 10: 0
a 11 10 b 10 10: 1
a 11 10 b 9 10: 1
a 11 10 b 8 10: 0
a 11 11 b 8 10: 1
b 10 10 c 9 9: 0
b 10 10 c 10 9: 1"""


@mark.parametrize("row", CHANGES.splitlines())
def test_a_limit_rises_only_if_another_falls_by_more(row):
    sized, refused = row.split(":")
    one, lines, tokens, other, more_lines, more_tokens = sized.split()
    after = {one: (int(lines), int(tokens)), other: (int(more_lines), int(more_tokens))}
    assert len(sizes.unpaid({"a": (10, 10), "b": (10, 10)}, after)) == int(refused)
