"""`linna plan`: search, planning, approval and uplink of observation windows, and standing requests."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from linna.commands._table import Command, Commands, Group, Option, as_json
from linna.errors import UsageError

if TYPE_CHECKING:
    from ground_service.client import Client
    from ground_service.planning.model import RequestPlan, SearchResult, StandingRequest, Window

Limits = tuple[float, float] | None
RANGE = ("MIN", "MAX")


def _stated(**request: Any) -> dict[str, Any]:
    """Return the values that are stated, limits by name."""
    return {
        name: {"min": value[0], "max": value[1]} if isinstance(value, list) else value
        for name, value in request.items()
        if value is not None
    }


def _search(
    service: Client,
    *,
    start: str | None = None,
    stop: str | None = None,
    ephemeris_id: int | None = None,
    spacecraft_id: int | None = None,
    altitude_km: Limits = None,
    sun_elevation_deg: Limits = None,
    latitude_deg: Limits = None,
    craters_per_frame: float | None = None,
    terrain: Literal["mare", "highland"] | None = None,
    sunlit: bool = False,
    minimum_duration_s: float | None = None,
    maximum_duration_s: float | None = None,
    first_coast_m: float | None = None,
    minimum_battery: float | None = None,
    needs_contact: bool = False,
    cadence_s: float | None = None,
    step_s: float | None = None,
) -> SearchResult:
    return service.search_windows(_stated(**{k: v for k, v in locals().items() if k != "service"}))


def _add(
    service: Client,
    *,
    start: str,
    stop: str,
    spacecraft_id: int,
    instance: str = "flight",
    name: str = "observation",
    cadence_s: float = 15.0,
    after: int | None = None,
    approve: bool = False,
) -> Window:
    request = {
        "name": name,
        "start": start,
        "stop": stop,
        "cadence_s": cadence_s,
        "spacecraft_id": spacecraft_id,
        "instance": instance,
        "predecessor_id": after,
    }
    window = service.add_window(request)
    return service.change_window(window.id, {"state": "approved"}) if approve else window


def _fail(service: Client, window_id: int, *, reason: str) -> Window:
    return service.change_window(window_id, {"state": "failed", "reason": reason})


def _delete(service: Client, window_id: int) -> dict[str, Any]:
    service.delete_window(window_id)
    return {"deleted": window_id}


def _uplink(service: Client, window_id: int, *, out: Path | None = None) -> dict[str, Any]:

    released = service.uplink_window(window_id)
    if out is not None:
        window = service.get_window(window_id)
        octets = service.take_uplink(window.spacecraft_id, instance=window.instance).octets
        if not octets:
            states = ", ".join(sorted({one.state for one in released})) or "none"
            raise UsageError(f"window {window_id}: nothing to send: its telecommands are {states}; no file is written")
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(octets)
    return {"window_id": window_id, "telecommands": [as_json(one) for one in released]}


def _add_request(
    service: Client,
    *,
    name: str,
    spacecraft_id: int,
    instance: str = "flight",
    windows: int,
    period_days: float = 7.0,
    horizon_days: float = 3.0,
    sun: Limits = None,
    altitude: Limits = None,
    latitude: Limits = None,
    longitude: Limits = None,
    duration: Limits = None,
    minimum_battery: float | None = None,
) -> StandingRequest:
    west, east = longitude or (None, None)
    shortest, longest = duration or (None, None)
    region = _stated(latitude_deg=latitude, west_deg=west, east_deg=east)
    request = _stated(
        name=name,
        spacecraft_id=spacecraft_id,
        instance=instance,
        windows=windows,
        period_days=period_days,
        horizon_days=horizon_days,
        sun_elevation_deg=sun,
        altitude_km=altitude,
        minimum_duration_s=shortest,
        maximum_duration_s=longest,
        minimum_battery=minimum_battery,
    )
    return service.add_request(request | ({"regions": [region]} if region else {}))


def _delete_request(service: Client, request_id: int) -> dict[str, Any]:
    service.delete_request(request_id)
    return {"deleted": request_id}


def _candidates(found: SearchResult) -> str:
    lines = [
        f"{one.start[:19]}Z  {one.stop[:19]}Z  {one.frames:>4} frames  "
        f"{one.altitude_km.min:.1f} to {one.altitude_km.max:.1f} km  "
        f"Sun {one.sun_elevation_deg.min:.0f} to {one.sun_elevation_deg.max:.0f} deg"
        for one in found.candidates
    ]
    last = found.reason or f"{len(found.candidates)} candidates; data: {'; '.join(found.data)}"
    return "\n".join([*lines, last])


def _window(window: Window) -> str:
    reason = f" ({window.reason})" if window.reason else ""
    return f"{window.id:>4}  {window.start[:19]}Z  {window.stop[:19]}Z  {window.state}{reason}  {window.name}"


def _released(made: dict[str, Any]) -> str:
    return "\n".join(f"telecommand {one['id']} ({one['name']}): {one['state']}" for one in made["telecommands"])


def _request(one: StandingRequest) -> str:
    states = ", ".join(f"{number} {state}" for state, number in one.windows.items()) or "no windows yet"
    return f"{one.id:>4}  {one.state:<7} {one.name}: {one.terms.windows} in {one.terms.period_days:g} days; {states}"


def _request_plan(plan: RequestPlan) -> str:
    lines = [plan.reason] if plan.reason else []
    for one in plan.candidates:
        outcome = f"window {one.window_id}" if one.window_id is not None else f"rejected: {one.reason}"
        lines.append(f"{one.start}  {one.stop}  {outcome}")
    lines += [f"window {one['window_id']} failed: {one['reason']}" for one in plan.replaced]
    return "\n".join(lines) or "no candidates"


def _request_state(found: StandingRequest) -> str:
    return f"standing request {found.id}: {found.state}"


REQUESTS: Commands = {
    "add": Command(
        _add_request,
        "add a standing request",
        _request_state,
        options={
            "windows": "windows in each period",
            "period_days": Option(metavar="D"),
            "horizon_days": Option("days ahead", "D"),
            "sun": Option("Sun elevation, degrees", RANGE),
            "altitude": Option("altitude, km", RANGE),
            "latitude": Option("latitude, degrees", RANGE),
            "longitude": Option("degrees, to the east", ("WEST", "EAST")),
            "duration": Option("duration, seconds", RANGE),
            "minimum_battery": Option("share of its capacity (default: 0.3)", "SHARE"),
        },
    ),
    "list": Command(
        "list_requests",
        "list the standing requests, newest first",
        _request,
        "requests",
        "no standing requests",
        limit=None,
    ),
    "plan": Command("get_request_plan", "show the candidates of the last plan with the reasons", _request_plan),
    "pause": Command(
        "change_request", "plan no further windows", _request_state, preset={"change": {"state": "paused"}}
    ),
    "resume": Command("change_request", "plan windows again", _request_state, preset={"change": {"state": "active"}}),
    "delete": Command(
        _delete_request,
        "delete a standing request; its windows stay",
        lambda made: f"request {made['deleted']} deleted",
    ),
}
PLAN: Commands = {
    "withdraw": Command("withdraw_ephemeris", "withdraw a reference ephemeris", lambda _: "withdrawn"),
    "ephemeris": Command(
        "add_ephemeris",
        "add a reference ephemeris (OEM, STK .e, Horizons CSV)",
        lambda made: f"ephemeris {made.id} ({made.name}): {made.start} to {made.stop}",
    ),
    "search": Command(
        _search,
        "search candidate windows over a reference ephemeris",
        _candidates,
        options={
            "start": "default: start of the ephemeris",
            "stop": "default: end of the ephemeris",
            "spacecraft_id": "consider the data that this spacecraft has already stored",
            "altitude_km": Option(metavar=RANGE),
            "sun_elevation_deg": Option(metavar=RANGE),
            "latitude_deg": Option(metavar=RANGE),
            "first_coast_m": "1 sigma along the track that the coast after a first window may end with",
            "craters_per_frame": Option("minimum number of catalogued craters in a frame", "N"),
            "sunlit": "require that the spacecraft is in full sunlight",
            "minimum_battery": Option(metavar="SHARE"),
            "needs_contact": "require that the data are downlinked within the time span",
        },
    ),
    "add": Command(
        _add,
        "enter a window as a draft",
        _window,
        options={"after": Option("window that must precede this one", "ID"), "approve": "approve the window as well"},
    ),
    "list": Command("list_windows", "list planned windows, newest first", _window, "windows", "no windows", limit=100),
    "show": Command("get_window", "show a window", _window),
    "approve": Command("change_window", "approve a draft", _window, preset={"change": {"state": "approved"}}),
    "draft": Command(
        "change_window", "return a window to the state draft", _window, preset={"change": {"state": "draft"}}
    ),
    "fail": Command(_fail, "mark a window as failed", _window),
    "delete": Command(_delete, "remove a window from the plan", lambda made: f"window {made['deleted']}: deleted"),
    "uplink": Command(
        _uplink,
        "release the time-tagged telecommands of a window",
        _released,
        options={"out": "write all released telecommands as CLTUs; they count as sent"},
    ),
    "preview": Command(
        "get_planned_telecommands",
        "show the telecommands that an uplink of a window would release",
        lambda one: f"{one.time or 'on reception':<27}  {one.name}  {one.text}".rstrip(),
        "telecommands",
        "none",
    ),
    "request": Group("standing requests, which the planner keeps in the plan", REQUESTS),
}
