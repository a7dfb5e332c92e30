"""HTTP operations on payload builds, archives for replays, and regressions."""

import uuid
from typing import Annotated, Literal

from fastapi import Path, Query, Response

from ground_service.access.security import Operator, UploadOf, Viewer, add_list, idempotent_id
from ground_service.access.service import Caller
from ground_service.errors import Forbidden
from ground_service.ground import Ground
from ground_service.http.common import API_PREFIX, GroundOf, IdempotencyKey, Key, PassId, upload_body
from ground_service.http.requests import operations, problems
from ground_service.jobs.service import DispatcherOf, Job, enter_jobs, get_job
from ground_service.regression import archives as archive_service
from ground_service.regression import service, store
from ground_service.regression.builds import CURRENT, load_build, register_build
from ground_service.regression.documents import regression_junit
from ground_service.regression.gates.policy import read_policy
from ground_service.regression.jobs import compared, missing_replays
from ground_service.regression.model import (
    ArchiveChange,
    Build,
    Calibration,
    Comparison,
    KeptArchive,
    Pruned,
    Regression,
    RegressionRequest,
)
from ground_service.regression.pass_archives import keep_pass
from ground_service.store.files import StoredFile

UPLOAD_PATHS = (f"{API_PREFIX}/builds", f"{API_PREFIX}/regression-archives")

Digest = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$", description="Identity of the archive")]

regressions = operations("regression")


add_list(regressions, "/builds", store.list_builds)


@regressions.post("/builds", status_code=201, openapi_extra=upload_body("Zip file of a build"))
async def add_build(upload: UploadOf, ground: GroundOf, caller: Operator) -> Build:
    """Register a build: a zip with build.toml and the files that it names.

    The program of a build runs on this machine: only administrators may register one.
    """
    stored = await upload.stored()
    return await upload.run(_register, ground, stored, caller)


@regressions.post("/builds/current", status_code=201)
def add_current_build(ground: GroundOf, caller: Operator) -> Build:
    """Register the installed flight code with its own network and parameters."""
    digest = register_build(ground, load_build(CURRENT), actor=caller.name).digest
    return ground.read(store.get_build, digest)


@regressions.get("/regression-archives")
def list_kept_archives(ground: GroundOf, _: Viewer) -> list[KeptArchive]:
    """List the archives that are kept for replays, oldest first."""
    return archive_service.kept_archives(ground)


@regressions.post("/regression-archives", status_code=201, openapi_extra=upload_body("Zip file of a pass archive"))
async def keep_archive(upload: UploadOf, ground: GroundOf, _: Operator, pinned: bool = False) -> KeptArchive:
    """Keep a zipped pass archive for replays, after checking every hash in it."""
    stored = await upload.stored()

    def keep() -> KeptArchive:
        kept = archive_service.keep_archive(ground, stored.path, pinned=pinned)
        return archive_service.kept_archive(ground, kept.digest)

    return await upload.run(keep)


@regressions.post("/passes/{pass_id}/regression-archive", status_code=201, responses=problems(404))
def keep_pass_archive(ground: GroundOf, _: Operator, pass_id: PassId, pinned: bool = False) -> KeptArchive:
    """Keep the regression archive of a pass: its received data, and the inputs of the payload if they are known."""
    return keep_pass(ground, pass_id, pinned=pinned)


@regressions.post("/regression-archives/{digest}/frames", status_code=202, responses=problems(404))
def render_kept_archive(ground: GroundOf, _: Operator, dispatcher: DispatcherOf, digest: Digest) -> Job:
    """Render the missing frames of a kept archive as a job, and compare them with the recorded hashes."""
    archive_service.kept_archive(ground, digest)
    return ground.read(get_job, dispatcher.submit("rendering", {"digest": digest}))


@regressions.patch("/regression-archives/{digest}")
def change_kept_archive(ground: GroundOf, _: Operator, digest: Digest, given: ArchiveChange) -> KeptArchive:
    """Change whether a kept archive is pinned."""
    archive_service.pin_archive(ground, digest, given.pinned)
    return archive_service.kept_archive(ground, digest)


@regressions.delete("/regression-archives")
def delete_kept_archives(
    ground: GroundOf,
    caller: Operator,
    unused_days: Annotated[float, Query(ge=0.0, le=36_500.0, description="Remove archives unused for this time")],
) -> Pruned:
    """Delete kept archives that are not pinned and were not used for a time."""
    unused_for_ns = round(unused_days * 86_400e9)
    return Pruned(removed=archive_service.let_go(ground, unused_for_ns=unused_for_ns, actor=caller.name))


@regressions.post("/regressions", status_code=202, responses=problems(404))
def start_regression(
    response: Response,
    ground: GroundOf,
    caller: Operator,
    dispatcher: DispatcherOf,
    request: RegressionRequest,
    idempotency_key: IdempotencyKey = None,
) -> Job:
    """Compare a candidate build with a baseline: a job for every missing replay, and one for the verdict."""
    identity = idempotent_id("regression", caller, idempotency_key) or uuid.uuid4().hex
    if request.policy is not None:
        read_policy(request.policy.encode(), request.policy_name)
    arguments = {
        **compared(ground, request),
        "policy": request.policy,
        **request.model_dump(include={"policy_name", "placebo", "repeat_baseline"}),
    }
    in_one_job = request.workers or request.placebo or request.repeat_baseline
    missing = [] if in_one_job else missing_replays(ground, arguments)
    replays = {f"{one['archive']} {one['build']}": one for one in missing}
    for job in enter_jobs(ground, replays, "regression", arguments, identity):
        dispatcher.start(job)
    response.headers["Location"] = f"{API_PREFIX}/regressions/{identity}"
    return ground.read(get_job, identity)


@regressions.post("/analyses", status_code=202, responses=problems(404))
def start_analysis(
    response: Response,
    ground: GroundOf,
    caller: Operator,
    dispatcher: DispatcherOf,
    request: Comparison,
    idempotency_key: IdempotencyKey = None,
) -> Job:
    """Return the metrics of one build (candidate and baseline alike) as a job, without a verdict."""
    job_id = idempotent_id("analysis", caller, idempotency_key)
    job = dispatcher.submit("analysis", compared(ground, request), job_id=job_id)
    response.headers["Location"] = f"{API_PREFIX}/jobs/{job}"
    return ground.read(get_job, job)


add_list(regressions, "/regressions", store.list_regressions)


@regressions.get("/calibrations")
def list_calibrations(ground: GroundOf, _: Viewer) -> list[Calibration]:
    """Return the noise of each metric in placebos, and whether its gate is calibrated."""
    return service.calibrations_of(ground)


@regressions.get("/regressions/{regression_id}")
def get_regression(ground: GroundOf, _: Viewer, regression_id: Key) -> Regression:
    """Show the verdict of a regression."""
    return ground.read(store.get_regression, regression_id)


@regressions.get(
    "/regressions/{regression_id}/report",
    response_class=Response,
    responses={200: {"content": {"text/html": {}, "application/xml": {}}, "description": "The report"}},
)
def get_regression_report(
    ground: GroundOf, _: Viewer, regression_id: Key, format: Literal["html", "junit"] = "html"
) -> Response:
    """Return the report of a regression as HTML, or its verdict as JUnit XML."""
    if format == "junit":
        found = ground.read(store.get_regression, regression_id)
        return Response(regression_junit(found.result, found.created.utc_ns), media_type="application/xml")
    return Response(service.report_of(ground, regression_id), media_type="text/html; charset=utf-8")


def _register(ground: Ground, stored: StoredFile, caller: Caller) -> Build:
    with archive_service.opened_archive(stored.path) as folder:
        build = load_build(folder)
        if build.command and not caller.may("admin"):
            raise Forbidden(f"{caller.name}: expected the role admin to register a program, found {caller.role}")
        register_build(ground, build, actor=caller.name)
    return ground.read(store.get_build, build.digest)
