"""SQL of users, tokens, stored responses and the audit log."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from sqlalchemy import Connection, String, delete, false, func, null, or_, select, update
from sqlalchemy.sql import Select

from ground_service.access.model import AuditEntry, AuditFilter, AuditHead, StoredAnswer, TokenRecord, User, UserRecord
from ground_service.errors import AuditBroken, Conflict, NotFound
from ground_service.ground import Ground
from ground_service.http.model import PageOf
from ground_service.store import audit as chain
from ground_service.store import repository
from ground_service.store.models import METADATA
from ground_service.store.repository import page, spacecraft_of
from ground_service.store.states import change_if

USERS, TOKENS = repository.USERS, repository.TOKENS
ANSWERS, AUDIT = repository.ANSWERS, repository.AUDIT

SESSION_LENGTH = 255
"""Characters of the identity of a provider's session that are stored."""

_IS_SESSION = or_(TOKENS.c.parent_id.is_not(None), TOKENS.c.provider_session.is_not(None))
_ANYBODY = select(USERS.c.id).limit(1)


def add_user(
    connection: Connection,
    name: str,
    role: str,
    now_utc_ns: int,
    *,
    issuer: str | None = None,
    subject: str | None = None,
    missions: Sequence[str] | None = None,
) -> bool:
    """Add a user, or with issuer and subject that of an OpenID provider; return False if another was faster."""
    values: dict[str, Any] = {"name": name, "role": role, "state": "active", "created_utc_ns": now_utc_ns}
    values["missions"] = _names(missions)
    values |= {} if issuer is None else {"issuer": issuer, "subject": subject}
    return repository.add_new(connection, USERS, **values) is not None


def has_users(connection: Connection) -> bool:
    """Return whether there are users."""
    return connection.execute(_ANYBODY).first() is not None


def find_user(connection: Connection, name: str) -> UserRecord | None:
    """Return a user; None if there is no such user."""
    row = repository.find(connection, USERS, name=name)
    return None if row is None else _user(row)


def find_provider_user(connection: Connection, issuer: str, subject: str) -> UserRecord | None:
    """Return the user of an OpenID provider; None if there is no such user."""
    row = repository.find(connection, USERS, issuer=issuer, subject=subject)
    return None if row is None else _user(row)


def get_user(connection: Connection, name: str) -> UserRecord:
    user = find_user(connection, name)
    if user is None:
        raise NotFound("user", repr(name)[1:-1][:80])
    return user


def list_users(connection: Connection) -> list[User]:
    """Return all users, by name."""
    rows = connection.execute(select(USERS).order_by(USERS.c.name)).mappings()
    return [User.of(row, provider=row["issuer"]) for row in rows]


def lock_admins(connection: Connection) -> list[int]:
    """Lock the active administrators, so that not all can be disabled at once; return their ids."""
    query = select(USERS.c.id).where(USERS.c.role == "admin", USERS.c.state == "active").order_by(USERS.c.id)
    return [int(key) for key in connection.execute(query.with_for_update()).scalars()]


def change_user(connection: Connection, user: UserRecord, column: str, expected: str, value: str) -> None:
    """Change the state or role of a user.

    Raises
    ------
    Conflict
        The column does not have the expected value.
    """
    if change_if(connection, USERS, user.id, {column: expected}, **{column: value}):
        return
    found = connection.execute(select(USERS.c[column]).where(USERS.c.id == user.id)).scalar()
    raise Conflict(f"user {user.name}: expected {column} {expected}, found {found}")


def limit_user(connection: Connection, user: UserRecord, missions: Sequence[str]) -> None:
    repository.change(connection, USERS, user.id, missions=_names(missions))


def add_token(
    connection: Connection,
    user: UserRecord,
    sha256: str,
    *,
    hint: str,
    now_utc_ns: int,
    expires_utc_ns: int | None,
    parent_id: int | None = None,
    provider_session: str | None = None,
    missions: Sequence[str] | None = None,
) -> int:
    """Add a token, or with `parent_id` or `provider_session` that of a browser session; return its id."""
    return int(
        repository.add(
            connection,
            TOKENS,
            user_id=user.id,
            token_sha256=sha256,
            hint=hint,
            created_utc_ns=now_utc_ns,
            expires_utc_ns=expires_utc_ns,
            parent_id=parent_id,
            provider_session=provider_session,
            missions=_names(missions),
        )
    )


def find_token(connection: Connection, sha256: str) -> TokenRecord | None:
    """Return the token with this hash and its user; None without any."""
    row = connection.execute(_tokens().where(TOKENS.c.token_sha256 == sha256)).mappings().first()
    return None if row is None else TokenRecord.of(row)


def get_token(connection: Connection, token_id: int, *, lock: bool = False) -> TokenRecord:
    """Return a token and its user; `lock`: until the transaction ends."""
    query = _tokens().where(TOKENS.c.id == token_id)
    row = connection.execute(query.with_for_update() if lock else query).mappings().first()
    if row is None:
        raise NotFound("token", token_id)
    return TokenRecord.of(row)


def list_tokens(connection: Connection, user: UserRecord | None) -> list[TokenRecord]:
    """Return the tokens of one user or of all users, newest first."""
    query = _tokens() if user is None else _tokens().where(TOKENS.c.user_id == user.id)
    return [TokenRecord.of(row) for row in connection.execute(query.order_by(TOKENS.c.id.desc())).mappings()]


def revoke_token(connection: Connection, token_id: int, now_utc_ns: int) -> bool:
    """Revoke a token and end the browser sessions started with it; return False if it was revoked before."""
    sessions = update(TOKENS).where(TOKENS.c.parent_id == token_id, TOKENS.c.revoked_utc_ns.is_(None))
    connection.execute(sessions.values(revoked_utc_ns=now_utc_ns))
    return change_if(connection, TOKENS, token_id, {"revoked_utc_ns": None}, revoked_utc_ns=now_utc_ns)


def revoke_tokens(connection: Connection, user: UserRecord, now_utc_ns: int, *, kept: int | None = None) -> int:
    """Revoke the tokens of a user, except one and the sessions started with it; return their number."""
    others = [] if kept is None else [TOKENS.c.id != kept, func.coalesce(TOKENS.c.parent_id, 0) != kept]
    query = update(TOKENS).where(TOKENS.c.user_id == user.id, TOKENS.c.revoked_utc_ns.is_(None), *others)
    return int(connection.execute(query.values(revoked_utc_ns=now_utc_ns)).rowcount)


def revoke_sessions(connection: Connection, user: UserRecord, now_utc_ns: int) -> int:
    """Revoke the browser sessions of a user, not the tokens; return their number."""
    query = update(TOKENS).where(TOKENS.c.user_id == user.id, TOKENS.c.revoked_utc_ns.is_(None), _IS_SESSION)
    return int(connection.execute(query.values(revoked_utc_ns=now_utc_ns)).rowcount)


def delete_ended_sessions(connection: Connection, now_utc_ns: int) -> int:
    """Delete the tokens of browser sessions that have expired; return their number.

    The audit log keeps the start of each session. Revoked sessions are deleted when they would have expired.
    """
    query = delete(TOKENS).where(_IS_SESSION, TOKENS.c.expires_utc_ns < now_utc_ns)
    return int(connection.execute(query).rowcount)


def end_provider_sessions(
    connection: Connection, issuer: str, subject: str | None, session: str | None, now_utc_ns: int
) -> dict[str, int]:
    """Revoke the browser sessions of a subject or of one session of an OpenID provider; return numbers by user."""
    conditions = [USERS.c.issuer == issuer, TOKENS.c.provider_session.is_not(None)]
    conditions += [] if subject is None else [USERS.c.subject == subject]
    conditions += [] if session is None else [TOKENS.c.provider_session == session]
    joined = select(TOKENS.c.id, USERS.c.name).join(USERS, USERS.c.id == TOKENS.c.user_id)
    rows = connection.execute(joined.where(*conditions, TOKENS.c.revoked_utc_ns.is_(None))).all()
    ended: dict[str, int] = {}
    for key, name in rows:
        ended[name] = ended.get(name, 0) + revoke_token(connection, key, now_utc_ns)
    return ended


def note_use(connection: Connection, token_id: int, used_utc_ns: int) -> None:
    """Store the last use of a token, unless a later one is stored."""
    earlier = or_(TOKENS.c.used_utc_ns.is_(None), TOKENS.c.used_utc_ns < used_utc_ns)
    connection.execute(update(TOKENS).where(TOKENS.c.id == token_id, earlier).values(used_utc_ns=used_utc_ns))


def take_key(connection: Connection, key: str, request: str, now_utc_ns: int) -> StoredAnswer | None:
    """Store an idempotency key with the hash of its request; return what is stored if the key is taken."""
    if repository.add_new(connection, ANSWERS, key=key, request=request, created_utc_ns=now_utc_ns):
        return None
    return StoredAnswer.of(repository.get(connection, ANSWERS, key, "answer"))


def set_answer(connection: Connection, key: str, answer: Mapping[str, Any]) -> None:
    """Store the response of an idempotency key that has none."""
    change_if(connection, ANSWERS, key, {"answer": None}, answer=answer)


def free_key(connection: Connection, key: str) -> None:
    """Delete an idempotency key that has no response."""
    connection.execute(delete(ANSWERS).where(ANSWERS.c.key == key, ANSWERS.c.answer.is_(None)))


def delete_answers(connection: Connection, before_utc_ns: int) -> int:
    """Delete the idempotency keys that were stored before a time; return their number."""
    query = delete(ANSWERS).where(ANSWERS.c.created_utc_ns < before_utc_ns)
    return int(connection.execute(query).rowcount)


Owner = Literal[
    "passes", "windows", "standing_requests", "telecommands", "alarms", "ingests", "landmarks",
    "reports", "monthly_reports", "missions", "links",
]  # fmt: skip
"""Table whose rows belong to a spacecraft."""


def owner_of(connection: Connection, names: Sequence[Owner], key: Any) -> int | None:
    """Return the spacecraft of the row with this key in one of several tables; None without any.

    The key of a mission description is its revision or the first digits of it.
    """
    for name in names:
        table = METADATA.tables[name]
        column = table.c.revision if name == "missions" else next(iter(table.primary_key.columns))
        if isinstance(column.type, String):
            text = str(key)
            here = column.startswith(text, autoescape=True) if name == "missions" else column == text
        else:
            here = column == int(key) if str(key).isdecimal() else false()
        owner = spacecraft_of(table)
        owners = set() if owner is None else set(connection.execute(select(owner).where(here)).scalars())
        if owners:
            return owners.pop() if len(owners) == 1 else None
    return None


def list_audit(connection: Connection, asked: AuditFilter) -> PageOf[AuditEntry]:
    """Return a page of the audit entries, newest first."""
    table = AUDIT.c
    query = select(AUDIT)
    if asked.action is not None:
        query = query.where(table.action.contains(asked.action, autoescape=True))
    if asked.since is not None:
        query = query.where(table.utc_ns >= asked.since.utc_ns)
    if asked.until is not None:
        query = query.where(table.utc_ns < asked.until.utc_ns)
    rows, total = page(connection, query, asked, table.id.desc(), others=["action"])
    return asked.page((AuditEntry.of(row, number=row["id"], time=row["utc_ns"]) for row in rows), total)


def _tokens() -> Select[Any]:
    joined = TOKENS.join(USERS, USERS.c.id == TOKENS.c.user_id)
    limits = USERS.c.missions.label("user_missions")
    return select(TOKENS, USERS.c.name, USERS.c.role, USERS.c.state, limits).select_from(joined)


def _names(missions: Sequence[str] | None) -> Any:
    return list(missions) if missions else null()


def _user(row: Mapping[str, Any]) -> UserRecord:
    return UserRecord.of(row, provider=row["issuer"])


def audit_head(ground: Ground) -> AuditHead:
    """Return the head of the chain.

    Raises
    ------
    AuditBroken
        If its row is missing.
    """
    head = ground.read(chain.read_head)
    if head is None:
        raise AuditBroken("the head of the audit chain is missing; run 'linna verify'")
    return AuditHead(number=head.number, sha256=head.sha256)
