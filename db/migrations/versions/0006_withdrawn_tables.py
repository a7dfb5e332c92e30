"""Remove the layouts of the telemetry displays and the actions of automation rules.

Revision: 1.5, after 1.4
"""

from __future__ import annotations

from alembic import op

revision = "1.5"
down_revision = "1.4"
branch_labels = None
depends_on = None


def upgrade() -> None:
    for table in ("display_objects", "automation_actions"):
        op.drop_table(table)
