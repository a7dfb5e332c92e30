"""Entities of users, tokens and the audit log."""

from typing import Annotated, Any, Literal

from pydantic import Field

from ground_service.http.model import Entity, Paging, RequestModel, RequestTime, UtcTime

DAYS_LIMIT = 36_500.0

USER_NAME = r"^[A-Za-z0-9][A-Za-z0-9._@-]{0,63}$"
Role = Literal["viewer", "operator", "admin"]
Days = Annotated[
    float | None,
    Field(default=None, gt=0.0, le=DAYS_LIMIT, allow_inf_nan=False, description="null: unlimited validity"),
]


MissionNames = Annotated[
    list[Annotated[str, Field(min_length=1, max_length=200)]], Field(max_length=100, examples=[["selenita"]])
]
Missions = Annotated[
    MissionNames | None,
    Field(default=None, min_length=1, description="Names of mission descriptions; null: all missions"),
]
"""Missions that a user or token is limited to."""

Words = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")]
"""Text of a filter."""


class User(Entity):
    """User of the service."""

    name: str = Field(examples=["ann"])
    role: Role
    state: Literal["active", "disabled"]
    created: UtcTime
    missions: Missions
    provider: str | None = Field(
        default=None, description="Issuer of the OpenID provider that states the role; null: added here"
    )


class ProviderIdentity(Entity):
    """Identity of a user who signed in with an OpenID provider."""

    issuer: str
    subject: str = Field(max_length=255)
    name: str
    role: Role | None = Field(description="Highest role that the provider states; None: none")
    session: str = Field(description="Session of the provider; empty if it states none")
    stated: str = Field(description="Claims searched for the role, and the values found")


class UserRecord(User):
    """A user with the key that tokens reference."""

    id: int


class Token(Entity):
    """Bearer token without its secret."""

    id: int = Field(examples=[1])
    user: str = Field(examples=["ann"])
    hint: str = Field(description="Beginning of the token", examples=["linna_3fXk2a"])
    state: Literal["active", "expired", "revoked"]
    created: UtcTime
    expires: UtcTime | None = Field(description="null: never")
    revoked: UtcTime | None
    missions: Missions
    used: UtcTime | None = Field(description="Last use, to the hour; null: never used")
    parent_id: int | None = Field(
        default=None, description="Token that a browser session was started with; null: no such session"
    )
    kind: Literal["token", "session", "provider session"] = Field(
        description="Bearer token, or browser session started with a token or with an OpenID provider"
    )


class TokenRecord(Entity):
    """Row of a token, with its user."""

    id: int
    user_id: int
    hint: str
    created_utc_ns: int
    expires_utc_ns: int | None
    revoked_utc_ns: int | None
    used_utc_ns: int | None
    parent_id: int | None
    provider_session: str | None
    missions: tuple[str, ...] | None
    name: str
    role: Role
    state: Literal["active", "disabled"] = Field(description="State of the user")
    user_missions: tuple[str, ...] | None

    @property
    def limits(self) -> tuple[str, ...] | None:
        """Missions that both the user and the token may use; None: all."""
        if self.missions is None or self.user_missions is None:
            return self.user_missions if self.missions is None else self.missions
        return tuple(one for one in self.missions if one in self.user_missions)

    def expired(self, utc_ns: int) -> bool:
        """Return whether the validity has ended at a time."""
        return self.expires_utc_ns is not None and self.expires_utc_ns <= utc_ns

    def token(self, utc_ns: int) -> Token:
        """Return the token as it is at a time."""
        state = "expired" if self.expired(utc_ns) else "active"
        return Token.of(
            dict(self),
            user=self.name,
            state="revoked" if self.revoked_utc_ns is not None else state,
            kind=(
                "provider session"
                if self.provider_session is not None
                else "token"
                if self.parent_id is None
                else "session"
            ),
        )


class StoredAnswer(Entity):
    """Row of an idempotency key: the hash of its request, and the response; None until the work is done."""

    request: str
    answer: dict[str, Any] | None


class Session(Entity):
    """The caller of a request: its user, role and end of validity."""

    name: str = Field(examples=["ann"])
    role: Role
    missions: tuple[str, ...] | None = Field(
        default=None, description="Missions that the caller is limited to; null: all"
    )
    expires: UtcTime | None = Field(description="null: unlimited")
    browser: bool = Field(description="Whether the request used the cookie of a browser session")
    provider: bool = Field(default=False, description="Whether the session was started with an OpenID provider")
    time: UtcTime = Field(description="Mission time of the service: its clock, unless a simulation sets it")
    recorded: bool = Field(
        default=False, description="Whether the mission time is that of recorded passes, and nothing flies"
    )


class NewSession(RequestModel):
    """Token to start a browser session with."""

    token: str = Field(min_length=1, max_length=200)


class UserWithToken(Entity):
    """User and new token; the token cannot be read again."""

    user: User
    token: str


class NewUser(RequestModel):
    """User to add."""

    name: str = Field(pattern=USER_NAME, examples=["ann"])
    role: Role
    missions: Missions
    days_valid: Days


class UserChange(RequestModel):
    """Change of the state, role or missions of a user."""

    state: Literal["active", "disabled"] | None = None
    role: Role | None = None
    missions: MissionNames | None = Field(default=None, description="Empty: all missions")


class NewToken(RequestModel):
    """Token to create."""

    days_valid: Days
    missions: Missions
    revoke_others: bool = Field(default=False, description="Revoke all earlier tokens of the user")


class AuditEntry(Entity):
    """Entry of the audit log with its hash chain values."""

    number: int = Field(examples=[1], description="1 for the first entry, without gaps")
    time: UtcTime
    actor: str = Field(examples=["ann"])
    action: str = Field(examples=["release telecommand"])
    target: str = Field(examples=["7"])
    detail: dict[str, Any]
    previous_sha256: str = Field(description="Hash of the previous entry")
    sha256: str = Field(description="Hash of this entry")


class AuditHead(Entity):
    """Newest entry of the chain; a copy stored elsewhere shows whether the log was truncated later."""

    number: int = Field(examples=[1], description="0: no entry yet")
    sha256: str


class AuditFilter(Paging):
    """Entries of the audit log to list."""

    actor: Words | None = None
    action: Words | None = Field(default=None, description="Part of the action")
    target: Words | None = None
    since: RequestTime | None = None
    until: RequestTime | None = Field(default=None, description="UTC, RFC 3339; exclusive")
