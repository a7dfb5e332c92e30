"""Sign-in with an OpenID provider: to the provider and back, and sign-out that the provider announces.

The session cookie is `SameSite=Strict`, and a browser does not send such a cookie along a chain of redirects that began
at another site. The answer to the provider is therefore a page of this service, which opens the next page itself.
"""

import logging
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.responses import RedirectResponse

from ground_service.access import service as users
from ground_service.access.provider import (
    SIGN_IN_S,
    PendingSignIn,
    Provider,
    end_provider_sessions,
    own_page,
    start_provider_session,
)
from ground_service.access.security import SESSION_COOKIE
from ground_service.errors import GroundError, NotFound, ProviderUnavailable, SignInRefused
from ground_service.web.pages import page_response, sign_in_page

log = logging.getLogger(__name__)

CALLBACK = "/sign-in/callback"

sign_in = APIRouter(include_in_schema=False)

Words = Annotated[str, Query(max_length=4096)]


@sign_in.get("/sign-in/provider")
async def begin_sign_in(request: Request, next: Words = "/") -> Response:
    """Send the browser to the provider."""
    begun = PendingSignIn.new(next)
    try:
        place = await _provider(request).begin(begun, _own(request, CALLBACK))
    except ProviderUnavailable as error:
        return _refused(error)
    response = RedirectResponse(place, status_code=303)
    response.headers["Cache-Control"] = "no-store"
    response.set_cookie(
        _cookie(request), begun.cookie(), max_age=SIGN_IN_S, httponly=True, samesite="lax", secure=_safe(request)
    )
    return response


@sign_in.get(CALLBACK)
async def complete_sign_in(
    request: Request, state: Words = "", code: Words = "", iss: Words | None = None, error: Words = ""
) -> Response:
    """Start the session of somebody whom the provider has sent back."""
    provider = _provider(request)
    try:
        begun = PendingSignIn.of_cookie(request.cookies.get(_cookie(request)), state)
        if error or not code:
            raise SignInRefused("answer of the provider", "a code", repr(error)[:80] if error else "none")
        who = await provider.complete(begun, code, _own(request, CALLBACK), iss)
        secret, _ = await to_thread.run_sync(start_provider_session, request.app.state.ground, who, begun.state)
    except (SignInRefused, ProviderUnavailable) as refusal:
        return _without_cookie(request, _refused(refusal))
    response = page_response(sign_in_page(next_page=begun.next_page))
    response.headers["Cache-Control"] = "no-store"
    response.set_cookie(
        SESSION_COOKIE,
        secret,
        max_age=users.PROVIDER_SESSION_NS // 1_000_000_000,
        httponly=True,
        samesite="strict",
        secure=_safe(request),
    )
    return _without_cookie(request, response)


@sign_in.get("/sign-in/ended")
async def sign_in_ended(request: Request, next: Words = "/") -> Response:
    """Send a browser without a session to the provider to end its session there, then to a page of this service."""
    place = await _provider(request).sign_out_address(_own(request, "/"))
    return RedirectResponse(place or own_page(next), status_code=303)


@sign_in.post("/sign-in/provider-sign-out", status_code=200)
async def sign_out_by_provider(request: Request, logout_token: Annotated[str, Form(max_length=16384)]) -> Response:
    """End the sessions that the provider names (OpenID Connect Back-Channel Logout 1.0)."""
    provider = _provider(request)
    try:
        subject, session, identity = await provider.signed_out(logout_token)
        await to_thread.run_sync(
            end_provider_sessions, request.app.state.ground, provider.issuer, subject, session, identity
        )
    except SignInRefused as refusal:
        log.warning("sign-out by the provider refused: %s", refusal)
        return Response(status_code=400, headers={"Cache-Control": "no-store"})
    return Response(status_code=200, headers={"Cache-Control": "no-store"})


def _provider(request: Request) -> Provider:
    found: Provider | None = request.app.state.provider
    if found is None:
        raise NotFound("sign-in", "provider")
    return found


def _refused(error: GroundError) -> Response:
    log.warning("sign-in refused: %s", error)
    unavailable = isinstance(error, ProviderUnavailable)
    text = "The sign-in provider cannot be used now. Bearer tokens still work." if unavailable else str(error)
    response = page_response(sign_in_page(refusal=text))
    response.status_code = 503 if unavailable else 401
    response.headers["Cache-Control"] = "no-store"
    return response


def _without_cookie(request: Request, response: Response) -> Response:
    response.delete_cookie(_cookie(request), httponly=True, samesite="lax", secure=_safe(request))
    return response


def _own(request: Request, path: str) -> str:
    """Return an address of this service; the host name has been checked (`http.origins`)."""
    return f"{request.url.scheme}://{request.url.netloc}{path}"


def _safe(request: Request) -> bool:
    return request.url.scheme == "https"


def _cookie(request: Request) -> str:
    """Return the name of the cookie; with the prefix, no other host of the domain can set it."""
    return "__Host-linna_sign_in" if _safe(request) else "linna_sign_in"
