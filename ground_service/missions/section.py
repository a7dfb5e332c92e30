"""Base class of the sections of a mission description."""

from typing import Any

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

Array = Field(strict=False)
"""Field of a tuple that TOML gives as an array."""


class Section(BaseModel):
    """Base class of the sections: frozen, without undeclared keys or non-finite numbers.

    Values are not converted between types, such as true to 1; TOML arrays are read as tuples.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)


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
