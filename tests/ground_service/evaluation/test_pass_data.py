"""Passes that are imported and evaluated with declared models and camera, whatever data the machine has."""

import hashlib
import json
import math
import shutil
from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose
from pytest import fixture, mark, raises

from ground_service.errors import EvaluationError, InvalidInput, NotFound, StorageFull
from ground_service.evaluation import service as reports
from ground_service.evaluation.inputs import load_pass_inputs, orientation_of
from ground_service.evaluation.recall import Viewing
from ground_service.evaluation.service import evaluate, make_report, pass_summary, report_document
from ground_service.ground import open_ground
from ground_service.http.model import Paging
from ground_service.ingest.service import ingest_file
from ground_service.missions import frames as declared
from ground_service.missions.ephemerides.service import HEADER, load_attitudes
from ground_service.missions.frames import camera_of, declared_frames
from ground_service.missions.model import Camera, Frames, Mission
from ground_service.missions.service import add_mission
from ground_service.passes.archive_import import import_archive
from ground_service.store import repository
from lunar.camera import BrownCamera, PinholeCamera, nadir_camera_from_mcmf
from lunar.datafolder import DataFolder
from lunar.frames import IauOrientation, continuous_quaternions, matrix_from_quaternion, quaternion_from_matrix
from lunar.gravity import builtin_gravity
from lunar.messages.aem import AttitudeSegment, format_aem
from lunar.timescales import format_utc, ticks_from_utc_ns
from reports import pdf_pages
from reports.render import to_json
from reports.values import SettingsComparison
from tests.ground_service.archive_hash import archive_hash
from tests.ground_service.conftest import circular_states, define_pass_of, enter_files
from tests.ground_service.evaluation.still import TurnedOrientation

MISSING_FILES = DataFolder(orientation_bpc=Path("no.bpc"), gravity=Path("no.gfc"), gravity_alternative=Path("no.cof"))
"""A data folder with other models; none of them may even be opened."""


def changed_archive(synthetic_pass, folder, attitude="", **changed):
    """Copy the archive, with a table of attitudes if any is given."""
    shutil.copytree(synthetic_pass.folder, folder)
    if attitude:
        (folder / "attitude.csv").write_text(f"{HEADER}\n{attitude}")
    enter_files(folder, **changed)
    return folder


def report_text(home, data, archive):
    with open_ground(home, data) as ground:
        return to_json(evaluate(ground, import_archive(ground, archive)))


def test_a_report_does_not_depend_on_the_data_of_the_machine(synthetic_pass, tmp_path):
    without = report_text(tmp_path / "a", DataFolder(), synthetic_pass.folder)
    assert report_text(tmp_path / "b", MISSING_FILES, synthetic_pass.folder) == without
    assert json.loads(without)["provenance"]["lunar orientation"] == "IAU WGCCRE 2009"


def test_a_pass_of_a_spacecraft_without_a_mission_description_says_so_and_how_to_enter_one(synthetic_pass, ground):
    """As of a pass flown live, whose mission description nobody has entered: the packets come, no document does."""
    ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
    report = evaluate(ground, define_pass_of(ground, synthetic_pass))
    assert report.verdict.startswith("Nothing can be judged: no mission description of spacecraft 76")
    assert "linna mission write SCENARIO" in report.verdict and "linna mission add FILE" in report.verdict
    assert report.verdict_level == "unknown"
    assert report.requirements[0].key == "mission"
    assert {one.status for one in report.requirements} == {"unknown"}
    assert report.provenance["mission description"] == "none registered"

    add_mission(ground, MISSION_76)
    again = evaluate(ground, define_pass_of(ground, synthetic_pass))
    table = {one.key: one.status for one in again.requirements}
    assert "mission" not in table
    assert table["completeness.packets"] in ("met", "unknown") and table["detector.recall"] == "not judged"


@mark.parametrize("stated", [b"", b"[observation]\nneeds_daylight = false\n"])
def test_the_sun_of_images_is_unknown_where_a_simulated_world_draws_its_light(synthetic_pass, ground, stated):
    add_mission(ground, MISSION_76 + stated)
    ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
    assert load_pass_inputs(ground, define_pass_of(ground, synthetic_pass)).sun_known == (stated == b"")


MISSION_76 = b"""name = "live"
[spacecraft]
id = 76
[requirements]
packets_percent = 10.0
"""


def test_a_pass_is_evaluated_in_the_orientation_that_it_declares(synthetic_pass, tmp_path, monkeypatch):
    """Turning the ground by 0.01 degrees moves an estimate by 308 m times the cosine of its latitude."""
    monkeypatch.setattr(declared, "_kernel", lambda data: TurnedOrientation())
    folder = changed_archive(synthetic_pass, tmp_path / "a", data_sources=["orientation DE421"])
    with open_ground(tmp_path / "home", MISSING_FILES) as ground:
        report = evaluate(ground, import_archive(ground, folder))
        shift = next(s for s in report.navigation if s.name == "spherical")
        latitude = np.radians(shift.latitude_deg)
    moved = shift.error_rtn_m - np.array([30.0, -40.0, 120.0])
    radius_m = 1_767_400.0
    assert_allclose(np.linalg.norm(moved, axis=1), radius_m * math.radians(0.01) * np.cos(latitude), rtol=2e-3)


def test_declared_models_are_used_and_others_are_named_as_missing():
    built_in = builtin_gravity()
    found = declared_frames(
        Frames(orientation="IAU WGCCRE 2009", gravity_field=built_in.name, gravity_degree=6), DataFolder()
    )
    assert found.orientation == IauOrientation()
    assert found.gravity.degree == 6
    assert set(found.refused) == {"onboard_orientation", "onboard_gravity"}
    assert "does not state the gravity field of the filter" in found.refused["onboard_gravity"]
    lost = declared_frames(Frames(orientation="DE440", gravity_field="GRGM1200L"), DataFolder())
    assert (lost.orientation, lost.gravity) == (None, None)
    assert "lunar orientation DE440, which is not available" in lost.refused["orientation"]
    assert "gravity field GRGM1200L, which is not available" in lost.refused["gravity"]


def test_a_regression_refuses_an_archive_whose_orientation_is_not_there_and_takes_no_kernel_of_another_name(
    monkeypatch,
):
    monkeypatch.setattr(declared, "_kernel", lambda data: TurnedOrientation("DE440"))
    with raises(EvaluationError, match="DE421, which is not available"):
        orientation_of(Mission(name="m", frames=Frames(orientation="DE421")), MISSING_FILES)
    assert orientation_of(Mission(name="m", frames=Frames(orientation="IAU WGCCRE 2009")), DataFolder())


def test_the_camera_is_the_declared_one_with_its_lens():
    assert camera_of(Camera()) == PinholeCamera()
    assert camera_of(Camera(width_px=256, height_px=128, fov_deg=90.0, k1=0.0)) == PinholeCamera(
        256, 128, math.pi / 2.0
    )
    assert camera_of(Camera(k1=-0.01, p2=1e-4)) == BrownCamera(k1=-0.01, p2=1e-4)


def test_the_attitude_of_an_archive_is_found_by_the_time_of_the_image(synthetic_pass, ground, tmp_path):
    ticks = ticks_from_utc_ns(synthetic_pass.utc_ns[[5, 2]])
    q_wxyz = quaternion_from_matrix(nadir_camera_from_mcmf(circular_states(synthetic_pass.utc_ns[[5, 2]])[0]))
    rows = "".join(f"{tick},{','.join(map(repr, q))}\n" for tick, q in zip(ticks, q_wxyz.tolist(), strict=True))
    folder = changed_archive(synthetic_pass, tmp_path / "a", attitude=rows)
    viewing = load_pass_inputs(ground, import_archive(ground, folder)).viewing
    assert np.flatnonzero(viewing.known(synthetic_pass.utc_ns)).tolist() == [2, 5]
    assert viewing.q_wxyz.tolist() == q_wxyz[::-1].tolist()


def first_nadir(synthetic_pass):
    """Rotation (3, 3) of a camera that looks down at the first image."""
    return nadir_camera_from_mcmf(circular_states(synthetic_pass.utc_ns[:1])[0])[0]


def with_attitude_message(synthetic_pass, folder, **fields):
    """Copy the archive with an AEM of a steady turn about the boresight, a sample every 10 s; return what it has."""
    shutil.copytree(synthetic_pass.folder, folder)
    utc_ns = synthetic_pass.utc_ns[0] + np.arange(0, 121, 10) * 10**9
    angle = np.radians(2.0) * np.arange(len(utc_ns))
    zero = np.zeros(len(utc_ns))
    turns = matrix_from_quaternion(np.column_stack([np.cos(angle / 2.0), zero, zero, np.sin(angle / 2.0)]))
    q_wxyz = continuous_quaternions(quaternion_from_matrix(turns @ first_nadir(synthetic_pass)))
    q_wxyz[3] *= -1.0  # the same attitude
    segment = AttitudeSegment(utc_ns, q_wxyz, **fields)
    (folder / "attitude.aem").write_text(format_aem((segment,)))
    enter_files(folder)
    return segment


def test_an_attitude_message_is_interpolated_to_the_times_of_the_images(synthetic_pass, ground, tmp_path):
    with_attitude_message(synthetic_pass, tmp_path / "a")
    viewing = load_pass_inputs(ground, import_archive(ground, tmp_path / "a")).viewing
    utc_ns = synthetic_pass.utc_ns
    # Images are 15 s apart; the message ends after 120 s.
    assert np.flatnonzero(viewing.known(utc_ns)).tolist() == list(range(9))
    turn = np.broadcast_to(np.eye(3), (len(utc_ns), 3, 3))
    rotations = viewing.camera_from_mcmf(utc_ns, np.full((len(utc_ns), 3), 1.0e6), turn)
    # A quaternion turns vectors: by 2 degrees in 10 s.
    rotations = rotations[:9] @ first_nadir(synthetic_pass).T
    angles = np.degrees(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))
    assert_allclose(angles, 3.0 * np.arange(9), atol=1e-9)


def test_attitudes_are_not_interpolated_over_a_gap():
    times = np.array([0, 1, 2, 3, 20, 21], dtype=np.int64) * 10**9
    viewing = Viewing(attitude_utc_ns=times, q_wxyz=np.tile([1.0, 0, 0, 0], (6, 1)), interpolated=True)
    asked = np.array([-1, 0, 2_500_000_000, 10 * 10**9, 20 * 10**9, 22 * 10**9])
    assert viewing.known(asked).tolist() == [False, True, True, False, True, False]


@mark.parametrize(
    "fields, message",
    [
        ({"frame_b": "SC_BODY_1"}, "expected REF_FRAME_A = ICRF and REF_FRAME_B = .*, found ICRF and SC_BODY_1"),
        ({"frame_a": "LVLH"}, "found LVLH and INSTRUMENT_1"),
    ],
)  # fmt: skip
def test_an_attitude_message_in_other_axes_is_refused(synthetic_pass, ground, tmp_path, fields, message):
    with_attitude_message(synthetic_pass, tmp_path / "a", **fields)
    with raises(InvalidInput, match=message):
        import_archive(ground, tmp_path / "a")


def test_two_attitude_files_are_refused(synthetic_pass, ground, tmp_path):
    folder = tmp_path / "a"
    with_attitude_message(synthetic_pass, folder)
    (folder / "attitude.csv").write_text(f"{HEADER}\n")
    enter_files(folder)
    with raises(InvalidInput, match=r"expected one of attitude\.csv and attitude\.aem, found both"):
        import_archive(ground, folder)


ROWS = ("5,2,0,0,0", "5,nan,0,0,0", "-1,1,0,0,0", "x,1,0,0,0")
UNREADABLE = "expected on-board ticks and a unit quaternion"


@mark.parametrize(
    "text, message",
    [
        ("CCSDS_AEM_VERS = 9", ": expected a CCSDS AEM, found line 1: expected an AEM version out of 1.0, 2.0"),
        ("", ", line 1: expected image_ticks,q_w"),
        ("ticks,q", ", line 1: expected image_ticks,q_w"),
        (f"{HEADER}\n5,1,0,0,0\n6,1,0,0", f", line 3: {UNREADABLE}"),
        *((f"{HEADER}\n{row}", f", line 2: {UNREADABLE}") for row in ROWS),
    ],
)
def test_a_table_of_attitudes_that_cannot_be_is_refused(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text and text + "\n")
    with raises(InvalidInput) as caught:
        load_attitudes(tmp_path / "a.csv", "a.csv")
    assert str(caught.value).startswith(f"a.csv{message}")


FRAMES = 40


@fixture(scope="module")
def imported(synthetic_pass, tmp_path_factory):
    with open_ground(tmp_path_factory.mktemp("imported") / "home") as ground:
        pass_id = import_archive(ground, synthetic_pass.folder)
        yield ground, pass_id, evaluate(ground, pass_id)


def test_importing_again_gives_the_same_pass_and_the_same_archive(imported, synthetic_pass):
    ground, pass_id, _ = imported
    vehicle = ground.read(repository.get, repository.PASSES, pass_id, "pass")["vehicle_id"]
    before = ground.read(archive_hash, vehicle)
    assert import_archive(ground, synthetic_pass.folder) == pass_id
    assert ground.read(archive_hash, vehicle) == before
    assert pass_summary(ground, pass_id)["packets"] == len(synthetic_pass.packets)


def test_a_report_is_written_and_kept(imported, tmp_path):
    ground, pass_id, _ = imported
    made = make_report(ground, pass_id, out=tmp_path / "out")
    assert "synthetic pass" in made.html.read_text()
    assert json.loads(made.json.read_text())
    row = ground.read(repository.get, repository.REPORTS, made.report_id, "report")
    assert ground.files.get(row["html_sha256"]) == made.html.read_bytes()


def test_settings_are_compared_with_those_of_the_pass_before(imported, synthetic_pass, tmp_path):
    ground, _, first = imported
    assert first.comparison is None
    folder = shutil.copytree(synthetic_pass.folder, tmp_path / "later")
    start = format_utc(first.span.start_utc_ns + 1_000_000_000) if first.span else ""
    enter_files(folder, start_utc=start, frames_expected=41, scenario_toml="no scenario")
    changes = (("observation.frames_expected", FRAMES, 41), ("scenario", {}, "no scenario"))
    later = evaluate(ground, import_archive(ground, folder))
    assert later.comparison == SettingsComparison(first.title, changes)


def test_a_pdf_is_made_of_stored_octets_when_it_is_first_read(imported, tmp_path, monkeypatch):
    """With a full disk it is read all the same, made again for the next reader, and equal."""
    ground, pass_id, _ = imported
    (tmp_path / "report.pdf").write_bytes(b"of the report before")
    key = make_report(ground, pass_id, out=tmp_path).report_id
    assert not (tmp_path / "report.pdf").exists()

    def fail(*_):
        raise StorageFull("archive")

    def kept():
        return ground.read(repository.get, repository.REPORTS, key, "report")["pdf_sha256"]

    with monkeypatch.context() as full:
        full.setattr(reports, "register_file", fail)
        first = report_document(ground, key, "pdf")
    assert first.startswith(b"%PDF-") and kept() is None
    monkeypatch.setattr(reports, "evaluate_pass", fail)
    digests = {hashlib.sha256(octets).hexdigest() for octets in (first, report_document(ground, key, "pdf"))}
    assert digests == {kept()}
    monkeypatch.setattr(pdf_pages, "pdf_of", fail)
    assert report_document(ground, key, "pdf")[:5] == b"%PDF-"


@mark.parametrize(
    "change, message",
    [
        ({"start_utc": None}, "start_utc: expected str, found None"),
        ({"stop_utc": "yesterday"}, "expected UTC epochs"),
        ({"stop_utc": "2020-01-01T00:00:00Z"}, "stop_utc: expected an epoch after"),
        ({"schema_version": 99}, "schema_version: expected 1 or less, found 99 of a newer version"),
        ({"../x": "0"}, "expected a path inside the archive"),
        ({"no.bin": "0"}, "no.bin: expected a file of the archive"),
        ({"reference.oem": "0" * 64}, "damaged or cut short"),
    ],
)
def test_a_wrong_manifest_is_refused_and_nothing_is_stored(synthetic_pass, ground, tmp_path, change, message):
    folder = shutil.copytree(synthetic_pass.folder, tmp_path / "wrong")
    manifest = json.loads((folder / "manifest.json").read_text())
    for key, value in change.items():
        if "." in key:
            manifest["files"][key] = {"sha256": value}
        else:
            manifest[key] = value
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with raises(InvalidInput, match=message):
        import_archive(ground, folder)
    for table in repository.PASSES, repository.FILES:
        assert ground.read(repository.newest, table, Paging())[1] == 0


def test_no_archive_and_no_pass_are_refused(ground, tmp_path):
    with raises(InvalidInput, match=r"expected a pass archive with manifest.json"):
        import_archive(ground, tmp_path)
    with raises(NotFound, match="pass 5: not found"):
        evaluate(ground, 5)
