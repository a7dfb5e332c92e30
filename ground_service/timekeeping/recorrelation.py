"""Time correlations that keep themselves: from the time reports in the archive and the times of their reception.

What is fitted depends on the time reports, receptions, boots and reference ephemerides that are there, not on the order
in which they came. Fitting again without anything new changes nothing.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import Connection, func, select, update

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput
from ground_service.events import CorrelationChanged, ReceptionsEntered, publish
from ground_service.ground import Ground
from ground_service.http.times import time_of
from ground_service.missions.stations import STATIONS
from ground_service.missions.store import mission_of_vehicle
from ground_service.store import repository
from ground_service.store.vehicles import vehicle_id
from ground_service.timekeeping.core import CorrelationFit, clock_runs, fit_correlation, utc_ns_of_ticks
from ground_service.timekeeping.store import load_correlations
from lunar.arrays import IntArray
from lunar.constants import SPEED_OF_LIGHT_M_S
from lunar.ephemeris import Ephemeris
from lunar.ephemeris_files import load_ephemeris
from lunar.errors import LunarError
from lunar.third_bodies import earth_position_icrf_m
from lunar.timescales import tai_ns_from_utc_ns, tdb_s_from_utc_ns
from lunar.visibility import link
from tmtc.dictionary import APID_TIME_REPORT

AUTOMATIC = "time reports, light time"
"""Method of correlations that are fitted again by themselves."""

RECEPTIONS_LIMIT = 100_000
_LINE = (
    "boot_count",
    "start_ticks",
    "stop_ticks",
    "reference_ticks",
    "reference_utc_ns",
    "drift_ppb",
    "points",
)


@dataclass(frozen=True, slots=True)
class ReceivedReport:
    """When a time report came to the Earth: the on-board time and the count in its header say which it is."""

    ticks: int
    sequence_count: int
    earth_utc_ns: int
    station: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class TimeReports:
    """Time reports (n,) that are in the archive and whose reception is known, by on-board time of the packet."""

    packet_ticks: IntArray
    sequence_count: IntArray
    ticks: IntArray
    earth_utc_ns: IntArray
    light_time_ns: IntArray
    boot: IntArray
    station: tuple[str, ...]


def received_reports(given: Sequence[Mapping[str, Any]]) -> list[ReceivedReport]:
    """Receptions out of plain values: packet_ticks, sequence_count, received (UTC text), station.

    Raises
    ------
    InvalidInput
        If a value is missing or cannot be read, or a station is not known.
    """
    known = {station.name.lower(): station.name for station in STATIONS}
    reports = []
    for number, one in enumerate(given):
        place = f"receptions.{number}"
        try:
            ticks, count = int(one["packet_ticks"]), int(one["sequence_count"])
            received = time_of(one["received"], f"{place}.received")
        except (KeyError, TypeError, ValueError, LunarError) as error:
            raise InvalidInput(
                "time report", place, "packet_ticks, sequence_count and received", str(error)[:120]
            ) from None
        if not (0 <= ticks < 1 << 48 and 0 <= count < 1 << 14):
            raise InvalidInput(
                "time report", place, "48 bits of ticks, 14 bits of count", f"{ticks}, {count}"
            )
        station = str(one.get("station") or "")
        if station and station.lower() not in known:
            expected = ", ".join(sorted(known.values()))
            raise InvalidInput("time report", f"{place}.station", expected, station[:64])
        reports.append(ReceivedReport(ticks, count, received, known.get(station.lower(), "")))
    return reports


def read_receptions(path: Path) -> list[ReceivedReport]:
    """Receptions out of a CSV file with the columns packet_ticks, sequence_count, received_utc and maybe station.

    Raises
    ------
    InvalidInput
        If the file cannot be read, or a row of it.
    """
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            reader = csv.DictReader(stream)
            rows = list(islice(reader, RECEPTIONS_LIMIT + 1))
            names = reader.fieldnames or ()
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidInput(str(path), "", "a CSV file of receptions", str(error)) from None
    for name in ("packet_ticks", "sequence_count", "received_utc"):
        if name not in names:
            raise InvalidInput(str(path), "line 1", f"a column {name}", ",".join(names)[:120] or "nothing")
    if len(rows) > RECEPTIONS_LIMIT:
        raise InvalidInput(str(path), "", f"at most {RECEPTIONS_LIMIT} receptions", "more")
    given = [{**row, "received": row["received_utc"]} for row in rows]
    try:
        return received_reports(given)
    except InvalidInput as error:
        raise InvalidInput(str(path), error.where or error.what, error.expected, error.found) from None


def enter_receptions(
    ground: Ground, spacecraft_id: int, instance: str, reports: Sequence[ReceivedReport], *, actor: str
) -> list[repository.Row]:
    """Note when time reports were received, and correlate again; the correlations then in force.

    The same again changes nothing. The reports themselves may come later.
    """
    table = repository.RECEPTIONS
    first: dict[tuple[int, int, str], int] = {}
    for report in reports:
        key = (report.ticks, report.sequence_count, report.station)
        first[key] = min(first.get(key, report.earth_utc_ns), report.earth_utc_ns)
    with ground.database.writing() as connection:
        vehicle = lock_vehicle(connection, vehicle_id(connection, spacecraft_id, instance))
        rows = connection.execute(select(table).where(table.c.vehicle_id == vehicle)).mappings()
        known = {(r["ticks"], r["sequence_count"], r["station"]): r["earth_utc_ns"] for r in rows}
        new = [
            dict(zip(("ticks", "sequence_count", "station"), key, strict=True))
            | {"vehicle_id": vehicle, "earth_utc_ns": time}
            for key, time in first.items()
            if key not in known
        ]
        if len(known) + len(new) > RECEPTIONS_LIMIT:
            raise InvalidInput(
                "time reports", "", f"at most {RECEPTIONS_LIMIT} of a spacecraft", str(len(known) + len(new))
            )
        if new:
            connection.execute(table.insert(), new)
        for (ticks, count, station), time in first.items():
            if time < known.get((ticks, count, station), time):
                connection.execute(
                    update(table)
                    .where(
                        table.c.vehicle_id == vehicle,
                        table.c.ticks == ticks,
                        table.c.sequence_count == count,
                        table.c.station == station,
                    )
                    .values(earth_utc_ns=time)
                )
        audit(connection, actor, "enter receptions", str(vehicle), {"reports": len(reports), "new": len(new)})
        publish(connection, ReceptionsEntered(vehicle_id=vehicle, reports=len(first)))
    recorrelate(ground, vehicle)
    return in_force(ground, vehicle)


def recorrelate(ground: Ground, vehicle: int, *, over_manual: bool = False) -> bool:
    """Fit the correlations of a vehicle again; whether that changed any.

    Correlations that an operator entered stay in force until `over_manual` is asked for. Nothing is fitted
    automatically if the mission description states another policy.
    """
    with ground.database.reading() as connection:
        if not _has_receptions(connection, vehicle):
            return False
    with ground.database.writing() as connection:
        lock_vehicle(connection, vehicle)
        table = repository.CORRELATIONS
        mine = (table.c.vehicle_id == vehicle, table.c.superseded == 0)
        old = [dict(row) for row in connection.execute(select(table).where(*mine)).mappings()]
        if any(row["method"] != AUTOMATIC for row in old) and not over_manual:
            return False
        mission = mission_of_vehicle(connection, vehicle)
        if mission is not None and mission.time.correlation in ("manual", "ideal") and not over_manual:
            return False
        reports = time_reports(ground, connection, vehicle)
        fits = fit_runs(reports)
        if {_line(row) for row in old} == {_line(row) for row in fits} and len(old) == len(fits):
            return False
        connection.execute(update(table).where(*mine).values(superseded=1))
        now = utc_now_ns()
        for values in fits:
            repository.add(
                connection,
                table,
                vehicle_id=vehicle,
                method=AUTOMATIC,
                superseded=0,
                created_utc_ns=now,
                **values,
            )
        publish(connection, CorrelationChanged(vehicle_id=vehicle, segments=len(fits)))
    return True


def vehicles_with_receptions(ground: Ground, start_utc_ns: int, stop_utc_ns: int) -> list[int]:
    """Return the vehicles with time reports received in an interval of time."""
    table = repository.RECEPTIONS
    query = select(table.c.vehicle_id).where(table.c.earth_utc_ns.between(start_utc_ns, stop_utc_ns))
    with ground.database.reading() as connection:
        return [int(vehicle) for vehicle in connection.execute(query.distinct()).scalars()]


def in_force(ground: Ground, vehicle: int) -> list[repository.Row]:
    """The correlations of a vehicle in force, by on-board time."""
    table = repository.CORRELATIONS
    query = (
        select(table)
        .where(table.c.vehicle_id == vehicle, table.c.superseded == 0)
        .order_by(table.c.start_ticks)
    )
    with ground.database.reading() as connection:
        return [dict(row) for row in connection.execute(query).mappings()]


def fit_runs(reports: TimeReports) -> list[dict[str, Any]]:
    """The columns of a correlation for every run of the clock."""
    fits = []
    for run in clock_runs(reports.ticks, reports.earth_utc_ns, reports.light_time_ns, reports.boot):
        if len(run) == 0:
            continue
        fit: CorrelationFit = fit_correlation(
            reports.ticks[run], reports.earth_utc_ns[run], reports.light_time_ns[run]
        )
        fits.append(
            {
                "boot_count": int(reports.boot[run[0]]),
                **{name: getattr(fit, name) for name in fit.__slots__},
            }
        )
    return fits


def residuals(ground: Ground, vehicle: int) -> list[dict[str, Any]]:
    """Every time report with its reception, and what the correlation in force leaves of it, ns."""
    with ground.database.reading() as connection:
        reports = time_reports(ground, connection, vehicle)
        correlations = load_correlations(connection, vehicle)
    utc_ns, ids = utc_ns_of_ticks(reports.ticks, correlations)
    sent = np.asarray(tai_ns_from_utc_ns(reports.earth_utc_ns)) - reports.light_time_ns
    left = sent - np.asarray(tai_ns_from_utc_ns(utc_ns))
    return [
        {
            "packet_ticks": int(reports.packet_ticks[k]),
            "sequence_count": int(reports.sequence_count[k]),
            "reported_ticks": int(reports.ticks[k]),
            "received_utc_ns": int(reports.earth_utc_ns[k]),
            "station": reports.station[k],
            "light_time_s": float(reports.light_time_ns[k]) * 1e-9,
            "boot_count": int(reports.boot[k]),
            "correlation_id": int(ids[k]),
            "residual_ns": int(left[k]),
        }
        for k in range(len(reports.ticks))
    ]


def time_reports(ground: Ground, connection: Connection, vehicle: int) -> TimeReports:
    """The time reports of a vehicle that are there, and whose reception and light time are known."""
    table, packets, receptions = repository.SAMPLES["time_reports"], repository.PACKETS, repository.RECEPTIONS
    # Every dictionary version tells the same of a report: one row each is enough.
    query = (
        select(
            receptions.c.ticks,
            receptions.c.sequence_count,
            func.max(table.c.reported_ticks),
            receptions.c.earth_utc_ns,
            receptions.c.station,
        )
        .join(
            packets,
            (packets.c.vehicle_id == receptions.c.vehicle_id)
            & (packets.c.apid == APID_TIME_REPORT)
            & (packets.c.ticks == receptions.c.ticks)
            & (packets.c.sequence_count == receptions.c.sequence_count),
        )
        .join(
            table,
            (table.c.vehicle_id == packets.c.vehicle_id)
            & (table.c.ticks == packets.c.ticks)
            & (table.c.packet_id == packets.c.id),
        )
        .where(receptions.c.vehicle_id == vehicle)
        .group_by(
            receptions.c.ticks, receptions.c.sequence_count, receptions.c.earth_utc_ns, receptions.c.station
        )
        .order_by(receptions.c.ticks, receptions.c.sequence_count, receptions.c.station)
    )
    rows = connection.execute(query).all()
    numbers = np.array([tuple(row)[:4] for row in rows], dtype=np.int64).reshape(-1, 4)
    stations = tuple(str(row[4]) for row in rows)
    light_time_ns = _light_time_ns(ground, connection, vehicle, numbers[:, 3], stations)
    known = np.flatnonzero(light_time_ns >= 0)
    numbers, light_time_ns = numbers[known], light_time_ns[known]
    return TimeReports(
        packet_ticks=numbers[:, 0],
        sequence_count=numbers[:, 1],
        ticks=numbers[:, 2],
        earth_utc_ns=numbers[:, 3],
        light_time_ns=light_time_ns,
        boot=_boots(connection, vehicle, numbers[:, 2]),
        station=tuple(stations[k] for k in known.tolist()),
    )


def lock_vehicle(connection: Connection, vehicle: int) -> int:
    """Lock a vehicle against concurrent correlation until the transaction ends, and return it."""
    table = repository.VEHICLES
    connection.execute(select(table.c.id).where(table.c.id == vehicle).with_for_update())
    return vehicle


def _has_receptions(connection: Connection, vehicle: int) -> bool:
    table = repository.RECEPTIONS
    query = select(table.c.ticks).where(table.c.vehicle_id == vehicle).limit(1)
    return connection.execute(query).first() is not None


def _line(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in _LINE)


def _boots(connection: Connection, vehicle: int, ticks: IntArray) -> IntArray:
    """The boot (n,) that the clock showed `ticks` (n,) in, by the housekeeping; 0 without any."""
    table = repository.SAMPLES["housekeeping"]
    rows = connection.execute(
        select(func.min(table.c.ticks), table.c.boot_count)
        .where(table.c.vehicle_id == vehicle)
        .group_by(table.c.boot_count)
    ).all()
    if not rows:
        return np.zeros(len(ticks), dtype=np.int64)
    starts = np.array(sorted(tuple(row) for row in rows), dtype=np.int64)
    return np.asarray(starts[np.maximum(np.searchsorted(starts[:, 0], ticks, side="right") - 1, 0), 1])


def _light_time_ns(
    ground: Ground, connection: Connection, vehicle: int, earth_utc_ns: IntArray, stations: tuple[str, ...]
) -> IntArray:
    """Light time (n,) from the spacecraft to the station, or to the Earth's centre where none is named.

    From the reference ephemerides, -1 where none covers; where none covers any report, from the Moon's centre, which is
    wrong by at most 6 ms in a low orbit.
    """
    if len(earth_utc_ns) == 0:
        return np.zeros(0, dtype=np.int64)
    light_s = np.full(len(earth_utc_ns), np.nan)
    known = {station.name: station for station in STATIONS}
    names = np.array(stations)
    for ephemeris in _references(ground, connection, vehicle, earth_utc_ns):
        covered = (earth_utc_ns - 2 * 10**9 >= ephemeris.start_utc_ns) & (
            earth_utc_ns <= ephemeris.stop_utc_ns
        )
        for name in sorted(set(stations)):
            here = np.flatnonzero(covered & np.isnan(light_s) & (names == name))
            if len(here):
                light_s[here] = link(ephemeris, earth_utc_ns[here], known.get(name)).light_time_s
    unknown = np.isnan(light_s)
    if unknown.all():
        away = np.asarray(earth_position_icrf_m(np.asarray(tdb_s_from_utc_ns(earth_utc_ns))))
        return np.asarray(np.rint(np.linalg.norm(away, axis=-1) / SPEED_OF_LIGHT_M_S * 1e9), dtype=np.int64)
    return np.where(unknown, -1, np.rint(np.where(unknown, 0.0, light_s) * 1e9)).astype(np.int64)


def _references(
    ground: Ground, connection: Connection, vehicle: int, earth_utc_ns: IntArray
) -> list[Ephemeris]:
    """Reference ephemerides to take light times from: those of the vehicle's passes first, then by precedence."""
    passes = repository.PASSES
    own = select(passes.c.ephemeris_id).where(
        passes.c.vehicle_id == vehicle, passes.c.ephemeris_id.is_not(None)
    )
    mine = set(connection.execute(own).scalars())
    rows = repository.covering_ephemerides(connection, int(earth_utc_ns.min()), int(earth_utc_ns.max()))
    if mine:
        rows = [row for row in rows if row["id"] in mine]
    return [load_ephemeris(ground.files.path(row["file_sha256"])) for row in rows]
