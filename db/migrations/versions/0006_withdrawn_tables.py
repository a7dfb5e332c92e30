"""Remove the layouts of the telemetry displays, the actions of automation rules and the link settings of receptions.

Revision: 1.5, after 1.4
"""

from alembic import op

revision = "1.5"
down_revision = "1.4"
branch_labels = None
depends_on = None


def upgrade() -> None:
    for table in ("display_objects", "automation_actions", "good_links"):
        op.drop_table(table)
