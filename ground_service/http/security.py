"""Who calls, and what they may do."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Annotated, Any

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from ground_service.access.service import LOCAL_CALLER, Caller, authenticate, has_users
from ground_service.errors import Forbidden, NotAuthorised

VERIFIED_CALLER = "verified_caller"
"""Key in the request state for the user whose token was verified; absent without a verified token."""

_bearer = HTTPBearer(auto_error=False, description="Token given out by 'linna user add'")


def caller_of(
    request: Request, given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
) -> Caller:
    """The caller of a request: the owner of its token, or the local user of a service without users."""
    ground = request.app.state.ground
    if given is None:
        if request.app.state.open_without_users and not has_users(ground):
            request.state.caller = LOCAL_CALLER.name
            return LOCAL_CALLER
        raise NotAuthorised("expected a bearer token in the Authorization header, found none")
    caller = authenticate(ground, given.credentials)
    request.state.caller = caller.name
    setattr(request.state, VERIFIED_CALLER, caller.name)
    return caller


def requires(role: str) -> Callable[..., Coroutine[Any, Any, Caller]]:
    """A dependency that lets only callers of this role or a higher one pass."""

    async def check(caller: Annotated[Caller, Depends(caller_of)]) -> Caller:
        if not caller.may(role):
            raise Forbidden(f"{caller.name}: expected the role {role} or higher, found {caller.role}")
        return caller

    return check
