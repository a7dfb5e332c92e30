"""Reference ephemerides and attitudes: uploaded, versioned by content, chosen by precedence and coverage."""

import functools
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, select, update

from ground_service.access.service import LOCAL_CALLER, Caller, audit
from ground_service.clock import utc_now_ns
from ground_service.errors import Forbidden, InvalidInput
from ground_service.ground import Ground
from ground_service.http.model import PageOf, Paging
from ground_service.missions.ephemerides.model import Ephemeris
from ground_service.missions.store import mission_in_force, missions_in_force
from ground_service.store import repository
from ground_service.store.event_kinds import EphemerisAdded, publish
from ground_service.store.files import StoredFile, register_file
from ground_service.store.vehicles import hold
from lunar import ephemeris
from lunar.comparison import check_pointing
from lunar.constants import NS
from lunar.ephemeris import Ephemeris as States
from lunar.errors import EphemerisError, LunarError, UnmovedByGravity
from lunar.frames import ICRF_NAMES
from lunar.messages.aem import CAMERA_NAMES, parse_aem
from lunar.messages.ephemeris_files import load_arcs, load_orbit
from lunar.timescales import TICKS_PER_SECOND

EPHEMERIDES = repository.EPHEMERIDES


def insert_ephemeris(
    connection: Connection,
    stored: StoredFile,
    content: ephemeris.Ephemeris,
    *,
    name: str,
    precedence: int,
    now_utc_ns: int,
) -> Ephemeris:
    """Add the ephemeris of an archived file."""
    key = repository.add(
        connection,
        EPHEMERIDES,
        file_sha256=stored.sha256,
        name=name,
        object_name=content.segments[0].object_name,
        frame=content.segments[0].frame,
        start_utc_ns=content.start_utc_ns,
        stop_utc_ns=content.stop_utc_ns,
        states=sum(len(segment.utc_ns) for segment in content.segments),
        precedence=precedence,
        created_utc_ns=now_utc_ns,
    )
    return get_ephemeris(connection, key)


def find_ephemeris(connection: Connection, *, sha256: str, precedence: int, name: str) -> Ephemeris | None:
    """Return the entry of a file with this precedence and name; None without any."""
    found = repository.find(connection, EPHEMERIDES, file_sha256=sha256, precedence=precedence, name=name)
    return None if found is None else _ephemeris(found)


def get_ephemeris(connection: Connection, ephemeris_id: int) -> Ephemeris:
    return _ephemeris(repository.get(connection, EPHEMERIDES, ephemeris_id, "ephemeris"))


def list_ephemerides(connection: Connection, asked: Paging) -> PageOf[Ephemeris]:
    """List the reference ephemerides, newest first."""
    rows, total = repository.newest(connection, EPHEMERIDES, asked)
    return asked.page(map(_ephemeris, rows), total)


def covering_ephemerides(
    connection: Connection, start_utc_ns: int, stop_utc_ns: int, spacecraft_id: int | None
) -> list[Ephemeris]:
    """Return the ephemerides of a spacecraft that overlap an interval, by precedence, then the newest first."""
    table = EPHEMERIDES.c
    query = (
        select(EPHEMERIDES)
        .where(table.start_utc_ns <= stop_utc_ns, table.stop_utc_ns >= start_utc_ns)
        .order_by(table.precedence.desc(), table.id.desc())
    )
    mission = mission_in_force(connection, spacecraft_id)
    rows = connection.execute(query).mappings()
    return [_ephemeris(row) for row in rows if mission is None or mission.spacecraft.is_object(row["object_name"])]


def mark_withdrawn(connection: Connection, ephemeris_id: int) -> Ephemeris:
    """Delete the entry of an ephemeris, whose file is kept, and return it; passes and windows use others."""
    found = get_ephemeris(connection, ephemeris_id)
    for table in (repository.PASSES, repository.WINDOWS):
        users = update(table).where(table.c.ephemeris_id == ephemeris_id)
        connection.execute(users.values(ephemeris_id=None))
    connection.execute(EPHEMERIDES.delete().where(EPHEMERIDES.c.id == ephemeris_id))
    return found


def _ephemeris(row: Mapping[Any, Any]) -> Ephemeris:
    return Ephemeris.of(row, sha256=row["file_sha256"])


def add_ephemeris(
    ground: Ground,
    stored: StoredFile,
    *,
    name: str,
    precedence: int = 0,
    actor: str = "local",
    caller: Caller = LOCAL_CALLER,
) -> Ephemeris:
    """Enter an archived ephemeris file as a reference ephemeris; the same file again gives the same entry.

    Raises
    ------
    InvalidInput
        If the file cannot be read as an ephemeris, gravity does not move its states, or it is that of an object that no
        mission description names.
    Forbidden
        If it is that of an object of another mission than those of the caller.
    """
    try:
        ephemeris = load_orbit(stored.path)
    except UnmovedByGravity as error:
        raise InvalidInput("ephemeris", error.where, error.expected, error.found) from None
    except LunarError as error:
        reason = str(error).replace(str(stored.path), name)
        raise InvalidInput("ephemeris", "", "a CCSDS OEM, STK .e or Horizons file", reason) from None
    now = utc_now_ns()
    with ground.database.writing() as connection:
        hold(connection, f"ephemeris {stored.sha256}")
        _check_object(connection, ephemeris.segments[0].object_name, caller)
        register_file(connection, stored, "ephemeris", name, now)
        known = find_ephemeris(connection, sha256=stored.sha256, precedence=precedence, name=name)
        if known is not None:
            return known
        added = insert_ephemeris(connection, stored, ephemeris, name=name, precedence=precedence, now_utc_ns=now)
        audit(connection, actor, "add ephemeris", name, {"id": added.id, "sha256": stored.sha256})
        publish(
            connection,
            EphemerisAdded(id=added.id, start_utc_ns=ephemeris.start_utc_ns, stop_utc_ns=ephemeris.stop_utc_ns),
        )
        return added


def _check_object(connection: Connection, name: str, caller: Caller) -> None:
    missions = missions_in_force(connection)
    owners = [number for number, one in missions.items() if one.spacecraft.is_object(name)]
    if caller.spacecraft is not None and not (owners and caller.may_use(*owners)):
        raise Forbidden(f"{caller.name}: expected an object of the caller's missions, found {name}")
    if missions and not owners:
        names = ", ".join(one.spacecraft.name or "" for one in missions.values())
        expected = f"a spacecraft with a mission description ({names}, or its spacecraft.object_names)"
        raise InvalidInput("ephemeris", "OBJECT_NAME", expected, name)


def withdraw_ephemeris(ground: Ground, ephemeris_id: int, *, actor: str, caller: Caller = LOCAL_CALLER) -> None:
    """Withdraw a reference ephemeris: plans and reports no longer use it; the audit log and its file are kept."""
    with ground.database.writing() as connection:
        if caller.spacecraft is not None:
            _check_object(connection, get_ephemeris(connection, ephemeris_id).object_name, caller)
        found = mark_withdrawn(connection, ephemeris_id)
        audit(connection, actor, "withdraw ephemeris", found.name, {"id": ephemeris_id, "sha256": found.sha256})
        publish(connection, EphemerisAdded(id=found.id, start_utc_ns=found.start.utc_ns, stop_utc_ns=found.stop.utc_ns))


def open_ephemeris(ground: Ground, reference: Ephemeris) -> States:
    """Return the states of a reference ephemeris; callers share one object for each file.

    Raises
    ------
    LunarError
        The file cannot be read.
    """
    return _loaded(str(ground.files.path(reference.sha256)))


@functools.lru_cache(maxsize=8)
def _loaded(path: str) -> States:
    return load_arcs(Path(path))


ATTITUDE_FILES = ("attitude.csv", "attitude.aem")
HEADER = "image_ticks,q_w,q_x,q_y,q_z"
_MANY = 8
"""Attitudes from which their span is compared with that of the pass."""

UNIT_TOLERANCE = 1e-3
"""Accepted deviation of a quaternion from unit length: attitude control reports have few digits."""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeTable:
    """Times of attitudes and the quaternions (n, 4) from ICRF axes to the camera.

    Attributes
    ----------
    image_ticks
        On-board time of images (n,); empty for an AEM.
    utc_ns
        Times (n,), ascending, of an AEM, whose attitudes are interpolated; None for a table of images.
    """

    image_ticks: NDArray[np.int64]
    q_wxyz: NDArray[np.float64]
    utc_ns: NDArray[np.int64] | None = None


def no_attitudes() -> AttitudeTable:
    """Return an empty table."""
    return AttitudeTable(np.zeros(0, dtype=np.int64), np.zeros((0, 4)))


def attitude_file(names: Collection[str], source: str) -> str | None:
    """Return the name of the attitude file among the files of an archive, None without one.

    Raises
    ------
    InvalidInput
        There are two of them.
    """
    found = [name for name in ATTITUDE_FILES if name in names]
    if len(found) > 1:
        raise InvalidInput(source, "", f"one of {' and '.join(ATTITUDE_FILES)}", "both")
    return found[0] if found else None


def load_attitudes(path: Path, source: str = "attitude.csv") -> AttitudeTable:
    """Return the attitudes in a file, a table or an AEM.

    Raises
    ------
    InvalidInput
        The file is neither; the message states the first invalid line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise InvalidInput(source, "", "UTF-8 text", "other octets") from None
    if lines and lines[0].lstrip().startswith(("CCSDS_AEM_VERS", "<")):
        return _of_message("\n".join(lines), source)
    if not lines or lines[0] != HEADER:
        raise InvalidInput(source, "line 1", HEADER, repr(lines[0][:80]) if lines else "nothing")
    ticks: list[int] = []
    quaternions: list[list[float]] = []
    for number, line in enumerate(lines[1:], 2):
        fields = line.split(",")
        try:
            time, quaternion = int(fields[0]), [float(value) for value in fields[1:]]
        except ValueError:
            time, quaternion = -1, []
        length = float(np.linalg.norm(quaternion)) if len(quaternion) == 4 else float("nan")
        if not 0 <= time < 1 << 48 or not abs(length - 1.0) <= UNIT_TOLERANCE:
            raise InvalidInput(source, f"line {number}", "on-board ticks and a unit quaternion", repr(line[:80]))
        if time in ticks[-1:]:
            raise InvalidInput(source, f"line {number}", "one attitude of an image", f"{time} again")
        ticks.append(time)
        quaternions.append(quaternion)
    return AttitudeTable(np.array(ticks, dtype=np.int64), np.array(quaternions).reshape(-1, 4))


def check_attitudes(table: AttitudeTable, reference: States, start_utc_ns: int, stop_utc_ns: int) -> None:
    """Refuse attitudes of other times than those of a pass, or of a camera that looks away from the Moon.

    Raises
    ------
    EphemerisError
        The attitudes are not those of the pass.
    """
    if not len(table.q_wxyz):
        return
    # The clock on board may not be set, but it counts seconds.
    since_s = (table.image_ticks - table.image_ticks.min(initial=1 << 48)) / TICKS_PER_SECOND
    utc_ns = start_utc_ns + np.rint(NS * since_s).astype(np.int64) if table.utc_ns is None else table.utc_ns
    spanned_s, most_s = float(np.ptp(utc_ns)) / NS, (stop_utc_ns - start_utc_ns) / NS
    if len(utc_ns) >= _MANY and not most_s / _MANY <= spanned_s <= 2.0 * most_s:
        raise EphemerisError(
            f"attitudes: expected times that span {most_s / _MANY:.0f} to {2.0 * most_s:.0f} s, found "
            f"{spanned_s:.6g} s: another unit (ticks are 2^-16 s)?"
        )
    check_pointing(reference, np.sort(utc_ns), table.q_wxyz[np.argsort(utc_ns)])


def _of_message(text: str, source: str) -> AttitudeTable:
    try:
        segments = parse_aem(text, source)
    except LunarError as error:
        raise InvalidInput(source, "", "a CCSDS AEM", str(error).removeprefix(f"{source}: ")) from None
    times, quaternions = [], []
    for one in segments:
        frames = (one.frame_a.upper(), one.frame_b.upper())
        if frames[0] not in ICRF_NAMES or not frames[1].startswith(CAMERA_NAMES):
            expected = "REF_FRAME_A = ICRF and REF_FRAME_B = INSTRUMENT_1 (the camera)"
            raise InvalidInput(source, "", expected, f"{one.frame_a} and {one.frame_b}")
        times.append(one.utc_ns)
        quaternions.append(one.q_wxyz)
    utc_ns, first = np.unique(np.concatenate(times), return_index=True)
    return AttitudeTable(np.zeros(0, dtype=np.int64), np.concatenate(quaternions)[first], utc_ns)
