"""Telemetry in a spool and as files that appear: every packet once, also after a crash."""

import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ground_service.errors import InvalidInput, StorageFull
from ground_service.ground import Ground
from ground_service.ingest.live import Spool, WatchedFolder
from ground_service.ingest.service import Place, ingest_file
from tests.ground_service.archive_hash import hash_of


@pytest.fixture
def expected(synthetic_pass: Any, tmp_path: Path) -> str:
    from ground_service.ground import open_ground

    with open_ground(tmp_path / "whole") as ground:
        ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
        return hash_of(ground)


@pytest.fixture
def stream(synthetic_pass: Any) -> bytes:
    return bytes((synthetic_pass.folder / "downlink.cadu").read_bytes())


def spool_of(ground: Ground, folder: Path, seen: list[Any]) -> Spool:
    def ingest(path: Path, recording: str, offset: int) -> dict[str, Any]:
        return {"packets_new": ingest_file(ground, path, place=Place(recording, offset)).packets_new}

    return Spool(folder, ingest, lambda _path, result: seen.append(result))


def test_segments_cut_at_any_octet_are_pieces_of_one_recording(
    ground: Ground, stream: bytes, expected: str, tmp_path: Path
) -> None:
    seen: list[Any] = []
    spool = spool_of(ground, tmp_path / "spool", seen)
    assert spool.open() == 0
    for start, stop in pairwise([0, 700, 4 * 1279 + 300, 4 * 1279 + 301, len(stream)]):
        spool.keep(stream[start:stop])
        spool.cut()
        spool.drain()
    assert len(seen) == 4
    assert hash_of(ground) == expected
    spool.begin()
    assert list((tmp_path / "spool").iterdir()) == []


@pytest.mark.parametrize("drained", [False, True])
def test_the_recording_of_a_run_that_crashed_goes_on(
    ground: Ground, stream: bytes, expected: str, tmp_path: Path, drained: bool
) -> None:
    """Also if all its segments are ingested."""
    folder, seen = tmp_path / "spool", []
    crashed = spool_of(ground, folder, seen)
    crashed.open()
    for octets in (stream[:2000], stream[2000:3000]):
        crashed.keep(octets)
        crashed.cut()
        if drained:
            crashed.drain()
    if not drained:
        crashed.keep(stream[3000:4000])
        crashed._stream.close()
    spool = spool_of(ground, folder, seen)
    assert spool.open() == (0 if drained else 4000)
    spool.drain()
    spool.keep(stream[3000 if drained else 4000 :])
    spool.cut()
    spool.drain()
    assert hash_of(ground) == expected


def test_the_segments_of_a_version_without_recordings_are_consecutive(
    ground: Ground, stream: bytes, expected: str, tmp_path: Path
) -> None:
    folder = tmp_path / "spool"
    folder.mkdir()
    (folder / "000000000004.segment").write_bytes(stream[:700])
    (folder / "000000000005.segment").write_bytes(stream[700:3000])
    (folder / "current").write_bytes(stream[3000:])
    spool = spool_of(ground, folder, [])
    assert spool.open() == len(stream)
    spool.drain()
    assert hash_of(ground) == expected


def test_a_segment_stays_in_the_spool_while_the_store_is_full(stream: bytes, tmp_path: Path) -> None:
    def full(*_: Any) -> dict[str, Any]:
        raise StorageFull("here")

    spool = Spool(tmp_path, full, lambda *_: None)
    spool.open()
    spool.keep(stream)
    spool.cut()
    with pytest.raises(StorageFull):
        spool.drain()
    assert b"".join(path.read_bytes() for path in tmp_path.glob("*.segment")) == stream


def test_noise_is_part_of_the_recording_and_an_unknown_coding_does_not_stop_the_rest(
    ground: Ground, stream: bytes, expected: str, tmp_path: Path
) -> None:
    seen: list[Any] = []
    spool = spool_of(ground, tmp_path / "spool", seen)
    spool.open()
    markers = bytes.fromhex("1ACFFC1D") + np.random.default_rng(1).bytes(1275)
    for octets in (b"\x00" * 5000, 40 * markers, stream):
        spool.keep(octets)
        spool.cut()
        spool.drain()
    assert seen[:2] == [{"packets_new": 0}] * 2
    assert hash_of(ground) == expected


def test_files_that_appear_are_ingested_once_when_they_are_whole(tmp_path: Path) -> None:
    folder, seen = tmp_path / "in", []
    folder.mkdir()

    def watched() -> WatchedFolder:
        return WatchedFolder(
            folder, tmp_path / "ledger.json", lambda path: {"file": path.name}, lambda p, r: seen.append(r)
        )

    for name, age in (("a.cadu", 100), ("b.cadu", 0), ("c.part", 100), (".hidden", 100)):
        (folder / name).write_bytes(b"x")
        os.utime(folder / name, (1000.0 - age, 1000.0 - age))
    assert watched().look(1000.0) == 1
    assert watched().look(1010.0) == 1  # the second one has settled; another process remembers the first
    assert watched().look(1020.0) == 0
    (folder / "a.cadu").write_bytes(b"longer")
    os.utime(folder / "a.cadu", (1020.0, 1020.0))
    assert watched().look(1030.0) == 1
    assert [one["file"] for one in seen] == ["a.cadu", "b.cadu", "a.cadu"]
    with pytest.raises(InvalidInput, match="expected a folder to watch"):
        WatchedFolder(tmp_path / "no", tmp_path / "l", lambda _: {}, lambda *_: None).look(0.0)
