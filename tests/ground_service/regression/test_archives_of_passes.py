"""Kept archives that are named by the pass that was imported from them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from ground_service.client.local import local_client
from ground_service.ground import Ground
from ground_service.http.times import UtcTime
from ground_service.passes.archive_import import import_archive, read_manifest
from ground_service.regression import store
from ground_service.regression.model import ArchiveRecord
from linna.commands import regress
from tests.ground_service.conftest import SyntheticPass


@pytest.fixture(scope="module")
def archive(make_pass: Callable[..., SyntheticPass]) -> Path:
    return make_pass(frames=4, seed=3).folder


def test_a_kept_archive_is_found_by_its_pass(either: Ground, archive: Path) -> None:
    _, digest = read_manifest(archive)
    record = ArchiveRecord(
        digest=digest,
        name="synthetic pass",
        frames=4,
        octets=1,
        pinned=False,
        kept_since=UtcTime(0),
        manifest_sha256="0" * 64,
    )
    with either.database.writing() as connection:
        store.keep_archive(connection, record)
    with local_client(either, "ann") as service:
        assert [one.pass_id for one in service.list_kept_archives()] == [None]
        pass_id = import_archive(either, archive)
        assert [one.pass_id for one in service.list_kept_archives()] == [pass_id]
        assert regress._kept(service, [str(pass_id)]) == ([digest], [])
        _, [unusable] = regress._kept(service, ["99"])
        assert "identity or the pass of one that is kept" in unusable["detail"]
