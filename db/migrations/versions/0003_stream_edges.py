"""Remember how ingested files begin and end instead of keeping loose octets a second time.

Revision: 0003, after 0002
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.drop_table("fragments")
    op.create_table(
        "stream_edges",
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("file_sha256", sa.String(length=64), nullable=False),
        sa.Column("link", sa.JSON(), nullable=True),
        sa.Column("octets", sa.BigInteger(), nullable=False),
        sa.Column("head_loose", sa.Integer(), nullable=False),
        sa.Column("tail_loose", sa.Integer(), nullable=False),
        sa.Column("head_count", sa.SmallInteger(), nullable=True),
        sa.Column("tail_count", sa.SmallInteger(), nullable=True),
        sa.ForeignKeyConstraint(
            ["file_sha256"], ["files.sha256"], name=op.f("fk_stream_edges_file_sha256_files")
        ),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_stream_edges_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint("vehicle_id", "file_sha256", name=op.f("pk_stream_edges")),
    )


def downgrade() -> None:
    op.drop_table("stream_edges")
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
