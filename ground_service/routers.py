"""Routers of the capabilities. They are imported when they are needed: all of them together take a second."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

from fastapi import APIRouter


@dataclass(frozen=True, slots=True)
class Router:
    """Router `name` in the module `module`; most of its operations are under the path `segment` of the API."""

    module: str
    name: str
    segment: str

    def imported(self) -> ModuleType:
        """Return the module."""
        return import_module(self.module)

    def load(self) -> APIRouter:
        """Return the router."""
        router: APIRouter = getattr(self.imported(), self.name)
        return router


OPERATIONS = (
    Router("ground_service.passes.routes", "passes", "passes"),
    Router("ground_service.ingest.routes", "ingests", "telemetry"),
    Router("ground_service.evaluation.routes", "evaluation", "reports"),
    Router("ground_service.evaluation.performance.routes", "reports", "monthly-reports"),
    Router("ground_service.evaluation.landmarks.routes", "landmarks", "landmarks"),
    Router("ground_service.exports.routes", "exports", "exports"),
    Router("ground_service.missions.ephemerides.routes", "ephemerides", "ephemerides"),
    Router("ground_service.jobs.routes", "jobs", "jobs"),
    Router("ground_service.missions.routes", "missions", "missions"),
    Router("ground_service.missions.timekeeping.routes", "timekeeping", "spacecraft"),
    Router("ground_service.planning.routes", "planning", "windows"),
    Router("ground_service.contacts.links.routes", "links", "links"),
    Router("ground_service.planning.routes", "requests", "requests"),
    Router("ground_service.contacts.commanding.routes", "telecommands", "telecommands"),
    Router("ground_service.passes.alarms.routes", "alarms", "alarms"),
    Router("ground_service.regression.routes", "regressions", "regressions"),
    Router("ground_service.access.routes", "access", "users"),
    Router("ground_service.worker.status_routes", "status", "status"),
)
"""Operations of the HTTP API."""
