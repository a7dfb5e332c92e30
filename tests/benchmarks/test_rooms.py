"""Rooms, floors and arrows of packages; the table of the benchmarks."""

from graphlib import CycleError

from pytest import raises

from benchmarks.rooms import Rooms, measure

MODULES = {
    "house": "",
    "house.attic": "import json\nfrom house.hall import (\n    door,\n)\n\n\ndef f():\n    from house import cellar\n",
    "house.hall": "", "house.hall.door": "from house.hall.key import KEY\nfrom house.cellar import STAIRS\n",
    "house.hall.key": "KEY = 1\n", "house.cellar": "STAIRS = 1\n", "houses": "import house\n",
}  # fmt: skip


def test_rooms_and_arrows_are_those_of_the_imports_and_a_circle_is_refused():
    """attic → hall → cellar, and attic → cellar inside a function; 7 of 12 lines import."""
    assert measure("house", MODULES) == Rooms(3, 3, 3, 6, 12, 7 / 12)
    with raises(CycleError, match="cycle"):
        measure("house", MODULES | {"house.cellar": "from house import attic\n"})
