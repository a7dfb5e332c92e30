"""Zipped pass archives: what could do harm is refused and leaves nothing behind."""

import stat
import tracemalloc
import zipfile

from pytest import mark, raises, warns

from ground_service.errors import InvalidInput
from ground_service.passes import archive_import
from ground_service.passes.archive_import import import_archive, import_zip, unpacked, zip_folder


def refused(ground, path, message):
    with raises(InvalidInput, match=message):
        import_zip(ground, path)


def zipped(path, entries, method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, octets in entries.items():
            archive.writestr(name, octets)
    return path


def test_a_zipped_archive_is_the_same_pass_as_its_folder(ground, synthetic_pass):

    packed = zip_folder(synthetic_pass.folder)
    try:
        assert import_zip(ground, packed) == import_archive(ground, synthetic_pass.folder)
    finally:
        packed.unlink()
    assert not list(ground.home.glob(".unpacking-*"))


@mark.parametrize("name", ["../evil", "/etc/evil", "a/../../evil", "..\\evil", "C:evil", "a" * 2000])
def test_paths_that_lead_elsewhere_are_refused(ground, tmp_path, name):
    path = zipped(tmp_path / "bad.zip", {"manifest.json": b"{}", name: b"x"})
    refused(ground, path, "expected a plain file inside the archive")
    assert not list(tmp_path.rglob("evil"))
    assert not list(ground.home.glob(".unpacking-*"))


def test_links_are_refused(ground, tmp_path):
    entry = zipfile.ZipInfo("link")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    path = zipped(tmp_path / "link.zip", {entry: b"/etc/passwd"})
    refused(ground, path, "expected a plain file inside the archive")


def test_a_bomb_is_stopped_before_it_fills_the_disk(ground, tmp_path):
    path = zipped(tmp_path / "bomb.zip", {"a": b"\0" * (64 << 20)})
    assert path.stat().st_size < 100_000
    refused(ground, path, "octets when unpacked, found 67108864")


def test_too_many_files_files_twice_and_no_zip_at_all_are_refused(ground, tmp_path, monkeypatch):
    with warns(UserWarning, match="Duplicate name"), zipfile.ZipFile(tmp_path / "twice.zip", "w") as archive:
        archive.writestr("a", "1")
        archive.writestr("a", "2")
    refused(ground, tmp_path / "twice.zip", "expected each file once")
    (tmp_path / "no.zip").write_bytes(b"PK\x03\x04 nothing of the kind")
    refused(ground, tmp_path / "no.zip", "expected a complete zip file")
    whole = zipped(tmp_path / "whole.zip", {"a": bytes(range(256)) * 400}, zipfile.ZIP_STORED)
    damaged = bytearray(whole.read_bytes())
    damaged[5000] ^= 1
    whole.write_bytes(damaged)
    with raises(InvalidInput, match="expected a whole file"), unpacked(whole, tmp_path, "whole.zip"):
        pass
    monkeypatch.setattr(archive_import, "ENTRIES_LIMIT", 3)
    refused(ground, zipped(tmp_path / "many.zip", {str(i): b"" for i in range(4)}), "expected at most 3 files, found 4")


def with_directory(folder, entries, claimed):
    """Write a zip file with a central directory of empty files, named by number, and another number at its end."""
    fixed = b"PK\1\2" + bytes(24) + (7).to_bytes(2, "little") + bytes(16)
    directory = b"".join(fixed + b"%07d" % number for number in range(entries))
    end = b"PK\5\6" + bytes(4) + claimed.to_bytes(2, "little") * 2
    (folder / "many.zip").write_bytes(directory + end + len(directory).to_bytes(4, "little") + bytes(6))
    return folder / "many.zip"


@mark.parametrize("claimed", [None, 1])
def test_a_great_directory_is_refused_before_it_is_read(ground, tmp_path, claimed):
    """The number of entries is counted in the directory, not taken from the end record."""
    entries = 1_200_000 if claimed is None else 25_000
    path = with_directory(tmp_path, entries, claimed or 0xFFFF)
    tracemalloc.start()
    try:
        refused(ground, path, "expected at most 20000 files, found")
        assert tracemalloc.get_traced_memory()[1] < 10 << 20
    finally:
        tracemalloc.stop()


def test_a_directory_of_too_many_octets_is_refused(ground, tmp_path):
    path = with_directory(tmp_path, 200_000, 1)
    refused(ground, path, "expected at most 8388608 octets of its directory")
