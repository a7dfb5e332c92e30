"""Verification ingests raw files again as in their first ingest."""

import itertools
from pathlib import Path
from typing import Any

import pytest

from ground_service.ground import Ground
from ground_service.ingest.service import Place, ingest_file
from ground_service.worker.integrity import verify
from tmtc.dictionary import DICTIONARY
from tmtc.downlink import encode_cadus

SPACECRAFT = 76


def stream_of(spacecraft: int, count: int = 40) -> bytes:
    values = {"event_id": "boot", "frame_number": 0, "value_1": 0.0, "value_2": 0.0}
    packets = [
        DICTIONARY.pack("event_info", values, ticks=k << 16, sequence_count=k) for k in range(1, count + 1)
    ]
    return encode_cadus(packets, spacecraft_id=spacecraft)


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
    result = verify(ground, deep=True)
    assert (result.verdict, result.damaged) == ("intact", [])
