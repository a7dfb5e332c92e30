"""Conditions and resources of the plan of a spacecraft over time, and the conflicts of its windows."""

import functools
from collections.abc import Sequence

import numpy as np

from ground_service.errors import InvalidInput, NotFound
from ground_service.ground import Ground
from ground_service.missions.catalogues import catalogue_of
from ground_service.missions.ephemerides.model import Ephemeris
from ground_service.missions.model import Mission
from ground_service.planning import service, store
from ground_service.planning.core import Planner
from ground_service.planning.filling import Option, ResourceGrid, curves, violation
from ground_service.planning.model import CraterDensity, PlanForecast, Span, Window, WindowConflict
from ground_service.planning.window_states import COMMITTED
from lunar.arrays import FloatArray
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M, NS
from lunar.timescales import format_utc

LIMIT_S = 8 * 86_400
SHORTEST_STEP_S = 60.0
LONGEST_STEP_S = 300.0
STEPS = 1440
HISTORY_NS = 86_400 * NS
"""The battery is assumed full, and the storage empty, a day before the interval or where the ephemeris begins."""

CELL_DEG = 10.0
DENSITY_DIAMETER_KM = (5.0, 30.0)
_AREA_KM2 = 1e4


def get_forecast(
    ground: Ground,
    *,
    spacecraft_id: int,
    instance: str,
    start_utc_ns: int,
    stop_utc_ns: int,
    ephemeris_id: int | None = None,
) -> PlanForecast:
    """Return what the plan of a spacecraft means for battery, storage and downlink between two times.

    Raises
    ------
    InvalidInput
        The interval is empty or too long.
    NotFound
        There is no such ephemeris.
    """
    span_s = (stop_utc_ns - start_utc_ns) / NS
    if not 0.0 < span_s <= LIMIT_S:
        expected = f"a time after the start, at most {LIMIT_S // 86_400} days"
        raise InvalidInput("forecast", "stop", expected, f"{span_s:.0f} s after it")
    with ground.database.reading() as connection:
        service.require_described(connection, spacecraft_id)
        mission = service.mission_of(connection, spacecraft_id)
        windows = store.windows_between(connection, spacecraft_id, instance, start_utc_ns - HISTORY_NS, stop_utc_ns)
        try:
            reference = service.ephemerides_for(connection, ephemeris_id, start_utc_ns, stop_utc_ns, spacecraft_id)[0]
        except NotFound:
            if ephemeris_id is not None:
                raise
            reference = None
    step_s = min(max(SHORTEST_STEP_S, span_s / STEPS), LONGEST_STEP_S)
    begin, end = start_utc_ns, stop_utc_ns
    if reference is not None:
        begin, end = max(begin, reference.start.utc_ns), min(end, reference.stop.utc_ns)
    count = int((end - begin) // round(step_s * NS))
    empty = PlanForecast(
        spacecraft_id=spacecraft_id,
        instance=instance,
        ephemeris_id=None if reference is None else reference.id,
        reason="no reference ephemeris covers the interval",
        data=[],
        step_s=step_s,
        **{name: [] for name in _COLUMNS},
        assumed=service.assumed_resources(mission),
        battery_floor=service.battery_floor(mission),
        storage_octets=service.resources_of(mission).storage_octets,
        conflicts=_overlaps(windows, {}),
    )
    if reference is None or count < 1:
        return empty
    planner = service.planner_of(ground, reference, mission)
    return _forecast(empty, planner, mission, reference, windows, begin, count, start_utc_ns, stop_utc_ns)


_COLUMNS = (
    "time_s",
    "latitude_deg",
    "longitude_deg",
    "altitude_km",
    "sun_elevation_deg",
    "sunlit",
    "battery_share",
    "stored_octets",
    "sent_octets",
    "downlink_octets",
)


def _forecast(
    empty: PlanForecast,
    planner: Planner,
    mission: Mission,
    reference: Ephemeris,
    windows: Sequence[Window],
    begin: int,
    count: int,
    start: int,
    stop: int,
) -> PlanForecast:
    """Return the forecast of `count` steps from `begin` on."""
    step_ns = round(empty.step_s * NS)
    before = min((begin - reference.start.utc_ns) // step_ns, HISTORY_NS // step_ns)
    first = begin - before * step_ns
    middles = first + np.arange(before + count, dtype=np.int64) * step_ns + step_ns // 2
    grid = service.resource_grid(planner, mission, first, before + count, empty.step_s)
    options = {
        one.id: Option(one.start.utc_ns, one.stop.utc_ns, one.data_octets) for one in windows if one.stop.utc_ns > first
    }
    found = curves(grid, list(options.values()))
    at = planner.conditions(middles[before:])
    covered = begin == start and reference.stop.utc_ns >= stop
    known = " to ".join(format_utc(one.utc_ns, 0) for one in (reference.start, reference.stop))
    reason = None if covered else f"ephemeris {reference.name} covers {known}"
    return empty.model_copy(
        update={
            "reason": reason,
            "data": [f"ephemeris {reference.name}", f"orientation {planner.orientation.name}"],
            "time_s": _rounded(middles[before:] / NS, 0),
            "latitude_deg": _rounded(np.degrees(at.latitude_rad), 2),
            "longitude_deg": _rounded((np.degrees(at.longitude_rad) + 180.0) % 360.0 - 180.0, 2),
            "altitude_km": _rounded(at.altitude_m / 1e3, 2),
            "sun_elevation_deg": _rounded(np.degrees(at.sun_elevation_rad), 1),
            "sunlit": _rounded(at.sunlit, 2),
            "battery_share": _rounded(found.battery_wh[before:] / grid.battery_wh, 4),
            "stored_octets": np.rint(found.stored_octets[before:]).astype(np.int64).tolist(),
            "sent_octets": np.rint(found.sent_octets[before:]).astype(np.int64).tolist(),
            "downlink_octets": np.rint(grid.downlink_octets[before:]).astype(np.int64).tolist(),
            "conflicts": _overlaps(windows, _violations(grid, windows, options)),
        }
    )


def _rounded(values: FloatArray, digits: int) -> list[float]:
    rounded: list[float] = np.round(values, digits).tolist()
    return rounded


def _violations(grid: ResourceGrid, windows: Sequence[Window], options: dict[int, Option]) -> dict[int, str]:
    """Return the limit that each window breaks with those before it; windows that break one do not count further."""
    taken: list[Option] = []
    reasons: dict[int, str] = {}
    # Committed windows come before drafts.
    for window in sorted(windows, key=lambda one: (one.state == "draft", one.start.utc_ns, one.id)):
        option = options.get(window.id)
        if option is None or any(
            option.start_utc_ns < one.stop_utc_ns and one.start_utc_ns < option.stop_utc_ns for one in taken
        ):
            continue
        reason = violation(grid, [*taken, option])
        if reason is None:
            taken.append(option)
        elif window.state == "draft" or window.state in COMMITTED:
            reasons[window.id] = reason
    return reasons


def _overlaps(windows: Sequence[Window], violations: dict[int, str]) -> list[WindowConflict]:
    """Return the conflicts of the windows: common times, and resources that are not available."""
    found = []
    for window in windows:
        reasons = [
            f"window {other.id} ({other.name}, {other.state}) covers part of the same time"
            for other in windows
            if other.id != window.id
            and other.start.utc_ns < window.stop.utc_ns
            and window.start.utc_ns < other.stop.utc_ns
        ]
        if window.id in violations:
            reasons.append(violations[window.id])
        if reasons:
            found.append(WindowConflict(window_id=window.id, reasons=reasons))
    return found


def crater_density(ground: Ground, spacecraft_id: int) -> CraterDensity:
    """Return the crater density of the catalogue of the mission description in force."""
    mission = ground.read(service.mission_of, spacecraft_id)
    low, high = DENSITY_DIAMETER_KM
    found = CraterDensity(source=None, reason=None, cell_deg=CELL_DEG, diameter_km=Span(min=low, max=high), rows=[])
    try:
        catalogue = catalogue_of(ground, mission)
    except InvalidInput as error:
        return found.model_copy(update={"reason": str(error)})
    rows = [list(row) for row in _density(_Counted(catalogue))]
    return found.model_copy(update={"source": catalogue.source, "rows": rows})


class _Counted:
    """A catalogue as a key of the cache: catalogues are kept in memory, so their identity is enough."""

    def __init__(self, catalogue: CraterCatalogue) -> None:
        self.catalogue = catalogue

    def __hash__(self) -> int:
        return hash((id(self.catalogue.diameter_m), len(self.catalogue)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Counted) and self.catalogue.diameter_m is other.catalogue.diameter_m


@functools.lru_cache(maxsize=4)
def _density(counted: _Counted) -> tuple[tuple[float, ...], ...]:
    """Return craters per 10,000 km2 in each cell; rows from south to north."""
    catalogue = counted.catalogue
    low, high = (1e3 * one for one in DENSITY_DIAMETER_KM)
    wanted = (catalogue.diameter_m >= low) & (catalogue.diameter_m <= high)
    latitude = np.degrees(catalogue.latitude_rad[wanted])
    longitude = (np.degrees(catalogue.longitude_rad[wanted]) + 180.0) % 360.0 - 180.0
    south, west = np.arange(-90.0, 90.1, CELL_DEG), np.arange(-180.0, 180.1, CELL_DEG)
    counts, _, _ = np.histogram2d(latitude, longitude, bins=(south, west))
    band_km2 = np.diff(np.sin(np.radians(south))) * (MOON_RADIUS_M / 1e3) ** 2 * np.radians(CELL_DEG)
    density = np.round(counts / band_km2[:, None] * _AREA_KM2, 2)
    return tuple(tuple(row) for row in density.tolist())
