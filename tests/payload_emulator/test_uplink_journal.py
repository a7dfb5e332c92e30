"""Stations that confirm transmissions, and the journal that a killed session repeats them from."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from lunar.datafolder import DataFolder
from payload_emulator.errors import RecordError
from payload_emulator.session.live.session import LiveSession
from payload_emulator.session.live.station_ports import (
    JournalEntry,
    StationPorts,
    add_to_journal,
    load_journal,
)
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.spacecraft.loading import launch
from tests.payload_emulator.test_continuous import SCENARIO

FIRST = JournalEntry(5, "madrid", 256, b"\x01\x02")
SECOND = JournalEntry(7, "canberra", 512, b"")


def test_a_journal_returns_its_entries_and_loses_an_incomplete_last_line(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    assert load_journal(path) == []
    add_to_journal(path, FIRST)
    with path.open("ab") as file:
        file.write(b'[7, "can')
    assert load_journal(path) == [FIRST]
    add_to_journal(path, SECOND)
    assert load_journal(path) == [FIRST, SECOND]


@pytest.mark.parametrize("line", [b"[1, 2]", b"text", b'[1, "a", 2, "0g"]'])
def test_a_line_that_is_no_entry_is_refused_with_its_number(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "journal"
    add_to_journal(path, FIRST)
    with path.open("ab") as file:
        file.write(line + b"\n")
    with pytest.raises(RecordError, match="journal, line 2: expected time, station, number and octets"):
        load_journal(path)


class Replies:
    """Stands for the telecommand port of a station."""

    def __init__(self) -> None:
        self.clients = {1: "client"}
        self.sent: list[int] = []

    def reply(self, number: int, octets: bytes) -> None:
        self.sent += struct.unpack(">Q", octets)

    def drop(self, client: str) -> None:
        self.clients.clear()

    def close(self) -> None:
        pass


def transmission(number: int, octets: bytes) -> bytes:
    return struct.pack(">QI", number, len(octets)) + octets


def test_a_station_sends_a_number_up_once_and_refuses_without_a_contact() -> None:
    sent_up: list[tuple[int, bytes]] = []
    has_contact = [True]

    def receive(number: int, octets: bytes) -> bool:
        if has_contact[0]:
            sent_up.append((number, octets))
        return has_contact[0]

    station = StationPorts("madrid", "127.0.0.1", receive, keeps=True, taken={3})
    station.telecommand.close()
    replies = station.telecommand = Replies()
    stream = transmission(256, b"abc") + transmission(3, b"known") + transmission(256, b"abc")
    for octet in stream:
        station._take(1, bytes([octet]))
    assert sent_up == [(256, b"abc")] and replies.sent == [256, 3, 256]
    has_contact[0] = False
    station._take(1, transmission(512, b"later"))
    assert replies.sent[-1] == 0 and len(sent_up) == 1
    has_contact[0] = True
    station._take(1, transmission(512, b"later") + transmission(513, b""))
    assert replies.sent[-2:] == [512, 513] and sent_up[1] == (512, b"later")
    station._take(1, struct.pack(">QI", 514, 1 << 30))
    assert not replies.clients
    station.close()


def test_a_session_repeats_the_newer_transmissions_of_its_journal_at_their_times(tmp_path: Path) -> None:
    epoch = parse_scenario(SCENARIO).epoch_utc_ns
    journal = tmp_path / "journal"
    later = JournalEntry(epoch + 10, "madrid", 512, b"later")
    for entry in (later, JournalEntry(epoch, "madrid", 256, b"now")):
        add_to_journal(journal, entry)
    session = LiveSession(
        *launch(parse_scenario(SCENARIO), DataFolder(None)), keeps=True, journal_file=journal
    )
    try:
        assert session.stations["madrid"].taken == {256, 512}
        session._repeat_journal()
        assert [octets for _, octets in session._uplinked] == [b"now"] and session._sent_up == {256}
        session.utc_ns += 10
        session._repeat_journal()
        session._repeat_journal()
        assert [octets for _, octets in session._uplinked] == [b"now", b"later"]
        # Without a contact nothing is taken, and nothing is written.
        assert not session._take_telecommands("madrid", 768, b"new") and len(load_journal(journal)) == 2
    finally:
        session.close()


def test_a_clock_file_that_others_have_mapped_is_not_shortened(tmp_path: Path) -> None:
    """A reader of the map would be ended by the kernel (SIGBUS) at that moment."""
    path = tmp_path / "clock"
    path.write_bytes(bytes(8) + b"further")
    session = LiveSession(*launch(parse_scenario(SCENARIO), DataFolder(None)), clock_file=path)
    session.close()
    assert path.read_bytes() == struct.pack("<q", session.utc_ns) + b"further"
