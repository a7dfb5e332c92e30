"""Dry run of a mission description: the plan of its first days and its telecommands, in an empty service."""

import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from threading import TIMEOUT_MAX, Timer

from ground_service.clock import mission_now_ns, set_mission_clock
from ground_service.contacts.links import service as links
from ground_service.errors import GroundError, InvalidInput, Stopping
from ground_service.ground import Ground, open_ground, run_apart
from ground_service.http.model import Paging
from ground_service.missions.catalogues import add_catalogue
from ground_service.missions.definitions import read_mission_file
from ground_service.missions.ephemerides.service import add_ephemeris, covering_ephemerides
from ground_service.missions.service import add_mission, read_mission
from ground_service.planning import service as planning
from ground_service.planning import standing, store
from ground_service.planning.model import StandingRequestIn, Window, WindowFilter
from ground_service.toml import parse_table, read_json
from lunar.constants import DAY_NS
from lunar.datafolder import DataFolder
from lunar.errors import LunarError

MISSION, CATALOGUE, REFERENCE, REQUEST = "mission.toml", "craters.csv", "reference.oem", "request.json"
"""Files in the folder of a mission description that the ground posts; a description can do without the catalogue."""

ASSUMED = {"name": "dry run", "windows": 10, "period_days": 1.0, "horizon_days": 1.0}
"""Request of a dry run in a service without one of the spacecraft."""

NO_EPHEMERIS = "no ephemeris of the spacecraft covers the time from now on"

MOST_S = 20.0
"""Longest dry run of a request to the service."""

TOO_LONG = "the dry run takes too long for a request to the service: use linna mission check --flight"

OPERATOR, APPROVER = "dry run", "dry run, second person"


@dataclass(frozen=True, slots=True)
class DryRun:
    """Windows with their telecommands released, and one line for each contradiction."""

    windows: tuple[Window, ...] = ()
    faults: tuple[str, ...] = ()


def rehearsed(ground: Ground, octets: bytes) -> DryRun:
    """Make the dry run of a description over the ephemeris and the active requests of its spacecraft in a service.

    Without a request it is one of ten windows in a day. Windows in the plan of the service do not count.
    """
    spacecraft, now = read_mission(octets)[0].spacecraft, mission_now_ns()
    with ground.database.reading() as connection:
        held = covering_ephemerides(connection, now, 1 << 62, spacecraft.id)
        listed = store.list_requests(connection, Paging(limit=1000)).items
    mine = [one.sha256 for one in held if spacecraft.is_object(one.object_name)]
    if not mine:
        return DryRun(faults=(NO_EPHEMERIS,))
    asked = [
        one.terms.model_dump(mode="json", exclude_none=True) | {"name": one.name, "spacecraft_id": spacecraft.id}
        for one in listed
        if one.spacecraft_id == spacecraft.id and one.state == "active"
    ]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / MISSION).write_bytes(octets)
        (folder / REQUEST).write_text(json.dumps(asked or [ASSUMED | {"spacecraft_id": spacecraft.id}]))
        shutil.copyfile(ground.files.path(mine[0]), folder / REFERENCE)
        flown = run_apart(_fly_at, folder / MISSION, ground.data, now, MOST_S)
    return replace(flown, faults=tuple(one.replace(f"{folder}/", "") for one in flown.faults))


def _fly_at(mission: Path, data: DataFolder, now_utc_ns: int, most_s: float) -> DryRun:
    set_mission_clock(lambda: now_utc_ns)
    return fly(mission, data, now_utc_ns, most_s)


def fly(mission: Path, data: DataFolder, now_utc_ns: int = 0, most_s: float = TIMEOUT_MAX) -> DryRun:
    """Plan the standing requests next to a mission description and release their telecommands; nothing is sent.

    The time is that at which the reference ephemeris begins, or `now_utc_ns` if that is later. A person approves
    windows that are not approved automatically, another one releases them.
    """
    with tempfile.TemporaryDirectory() as home, open_ground(Path(home), data) as ground:
        limit = Timer(most_s, ground.stopping.set)
        limit.start()
        try:
            requests, begin_utc_ns = _posted(ground, mission)
            start_utc_ns = max(begin_utc_ns, now_utc_ns)
            standing.plan_tick(ground, start_utc_ns)
            faults = list(_faults(ground, mission, requests, start_utc_ns))
            windows = ground.read(store.list_windows, WindowFilter()).items
        except Stopping:
            return DryRun(faults=(TOO_LONG,))
        except (GroundError, LunarError) as error:
            return DryRun(faults=(str(error),))
        finally:
            limit.cancel()
    return DryRun(tuple(sorted(windows, key=lambda one: one.start.utc_ns)), tuple(faults))


def _posted(ground: Ground, mission: Path) -> tuple[list[int], int]:
    """Add the files to a service; return the requests and the time at which the ephemeris begins."""
    folder = mission.parent
    for name in (REFERENCE, REQUEST):
        if not (folder / name).is_file():
            raise InvalidInput(str(folder / name), "", "a file in the folder of the mission description", "none")
    if (folder / CATALOGUE).is_file():
        add_catalogue(ground, ground.files.put_file(folder / CATALOGUE), CATALOGUE, actor=OPERATOR)
    add_mission(ground, read_mission_file(mission), source=str(mission), actor=OPERATOR)
    reference = add_ephemeris(
        ground, ground.files.put_file(folder / REFERENCE), name=REFERENCE, precedence=0, actor=OPERATOR
    )
    path, requests = folder / REQUEST, []
    found = read_json(path.read_bytes(), str(path))
    for one in found if isinstance(found, list) else [found]:
        given = parse_table(StandingRequestIn, one, str(path))
        if given.start is None:
            given = given.model_copy(update={"start": reference.start})
        requests.append(standing.add_request(ground, given, actor=OPERATOR).id)
    return requests, reference.start.utc_ns


def _faults(ground: Ground, mission: Path, requests: list[int], now: int) -> Iterator[str]:
    """Yield what contradicts the flight, as place, expected and found; release what a person has to release."""
    if (reason := _no_uplink(ground, now)) is not None:
        yield str(InvalidInput(str(mission), "links", "contacts of a link with an uplink", reason))
    with ground.database.reading() as connection:
        plans = [store.get_plan(connection, one) for one in requests]
        windows = store.list_windows(connection, WindowFilter()).items
    if not windows:
        reasons = Counter(one.reason for plan in plans for one in plan.candidates if one.reason is not None)
        stated = [one.reason for one in plans if one.reason is not None]
        found = next(iter(stated or dict(reasons.most_common(1))), "none")
        yield str(InvalidInput(str(mission.parent / REQUEST), "", "windows that can be planned", found))
    for one in windows:
        ground.check_stopping()
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
            contacts, reason = links.predict(ground, declared, now, now + DAY_NS)
            if contacts:
                return None
            reasons.append(f"{declared.link.name}: {reason or 'no contact in the first day'}")
    return "; ".join(reasons) or "no link with an uplink"
