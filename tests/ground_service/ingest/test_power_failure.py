"""A power failure at any operation of an ingest: acknowledged data are complete, and the rest can be ingested later."""

import shutil

import pytest

from benchmarks.campaigns.power import campaign


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc compiles the recorder of file operations")
def test_nothing_that_was_acknowledged_is_lost_in_a_power_failure() -> None:
    figures = campaign(cuts=20, pieces=4, packets=40, seed=2, resumed=10)
    assert figures["cuts"] == 20 and figures["synchronised"] > 20
    assert figures["faults"] == {}
