"""Add telecommands.

Revision: 0005, after 0004
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
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
        sa.ForeignKeyConstraint(
            ["vehicle_id"], ["vehicles.id"], name=op.f("fk_telecommands_vehicle_id_vehicles")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_telecommands")),
    )
    op.create_index(op.f("ix_telecommands_state"), "telecommands", ["state"])
    op.create_index("ix_telecommands_vehicle_id_request_id", "telecommands", ["vehicle_id", "request_id"])


def downgrade() -> None:
    op.drop_index("ix_telecommands_vehicle_id_request_id", table_name="telecommands")
    op.drop_index(op.f("ix_telecommands_state"), table_name="telecommands")
    op.drop_table("telecommands")
