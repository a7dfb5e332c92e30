"""Create the schema of version 1.0: files, packets, decoded samples, passes, commands, windows, users, audit, builds.

Databases of the eleven revisions before it cannot be migrated; their raw files can be ingested again.

Revision: 1.0, the first
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "1.0"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "answers",
        sa.Column("key", sa.String(length=64), nullable=False),
        sa.Column("request", sa.String(length=64), nullable=False),
        sa.Column("answer", sa.JSON(), nullable=True),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("key", name=op.f("pk_answers")),
    )
    op.create_table(
        "audit",
        sa.Column("id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("actor", sa.String(length=64), nullable=False),
        sa.Column("action", sa.String(length=48), nullable=False),
        sa.Column("target", sa.Text(), nullable=False),
        sa.Column("detail", sa.JSON(), nullable=False),
        sa.Column("previous_sha256", sa.String(length=64), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_audit")),
    )
    op.create_index(op.f("ix_audit_utc_ns"), "audit", ["utc_ns"], unique=False)
    head = op.create_table(
        "audit_head",
        sa.Column("id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("number", sa.BigInteger(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_audit_head")),
    )
    op.bulk_insert(head, [{"id": 1, "number": 0, "sha256": "0" * 64}])
    op.create_table(
        "row_digests",
        sa.Column("table_name", sa.String(length=64), nullable=False),
        sa.Column("row_key", sa.Text(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.PrimaryKeyConstraint("table_name", "row_key", name=op.f("pk_row_digests")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "detections",
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("dictionary_version", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("ticks", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_ticks", sa.BigInteger(), nullable=False),
        sa.Column("frame_number", sa.BigInteger(), nullable=False),
        sa.Column("image_quality", sa.SmallInteger(), nullable=False),
        sa.Column("count", sa.SmallInteger(), nullable=False),
        sa.Column("items", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint(
            "vehicle_id", "dictionary_version", "ticks", "packet_id", name=op.f("pk_detections")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "events",
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("dictionary_version", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("ticks", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("severity", sa.SmallInteger(), nullable=False),
        sa.Column("event_id", sa.Integer(), nullable=False),
        sa.Column("frame_number", sa.BigInteger(), nullable=False),
        sa.Column("value_1", sa.Double(), nullable=True),
        sa.Column("value_2", sa.Double(), nullable=True),
        sa.PrimaryKeyConstraint(
            "vehicle_id", "dictionary_version", "ticks", "packet_id", name=op.f("pk_events")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "event_log",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("payload", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_event_log")),
    )
    op.create_table(
        "event_positions",
        sa.Column("consumer", sa.String(length=32), nullable=False),
        sa.Column("number", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("consumer", name=op.f("pk_event_positions")),
    )
    op.create_table(
        "files",
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("octets", sa.BigInteger(), nullable=False),
        sa.Column("received_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("sha256", name=op.f("pk_files")),
    )
    op.create_table(
        "builds",
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("version", sa.Text(), nullable=False),
        sa.Column("description", sa.Text(), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("files", sa.JSON(), nullable=False),
        sa.Column("flight_code", sa.String(length=64), nullable=True),
        sa.Column("provenance", sa.JSON(), nullable=False),
        sa.Column("registered_by", sa.String(length=64), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("file_sha256", sa.String(length=64), nullable=True),
        sa.ForeignKeyConstraint(["file_sha256"], ["files.sha256"], name=op.f("fk_builds_file_sha256_files")),
        sa.PrimaryKeyConstraint("digest", name=op.f("pk_builds")),
    )
    op.create_table(
        "filter_states",
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("dictionary_version", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("ticks", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_ticks", sa.BigInteger(), nullable=False),
        sa.Column("frame_number", sa.BigInteger(), nullable=False),
        sa.Column("values", sa.LargeBinary(), nullable=False),
        sa.Column("innovation_degrees", sa.Integer(), nullable=True),
        sa.PrimaryKeyConstraint(
            "vehicle_id", "dictionary_version", "ticks", "packet_id", name=op.f("pk_filter_states")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "frame_outcomes",
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("dictionary_version", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("ticks", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_ticks", sa.BigInteger(), nullable=False),
        sa.Column("frame_number", sa.BigInteger(), nullable=False),
        sa.Column("estimator", sa.SmallInteger(), nullable=False),
        sa.Column("outcome", sa.SmallInteger(), nullable=False),
        sa.Column("reset_trigger", sa.SmallInteger(), nullable=False),
        sa.Column("detections", sa.SmallInteger(), nullable=False),
        sa.Column("candidate_pairs", sa.Integer(), nullable=False),
        sa.Column("pairs", sa.SmallInteger(), nullable=False),
        sa.Column("shift_east_m", sa.Float(), nullable=True),
        sa.Column("shift_north_m", sa.Float(), nullable=True),
        sa.Column("anchor_reads", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint(
            "vehicle_id", "dictionary_version", "ticks", "packet_id", name=op.f("pk_frame_outcomes")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "housekeeping",
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("dictionary_version", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("ticks", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("boot_count", sa.Integer(), nullable=False),
        sa.Column("mode", sa.SmallInteger(), nullable=False),
        sa.Column("frames_processed", sa.BigInteger(), nullable=False),
        sa.Column("frames_bad", sa.BigInteger(), nullable=False),
        sa.Column("detections_total", sa.BigInteger(), nullable=False),
        sa.Column("packets_sent", sa.BigInteger(), nullable=False),
        sa.Column("anchor_reads", sa.BigInteger(), nullable=False),
        sa.Column("events_sent", sa.BigInteger(), nullable=False),
        sa.Column("telecommands_accepted", sa.Integer(), nullable=False),
        sa.Column("telecommands_rejected", sa.Integer(), nullable=False),
        sa.Column("last_image_quality", sa.SmallInteger(), nullable=False),
        sa.Column("temperature_c", sa.Double(), nullable=False),
        sa.Column("bus_voltage_v", sa.Double(), nullable=False),
        sa.Column("power_w", sa.Double(), nullable=False),
        sa.Column("memory_used_kib", sa.BigInteger(), nullable=False),
        sa.Column("queue_depth", sa.Integer(), nullable=False),
        sa.Column("storage_used_permille", sa.Integer(), nullable=False),
        sa.Column("model_hash", sa.BigInteger(), nullable=False),
        sa.Column("parameters_hash", sa.BigInteger(), nullable=False),
        sa.Column("catalogue_hash", sa.BigInteger(), nullable=False),
        sa.Column("anchor_table_hash", sa.BigInteger(), nullable=False),
        sa.Column("clock_status", sa.SmallInteger(), nullable=False),
        sa.Column("watchdog_resets", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint(
            "vehicle_id", "dictionary_version", "ticks", "packet_id", name=op.f("pk_housekeeping")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "identifications",
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("dictionary_version", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("ticks", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_ticks", sa.BigInteger(), nullable=False),
        sa.Column("frame_number", sa.BigInteger(), nullable=False),
        sa.Column("count", sa.SmallInteger(), nullable=False),
        sa.Column("items", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint(
            "vehicle_id", "dictionary_version", "ticks", "packet_id", name=op.f("pk_identifications")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "jobs",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("arguments", sa.JSON(), nullable=False),
        sa.Column("progress", sa.Double(), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("result", sa.JSON(), nullable=True),
        sa.Column("error", sa.Text(), nullable=True),
        sa.Column("traceparent", sa.String(length=55), nullable=True),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("started_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("finished_utc_ns", sa.BigInteger(), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_jobs")),
    )
    op.create_index(op.f("ix_jobs_state"), "jobs", ["state"], unique=False)
    op.create_table(
        "navigation_states",
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("dictionary_version", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("ticks", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_ticks", sa.BigInteger(), nullable=False),
        sa.Column("frame_number", sa.BigInteger(), nullable=False),
        sa.Column("estimator", sa.SmallInteger(), nullable=False),
        sa.Column("outcome", sa.SmallInteger(), nullable=False),
        sa.Column("latitude_deg", sa.Double(), nullable=True),
        sa.Column("longitude_deg", sa.Double(), nullable=True),
        sa.Column("altitude_m", sa.Double(), nullable=True),
        sa.Column("velocity_x_m_s", sa.Float(), nullable=True),
        sa.Column("velocity_y_m_s", sa.Float(), nullable=True),
        sa.Column("velocity_z_m_s", sa.Float(), nullable=True),
        sa.Column("sigma_r_m", sa.Float(), nullable=True),
        sa.Column("sigma_t_m", sa.Float(), nullable=True),
        sa.Column("sigma_n_m", sa.Float(), nullable=True),
        sa.Column("nis", sa.Float(), nullable=True),
        sa.Column("matched", sa.SmallInteger(), nullable=False),
        sa.PrimaryKeyConstraint(
            "vehicle_id", "dictionary_version", "ticks", "packet_id", name=op.f("pk_navigation_states")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "packets",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("apid", sa.SmallInteger(), nullable=False),
        sa.Column("sequence_count", sa.SmallInteger(), nullable=False),
        sa.Column("ticks", sa.BigInteger(), nullable=False),
        sa.Column("digest", sa.LargeBinary(length=16), nullable=False),
        sa.Column("octets", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_packets")),
        sa.UniqueConstraint(
            "vehicle_id",
            "apid",
            "ticks",
            "sequence_count",
            "digest",
            name=op.f("uq_packets_vehicle_id_apid_ticks_sequence_count_digest"),
        ),
    )
    op.create_table(
        "regression_archives",
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("manifest_sha256", sa.String(length=64), nullable=False),
        sa.Column("frames", sa.Integer(), nullable=False),
        sa.Column("frames_stored", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("pass_id", sa.Integer(), nullable=True),
        sa.Column("octets", sa.BigInteger(), nullable=False),
        sa.Column("pinned", sa.SmallInteger(), nullable=False),
        sa.Column("used_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("digest", name=op.f("pk_regression_archives")),
    )
    op.create_index(op.f("ix_regression_archives_pass_id"), "regression_archives", ["pass_id"], unique=False)
    op.create_index(
        op.f("ix_regression_archives_used_utc_ns"), "regression_archives", ["used_utc_ns"], unique=False
    )
    op.create_table(
        "regressions",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("baseline_digest", sa.String(length=64), nullable=False),
        sa.Column("candidate_digest", sa.String(length=64), nullable=False),
        sa.Column("verdict", sa.String(length=16), nullable=False),
        sa.Column("result", sa.JSON(), nullable=False),
        sa.Column("missions", sa.JSON(), nullable=False),
        sa.Column("html_sha256", sa.String(length=64), nullable=True),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_regressions")),
    )
    op.create_table(
        "replays",
        sa.Column("id", sa.String(length=64), nullable=False),
        sa.Column("archive_digest", sa.String(length=64), nullable=False),
        sa.Column("build_digest", sa.String(length=64), nullable=False),
        sa.Column("outcome", sa.String(length=16), nullable=False),
        sa.Column("detail", sa.Text(), nullable=False),
        sa.Column("downlink_sha256", sa.String(length=64), nullable=True),
        sa.Column("performance_sha256", sa.String(length=64), nullable=True),
        sa.Column("wall_s", sa.Double(), nullable=False),
        sa.Column("cpu_s", sa.Double(), nullable=False),
        sa.Column("peak_rss_mib", sa.Double(), nullable=False),
        sa.Column("isolation", sa.Text(), nullable=False),
        sa.Column("machine", sa.Text(), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_replays")),
    )
    op.create_index(op.f("ix_replays_archive_digest"), "replays", ["archive_digest"], unique=False)
    op.create_index(op.f("ix_replays_build_digest"), "replays", ["build_digest"], unique=False)
    op.create_table(
        "rollups",
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("dictionary_version", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("kind", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("part", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("level", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("bucket", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("first_ticks", sa.BigInteger(), nullable=False),
        sa.Column("last_ticks", sa.BigInteger(), nullable=False),
        sa.Column("rows", sa.BigInteger(), nullable=False),
        sa.Column("statistics", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint(
            "vehicle_id", "dictionary_version", "kind", "part", "level", "bucket", name=op.f("pk_rollups")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "time_reports",
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("dictionary_version", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("ticks", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("reported_ticks", sa.BigInteger(), nullable=False),
        sa.Column("rate_exponent", sa.SmallInteger(), nullable=False),
        sa.PrimaryKeyConstraint(
            "vehicle_id", "dictionary_version", "ticks", "packet_id", name=op.f("pk_time_reports")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "users",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("role", sa.String(length=16), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("issuer", sa.String(length=512), nullable=True),
        sa.Column("subject", sa.String(length=255), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_users")),
        sa.UniqueConstraint("issuer", "subject", name=op.f("uq_users_issuer_subject")),
        sa.UniqueConstraint("name", name=op.f("uq_users_name")),
    )
    op.create_table(
        "vehicles",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("ccsds_id", sa.Integer(), nullable=False),
        sa.Column("instance", sa.String(length=96), nullable=False),
        sa.Column("decoded_version", sa.SmallInteger(), nullable=True),
        sa.Column("redecoding_version", sa.SmallInteger(), nullable=True),
        sa.Column("redecoded_to", sa.BigInteger(), nullable=True),
        sa.Column("redecode_until", sa.BigInteger(), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_vehicles")),
        sa.UniqueConstraint("ccsds_id", "instance", name=op.f("uq_vehicles_ccsds_id_instance")),
    )
    op.create_table(
        "verifications",
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("dictionary_version", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("ticks", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("subtype", sa.SmallInteger(), nullable=False),
        sa.Column("request_id", sa.BigInteger(), nullable=False),
        sa.Column("step", sa.SmallInteger(), nullable=True),
        sa.Column("failure_code", sa.Integer(), nullable=True),
        sa.PrimaryKeyConstraint(
            "vehicle_id", "dictionary_version", "ticks", "packet_id", name=op.f("pk_verifications")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "correlations",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("method", sa.String(length=32), nullable=False),
        sa.Column("boot_count", sa.Integer(), nullable=True),
        sa.Column("start_ticks", sa.BigInteger(), nullable=False),
        sa.Column("stop_ticks", sa.BigInteger(), nullable=False),
        sa.Column("reference_ticks", sa.BigInteger(), nullable=False),
        sa.Column("reference_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("drift_ppb", sa.Double(), nullable=False),
        sa.Column("residual_rms_ns", sa.Double(), nullable=True),
        sa.Column("residual_max_ns", sa.Double(), nullable=True),
        sa.Column("points", sa.Integer(), nullable=False),
        sa.Column("rejected", sa.Integer(), nullable=False),
        sa.Column("superseded", sa.SmallInteger(), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_correlations_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_correlations")),
    )
    op.create_index(op.f("ix_correlations_vehicle_id"), "correlations", ["vehicle_id"], unique=False)
    op.create_table(
        "ephemerides",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("file_sha256", sa.String(length=64), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("object_name", sa.Text(), nullable=False),
        sa.Column("frame", sa.String(length=16), nullable=False),
        sa.Column("start_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("stop_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("states", sa.Integer(), nullable=False),
        sa.Column("precedence", sa.Integer(), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["file_sha256"], ["files.sha256"], name=op.f("fk_ephemerides_file_sha256_files")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_ephemerides")),
    )
    op.create_table(
        "ingests",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=True),
        sa.Column("file_sha256", sa.String(length=64), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("error", sa.Text(), nullable=True),
        sa.Column("dictionary_version", sa.Integer(), nullable=False),
        sa.Column("received_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("finished_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("accounting", sa.JSON(), nullable=False),
        sa.Column("first_ticks", sa.BigInteger(), nullable=True),
        sa.Column("last_ticks", sa.BigInteger(), nullable=True),
        sa.ForeignKeyConstraint(["file_sha256"], ["files.sha256"], name=op.f("fk_ingests_file_sha256_files")),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_ingests_vehicle_id_vehicles")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_ingests")),
    )
    op.create_index("ix_ingests_extent", "ingests", ["last_ticks", "first_ticks"], unique=False)
    op.create_index(op.f("ix_ingests_file_sha256"), "ingests", ["file_sha256"], unique=False)
    op.create_index(op.f("ix_ingests_vehicle_id"), "ingests", ["vehicle_id"], unique=False)
    op.create_table(
        "receptions",
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("ticks", sa.BigInteger(), nullable=False),
        sa.Column("sequence_count", sa.SmallInteger(), nullable=False),
        sa.Column("station", sa.String(length=64), nullable=False),
        sa.Column("earth_utc_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_receptions_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint(
            "vehicle_id", "ticks", "sequence_count", "station", name=op.f("pk_receptions")
        ),
    )
    op.create_table(
        "pieces",
        sa.Column(
            "ingest_id",
            sa.BigInteger().with_variant(sa.Integer(), "sqlite"),
            autoincrement=False,
            nullable=False,
        ),
        sa.Column("scope", sa.String(length=128), nullable=False),
        sa.Column("spacecraft_id", sa.Integer(), nullable=True),
        sa.Column("file_sha256", sa.String(length=64), nullable=False),
        sa.Column("octets", sa.BigInteger(), nullable=False),
        sa.Column("stream", sa.String(length=200), nullable=False),
        sa.Column("position", sa.BigInteger(), nullable=False),
        sa.Column("links_tried", sa.Integer(), nullable=True),
        sa.Column("station", sa.String(length=64), nullable=False),
        sa.Column("link", sa.String(length=200), nullable=True),
        sa.Column("packets_stored", sa.BigInteger(), nullable=False),
        sa.Column("packets_joined", sa.BigInteger(), nullable=False),
        sa.Column("samples_stored", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["file_sha256"], ["files.sha256"], name=op.f("fk_pieces_file_sha256_files")),
        sa.ForeignKeyConstraint(["ingest_id"], ["ingests.id"], name=op.f("fk_pieces_ingest_id_ingests")),
        sa.PrimaryKeyConstraint("ingest_id", name=op.f("pk_pieces")),
    )
    op.create_index(op.f("ix_pieces_file_sha256"), "pieces", ["file_sha256"])
    op.create_index("ix_pieces_place", "pieces", ["scope", "stream", "position"])
    op.create_index("ix_pieces_unread", "pieces", ["scope", "links_tried"])
    op.create_table(
        "alarms",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("source", sa.String(length=16), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("open", sa.SmallInteger(), nullable=True),
        sa.Column("severity", sa.SmallInteger(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("active", sa.SmallInteger(), nullable=False),
        sa.Column("count", sa.BigInteger(), nullable=False),
        sa.Column("value", sa.Double(), nullable=True),
        sa.Column("first_ticks", sa.BigInteger(), nullable=False),
        sa.Column("last_ticks", sa.BigInteger(), nullable=False),
        sa.Column("raised_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("acknowledged_by", sa.String(length=64), nullable=True),
        sa.Column("acknowledged_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("shelved_by", sa.String(length=64), nullable=True),
        sa.Column("shelved_until_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("cleared_utc_ns", sa.BigInteger(), nullable=True),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_alarms_vehicle_id_vehicles")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_alarms")),
        sa.UniqueConstraint(
            "vehicle_id", "source", "name", "open", name=op.f("uq_alarms_vehicle_id_source_name_open")
        ),
    )
    op.create_index("ix_alarms_newest", "alarms", ["open", "last_ticks"])
    op.create_table(
        "display_objects",
        sa.Column("key", sa.String(length=64), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("type", sa.Text(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("document", sa.Text(), nullable=False),
        sa.Column("octets", sa.Integer(), nullable=False),
        sa.Column("created_by", sa.String(length=64), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("changed_by", sa.String(length=64), nullable=False),
        sa.Column("changed_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("key", name=op.f("pk_display_objects")),
    )
    op.create_table(
        "alarm_changes",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("alarm_id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("actor", sa.String(length=64), nullable=False),
        sa.Column("change", sa.String(length=16), nullable=False),
        sa.Column("comment", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["alarm_id"], ["alarms.id"], name=op.f("fk_alarm_changes_alarm_id_alarms")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_alarm_changes")),
    )
    op.create_index(op.f("ix_alarm_changes_alarm_id"), "alarm_changes", ["alarm_id"])
    op.create_table(
        "alarm_positions",
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("packet_id", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_alarm_positions_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint("vehicle_id", name=op.f("pk_alarm_positions")),
    )
    op.create_table(
        "good_links",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("station", sa.String(length=64), nullable=False),
        sa.Column("settings", sa.JSON(), nullable=False),
        sa.Column("ingest_id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("since_utc_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["ingest_id"], ["ingests.id"], name=op.f("fk_good_links_ingest_id_ingests")),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_good_links_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_good_links")),
    )
    op.create_index("ix_good_links_newest", "good_links", ["vehicle_id", "station", "id"])
    op.create_table(
        "known_links",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("scope", sa.String(length=128), nullable=False),
        sa.Column("digest", sa.String(length=16), nullable=False),
        sa.Column("settings", sa.JSON(), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_known_links")),
        sa.UniqueConstraint("scope", "digest", name=op.f("uq_known_links_scope_digest")),
    )
    op.create_table(
        "stream_edges",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("domain", sa.String(length=200), nullable=False),
        sa.Column("identity", sa.LargeBinary(length=16), nullable=False),
        sa.Column("role", sa.SmallInteger(), nullable=False),
        sa.Column("open", sa.SmallInteger(), nullable=False),
        sa.Column("count", sa.SmallInteger(), nullable=False),
        sa.Column("next_count", sa.SmallInteger(), nullable=False),
        sa.Column("fit", sa.Integer(), nullable=False),
        sa.Column("file_sha256", sa.String(length=64), nullable=True),
        sa.Column("start", sa.BigInteger(), nullable=True),
        sa.Column("length", sa.Integer(), nullable=False),
        sa.Column("octets", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_stream_edges")),
        sa.UniqueConstraint("domain", "identity", name=op.f("uq_stream_edges_domain_identity")),
    )
    op.create_index("ix_stream_edges_fit", "stream_edges", ["domain", "role", "open", "fit", "count"])
    op.create_index("ix_stream_edges_count", "stream_edges", ["domain", "role", "open", "count"])
    op.create_index("ix_stream_edges_next", "stream_edges", ["domain", "role", "open", "next_count"])
    op.create_index("ix_stream_edges_newest", "stream_edges", ["domain", "role", "open", "id"])
    op.create_index("ix_stream_edges_file", "stream_edges", ["file_sha256", "open"])
    op.create_table(
        "command_counters",
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("telecommands", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_command_counters_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint("vehicle_id", name=op.f("pk_command_counters")),
    )
    op.create_table(
        "missions",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("revision", sa.String(length=64), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("ccsds_id", sa.Integer(), nullable=True),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("entered_by", sa.String(length=64), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_missions")),
        sa.UniqueConstraint("revision", name=op.f("uq_missions_revision")),
    )
    op.create_index(op.f("ix_missions_ccsds_id"), "missions", ["ccsds_id"], unique=False)
    op.create_table(
        "telecommands",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("arguments", sa.JSON(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("critical", sa.SmallInteger(), nullable=False),
        sa.Column("timeout_s", sa.Integer(), nullable=False),
        sa.Column("requested_by", sa.String(length=64), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("decided_by", sa.String(length=64), nullable=True),
        sa.Column("decided_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("sequence_count", sa.SmallInteger(), nullable=True),
        sa.Column("request_id", sa.BigInteger(), nullable=True),
        sa.Column("octets", sa.LargeBinary(), nullable=True),
        sa.Column("sent_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("sent_after_ticks", sa.BigInteger(), nullable=True),
        sa.Column("timeout_noted_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("window_id", sa.Integer(), nullable=True),
        sa.Column("carrier_id", sa.BigInteger(), nullable=True),
        sa.Column("mission_id", sa.Integer(), nullable=True),
        sa.Column("send_before_utc_ns", sa.BigInteger(), nullable=True),
        sa.ForeignKeyConstraint(
            ["mission_id"], ["missions.id"], name=op.f("fk_telecommands_mission_id_missions")
        ),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_telecommands_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_telecommands")),
    )
    op.create_index(op.f("ix_telecommands_state"), "telecommands", ["state"], unique=False)
    op.create_index(
        "ix_telecommands_vehicle_id_request_id", "telecommands", ["vehicle_id", "request_id"], unique=False
    )
    op.create_index(op.f("ix_telecommands_window_id"), "telecommands", ["window_id"], unique=False)
    op.create_table(
        "tokens",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=False),
        sa.Column("token_sha256", sa.String(length=64), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("hint", sa.String(length=16), nullable=False),
        sa.Column("expires_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("revoked_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("used_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("parent_id", sa.Integer(), nullable=True),
        sa.Column("provider_session", sa.String(length=255), nullable=True),
        sa.ForeignKeyConstraint(["parent_id"], ["tokens.id"], name=op.f("fk_tokens_parent_id_tokens")),
        sa.ForeignKeyConstraint(["user_id"], ["users.id"], name=op.f("fk_tokens_user_id_users")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_tokens")),
        sa.UniqueConstraint("token_sha256", name=op.f("uq_tokens_token_sha256")),
    )
    op.create_index(op.f("ix_tokens_user_id"), "tokens", ["user_id"], unique=False)
    op.create_table(
        "packet_definitions",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("mission_id", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["mission_id"], ["missions.id"], name=op.f("fk_packet_definitions_mission_id_missions")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_packet_definitions")),
        sa.UniqueConstraint("digest", name=op.f("uq_packet_definitions_digest")),
    )
    op.create_table(
        "packet_decodings",
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("definition_id", sa.Integer(), nullable=False),
        sa.Column("decoded_to", sa.BigInteger(), nullable=False),
        sa.Column("complete", sa.SmallInteger(), nullable=False),
        sa.Column("read_again_to", sa.BigInteger(), nullable=True),
        sa.Column("counts", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(
            ["definition_id"],
            ["packet_definitions.id"],
            name=op.f("fk_packet_decodings_definition_id_packet_definitions"),
        ),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_packet_decodings_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint("vehicle_id", "definition_id", name=op.f("pk_packet_decodings")),
    )
    op.create_table(
        "parameter_samples",
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("definition_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("container", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("ticks", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("values", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint(
            "vehicle_id",
            "definition_id",
            "container",
            "ticks",
            "packet_id",
            name=op.f("pk_parameter_samples"),
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "passes",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("start_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("stop_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("archive_digest", sa.String(length=64), nullable=True),
        sa.Column("manifest", sa.JSON(), nullable=False),
        sa.Column("ephemeris_id", sa.Integer(), nullable=True),
        sa.Column("catalogue_sha256", sa.String(length=64), nullable=True),
        sa.Column("attitude_sha256", sa.String(length=64), nullable=True),
        sa.Column("mission_id", sa.Integer(), nullable=True),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["attitude_sha256"], ["files.sha256"], name=op.f("fk_passes_attitude_sha256_files")
        ),
        sa.ForeignKeyConstraint(
            ["catalogue_sha256"], ["files.sha256"], name=op.f("fk_passes_catalogue_sha256_files")
        ),
        sa.ForeignKeyConstraint(
            ["ephemeris_id"], ["ephemerides.id"], name=op.f("fk_passes_ephemeris_id_ephemerides")
        ),
        sa.ForeignKeyConstraint(["mission_id"], ["missions.id"], name=op.f("fk_passes_mission_id_missions")),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_passes_vehicle_id_vehicles")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_passes")),
        sa.UniqueConstraint("archive_digest", name=op.f("uq_passes_archive_digest")),
    )
    op.create_index(
        "ix_passes_vehicle_id_start_utc_ns", "passes", ["vehicle_id", "start_utc_ns"], unique=False
    )
    op.create_table(
        "links",
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("ccsds_id", sa.Integer(), nullable=False),
        sa.Column("instance", sa.String(length=96), nullable=False),
        sa.Column("owner", sa.String(length=96), nullable=True),
        sa.Column("lease_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("octets", sa.BigInteger(), nullable=False),
        sa.Column("heard_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("clock_offset_ns", sa.BigInteger(), nullable=True),
        sa.Column("considered_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("send_requested", sa.BigInteger(), nullable=False),
        sa.Column("send_done", sa.BigInteger(), nullable=False),
        sa.Column("changed_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_links")),
    )
    op.create_table(
        "leases",
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("owner", sa.String(length=96), nullable=True),
        sa.Column("lease_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_leases")),
    )
    op.create_table(
        "contacts",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("link", sa.String(length=64), nullable=False),
        sa.Column("station", sa.String(length=64), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("start_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("stop_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("predicted_start_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("predicted_stop_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("octets", sa.BigInteger(), nullable=False),
        sa.Column("telecommands", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_contacts_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_contacts")),
    )
    op.create_index("ix_contacts_link_id", "contacts", ["link", "id"], unique=False)
    op.create_table(
        "transmissions",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("link", sa.String(length=64), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("contact_id", sa.BigInteger(), nullable=True),
        sa.Column("octets", sa.LargeBinary(), nullable=False),
        sa.Column("telecommands", sa.JSON(), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("taken_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("transmitted_utc_ns", sa.BigInteger(), nullable=True),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_transmissions_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_transmissions")),
    )
    op.create_index(op.f("ix_transmissions_link"), "transmissions", ["link"], unique=False)
    op.create_table(
        "pass_frames",
        sa.Column("pass_id", sa.Integer(), nullable=False),
        sa.Column("frame_number", sa.BigInteger(), nullable=False),
        sa.Column("file_sha256", sa.String(length=64), nullable=False),
        sa.ForeignKeyConstraint(
            ["file_sha256"], ["files.sha256"], name=op.f("fk_pass_frames_file_sha256_files")
        ),
        sa.ForeignKeyConstraint(["pass_id"], ["passes.id"], name=op.f("fk_pass_frames_pass_id_passes")),
        sa.PrimaryKeyConstraint("pass_id", "frame_number", name=op.f("pk_pass_frames")),
    )
    op.create_table(
        "monthly_reports",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("spacecraft_id", sa.Integer(), nullable=False),
        sa.Column("instance", sa.String(length=96), nullable=False),
        sa.Column("month", sa.String(length=7), nullable=False),
        sa.Column("passes", sa.Integer(), nullable=False),
        sa.Column("verdict", sa.Text(), nullable=False),
        sa.Column("html_sha256", sa.String(length=64), nullable=False),
        sa.Column("pdf_sha256", sa.String(length=64), nullable=False),
        sa.Column("json_sha256", sa.String(length=64), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["html_sha256"], ["files.sha256"], name=op.f("fk_monthly_reports_html_sha256_files")
        ),
        sa.ForeignKeyConstraint(
            ["json_sha256"], ["files.sha256"], name=op.f("fk_monthly_reports_json_sha256_files")
        ),
        sa.ForeignKeyConstraint(
            ["pdf_sha256"], ["files.sha256"], name=op.f("fk_monthly_reports_pdf_sha256_files")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_monthly_reports")),
    )
    op.create_index(
        op.f("ix_monthly_reports_spacecraft_id"), "monthly_reports", ["spacecraft_id"], unique=False
    )
    op.create_table(
        "reports",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("pass_id", sa.Integer(), nullable=False),
        sa.Column("html_sha256", sa.String(length=64), nullable=False),
        sa.Column("json_sha256", sa.String(length=64), nullable=False),
        sa.Column("pdf_sha256", sa.String(length=64), nullable=True),
        sa.Column("summary", sa.JSON(), nullable=False),
        sa.Column("mission_id", sa.Integer(), nullable=True),
        sa.Column("event_number", sa.BigInteger(), nullable=True),
        sa.Column("previous_id", sa.String(length=32), nullable=True),
        sa.Column("changes", sa.JSON(), nullable=True),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["html_sha256"], ["files.sha256"], name=op.f("fk_reports_html_sha256_files")),
        sa.ForeignKeyConstraint(["json_sha256"], ["files.sha256"], name=op.f("fk_reports_json_sha256_files")),
        sa.ForeignKeyConstraint(["mission_id"], ["missions.id"], name=op.f("fk_reports_mission_id_missions")),
        sa.ForeignKeyConstraint(["pass_id"], ["passes.id"], name=op.f("fk_reports_pass_id_passes")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_reports")),
    )
    op.create_index(op.f("ix_reports_pass_id"), "reports", ["pass_id"], unique=False)
    op.create_table(
        "standing_requests",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("priority", sa.Integer(), nullable=False),
        sa.Column("terms", sa.JSON(), nullable=False),
        sa.Column("plan", sa.JSON(), nullable=True),
        sa.Column("plans", sa.Integer(), nullable=False),
        sa.Column("planned_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("anchor_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("created_by", sa.String(length=64), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("changed_utc_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_standing_requests_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_standing_requests")),
    )
    op.create_table(
        "windows",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("start_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("stop_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("cadence_s", sa.Double(), nullable=False),
        sa.Column("decision", sa.String(length=16), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("predecessor_id", sa.Integer(), nullable=True),
        sa.Column("ephemeris_id", sa.Integer(), nullable=True),
        sa.Column("pass_id", sa.Integer(), nullable=True),
        sa.Column("mission_id", sa.Integer(), nullable=True),
        sa.Column("data_octets", sa.BigInteger(), nullable=False),
        sa.Column("predicted", sa.JSON(), nullable=False),
        sa.Column("closed", sa.SmallInteger(), server_default="0", nullable=False),
        sa.Column("uploads", sa.JSON(), nullable=True),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("created_by", sa.String(length=64), nullable=False),
        sa.Column("edited_by", sa.String(length=64), nullable=False),
        sa.Column("decided_by", sa.String(length=64), nullable=True),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("changed_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("request_id", sa.Integer(), nullable=True),
        sa.ForeignKeyConstraint(
            ["ephemeris_id"], ["ephemerides.id"], name=op.f("fk_windows_ephemeris_id_ephemerides")
        ),
        sa.ForeignKeyConstraint(["mission_id"], ["missions.id"], name=op.f("fk_windows_mission_id_missions")),
        sa.ForeignKeyConstraint(["pass_id"], ["passes.id"], name=op.f("fk_windows_pass_id_passes")),
        sa.ForeignKeyConstraint(
            ["predecessor_id"], ["windows.id"], name=op.f("fk_windows_predecessor_id_windows")
        ),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_windows_vehicle_id_vehicles")),
        sa.ForeignKeyConstraint(
            ["request_id"], ["standing_requests.id"], name=op.f("fk_windows_request_id_standing_requests")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_windows")),
    )
    op.create_index(
        "ix_windows_vehicle_id_start_utc_ns", "windows", ["vehicle_id", "start_utc_ns"], unique=False
    )

    op.create_table(
        "automation_actions",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("event_number", sa.BigInteger(), nullable=False),
        sa.Column("trigger", sa.String(length=32), nullable=False),
        sa.Column("rule", sa.String(length=100), nullable=False),
        sa.Column("position", sa.SmallInteger(), nullable=False),
        sa.Column("action", sa.String(length=32), nullable=False),
        sa.Column("subject", sa.String(length=32), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=True),
        sa.Column("pass_id", sa.Integer(), nullable=True),
        sa.Column("window_id", sa.Integer(), nullable=True),
        sa.Column("mission_id", sa.Integer(), nullable=True),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("result", sa.JSON(), nullable=True),
        sa.Column("error", sa.Text(), nullable=True),
        sa.Column("attempts", sa.SmallInteger(), nullable=False),
        sa.Column("next_attempt_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("decided_by", sa.String(length=64), nullable=True),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("changed_utc_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["mission_id"], ["missions.id"], name=op.f("fk_automation_actions_mission_id_missions")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_automation_actions")),
        sa.UniqueConstraint(
            "event_number",
            "rule",
            "position",
            "subject",
            name=op.f("uq_automation_actions_event_number_rule_position_subject"),
        ),
    )
    op.create_index(op.f("ix_automation_actions_pass_id"), "automation_actions", ["pass_id"], unique=False)
    op.create_index(op.f("ix_automation_actions_state"), "automation_actions", ["state"], unique=False)
    op.create_table(
        "landmarks",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("spacecraft_id", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        *(
            sa.Column(name, sa.Double(), nullable=False)
            for name in (
                "latitude_deg", "longitude_deg", "height_m", "sigma_east_m", "sigma_north_m", "sigma_up_m",
                "diameter_m", "diameter_sigma_m",
            )
        ),
        sa.Column("passes", sa.Integer(), nullable=False),
        sa.Column("sightings", sa.Integer(), nullable=False),
        sa.Column("looks", sa.Integer(), nullable=False),
        sa.Column("score", sa.Double(), nullable=False),
        sa.Column("evidence", sa.JSON(), nullable=False),
        sa.Column("decided_by", sa.String(length=64), nullable=True),
        sa.Column("decided_utc_ns", sa.BigInteger(), nullable=True),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("changed_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_landmarks")),
    )  # fmt: skip
    op.create_index("ix_landmarks_spacecraft_id_state", "landmarks", ["spacecraft_id", "state"], unique=False)


def downgrade() -> None:
    op.drop_table("landmarks")
    op.drop_table("transmissions")
    op.drop_table("contacts")
    op.drop_table("leases")
    op.drop_table("links")
    op.drop_table("automation_actions")
    op.drop_table("windows")
    op.drop_table("standing_requests")
    op.drop_table("reports")
    op.drop_table("monthly_reports")
    op.drop_table("pass_frames")
    op.drop_table("passes")
    op.drop_table("parameter_samples")
    op.drop_table("packet_decodings")
    op.drop_table("packet_definitions")
    op.drop_table("tokens")
    op.drop_table("telecommands")
    op.drop_table("missions")
    op.drop_table("command_counters")
    op.drop_table("stream_edges")
    op.drop_table("known_links")
    op.drop_table("good_links")
    op.drop_table("alarm_positions")
    op.drop_table("display_objects")
    op.drop_table("alarm_changes")
    op.drop_table("alarms")
    op.drop_table("pieces")
    op.drop_table("receptions")
    op.drop_table("ingests")
    op.drop_table("ephemerides")
    op.drop_table("correlations")
    op.drop_table("verifications")
    op.drop_table("vehicles")
    op.drop_table("users")
    op.drop_table("time_reports")
    op.drop_table("rollups")
    op.drop_table("replays")
    op.drop_table("regressions")
    op.drop_table("regression_archives")
    op.drop_table("packets")
    op.drop_table("navigation_states")
    op.drop_table("jobs")
    op.drop_table("identifications")
    op.drop_table("housekeeping")
    op.drop_table("frame_outcomes")
    op.drop_table("filter_states")
    op.drop_table("builds")
    op.drop_table("files")
    op.drop_table("event_positions")
    op.drop_table("event_log")
    op.drop_table("events")
    op.drop_table("detections")
    op.drop_table("row_digests")
    op.drop_table("audit_head")
    op.drop_table("audit")
    op.drop_table("answers")
