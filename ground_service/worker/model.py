"""Entities of the state of the service."""

from __future__ import annotations

from pydantic import Field

from ground_service.http.model import Entity


class Health(Entity):
    """State of the service."""

    status: str = Field(examples=["ok"])
