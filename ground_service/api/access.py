"""Operations on users, tokens and the audit log."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Response
from pydantic import Field

from ground_service.access import audit_log
from ground_service.access import service as users
from ground_service.errors import InvalidInput
from ground_service.http import schemas
from ground_service.http.common import (
    API_PREFIX,
    PROBLEMS,
    Admin,
    GroundOf,
    Limit,
    Offset,
    Operator,
    RowId,
    page_of,
)
from ground_service.http.model import Given, Schema
from ground_service.http.requests import StrictRoute
from ground_service.http.times import time_of

access = APIRouter(route_class=StrictRoute, prefix=API_PREFIX, responses=PROBLEMS)

Role = Literal["viewer", "operator", "admin"]
UserName = Annotated[str, Path(pattern=r"^[A-Za-z0-9][A-Za-z0-9._@-]{0,63}$")]
Words = Annotated[str | None, Query(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")]
Days = Annotated[
    float | None,
    Field(
        default=None, gt=0.0, le=users.DAYS_LIMIT, allow_inf_nan=False, description="null: unlimited validity"
    ),
]


class NewUser(Given):
    """User to add."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._@-]{0,63}$", examples=["ann"])
    role: Role
    days_valid: Days


class UserChange(Given):
    """Change of the state or role of a user, or both."""

    state: Literal["active", "disabled"] | None = None
    role: Role | None = None


class NewToken(Given):
    """Token to create."""

    days_valid: Days
    revoke_others: bool = Field(default=False, description="Revoke all earlier tokens of the user")


class UserWithToken(Schema):
    """User and new token; the token cannot be read again."""

    user: users.User
    token: str


@access.get("/users", response_model=schemas.PageOf[users.User])
def list_users(ground: GroundOf, _: Admin) -> Any:
    """List all users."""
    found = users.list_users(ground)
    return page_of(found, len(found), max(len(found), 1), 0)


@access.post("/users", status_code=201, response_model=UserWithToken)
def add_user(ground: GroundOf, caller: Admin, given: NewUser) -> Any:
    """Add a user; the response contains the token, which cannot be read again."""
    token = users.add_user(ground, given.name, given.role, days_valid=given.days_valid, actor=caller.name)
    return UserWithToken(user=users.get_user(ground, given.name), token=token)


@access.get("/users/{name}", response_model=users.User)
def get_user(ground: GroundOf, _: Admin, name: UserName) -> Any:
    """Show one user."""
    return users.get_user(ground, name)


@access.patch("/users/{name}", response_model=users.User)
def change_user(ground: GroundOf, caller: Admin, name: UserName, given: UserChange) -> Any:
    """Disable or enable a user, or change the role; 409 states the conflicting state."""
    return users.change_user(ground, name, state=given.state, role=given.role, actor=caller.name)


@access.post("/users/{name}/tokens", status_code=201, response_model=UserWithToken)
def add_token(ground: GroundOf, caller: Admin, name: UserName, given: NewToken) -> Any:
    """Create a token for a user; the response contains it, and it cannot be read again."""
    make = users.renew_token if given.revoke_others else users.add_token
    token = make(ground, name, days_valid=given.days_valid, actor=caller.name)
    return UserWithToken(user=users.get_user(ground, name), token=token)


@access.get("/tokens", response_model=schemas.PageOf[users.Token])
def list_tokens(ground: GroundOf, _: Admin, user: Words = None) -> Any:
    """List tokens without their secrets, newest first."""
    found = users.list_tokens(ground, user)
    return page_of(found, len(found), max(len(found), 1), 0)


@access.delete("/tokens/{token_id}", status_code=204, response_class=Response)
def revoke_token(ground: GroundOf, caller: Admin, token_id: RowId) -> None:
    """Revoke a token."""
    users.revoke_token(ground, token_id, actor=caller.name)


@access.get("/audit", response_model=schemas.PageOf[audit_log.AuditEntry])
def list_audit(
    ground: GroundOf,
    _: Operator,
    actor: Words = None,
    action: Words = None,
    target: Words = None,
    since: Annotated[str | None, Query(max_length=40, description="RFC 3339 UTC")] = None,
    until: Annotated[str | None, Query(max_length=40, description="RFC 3339 UTC, exclusive")] = None,
    limit: Limit = 100,
    offset: Offset = 0,
) -> Any:
    """List the audit entries, newest first: actor, time, action and target."""
    times = [
        None if text is None else time_of(text, where) for text, where in ((since, "since"), (until, "until"))
    ]
    if times[0] is not None and times[1] is not None and times[0] > times[1]:
        raise InvalidInput("audit", "until", f"a time after {since}", str(until))
    found, total = audit_log.list_entries(
        ground,
        actor=actor,
        action=action,
        target=target,
        since_utc_ns=times[0],
        until_utc_ns=times[1],
        limit=limit,
        offset=offset,
    )
    return page_of(found, total, limit, offset)


@access.get("/audit/head", response_model=audit_log.AuditHead)
def get_audit_head(ground: GroundOf, _: Operator) -> Any:
    """Show number and hash of the newest entry, to be stored elsewhere."""
    return audit_log.audit_head(ground)
