"""Users, roles and bearer tokens. A token is shown once, when it is created; only its hash is stored.

Every change compares the expected state with the stored state and fails with a conflict if another change came first.
Nothing is cached: every process refuses a disabled user or a revoked token as soon as the change is committed.
"""

from __future__ import annotations

import hashlib
import math
import re
import secrets
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import Connection, or_, select, update

from ground_service.access.model import DAYS_LIMIT, Token, User
from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, InvalidInput, NotAuthorised, NotFound, StoreError
from ground_service.ground import Ground
from ground_service.store import audit as audit_log
from ground_service.store import repository

ROLES = ("viewer", "operator", "admin")
"""Each may do what those before it may: look; plan, upload and command; manage users."""

STATES = ("active", "disabled")

TOKEN_OCTETS = 32
TOKEN_MINIMUM = 24
HINT_LENGTH = 12
"""Number of characters of a token that are stored to identify it; 37 random characters remain secret."""

USED_STEP_NS = 3_600_000_000_000
"""Resolution of the stored time of last use, to limit the number of writes."""

RESERVED_NAMES = ("local", "service", "archive")
"""Names of the program itself as an actor in the audit log."""

_ANYBODY = select(repository.USERS.c.id).limit(1)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")


@dataclass(frozen=True, slots=True)
class Caller:
    """Authenticated caller with role and token."""

    name: str
    role: str
    token_id: int | None = None

    def may(self, role: str) -> bool:
        """Whether the caller has this role or a higher one."""
        return ROLES.index(self.role) >= ROLES.index(role)


LOCAL_CALLER = Caller("local", "admin")
"""Caller of a service without users, which listens only on the local machine."""


def add_user(
    ground: Ground, name: str, role: str, *, days_valid: float | None = None, actor: str = "local"
) -> str:
    """Add a user and return the token, which cannot be read again later.

    Raises
    ------
    InvalidInput
        If the name, the role or the validity is invalid.
    Conflict
        If the user exists already.
    """
    _check(name, role)
    lifetime_ns = _lifetime_ns(days_valid)
    now = utc_now_ns()
    with ground.database.writing() as connection:
        if _add_row(connection, name, role, now) is None:
            raise Conflict(f"user {name}: exists already")
        token_id, token = _add_token(connection, _user_row(connection, name)["id"], now, lifetime_ns)
        audit(connection, actor, "add user", name, {"role": role, "token_id": token_id})
    return token


def renew_token(ground: Ground, name: str, *, days_valid: float | None = None, actor: str = "local") -> str:
    """Create a token for a user, revoke all earlier ones, and return it."""
    lifetime_ns = _lifetime_ns(days_valid)
    now = utc_now_ns()
    with ground.database.writing() as connection:
        user = _user_row(connection, name)
        revoked = _revoke_all(connection, user["id"], now)
        token_id, token = _add_token(connection, user["id"], now, lifetime_ns)
        audit(connection, actor, "renew token", name, {"token_id": token_id, "revoked": revoked})
    return token


def add_token(ground: Ground, name: str, *, days_valid: float | None = None, actor: str = "local") -> str:
    """Create a further token for a user and return it; earlier ones remain valid."""
    lifetime_ns = _lifetime_ns(days_valid)
    now = utc_now_ns()
    with ground.database.writing() as connection:
        user = _user_row(connection, name)
        token_id, token = _add_token(connection, user["id"], now, lifetime_ns)
        audit(connection, actor, "add token", name, {"token_id": token_id})
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
    _check(name, role)
    now = utc_now_ns()
    hashed = token_sha256(token)
    with ground.database.writing() as connection:
        user = repository.find(connection, repository.USERS, name=name)
        if user is not None and user["state"] != "active":
            raise Conflict(f"user {name}: expected state active, found {user['state']}")
        known = repository.find(connection, repository.TOKENS, token_sha256=hashed)
        if known is not None and (user is None or known["user_id"] != user["id"]):
            raise Conflict(f"user {name}: expected a unique token, found that of another user")
        if known is not None and known["revoked_utc_ns"] is not None:
            raise Conflict(f"user {name}: expected a token in force, found one that was revoked")
        if user is not None:
            if known is not None and user["role"] == role:
                return False
            _set_role(connection, user, role)
            _revoke_all(connection, user["id"], now, kept=None if known is None else known["id"])
        elif _add_row(connection, name, role, now) is None:
            raise Conflict(f"user {name}: exists already")
        token_id = (
            known["id"]
            if known is not None
            else _keep_token(connection, _user_row(connection, name)["id"], token, token[:4], now, None)
        )
        audit(connection, actor, "ensure user", name, {"role": role, "token_id": token_id})
    return True


def list_users(ground: Ground) -> list[User]:
    """Return all users, by name."""
    with ground.database.reading() as connection:
        rows = connection.execute(select(repository.USERS).order_by(repository.USERS.c.name)).mappings()
        return [_user(dict(row)) for row in rows]


def get_user(ground: Ground, name: str) -> User:
    """Return one user.

    Raises
    ------
    NotFound
        If there is no such user.
    """
    with ground.database.reading() as connection:
        return _user(_user_row(connection, name))


def change_user(
    ground: Ground, name: str, *, state: str | None = None, role: str | None = None, actor: str = "local"
) -> User:
    """Disable or enable a user, or change the role.

    Raises
    ------
    NotFound
        If there is no such user.
    Conflict
        If the user has this state or role already, or is the last active administrator.
    """
    if state is None and role is None:
        raise InvalidInput("user", name, "a new state or role", "neither")
    if state is not None and state not in STATES:
        raise InvalidInput("user", "state", " or ".join(STATES), repr(state)[:80])
    if role is not None:
        _check(name, role)
    with ground.database.writing() as connection:
        admins = _locked_admins(connection)
        user = _user_row(connection, name)
        loses = (state == "disabled") or (role is not None and role != "admin")
        if loses and admins == [user["id"]]:
            raise Conflict(f"user {name}: expected another active administrator, found none")
        if state is not None:
            before = next(one for one in STATES if one != state)
            _compare_and_set(connection, user["id"], name, "state", before, state)
            audit(connection, actor, "disable user" if state == "disabled" else "enable user", name, {})
        if role is not None:
            _set_role(connection, user, role)
            audit(connection, actor, "change role", name, {"from": user["role"], "to": role})
        return _user(_user_row(connection, name))


def list_tokens(ground: Ground, name: str | None = None) -> list[Token]:
    """Return the tokens of one user or of all users, newest first, without their secrets."""
    users, tokens = repository.USERS, repository.TOKENS
    query = (
        select(tokens, users.c.name).join(users, users.c.id == tokens.c.user_id).order_by(tokens.c.id.desc())
    )
    with ground.database.reading() as connection:
        if name is not None:
            query = query.where(tokens.c.user_id == _user_row(connection, name)["id"])
        return [_token(dict(row)) for row in connection.execute(query).mappings()]


def revoke_token(ground: Ground, token_id: int, *, actor: str = "local") -> Token:
    """Revoke one token.

    Raises
    ------
    NotFound
        If there is no such token.
    Conflict
        If it has been revoked already.
    """
    users, tokens = repository.USERS, repository.TOKENS
    with ground.database.writing() as connection:
        changed = connection.execute(
            update(tokens)
            .where(tokens.c.id == token_id, tokens.c.revoked_utc_ns.is_(None))
            .values(revoked_utc_ns=utc_now_ns())
        ).rowcount
        row = repository.get(connection, tokens, token_id, "token")
        name = str(repository.get(connection, users, row["user_id"], "user")["name"])
        if changed != 1:
            raise Conflict(f"token {token_id}: expected state active, found revoked")
        audit(connection, actor, "revoke token", name, {"token_id": token_id})
        return _token({**row, "name": name})


def has_users(ground: Ground) -> bool:
    """Return whether the service has users."""
    with ground.database.reading() as connection:
        return connection.execute(_ANYBODY).first() is not None


def authenticate(ground: Ground, token: str) -> Caller:
    """Return the caller that a token belongs to.

    Raises
    ------
    NotAuthorised
        If the token is unknown, expired or revoked, or if its user is disabled.
    """
    row = _token_row(ground, token)
    if row is None or row["revoked_utc_ns"] is not None:
        raise NotAuthorised("token: expected one that 'linna user add' gave out, found another")
    if row["state"] != "active":
        raise NotAuthorised(f"token: user {row['name']} is disabled")
    now = utc_now_ns()
    if row["expires_utc_ns"] is not None and row["expires_utc_ns"] <= now:
        raise NotAuthorised("token: has expired; 'linna user token NAME' gives a new one")
    if row["used_utc_ns"] is None or row["used_utc_ns"] <= now - USED_STEP_NS:
        _note_use(ground, row["id"], now)
    return Caller(row["name"], row["role"], row["id"])


def token_valid(ground: Ground, token: str) -> bool:
    """Return whether a token is valid now; one indexed query, for connections that outlive their opening request."""
    row = _token_row(ground, token)
    if row is None or row["revoked_utc_ns"] is not None or row["state"] != "active":
        return False
    return row["expires_utc_ns"] is None or bool(row["expires_utc_ns"] > utc_now_ns())


def token_sha256(token: str) -> str:
    """Return the stored hash of a token (hex)."""
    return hashlib.sha256(token.encode()).hexdigest()


def audit(connection: Connection, actor: str, action: str, target: str, detail: dict[str, Any]) -> None:
    """Add an entry to the audit log, in the transaction of the recorded change."""
    audit_log.add_note(connection, audit_log.Note(utc_now_ns(), actor, action, target, detail))


def _check(name: str, role: str) -> None:
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


def _user_row(connection: Connection, name: str) -> repository.Row:
    row = repository.find(connection, repository.USERS, name=name)
    if row is None:
        raise NotFound("user", repr(name)[1:-1][:80])
    return row


def _add_row(connection: Connection, name: str, role: str, now: int) -> int | None:
    """Add a user; None if another transaction added it first."""
    return repository.add_new(
        connection, repository.USERS, name=name, role=role, state="active", created_utc_ns=now
    )


def _locked_admins(connection: Connection) -> list[int]:
    """Lock the active administrators, so that not all can be disabled at once, and return their ids."""
    users = repository.USERS
    query = select(users.c.id).where(users.c.role == "admin", users.c.state == "active").order_by(users.c.id)
    return [int(key) for key in connection.execute(query.with_for_update()).scalars()]


def _set_role(connection: Connection, user: repository.Row, role: str) -> None:
    if user["role"] != role:
        _compare_and_set(connection, user["id"], user["name"], "role", user["role"], role)


def _compare_and_set(
    connection: Connection, key: int, name: str, column: str, expected: str, value: str
) -> None:
    users = repository.USERS
    changed = connection.execute(
        update(users).where(users.c.id == key, users.c[column] == expected).values({column: value})
    ).rowcount
    if changed != 1:
        found = connection.execute(select(users.c[column]).where(users.c.id == key)).scalar()
        raise Conflict(f"user {name}: expected {column} {expected}, found {found}")


def _token_row(ground: Ground, token: str) -> repository.Row | None:
    users, tokens = repository.USERS, repository.TOKENS
    query = (
        select(
            tokens.c.id,
            tokens.c.expires_utc_ns,
            tokens.c.revoked_utc_ns,
            tokens.c.used_utc_ns,
            users.c.name,
            users.c.role,
            users.c.state,
        )
        .join(users, users.c.id == tokens.c.user_id)
        .where(tokens.c.token_sha256 == token_sha256(token))
    )
    with ground.database.reading() as connection:
        row = connection.execute(query).mappings().first()
    return dict(row) if row is not None else None


def _note_use(ground: Ground, token_id: int, now: int) -> None:
    """Store the hour of the last use, if the store can be written."""
    tokens = repository.TOKENS
    earlier = or_(tokens.c.used_utc_ns.is_(None), tokens.c.used_utc_ns <= now - USED_STEP_NS)
    with suppress(StoreError), ground.database.writing() as connection:
        connection.execute(
            update(tokens)
            .where(tokens.c.id == token_id, earlier)
            .values(used_utc_ns=now // USED_STEP_NS * USED_STEP_NS)
        )


def _user(row: repository.Row) -> User:
    return User.of(row)


def _token(row: repository.Row) -> Token:
    expires = row["expires_utc_ns"]
    state: Literal["active", "expired", "revoked"] = "active"
    if row["revoked_utc_ns"] is not None:
        state = "revoked"
    elif expires is not None and expires <= utc_now_ns():
        state = "expired"
    return Token.of(row, user=row["name"], state=state)


def _add_token(connection: Connection, user_id: int, now: int, lifetime_ns: int | None) -> tuple[int, str]:
    token = "linna_" + secrets.token_urlsafe(TOKEN_OCTETS)
    return _keep_token(connection, user_id, token, token[:HINT_LENGTH], now, lifetime_ns), token


def _keep_token(
    connection: Connection, user_id: int, token: str, hint: str, now: int, lifetime_ns: int | None
) -> int:
    return int(
        repository.add(
            connection,
            repository.TOKENS,
            user_id=user_id,
            token_sha256=token_sha256(token),
            hint=hint,
            created_utc_ns=now,
            expires_utc_ns=None if lifetime_ns is None else now + lifetime_ns,
        )
    )


def _revoke_all(connection: Connection, user_id: int, now: int, kept: int | None = None) -> int:
    """Revoke the tokens of a user, all but one where that is kept; how many."""
    tokens = repository.TOKENS
    others = [] if kept is None else [tokens.c.id != kept]
    return int(
        connection.execute(
            update(tokens)
            .where(tokens.c.user_id == user_id, tokens.c.revoked_utc_ns.is_(None), *others)
            .values(revoked_utc_ns=now)
        ).rowcount
    )
