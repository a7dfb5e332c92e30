"""Browser sessions of users who signed in with an OpenID provider.

A user of the provider is identified by issuer and subject, never by name: a name of the provider cannot take over a
user that has this name already. The role is that of the newest sign-in.
"""

from __future__ import annotations

import hashlib

from sqlalchemy import Connection

from ground_service.access import service, store
from ground_service.access.model import ProviderIdentity, Session, UserRecord
from ground_service.clock import is_recorded, mission_now_ns, utc_now_ns
from ground_service.errors import InvalidInput, SignInRefused
from ground_service.ground import Ground
from ground_service.http.times import UtcTime


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


def end_provider_sessions(
    ground: Ground, issuer: str, subject: str | None, session: str | None, identity: str
) -> int:
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
    service.audit(
        connection, user.name, "refuse sign-in", user.name, {"reason": str(reason), "revoked": revoked}
    )


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
