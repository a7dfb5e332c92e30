"""Ingest: any order, any split, any repetition of the same octets gives the same archive."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import func, select

from ground_service.errors import InvalidInput
from ground_service.services.ground import Ground, open_ground
from ground_service.services.ingest import ingest_file
from ground_service.store import repository
from ground_service.store.canonical import archive_hash
from tmtc.crc import append_crc
from tmtc.downlink import encode_cadus

SPACECRAFT = 76


def ingest(ground: Ground, octets: bytes, folder: Path, name: str = "downlink.bin") -> Any:
    path = folder / name
    path.write_bytes(octets)
    return ingest_file(ground, path, spacecraft_id=SPACECRAFT)


def archive(ground: Ground) -> str:
    with ground.database.reading() as connection:
        return archive_hash(connection, repository.vehicle_id(connection, SPACECRAFT, "flight"))


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
        other = repository.vehicle_id(connection, 33, "flight")
        stored = repository.page(connection, repository.PACKETS, vehicle_id=other)
    assert stored.total == 20


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
        InvalidInput, match=r"noise\.bin: expected a stream of CADUs or of space packets, found 4000"
    ):
        ingest(ground, np.random.default_rng(3).bytes(4000), tmp_path, "noise.bin")
    with ground.database.reading() as connection:
        record = repository.page(connection, repository.INGESTS).rows[0]
    assert record["state"] == "failed"
    assert "noise.bin" in record["error"]


def test_a_missing_file_is_refused(ground: Ground, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="expected a downlink file, found nothing there"):
        ingest_file(ground, tmp_path / "no.bin", spacecraft_id=SPACECRAFT)


def split_anywhere(octets: bytes, data: st.DataObject, smallest: int) -> list[bytes]:
    """Pieces of at least `smallest` octets, cut at any octet, in any order."""
    cuts = [0]
    for _ in range(data.draw(st.integers(1, 5))):
        low, high = cuts[-1] + smallest, len(octets) - smallest
        if low <= high:
            cuts.append(data.draw(st.integers(low, high)))
    pieces = [octets[a:b] for a, b in itertools.pairwise([*cuts, len(octets)])]
    return [pieces[i] for i in data.draw(st.permutations(range(len(pieces))))]


@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_a_stream_of_frames_may_be_cut_at_any_octet(
    data: st.DataObject, packets: list[bytes], expected: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Pieces hold two whole CADUs or more (259 octets each here), so that each has a frame to be placed by."""
    folder = tmp_path_factory.mktemp("cut")
    stream = encode_cadus(packets, spacecraft_id=SPACECRAFT, frame_length=223)
    with open_ground(folder / "home") as ground:
        for piece in split_anywhere(stream, data, 3 * 259):
            ingest(ground, piece, folder)
        assert archive(ground) == expected


@settings(max_examples=10, deadline=None)
@given(data=st.data())
def test_bare_packets_may_be_cut_at_any_octet(
    data: st.DataObject, packets: list[bytes], expected: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Pieces hold a whole packet or more; the longest here has about 600 octets."""
    folder = tmp_path_factory.mktemp("cut")
    smallest = 2 * max(len(packet) for packet in packets)
    with open_ground(folder / "home") as ground:
        for piece in split_anywhere(b"".join(packets), data, smallest):
            ingest(ground, piece, folder)
        assert archive(ground) == expected
