"""A downlink read in windows, in any split, order and repetition, by any number of processes."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np
from pytest import fixture, mark
from sqlalchemy import func, select

from benchmarks.campaigns.cuts import KINDS, ORDERS, Piece, archive, case_of, ingest
from ground_service.ground import open_ground
from ground_service.ingest.core import NO_RECORD, LinkContent
from ground_service.ingest.frames import FrameReader, PacketReader, Section
from ground_service.ingest.reception import Reading
from ground_service.ingest.service import PiecePosition, ingest_file
from ground_service.store import repository
from ground_service.telemetry.decoding import redecode
from tests.ground_service.archive_hash import hash_of
from tmtc.arrays import as_octets
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import DownlinkEncoder, LinkSettings, decode, encode_cadus, plan_of
from tmtc.link.frames import Clcw, pack_clcw

SPACECRAFT = 76


@fixture(scope="module")
def packets(make_pass):
    return list(make_pass(frames=30).packets)


@fixture(scope="module")
def stream(packets):
    return encode_cadus(packets, spacecraft_id=SPACECRAFT, frame_length=223)


def windows(octets, size):
    for start in range(0, len(octets), size):
        yield as_octets(octets[start : start + size]), start + size >= len(octets)


def reader_of(octets, spacecraft_id=None):
    sections = plan_of(octets).sections
    section = Section(None, 0, len(octets), 0, len(octets))
    if not sections:
        return PacketReader(section, LinkContent(), spacecraft_id=spacecraft_id)
    return FrameReader(section, sections[0].settings, LinkContent(), spacecraft_id=spacecraft_id, record=NO_RECORD)


def read(octets, window, spacecraft_id=None):
    """The packets, the counts, and the octets in no frame or packet."""
    reader = reader_of(octets, spacecraft_id)
    packets = [packet for batch in reader.batches(windows(octets, window)) for packet in batch.octets]
    found = reader.found
    return packets, found, len(octets) - found.octets_used + found.octets_unused


@mark.parametrize("window", [1 << 20, 8_000, 997])
def test_every_packet_comes_through_whatever_the_windows(packets, stream, window):
    found, accounting, skipped = read(stream, window)
    assert set(found) == set(packets)
    assert (accounting.packets, accounting.frames) == (len(packets), len(stream) // 259)
    assert (accounting.frames_bad, skipped, accounting.crc_errors) == (0, 0, 0)
    assert accounting.octets_used == len(stream)


@mark.parametrize("window", [1 << 20, 60_000])
def test_damage_is_accounted_for_alike_in_windows_and_at_once(stream, window):
    stream = bytearray(stream)
    rng = np.random.default_rng(5)
    for at in rng.integers(0, len(stream), 3 * len(stream) // 259):
        stream[at] ^= int(rng.integers(1, 256))
    for frame in 3, 17, 40:
        stream[frame * 259 + 10 : frame * 259 + 110] = rng.bytes(100)
    whole = decode(bytes(stream))
    found, accounting, skipped = read(bytes(stream), window)
    assert set(found) == set(whole.cut.packets(whole.buffer))
    assert accounting.packets == whole.packets
    assert accounting.symbols_corrected == whole.symbols_corrected > 100
    assert accounting.frames_bad == whole.frames_bad == 3
    assert skipped == whole.octets_skipped


def test_bare_packets_are_read_in_any_windows(packets):
    found, _, skipped = read(b"".join(packets), 1000, SPACECRAFT)
    assert (found, skipped) == (packets, 0)


def test_two_spacecraft_in_one_file_are_separated_and_one_that_is_named_excludes_the_other(packets):
    two = encode_cadus(packets[:40], spacecraft_id=76) + encode_cadus(packets[20:60], spacecraft_id=33)
    reader, by_spacecraft = reader_of(two), {}
    for batch in reader.batches(windows(two, 1 << 20)):
        by_spacecraft.setdefault(batch.spacecraft_id, []).extend(batch.octets)
    assert by_spacecraft == {76: packets[:40], 33: packets[20:60]}
    assert reader.found.frames_bad == 0
    found, accounting, _ = read(two, 1 << 20, 33)
    assert found == packets[20:60] and accounting.frames_bad > 0


def test_memory_does_not_grow_with_the_stream(stream):
    read(stream, 1 << 20)  # imports and compiles
    section = Section(None, 0, 75 * len(stream), 0, 75 * len(stream))
    settings = LinkSettings(frame_length=223)
    reader = FrameReader(section, settings, LinkContent(), spacecraft_id=SPACECRAFT, record=NO_RECORD)
    peaks = []
    tracemalloc.start()
    for _ in reader.batches((as_octets(5 * stream), False) for _ in range(15)):
        reader.take_fragments()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.reset_peak()
    tracemalloc.stop()
    assert len(peaks) == 15
    # The first windows leave behind what is kept until the end; ten more windows of the stream do not.
    assert max(peaks[4:]) - peaks[3] < len(stream)


@mark.parametrize("window", [1 << 20, 60_000])
def test_the_uplink_is_seen_alike_in_windows_and_at_once(packets, window):
    encoder = DownlinkEncoder(SPACECRAFT, LinkSettings(frame_length=223))
    clcws = [pack_clcw(Clcw(0, k // 9, lockout=40 < k < 60, farm_b_counter=k % 4)) for k in range(len(packets))]
    stream = encoder.encode(packets, clcw=clcws)
    (whole,) = decode(stream).uplink
    found, accounting, _ = read(stream, window)
    assert set(found) == set(packets)
    assert accounting.uplink == {(SPACECRAFT, 0): whole}
    assert whole.frames == accounting.frames and whole.changes > 50 and whole.frames_lockout > 0


def test_the_uplinks_of_two_spacecraft_in_one_file_are_separated(packets):
    stream = b"".join(
        DownlinkEncoder(spacecraft).encode(packets[:40], clcw=pack_clcw(Clcw(0, number)))
        for spacecraft, number in ((76, 5), (33, 200))
    )
    _, accounting, _ = read(stream, 1 << 20)
    assert {key: seen.report_value for key, seen in accounting.uplink.items()} == {(76, 0): 5, (33, 0): 200}


FEW = 2 * len(KINDS)
"""Cases of a run in one process; the campaign has 500."""


@fixture(scope="module")
def one_process(tmp_path_factory):
    with archive(tmp_path_factory.mktemp("pieces") / "home") as found:
        yield found


@fixture(scope="module")
def several_processes(tmp_path_factory, new_postgres_database):
    with archive(tmp_path_factory.mktemp("pieces") / "home", new_postgres_database(), 3) as found:
        yield found


def test_each_kind_meets_each_order_and_each_piece_is_of_its_recording():
    cases = [case_of(number) for number in range(len(KINDS) * len(ORDERS))]
    assert {(case.kind, case.order) for case in cases} == {(kind, order) for kind in KINDS for order in ORDERS}
    for case in cases:
        for recording in case.recordings:
            octets = bytearray(len(recording.octets))
            for piece in case.pieces:
                if piece.recording is recording:
                    octets[piece.start : piece.stop] = b"\1" * (piece.stop - piece.start)
            assert all(octets)


@mark.parametrize("number", [k * len(ORDERS) + k for k in range(FEW)])
def test_any_split_order_and_repetition_gives_the_same_archive(one_process, number):
    assert one_process.difference(case_of(number)) == ""


@mark.parametrize("number", [200 + k * (len(ORDERS) + 1) for k in range(len(KINDS))])
def test_any_number_of_processes_gives_the_same_archive(several_processes, number):
    assert several_processes.difference(case_of(number)) == ""


def test_a_piece_that_proved_nothing_is_read_with_a_later_one_around_it(one_process):
    assert one_process.difference(case_of(10, ["without checksum", "foreign"])) == ""


CASES = """\
121 channels: a packet that ends with the last frame of its channel
229 damaged: frames that a piece did not show
227 stations: parts that share frames
305 stations: parts that share frames
384 records: headers cut from their frames"""


@mark.parametrize("case", CASES.splitlines())
def test_what_a_piece_did_not_show_is_read_with_a_later_one(one_process, case):
    number, kind = case.partition(":")[0].split()
    assert one_process.difference(case_of(int(number), (kind,) * 13)) == ""


def test_a_piece_that_became_readable_while_it_was_read_is_read_again(one_process, monkeypatch):
    (recording,) = case_of(3, ["without proof"]).recordings
    rest, ground = Piece(recording, 600, len(recording.octets)), one_process.ground

    def just_before_the_rest(_reading, _run):
        monkeypatch.undo()
        ingest(ground, rest, "late", "rest")
        return []

    monkeypatch.setattr(Reading, "_links_of_recording", just_before_the_rest)
    path = ground.home / "first"
    path.write_bytes(recording.octets[:600])
    result = ingest_file(ground, path, instance="late", place=PiecePosition("r", 0))
    assert (result.frames, result.octets_pending) == (2, 80)


def test_a_lost_piece_is_a_difference(one_process):
    case = case_of(200 * len(ORDERS), ["short frames"])
    case.pieces.pop()
    assert one_process.difference(case).startswith("differs in")


KILLS = 4

INGEST = """
import sys
from pathlib import Path
from ground_service.ingest import reception
from ground_service.store import files
from ground_service.ground import open_ground
from ground_service.ingest.service import ingest_file
files.BLOCK_OCTETS = 4_000
reception.WINDOW_OCTETS = 4_000
with open_ground(Path(sys.argv[1])) as ground:
    print("ready", flush=True)
    ingest_file(ground, Path(sys.argv[2]))
"""


def rows_of(ground, version):
    with ground.database.reading() as connection:
        return {
            name: connection.execute(
                select(func.count()).select_from(table).where(table.c.dictionary_version == version)
            ).scalar_one()
            for name, table in repository.SAMPLES.items()
        }


@fixture(scope="module")
def downlink(make_pass):
    return Path(make_pass(frames=30, seed=4).folder) / "downlink.cadu"


@mark.campaign
def test_an_ingest_killed_at_any_moment_loses_and_doubles_nothing(downlink, tmp_path):
    """The stream is stored in about ten transactions; the process is killed outright at random moments among them."""
    with open_ground(tmp_path / "whole") as ground:
        result = ingest_file(ground, downlink)
        expected = hash_of(ground)
    home = tmp_path / "killed"
    rng = np.random.default_rng(11)
    for _ in range(KILLS):
        process = subprocess.Popen(
            [sys.executable, "-c", INGEST, str(home), str(downlink)], stdout=subprocess.PIPE, env=dict(os.environ)
        )
        process.stdout.readline()
        time.sleep(float(rng.uniform(0.0, 0.4)))
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
    with open_ground(home) as ground:
        again = ingest_file(ground, downlink)
        assert again.packets == result.packets
        assert hash_of(ground) == expected


def test_decoding_again_adds_rows_to_the_old_ones(downlink, ground):
    result = ingest_file(ground, downlink)
    before = rows_of(ground, DICTIONARY.version)
    newer = dataclasses.replace(DICTIONARY, version=DICTIONARY.version + 1)
    assert redecode(ground, result.vehicle_id, newer) == sum(before.values()) == result.samples
    assert rows_of(ground, DICTIONARY.version) == rows_of(ground, newer.version) == before
    archive = hash_of(ground)
    redecode(ground, result.vehicle_id, newer)
    redecode(ground, result.vehicle_id, DICTIONARY)
    assert hash_of(ground) == archive
