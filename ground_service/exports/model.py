"""Entities of exports."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, WithJsonSchema

from ground_service.exports.formats import FORMATS
from ground_service.http.model import Entity, Given


def _known(name: str) -> str:
    if name not in FORMATS:
        raise ValueError(f"expected one of {', '.join(FORMATS)}, found {name!r}")
    return name


FormatName = Annotated[str, AfterValidator(_known), WithJsonSchema({"type": "string", "enum": list(FORMATS)})]


class ExportRequest(Given):
    """A pass, and the format of its export."""

    pass_id: int = Field(ge=1, le=2**31 - 1, examples=[1])
    format: FormatName = Field(examples=["geojson"])
    states: str = Field(
        default="reference",
        min_length=1,
        max_length=40,
        examples=["reference"],
        description="States of orbits and maps: `reference`, or the name of an estimator",
    )
    version: Literal["1.0", "2.0"] = Field(default="2.0", description="Version of a CCSDS AEM")


class ExportFormatInfo(Entity):
    """A format of exports."""

    name: str = Field(examples=["geojson"])
    description: str
    ending: str = Field(examples=["geojson"], description="Ending of the file; zip: several files")
    states: bool = Field(description="The request chooses the states")
    extra: str = Field(
        description="Extra of the installation that the format needs; empty: none", examples=["geo"]
    )
    available: bool = Field(description="The library of the extra is installed")
