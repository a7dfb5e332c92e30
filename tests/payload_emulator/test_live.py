"""The payload as a process: commanded and watched over TCP; and a fault."""

import base64
import json
import selectors
import socket
import struct
import threading
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.linalg import norm
from pytest import fixture, mark, raises

from lunar.camera import project_mcmf
from lunar.datafolder import find_data
from lunar.frames import mcmf_from_spherical
from lunar.timescales import parse_utc
from payload_emulator.errors import LinkError
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.session.live.console import rims_in_view, step_message
from payload_emulator.session.live.session import LiveSession
from payload_emulator.session.live.station_ports import (
    CLIENT_LIMIT,
    RECORD_HEADER,
    UNSENT_LIMIT_OCTETS,
    Server,
    TelecommandBuffer,
)
from payload_emulator.session.scenario import FaultsSection, parse_scenario
from payload_emulator.session.spacecraft.loading import load_scenario_payload
from payload_emulator.session.spacecraft.loop import StepInput, StepResult, new_spacecraft
from payload_emulator.session.spacecraft.schedule import Operator, fly_scenario
from payload_emulator.session.world.camera import Exposure, expose
from payload_emulator.session.world.world import build_world
from payload_emulator.sim.board.link import Receiver
from payload_emulator.sim.board.platform import FAULT_KINDS
from studies.harness.parts import free_port, listens
from tests.scenarios import live_scenario
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import decode
from tmtc.link.settings import LinkSettings
from tmtc.link.uplink import UplinkEncoder

SCENARIO = live_scenario("live", 3, 240.0)
NO_DATA = find_data(None)
EPOCH = parse_utc("2029-08-07T01:40:00Z")


@fixture(scope="module")
def flown():
    world = build_world(parse_scenario(SCENARIO), NO_DATA)
    return world, load_scenario_payload(world, NO_DATA)[0]


def connected(port):
    return socket.create_connection(("127.0.0.1", port), timeout=900.0)


class Watcher:
    """A client of the live payload."""

    def __init__(self, live):
        self.telemetry = connected(live.ports["telemetry earth"])
        self.telecommands = connected(live.ports["telecommand earth"])
        self.console = connected(live.ports["console"])
        self.lines = self.console.makefile("r")
        self.say("watch")

    def say(self, word):
        self.console.sendall(word.encode() + b"\n")

    def until(self, wanted):
        """Messages up to the first that is wanted."""
        found = []
        for line in self.lines:
            found.append(json.loads(line))
            if wanted(found[-1]):
                return found
        raise AssertionError("the console ended")

    def rest_of_telemetry(self):
        octets = b""
        while part := self.telemetry.recv(65_536):
            octets += part
        length = RECORD_HEADER.size + LinkSettings().cadu_length
        starts = range(RECORD_HEADER.size, len(octets), length)
        return b"".join(octets[start : start + LinkSettings().cadu_length] for start in starts)

    def close(self):
        self.lines.close()
        for connection in (self.telemetry, self.telecommands, self.console):
            connection.close()


@contextmanager
def watched(world, loaded):
    """Fly a payload live, paused at the start, with a client."""
    live = LiveSession(world, loaded, has_operator=True, paused=True)
    thread = threading.Thread(target=live.run, daemon=True)
    watcher = Watcher(live)
    thread.start()
    try:
        yield live, watcher
    finally:
        live.stopping.set()
        thread.join()
        watcher.close()
    assert not thread.is_alive()


@fixture
def running(flown):
    with watched(*flown) as both:
        yield both


def ping(count):
    return DICTIONARY.pack_command("test_connection", {}, sequence_count=count)


def seen_from(world, utc_ns, packets):
    """A step with a nadir image that is not rendered."""
    position = world.truth.positions_mcmf(utc_ns)[0]
    exposure = Exposure(utc_ns, np.zeros((0, 0), np.uint8), np.zeros(9), 0, world.camera_from_mcmf(position))
    return StepResult(StepInput(utc_ns, 0, 1.0, True, 0), exposure, packets, b"")


def test_rings_of_the_catalogue_lie_on_the_rims_of_the_rendered_ground():
    world = build_world(parse_scenario(SCENARIO.replace('"reduced"', '"rendered"')), NO_DATA)
    exposure = expose(world, int(world.frame_utc_ns[0]))
    rings = rims_in_view(world, exposure.utc_ns, exposure.camera_from_mcmf)
    row = {int(one): k for k, one in enumerate(world.terrain.catalogue.ids)}
    craters = world.terrain.measured(np.array([row[one["id"]] for one in rings]))
    position = world.truth.positions_mcmf(exposure.utc_ns)[0]
    axes = (world.true_camera, exposure.camera_from_mcmf, position)
    rims = project_mcmf(*axes, craters.position_mcmf_m)
    sphere = project_mcmf(*axes, mcmf_from_spherical(craters.latitude_rad, craters.longitude_rad, 0.0))
    shown = np.array([[one["u_px"], one["v_px"]] for one in rings])
    assert len(rings) > 20
    assert np.median(norm(shown - rims, axis=1)) < 0.2  # px; what is left is the tilt of rims
    assert norm(shown - sphere, axis=1).max() > 5.0  # px: heights matter
    assert all(one["minor_px"] <= one["diameter_px"] <= one["major_px"] for one in rings)


def test_detections_that_the_payload_identified_have_their_craters(flown):
    world, loaded = flown
    frame = {"frame_number": 0, "image_ticks": 0}
    found = {"u_px": 1.0, "v_px": 2.0, "diameter_px": 9.0, "score": 0.5, "size_class": 0, "sigma_px": 0.5}
    pairs = {**frame, "items": [{"detection": 1, "crater_id": 4711}]}
    detections = {**frame, "image_quality": 0, "items": [found, found, found]}
    packets = [
        DICTIONARY.pack(name, values, ticks=0, sequence_count=0)
        for name, values in (("identifications", pairs), ("detections", detections))
    ]
    turn = seen_from(world, int(world.frame_utc_ns[0]), packets)
    message = step_message(new_spacecraft(world, loaded), turn)
    assert [one.get("crater_id") for one in message["detections"]] == [None, 4711, None]
    assert message["terrain"] == {"name": world.terrain.name, "real": False}


def test_a_session_of_watching_stepping_and_commanding(running):
    _, watcher = running
    watcher.say("step")
    watcher.say("step")
    first = watcher.until(lambda message: message["kind"] == "frame")[-1]
    assert first["mode"] == "observing" and first["paused"] and first["frame"] == 0
    assert base64.b64decode(first["image_jpeg"])[:3] == b"\xff\xd8\xff"
    assert first["catalogue"] and {"id", "u_px", "v_px", "diameter_px"} <= set(first["catalogue"][0])
    assert first["estimates"]["spherical"]["outcome"] == "anchored"
    assert first["estimates"]["spherical"]["error_m"] < 50.0
    # A frame stepped by hand restarts the odometry.
    watcher.say("step")
    second = watcher.until(lambda message: message["kind"] == "frame")[-1]
    assert second["estimates"]["spherical"]["reset_trigger"] == "manual_step"
    # Telecommands, as CLTU and bare, in pieces.
    cltu = UplinkEncoder(0x4C).encode([ping(7)])
    watcher.telecommands.sendall(cltu[:11])
    watcher.telecommands.sendall(cltu[11:] + ping(8)[:5])
    watcher.telecommands.sendall(ping(8)[5:] + ping(8))
    watcher.say("sideways")
    watcher.until(lambda message: message["kind"] == "error")
    watcher.say("run")
    seen = watcher.until(
        lambda message: sum(v["stage"] == "not_accepted" for v in message.get("verifications", ())) == 1
    )
    stages = [v["stage"] for message in seen for v in message.get("verifications", ())]
    assert stages.count("completed") >= 2
    watcher.say("quit")
    decoded = decode(watcher.rest_of_telemetry(), spacecraft_id=0x4C)
    assert decoded.complete
    assert decoded.by_apid[DICTIONARY.packet("connection_report").apid] == 2
    # The CLTU was an expedited frame; what came bare went past the receiver's frames, as did the operator's.
    (uplink,) = decoded.uplink
    assert uplink.frames == decoded.frame_count and not uplink.no_rf_available and uplink.changes > 0


def test_the_scenario_runs_through_and_the_machine_goes_on(running):
    live, watcher = running
    watcher.say("run")
    messages = watcher.until(
        lambda message: message["kind"] == "turn" and message["mode"] == "standby" and live.account.frames == 16
    )
    assert [message["frame"] for message in messages if message["kind"] == "frame"] == list(range(16))
    assert {message["estimates"]["spherical"]["outcome"] for message in messages if message["kind"] == "frame"} <= {
        "anchored", "multi", "single", "predicted",
    }  # fmt: skip
    watcher.say("rate 5")
    watcher.until(lambda message: message.get("rate") == 5.0)


def test_the_operator_answers_to_telemetry_of_two_light_times_ago(flown):
    second = 1_000_000_000
    modes = [PayloadMode(1 + (k // 3) % 3) for k in range(12)]
    for step_s, behind in ((10, 0), (1, 2)):
        operator = Operator(flown[0])
        # What the payload is in before moment k it was in telemetry of moment k - 1.
        seen = [
            operator._mode_seen(StepInput(EPOCH + k * step_s * second, -1, 1.0, True, 0, 1.28), mode)
            for k, mode in enumerate(modes)
        ]
        assert seen[behind:] == modes[: len(modes) - behind]


def test_a_port_in_use_is_named_and_nothing_stays_open(flown):
    world, loaded = flown
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with raises(LinkError, match=f"telecommand of earth port {port}: expected a free port"):
            LiveSession(world, loaded, has_operator=True, station_ports={"earth": (0, port)})


def test_who_reaches_the_console_reaches_the_mission_description(flown):
    port = free_port()
    answers = []

    def text(world, used):
        answers.append(listens(port))
        return "text"

    LiveSession(*flown, console_port=port, mission=text).close()
    assert answers == [False]


def reset(connection):
    """Close a connection with RST instead of FIN."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()


def test_hundreds_of_short_half_open_and_reset_connections_do_not_stop_the_payload(running):
    live, watcher = running
    held = []
    for k in range(300):
        for name in ("telemetry earth", "telecommand earth", "console"):
            connection = connected(live.ports[name])
            if name == "console":
                # The answer to an unknown word meets a connection that is gone already.
                connection.sendall(b"unknown\n" * 3 + b"half a wo")
            elif name == "telecommand earth":
                connection.sendall(ping(k)[:7])
            if k % 3 == 0:
                reset(connection)
            elif k % 3 == 1:
                connection.close()
            else:
                connection.shutdown(socket.SHUT_WR)
                held.append(connection)
        if k % 10 == 0:
            watcher.say("step")
    watcher.say("rate 5")
    watcher.say("step")
    watcher.until(lambda message: message.get("rate") == 5.0)
    for connection in held:
        connection.close()
    # Parts of packets and words that were broken off do not run into those of others.
    wanted = int.from_bytes(ping(1005)[:4], "big")
    watcher.telecommands.sendall(ping(1005))
    watcher.say("rate 0")
    watcher.say("run")
    watcher.until(
        lambda message: any(
            v["stage"] == "completed" and v["request_id"] == wanted for v in message.get("verifications", ())
        )
    )


def served(server):
    selector = selectors.DefaultSelector()
    server.attach(selector)
    return selector


def turn(selector):
    for key, events in selector.select(0.01):
        server, client = key.data
        server.serve(client, events)


def test_a_reader_that_does_not_read_is_disconnected_and_delays_nobody():
    received = []
    server = Server("telemetry", 0, "127.0.0.1", lambda number, octets: received.append((number, octets)))
    selector = served(server)
    slow, quick = (connected(server.port) for _ in range(2))
    while len(server.clients) < 2:
        turn(selector)
    chunk, octets = bytes(range(256)) * 1024, b""
    sent = 0
    while len(server.clients) == 2:
        server.send(chunk)
        sent += len(chunk)
        while len(octets) < sent:
            turn(selector)
            octets += quick.recv(1 << 20)
        # What the kernel holds for a reader comes on top of what is kept here.
        assert sent < UNSENT_LIMIT_OCTETS + (64 << 20)
    assert octets == chunk * (sent // len(chunk))
    assert all(len(client.unsent) == 0 for client in server.clients.values())
    # Who reads late, but reads, gets everything: the selector tells when there is room again.
    server.send(chunk * 20)
    late = b""
    while len(late) < 20 * len(chunk):
        turn(selector)
        late += quick.recv(1 << 16)
    assert late == chunk * 20
    server.close()
    slow.close()
    quick.close()
    selector.close()


@mark.parametrize("leave", [socket.socket.close, reset], ids=["closed", "reset"])
def test_words_of_a_client_that_left_without_reading_are_received(leave):
    received = []
    server = Server("console", 0, "127.0.0.1", lambda number, octets: received.append(octets))
    selector = served(server)
    client = connected(server.port)
    while not server.clients:
        turn(selector)
    server.send(b"snapshot that nobody reads\n")
    assert client.recv(1, socket.MSG_PEEK) == b"s"
    client.sendall(b"x" * 30_000 + b"\nquit\n")
    leave(client)
    # The snapshots meet a connection that is gone, before its words are read.
    for _ in range(3):
        server.send(b"another one\n")
    while server.clients:
        turn(selector)
    assert b"".join(received) == b"x" * 30_000 + b"\nquit\n"
    server.close()
    selector.close()


def test_no_more_connections_are_held_than_the_limit():
    server = Server("telemetry", 0, "127.0.0.1", lambda number, octets: None)
    selector = served(server)
    clients = [connected(server.port) for _ in range(CLIENT_LIMIT + 3)]
    while server._accepted < CLIENT_LIMIT:
        turn(selector)
    for _ in range(3):
        turn(selector)
    assert len(server.clients) == CLIENT_LIMIT
    assert [client.recv(1) for client in clients[CLIENT_LIMIT:]] == [b""] * 3
    server.close()
    selector.close()
    for client in clients:
        client.close()


def test_telecommands_come_out_of_any_noise_whole_or_not_at_all():
    rng = np.random.default_rng(6)
    for trial in range(200):
        telecommands = [ping(k) for k in range(4)]
        noise = [bytes(rng.integers(0x30, 0x80, int(rng.integers(0, 9))).astype(np.uint8)) for _ in telecommands]
        encoder = UplinkEncoder(0x4C)
        parts = [
            quiet + (encoder.encode([telecommand]) if (trial >> k) & 1 else telecommand)
            for k, (quiet, telecommand) in enumerate(zip(noise, telecommands, strict=True))
        ]
        stream, buffer, found = b"".join(parts), TelecommandBuffer(Receiver(0x4C)), []
        while stream:
            cut = int(rng.integers(1, 40))
            found += buffer.take(stream[:cut])
            stream = stream[cut:]
        assert found == telecommands
        assert buffer.dropped >= sum(map(len, noise))


def test_a_flood_of_octets_is_not_kept():
    buffer = TelecommandBuffer(Receiver(0x4C))
    for _ in range(40):
        assert buffer.take(b"\xeb\x90" + b"\x00" * 65_536) == []
    assert buffer.dropped > 1 << 20


def test_a_processor_that_hangs_is_reset_and_the_payload_goes_on(flown):
    world, loaded = flown
    scenario = replace(world.scenario, faults=FaultsSection(("processor_hang at 60",)))
    flights = []
    for _ in range(2):
        spacecraft = new_spacecraft(replace(world, scenario=scenario), loaded)
        packets = [packet for result in fly_scenario(spacecraft.world, spacecraft) for packet in result.packets]
        flights.append(packets)
        assert len(spacecraft.resets) == 1 and spacecraft.payload.mode is PayloadMode.standby
    unpacked = list(map(DICTIONARY.unpack, flights[0]))
    labels = DICTIONARY.labels("event_info", "event_id")
    events = [labels[values["event_id"]] for name, values in unpacked if name.startswith("event_")]
    frames = [values["frame_number"] for name, values in unpacked if name == "detections"]
    # 16 images are due, of which two pass while the processor hangs and starts again.
    assert "watchdog_reset" in events and frames == list(range(14))
    assert flights[1] == flights[0]  # the same seed gives the same flight


def test_every_kind_of_fault_is_documented():
    page = (Path(__file__).resolve().parents[2] / "docs/payload.md").read_text()
    assert all(f"`{kind}`" in page for kind in FAULT_KINDS)
