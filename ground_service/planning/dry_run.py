"""Dry run of a mission description: the plan of its first days and its telecommands, in an empty service."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ground_service.contacts.links import service as links
from ground_service.errors import GroundError, InvalidInput
from ground_service.ground import Ground, open_ground
from ground_service.missions.catalogues import add_catalogue
from ground_service.missions.definitions import read_mission_file
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.service import add_mission
from ground_service.planning import request_store, standing, store
from ground_service.planning import service as planning
from ground_service.planning.model import Window, WindowFilter
from ground_service.planning.request_model import StandingRequestIn
from ground_service.toml import parse_table, read_json
from lunar.datafolder import DataFolder
from lunar.errors import LunarError

CATALOGUE, REFERENCE, REQUEST = "craters.csv", "reference.oem", "request.json"
"""Files beside a mission description that the ground posts; a description can do without the catalogue."""

OPERATOR, APPROVER = "dry run", "dry run, second person"


@dataclass(frozen=True, slots=True)
class DryRun:
    """Windows with their telecommands released, and one line for each contradiction."""

    windows: tuple[Window, ...] = ()
    faults: tuple[str, ...] = ()


def fly(mission: Path, data: DataFolder) -> DryRun:
    """Plan the standing request beside a mission description and release its telecommands; nothing is sent.

    The time is that at which the reference ephemeris begins. A person approves windows that are not approved
    automatically, another one releases them.
    """
    with tempfile.TemporaryDirectory() as home, open_ground(Path(home), data) as ground:
        try:
            request_id, start_utc_ns = _posted(ground, mission)
            standing.plan_tick(ground, start_utc_ns)
            faults = list(_faults(ground, mission, request_id, start_utc_ns))
            windows = ground.read(store.list_windows, WindowFilter()).items
        except (GroundError, LunarError) as error:
            return DryRun(faults=(str(error),))
    return DryRun(tuple(sorted(windows, key=lambda one: one.start.utc_ns)), tuple(faults))


def _posted(ground: Ground, mission: Path) -> tuple[int, int]:
    """Add the files to a service; return the request and the time at which the ephemeris begins."""
    folder = mission.parent
    for name in (REFERENCE, REQUEST):
        if not (folder / name).is_file():
            raise InvalidInput(str(folder / name), "", "a file beside the mission description", "none")
    if (folder / CATALOGUE).is_file():
        add_catalogue(ground, ground.files.put_file(folder / CATALOGUE), CATALOGUE, actor=OPERATOR)
    add_mission(ground, read_mission_file(mission), source=str(mission), actor=OPERATOR)
    reference = add_ephemeris(
        ground, ground.files.put_file(folder / REFERENCE), name=REFERENCE, precedence=0, actor=OPERATOR
    )
    path = folder / REQUEST
    given = parse_table(StandingRequestIn, read_json(path.read_bytes(), str(path)), str(path))
    if given.start is None:
        given = given.model_copy(update={"start": reference.start})
    return standing.add_request(ground, given, actor=OPERATOR).id, reference.start.utc_ns


def _faults(ground: Ground, mission: Path, request_id: int, now: int) -> Iterator[str]:
    """Yield what contradicts the flight, as place, expected and found; release what a person has to release."""
    if (reason := _no_uplink(ground, now)) is not None:
        yield str(InvalidInput(str(mission), "links", "contacts of a link with an uplink", reason))
    with ground.database.reading() as connection:
        plan = request_store.get_plan(connection, request_id)
        windows = store.list_windows(connection, WindowFilter()).items
    if not windows:
        reasons = Counter(one.reason for one in plan.candidates if one.reason is not None)
        found = plan.reason or next((reason for reason, _ in reasons.most_common(1)), "none")
        yield str(InvalidInput(str(mission.parent / REQUEST), "", "windows that can be planned", found))
    for one in windows:
        try:
            if one.state == "draft":
                planning.change_window(ground, one.id, actor=APPROVER, changes={}, decision="approved")
            planning.uplink_window(ground, one.id, actor=OPERATOR)
        except GroundError as error:
            expected = f"telecommands of the window from {one.start}"
            yield str(InvalidInput(str(mission), "", expected, str(error)))


def _no_uplink(ground: Ground, now: int) -> str | None:
    """Return why no telecommand can be sent; None if a contact with an uplink is predicted."""
    reasons = []
    for declared in links.declared_links(ground).values():
        if declared.link.uplink is not None:
            contacts, reason = links.predict(ground, declared, now, now + standing.DAY_NS)
            if contacts:
                return None
            reasons.append(f"{declared.link.name}: {reason or 'no contact in the first day'}")
    return "; ".join(reasons) or "no link with an uplink"
