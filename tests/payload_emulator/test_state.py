"""Exact states: views, known objects, refusals; stations that confirm transmissions, and their journal."""

import json
import os
import struct
from collections import Counter, deque
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pytest import mark, raises

from lunar.datafolder import DataFolder
from payload_emulator.errors import RecordError
from payload_emulator.flight.navigation.filter import filter as kalman
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.session.live.session import LiveSession
from payload_emulator.session.live.state import VERSION, load_state, pack_state, save_state, unpack_state
from payload_emulator.session.live.station_ports import JournalEntry, StationPorts, add_to_journal, load_journal
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.spacecraft.loading import launch
from payload_emulator.sim.board.platform import parse_fault
from tests.payload_emulator.test_continuous import SCENARIO
from tmtc.link.uplink import Farm


def kept(value):
    """Return a value as it comes back."""
    return unpack_state(pack_state("a", {"value": value}, {}), "a", {})["value"]


def test_views_stay_views_of_their_memory():
    memory = np.arange(24, dtype=np.uint8)
    found = kept({"software": [memory, memory[6:20:2]], "words": memory.view(np.uint16)[3:]})
    whole, ring = found["software"]
    assert np.array_equal(ring, memory[6:20:2])
    whole[6:8] = 255
    assert ring[0] == 255 and found["words"][0] == 65_535
    assert memory[6] == 6


@mark.parametrize(
    "value",
    [
        None, True, 2**200, 0.1 + 0.2, -0.0, float("inf"), "µ\n", b"\x00\xff", (1, (2,)), {1, 2}, frozenset({3}),
        {2.5: [1], "b": None}, deque([1, 2], maxlen=2), Counter("abba"),
        np.float32(0.1), np.arange(6).reshape(2, 3), np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.zeros((0, 7)), Farm(2, expected=9, lockout=True), {parse_fault("camera_dark at 3 for 5")}, PayloadMode.safe,
        kalman,
    ],
    ids=repr,
)  # fmt: skip
def test_a_value_comes_back_equal_and_of_its_type(value):
    found = kept([value, value])
    assert type(found[0]) is type(value) and repr(found[0]) == repr(value)
    if isinstance(value, np.ndarray):
        assert found[0].dtype == value.dtype and found[0].flags.fnc == value.flags.fnc
    if not isinstance(value, bool | int | float | str | None):
        assert found[0] is found[1]


def test_a_value_may_contain_itself_a_key_may_occur_again_and_random_numbers_go_on():
    value = {"list": []}
    value["list"].append(value)
    found = kept(value)
    assert found["list"][0] is found
    key = ("madrid", 1)
    value = {"by": {key: [key]}, "queue": deque([(key, b"octets")])}
    assert kept(value) == value
    generator = np.random.default_rng((3, 2**41))
    generator.integers(0, 9, 7, dtype=np.uint8)
    found = kept(generator)
    assert found.random(5).tolist() == generator.random(5).tolist()
    assert found.integers(0, 9, 5).tolist() == generator.integers(0, 9, 5).tolist()


def test_known_objects_are_those_of_the_reader():
    network, other = object(), object()
    octets = pack_state("a", {"one": [network]}, {"network": network})
    assert unpack_state(octets, "a", {"network": other})["one"] == [other]
    with raises(RecordError, match=r"found damage .*network"):
        unpack_state(octets, "a", {})


class Pair(NamedTuple):
    one: int


@mark.parametrize(
    "value",
    [lambda: None, Path("x"), Pair(1), np.array([None]), np.zeros(2, "i4,f8")],
    ids=lambda one: type(one).__name__,
)
def test_what_cannot_be_kept_is_refused_in_one_line(value):
    with raises(RecordError, match=r"state: expected .*, found"):
        pack_state("a", {"value": value}, {})


def test_the_state_of_another_scenario_or_version_is_refused():
    octets = pack_state("a", {"one": 1}, {})
    with raises(RecordError, match="expected the state of scenario b, found that of a"):
        unpack_state(octets, "b", {})
    other = octets.replace(f"version {VERSION}".encode(), b"version 1", 1)
    with raises(RecordError, match=f"expected version {VERSION} of the state, found 1"):
        unpack_state(other, "a", {})


def test_a_damaged_file_is_refused_with_its_name(tmp_path):
    path = tmp_path / "exact"
    assert load_state(path, "a", {}) is None
    save_state(path, "a", {"one": np.arange(40)}, {})
    whole = path.read_bytes()
    found = load_state(path, "a", {})
    assert found is not None and np.array_equal(found["one"], np.arange(40))
    assert [one.name for one in tmp_path.iterdir()] == ["exact"]
    begin = whole.index(b"\n") + 1
    cut = (whole[:length] for length in (0, 1, 20, begin - 1, begin, begin + 1, begin + 60, len(whole) - 1))
    places = (3, begin + 2, begin + 100, len(whole) - 2)
    for octets in (*cut, *(whole[:k] + bytes([whole[k] ^ 4]) + whole[k + 1 :] for k in places)):
        path.write_bytes(octets)
        with raises(RecordError, match=r"exact: expected the state of a spacecraft process .*, found"):
            load_state(path, "a", {})


def test_a_failure_while_writing_leaves_the_state_before(tmp_path, monkeypatch):
    path = tmp_path / "exact"
    save_state(path, "a", {"one": 1}, {})

    def fail(_):
        raise OSError("no space")

    monkeypatch.setattr(os, "fsync", fail)
    with raises(OSError):
        save_state(path, "a", {"one": 2}, {})
    assert load_state(path, "a", {}) == {"one": 1}


def sealed(root):
    """Return a document, and eight octets, with the header that fits."""
    body = json.dumps(root).encode() + b"\n" + bytes(range(8))
    return f"LINNA spacecraft state, version {VERSION}, SHA-256 {sha256(body).hexdigest()}\n".encode() + body


NODES = """
7
null
["list", 1]
["ref", 9]
["dict", ["one"]]
["dict", ["one", ["known", "x"]]]
["unknown"]
[]
["dict", ["one", ["object", "subprocess:Popen"]]]
["dict", ["one", ["module", "subprocess"]]]
["dict", ["one", ["object", "payload_emulator.session.live.state:Path"]]]
["dict", ["one", ["object", "payload_emulator.session.live.state:pack_state"]]]
["dict", ["one", ["object", "payload_emulator.session.live.state:json.JSONDecoder"]]]
["dict", ["one", ["object", "payload_emulator.session.none:Any"]]]
["dict", ["one", ["object", "payload_emulator.flight.onboard.modes:PayloadMode"]]]
["dict", ["one", ["enum", "tmtc.link.uplink:Farm", 1]]]
["dict", ["one", ["trajectory", ["dict"]]]]
["dict", ["one", ["array", "O", [1], "C", 0]]]
["dict", ["one", ["view", ["array", "|u1", [8], "C", 0], 0, [1], [8], "O"]]]
["dict", ["one", ["view", ["array", "|u1", [8], "C", 0], 4, [1], [8], "<i8"]]]
["dict", ["one", ["bytes", 1]]]
["dict", ["one", ["object", "tmtc.link.uplink:Farm", ["unknown", 1]]]]
"""


@mark.parametrize("node", NODES.strip().splitlines())
def test_another_document_with_a_fitting_checksum_is_refused_and_calls_nothing(node):
    with raises(RecordError, match="found damage"):
        unpack_state(sealed(["a", json.loads(node), [8]]), "a", {})


def test_a_document_names_octets_by_their_numbers_and_equal_ones_are_written_once():
    root = ["dict", ["one", ["list", ["bytes", 0], ["bytearray", 1]]]]
    assert unpack_state(sealed(["a", root, [3, 5]]), "a", {}) == {"one": [b"\0\1\2", b"\3\4\5\6\7"]}
    once = len(pack_state("a", {"one": bytes(50_000)}, {}))
    assert len(pack_state("a", {"one": bytes(50_000), "two": bytearray(50_000)}, {})) < once + 100


FIRST = JournalEntry(5, "madrid", 256, b"\x01\x02")
SECOND = JournalEntry(7, "canberra", 512, b"")


def test_a_journal_returns_its_entries_and_loses_an_incomplete_last_line(tmp_path):
    path = tmp_path / "journal"
    assert load_journal(path) == []
    add_to_journal(path, FIRST)
    with path.open("ab") as file:
        file.write(b'[7, "can')
    assert load_journal(path) == [FIRST]
    add_to_journal(path, SECOND)
    assert load_journal(path) == [FIRST, SECOND]


@mark.parametrize("line", [b"[1, 2]", b"text", b'[1, "a", 2, "0g"]'])
def test_a_line_that_is_no_entry_is_refused_with_its_number(tmp_path, line):
    path = tmp_path / "journal"
    add_to_journal(path, FIRST)
    with path.open("ab") as file:
        file.write(line + b"\n")
    with raises(RecordError, match="journal, line 2: expected time, station, number and octets"):
        load_journal(path)


class Replies:
    """Stands for the telecommand port of a station."""

    def __init__(self):
        self.clients = {1: "client"}
        self.sent = []

    def reply(self, number, octets):
        self.sent += struct.unpack(">Q", octets)

    def drop(self, client):
        self.clients.clear()

    def close(self):
        pass


def transmission(number, octets):
    return struct.pack(">QI", number, len(octets)) + octets


def test_a_station_sends_a_number_up_once_and_refuses_without_a_contact():
    sent_up = []
    has_contact = [True]

    def receive(number, octets):
        if has_contact[0]:
            sent_up.append((number, octets))
        return has_contact[0]

    station = StationPorts("madrid", "127.0.0.1", receive, keeps=True, taken={3})
    station.telecommand.close()
    replies = station.telecommand = Replies()
    for octet in transmission(256, b"abc") + transmission(3, b"known") + transmission(256, b"abc"):
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


def test_a_session_repeats_the_newer_transmissions_of_its_journal_at_their_times(tmp_path):
    epoch = parse_scenario(SCENARIO).epoch_utc_ns
    journal = tmp_path / "journal"
    for entry in (JournalEntry(epoch + 10, "madrid", 512, b"later"), JournalEntry(epoch, "madrid", 256, b"now")):
        add_to_journal(journal, entry)
    session = LiveSession(*launch(parse_scenario(SCENARIO), DataFolder(None)), keeps=True, journal_file=journal)
    contacts = session.contacts
    try:
        assert contacts.stations["madrid"].taken == {256, 512}
        contacts.repeat_journal(session.utc_ns)
        assert [octets for _, octets in contacts._uplink] == [b"now"] and contacts._sent_up == {256}
        session.utc_ns += 10
        contacts.repeat_journal(session.utc_ns)
        contacts.repeat_journal(session.utc_ns)
        assert [octets for _, octets in contacts._uplink] == [b"now", b"later"]
        # Without a contact nothing is taken, and nothing is written.
        assert not contacts.receive(lambda: session.utc_ns, "madrid", 768, b"new") and len(load_journal(journal)) == 2
    finally:
        session.close()


def test_a_clock_file_that_others_have_mapped_is_not_shortened(tmp_path):
    """A reader of the map would be ended by the kernel (SIGBUS) at that moment."""
    path = tmp_path / "clock"
    path.write_bytes(bytes(8) + b"further")
    session = LiveSession(*launch(parse_scenario(SCENARIO), DataFolder(None)), clock_file=path)
    session.close()
    assert path.read_bytes() == struct.pack("<q", session.utc_ns) + b"further"
