"""Base classes of requests and responses."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Schema(BaseModel):
    """Base of everything sent; what is not known is refused."""

    model_config = ConfigDict(extra="forbid")


class Given(Schema):
    """Base class of requests; values are not converted between types, such as true to 1."""

    model_config = ConfigDict(extra="forbid", strict=True)
