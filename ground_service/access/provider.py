"""Sign-in with an OpenID provider: requests by authlib's client, and checks of its tokens.

Authorization code flow with PKCE, state and nonce. A sign-in that has begun is remembered by the browser alone, in a
cookie for ten minutes, so that strangers cannot fill the database and every API process can complete it.

References
----------
OpenID Connect Core 1.0 section 3.1, Discovery 1.0 section 4, Back-Channel Logout 1.0; RFC 7636 (PKCE); RFC 9207.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import math
import secrets
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import quote, unquote, urlencode, urlsplit

import httpx
from sqlalchemy import Connection

from ground_service.access import service, store
from ground_service.access.model import ProviderIdentity, Role, Session, UserRecord
from ground_service.clock import is_recorded, mission_now_ns, utc_now_ns
from ground_service.errors import InvalidInput, ProviderUnavailable, SettingsError, SignInRefused
from ground_service.ground import Ground
from ground_service.http.model import UtcTime

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

NEXT_LENGTH = 1000
SECRET_OCTETS = 32
LOGOUT_EVENT = "http://schemas.openid.net/event/backchannel-logout"


@dataclass(frozen=True, slots=True)
class PendingSignIn:
    """A sign-in that has begun, as the cookie of the browser remembers it."""

    state: str
    nonce: str
    verifier: str
    next_page: str

    @classmethod
    def new(cls, next_page: str) -> PendingSignIn:
        """Return a new sign-in; `next_page` is the page to open after it."""
        state, nonce, verifier = (secrets.token_urlsafe(SECRET_OCTETS) for _ in range(3))
        return cls(state, nonce, verifier, own_page(next_page))

    def cookie(self) -> str:
        """Return the value of the cookie."""
        return ".".join((self.state, self.nonce, self.verifier, quote(self.next_page, safe="")))

    @classmethod
    def of_cookie(cls, cookie: str | None, state: str) -> PendingSignIn:
        """Return the sign-in that a provider answers.

        Raises
        ------
        SignInRefused
            If this browser has not begun a sign-in with this state.
        """
        words = (cookie or "").split(".", 3)
        if len(words) != 4 or not all(words):
            raise SignInRefused("state", "a sign-in that this browser began within the last 10 minutes", "none")
        if not hmac.compare_digest(words[0].encode(), state.encode()):
            raise SignInRefused("state", "that of the sign-in this browser began last", "another")
        return cls(words[0], words[1], words[2], own_page(unquote(words[3])))


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
    _client: Any = None
    _read_s: float = 0.0
    _reading: asyncio.Lock = field(default_factory=asyncio.Lock)

    async def begin(self, begun: PendingSignIn, redirect_uri: str) -> str:
        """Return the address of the provider to send the browser to."""
        client = await self._configured()
        found = await client.create_authorization_url(
            redirect_uri, state=begun.state, nonce=begun.nonce, code_verifier=begun.verifier
        )
        return str(found["url"])

    async def complete(
        self, begun: PendingSignIn, code: str, redirect_uri: str, issuer: str | None = None
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
        from authlib.integrations.base_client import OAuthError

        client = await self._configured()
        stated = client.server_metadata.get("authorization_response_iss_parameter_supported") is True
        if issuer != self.issuer and (issuer is not None or stated):
            raise SignInRefused("iss of the answer", self.issuer, issuer or "none")
        try:
            with _unavailable(client.server_metadata["token_endpoint"]):
                answer = await client.fetch_access_token(redirect_uri, code=code, code_verifier=begun.verifier)
        except OAuthError as error:
            raise SignInRefused("code", "one that the provider accepts", _word(error.error)) from None
        token = answer.get("id_token")
        if not isinstance(token, str):
            raise SignInRefused("answer to the code", "an ID token", "none")
        claims = await self._verified(token)
        self._check(claims, {"nonce": begun.nonce, "access_token": answer.get("access_token")})
        return self._identity(claims[1])

    async def check(self) -> None:
        """Read addresses and keys of the provider.

        Raises
        ------
        ProviderUnavailable
            If it cannot be used.
        """
        await self._configured()

    async def sign_out_address(self, redirect_uri: str) -> str | None:
        """Return the address that ends the session at the provider; None if it has none or cannot be reached."""
        try:
            place = (await self._configured()).server_metadata.get("end_session_endpoint")
        except ProviderUnavailable:
            return None
        if not isinstance(place, str):
            return None
        query = urlencode({"client_id": self.client_id, "post_logout_redirect_uri": redirect_uri})
        return f"{place}{'&' if urlsplit(place).query else '?'}{query}"

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
        subject, session = (claims.get(name) if isinstance(claims.get(name), str) else None for name in ("sub", "sid"))
        identity = claims.get("jti")
        if (subject is None and session is None) or not isinstance(identity, str):
            raise SignInRefused("logout token", "jti, and sub or sid", "none")
        return subject, session, identity

    async def _configured(self) -> Any:
        """Return authlib's client with addresses and keys of the provider that are at most an hour old."""
        async with self._reading:
            if self._client is None or time.monotonic() - self._read_s > CONFIGURATION_S:
                self._client = await self._read()
                self._read_s = time.monotonic()
            return self._client

    async def _read(self) -> Any:
        """Read addresses and keys (OpenID Connect Discovery 1.0)."""
        from authlib.integrations.starlette_client import StarletteOAuth2App
        from authlib.oidc.discovery import OpenIDProviderMetadata

        place = f"{self.issuer.rstrip('/')}/.well-known/openid-configuration"
        client = StarletteOAuth2App(
            None,
            client_id=self.client_id,
            client_secret=self.client_secret,
            server_metadata_url=place,
            client_kwargs={
                "scope": " ".join(self.scopes),
                "code_challenge_method": "S256",
                "token_endpoint_auth_method": "none" if self.client_secret is None else _basic_login,
                "timeout": TIMEOUT_S,
            },
        )
        with _unavailable(place):
            stated = OpenIDProviderMetadata(await client.load_server_metadata())
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
        with _unavailable(stated["jwks_uri"]):
            await client.fetch_jwk_set()
        return client

    async def _verified(self, token: str) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return header and claims of a token whose signature is that of a key of the provider.

        A provider may have new keys since they were read; they are then read again, once in `KEYS_AGAIN_S`.
        """
        client = await self._configured()
        try:
            return _decoded(token, client.server_metadata["jwks"])
        except SignInRefused:
            if time.monotonic() - self._read_s < KEYS_AGAIN_S:
                raise
        self._read_s = -math.inf
        return _decoded(token, (await self._configured()).server_metadata["jwks"])

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
                "ID token", "issuer, audience, times and nonce of this sign-in", _word(f"{reason} {name or ''}".strip())
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
        from authlib.deprecate import AuthlibDeprecationWarning

        with warnings.catch_warnings():
            # It recommends another HTTP library than the installed one; both serve it.
            warnings.simplefilter("ignore", AuthlibDeprecationWarning)
            import authlib.integrations.starlette_client  # noqa: F401  fail now, not at the first sign-in
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


@contextmanager
def _unavailable(place: str) -> Iterator[None]:
    """Translate errors of a request to the provider, and answers that are no JSON objects."""
    try:
        yield
    except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError, TypeError, AttributeError) as error:
        expected = f"a JSON object within {TIMEOUT_S:.0f} s"
        raise ProviderUnavailable(place, expected, str(error) or type(error).__name__) from None


def _basic_login(client: Any, _method: str, uri: str, headers: Any, body: Any) -> tuple[str, Any, Any]:
    """Add the login of the service; both parts are form-encoded before they are joined (RFC 6749 section 2.3.1)."""
    login = ":".join(quote(part, safe="") for part in (client.client_id, client.client_secret))
    headers["Authorization"] = f"Basic {base64.b64encode(login.encode()).decode()}"
    return uri, headers, body


def _decoded(token: str, keys: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    from joserfc import jwk, jwt
    from joserfc.errors import JoseError

    try:
        found = jwt.decode(token, jwk.KeySet.import_key_set(cast("Any", keys)), algorithms=list(ALGORITHMS))
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


def start_provider_session(ground: Ground, who: ProviderIdentity, state: str) -> tuple[str, Session]:
    """Start a browser session; return the secret of its cookie, and whose session it is.

    The user is added at the first sign-in, and gets the role that the provider states at every sign-in. A user without
    a role is refused, and all sessions and tokens of the user end.

    Parameters
    ----------
    state
        State of the sign-in, which can be used once.

    Raises
    ------
    SignInRefused
        If the state was used before, or the user has no role, is disabled, or has the name of another user.
    """
    now = utc_now_ns()
    with ground.database.writing() as connection:
        if store.take_key(connection, _digest("sign-in", who.issuer, state), "sign-in", now) is not None:
            raise SignInRefused("state", "one that was not used before", "one that was")
        user = store.find_provider_user(connection, who.issuer, who.subject)
        refusal = _refusal(connection, who, user)
        if refusal is None:
            user = _user(connection, who, user, now)
            secret = _session(connection, who, user, now)
        else:
            _record_refusal(connection, who, user, refusal, now)
    if refusal is not None:
        raise refusal
    assert user is not None and who.role is not None
    started = Session(
        name=user.name,
        role=who.role,
        expires=UtcTime(now + service.PROVIDER_SESSION_NS),
        browser=True,
        time=UtcTime(mission_now_ns()),
        recorded=is_recorded(),
    )
    return secret, started


def end_provider_sessions(ground: Ground, issuer: str, subject: str | None, session: str | None, identity: str) -> int:
    """End the browser sessions that a provider names in a logout token; return their number.

    Parameters
    ----------
    session
        Session of the provider; None: all sessions of the subject.
    identity
        Identity of the logout token, which can be used once.

    Raises
    ------
    SignInRefused
        If the token was used before.
    """
    now = utc_now_ns()
    with ground.database.writing() as connection:
        if store.take_key(connection, _digest("sign-out", issuer, identity), "sign-out", now) is not None:
            raise SignInRefused("logout token", "one that was not used before", "one that was")
        ended = store.end_provider_sessions(connection, issuer, subject, session, now)
        for name, number in ended.items():
            service.audit(connection, name, "end sessions by provider", name, {"sessions": number})
    return sum(ended.values())


def _refusal(connection: Connection, who: ProviderIdentity, user: UserRecord | None) -> SignInRefused | None:
    """Return why somebody cannot sign in; None for nothing."""
    if who.role is None:
        return SignInRefused("role", "a user with a role in this service", who.stated)
    if user is not None:
        if user.state != "active":
            return SignInRefused(f"user {user.name}", "state active", user.state)
        return None
    try:
        service.check_user(who.name, who.role)
    except InvalidInput as error:
        return SignInRefused("name", error.expected, error.found)
    if store.find_user(connection, who.name) is not None:
        return SignInRefused(
            f"user {who.name}", "a name that no other user of this service has", "a user from elsewhere"
        )
    return None


def _record_refusal(
    connection: Connection, who: ProviderIdentity, user: UserRecord | None, reason: SignInRefused, now: int
) -> None:
    if user is None:
        return  # strangers cannot fill the audit log
    revoked = store.revoke_tokens(connection, user, now)
    service.audit(connection, user.name, "refuse sign-in", user.name, {"reason": str(reason), "revoked": revoked})


def _user(connection: Connection, who: ProviderIdentity, user: UserRecord | None, now: int) -> UserRecord:
    assert who.role is not None
    if user is None:
        if not store.add_user(connection, who.name, who.role, now, issuer=who.issuer, subject=who.subject):
            raise SignInRefused(
                f"user {who.name}", "one sign-in at a time", "another at the same moment; sign in again"
            )
        service.audit(connection, who.name, "add user", who.name, {"role": who.role, "provider": who.issuer})
        return store.get_user(connection, who.name)
    if user.role != who.role:
        store.change_user(connection, user, "role", user.role, who.role)
        detail = {"from": user.role, "to": who.role, "provider": who.issuer}
        service.audit(connection, user.name, "change role", user.name, detail)
    return user


def _session(connection: Connection, who: ProviderIdentity, user: UserRecord, now: int) -> str:
    key, secret = service.add_session_token(connection, user, now, who.session[: store.SESSION_LENGTH])
    detail = {"token_id": key, "provider": who.issuer}
    service.audit(connection, user.name, "start session", user.name, detail)
    return secret


def _digest(*words: str) -> str:
    return hashlib.sha256("\0".join(words).encode()).hexdigest()
