"""Yamcs 5.12 as a peer of the archive: python -m benchmarks yamcs.

Both receive the same frames of an hour of telemetry (housekeeping, detections, states and events in equal numbers) and
keep packets and parameters; then the values of housekeeping are read back over HTTP. Rates are by processor time of the
servers (with the JVM's own compiler). Yamcs is started with what `linna tm yamcs` writes, from the environment that
`python -m benchmarks.campaigns.compatibility --row Yamcs` makes.
"""

import socket
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path

import httpx

from benchmarks._ground_service import processor_s, resident_mib, wait_for_job
from benchmarks._rows import ROOT, NotMeasured, Row
from benchmarks._servers import Deployment
from benchmarks._yamcs import Server, until
from benchmarks.ground import START, definition, mixed_downlink
from lunar.constants import DAY_NS
from lunar.timescales import format_utc
from studies.harness.parts import free_port
from tmtc.dictionary.payload import DICTIONARY
from tmtc.link.frame_reading import plain_frames
from tmtc.link.settings import LinkSettings

ENVIRONMENT = ROOT / "build" / "compatibility" / "environments" / "yamcs" / "bin" / "python"
PACKETS, WARM = 36_000, 4_000
STEP_NS = 4 * 3_600 * 1_000_000_000 // PACKETS
FRAMES_A_TURN, TURN_S = 50, 5.0
"""Datagrams that are sent before Yamcs is asked whether it has them, and the time after which they are lost."""
PACKET = "housekeeping"
FIGURES = (
    ("store", "frames to durable packets and parameters", "packets/s"),
    ("read", "values of an hour of housekeeping read as CSV", "values/s"),
    ("memory", "largest memory of the server", "MiB"),
    ("start", "start until it answers", "s"),
)
spent = partial(processor_s, children=True)


def ours(stream: bytes, warm: bytes) -> dict[str, float]:
    """Return the figures of our service on SQLite."""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as name, Deployment(Path(name)) as service:
        part, found = service.parts["api 1"], {"start": time.monotonic() - begin}
        with httpx.Client(base_url=f"{service.apis[0]}/api/v1", timeout=600.0) as client:

            def send(octets: bytes) -> None:
                answer = client.post("/telemetry?spacecraft_id=76", content=octets)
                wait_for_job(client, answer.raise_for_status().json()["job_id"])

            send(warm)
            used = spent(part)
            send(stream)
            found["store"] = PACKETS / (spent(part) - used)
            found["memory"] = resident_mib(part, "VmHWM")
            key = client.post("/passes", json=definition(PACKETS, STEP_NS)).raise_for_status().json()["id"]
            used = spent(part)
            text = client.get(f"/passes/{key}/packets/{PACKET}?format=csv").raise_for_status().text
            found["read"] = _values(text) / (spent(part) - used)
    return found


def _values(table: str) -> int:
    return (len(table.splitlines()) - 1) * len(DICTIONARY.packet(PACKET).fields)


def theirs(stream: bytes, warm: bytes) -> dict[str, float]:
    """Return the figures of Yamcs; the packets that its archive has are counted."""
    http, frames = free_port(), free_port()
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name) / "instance"
        command = [sys.executable, "-m", "linna", "tm", "yamcs", "--out", str(folder), "--frame-port", str(frames)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        begin = time.monotonic()
        server = Server(stack, folder, http, ENVIRONMENT)
        found = {"start": time.monotonic() - begin}
        before = _send(server, warm, frames)
        used = spent(server.part)
        stored = _send(server, stream, frames) - before
        found["store"] = stored / (spent(server.part) - used)
        found["lost"] = PACKETS - stored
        found["memory"] = resident_mib(server.part, "VmHWM")
        used = spent(server.part)
        number = _values(_exported(server))
        found["read"] = number / (spent(server.part) - used)
    return found


def _send(server: Server, cadus: bytes, port: int) -> int:
    """Send frames one by one, as fast as they are taken; return the number of packets that the archive has then."""
    frames = list(plain_frames([cadus], LinkSettings()))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for at in range(0, len(frames), FRAMES_A_TURN):
            turn = frames[at : at + FRAMES_A_TURN]
            wanted = _count(server, "frames") + len(turn)
            for frame in turn:
                out.sendto(frame, ("127.0.0.1", port))
            with suppress(TimeoutError):
                until(lambda wanted=wanted: _count(server, "frames") >= wanted, TURN_S, "frames", 0.02)
    return _count(server, "frames.vc0")


def _count(server: Server, link: str) -> int:
    return int(server.get(f"/links/linna/{link}")["dataInCount"])


def _exported(server: Server) -> str:
    names = ",".join(f"/LINNA/{PACKET}_{field.name}" for field in DICTIONARY.packet(PACKET).fields)
    span = {"start": format_utc(START), "stop": format_utc(START + PACKETS // 4 * STEP_NS)}
    query = urllib.parse.urlencode({"parameters": names, **span})
    with urllib.request.urlopen(f"{server.url}/archive/linna:exportParameterValues?{query}", timeout=600) as answer:
        return str(answer.read().decode())


def rows() -> Iterator[Row]:
    """Yield packets to durable storage, values read back, memory and start, compared with those of Yamcs."""
    if not ENVIRONMENT.is_file():
        raise NotMeasured("Yamcs is not installed: python -m benchmarks.campaigns.compatibility --row Yamcs")
    stream, warm = mixed_downlink(PACKETS, START, STEP_NS), mixed_downlink(WARM, START - DAY_NS, STEP_NS)
    mine, other = ours(stream, warm), theirs(stream, warm)
    lost = f"Yamcs lost {other['lost']:.0f} packets" if other["lost"] else ""
    for key, what, unit in FIGURES:
        yield Row(what, mine[key], unit, "Yamcs 5.12.8", other[key], lost if key == "store" else "")
