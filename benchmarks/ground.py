"""The ground service measured: python -m benchmarks.ground [--only sqlite postgresql states api stream] [--packets N].

`sqlite`, `postgresql`: a mixed downlink as CADUs (housekeeping, detections of 20 craters, navigation states, events in
equal numbers) stored packet by packet and decoded; rates are by processor time (of this process: not of a database
server) and by the clock. `states`: down-sampled reads over one parameter, compared with reading rows. `api`: ordinary
reads at a steady rate. `stream`: memory of the service while a long downlink comes in.
"""

import argparse
import gc
import json
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._ground_service import answers_under_load, memory_of_a_stream
from benchmarks._rows import Row
from benchmarks._servers import PostgresServer
from ground_service.errors import GroundError
from ground_service.ground import open_ground
from ground_service.ingest.service import ingest_file
from ground_service.passes.service import define_pass, state_series
from ground_service.store.database import prepare_database
from ground_service.store.vehicles import vehicle_id
from ground_service.telemetry import store as telemetry
from ground_service.telemetry.rollups import STATE_VALUES
from ground_service.telemetry.writing import store_samples
from lunar.timescales import format_utc, parse_utc, ticks_from_utc_ns
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.packets.space_packets import PacketSequencer

PARTS = ("sqlite", "postgresql", "states", "api", "stream")
STATE_BLOCK = 200_000
API_PACKETS = 20_000
VALUES_PER_PACKET = (24 + 4 + 20 * 6 + 17 + 5) / 4
START = parse_utc("2029-08-07T00:00:00Z")
STEP_NS = 100_000_000


def mixed_downlink(count: int, start_utc_ns: int = START) -> bytes:
    """CADUs that hold `count` packets of four kinds, ten of each kind a second."""
    rng = np.random.default_rng(1)
    sequencer = PacketSequencer()
    housekeeping: dict[str, Any] = {field.name: 1 for field in DICTIONARY.packet("housekeeping").fields}
    packets = []
    for k in range(count // 4):
        ticks = int(ticks_from_utc_ns(start_utc_ns + k * STEP_NS))
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


def ingest(packets: int, database_url: str | None) -> dict[str, Any]:
    """Rates of one ingest into an empty archive, and of the same ingest again."""
    with tempfile.TemporaryDirectory() as folder:
        stream = Path(folder) / "mixed.cadu"
        stream.write_bytes(mixed_downlink(packets))
        warm = Path(folder) / "warm.cadu"
        warm.write_bytes(mixed_downlink(400))
        if database_url:
            prepare_database(database_url, upgrade=True).engine.dispose()
        with open_ground(Path(folder) / "home", database_url=database_url) as ground:
            ingest_file(ground, warm, instance="warm")
            figures: dict[str, Any] = {"packets": packets}
            for name in ("new", "repeated"):
                gc.collect()  # garbage of the preparation would be collected in one of the measurements
                clock, processor = time.perf_counter(), time.process_time()
                result = ingest_file(ground, stream)
                clock, processor = time.perf_counter() - clock, time.process_time() - processor
                figures[f"{name}_packets_per_s"] = round(result.packets / clock)
                figures[f"{name}_packets_per_cpu_s"] = round(result.packets / processor)
                figures[f"{name}_values_per_s"] = round(result.packets * VALUES_PER_PACKET / clock)
                figures[f"{name}_values_per_cpu_s"] = round(result.packets * VALUES_PER_PACKET / processor)
    return figures


def definition(packets: int) -> dict[str, Any]:
    """A pass over all of `mixed_downlink(packets)`."""
    stop = format_utc(START + packets * STEP_NS // 4)
    return {"name": "all", "start": format_utc(START), "stop": stop, "spacecraft_id": 76}


def states(rows: int, queries: int = 40) -> dict[str, Any]:
    """Time down-sampled reads over a parameter, whole and in part, and reading all rows of a part."""
    ticks_a_row = 6_554  # ten a second
    with tempfile.TemporaryDirectory() as folder, open_ground(Path(folder)) as ground:
        vehicle = ground.write(vehicle_id, 76, "flight")
        first = int(ticks_from_utc_ns(START))
        rng = np.random.default_rng(1)
        for start in range(0, rows, STATE_BLOCK):
            count = min(STATE_BLOCK, rows - start)
            number = np.arange(start, start + count)
            columns: dict[str, Any] = {name: rng.normal(size=count) for name in STATE_VALUES}
            columns["matched"] = np.full(count, 5)
            columns |= {
                "packet": np.arange(count),
                "ticks": first + number * ticks_a_row,
                "packet_ticks": first + number * ticks_a_row,
                "frame_number": number,
                "estimator": np.zeros(count, dtype=np.int64),
                "outcome": np.ones(count, dtype=np.int64),
            }
            ground.write(
                store_samples, vehicle, DICTIONARY.version, {"navigation_states": columns}, number + 1
            )
        span_ns = rows * STEP_NS
        keys = []
        for part in range(queries):
            # From the whole down to a thousandth, somewhere.
            length = span_ns / 10 ** (3.0 * part / max(queries - 1, 1))
            begin = START + int(rng.uniform(0.0, span_ns - length)) if part else START - STEP_NS
            keys.append(
                define_pass(
                    ground,
                    name=str(part),
                    start_utc_ns=begin,
                    stop_utc_ns=begin + int(length) + 2 * STEP_NS,
                    spacecraft_id=76,
                )
            )
        times, processor = [], []
        for key in keys:
            clock, cpu = time.perf_counter(), time.process_time()
            state_series(ground, key, "paper", ("altitude_m",), 2000)
            times.append(1e3 * (time.perf_counter() - clock))
            processor.append(1e3 * (time.process_time() - cpu))
        with ground.database.reading() as connection:
            clock = time.perf_counter()
            stop = first + rows // 10 * ticks_a_row
            where = (vehicle, first, stop, DICTIONARY.version)
            telemetry.sample_arrays(connection, "navigation_states", where, ("ticks", "altitude_m"))
            all_of_a_tenth = time.perf_counter() - clock
    return {
        "states_rows": rows,
        "states_whole_ms": round(times[0], 1),
        "states_p50_ms": round(float(np.percentile(times, 50)), 1),
        "states_p95_ms": round(float(np.percentile(times, 95)), 1),
        "states_p95_cpu_ms": round(float(np.percentile(processor, 95)), 1),
        "every_row_of_a_tenth_ms": round(1e3 * all_of_a_tenth, 1),
    }


def postgres(packets: int, url: str | None) -> dict[str, Any]:
    """As `ingest`, into PostgreSQL: at `url`, or a private server where PostgreSQL is installed."""
    if url:
        return ingest(packets, url)
    with tempfile.TemporaryDirectory() as folder, PostgresServer(Path(folder)) as server:
        return ingest(packets, server.url)


def rows() -> Iterator[Row]:
    """Yield a smaller run of every part; lost packets, errors and memory that grows with the file are errors."""
    for database in ("sqlite", "postgresql"):
        try:
            found = ingest(24_000, None) if database == "sqlite" else postgres(24_000, None)
        except GroundError:
            yield Row("ingest, postgresql: not measured, PostgreSQL is not installed", 0.0, "packets/s")
            continue
        again = found["repeated_packets_per_cpu_s"]
        what = f"ingest, {database}, of processor time"
        yield Row(what, found["new_packets_per_cpu_s"], "packets/s", "packets that are stored already", again)
    found = states(1_000_000)
    every = 10.0 * found["every_row_of_a_tenth_ms"]
    yield Row("states of 1 M rows, 95 %", found["states_p95_ms"], "ms", "reading every row", every)
    found = answers_under_load(mixed_downlink(API_PACKETS), definition(API_PACKETS), 50.0, 10.0)
    wrong = f"errors {found['api_errors']}" if found["api_errors"] else ""
    yield Row("API reads at 50/s, 95 %", found["api_p95_ms"], "ms", "median", found["api_p50_ms"], wrong)
    found = memory_of_a_stream(mixed_downlink(24_000), 200)
    idle, peak = found["idle_anonymous_mib"], found["stream_peak_anonymous_mib"]
    wrong = (
        ""
        if found["stream_state"] == "done" and peak < idle + 300
        else f"{found['stream_state']}, {peak} MiB"
    )
    yield Row("upload of 200 MB: anonymous memory, peak", peak, "MiB", "idle", idle, wrong)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--packets", type=int, default=100_000)
    parser.add_argument("--rows", type=int, default=10_000_000, help="rows of the parameter that is queried")
    parser.add_argument("--rate", type=float, default=100.0, help="requests a second")
    parser.add_argument("--seconds", type=float, default=20.0, help="of requests")
    parser.add_argument("--stream-mb", type=int, default=2000, help="size of the downlink that streams in")
    parser.add_argument("--database-url", help="an empty PostgreSQL database; default: a temporary server")
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=" ".join(PARTS)
    )
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was started is ended
    figures: dict[str, Any] = {}
    for name in given.only:
        print(f"{name} ...", file=sys.stderr, flush=True)
        if name == "sqlite":
            figures[name] = ingest(given.packets, None)
        elif name == "postgresql":
            figures[name] = postgres(given.packets, given.database_url)
        elif name == "states":
            figures[name] = states(given.rows)
        elif name == "api":
            stream = mixed_downlink(API_PACKETS)
            figures[name] = answers_under_load(stream, definition(API_PACKETS), given.rate, given.seconds)
        else:
            figures[name] = memory_of_a_stream(mixed_downlink(given.packets), given.stream_mb)
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
