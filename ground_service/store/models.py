"""Tables of the service.

The record is `packets` (octets, once, by content) and `files`; the sample tables hold what one dictionary
version decodes from a packet and can be made again from it. Sample tables are clustered by
(vehicle, dictionary version, time, packet), so a time range of one vehicle is one contiguous read.

Times on board are ``ticks`` (2^-16 s since 2000-01-01 TAI); times on the ground are ``utc_ns``. The UTC of a
sample is computed from its ticks with a time correlation when it is read, so late data never need rewriting.
A vehicle is one spacecraft in one `instance`: the flown one, or one emulated or replayed run, each a domain of
its own for time and sequence counts.
"""

from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    Column,
    Double,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    SmallInteger,
    String,
    Table,
    Text,
    UniqueConstraint,
)

from tmtc.dictionary.fields import HOUSEKEEPING_FIELDS

NO_TICKS = -1
"""On-board time of a packet that carries none."""

BigKey = BigInteger().with_variant(Integer, "sqlite")
Flag = SmallInteger


CLUSTERED: dict[str, Any] = {"sqlite_with_rowid": False}
"""Options of a table whose rows are stored in the order of the primary key."""

METADATA = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)
"""All tables, with names for every constraint so that migrations can find them."""


def key(name: str, *arguments: Any, **options: Any) -> Column[Any]:
    """Return a column of the primary key."""
    return Column(name, *arguments, primary_key=True, **options)


def column(name: str, *arguments: Any, **options: Any) -> Column[Any]:
    """Return a column without NULL."""
    return Column(name, *arguments, nullable=False, **options)


def optional(name: str, *arguments: Any, **options: Any) -> Column[Any]:
    """Return a column that may be NULL."""
    return Column(name, *arguments, **options)


def columns(kind: Any, *names: str) -> tuple[Column[Any], ...]:
    """Return columns of one type without NULL."""
    return tuple(column(name, kind) for name in names)


def optionals(kind: Any, *names: str) -> tuple[Column[Any], ...]:
    """Return columns of one type that may be NULL."""
    return tuple(optional(name, kind) for name in names)


def table(name: str, *parts: Any, **options: Any) -> Table:
    """Return a table of this schema."""
    return Table(name, METADATA, *parts, **options)


FILES = table(
    "files",
    key("sha256", String(64)),
    column("kind", String(32)),
    column("name", Text),
    *columns(BigInteger, "octets", "received_utc_ns"),
)
"""A file of the archive, stored once under the SHA-256 of its octets."""

VEHICLES = table(
    "vehicles",
    key("id", Integer),
    column("ccsds_id", Integer),
    column("instance", String(96)),
    *optionals(SmallInteger, "decoded_version", "redecoding_version"),
    *optionals(BigInteger, "redecoded_to", "redecode_until"),
    UniqueConstraint("ccsds_id", "instance"),
)
"""A spacecraft in one instance: a domain of time, boots and sequence counts.

`decoded_version` is the dictionary version that has decoded all of its packets, the one to read; NULL before the
first. While a newer one decodes them again, `redecoded_to` is the last packet that it has done and `redecode_until`
the last that it has to do.
"""

INGESTS = table(
    "ingests",
    key("id", BigKey),
    optional("vehicle_id", ForeignKey("vehicles.id"), index=True),
    column("file_sha256", ForeignKey("files.sha256"), index=True),
    column("state", String(16)),
    optional("error", Text),
    column("dictionary_version", Integer),
    column("received_utc_ns", BigInteger),
    optional("finished_utc_ns", BigInteger),
    column("accounting", JSON),
    *optionals(BigInteger, "first_ticks", "last_ticks"),
    Index("ix_ingests_extent", "last_ticks", "first_ticks"),
)
"""One run of the ingest over one file: what was in it and what of it was new.

`first_ticks` and `last_ticks` are the earliest and the latest on-board time of its packets; NULL: unknown.
"""

PACKETS = table(
    "packets",
    key("id", BigKey),
    column("vehicle_id", Integer),
    *columns(SmallInteger, "apid", "sequence_count"),
    column("ticks", BigInteger),
    column("digest", LargeBinary(16)),
    column("octets", LargeBinary),
    UniqueConstraint("vehicle_id", "apid", "ticks", "sequence_count", "digest"),
)
"""A space packet, immutable, once per vehicle by content."""

IMPLAUSIBLE_PACKETS = table(
    "implausible_packets",
    key("id", BigKey),
    column("vehicle_id", ForeignKey("vehicles.id")),
    column("ingest_id", ForeignKey("ingests.id"), index=True),
    *columns(SmallInteger, "apid", "sequence_count"),
    column("ticks", BigInteger),
    column("digest", LargeBinary(16)),
    column("octets", LargeBinary),
    column("reason", Text),
    UniqueConstraint("vehicle_id", "digest"),
)
"""A space packet whose on-board time is implausible: kept apart from `packets`, so that it decides nothing."""

PIECES = table(
    "pieces",
    key("ingest_id", ForeignKey("ingests.id"), autoincrement=False),
    column("scope", String(128)),
    optional("spacecraft_id", Integer),
    column("file_sha256", ForeignKey("files.sha256"), index=True),
    column("octets", BigInteger),
    column("stream", String(200)),
    column("position", BigInteger),
    optional("waits", Integer),
    column("station", String(64)),
    optional("link", String(200)),
    column("packets_stored", BigInteger, default=0),
    column("packets_joined", BigInteger, default=0),
    column("samples_stored", BigInteger, default=0),
    Index("ix_pieces_place", "scope", "stream", "position"),
    Index("ix_pieces_waiting", "scope", "waits"),
)
"""Ingested file of a downlink, and its position in its recording.

A recording is one reception of one station: `stream` and `position` (octets from its start) are stated by the sender. A
file without them is a recording of its own; `stream` is empty. Pieces of one `scope` (instance of the spacecraft) and
`stream` adjoin. `spacecraft_id` selects the frames of one spacecraft; NULL: those of every spacecraft. `station`
(empty: not stated) and `link` (text of the settings, NULL: not stated) are those of the sender. `waits` is 1 for a
piece that is to be read again when the link of its recording is known, otherwise NULL. `packets_stored` counts the new
packets that the ingest added to the archive, `packets_joined` those of them that were completed with fragments, and
`samples_stored` their samples, over all attempts of the ingest.
"""

FRAGMENTS = table(
    "fragments",
    key("id", BigKey),
    column("vehicle_id", ForeignKey("vehicles.id")),
    column("channel", String(24)),
    *columns(SmallInteger, "begins", "ends", "count", "next_count"),
    *columns(BigInteger, "first", "last"),
    column("stream", String(200)),
    column("fit", Integer),
    column("digest", LargeBinary(16)),
    column("octets", LargeBinary),
    UniqueConstraint("vehicle_id", "channel", "digest"),
    Index("ix_fragments_first", "vehicle_id", "channel", "count", "fit"),
    Index("ix_fragments_last", "vehicle_id", "channel", "next_count", "fit"),
)
"""Octets of a packet that was cut, stored until the others are received; see `ingest.fragments.Fragment`.

`channel`: number of the virtual channel, start and end of the packet zone in its frames.
"""


def samples(name: str, *columns: Column[Any]) -> Table:
    """Return a table of decoded samples.

    Packets and samples carry no foreign keys: they are written in bulk, in one transaction with what they
    point to, and a check per row would cost more than the row.
    """
    return table(
        name,
        key("vehicle_id", Integer, autoincrement=False),
        key("dictionary_version", SmallInteger, autoincrement=False),
        key("ticks", BigInteger, autoincrement=False),
        key("packet_id", BigInteger, autoincrement=False),
        *columns,
        **CLUSTERED,
    )


_COLUMN_TYPES = {"u8": SmallInteger, "u16": Integer, "u32": BigInteger}

HOUSEKEEPING = samples(
    "housekeeping",
    *(
        column(one.name, Double if one.is_calibrated else _COLUMN_TYPES[one.type])
        for one in HOUSEKEEPING_FIELDS
        if one.name != "structure_id"
    ),
)
"""Engineering values of a housekeeping report; `ticks` is the packet's time."""


def image_samples(name: str, *columns: Column[Any]) -> Table:
    """Return a table of samples of an image; their `ticks` is the time of the image."""
    return samples(name, column("packet_ticks", BigInteger), column("frame_number", BigInteger), *columns)


DETECTIONS = image_samples("detections", *columns(SmallInteger, "image_quality", "count"), column("items", LargeBinary))
"""Detections of one image; `items` packed as `store.codec.DETECTION_ITEM`."""

NAVIGATION_STATES = image_samples(
    "navigation_states",
    *columns(SmallInteger, "estimator", "outcome"),
    *optionals(Double, "latitude_deg", "longitude_deg", "altitude_m"),
    *optionals(Float, "velocity_x_m_s", "velocity_y_m_s", "velocity_z_m_s", "sigma_r_m", "sigma_t_m"),
    *optionals(Float, "sigma_n_m", "nis"),
    column("matched", SmallInteger),
)
"""State of one on-board estimator."""

FRAME_OUTCOMES = image_samples(
    "frame_outcomes",
    *columns(SmallInteger, "estimator", "outcome", "reset_trigger", "detections"),
    column("candidate_pairs", Integer),
    column("pairs", SmallInteger),
    *optionals(Float, "shift_east_m", "shift_north_m"),
    column("anchor_reads", BigInteger),
)
"""Outcome of one estimator for one image."""

EVENTS = samples(
    "events",
    column("severity", SmallInteger),
    column("event_id", Integer),
    column("frame_number", BigInteger),
    *optionals(Double, "value_1", "value_2"),
)
"""An event report; `ticks` is the packet's time, `severity` 1 (info) to 4 (high)."""

TIME_REPORTS = samples("time_reports", column("reported_ticks", BigInteger), column("rate_exponent", SmallInteger))
"""A time report; `ticks` is the packet's time."""

VERIFICATIONS = samples(
    "verifications",
    column("subtype", SmallInteger),
    column("request_id", BigInteger),
    optional("step", SmallInteger),
    optional("failure_code", Integer),
)
"""A telecommand verification report (service 1); `ticks` is the packet's time."""

FILTER_STATES = image_samples("filter_states", column("values", LargeBinary), optional("innovation_degrees", Integer))
"""Estimate of the navigation filter with its covariance.

`values` holds the state and its covariance as `store.codec.pack_filter_states` packs them; `innovation_degrees`
are those of the NIS of the frame, None if the packet does not contain it (dictionary version 2).
"""

IDENTIFICATIONS = image_samples("identifications", column("count", SmallInteger), column("items", LargeBinary))
"""Catalogued crater with which each used detection of an image was identified.

`items` packs pairs of detection (uint16) and crater (uint32), little-endian.
"""

SAMPLE_TABLES = (
    HOUSEKEEPING,
    DETECTIONS,
    NAVIGATION_STATES,
    FRAME_OUTCOMES,
    EVENTS,
    TIME_REPORTS,
    VERIFICATIONS,
    FILTER_STATES,
    IDENTIFICATIONS,
)


PACKET_DEFINITIONS = table(
    "packet_definitions",
    key("id", Integer),
    column("digest", String(64), unique=True),
    column("mission_id", ForeignKey("missions.id")),
)
"""Declarations of packets in mission descriptions, identified by their content.

`mission_id` is a revision that states them.
"""

PACKET_DECODINGS = table(
    "packet_decodings",
    key("vehicle_id", ForeignKey("vehicles.id")),
    key("definition_id", ForeignKey("packet_definitions.id")),
    column("decoded_to", BigInteger),
    column("complete", Flag),
    optional("read_again_to", BigInteger),
    column("counts", JSON),
)
"""Decoding of the packets of a vehicle with one definition.

Packets up to `decoded_to` are decoded. The values can be read when `complete` is 1: until then, those of an
earlier definition are read. `counts` contains numbers of packets by APID and outcome. Raw files of ingests up to
`read_again_to` have to be read again, because the definition declares packets without a checksum; NULL: none.
"""

PARAMETER_SAMPLES = table(
    "parameter_samples",
    key("vehicle_id", Integer, autoincrement=False),
    key("definition_id", Integer, autoincrement=False),
    key("container", SmallInteger, autoincrement=False),
    key("ticks", BigInteger, autoincrement=False),
    key("packet_id", BigInteger, autoincrement=False),
    column("values", LargeBinary),
    **CLUSTERED,
)
"""Values of a packet decoded with a definition of the mission description.

`container` is the number of its container in the definition, `values` float64 numbers (little-endian) in the order
of `tmtc.xtce.series.packet_layouts`; `ticks` is the time in its secondary header.
"""

ROLLUPS = table(
    "rollups",
    key("vehicle_id", Integer, autoincrement=False),
    key("dictionary_version", SmallInteger, autoincrement=False),
    key("kind", SmallInteger, autoincrement=False),
    key("part", SmallInteger, autoincrement=False),
    key("level", SmallInteger, autoincrement=False),
    key("bucket", BigInteger, autoincrement=False),
    *columns(BigInteger, "first_ticks", "last_ticks", "rows"),
    column("statistics", LargeBinary),
    **CLUSTERED,
)
"""Samples of one kind aggregated over a bucket of on-board time; see `store.rollups`."""

CORRELATIONS = table(
    "correlations",
    key("id", Integer),
    column("vehicle_id", ForeignKey("vehicles.id"), index=True),
    column("method", String(32)),
    optional("boot_count", Integer),
    *columns(BigInteger, "start_ticks", "stop_ticks", "reference_ticks", "reference_utc_ns"),
    column("drift_ppb", Double),
    *optionals(Double, "residual_rms_ns", "residual_max_ns"),
    column("points", Integer),
    column("rejected", Integer, default=0),
    column("superseded", Flag, default=0),
    column("created_utc_ns", BigInteger),
)
"""A straight line from on-board ticks to UTC over one stretch of on-board time.

``utc_ns = reference_utc_ns + (ticks - reference_ticks) * nanoseconds per tick * (1 + drift_ppb * 1e-9)``
"""

RECEPTIONS = table(
    "receptions",
    key("vehicle_id", ForeignKey("vehicles.id")),
    key("ticks", BigInteger),
    key("sequence_count", SmallInteger),
    key("station", String(64)),
    column("earth_utc_ns", BigInteger),
)
"""Reception times of time reports at stations, whether or not the report itself has been received.

The report is the packet of time reports with these `ticks` in its header and this count. `station` is empty where
only the Earth is known; of several times at one station the first counts, as later ones are played back.
"""

EPHEMERIDES = table(
    "ephemerides",
    key("id", Integer),
    column("file_sha256", ForeignKey("files.sha256")),
    *columns(Text, "name", "object_name"),
    column("frame", String(16)),
    *columns(BigInteger, "start_utc_ns", "stop_utc_ns"),
    column("states", Integer),
    column("precedence", Integer, default=0),
    column("created_utc_ns", BigInteger),
)
"""A reference ephemeris; the later uploaded of equal precedence wins where two cover a time."""

MISSIONS = table(
    "missions",
    key("id", Integer),
    column("revision", String(64), unique=True),
    column("name", Text),
    optional("ccsds_id", Integer, index=True),
    column("text", Text),
    column("entered_by", String(64)),
    column("created_utc_ns", BigInteger),
)
"""Revision of a mission description, identified by the hash of its stated values and never changed."""

PASSES = table(
    "passes",
    key("id", Integer),
    column("vehicle_id", ForeignKey("vehicles.id")),
    column("name", Text),
    *columns(BigInteger, "start_utc_ns", "stop_utc_ns"),
    optional("archive_digest", String(64), unique=True),
    column("manifest", JSON),
    optional("ephemeris_id", ForeignKey("ephemerides.id")),
    optional("catalogue_sha256", ForeignKey("files.sha256")),
    optional("attitude_sha256", ForeignKey("files.sha256")),
    optional("mission_id", ForeignKey("missions.id")),
    column("created_utc_ns", BigInteger),
    Index("ix_passes_vehicle_id_start_utc_ns", "vehicle_id", "start_utc_ns"),
)
"""An observation window of one vehicle: an interval of time that samples belong to by on-board time.

`mission_id` is the revision of the mission description that was in force, `attitude_sha256` the attitude
table; NULL if unknown.
"""

MONTHLY_REPORTS = table(
    "monthly_reports",
    key("id", String(32)),
    column("spacecraft_id", Integer, index=True),
    column("instance", String(96)),
    column("month", String(7)),
    column("passes", Integer),
    column("verdict", Text),
    column("html_sha256", ForeignKey("files.sha256")),
    column("pdf_sha256", ForeignKey("files.sha256")),
    column("json_sha256", ForeignKey("files.sha256")),
    column("created_utc_ns", BigInteger),
)
"""A report of a month of a spacecraft in one instance; the id is the hash of its content."""

PASS_FRAMES = table(
    "pass_frames",
    key("pass_id", ForeignKey("passes.id")),
    key("frame_number", BigInteger),
    column("file_sha256", ForeignKey("files.sha256")),
)
"""An image kept with a pass, for the galleries of its report."""

JOBS = table(
    "jobs",
    key("id", String(32)),
    column("kind", String(32)),
    column("state", String(16), index=True),
    column("arguments", JSON),
    column("progress", Double),
    column("attempts", Integer),
    optional("result", JSON),
    optional("error", Text),
    optional("traceparent", String(55)),
    column("created_utc_ns", BigInteger),
    *optionals(BigInteger, "started_utc_ns", "finished_utc_ns"),
)
"""A piece of background work, visible from queued to its end; `traceparent` is the step that entered it."""

REPORTS = table(
    "reports",
    key("id", String(32)),
    column("pass_id", ForeignKey("passes.id"), index=True),
    column("html_sha256", ForeignKey("files.sha256")),
    column("json_sha256", ForeignKey("files.sha256")),
    optional("pdf_sha256", String(64)),
    column("summary", JSON),
    optional("mission_id", ForeignKey("missions.id")),
    optional("event_number", BigInteger),
    optional("previous_id", String(32)),
    optional("changes", JSON),
    column("created_utc_ns", BigInteger),
    optional("print_sha256", String(64)),
)
"""A report made of a pass; its documents are files of the archive.

The PDF is made of the print form and the figures of the page when it is first read; NULL until then.
`mission_id` is the revision of the mission description that the evaluation used. `event_number` is the event that
caused a re-evaluation of the pass, `previous_id` the report before it, and `changes` the changed figures; NULL for
a report on request.
"""

USERS = table(
    "users",
    key("id", Integer),
    column("name", String(64), unique=True),
    *columns(String(16), "role", "state"),
    column("created_utc_ns", BigInteger),
    optional("issuer", String(512)),
    optional("subject", String(255)),
    optional("missions", JSON),
    UniqueConstraint("issuer", "subject"),
)
"""User of the service with one role; `state` is active or disabled, `missions` the names it is limited to.

`issuer` and `subject` identify a user of an OpenID provider; NULL for users that were added here.
"""

TOKENS = table(
    "tokens",
    key("id", Integer),
    column("user_id", ForeignKey("users.id"), index=True),
    column("token_sha256", String(64), unique=True),
    column("created_utc_ns", BigInteger),
    column("hint", String(16)),
    *optionals(BigInteger, "expires_utc_ns", "revoked_utc_ns", "used_utc_ns"),
    optional("parent_id", ForeignKey("tokens.id")),
    optional("provider_session", String(255)),
    optional("missions", JSON),
)
"""Bearer token of a user; only its hash is stored. `missions` limits it further than its user.

`hint` is the start of the token, to identify it; `used_utc_ns` has a resolution of an hour. The token of a browser
session has the token that it was started with in `parent_id`, and is valid only while that one is. The token of a
session that an OpenID provider started has the provider's session in `provider_session`, empty if it states none.
"""

AUDIT = table(
    "audit",
    key("id", BigInteger, autoincrement=False),
    column("utc_ns", BigInteger, index=True),
    column("actor", String(64)),
    column("action", String(48)),
    column("target", Text),
    column("detail", JSON),
    *columns(String(64), "previous_sha256", "sha256"),
)
"""Action of a user; entries are only appended, numbered from 1 without gaps (see `store.audit`)."""

AUDIT_HEAD = table(
    "audit_head", key("id", Integer, autoincrement=False), column("number", BigInteger), column("sha256", String(64))
)
"""Number and hash of the newest audit entry: one row, locked while entries are appended."""

EVENT_LOG = table(
    "event_log", key("id", BigKey), column("utc_ns", BigInteger), column("kind", String(32)), column("payload", JSON)
)
"""Event of the log; `id` is its number, from 1 without gaps."""

ALARMS = table(
    "alarms",
    key("id", BigKey),
    column("vehicle_id", ForeignKey("vehicles.id")),
    column("source", String(16)),
    column("name", String(64)),
    optional("open", Flag),
    column("severity", SmallInteger),
    column("state", String(16)),
    column("active", Flag),
    column("count", BigInteger),
    optional("value", Double),
    *columns(BigInteger, "first_ticks", "last_ticks", "raised_utc_ns"),
    optional("acknowledged_by", String(64)),
    optional("acknowledged_utc_ns", BigInteger),
    optional("shelved_by", String(64)),
    *optionals(BigInteger, "shelved_until_utc_ns", "cleared_utc_ns"),
    UniqueConstraint("vehicle_id", "source", "name", "open"),
    Index("ix_alarms_newest", "open", "last_ticks"),
)
"""Alarm of a vehicle (see `alarms.core`); `open` is 1 until the alarm is cleared, then NULL.

A cause (`source` and `name`) has at most one open alarm. `active`: the newest telemetry has the condition.
"""

ALARM_CHANGES = table(
    "alarm_changes",
    key("id", BigKey),
    column("alarm_id", ForeignKey("alarms.id"), index=True),
    column("utc_ns", BigInteger),
    column("actor", String(64)),
    column("change", String(16)),
    column("comment", Text),
)
"""Change in the life of an alarm."""

ALARM_POSITIONS = table(
    "alarm_positions",
    key("vehicle_id", ForeignKey("vehicles.id"), autoincrement=False),
    column("packet_id", BigInteger),
)
"""Last packet of a vehicle that has been examined for alarms."""

EVENT_POSITIONS = table("event_positions", key("consumer", String(32)), column("number", BigInteger))
"""Number of the last event that a consumer has handled."""

ANSWERS = table(
    "answers",
    key("key", String(64)),
    column("request", String(64)),
    optional("answer", JSON),
    column("created_utc_ns", BigInteger),
)
"""Answers by idempotency key; NULL while the work is in progress."""

TELECOMMANDS = table(
    "telecommands",
    key("id", BigKey),
    column("vehicle_id", ForeignKey("vehicles.id")),
    column("name", String(64)),
    column("arguments", JSON),
    column("state", String(16), index=True),
    column("critical", Flag),
    column("timeout_s", Integer),
    column("requested_by", String(64)),
    column("created_utc_ns", BigInteger),
    optional("decided_by", String(64)),
    optional("decided_utc_ns", BigInteger),
    optional("reason", Text),
    optional("sequence_count", SmallInteger),
    optional("request_id", BigInteger),
    optional("octets", LargeBinary),
    *optionals(BigInteger, "sent_utc_ns", "sent_after_ticks", "timeout_noted_utc_ns"),
    optional("window_id", Integer, index=True),
    optional("carrier_id", BigInteger),
    optional("mission_id", ForeignKey("missions.id")),
    optional("send_before_utc_ns", BigInteger),
    Index("ix_telecommands_vehicle_id_request_id", "vehicle_id", "request_id"),
)
"""A telecommand, from being entered to its end; its octets exist from its release on.

One that is inside another (an activity of the on-board schedule) names that one in `carrier_id`.
"""

HANDOVERS = table(
    "handovers",
    key("vehicle_id", ForeignKey("vehicles.id"), autoincrement=False),
    column("note", Text),
    optional("noted_by", String(64)),
    optional("noted_utc_ns", BigInteger),
    optional("held_by", String(64)),
    optional("held_utc_ns", BigInteger),
    column("hold_reason", Text),
)
"""Note of the last shift about a vehicle; while `held_by` is given, none of its telecommands is released or sent."""

LINKS = table(
    "links",
    key("name", String(64)),
    column("ccsds_id", Integer),
    column("instance", String(96)),
    optional("owner", String(96)),
    column("lease_utc_ns", BigInteger),
    column("state", String(16)),
    optional("reason", Text),
    column("octets", BigInteger),
    *optionals(BigInteger, "heard_utc_ns", "clock_offset_ns"),
    *columns(BigInteger, "considered_utc_ns", "send_requested", "send_done", "changed_utc_ns"),
)
"""State of a connection to a ground station; one process at a time owns it.

`lease_utc_ns` is the end of the lease of the owner, wall time. `heard_utc_ns` is the mission time of the last
reception, `considered_utc_ns` the mission time up to which predicted contacts were compared with receptions.
"""

LEASES = table("leases", key("name", String(64)), optional("owner", String(96)), column("lease_utc_ns", BigInteger))
"""Right of one process among many to do recurring work, until `lease_utc_ns` by the clock of the database."""

CONTACTS = table(
    "contacts",
    key("id", BigKey),
    *columns(String(64), "link", "station"),
    column("vehicle_id", ForeignKey("vehicles.id")),
    column("state", String(16)),
    optional("reason", Text),
    column("start_utc_ns", BigInteger),
    *optionals(BigInteger, "stop_utc_ns", "predicted_start_utc_ns", "predicted_stop_utc_ns"),
    column("octets", BigInteger),
    column("telecommands", Integer),
    Index("ix_contacts_link_id", "link", "id"),
)
"""Contact over a link: open, ended or missed; times are mission time."""

TRANSMISSIONS = table(
    "transmissions",
    key("id", BigKey),
    column("link", String(64), index=True),
    column("vehicle_id", ForeignKey("vehicles.id")),
    optional("contact_id", BigInteger),
    column("octets", LargeBinary),
    column("telecommands", JSON),
    column("attempts", Integer),
    column("taken_utc_ns", BigInteger),
    optional("transmitted_utc_ns", BigInteger),
)
"""Octets of telecommands for one link; `transmitted_utc_ns` (mission time) is NULL until they are on the wire."""

COMMAND_COUNTERS = table(
    "command_counters", key("vehicle_id", ForeignKey("vehicles.id")), column("telecommands", BigInteger)
)
"""Number of telecommand sequence counts assigned for a vehicle; locked during commanding."""

WINDOWS = table(
    "windows",
    key("id", Integer),
    column("vehicle_id", ForeignKey("vehicles.id")),
    column("name", Text),
    *columns(BigInteger, "start_utc_ns", "stop_utc_ns"),
    column("cadence_s", Double),
    *columns(String(16), "decision", "state"),
    optional("reason", Text),
    optional("predecessor_id", ForeignKey("windows.id")),
    optional("ephemeris_id", ForeignKey("ephemerides.id")),
    optional("pass_id", ForeignKey("passes.id")),
    optional("mission_id", ForeignKey("missions.id")),
    column("data_octets", BigInteger),
    column("predicted", JSON),
    column("closed", Flag, server_default="0"),
    optional("uploads", JSON),
    column("version", Integer),
    *columns(String(64), "created_by", "edited_by"),
    optional("decided_by", String(64)),
    *columns(BigInteger, "created_utc_ns", "changed_utc_ns"),
    optional("request_id", ForeignKey("standing_requests.id")),
    Index("ix_windows_vehicle_id_start_utc_ns", "vehicle_id", "start_utc_ns"),
)
"""Planned observation window.

`decision` is the decision of a person (draft, approved, failed). `state` is the progress of the window including
telemetry, updated by `planning.progress`. `version` counts changes by persons. `edited_by` added the window
or changed it last, `decided_by` made the decision. `closed`: it is processed although telemetry is missing.
`uploads` is what its telecommands load on board.
"""

STANDING_REQUESTS = table(
    "standing_requests",
    key("id", Integer),
    column("vehicle_id", ForeignKey("vehicles.id")),
    column("name", Text),
    column("state", String(16)),
    column("priority", Integer),
    column("terms", JSON),
    optional("plan", JSON),
    column("plans", Integer),
    optional("planned_utc_ns", BigInteger),
    column("anchor_utc_ns", BigInteger),
    column("version", Integer),
    column("created_by", String(64)),
    *columns(BigInteger, "created_utc_ns", "changed_utc_ns"),
)
"""Standing request with its last plan; `plans` counts plans, so that one of several processes stores each."""

LANDMARKS = table(
    "landmarks",
    key("id", Integer),
    column("spacecraft_id", Integer),
    column("state", String(16)),
    *columns(Double, "latitude_deg", "longitude_deg", "height_m", "sigma_east_m", "sigma_north_m"),
    *columns(Double, "sigma_up_m", "diameter_m", "diameter_sigma_m"),
    *columns(Integer, "passes", "sightings", "looks"),
    column("score", Double),
    column("evidence", JSON),
    optional("decided_by", String(64)),
    optional("decided_utc_ns", BigInteger),
    optional("reason", Text),
    *columns(BigInteger, "created_utc_ns", "changed_utc_ns"),
    Index("ix_landmarks_spacecraft_id_state", "spacecraft_id", "state"),
)
"""Place at which detections recur that no catalogued crater explains.

`evidence` has the place and the sightings of each pass that looked at it. `state` is seen, proposed, accepted or
rejected.
"""

BUILDS = table(
    "builds",
    key("digest", String(64)),
    *columns(Text, "name", "version", "description"),
    column("kind", String(16)),
    column("files", JSON),
    optional("flight_code", String(64)),
    column("provenance", JSON),
    column("registered_by", String(64)),
    column("created_utc_ns", BigInteger),
    optional("file_sha256", ForeignKey("files.sha256")),
)
"""A payload build under test; `digest` is the hash of everything that decides what it does.

`file_sha256` is a zip file with the build file and all files of the build; NULL for builds of earlier versions, which
are only in the folder of the service.
"""

REGRESSION_ARCHIVES = table(
    "regression_archives",
    key("digest", String(64)),
    column("name", Text),
    column("manifest_sha256", String(64)),
    *columns(Integer, "frames", "frames_stored"),
    column("state", String(16)),
    column("reason", Text),
    optional("pass_id", Integer, index=True),
    column("octets", BigInteger),
    column("pinned", Flag),
    column("used_utc_ns", BigInteger, index=True),
    column("created_utc_ns", BigInteger),
)
"""A pass archive kept for replays; `digest` is the SHA-256 of the manifest that it was kept with."""

REPLAYS = table(
    "replays",
    key("id", String(64)),
    column("archive_digest", String(64), index=True),
    column("build_digest", String(64), index=True),
    column("outcome", String(16)),
    column("detail", Text),
    *optionals(String(64), "downlink_sha256", "performance_sha256"),
    *columns(Double, "wall_s", "cpu_s", "peak_rss_mib"),
    *columns(Text, "isolation", "machine"),
    column("created_utc_ns", BigInteger),
    optional("printed", Text),
)
"""Result of one build on one archive; `id` is the hash of both identities."""

REGRESSIONS = table(
    "regressions",
    key("id", String(32)),
    *columns(String(64), "baseline_digest", "candidate_digest"),
    column("verdict", String(16)),
    *columns(JSON, "result", "missions"),
    optional("html_sha256", String(64)),
    column("created_utc_ns", BigInteger),
)
"""A candidate build judged against a baseline over archived passes."""
