"""Frames that others took: a flown pass given back as a folder of images, orbit and attitudes."""

import json
import re
import shutil

import numpy as np
import pytest

from lunar.datafolder import DataFolder
from lunar.messages.aem import AttitudeSegment, format_aem
from lunar.timescales import format_utc
from payload_emulator.errors import ScenarioError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.session.archive import emulator
from payload_emulator.session.archive.emulator import emulate, sun_warnings
from payload_emulator.session.archive.replay import FlightBuild, replay_archive
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.world.external import load_external
from payload_emulator.session.world.world import build_world
from tests.lazy import Lazy

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


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A pass with all its frames, and its images, orbit and attitudes as somebody else would give them."""
    folder = tmp_path_factory.mktemp("flown", numbered=True)
    emulate(parse_scenario(TEXT), DataFolder(), folder / "pass", frames_kept=None)
    given = folder / "given"
    given.mkdir(mode=0o700)
    rows = [line.split(",") for line in (folder / "pass" / "frame_times.csv").read_text().splitlines()[1:]]
    table = ["file,utc"]
    for number, utc_ns in rows:
        name = f"{int(number):06d}.png"
        shutil.copy(folder / "pass" / "frames" / name, given / name)
        table.append(f"{name},{format_utc(int(utc_ns), 9)}")
    (given / "frames.csv").write_text("\n".join(table) + "\n")
    shutil.copy(folder / "pass" / "truth.oem", given / "orbit.oem")
    times = np.array([int(utc_ns) for _, utc_ns in rows], dtype=np.int64)
    q_wxyz = np.array([item["attitude"][:4] for item in inputs(folder / "pass") if item["frame"] >= 0])
    (given / "attitude.aem").write_text(format_aem((AttitudeSegment(times, q_wxyz),)))
    (given / "scenario.toml").write_text(TEXT)
    return folder


def inputs(folder):
    return [json.loads(line) for line in (folder / "payload" / "inputs.jsonl").read_text().splitlines()]


def copied(flown, to):
    shutil.copytree(flown / "given", to)
    return to


def test_a_pass_that_is_given_back_shows_the_payload_the_same(flown, tmp_path, capsys):
    from linna.cli import run

    out = tmp_path / "again"
    command = ["emulate", "--images", str(flown / "given"), "--evidence", "photographs", "--out", str(out), "--json"]
    assert run(command) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["frames"] == summary["frames_kept"] == 3
    assert summary["data"][0].startswith("external images given (000000.png") and summary["warnings"] == []
    first = [item for item in inputs(flown / "pass") if item["frame"] >= 0]
    again = [item for item in inputs(out) if item["frame"] >= 0]
    assert [item["pixels_sha256"] for item in again] == [item["pixels_sha256"] for item in first]
    assert [item["ticks"] for item in again] == [item["ticks"] for item in first]
    for one, other in zip(first, again, strict=True):
        # An AEM has ten digits and more; a pointing error of half a degree would show at once.
        np.testing.assert_allclose(other["attitude"][:4], one["attitude"][:4], atol=1e-9)
    assert 'world = "photographs"' in (out / "mission.toml").read_text()
    # Nothing outside the archive is needed to fly it again.
    replayed = replay_archive(out, FlightBuild(), tmp_path / "replayed")
    assert replayed["frames"] == 3


def test_frames_whose_sun_is_not_that_of_the_ephemeris_are_named_with_both_azimuths(flown, tmp_path, monkeypatch):
    folder, data, scenario = copied(flown, tmp_path / "given"), DataFolder(), parse_scenario(TEXT)
    detector = OnnxDetector(load_shipped_model())
    for image in sorted(folder.glob("*.png"))[1:]:
        cv2.imwrite(str(image), np.rot90(cv2.imread(str(image)), 2))
    world = build_world(scenario, data, load_external(folder, scenario))
    warnings = sun_warnings(world, detector)
    assert [text[9:].split("Z: ")[0] for text in warnings] == ["2029-08-08T02:58:20", "2029-08-08T02:58:40"]
    for text in warnings:
        seen, known = (float(azimuth) for azimuth in re.findall(r"(?:azimuth|at) (\d+) deg", text))
        assert abs(seen - known) == pytest.approx(180.0, abs=20.0)  # of a few craters
    monkeypatch.setattr(emulator, "true_sun_direction", lambda world, position, *_: -position / 1.8e6)
    assert len(sun_warnings(world, detector)) == 3 and "elevation -" in sun_warnings(world, detector)[0]


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
    assert "photographs" not in (tmp_path / "out" / "mission.toml").read_text()


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
    assert np.degrees(np.arccos((np.trace(quarter) - 1.0) / 2.0)) == pytest.approx(10.0, abs=1e-6)
    assert np.trace(frames.camera_from_icrf(int(start))) == pytest.approx(3.0)
    (folder / "attitude.aem").unlink()
    assert load_external(folder, parse_scenario(TEXT)).camera_from_icrf(int(start)) is None


def edited(name, old, new):
    def edit(folder):
        path = folder / name
        path.write_text(path.read_text().replace(old, new, 1))

    return edit


@pytest.mark.parametrize(
    ("edit", "words"),
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
    error = capsys.readouterr().err.strip().splitlines()
    assert words in error[-1]
    assert not (tmp_path / "out").exists()


def test_frames_outside_the_ephemeris_are_refused(flown, tmp_path):
    folder = copied(flown, tmp_path / "given")
    (folder / "attitude.aem").unlink()
    edited("frames.csv", "000000.png,2029-08-08T02:58:00", "000000.png,2029-08-08T01:30:00")(folder)
    scenario = parse_scenario(TEXT)
    with pytest.raises(ScenarioError, match="expected states from 2029-08-08T01:30"):
        emulate(scenario, DataFolder(), tmp_path / "out", external=load_external(folder, scenario))


@pytest.mark.parametrize(
    ("arguments", "words"),
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
