"""Ingest into the ground database and a query over it: python -m benchmarks.ground [--packets N] [--database-url URL].

A mixed downlink as CADUs (housekeeping, detections of 20 craters, navigation states, events in equal numbers), stored
packet by packet and decoded. Rates are by processor time and by the clock: on a quiet machine they are alike.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from ground_service.services.ground import open_ground
from ground_service.services.ingest import ingest_file
from ground_service.services.passes import define_pass, state_series
from ground_service.store.database import prepare_database
from lunar.timescales import parse_utc, ticks_from_utc_ns
from tmtc.dictionary import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.packets import PacketSequencer

VALUES_PER_PACKET = (24 + 4 + 20 * 6 + 17 + 5) / 4
START = parse_utc("2029-08-07T00:00:00Z")
STEP_NS = 100_000_000


def mixed_downlink(count: int) -> bytes:
    """CADUs that hold `count` packets of four kinds, ten of each kind a second."""
    rng = np.random.default_rng(1)
    sequencer = PacketSequencer()
    housekeeping: dict[str, Any] = {field.name: 1 for field in DICTIONARY.packet("housekeeping").fields}
    packets = []
    for k in range(count // 4):
        ticks = int(ticks_from_utc_ns(START + k * STEP_NS))
        frame = {"frame_number": k, "image_ticks": ticks}
        items = {
            "u_px": rng.integers(0, 32_000, 20) / 64,
            "v_px": rng.integers(0, 32_000, 20) / 64,
            "diameter_px": rng.integers(600, 3000, 20) / 64,
            "score": rng.integers(0, 255, 20) / 255,
            "size_class": rng.integers(0, 3, 20),
            "sigma_px": np.full(20, 1.0),
        }
        state = {
            "estimator": 0,
            "outcome": 1,
            "latitude_deg": 60.0 - k * 1e-3,
            "longitude_deg": 300.0,
            "altitude_m": 30e3 + rng.normal(),
            "velocity_icrf_m_s": [1.0, 2.0, 3.0],
            "sigma_rtn_m": [1.0, 2.0, 3.0],
            "nis": 1.0,
            "matched": 5,
        }
        event = {"event_id": 3, "frame_number": k, "value_1": 0.0, "value_2": 1.0}
        for name, values in (
            ("housekeeping", {**housekeeping, "frames_processed": k}),
            ("detections", {**frame, "image_quality": 0, "items": items}),
            ("navigation_state", {**frame, **state}),
            ("event_info", event),
        ):
            apid = DICTIONARY.packet(name).apid
            packets.append(DICTIONARY.pack(name, values, ticks=ticks, sequence_count=sequencer.next(apid)))
    return encode_cadus(packets, spacecraft_id=76)


def measure(packets: int, database_url: str | None) -> dict[str, Any]:
    """Figures of one ingest into an empty archive, of the same ingest again, and of a query over it."""
    with tempfile.TemporaryDirectory() as folder:
        stream = Path(folder) / "mixed.cadu"
        stream.write_bytes(mixed_downlink(packets))
        warm = Path(folder) / "warm.cadu"
        warm.write_bytes(mixed_downlink(400))
        if database_url:
            prepare_database(database_url, upgrade=True).engine.dispose()
        with open_ground(Path(folder) / "home", database_url=database_url) as ground:
            ingest_file(ground, warm, instance="warm")
            figures: dict[str, Any] = {"database": ground.database.dialect, "packets": packets}
            for name in ("new", "repeated"):
                clock, processor = time.perf_counter(), time.process_time()
                result = ingest_file(ground, stream)
                clock, processor = time.perf_counter() - clock, time.process_time() - processor
                figures[f"{name}_packets_per_s"] = round(result.packets / clock)
                figures[f"{name}_packets_per_cpu_s"] = round(result.packets / processor)
                figures[f"{name}_values_per_s"] = round(result.packets * VALUES_PER_PACKET / clock)
            pass_id = define_pass(
                ground,
                name="all",
                start_utc_ns=START,
                stop_utc_ns=START + packets * STEP_NS // 4,
                spacecraft_id=76,
            )
            times = []
            for _ in range(20):
                clock = time.perf_counter()
                state_series(ground, pass_id, "paper", ("altitude_m",), 2000)
                times.append(time.perf_counter() - clock)
            figures["states_p95_ms"] = round(1e3 * float(np.percentile(times, 95)), 1)
            figures["states_rows"] = packets // 4
            figures["peak_rss_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--packets", type=int, default=100_000)
    parser.add_argument("--database-url", help="an empty database; default: SQLite")
    arguments = parser.parse_args()
    print(json.dumps(measure(arguments.packets, arguments.database_url), indent=2))


if __name__ == "__main__":
    main()
