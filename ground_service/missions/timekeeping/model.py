"""Entities of time reports and time correlations."""

from pydantic import Field

from ground_service.http.model import Entity, RequestModel, RequestTime, UtcTime

RECEPTIONS_LIMIT = 100_000
"""Largest number of reception times of time reports of a vehicle."""


class TimePointIn(RequestModel):
    """A time report as it was received."""

    ticks: int = Field(ge=0, lt=2**48, description="On-board time, 2^-16 s")
    received: RequestTime = Field(description="Earth reception time")
    light_time_s: float = Field(ge=0.0, le=10.0, allow_inf_nan=False, examples=[1.28])
    boot_count: int = Field(default=0, ge=0, le=65_535)


class TimePoints(RequestModel):
    """Time reports of one spacecraft."""

    points: list[TimePointIn] = Field(min_length=1, max_length=10_000)


class ReceptionIn(RequestModel):
    """Earth reception time of a time report; its packet may arrive before or after this."""

    packet_ticks: int = Field(ge=0, lt=2**48, description="On-board time in the packet's header, 2^-16 s")
    sequence_count: int = Field(ge=0, lt=2**14, description="Count in the packet's header")
    received: RequestTime
    station: str = Field(default="", max_length=64, description="Empty: light time to the Earth's centre")


class Receptions(RequestModel):
    """Receptions of time reports of one spacecraft."""

    receptions: list[ReceptionIn] = Field(min_length=1, max_length=10_000)


class TimeReport(Entity):
    """A received time report and its residual to the correlation in force."""

    packet_ticks: int
    sequence_count: int
    reported_ticks: int
    received: UtcTime
    station: str
    light_time_s: float = Field(examples=[1.28])
    boot_count: int
    correlation_id: int = Field(description="0 is an ideal clock")
    residual_ns: int
    remark: str = Field(default="", description="Reason of exclusion: the clock of the station is doubted")


class Correlation(Entity):
    """A straight line from on-board time to UTC over one run of the clock."""

    id: int
    boot_count: int | None
    start_ticks: int
    stop_ticks: int
    reference_ticks: int
    reference: UtcTime = Field(description="UTC of reference_ticks, to the microsecond")
    reference_utc_ns: int = Field(description="UTC of reference_ticks in nanoseconds since 1970")
    drift_ppb: float
    residual_rms_ns: float | None
    residual_max_ns: float | None
    points: int
    rejected: int = Field(description="Time reports rejected as outliers")
    method: str = Field(examples=["time reports, light time"])
    in_force: bool
    created: UtcTime
