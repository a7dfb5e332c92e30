"""Dry run of a mission description: what contradicts the flight is found before it, one line each."""

import json

from pytest import fixture, mark

from ground_service.errors import Stopping
from ground_service.ground import Ground
from ground_service.http.model import Paging
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.store import list_missions
from ground_service.planning import dry_run, standing
from ground_service.planning.dry_run import NO_EPHEMERIS, TOO_LONG, fly, rehearsed
from ground_service.planning.model import StandingRequestIn
from lunar.datafolder import DataFolder
from tests.ground_service.conftest import START, save_circle
from tests.ground_service.planning.test_standing import AUTOMATIC, LINKS, MISSION

UPLOADS = '[uploads]\ntables = ["orientation"]\n'
CRITICAL = ("perform_function/set_mode", "uplink_first", "uplink_middle", "uplink_last")
REQUEST = {"name": "low Sun", "spacecraft_id": 76, "windows": 2, "period_days": 7.0, "horizon_days": 1.0}


@fixture(scope="module")
def oem(tmp_path_factory):
    return save_circle(tmp_path_factory.mktemp("oem") / "reference.oem", START, 30.0)


@fixture
def flown(tmp_path, oem):
    """A function that writes the files and makes the dry run."""

    def run(extra=AUTOMATIC + LINKS, **request):
        (tmp_path / "mission.toml").write_text(MISSION.format(extra=extra))
        (tmp_path / "reference.oem").write_bytes(oem.read_bytes())
        (tmp_path / "request.json").write_text(json.dumps(REQUEST | request))
        return fly(tmp_path / "mission.toml", DataFolder())

    return run


def test_a_description_that_flies_has_windows_with_telecommands(flown):
    found = flown()
    assert found.faults == () and len(found.windows) == 2
    # One enables the schedule; start and stop are each inserted into it by another.
    assert [len(one.telecommands) for one in found.windows] == [5, 5]


@mark.parametrize(
    "extra, request_changes, fault",
    [
        (
            AUTOMATIC + UPLOADS + LINKS,
            {},
            "mission.toml, approval.windows: expected approval.one_person_for with the telecommands of a window that "
            "is approved automatically, found a second person needed for " + ", ".join(CRITICAL),
        ),
        (
            AUTOMATIC + LINKS + "[observation]\nlatitude_limit_deg = 20.0\n",
            {"regions": [{"latitude_deg": {"min": 40.0, "max": 80.0}}]},
            "request.json: expected windows that can be planned, found no window: excluded by latitude limit of the "
            "mission description 20 deg, regions",
        ),
        (
            AUTOMATIC + LINKS,
            {"sun_elevation_deg": {"min": 89.9, "max": 90.0}},
            "request.json: expected windows that can be planned, found no window: excluded by Sun elevation",
        ),
        (
            AUTOMATIC + LINKS + "[resources]\nstorage_mib = 0.01\n",
            {},
            "request.json: expected windows that can be planned, found 58200 octets would be stored on board, expected "
            "at most 10486",
        ),
        (
            AUTOMATIC,
            {},
            "mission.toml, links: expected contacts of a link with an uplink, found no link with an uplink",
        ),
        (
            AUTOMATIC + LINKS.replace('station = "here"\n', "").replace('station = "there"\n', ""),
            {},
            "found a: the mission description states no place of the station; b: the mission description states no "
            "place of the station",
        ),
        (AUTOMATIC + LINKS, {"spacecraft_id": 5000}, "request.json, spacecraft_id: expected less than"),
    ],
)
def test_each_contradiction_is_one_line(flown, extra, request_changes, fault):
    found = flown(extra, **request_changes)
    assert len(found.faults) == 1, found.faults
    assert fault in found.faults[0]


def test_windows_that_persons_approve_are_approved_and_released_by_two(flown):
    found = flown(UPLOADS + LINKS)
    assert found.faults == ()
    assert [one.decided_by for one in found.windows] == ["dry run, second person"] * 2


def test_a_text_is_rehearsed_with_the_requests_and_ephemerides_of_the_service(ground, oem, mission_time, monkeypatch):
    def rehearse(extra=""):
        text = MISSION.format(extra=AUTOMATIC + LINKS + extra).encode()
        found = rehearsed(ground, text)
        return len(found.windows), found.faults

    mission_time.utc_ns = START
    assert rehearse() == (0, (NO_EPHEMERIS,))
    add_ephemeris(ground, ground.files.put_file(oem), name="reference", precedence=0, actor="ann")
    assert rehearse() == (10, ())
    added = standing.add_request(ground, StandingRequestIn.model_validate(REQUEST), actor="ann")
    assert rehearse() == (2, ())
    count, (reason,) = rehearse("[resources]\nstorage_mib = 0.01\n")
    assert count == 0 and "request.json: expected windows that can be planned, found" in reason
    assert ground.read(list_missions, Paging()).total == 0
    standing.delete_request(ground, added.id, actor="ann")
    assert rehearse() == (10, ())
    monkeypatch.setattr(dry_run, "MOST_S", 0.0)
    assert rehearse() == (0, (TOO_LONG,))


@mark.parametrize("place", [1, 2, 4])  # a request, a day of its horizon, the release of a window
def test_a_dry_run_that_takes_too_long_ends(flown, monkeypatch, place):
    asked = []

    def check(_):
        asked.append(None)
        if len(asked) == place:
            raise Stopping

    monkeypatch.setattr(Ground, "check_stopping", check)
    assert flown(UPLOADS + LINKS).faults == (TOO_LONG,)
