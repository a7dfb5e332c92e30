"""The operations on payload builds, archives to fly again, and regressions under /api/v1."""

from __future__ import annotations

import uuid
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response
from pydantic import Field

from ground_service.access.service import Caller
from ground_service.api.routes import get_job
from ground_service.errors import Forbidden
from ground_service.ground import Ground
from ground_service.http import schemas
from ground_service.http.common import (
    API_PREFIX,
    PROBLEMS,
    GroundOf,
    IdempotencyKey,
    Key,
    Limit,
    Offset,
    Operator,
    Viewer,
    idempotent_id,
    page_of,
)
from ground_service.http.model import Given, Schema
from ground_service.http.requests import StrictRoute
from ground_service.http.uploads import UploadOf
from ground_service.http.views import time_text
from ground_service.jobs import enter_jobs
from ground_service.regression import archives as archive_service
from ground_service.regression.builds import load_build, register_build
from ground_service.regression.jobs import missing_replays, prepared
from ground_service.store import repository
from ground_service.store.files import StoredFile

REGRESSION_UPLOAD_PATHS = (f"{API_PREFIX}/builds", f"{API_PREFIX}/regression-archives")

Digest = Annotated[str, Path(pattern=r"^[0-9a-f]{8,64}$")]
_ZIP = {
    "requestBody": {
        "required": True,
        "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
    }
}

regressions = APIRouter(route_class=StrictRoute, prefix=API_PREFIX, responses=PROBLEMS)


class BuildOut(Schema):
    """A registered payload build."""

    digest: str
    name: str = Field(examples=["detector 7"])
    version: str = Field(examples=["1.2.0"])
    description: str
    kind: str = Field(description="command or flight", examples=["flight"])
    files: dict[str, str]
    flight_code: str | None
    provenance: dict[str, Any]
    registered_by: str
    registered: str


class ArchiveOut(Schema):
    """A pass archive kept to be flown again."""

    digest: str
    name: str
    frames: int
    octets: int
    pinned: bool
    kept_since: str


class RegressionRequest(Given):
    """Which builds to hold against each other, over which archives."""

    candidate: str = Field(
        pattern=r"^(current|[0-9a-f]{8,64})$", description="Identity of a build, or current"
    )
    baseline: str = Field(default="current", pattern=r"^(current|[0-9a-f]{8,64})$")
    archives: list[Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]] = Field(
        default_factory=list, max_length=1000, description="Identities of kept archives; all when empty"
    )


class RegressionOut(Schema):
    """The verdict on a candidate build."""

    id: str
    verdict: str = Field(description="pass, fail or inconclusive", examples=["pass"])
    created: str
    result: dict[str, Any] = Field(description="As printed by `linna regress run --json`")


class RegressionItem(Schema):
    """One line of the list of verdicts."""

    id: str
    verdict: str = Field(description="pass, fail or inconclusive", examples=["pass"])
    candidate: str = Field(description="Identity of the build that was judged")
    baseline: str = Field(description="Identity of the build it was held against")
    gates: int = Field(description="Gates that were judged")
    gates_failed: int
    gates_inconclusive: int
    frames: int = Field(description="Number of frames processed by both builds")
    frames_needed: int | None = Field(
        description="Number of frames needed to decide every gate over the suite; null if unknown"
    )
    created: str


@regressions.get("/builds", response_model=schemas.PageOf[BuildOut])
def list_builds(ground: GroundOf, _: Viewer, limit: Limit = 100, offset: Offset = 0) -> Any:
    """Registered builds, the newest first."""
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.BUILDS, limit=limit, offset=offset)
    return page_of([_build(row) for row in page.rows], page.total, limit, offset)


@regressions.post("/builds", status_code=201, response_model=BuildOut, openapi_extra=_ZIP)
async def add_build(upload: UploadOf, ground: GroundOf, caller: Operator) -> BuildOut:
    """Register a build: a zip that holds build.toml and the files it names.

    A build that is a program is code to be run here: only administrators may register one.
    """
    stored = await upload.stored()
    return await upload.run(_register, ground, stored, caller)


@regressions.get("/regression-archives", response_model=list[ArchiveOut])
def list_archives(ground: GroundOf, _: Viewer) -> Any:
    """Archives that are kept to be flown again, the oldest first."""
    return [_archive(row) for row in archive_service.kept_archives(ground)]


@regressions.post("/regression-archives", status_code=201, response_model=ArchiveOut, openapi_extra=_ZIP)
async def add_archive(upload: UploadOf, ground: GroundOf, _: Operator, pinned: bool = False) -> ArchiveOut:
    """Keep a zipped pass archive, after checking every hash in it."""
    stored = await upload.stored()

    def keep() -> ArchiveOut:
        kept = archive_service.keep_archive(ground, stored.path, pinned=pinned)
        with ground.database.reading() as connection:
            return _archive(
                repository.get(connection, repository.REGRESSION_ARCHIVES, kept.digest, "archive")
            )

    return await upload.run(keep)


@regressions.post("/regressions", status_code=202, response_model=schemas.Job)
def start_regression(
    request: Request,
    response: Response,
    ground: GroundOf,
    caller: Operator,
    given: RegressionRequest,
    idempotency_key: IdempotencyKey = None,
) -> Any:
    """Hold a candidate against a baseline: a job for every replay that is missing, and one for the verdict."""
    identity = idempotent_id("regression", caller, idempotency_key) or uuid.uuid4().hex
    arguments = prepared(ground, given.candidate, given.baseline, given.archives)
    replays = {f"{one['archive']} {one['build']}": one for one in missing_replays(ground, arguments)}
    for job in enter_jobs(ground, replays, "regression", arguments, identity):
        request.app.state.dispatcher.start(job)
    response.headers["Location"] = f"{API_PREFIX}/regressions/{identity}"
    return get_job(ground, caller, identity)


@regressions.get("/regressions", response_model=schemas.PageOf[RegressionItem])
def list_regressions(ground: GroundOf, _: Viewer, limit: Limit = 100, offset: Offset = 0) -> Any:
    """Verdicts, the newest first."""
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.REGRESSIONS, limit=limit, offset=offset)
    items = [
        RegressionItem(
            id=row["id"],
            verdict=row["verdict"],
            candidate=row["candidate_digest"],
            baseline=row["baseline_digest"],
            gates=len(row["result"]["gates"]),
            gates_failed=_count(row, "fail"),
            gates_inconclusive=_count(row, "inconclusive"),
            frames=row["result"]["frames"],
            frames_needed=row["result"]["frames_needed"],
            created=time_text(row["created_utc_ns"]),
        )
        for row in page.rows
    ]
    return page_of(items, page.total, limit, offset)


@regressions.get("/regressions/{regression_id}", response_model=RegressionOut)
def get_regression(ground: GroundOf, _: Viewer, regression_id: Key) -> RegressionOut:
    """A verdict."""
    with ground.database.reading() as connection:
        row = repository.get(connection, repository.REGRESSIONS, regression_id, "regression")
    return RegressionOut(
        id=row["id"],
        verdict=row["verdict"],
        created=time_text(row["created_utc_ns"]),
        result=row["result"],
    )


@regressions.get("/regressions/{regression_id}/report", response_class=Response)
def get_regression_report(ground: GroundOf, _: Viewer, regression_id: Key) -> Response:
    """The report of a regression as HTML."""
    with ground.database.reading() as connection:
        row = repository.get(connection, repository.REGRESSIONS, regression_id, "regression")
    return Response(ground.files.get(row["html_sha256"]), media_type="text/html; charset=utf-8")


def _register(ground: Ground, stored: StoredFile, caller: Caller) -> BuildOut:
    with archive_service.opened_archive(stored.path) as folder:
        build = load_build(folder)
        if build.command and not caller.may("admin"):
            raise Forbidden(
                f"{caller.name}: expected the role admin to register a program, found {caller.role}"
            )
        register_build(ground, build, actor=caller.name)
    with ground.database.reading() as connection:
        return _build(repository.get(connection, repository.BUILDS, build.digest, "build"))


def _count(row: repository.Row, outcome: str) -> int:
    """Return the number of gates with this outcome that are not waived."""
    return sum(gate["outcome"] == outcome and not gate["waived"] for gate in row["result"]["gates"])


def _build(row: repository.Row) -> BuildOut:
    names = (
        "digest",
        "name",
        "version",
        "description",
        "kind",
        "files",
        "flight_code",
        "provenance",
        "registered_by",
    )
    return BuildOut(**{name: row[name] for name in names}, registered=time_text(row["created_utc_ns"]))


def _archive(row: repository.Row) -> ArchiveOut:
    return ArchiveOut(
        digest=row["digest"],
        name=row["name"],
        frames=row["frames"],
        octets=row["octets"],
        pinned=bool(row["pinned"]),
        kept_since=time_text(row["created_utc_ns"]),
    )
