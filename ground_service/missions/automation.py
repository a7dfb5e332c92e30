"""Sections `[automation]` and `[notify]` of a mission description, and how those of earlier versions are read."""

import logging
from collections.abc import Mapping
from typing import Annotated, Any, Final, Self
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, model_validator
from pydantic_core import CoreSchema, core_schema

Array = Field(strict=False)
"""Field of a tuple that TOML gives as an array."""


class Section(BaseModel):
    """Base class of the sections: frozen, without undeclared keys or non-finite numbers.

    Values are not converted between types, such as true to 1; TOML arrays are read as tuples.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True, defer_build=True)


class Table:
    """Annotation of a section that is a dataclass: it is read from a table, its tuples from arrays."""

    @staticmethod
    def __get_pydantic_core_schema__(kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        schema = handler(kind)
        handler.resolve_ref_schema(schema)["strict"] = False  # type: ignore[index]
        return core_schema.no_info_before_validator_function(_with_tuples, schema)


def _with_tuples(table: Any) -> Any:
    if not isinstance(table, dict):
        return table
    return {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}


log = logging.getLogger(__name__)

WITHDRAWN: Final = {
    "rules": "no rules (the follow-up of an event is fixed, and alert rules are those of Prometheus)",
    "channels": "receivers of notifications as [notify.NAME]",
}
"""Keys of `[automation]` in earlier versions, and what is expected in their place."""

ChannelName = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9._-]+$")]


class Channel(Section):
    """Receiver of notifications.

    Attributes
    ----------
    webhook
        Address (http or https) that receives a JSON document by POST.
    email
        Addresses that receive a message.
    smtp, sender
        Mail server as HOST:PORT, and the sender of messages.
    signing_secret
        Name of the file in the folder `secrets` of the service with the key of the webhook's HMAC-SHA256 signature.
    """

    webhook: Annotated[str, Field(pattern=r"^https?://[^\s]+$", max_length=1000)] | None = None
    email: Annotated[tuple[Annotated[str, Field(pattern=r"^[^@\s]+@[^@\s]+$")], ...], Array] | None = None
    smtp: Annotated[str, Field(pattern=r"^[^\s:/]+:[0-9]{1,5}$")] = "localhost:25"
    sender: Annotated[str, Field(pattern=r"^[^@\s]+@[^@\s]+$")] = "linna@localhost"
    signing_secret: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9._-]*$", max_length=64)] | None = None

    @property
    def server(self) -> tuple[str, int]:
        """Host and port of the webhook or of the mail server."""
        if self.webhook is not None:
            parts = urlsplit(self.webhook)
            return parts.hostname or "", parts.port or (443 if parts.scheme == "https" else 80)
        host, _, port = self.smtp.rpartition(":")
        return host, int(port)

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.webhook is None) == (not self.email):
            raise ValueError("either webhook or email")
        if self.signing_secret is not None and self.webhook is None:
            raise ValueError("signing_secret with a webhook only")
        return self


class Automation(Section):
    """Automatic operation.

    Attributes
    ----------
    evaluate
        Whether passes are evaluated and reported and their archives kept without a request; not stated: true.
    landmarks
        Whether each processed pass is searched for landmarks; not stated: false.
    """

    evaluate: bool | None = None
    landmarks: bool | None = None

    @model_validator(mode="before")
    @classmethod
    def _without_rules(cls, table: Any) -> Any:
        for key, expected in WITHDRAWN.items():
            if isinstance(table, Mapping) and key in table:
                raise ValueError(f"{expected}, found automation.{key}")
        return table


def without_rules(table: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return the table of a description that an earlier version stored, in the present form.

    Channels receive the notifications. Rules have no effect, which a remark in the log states; an empty list of rules
    meant that nothing follows an event.
    """
    automation = dict(table.get("automation", {}))
    rules, channels = automation.pop("rules", None), automation.pop("channels", None)
    if rules:
        log.warning("%s: %d rules of an earlier version have no effect, see docs/automation.md", source, len(rules))
    elif rules is not None:
        automation.setdefault("evaluate", False)
    return {**table, "automation": automation, **({"notify": channels} if channels else {})}
