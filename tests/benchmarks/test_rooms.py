"""Rooms, floors and arrows of packages."""

from graphlib import CycleError

import pytest

from benchmarks.rooms import Rooms, measure

MODULES = {
    "house": "",
    "house.attic": "import json\nfrom house.hall import (\n    door,\n)\n\n\ndef f():\n    from house import cellar\n",
    "house.hall": "",
    "house.hall.door": "from house.hall.key import KEY\nfrom house.cellar import STAIRS\n",
    "house.hall.key": "KEY = 1\n",
    "house.cellar": "STAIRS = 1\n",
    "houses": "import house\n",
}


def test_rooms_floors_and_arrows_are_those_of_the_imports() -> None:
    """attic → hall → cellar, and attic → cellar inside a function; 7 of 12 lines import."""
    assert measure("house", MODULES) == Rooms(3, 3, 3, 6, 12, 7 / 12)


def test_a_circle_of_imports_between_rooms_is_refused() -> None:
    with pytest.raises(CycleError, match="cycle"):
        measure("house", MODULES | {"house.cellar": "from house import attic\n"})
