"""Verification derives everything again from the raw files, as in their first ingest, and compares."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import text

from ground_service.ground import Ground
from ground_service.ingest.service import Place, ingest_file
from ground_service.store.models import ROLLUPS
from ground_service.store.rows import table_digests
from ground_service.worker.integrity import verify
from ground_service.worker.integrity_store import same_values
from tests.ground_service.conftest import event_packet
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus

SPACECRAFT = 76


def stream_of(spacecraft: int, count: int = 40) -> bytes:
    return encode_cadus(
        [event_packet(k << 16, k, "boot") for k in range(1, count + 1)], spacecraft_id=spacecraft
    )


@pytest.mark.parametrize(
    "stated",
    [
        {"spacecraft_id": SPACECRAFT},
        {"spacecraft_id": SPACECRAFT, "place": Place("s", 100)},
        {"instance": "twin"},
    ],
)
def test_what_was_stated_with_a_downlink_holds_for_its_verification(
    ground: Ground, tmp_path: Path, stated: dict[str, Any]
) -> None:
    """A spacecraft filter excludes the same packets; pieces with a position are joined by position."""
    octets = stream_of(SPACECRAFT) + stream_of(SPACECRAFT + 1)
    place = stated.pop("place", None)
    cuts = [0, len(octets)] if place is None else [*range(0, 1200, 60), len(octets)]
    for start, stop in reversed(list(itertools.pairwise(cuts))):
        (tmp_path / "piece").write_bytes(octets[start:stop])
        stands = None if place is None else Place(place.stream, place.offset + start)
        ingest_file(ground, tmp_path / "piece", place=stands, **stated)
    result = verify(ground, rebuild=True)
    assert (result.verdict, result.damaged) == ("intact", [])


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        ("UPDATE rollups SET rows = rows + 1 WHERE level = 6", "values of its packets, found others"),
        ("DELETE FROM rollups WHERE level = 6", "expected this row, found none"),
    ],
)
def test_a_damaged_row_is_named(either: Ground, tmp_path: Path, damage: str, reason: str) -> None:
    values: dict[str, Any] = {field.name: 1 for field in DICTIONARY.packet("housekeeping").fields}
    packet = DICTIONARY.pack("housekeeping", values, ticks=1 << 16, sequence_count=0)
    (tmp_path / "d.cadu").write_bytes(encode_cadus([packet], spacecraft_id=SPACECRAFT))
    ingest_file(either, tmp_path / "d.cadu")
    assert verify(either, rebuild=True).damaged == []
    with either.database.writing() as connection:
        connection.execute(text(damage))
    assert reason in " ".join(
        f"{one.kind} {one.key}: {one.reason}" for one in verify(either, rebuild=True).damaged
    )
    assert verify(either).damaged == []


def test_an_ingest_before_version_1_has_no_piece(either: Ground, tmp_path: Path) -> None:
    """The spacecraft of the ingest selects the frames."""
    (tmp_path / "d.cadu").write_bytes(stream_of(SPACECRAFT) + stream_of(SPACECRAFT + 1))
    ingest_file(either, tmp_path / "d.cadu", spacecraft_id=SPACECRAFT)
    with either.database.writing() as connection:
        connection.execute(text("DELETE FROM pieces"))
    assert verify(either, rebuild=True).damaged == []


def test_sums_of_roll_ups_may_differ_by_the_order_of_addition(ground: Ground, tmp_path: Path) -> None:
    row = np.array([3.0, 0.6, 0.1, 0.3, 0.0, 0.0, np.inf, -np.inf])
    for index, change, same in ((1, 1e-16, True), (1, 1e-6, False), (3, 1e-16, False), (0, 1.0, False)):
        other = row.copy()
        other[index] += change
        pair = [((1,), (1, 2, 3, one.tobytes())) for one in (row, other)]
        assert same_values(ROLLUPS, *pair) == same


def test_a_rebuild_writes_nothing_to_the_archive(either: Ground, tmp_path: Path) -> None:
    (tmp_path / "d.cadu").write_bytes(stream_of(SPACECRAFT))
    ingest_file(either, tmp_path / "d.cadu")
    with either.database.snapshot() as connection:
        before = table_digests(connection)
    names = sorted(either.files.names())
    assert verify(either, rebuild=True).verdict == "intact"
    with either.database.snapshot() as connection:
        assert table_digests(connection) == before
    assert sorted(either.files.names()) == names
