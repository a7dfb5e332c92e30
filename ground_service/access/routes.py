"""HTTP operations on users, tokens and the audit log."""

from typing import Annotated

from fastapi import Path, Query, Request, Response

from ground_service.access import model, store
from ground_service.access import service as users
from ground_service.access.security import SESSION_COOKIE, Admin, Operator, Viewer
from ground_service.errors import InvalidInput
from ground_service.http.common import GroundOf, RowId, linked
from ground_service.http.model import PageOf
from ground_service.http.requests import operations, problems

access = operations("access")

UserName = Annotated[str, Path(pattern=model.USER_NAME)]


_LONGEST_TOKEN = model.NewToken.model_validate({})


@access.post("/session", responses=problems(401))
def start_session(request: Request, response: Response, ground: GroundOf, given: model.NewSession) -> model.Session:
    """Start a browser session with a token; the response sets its cookie."""
    secret, session = users.start_session(ground, given.token)
    response.set_cookie(
        SESSION_COOKIE,
        secret,
        max_age=users.SESSION_NS // 1_000_000_000,
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return session


@access.get("/session")
def get_session(request: Request, ground: GroundOf, caller: Viewer) -> model.Session:
    """Show the user of this request, the role, and the end of the validity."""
    return users.session_of(ground, caller, browser=_by_cookie(request))


@access.delete("/session", status_code=204, response_class=Response)
def end_session(request: Request, ground: GroundOf, caller: Viewer) -> Response:
    """End the browser session of this request; tokens in headers are not revoked."""
    if _by_cookie(request):
        users.end_session(ground, caller)
    response = Response(status_code=204)
    response.delete_cookie(SESSION_COOKIE, httponly=True, samesite="strict")
    return response


def _by_cookie(request: Request) -> bool:
    return "authorization" not in request.headers and SESSION_COOKIE in request.cookies


@access.get("/users")
def list_users(ground: GroundOf, _: Admin) -> PageOf[model.User]:
    """List all users."""
    return PageOf.all_of(users.list_users(ground))


@access.post("/users", status_code=201, responses=problems(409))
def add_user(ground: GroundOf, caller: Admin, given: model.NewUser) -> model.UserWithToken:
    """Add a user; the response contains the token, which cannot be read again."""
    token = users.add_user(
        ground, given.name, given.role, days_valid=given.days_valid, missions=given.missions, actor=caller.name
    )
    return model.UserWithToken(user=users.get_user(ground, given.name), token=token)


@access.get("/users/{name}")
def get_user(ground: GroundOf, _: Admin, name: UserName) -> model.User:
    """Show one user."""
    return users.get_user(ground, name)


@access.patch("/users/{name}", responses=problems(409))
def change_user(ground: GroundOf, caller: Admin, name: UserName, given: model.UserChange) -> model.User:
    """Disable or enable a user, or change the role or missions; 409 states the conflicting state."""
    return users.change_user(
        ground, name, state=given.state, role=given.role, missions=given.missions, actor=caller.name
    )


@access.post("/users/{name}/tokens", status_code=201)
def add_token(
    ground: GroundOf, caller: Admin, name: UserName, given: model.NewToken = _LONGEST_TOKEN
) -> model.UserWithToken:
    """Create a token for a user; the response contains it, and it cannot be read again."""
    token = users.add_token(
        ground,
        name,
        days_valid=given.days_valid,
        missions=given.missions,
        revoke_others=given.revoke_others,
        actor=caller.name,
    )
    return model.UserWithToken(user=users.get_user(ground, name), token=token)


@access.get("/tokens", responses=problems(404))
def list_tokens(ground: GroundOf, _: Admin, user: model.Words | None = None) -> PageOf[model.Token]:
    """List tokens without their secrets, newest first."""
    return PageOf.all_of(users.list_tokens(ground, user))


@access.delete("/tokens/{token_id}", status_code=204, response_class=Response, responses=problems(409))
def revoke_token(ground: GroundOf, caller: Admin, token_id: RowId) -> None:
    """Revoke a token."""
    users.revoke_token(ground, token_id, actor=caller.name)


@access.get("/audit")
def list_audit(
    ground: GroundOf, _: Operator, request: Request, asked: Annotated[model.AuditFilter, Query()]
) -> PageOf[model.AuditEntry]:
    """List the audit entries, newest first: actor, time, action and target."""
    if asked.since is not None and asked.until is not None and asked.since.utc_ns > asked.until.utc_ns:
        raise InvalidInput("audit", "until", f"a time after {asked.since}", str(asked.until))
    return linked(request, ground.read(store.list_audit, asked))


@access.get("/audit/head")
def get_audit_head(ground: GroundOf, _: Operator) -> model.AuditHead:
    """Show number and hash of the newest entry, to be stored elsewhere."""
    return store.audit_head(ground)
