"""Users, roles and bearer tokens. A token is shown once, when it is made; only its hash is kept."""

from __future__ import annotations

import hashlib
import re
import secrets
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, select

from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, InvalidInput, NotAuthorised, NotFound
from ground_service.services.ground import Ground
from ground_service.store import repository

ROLES = ("viewer", "operator", "admin")
"""Each may do what those before it may: look; plan, upload and command; manage users."""

TOKEN_OCTETS = 32
TOKEN_MINIMUM = 24
_ANYBODY = select(repository.USERS.c.id).limit(1)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")


@dataclass(frozen=True, slots=True)
class Caller:
    """Who asks for something, and in which role."""

    name: str
    role: str

    def may(self, role: str) -> bool:
        """Whether the caller has this role or a higher one."""
        return ROLES.index(self.role) >= ROLES.index(role)


LOCAL_CALLER = Caller("local", "admin")
"""Whoever sits at the machine of a service that has no users and listens to that machine alone."""


def add_user(ground: Ground, name: str, role: str, *, days_valid: float | None = None) -> str:
    """Add a user; the token, which cannot be read again later.

    Raises
    ------
    InvalidInput
        If the name or the role cannot be used.
    Conflict
        If there is such a user already.
    """
    _check(name, role)
    now = utc_now_ns()
    with ground.database.writing() as connection:
        if repository.find(connection, repository.USERS, name=name) is not None:
            raise Conflict(f"user {name}: exists already")
        user = repository.add(connection, repository.USERS, name=name, role=role, created_utc_ns=now)
        token = _add_token(connection, user, now, days_valid)
        audit(connection, "local", "add user", name, {"role": role})
    return token


def renew_token(ground: Ground, name: str, *, days_valid: float | None = None) -> str:
    """A new token for a user; all earlier ones become void."""
    now = utc_now_ns()
    with ground.database.writing() as connection:
        user = repository.find(connection, repository.USERS, name=name)
        if user is None:
            raise NotFound("user", name)
        _revoke(connection, user["id"], now)
        token = _add_token(connection, user["id"], now, days_valid)
        audit(connection, "local", "renew token", name, {})
    return token


def ensure_user(ground: Ground, name: str, role: str, token: str) -> bool:
    """See to it that a user exists with this role and token, as a deployment is set up; whether anything changed.

    Raises
    ------
    InvalidInput
        If the token is too short to be safe.
    """
    if len(token) < TOKEN_MINIMUM:
        raise InvalidInput("token", "", f"{TOKEN_MINIMUM} characters or more", f"{len(token)}")
    _check(name, role)
    now = utc_now_ns()
    hashed = hashlib.sha256(token.encode()).hexdigest()
    with ground.database.writing() as connection:
        user = repository.find(connection, repository.USERS, name=name)
        if user is not None:
            valid = repository.find(
                connection, repository.TOKENS, user_id=user["id"], token_sha256=hashed, revoked_utc_ns=None
            )
            if valid is not None and user["role"] == role:
                return False
            repository.change(connection, repository.USERS, user["id"], role=role)
            _revoke(connection, user["id"], now)
            key = user["id"]
        else:
            key = repository.add(connection, repository.USERS, name=name, role=role, created_utc_ns=now)
        _keep_token(connection, key, token, now, None)
        audit(connection, "local", "ensure user", name, {"role": role})
    return True


def list_users(ground: Ground) -> list[dict[str, Any]]:
    """All users, by name."""
    with ground.database.reading() as connection:
        rows = connection.execute(select(repository.USERS).order_by(repository.USERS.c.name)).mappings()
        return [
            {"name": row["name"], "role": row["role"], "created_utc_ns": row["created_utc_ns"]}
            for row in rows
        ]


def has_users(ground: Ground) -> bool:
    """Whether anybody has been added."""
    with ground.database.reading() as connection:
        return connection.execute(_ANYBODY).first() is not None


def authenticate(ground: Ground, token: str) -> Caller:
    """Whose token this is.

    Raises
    ------
    NotAuthorised
        If it is nobody's, has expired or was revoked.
    """
    hashed = hashlib.sha256(token.encode()).hexdigest()
    users, tokens = repository.USERS, repository.TOKENS
    with ground.database.reading() as connection:
        row = (
            connection.execute(
                select(users.c.name, users.c.role, tokens.c.expires_utc_ns, tokens.c.revoked_utc_ns)
                .join(users, users.c.id == tokens.c.user_id)
                .where(tokens.c.token_sha256 == hashed)
            )
            .mappings()
            .first()
        )
    if row is None or row["revoked_utc_ns"] is not None:
        raise NotAuthorised("token: expected one that 'linna user add' gave out, found another")
    if row["expires_utc_ns"] is not None and row["expires_utc_ns"] <= utc_now_ns():
        raise NotAuthorised("token: has expired; 'linna user token NAME' gives a new one")
    return Caller(row["name"], row["role"])


def audit(connection: Connection, actor: str, action: str, target: str, detail: dict[str, Any]) -> None:
    """Add an entry to the log of what was done, in the transaction that does it."""
    repository.add(
        connection,
        repository.AUDIT,
        utc_ns=utc_now_ns(),
        actor=actor,
        action=action,
        target=target,
        detail=detail,
    )


def _check(name: str, role: str) -> None:
    if not _NAME.fullmatch(name):
        raise InvalidInput("user", "name", "1 to 64 letters, digits and . _ @ -", repr(name)[:80])
    if role not in ROLES:
        raise InvalidInput("user", "role", ", ".join(ROLES), repr(role)[:80])


def _add_token(connection: Connection, user_id: int, now: int, days_valid: float | None) -> str:
    token = "linna_" + secrets.token_urlsafe(TOKEN_OCTETS)
    _keep_token(connection, user_id, token, now, days_valid)
    return token


def _keep_token(connection: Connection, user_id: int, token: str, now: int, days_valid: float | None) -> None:
    repository.add(
        connection,
        repository.TOKENS,
        user_id=user_id,
        token_sha256=hashlib.sha256(token.encode()).hexdigest(),
        created_utc_ns=now,
        expires_utc_ns=None if days_valid is None else now + int(days_valid * 86_400e9),
    )


def _revoke(connection: Connection, user_id: int, now: int) -> None:
    table = repository.TOKENS
    connection.execute(
        table.update()
        .where(table.c.user_id == user_id, table.c.revoked_utc_ns.is_(None))
        .values(revoked_utc_ns=now)
    )
