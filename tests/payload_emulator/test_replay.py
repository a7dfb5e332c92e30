"""An archived pass flown again: from its frames, its scenario, by another build, or from a folder of images."""

import json
import shutil
from dataclasses import replace
from json import loads
from types import SimpleNamespace

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx, fixture, mark, raises

from ground_service.ground import open_ground
from ground_service.regression.archives import check_archive, keep_archive
from ground_service.regression.rendering import settle_archive, with_detections
from lunar.datafolder import DataFolder
from lunar.messages.aem import AttitudeSegment, format_aem
from lunar.timescales import format_utc
from payload_emulator.errors import ParameterError, RecordError, ScenarioError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.payload import FlightParameters
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.flight.vision.preprocess import Preparation
from payload_emulator.session.archive import emulator
from payload_emulator.session.archive.emulator import emulate, file_entries, sun_warnings
from payload_emulator.session.archive.recording import load_image, load_record, missing_frames
from payload_emulator.session.archive.replay import (
    FlightBuild,
    complete_archive,
    load_flight_build,
    names_command,
    replay,
    replay_archive,
    stored_images,
)
from payload_emulator.session.archive.suite import SUITE, suite_scenarios
from payload_emulator.session.scenario import format_scenario, parse_scenario
from payload_emulator.session.spacecraft.parameter_file import BuildParameters, format_parameters, parse_parameters
from payload_emulator.session.world import world
from payload_emulator.session.world.external import load_external
from tests.lazy import Lazy
from tests.scenarios import short_scenario
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import decode
from tmtc.packets.stream import cut_packets

onnx = Lazy("onnx")

FRAMES = 5
SCENARIO = short_scenario(75.0, "") + "[disturbances]\noutage_at_s = 25.0\noutage_duration_s = 15.0\n"
NO_IMAGE = 2


@fixture(scope="module")
def archive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("replay") / "pass"
    emulate(parse_scenario(SCENARIO), DataFolder(), folder, frames_kept=None)
    return folder


@fixture
def copy(archive, tmp_path):
    shutil.copytree(archive, tmp_path / "copy")
    return tmp_path / "copy"


def restated(folder, change):
    """Write the manifest of an archive again, changed."""
    path = folder / "manifest.json"
    manifest = loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))


def no_clock():
    """In place of the processor's clock: what a replay says must not hang on it."""
    return 0.0


def packets_of(name, octets):
    decoded = decode(octets)
    table = decoded.tables()[name]
    every = list(decoded.cut.packets(decoded.buffer))
    return [every[i] for i in table.packet_index.tolist()]


def test_the_service_renders_the_frames_that_an_archive_lacks(copy, tmp_path):
    """Of the files that a scenario can name, the renderer opens only those that the service refuses."""
    shutil.rmtree(copy / "frames")
    scenario = parse_scenario(loads((copy / "manifest.json").read_text())["scenario_toml"])
    named = replace(
        scenario,
        detector=replace(scenario.detector, network="/nowhere/network.onnx"),
        navigation=replace(scenario.navigation, filter_gravity="/nowhere/field", anchoring_catalogue="/nowhere/table"),
    )
    restated(copy, lambda m: m.update(scenario_toml=format_scenario(named), files=file_entries(copy)))
    with open_ground(tmp_path / "home") as ground:
        kept = keep_archive(ground, copy)
        assert kept.state == "to render" and kept.frames_stored < kept.frames
        settled = settle_archive(ground, kept.digest)
        assert (settled.state, settled.reason, settled.frames_stored) == ("complete", "", kept.frames)
        assert list((tmp_path / "home/regression/scratch").iterdir()) == []


def test_frames_are_rendered_with_the_data_that_the_archive_declares(copy, tmp_path, monkeypatch):
    """Other data in the folder of the worker change nothing; without the declared data nothing is rendered."""
    shutil.rmtree(copy / "frames")
    built, other = world.build_world, DataFolder(tmp_path)
    foreign = replace(built(parse_scenario(SCENARIO), other), data_names=("SLDEM2015",))
    monkeypatch.setattr(
        world, "build_world", lambda scenario, data: foreign if data is other else built(scenario, data)
    )
    assert complete_archive(copy, tmp_path / "complete", other)["files"].keys() >= {"frames/000000.png"}
    restated(copy, lambda manifest: manifest["data_sources"].append("height model of Mars"))
    with raises(RecordError, match=r"^data product missing: height model of Mars$"):
        complete_archive(copy, tmp_path / "incomplete", other)


def test_received_detections_replace_the_frames_that_an_archive_lacks(copy, tmp_path):
    """A replay from received detections reports the same detections; navigation differs by their resolution only."""
    flown = (copy / "downlink.cadu").read_bytes()
    assert with_detections(replace(check_archive(copy), reason="no frames")).has_inputs
    shutil.rmtree(copy / "frames")
    replay_archive(copy, FlightBuild(), tmp_path / "out")
    again = (tmp_path / "out/downlink.cadu").read_bytes()
    assert packets_of("detections", again) == packets_of("detections", flown)
    before, after = (decode(octets).tables()["navigation_state"].columns for octets in (flown, again))
    assert len(before["image_ticks"]) == len(after["image_ticks"]) > FRAMES
    # A resolution of 1/64 px is 3 m on the ground here.
    assert np.nanmax(np.abs(before["latitude_deg"] - after["latitude_deg"])) < 1e-3
    assert np.nanmax(np.abs(before["altitude_m"] - after["altitude_m"])) < 30.0


def test_a_replay_asks_no_clock_for_what_it_says(archive):
    record = load_record(archive)
    timed, untimed = (
        replay(record, stored_images(archive, record), cpu_clock=clock)
        for clock in (lambda: float(np.random.default_rng().random()), no_clock)
    )
    assert timed.packets == untimed.packets
    assert all((values == 0.0).all() for values in untimed.stages_ms.values())


def test_costs_are_reported_for_every_frame_and_stay_out_of_the_downlink(archive, tmp_path):
    summary = replay_archive(archive, FlightBuild(), tmp_path / "out")
    costs = loads((tmp_path / "out/performance.json").read_text())
    assert set(costs["stages"]) == {"network", "detector", "navigation"}
    assert all(len(values) == FRAMES for values in costs["stages"].values())
    assert min(value for i, value in enumerate(costs["stages"]["network"]) if i != NO_IMAGE) > 0.0
    assert summary["frames"] == FRAMES
    assert set(summary) >= {"outcomes", "fixes", "truth_reads_after_start", "realtime_factor"}


def test_a_frame_that_the_camera_did_not_give_is_recorded_as_such(archive):
    record = load_record(archive)
    frames = [item for item in record.inputs if item.number >= 0]
    assert [item.image_sha256 == "" for item in frames] == [i == NO_IMAGE for i in range(FRAMES)]
    assert load_image(archive, frames[NO_IMAGE]).size == 0
    assert missing_frames(archive, record.inputs) == []


def test_an_archive_without_frames_is_rendered_bit_for_bit(copy, archive, tmp_path):
    (copy / "frames/000003.png").unlink()
    with raises(RecordError, match="1 missing, the first 3"):
        replay_archive(copy, FlightBuild(), tmp_path / "refused")
    manifest = complete_archive(copy, tmp_path / "whole", DataFolder())
    assert (tmp_path / "whole/frames/000003.png").read_bytes() == (archive / "frames/000003.png").read_bytes()
    assert set(manifest["files"]) == set(loads((archive / "manifest.json").read_text())["files"])


def test_a_scenario_that_renders_something_else_is_refused(copy, tmp_path):
    (copy / "frames/000003.png").unlink()
    restated(copy, lambda m: m.update(scenario_toml=m["scenario_toml"].replace("seed = 7", "seed = 8")))
    with raises(RecordError, match="frame 3 rendered from the scenario"):
        replay_archive(copy, FlightBuild(), tmp_path / "out", data=DataFolder())


def test_an_archive_that_cannot_be_flown_says_why(copy, tmp_path):
    """Another image, detections that are none, samples of a withdrawn instrument, an archive of before."""

    def refused(match):
        with raises(RecordError, match=match):
            replay_archive(copy, FlightBuild(), tmp_path / "out")

    image, path = copy / "frames/000001.png", copy / "payload/inputs.jsonl"
    whole = image.read_bytes()
    shutil.copy(copy / "frames/000000.png", image)
    refused("SHA-256")
    image.write_bytes(whole)
    (copy / "payload/detections.jsonl").write_text('{"ticks": 1}\n')
    refused("expected the detections of each image, found something else")
    path.write_text(path.read_text().replace('{"frame"', '{"instruments": {"altimeter": []}, "frame"', 1))
    refused(r"inputs\.jsonl, line 1: .* found samples of altimeter")
    shutil.rmtree(path.parent)
    refused(r"expected payload/inputs\.jsonl, found none")


def test_a_parameter_of_older_code_is_dropped_and_reported(copy, tmp_path):
    path = copy / "payload/parameters.toml"
    path.write_text(path.read_text().replace("[detector]\n", "[detector]\nforgotten = 3\n"))
    assert replay_archive(copy, FlightBuild(), tmp_path / "out")["dropped"] == ["detector.forgotten"]


def test_a_build_changes_the_parameters_that_it_names_only(archive, tmp_path):
    (tmp_path / "p.toml").write_text("detector.score_threshold = 0.9\n")
    (tmp_path / "build.toml").write_text('name = "strict"\nparameters = "p.toml"\n')
    build = load_flight_build(tmp_path / "build.toml")
    assert not names_command(tmp_path / "build.toml")
    plain = replay_archive(archive, FlightBuild(), tmp_path / "plain")
    assert replay_archive(archive, build, tmp_path / "strict")["detections"] < plain["detections"]


def test_a_build_flies_its_own_network(archive):
    network = onnx.load_model_from_string(load_shipped_model())
    uncalibrated = [one for one in network.metadata_props if "calibration" not in one.key]
    del network.metadata_props[:]
    network.metadata_props.extend(uncalibrated)
    own = network.SerializeToString()
    record = load_record(archive)
    octets = b"".join(replay(record, stored_images(archive, record), FlightBuild(model=own)).packets)
    reported = DICTIONARY.unpack_many(octets, cut_packets(octets))["housekeeping"].columns["model_hash"]
    flown, shipped = (OnnxDetector(one).model_hash for one in (own, load_shipped_model()))
    assert set(reported.tolist()) == {flown} != {shipped}


def test_a_build_file_of_a_program_is_not_flown_here(tmp_path):
    (tmp_path / "build.toml").write_text('name = "x"\ncommand = ["x", "{archive}", "{out}"]\n')
    assert names_command(tmp_path / "build.toml")
    with raises(ParameterError, match="found one with a command"):
        load_flight_build(tmp_path / "build.toml")


def test_parameters_survive_their_file_and_one_can_be_set_by_its_dotted_name():
    parameters = BuildParameters(flight=FlightParameters())
    again = parse_parameters(format_parameters(parameters))
    assert again == parameters
    assert again.flight.sha256 == parameters.flight.sha256
    assert BuildParameters().flight.anchored.gravity_degree == 100
    assert parse_parameters("flight.anchored.gravity_degree = 4").flight.anchored.gravity_degree == 4


BAD = """
flight.anchored.gravity_degre = 3 -> , flight.anchored.gravity_degre: expected gravity_degree (nearest known key),\
 found an unknown key
flight.anchored.gravity_degree = 'x' -> expected a whole number, found 'x'
flight.modes = ["sideways"] -> , flight.modes[0]: expected one of
flight = 3 -> , flight: expected a table, found 3
flight = -> : expected parameters (TOML), found\x20
detector.score_threshold = 1.5 -> , detector.score_threshold: expected a finite number from 0 to 1, found 1.5
detector.score_threshold = nan -> expected a finite number from 0 to 1, found nan
flight.anchored.search_radius_m = inf -> expected a finite number from 0, found inf
flight.anchored.detection_sigma_px = -0.1 -> expected a finite number from 0, found -0.1
flight.anchored.errors.catalogue_offset_m = [1.0, -1.0, 1.0] -> catalogue_offset_m[1]: expected a finite
flight.housekeeping_interval_s = 0 -> expected a finite number from 0.001, found 0
detector.max_detections = 0 -> expected a finite number from 1, found 0
flight.anchored.offset.noise_fixes = 0 -> expected a finite number from 1, found 0
flight.anchored.offset.noise_largest = 0.5 -> expected a finite number from 1, found 0.5
flight.anchored.lost.minimum_altitude_m = 60000 -> flight.anchored.lost.minimum_altitude_m: expected at most\
 maximum_altitude_m = 55000.0, found 60000.0
flight.anchored.limits.highest_radius_m = 1 -> lowest_radius_m: expected at most highest_radius_m = 1.0
"""


@mark.parametrize("text, message", [line.split(" -> ") for line in BAD.strip().splitlines()])
def test_a_bad_parameter_is_refused_with_its_name(text, message):
    with raises(ParameterError) as error:
        parse_parameters(text, source="p.toml")
    assert message in str(error.value) and str(error.value).startswith(("p.toml: ", "p.toml, "))


def test_the_shipped_suite_has_a_pass_of_every_kind():
    scenarios = suite_scenarios(frames=10, seeds=2)
    assert len(scenarios) == 2 * len(list(SUITE.glob("*.toml"))) == 12
    assert {scenario.light.mode for scenario in scenarios} == {"paper", "real"}
    assert any(scenario.disturbances.outage_duration_s > 0.0 for scenario in scenarios)
    assert all(scenario.window.duration_s == 10 * scenario.camera.frame_interval_s for scenario in scenarios)
    assert len({scenario.name for scenario in scenarios}) == 12
    # By the names as `linna regress suite` lists them, or by file.
    low = suite_scenarios(["low", str(SUITE / "low.toml")])
    assert [one.name for one in low] == ["suite-low", "suite-low"]


def test_the_dictionary_of_the_archive_decodes_its_downlink(archive):
    from tmtc.dictionary.definitions import parse_dictionary

    dictionary = parse_dictionary((archive / "payload/dictionary.json").read_text())
    assert dictionary.hash == DICTIONARY.hash
    assert decode((archive / "downlink.cadu").read_bytes(), dictionary=dictionary).unknown == 0


cv2 = Lazy("cv2")

TEXT = """
name = "given"
seed = 5
[dynamics]
gravity = "builtin"
degree = 8
orientation = "iau"
[window]
search = "none"
start = "2029-08-08T02:58:00Z"
duration_s = 60.0
latitude_limit_deg = 90.0
[camera]
frame_interval_s = 20.0
tilt_deg = 4.0
[attitude]
pointing_error_deg = 0.5
knowledge_noise_deg = 0.0
knowledge_bias_deg = 0.0
[light]
mode = "real"
[terrain]
source = "procedural"
[navigation]
estimators = ["anchored"]
filter_gravity = "builtin"
filter_degree = 8
"""


@fixture(scope="module")
def flown(tmp_path_factory):
    """A pass with all its frames, and its images, orbit and attitudes as somebody else would give them."""
    folder = tmp_path_factory.mktemp("flown", numbered=True)
    emulate(parse_scenario(TEXT), DataFolder(), folder / "pass", frames_kept=None)
    given = folder / "given"
    given.mkdir(mode=0o700)
    rows = [line.split(",") for line in (folder / "pass/frame_times.csv").read_text().splitlines()[1:]]
    table = ["file,utc"]
    for number, utc_ns in rows:
        name = f"{int(number):06d}.png"
        shutil.copy(folder / "pass/frames" / name, given / name)
        table.append(f"{name},{format_utc(int(utc_ns), 9)}")
    (given / "frames.csv").write_text("\n".join(table) + "\n")
    shutil.copy(folder / "pass/truth.oem", given / "orbit.oem")
    times = np.array([int(utc_ns) for _, utc_ns in rows], dtype=np.int64)
    q_wxyz = np.array([item["attitude"][:4] for item in inputs(folder / "pass") if item["frame"] >= 0])
    (given / "attitude.aem").write_text(format_aem((AttitudeSegment(times, q_wxyz),)))
    (given / "scenario.toml").write_text(TEXT)
    return folder


def inputs(folder):
    return [loads(line) for line in (folder / "payload/inputs.jsonl").read_text().splitlines()]


def copied(flown, to):
    shutil.copytree(flown / "given", to)
    return to


def test_a_pass_that_is_given_back_shows_the_payload_the_same(flown, tmp_path, capsys):
    from linna.cli import run

    out = tmp_path / "again"
    command = ["emulate", "--images", str(flown / "given"), "--evidence", "photographs", "--out", str(out), "--json"]
    assert run(command) == 0
    summary = loads(capsys.readouterr().out)
    assert summary["frames"] == summary["frames_kept"] == 3
    assert summary["data"][0].startswith("external images given (000000.png") and summary["warnings"] == []
    first = [item for item in inputs(flown / "pass") if item["frame"] >= 0]
    again = [item for item in inputs(out) if item["frame"] >= 0]
    assert [item["pixels_sha256"] for item in again] == [item["pixels_sha256"] for item in first]
    assert [item["ticks"] for item in again] == [item["ticks"] for item in first]
    for one, other in zip(first, again, strict=True):
        # An AEM has ten digits and more; a pointing error of half a degree would show at once.
        assert_allclose(other["attitude"][:4], one["attitude"][:4], atol=1e-9)
    assert 'world = "photographs"' in (out / "mission.toml").read_text()
    # Nothing outside the archive is needed to fly it again.
    assert replay_archive(out, FlightBuild(), tmp_path / "replayed")["frames"] == 3


@mark.parametrize("seen_deg, elevation, count", [(50.0, 1.0, 0), (140.0, 1.0, 3), (90.0, -1.0, 3), (None, -1.0, 0)])
def test_a_frame_is_named_if_its_sun_is_off_by_45_degrees_or_below_the_horizon(monkeypatch, seen_deg, elevation, count):
    """The ephemeris has the Sun at the right of the image, at an azimuth of 90 degrees."""
    x, seen = np.array([1.0, 0.0, 0.0]), seen_deg and SimpleNamespace(azimuth_deg=seen_deg, determined=True)
    exposure = SimpleNamespace(image=np.zeros((4, 4), np.uint8), attitude=np.array([1.0, 0, 0, 0, 1.0, 0.0]))
    for name, value in ("expose", exposure), ("find_sun", seen), ("true_sun_direction", elevation * x):
        monkeypatch.setattr(emulator, name, lambda *_, value=value: value)
    truth = SimpleNamespace(positions_mcmf=lambda _: 1.8e6 * x[None])
    world = SimpleNamespace(frame_utc_ns=np.arange(5) * 10**9, truth=truth)
    assert len(sun_warnings(world, SimpleNamespace(preparation=Preparation.gray_first))) == count


def test_without_attitudes_the_camera_points_as_the_scenario_says(flown, tmp_path):
    folder = copied(flown, tmp_path / "given")
    (folder / "attitude.aem").unlink()
    scenario = parse_scenario(TEXT)
    frames = load_external(folder, scenario)
    assert frames.camera_from_icrf(int(frames.utc_ns[0])) is None
    emulate(scenario, DataFolder(), tmp_path / "out", external=frames)
    one = next(item for item in inputs(flown / "pass") if item["frame"] == 0)["attitude"][:4]
    other = next(item for item in inputs(tmp_path / "out") if item["frame"] == 0)["attitude"][:4]
    # The scenario's pointing without its error of half a degree.
    assert 1e-4 < 2.0 * np.arccos(min(1.0, abs(np.dot(one, other)))) < 0.05
    assert "photographs" not in (tmp_path / "out/mission.toml").read_text()


def test_attitudes_between_two_epochs_lie_on_the_arc_between_them(flown, tmp_path):
    folder = copied(flown, tmp_path / "given")
    start = load_external(folder, parse_scenario(TEXT)).utc_ns[0]
    half = np.radians(20.0)
    turned = np.array([[1.0, 0, 0, 0], [-np.cos(half), 0, 0, -np.sin(half)]])
    times = np.array([start, start + 40_000_000_000])
    (folder / "attitude.aem").write_text(format_aem((AttitudeSegment(times, turned),)))
    frames = load_external(folder, parse_scenario(TEXT))
    quarter = frames.camera_from_icrf(int(start) + 10_000_000_000)
    # A quarter of forty degrees, whatever the sign of the quaternion.
    assert np.degrees(np.arccos((np.trace(quarter) - 1.0) / 2.0)) == approx(10.0, abs=1e-6)
    assert np.trace(frames.camera_from_icrf(int(start))) == approx(3.0)
    (folder / "attitude.aem").unlink()
    assert load_external(folder, parse_scenario(TEXT)).camera_from_icrf(int(start)) is None


def edited(name, old, new):
    def edit(folder):
        path = folder / name
        path.write_text(path.read_text().replace(old, new, 1))

    return edit


@mark.parametrize(
    "edit, words",
    [
        (lambda folder: (folder / "frames.csv").unlink(), "frames.csv: expected a table with columns file and utc"),
        (edited("frames.csv", "file,utc", "name,utc"), "frames.csv, line 2: expected a file and a UTC"),
        (edited("frames.csv", "2029-", "20x9-"), "frames.csv, line 2: expected a UTC, found '20x9-"),
        (
            edited("frames.csv", "000001.png,2029-08-08T02:58:20", "000001.png,2029-08-08T02:57:20"),
            "line 3: expected a time",
        ),
        (edited("frames.csv", "000001.png", "none.png"), "line 3: expected the image"),
        (edited("frames.csv", "000001.png", "000000.png"), "lines 2 and 3: expected an image of its own"),
        (lambda folder: (folder / "frames.csv").write_text("file,utc\n"), "expected at least one frame"),
        (lambda folder: (folder / "orbit.oem").unlink(), "expected one ephemeris *.oem, found 0"),
        (lambda folder: shutil.copy(folder / "orbit.oem", folder / "b.oem"), "expected one ephemeris *.oem, found 2"),
        (edited("attitude.aem", "ICRF", "MOON_ME"), "attitude.aem"),
        (
            edited("frames.csv", "000000.png,2029-08-08T02:58:00", "000000.png,2029-08-08T02:48:00"),
            "expected attitudes from",
        ),
        (edited("scenario.toml", "tilt_deg = 4.0", "width_px = 500"), "found 512 x 512"),
    ],
)
def test_a_broken_folder_is_refused_in_one_line(flown, tmp_path, capsys, edit, words):
    from linna.cli import run

    folder = copied(flown, tmp_path / "given")
    edit(folder)
    assert run(["emulate", "--images", str(folder), "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err.strip().splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_frames_outside_the_ephemeris_are_refused(flown, tmp_path):
    folder = copied(flown, tmp_path / "given")
    (folder / "attitude.aem").unlink()
    edited("frames.csv", "000000.png,2029-08-08T02:58:00", "000000.png,2029-08-08T01:30:00")(folder)
    scenario = parse_scenario(TEXT)
    with raises(ScenarioError, match="expected states from 2029-08-08T01:30"):
        emulate(scenario, DataFolder(), tmp_path / "out", external=load_external(folder, scenario))


@mark.parametrize(
    "arguments, words",
    [
        ([], "expected a scenario or --images DIR"),
        (["selenita", "--evidence", "photographs"], "--evidence: expected together with --images"),
        (["selenita", "--images", "x", "--live"], "--images: expected together with --out DIR alone"),
    ],
)
def test_options_that_do_not_fit_are_refused(arguments, words, capsys):
    from linna.cli import run

    assert run(["emulate", *arguments]) == 2
    assert words in capsys.readouterr().err
