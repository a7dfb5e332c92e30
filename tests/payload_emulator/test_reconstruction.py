"""Images and inputs of a live pass, made again from the declared world; rings of craters over them."""

import json
import shutil
from dataclasses import replace

import numpy as np
from pytest import approx, fixture, mark, raises

from lunar.catalogue import save_catalogue
from lunar.datafolder import DataFolder
from payload_emulator.errors import PayloadError
from payload_emulator.flight.payload import FlightParameters
from payload_emulator.session.archive.reconstruction import CATALOGUE, reconstruct
from payload_emulator.session.archive.replay import FlightBuild, complete_archive, replay_archive
from payload_emulator.session.live.station_ports import RECORD_HEADER
from payload_emulator.session.scenario import format_scenario, parse_scenario
from payload_emulator.session.spacecraft.loading import launch_payload
from payload_emulator.session.world.camera import Exposure, craters_in_view
from payload_emulator.session.world.world import build_world, clock_ticks, first_utc_ns, open_world
from tests.payload_emulator.test_continuous import CADU, EPOCH, HOUR_NS, NS, first, flown, scenario
from tests.scenarios import still_scenario
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import decode
from tmtc.link.settings import LinkSettings

FRAMES = 4
WINDOW = EPOCH + 5 * HOUR_NS


JUMP_S = 5 * 3600.0 + 20.0
OUTAGE = 'outages = ["madrid 2029-08-07T04:00:00Z 2029-08-07T06:00:00Z"]\n'
"""The window is uplinked before it and received after it."""


def world(further=""):
    """The scenario of the continuous session with rendered images; the clock jumps between the second and the third."""
    text = format_scenario(scenario(OUTAGE)).replace('images = "reduced"', 'images = "rendered"')
    text = text.replace("events = []", f'events = ["clock_jump at {JUMP_S} size 1.0"]')
    return parse_scenario(text + further)


def packets_of(records):
    step = RECORD_HEADER.size + CADU
    cadus = b"".join(records[at + RECORD_HEADER.size : at + step] for at in range(0, len(records), step))
    result = decode(cadus, settings=LinkSettings())
    return b"".join(result.cut.packets(result.buffer))


def received(folder, described):
    """Fly a window and write what the ground has of it: packets, telecommands, catalogue, declared world."""
    sent = []

    def commands(ground):
        sent.append(ground.at(WINDOW, ground.function("start_observation", FRAMES * 15.0, 15.0)))
        sent.append(ground.at(WINDOW + 90 * NS, ground.function("set_mode", 3.0)))
        return sent

    terrain = open_world(described, DataFolder(None)).terrain
    folder.mkdir()
    listed = terrain.catalogue.diameter_m
    some = np.flatnonzero((listed > 5e3) & (listed < 8e3))[:40]
    save_catalogue(terrain.measured(some), folder / CATALOGUE)
    session, ground = flown(described, 6.5, first(commands), craters=folder / CATALOGUE)
    assert session.account.frames == FRAMES
    (folder / "downlink.packets").write_bytes(packets_of(ground.records))
    (folder / "telecommands.packets").write_bytes(b"".join(sent))
    manifest = {"pass_name": "live", "spacecraft_id": 76, "cadence_s": 15.0}
    (folder / "manifest.json").write_text(
        json.dumps({**manifest, "scenario_toml": format_scenario(described), "files": {}})
    )
    return folder


@fixture(scope="module")
def live(tmp_path_factory):
    return received(tmp_path_factory.mktemp("reconstruction") / "pass", world())


@fixture
def copy(live, tmp_path):
    shutil.copytree(live, tmp_path / "copy")
    return tmp_path / "copy"


def of_kind(name, octets):
    """Values of the packets of one kind in the order of the images, without the number of the frame since boot."""
    found = []
    decoded = decode(octets)
    for packet in decoded.cut.packets(decoded.buffer):
        kind, values = DICTIONARY.unpack(packet)
        if kind == name:
            del values["frame_number"]
            found.append(json.loads(json.dumps(values, default=lambda value: value.tolist())))
    return found


def test_the_flown_build_says_of_the_images_made_again_what_it_said_in_flight(live, tmp_path):
    """The detector looked at the same pixels: its reports have the same octets, and so have those of the images."""
    whole = tmp_path / "whole"
    complete_archive(live, whole, DataFolder(None))
    replay_archive(whole, FlightBuild(), tmp_path / "out")
    before, again = (live / "downlink.packets").read_bytes(), (tmp_path / "out/downlink.cadu").read_bytes()
    for name in ("image_report", "detections"):
        assert of_kind(name, again) == of_kind(name, before), name
        assert len(of_kind(name, before)) == FRAMES
    assert any(one["items"]["u_px"] for one in of_kind("detections", before))


def test_images_before_and_after_a_jump_of_the_clock_are_made_again(live, tmp_path):
    manifest = complete_archive(live, tmp_path / "whole", DataFolder(None))
    assert sum(name.startswith("frames/") for name in manifest["files"]) == FRAMES


def test_the_first_time_of_a_tick_is_the_same_from_everywhere():
    moon = open_world(world(), DataFolder(None))
    for seconds in (0.0, 1.0, 3333.333, 2_592_000.25):
        ticks = clock_ticks(moon, EPOCH + round(seconds * NS))
        start = first_utc_ns(moon, ticks)
        assert clock_ticks(moon, start) == ticks and clock_ticks(moon, start - 1) == ticks - 1
        assert abs(start - EPOCH - seconds * NS) < 16_000


def in_world(old, new):
    def changed(folder):
        manifest = json.loads((folder / "manifest.json").read_text())
        assert old in manifest["scenario_toml"]
        manifest["scenario_toml"] = manifest["scenario_toml"].replace(old, new)
        (folder / "manifest.json").write_text(json.dumps(manifest))

    return changed


def without_reports(folder):
    decoded = decode((folder / "downlink.packets").read_bytes())
    kept = [one for one in decoded.cut.packets(decoded.buffer) if DICTIONARY.unpack(one)[0] != "image_report"]
    (folder / "downlink.packets").write_bytes(b"".join(kept))


def with_another_catalogue(folder):
    lines = (folder / CATALOGUE).read_text().splitlines(keepends=True)
    (folder / CATALOGUE).write_text("".join(lines[:20]))


@mark.parametrize(
    "change, said",
    [
        (in_world("elevation_min_deg = 5.0", "elevation_min_deg = 6.0"), "image 0 of .* expected image_crc"),
        (in_world("read_noise_e = 15.0", "read_noise_e = 15.5"), "expected image_crc"),
        (in_world("drift_ppm = 5.0", "drift_ppm = 6.0"), "image 0 of the declared world"),
        (in_world("read_noise_e", "read_nose_e"), "read_noise_e"),
        (with_another_catalogue, "catalogue_hash of the declared payload: expected [0-9A-F]{8} as in telemetry"),
        (in_world('images = "rendered"', 'images = "reduced"'), "expected a world with rendered images"),
        (without_reports, "expected image reports in telemetry, found none"),
        (lambda folder: (folder / "telecommands.packets").unlink(), "expected telecommands that were sent"),
    ],
)  # fmt: skip
def test_what_telemetry_does_not_confirm_is_refused(change, said, copy, tmp_path):
    change(copy)
    with raises(PayloadError, match=said):
        reconstruct(copy, tmp_path / "out", DataFolder(None))


def test_only_a_payload_as_launched_reports_images():
    described = world()
    opened = open_world(described, DataFolder(None))
    launched = launch_payload(described, opened.camera, DataFolder(None)).parameters.flight
    assert launched.image_reports and not replace(launched, image_reports=False).image_reports
    assert launched.hash != replace(launched, image_reports=False).hash
    assert (
        replace(launched, image_reports=False).hash
        == replace(
            FlightParameters(),
            **{name: getattr(launched, name) for name in ("camera", "modes", "odometry", "anchored")},
        ).hash
    )


SCENARIO = (
    still_scenario("overlay", 30.0, 1)
    + """[camera]
tilt_deg = 12.0
k1 = -0.02
"""
)
RIM_M = 5_000.0


def test_rings_lie_where_rims_on_high_ground_are_seen_by_a_tilted_distorted_camera():
    world = build_world(parse_scenario(SCENARIO), DataFolder())
    utc_ns = int(world.frame_utc_ns[0])
    position = world.truth.positions_mcmf(utc_ns)[0]
    rotation = world.camera_from_mcmf(position)
    exposure = Exposure(utc_ns, np.zeros((8, 8, 3), dtype=np.uint8), np.zeros(7), 0, rotation)
    craters = world.terrain.catalogue
    world.terrain.catalogue = replace(craters, rim_height_m=np.full(len(craters), RIM_M))
    index, uv, _ = craters_in_view(world, exposure, 6.0)
    assert len(index) > 5

    latitude, longitude = craters.latitude_rad[index], craters.longitude_rad[index]
    unit = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=1
    )
    focal_px = 256.0 / np.tan(np.radians(60.0))

    def pixels(height_m):
        seen = ((1_737_400.0 + height_m) * unit - position) @ rotation.T
        plane = seen[:, :2] / seen[:, 2:]
        return 255.5 + focal_px * plane * (1.0 - 0.02 * np.sum(plane**2, axis=1, keepdims=True))

    assert uv == approx(pixels(RIM_M), abs=1e-6)
    assert np.max(np.linalg.norm(uv - pixels(0.0), axis=1)) > 10.0
