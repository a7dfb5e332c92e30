"""Telemetry over a connection and as files that appear: every packet once, also after a crash."""

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ground_service.errors import InvalidInput, StorageFull
from ground_service.ground import Ground
from ground_service.ingest import live as live_ingest
from ground_service.ingest.live import Spool, WatchedFolder, follow_tcp
from ground_service.ingest.service import ingest_file
from ground_service.store.vehicles import vehicle_id
from tests.ground_service.archive_hash import archive_hash


def hash_of(ground: Ground) -> str:
    with ground.database.reading() as connection:
        return archive_hash(connection, vehicle_id(connection, 76, "flight"))


@pytest.fixture
def expected(synthetic_pass: Any, tmp_path: Path) -> str:
    from ground_service.ground import open_ground

    with open_ground(tmp_path / "whole") as ground:
        ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
        return hash_of(ground)


@pytest.fixture
def stream(synthetic_pass: Any) -> bytes:
    return bytes((synthetic_pass.folder / "downlink.cadu").read_bytes())


@contextmanager
def sender(pieces: list[bytes], pause_s: float = 0.0) -> Iterator[tuple[str, int]]:
    """A port that gives the pieces to each client, pausing between them, and closes."""
    listener = socket.create_server(("127.0.0.1", 0))
    done = threading.Event()

    def send() -> None:
        connection, _ = listener.accept()
        with connection:
            for piece in pieces:
                connection.sendall(piece)
                done.wait(pause_s)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield listener.getsockname()[:2]
    finally:
        done.set()
        thread.join(20)
        listener.close()


def spool_of(ground: Ground, folder: Path, seen: list[Any]) -> Spool:
    def ingest(path: Path) -> dict[str, Any]:
        return {"packets_new": ingest_file(ground, path).packets_new}

    return Spool(folder, ingest, lambda _path, result: seen.append(result))


def test_a_connection_is_ingested_as_it_pauses(
    ground: Ground, stream: bytes, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_ingest, "PAUSE_S", 0.05)
    cadu = 1279  # 4 octets of marker and five codewords of 255
    pieces = [stream[: 4 * cadu + 300], stream[4 * cadu + 300 : 9 * cadu], stream[9 * cadu :]]
    seen: list[Any] = []
    with sender(pieces, pause_s=0.4) as address:
        taken = follow_tcp(
            address, spool_of(ground, tmp_path / "spool", seen), reconnect=False, stop=lambda: False
        )
    assert taken == len(stream)
    assert len(seen) == 3
    assert hash_of(ground) == expected
    assert list((tmp_path / "spool").iterdir()) == []


def test_what_a_crash_left_in_the_spool_is_ingested_first(
    ground: Ground, stream: bytes, expected: str, tmp_path: Path
) -> None:
    folder = tmp_path / "spool"
    folder.mkdir()
    third = len(stream) // 3
    (folder / "000000000004.segment").write_bytes(stream[:third])  # sealed, perhaps ingested already
    (folder / "current").write_bytes(stream[third : 2 * third])  # being written when the power went
    ingest_file(ground, folder / "000000000004.segment")
    seen: list[Any] = []
    with sender([stream]) as address:  # the sender begins again from the start
        follow_tcp(address, spool_of(ground, folder, seen), reconnect=False, stop=lambda: False)
    assert seen[0] == {"packets_new": 0}
    assert hash_of(ground) == expected


def test_a_segment_stays_in_the_spool_while_the_store_is_full(stream: bytes, tmp_path: Path) -> None:
    def full(_path: Path) -> dict[str, Any]:
        raise StorageFull("here")

    spool = Spool(tmp_path, full, lambda *_: None)
    spool.recover()
    spool.take(stream)
    with pytest.raises(StorageFull):
        spool.seal()
    assert b"".join(path.read_bytes() for path in tmp_path.glob("*.segment")) == stream


def test_noise_is_told_and_does_not_stop_the_rest(
    ground: Ground, stream: bytes, expected: str, tmp_path: Path
) -> None:
    seen: list[Any] = []
    spool = spool_of(ground, tmp_path / "spool", seen)
    spool.recover()
    for octets in (b"\x00" * 5000, stream):
        spool.take(octets)
        spool.seal()
    assert isinstance(seen[0], InvalidInput)
    assert hash_of(ground) == expected


def test_nobody_there_is_told_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_ingest, "CONNECT_S", 0.0)
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = free.getsockname()[:2]
    spool = Spool(tmp_path, lambda _: {}, lambda *_: None)
    with pytest.raises(InvalidInput, match=r"127\.0\.0\.1:\d+: expected a sender of telemetry"):
        follow_tcp(address, spool, reconnect=False, stop=lambda: False)


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
