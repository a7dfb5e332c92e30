"""Spacecraft that an operation concerns: one declaration for all operations, for callers limited to missions.

Most decisions follow from the parameters: the spacecraft, or the row of a table that belongs to one. The sets below are
the decisions that do not. An operation without a decision is refused to a limited caller.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Literal

from fastapi import Request
from fastapi.routing import APIRoute

from ground_service.access.service import Caller
from ground_service.access.store import Owner, owner_of
from ground_service.errors import Forbidden
from ground_service.http.requests import query_keys

Decision = Literal["all", "list", "content", "service", "spacecraft"]

ALL = {
    "start_session", "get_session", "end_session", "get_status", "list_export_formats", "list_jobs",
    "get_job", "list_ephemerides", "list_catalogues", "add_catalogue", "list_builds", "moon_map",
}  # fmt: skip
"""Operations that concern no spacecraft: documents and data products that all missions share, and progress of jobs."""

LISTS = {
    "list_passes", "list_ingests", "list_monthly_reports", "list_landmarks", "list_missions",
    "list_windows", "list_requests", "list_telecommands", "list_alarms",
    "list_handovers", "list_implausible", "list_spacecraft", "list_links", "list_contacts",
}  # fmt: skip
"""Lists from which the rows of other spacecraft are left out."""

CONTENT = {"add_ephemeris", "withdraw_ephemeris", "add_mission", "check_mission"}
"""Operations whose content states the spacecraft; their use cases ask `Caller.may_use`."""

SERVICE = {
    "upload_archive", "repeat_job", "delete_job", "withdraw_catalogue", "add_build",
    "add_current_build", "list_kept_archives", "keep_archive", "render_kept_archive", "change_kept_archive",
    "delete_kept_archives", "start_regression", "start_analysis", "list_regressions", "list_calibrations",
    "get_regression", "get_regression_report", "regression_page", "list_users", "add_user", "get_user", "change_user",
    "add_token", "list_tokens", "revoke_token", "list_audit", "get_audit_head",
}  # fmt: skip
"""Operations that concern the whole service, or passes of any mission."""

DECIDED: dict[Decision, set[str]] = {"all": ALL, "list": LISTS, "content": CONTENT, "service": SERVICE}

ROWS: dict[str, tuple[Owner, ...]] = {
    "pass_id": ("passes",),
    "window_id": ("windows",),
    "request_id": ("standing_requests",),
    "command_id": ("telecommands",),
    "alarm_id": ("alarms",),
    "ingest_id": ("ingests",),
    "landmark_id": ("landmarks",),
    "report_id": ("reports", "monthly_reports"),
    "revision": ("missions",),
    "name": ("links",),
}
"""Tables of the rows that parameters name; the name of anything but a link is in an operation of the sets."""

SPACECRAFT = "spacecraft_id"


@dataclass(frozen=True, slots=True)
class Scope:
    """Decision of an operation, and the place and name of the parameter that it depends on."""

    decision: Decision
    place: Literal["", "path", "query", "body"] = ""
    parameter: str = ""


def scope_of(route: APIRoute) -> Scope | None:
    """Return the decision of an operation; None without one."""
    for decision, names in DECIDED.items():
        if route.name in names:
            return Scope(decision)
    dependant = route.dependant
    body = {name for one in dependant.body_params for name in getattr(one.field_info.annotation, "model_fields", ())}
    places: tuple[tuple[Literal["path", "query", "body"], Collection[str]], ...] = (
        ("path", [one.name for one in dependant.path_params]),
        ("query", query_keys(dependant).known),
        ("body", body),
    )
    for place, found in places:
        for name in (SPACECRAFT, *ROWS):
            if name in found:
                return Scope("spacecraft", place, name)
    return None


def check_scope(request: Request, caller: Caller) -> None:
    """Check that an operation concerns only spacecraft of a caller.

    Raises
    ------
    Forbidden
        It concerns another spacecraft, or does not state one; the whole service; or has no decision.
    """
    if caller.missions is None:
        return
    scope = scope_of(request.scope["route"])
    if scope is not None and scope.decision in ("all", "list", "content"):
        return
    missions = ", ".join(caller.missions) or "none"
    expected = f"{caller.name}: expected a spacecraft of the missions {missions}"
    if scope is None or scope.decision == "service":
        raise Forbidden(f"{expected}, found an operation of the whole service")
    values = [one for one in _values(request, scope) if one is not None]
    if not values:
        raise Forbidden(f"{expected} as {scope.parameter}, found none")
    for value in values:
        if scope.parameter == SPACECRAFT:
            owner = int(value) if str(value).isdecimal() else None
        else:
            owner = request.app.state.ground.read(owner_of, ROWS[scope.parameter], value)
        if not caller.may_use(owner):
            raise Forbidden(f"{expected}, found {scope.parameter} {str(value)[:80]} of another one")


def _values(request: Request, scope: Scope) -> list[Any]:
    if scope.place == "path":
        return [request.path_params.get(scope.parameter)]
    if scope.place == "query":
        return request.query_params.getlist(scope.parameter)
    body = getattr(request, "_json", None)
    return [body.get(scope.parameter)] if isinstance(body, dict) else []
