"""What may happen to a running ingest, and archives decoded again."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import func, select

from ground_service.ground import Ground, open_ground
from ground_service.ingest.redecode import redecode
from ground_service.ingest.service import ingest_file
from ground_service.store import repository
from tests.ground_service.archive_hash import hash_of
from tmtc.dictionary.payload import DICTIONARY

KILLS = 4

INGEST = """
import sys
from pathlib import Path
from ground_service.ingest import reception
from ground_service.store import files
from ground_service.ground import open_ground
from ground_service.ingest.service import ingest_file
files.BLOCK_OCTETS = 4_000
reception.WINDOW_OCTETS = 4_000
with open_ground(Path(sys.argv[1])) as ground:
    print("ready", flush=True)
    ingest_file(ground, Path(sys.argv[2]))
"""


def rows_of(ground: Ground, version: int) -> dict[str, int]:
    with ground.database.reading() as connection:
        return {
            name: connection.execute(
                select(func.count()).select_from(table).where(table.c.dictionary_version == version)
            ).scalar_one()
            for name, table in repository.SAMPLES.items()
        }


@pytest.fixture(scope="module")
def downlink(make_pass: Callable[..., Any]) -> Path:
    return Path(make_pass(frames=30, seed=4).folder) / "downlink.cadu"


@pytest.mark.campaign
def test_an_ingest_killed_at_any_moment_loses_and_doubles_nothing(downlink: Path, tmp_path: Path) -> None:
    """The stream is stored in about ten transactions; the process is killed outright at random moments among them."""
    with open_ground(tmp_path / "whole") as ground:
        result = ingest_file(ground, downlink)
        expected = hash_of(ground)
    home = tmp_path / "killed"
    rng = np.random.default_rng(11)
    for _ in range(KILLS):
        process = subprocess.Popen(
            [sys.executable, "-c", INGEST, str(home), str(downlink)],
            stdout=subprocess.PIPE,
            env=dict(os.environ),
        )
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(float(rng.uniform(0.0, 0.4)))
        process.send_signal(signal.SIGKILL)
        process.wait(60)
        process.stdout.close()
    with open_ground(home) as ground:
        again = ingest_file(ground, downlink)
        assert again.packets == result.packets
        assert hash_of(ground) == expected


def test_decoding_again_puts_rows_beside_the_old_ones(downlink: Path, ground: Ground) -> None:
    result = ingest_file(ground, downlink)
    before = rows_of(ground, DICTIONARY.version)
    newer = dataclasses.replace(DICTIONARY, version=DICTIONARY.version + 1)
    assert result.vehicle_id is not None
    assert redecode(ground, result.vehicle_id, newer) == sum(before.values()) == result.samples
    assert rows_of(ground, DICTIONARY.version) == before
    assert rows_of(ground, newer.version) == before
    archive = hash_of(ground)
    redecode(ground, result.vehicle_id, newer)
    redecode(ground, result.vehicle_id, DICTIONARY)
    assert hash_of(ground) == archive
