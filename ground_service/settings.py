"""Settings of the deployment, read once at the edge from ``LINNA_*`` variables and passed on.

Nothing below the command line, the API factory and the worker reads the environment.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from pydantic import Field, SecretStr, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

from ground_service.errors import SettingsError


def default_home() -> Path:
    """Where the archive lives when ``LINNA_HOME`` is not set: the user's own data folder."""
    base = os.environ.get("XDG_DATA_HOME")
    return (Path(base) if base else Path.home() / ".local" / "share") / "linna"


class Settings(BaseSettings):
    """Everything that a deployment can set. The defaults need no server: SQLite and in-process jobs."""

    model_config = SettingsConfigDict(env_prefix="LINNA_", env_ignore_empty=True, extra="ignore")

    home: Path = Field(
        default_factory=default_home, description="Folder of the database, raw files and reports"
    )
    database_url: SecretStr | None = Field(
        default=None, description="SQLAlchemy URL; default: SQLite file linna.db under the home folder"
    )
    broker_url: SecretStr | None = Field(
        default=None, description="Celery broker such as redis://host:6379/0; default: jobs run in-process"
    )
    data: Path | None = Field(
        default=None, description="Folder of the public data products (gravity, kernels)"
    )
    host: str = Field(default="127.0.0.1", description="Address that the HTTP server binds to")
    port: int = Field(default=8042, ge=0, le=65535, description="Port of the HTTP server")
    live_console: str | None = Field(
        default=None,
        pattern=r"^[A-Za-z0-9.:-]+:[0-9]{1,5}$",
        description="HOST:PORT of the console of a payload flown live, for the live page",
    )
    log_format: Literal["text", "json"] = Field(default="text", description="Form of the log on stderr")
    rate_limit_per_s: float = Field(
        default=200.0, ge=0.0, description="Requests a second that one caller may make; 0: any number"
    )
    retention_days: int = Field(
        default=90, ge=1, description="Days for which the feed and finished jobs are kept"
    )
    upload_limit_mib: int = Field(default=4096, ge=1, description="Largest upload accepted, MiB")

    def resolved_database_url(self) -> str:
        """The SQLAlchemy URL in force."""
        if self.database_url is not None:
            return normalised_url(self.database_url.get_secret_value())
        return f"sqlite:///{self.home / 'linna.db'}"

    def resolved_live_console(self) -> tuple[str, int] | None:
        """Host and port of the console of a live payload; None where there is none."""
        if self.live_console is None:
            return None
        host, _, port = self.live_console.rpartition(":")
        return host, int(port)

    def resolved_broker_url(self) -> str | None:
        """The Celery broker in force; None for in-process jobs."""
        return self.broker_url.get_secret_value() if self.broker_url is not None else None


def load_settings(**given: object) -> Settings:
    """Settings from the environment, overridden by what is given (None means: not given).

    ``LINNA_DATABASE_URL_FILE`` and ``LINNA_BROKER_URL_FILE`` name files that hold the secret instead.

    Raises
    ------
    SettingsError
        If a value cannot be used; the message names the setting.
    """
    values = {name: value for name, value in given.items() if value is not None}
    for name in ("database_url", "broker_url"):
        path = os.environ.get(f"LINNA_{name.upper()}_FILE")
        if path and name not in values:
            try:
                values[name] = Path(path).read_text(encoding="utf-8").strip()
            except OSError as error:
                raise SettingsError(
                    f"LINNA_{name.upper()}_FILE", "a readable file", f"{path} ({error.strerror})"
                ) from None
    try:
        return Settings(**values)  # type: ignore[arg-type]
    except ValidationError as error:
        first = error.errors()[0]
        name = "LINNA_" + "_".join(str(part) for part in first["loc"]).upper()
        raise SettingsError(name, first["msg"].lower(), repr(first.get("input"))) from None


def normalised_url(url: str) -> str:
    """The URL with the driver that is installed, for the spellings people use."""
    for prefix in ("postgres://", "postgresql://"):
        if url.startswith(prefix):
            return "postgresql+psycopg://" + url[len(prefix) :]
    return url
