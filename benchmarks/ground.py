"""The ground service measured: python -m benchmarks ground.

A mixed downlink as CADUs (housekeeping, detections of 20 craters, navigation states, events in equal numbers) stored
packet by packet and decoded, by processor time of this process (not of a database server); down-sampled reads over one
parameter, compared with reading rows; ordinary reads at a steady rate; memory of the service while a downlink comes in.
"""

import gc
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

STATE_BLOCK = 200_000
API_PACKETS = 20_000
START = parse_utc("2029-08-07T00:00:00Z")
STEP_NS = 100_000_000


def mixed_downlink(count: int, start_utc_ns: int = START, step_ns: int = STEP_NS) -> bytes:
    """CADUs that hold `count` packets of four kinds, one of each kind a step."""
    rng = np.random.default_rng(1)
    sequencer = PacketSequencer()
    housekeeping: dict[str, Any] = {field.name: 1 for field in DICTIONARY.packet("housekeeping").fields}
    packets = []
    for k in range(count // 4):
        ticks = int(ticks_from_utc_ns(start_utc_ns + k * step_ns))
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


def ingest(packets: int, database_url: str | None) -> tuple[float, float]:
    """Packets a second of processor time of one ingest into an empty archive, and of the same ingest again."""
    with tempfile.TemporaryDirectory() as folder:
        stream = Path(folder) / "mixed.cadu"
        stream.write_bytes(mixed_downlink(packets))
        warm = Path(folder) / "warm.cadu"
        warm.write_bytes(mixed_downlink(400))
        if database_url:
            prepare_database(database_url, upgrade=True).engine.dispose()
        with open_ground(Path(folder) / "home", database_url=database_url) as ground:
            ingest_file(ground, warm, instance="warm")
            rates = []
            for _ in range(2):
                gc.collect()  # garbage of the preparation would be collected in one of the measurements
                processor = time.process_time()
                result = ingest_file(ground, stream)
                rates.append(result.packets / (time.process_time() - processor))
    return rates[0], rates[1]


def definition(packets: int, step_ns: int = STEP_NS) -> dict[str, Any]:
    """A pass over all of `mixed_downlink(packets)`."""
    stop = format_utc(START + packets * step_ns // 4)
    return {"name": "all", "start": format_utc(START), "stop": stop, "spacecraft_id": 76}


def states(rows: int, queries: int = 40) -> tuple[float, float]:
    """Milliseconds of down-sampled reads over a parameter (95 %), and of reading all rows."""
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
            ground.write(store_samples, vehicle, DICTIONARY.version, {"navigation_states": columns}, number + 1)
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
        times = []
        for key in keys:
            clock = time.perf_counter()
            state_series(ground, key, "paper", ("altitude_m",), 2000)
            times.append(1e3 * (time.perf_counter() - clock))
        with ground.database.reading() as connection:
            clock = time.perf_counter()
            stop = first + rows // 10 * ticks_a_row
            where = (vehicle, first, stop, DICTIONARY.version)
            telemetry.sample_arrays(connection, "navigation_states", where, ("ticks", "altitude_m"))
            all_of_a_tenth = time.perf_counter() - clock
    return float(np.percentile(times, 95)), 1e4 * all_of_a_tenth


def rows() -> Iterator[Row]:
    """Yield a smaller run of every part; lost packets, errors and memory that grows with the file are errors."""

    def ingested(database: str, url: str | None) -> Row:
        new, again = ingest(24_000, url)
        return Row(f"ingest, {database}, of processor time", new, "packets/s", "packets that are stored already", again)

    yield ingested("sqlite", None)
    try:
        with tempfile.TemporaryDirectory() as folder, PostgresServer(Path(folder)) as server:
            yield ingested("postgresql", server.url)
    except GroundError:
        yield Row("ingest, postgresql: not measured, PostgreSQL is not installed", 0.0, "packets/s")
    part, every = states(1_000_000)
    yield Row("states of 1 M rows, 95 %", part, "ms", "reading every row", every)
    yield answers_under_load(mixed_downlink(API_PACKETS), definition(API_PACKETS), 50.0, 10.0)
    yield memory_of_a_stream(mixed_downlink(24_000), 200)
