"""Ingest: any order, any split, any repetition of the same octets gives the same archive."""

import contextlib
import itertools
import multiprocessing
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import event, func, select

from ground_service.errors import DatabaseBusy, InvalidInput
from ground_service.ground import Ground, open_ground
from ground_service.http.model import Paging
from ground_service.ingest import edge_store as edges
from ground_service.ingest.edges import MIDDLE
from ground_service.ingest.service import Place, ingest_file
from ground_service.store import repository
from ground_service.store.vehicles import vehicle_id
from tests.ground_service.archive_hash import archive_hash
from tmtc.crc import append_crc
from tmtc.downlink import encode_cadus

SPACECRAFT = 76


def ingest(ground: Ground, octets: bytes, folder: Path, name: str = "downlink.bin") -> Any:
    path = folder / name
    path.write_bytes(octets)
    return ingest_file(ground, path, spacecraft_id=SPACECRAFT)


def archive(ground: Ground) -> str:
    with ground.database.reading() as connection:
        return archive_hash(connection, vehicle_id(connection, SPACECRAFT, "flight"))


def rows(ground: Ground, table: Any) -> int:
    with ground.database.reading() as connection:
        return int(connection.execute(select(func.count()).select_from(table)).scalar_one())


@pytest.fixture(scope="module")
def packets(make_pass: Callable[..., Any]) -> list[bytes]:
    return list(make_pass(frames=6).packets)


@pytest.fixture(scope="module")
def expected(packets: list[bytes], tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("whole")
    ground = open_ground(folder / "home")
    ingest(ground, b"".join(packets), folder)
    result = archive(ground)
    ground.close()
    return result


def test_every_packet_is_stored_with_its_rows(ground: Ground, packets: list[bytes], tmp_path: Path) -> None:
    result = ingest(ground, b"".join(packets), tmp_path)
    assert result.packets == result.packets_new == len(packets)
    assert result.samples == len(packets)
    assert (result.crc_errors, result.octets_skipped, result.unknown) == (0, 0, 0)
    assert rows(ground, repository.SAMPLES["detections"]) == 6
    assert rows(ground, repository.SAMPLES["navigation_states"]) == 12


def test_ingesting_twice_changes_nothing(
    ground: Ground, packets: list[bytes], expected: str, tmp_path: Path
) -> None:
    ingest(ground, b"".join(packets), tmp_path)
    again = ingest(ground, b"".join(packets), tmp_path)
    assert (again.packets_new, again.packets_repeated) == (0, len(packets))
    assert archive(ground) == expected


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_order_split_and_repetition_gives_the_same_archive(
    data: st.DataObject, packets: list[bytes], expected: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("shuffled")
    seed = data.draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(packets)).tolist() + rng.integers(0, len(packets), 5).tolist()
    cuts = sorted(data.draw(st.lists(st.integers(0, len(order)), max_size=4)))
    ground = open_ground(folder / "home")
    for first, last in zip([0, *cuts], [*cuts, len(order)], strict=True):
        if last > first:
            ingest(ground, b"".join(packets[i] for i in order[first:last]), folder)
    assert archive(ground) == expected
    ground.close()


def test_a_damaged_packet_is_counted_and_the_rest_is_stored(
    ground: Ground, packets: list[bytes], tmp_path: Path
) -> None:
    octets = bytearray(b"".join(packets))
    octets[len(packets[0]) + 30] ^= 0x10
    result = ingest(ground, bytes(octets), tmp_path)
    assert (result.packets, result.crc_errors) == (len(packets) - 1, 1)


def test_a_file_cut_short_gives_what_is_whole(ground: Ground, packets: list[bytes], tmp_path: Path) -> None:
    result = ingest(ground, b"".join(packets)[:-5], tmp_path)
    assert result.packets == len(packets) - 1
    assert result.octets_skipped == len(packets[-1]) - 5


def test_clocks_of_1970_and_of_the_future_are_stored_as_they_are(
    ground: Ground, packets: list[bytes], tmp_path: Path
) -> None:
    from tmtc.dictionary import DICTIONARY

    values = {"event_id": 1, "frame_number": 0, "value_1": 0.0, "value_2": 0.0}
    strays = [DICTIONARY.pack("event_info", values, ticks=t, sequence_count=9) for t in (0, (1 << 48) - 1)]
    result = ingest(ground, b"".join([*packets, *strays]), tmp_path)
    assert result.packets_new == len(packets) + 2
    again = ingest(ground, b"".join(strays), tmp_path)
    assert again.packets_new == 0


def test_two_spacecraft_in_one_file_have_archives_of_their_own(
    ground: Ground, packets: list[bytes], expected: str, tmp_path: Path
) -> None:
    mixed = encode_cadus(packets, spacecraft_id=SPACECRAFT) + encode_cadus(packets[:20], spacecraft_id=33)
    (tmp_path / "mixed.cadu").write_bytes(mixed)
    result = ingest_file(ground, tmp_path / "mixed.cadu")
    assert result.packets_new == len(packets) + 20 and result.frames_bad == 0
    assert archive(ground) == expected
    with ground.database.reading() as connection:
        other = vehicle_id(connection, 33, "flight")
        stored = repository.newest(connection, repository.PACKETS, Paging(), vehicle_id=other)
    assert stored[1] == 20


def test_a_downlink_of_another_dictionary_is_kept_octet_by_octet_and_counted(
    ground: Ground, packets: list[bytes], tmp_path: Path
) -> None:
    def foreign(packet: bytes) -> bytes:
        """The packet under a message type that no dictionary of ours has."""
        return append_crc(packet[:7] + bytes((201, 77)) + packet[9:-2])

    strangers = [foreign(packet) for packet in packets[:25]]
    result = ingest(ground, b"".join([*strangers, *packets[25:]]), tmp_path)
    assert (result.packets_new, result.unknown, result.crc_errors) == (len(packets), 25, 0)
    assert result.samples == len(packets) - 25
    table = repository.PACKETS
    with ground.database.reading() as connection:
        kept = set(connection.execute(select(table.c.octets)).scalars())
    assert set(strangers) <= kept


def test_noise_is_refused_in_one_line_and_remembered(ground: Ground, tmp_path: Path) -> None:
    with pytest.raises(
        InvalidInput, match=r"noise\.bin: expected a stream of CADUs or of space packets, found 70000"
    ):
        ingest(ground, np.random.default_rng(3).bytes(70_000), tmp_path, "noise.bin")
    with ground.database.reading() as connection:
        record = repository.newest(connection, repository.INGESTS, Paging())[0][0]
    assert record["state"] == "failed"
    assert "noise.bin" in record["error"]


def test_a_missing_file_is_refused(ground: Ground, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="expected a downlink file, found nothing there"):
        ingest_file(ground, tmp_path / "no.bin", spacecraft_id=SPACECRAFT)


def random_pieces(octets: bytes, seed: int, count: int, smallest: int = 1) -> list[bytes]:
    """Pieces cut at random octets, in random order, some of them twice."""
    rng = np.random.default_rng(seed)
    cuts = [0]
    for cut in sorted(rng.integers(1, len(octets), count).tolist()):
        if cut - cuts[-1] >= smallest and len(octets) - cut >= smallest:
            cuts.append(cut)
    pieces = [octets[a:b] for a, b in itertools.pairwise([*cuts, len(octets)])]
    order = [*rng.permutation(len(pieces)).tolist(), *rng.integers(0, len(pieces), 2).tolist()]
    return [pieces[i] for i in order]


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.campaign)])
@pytest.mark.parametrize("frame_length", [223, 1115])
def test_a_stream_of_frames_may_be_cut_at_any_octet(
    ground: Ground, packets: list[bytes], expected: str, tmp_path: Path, seed: int, frame_length: int
) -> None:
    """Pieces of any size without position: shorter than a CADU, without a marker, or cut within one."""
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT, frame_length=frame_length)
    pieces = random_pieces(stream, seed, 12)
    if frame_length == 223:  # a piece has to show the link where it is not the usual one
        pieces = [*pieces[1:], stream[:1200], pieces[0]]
    for piece in pieces:
        result = ingest(ground, piece, tmp_path)
    assert archive(ground) == expected
    assert result.octets_pending == 0


@pytest.mark.parametrize("placed", [False, True])
@pytest.mark.parametrize("bare", [False, True])
def test_pieces_are_joined_whether_or_not_their_spacecraft_is_stated(
    ground: Ground, packets: list[bytes], expected: str, tmp_path: Path, bare: bool, placed: bool
) -> None:
    """Bare packets always need it; another spacecraft's pieces in between are not joined with them."""
    stream = b"".join(packets) if bare else encode_cadus(packets, spacecraft_id=SPACECRAFT)
    cuts = np.unique(np.random.default_rng(6).integers(1, len(stream), 8)).tolist()
    pieces = list(itertools.pairwise([0, *cuts, len(stream)]))
    if placed:
        pieces.reverse()
    for number, (start, stop) in enumerate(pieces):
        for spacecraft in (SPACECRAFT if bare or number % 2 else None, SPACECRAFT + 1):
            ingest_file(
                ground,
                written(tmp_path, stream[start:stop]),
                spacecraft_id=spacecraft,
                place=Place(f"of {spacecraft}" if bare else "stream", start) if placed else None,
            )
    assert archive(ground) == expected
    other = repository.PACKETS
    with ground.database.reading() as connection:
        vehicle = vehicle_id(connection, SPACECRAFT + 1, "flight")
        count = select(func.count()).select_from(other).where(other.c.vehicle_id == vehicle)
        assert connection.execute(count).scalar_one() == (len(packets) if bare else 0)


@pytest.mark.parametrize("seed", range(2))
def test_bare_packets_may_be_cut_at_any_octet(
    ground: Ground, packets: list[bytes], expected: str, tmp_path: Path, seed: int
) -> None:
    for piece in random_pieces(b"".join(packets), seed, 8):
        ingest(ground, piece, tmp_path)
    assert archive(ground) == expected


@pytest.mark.parametrize("bare", [False, True])
@pytest.mark.parametrize("placed", [False, True])
def test_pieces_of_a_few_octets_are_joined_by_their_place(
    ground: Ground, packets: list[bytes], tmp_path: Path, bare: bool, placed: bool
) -> None:
    """In order of arrival without a position, in any order with one."""
    chosen = packets[:4]
    stream = b"".join(chosen) if bare else encode_cadus(chosen, spacecraft_id=SPACECRAFT, frame_length=223)
    size = 40
    starts = list(range(0, len(stream), size))
    if placed:
        starts = np.random.default_rng(3).permutation(starts).tolist()
    for start in starts:
        (tmp_path / "piece").write_bytes(stream[start : start + size])
        place = Place("stream", start) if placed else None
        ingest_file(
            ground,
            tmp_path / "piece",
            spacecraft_id=SPACECRAFT if bare else None,
            place=place,
        )
    table = repository.PACKETS
    with ground.database.reading() as connection:
        assert set(connection.execute(select(table.c.octets)).scalars()) == set(chosen)


def test_single_octets_are_joined_by_their_place(
    ground: Ground, packets: list[bytes], tmp_path: Path
) -> None:
    stream = encode_cadus(packets[:1], spacecraft_id=SPACECRAFT)
    ingest_file(ground, written(tmp_path, stream[:900]), place=Place("stream", 0))
    for start in np.random.default_rng(1).permutation(np.arange(900, 912)).tolist():
        ingest_file(ground, written(tmp_path, stream[start : start + 1]), place=Place("stream", start))
    assert rows(ground, repository.PACKETS) == 0
    ingest_file(ground, written(tmp_path, stream[912:]), place=Place("stream", 912))
    assert rows(ground, repository.PACKETS) == 1


def test_octets_that_wait_are_counted_and_are_no_error(
    ground: Ground, packets: list[bytes], tmp_path: Path
) -> None:
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT)
    first = ingest(ground, stream[300:900], tmp_path)
    assert (first.packets, first.packets_new, first.octets_pending) == (0, 0, 600)
    with ground.database.reading() as connection:
        record = repository.newest(connection, repository.INGESTS, Paging())[0][0]
    assert (record["state"], record["error"]) == ("done", None)
    assert record["accounting"]["octets_pending"] == 600
    last = ingest(ground, stream[900:2000], tmp_path)
    assert (last.frames_joined, last.packets_new) == (0, 0)
    both = ingest(ground, stream[:300], tmp_path)
    assert both.frames_joined == 1 and both.packets_joined > 0


def test_octets_that_fit_by_length_and_count_alone_make_no_packet(
    ground: Ground, packets: list[bytes], tmp_path: Path
) -> None:
    """The end of another spacecraft's CADU of the same count: the code shows that it does not belong here."""
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT)
    other = encode_cadus([bytes(reversed(packet)) for packet in packets], spacecraft_id=SPACECRAFT)
    ingest(ground, stream[:700], tmp_path)
    assert ingest(ground, other[700 : 3 * 1279], tmp_path).frames_joined == 0
    assert ingest(ground, stream[700 : 3 * 1279], tmp_path).frames_joined == 1
    kept = set(packets)
    table = repository.PACKETS
    with ground.database.reading() as connection:
        assert set(connection.execute(select(table.c.octets)).scalars()) <= kept


def test_frames_of_two_receivers_are_merged(
    ground: Ground, packets: list[bytes], expected: str, tmp_path: Path
) -> None:
    """Each receiver loses other frames; one sends every frame twice, the other the odd ones first."""
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT, frame_length=223)
    frames = [stream[at : at + 259] for at in range(0, len(stream), 259)]
    ingest(ground, b"".join(2 * frame for k, frame in enumerate(frames) if k % 4), tmp_path)
    assert archive(ground) != expected
    kept = [frame for k, frame in enumerate(frames) if k % 4 != 2]
    ingest(ground, b"".join(kept[1::2] + kept[::2]), tmp_path)
    assert archive(ground) == expected


@pytest.mark.parametrize("bare", [False, True])
def test_pieces_with_a_place_are_not_searched_for_by_content(
    ground: Ground, packets: list[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bare: bool
) -> None:
    """Otherwise, many small pieces would be tried in every order for each new piece."""
    roles: list[int] = []
    original = edges.candidates
    monkeypatch.setattr(
        edges,
        "candidates",
        lambda connection, domain, role, **wanted: (
            roles.append(role) or original(connection, domain, role, **wanted)
            if not domain.startswith("channel")
            else original(connection, domain, role, **wanted)
        ),
    )
    chosen = packets[:2]
    stream = b"".join(chosen) if bare else encode_cadus(chosen, spacecraft_id=SPACECRAFT, frame_length=223)
    for start in range(len(stream) - len(stream) % 60, -1, -60):
        ingest_file(
            ground,
            written(tmp_path, stream[start : start + 60]),
            spacecraft_id=SPACECRAFT if bare else None,
            place=Place("stream", start),
        )
    assert rows(ground, repository.PACKETS) == 2
    assert MIDDLE not in roles


def test_a_piece_is_stored_in_few_transactions(ground: Ground, packets: list[bytes], tmp_path: Path) -> None:
    """Each commit waits for the disk: entered, read, joined (CADU, packets), correlated and accounted for."""
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT)
    middle = len(stream) // 2
    ingest(ground, stream[:middle], tmp_path)
    commits = []
    event.listen(
        ground.database.engine, "commit", lambda c: commits.append(c.get_execution_options()["linna_write"])
    )
    assert ingest(ground, stream[middle:], tmp_path).frames_joined == 1
    assert len(commits) <= 6


@pytest.mark.parametrize("order", [(0, 3, 2, 1), (3, 0, 1, 2), (2, 0, 3, 1)])
def test_the_beginning_of_another_cadu_that_the_code_repairs_is_not_used_up(
    ground: Ground, packets: list[bytes], expected: str, tmp_path: Path, order: tuple[int, ...]
) -> None:
    """Two CADUs are cut at the same octet; 73 wrong octets of a frame are within what the code corrects.

    A third piece of the first CADU keeps its end from being repaired in the same way.
    """
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT)
    cuts = [0, 1279 + 77, 1279 + 300, 3 * 1279 + 77, len(stream)]
    pieces = [stream[a:b] for a, b in itertools.pairwise(cuts)]
    for number in order:
        ingest(ground, pieces[number], tmp_path)
    assert archive(ground) == expected


class PowerFailure(Exception):
    """The process ends here."""


@pytest.mark.parametrize("shuffled", [False, True])
def test_an_ingest_that_ends_after_any_commit_is_made_up_for_by_the_next(
    packets: list[bytes], expected: str, tmp_path: Path, shuffled: bool
) -> None:
    """A CADU of three pieces, with packets that reach into its neighbours; the piece that completes it is cut off."""
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT)
    pieces = [stream[:1700], stream[1700:2300], stream[2300:]]
    if shuffled:
        pieces = [pieces[2], pieces[0], pieces[1]]
    for commits in range(1, 8):
        with open_ground(tmp_path / f"{commits}") as ground:
            for piece in pieces[:2]:
                ingest(ground, piece, tmp_path)
            dialect, left = ground.database.engine.dialect, [commits]
            commit = dialect.do_commit

            def failing(connection: Any, commit: Any = commit, left: list[int] = left) -> None:
                commit(connection)
                left[0] -= 1
                if left[0] == 0:
                    raise PowerFailure

            dialect.do_commit = failing
            with contextlib.suppress(PowerFailure):
                ingest(ground, pieces[2], tmp_path)
            dialect.do_commit = commit
            ingest(ground, pieces[2], tmp_path)
            assert archive(ground) == expected, f"after commit {commits}"
            with ground.database.reading() as connection:
                stored = connection.execute(select(func.sum(repository.PIECES.c.packets_stored))).scalar_one()
            assert stored == len(packets), f"after commit {commits}"


def ingest_pieces(url: str, home: str, pieces: list[tuple[int, bytes]], placed: bool) -> None:
    """Ingest pieces as one worker process."""
    with open_ground(Path(home), database_url=url) as ground:
        for number, (start, octets) in enumerate(pieces):
            path = Path(home) / f"piece-{os.getpid()}-{number}"
            path.write_bytes(octets)
            place = Place("stream", start) if placed else None
            for attempt in range(20):
                try:
                    ingest_file(ground, path, place=place)
                    break
                except DatabaseBusy:
                    assert attempt < 19


@pytest.mark.parametrize("placed", [True, False])
@pytest.mark.parametrize("seed", [4, pytest.param(5, marks=pytest.mark.campaign)])
def test_two_workers_give_the_same_archive(
    packets: list[bytes],
    expected: str,
    tmp_path: Path,
    migrated_postgres: Callable[[], str],
    seed: int,
    placed: bool,
) -> None:
    """Neighbours are ingested at the same time by different processes; every third piece by both.

    Without places no CADU is cut more often than `MIDDLES_IN_A_CADU` allows.
    """
    url = migrated_postgres()
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT)
    cuts = np.unique(np.random.default_rng(seed).integers(1, len(stream), 24 if placed else 10)).tolist()
    pieces = [(a, stream[a:b]) for a, b in itertools.pairwise([0, *cuts, len(stream)])]
    shares = [[one for k, one in enumerate(pieces) if k % 2 == half or k % 3 == 0] for half in (0, 1)]
    context = multiprocessing.get_context("spawn")
    workers = [
        context.Process(target=ingest_pieces, args=(url, str(tmp_path / "home"), share, placed))
        for share in shares
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(120)
        assert worker.exitcode == 0
    with open_ground(tmp_path / "home", database_url=url) as ground:
        assert archive(ground) == expected
        table = repository.INGESTS
        with ground.database.reading() as connection:
            records = connection.execute(select(table.c.accounting)).scalars().all()
        assert sum(one["packets_new"] for one in records) == len(packets)


def written(folder: Path, octets: bytes) -> Path:
    (folder / "piece").write_bytes(octets)
    return folder / "piece"
