"""Add roll-ups of sample series, states of the navigation filter and identifications, and reports as PDF.

Revision: 0007, after 0006
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

_SAMPLE = ("vehicle_id", "dictionary_version", "ticks", "packet_id")


def _sample_columns() -> list[sa.Column]:
    return [
        sa.Column("vehicle_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("dictionary_version", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("ticks", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("packet_ticks", sa.BigInteger(), nullable=False),
        sa.Column("frame_number", sa.BigInteger(), nullable=False),
    ]


def upgrade() -> None:
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
        "filter_states",
        *_sample_columns(),
        sa.Column("values", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint(*_SAMPLE, name=op.f("pk_filter_states")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "identifications",
        *_sample_columns(),
        sa.Column("count", sa.SmallInteger(), nullable=False),
        sa.Column("items", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint(*_SAMPLE, name=op.f("pk_identifications")),
        sqlite_with_rowid=False,
    )
    op.add_column("reports", sa.Column("pdf_sha256", sa.String(length=64), nullable=True))


def downgrade() -> None:
    op.drop_column("reports", "pdf_sha256")
    op.drop_table("identifications")
    op.drop_table("filter_states")
    op.drop_table("rollups")
