"""Automatic time correlation from archived time reports and the times of their reception.

What is fitted depends on the time reports, receptions, boots and reference ephemerides that are there, not on the order
in which they came. Fitting again without anything new changes nothing.
"""

import csv
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import Connection

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, InvalidInput
from ground_service.ground import Ground
from ground_service.http.model import UtcTime, time_of
from ground_service.missions.ephemerides.model import Ephemeris
from ground_service.missions.ephemerides.service import covering_ephemerides
from ground_service.missions.places import stations_of
from ground_service.missions.store import mission_of_vehicle
from ground_service.missions.timekeeping import store
from ground_service.missions.timekeeping.core import (
    LONE_DRIFT,
    CorrelationFit,
    StationDoubt,
    TimeCorrelation,
    clock_runs,
    doubted_stations,
    fit_correlation,
    moved_ticks,
    utc_ns_of_ticks,
)
from ground_service.missions.timekeeping.model import RECEPTIONS_LIMIT, Correlation, TimeReport
from ground_service.store.event_kinds import ClockDoubted, CorrelationChanged, ReceptionsEntered, publish, publish_once
from ground_service.store.vehicles import find_vehicle, get_vehicle, lock_vehicle, vehicle_id
from lunar.arrays import IntArray
from lunar.constants import SPEED_OF_LIGHT_M_S
from lunar.ephemeris import Ephemeris as States
from lunar.errors import LunarError
from lunar.messages.ephemeris_files import load_arcs
from lunar.plausible import CORRELATION_RMS_NS
from lunar.third_bodies import earth_position_icrf_m
from lunar.timescales import tai_ns_from_utc_ns, tdb_s_from_utc_ns
from lunar.visibility import DSN_STATIONS, GroundStation, link

AUTOMATIC = "time reports, light time"
"""Method of correlations that are fitted again by themselves."""

_BLOCK_NS = 86_400 * 10**9
"""Receptions whose light times are kept together."""

_LINE = ("start_ticks", "stop_ticks", "reference_ticks", "reference_utc_ns", "drift_ppb", "points")


@dataclass(frozen=True, slots=True)
class ReceivedReport:
    """Reception of a time report on the Earth; on-board time and count of its header identify it."""

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
    known = {station.name.lower(): station.name for station in DSN_STATIONS}
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
            raise InvalidInput("time report", place, "48 bits of ticks, 14 bits of count", f"{ticks}, {count}")
        station = str(one.get("station") or "")
        if station and station.lower() not in known:
            expected = ", ".join(sorted(known.values()))
            raise InvalidInput("time report", f"{place}.station", expected, station[:64])
        reports.append(ReceivedReport(ticks, count, received, known.get(station.lower(), "")))
    return reports


def read_receptions(path: Path, least: int = 1) -> list[ReceivedReport]:
    """Receptions out of a CSV file with the columns packet_ticks, sequence_count, received_utc and maybe station.

    Raises
    ------
    InvalidInput
        If the file cannot be read, or a row of it.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.DictReader(stream)
            rows = list(islice(reader, RECEPTIONS_LIMIT + 1))
            names = reader.fieldnames or ()
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidInput(str(path), "", "a CSV file of receptions", str(error)) from None
    for name in ("packet_ticks", "sequence_count", "received_utc"):
        if name not in names:
            raise InvalidInput(str(path), "line 1", f"a column {name}", ",".join(names)[:120] or "nothing")
    if not least <= len(rows) <= RECEPTIONS_LIMIT:
        found = "more" if rows else "none"
        raise InvalidInput(str(path), "", f"{least} to {RECEPTIONS_LIMIT} receptions", found)
    given = [{**row, "received": row["received_utc"]} for row in rows]
    try:
        return received_reports(given)
    except InvalidInput as error:
        raise InvalidInput(str(path), error.where or error.what, error.expected, error.found) from None


def enter_receptions(
    ground: Ground, spacecraft_id: int, instance: str, reports: Sequence[ReceivedReport], *, actor: str
) -> list[Correlation]:
    """Note when time reports were received, and correlate again; the correlations then in force.

    The same again changes nothing. The reports themselves may come later.
    """
    first: dict[store.ReceptionKey, int] = {}
    for report in reports:
        key = (report.ticks, report.sequence_count, report.station)
        first[key] = min(first.get(key, report.earth_utc_ns), report.earth_utc_ns)
    with ground.database.writing() as connection:
        vehicle = lock_vehicle(connection, vehicle_id(connection, spacecraft_id, instance)).id
        known = store.receptions(connection, vehicle)
        new = {key: time for key, time in first.items() if key not in known}
        if len(known) + len(new) > RECEPTIONS_LIMIT:
            raise InvalidInput(
                "time reports", "", f"at most {RECEPTIONS_LIMIT} of a spacecraft", str(len(known) + len(new))
            )
        store.add_receptions(connection, vehicle, new)
        for key, time in first.items():
            if time < known.get(key, time):
                store.change_reception(connection, vehicle, key, time)
        audit(connection, actor, "enter receptions", str(vehicle), {"reports": len(reports), "new": len(new)})
        publish(connection, ReceptionsEntered(vehicle_id=vehicle, reports=len(first)))
    recorrelate(ground, vehicle)
    return ground.read(store.correlations_in_force, vehicle)


def recorrelate(ground: Ground, vehicle: int, *, over_manual: bool = False) -> bool:
    """Fit the correlations of a vehicle again; whether that changed any.

    Correlations that an operator entered stay in force until `over_manual` is asked for. Nothing is fitted
    automatically if the mission description states another policy.
    """
    with ground.database.reading() as connection:
        if not store.has_receptions(connection, vehicle):
            return False
    with ground.database.writing() as connection:
        lock_vehicle(connection, vehicle)
        old = store.correlations_in_force(connection, vehicle)
        if any(one.method != AUTOMATIC for one in old) and not over_manual:
            return False
        mission = mission_of_vehicle(connection, vehicle)
        if mission is not None and mission.time.correlation in ("manual", "ideal") and not over_manual:
            return False
        fits, doubts = fit_runs(time_reports(ground, connection, vehicle))
        for doubt in sorted(set(doubts.values()), key=str):
            doubted = ClockDoubted(vehicle_id=vehicle, station=doubt.station, difference_s=round(doubt.difference_s, 3))
            publish_once(connection, doubted)
        lines = {_line(one.boot_count, one) for one in old}
        if lines == {_line(*fit) for fit in fits} and len(old) == len(fits):
            return False
        before = store.load_correlations(connection, vehicle)
        store.replace_correlations(connection, vehicle, fits, method=AUTOMATIC, now_utc_ns=utc_now_ns())
        _publish_change(connection, vehicle, before)
    return True


def _publish_change(connection: Connection, vehicle: int, before: Sequence[TimeCorrelation]) -> None:
    now = store.load_correlations(connection, vehicle)
    first, last = moved_ticks(before, now)
    changed = CorrelationChanged(vehicle_id=vehicle, segments=len(now), first_ticks=first, last_ticks=last)
    publish(connection, changed)


def fit_runs(reports: TimeReports) -> tuple[list[tuple[int, CorrelationFit]], dict[int, StationDoubt]]:
    """Return the boot and the fitted line of every run of the clock, and the doubts about reports by their row.

    A line about which the reports scatter by more than `CORRELATION_RMS_NS` is left out.
    """
    kept, doubts = doubted_stations(
        reports.ticks, reports.earth_utc_ns, reports.light_time_ns, reports.boot, reports.station
    )
    rows = np.flatnonzero(kept)
    runs = clock_runs(reports.ticks[rows], reports.earth_utc_ns[rows], reports.light_time_ns[rows], reports.boot[rows])
    fits = []
    for run in (rows[found] for found in runs if len(found)):
        fit = _fit(reports, run)
        if fit.residual_rms_ns > CORRELATION_RMS_NS and (steady := _steady(reports, run)).size:
            fit = _fit(reports, steady)
            for name, mine in _by_station(reports, np.setdiff1d(run, steady)).items():
                kept[mine], left_ns = False, _left_ns(reports, mine, fit)
                doubt = StationDoubt(name, float(left_ns[np.argmax(np.abs(left_ns))]) * 1e-9)
                doubts.update(dict.fromkeys(mine.tolist(), doubt))
        inside = (reports.ticks >= fit.start_ticks) & (reports.ticks <= fit.stop_ticks) & ~kept
        rejected = fit.rejected + int((inside & (reports.boot == reports.boot[run[0]])).sum())
        if fit.residual_rms_ns <= CORRELATION_RMS_NS:
            fits.append((int(reports.boot[run[0]]), replace(fit, rejected=rejected)))
        else:
            for name, mine in _by_station(reports, run).items():
                doubt = StationDoubt(name, fit.residual_rms_ns * 1e-9, "one line through all (rms)")
                doubts.update(dict.fromkeys(mine.tolist(), doubt))
    return fits, doubts


def _fit(reports: TimeReports, rows: IntArray) -> CorrelationFit:
    return fit_correlation(reports.ticks[rows], reports.earth_utc_ns[rows], reports.light_time_ns[rows])


def _by_station(reports: TimeReports, rows: IntArray) -> dict[str, IntArray]:
    names = np.array(reports.station)[rows]
    return {str(name): rows[names == name] for name in np.unique(names)}


def _steady(reports: TimeReports, rows: IntArray) -> IntArray:
    """Return the reports of stations whose own lines drift as an oscillator on board can, where others drift more."""
    stations = _by_station(reports, rows)
    fits = {name: _fit(reports, mine) for name, mine in stations.items()}
    good = [
        stations[name]
        for name, fit in fits.items()
        if fit.residual_rms_ns <= CORRELATION_RMS_NS and abs(fit.drift_ppb) <= LONE_DRIFT * 1e9
    ]
    return np.concatenate(good) if 0 < len(good) < len(stations) else np.zeros(0, dtype=np.int64)


def _left_ns(reports: TimeReports, rows: IntArray, fit: CorrelationFit) -> IntArray:
    """Return by how much receptions are after what a line says."""
    line = TimeCorrelation(0, fit.start_ticks, fit.stop_ticks, fit.reference_ticks, fit.reference_utc_ns, fit.drift_ppb)
    expected = np.asarray(tai_ns_from_utc_ns(line.utc_ns(reports.ticks[rows])))
    return np.asarray(tai_ns_from_utc_ns(reports.earth_utc_ns[rows]) - reports.light_time_ns[rows] - expected)


def residuals(ground: Ground, vehicle: int) -> list[TimeReport]:
    """Every time report with its reception, and what the correlation in force leaves of it, ns."""
    with ground.database.reading() as connection:
        reports = time_reports(ground, connection, vehicle)
        correlations = store.load_correlations(connection, vehicle)
    utc_ns, ids = utc_ns_of_ticks(reports.ticks, correlations)
    _, doubts = fit_runs(reports)
    sent = np.asarray(tai_ns_from_utc_ns(reports.earth_utc_ns)) - reports.light_time_ns
    left = sent - np.asarray(tai_ns_from_utc_ns(utc_ns))
    return [
        TimeReport(
            packet_ticks=int(reports.packet_ticks[k]),
            sequence_count=int(reports.sequence_count[k]),
            reported_ticks=int(reports.ticks[k]),
            received=UtcTime(reports.earth_utc_ns[k]),
            station=reports.station[k],
            light_time_s=float(reports.light_time_ns[k]) * 1e-9,
            boot_count=int(reports.boot[k]),
            correlation_id=int(ids[k]),
            residual_ns=int(left[k]),
            remark=str(doubts.get(k, "")),
        )
        for k in range(len(reports.ticks))
    ]


def time_reports(ground: Ground, connection: Connection, vehicle: int) -> TimeReports:
    """The time reports of a vehicle that are there, and whose reception and light time are known."""
    numbers, stations = store.received_time_reports(connection, vehicle)
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


def _line(boot_count: int | None, line: Correlation | CorrelationFit) -> tuple[object, ...]:
    return boot_count, *(getattr(line, name) for name in _LINE)


def _boots(connection: Connection, vehicle: int, ticks: IntArray) -> IntArray:
    """The boot (n,) that the clock showed `ticks` (n,) in, by the housekeeping; 0 without any."""
    starts = store.boot_starts(connection, vehicle)
    if not len(starts):
        return np.zeros(len(ticks), dtype=np.int64)
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
    known = {station.name: station for station in DSN_STATIONS}
    mission = mission_of_vehicle(connection, vehicle)
    if mission is not None:
        known |= {station.name: station for station in stations_of(mission.link)}
    names = np.array(stations)
    for row in _references(connection, vehicle, earth_utc_ns):
        covered = (earth_utc_ns - 2 * 10**9 >= row.start.utc_ns) & (earth_utc_ns <= row.stop.utc_ns)
        for name in sorted(set(stations)):
            here = np.flatnonzero(covered & np.isnan(light_s) & (names == name))
            for block in np.unique(earth_utc_ns[here] // _BLOCK_NS):
                mine = here[earth_utc_ns[here] // _BLOCK_NS == block]
                times = tuple(earth_utc_ns[mine].tolist())
                light_s[mine] = _light_times_s(ground.files.path(row.sha256), known.get(name), times)
    unknown = np.isnan(light_s)
    if unknown.all():
        away = np.asarray(earth_position_icrf_m(np.asarray(tdb_s_from_utc_ns(earth_utc_ns))))
        return np.asarray(np.rint(np.linalg.norm(away, axis=-1) / SPEED_OF_LIGHT_M_S * 1e9), dtype=np.int64)
    return np.where(unknown, -1, np.rint(np.where(unknown, 0.0, light_s) * 1e9)).astype(np.int64)


def _references(connection: Connection, vehicle: int, earth_utc_ns: IntArray) -> list[Ephemeris]:
    """Reference ephemerides to take light times from: those of the vehicle's passes first, then by precedence."""
    mine = store.ephemerides_of_passes(connection, vehicle)
    spacecraft = get_vehicle(connection, vehicle, "spacecraft").ccsds_id
    rows = covering_ephemerides(connection, int(earth_utc_ns.min()), int(earth_utc_ns.max()), spacecraft)
    if mine:
        rows = [row for row in rows if row.id in mine]
    return rows


@functools.lru_cache(maxsize=1024)
def _light_times_s(path: Path, station: GroundStation | None, earth_utc_ns: tuple[int, ...]) -> tuple[float, ...]:
    """Return the light times at receptions of a block by an ephemeris file, whose name is its SHA-256.

    Every correlation needs those of all receptions. They are kept, so that the files need not be.
    """
    found = link(_load(path), np.array(earth_utc_ns, dtype=np.int64), station).light_time_s
    return tuple(np.asarray(found, dtype=np.float64).tolist())


@functools.lru_cache(maxsize=2)
def _load(path: Path) -> States:
    return load_arcs(path)


MANUAL = "least squares of time reports"
"""Method of correlations that an operator entered."""


@dataclass(frozen=True, slots=True)
class TimePoint:
    """A time report as received: what the clock showed, when that reached the Earth, the light time, the boot."""

    ticks: int
    earth_utc_ns: int
    light_time_ns: int
    boot_count: int = 0


def correlate(
    ground: Ground, vehicle: int, points: Sequence[TimePoint], *, actor: str = "local"
) -> list[CorrelationFit]:
    """Fit a correlation for every boot among the points; they replace those in force, which stay on record.

    Raises
    ------
    InvalidInput
        If there are no points.
    """
    if not points:
        raise InvalidInput("time correlation", "points", "at least one time report", "none")
    fits: dict[int, CorrelationFit] = {}
    for boot in sorted({point.boot_count for point in points}):
        mine = [point for point in points if point.boot_count == boot]
        fits[boot] = fit_correlation(
            np.array([point.ticks for point in mine], dtype=np.int64),
            np.array([point.earth_utc_ns for point in mine], dtype=np.int64),
            np.array([point.light_time_ns for point in mine], dtype=np.int64),
        )
    with ground.database.writing() as connection:
        lock_vehicle(connection, vehicle)
        before = store.load_correlations(connection, vehicle)
        store.replace_correlations(connection, vehicle, fits.items(), method=MANUAL, now_utc_ns=utc_now_ns())
        audit(connection, actor, "correlate time", str(vehicle), {"boots": len(fits), "points": len(points)})
        _publish_change(connection, vehicle, before)
    return list(fits.values())


def correlate_spacecraft(
    ground: Ground, spacecraft_id: int, instance: str, points: Sequence[TimePoint], *, actor: str
) -> list[Correlation]:
    """As `correlate`, of a spacecraft by its number; the correlations now in force."""
    vehicle = _vehicle(ground, spacecraft_id, instance)
    correlate(ground, vehicle, points, actor=actor)
    return [one for one in ground.read(store.correlations_on_record, vehicle) if one.in_force]


def spacecraft_correlations(ground: Ground, spacecraft_id: int, instance: str) -> list[Correlation]:
    """All correlations that a spacecraft ever had, the newest first."""
    return ground.read(store.correlations_on_record, _vehicle(ground, spacecraft_id, instance))


def correlate_again(ground: Ground, spacecraft_id: int, instance: str, *, actor: str) -> list[Correlation]:
    """Correlate a spacecraft from its received time reports, also over what was entered; the correlations in force."""
    vehicle = _vehicle(ground, spacecraft_id, instance)
    if recorrelate(ground, vehicle, over_manual=True):
        ground.write(audit, actor, "correlate time", str(vehicle), {"from": "time reports"})
    return ground.read(store.correlations_in_force, vehicle)


def withdraw_correlations(ground: Ground, spacecraft_id: int, instance: str, *, actor: str) -> list[Correlation]:
    """Withdraw the correlations in force that a person entered, and correlate again; the correlations then in force.

    The withdrawn ones stay on record.

    Raises
    ------
    Conflict
        None in force was entered by a person.
    """
    vehicle = _vehicle(ground, spacecraft_id, instance)
    with ground.database.writing() as connection:
        lock_vehicle(connection, vehicle)
        entered = [one.id for one in store.correlations_in_force(connection, vehicle) if one.method == MANUAL]
        if not entered:
            raise Conflict(
                f"spacecraft {spacecraft_id}: expected correlations in force that a person entered, found none"
            )
        before = store.load_correlations(connection, vehicle)
        store.replace_correlations(connection, vehicle, (), method=MANUAL, now_utc_ns=utc_now_ns())
        audit(connection, actor, "withdraw correlations", str(vehicle), {"ids": entered})
        _publish_change(connection, vehicle, before)
    recorrelate(ground, vehicle)
    return ground.read(store.correlations_in_force, vehicle)


def spacecraft_time_reports(ground: Ground, spacecraft_id: int, instance: str) -> list[TimeReport]:
    """The received time reports of a spacecraft with what the correlations in force leave of them."""
    return residuals(ground, _vehicle(ground, spacecraft_id, instance))


def _vehicle(ground: Ground, spacecraft_id: int, instance: str) -> int:
    return ground.read(find_vehicle, spacecraft_id, instance).id
