"""Data of the wrong time: yesterday's in the middle of today's, and references that do not reach the pass."""

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ground_service.evaluation.service import make_report, pass_summary
from ground_service.ground import Ground
from ground_service.ingest.service import ingest_file
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.service import add_mission
from ground_service.passes.service import completeness, define_pass
from lunar.ephemeris import ephemeris_from_states
from lunar.messages.ephemeris_files import load_ephemeris
from lunar.messages.oem import save_oem
from lunar.timescales import parse_utc, ticks_from_utc_ns
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus

NS = 1_000_000_000
DAY = 86_400
START = parse_utc("2029-08-07T06:00:00Z")
FRAMES = 200
MISSION = b"""
name = "test"
[spacecraft]
id = 76
[frames]
orientation = "IAU WGCCRE 2009"
"""


def housekeeping(day: int) -> list[bytes]:
    """A packet every ten seconds; the counts of a day go on where those of the day before ended."""
    values: dict[str, Any] = {field.name: 1 for field in DICTIONARY.packet("housekeeping").fields}
    first = int(ticks_from_utc_ns(START + day * DAY * NS))
    return [
        DICTIONARY.pack(
            "housekeeping",
            {**values, "frames_processed": k},
            ticks=first + k * 10 * 65_536,
            sequence_count=(16_300 + (day + 1) * FRAMES + k) % 16_384,
        )
        for k in range(FRAMES)
    ]


def day_pass(ground: Ground, day: int) -> int:
    start = START + day * DAY * NS
    return define_pass(
        ground, name=str(day), start_utc_ns=start, stop_utc_ns=start + 10 * FRAMES * NS, spacecraft_id=76
    )


def test_bursts_of_yesterday_in_todays_stream_fall_into_their_own_day(ground: Ground, tmp_path: Path) -> None:
    rng = random.Random(1)
    today, yesterday = housekeeping(0), housekeeping(-1)
    stream: list[bytes] = []
    while today or yesterday:
        burst = yesterday if yesterday and (not today or rng.random() < 0.3) else today
        for _ in range(min(rng.randint(1, 25), len(burst))):
            stream.append(burst.pop(0))
    (tmp_path / "d.cadu").write_bytes(encode_cadus(stream, spacecraft_id=76))
    assert ingest_file(ground, tmp_path / "d.cadu").packets_new == 2 * FRAMES
    for day in (0, -1):
        found = completeness(ground, day_pass(ground, day))
        assert (found.packets, found.lost, found.conflicts) == (FRAMES, 0, 0)


@pytest.mark.parametrize(("share", "covered"), [(0.0, False), (0.5, True)])
def test_a_reference_that_does_not_cover_gives_figures_where_it_does(
    ground: Ground, synthetic_pass: Any, tmp_path: Path, share: float, covered: bool
) -> None:
    whole = load_ephemeris(synthetic_pass.folder / "reference.oem")
    first, last = int(synthetic_pass.utc_ns[0]), int(synthetic_pass.utc_ns[-1])
    stop = first + int(share * (last - first))
    times = np.arange(first - 3600 * NS if share == 0.0 else first - 300 * NS, stop - 60 * NS, 15 * NS)
    times = times[(times >= whole.start_utc_ns) & (times <= whole.stop_utc_ns)]
    save_oem(ephemeris_from_states(times, *whole.at(times)), tmp_path / "part.oem")
    add_ephemeris(ground, ground.files.put_file(tmp_path / "part.oem"), name="part")
    add_mission(ground, MISSION)
    ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
    key = define_pass(ground, name="p", start_utc_ns=first, stop_utc_ns=last, spacecraft_id=76)
    figures = pass_summary(ground, key)["navigation"]
    found = figures.get("spherical", {"median_3d_m": None})["median_3d_m"]
    assert found == (pytest.approx(130.0, abs=1.0) if covered else None)
    assert make_report(ground, key).report_id
