"""Faults of the database and the disk, and two owners at a time: nothing is lost, recorded twice, or sent twice."""

import errno
import fcntl
import os
import threading

import numpy as np
from pytest import fixture, mark, raises
from sqlalchemy import func, select

from ground_service.clock import mission_now_ns
from ground_service.contacts.links import runner as runners
from ground_service.contacts.links import service, store
from ground_service.contacts.links.runner import ACKNOWLEDGEMENT, DISCARDED_BLOCKS, Connector, LinkRunner, ended_holder
from ground_service.contacts.links.supervisor import LinkSupervisor
from ground_service.errors import DatabaseBusy, Stopping, StorageFull
from ground_service.ingest.live import SETTLED_S, Spool, WatchedFolder
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.store import repository
from ground_service.store.event_kinds import read_events
from lunar.ephemeris import Ephemeris, ephemeris_from_states
from lunar.messages.oem import save_oem
from tests.ground_service.conftest import START, circular_states
from tests.ground_service.contacts.links.conftest import acquired, declare, operated
from tests.ground_service.contacts.links.test_links import (
    CADU,
    PLACES,
    contact_events,
    expected,
    hash_of,
    released,
    stream,
)
from tests.serving import wait_for

__all__ = ["expected", "stream"]

NS = 1_000_000_000


@fixture(autouse=True)
def _short_waits(monkeypatch):
    monkeypatch.setattr(runners, "RETRY_S", 0.05)


def failing(work, times):
    """Return `work` with a busy database at some of its calls, counted from 1."""
    calls = [0]

    def run(*arguments, **named):
        calls[0] += 1
        if calls[0] in times:
            raise DatabaseBusy("test")
        return work(*arguments, **named)

    return run


def test_a_block_received_while_the_database_is_busy_is_kept(ground, station, stream, expected, monkeypatch):
    declare(ground, station.link())
    monkeypatch.setattr(service, "start_contact", failing(service.start_contact, {1, 2}))
    with operated(ground) as runner:
        station.accept().sendall(stream)
        wait_for(lambda: runner.octets_received == len(stream), "all octets")
        assert hash_of(ground) == expected


def test_a_block_held_at_the_stop_is_in_the_spool(ground, station, stream, monkeypatch):
    declare(ground, station.link())
    monkeypatch.setattr(service, "start_contact", failing(service.start_contact, set(range(1, 10_000))))
    with operated(ground) as runner:
        station.accept().sendall(stream[: 3 * CADU])
        wait_for(lambda: runner._block is not None, "the block")
        held = len(runner._block or b"")
    assert runner.octets_received == held


def test_a_full_disk_loses_nothing_and_the_link_shows_it(ground, station, stream, expected, monkeypatch):
    declare(ground, station.link("acknowledge = true"))
    full, synchronise = [False], os.fdatasync

    def fdatasync(number):
        if full[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        synchronise(number)

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    with operated(ground) as runner:
        connection = station.accept()
        wait_for(lambda: service.get_link(ground, "lab").state == "connected", "the connection")
        full[0] = True
        connection.sendall(stream)
        wait_for(lambda: service.get_link(ground, "lab").state == "failed", "the state")
        assert "no space left" in (service.get_link(ground, "lab").reason or "")
        threading.Event().wait(0.3)
        states = [one.payload["state"] for one in read_events(ground.database, 0, 10_000) if one.kind == "link"]
        assert states.count("failed") == 1
        full[0] = False
        wait_for(lambda: runner.octets_received == len(stream), "all octets")
        assert hash_of(ground) == expected
        wait_for(lambda: service.get_link(ground, "lab").state != "failed", "the state after it")
        connection.settimeout(10.0)
        counts = [0]
        while counts[-1] < len(stream):
            counts.append(ACKNOWLEDGEMENT.unpack(connection.recv(ACKNOWLEDGEMENT.size))[0])
        assert counts[-1] == len(stream) and counts == sorted(set(counts))


class HalfWritten:
    """A stream to a disk that becomes full after some octets."""

    def __init__(self, stream, room):
        self.stream, self.room = stream, room

    def __getattr__(self, name):
        return getattr(self.stream, name)

    def write(self, octets):
        if self.room == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = self.stream.write(octets[: self.room])
        self.room -= written
        return int(written)


def test_octets_that_were_written_in_part_are_not_written_twice(tmp_path):
    spool = Spool(tmp_path, lambda *_: {}, lambda *_: None)
    spool.open()
    spool.keep(b"first ")
    whole = spool._stream
    spool._stream = HalfWritten(whole, 3)
    with raises(StorageFull):
        spool.keep(b"second")
    assert spool.size == 6
    spool._stream = whole
    spool.keep(b"second")
    sealed = spool.cut()
    assert sealed is not None and sealed.read_bytes() == b"first second"


@mark.parametrize("renamed", [False, True])
def test_a_segment_that_could_not_be_cut_is_kept(tmp_path, monkeypatch, renamed):
    from ground_service.ingest import live

    replace = live.replace_durably

    def broken(written, target):
        if renamed:
            replace(written, target)
        raise OSError(errno.EIO, "Input/output error")

    spool = Spool(tmp_path, lambda *_: {}, lambda *_: None)
    spool.open()
    spool.keep(b"first ")
    with monkeypatch.context() as patch:
        patch.setattr(live, "replace_durably", broken)
        with raises(OSError, match="Input/output"):
            spool.cut()
    assert spool.size == (0 if renamed else 6)
    spool.keep(b"second")
    spool.cut()
    assert b"".join(path.read_bytes() for path in sorted(tmp_path.glob("*.segment"))) == b"first second"


def test_a_link_that_could_not_be_opened_is_opened_later_with_its_spool_and_its_contact(
    ground, station, stream, monkeypatch, mission_time
):
    declare(ground, station.link())
    declared = service.declared_links(ground)["lab"]
    assert service.start_contact(ground, declared, mission_now_ns()) is not None
    folder = ground.home / "incoming/link-lab"
    folder.mkdir(parents=True)
    (folder / "000000000000.segment").write_bytes(stream)
    monkeypatch.setattr(store, "open_contact", failing(store.open_contact, {1, 2}))
    monkeypatch.setattr(service, "acquire", failing(service.acquire, {2}))
    with operated(ground) as runner:
        wait_for(lambda: runner.octets_received == len(stream), "the segment")
        mission_time.advance(100.0)
        wait_for(lambda: contact_events(ground)[-1] == "contact ended", "the end of the contact")
        assert runner.alive


def test_a_gap_in_the_ephemeris_is_a_reason_and_not_an_error(ground, station, tmp_path):
    declare(ground, PLACES + station.link('station = "here"'))
    parts = []
    for begin in 0, 7200:
        every = START + np.arange(begin, begin + 3601, 60, dtype=np.int64) * NS
        parts += ephemeris_from_states(every, *circular_states(every)).segments
    save_oem(Ephemeris(tuple(parts)), tmp_path / "gap.oem")
    add_ephemeris(ground, ground.files.put_file(tmp_path / "gap.oem"), name="with a gap", actor="ann")
    declared = service.declared_links(ground)["lab"]
    contacts, reason = service.predict(ground, declared, START, START + 10_000 * NS)
    assert contacts == () and reason is not None
    assert reason.startswith("reference ephemeris with a gap: ") and "expected an epoch within" in reason
    assert service.start_contact(ground, declared, START + 5000 * NS) is not None


def test_the_spool_is_locked_until_the_owner_that_lost_the_lease_has_ingested_it(ground, station, stream, monkeypatch):
    monkeypatch.setattr(runners, "RENEW_S", 0.1)
    declare(ground, station.link())
    entered, go_on = threading.Event(), threading.Event()
    with operated(ground, "first") as first:
        ingest = first._spool.ingest

        def slow(*given):
            entered.set()
            assert go_on.wait()
            return ingest(*given)

        first._spool.ingest = slow
        station.accept().sendall(stream[: 3 * CADU])
        assert entered.wait()
        declared = service.declared_links(ground)["lab"]
        while not service.acquire(ground, declared, "second", 60 * NS):
            service.release(ground, "lab", "first")  # which renews it all the time: it may have it back at once
        wait_for(lambda: first.lost, "the lost lease")
        second = LinkRunner(ground, declared, "second")
        threading.Event().wait(0.3)
        held_by_second = second._hold_spool()
        go_on.set()
        assert not held_by_second
        wait_for(second._hold_spool, "the lock")
        assert not list((ground.home / "incoming/link-lab").glob("*.segment"))
        assert first.octets_received == 3 * CADU
        second._lock.close()


def test_a_link_is_taken_at_once_from_an_owner_that_has_ended_and_not_from_others(ground, station):
    declare(ground, station.link())
    acquired(ground, "killed", lease_ns=70 * NS)
    supervisor = LinkSupervisor(ground)
    folder = ground.home / "incoming/link-lab"
    folder.mkdir(parents=True)
    held = folder / "lock"

    def is_taken():
        supervisor.look()
        return "lab" in supervisor.runners

    try:
        assert not is_taken()  # it never held the spool: it may be about to
        held.write_text("another")
        assert not is_taken()
        held.write_text("killed")
        with held.open() as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            assert not is_taken()
        assert is_taken() and service.get_link(ground, "lab").owner == supervisor.owner
        wait_for(lambda: held.read_text() == supervisor.owner, "the name of the next owner")
        assert ended_holder(ground.home, "lab") is None
    finally:
        supervisor.stop()
    assert held.read_text() == ""


def test_a_process_that_never_held_the_spool_ingests_nothing_of_it(ground, station, stream):
    declare(ground, station.link())
    folder = ground.home / "incoming/link-lab"
    folder.mkdir(parents=True)
    segment = folder / "000000000000.segment"
    segment.write_bytes(stream)
    with (folder / "lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with operated(ground):
            wait_for(lambda: "holds the spool" in (service.get_link(ground, "lab").reason or ""), "the reason")
        assert segment.exists()


def test_a_contact_ends_once_for_two_processes(either, station, monkeypatch):
    declare(either, station.link())
    declared = service.declared_links(either)["lab"]
    found = service.start_contact(either, declared, mission_now_ns())
    assert found is not None
    # Both have read the open contact before one of them writes.
    monkeypatch.setattr(store, "open_contact", lambda *_: found)
    service.end_contact(either, found.id, "lab", found.start_utc_ns + 5)
    service.end_contact(either, found.id, "lab", found.start_utc_ns + 9)
    assert contact_events(either) == ["contact started", "contact ended"]
    (row,) = either.read(store.contacts_between, 0, found.start_utc_ns + NS)
    assert (row.state, row.stop_utc_ns) == ("ended", found.start_utc_ns + 5)


def test_a_transmission_is_repeated_once_for_two_links(either, station, monkeypatch):
    declare(either, station.link())
    released(either)
    declared = acquired(either)
    (transmission,) = service.take_transmissions(either, declared, "here")
    service.note_transmitted(either, transmission, None)
    first = service.start_contact(either, declared, mission_now_ns())
    service.note_reception(either, "lab", first.id, 100, None, None)
    service.end_contact(either, first.id, "lab", mission_now_ns())
    contact = service.start_contact(either, declared, mission_now_ns())
    sent = either.read(store.transmitted_before, contact.vehicle_id, mission_now_ns(), 0, 3)
    monkeypatch.setattr(store, "transmitted_before", lambda *_: sent)
    assert service.repeat_unconfirmed(either, declared, contact) == 1
    assert service.repeat_unconfirmed(either, declared, contact) == 0
    assert len(service.take_transmissions(either, declared, "here")) == 1
    assert repeated(either) == 1


def repeated(ground):
    table = repository.AUDIT
    query = select(func.count()).where(table.c.action == "repeat transmission")
    with ground.database.reading() as connection:
        return int(connection.execute(query).scalar_one())


class Talking(Connector):
    """A station that sends without end."""

    received = 0

    def receive(self, timeout_s):
        type(self).received += 1
        assert self.received <= DISCARDED_BLOCKS
        return b"x"


def test_a_station_that_talks_without_end_on_the_uplink_does_not_stop_the_link():
    Talking(("localhost", 1)).discard_input()
    assert Talking.received == DISCARDED_BLOCKS


def stopping(*_):
    raise Stopping


def test_a_segment_whose_ingest_is_stopped_is_kept(tmp_path):
    seen = []
    spool = Spool(tmp_path, stopping, lambda _, result: seen.append(result))
    spool.open()
    spool.keep(b"octets")
    spool.cut()
    with raises(Stopping):
        spool.drain()
    assert seen == [] and len(list(tmp_path.glob("*.segment"))) == 1


def test_a_file_whose_ingest_is_stopped_is_read_again(tmp_path):
    (tmp_path / "in").mkdir()
    path = tmp_path / "in/pass.cadu"
    path.write_bytes(b"octets")
    seen = []
    folder = WatchedFolder(tmp_path / "in", tmp_path / "ledger.json", stopping, lambda _, result: seen.append(result))
    with raises(Stopping):
        folder.look(path.stat().st_mtime + 2 * SETTLED_S)
    assert seen == [] and not (tmp_path / "ledger.json").exists()
