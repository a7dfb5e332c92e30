"""Any split, order and repetition of recordings, by any number of processes, gives the same archive."""

from collections.abc import Callable, Iterator

import pytest

from benchmarks.campaigns.cuts import KINDS, ORDERS, Archive, Piece, archive, case_of, ingest
from ground_service.ingest.reception import Reading, Run
from ground_service.ingest.service import Place, ingest_file

FEW = 2 * len(KINDS)
"""Cases of a run in one process; the campaign has 500."""


@pytest.fixture(scope="module")
def one_process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Archive]:
    with archive(tmp_path_factory.mktemp("pieces") / "home") as found:
        yield found


@pytest.fixture(scope="module")
def several_processes(
    tmp_path_factory: pytest.TempPathFactory, new_postgres_database: Callable[[], str]
) -> Iterator[Archive]:
    with archive(tmp_path_factory.mktemp("pieces") / "home", new_postgres_database(), 3) as found:
        yield found


def test_each_kind_meets_each_order_and_each_piece_is_of_its_recording() -> None:
    cases = [case_of(number) for number in range(len(KINDS) * len(ORDERS))]
    assert {(case.kind, case.order) for case in cases} == {
        (kind, order) for kind in KINDS for order in ORDERS
    }
    for case in cases:
        for recording in case.recordings:
            octets = bytearray(len(recording.octets))
            for piece in case.pieces:
                if piece.recording is recording:
                    octets[piece.start : piece.stop] = b"\1" * (piece.stop - piece.start)
            assert all(octets)


@pytest.mark.parametrize("number", [k * len(ORDERS) + k for k in range(FEW)])
def test_any_split_order_and_repetition_gives_the_same_archive(one_process: Archive, number: int) -> None:
    assert one_process.difference(case_of(number)) == ""


@pytest.mark.parametrize("number", [200 + k * (len(ORDERS) + 1) for k in range(len(KINDS))])
def test_any_number_of_processes_gives_the_same_archive(several_processes: Archive, number: int) -> None:
    assert several_processes.difference(case_of(number)) == ""


def test_a_piece_that_proved_nothing_is_read_with_a_later_one_around_it(one_process: Archive) -> None:
    assert one_process.difference(case_of(10, ["without checksum", "foreign"])) == ""


def test_a_packet_that_ends_with_the_last_frame_of_its_channel_is_completed(one_process: Archive) -> None:
    assert one_process.difference(case_of(121, ("channels",) * 13)) == ""


def test_frames_that_a_piece_did_not_show_are_read_with_a_later_one_around_it(one_process: Archive) -> None:
    assert one_process.difference(case_of(229, ("damaged",) * 13)) == ""


@pytest.mark.parametrize(("number", "kind"), [(227, "stations"), (305, "stations"), (384, "records")])
def test_parts_that_share_frames_and_headers_cut_from_their_frames_are_used(
    one_process: Archive, number: int, kind: str
) -> None:
    assert one_process.difference(case_of(number, (kind,) * 13)) == ""


def test_a_piece_that_became_readable_while_it_was_read_is_read_again(
    one_process: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    (recording,) = case_of(3, ["without proof"]).recordings
    rest, ground = Piece(recording, 600, len(recording.octets)), one_process.ground

    def just_before_the_rest(_reading: Reading, _run: Run) -> list[object]:
        monkeypatch.undo()
        ingest(ground, rest, "late", "rest")
        return []

    monkeypatch.setattr(Reading, "_links_of_recording", just_before_the_rest)
    path = ground.home / "first"
    path.write_bytes(recording.octets[:600])
    result = ingest_file(ground, path, instance="late", place=Place("r", 0))
    assert (result.frames, result.octets_pending) == (2, 80)


def test_a_lost_piece_is_a_difference(one_process: Archive) -> None:
    case = case_of(200 * len(ORDERS), ["short frames"])
    case.pieces.pop()
    assert "packets" in one_process.difference(case)
