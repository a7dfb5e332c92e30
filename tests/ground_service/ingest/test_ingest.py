"""Ingest of whole recordings and pieces: what is stored, counted, refused, made up for and decoded again."""

import contextlib
import json
import logging
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
from pytest import fixture, mark, raises
from sqlalchemy import event, func, select, text

from ground_service.app import create_app
from ground_service.errors import InvalidInput
from ground_service.ground import open_ground
from ground_service.http.model import Paging
from ground_service.ingest.service import PiecePosition, ingest_file
from ground_service.ingest.store import store_batch
from ground_service.passes.service import list_events, parameter_series, state_series
from ground_service.settings import Settings
from ground_service.store import database as stores
from ground_service.store import repository
from ground_service.store.database import open_database
from ground_service.store.vehicles import vehicle_id
from ground_service.telemetry import decoding as parameters
from ground_service.telemetry.decoding import catch_up, redecode, vehicles_behind
from ground_service.telemetry.packets import batch_of_cut
from tests.ground_service.archive_hash import hash_of
from tests.ground_service.conftest import define_pass_of
from tests.serving import TestClient
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import decode, encode_cadus
from tmtc.packets.space_packets import append_crc

SPACECRAFT = 76


def ingest(ground, octets, name="downlink.bin", link=None):
    path = ground.home / name
    path.write_bytes(octets)
    return ingest_file(ground, path, spacecraft_id=SPACECRAFT, link=link)


def rows(ground, table):
    with ground.database.reading() as connection:
        return int(connection.execute(select(func.count()).select_from(table)).scalar_one())


@fixture(scope="module")
def packets(make_pass):
    return list(make_pass(frames=6).packets)


@fixture(scope="module")
def stream(packets):
    return encode_cadus(packets, spacecraft_id=SPACECRAFT)


@fixture(scope="module")
def frames(packets):
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT, frame_length=223)
    return [stream[at : at + 259] for at in range(0, len(stream), 259)]


@fixture(scope="module")
def expected(packets, tmp_path_factory):
    with open_ground(tmp_path_factory.mktemp("whole") / "home") as ground:
        ingest(ground, b"".join(packets))
        return hash_of(ground)


def test_every_packet_is_stored_with_its_rows(ground, packets):
    result = ingest(ground, b"".join(packets))
    assert result.packets == result.packets_new == result.samples == len(packets)
    assert (result.crc_errors, result.octets_skipped, result.unknown) == (0, 0, 0)
    assert rows(ground, repository.SAMPLES["detections"]) == 6
    assert rows(ground, repository.SAMPLES["navigation_states"]) == 12


def test_a_damaged_packet_and_one_cut_short_are_counted_and_the_rest_is_stored(ground, packets):
    octets = bytearray(b"".join(packets)[:-5])
    octets[len(packets[0]) + 30] ^= 0x10
    result = ingest(ground, octets)
    assert (result.packets, result.crc_errors) == (len(packets) - 2, 1)
    assert result.octets_skipped == len(packets[-1]) - 5


def test_clocks_of_2000_and_of_the_future_are_kept_apart_once(ground, packets):
    values = {"event_id": 1, "frame_number": 0, "value_1": 0.0, "value_2": 0.0}
    strays = [DICTIONARY.pack("event_info", values, ticks=t, sequence_count=9) for t in (0, (1 << 48) - 1)]
    result = ingest(ground, b"".join([*packets, *strays]))
    assert (result.packets_new, result.packets_implausible) == (len(packets), 2)
    again = ingest(ground, b"".join(strays))
    assert (again.packets_new, again.packets_implausible) == (0, 0)


def test_a_downlink_of_another_dictionary_is_kept_octet_by_octet_and_counted(ground, packets):
    def foreign(packet):
        """The packet under a message type that no dictionary of ours has."""
        return append_crc(packet[:7] + bytes((201, 77)) + packet[9:-2])

    strangers = [foreign(packet) for packet in packets[:25]]
    result = ingest(ground, b"".join([*strangers, *packets[25:]]))
    assert (result.packets_new, result.unknown, result.crc_errors) == (len(packets), 25, 0)
    assert result.samples == len(packets) - 25
    assert set(strangers) <= stored(ground)


def stored(ground):
    with ground.database.reading() as connection:
        return set(connection.execute(select(repository.PACKETS.c.octets)).scalars())


@mark.parametrize("octets", [1_000, 70_000])
def test_noise_is_refused_in_one_line_and_remembered(ground, octets):
    with raises(InvalidInput, match=rf"noise\.bin: expected a stream of CADUs or of space packets, found {octets}"):
        ingest(ground, np.random.default_rng(3).bytes(octets), "noise.bin")
    record = ground.read(repository.newest, repository.INGESTS, Paging())[0][0]
    assert record["state"] == "failed" and "noise.bin" in record["error"]


def test_a_missing_file_is_refused(ground, tmp_path):
    with raises(InvalidInput, match="expected a downlink file, found nothing there"):
        ingest_file(ground, tmp_path / "no.bin", spacecraft_id=SPACECRAFT)


def place(ground, octets, start, stream="stream", **more):
    path = ground.home / "piece"
    path.write_bytes(octets)
    return ingest_file(ground, path, place=PiecePosition(stream, start), **more)


def test_octets_that_wait_are_counted_and_are_no_error(ground, packets, stream, expected):
    first = place(ground, stream[300:900], 300)
    assert (first.packets, first.octets_pending) == (0, 600)
    record = ground.read(repository.newest, repository.INGESTS, Paging())[0][0]
    assert (record["state"], record["error"]) == ("done", None)
    assert record["accounting"]["octets_pending"] == 600
    last = place(ground, stream[900:], 900)
    assert (last.frames_joined, last.octets_pending) == (0, 979)
    both = place(ground, stream[:300], 0)
    assert both.frames_joined == 1 and both.packets > 0 and both.packets_joined == 1
    assert hash_of(ground) == expected


def test_an_incomplete_frame_at_either_end_of_a_whole_recording_is_counted(ground, stream):
    result = ingest(ground, stream[300 : 4 * 1279 + 100])
    assert (result.frames, result.octets_pending) == (3, 979 + 100)
    with raises(InvalidInput, match=r"600 octets with no frame or packet of .*--recording NAME FILE"):
        ingest(ground, stream[300:900])


def test_a_frame_of_two_recordings_is_none(ground, stream):
    """The octets before and behind a cut belong together only in one recording of one instance."""
    place(ground, stream[:4000], 0)
    for name, instance in (("other", "flight"), ("stream", "twin")):
        assert place(ground, stream[4000:], 4000, name, instance=instance).frames_joined == 0
    assert place(ground, stream[4000:], 4000).frames_joined == 1


def test_pieces_for_one_spacecraft_and_for_any_adjoin(ground, stream, expected):
    """The same octets read for another spacecraft before are read again."""
    for number, start in enumerate(range(0, len(stream), 1_000)):
        mine = SPACECRAFT if number % 2 else None
        for spacecraft in (SPACECRAFT + 1, mine):
            place(ground, stream[start : start + 1_000], start, spacecraft_id=spacecraft)
    assert hash_of(ground) == expected


def test_octets_that_came_before_are_counted_as_repeated(ground, stream):
    first = place(ground, stream[:5_000], 0)
    again = place(ground, stream[:5_000], 0)
    assert (again.frames, again.packets_new, again.octets_repeated) == (first.frames, 0, 0)
    part = place(ground, stream[1_000:6_000], 1_000)
    assert (part.octets_repeated, part.frames, part.frames_joined) == (4_000, 1, 1)
    inside = place(ground, stream[2_000:3_000], 2_000)
    assert (inside.octets_repeated, inside.frames, inside.octets_skipped) == (1_000, 0, 0)


def test_single_octets_are_joined_by_their_place(ground, packets):
    stream = encode_cadus(packets[:1], spacecraft_id=SPACECRAFT)
    place(ground, stream[:900], 0)
    for start in np.random.default_rng(1).permutation(np.arange(900, 912)).tolist():
        place(ground, stream[start : start + 1], start)
    assert rows(ground, repository.PACKETS) == 0
    place(ground, stream[912:], 912)
    assert rows(ground, repository.PACKETS) == 1


def test_fragments_that_fit_by_length_and_count_alone_make_no_packet(ground, packets, stream):
    """The rest of other packets with the same frame counts: the checksum shows that it does not belong here."""
    others = [append_crc(one[:9] + b"?" + one[10:-2]) for one in packets]
    other = encode_cadus(others, spacecraft_id=SPACECRAFT)
    ingest(ground, stream[: 2 * 1279])
    ingest(ground, other[2 * 1279 : 4 * 1279])
    assert stored(ground) <= {*packets, *others}
    assert ingest(ground, stream[2 * 1279 :]).packets_joined == 1


def test_many_fragments_are_stored_before_the_end_of_a_recording(ground, frames, expected, monkeypatch):
    monkeypatch.setattr("ground_service.ingest.reception.WINDOW_OCTETS", 2_000)
    monkeypatch.setattr("ground_service.ingest.reception.FRAGMENTS_LIMIT", 3)
    ingest(ground, b"".join(frames[1::2] + frames[::2]), link="frame_length=223")
    assert hash_of(ground) == expected
    assert rows(ground, repository.FRAGMENTS) == 0


def test_a_piece_is_stored_in_few_transactions(ground, stream):
    """Each commit waits for the disk: entered, read, completed with fragments, correlated."""
    middle = len(stream) // 2
    place(ground, stream[:middle], 0)
    commits = []
    event.listen(ground.database.engine, "commit", lambda c: commits.append(c.get_execution_options()["linna_write"]))
    assert place(ground, stream[middle:], middle).frames_joined == 1
    assert len(commits) <= 5


class PowerFailure(Exception):
    """The process ends here."""


@mark.parametrize("shuffled", [False, True])
def test_an_ingest_that_ends_after_any_commit_is_made_up_for_by_the_next(packets, stream, expected, tmp_path, shuffled):
    """A CADU of three pieces, with packets that reach into its neighbours; the piece that completes it is cut off."""
    pieces = [(0, stream[:1700]), (1700, stream[1700:2300]), (2300, stream[2300:])]
    if shuffled:
        pieces = [pieces[2], pieces[0], pieces[1]]
    for commits in range(1, 8):
        with open_ground(tmp_path / f"{commits}") as ground:
            for start, octets in pieces[:2]:
                place(ground, octets, start)
            dialect, left = ground.database.engine.dialect, [commits]
            commit = dialect.do_commit

            def failing(connection, commit=commit, left=left):
                commit(connection)
                left[0] -= 1
                if left[0] == 0:
                    raise PowerFailure

            dialect.do_commit = failing
            start, octets = pieces[2]
            with contextlib.suppress(PowerFailure):
                place(ground, octets, start)
            dialect.do_commit = commit
            place(ground, octets, start)
            assert hash_of(ground) == expected, f"after commit {commits}"
            with ground.database.reading() as connection:
                stored = connection.execute(select(func.sum(repository.PIECES.c.packets_stored))).scalar_one()
            assert stored == len(packets), f"after commit {commits}"


OLD = replace(DICTIONARY, version=DICTIONARY.version - 1)


def fill_with_the_old(home, made):
    """Restore the state of an earlier program: all packets, decoded by its dictionary."""
    found = decode((made.folder / "downlink.cadu").read_bytes())
    with open_ground(home) as ground:
        with ground.database.writing() as connection:
            vehicle = vehicle_id(connection, 76, "flight")
            store_batch(connection, vehicle, batch_of_cut(found.buffer, found.cut, OLD, 76))
            repository.change(connection, repository.VEHICLES, vehicle, decoded_version=OLD.version)
        define_pass_of(ground, made)


@fixture
def old(tmp_path, synthetic_pass):
    fill_with_the_old(tmp_path / "home", synthetic_pass)
    with open_ground(tmp_path / "home") as ground:
        yield ground


def looked_at(ground):
    return (
        list_events(ground, 1, Paging(limit=1)).total,
        parameter_series(ground, 1, "power_w", 1000).samples,
        state_series(ground, 1, "spherical", ("altitude_m",), 100)[0].samples,
    )


def versions(ground):
    table = repository.SAMPLES["housekeeping"]
    with ground.database.reading() as connection:
        return set(connection.execute(select(table.c.dictionary_version).distinct()).scalars())


def test_an_archive_of_the_old_dictionary_is_read_and_then_decoded_again(old):
    before = looked_at(old)
    assert before == (1, 40, 40)
    assert vehicles_behind(old) == [1]
    assert catch_up(old, 1) > 0
    assert (looked_at(old), vehicles_behind(old), catch_up(old, 1)) == (before, [], 0)
    assert versions(old) == {OLD.version, DICTIONARY.version}


def test_serving_enters_the_job_that_decodes_again(tmp_path, synthetic_pass):
    fill_with_the_old(tmp_path / "home", synthetic_pass)
    with TestClient(create_app(Settings(home=tmp_path / "home"), inline_jobs=True)) as client:
        (job,) = client.get("/api/v1/jobs").json()["items"]
        assert (job["kind"], job["state"]) == ("redecode", "done")
        assert len(client.get("/api/v1/passes/1/events").json()["items"]) == 1
    with open_ground(tmp_path / "home") as ground:
        assert vehicles_behind(ground) == []


def test_what_comes_in_meanwhile_and_a_kill_in_the_middle_change_nothing(
    old, tmp_path, make_pass, synthetic_pass, monkeypatch
):
    monkeypatch.setattr(parameters, "BLOCK_PACKETS", 50)
    more = make_pass(frames=3, seed=5).folder / "downlink.cadu"
    blocks = Mock(side_effect=[parameters._block, parameters._block, KeyboardInterrupt, *[parameters._block] * 99])
    monkeypatch.setattr(parameters, "_block", lambda *given: blocks()(*given))
    with raises(KeyboardInterrupt):
        ingest_file(old, more)
    assert looked_at(old)[0] >= 1  # still as the old dictionary decoded it
    ingest_file(old, more)
    with open_ground(tmp_path / "fresh") as fresh:
        for path in (more, synthetic_pass.folder / "downlink.cadu"):
            ingest_file(fresh, path)
        redecode(fresh, 1, OLD)
        redecode(old, 1, OLD)
        assert hash_of(old) == hash_of(fresh)


ZONE = 1107
"""Octets of a frame for packets."""

FILE = "INSERT INTO files (sha256, kind, name, octets, received_utc_ns) VALUES (:sha256, 'downlink', 'a', 600, 1)"
EDGE = (
    "INSERT INTO stream_edges"
    " (domain, identity, role, open, count, next_count, fit, file_sha256, start, length, octets)"
    " VALUES (:domain, :identity, :role, 1, :count, :next_count, :fit, :sha256, :start, :length, :octets)"
)
INGEST = (
    "INSERT INTO ingests (id, file_sha256, state, dictionary_version, received_utc_ns, accounting)"
    " VALUES (:id, :sha256, 'done', 1, 1, :accounting)"
)
PIECE = (
    "INSERT INTO pieces (ingest_id, scope, file_sha256, octets, stream, position, links_tried, station,"
    " packets_stored, packets_joined, samples_stored) VALUES (:id, 'flight', :sha256, 600, :stream, 0, 2, '', 0, 0, 0)"
)


@fixture
def begun(synthetic_pass):
    """Octets of a packet in the first frame of the downlink and behind it."""
    at = 0
    for packet in synthetic_pass.packets:
        if at + len(packet) > ZONE:
            return at + len(packet) - ZONE, packet[: ZONE - at]
        at += len(packet)
    raise AssertionError


@fixture
def upgraded(begun, tmp_path, caplog):
    """An archive in which the beginning of a packet waits, and two pieces of 600 octets, one without a position."""
    home = tmp_path / "home"
    home.mkdir()
    database = open_database(f"sqlite:///{home / 'linna.db'}")
    stores.upgrade_database(database, "1.1")
    with database.engine.begin() as connection:
        connection.execute(text("INSERT INTO vehicles (id, ccsds_id, instance) VALUES (1, 76, 'flight')"))
        for number, stream in ((1, ""), (2, "s")):
            ids = {"id": number, "sha256": str(number) * 64}
            connection.execute(text(FILE), ids)
            connection.execute(text(INGEST), ids | {"accounting": json.dumps({"octets_pending": 5})})
            connection.execute(text(PIECE), ids | {"stream": stream})
            raw = {"role": 1, "count": -1, "next_count": -1, "fit": 600, "octets": bytes(600)}
            for domain in ("cadus a flight", "packets 76 flight"):
                edge = {"domain": domain, "identity": ids["sha256"].encode()[:16], "start": 0, "length": 600}
                connection.execute(text(EDGE), raw | edge | {"sha256": ids["sha256"]})
        missing, octets = begun
        opener = {"domain": "channel 1 0 6 1113", "identity": b"x" * 16, "role": 0, "count": 1, "next_count": 1}
        opener |= {"fit": missing, "octets": octets, "length": len(octets), "start": None, "sha256": None}
        connection.execute(text(EDGE), opener)
    database.engine.dispose()
    with caplog.at_level(logging.WARNING):
        return open_ground(home)


def test_the_beginning_of_a_packet_is_kept(upgraded, synthetic_pass, tmp_path):
    stream = (synthetic_pass.folder / "downlink.cadu").read_bytes()
    (tmp_path / "rest.cadu").write_bytes(stream[1279:])
    with upgraded as ground:
        assert ingest_file(ground, tmp_path / "rest.cadu").packets_joined == 1


def test_waiting_pieces_without_a_position_are_listed(upgraded, caplog):
    said = [one.getMessage() for one in caplog.get_records("setup")]
    assert [one for one in said if "--recording NAME FILE" in one] == [
        f"ingest 1, file {'1' * 64}: 600 octets wait for others without a position; ingest the files of its "
        "recording again with 'linna ingest --recording NAME FILE...'"
    ]
    with upgraded as ground, ground.database.reading() as connection:
        rows = connection.execute(text("SELECT accounting FROM ingests ORDER BY id")).scalars().all()
        waits = connection.execute(text("SELECT waits FROM pieces ORDER BY ingest_id")).scalars().all()
    assert [json.loads(one)["octets_pending"] for one in rows] == [600, 600]
    assert waits == [None, 1]
