"""Time correlation of a spacecraft whose telemetry comes over a link with reception times."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from ground_service.contacts.links import service
from ground_service.ground import Ground
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.timekeeping import recorrelation
from ground_service.missions.timekeeping.service import spacecraft_correlations, spacecraft_time_reports
from lunar.ephemeris import Ephemeris, ephemeris_from_states
from lunar.messages.oem import save_oem
from lunar.timescales import ticks_from_utc_ns
from lunar.visibility import GroundStation, link
from tests.ground_service.conftest import START, circular_states
from tests.ground_service.contacts.links.conftest import Station, declare, operated
from tests.serving import wait_for
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import DownlinkEncoder
from tmtc.link.settings import LinkSettings

NS = 1_000_000_000
REPORTS = 30
OFFSET_S, DRIFT = 0.4, 5e-6
TICK_NS = 15_259
PLACE = GroundStation("lab", np.radians(40.0), np.radians(100.0), 500.0, 0.0)
"""A station that only the mission description knows."""

MISSION = """
[link]
frame_length = 1115
coding = "rs"
randomiser = "legacy"
frame_checksum = true
[link.stations.lab]
latitude_deg = 40.0
longitude_deg = 100.0
height_m = 500.0
header_octets = 8
time_code = "unix_ns"
time_offset = 0
"""


@pytest.fixture(scope="module")
def orbit() -> Ephemeris:
    every = START + np.arange(-1800, 7200, 60, dtype=np.int64) * NS
    return ephemeris_from_states(every, *circular_states(every))


def downlink(orbit: Ephemeris, station_clock_ns: int) -> bytes:
    """Return records with a time report every two minutes, each sent when it was made, of a clock that drifts."""
    encoder = DownlinkEncoder(76, LinkSettings())
    records = b""
    for k in range(REPORTS):
        received = START + k * 120 * NS
        light_s = float(link(orbit, np.array([received]), PLACE).light_time_s[0])
        sent = received - round(light_s * NS)
        error_s = OFFSET_S + DRIFT * (sent - START) / NS
        ticks = int(ticks_from_utc_ns(sent)) + round(error_s * 65_536)
        values = {"reported_ticks": ticks, "rate_exponent": 4}
        packet = DICTIONARY.pack("time_report", values, ticks=ticks, sequence_count=k)
        records += struct.pack(">q", received + station_clock_ns) + encoder.encode([packet])
    return records


@pytest.mark.parametrize(("station_clock_s", "is_used"), [(0, True), (3600, False), (-3600, False)])
def test_the_clock_is_correlated_from_time_reports_of_a_link(
    either: Ground,
    station: Station,
    orbit: Ephemeris,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    station_clock_s: int,
    is_used: bool,
) -> None:
    save_oem(orbit, tmp_path / "orbit.oem")
    add_ephemeris(either, either.files.put_file(tmp_path / "orbit.oem"), name="orbit")
    declare(either, MISSION + station.link('station = "lab"'))
    octets = downlink(orbit, station_clock_s * NS)
    with operated(either) as runner:
        station.accept().sendall(octets)
        wait_for(lambda: runner.octets_received == len(octets), "the telemetry")
        wait_for(lambda: service.get_link(either, "lab").octets == len(octets), "its account")
    rows = [one for one in spacecraft_correlations(either, 76, "flight") if one.in_force]
    reports = spacecraft_time_reports(either, 76, "flight")
    if not is_used:
        assert rows == [] and reports == []
        return
    (line,) = rows
    assert (line.points, line.rejected, line.method) == (REPORTS, 0, "time reports, light time")
    # The clock is fast by 5 ppm: a tick over an hour is 4 ppb.
    assert line.drift_ppb == pytest.approx(-1e9 * DRIFT, abs=10.0)
    assert line.residual_rms_ns is not None and line.residual_max_ns is not None
    assert 0.0 < line.residual_rms_ns < line.residual_max_ns < 2 * TICK_NS
    assert {one.station for one in reports} == {"lab"}
    assert max(abs(one.residual_ns) for one in reports) < 2 * TICK_NS
    # The light times are kept; the ephemeris need not be.
    monkeypatch.delattr(recorrelation, "_load")
    assert spacecraft_time_reports(either, 76, "flight") == reports
