"""Add planned observation windows, and to telecommands the window and the command that carries them.

Revision: 0006, after 0005
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
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
        sa.Column("data_octets", sa.BigInteger(), nullable=False),
        sa.Column("predicted", sa.JSON(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("created_by", sa.String(length=64), nullable=False),
        sa.Column("created_utc_ns", sa.BigInteger(), nullable=False),
        sa.Column("changed_utc_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["ephemeris_id"], ["ephemerides.id"], name=op.f("fk_windows_ephemeris_id_ephemerides")
        ),
        sa.ForeignKeyConstraint(["pass_id"], ["passes.id"], name=op.f("fk_windows_pass_id_passes")),
        sa.ForeignKeyConstraint(
            ["predecessor_id"], ["windows.id"], name=op.f("fk_windows_predecessor_id_windows")
        ),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_windows_vehicle_id_vehicles")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_windows")),
    )
    op.create_index("ix_windows_vehicle_id_start_utc_ns", "windows", ["vehicle_id", "start_utc_ns"])
    op.add_column("telecommands", sa.Column("window_id", sa.Integer(), nullable=True))
    op.add_column("telecommands", sa.Column("carrier_id", sa.BigInteger(), nullable=True))
    op.create_index(op.f("ix_telecommands_window_id"), "telecommands", ["window_id"])


def downgrade() -> None:
    op.drop_index(op.f("ix_telecommands_window_id"), table_name="telecommands")
    op.drop_column("telecommands", "carrier_id")
    op.drop_column("telecommands", "window_id")
    op.drop_index("ix_windows_vehicle_id_start_utc_ns", table_name="windows")
    op.drop_table("windows")
