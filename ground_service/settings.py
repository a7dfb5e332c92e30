"""Settings of the deployment, read once at the edge from ``LINNA_*`` variables and passed on.

Nothing below the command line, the API factory and the worker reads the environment.
"""

import ipaddress
import os
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import quote, urlsplit

from pydantic import BeforeValidator, Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from ground_service import logs
from ground_service.errors import SettingsError

URLS = ("database_url", "migration_database_url", "broker_url")
SECRETS = ("oidc_client_secret", "objects_access_key", "objects_secret_key")


def default_home() -> Path:
    """Return the folder of the archive if ``LINNA_HOME`` is not set: the user's own data folder."""
    base = os.environ.get("XDG_DATA_HOME")
    return (Path(base) if base else Path.home() / ".local" / "share") / "linna"


def _words(value: object) -> object:
    """Return the entries of a comma-separated list."""
    return tuple(word.strip() for word in value.split(",") if word.strip()) if isinstance(value, str) else value


Words = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_words)]


class Settings(BaseSettings):
    """Everything that a deployment can set. The defaults need no server: SQLite and in-process jobs."""

    model_config = SettingsConfigDict(env_prefix="LINNA_", env_ignore_empty=True, extra="ignore")

    home: Path = Field(default_factory=default_home, description="Folder of the database, raw files and reports")
    database_url: SecretStr | None = Field(
        default=None, description="SQLAlchemy URL; default: SQLite file linna.db under the home folder"
    )
    migration_database_url: SecretStr | None = Field(
        default=None,
        description="URL of the owner of the schema, used only by `linna db upgrade`, which then grants the role of "
        "LINNA_DATABASE_URL its rights; default: LINNA_DATABASE_URL",
    )
    backup_role: str | None = Field(
        default=None, description="Database role for backups: `linna db upgrade` grants it the right to read all tables"
    )
    allow_database_owner: bool = Field(
        default=False,
        description="Permit a database role that can change the schema or the audit log, for example on a laptop",
    )
    broker_url: SecretStr | None = Field(
        default=None, description="Celery broker such as redis://host:6379/0; default: jobs run in-process"
    )
    data: Path | None = Field(default=None, description="Folder of the public data products (gravity, kernels)")
    clock_file: Path | None = Field(
        default=None,
        description="File with the mission time of a simulated mission, written by `linna emulate --live`; "
        "default: the wall clock",
    )
    host: str = Field(default="127.0.0.1", description="Address that the HTTP server binds to")
    port: int = Field(default=8042, ge=0, le=65535, description="Port of the HTTP server")
    objects: str | None = Field(
        default=None,
        pattern=r"^s3://[a-z0-9][a-z0-9.-]{1,61}[a-z0-9](/[A-Za-z0-9._/-]*)?$",
        description="Bucket of an object store (S3) for all files, such as s3://linna/operations; the folders under "
        "LINNA_HOME are then caches; needs the extra `objects`; default: folders under LINNA_HOME",
    )
    objects_endpoint: str | None = Field(
        default=None, pattern=r"^https?://", description="URL of the object store; default: that of AWS"
    )
    objects_region: str | None = Field(default=None, description="Region of the object store")
    objects_access_key: SecretStr | None = Field(
        default=None,
        description="Access key of the object store; default: what the AWS libraries find, such as a role of the host",
    )
    objects_secret_key: SecretStr | None = Field(default=None, description="Secret key of the object store")
    objects_cache_gib: float = Field(
        default=20.0, ge=0.0, description="Size that the cache of an object store is trimmed to, GiB"
    )
    oidc_issuer: str | None = Field(
        default=None,
        description="Issuer of an OpenID provider for sign-in, such as https://login.example.org/realms/ops; needs the "
        "extra `oidc`; default: sign-in with tokens only",
    )
    oidc_client_id: str | None = Field(default=None, description="Name of this service at the OpenID provider")
    oidc_client_secret: SecretStr | None = Field(
        default=None, description="Secret of this service at the OpenID provider; default: a public client"
    )
    oidc_scopes: Words = Field(
        default=("profile",), description="Comma-separated scopes to ask for, in addition to openid"
    )
    oidc_name_claim: str = Field(
        default="preferred_username", description="Claim of the ID token with the name of the user"
    )
    oidc_role_claim: str = Field(
        default="roles",
        description="Claim of the ID token with groups or roles; a dot leads into an object: realm_access.roles",
    )
    oidc_roles: Words = Field(
        default=(),
        description="Comma-separated entries ROLE=VALUE: which value of the claim gives which role, such as "
        "admin=linna-admins,operator=linna-operators,viewer=linna-viewers",
    )
    live_console: str | None = Field(
        default=None,
        pattern=r"^[A-Za-z0-9.:-]+:[0-9]{1,5}$",
        description="HOST:PORT of the console of a payload flown live, for the live page",
    )
    openmct: Path | None = Field(
        default=None,
        description="Folder of the npm package openmct for the telemetry displays at /mct; "
        "default: the one that `make openmct` installs",
    )
    links: bool = Field(
        default=True,
        description="Operate the links of mission descriptions in `linna serve`; false where `linna link run` does",
    )
    plan_hourly: bool = Field(
        default=True,
        description="Bring the plan up to date once an hour of mission time; false: only after events such as the end "
        "of a contact, so that the plan of a simulated mission does not depend on the speed of the machine",
    )
    traces: str | None = Field(
        default=None,
        pattern=r"^https?://",
        description="URL of an OpenTelemetry collector (OTLP over HTTP) for traces, such as "
        "http://collector:4318/v1/traces; needs the extra `traces`; default: none",
    )
    backups: Path | None = Field(
        default=None, description="Folder of backups, whose age the metrics and the status state"
    )
    audit_heads: str | None = Field(
        default=None,
        description="Folder of another machine, or channel:NAME of a mission description, to which the nightly job "
        "writes the head of the audit chain, signed with the key in secrets/audit under LINNA_HOME",
    )
    log_format: Literal["text", "json"] = Field(default="text", description="Form of the log on stderr")
    allowed_hosts: Words = Field(
        default=(),
        description="Comma-separated host names of the service for browsers and programs, "
        "in addition to localhost and the addresses it listens on",
    )
    trusted_proxies: Words = Field(
        default=(),
        description="Comma-separated addresses or networks of reverse proxies whose X-Forwarded-For and "
        "-Proto headers are accepted; headers of other peers are ignored",
    )
    notify_networks: Words = Field(
        default=(),
        description="Comma-separated addresses or networks of webhooks and mail servers that are not public, such as "
        "127.0.0.1 or 10.0.0.0/8; notifications to other addresses that are not public are refused",
    )
    retention_days: int = Field(default=90, ge=1, description="Days for which the feed and finished jobs are kept")
    archive_days: int = Field(
        default=0,
        ge=0,
        description="Days after their last use for which regression archives are kept; 0: without limit",
    )
    archive_limit_mib: int = Field(
        default=0, ge=0, description="Size of the kept regression archives in MiB, pinned ones included; 0: any"
    )
    placebo_passes: int = Field(
        default=3,
        ge=0,
        le=100,
        description="Kept archives over which the installed flight code is compared with itself every night, with "
        "other noise in the images; 0: none",
    )
    runner_exchange: Path | None = Field(
        default=None,
        description="Folder shared with a runner (`linna runner`) that runs payload builds; "
        "default: builds run in a local sandbox, or are refused",
    )
    sockets: int = Field(default=500, ge=1, description="Simultaneous WebSockets")
    sockets_per_user: int = Field(
        default=30, ge=1, description="Simultaneous WebSockets of one user, or of one address without users"
    )
    drain_s: float = Field(
        default=0.0,
        ge=0.0,
        le=600.0,
        description="Seconds for which `linna serve` answers requests after SIGTERM while /readyz tells proxies to use "
        "other processes; then it finishes its requests and ends",
    )
    upload_limit_mib: int = Field(default=4096, ge=1, description="Largest upload accepted, MiB")

    @field_validator("broker_url")
    @classmethod
    def _broker(cls, value: SecretStr | None) -> SecretStr | None:
        parts = urlsplit(value.get_secret_value() if value else "redis://none")
        if parts.scheme not in ("redis", "rediss") or not parts.hostname:
            raise ValueError("expected a URL such as redis://host:6379/0, found another one")
        return value

    @field_validator("trusted_proxies", "notify_networks")
    @classmethod
    def _networks(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for text in value:
            try:
                ipaddress.ip_network(text)
            except ValueError:
                raise ValueError(f"expected IP addresses or networks, found {text!r}") from None
        return value

    @field_validator("oidc_issuer")
    @classmethod
    def _issuer(cls, value: str | None) -> str | None:
        parts = urlsplit(value or "https://none")
        local = parts.hostname in ("127.0.0.1", "::1", "localhost")
        if not parts.hostname or parts.query or parts.fragment or parts.username is not None:
            raise ValueError(f"expected the address of an OpenID provider, found {value!r}")
        if parts.scheme != "https" and not (parts.scheme == "http" and local):
            raise ValueError(f"expected an https address, found {value!r}")
        return value

    @field_validator("oidc_roles")
    @classmethod
    def _roles(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for entry in value:
            role, mark, word = entry.partition("=")
            if role not in ("viewer", "operator", "admin") or not mark or not word:
                raise ValueError(f"expected viewer=, operator= or admin= and a value, found {entry!r}")
        return value

    @property
    def kept(self) -> dict[str, Any]:
        """Arguments of the nightly job: for how long, or up to which size, data are kept."""
        named = {"retention_days", "archive_days", "archive_limit_mib", "audit_heads", "placebo_passes"}
        return self.model_dump(include=named)

    def resolved_database_url(self) -> str:
        """The SQLAlchemy URL in force."""
        if self.database_url is not None:
            return normalised_url(self.database_url.get_secret_value())
        return f"sqlite:///{self.home / 'linna.db'}"

    def resolved_migration_url(self) -> str:
        """Return the SQLAlchemy URL for changes of the schema."""
        if self.migration_database_url is not None:
            return normalised_url(self.migration_database_url.get_secret_value())
        return self.resolved_database_url()

    def resolved_live_console(self) -> tuple[str, int] | None:
        """Host and port of the console of a live payload; None where there is none."""
        if self.live_console is None:
            return None
        host, _, port = self.live_console.rpartition(":")
        return host, int(port)

    def resolved_broker_url(self) -> str | None:
        """The Celery broker in force; None for in-process jobs."""
        return self.broker_url.get_secret_value() if self.broker_url is not None else None

    @property
    def redis_url(self) -> str | None:
        """The Celery broker in force if it is Redis, which wakes up other processes."""
        broker = self.resolved_broker_url()
        return broker if broker is not None and broker.startswith(("redis://", "rediss://")) else None


def load_settings(**given: object) -> Settings:
    """Return the settings of the environment, overridden by the arguments that are not None.

    For each setting of `URLS` and `SECRETS`, a variable such as ``LINNA_DATABASE_URL_FILE`` names a file that contains
    the value instead; ``LINNA_DATABASE_PASSWORD_FILE`` and the like name files with the password alone, for a URL that
    has a user and no password.

    Raises
    ------
    SettingsError
        If a value is invalid; the message names the setting.
    """
    values: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    for name in (*URLS, *SECRETS):
        path = os.environ.get(f"LINNA_{name.upper()}_FILE")
        if path and name not in values:
            values[name] = _secret(name, path)
    for name in URLS:
        password = os.environ.get(f"LINNA_{name.removesuffix('_url').upper()}_PASSWORD_FILE")
        url = values.get(name) or os.environ.get(f"LINNA_{name.upper()}")
        if password and url:
            values[name] = _with_password(
                f"LINNA_{name.upper()}", str(url), _secret(f"{name.removesuffix('_url')}_password", password)
            )
    try:
        return Settings(**values)
    except ValidationError as error:
        first = error.errors()[0]
        name = "LINNA_" + "_".join(str(part) for part in first["loc"]).upper()
        if first["type"] == "value_error":
            expected, _, found = str(first["ctx"]["error"]).removeprefix("expected ").partition(", found ")
            raise SettingsError(name, expected, found) from None
        raise SettingsError(name, first["msg"].lower(), repr(first.get("input"))) from None


def start_tracing(settings: Settings) -> None:
    """Send traces of this process to the collector of the settings, if they name one.

    Raises
    ------
    SettingsError
        If OpenTelemetry is not installed.
    """
    try:
        logs.configure(settings.traces)
    except ImportError as error:
        raise SettingsError("LINNA_TRACES", "the extra 'traces' to be installed", str(error)) from None


def _secret(name: str, path: str) -> str:
    variable = f"LINNA_{name.upper()}_FILE"
    try:
        value = Path(path).read_text(encoding="utf-8").strip()
    except OSError as error:
        raise SettingsError(variable, "a readable file", f"{path} ({error.strerror})") from None
    except ValueError:
        raise SettingsError(variable, "a text file (UTF-8)", f"other octets in {path}") from None
    if not value.isprintable():
        raise SettingsError(variable, "one line", f"control characters or further lines in {path}")
    if not value:
        # Without a value, the service would continue with the default, such as SQLite.
        raise SettingsError(variable, "a file with a value", f"an empty file {path}")
    return value


def _with_password(name: str, url: str, password: str) -> str:
    """Return the URL with this password if it has a user without a password."""
    scheme, mark, rest = url.partition("://")
    user, _, place = rest.rpartition("@")
    if ":" in user or scheme.startswith("sqlite"):
        return url
    if not user:
        raise SettingsError(name, "a URL with a user, whose password is in a file", repr(url))
    return f"{scheme}{mark}{user}:{quote(password, safe='')}@{place}"


def normalised_url(url: str) -> str:
    """The URL with the driver that is installed, for the spellings people use."""
    for prefix in ("postgres://", "postgresql://"):
        if url.startswith(prefix):
            return "postgresql+psycopg://" + url[len(prefix) :]
    return url
