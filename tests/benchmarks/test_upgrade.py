"""Rolling upgrade with a migration under load: no error response, and no job is started twice."""

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.upgrade import REVISION, roll


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder in which the user of PostgreSQL can write, unlike in those of pytest."""
    made = Path(tempfile.mkdtemp(prefix="linna-upgrade-"))
    yield made
    shutil.rmtree(made, ignore_errors=True)


@pytest.mark.campaign
def test_an_upgrade_under_load_answers_every_request(folder: Path) -> None:
    for program in ("nginx", "redis-server"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    figures = roll(folder, drain_s=2.0, clients=2, pause_s=0.1, replaced=("api 1", "worker"))
    assert figures["errors"] == []
    assert figures["requests_during_upgrade"] > 20
    assert figures["jobs"] == {"done": figures["uploads"]} and figures["attempts"] == figures["uploads"]
    assert figures["revision"] == REVISION
