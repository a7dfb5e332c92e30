"""The spacecraft commanded by the ground: windows, contacts, storage, clock, state."""

import contextlib
import hashlib
import json
import selectors
import socket
import struct
import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from pytest import approx, fixture, mark, raises

from ground_service.missions.model import parse_mission
from linna import cli
from lunar.camera import PinholeCamera
from lunar.datafolder import DataFolder
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from lunar.timescales import parse_utc
from payload_emulator.errors import ModelError, ScenarioError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.session.archive.mission import (
    OPERATIONS,
    live_mission_text,
    mission_text,
    scenario_mission_text,
    trained_ground,
    unseen_share,
)
from payload_emulator.session.live.session import LiveSession
from payload_emulator.session.live.station_ports import RECORD_HEADER
from payload_emulator.session.scenario import DetectorSection, parse_scenario
from payload_emulator.session.spacecraft.loading import launch, launch_payload
from payload_emulator.session.world.world import build_world, open_world
from payload_emulator.sim.terrain.registration import Rims, fit_registration
from tests.scenarios import commanded_scenario, still_scenario
from tests.serving import wait_for
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import decode
from tmtc.link.settings import LinkSettings

NS = 1_000_000_000
HOUR_NS = 3600 * NS
EPOCH = parse_utc("2029-08-07T00:00:00Z")
CADU = LinkSettings().cadu_length

SCENARIO = commanded_scenario(
    "continuous",
    "[clock]\noffset_s = 0.4\ndrift_ppm = 5.0\n"
    '[link]\nstations = ["madrid"]\nrate_bps = 64000.0\nuplink_bps = 64000.0\n',
)

SHORT = 'outages = ["madrid 2029-08-07T04:00:00Z 2029-08-07T23:00:00Z"]\n'
"""Ends the first contact, which begins at 03:27:55, after half an hour."""


def scenario(further=""):
    return parse_scenario(SCENARIO + further)


def first(send, say=""):
    """Let the ground send telecommands, and a word to the console, when its first contact starts."""

    def act(ground, contact):
        if contact["state"] == "started" and ground.count == 0:
            ground.send(*send(ground))
            if say:
                ground.say(say)

    return act


class Ground:
    """Station client and operator of a session in the test's process."""

    def __init__(self, session, act=lambda ground, contact: None):
        self.session, self.act = session, act
        self.contacts = []
        self.records = b""
        self.count = 0
        self._lock = threading.Lock()
        self._telemetry = self._connect("telemetry madrid")
        self._telecommand = self._connect("telecommand madrid")
        self._console = self._connect("console")
        works = (self._receive, self._operate)
        self._threads = [threading.Thread(target=one, daemon=True) for one in works]
        for thread in self._threads:
            thread.start()

    def _connect(self, name):
        return socket.create_connection(("127.0.0.1", self.session.ports[name]), timeout=900.0)

    def _receive(self):
        while octets := self._telemetry.recv(65_536):
            self.records += octets

    def _operate(self):
        for line in self._console.makefile("r"):
            message = json.loads(line)
            if message["kind"] == "contact":
                self.contacts.append(message)
                self.act(self, message)
            if message["kind"] in ("contact", "finished"):
                self._console.sendall(b"run\n")

    def send(self, *packets):
        """Send telecommands, and wait until the station has them."""
        self._telecommand.sendall(b"".join(packets))
        time.sleep(0.1)

    def say(self, word):
        """Send a word to the console."""
        self._console.sendall(word.encode() + b"\n")

    def command(self, name, **values):
        self.count += 1
        return DICTIONARY.pack_command(name, values, sequence_count=self.count, source=1)

    def at(self, utc_ns, packet):
        items = {"octet": np.frombuffer(packet, dtype=np.uint8)}
        return self.command("insert_activity", release_ticks=self.session._ticks(utc_ns), items=items)

    def function(self, name, first=0.0, second=0.0):
        return self.command("perform_function", function_id=name, argument_1=first, argument_2=second)

    def close(self):
        for thread in self._threads:
            thread.join()
        for connection in (self._telemetry, self._telecommand, self._console):
            connection.close()


def opened(scenario, craters=None, **options):
    """Return a session of a launched spacecraft."""
    return LiveSession(*launch(scenario, DataFolder(None), craters), **options)


@contextlib.contextmanager
def running(session):
    """Run a session in a thread, which has to end within the context."""
    thread = threading.Thread(target=session.run, daemon=True)
    thread.start()
    try:
        yield thread
        thread.join()
        assert not thread.is_alive()
    finally:
        session.stopping.set()


def flown(scenario, hours, act=lambda ground, contact: None, **options):
    """Fly a session for some hours from its epoch, with a client."""
    stop = EPOCH + round(hours * HOUR_NS)
    session = opened(scenario, holds=True, stop_utc_ns=stop, **options)
    with running(session):
        ground = Ground(session, act)
    ground.close()
    return session, ground


def packets_of(records):
    """Reception time, name and values of every packet in records; what was sent at once has one reception time."""
    length = RECORD_HEADER.size + CADU
    assert len(records) % length == 0
    dumps = {}
    for start in range(0, len(records), length):
        received = RECORD_HEADER.unpack_from(records, start)[0]
        dumps[received] = dumps.get(received, b"") + records[start + RECORD_HEADER.size : start + length]
    found = []
    for received, cadus in dumps.items():
        result = decode(cadus, settings=LinkSettings())
        for start, size in zip(result.cut.offsets.tolist(), result.cut.lengths.tolist(), strict=True):
            name, values = DICTIONARY.unpack(result.buffer[start : start + size].tobytes())
            found.append((received, name, values))
    return found


WINDOW = EPOCH + 7 * HOUR_NS + 37 * NS
"""Start of the window, whose frames lie between whole minutes; the scenario itself observes after its epoch."""


@fixture(scope="module")
def flight():
    """Sixteen hours with time reports and one window: the Moon is above the station for twelve of them."""

    def commands(ground):
        yield ground.command("set_time_report_rate", rate_exponent=0)
        yield ground.at(WINDOW + 100 * NS, ground.command("test_connection"))
        yield ground.at(WINDOW, ground.function("start_observation", 180.0, 15.0))
        yield ground.at(WINDOW + 185 * NS, ground.function("set_mode", 3.0))

    session, ground = flown(scenario(), 16.0, first(commands))
    return session, ground, packets_of(ground.records)


def test_the_store_fills_between_contacts_and_is_empty_after_one():
    _, ground = flown(scenario(), 48.0)
    started = [one for one in ground.contacts if one["state"] == "started"]
    ended = [one for one in ground.contacts if one["state"] == "ended"]
    gaps = [
        (parse_utc(later["utc"]) - parse_utc(earlier["utc"])) / (60 * NS)
        for earlier, later in zip(ended, started[1:], strict=False)
    ]
    # At least a housekeeping packet each minute waits after a gap, and few after a contact.
    assert max(gaps) > 60
    for gap, contact in zip(gaps, started[1:], strict=False):
        assert gap < 10 or contact["waiting"] > 0.8 * gap
    assert all(one["waiting"] < 5 for one in ended)


def test_battery_and_temperature_follow_the_sun_and_outside_windows_no_image_is_made(flight):
    rows = [values for _, name, values in flight[2] if name == "housekeeping"]
    volts = np.array([row["bus_voltage_v"] for row in rows])
    board_c = np.array([row["temperature_c"] for row in rows])
    assert volts.max() - volts.min() > 0.05
    assert board_c.max() - board_c.min() > 5.0
    session, _, _ = flight
    assert session.spacecraft.payload.summary()["frames_processed"] == session.account.frames == 12


def test_the_ground_of_an_observation_is_dropped_in_the_first_change_of_contact_after_it(monkeypatch):
    session = opened(scenario())
    terrain = session.world.terrain
    found = []
    for mode in (PayloadMode.observing, PayloadMode.standby):
        monkeypatch.setattr(session.spacecraft.payload._machine, "mode", mode)
        terrain.release_thread()
        terrain.height_m(0.1, 0.1)
        terrain.release_thread()
        session._hold(selectors.DefaultSelector())
        session.spacecraft.camera._renderer.submit(int).result()
        found.append(len(terrain._slots))
    session.close()
    assert found == [1, 0]


def test_a_contact_ends_with_an_outage_of_its_station_and_later_telecommands_are_lost():
    def act(ground, contact):
        if contact["state"] == "ended":
            ground.send(ground.command("test_connection"))

    session, ground = flown(scenario(SHORT), 4.5, act)
    assert [one["state"] for one in ground.contacts] == ["started", "ended"]
    assert abs(parse_utc(ground.contacts[1]["utc"]) - parse_utc("2029-08-07T04:00:00Z")) < NS
    assert session.account.telecommands == 0
    assert session.account.telecommand_octets_lost > 0


def test_the_uplink_carries_no_more_than_its_rate():
    """At 8 bit/s a contact of half an hour takes a part of 2000 telecommands; the others are lost."""
    slow = parse_scenario(SCENARIO.replace("uplink_bps = 64000.0", "uplink_bps = 8.0") + SHORT)
    act = first(lambda ground: [ground.command("test_connection") for _ in range(2_000)])
    session, ground = flown(slow, 4.5, act)
    start, stop = (parse_utc(one["utc"]) for one in ground.contacts[:2])
    seconds, packet = (stop - start) / NS, len(ground.command("test_connection"))
    assert session.account.telecommands == approx(seconds / packet, abs=2)
    assert session.account.telecommand_octets_lost == approx(2_000 * packet - seconds, abs=2 * packet)


def test_an_exact_state_gives_the_same_flight_as_without_an_interruption(tmp_path):
    """The state is written between the uplink of a window and the window; it has the schedule of the payload."""
    snapshot = tmp_path / "exact"

    def commands(ground):
        yield ground.command("set_time_report_rate", rate_exponent=0)
        yield ground.at(EPOCH + 5 * HOUR_NS, ground.function("start_observation", 600.0, 15.0))

    act = first(commands)
    whole, received = flown(scenario(SHORT), 29.0, act)
    begun, before = flown(scenario(SHORT), 4.5, act, state_file=snapshot)
    assert begun.account.frames == 0
    second, after = flown(scenario(SHORT), 29.0, state_file=snapshot)
    assert second.spacecraft.resets == []
    assert second.account == whole.account and whole.account.frames == 40
    assert before.records + after.records == received.records and len(after.records) > 0


def test_an_exact_state_in_a_contact_keeps_what_is_still_on_the_uplink(tmp_path):
    """At 16 bit/s most of 60 telecommands reach the spacecraft after the state was written."""
    slow = parse_scenario(SCENARIO.replace("uplink_bps = 64000.0", "uplink_bps = 16.0") + SHORT)

    act = first(lambda ground: [ground.command("test_connection") for _ in range(60)], "save")
    whole, received = flown(slow, 5.0, act)
    begun, _ = flown(slow, 3.5, act, state_file=tmp_path / "exact")
    assert begun.account.telecommands < 60 == whole.account.telecommands
    second, after = flown(slow, 5.0, state_file=tmp_path / "exact")
    assert second.account == whole.account
    assert received.records.endswith(after.records) and len(after.records) > 0


def test_a_session_ends_with_its_console_if_that_is_asked_for():
    session = opened(scenario(), paused=True, ends_with_console=True)
    port = session.ports["console"]
    with running(session) as thread, socket.create_connection(("127.0.0.1", port)) as console:
        console.sendall(b"state\n")
        assert json.loads(console.makefile("r").readline())["kind"] == "state"
        assert thread.is_alive()


def test_a_console_that_connects_after_the_end_is_informed(tmp_path):
    """A session that is resumed after its end has passed waits for `run`, and informs every client."""
    state = tmp_path / "session.state"
    flown(scenario(), 1.0, state_file=state)
    session = opened(scenario(), holds=True, stop_utc_ns=EPOCH, state_file=state)
    with running(session) as thread:
        wait_for(lambda: session.console.held, "the end of the session")
        with socket.create_connection(("127.0.0.1", session.ports["console"]), timeout=900.0) as console:
            assert json.loads(console.makefile("r").readline())["kind"] == "finished"
            console.sendall(b"run\n")
            thread.join()


def test_images_that_the_payload_refuses_to_look_at_are_no_frames():
    """In safe mode the start of the observation is refused, and the image that was made for it is not counted."""

    def commands(ground):
        yield ground.at(EPOCH + 5 * HOUR_NS - 60 * NS, ground.function("set_mode", 0.0))
        yield ground.at(EPOCH + 5 * HOUR_NS, ground.function("start_observation", 60.0, 15.0))

    session, _ = flown(scenario(SHORT), 6.0, first(commands))
    payload = session.spacecraft.payload
    assert session.account.frames == payload.frames == 0


def test_records_that_are_not_acknowledged_come_again_on_the_next_connection():
    session = opened(scenario(), keeps=True)
    station = session.contacts.stations["madrid"]
    station.send(5, bytes(CADU), CADU)
    station.send(6, bytes(2 * CADU), CADU)
    length = RECORD_HEADER.size + CADU
    with selectors.DefaultSelector() as selector:
        for server in session._servers():
            server.attach(selector)

        def served(connection, count):
            got = b""
            while len(got) < count:
                session._serve(selector, 0.05)
                connection.setblocking(False)
                with contextlib.suppress(BlockingIOError):
                    got += connection.recv(65_536)
            return got

        with socket.create_connection(("127.0.0.1", station.telemetry.port)) as early:
            assert len(served(early, 3 * length)) == 3 * length
            early.send(struct.pack(">Q", length))
        for _ in range(20):
            session._serve(selector, 0.02)
        with socket.create_connection(("127.0.0.1", station.telemetry.port)) as second:
            again = served(second, 2 * length)
        assert RECORD_HEADER.unpack_from(again)[0] == 6 and len(again) == 2 * length
        for server in session._servers():
            server.close()


def test_the_mission_description_names_stations_and_links():
    world = open_world(scenario(SHORT), DataFolder(None))
    text = live_mission_text(world, DataFolder(None), "127.0.0.1", {"madrid": (1, 2)}, OPERATIONS)
    mission = parse_mission(text)
    assert mission.link.stations["madrid"].latitude_deg == 40.43
    assert mission.link.stations["madrid"].outages == ("2029-08-07T04:00:00.000Z/2029-08-07T23:00:00.000Z",)
    assert mission.links is not None and mission.links[0].downlink == "127.0.0.1:1"
    written = parse_mission(scenario_mission_text(scenario(SHORT), DataFolder(None)))
    assert written.links is not None and written.links[0].downlink == "127.0.0.1:10015"
    assert written.approval is not None and written.uploads is not None


@mark.parametrize("option, limit", [("--rate", "from"), ("--days", "above")])
def test_impossible_options_are_refused_in_one_line(option, limit, capsys):
    assert cli.run(["emulate", "low-over-mare", "--live", option, "-1"]) == 2
    assert f"{option}: expected a number {limit} 0, found '-1'" in capsys.readouterr().err


def test_a_scenario_with_an_ephemeris_or_a_kidnap_is_refused():
    moved = "[disturbances]\nkidnap_distance_km = 10.0\n[maneuvers]\nenabled = false\n"
    with raises(ScenarioError, match="expected an orbit to propagate without end, found a kidnap"):
        opened(scenario(moved))


MISSION_SCENARIO = (
    still_scenario("small", 60.0)
    + """[camera]
tilt_deg = 20.0
k1 = -0.05
[requirements]
recall = -1.0
temperature_min_c = -15.0
median_error_m = 42.0
"""
)


@fixture(scope="module")
def world():
    return build_world(parse_scenario(MISSION_SCENARIO), DataFolder())


def stated_of(world):
    return parse_mission(mission_text(world, DataFolder()))


def test_the_ground_reads_what_the_emulator_writes(world):
    mission = stated_of(world)
    assert (mission.name, mission.spacecraft.id) == ("small", 76)
    assert mission.frames.orientation == world.truth.orientation.name == "IAU WGCCRE 2009"
    assert mission.frames.gravity_field == world.gravity.name
    assert (mission.camera.tilt_deg, mission.camera.k1, mission.camera.fov_deg) == (20.0, -0.05, 120.0)
    assert mission.evidence.level == "2" and mission.evidence.seed == 7
    assert mission.link.frame_length == 1115 and mission.link.interleave == 5


def test_the_network_and_the_threshold_in_force_are_stated(world):
    own = stated_of(world).detector
    assert (own.network, own.max_detections) == ("craters", 120)
    assert own.sha256 == hashlib.sha256(load_shipped_model()).hexdigest()
    assert own.score_threshold == 0.44  # in the metadata of the shipped network
    detector = DetectorSection(score_threshold=0.61, max_detections=80)
    changed = replace(world, scenario=replace(world.scenario, detector=detector))
    stated = stated_of(changed).detector
    assert (stated.score_threshold, stated.max_detections) == (0.61, 80)
    lost = replace(world, scenario=replace(world.scenario, detector=DetectorSection(network="lost.onnx")))
    with raises(ModelError, match=r"expected craters.* or an ONNX file, found 'lost.onnx'"):
        mission_text(lost, DataFolder())


def test_the_registration_of_the_terrain_is_stated(world):
    assert stated_of(world).catalogue.registration_north_m is None
    latitude, longitude, _ = spherical_from_mcmf(world.truth.positions_mcmf(world.frame_utc_ns))
    # A rim every half degree around the frames, all 40 m north and 20 m west of the list.
    offsets = np.radians(np.stack(np.meshgrid(np.arange(-5.0, 5.1, 0.5), np.arange(-5.0, 5.1, 0.5))))
    places = offsets.reshape(2, -1) + np.array([[latitude[0]], [longitude[0]]])
    same = np.ones(places.shape[1])
    registration = fit_registration(Rims(*places, -20.0 * same, 40.0 * same, 60.0 * same))
    shifted = SimpleNamespace(catalogue=world.terrain.catalogue, is_real=False, registration=registration)
    stated = stated_of(replace(world, terrain=shifted)).catalogue
    assert stated.registration_north_m == approx(40.0, abs=3.0)
    assert stated.registration_east_m == approx(-20.0, abs=3.0)
    assert 10.0 <= stated.registration_sigma_m < 20.0
    assert 0 < stated.registration_rims <= same.size
    known = np.isfinite(registration.at(latitude, longitude)[1])
    assert stated.registered_share == approx(known.mean(), abs=5e-4) and known.any()
    shifted.registration = fit_registration(Rims(places[0], places[1] + np.pi, same, same, 60.0 * same))
    stated = stated_of(replace(world, terrain=shifted)).catalogue
    assert stated.registered_share == 0.0 and stated.registration_sigma_m is None


def test_limits_and_the_offset_of_the_list_that_the_payload_starts_with_are_stated(world):
    stated = stated_of(world).catalogue
    loaded = launch_payload(world.scenario, world.camera, DataFolder()).parameters.flight.anchored
    up_m = loaded.errors.catalogue_offset_m[2]
    assert stated.offset_sigma_m == (loaded.offset.prior_m, loaded.offset.prior_m, up_m)
    assert np.radians(stated.offset_correlation_deg) == approx(loaded.offset.correlation_rad)
    requirements = stated_of(world).requirements
    assert requirements.estimator == "anchored"
    assert (requirements.median_error_m, requirements.recall, requirements.memory_mib) == (42.0, None, None)
    assert (requirements.temperature_max_c, requirements.temperature_min_c) == (60.0, -15.0)


PLACES = """
0 270 seen
0 292.5 unseen: the held-out strip
0 283.5 unseen: within 60 km (1.98 degrees at the equator) west of it
0 282.5 seen
15 35 unseen: the held-out block
40 20 seen
-45 322 seen in validation: thresholds were chosen there
0 100 unseen: far from every box
70 270 unseen: beyond the latitudes of training
0 -90 seen
0 630 seen
"""


@mark.parametrize("latitude_deg, longitude_deg, seen", [line.split(maxsplit=2) for line in PLACES.strip().splitlines()])
def test_ground_is_seen_where_the_recipe_of_the_shipped_detector_looked(latitude_deg, longitude_deg, seen):
    place = np.array([float(latitude_deg)]), np.array([float(longitude_deg)])
    assert any(region.contains(*place).all() for region in trained_ground()) is seen.startswith("seen")


def test_what_windows_need_is_stated(world):
    """The light, and the tables that the ground uploads for each estimator."""
    scenario = world.scenario
    for mode, needed in (("paper", False), ("real", True)):
        lit = replace(world, scenario=replace(scenario, light=replace(scenario.light, mode=mode)))
        assert stated_of(lit).observation.needs_daylight is needed
    for estimators, tables in (
        (("spherical", "anchored"), ("orientation", "anchor_ephemeris", "initial_state")),
        (("anchored",), ("orientation", "initial_state")),
        (("paper",), ("anchor_ephemeris",)),
    ):
        navigation = replace(scenario.navigation, estimators=estimators)
        flown = replace(world, scenario=replace(scenario, navigation=navigation))
        text = live_mission_text(flown, DataFolder(), "127.0.0.1", {"earth": (1, 2)}, OPERATIONS)
        stated = parse_mission(text)
        assert stated.uploads is not None and stated.uploads.tables == tables
        assert stated.time.correlation == "automatic" and stated.critical_in_windows == ()


class RealTerrain:
    """A terrain that claims to be real."""

    is_real, name = True, "LROC WAC GLD100"

    def __init__(self, terrain):
        self._terrain = terrain

    def __getattr__(self, name):
        return getattr(self._terrain, name)


def flown_over(longitudes_deg, is_real=True):
    """A world whose frames are taken 20 km above the equator; a footprint is 69 km (1.14 degrees) to either side."""
    position = mcmf_from_spherical(0.0, np.radians(longitudes_deg), np.full(len(longitudes_deg), 20e3))
    return SimpleNamespace(
        terrain=SimpleNamespace(is_real=is_real),
        truth=SimpleNamespace(positions_mcmf=lambda _: position),
        frame_utc_ns=np.arange(len(longitudes_deg)),
        camera=PinholeCamera(),
    )


@mark.parametrize(
    "longitudes_deg, share",
    [
        ([290.0, 292.0], 1.0),
        ([270.0], 0.0),
        ([290.0, 270.0, 271.0, 272.0], 0.25),
        ([283.5], 0.0),  # its centre is unseen, its western edge is not
        ([284.4], 1.0),
    ],
)
def test_the_unseen_share_counts_frames_whose_whole_footprint_is_unseen(longitudes_deg, share):
    assert unseen_share(flown_over(longitudes_deg)) == share


def test_the_ground_of_training_is_stated_over_real_terrain(world):
    real = replace(world, terrain=cast(Any, RealTerrain(world.terrain)))
    evidence = stated_of(real).evidence
    assert evidence.trained_regions == trained_ground()
    assert (evidence.unseen_share, evidence.level) == (None, None)  # each pass has its own


def test_there_is_no_unseen_share_away_from_real_terrain():
    assert unseen_share(flown_over([290.0], is_real=False)) is None
