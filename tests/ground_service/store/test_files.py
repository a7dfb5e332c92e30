"""File archive: atomic and durable storage, no leftovers."""

import os
import subprocess
import sys
from pathlib import Path

from pytest import fixture, raises
from sqlalchemy import text

from ground_service.ground import open_ground
from ground_service.store.files import FileArchive, make_durable_folder, replace_durably


@fixture
def ended_process():
    """Return the id of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_octets_name_and_folders_are_synchronised_before_the_file_is_stored(tmp_path, monkeypatch):
    operations = []
    replace, fsync = os.replace, os.fsync

    def noted_replace(source, target):
        operations.append("replace")
        replace(source, target)

    def noted_fsync(descriptor):
        place = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        operations.append("octets" if place.is_file() else str(place.relative_to(tmp_path)))
        fsync(descriptor)

    monkeypatch.setattr(os, "replace", noted_replace)
    monkeypatch.setattr(os, "fsync", noted_fsync)
    stored = FileArchive(tmp_path / "home/files").put_octets(b"telemetry")
    assert operations == [".", "home", "octets", "replace", f"home/files/{stored.sha256[:2]}", "home/files"]


def test_a_file_that_another_process_stored_is_synchronised_too(tmp_path, monkeypatch):
    files = FileArchive(tmp_path)
    files.put_octets(b"telemetry")
    monkeypatch.setattr("ground_service.store.files._durable", set())  # as in another process
    synchronised = []
    monkeypatch.setattr(os, "fsync", lambda fd: synchronised.append(os.readlink(f"/proc/self/fd/{fd}")))
    stored = files.put_octets(b"telemetry")
    assert synchronised[-2:] == [str(stored.path.parent), str(tmp_path)]
    synchronised.clear()
    files.put_octets(b"telemetry")
    assert len(synchronised) == 2, "octets and folder; the folder itself was synchronised before"
    assert synchronised[-1] == str(stored.path.parent)


def test_leftovers_of_ended_processes_are_removed_at_the_start(tmp_path, ended_process):
    files = FileArchive(tmp_path / "files")

    def interrupted():
        yield b"half of it"
        yield Path(next((tmp_path / "files").glob(".incoming-*"))).name.encode()
        raise KeyboardInterrupt

    with raises(KeyboardInterrupt):
        files.put(interrupted())
    assert not list(files.root.glob(".incoming-*")), "an aborted upload leaves nothing"

    names = []

    def watched():
        yield b"the first "
        names.append(next(files.root.glob(".incoming-*")).name)
        yield b"and the rest"

    files.put(watched())
    mine = names[0].rsplit("-", 1)[0]  # this host and process, which runs
    of_ended = mine.replace(f".{os.getpid()}", f".{ended_process}")
    same_number_before = mine.rpartition(".")[0] + ".12345"
    left_over = (f"{of_ended}-b", f"{same_number_before}-d", ".incoming-old")
    for name in f"{mine}-a", ".incoming-00000000.1-c", *left_over:
        (files.root / name).write_bytes(b"half")
        folder = tmp_path / name.replace("incoming", "unpacking")
        (folder / "images").mkdir(parents=True)
        (folder / "images/0.png").write_bytes(b"half")
    for old in files.root / ".incoming-old", tmp_path / ".unpacking-old":
        os.utime(old, (0, 0))
    with open_ground(tmp_path):
        left = sorted(path.name for path in files.root.glob(".incoming-*"))
        folders = sorted(path.name for path in tmp_path.glob(".unpacking-*"))
    assert left == sorted([f"{mine}-a", ".incoming-00000000.1-c"])
    assert folders == [name.replace("incoming", "unpacking") for name in left]


def test_a_folder_is_whole_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    (tmp_path / "partial/files").mkdir(parents=True)
    (tmp_path / "partial/files/a").write_bytes(b"a")
    (tmp_path / "partial/list").write_bytes(b"list")
    steps = []
    replace, read = os.replace, os.readlink
    monkeypatch.setattr(os, "fsync", lambda fd: steps.append(read(f"/proc/self/fd/{fd}")))
    monkeypatch.setattr(os, "replace", lambda a, b: (steps.append("name"), replace(a, b)))
    replace_durably(tmp_path / "partial", tmp_path / "backup")
    partial = str(tmp_path / "partial")
    before = {partial, f"{partial}/files", f"{partial}/files/a", f"{partial}/list"}
    assert set(steps[:-2]) == before
    assert steps[-2:] == ["name", str(tmp_path)]
    assert (tmp_path / "backup/files/a").read_bytes() == b"a"


def test_commits_to_sqlite_are_synchronised(ground):
    with ground.database.reading() as connection:
        assert connection.execute(text("PRAGMA synchronous")).scalar() == 2  # FULL


def test_folders_are_made_once(tmp_path):
    make_durable_folder(tmp_path / "a/b")
    make_durable_folder(tmp_path / "a/b")
    assert (tmp_path / "a/b").is_dir()
