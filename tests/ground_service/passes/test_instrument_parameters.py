"""Parameters of optional instruments: every field of a sample has a series at the times of the samples."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from ground_service.errors import NotFound
from ground_service.ground import Ground
from ground_service.ingest.service import ingest_file
from ground_service.passes.parameters import pass_parameters
from ground_service.passes.service import define_pass, parameter_series
from lunar.timescales import parse_utc, ticks_from_utc_ns
from tests.ground_service.conftest import NS, SPACECRAFT, encode_downlink
from tmtc.dictionary import DICTIONARY

START = parse_utc("2029-08-07T06:00:00Z")
SECOND = 1 << 16


def altimeter(ranges: list[list[float]]) -> list[bytes]:
    """Packets every 15 s with a sample every 5 s before them."""
    first = int(ticks_from_utc_ns(np.array([START]))[0])
    return [
        DICTIONARY.pack(
            "altimeter",
            {
                "frame_number": k,
                "frame_ticks": first + 15 * SECOND * k,
                "items": [
                    {
                        "sample_ticks": first + (15 * k + 5 * (i - 3)) * SECOND,
                        "sample_status": "used",
                        "range_m": value,
                        "innovation": math.nan,
                        "innovation_sigma": math.nan,
                    }
                    for i, value in enumerate(row)
                ],
            },
            ticks=first + 15 * SECOND * k,
            sequence_count=k,
        )
        for k, row in enumerate(ranges)
    ]


@pytest.fixture
def pass_id(ground: Ground, tmp_path: Path) -> int:
    path = tmp_path / "downlink.cadu"
    path.write_bytes(encode_downlink(altimeter([[1.0, 2.0, math.nan], [4.0, 5.0, 6.0]])))
    ingest_file(ground, path)
    return define_pass(
        ground, name="p", start_utc_ns=START, stop_utc_ns=START + 60 * NS, spacecraft_id=SPACECRAFT
    )


def test_a_field_of_a_sample_is_listed_and_has_a_series(ground: Ground, pass_id: int) -> None:
    (listed,) = [
        one for one in pass_parameters(ground, pass_id).parameters if one.name == "altimeter.range_m"
    ]
    assert (listed.packet, listed.source, listed.unit) == ("altimeter", "dictionary", "m")
    found = parameter_series(ground, pass_id, "altimeter.range_m", 100)
    assert found.buckets.mean.tolist() == [1.0, 2.0, 4.0, 5.0, 6.0]
    np.testing.assert_allclose(
        (found.buckets.start_utc_ns - START) / NS, [-15.0, -10.0, 0.0, 5.0, 10.0], atol=1e-3
    )


def test_an_instrument_that_sent_nothing_has_an_empty_series(ground: Ground, pass_id: int) -> None:
    assert parameter_series(ground, pass_id, "star_tracker.roll_arcsec", 100).samples == 0
    with pytest.raises(NotFound, match=r"altimeter\.rang"):
        parameter_series(ground, pass_id, "altimeter.rang", 100)
