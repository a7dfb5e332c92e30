"""An archive that an older dictionary decoded: never empty, decoded again by itself, whatever happens meanwhile."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from ground_service.app import create_app
from ground_service.ground import Ground, open_ground
from ground_service.http.model import Paging
from ground_service.ingest import redecode as redecoding
from ground_service.ingest.packets import batch_of_cut
from ground_service.ingest.redecode import catch_up, redecode, vehicles_behind
from ground_service.ingest.service import ingest_file
from ground_service.ingest.store import store_batch
from ground_service.passes.service import list_events, parameter_series, state_series
from ground_service.settings import Settings
from ground_service.store import repository
from ground_service.store.vehicles import vehicle_id
from tests.ground_service.archive_hash import archive_hash
from tests.ground_service.conftest import define_pass_of
from tests.serving import TestClient
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import decode

OLD = replace(DICTIONARY, version=DICTIONARY.version - 1)


def fill_with_the_old(home: Path, made: Any) -> None:
    """What the program before this one left: all packets, decoded by its dictionary."""
    found = decode((made.folder / "downlink.cadu").read_bytes())
    with open_ground(home) as ground:
        with ground.database.writing() as connection:
            vehicle = vehicle_id(connection, 76, "flight")
            store_batch(connection, vehicle, batch_of_cut(found.buffer, found.cut, OLD, 76))
            repository.change(connection, repository.VEHICLES, vehicle, decoded_version=OLD.version)
        define_pass_of(ground, made)


@pytest.fixture
def old(tmp_path: Path, synthetic_pass: Any) -> Iterator[Ground]:
    fill_with_the_old(tmp_path / "home", synthetic_pass)
    with open_ground(tmp_path / "home") as ground:
        yield ground


def looked_at(ground: Ground) -> tuple[int, int, int]:
    return (
        list_events(ground, 1, Paging(limit=1)).total,
        parameter_series(ground, 1, "power_w", 1000).samples,
        state_series(ground, 1, "spherical", ("altitude_m",), 100)[0].samples,
    )


def versions(ground: Ground) -> set[int]:
    table = repository.SAMPLES["housekeeping"]
    with ground.database.reading() as connection:
        return set(connection.execute(select(table.c.dictionary_version).distinct()).scalars())


def test_an_archive_of_the_old_dictionary_is_read_and_then_decoded_again(old: Ground) -> None:
    before = looked_at(old)
    assert before == (1, 40, 40)
    assert vehicles_behind(old) == [1]
    assert catch_up(old, 1) > 0
    assert looked_at(old) == before
    assert vehicles_behind(old) == []
    assert versions(old) == {OLD.version, DICTIONARY.version}
    assert catch_up(old, 1) == 0


def test_serving_enters_the_job_that_decodes_again(tmp_path: Path, synthetic_pass: Any) -> None:
    fill_with_the_old(tmp_path / "home", synthetic_pass)
    with TestClient(create_app(Settings(home=tmp_path / "home"), inline_jobs=True)) as client:
        (job,) = client.get("/api/v1/jobs").json()["items"]
        assert (job["kind"], job["state"]) == ("redecode", "done")
        assert len(client.get("/api/v1/passes/1/events").json()["items"]) == 1
    with open_ground(tmp_path / "home") as ground:
        assert vehicles_behind(ground) == []


def test_what_comes_in_meanwhile_and_a_kill_in_the_middle_change_nothing(
    old: Ground, tmp_path: Path, make_pass: Any, synthetic_pass: Any, monkeypatch: Any
) -> None:
    monkeypatch.setattr(redecoding, "BLOCK_PACKETS", 50)
    more = make_pass(frames=3, seed=5).folder / "downlink.cadu"
    whole_block = redecoding._block
    blocks = 0

    def killed(*given: Any) -> Any:
        nonlocal blocks
        blocks += 1
        if blocks == 3:
            raise KeyboardInterrupt
        return whole_block(*given)

    monkeypatch.setattr(redecoding, "_block", killed)
    with pytest.raises(KeyboardInterrupt):
        ingest_file(old, more)
    assert looked_at(old)[0] >= 1  # still as the old dictionary decoded it
    ingest_file(old, more)
    with open_ground(tmp_path / "fresh") as fresh:
        for path in (more, synthetic_pass.folder / "downlink.cadu"):
            ingest_file(fresh, path)
        redecode(fresh, 1, OLD)
        redecode(old, 1, OLD)
        hashes = []
        for ground in (old, fresh):
            with ground.database.reading() as connection:
                hashes.append(archive_hash(connection, 1))
    assert hashes[0] == hashes[1]
