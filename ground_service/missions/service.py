"""Use cases of mission descriptions: add, list, show, and find the description of a pass."""

import difflib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from sqlalchemy import Connection

from ground_service.access.service import LOCAL_CALLER, Caller, audit
from ground_service.clock import utc_now_ns
from ground_service.errors import Forbidden, InvalidInput
from ground_service.ground import Ground
from ground_service.missions import store
from ground_service.missions.definitions import definition_faults, read_mission_file
from ground_service.missions.frames import mission_of_manifest
from ground_service.missions.model import (
    MISSION_LIMIT_OCTETS,
    Approval,
    Mission,
    MissionCheck,
    MissionDetail,
    format_mission,
    parse_mission,
    read_document,
)
from ground_service.store.event_kinds import MissionAdded, publish

COMPARED_LIMIT = 1_000_000
_LINE = re.compile(r"([-+])(\d+)")
"""Largest product of the numbers of lines that are compared; the comparison of lines that repeat takes seconds."""


def read_mission(octets: bytes, source: str = "mission.toml") -> tuple[Mission, str]:
    """Return the mission description and its text from the octets of a file.

    Raises
    ------
    InvalidInput
        The octets are not a mission description.
    """
    text = _text_of(octets, source)
    read, faults = _read(text, source)
    if read is None or faults:
        raise faults[0]
    return read, text


def check_mission_file(path: Path) -> tuple[Mission | None, list[str]]:
    """Return the mission description of a file, or None and one line for each fault.

    Raises
    ------
    InvalidInput
        The file, or an XTCE file that it names, cannot be read, or is not text.
    """
    read, faults = _read(_text_of(read_mission_file(path), str(path)), str(path))
    return None if faults else read, [str(fault) for fault in faults]


def check_mission(ground: Ground, octets: bytes, *, caller: Caller = LOCAL_CALLER) -> MissionCheck:
    """Check a mission description and compare it with the revision in force of its spacecraft; nothing is added.

    Raises
    ------
    InvalidInput
        It is not text.
    Forbidden
        It is of a mission that the caller is not limited to.
    """
    text = _text_of(octets, "mission.toml")
    mission, faults = _read(text, "mission.toml")
    if mission is None:
        return MissionCheck(faults=tuple(map(str, faults)), unknown=(), changes=())
    _require_own(mission, "mission.toml", caller)
    with ground.database.reading() as connection:
        key = store.newest_of_spacecraft(connection, mission.spacecraft.id)
        before = "" if key is None else store.detail(connection, key).text
    changes = _changes(before.splitlines(), text.splitlines())
    return MissionCheck(faults=tuple(map(str, faults)), unknown=mission.unknown, changes=changes)


def _changes(before: list[str], after: list[str]) -> tuple[str, ...]:
    """Return a unified difference; of texts that would take seconds to compare, the number of lines that differ."""
    longest = min(len(before), len(after))
    head = next((k for k in range(longest) if before[k] != after[k]), longest)
    rest = longest - head
    tail = next((k for k in range(rest) if before[-1 - k] != after[-1 - k]), rest)
    removed, added = len(before) - head - tail, len(after) - head - tail
    if removed * added > COMPARED_LIMIT:
        return (f"@@ {removed} lines from line {head + 1} on are replaced by {added}: too many to compare @@",)
    begin, end = max(head - 1, 0), max(tail - 1, 0)
    old, new = before[begin : len(before) - end], after[begin : len(after) - end]
    found = tuple(difflib.unified_diff(old, new, lineterm="", n=1))[2:]
    return tuple(_LINE.sub(lambda at: f"{at[1]}{int(at[2]) + begin}", one) if one[:2] == "@@" else one for one in found)


def _text_of(octets: bytes, source: str) -> str:
    if len(octets) > MISSION_LIMIT_OCTETS:
        raise InvalidInput(source, "", f"at most {MISSION_LIMIT_OCTETS} octets", str(len(octets)))
    try:
        return octets.decode("utf-8")
    except UnicodeDecodeError as error:
        found = f"octet {error.object[error.start]:#04x} at {error.start}"
        raise InvalidInput(source, "", "UTF-8 text", found) from None


def _read(text: str, source: str) -> tuple[Mission | None, list[InvalidInput]]:
    """Return what a text describes, None if that is unknown, and all faults."""
    read = read_document(text, source)
    return (read, definition_faults(read, source)) if isinstance(read, Mission) else (None, read)


def _require_own(mission: Mission, source: str, caller: Caller) -> None:
    named = caller.missions is None or mission.name in caller.missions
    if not named or not caller.may_use(mission.spacecraft.id):
        raise Forbidden(
            f"{source}: {caller.name}: expected name and spacecraft of {', '.join(caller.missions or ())}, "
            f"found {mission.name!r} and {mission.spacecraft.id}"
        )


def add_mission(
    ground: Ground, octets: bytes, *, source: str = "mission.toml", actor: str = "local", caller: Caller = LOCAL_CALLER
) -> MissionDetail:
    """Add a mission description as a revision; the same content gives the same revision.

    Raises
    ------
    Forbidden
        It changes which telecommands need a second person, whether windows are approved by a person, the links or the
        channels of notifications, and the caller is not permitted to change these; or it is of a spacecraft or has
        the name of a mission that the caller is not limited to.
    """
    mission, text = read_mission(octets, source)
    _require_own(mission, source, caller)
    with ground.database.writing() as connection:
        if not caller.may("admin") and mission.spacecraft.id is not None:
            mine = store.missions_in_force(connection).get(mission.spacecraft.id)
            for name, given, found in _reaching_out(mission, mine):
                if given != found:
                    raise Forbidden(f"{source}: changes {name}; expected an administrator")
        _check_link_names(connection, mission, source)
        return store.detail(connection, enter(connection, mission, text, actor=actor))


def _check_link_names(connection: Connection, mission: Mission, source: str) -> None:
    """Refuse names of links that the description of another spacecraft uses."""
    mine = {one.name for one in mission.links or ()}
    if not mine:
        return
    for spacecraft, other in store.missions_in_force(connection).items():
        taken = mine.intersection(one.name for one in other.links or ())
        if spacecraft != mission.spacecraft.id and taken:
            raise InvalidInput(
                source, "links", "names that no other spacecraft uses", f"{min(taken)!r} of spacecraft {spacecraft}"
            )


def _reaching_out(mission: Mission, in_force: Mission | None) -> Iterator[tuple[str, object, object]]:
    """Yield the parts that make the service read, write or connect elsewhere, or act without a person."""
    found = Approval() if in_force is None else in_force.approval
    yield "which telecommands need a second person", _persons(mission.approval), _persons(found)
    yield "links", mission.links or (), () if in_force is None else in_force.links or ()
    yield "notify", mission.notify, {} if in_force is None else in_force.notify
    if mission.approval.windows == "automatic":
        yield "approval.windows", "automatic", found.windows


def _persons(approval: Approval) -> tuple[frozenset[str], frozenset[str]]:
    return frozenset(approval.second_person_for or ()), frozenset(approval.one_person_for or ())


def enter(connection: Connection, mission: Mission, text: str | None = None, *, actor: str) -> int:
    """Add a revision in the caller's transaction; return its id."""
    key, new = store.add_revision(
        connection, mission, text or format_mission(mission), actor=actor, now_utc_ns=utc_now_ns()
    )
    if new:
        audit(connection, actor, "add mission", mission.name, {"id": key, "revision": mission.revision})
        added = MissionAdded(id=key, mission=mission.name, spacecraft_id=mission.spacecraft.id)
        publish(connection, added)
    return key


def mission_of_pass(connection: Connection, mission_id: int | None, manifest: Mapping[str, Any]) -> Mission:
    """Return the description that a pass refers to, otherwise that of its manifest."""
    if mission_id is not None:
        return store.get_mission(connection, mission_id)
    return mission_of_manifest(manifest)


def without_tokens(found: MissionDetail) -> MissionDetail:
    """Return a revision whose webhooks show scheme and host only: the rest of an address may be a token or password."""
    channels, shown = found.document.notify, {}
    for channel in channels.values():
        if channel.webhook is not None:
            parts = urlsplit(channel.webhook)
            shown[channel.webhook] = f"{parts.scheme}://{parts.hostname}/..."
    if not shown:
        return found
    text = found.text
    for address in sorted(shown, key=len, reverse=True):
        text = text.replace(address, shown[address])
    if any(one.webhook in shown for one in parse_mission(text, stored=True).notify.values()):
        text = ""  # an address is written with escapes
    public = {name: one.model_copy(update={"webhook": shown.get(one.webhook or "")}) for name, one in channels.items()}
    document = found.document.model_copy(update={"notify": public})
    return found.model_copy(update={"document": document, "text": text})
