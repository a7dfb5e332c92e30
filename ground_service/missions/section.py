"""Base class of the sections of a mission description."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

Array = Field(strict=False)
"""Field of a tuple that TOML gives as an array."""


class Section(BaseModel):
    """Base class of the sections: frozen, without undeclared keys or non-finite numbers.

    Values are not converted between types, such as true to 1; TOML arrays are read as tuples.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)
