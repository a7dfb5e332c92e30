"""Tables of the service.

The record is `packets` (octets, once, by content) and `files`; the sample tables hold what one dictionary
version decodes from a packet and can be made again from it. Sample tables are clustered by
(vehicle, dictionary version, time, packet), so a time range of one vehicle is one contiguous read.

Times on board are ``ticks`` (2^-16 s since 2000-01-01 TAI); times on the ground are ``utc_ns``. The UTC of a
sample is computed from its ticks with a time correlation when it is read, so late data never need rewriting.
A vehicle is one spacecraft in one `instance`: the flown one, or one emulated or replayed run, each a domain of
its own for time and sequence counts.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    Double,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    SmallInteger,
    String,
    Text,
    UniqueConstraint,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

NO_TICKS = -1
"""On-board time of a packet that carries none."""

BigKey = BigInteger().with_variant(Integer, "sqlite")
Flag = SmallInteger


class Base(DeclarativeBase):
    """Base of all tables, with names for every constraint so that migrations can find them."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


class File(Base):
    """A file of the archive, stored once under the SHA-256 of its octets."""

    __tablename__ = "files"
    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    kind: Mapped[str] = mapped_column(String(32))
    name: Mapped[str] = mapped_column(Text)
    octets: Mapped[int] = mapped_column(BigInteger)
    received_utc_ns: Mapped[int] = mapped_column(BigInteger)


class Vehicle(Base):
    """A spacecraft in one instance: a domain of time, boots and sequence counts.

    `decoded_version` is the dictionary version that has decoded all of its packets, the one to read; NULL before the
    first. While a newer one decodes them again, `redecoded_to` is the last packet that it has done and `redecode_until`
    the last that it has to do.
    """

    __tablename__ = "vehicles"
    __table_args__ = (UniqueConstraint("ccsds_id", "instance"),)
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    ccsds_id: Mapped[int] = mapped_column(Integer)
    instance: Mapped[str] = mapped_column(String(96))
    decoded_version: Mapped[int | None] = mapped_column(SmallInteger)
    redecoding_version: Mapped[int | None] = mapped_column(SmallInteger)
    redecoded_to: Mapped[int | None] = mapped_column(BigInteger)
    redecode_until: Mapped[int | None] = mapped_column(BigInteger)


class Ingest(Base):
    """One run of the ingest over one file: what was in it and what of it was new."""

    __tablename__ = "ingests"
    id: Mapped[int] = mapped_column(BigKey, primary_key=True)
    vehicle_id: Mapped[int | None] = mapped_column(ForeignKey("vehicles.id"), index=True)
    file_sha256: Mapped[str] = mapped_column(ForeignKey("files.sha256"), index=True)
    state: Mapped[str] = mapped_column(String(16))
    error: Mapped[str | None] = mapped_column(Text)
    dictionary_version: Mapped[int] = mapped_column(Integer)
    received_utc_ns: Mapped[int] = mapped_column(BigInteger)
    finished_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    accounting: Mapped[dict[str, Any]] = mapped_column(JSON)


class Packet(Base):
    """A space packet, immutable, once per vehicle by content."""

    __tablename__ = "packets"
    __table_args__ = (UniqueConstraint("vehicle_id", "apid", "ticks", "sequence_count", "digest"),)
    id: Mapped[int] = mapped_column(BigKey, primary_key=True)
    vehicle_id: Mapped[int] = mapped_column(Integer)
    apid: Mapped[int] = mapped_column(SmallInteger)
    sequence_count: Mapped[int] = mapped_column(SmallInteger)
    ticks: Mapped[int] = mapped_column(BigInteger)
    digest: Mapped[bytes] = mapped_column(LargeBinary(16))
    octets: Mapped[bytes] = mapped_column(LargeBinary)


class Piece(Base):
    """Ingested file of a downlink, and its position in its stream.

    Pieces of one `scope` (instance of the spacecraft) can be joined. `spacecraft_id` selects the frames of
    one spacecraft; NULL: those of every spacecraft. `stream` and `position` (octets from its start) are stated by the
    sender. Otherwise, `stream` is empty and `position` is the number of the ingest, so that successive ingests are
    adjacent. `station` (empty: not stated) and `link` (text of the settings, NULL: not stated) are those of the sender.
    `links_tried` is the number of known links of the scope that could not read it; NULL if one could.
    `packets_stored` counts the new packets that the ingest added to the archive, `packets_joined` those of them that
    were joined with other pieces, and `samples_stored` their samples, over all attempts of the ingest.
    """

    __tablename__ = "pieces"
    __table_args__ = (
        Index("ix_pieces_place", "scope", "stream", "position"),
        Index("ix_pieces_unread", "scope", "links_tried"),
    )
    ingest_id: Mapped[int] = mapped_column(ForeignKey("ingests.id"), primary_key=True, autoincrement=False)
    scope: Mapped[str] = mapped_column(String(128))
    spacecraft_id: Mapped[int | None] = mapped_column(Integer)
    file_sha256: Mapped[str] = mapped_column(ForeignKey("files.sha256"), index=True)
    octets: Mapped[int] = mapped_column(BigInteger)
    stream: Mapped[str] = mapped_column(String(200))
    position: Mapped[int] = mapped_column(BigInteger)
    links_tried: Mapped[int | None] = mapped_column(Integer)
    station: Mapped[str] = mapped_column(String(64))
    link: Mapped[str | None] = mapped_column(String(200))
    packets_stored: Mapped[int] = mapped_column(BigInteger, default=0)
    packets_joined: Mapped[int] = mapped_column(BigInteger, default=0)
    samples_stored: Mapped[int] = mapped_column(BigInteger, default=0)


class GoodLink(Base):
    """Link settings under which a spacecraft was received by a station; the newest row is used first."""

    __tablename__ = "good_links"
    __table_args__ = (Index("ix_good_links_newest", "vehicle_id", "station", "id"),)
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"))
    station: Mapped[str] = mapped_column(String(64))
    settings: Mapped[dict[str, Any]] = mapped_column(JSON)
    ingest_id: Mapped[int] = mapped_column(ForeignKey("ingests.id"))
    since_utc_ns: Mapped[int] = mapped_column(BigInteger)


class KnownLink(Base):
    """Link found for the downlinks of a scope; `settings` NULL: bare packets."""

    __tablename__ = "known_links"
    __table_args__ = (UniqueConstraint("scope", "digest"),)
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    scope: Mapped[str] = mapped_column(String(128))
    digest: Mapped[str] = mapped_column(String(16))
    settings: Mapped[dict[str, Any] | None] = mapped_column(JSON)


class StreamEdge(Base):
    """Octets of a CADU or packet that was cut, stored until the adjacent octets are received.

    `domain` names the edges that may be joined: those of the raw octets of one link, or of one virtual channel. `role`,
    `count`, `next_count` and `fit` are those of `link.edges.Edge`, -1 if unknown; the `count` of an opener is its
    `next_count`. `open` is 0 when the octets have been used; they are then deleted. `start` is their position in
    `file_sha256`, NULL for octets of a channel.
    """

    __tablename__ = "stream_edges"
    __table_args__ = (
        UniqueConstraint("domain", "identity"),
        Index("ix_stream_edges_fit", "domain", "role", "open", "fit", "count"),
        Index("ix_stream_edges_count", "domain", "role", "open", "count"),
        Index("ix_stream_edges_next", "domain", "role", "open", "next_count"),
        Index("ix_stream_edges_newest", "domain", "role", "open", "id"),
        Index("ix_stream_edges_file", "file_sha256", "open"),
    )
    id: Mapped[int] = mapped_column(BigKey, primary_key=True)
    domain: Mapped[str] = mapped_column(String(200))
    identity: Mapped[bytes] = mapped_column(LargeBinary(16))
    role: Mapped[int] = mapped_column(SmallInteger)
    open: Mapped[int] = mapped_column(SmallInteger)
    count: Mapped[int] = mapped_column(SmallInteger)
    next_count: Mapped[int] = mapped_column(SmallInteger)
    fit: Mapped[int] = mapped_column(Integer)
    file_sha256: Mapped[str | None] = mapped_column(String(64))
    start: Mapped[int | None] = mapped_column(BigInteger)
    length: Mapped[int] = mapped_column(Integer)
    octets: Mapped[bytes] = mapped_column(LargeBinary)


class Sample:
    """Columns that every decoded sample has.

    Packets and samples carry no foreign keys: they are written in bulk, in one transaction with what they
    point to, and a check per row would cost more than the row.
    """

    vehicle_id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False, sort_order=-1)
    dictionary_version: Mapped[int] = mapped_column(
        SmallInteger, primary_key=True, autoincrement=False, sort_order=-1
    )
    ticks: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False, sort_order=-1)
    packet_id: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False, sort_order=-1)


CLUSTERED = {"sqlite_with_rowid": False}


class Housekeeping(Sample, Base):
    """Engineering values of a housekeeping report; `ticks` is the packet's time."""

    __tablename__ = "housekeeping"
    __table_args__ = CLUSTERED
    boot_count: Mapped[int] = mapped_column(Integer)
    mode: Mapped[int] = mapped_column(SmallInteger)
    frames_processed: Mapped[int] = mapped_column(BigInteger)
    frames_bad: Mapped[int] = mapped_column(BigInteger)
    detections_total: Mapped[int] = mapped_column(BigInteger)
    packets_sent: Mapped[int] = mapped_column(BigInteger)
    anchor_reads: Mapped[int] = mapped_column(BigInteger)
    events_sent: Mapped[int] = mapped_column(BigInteger)
    telecommands_accepted: Mapped[int] = mapped_column(Integer)
    telecommands_rejected: Mapped[int] = mapped_column(Integer)
    last_image_quality: Mapped[int] = mapped_column(SmallInteger)
    temperature_c: Mapped[float] = mapped_column(Double)
    bus_voltage_v: Mapped[float] = mapped_column(Double)
    power_w: Mapped[float] = mapped_column(Double)
    memory_used_kib: Mapped[int] = mapped_column(BigInteger)
    queue_depth: Mapped[int] = mapped_column(Integer)
    storage_used_permille: Mapped[int] = mapped_column(Integer)
    model_hash: Mapped[int] = mapped_column(BigInteger)
    parameters_hash: Mapped[int] = mapped_column(BigInteger)
    catalogue_hash: Mapped[int] = mapped_column(BigInteger)
    anchor_table_hash: Mapped[int] = mapped_column(BigInteger)
    clock_status: Mapped[int] = mapped_column(SmallInteger)
    watchdog_resets: Mapped[int] = mapped_column(Integer)


class DetectionFrame(Sample, Base):
    """Detections of one image; `ticks` is the image's time, `items` packed as `store.codec.DETECTION_ITEM`."""

    __tablename__ = "detections"
    __table_args__ = CLUSTERED
    packet_ticks: Mapped[int] = mapped_column(BigInteger)
    frame_number: Mapped[int] = mapped_column(BigInteger)
    image_quality: Mapped[int] = mapped_column(SmallInteger)
    count: Mapped[int] = mapped_column(SmallInteger)
    items: Mapped[bytes] = mapped_column(LargeBinary)


class NavigationState(Sample, Base):
    """State of one on-board estimator; `ticks` is the image's time."""

    __tablename__ = "navigation_states"
    __table_args__ = CLUSTERED
    packet_ticks: Mapped[int] = mapped_column(BigInteger)
    frame_number: Mapped[int] = mapped_column(BigInteger)
    estimator: Mapped[int] = mapped_column(SmallInteger)
    outcome: Mapped[int] = mapped_column(SmallInteger)
    latitude_deg: Mapped[float | None] = mapped_column(Double)
    longitude_deg: Mapped[float | None] = mapped_column(Double)
    altitude_m: Mapped[float | None] = mapped_column(Double)
    velocity_x_m_s: Mapped[float | None] = mapped_column(Float)
    velocity_y_m_s: Mapped[float | None] = mapped_column(Float)
    velocity_z_m_s: Mapped[float | None] = mapped_column(Float)
    sigma_r_m: Mapped[float | None] = mapped_column(Float)
    sigma_t_m: Mapped[float | None] = mapped_column(Float)
    sigma_n_m: Mapped[float | None] = mapped_column(Float)
    nis: Mapped[float | None] = mapped_column(Float)
    matched: Mapped[int] = mapped_column(SmallInteger)


class FrameOutcome(Sample, Base):
    """What one estimator made of one image; `ticks` is the image's time."""

    __tablename__ = "frame_outcomes"
    __table_args__ = CLUSTERED
    packet_ticks: Mapped[int] = mapped_column(BigInteger)
    frame_number: Mapped[int] = mapped_column(BigInteger)
    estimator: Mapped[int] = mapped_column(SmallInteger)
    outcome: Mapped[int] = mapped_column(SmallInteger)
    reset_trigger: Mapped[int] = mapped_column(SmallInteger)
    detections: Mapped[int] = mapped_column(SmallInteger)
    candidate_pairs: Mapped[int] = mapped_column(Integer)
    pairs: Mapped[int] = mapped_column(SmallInteger)
    shift_east_m: Mapped[float | None] = mapped_column(Float)
    shift_north_m: Mapped[float | None] = mapped_column(Float)
    anchor_reads: Mapped[int] = mapped_column(BigInteger)


class Event(Sample, Base):
    """An event report; `ticks` is the packet's time, `severity` 1 (info) to 4 (high)."""

    __tablename__ = "events"
    __table_args__ = CLUSTERED
    severity: Mapped[int] = mapped_column(SmallInteger)
    event_id: Mapped[int] = mapped_column(Integer)
    frame_number: Mapped[int] = mapped_column(BigInteger)
    value_1: Mapped[float | None] = mapped_column(Double)
    value_2: Mapped[float | None] = mapped_column(Double)


class TimeReport(Sample, Base):
    """A time report; `ticks` is the packet's time."""

    __tablename__ = "time_reports"
    __table_args__ = CLUSTERED
    reported_ticks: Mapped[int] = mapped_column(BigInteger)
    rate_exponent: Mapped[int] = mapped_column(SmallInteger)


class Verification(Sample, Base):
    """A telecommand verification report (service 1); `ticks` is the packet's time."""

    __tablename__ = "verifications"
    __table_args__ = CLUSTERED
    subtype: Mapped[int] = mapped_column(SmallInteger)
    request_id: Mapped[int] = mapped_column(BigInteger)
    step: Mapped[int | None] = mapped_column(SmallInteger)
    failure_code: Mapped[int | None] = mapped_column(Integer)


class FilterState(Sample, Base):
    """Estimate of the navigation filter with its covariance; `ticks` is the image's time.

    `values` holds the state and its covariance as `store.codec.pack_filter_states` packs them; `innovation_degrees`
    are those of the NIS of the frame, None if the packet does not contain it (dictionary version 2).
    """

    __tablename__ = "filter_states"
    __table_args__ = CLUSTERED
    packet_ticks: Mapped[int] = mapped_column(BigInteger)
    frame_number: Mapped[int] = mapped_column(BigInteger)
    values: Mapped[bytes] = mapped_column(LargeBinary)
    innovation_degrees: Mapped[int | None] = mapped_column(Integer)


class Identification(Sample, Base):
    """Which catalogued crater each used detection of an image was taken for; `ticks` is the image's time.

    `items` packs pairs of detection (uint16) and crater (uint32), little-endian.
    """

    __tablename__ = "identifications"
    __table_args__ = CLUSTERED
    packet_ticks: Mapped[int] = mapped_column(BigInteger)
    frame_number: Mapped[int] = mapped_column(BigInteger)
    count: Mapped[int] = mapped_column(SmallInteger)
    items: Mapped[bytes] = mapped_column(LargeBinary)


SAMPLE_TABLES = (
    Housekeeping,
    DetectionFrame,
    NavigationState,
    FrameOutcome,
    Event,
    TimeReport,
    Verification,
    FilterState,
    Identification,
)


class PacketDefinition(Base):
    """Declarations of packets in mission descriptions, identified by their content.

    `mission_id` is a revision that states them.
    """

    __tablename__ = "packet_definitions"
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    digest: Mapped[str] = mapped_column(String(64), unique=True)
    mission_id: Mapped[int] = mapped_column(ForeignKey("missions.id"))


class PacketDecoding(Base):
    """Decoding of the packets of a vehicle with one definition.

    Packets up to `decoded_to` are decoded. The values can be read when `complete` is 1: until then, those of an
    earlier definition are read. `counts` contains numbers of packets by APID and outcome. Raw files of ingests up to
    `read_again_to` have to be read again, because the definition declares packets without a checksum; NULL: none.
    """

    __tablename__ = "packet_decodings"
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"), primary_key=True)
    definition_id: Mapped[int] = mapped_column(ForeignKey("packet_definitions.id"), primary_key=True)
    decoded_to: Mapped[int] = mapped_column(BigInteger)
    complete: Mapped[int] = mapped_column(Flag)
    read_again_to: Mapped[int | None] = mapped_column(BigInteger)
    counts: Mapped[dict[str, Any]] = mapped_column(JSON)


class ParameterSample(Base):
    """Values of a packet decoded with a definition of the mission description.

    `container` is the number of its container in the definition, `values` float64 numbers (little-endian) in the order
    of `tmtc.xtce_series.packet_layouts`; `ticks` is the time in its secondary header.
    """

    __tablename__ = "parameter_samples"
    __table_args__ = CLUSTERED
    vehicle_id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    definition_id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    container: Mapped[int] = mapped_column(SmallInteger, primary_key=True, autoincrement=False)
    ticks: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    packet_id: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    values: Mapped[bytes] = mapped_column(LargeBinary)


class Rollup(Base):
    """Samples of one kind aggregated over a bucket of on-board time; see `store.rollups`."""

    __tablename__ = "rollups"
    __table_args__ = CLUSTERED
    vehicle_id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    dictionary_version: Mapped[int] = mapped_column(SmallInteger, primary_key=True, autoincrement=False)
    kind: Mapped[int] = mapped_column(SmallInteger, primary_key=True, autoincrement=False)
    part: Mapped[int] = mapped_column(SmallInteger, primary_key=True, autoincrement=False)
    level: Mapped[int] = mapped_column(SmallInteger, primary_key=True, autoincrement=False)
    bucket: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    first_ticks: Mapped[int] = mapped_column(BigInteger)
    last_ticks: Mapped[int] = mapped_column(BigInteger)
    rows: Mapped[int] = mapped_column(BigInteger)
    statistics: Mapped[bytes] = mapped_column(LargeBinary)


class Correlation(Base):
    """A straight line from on-board ticks to UTC over one stretch of on-board time.

    ``utc_ns = reference_utc_ns + (ticks - reference_ticks) * nanoseconds per tick * (1 + drift_ppb * 1e-9)``
    """

    __tablename__ = "correlations"
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"), index=True)
    method: Mapped[str] = mapped_column(String(32))
    boot_count: Mapped[int | None] = mapped_column(Integer)
    start_ticks: Mapped[int] = mapped_column(BigInteger)
    stop_ticks: Mapped[int] = mapped_column(BigInteger)
    reference_ticks: Mapped[int] = mapped_column(BigInteger)
    reference_utc_ns: Mapped[int] = mapped_column(BigInteger)
    drift_ppb: Mapped[float] = mapped_column(Double)
    residual_rms_ns: Mapped[float | None] = mapped_column(Double)
    residual_max_ns: Mapped[float | None] = mapped_column(Double)
    points: Mapped[int] = mapped_column(Integer)
    rejected: Mapped[int] = mapped_column(Integer, default=0)
    superseded: Mapped[int] = mapped_column(Flag, default=0)
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)


class Reception(Base):
    """When a station on the Earth received a time report, whether or not the report itself has come in yet.

    The report is the packet of time reports with these `ticks` in its header and this count. `station` is empty where
    only the Earth is known; of several times at one station the first counts, as later ones are played back.
    """

    __tablename__ = "receptions"
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"), primary_key=True)
    ticks: Mapped[int] = mapped_column(BigInteger, primary_key=True)
    sequence_count: Mapped[int] = mapped_column(SmallInteger, primary_key=True)
    station: Mapped[str] = mapped_column(String(64), primary_key=True)
    earth_utc_ns: Mapped[int] = mapped_column(BigInteger)


class EphemerisRecord(Base):
    """A reference ephemeris; the later uploaded of equal precedence wins where two cover a time."""

    __tablename__ = "ephemerides"
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    file_sha256: Mapped[str] = mapped_column(ForeignKey("files.sha256"))
    name: Mapped[str] = mapped_column(Text)
    object_name: Mapped[str] = mapped_column(Text)
    frame: Mapped[str] = mapped_column(String(16))
    start_utc_ns: Mapped[int] = mapped_column(BigInteger)
    stop_utc_ns: Mapped[int] = mapped_column(BigInteger)
    states: Mapped[int] = mapped_column(Integer)
    precedence: Mapped[int] = mapped_column(Integer, default=0)
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)


class MissionRecord(Base):
    """Revision of a mission description, identified by the hash of its stated values and never changed."""

    __tablename__ = "missions"
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    revision: Mapped[str] = mapped_column(String(64), unique=True)
    name: Mapped[str] = mapped_column(Text)
    ccsds_id: Mapped[int | None] = mapped_column(Integer, index=True)
    text: Mapped[str] = mapped_column(Text)
    entered_by: Mapped[str] = mapped_column(String(64))
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)


class Pass(Base):
    """An observation window of one vehicle: an interval of time that samples belong to by on-board time.

    `mission_id` is the revision of the mission description that was in force, `attitude_sha256` the attitude
    table; NULL if unknown.
    """

    __tablename__ = "passes"
    __table_args__ = (Index("ix_passes_vehicle_id_start_utc_ns", "vehicle_id", "start_utc_ns"),)
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"))
    name: Mapped[str] = mapped_column(Text)
    start_utc_ns: Mapped[int] = mapped_column(BigInteger)
    stop_utc_ns: Mapped[int] = mapped_column(BigInteger)
    archive_digest: Mapped[str | None] = mapped_column(String(64), unique=True)
    manifest: Mapped[dict[str, Any]] = mapped_column(JSON)
    ephemeris_id: Mapped[int | None] = mapped_column(ForeignKey("ephemerides.id"))
    catalogue_sha256: Mapped[str | None] = mapped_column(ForeignKey("files.sha256"))
    attitude_sha256: Mapped[str | None] = mapped_column(ForeignKey("files.sha256"))
    mission_id: Mapped[int | None] = mapped_column(ForeignKey("missions.id"))
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)


class PassFrame(Base):
    """An image kept with a pass, for the galleries of its report."""

    __tablename__ = "pass_frames"
    pass_id: Mapped[int] = mapped_column(ForeignKey("passes.id"), primary_key=True)
    frame_number: Mapped[int] = mapped_column(BigInteger, primary_key=True)
    file_sha256: Mapped[str] = mapped_column(ForeignKey("files.sha256"))


class Job(Base):
    """A piece of background work, visible from queued to its end."""

    __tablename__ = "jobs"
    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    kind: Mapped[str] = mapped_column(String(32))
    state: Mapped[str] = mapped_column(String(16), index=True)
    arguments: Mapped[dict[str, Any]] = mapped_column(JSON)
    progress: Mapped[float] = mapped_column(Double)
    attempts: Mapped[int] = mapped_column(Integer)
    result: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    error: Mapped[str | None] = mapped_column(Text)
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)
    started_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    finished_utc_ns: Mapped[int | None] = mapped_column(BigInteger)


class Report(Base):
    """A report made of a pass; its documents are files of the archive.

    `mission_id` is the revision of the mission description that the evaluation used. `event_number` is the event that
    caused a re-evaluation of the pass, `previous_id` the report before it, and `changes` the changed figures; NULL for
    a report on request.
    """

    __tablename__ = "reports"
    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    pass_id: Mapped[int] = mapped_column(ForeignKey("passes.id"), index=True)
    html_sha256: Mapped[str] = mapped_column(ForeignKey("files.sha256"))
    json_sha256: Mapped[str] = mapped_column(ForeignKey("files.sha256"))
    pdf_sha256: Mapped[str | None] = mapped_column(String(64))
    summary: Mapped[dict[str, Any]] = mapped_column(JSON)
    mission_id: Mapped[int | None] = mapped_column(ForeignKey("missions.id"))
    event_number: Mapped[int | None] = mapped_column(BigInteger)
    previous_id: Mapped[str | None] = mapped_column(String(32))
    changes: Mapped[list[dict[str, Any]] | None] = mapped_column(JSON)
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)


class User(Base):
    """User of the service with one role; `state` is active or disabled."""

    __tablename__ = "users"
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    role: Mapped[str] = mapped_column(String(16))
    state: Mapped[str] = mapped_column(String(16))
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)


class Token(Base):
    """Bearer token of a user; only its hash is stored.

    `hint` is the start of the token, to identify it; `used_utc_ns` has a resolution of an hour. The token of a browser
    session has the token that it was started with in `parent_id`, and is valid only while that one is.
    """

    __tablename__ = "tokens"
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    user_id: Mapped[int] = mapped_column(ForeignKey("users.id"), index=True)
    token_sha256: Mapped[str] = mapped_column(String(64), unique=True)
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)
    hint: Mapped[str] = mapped_column(String(16))
    expires_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    revoked_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    used_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    parent_id: Mapped[int | None] = mapped_column(ForeignKey("tokens.id"))


class AuditEntry(Base):
    """Action of a user; entries are only appended, numbered from 1 without gaps (see `store.audit`)."""

    __tablename__ = "audit"
    id: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    utc_ns: Mapped[int] = mapped_column(BigInteger, index=True)
    actor: Mapped[str] = mapped_column(String(64))
    action: Mapped[str] = mapped_column(String(48))
    target: Mapped[str] = mapped_column(Text)
    detail: Mapped[dict[str, Any]] = mapped_column(JSON)
    previous_sha256: Mapped[str] = mapped_column(String(64))
    sha256: Mapped[str] = mapped_column(String(64))


class AuditHead(Base):
    """Number and hash of the newest audit entry: one row, locked while entries are appended."""

    __tablename__ = "audit_head"
    id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    number: Mapped[int] = mapped_column(BigInteger)
    sha256: Mapped[str] = mapped_column(String(64))


class RowDigest(Base):
    """SHA-256 of a row as the program wrote it, kept by triggers (see `store.row_digests`)."""

    __tablename__ = "row_digests"
    __table_args__ = CLUSTERED
    table_name: Mapped[str] = mapped_column(String(64), primary_key=True)
    row_key: Mapped[str] = mapped_column(Text, primary_key=True)
    sha256: Mapped[str] = mapped_column(String(64))


class LoggedEventRow(Base):
    """Event of the log; `id` is its number, from 1 without gaps."""

    __tablename__ = "event_log"
    id: Mapped[int] = mapped_column(BigKey, primary_key=True)
    utc_ns: Mapped[int] = mapped_column(BigInteger)
    kind: Mapped[str] = mapped_column(String(32))
    payload: Mapped[dict[str, Any]] = mapped_column(JSON)


class AlarmRecord(Base):
    """Alarm of a vehicle (see `alarms.core`); `open` is 1 until the alarm is cleared, then NULL.

    A cause (`source` and `name`) has at most one open alarm. `active`: the newest telemetry has the condition.
    """

    __tablename__ = "alarms"
    __table_args__ = (
        UniqueConstraint("vehicle_id", "source", "name", "open"),
        Index("ix_alarms_newest", "open", "last_ticks"),
    )
    id: Mapped[int] = mapped_column(BigKey, primary_key=True)
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"))
    source: Mapped[str] = mapped_column(String(16))
    name: Mapped[str] = mapped_column(String(64))
    open: Mapped[int | None] = mapped_column(Flag)
    severity: Mapped[int] = mapped_column(SmallInteger)
    state: Mapped[str] = mapped_column(String(16))
    active: Mapped[int] = mapped_column(Flag)
    count: Mapped[int] = mapped_column(BigInteger)
    value: Mapped[float | None] = mapped_column(Double)
    first_ticks: Mapped[int] = mapped_column(BigInteger)
    last_ticks: Mapped[int] = mapped_column(BigInteger)
    raised_utc_ns: Mapped[int] = mapped_column(BigInteger)
    acknowledged_by: Mapped[str | None] = mapped_column(String(64))
    acknowledged_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    shelved_by: Mapped[str | None] = mapped_column(String(64))
    shelved_until_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    cleared_utc_ns: Mapped[int | None] = mapped_column(BigInteger)


class AlarmChangeRecord(Base):
    """Change in the life of an alarm."""

    __tablename__ = "alarm_changes"
    id: Mapped[int] = mapped_column(BigKey, primary_key=True)
    alarm_id: Mapped[int] = mapped_column(ForeignKey("alarms.id"), index=True)
    utc_ns: Mapped[int] = mapped_column(BigInteger)
    actor: Mapped[str] = mapped_column(String(64))
    change: Mapped[str] = mapped_column(String(16))
    comment: Mapped[str] = mapped_column(Text)


class AlarmPosition(Base):
    """Last packet of a vehicle that has been examined for alarms."""

    __tablename__ = "alarm_positions"
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"), primary_key=True, autoincrement=False)
    packet_id: Mapped[int] = mapped_column(BigInteger)


class EventPosition(Base):
    """Number of the last event that a consumer has handled."""

    __tablename__ = "event_positions"
    consumer: Mapped[str] = mapped_column(String(32), primary_key=True)
    number: Mapped[int] = mapped_column(BigInteger)


class Answer(Base):
    """What was answered under an idempotency key; NULL while the work is being done."""

    __tablename__ = "answers"
    key: Mapped[str] = mapped_column(String(64), primary_key=True)
    request: Mapped[str] = mapped_column(String(64))
    answer: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)


class Telecommand(Base):
    """A telecommand, from being entered to its end; its octets exist from its release on.

    One that is inside another (an activity of the on-board schedule) names that one in `carrier_id`.
    """

    __tablename__ = "telecommands"
    __table_args__ = (Index("ix_telecommands_vehicle_id_request_id", "vehicle_id", "request_id"),)
    id: Mapped[int] = mapped_column(BigKey, primary_key=True)
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"))
    name: Mapped[str] = mapped_column(String(64))
    arguments: Mapped[dict[str, Any]] = mapped_column(JSON)
    state: Mapped[str] = mapped_column(String(16), index=True)
    critical: Mapped[int] = mapped_column(Flag)
    timeout_s: Mapped[int] = mapped_column(Integer)
    requested_by: Mapped[str] = mapped_column(String(64))
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)
    decided_by: Mapped[str | None] = mapped_column(String(64))
    decided_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    reason: Mapped[str | None] = mapped_column(Text)
    sequence_count: Mapped[int | None] = mapped_column(SmallInteger)
    request_id: Mapped[int | None] = mapped_column(BigInteger)
    octets: Mapped[bytes | None] = mapped_column(LargeBinary)
    sent_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    sent_after_ticks: Mapped[int | None] = mapped_column(BigInteger)
    timeout_noted_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    window_id: Mapped[int | None] = mapped_column(Integer, index=True)
    carrier_id: Mapped[int | None] = mapped_column(BigInteger)
    mission_id: Mapped[int | None] = mapped_column(ForeignKey("missions.id"))
    send_before_utc_ns: Mapped[int | None] = mapped_column(BigInteger)


class LinkRecord(Base):
    """State of a connection to a ground station; one process at a time owns it.

    `lease_utc_ns` is the end of the lease of the owner, wall time. `heard_utc_ns` is the mission time of the last
    reception, `considered_utc_ns` the mission time up to which predicted contacts were compared with receptions.
    """

    __tablename__ = "links"
    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    ccsds_id: Mapped[int] = mapped_column(Integer)
    instance: Mapped[str] = mapped_column(String(96))
    owner: Mapped[str | None] = mapped_column(String(96))
    lease_utc_ns: Mapped[int] = mapped_column(BigInteger)
    state: Mapped[str] = mapped_column(String(16))
    reason: Mapped[str | None] = mapped_column(Text)
    octets: Mapped[int] = mapped_column(BigInteger)
    heard_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    clock_offset_ns: Mapped[int | None] = mapped_column(BigInteger)
    considered_utc_ns: Mapped[int] = mapped_column(BigInteger)
    send_requested: Mapped[int] = mapped_column(BigInteger)
    send_done: Mapped[int] = mapped_column(BigInteger)
    changed_utc_ns: Mapped[int] = mapped_column(BigInteger)


class ContactRecord(Base):
    """Contact over a link: open, ended or missed; times are mission time."""

    __tablename__ = "contacts"
    __table_args__ = (Index("ix_contacts_link_id", "link", "id"),)
    id: Mapped[int] = mapped_column(BigKey, primary_key=True)
    link: Mapped[str] = mapped_column(String(64))
    station: Mapped[str] = mapped_column(String(64))
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"))
    state: Mapped[str] = mapped_column(String(16))
    reason: Mapped[str | None] = mapped_column(Text)
    start_utc_ns: Mapped[int] = mapped_column(BigInteger)
    stop_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    predicted_start_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    predicted_stop_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    octets: Mapped[int] = mapped_column(BigInteger)
    telecommands: Mapped[int] = mapped_column(Integer)


class Transmission(Base):
    """Octets of telecommands for one link; `transmitted_utc_ns` (mission time) is NULL until they are on the wire."""

    __tablename__ = "transmissions"
    id: Mapped[int] = mapped_column(BigKey, primary_key=True)
    link: Mapped[str] = mapped_column(String(64), index=True)
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"))
    contact_id: Mapped[int | None] = mapped_column(BigInteger)
    octets: Mapped[bytes] = mapped_column(LargeBinary)
    telecommands: Mapped[list[int]] = mapped_column(JSON)
    attempts: Mapped[int] = mapped_column(Integer)
    taken_utc_ns: Mapped[int] = mapped_column(BigInteger)
    transmitted_utc_ns: Mapped[int | None] = mapped_column(BigInteger)


class CommandCounter(Base):
    """Number of telecommand sequence counts assigned for a vehicle; locked during commanding."""

    __tablename__ = "command_counters"
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"), primary_key=True)
    telecommands: Mapped[int] = mapped_column(BigInteger)


class Window(Base):
    """Planned observation window.

    `decision` is the decision of a person (draft, approved, failed). `state` is the progress of the window including
    telemetry, updated by `planning.progress`. `version` counts changes by persons. `edited_by` added the window
    or changed it last, `decided_by` made the decision. `closed`: it is processed although telemetry is missing.
    `uploads` is what its telecommands load on board.
    """

    __tablename__ = "windows"
    __table_args__ = (Index("ix_windows_vehicle_id_start_utc_ns", "vehicle_id", "start_utc_ns"),)
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"))
    name: Mapped[str] = mapped_column(Text)
    start_utc_ns: Mapped[int] = mapped_column(BigInteger)
    stop_utc_ns: Mapped[int] = mapped_column(BigInteger)
    cadence_s: Mapped[float] = mapped_column(Double)
    decision: Mapped[str] = mapped_column(String(16))
    state: Mapped[str] = mapped_column(String(16))
    reason: Mapped[str | None] = mapped_column(Text)
    predecessor_id: Mapped[int | None] = mapped_column(ForeignKey("windows.id"))
    ephemeris_id: Mapped[int | None] = mapped_column(ForeignKey("ephemerides.id"))
    pass_id: Mapped[int | None] = mapped_column(ForeignKey("passes.id"))
    mission_id: Mapped[int | None] = mapped_column(ForeignKey("missions.id"))
    data_octets: Mapped[int] = mapped_column(BigInteger)
    predicted: Mapped[dict[str, Any]] = mapped_column(JSON)
    closed: Mapped[int] = mapped_column(Flag, server_default="0")
    uploads: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    version: Mapped[int] = mapped_column(Integer)
    created_by: Mapped[str] = mapped_column(String(64))
    edited_by: Mapped[str] = mapped_column(String(64))
    decided_by: Mapped[str | None] = mapped_column(String(64))
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)
    changed_utc_ns: Mapped[int] = mapped_column(BigInteger)
    request_id: Mapped[int | None] = mapped_column(ForeignKey("standing_requests.id"))


class StandingRequestRow(Base):
    """Standing request with its last plan; `plans` counts plans, so that one of several processes stores each."""

    __tablename__ = "standing_requests"
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    vehicle_id: Mapped[int] = mapped_column(ForeignKey("vehicles.id"))
    name: Mapped[str] = mapped_column(Text)
    state: Mapped[str] = mapped_column(String(16))
    priority: Mapped[int] = mapped_column(Integer)
    terms: Mapped[dict[str, Any]] = mapped_column(JSON)
    plan: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    plans: Mapped[int] = mapped_column(Integer)
    planned_utc_ns: Mapped[int | None] = mapped_column(BigInteger)
    anchor_utc_ns: Mapped[int] = mapped_column(BigInteger)
    version: Mapped[int] = mapped_column(Integer)
    created_by: Mapped[str] = mapped_column(String(64))
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)
    changed_utc_ns: Mapped[int] = mapped_column(BigInteger)


class AutomationActionRow(Base):
    """Action of an automation rule that an event caused; one for the same event, rule, place in it and subject.

    `subject` is the pass, vehicle or mission. `mission_id` is the revision in force; NULL without any.
    """

    __tablename__ = "automation_actions"
    __table_args__ = (UniqueConstraint("event_number", "rule", "position", "subject"),)
    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    event_number: Mapped[int] = mapped_column(BigInteger)
    trigger: Mapped[str] = mapped_column(String(32))
    rule: Mapped[str] = mapped_column(String(100))
    position: Mapped[int] = mapped_column(SmallInteger)
    action: Mapped[str] = mapped_column(String(32))
    subject: Mapped[str] = mapped_column(String(32))
    vehicle_id: Mapped[int | None] = mapped_column(Integer)
    pass_id: Mapped[int | None] = mapped_column(Integer, index=True)
    window_id: Mapped[int | None] = mapped_column(Integer)
    mission_id: Mapped[int | None] = mapped_column(ForeignKey("missions.id"))
    text: Mapped[str] = mapped_column(Text)
    state: Mapped[str] = mapped_column(String(16), index=True)
    result: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    error: Mapped[str | None] = mapped_column(Text)
    decided_by: Mapped[str | None] = mapped_column(String(64))
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)
    changed_utc_ns: Mapped[int] = mapped_column(BigInteger)


class RegisteredBuild(Base):
    """A payload build under test; `digest` is the hash of everything that decides what it does."""

    __tablename__ = "builds"
    digest: Mapped[str] = mapped_column(String(64), primary_key=True)
    name: Mapped[str] = mapped_column(Text)
    version: Mapped[str] = mapped_column(Text)
    description: Mapped[str] = mapped_column(Text)
    kind: Mapped[str] = mapped_column(String(16))
    files: Mapped[dict[str, Any]] = mapped_column(JSON)
    flight_code: Mapped[str | None] = mapped_column(String(64))
    provenance: Mapped[dict[str, Any]] = mapped_column(JSON)
    registered_by: Mapped[str] = mapped_column(String(64))
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)


class RegressionArchive(Base):
    """A pass archive kept to be flown again; `digest` is the SHA-256 of its manifest."""

    __tablename__ = "regression_archives"
    digest: Mapped[str] = mapped_column(String(64), primary_key=True)
    name: Mapped[str] = mapped_column(Text)
    manifest_sha256: Mapped[str] = mapped_column(String(64))
    frames: Mapped[int] = mapped_column(Integer)
    octets: Mapped[int] = mapped_column(BigInteger)
    pinned: Mapped[int] = mapped_column(Flag)
    used_utc_ns: Mapped[int] = mapped_column(BigInteger, index=True)
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)


class Replay(Base):
    """Result of one build on one archive; `id` is the hash of both identities."""

    __tablename__ = "replays"
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    archive_digest: Mapped[str] = mapped_column(String(64), index=True)
    build_digest: Mapped[str] = mapped_column(String(64), index=True)
    outcome: Mapped[str] = mapped_column(String(16))
    detail: Mapped[str] = mapped_column(Text)
    downlink_sha256: Mapped[str | None] = mapped_column(String(64))
    performance_sha256: Mapped[str | None] = mapped_column(String(64))
    wall_s: Mapped[float] = mapped_column(Double)
    cpu_s: Mapped[float] = mapped_column(Double)
    peak_rss_mib: Mapped[float] = mapped_column(Double)
    isolation: Mapped[str] = mapped_column(Text)
    machine: Mapped[str] = mapped_column(Text)
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)


class Regression(Base):
    """A candidate build judged against a baseline over archived passes."""

    __tablename__ = "regressions"
    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    baseline_digest: Mapped[str] = mapped_column(String(64))
    candidate_digest: Mapped[str] = mapped_column(String(64))
    verdict: Mapped[str] = mapped_column(String(16))
    result: Mapped[dict[str, Any]] = mapped_column(JSON)
    missions: Mapped[list[str]] = mapped_column(JSON)
    html_sha256: Mapped[str | None] = mapped_column(String(64))
    created_utc_ns: Mapped[int] = mapped_column(BigInteger)
