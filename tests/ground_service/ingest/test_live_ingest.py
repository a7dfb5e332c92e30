"""Telemetry in a spool and as files that appear: every packet once, also after a crash; reception times."""

import os
import struct
from itertools import pairwise

import numpy as np
from pytest import fixture, mark, raises
from sqlalchemy import event

from ground_service.errors import InvalidInput, StorageFull
from ground_service.ground import open_ground
from ground_service.ingest import store
from ground_service.ingest.core import NO_TIME, LinkContent, RecordFormat
from ground_service.ingest.frames import FrameReader, Section
from ground_service.ingest.link_settings import known_before
from ground_service.ingest.live import Spool, WatchedFolder
from ground_service.ingest.recording_store import Piece
from ground_service.ingest.service import PiecePosition, ingest_file
from ground_service.missions.service import add_mission
from ground_service.store.event_kinds import read_events
from ground_service.store.repository import RECEPTIONS
from ground_service.store.vehicles import vehicle_id
from ground_service.telemetry.packets import CLOCKS_AGREE_NS, batch_of_cut, time_receptions
from lunar.timescales import parse_utc, ticks_from_utc_ns
from tests.ground_service.archive_hash import hash_of
from tmtc.arrays import as_octets
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.link.frames import FRAME_HEADER_LENGTH
from tmtc.link.settings import LinkSettings
from tmtc.packets.space_packets import CRC_LENGTH
from tmtc.packets.stream import cut_packets


@fixture
def expected(synthetic_pass, tmp_path):
    with open_ground(tmp_path / "whole") as ground:
        ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
        return hash_of(ground)


@fixture
def stream(synthetic_pass):
    return bytes((synthetic_pass.folder / "downlink.cadu").read_bytes())


def spool_of(ground, seen):
    def ingest(path, recording, offset):
        return {"packets_new": ingest_file(ground, path, place=PiecePosition(recording, offset)).packets_new}

    return Spool(ground.home / "spool", ingest, lambda _path, result: seen.append(result))


def take(spool, octets):
    spool.keep(octets)
    spool.cut()
    spool.drain()


def test_segments_cut_at_any_octet_are_pieces_of_one_recording(ground, stream, expected):
    spool = spool_of(ground, seen := [])
    assert spool.open() == 0
    for start, stop in pairwise([0, 700, 4 * 1279 + 300, 4 * 1279 + 301, len(stream)]):
        take(spool, stream[start:stop])
    assert len(seen) == 4
    assert hash_of(ground) == expected
    spool.begin()
    assert list((ground.home / "spool").iterdir()) == []


@mark.parametrize("drained", [False, True])
def test_the_recording_of_a_run_that_crashed_goes_on(ground, stream, expected, drained):
    """Also if all its segments are ingested."""
    crashed = spool_of(ground, [])
    crashed.open()
    for octets in (stream[:2000], stream[2000:3000]):
        crashed.keep(octets)
        crashed.cut()
        if drained:
            crashed.drain()
    if not drained:
        crashed.keep(stream[3000:4000])
        crashed._stream.close()
    spool = spool_of(ground, [])
    assert spool.open() == (0 if drained else 4000)
    spool.drain()
    take(spool, stream[3000 if drained else 4000 :])
    assert hash_of(ground) == expected


def test_the_segments_of_a_version_without_recordings_are_consecutive(ground, stream, expected):
    folder = ground.home / "spool"
    folder.mkdir()
    (folder / "000000000004.segment").write_bytes(stream[:700])
    (folder / "000000000005.segment").write_bytes(stream[700:3000])
    (folder / "current").write_bytes(stream[3000:])
    spool = spool_of(ground, [])
    assert spool.open() == len(stream)
    spool.drain()
    assert hash_of(ground) == expected


def test_a_segment_stays_in_the_spool_while_the_store_is_full(stream, tmp_path):
    def full(*_):
        raise StorageFull("here")

    spool = Spool(tmp_path, full, lambda *_: None)
    spool.open()
    with raises(StorageFull):
        take(spool, stream)
    assert b"".join(path.read_bytes() for path in tmp_path.glob("*.segment")) == stream


def test_noise_is_part_of_the_recording_and_an_unknown_coding_does_not_stop_the_rest(ground, stream, expected):
    spool = spool_of(ground, seen := [])
    spool.open()
    markers = bytes.fromhex("1ACFFC1D") + np.random.default_rng(1).bytes(1275)
    for octets in (b"\x00" * 5000, 40 * markers, stream):
        take(spool, octets)
    assert seen[:2] == [{"packets_new": 0}] * 2
    assert hash_of(ground) == expected


def test_files_that_appear_are_ingested_once_when_they_are_whole(tmp_path):
    folder, seen = tmp_path / "in", []
    folder.mkdir()

    def watched():
        return WatchedFolder(
            folder, tmp_path / "ledger.json", lambda path: {"file": path.name}, lambda p, r: seen.append(r)
        )

    for name in ("a.cadu", "b.cadu", "c.part", ".hidden"):
        (folder / name).write_bytes(b"x")
        os.utime(folder / name, (1000.0 - 100.0 * (name[0] != "b"),) * 2)
    assert watched().look(1000.0) == 1
    assert watched().look(1010.0) == 1  # the second one has settled; another process remembers the first
    assert watched().look(1020.0) == 0
    (folder / "a.cadu").write_bytes(b"longer")
    os.utime(folder / "a.cadu", (1020.0, 1020.0))
    assert watched().look(1030.0) == 1
    assert [one["file"] for one in seen] == ["a.cadu", "b.cadu", "a.cadu"]
    with raises(InvalidInput, match="expected a folder to watch"):
        WatchedFolder(tmp_path / "no", tmp_path / "l", lambda _: {}, lambda *_: None).look(0.0)


NS = 1_000_000_000
START = parse_utc("2029-08-07T06:00:00Z")
SETTINGS = LinkSettings().explicit
RECORD = RecordFormat(header_octets=8, time_code="unix_ns")


def report(ticks, count):
    values = {"reported_ticks": ticks, "rate_exponent": 4}
    return DICTIONARY.pack("time_report", values, ticks=ticks, sequence_count=count)


def batch_of(packets, received):
    octets = b"".join(packets)
    return batch_of_cut(octets, cut_packets(octets), DICTIONARY, 76, received)


@mark.parametrize("window_octets", [1 << 20, 3_000])
def test_a_packet_has_the_reception_time_of_the_frame_in_which_it_begins(window_octets):
    ticks = int(ticks_from_utc_ns(START))
    packets = [report(ticks + k, k) for k in range(400)]
    cadus = encode_cadus(packets, spacecraft_id=76)
    length = SETTINGS.cadu_length
    rows = [cadus[at : at + length] for at in range(0, len(cadus), length)]
    times = START + np.arange(len(rows), dtype=np.int64) * NS
    stream = b"".join(struct.pack(">q", time) + row for time, row in zip(times.tolist(), rows, strict=True))
    section = Section(SETTINGS, 0, len(stream), 0, len(stream))
    reader = FrameReader(section, SETTINGS, LinkContent(), spacecraft_id=76, record=RECORD)
    blocks = [stream[at : at + window_octets] for at in range(0, len(stream), window_octets)]
    found = {}
    for batch in reader.batches((as_octets(one), one is blocks[-1]) for one in blocks):
        found |= dict(zip(batch.sequence_count.tolist(), batch.received_utc_ns.tolist(), strict=True))
    starts = np.cumsum([0, *map(len, packets)])
    zone = SETTINGS.frame_length - FRAME_HEADER_LENGTH - CRC_LENGTH
    assert len(rows) >= 8 and len(found) == len(packets)
    for k in range(len(packets)):
        first, last = int(starts[k]) // zone, (int(starts[k + 1]) - 1) // zone
        # A packet that is continued in a later window of the reader has the time of its end.
        expected = {int(times[first])} if window_octets > len(stream) else {int(times[first]), int(times[last])}
        assert found[k] in expected
    assert (reader.found.first_utc_ns, reader.found.last_utc_ns) == (times[0], times[-1])


def test_reports_of_clocks_that_differ_are_left_out():
    ticks = int(ticks_from_utc_ns(START))
    packets = [report(ticks, k) for k in range(6)]
    later = np.array([1.3, 60.0, 60.1, -60.0, 3600.0, 0.0])
    received = START + np.rint(later * NS).astype(np.int64)
    received[5] = NO_TIME
    assert CLOCKS_AGREE_NS == 60 * NS
    found = time_receptions(batch_of(packets, received))
    assert found == {(ticks, k): int(received[k]) for k in (0, 1, 3)}
    assert time_receptions(batch_of(packets, None)) == {}


def noted(ground):
    names = ("ticks", "sequence_count", "station", "earth_utc_ns")
    with ground.database.reading() as connection:
        rows = connection.execute(RECEPTIONS.select().order_by(*(RECEPTIONS.c[name] for name in names)))
        return [tuple(getattr(row, name) for name in names) for row in rows]


def test_the_first_reception_counts_in_any_order(either, monkeypatch):
    with either.database.writing() as connection:
        vehicle = vehicle_id(connection, 76, "flight")
        for received in ({(7, 1): 500, (8, 2): 600}, {(7, 1): 400}, {(7, 1): 450}):
            store.note_receptions(connection, vehicle, "madrid", received)
        store.note_receptions(connection, vehicle, "canberra", {(7, 1): 700})
    expected = [(7, 1, "canberra", 700), (7, 1, "madrid", 400), (8, 2, "madrid", 600)]
    assert noted(either) == expected
    logged = read_events(either.database, 0)
    reports = [one.payload["reports"] for one in logged if one.kind == "receptions"]
    assert reports == [2, 1, 1]  # the later reception of the same report changes nothing
    monkeypatch.setattr(store, "RECEPTIONS_LIMIT", 3)
    with either.database.writing() as connection:
        store.note_receptions(connection, vehicle, "madrid", {(9, 3): 800})
    assert noted(either) == expected


SPACECRAFT = 76
STATEMENTS = 10
"""Statements of one piece besides the three bulk inserts (packets, samples, roll-ups)."""


@fixture(scope="module")
def pieces(make_pass):
    """The first one shows the link; the others hold one packet each, in complete frames."""
    packets = list(make_pass(frames=6).packets)
    return [encode_cadus(one, spacecraft_id=SPACECRAFT) for one in (packets[:4], *([one] for one in packets[4:]))]


def ingest(ground, octets):
    """Ingest a piece and check its stored result."""
    path = ground.home / "piece"
    path.write_bytes(octets)
    made = ingest_file(ground, path, spacecraft_id=SPACECRAFT)
    kept = ground.read(store.get_ingest, made.ingest_id)
    assert (kept.accounting, kept.state) == (made, "done")


def test_a_small_piece_takes_few_statements_in_two_transactions(either, pieces):
    for piece in pieces[:3]:
        ingest(either, piece)
    statements = []
    until_commit = []
    engine = either.database.engine
    event.listen(engine, "before_cursor_execute", lambda *given: statements.append(given[2]))
    event.listen(
        engine, "commit", lambda c: c.get_execution_options()["linna_write"] and until_commit.append(len(statements))
    )
    ingest(either, pieces[3])
    # What follows the second commit are the automatic steps. SQLite begins transactions and has the bulk inserts.
    entered, stored = until_commit[:2]
    limit = STATEMENTS if either.database.dialect == "postgresql" else STATEMENTS + 6
    assert stored <= limit, statements[:stored]
    assert any("UPDATE ingests" in one for one in statements[entered:stored])
    assert not any("UPDATE ingests" in one for one in statements[stored:])


def test_the_declared_link_follows_new_mission_descriptions(either):
    piece = Piece(1, "flight", SPACECRAFT, "0" * 64, 1279, "", 0)

    def known():
        return either.read(known_before, piece)

    assert known().expected.settings == (LinkSettings().explicit,)
    assert known().around.vehicle_id is None
    vehicle = either.write(vehicle_id, SPACECRAFT, "flight")
    assert known().around.vehicle_id == vehicle
    text = f'name = "one"\n[spacecraft]\nid = {SPACECRAFT}\n[link]\nframe_length = 1115\ncoding = "none"\n'
    add_mission(either, text.encode(), actor="ann")
    (stated,) = known().expected.settings
    assert (stated.frame_length, stated.coding) == (1115, "none")
    add_mission(either, text.replace("1115", "223").encode(), actor="ann")
    assert [one.frame_length for one in known().expected.settings] == [223]
