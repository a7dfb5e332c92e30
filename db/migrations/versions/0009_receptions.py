"""Add when time reports were received, and how well each time correlation fits.

Revision: 0009, after 0008
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
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
    op.add_column("correlations", sa.Column("residual_max_ns", sa.Double(), nullable=True))
    op.add_column("correlations", sa.Column("rejected", sa.Integer(), nullable=False, server_default="0"))


def downgrade() -> None:
    op.drop_column("correlations", "rejected")
    op.drop_column("correlations", "residual_max_ns")
    op.drop_table("receptions")
