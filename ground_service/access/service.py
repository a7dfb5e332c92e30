"""Users, roles and bearer tokens. A token is shown once, when it is created; only its hash is stored.

Every change compares the expected state with the stored state and fails with a conflict if another change came first.
Nothing is cached: every process refuses a disabled user or a revoked token as soon as the change is committed.
"""

import hashlib
import math
import re
import secrets
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from sqlalchemy import Connection

from ground_service.access import store
from ground_service.access.model import DAYS_LIMIT, Role, Session, Token, User, UserRecord
from ground_service.clock import is_recorded, mission_now_ns, utc_now_ns
from ground_service.errors import Conflict, InvalidInput, NotAuthorised, StoreError
from ground_service.ground import Ground
from ground_service.http.model import UtcTime
from ground_service.store import audit as audit_log
from ground_service.store.vehicles import spacecraft_of_missions

ROLES = ("viewer", "operator", "admin")
"""Each may do what those before it may: look; plan, upload and command; manage users."""

STATES = ("active", "disabled")

TOKEN_OCTETS = 32
TOKEN_MINIMUM = 24
SESSION_NS = 12 * 3_600_000_000_000
"""Longest duration of a browser session: one shift."""

PROVIDER_SESSION_NS = 3_600_000_000_000
"""Duration of a session that an OpenID provider started, after which the provider states the role again."""

HINT_LENGTH = 12
"""Number of characters of a token that are stored to identify it; 37 random characters remain secret."""

USED_STEP_NS = 3_600_000_000_000
"""Resolution of the stored time of last use, to limit the number of writes."""

RESERVED_NAMES = ("local", "service", "archive", "planner", "link", "telemetry", "ingest")
"""Names of the program itself as an actor in the audit log."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")


class OfSpacecraft(Protocol):
    """Something that belongs to a spacecraft."""

    @property
    def spacecraft_id(self) -> int | None: ...


Owned = TypeVar("Owned", bound=OfSpacecraft)


@dataclass(frozen=True, slots=True)
class Caller:
    """Authenticated caller with role and token; one who is limited to missions has names and spacecraft of these."""

    name: str
    role: Role
    token_id: int | None = None
    missions: tuple[str, ...] | None = None
    spacecraft: frozenset[int] | None = None

    def may(self, role: str) -> bool:
        """Return whether the caller has this role or a higher one."""
        return ROLES.index(self.role) >= ROLES.index(role)

    def may_use(self, *spacecraft_id: int | None) -> bool:
        """Return whether the caller may read and command all of these spacecraft; None is one that is not known."""
        return self.spacecraft is None or self.spacecraft.issuperset(spacecraft_id)

    def own(self, items: Iterable[Owned]) -> list[Owned]:
        """Return those of a list that belong to spacecraft of the caller."""
        return [one for one in items if self.may_use(one.spacecraft_id)]


LOCAL_CALLER = Caller("local", "admin")
"""Caller of a service without users, which listens only on the local machine."""


def add_user(
    ground: Ground,
    name: str,
    role: str,
    *,
    days_valid: float | None = None,
    missions: Sequence[str] | None = None,
    actor: str = "local",
) -> str:
    """Add a user, who may be limited to missions, and return the token, which cannot be read again later.

    Raises
    ------
    InvalidInput
        If the name, the role or the validity is invalid.
    Conflict
        If the user exists already.
    """
    check_user(name, role)
    lifetime_ns = _lifetime_ns(days_valid)
    now = utc_now_ns()
    with ground.database.writing() as connection:
        user = _add_user(connection, name, role, now, missions)
        token_id, token = _add_token(connection, user, now, lifetime_ns)
        detail = {"role": role, "token_id": token_id, **_limits(missions)}
        audit(connection, actor, "add user", name, detail)
    return token


def add_token(
    ground: Ground,
    name: str,
    *,
    days_valid: float | None = None,
    missions: Sequence[str] | None = None,
    revoke_others: bool = False,
    actor: str = "local",
) -> str:
    """Create a token for a user, which may be limited to missions, and return it; earlier ones can be revoked."""
    lifetime_ns = _lifetime_ns(days_valid)
    now = utc_now_ns()
    with ground.database.writing() as connection:
        user = store.get_user(connection, name)
        detail = {"revoked": store.revoke_tokens(connection, user, now)} if revoke_others else {}
        token_id, token = _add_token(connection, user, now, lifetime_ns, missions=missions)
        action = "renew token" if revoke_others else "add token"
        audit(connection, actor, action, name, {"token_id": token_id, **detail, **_limits(missions)})
    return token


def ensure_user(ground: Ground, name: str, role: str, token: str, *, actor: str = "local") -> bool:
    """Create a user with this role and token if needed, for deployments; return whether anything changed.

    Raises
    ------
    InvalidInput
        If the token is too short to be secure.
    Conflict
        If the user is disabled or the token was revoked: a restart of the deployment must not enable either again. If
        another user has this token.
    """
    if len(token) < TOKEN_MINIMUM:
        raise InvalidInput("token", "", f"{TOKEN_MINIMUM} characters or more", f"{len(token)}")
    check_user(name, role)
    now = utc_now_ns()
    hashed = token_sha256(token)
    with ground.database.writing() as connection:
        user = store.find_user(connection, name)
        if user is not None and user.state != "active":
            raise Conflict(f"user {name}: expected state active, found {user.state}")
        known = store.find_token(connection, hashed)
        if known is not None and (user is None or known.user_id != user.id):
            raise Conflict(f"user {name}: expected a unique token, found that of another user")
        if known is not None and known.revoked_utc_ns is not None:
            raise Conflict(f"user {name}: expected a token in force, found one that was revoked")
        if user is not None:
            if known is not None and user.role == role:
                return False
            _set_role(connection, user, role)
            store.revoke_tokens(connection, user, now, kept=None if known is None else known.id)
        else:
            user = _add_user(connection, name, role, now)
        token_id = (
            known.id
            if known is not None
            else store.add_token(connection, user, hashed, hint=token[:4], now_utc_ns=now, expires_utc_ns=None)
        )
        audit(connection, actor, "ensure user", name, {"role": role, "token_id": token_id})
    return True


def list_users(ground: Ground) -> list[User]:
    """Return all users, by name."""
    return ground.read(store.list_users)


def get_user(ground: Ground, name: str) -> User:
    with ground.database.reading() as connection:
        return User.of(dict(store.get_user(connection, name)))


def change_user(
    ground: Ground,
    name: str,
    *,
    state: str | None = None,
    role: str | None = None,
    missions: Sequence[str] | None = None,
    actor: str = "local",
) -> User:
    """Disable or enable a user, or change the role or the missions (empty: all).

    Raises
    ------
    NotFound
        If there is no such user.
    Conflict
        If the user has this state or role already, or is the last active administrator.
    """
    if state is None and role is None and missions is None:
        raise InvalidInput("user", name, "a new state, role or missions", "none of them")
    if state is not None and state not in STATES:
        raise InvalidInput("user", "state", " or ".join(STATES), repr(state)[:80])
    if role is not None:
        check_user(name, role)
    with ground.database.writing() as connection:
        admins = store.lock_admins(connection)
        user = store.get_user(connection, name)
        loses = (state == "disabled") or (role is not None and role != "admin")
        if loses and admins == [user.id]:
            raise Conflict(f"user {name}: expected another active administrator, found none")
        if state is not None:
            before = next(one for one in STATES if one != state)
            store.change_user(connection, user, "state", before, state)
            # A session must not continue when the user is enabled again.
            detail = {"sessions": store.revoke_sessions(connection, user, utc_now_ns())}
            audit(connection, actor, "disable user" if state == "disabled" else "enable user", name, detail)
        if role is not None:
            if user.provider is not None:
                raise Conflict(f"user {name}: the OpenID provider {user.provider} states the role")
            _set_role(connection, user, role)
            audit(connection, actor, "change role", name, {"from": user.role, "to": role})
        if missions is not None:
            store.limit_user(connection, user, missions)
            change = {"from": user.missions, "to": list(missions) or None}
            audit(connection, actor, "change missions", name, change)
        return User.of(dict(store.get_user(connection, name)))


def list_tokens(ground: Ground, name: str | None = None) -> list[Token]:
    """Return the tokens of one user or of all users, newest first, without their secrets."""
    with ground.database.reading() as connection:
        tokens = store.list_tokens(connection, None if name is None else store.get_user(connection, name))
    now = utc_now_ns()
    return [one.token(now) for one in tokens]


def revoke_token(ground: Ground, token_id: int, *, actor: str = "local") -> Token:
    """Revoke one token.

    Raises
    ------
    NotFound
        If there is no such token.
    Conflict
        If it has been revoked already.
    """
    now = utc_now_ns()
    with ground.database.writing() as connection:
        changed = store.revoke_token(connection, token_id, now)
        token = store.get_token(connection, token_id)
        if not changed:
            raise Conflict(f"token {token_id}: expected state active, found revoked")
        audit(connection, actor, "revoke token", token.name, {"token_id": token_id})
    return token.token(now)


def authenticate(ground: Ground, token: str) -> Caller:
    """Return the caller that a token belongs to.

    Raises
    ------
    NotAuthorised
        If the token is unknown, expired or revoked, or if its user is disabled.
    """
    found = ground.read(store.find_token, token_sha256(token))
    if found is None or found.revoked_utc_ns is not None:
        raise NotAuthorised("token: expected one that 'linna user add' gave out, found another")
    if found.state != "active":
        raise NotAuthorised(f"token: user {found.name} is disabled")
    now = utc_now_ns()
    if found.expired(now):
        raise NotAuthorised("token: has expired; 'linna user token NAME' gives a new one")
    if found.used_utc_ns is None or found.used_utc_ns <= now - USED_STEP_NS:
        _note_use(ground, found.id, now)
    limits = found.limits
    spacecraft = None if limits is None else ground.read(spacecraft_of_missions, limits)
    return Caller(found.name, found.role, found.id, limits, spacecraft)


def start_session(ground: Ground, token: str) -> tuple[str, Session]:
    """Start a browser session with a token; return the secret of its cookie, and whose session it is.

    A session ends after `SESSION_NS`, with the validity of the token, or with its revocation.

    Raises
    ------
    NotAuthorised
        If the token is not valid.
    """
    caller = authenticate(ground, token)
    now = utc_now_ns()
    with ground.database.writing() as connection:
        parent = store.get_token(connection, caller.token_id or 0, lock=True)
        if parent.revoked_utc_ns is not None or parent.state != "active":
            raise NotAuthorised("token: has been revoked")
        expires = now + SESSION_NS
        if parent.expires_utc_ns is not None:
            expires = min(expires, parent.expires_utc_ns)
        user = store.get_user(connection, caller.name)
        key, secret = _add_token(
            connection, user, now, expires - now, parent_id=parent.parent_id or parent.id, missions=parent.missions
        )
        audit(connection, caller.name, "start session", caller.name, {"token_id": key, "parent_id": parent.id})
    started = Session(
        name=caller.name,
        role=user.role,
        missions=caller.missions,
        expires=UtcTime(expires),
        browser=True,
        time=UtcTime(mission_now_ns()),
        recorded=is_recorded(),
    )
    return secret, started


def session_of(ground: Ground, caller: Caller, *, browser: bool) -> Session:
    """Return who a caller is, and until when."""
    expires, provider = None, False
    if caller.token_id is not None:
        token = ground.read(store.get_token, caller.token_id)
        expires, provider = token.expires_utc_ns, token.provider_session is not None
    until = None if expires is None else UtcTime(expires)
    return Session(
        name=caller.name,
        role=caller.role,
        missions=caller.missions,
        expires=until,
        browser=browser,
        provider=provider,
        time=UtcTime(mission_now_ns()),
        recorded=is_recorded(),
    )


def end_session(ground: Ground, caller: Caller) -> None:
    """End the browser session of a caller; a second call changes nothing."""
    if caller.token_id is None:
        return
    with ground.database.writing() as connection:
        if store.revoke_token(connection, caller.token_id, utc_now_ns()):
            audit(connection, caller.name, "end session", caller.name, {"token_id": caller.token_id})


def token_sha256(token: str) -> str:
    """Return the stored hash of a token (hex)."""
    return hashlib.sha256(token.encode()).hexdigest()


def audit(connection: Connection, actor: str, action: str, target: str, detail: dict[str, Any]) -> None:
    """Add an entry to the audit log, in the transaction of the recorded change."""
    audit_log.add_note(connection, audit_log.Note(utc_now_ns(), actor, action, target, detail))


def add_session_token(connection: Connection, user: UserRecord, now: int, provider_session: str) -> tuple[int, str]:
    """Add the token of a browser session that an OpenID provider started; return its id and secret."""
    return _add_token(connection, user, now, PROVIDER_SESSION_NS, provider_session=provider_session)


def check_user(name: str, role: str) -> None:
    """Check the name and the role of a user.

    Raises
    ------
    InvalidInput
        If one of them is not permitted.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InvalidInput("user", "name", "1 to 64 letters, digits and . _ @ -", repr(name)[:80])
    if name in RESERVED_NAMES:
        raise InvalidInput("user", "name", "a name that is not reserved for the program", name)
    if role not in ROLES:
        raise InvalidInput("user", "role", ", ".join(ROLES), repr(role)[:80])


def _lifetime_ns(days: float | None) -> int | None:
    if days is None:
        return None
    if isinstance(days, bool) or not math.isfinite(days) or not 0.0 < days <= DAYS_LIMIT:
        raise InvalidInput("token", "days valid", f"more than 0, at most {DAYS_LIMIT:.0f}", repr(days)[:80])
    return int(days * 86_400e9)


def _limits(missions: Sequence[str] | None) -> dict[str, list[str]]:
    return {"missions": list(missions)} if missions else {}


def _add_user(
    connection: Connection, name: str, role: str, now: int, missions: Sequence[str] | None = None
) -> UserRecord:
    if not store.add_user(connection, name, role, now, missions=missions):
        raise Conflict(f"user {name}: exists already")
    return store.get_user(connection, name)


def _set_role(connection: Connection, user: UserRecord, role: str) -> None:
    if user.role != role:
        store.change_user(connection, user, "role", user.role, role)


def _note_use(ground: Ground, token_id: int, now: int) -> None:
    """Store the hour of the last use, if the database can be written."""
    with suppress(StoreError), ground.database.writing() as connection:
        store.note_use(connection, token_id, now // USED_STEP_NS * USED_STEP_NS)


def _add_token(
    connection: Connection,
    user: UserRecord,
    now: int,
    lifetime_ns: int | None,
    parent_id: int | None = None,
    provider_session: str | None = None,
    missions: Sequence[str] | None = None,
) -> tuple[int, str]:
    token = "linna_" + secrets.token_urlsafe(TOKEN_OCTETS)
    expires = None if lifetime_ns is None else now + lifetime_ns
    key = store.add_token(
        connection,
        user,
        token_sha256(token),
        hint=token[:HINT_LENGTH],
        now_utc_ns=now,
        expires_utc_ns=expires,
        parent_id=parent_id,
        provider_session=provider_session,
        missions=missions,
    )
    return key, token
