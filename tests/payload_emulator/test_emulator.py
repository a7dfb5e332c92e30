"""A pass with contacts, losses and faults: the archive's own account is what the ground finds."""

import hashlib
import json
import math
from dataclasses import replace

import numpy as np
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark, raises

from lunar.datafolder import DataFolder, find_data
from lunar.ephemeris import Ephemeris, ephemeris_from_states
from lunar.frames import IauOrientation, rtn_from_inertial
from lunar.timescales import parse_utc
from payload_emulator.errors import ScenarioError
from payload_emulator.flight.payload import Payload
from payload_emulator.session.archive import emulator
from payload_emulator.session.archive.emulator import emulate
from payload_emulator.session.scenario import SHIPPED, ReferenceSection, load_scenario, parse_scenario
from payload_emulator.session.world.frame import render_frame
from payload_emulator.session.world.world import _truth_of_ephemeris, sample_truth, with_reference_error
from tmtc.dictionary.tables import CatalogueTable, pack_catalogue_table
from tmtc.downlink import decode
from tmtc.errors import TableError

ORBIT = """
[dynamics]
gravity = "builtin"
degree = 8
orientation = "iau"
[window]
search = "none"
start = "2029-08-08T02:30:00Z"
"""

SCENARIO = f"""
name = "lossy"
seed = 11
{ORBIT}duration_s = 6600.0
[camera]
images = "reduced"
frame_interval_s = 30.0
[terrain]
source = "procedural"
[navigation]
estimators = ["spherical"]
filter_gravity = "builtin"
filter_degree = 8
[clock]
offset_s = 0.4
drift_ppm = 3.0
[link]
stations = ["goldstone", "madrid", "canberra"]
minimum_elevation_deg = 5.0
rate_bps = 16000.0
frame_loss = 0.02
burst_start = 0.01
burst_end = 0.3
burst_frame_loss = 0.3
burst_bit_error_rate = 5e-3
repeat_share = 0.2
reorder_share = 0.2
playback = true
[faults]
events = ["processor_hang at 600", "camera_dark at 1200 for 120"]
"""


@fixture(scope="module")
def archive(tmp_path_factory):
    out = tmp_path_factory.mktemp("lossy") / "pass"
    return emulate(parse_scenario(SCENARIO), find_data(None), out), out


def test_every_octet_of_a_lossy_downlink_is_accounted_for(archive):
    summary, out = archive
    link, octets = summary["link"], (out / "downlink.cadu").read_bytes()
    found = decode(octets).accounting()
    for key in ("frames", "frames_bad", "packets", "duplicates"):
        assert found[key] == link[key], key
    assert sum(found["octets"].values()) == link["octets"] == len(octets)
    assert (found["crc_errors"], found["conflicts"], found["unknown"]) == (0, 0, 0)
    # Late playback and repeated dumps make copies; what is missing by its counts was lost on the link.
    assert link["duplicates"] > 0 and link["packets_lost"] > 0
    assert found["packets_missing"] <= link["packets_lost"]
    assert json.loads((out / "summary.json").read_text())["link"] == link


def test_the_machine_tells_of_its_faults_and_finishes_the_window(archive):
    summary, out = archive
    assert summary["resets"] == ["watchdog"]
    assert summary["mode"] in ("standby", "downlinking")
    tables = decode((out / "downlink.cadu").read_bytes()).tables()
    events = {int(code) for name, t in tables.items() if name.startswith("event_") for code in t.columns["event_id"]}
    # boot, activity released, image dark, watchdog reset, state recovered
    assert {1, 5, 16, 50, 57} <= events
    quantities = tables["housekeeping"].columns
    assert quantities["boot_count"].max() == 2
    assert 20.0 > quantities["power_w"].max() > quantities["power_w"].min() > 1.0
    assert 10.0 < quantities["bus_voltage_v"].min() <= quantities["bus_voltage_v"].max() < 13.0
    # No frame is seen twice, and none goes back in time.
    table = tables["detections"]
    _, first = np.unique(table.ticks, return_index=True)
    assert np.all(np.diff(table.columns["frame_number"][first]) >= 1)


def test_the_dumps_are_listed_with_the_times_they_left(archive):
    summary, out = archive
    head, *rows = (out / "dumps.csv").read_text().splitlines()
    assert head == "sent_utc,received_utc,virtual_channel,packets,octets"
    assert len(rows) == summary["link"]["dumps"]
    assert sum(int(row.split(",")[3]) for row in rows) == summary["packets"]
    assert {row.split(",")[2] for row in rows} == {"0", "1"}
    # The Moon is 1.2 to 1.4 light seconds away.
    ways_s = [(parse_utc(b) - parse_utc(a)) / 1e9 for a, b in (row.split(",")[:2] for row in rows)]
    assert all(1.15 < way_s < 1.4 for way_s in ways_s)


def test_the_ground_finds_the_time_of_every_frame_from_time_reports(archive, tmp_path):
    from ground_service.evaluation.inputs import load_pass_inputs
    from ground_service.ground import open_ground
    from ground_service.missions.timekeeping.store import correlations_in_force
    from ground_service.passes.archive_import import import_archive
    from ground_service.worker.follow_up import follow_in_process

    _, out = archive
    true = np.loadtxt(out / "frame_times.csv", delimiter=",", skiprows=1, dtype=np.int64)
    with open_ground(tmp_path / "home") as ground:
        follow_in_process(ground)
        found = load_pass_inputs(ground, import_archive(ground, out)).detections
        lines = ground.read(correlations_in_force, 1)
    assert [line.boot_count for line in lines] == [1, 2]
    assert lines[1].drift_ppb == approx(-3000.0, abs=200.0)
    nearest = np.abs(found.utc_ns[:, None] - true[None, :, 1]).min(axis=1)
    # 0.4 s off without the correlation; a tick is 15 us, and the first line is carried on to the boot.
    assert nearest.max() < 1_000_000


SHORT = f"""
name = "short"
{ORBIT}duration_s = 90.0
latitude_limit_deg = 90.0
[camera]
images = "reduced"
frame_interval_s = 30.0
[terrain]
source = "procedural"
[navigation]
estimators = ["anchored"]
filter_gravity = "builtin"
filter_degree = 8
"""


def test_a_named_anchoring_table_is_uploaded_as_it_is(tmp_path):
    table = CatalogueTable(
        np.arange(3), np.radians([10.0, 20.0, 30.0]), np.radians([40.0, 50.0, 60.0]), np.full(3, 8e3), np.zeros(3),
        np.full((3, 3), 50.0),
    )  # fmt: skip
    named = tmp_path / "three.table"
    named.write_bytes(pack_catalogue_table(table))
    emulate(parse_scenario(SHORT).with_choices(anchoring_catalogue=named), find_data(None), tmp_path / "pass")
    manifest = json.loads((tmp_path / "pass/manifest.json").read_text())
    assert manifest["tables"]["catalogue"] == hashlib.sha256(named.read_bytes()).hexdigest()


def test_an_anchoring_table_that_is_none_is_refused_before_the_flight(tmp_path):
    (tmp_path / "damaged.table").write_bytes(b"no table")
    for name, words in (("none.table", ": expected a table made by linna catalogue curate"), ("damaged.table", "")):
        scenario = parse_scenario(SHORT).with_choices(anchoring_catalogue=tmp_path / name)
        with raises(TableError, match=name + words if words else None):
            emulate(scenario, find_data(None), tmp_path / "pass")
    assert not (tmp_path / "pass").exists()


@mark.parametrize("reads", [0, 2])
def test_reads_of_the_truth_are_counted_where_they_happen(reads, tmp_path, monkeypatch):
    """A payload cannot read the truth; a payload with access to it is detected."""
    stolen = []
    build, step = emulator.build_world, Payload.step

    def seen(*given):
        stolen.append(build(*given))
        return stolen[0]

    def stealing(self, *given):
        for _ in range(reads):
            stolen[0].truth.states(int(stolen[0].frame_utc_ns[0]))
        return step(self, *given)

    monkeypatch.setattr(emulator, "build_world", seen)
    monkeypatch.setattr(Payload, "step", stealing)
    text = SCENARIO.replace("duration_s = 6600.0", "duration_s = 90.0").replace('name = "lossy"', 'name = "short"')
    text = text.replace('estimators = ["spherical"]', 'estimators = ["paper"]')
    text = text.replace("2029-08-08T02:30:00Z", "2029-08-07T01:40:00Z")
    summary = emulate(parse_scenario(text), find_data(None), tmp_path / "pass")
    frames = summary["frames"]
    assert frames >= 2
    assert summary["truth_reads_after_start"] >= reads * frames
    assert (summary["truth_reads_after_start"] > 0) is (reads > 0)
    # The odometry reads its anchor ephemeris at every frame: that is another count.
    assert summary["anchor_reads_after_start"] >= frames - 1


EPOCH = parse_utc("2029-08-07T00:10:00Z")


@fixture(scope="module")
def scenario():
    scenario = load_scenario(SHIPPED / "selenita.toml")
    return replace(scenario, terrain=replace(scenario.terrain, source="procedural"))


@fixture(scope="module")
def frame(scenario):
    return render_frame(scenario, DataFolder(), EPOCH)


def test_a_frame_tells_where_and_under_what_sun_it_was_taken_as_json_without_nan(frame):
    assert frame.image.shape == (512, 512, 3) and frame.image.dtype == np.uint8
    assert frame.metadata["epoch"] == "2029-08-07T00:10:00.000Z"
    # The paper's light, and its orbit's altitudes.
    assert 5.0 <= frame.metadata["sun_elevation_deg"] <= 15.0
    assert -45.0 <= frame.metadata["sun_azimuth_deg"] <= 45.0
    assert 10.0 < frame.metadata["altitude_km"] < 60.0
    assert len(frame.metadata["corners_deg"]) == 4
    text = json.dumps({"metadata": frame.metadata, "labels": frame.labels}, allow_nan=False)
    assert json.loads(text)["labels"] == frame.labels
    assert any(label["inside"] for label in frame.labels)


def test_the_same_scenario_and_epoch_give_the_same_picture(scenario, frame):
    again = render_frame(scenario, DataFolder(), EPOCH)
    assert_array_equal(again.image, frame.image)
    assert again.labels == frame.labels


@mark.parametrize(
    "chosen, words",
    [((EPOCH - 10**15,), "at or after the scenario's"), ((EPOCH, "magic"), "fast, raymarch, cycles, found 'magic'")],
)
def test_an_epoch_before_the_orbit_and_an_unknown_renderer_are_refused(scenario, chosen, words):
    with raises(ScenarioError, match=words):
        render_frame(scenario, DataFolder(), *chosen)


GM = 4.9028e12
RADIUS_M = 1_767_400.0
RATE = math.sqrt(GM / RADIUS_M**3)
PERIOD_S = 2.0 * math.pi / RATE
SECTION = ReferenceSection(radial_m=10.0, transverse_m=30.0, normal_m=15.0)
TIMES_NS = np.arange(0, round(PERIOD_S) + 1, 30, dtype=np.int64) * 1_000_000_000


def circle():
    u = RATE * TIMES_NS / 1e9
    zero = np.zeros_like(u)
    position = RADIUS_M * np.stack([np.cos(u), np.sin(u), zero], axis=1)
    return ephemeris_from_states(TIMES_NS, position, RATE * RADIUS_M * np.stack([-np.sin(u), np.cos(u), zero], axis=1))


def errors_rtn_m(section, seed):
    truth = circle()
    wrong = with_reference_error(truth, section, seed).segments[0]
    own = truth.segments[0]
    rtn = rtn_from_inertial(own.position_m, own.velocity_m_s)
    return np.einsum("nij,nj->ni", rtn, wrong.position_m - own.position_m)


def test_errors_have_the_declared_sizes():
    """300 draws of a root mean square: its own standard error is 4 %, so that 13 % is three of them."""
    squares = [np.mean(errors_rtn_m(SECTION, seed) ** 2, axis=0) for seed in range(300)]
    assert_allclose(np.sqrt(np.mean(squares, axis=0)), SECTION.sigma_rtn_m, rtol=0.13)


def test_the_wrong_orbit_is_an_orbit():
    """Its first state, flown for a revolution in a point mass's field, stays on it to the squares left out (1 mm)."""
    wrong = with_reference_error(circle(), SECTION, 3).segments[0]
    state = np.concatenate([wrong.position_m[0], wrong.velocity_m_s[0]])

    def slope(s):
        return np.concatenate([s[3:], -GM * s[:3] / norm(s[:3]) ** 3])

    worst = 0.0
    for k in range(1, len(TIMES_NS)):
        for _ in range(3):  # Runge-Kutta of fourth order, steps of 10 s
            h = 10.0
            k1 = slope(state)
            k2 = slope(state + 0.5 * h * k1)
            k3 = slope(state + 0.5 * h * k2)
            state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + slope(state + h * k3))
        worst = max(worst, float(norm(state[:3] - wrong.position_m[k])))
    assert np.abs(errors_rtn_m(SECTION, 3)).max() > 5.0
    assert worst < 0.02


def test_the_same_seed_gives_the_same_errors_none_the_truth_and_an_offset_adds_in_squares():
    assert_array_equal(errors_rtn_m(SECTION, 1), errors_rtn_m(SECTION, 1))
    assert np.abs(errors_rtn_m(SECTION, 1) - errors_rtn_m(SECTION, 2)).max() > 1.0
    truth = circle()
    assert with_reference_error(truth, ReferenceSection(), 1) is truth
    section = ReferenceSection(position_error_m=40.0, radial_m=30.0, transverse_m=60.0)
    assert section.sigma_rtn_m == approx((50.0, math.hypot(40.0, 60.0), 40.0))


@mark.parametrize(
    "line, message",
    [
        ("radial_m = 10.0", "reference.transverse_m must be at least twice reference.radial_m, found 0.0"),
        ("normal_m = -1.0", "reference.normal_m must be zero or more, found -1.0"),
    ],
)
def test_errors_that_no_orbit_has_are_refused(line, message):
    with raises(ScenarioError, match=message):
        parse_scenario(f'name = "x"\n[reference]\n{line}\n')


@mark.parametrize("path", sorted([*SHIPPED.glob("*.toml"), *SHIPPED.glob("suite/*.toml")]), ids=lambda path: path.stem)
def test_the_reference_of_a_shipped_scenario_is_not_the_truth(path):
    if "[dataset" in path.read_text():
        return
    assert 10.0 <= math.hypot(*load_scenario(path).reference.sigma_rtn_m) <= 100.0


def test_the_arcs_of_a_flown_ephemeris_are_those_of_the_reference():
    """The second orbit solution is 10 km higher; the state at its start is its own, 20 ns of TDB notwithstanding."""
    one = circle().segments[0]
    first = replace(one, utc_ns=one.utc_ns[:60], tai_ns=None, **states_of(one, slice(None, 60), 1.0))
    second = replace(one, utc_ns=one.utc_ns[59:], tai_ns=None, **states_of(one, slice(59, None), 1.00565))
    found = sample_truth(_truth_of_ephemeris(Ephemeris((first, second)), IauOrientation()), TIMES_NS[[30, 90]])
    assert found.segments[0].stop_utc_ns == found.segments[1].start_utc_ns == TIMES_NS[59]
    radii = norm([found.segments[0].position_m[-1], found.segments[1].position_m[0]], axis=1)
    assert_allclose(radii, [RADIUS_M, 1.00565 * RADIUS_M], atol=1.0)


def states_of(one, part, scale):
    return {"position_m": scale * one.position_m[part], "velocity_m_s": one.velocity_m_s[part]}
