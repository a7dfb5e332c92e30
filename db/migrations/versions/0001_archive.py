"""Create the archive: files, packets, decoded samples, passes, jobs and reports.

Revision: 0001, the first
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
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
        "files",
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("octets", sa.BigInteger(), nullable=False),
        sa.Column("received_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("sha256", name=op.f("pk_files")),
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
        "jobs",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("arguments", sa.JSON(), nullable=False),
        sa.Column("progress", sa.Double(), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("result", sa.JSON(), nullable=True),
        sa.Column("error", sa.Text(), nullable=True),
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
        "vehicles",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("ccsds_id", sa.Integer(), nullable=False),
        sa.Column("instance", sa.String(length=96), nullable=False),
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
        sa.Column("points", sa.Integer(), nullable=False),
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
        "fragments",
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("digest", sa.LargeBinary(length=16), nullable=False),
        sa.Column("place", sa.String(length=8), nullable=False),
        sa.Column("octets", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_fragments_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint("vehicle_id", "digest", name=op.f("pk_fragments")),
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
        sa.ForeignKeyConstraint(["file_sha256"], ["files.sha256"], name=op.f("fk_ingests_file_sha256_files")),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_ingests_vehicle_id_vehicles")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_ingests")),
    )
    op.create_index(op.f("ix_ingests_file_sha256"), "ingests", ["file_sha256"], unique=False)
    op.create_index(op.f("ix_ingests_vehicle_id"), "ingests", ["vehicle_id"], unique=False)
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
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["catalogue_sha256"], ["files.sha256"], name=op.f("fk_passes_catalogue_sha256_files")
        ),
        sa.ForeignKeyConstraint(
            ["ephemeris_id"], ["ephemerides.id"], name=op.f("fk_passes_ephemeris_id_ephemerides")
        ),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_passes_vehicle_id_vehicles")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_passes")),
        sa.UniqueConstraint("archive_digest", name=op.f("uq_passes_archive_digest")),
    )
    op.create_index(
        "ix_passes_vehicle_id_start_utc_ns", "passes", ["vehicle_id", "start_utc_ns"], unique=False
    )
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
        "reports",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("pass_id", sa.Integer(), nullable=False),
        sa.Column("html_sha256", sa.String(length=64), nullable=False),
        sa.Column("json_sha256", sa.String(length=64), nullable=False),
        sa.Column("summary", sa.JSON(), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["html_sha256"], ["files.sha256"], name=op.f("fk_reports_html_sha256_files")),
        sa.ForeignKeyConstraint(["json_sha256"], ["files.sha256"], name=op.f("fk_reports_json_sha256_files")),
        sa.ForeignKeyConstraint(["pass_id"], ["passes.id"], name=op.f("fk_reports_pass_id_passes")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_reports")),
    )
    op.create_index(op.f("ix_reports_pass_id"), "reports", ["pass_id"], unique=False)


def downgrade() -> None:
    op.drop_index(op.f("ix_reports_pass_id"), table_name="reports")
    op.drop_table("reports")
    op.drop_table("pass_frames")
    op.drop_index("ix_passes_vehicle_id_start_utc_ns", table_name="passes")
    op.drop_table("passes")
    op.drop_index(op.f("ix_ingests_vehicle_id"), table_name="ingests")
    op.drop_index(op.f("ix_ingests_file_sha256"), table_name="ingests")
    op.drop_table("ingests")
    op.drop_table("fragments")
    op.drop_table("ephemerides")
    op.drop_index(op.f("ix_correlations_vehicle_id"), table_name="correlations")
    op.drop_table("correlations")
    op.drop_table("verifications")
    op.drop_table("vehicles")
    op.drop_table("time_reports")
    op.drop_table("packets")
    op.drop_table("navigation_states")
    op.drop_index(op.f("ix_jobs_state"), table_name="jobs")
    op.drop_table("jobs")
    op.drop_table("housekeeping")
    op.drop_table("frame_outcomes")
    op.drop_table("files")
    op.drop_table("events")
    op.drop_table("detections")
