"""Two spacecraft of different missions in one database; links and resources of a mission description."""

import numpy as np
from pytest import fixture, mark, raises

from ground_service.contacts.commanding.service import enter_command
from ground_service.errors import InvalidInput
from ground_service.evaluation.core import evaluate_pass
from ground_service.evaluation.inputs import load_pass_inputs
from ground_service.evaluation.service import make_report
from ground_service.ingest.service import ingest_file
from ground_service.missions.frames import camera_of
from ground_service.missions.model import Camera, format_mission, parse_mission
from ground_service.missions.service import add_mission
from ground_service.missions.timekeeping import recorrelation
from ground_service.missions.timekeeping.recorrelation import ReceivedReport, enter_receptions, recorrelate
from ground_service.passes.service import define_pass
from ground_service.planning import service as planning
from ground_service.store import repository
from lunar.frames import IauOrientation
from lunar.timescales import parse_utc
from tests.ground_service.conftest import add_reference
from tmtc.downlink import encode_cadus

START, STOP = parse_utc("2029-08-07T06:00:00Z"), parse_utc("2029-08-07T06:05:45Z")

WIDE = """
schema_version = 1
name = "wide"
[spacecraft]
id = 76
[time]
correlation = "automatic"
[frames]
orientation = "IAU WGCCRE 2009"
[camera]
fov_deg = 120
[evidence]
world = "procedural"
seed = 1
[requirements]
estimator = "spherical"
median_error_m = 200
[automation]
evaluate = true
"""

NARROW = """
schema_version = 1
name = "narrow"
[spacecraft]
id = 77
[time]
correlation = "manual"
[frames]
orientation = "IAU WGCCRE 2009"
[camera]
fov_deg = 40
[evidence]
world = "photographs"
[requirements]
estimator = "spherical"
median_error_m = 100
"""


@fixture(scope="module")
def made(make_pass):
    return make_pass(frames=24, seed=2)


def both(ground):
    """Add the description of each spacecraft."""
    return {76: add_mission(ground, WIDE.encode()), 77: add_mission(ground, NARROW.encode())}


def flown(ground, made, spacecraft, folder):
    """Ingest the same packets as telemetry of a spacecraft; return the id of its pass."""
    path = folder / f"{spacecraft}.cadu"
    path.write_bytes(encode_cadus(made.packets, spacecraft_id=spacecraft))
    ingest_file(ground, path)
    return define_pass(ground, name="pass", start_utc_ns=START, stop_utc_ns=STOP, spacecraft_id=spacecraft)


def row(ground, table, **equal):
    return ground.read(repository.find, table, **equal)


def test_every_pass_is_judged_by_the_description_of_its_spacecraft(either, made, tmp_path):
    missions = both(either)
    add_reference(either, made.folder / "reference.oem")
    passes = {spacecraft: flown(either, made, spacecraft, tmp_path) for spacecraft in missions}
    reports = {}
    for spacecraft, pass_id in passes.items():
        inputs = load_pass_inputs(either, pass_id)
        assert inputs.viewing.camera == camera_of(Camera(fov_deg=120.0 if spacecraft == 76 else 40.0))
        reports[spacecraft] = evaluate_pass(inputs)
        made_report = make_report(either, pass_id)
        for table, key in ((repository.PASSES, pass_id), (repository.REPORTS, made_report.report_id)):
            assert row(either, table, id=key)["mission_id"] == missions[spacecraft].id
    for report, level, name, limit in ((reports[76], "2", "wide", 200.0), (reports[77], "5", "narrow", 100.0)):
        assert report.evidence_level[:1] == level
        assert report.provenance["mission description"].startswith(f"{name}, revision")
        assert [one.limit for one in report.requirements if one.key == "accuracy.median"] == [limit]


def test_windows_and_telecommands_reference_the_description_of_their_spacecraft(ground, made):
    missions = both(ground)
    add_reference(ground, made.folder / "reference.oem")
    for spacecraft, mission in missions.items():
        command = enter_command(ground, "test_connection", {}, spacecraft_id=spacecraft, actor="ann")
        assert row(ground, repository.TELECOMMANDS, id=command)["mission_id"] == mission.id
        entry = planning.WindowEntry("w", START, STOP, 15.0, spacecraft)
        window = planning.add_window(ground, entry, actor="ann")
        assert row(ground, repository.WINDOWS, id=window.id)["mission_id"] == mission.id
    newer = add_mission(ground, NARROW.replace("40", "41").encode())
    planning.change_window(ground, window.id, actor="ann", changes={}, decision="approved")
    assert row(ground, repository.WINDOWS, id=window.id)["mission_id"] == newer.id


def test_a_window_is_predicted_with_the_camera_of_its_spacecraft(ground, made, monkeypatch):
    both(ground)
    add_reference(ground, made.folder / "reference.oem")
    planners = []
    made_planner = planning.planner_of
    monkeypatch.setattr(planning, "planner_of", lambda *given: planners.append(made_planner(*given)) or planners[-1])
    for spacecraft in (76, 77):
        entry = planning.WindowEntry("w", START, STOP - 60_000_000_000, 15.0, spacecraft)
        planning.add_window(ground, entry, actor="ann")
    cameras = [planner.camera for planner in planners]
    assert cameras == [camera_of(Camera(fov_deg=fov)) for fov in (120.0, 40.0)]
    assert {planner.orientation.name for planner in planners[:2]} == {IauOrientation().name}


def test_only_the_spacecraft_whose_description_permits_it_is_correlated_automatically(
    ground, made, tmp_path, monkeypatch
):
    fitted = []

    def reports(_ground, _connection, vehicle):
        fitted.append(vehicle)
        return recorrelation.TimeReports(*[np.zeros(0, dtype=np.int64)] * 6, ())

    monkeypatch.setattr(recorrelation, "time_reports", reports)
    both(ground)
    vehicles = {}
    for spacecraft in (76, 77):
        flown(ground, made, spacecraft, tmp_path)
        vehicles[spacecraft] = row(ground, repository.VEHICLES, ccsds_id=spacecraft)["id"]
        enter_receptions(ground, spacecraft, "flight", [ReceivedReport(1, 2, START)], actor="ann")
    assert set(fitted) == {vehicles[76]}
    recorrelate(ground, vehicles[77], over_manual=True)
    assert set(fitted) == set(vehicles.values())


HEAD = 'name = "selenita"\n[spacecraft]\nid = {id}\n'
LINK = """
[[links]]
name = "lab"
kind = "tcp"
downlink = "127.0.0.1:10015"
uplink = "127.0.0.1:10025"
"""


def text(*parts, number=76):
    return HEAD.format(id=number) + "\n".join(parts)


def test_links_are_read_with_their_defaults_and_a_description_without_keeps_its_revision():
    mission = parse_mission(text(LINK))
    link = mission.links[0]
    assert (link.send, link.format, link.reconnect, link.silence_s) == ("automatic", "cltu", True, 60.0)
    again = parse_mission(format_mission(mission))
    assert again == mission and again.revision == mission.revision
    plain = parse_mission(text())
    assert plain.links is None
    assert plain.revision == parse_mission(text("[resources]")).revision


@mark.parametrize(
    "parts, place, expected",
    [
        ((LINK.replace("10015", "99999"),), "links.0", "downlink as HOST:PORT, found '127.0.0.1:99999'"),
        ((LINK.replace("downlink", "downlnk"),), "links.0.downlnk", "'downlink'"),
        ((LINK, LINK), "", "each name of links once, found 'lab' again"),
        (('[[links]]\nname = "a"\nkind = "file"\ndownlink = "in"',), "links.0", "absolute path of a folder"),
        (('[[links]]\nname = "a"\nkind = "file"\ndownlink = "/x"\nuplink = "/x"',), "links.0", "different folders"),
        (('[[links]]\nname = "a"\nkind = "tcp"',), "links.0", "downlink, uplink or both, found neither"),
        ((LINK.replace('"lab"', '"../lab"'),), "links.0.name", "pattern"),
        (("[resources]\nobserve_hours_per_day = 25.0",), "resources.observe_hours_per_day", "24"),
    ],
)
def test_a_fault_is_one_line_with_its_place(parts, place, expected):
    with raises(InvalidInput) as refused:
        parse_mission(text(*parts), "mission.toml")
    message = str(refused.value)
    assert place in message and expected in message and "\n" not in message


def test_links_need_a_spacecraft():
    with raises(InvalidInput, match="a spacecraft id with links, found none"):
        parse_mission('name = "x"\n' + LINK)


def test_two_spacecraft_cannot_use_the_same_link_name(ground):
    add_mission(ground, text(LINK).encode())
    with raises(InvalidInput, match="'lab' of spacecraft 76"):
        add_mission(ground, text(LINK, number=77).encode())
    add_mission(ground, text(LINK, "[resources]\nbattery_wh = 60.0").encode())
    add_mission(ground, text(LINK.replace("lab", "other"), number=77).encode())
