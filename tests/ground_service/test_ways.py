"""One window flown in every way: an archive, its replay, live with the operator, live and commanded by the ground."""

import json
import shutil
import socket
import threading
import zlib

import numpy as np
from pytest import fixture

from ground_service.evaluation.core import summary_of
from ground_service.evaluation.service import evaluate
from ground_service.passes.archive_import import import_archive
from lunar.datafolder import DataFolder
from lunar.frames import spherical_from_mcmf
from payload_emulator.session.archive.emulator import emulate, file_entries
from payload_emulator.session.archive.recording import frame_path
from payload_emulator.session.archive.replay import FlightBuild, replay_archive
from payload_emulator.session.live.session import LiveSession
from payload_emulator.session.live.station_ports import RECORD_HEADER
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.spacecraft.loading import launch, load_scenario_payload
from payload_emulator.session.world.world import build_world, clock_ticks, open_world
from tests.lazy import Lazy
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import decode, encode_cadus
from tmtc.link.settings import LinkSettings

cv2 = Lazy("cv2")

NO_DATA = DataFolder(None)
NS = 1_000_000_000
FRAMES = 4

SCENARIO = f"""
name = "ways"
seed = 5
[orbit]
epoch = "2029-08-07T01:39:00Z"
[dynamics]
gravity = "builtin"
degree = 8
orientation = "iau"
[window]
search = "none"
start = "2029-08-07T01:40:07Z"
duration_s = {FRAMES * 15.0}
[camera]
width_px = 256
height_px = 256
[terrain]
source = "procedural"
[navigation]
estimators = ["spherical"]
filter_gravity = "builtin"
filter_degree = 8
[attitude]
pointing_error_deg = 0.1
knowledge_noise_deg = 0.01
[clock]
offset_s = 0.4
"""


def packets_of(cadus):
    found = decode(cadus)
    assert found.complete
    return list(found.cut.packets(found.buffer))


def flown(session, telecommands=lambda session: b""):
    """Fly a session that is paused until it has its telecommands, and return what a station receives."""
    thread = threading.Thread(target=session.run, daemon=True)
    thread.start()
    records = b""
    try:
        with (
            socket.create_connection(("127.0.0.1", session.ports["telemetry earth"]), timeout=60.0) as telemetry,
            socket.create_connection(("127.0.0.1", session.ports["telecommand earth"]), timeout=900.0) as up,
            socket.create_connection(("127.0.0.1", session.ports["console"]), timeout=900.0) as console,
        ):
            octets = telecommands(session)
            up.sendall(octets)
            lines = console.makefile("r")
            while sum(len(one) for _, one in session.contacts._uplink) < len(octets):
                console.sendall(b"state\n")
                assert json.loads(lines.readline())["kind"] == "state"
            console.sendall(b"run\n")
            while block := telemetry.recv(65_536):
                records += block
            lines.close()
        thread.join()
        assert not thread.is_alive()
    finally:
        session.stopping.set()
    length = RECORD_HEADER.size + LinkSettings().cadu_length
    starts = range(RECORD_HEADER.size, len(records), length)
    return packets_of(b"".join(records[at : at + LinkSettings().cadu_length] for at in starts))


def of_kind(name, packets):
    """Return the values of packets of one kind by the on-board time of the image, as plain values."""
    found = {}
    for packet in packets:
        kind, values = DICTIONARY.unpack(packet)
        if kind == name:
            found[int(values["image_ticks"])] = json.loads(json.dumps(values, default=lambda value: value.tolist()))
    return found


@fixture(scope="module")
def archive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ways") / "archive"
    emulate(parse_scenario(SCENARIO), NO_DATA, folder, frames_kept=None)
    return folder


@fixture(scope="module")
def ways(archive, tmp_path_factory):
    """Return the packets of each way."""
    world = build_world(parse_scenario(SCENARIO), NO_DATA)
    loaded, _, _ = load_scenario_payload(world, NO_DATA)
    session = LiveSession(world, loaded, has_operator=True, ends_with_scenario=True, paused=True)
    replayed = tmp_path_factory.mktemp("replay")
    replay_archive(archive, FlightBuild(), replayed)
    return {
        "archive": packets_of((archive / "downlink.cadu").read_bytes()),
        "live": flown(session),
        "replay": packets_of((replayed / "downlink.cadu").read_bytes()),
    }


def test_a_live_flight_and_a_replay_give_the_packets_of_the_archive(ways):
    packets, again = ways["archive"], ways["replay"]
    assert len(of_kind("detections", packets)) == FRAMES
    assert ways["live"] == packets
    assert len(again) == len(packets)
    # A replay has no board: times of its processor, readings and memory are unknown.
    other = [DICTIONARY.unpack(one)[0] for one, two in zip(packets, again, strict=True) if one != two]
    assert set(other) == {"housekeeping", "performance"}
    assert len(other) < len(packets) / 4


def test_every_way_has_the_same_figures_in_its_report(archive, ways, either, tmp_path):
    figures = {}
    for name, packets in ways.items():
        folder = tmp_path / name
        shutil.copytree(archive, folder)
        (folder / "downlink.cadu").write_bytes(encode_cadus(packets, spacecraft_id=76))
        manifest = json.loads((folder / "manifest.json").read_text())
        manifest |= {"pass_name": name, "files": file_entries(folder)}
        (folder / "manifest.json").write_text(json.dumps(manifest))
        figures[name] = summary_of(evaluate(either, import_archive(either, folder)))
    assert len({one.pop("pass_id") for one in figures.values()}) == len(ways)
    assert figures["archive"]["detector"]["recall"] > 0.3 and figures["archive"]["navigation"]
    assert figures["live"] == figures["archive"]
    # A replay has no board.
    board = [one["key"] for one in figures["replay"]["requirements"] if one["key"].startswith("resources.")]
    for one in figures.values():
        one["requirements"] = [row for row in one["requirements"] if row["key"] not in board]
        del one["verdict"]
    assert figures["replay"] == figures["archive"]


def commanded(scenario, start_utc_ns, frames):
    """Fly a window that the ground commands, and a minute beyond it."""
    stop = start_utc_ns + (frames * 15 + 60) * NS
    session = LiveSession(*launch(scenario, NO_DATA), stop_utc_ns=stop, paused=True)

    def telecommands(session):
        values = {"function_id": "start_observation", "argument_1": frames * 15.0 - 7.5, "argument_2": 15.0}
        start = DICTIONARY.pack_command("perform_function", values, sequence_count=0, source=1)
        items = {"octet": np.frombuffer(start, dtype=np.uint8)}
        ticks = clock_ticks(session.world, start_utc_ns)
        later = {"release_ticks": ticks, "items": items}
        return DICTIONARY.pack_command("insert_activity", later, sequence_count=1, source=1)

    return session, flown(session, telecommands)


def test_a_window_commanded_by_the_ground_gives_the_images_and_detections_of_the_archive(archive):
    scenario = parse_scenario(SCENARIO)
    first = int(build_world(scenario, NO_DATA).frame_utc_ns[0])
    session, packets = commanded(scenario, first, FRAMES)
    assert session.account.frames == FRAMES
    pictures = [
        cv2.imread(str(archive / frame_path(number)), cv2.IMREAD_UNCHANGED)[..., ::-1] for number in range(FRAMES)
    ]
    reported = of_kind("image_report", packets)
    assert [one["image_crc"] for one in reported.values()] == [
        zlib.crc32(np.ascontiguousarray(one)) for one in pictures
    ]
    archived = of_kind("detections", packets_of((archive / "downlink.cadu").read_bytes()))
    found = of_kind("detections", packets)
    for one in *archived.values(), *found.values():
        # The class of size needs an estimator, whose tables this ground has not uploaded.
        assert len(one["items"].pop("size_class")) > 5
    assert found == archived


def test_ground_that_cannot_be_rendered_gives_no_image_and_the_flight_goes_on():
    """Frames across the pole, for which terrain has no tiles."""
    small = SCENARIO.replace("256", "32")
    world = open_world(parse_scenario(small), NO_DATA)
    times = world.truth.start_utc_ns + np.arange(120, 8_000, 15, dtype=np.int64) * NS
    latitude = np.degrees(spherical_from_mcmf(world.truth.positions_mcmf(times))[0])
    at = times[np.flatnonzero(latitude > 87.0)[0]]
    session, packets = commanded(parse_scenario(small), int(at), 3)
    assert session.account.images_lost == 3 and session.utc_ns > at + 45 * NS
    assert {one["width_px"] for one in of_kind("image_report", packets).values()} == {0}
