"""Add payload builds, archives kept to be flown again, replays and regressions.

Revision: 0008, after 0007
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
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
        sa.PrimaryKeyConstraint("digest", name=op.f("pk_builds")),
    )
    op.create_table(
        "regression_archives",
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("manifest_sha256", sa.String(length=64), nullable=False),
        sa.Column("frames", sa.Integer(), nullable=False),
        sa.Column("octets", sa.BigInteger(), nullable=False),
        sa.Column("pinned", sa.SmallInteger(), nullable=False),
        sa.Column("used_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("digest", name=op.f("pk_regression_archives")),
    )
    op.create_index(op.f("ix_regression_archives_used_utc_ns"), "regression_archives", ["used_utc_ns"])
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
    op.create_index(op.f("ix_replays_archive_digest"), "replays", ["archive_digest"])
    op.create_index(op.f("ix_replays_build_digest"), "replays", ["build_digest"])
    op.create_table(
        "regressions",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("baseline_digest", sa.String(length=64), nullable=False),
        sa.Column("candidate_digest", sa.String(length=64), nullable=False),
        sa.Column("verdict", sa.String(length=16), nullable=False),
        sa.Column("result", sa.JSON(), nullable=False),
        sa.Column("html_sha256", sa.String(length=64), nullable=True),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_regressions")),
    )


def downgrade() -> None:
    op.drop_table("regressions")
    op.drop_index(op.f("ix_replays_build_digest"), table_name="replays")
    op.drop_index(op.f("ix_replays_archive_digest"), table_name="replays")
    op.drop_table("replays")
    op.drop_index(op.f("ix_regression_archives_used_utc_ns"), table_name="regression_archives")
    op.drop_table("regression_archives")
    op.drop_table("builds")
