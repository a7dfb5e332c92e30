"""Note per vehicle which dictionary version has decoded all of its packets, and how far a newer one has come.

What was decoded before is taken to be complete in the version that gave the most rows.

Revision: 0010, after 0009
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

SAMPLES = (
    "housekeeping", "detections", "navigation_states", "frame_outcomes", "events", "time_reports", "verifications",
    "filter_states", "identifications",
)  # fmt: skip


def upgrade() -> None:
    op.add_column("vehicles", sa.Column("decoded_version", sa.SmallInteger(), nullable=True))
    op.add_column("vehicles", sa.Column("redecoding_version", sa.SmallInteger(), nullable=True))
    op.add_column("vehicles", sa.Column("redecoded_to", sa.BigInteger(), nullable=True))
    op.add_column("vehicles", sa.Column("redecode_until", sa.BigInteger(), nullable=True))
    connection = op.get_bind()
    rows: dict[int, dict[int, int]] = {}
    for name in SAMPLES:
        counted = connection.execute(
            sa.text(
                f"SELECT vehicle_id, dictionary_version, count(*) FROM {name} "
                "GROUP BY vehicle_id, dictionary_version"
            )
        )
        for vehicle, version, count in counted:
            versions = rows.setdefault(vehicle, {})
            versions[version] = versions.get(version, 0) + count
    for vehicle, versions in rows.items():
        connection.execute(
            sa.text("UPDATE vehicles SET decoded_version = :version WHERE id = :vehicle"),
            {"version": max(versions, key=lambda version: (versions[version], version)), "vehicle": vehicle},
        )


def downgrade() -> None:
    for name in ("redecode_until", "redecoded_to", "redecoding_version", "decoded_version"):
        op.drop_column("vehicles", name)
