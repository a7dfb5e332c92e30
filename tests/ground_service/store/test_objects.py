"""Files in an object store: a local S3 server, caches of several machines, loss and damage."""

import hashlib
import os
import time
import uuid

from pytest import fixture, raises

from ground_service.errors import FileDamaged, NotFound, ObjectsUnavailable, SettingsError
from ground_service.settings import Settings, load_settings
from ground_service.store import files as files_module
from ground_service.store import objects as objects_module
from ground_service.store.files import FileArchive, files_of
from ground_service.store.objects import objects_of
from tests.ground_service.object_server import running_objects


@fixture(scope="module")
def server():
    with running_objects(f"files-{uuid.uuid4().hex[:8]}") as running:
        yield running


@fixture
def machine(server, tmp_path):
    """A function that returns the file archive of a machine of its own; the tests use different contents."""
    return lambda name: files_of(tmp_path / name, server.store())


def test_a_file_stored_on_one_machine_is_read_on_another(machine):
    stored = machine("a").put_octets(b"telemetry of one")
    other = machine("b")
    assert not other.place(stored.sha256).exists()
    assert other.octets(stored.sha256) == 16
    assert b"".join(other.blocks(stored.sha256)) == b"telemetry of one"
    assert not other.place(stored.sha256).exists()  # without filling the cache
    assert other.get(stored.sha256) == b"telemetry of one"
    assert other.read(stored.sha256, 3, 6) == b"eme"
    assert other.path(stored.sha256).read_bytes() == b"telemetry of one"
    assert (stored.sha256, True) in set(other.names())


def test_storing_again_changes_nothing_and_restores_a_lost_object(machine, server):
    one = machine("a")
    stored = one.put_octets(b"again")
    assert one.put_octets(b"again") == stored
    server.store().under("files").remove(stored.sha256)
    assert one.path(stored.sha256).is_file() and one.octets(stored.sha256) is None
    one.put_octets(b"again")  # the copy in the cache is no reason not to send it
    assert machine("b").get(stored.sha256) == b"again"


def test_a_file_that_is_not_stored_is_not_found(machine):
    sha256 = hashlib.sha256(b"never").hexdigest()
    one = machine("a")
    assert one.octets(sha256) is None and not one.path(sha256).exists()
    with raises(NotFound):
        one.get(sha256)
    with raises(NotFound):
        next(one.blocks(sha256))


def test_a_removed_file_is_gone_for_all(machine):
    one = machine("a")
    stored = one.put_octets(b"to be removed")
    one.remove(stored.sha256)
    one.remove(stored.sha256)
    assert not stored.path.exists() and machine("b").octets(stored.sha256) is None


def test_a_damaged_object_is_not_taken_into_a_cache(machine, server):
    one = machine("a")
    stored = one.put_octets(b"good octets")
    store = server.store().under("files")
    store._client().put_object(Bucket=store.bucket, Key=store.key(stored.sha256), Body=b"bad octets!")
    other = machine("b")
    with raises(FileDamaged, match=f"object {stored.sha256}"):
        other.path(stored.sha256)
    assert [path for path in other.root.rglob("*") if path.is_file()] == []
    one.remove(stored.sha256)


def test_nothing_is_acknowledged_while_the_store_is_away(tmp_path):
    with running_objects(f"away-{uuid.uuid4().hex[:8]}") as server:
        one, other = (files_of(tmp_path / name, server.store()) for name in "ab")
        known = one.put_octets(b"before")
        server.stop()
        for attempt in (
            lambda: one.put_octets(b"during"),
            lambda: other.path(known.sha256),
            lambda: one.octets(known.sha256),
            one.require_writable,
        ):
            with raises(ObjectsUnavailable, match="cannot be used"):
                attempt()
        assert not one.place(hashlib.sha256(b"during").hexdigest()).exists()
        assert one.get(known.sha256) == b"before"  # from the cache
        server.start()
        assert other.get(known.sha256) == b"before"
        assert other.put_octets(b"during").octets == 6
        one.require_writable()
        assert not list(one.root.glob(".incoming-*"))


def test_a_bucket_that_does_not_exist_is_one_line(server, tmp_path):
    settings = Settings(**{**server.settings(), "objects": "s3://another-bucket"})
    files = files_of(tmp_path, objects_of(settings))
    with raises(ObjectsUnavailable, match="bucket another-bucket: cannot be used: NoSuchBucket"):
        files.put_octets(b"x")


def test_large_objects_are_sent_in_parts(machine, monkeypatch):
    monkeypatch.setattr(objects_module, "SINGLE_OCTETS", 1 << 20)
    monkeypatch.setattr(objects_module, "PART_OCTETS", 5 << 20)
    block = bytes(range(256)) * 4096
    stored = machine("a").put(block for _ in range(12))
    assert stored.octets == 12 << 20
    assert hashlib.sha256(b"".join(machine("b").blocks(stored.sha256))).hexdigest() == stored.sha256


def test_the_cache_is_trimmed_to_its_size_oldest_first(server, tmp_path):
    settings = Settings(**server.settings(), objects_cache_gib=300 / (1 << 30))
    files = files_of(tmp_path, objects_of(settings))
    stored = [files.put_octets(bytes([k]) * 100) for k in range(5)]
    now = time.time()
    for k, one in enumerate(stored):
        os.utime(one.path, (now, now - 7200 + k))
    files.path(stored[0].sha256)  # used now
    files.remove(stored[2].sha256)
    lost = stored[1]
    server.store().under("files").remove(lost.sha256)  # only here: must stay
    assert files.trim() == 1
    left = {one.sha256 for one in stored if one.path.exists()}
    assert left == {stored[0].sha256, lost.sha256, stored[4].sha256}
    assert files.get(stored[3].sha256) == bytes([3]) * 100  # fetched again


def test_files_of_the_last_hour_stay_in_the_cache(server, tmp_path):
    settings = Settings(**server.settings(), objects_cache_gib=0.0)
    files = files_of(tmp_path, objects_of(settings))
    stored = files.put_octets(b"just stored")
    assert files.trim() == 0 and stored.path.exists()
    assert files.trim(time.time() + files_module.CACHED_S + 1) == 1


def test_the_cache_is_trimmed_at_times_and_without_the_store_not_at_all(server, tmp_path, monkeypatch):
    settings = Settings(**server.settings(), objects_cache_gib=0.0)
    files = files_of(tmp_path, objects_of(settings))
    monkeypatch.setattr(files_module, "TRIM_S", 0.0)
    first = files.put_octets(b"first of two")
    os.utime(first.path, (0, 0))
    files.put_octets(b"second of two")
    assert not first.path.exists()
    files.path(first.sha256)
    os.utime(first.path, (0, 0))

    def away(_self, _sha256):
        raise ObjectsUnavailable("linna", "away")

    monkeypatch.setattr(objects_module.ObjectStore, "octets", away)
    files.trim_at_times()
    assert first.path.exists()


def test_a_folder_is_never_trimmed(tmp_path):
    files = FileArchive(tmp_path)
    stored = files.put_octets(b"the only copy")
    assert files.trim(time.time() + 1e9) == 0 and stored.path.exists()


def test_keys_come_from_files_and_are_not_shown(monkeypatch, tmp_path):
    monkeypatch.setenv("LINNA_OBJECTS", "s3://linna")
    for name in ("access", "secret"):
        (tmp_path / name).write_text(f"{name}-value\n")
        monkeypatch.setenv(f"LINNA_OBJECTS_{name.upper()}_KEY_FILE", str(tmp_path / name))
    found = objects_of(load_settings())
    assert found is not None and (found.access_key, found.secret_key) == ("access-value", "secret-value")
    assert found.prefix == "" and "secret-value" not in repr(found)
    monkeypatch.delenv("LINNA_OBJECTS_SECRET_KEY_FILE")
    with raises(SettingsError, match="LINNA_OBJECTS_ACCESS_KEY: expected an access key and a secret key"):
        objects_of(load_settings())
