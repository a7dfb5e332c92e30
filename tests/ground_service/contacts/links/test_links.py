"""One link: reception without loss, contacts, transmission, takeover by another process, on both databases."""

import contextlib
import os
import socket
import struct
import threading
import time
from unittest.mock import MagicMock

import numpy as np
from pytest import approx, fixture, mark, raises
from sqlalchemy import select, update

from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.contacts.commanding.service import (
    enter_command,
    get_command,
    hold_spacecraft,
    release_command,
    resume_spacecraft,
)
from ground_service.contacts.links import service, store
from ground_service.contacts.links.runner import ACKNOWLEDGEMENT, TRANSMISSION, LinkRunner
from ground_service.errors import Conflict, NotFound
from ground_service.ground import open_ground
from ground_service.ingest.service import ingest_file
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.timekeeping import recorrelation
from ground_service.missions.timekeeping.recorrelation import spacecraft_correlations, spacecraft_time_reports
from ground_service.store import repository
from ground_service.store.event_kinds import read_events
from ground_service.store.vehicles import all_vehicles
from lunar.ephemeris import ephemeris_from_states
from lunar.messages.oem import save_oem
from lunar.timescales import ticks_from_utc_ns
from lunar.visibility import GroundStation, link
from tests.ground_service.archive_hash import archive_hash
from tests.ground_service.conftest import START, add_reference, circular_states
from tests.ground_service.contacts.links.conftest import Station, acquired, declare, operated
from tests.serving import wait_for
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import DownlinkEncoder
from tmtc.link.settings import LinkSettings
from tmtc.link.uplink import UplinkDecoder

CADU = 1279
SPACECRAFT = 76


def hash_of(ground):
    with ground.database.reading() as connection:
        known = [one.id for one in all_vehicles(connection) if one.instance == "flight"]
        return archive_hash(connection, known[0]) if known else ""


@fixture(scope="module")
def stream(synthetic_pass):
    return bytes((synthetic_pass.folder / "downlink.cadu").read_bytes())


@fixture(scope="module")
def expected(synthetic_pass, tmp_path_factory):
    with open_ground(tmp_path_factory.mktemp("whole")) as ground:
        ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
        return hash_of(ground)


def unsent(runner):
    return service.unsent(runner._ground, runner.declared)


def released(ground, count=1):
    keys = [enter_command(ground, "test_connection", {}, spacecraft_id=SPACECRAFT, actor="ann") for _ in range(count)]
    for key in keys:
        release_command(ground, key, actor="bob")
    return keys


def packets_of(octets):
    return list(UplinkDecoder(SPACECRAFT).decode(octets).packets)


def octets_of(ground, keys):
    return [bytes(get_command(ground, key).record.octets or b"") for key in keys]


def both_links(lab, other, more):
    return lab.link(more) + other.link(more).replace('"lab"', '"other"')


def sent_to(station):
    return packets_of(bytes(station.telecommands))


def wait_for_telecommands(ground, station, keys):
    wait_for(lambda: sent_to(station) == octets_of(ground, keys), f"the telecommands {keys}")


def wait_for_state(ground, state):
    wait_for(lambda: service.get_link(ground, "lab").state == state, f"the state {state}")


def received_of(ground):
    return service.get_link(ground, "lab").octets


def contact_events(ground):
    return [one.kind for one in read_events(ground.database, 0, 10_000) if one.kind.startswith("contact")]


def steps(runner):
    """Wait until the link has looked at what to send once more, from the beginning to the end."""
    for _ in range(3):
        before = runner._sent_s
        wait_for(lambda s=before: runner._sent_s > s, "the next look")


@mark.parametrize("cut", [1, 3, 4, CADU - 1, CADU, CADU + 1, 5 * CADU + 700, 9 * CADU + 2])
def test_a_connection_that_is_cut_at_any_octet_and_continued_loses_nothing(ground, station, stream, expected, cut):
    declare(ground, station.link())
    with operated(ground) as runner:
        first = station.accept()
        first.sendall(stream[:cut])
        first.close()
        second = station.accept()
        second.sendall(stream[cut:])
        wait_for(lambda: runner.octets_received >= len(stream) - CADU, "the archive")
        second.close()
        wait_for(lambda: hash_of(ground) == expected, "the same archive")
    assert service.get_link(ground, "lab").octets <= len(stream)


def test_parts_of_frames_are_ingested_as_they_arrive(ground, station, stream, expected):
    """The rest may never come; if it does, it has a position in the same recording."""
    declare(ground, station.link())
    with operated(ground):
        connection = station.accept()
        start = 0
        for stop in 700, 5 * CADU, 6 * CADU - 9, 6 * CADU, len(stream):
            connection.sendall(stream[start:stop])
            wait_for(lambda stop=stop: received_of(ground) == stop, f"{stop} octets in the archive")
            start = stop
    assert hash_of(ground) == expected
    with ground.database.reading() as connection_:
        pieces = connection_.execute(select(repository.PIECES).order_by(repository.PIECES.c.position)).all()
    assert len({one.stream for one in pieces}) == 1
    assert [one.position for one in pieces[1:]] == [one.position + one.octets for one in pieces[:-1]]


def test_each_contact_is_a_recording_unless_it_ends_within_a_frame(ground, station, stream, expected, mission_time):
    declare(ground, station.link())
    with operated(ground) as runner:
        connection = station.accept()
        start = 0
        for number, stop in enumerate((3 * CADU, 5 * CADU + 77, len(stream)), 1):
            connection.sendall(stream[start:stop])
            wait_for(lambda n=stop: runner.octets_received == n, f"{stop} octets")
            mission_time.advance(3600.0)
            wait_for(lambda n=number: contact_events(ground).count("contact ended") == n, f"contact {number}")
            start = stop
    assert hash_of(ground) == expected
    with ground.database.reading() as connection_:
        pieces = connection_.execute(select(repository.PIECES).order_by(repository.PIECES.c.ingest_id)).all()
    streams = list(dict.fromkeys(one.stream for one in pieces))
    assert [sum(one.octets for one in pieces if one.stream == name) for name in streams] == [
        3 * CADU,
        len(stream) - 3 * CADU,
    ]


def test_what_an_ended_process_has_left_in_its_spool_is_ingested_by_the_next(either, station, stream, expected):
    declare(either, station.link())
    folder = either.home / "incoming/link-lab"
    folder.mkdir(parents=True)
    (folder / "000000000003.segment").write_bytes(stream[: 4 * CADU + 9])
    (folder / "current").write_bytes(stream[4 * CADU + 9 :])
    with operated(either) as runner:
        wait_for(lambda: runner.octets_received == len(stream), "all octets")
    assert hash_of(either) == expected


def test_released_telecommands_are_sent_in_the_next_contact_and_not_before(either, station, stream, mission_time):
    declare(either, station.link())
    keys = released(either, 3)
    with operated(either) as runner:
        connection = station.accept()
        wait_for_state(either, "connected")
        steps(runner)
        assert not station.telecommands and unsent(runner) == 3
        connection.sendall(stream)
        wait_for_telecommands(either, station, keys)
        wait_for(lambda: unsent(runner) == 0, "the record of the transmission")
        wait_for(lambda: runner.octets_received == len(stream), "the telemetry")
        mission_time.advance(3600.0)
        wait_for(lambda: contact_events(either)[-1] == "contact ended", "the end of the contact")
        more = released(either)
        steps(runner)
        assert len(sent_to(station)) == 3
        connection.sendall(stream[: 2 * CADU])
        wait_for_telecommands(either, station, keys + more)
    assert contact_events(either).count("contact started") == 2
    ended = [one for one in read_events(either.database, 0, 10_000) if one.kind == "contact ended"]
    assert (ended[0].payload["octets"], ended[0].payload["telecommands"]) == (len(stream), 3)


def test_manual_links_send_on_request_only(ground, station, stream):
    declare(ground, station.link('send = "manual"'))
    with raises(Conflict, match="expected a process that operates it"):
        service.request_send(ground, "lab", actor="ann")
    keys = released(ground)
    with operated(ground) as runner:
        station.accept().sendall(stream[: 3 * CADU])
        wait_for_state(ground, "contact")
        steps(runner)
        assert not station.telecommands
        assert service.request_send(ground, "lab", actor="ann").unsent == 1
        wait_for_telecommands(ground, station, keys)
        later = released(ground)
        steps(runner)
        assert len(sent_to(station)) == 1
        assert get_command(ground, later[0]).state == "released"
    with raises(NotFound):
        service.request_send(ground, "other", actor="ann")


def taken_and_not_sent(ground, station):
    """Two telecommands that a process took and did not send; its lease of 1 ns has ended."""
    declare(ground, station.link())
    keys = released(ground, 2)
    declared = acquired(ground, "dead", lease_ns=1)
    assert len(service.take_transmissions(ground, declared, "dead")) == 1
    time.sleep(0.01)
    return keys, declared


def test_a_link_sends_nothing_of_a_spacecraft_on_hold_and_continues_after_it(either, station, stream):
    keys, declared = taken_and_not_sent(either, station)
    hold_spacecraft(either, 76, "flight", reason="antenna", actor="ann")
    assert service.take_transmissions(either, declared, "dead") == []
    with operated(either) as runner:
        station.accept().sendall(stream[: 3 * CADU])
        wait_for_state(either, "contact")
        steps(runner)
        assert not station.telecommands
        with raises(Conflict, match="link lab: spacecraft 76 is on hold"):
            service.request_send(either, "lab", actor="ann")
        resume_spacecraft(either, 76, "flight", actor="ann")
        wait_for_telecommands(either, station, keys)


def test_telecommands_taken_by_a_process_that_ended_are_sent_once_by_the_next(either, station, stream):
    keys, declared = taken_and_not_sent(either, station)
    assert service.take_transmissions(either, declared, "nobody") == service.take_transmissions(
        either, declared, "dead"
    )
    assert service.get_link(either, "lab").unconfirmed == 1
    with operated(either, "living") as runner:
        station.accept().sendall(stream[: 3 * CADU])
        wait_for_telecommands(either, station, keys)
        steps(runner)
        assert len(sent_to(station)) == 2
    assert service.get_link(either, "lab").unconfirmed == 0


def test_a_process_without_the_lease_takes_no_telecommands(either, station):
    declare(either, station.link())
    keys = released(either)
    declared = acquired(either, "first")
    assert not service.acquire(either, declared, "second", 15_000_000_000)
    assert service.take_transmissions(either, declared, "second") == []
    assert get_command(either, keys[0]).state == "released"
    service.release(either, "lab", "second")
    assert not service.acquire(either, declared, "second", 15_000_000_000)
    service.release(either, "lab", "first")
    assert service.acquire(either, declared, "second", 15_000_000_000)


def test_transmissions_without_a_sign_of_reception_are_repeated_in_the_next_contact(
    ground, station, stream, mission_time
):
    declare(ground, station.link())
    keys = released(ground)
    with operated(ground) as runner:
        connection = station.accept()
        for contact in range(service.REPEAT_ATTEMPTS + 1):
            rows = [stream[k * CADU : (k + 1) * CADU] for k in range(4 * contact, 4 * contact + 4)]
            connection.sendall(rows[0] + rows[1])
            wanted = min(contact + 1, service.REPEAT_ATTEMPTS)
            wait_for(lambda n=wanted: len(sent_to(station)) == n, "the transmission")
            wait_for(lambda: not ground.read(store.pending_transmissions, "lab"), "the record of the transmission")
            mission_time.advance(0.1)
            connection.sendall(rows[2] + rows[3])  # telemetry from after the transmission
            received = 4 * (contact + 1) * CADU
            wait_for(lambda n=received: runner.octets_received == n, "the telemetry")
            mission_time.advance(3600.0)
            wait_for(lambda n=contact: contact_events(ground).count("contact ended") == n + 1, "the end of the contact")
        sent = sent_to(station)
    assert sent == octets_of(ground, keys) * service.REPEAT_ATTEMPTS


class Socket:
    """A connection that returns what the test has put in, or nothing."""

    connected = True
    fault = None

    def __init__(self):
        self.blocks = []

    def connect(self):
        return True

    def receive(self, _seconds):
        return self.blocks.pop(0) if self.blocks else None

    def close(self):
        pass


def test_octets_that_are_read_late_are_no_silence(ground, station, stream, mission_time):
    """A process that was held up finds octets of the whole time: their contact goes on, and no frame is cut."""
    declare(ground, station.link())
    runner, line = LinkRunner(ground, acquired(ground, "me", lease_ns=3_600_000_000_000), "me"), Socket()
    ingesting = threading.Thread(target=runner._ingest_all, daemon=True)
    try:
        runner._open()
        ingesting.start()
        runner._down = line
        line.blocks = [stream[: 2 * CADU + 100]]
        runner._receive()
        mission_time.advance(3600.0)
        line.blocks = [stream[2 * CADU + 100 : 4 * CADU]]
        runner._receive()
        runner._follow_contact()
        assert contact_events(ground) == ["contact started"]
        mission_time.advance(3600.0)
        runner._receive()  # finds nothing

        def ended():
            runner._follow_contact()
            return contact_events(ground) == ["contact started", "contact ended"]

        wait_for(ended, "the end of the contact")
    finally:
        runner._stopping.set()
        runner._cut_all.set()
        runner._work.set()
        ingesting.join()
        runner._spool.cut()
        runner._spool.drain()
        if runner._lock is not None:
            runner._lock.close()


def test_expired_telecommands_are_not_sent(ground, station, stream):
    declare(ground, station.link())
    late, timely = released(ground, 2)
    with ground.database.writing() as connection:
        for key, before in (late, mission_now_ns() - 1), (timely, mission_now_ns() + 10**12):
            repository.change(connection, repository.TELECOMMANDS, key, send_before_utc_ns=before)
    with operated(ground) as runner:
        station.accept().sendall(stream[: 3 * CADU])
        wait_for_telecommands(ground, station, [timely])
        wait_for(lambda: unsent(runner) == 0, "the record of the transmission")
    assert get_command(ground, late).state == "released"


def records(stream, utc_ns):
    rows = [stream[at : at + CADU] for at in range(0, len(stream), CADU)]
    return b"".join(struct.pack(">q", utc_ns) + row for row in rows)


@mark.parametrize("hours", [0, 1, -1])
def test_a_wrong_clock_of_the_station_is_reported_and_nothing_is_lost(ground, station, stream, expected, hours):
    declare(
        ground,
        '[link]\nframe_length = 1115\ncoding = "rs"\nrandomiser = "legacy"\nframe_checksum = true\n'
        '[link.stations.madrid]\nheader_octets = 8\ntime_code = "unix_ns"\ntime_offset = 0\n'
        + station.link('station = "madrid"'),
    )
    with operated(ground):
        station.accept().sendall(records(stream, utc_now_ns() + hours * 3600 * 10**9))
        wait_for(lambda: hash_of(ground) == expected, "the same archive")
        wait_for(lambda: service.get_link(ground, "lab").clock_offset_s is not None, "the offset")
        link = service.get_link(ground, "lab")
    assert link.clock_offset_s == approx(hours * 3600, abs=PATIENCE_OF_CLOCK_S)
    assert (link.reason is not None and "the clock of the station differs" in link.reason) == bool(hours)


PATIENCE_OF_CLOCK_S = 20.0


def test_states_say_why_a_link_waits(ground, station):
    declare(ground, station.link())
    assert service.get_link(ground, "lab").reason == "no process operates it"
    station.down.close()
    with operated(ground):
        wait_for(lambda: "refused" in (service.get_link(ground, "lab").reason or ""), "the reason")
        assert service.get_link(ground, "lab").state == "waiting"


def test_a_link_that_is_not_to_reconnect_fails_when_the_station_closes(ground, station, stream):
    declare(ground, station.link("reconnect = false"))
    with operated(ground):
        connection = station.accept()
        connection.sendall(stream[: 3 * CADU])
        connection.close()
        wait_for_state(ground, "failed")
        assert service.get_link(ground, "lab").reason == "closed by the station"


def arrive(path, octets):
    """Let a file appear whole, which has not changed for long."""
    outside = path.parents[1] / "written"
    outside.write_bytes(octets)
    os.utime(outside, (1, 1))
    outside.rename(path)


def test_folders_are_watched_and_telecommands_written(ground, tmp_path, stream, expected):
    incoming, outgoing = tmp_path / "in", tmp_path / "out"
    declare(ground, f'[[links]]\nname = "lab"\nkind = "file"\ndownlink = "{incoming}"\nuplink = "{outgoing}"\n')
    with operated(ground) as runner:
        wait_for(lambda: "expected a folder" in (service.get_link(ground, "lab").reason or ""), "the reason")
        incoming.mkdir()
        outgoing.mkdir()
        arrive(incoming / "pass.cadu", stream)
        keys = released(ground, 2)
        wait_for(lambda: list(outgoing.glob("*.cltu")), "the file")
        wait_for(lambda: runner.octets_received == len(stream), "the telemetry")
        assert hash_of(ground) == expected
    assert [path.name for path in outgoing.iterdir()] == ["lab-00000001.cltu"]
    assert packets_of((outgoing / "lab-00000001.cltu").read_bytes()) == octets_of(ground, keys)
    assert contact_events(ground) == ["contact started", "contact ended"]


def test_the_file_is_not_read_again_by_the_next_process(ground, tmp_path, stream):
    declare(ground, f'[[links]]\nname = "lab"\nkind = "file"\ndownlink = "{tmp_path}/in"\n')
    (tmp_path / "in").mkdir()
    arrive(tmp_path / "in/pass.cadu", stream)
    with operated(ground) as runner:
        wait_for(lambda: runner.octets_received == len(stream), "the telemetry")
    with operated(ground, "another") as runner:
        arrive(tmp_path / "in/next.cadu", stream[: 2 * CADU])
        wait_for(lambda: runner.octets_received, "the next file")
        assert runner.octets_received == 2 * CADU


@mark.parametrize("share, missed", [(1.0, 0), (0.3, 1)])
def test_a_contact_in_which_another_station_received_is_not_missed(
    ground, station, synthetic_pass, mission_time, share, missed
):
    declare(ground, PLACES + both_links(station, station, 'station = "here"'))
    add_reference(ground, synthetic_pass.folder / "reference.oem")
    lab, other = (acquired(ground, "me", name) for name in ("lab", "other"))
    mission_time.utc_ns = START - 500 * 10**9
    (contact, _) = service.list_contacts(ground, mission_time.utc_ns, START + 1000 * 10**9).contacts
    start, stop = contact.start.utc_ns, contact.stop.utc_ns
    mission_time.utc_ns = start
    row = service.start_contact(ground, other, start)
    service.end_contact(ground, row.id, "other", start + round(share * (stop - start)))
    mission_time.utc_ns = stop + service.MARGIN_NS + 2 * 10**9
    assert service.note_missed(ground, lab, "me", mission_time.utc_ns, "nothing was received") == missed


def test_missed_contacts_are_recorded_once_with_the_reason(either, station, synthetic_pass, mission_time):
    declare(either, PLACES + station.link('station = "here"'))
    add_reference(either, synthetic_pass.folder / "reference.oem")
    mission_time.utc_ns = START - 500 * 10**9
    found = service.list_contacts(either, START - 500 * 10**9, START + 1000 * 10**9)
    assert found.unpredicted == {} and [one.state for one in found.contacts] == ["predicted"]
    (contact,) = found.contacts
    declared = acquired(either)
    assert service.note_missed(either, declared, "here", contact.start.utc_ns, "nothing was received") == 0
    after = contact.stop.utc_ns + service.MARGIN_NS + 2 * 10**9
    assert service.note_missed(either, declared, "other", after, "nothing was received") == 0
    # looked at every half minute, as a link does, the whole contact counts
    times = range(contact.start.utc_ns, after + 120 * 10**9, 30 * 10**9)
    counts = [service.note_missed(either, declared, "here", t, "nothing was received") for t in times]
    assert sum(counts) == 1 and counts[[t >= after for t in times].index(True)] == 1
    (missed,) = service.list_contacts(either, START - 500 * 10**9, START + 1000 * 10**9).contacts
    assert (missed.state, missed.reason) == ("missed", "nothing was received")
    assert missed.predicted_start.utc_ns <= contact.start.utc_ns
    assert abs(missed.predicted_stop.utc_ns - contact.stop.utc_ns) <= 10**9
    assert contact_events(either) == ["contact missed"]


PLACES = """[link.stations.here]
latitude_deg = -20.0
longitude_deg = 120.0
minimum_elevation_deg = 0.0
"""


def test_contacts_without_a_place_or_an_ephemeris_are_not_predicted(ground, station):
    now = mission_now_ns()
    for section, reason in (
        (station.link(), "the mission description states no place of the station"),
        (PLACES + station.link('station = "here"'), "no reference ephemeris covers the time"),
    ):
        declare(ground, section)
        assert service.list_contacts(ground, now, now + 10**12).unpredicted == {"lab": reason}


def test_the_lease_is_kept_while_the_link_is_operated(ground, station):
    declare(ground, station.link())
    with operated(ground):
        first = ground.read(store.find_link, "lab")
        wait_for(lambda: ground.read(store.find_link, "lab").lease_utc_ns > first.lease_utc_ns, "a longer lease")
        assert service.get_link(ground, "lab").owner == "here"
    assert service.get_link(ground, "lab").owner is None


def test_after_a_standstill_the_state_is_what_the_process_sees(either, station):
    """Another process had the link meanwhile, and gave it back."""
    declare(either, station.link())
    with operated(either) as runner:
        station.accept()
        wait_for_state(either, "connected")
        lost = {"owner": None, "lease_utc_ns": 0, "state": "waiting"}
        with either.database.writing() as connection:
            connection.execute(update(repository.LINKS).values(**lost))
        runner._renewed_s -= 25.0
        wait_for_state(either, "connected")


class Confirming(Station):
    """A station that confirms transmissions: `answers` are given first (None: the connection is closed)."""

    def __init__(self, *answers):
        self.answers = list(answers)
        self.transmissions = []
        super().__init__()

    def _read(self, connection):
        with contextlib.suppress(OSError):
            while head := connection.recv(TRANSMISSION.size, socket.MSG_WAITALL):
                number, length = TRANSMISSION.unpack(head)
                self.transmissions.append((number, connection.recv(length, socket.MSG_WAITALL)))
                answer = self.answers.pop(0) if self.answers else number
                if answer is None:
                    connection.shutdown(socket.SHUT_RDWR)
                    return
                connection.sendall(ACKNOWLEDGEMENT.pack(answer))


@mark.parametrize("answer", [0, 5, None])
def test_a_transmission_is_repeated_with_its_number_until_the_station_confirms_it(either, confirming, stream, answer):
    station = confirming(answer, answer)
    declare(either, station.link("confirm = true"))
    keys = released(either, 2)
    with operated(either) as runner:
        station.accept().sendall(stream[: 2 * CADU])
        wait_for(lambda: unsent(runner) == 0, "the record of the transmission")
    numbers, octets = zip(*station.transmissions, strict=True)
    assert len(numbers) == 3 and len(set(numbers)) == 1 and numbers[0] > 0
    assert packets_of(octets[-1]) == octets_of(either, keys)


def test_a_transmission_that_a_station_refuses_is_sent_by_the_link_in_contact(either, confirming, stream, mission_time):
    """At a handover the link of the first station does not know yet that its contact has ended."""
    first, second = confirming(*[0] * 1000), confirming()
    declare(either, both_links(first, second, "confirm = true"))
    other = LinkRunner(either, acquired(either, "there", "other", 15_000_000_000), "there")
    with operated(either) as runner:
        other.start()
        try:
            first.accept().sendall(stream[: 2 * CADU])
            wait_for(lambda: either.read(store.open_contact, "lab"), "the first contact")
            keys = released(either, 2)
            wait_for(lambda: first.transmissions, "the refused transmission")
            # Also when its contact has ended, the station is asked.
            mission_time.advance(100.0)
            wait_for(lambda: either.read(store.open_contact, "lab") is None, "the end of the first contact")
            assert not second.transmissions and unsent(runner) == 2
            second.accept().sendall(stream[2 * CADU : 4 * CADU])
            wait_for(lambda: unsent(runner) + unsent(other) == 0, "the transmission")
        finally:
            other.stop()
    ((_, octets),) = second.transmissions
    assert packets_of(octets) == octets_of(either, keys)
    assert len({number for number, _ in first.transmissions + second.transmissions}) == 1
    with either.database.reading() as connection:
        query = select(repository.AUDIT.c.detail).where(repository.AUDIT.c.action == "hand over transmission")
        (detail,) = connection.execute(query).scalars()
    assert detail == {"telecommands": keys, "from": "lab", "to": "other"}


@fixture
def confirming():
    """Make stations that confirm."""
    made = []
    yield lambda *answers: made.append(Confirming(*answers)) or made[-1]
    for one in made:
        one.close()


def held_elsewhere(ground, station):
    """Telecommands that the link "other" has taken and not sent, and later ones that any link may take."""
    declare(ground, both_links(station, station, "confirm = true"))
    other = acquired(ground, "there", "other", 15_000_000_000)
    earlier = released(ground, 2)
    (transmission,) = service.take_transmissions(ground, other, "there")
    return transmission, earlier, released(ground, 2)


def test_telecommands_do_not_overtake_those_that_another_link_has(either, confirming, stream):
    """At a handover the payload would refuse the overtaken ones as out of sequence."""
    station = confirming()
    transmission, earlier, later = held_elsewhere(either, station)
    with operated(either) as runner:
        station.accept().sendall(stream[: 2 * CADU])
        wait_for(lambda: runner._waits_s is not None, "telecommands that wait")
        assert not station.transmissions
        other = service.declared_links(either)["other"]
        assert service.hand_over(either, other, transmission) == "lab"
        wait_for(lambda: unsent(runner) == 0, "both transmissions")
        assert runner._waits_s is None
    assert [packets_of(octets) for _, octets in station.transmissions] == [
        octets_of(either, earlier),
        octets_of(either, later),
    ]


def test_telecommands_do_not_wait_for_ever_for_those_of_another_link(either, confirming, stream, monkeypatch):
    monkeypatch.setattr("ground_service.contacts.links.runner.TURN_S", 0.0)
    log = MagicMock()
    monkeypatch.setattr("ground_service.contacts.links.runner.log", log)
    station = confirming()
    transmission, _, later = held_elsewhere(either, station)
    with operated(either) as runner:
        station.accept().sendall(stream[: 2 * CADU])
        wait_for(lambda: unsent(runner) == 0, "the later telecommands")
    assert [packets_of(octets) for _, octets in station.transmissions] == [octets_of(either, later)]
    assert [one.id for one in either.read(store.pending_transmissions, "other")] == [transmission.id]
    assert log.warning.call_args.args[1:] == ("lab", later, "other")


@mark.parametrize(
    "change",
    [
        ('format = "packets"', ""), ('send = "manual"', ""), ('instance = "twin"', ""), ("", "released"),
        ("", "ended"),
    ],
)  # fmt: skip
def test_a_refused_transmission_is_given_to_no_link_that_cannot_send_it(either, station, change):
    section, event = change
    declare(either, station.link() + station.link(section).replace('"lab"', '"other"'))
    released(either)
    lab, other = (acquired(either, name=name) for name in ("lab", "other"))
    for one in lab, other:
        assert service.start_contact(either, one, utc_now_ns()) is not None
    (transmission,) = service.take_transmissions(either, lab, "here")
    if event == "released":
        service.release(either, "other", "here")
    elif event == "ended":
        contact = either.read(store.open_contact, "other")
        service.end_contact(either, contact.id, "other", utc_now_ns())
    assert service.hand_over(either, lab, transmission) is None
    assert [one.id for one in either.read(store.pending_transmissions, "lab")] == [transmission.id]


def test_the_next_owner_knows_when_a_contact_last_received_telemetry(either, station, stream, mission_time):
    """Mission time may stand still then: counted from the start of the process, the silence would never end."""
    declare(either, station.link())
    with operated(either) as runner:
        station.accept().sendall(stream)
        wait_for(lambda: runner.octets_received == len(stream), "all octets")
    assert either.read(store.open_contact, "lab") is not None
    mission_time.advance(100.0)
    assert service.silent_contacts(either) == ["lab"]
    with operated(either, "next"):
        station.accept()
        wait_for(lambda: either.read(store.open_contact, "lab") is None, "the end of the contact")
    assert service.silent_contacts(either) == []


NS = 1_000_000_000
REPORTS = 30
OFFSET_S, DRIFT = 0.4, 5e-6
TICK_NS = 15_259
PLACE = GroundStation("lab", np.radians(40.0), np.radians(100.0), 500.0, 0.0)
"""A station that only the mission description knows."""

MISSION = """
[link]
frame_length = 1115
coding = "rs"
randomiser = "legacy"
frame_checksum = true
[link.stations.lab]
latitude_deg = 40.0
longitude_deg = 100.0
height_m = 500.0
header_octets = 8
time_code = "unix_ns"
time_offset = 0
"""


@fixture(scope="module")
def orbit():
    every = START + np.arange(-1800, 7200, 60, dtype=np.int64) * NS
    return ephemeris_from_states(every, *circular_states(every))


def downlink(orbit, station_clock_ns):
    """Return records with a time report every two minutes, each sent when it was made, of a clock that drifts."""
    encoder = DownlinkEncoder(76, LinkSettings())
    records = b""
    for k in range(REPORTS):
        received = START + k * 120 * NS
        light_s = float(link(orbit, np.array([received]), PLACE).light_time_s[0])
        sent = received - round(light_s * NS)
        error_s = OFFSET_S + DRIFT * (sent - START) / NS
        ticks = int(ticks_from_utc_ns(sent)) + round(error_s * 65_536)
        values = {"reported_ticks": ticks, "rate_exponent": 4}
        packet = DICTIONARY.pack("time_report", values, ticks=ticks, sequence_count=k)
        records += struct.pack(">q", received + station_clock_ns) + encoder.encode([packet])
    return records


@mark.parametrize("station_clock_s", [0, 3600, -3600])
def test_the_clock_is_correlated_from_time_reports_of_a_link(
    either, station, orbit, tmp_path, monkeypatch, station_clock_s
):
    save_oem(orbit, tmp_path / "orbit.oem")
    add_ephemeris(either, either.files.put_file(tmp_path / "orbit.oem"), name="orbit")
    declare(either, MISSION + station.link('station = "lab"'))
    octets = downlink(orbit, station_clock_s * NS)
    with operated(either) as runner:
        station.accept().sendall(octets)
        wait_for(lambda: runner.octets_received == len(octets), "the telemetry")
        wait_for(lambda: service.get_link(either, "lab").octets == len(octets), "its account")
    rows = [one for one in spacecraft_correlations(either, 76, "flight") if one.in_force]
    reports = spacecraft_time_reports(either, 76, "flight")
    if station_clock_s:
        assert rows == [] and reports == []
        return
    (line,) = rows
    assert (line.points, line.rejected, line.method) == (REPORTS, 0, "time reports, light time")
    # The clock is fast by 5 ppm: a tick over an hour is 4 ppb.
    assert line.drift_ppb == approx(-1e9 * DRIFT, abs=10.0)
    assert 0.0 < line.residual_rms_ns < line.residual_max_ns < 2 * TICK_NS
    assert {one.station for one in reports} == {"lab"}
    assert max(abs(one.residual_ns) for one in reports) < 2 * TICK_NS
    # The light times are kept; the ephemeris need not be.
    monkeypatch.delattr(recorrelation, "_load")
    assert spacecraft_time_reports(either, 76, "flight") == reports
