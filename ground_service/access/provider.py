"""Sign-in with an OpenID provider: addresses and keys of the provider, requests to it, and checks of its tokens.

Authorization code flow with PKCE, state and nonce. A sign-in that has begun is remembered by the browser alone, in a
cookie for ten minutes, so that strangers cannot fill the database and every API process can complete it.

References
----------
OpenID Connect Core 1.0 section 3.1, Discovery 1.0 section 4, Back-Channel Logout 1.0; RFC 7636 (PKCE); RFC 9207.
"""

from __future__ import annotations

import asyncio
import hmac
import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import quote, unquote, urlencode, urlsplit

import httpx

from ground_service.access.model import ProviderIdentity, Role
from ground_service.errors import ProviderUnavailable, SettingsError, SignInRefused

if TYPE_CHECKING:
    from ground_service.settings import Settings

ALGORITHMS = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "EdDSA", "Ed25519")
"""Accepted signatures: asymmetric only. With HMAC, a public key could pass as the secret."""

LEEWAY_S = 60
"""Permitted difference between the clocks of the provider and of this machine."""

SIGN_IN_S = 600
"""Time to complete a sign-in at the provider."""

TIMEOUT_S = 5.0
CONFIGURATION_S = 3600.0
"""Time for which the addresses and keys of the provider are kept."""

KEYS_AGAIN_S = 30.0
"""Shortest time between two requests for keys because of a token with an unknown key."""

ANSWER_OCTETS = 1 << 20
NEXT_LENGTH = 1000
SECRET_OCTETS = 32
LOGOUT_EVENT = "http://schemas.openid.net/event/backchannel-logout"


@dataclass(frozen=True, slots=True)
class Begun:
    """A sign-in that has begun, as the cookie of the browser remembers it."""

    state: str
    nonce: str
    verifier: str
    next_page: str

    @classmethod
    def new(cls, next_page: str) -> Begun:
        """Return a new sign-in; `next_page` is the page to open after it."""
        state, nonce, verifier = (secrets.token_urlsafe(SECRET_OCTETS) for _ in range(3))
        return cls(state, nonce, verifier, own_page(next_page))

    def cookie(self) -> str:
        """Return the value of the cookie."""
        return ".".join((self.state, self.nonce, self.verifier, quote(self.next_page, safe="")))

    @classmethod
    def of_cookie(cls, cookie: str | None, state: str) -> Begun:
        """Return the sign-in that a provider answers.

        Raises
        ------
        SignInRefused
            If this browser has not begun a sign-in with this state.
        """
        words = (cookie or "").split(".", 3)
        if len(words) != 4 or not all(words):
            raise SignInRefused(
                "state", "a sign-in that this browser began within the last 10 minutes", "none"
            )
        if not hmac.compare_digest(words[0].encode(), state.encode()):
            raise SignInRefused("state", "that of the sign-in this browser began last", "another")
        return cls(words[0], words[1], words[2], own_page(unquote(words[3])))


@dataclass(frozen=True, slots=True)
class Configuration:
    """Addresses of the provider and its keys."""

    authorization: str
    token: str
    end_session: str | None
    states_issuer: bool
    keys: dict[str, Any]
    read_s: float


@dataclass(slots=True)
class Provider:
    """OpenID provider of a deployment. One per process; keeps its configuration for an hour."""

    issuer: str
    client_id: str
    client_secret: str | None
    scopes: tuple[str, ...]
    name_claim: str
    role_claim: str
    roles: Mapping[str, Role]
    _known: Configuration | None = None
    _reading: asyncio.Lock = field(default_factory=asyncio.Lock)

    async def begin(self, begun: Begun, redirect_uri: str) -> str:
        """Return the address of the provider to send the browser to."""
        from authlib.oauth2.rfc7636 import create_s256_code_challenge

        found = await self._configuration()
        query = {
            "response_type": "code",
            "client_id": self.client_id,
            "redirect_uri": redirect_uri,
            "scope": " ".join(self.scopes),
            "state": begun.state,
            "nonce": begun.nonce,
            "code_challenge": create_s256_code_challenge(begun.verifier),
            "code_challenge_method": "S256",
        }
        return f"{found.authorization}{'&' if urlsplit(found.authorization).query else '?'}{urlencode(query)}"

    async def complete(
        self, begun: Begun, code: str, redirect_uri: str, issuer: str | None = None
    ) -> ProviderIdentity:
        """Exchange a code for an ID token and return who signed in.

        Parameters
        ----------
        issuer
            Parameter `iss` of the answer (RFC 9207); None: not given.

        Raises
        ------
        SignInRefused
            If the provider refuses the code, or its token is not valid or names no role.
        ProviderUnavailable
            If the provider cannot be reached.
        """
        found = await self._configuration()
        if issuer != self.issuer and (issuer is not None or found.states_issuer):
            raise SignInRefused("iss of the answer", self.issuer, issuer or "none")
        answer = await self._exchange(found, begun, code, redirect_uri)
        token = answer.get("id_token")
        if not isinstance(token, str):
            raise SignInRefused("answer to the code", "an ID token", "none")
        claims = await self._verified(token)
        self._check(claims, {"nonce": begun.nonce, "access_token": answer.get("access_token")})
        return self._identity(claims[1])

    async def sign_out_address(self, redirect_uri: str) -> str | None:
        """Return the address that ends the session at the provider; None if it has none or cannot be reached."""
        try:
            found = await self._configuration()
        except ProviderUnavailable:
            return None
        if found.end_session is None:
            return None
        query = urlencode({"client_id": self.client_id, "post_logout_redirect_uri": redirect_uri})
        return f"{found.end_session}{'&' if urlsplit(found.end_session).query else '?'}{query}"

    async def signed_out(self, token: str) -> tuple[str | None, str | None, str]:
        """Return subject, session and identity of a logout token; one of the first two may be None.

        Raises
        ------
        SignInRefused
            If the token is not valid.
        """
        header, claims = await self._verified(token)
        self._check((header, claims), {})
        events = claims.get("events")
        if not isinstance(events, dict) or LOGOUT_EVENT not in events:
            raise SignInRefused("logout token", f"the event {LOGOUT_EVENT}", "another")
        if "nonce" in claims:
            raise SignInRefused("logout token", "no nonce", "one")
        subject, session = (
            claims.get(name) if isinstance(claims.get(name), str) else None for name in ("sub", "sid")
        )
        identity = claims.get("jti")
        if (subject is None and session is None) or not isinstance(identity, str):
            raise SignInRefused("logout token", "jti, and sub or sid", "none")
        return subject, session, identity

    async def _configuration(self) -> Configuration:
        async with self._reading:
            if self._known is None or time.monotonic() - self._known.read_s > CONFIGURATION_S:
                self._known = await self._read()
            return self._known

    async def _read(self) -> Configuration:
        """Read addresses and keys (OpenID Connect Discovery 1.0)."""
        from authlib.oidc.discovery import OpenIDProviderMetadata

        place = f"{self.issuer.rstrip('/')}/.well-known/openid-configuration"
        stated = OpenIDProviderMetadata(await self._get(place))
        if stated.get("issuer") != self.issuer:
            raise ProviderUnavailable(place, f"issuer {self.issuer}", str(stated.get("issuer"))[:200])
        try:
            stated.validate_authorization_endpoint()
            stated.validate_token_endpoint()
            stated.validate_jwks_uri()
        except ValueError as error:
            if urlsplit(self.issuer).scheme == "https":
                raise ProviderUnavailable(place, "https addresses of the provider", str(error)) from None
        for name in ("authorization_endpoint", "token_endpoint", "jwks_uri"):
            if not isinstance(stated.get(name), str):
                raise ProviderUnavailable(place, name, "none")
        end_session = stated.get("end_session_endpoint")
        return Configuration(
            authorization=stated["authorization_endpoint"],
            token=stated["token_endpoint"],
            end_session=end_session if isinstance(end_session, str) else None,
            states_issuer=stated.get("authorization_response_iss_parameter_supported") is True,
            keys=await self._get(stated["jwks_uri"]),
            read_s=time.monotonic(),
        )

    async def _exchange(
        self, found: Configuration, begun: Begun, code: str, redirect_uri: str
    ) -> dict[str, Any]:
        form = {
            "grant_type": "authorization_code",
            "code": code,
            "redirect_uri": redirect_uri,
            "code_verifier": begun.verifier,
            "client_id": self.client_id,
        }
        login = None
        if self.client_secret is not None:
            # RFC 6749 section 2.3.1: both are form-encoded before they are joined
            login = (quote(self.client_id, safe=""), quote(self.client_secret, safe=""))
        status, answer = await self._ask("POST", found.token, form, login)
        if status != 200:
            raise SignInRefused("code", "one that the provider accepts", _word(answer.get("error")))
        return answer

    async def _get(self, place: str) -> dict[str, Any]:
        status, answer = await self._ask("GET", place)
        if status != 200:
            raise ProviderUnavailable(place, "status 200", str(status))
        return answer

    async def _ask(
        self,
        method: str,
        place: str,
        form: dict[str, str] | None = None,
        login: tuple[str, str] | None = None,
    ) -> tuple[int, dict[str, Any]]:
        """Return status and JSON object of an answer of the provider; redirects are not followed."""
        try:
            async with (
                httpx.AsyncClient(timeout=TIMEOUT_S) as client,
                client.stream(method, place, data=form, auth=login) as answer,
            ):
                octets = b""
                async for block in answer.aiter_bytes():
                    octets += block
                    if len(octets) > ANSWER_OCTETS:
                        raise ProviderUnavailable(place, f"at most {ANSWER_OCTETS} octets", "more")
        except (httpx.HTTPError, httpx.InvalidURL, OSError) as error:
            raise ProviderUnavailable(
                place, f"an answer within {TIMEOUT_S:.0f} s", str(error) or type(error).__name__
            ) from None
        try:
            found = httpx.Response(200, content=octets).json()
        except ValueError:
            found = None
        if not isinstance(found, dict):
            raise ProviderUnavailable(place, "a JSON object", f"status {answer.status_code} without one")
        return answer.status_code, found

    async def _verified(self, token: str) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return header and claims of a token whose signature is that of a key of the provider.

        A provider may have new keys since they were read; they are then read again, once in `KEYS_AGAIN_S`.
        """
        found = await self._configuration()
        try:
            return _decoded(token, found.keys)
        except SignInRefused:
            if time.monotonic() - found.read_s < KEYS_AGAIN_S:
                raise
        async with self._reading:
            self._known = await self._read()
        return _decoded(token, self._known.keys)

    def _check(self, decoded: tuple[dict[str, Any], dict[str, Any]], params: dict[str, Any]) -> None:
        """Check issuer, audience, times, nonce and hash of a token."""
        from authlib.oidc.core import CodeIDToken
        from joserfc.errors import JoseError

        header, claims = decoded
        options: dict[str, Any] = {
            "iss": {"essential": True, "value": self.issuer},
            "aud": {"essential": True, "value": self.client_id},
            "sub": {"essential": True},
            "exp": {"essential": True},
        }
        if "events" in claims:  # a logout token has a subject or a session
            del options["sub"]
            claims = {"sub": claims.get("sid", ""), **claims}
        token = CodeIDToken(claims, header, options, {**params, "client_id": self.client_id})
        try:
            token.validate(leeway=LEEWAY_S)
        except (JoseError, ValueError, TypeError) as error:
            name = getattr(error, "claim", None)
            reason = getattr(error, "error", None) or str(error)
            raise SignInRefused(
                "ID token",
                "issuer, audience, times and nonce of this sign-in",
                _word(f"{reason} {name or ''}".strip()),
            ) from None

    def _identity(self, claims: Mapping[str, Any]) -> ProviderIdentity:
        """Return who a token names, with the highest role that one of its groups has."""
        name = claims.get(self.name_claim)
        if not isinstance(name, str):
            raise SignInRefused(f"claim {self.name_claim}", "the name of the user", _word(name))
        stated = _at(claims, self.role_claim)
        words = [stated] if isinstance(stated, str) else stated if isinstance(stated, list) else []
        found = {self.roles[word] for word in words if isinstance(word, str) and word in self.roles}
        role = next((one for one in ("admin", "operator", "viewer") if one in found), None)
        session = claims.get("sid")
        return ProviderIdentity(
            issuer=self.issuer,
            subject=str(claims["sub"]),
            name=name,
            role=role,
            session=session if isinstance(session, str) else "",
            stated=f"claim {self.role_claim}: expected one of {', '.join(sorted(self.roles))}, "
            f"found {', '.join(str(word) for word in words)[:200] or 'none'}",
        )


def provider_of(settings: Settings) -> Provider | None:
    """Return the OpenID provider of the settings; None without one.

    Raises
    ------
    SettingsError
        If a setting of it is missing or the extra `oidc` is not installed.
    """
    if settings.oidc_issuer is None:
        return None
    try:
        import authlib.oidc.core  # noqa: F401  fail at the start, not at the first sign-in
    except ImportError as error:
        raise SettingsError("LINNA_OIDC_ISSUER", "the extra 'oidc' to be installed", str(error)) from None
    if settings.oidc_client_id is None:
        raise SettingsError("LINNA_OIDC_CLIENT_ID", "the name of this service at the provider", "none")
    roles = {}
    for entry in settings.oidc_roles:
        role, _, word = entry.partition("=")
        if word in roles:
            raise SettingsError("LINNA_OIDC_ROLES", "one role for each value", f"{word!r} twice")
        roles[word] = cast("Role", role)
    if not roles:
        raise SettingsError("LINNA_OIDC_ROLES", "entries such as admin=linna-admins", "none")
    secret = settings.oidc_client_secret
    return Provider(
        issuer=settings.oidc_issuer,
        client_id=settings.oidc_client_id,
        client_secret=None if secret is None else secret.get_secret_value(),
        scopes=tuple(dict.fromkeys(("openid", *settings.oidc_scopes))),
        name_claim=settings.oidc_name_claim,
        role_claim=settings.oidc_role_claim,
        roles=roles,
    )


def own_page(text: str) -> str:
    """Return a path of this service, or "/" for anything that a browser could take for another address."""
    printable = text.isascii() and text.isprintable() and " " not in text
    if not printable or "\\" in text or not text.startswith("/") or len(text) > NEXT_LENGTH:
        return "/"
    return "/" if text.startswith("//") else text


def _decoded(token: str, keys: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    from joserfc import jwk, jwt
    from joserfc.errors import JoseError

    try:
        found = jwt.decode(token, jwk.KeySet.import_key_set(cast(Any, keys)), algorithms=list(ALGORITHMS))
    except (JoseError, ValueError, KeyError, TypeError) as error:
        raise SignInRefused(
            "ID token", "a signature of a key of the provider", _word(str(error) or type(error).__name__)
        ) from None
    return dict(found.header), dict(found.claims)


def _at(claims: Mapping[str, Any], path: str) -> Any:
    """Return a claim, or one inside others by its path: `realm_access.roles`."""
    if path in claims:
        return claims[path]
    value: Any = claims
    for part in path.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _word(value: object) -> str:
    """Return a printable part of what somebody else wrote."""
    text = "none" if value is None else str(value)
    return "".join(one for one in text if one.isprintable())[:200]
