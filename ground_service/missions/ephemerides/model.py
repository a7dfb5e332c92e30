"""Entities of reference ephemerides."""

from pydantic import Field

from ground_service.http.model import Entity, UtcTime


class Ephemeris(Entity):
    """A reference ephemeris."""

    id: int = Field(examples=[1])
    name: str = Field(examples=["reference of pass 12"])
    object_name: str = Field(examples=["SELENITA"])
    frame: str = Field(examples=["ICRF"])
    start: UtcTime
    stop: UtcTime
    states: int = Field(examples=[241])
    precedence: int = Field(examples=[0], description="The highest precedence is preferred")
    sha256: str
