"""Add the packets whose on-board time is implausible.

Revision: 1.7, after 1.6
"""

import sqlalchemy as sa
from alembic import op

revision = "1.7"
down_revision = "1.6"
branch_labels = None
depends_on = None


def upgrade() -> None:
    key = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
    op.create_table(
        "implausible_packets",
        sa.Column("id", key, nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("ingest_id", key, nullable=False),
        sa.Column("apid", sa.SmallInteger(), nullable=False),
        sa.Column("sequence_count", sa.SmallInteger(), nullable=False),
        sa.Column("ticks", sa.BigInteger(), nullable=False),
        sa.Column("digest", sa.LargeBinary(length=16), nullable=False),
        sa.Column("octets", sa.LargeBinary(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_implausible_packets_vehicle_id_vehicles")
        ),
        sa.ForeignKeyConstraint(["ingest_id"], ["ingests.id"], name=op.f("fk_implausible_packets_ingest_id_ingests")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_implausible_packets")),
        sa.UniqueConstraint("vehicle_id", "digest", name=op.f("uq_implausible_packets_vehicle_id_digest")),
    )
    op.create_index(op.f("ix_implausible_packets_ingest_id"), "implausible_packets", ["ingest_id"])
