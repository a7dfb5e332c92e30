"""Entities of ingests."""

from dataclasses import dataclass

from pydantic import ConfigDict, Field

from ground_service.http.model import Entity, InstanceName, Paging, RequestModel, SpacecraftNumber, UtcTime
from ground_service.toml import LINE_PATTERN_JSON
from tmtc.link.frames import UplinkSeen


class IngestAccepted(Entity):
    """A stored upload that will be ingested."""

    ingest_id: int = Field(examples=[1])
    job_id: str
    sha256: str
    octets: int


class ReceivedSection(Entity):
    """Octets [start, stop) of a file, the settings of their link, and the origin of the settings."""

    start: int
    stop: int
    source: str = Field(description="stated (by the sender), mission or default", examples=["mission"])
    frame_length: int = Field(examples=[1115])
    cadu_length: int = Field(examples=[1279])
    coding: str = Field(examples=["rs"])
    interleave: int | None
    rs_errors: int | None
    dual_basis: bool | None
    randomiser: str = Field(examples=["legacy"])
    checksum: bool


class ReceivedLink(Entity):
    """Link quality of one piece, see `ingest.quality.LinkContent`; null: unknown."""

    model_config = ConfigDict(extra="ignore", frozen=True)  # accountings of earlier versions have more fields

    station: str = Field(description="Empty: not stated", examples=["madrid"])
    frames: int
    frames_good: int
    codewords: int
    codewords_lost: int
    symbols_corrected: int
    wrong_bits: int
    checked_bits: int
    bit_error_rate: float | None
    lock_losses: int
    frames_inverted: int
    octets: int
    octets_frames: int
    octets_records: int
    octets_other: int
    first_utc_ns: int | None
    last_utc_ns: int | None
    sections: tuple[ReceivedSection, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedControlWords(UplinkSeen):
    """Telecommand channel of a spacecraft as reported in the frames of one file."""

    spacecraft_id: int


class IngestResult(Entity):
    """Content of an ingested piece of a recording with what it completes, and the new part of it.

    `first_ticks` and `last_ticks` are the earliest and the latest on-board time of the complete packets in the file.
    """

    ingest_id: int
    vehicle_id: int | None
    octets: int
    octets_repeated: int = Field(default=0, description="Octets that earlier pieces of the recording have")
    packets: int
    packets_new: int = Field(description="Packets that were not in the archive")
    packets_joined: int = Field(description="New packets completed with earlier pieces or other recordings")
    packets_repeated: int
    packets_implausible: int = Field(
        default=0, description="Packets kept apart because their on-board time is implausible"
    )
    samples: int
    crc_errors: int
    octets_skipped: int
    octets_pending: int = Field(
        description="Octets of an incomplete frame or packet at the ends of the recording as far as received"
    )
    frames: int
    frames_bad: int
    frames_joined: int = Field(description="Frames completed with earlier pieces")
    symbols_corrected: int
    unknown: int = Field(description="Packets without a definition")
    first_ticks: int | None = None
    last_ticks: int | None = None
    vehicle_ids: tuple[int, ...] = Field(default=(), description="Vehicles whose packets the file contains")
    reception: ReceivedLink | None = Field(default=None, description="null: bare packets")
    remark: str = Field(default="", description="Contradiction between the octets and the declared link; empty: none")
    uplink: tuple[ReceivedControlWords, ...] = ()


class Withdrawal(RequestModel):
    """Reason for the withdrawal of an ingest."""

    reason: str = Field(min_length=1, max_length=500, pattern=LINE_PATTERN_JSON, examples=["another flight"])


class ImplausibleFilter(Paging):
    """Packets with an implausible time to list."""

    spacecraft_id: SpacecraftNumber | None = None
    instance: InstanceName | None = None
    ingest_id: int | None = None


class ImplausiblePacket(Entity):
    """A packet whose on-board time is implausible: kept, but not used."""

    id: int
    spacecraft_id: int = Field(examples=[76])
    instance: str = Field(examples=["flight"])
    ingest_id: int
    apid: int
    sequence_count: int
    time: UtcTime = Field(description="On-board time, not corrected")
    reason: str = Field(examples=["1.1 d after all other telemetry, 1 of 10 packets agree"])


class Ingest(Entity):
    """One ingest of one file."""

    id: int = Field(examples=[1])
    state: str = Field(examples=["done"], description="queued, running, done, failed, withdrawing or withdrawn")
    sha256: str
    received: UtcTime
    finished: UtcTime | None
    error: str | None
    dictionary_version: int = Field(examples=[1])
    accounting: IngestResult | None = Field(description="null: not ingested yet, or by an earlier version")
